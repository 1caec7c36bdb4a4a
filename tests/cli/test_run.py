"""`calib run` as a person types it: real verbs in real processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from calib.cli.run import run
from calib.core.errors import BadInputError
from calib.io.logs import log_text
from calib.runner.graph import HIDDEN
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of


def _log(path: Path, scenario: str, seconds: float, seed: int) -> None:
    made = run_scenario(make_scenario(scenario), SimulatedRig(), seed, "truth", seconds)
    path.write_text(log_text(log_of(made)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """The shipped pictures with a log at rest and one in motion."""
    root = tmp_path_factory.mktemp("rig")
    shutil.copytree(project_root / "images", root / "images")
    (root / "logs").mkdir()
    _log(root / "logs" / "static1.csv", "static", 12.0, 0)
    _log(root / "logs" / "swing.csv", "swing", 5.0, 1)
    return root


def _words(folder: Path, out: Path, *more: str) -> list[str]:
    start = "from calib.cli.main import main; main()"
    return [sys.executable, "-c", start, "run", str(folder), "-o", str(out), *more]


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
    assert "view17.png" in page and str(folder) not in page
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
