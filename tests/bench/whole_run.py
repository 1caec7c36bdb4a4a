"""How long `calib run` takes: the simulated rig, ten minutes of its logs, and again with one log changed.

    python tests/bench/whole_run.py [FOLDER]

Wall time and processor time of each run, and of the latter the ratio of what is wanted to what was found. Wall
time means something on an idle machine only; over two processors it cannot fall below half of the processor
time. The first run of all compiles what numba compiles, into a cache of its own.
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

from calib.io.logs import log_text, read_log
from calib.twin.folder import write_rig_folder
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

CALIB = [sys.executable, "-c", "from calib.cli.main import main; main()"]
WANTED_S = 600.0
COLD_S, WARM_S, UNCHANGED_S = 26.0, 20.0, 1.0


def _folder(root: Path) -> Path:
    """The simulated rig's folder, with more at rest until there are ten minutes."""
    logs = write_rig_folder(root, SimulatedRig())
    seconds = sum(float(log.t_s[-1] - log.t_s[0]) for log in map(read_log, logs))
    more = (WANTED_S - seconds) / 2.0
    for seed in (101, 102):
        made = run_scenario(make_scenario("static"), SimulatedRig(), seed, "sensors", more)
        (root / "logs" / f"static{seed}.csv").write_text(log_text(log_of(made)))
    return root


def rows(folder: Path | None = None) -> list[Row]:
    """A row for each run: a new rig of the twin, or a folder, cold, warm, unchanged and with a log changed."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "out"
        os.environ["NUMBA_CACHE_DIR"] = f"{place}/compiled"
        root = _folder(Path(place) / "rig") if folder is None else folder
        found = [
            _timed("calib run, compiling", COLD_S, root, out),
            _timed("calib run, again", WARM_S, root, out, "--fresh"),
            _timed("calib run, unchanged", UNCHANGED_S, root, out),
        ]
        log = sorted((root / "logs").glob("*.csv"))[0]
        log.write_text(log.read_text().rstrip("\n").rpartition("\n")[0] + "\n")
        return [*found, _timed(f"calib run, {log.name} shorter", None, root, out)]


def _timed(what: str, wanted_s: float | None, folder: Path, out: Path, *more: str) -> Row:
    words = [*CALIB, "run", str(folder), "-o", str(out), *more]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - began
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    note = f"processor time; {wall:.1f} s by the clock, exit code {done.returncode}"
    return Row(what, "wanted", spent, wanted_s, 1.0, note=note)


if __name__ == "__main__":
    print_rows(rows(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
