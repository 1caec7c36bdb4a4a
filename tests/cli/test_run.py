"""`calib run` as a person types it, and the same bytes whatever threads, processes and hash seeds."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from fleet_processes import COMMAND

from calib.cli.run import run
from calib.core.errors import BadInputError
from calib.io.logs import log_text
from calib.runner.graph import HIDDEN
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """The shipped pictures with a log at rest and one in motion."""
    root = tmp_path_factory.mktemp("rig")
    shutil.copytree(project_root / "images", root / "images")
    (root / "logs").mkdir()
    for seed, (name, scenario, seconds) in enumerate((("static1", "static", 12.0), ("swing", "swing", 8.0))):
        made = run_scenario(make_scenario(scenario), SimulatedRig(), seed, "truth", seconds)
        (root / "logs" / f"{name}.csv").write_text(log_text(run_log(made)))
    return root


def _words(folder: Path, out: Path, *more: str) -> list[str]:
    return [*COMMAND, "run", str(folder), "-o", str(out), *more]


def _public(out: Path) -> dict[str, bytes]:
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and HIDDEN not in path.parts
    }


def _children(process: int) -> list[int]:
    found = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True, check=False
    )
    return [int(word) for word in found.stdout.split()]


@pytest.mark.slow
def test_whole_folder_killed_rerun_and_changed(folder: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    done = subprocess.run(_words(folder, out, "--json"), capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1, 3), done.stderr
    told = json.loads(done.stdout)
    status = {job["name"]: job["status"] for job in told["run"]["jobs"]}
    assert {status[n] for n in ("intrinsics", "extrinsics", "distortion", "lowpass")} == {"ok"}
    rig = yaml.safe_load((out / "rig.yaml").read_text())
    assert abs(rig["camera"]["fx_px"] - 273.4) < 0.2
    assert {"camera", "plane", "lens", "imu", "lowpass"} <= set(rig)
    assert (out / "firmware" / "calib_constants.h").stat().st_size > 1000
    assert (out / "states" / "swing.csv").read_text().startswith("t_s,")
    page = (out / "report.html").read_text()
    assert "view17.png" in page and str(folder) not in page and "<strong>Simulated.</strong>" in page
    assert told["decision"]["answer"] in ("yes", "with care", "not yet", "no")
    # Killed on the way, with its processes, and run again: the same bytes, with one process at a time.
    process = subprocess.Popen(_words(folder, other, "--jobs", "2"), stderr=subprocess.DEVNULL)
    while not (other / HIDDEN / "stages" / "imu-static").exists() and process.poll() is None:
        time.sleep(0.05)
    children = _children(process.pid)
    process.kill()
    process.wait()
    again = subprocess.run(_words(folder, other, "--jobs", "1"), capture_output=True, text=True, check=False)
    assert "interrupted" in again.stderr and "as before" in again.stderr
    assert again.returncode == done.returncode
    wanted = told["decision"]["record_next"]
    assert [line[8:] for line in again.stdout.splitlines() if line.startswith("  next: ")][:3] == wanted[:3]
    assert _public(other) == _public(out)
    for child in children:
        with pytest.raises(ProcessLookupError):
            os.kill(child, signal.SIG_DFL)
    # One more log: all the rest is as before.
    more = tmp_path / "more"
    shutil.copytree(folder, more)
    shutil.copy(more / "logs" / "static1.csv", more / "logs" / "static2.csv")
    changed = subprocess.run(_words(more, other), capture_output=True, text=True, check=False)
    assert "Camera: ok, as before" in changed.stderr
    assert (other / "states" / "static2.csv").exists()


@pytest.mark.slow
def test_two_at_once_one_refuses(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = subprocess.Popen(_words(folder, out), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        while not (out / HIDDEN / "stages").exists() and first.poll() is None:
            time.sleep(0.05)
        second = subprocess.run(_words(folder, out), capture_output=True, text=True, check=False)
    finally:
        first.kill()
        first.wait()
    assert second.returncode == 3
    assert "another calib run" in second.stderr and second.stderr.count("\n") == 1


def test_what_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="is not there"):
        run(tmp_path / "none", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_output_in_the_inputs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text("t_s\n")
    with pytest.raises(BadInputError, match="folder that is read"):
        run(tmp_path, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["logs"]


WAYS: dict[str, tuple[int, int, str, str]] = {
    "one": (1, 1, "1", "0"),
    "two": (2, 2, "2", "12345"),
}
"""Processors, stages at a time, threads asked of every library, hash seed."""


def _on(processors: int) -> Callable[[], None]:
    free = sorted(os.sched_getaffinity(0))[:processors]
    return lambda: os.sched_setaffinity(0, free)


def _run(folder: Path, out: Path, way: str) -> dict[str, bytes]:
    """All that a run leaves, results of stages included."""
    processors, jobs, threads, seed = WAYS[way]
    names = ("OPENBLAS", "OMP", "MKL", "NUMBA", "VECLIB_MAXIMUM", "NUMEXPR")
    environment = {**os.environ, **{f"{name}_NUM_THREADS": threads for name in names}, "PYTHONHASHSEED": seed}
    ended = subprocess.run(
        _words(folder, out, "--jobs", str(jobs)),
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
