"""The same folder gives the same bytes: whatever the number of threads and processes, and the hash seed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from calib.io.logs import log_text
from calib.runner.graph import HIDDEN
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of

WAYS: dict[str, tuple[int, int, str, str]] = {
    "one": (1, 1, "1", "0"),
    "two": (2, 2, "2", "12345"),
}
"""Processors, stages at a time, threads asked of every library, hash seed."""

LOGS = (("static1", "static", 12.0, 0), ("swing", "swing", 8.0, 1))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    root = tmp_path_factory.mktemp("rig")
    shutil.copytree(project_root / "images", root / "images")
    (root / "logs").mkdir()
    for name, scenario, seconds, seed in LOGS:
        made = run_scenario(make_scenario(scenario), SimulatedRig(), seed, "truth", seconds)
        (root / "logs" / f"{name}.csv").write_text(log_text(log_of(made)))
    return root


def _on(processors: int) -> Callable[[], None]:
    free = sorted(os.sched_getaffinity(0))[:processors]
    return lambda: os.sched_setaffinity(0, free)


def _run(folder: Path, out: Path, way: str) -> dict[str, bytes]:
    """All that a run leaves, results of stages included."""
    processors, jobs, threads, seed = WAYS[way]
    names = ("OPENBLAS", "OMP", "MKL", "NUMBA", "VECLIB_MAXIMUM", "NUMEXPR")
    environment = {**os.environ, **{f"{name}_NUM_THREADS": threads for name in names}, "PYTHONHASHSEED": seed}
    words = ["run", str(folder), "-o", str(out), "--jobs", str(jobs)]
    ended = subprocess.run(
        [sys.executable, "-c", "from calib.cli.main import main; main()", *words],
        env=environment, capture_output=True, text=True, check=False, preexec_fn=_on(processors),
    )  # fmt: skip
    assert ended.returncode in (0, 1), ended.stderr
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and path != out / HIDDEN / "lock"
    }


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processors are given to a process on Linux only")
def test_any_number_of_threads_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    wanted = _run(folder, tmp_path / "one", "one")
    assert {"rig.yaml", "report.html", "firmware/calib_constants.h", "states/swing.csv"} <= set(wanted)
    # The same folder under another name, with other times.
    again = tmp_path / "a copy"
    shutil.copytree(folder, again, copy_function=shutil.copyfile)
    found = _run(again, tmp_path / "two", "two")
    assert set(found) == set(wanted)
    assert [name for name in wanted if found[name] != wanted[name]] == []
