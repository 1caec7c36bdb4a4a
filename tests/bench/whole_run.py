"""How long `calib run` takes: 17 pictures and ten minutes of logs, again, and with one log changed.

    python tests/bench/whole_run.py [FOLDER]

Wall time and processor time of each run. Wall time means something on an idle machine only; over two
processors it cannot fall below half of the processor time. The first run of all compiles what numba
compiles and is not shown.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from calib.io.logs import log_text, read_log
from calib.twin.folder import write_rig_folder
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

WANTED_S = 600.0


def _folder(root: Path) -> Path:
    """The simulated rig's folder, with more at rest until there are ten minutes."""
    logs = write_rig_folder(root, SimulatedRig())
    seconds = sum(float(log.t_s[-1] - log.t_s[0]) for log in map(read_log, logs))
    more = (WANTED_S - seconds) / 2.0
    for seed in (101, 102):
        made = run_scenario(make_scenario("static"), SimulatedRig(), seed, "sensors", more)
        (root / "logs" / f"static{seed}.csv").write_text(log_text(log_of(made)))
    return root


def _timed(what: str, folder: Path, out: Path, *more: str) -> None:
    words = [
        sys.executable,
        "-c",
        "from calib.cli.main import main; main()",
        "run",
        str(folder),
        "-o",
        str(out),
    ]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run([*words, *more], capture_output=True, text=True, check=False)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - began
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"{what:<32} {wall:7.1f} s wall {spent:7.1f} s of processors, exit code {done.returncode}", flush=True
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "out"
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else _folder(Path(place) / "rig")
        _timed("(first, with compiling)", folder, out)
        _timed("everything again", folder, out, "--fresh")
        _timed("nothing changed", folder, out)
        log = sorted((folder / "logs").glob("*.csv"))[0]
        log.write_text(log.read_text().rstrip("\n").rpartition("\n")[0] + "\n")
        _timed(f"{log.name} one row shorter", folder, out)


if __name__ == "__main__":
    main()
