"""How long `calib run` of the simulated rig takes: at first, again, and with nothing changed.

    python tests/bench/whole_run.py

Processor time, and the ratio of what is wanted to it; time by the clock, which means something on an idle
machine only and cannot fall below half of the former on two processors. The first run compiles what numba
compiles, into a cache of its own.
"""

from __future__ import annotations

import os
import tempfile

from _rows import CALIB, Row, print_rows, run

RUNS = {"compiling": (26.0, ()), "again": (20.0, ("--fresh",)), "unchanged": (1.0, ())}
"""Processor time [s] that is wanted of each run, and its options."""


def rows() -> list[Row]:
    """A row for each run."""
    found = []
    with tempfile.TemporaryDirectory() as place:
        os.environ["NUMBA_CACHE_DIR"] = f"{place}/compiled"
        for what, (wanted_s, more) in RUNS.items():
            done = run([*CALIB, "run", "-o", f"{place}/out", *more])
            note = f"processor time; {done.seconds:.1f} s by the clock, exit code {done.code}"
            found.append(Row(f"calib run, {what}", "wanted", done.cpu_s, wanted_s, 1.0, note=note))
    return found


if __name__ == "__main__":
    print_rows(rows())
