"""How long `calib run` of the simulated rig takes: at first, again, and with nothing changed.

    python tests/bench/whole_run.py

Processor time, and the ratio of what is wanted to it; time by the clock, which means something on an idle
machine only and cannot fall below half of the former on two processors. The first run compiles what numba
compiles, into a cache of its own.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE)]

from _rows import Row, print_rows

CALIB = [sys.executable, "-c", "from calib.cli.main import main; main()"]
RUNS = {"compiling": (26.0, ()), "again": (20.0, ("--fresh",)), "unchanged": (1.0, ())}
"""Processor time [s] that is wanted of each run, and its options."""


def rows() -> list[Row]:
    """A row for each run."""
    found = []
    with tempfile.TemporaryDirectory() as place:
        environment = {**os.environ, "NUMBA_CACHE_DIR": f"{place}/compiled"}
        for what, (wanted_s, more) in RUNS.items():
            words = [*CALIB, "run", "-o", f"{place}/out", *more]
            before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
            done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
            after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - began
            spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            note = f"processor time; {wall:.1f} s by the clock, exit code {done.returncode}"
            found.append(Row(f"calib run, {what}", "wanted", spent, wanted_s, 1.0, note=note))
    return found


if __name__ == "__main__":
    print_rows(rows())
