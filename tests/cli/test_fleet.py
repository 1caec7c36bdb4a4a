"""`calib fleet` and `calib sweep` as a person types them: what is refused, and what survives."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fleet_processes import COMMAND, all_gone, done, first_worker, started, until, workers
from fleet_rigs import write_fleet, write_manifest

from calib.runner import processes
from calib.runner.outcomes import opened_store
from calib.runner.processes import Here
from calib.runner.sweep import read_sweep, run_sweep, summarise_sweep
from calib.show.fleet import write_sweep_page

pytest.importorskip("distributed")


def _manifest(tmp_path: Path, rows: str) -> Path:
    path = tmp_path / "m.csv"
    path.write_text("name,path\n" + rows)
    return path


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("", "has a header but no rows"),
        ("a,x\na,y\n", "the name 'a' is that of line 2"),
        ("../a,x\n", "line 2: name is '../a', expected a name without a dot"),
    ],
)
def test_a_manifest_that_is_none(calib: Callable[..., Any], tmp_path: Path, rows: str, said: str) -> None:
    ended = calib("fleet", _manifest(tmp_path, rows), "-o", tmp_path / "out")
    assert ended.code == 3 and said in ended.sentence
    assert not (tmp_path / "out").exists()


def test_what_cannot_be(calib: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = _manifest(tmp_path, "a,x\n")

    def ended(*words: object) -> tuple[int, str]:
        found = calib("fleet", *words)
        return found.code, found.sentence

    code, said = ended(tmp_path / "none.csv", "-o", tmp_path / "out")
    assert code == 3 and "none.csv: cannot be read" in said
    code, said = ended(manifest, "-o", manifest / "out")
    assert code == 3 and "is a file" in said
    code, said = ended(manifest, "-o", tmp_path / "out", "--scheduler", "tcp://x:1", "--workers", "2")
    assert code == 2 and "--workers" in said
    code, said = ended(manifest, "-o", tmp_path / "out", "--timeout", "never")
    assert code == 2 and "--timeout: 'never' is not a number with a unit" in said
    code, said = ended(manifest, "-o", tmp_path / "x" / "out")
    assert code == 3 and "lies in the folder of a" in said
    with opened_store(tmp_path / "taken", "calib fleet", ()):
        code, said = ended(manifest, "-o", tmp_path / "taken")
    assert code == 3 and "another calib fleet" in said and "is at work there" in said
    monkeypatch.setattr(processes, "_CONNECT_S", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        code, said = ended(manifest, "-o", tmp_path / "out", "--scheduler", address)
    assert code == 3 and said == f"{address}: no scheduler answers there within 0.5 s"


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Path]]:
    """Six rigs and their manifest, with one folder that is not there and one without a picture in it."""
    root = tmp_path_factory.mktemp("rigs")
    folders = write_fleet(root, 6, cameras=2)
    (root / "bad" / "images").mkdir(parents=True)
    (root / "bad" / "images" / "a.png").write_bytes(b"no picture")
    return write_manifest(root / "m.csv", [*folders, root / "bad", root / "gone"], "radial2"), folders


def _results(out: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in sorted(out.glob("rigs/*/rig.yaml"))}


@pytest.mark.slow
def test_killed_worker_killed_client_and_single_runs_end_in_the_same(
    rigs: tuple[Path, list[Path]], environment: dict[str, str], tmp_path: Path
) -> None:
    manifest, folders = rigs
    out, other = tmp_path / "out", tmp_path / "other"
    # A worker is killed on the way: nothing is lost.
    with started(environment, "fleet", manifest, "-o", out, "--workers", 2, "--json") as process:
        victim = first_worker(process)
        until(lambda: done(out) >= 2, process)
        os.kill(victim, signal.SIGKILL)
        said, told = process.communicate()
    assert process.returncode == 1, told
    found = json.loads(said)["fleet"]
    assert found["rigs"] == 8 and found["verdicts"]["failed"] == 2 and "lost" not in found["verdicts"]
    looks = {look["name"]: look["why"] for look in found["to_look_at"]}
    assert "is not there, expected a folder with images" in looks["gone"] and "a.png" in looks["bad"]
    whole = _results(out)
    assert set(whole) >= {folder.name for folder in folders}
    assert (out / "fleet.parquet").stat().st_size > 1000
    page = (out / "fleet.html").read_text()
    assert "Fleet of 8 rigs" in page and "gone</td>" in page
    # The same bytes as those of single runs, each in a process of its own.
    for folder in folders[:2]:
        rig = tmp_path / f"{folder.name}.yaml"
        for words in (
            ("intrinsics", str(folder / "images"), "--model", "radial2"),
            ("distortion",),
        ):
            subprocess.run(
                [*COMMAND, *words, "--rig", str(rig)], env=environment, capture_output=True, check=False
            )
        assert rig.read_bytes() == whole[folder.name]
    # The client and its scheduler are killed: the workers follow, and the next run goes on.
    with started(environment, "fleet", manifest, "-o", other, "--workers", 2) as process:
        until(lambda: done(other) >= 2, process)
        children = workers(process.pid)
        process.kill()
        process.wait()
    assert children and all_gone(children)
    before = {path: path.stat().st_mtime_ns for path in other.glob("rigs/*/rig.yaml")}
    with started(environment, "fleet", manifest, "-o", other, "--workers", 1, "--json") as process:
        said, told = process.communicate()
    assert process.returncode == 1 and "interrupted" in told
    assert json.loads(said)["fleet"]["as_before"] >= 2
    for name in ("fleet.parquet", "fleet.html"):
        assert (other / name).read_bytes() == (out / name).read_bytes(), name
    assert _results(other) == whole
    assert all(path.stat().st_mtime_ns == when for path, when in before.items())
    assert not (other / ".fleet" / "scratch").exists()
    # One rig's pictures change, another result was edited: those two are done again.
    copy = tmp_path / "rigs"
    shutil.copytree(manifest.parent, copy)
    manifest = write_manifest(copy / "m.csv", [copy / f.name for f in folders], "radial2")
    (copy / folders[0].name / "images" / "view5.png").unlink()
    (other / "rigs" / folders[1].name / "rig.yaml").write_text("edited")
    with started(environment, "fleet", manifest, "-o", other, "--workers", 1, "--json") as process:
        said, _ = process.communicate()
    assert json.loads(said)["fleet"]["as_before"] == 4
    again = _results(other)
    assert again[folders[1].name] == whole[folders[1].name]
    assert again[folders[0].name] != whole[folders[0].name]


def _dask(environment: dict[str, str], *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
        env={**environment, "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )


@pytest.mark.slow
def test_an_existing_scheduler_that_is_killed(
    rigs: tuple[Path, list[Path]], environment: dict[str, str], tmp_path: Path
) -> None:
    manifest, folders = rigs
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, out = f"tcp://127.0.0.1:{port}", tmp_path / "out"
    scheduler_words = ("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    worker_words = ("dask_worker", address, "--nthreads", "1", "--local-directory", str(tmp_path / "w"))
    running = [_dask(environment, *scheduler_words), _dask(environment, *worker_words)]
    try:
        with started(environment, "fleet", manifest, "-o", out, "--scheduler", address) as process:
            until(lambda: done(out) >= 2, process)
            running[0].kill()
            _, told = process.communicate(timeout=120)
        assert process.returncode == 3
        last = told.strip().splitlines()[-1]
        assert last.startswith(f"calib: the scheduler at {address} does not answer any more")
        assert "Traceback" not in told
        kept = done(out)
        running.append(_dask(environment, *scheduler_words))
        running.append(_dask(environment, *worker_words))
        with started(environment, "fleet", manifest, "-o", out, "--scheduler", address, "--json") as process:
            said, told = process.communicate(timeout=300)
        assert process.returncode == 1, told
        found = json.loads(said)["fleet"]
        assert found["as_before"] >= kept - 2 and found["rigs"] == 8
        assert set(_results(out)) >= {folder.name for folder in folders}
    finally:
        for one in running:
            one.terminate()
        for one in running:
            try:
                one.wait(20)
            except subprocess.TimeoutExpired:
                one.kill()
                one.wait()


def test_what_is_no_sweep(calib: Callable[..., Any], tmp_path: Path) -> None:
    spec = tmp_path / "s.yaml"
    spec.write_text("base: {controller: pid, reference: jump}\n")
    ended = calib("sweep", spec, "-o", tmp_path / "out")
    assert ended.code == 3
    assert "nothing to sweep over" in ended.sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_controllers_over_plants(environment: dict[str, str], tmp_path: Path) -> None:
    spec, out = tmp_path / "s.yaml", tmp_path / "out"
    spec.write_text(
        "base: {scenario: orientation, feedback: truth, duration: 3s}\n"
        "grid: {scenario.controller: [p, pid], actuator.mass_kg: [0.05, 5000]}\n"
        "draws: {count: 3, actuator.stiffness_scale: {uniform: [0.9, 1.1]}}\nmeasure: [peak_rad]\nnear: 0.7\n"
    )
    words = [*COMMAND, "sweep", str(spec), "-o", str(out), "--workers", "1", "--json"]
    first = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert first.returncode == 1, first.stderr
    found = json.loads(first.stdout)["sweep"]
    # Half of the cases have a mass that no actuator has.
    assert (found["cases"], found["failed"], found["as_before"]) == (12, 6, 0)
    assert "actuator.mass_kg is 5000" in found["why"]
    assert found["best"][0]["parameters"] == {"scenario.controller": "pid", "actuator.mass_kg": 0.05}
    assert found["best"][0]["draws"] == 3 and abs(found["best"][0]["median"] - 0.7) < 0.1
    assert "Sweep of scenario orientation" in (out / "sweep.html").read_text()
    again = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    told = json.loads(again.stdout)["sweep"]
    assert told["as_before"] == 12 and told["best"] == found["best"]


_MANY = (
    "base: {scenario: orientation, feedback: truth, duration: 6s}\n"
    "grid: {scenario.controller: [p, pid], actuator.mass_kg: {from: 0.04, to: 0.06, count: 8}}\n"
    "draws: {count: 8, seed: 3, actuator.stiffness_scale: {uniform: [0.9, 1.1]}}\nmeasure: [peak_rad]\n"
)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_killed_client_and_killed_worker_end_in_the_same(environment: dict[str, str], tmp_path: Path) -> None:
    spec, out, here = tmp_path / "s.yaml", tmp_path / "out", tmp_path / "here"
    spec.write_text(_MANY)
    # The client and its scheduler are killed: the workers follow.
    with started(environment, "sweep", spec, "-o", out, "--workers", 2) as process:
        until(lambda: done(out) >= 2, process)
        children = workers(process.pid)
        process.kill()
        process.wait()
    assert children and all_gone(children)
    assert not (out / "sweep.parquet").exists()
    kept = {path: path.stat().st_mtime_ns for path in (out / ".sweep" / "outcomes").glob("*.json")}
    assert 2 <= len(kept) < 128
    # The next run goes on, and a worker is killed on the way: nothing is lost, nothing is done again.
    with started(environment, "sweep", spec, "-o", out, "--workers", 2, "--json") as process:
        victim = first_worker(process)
        until(lambda: done(out) > len(kept), process)
        os.kill(victim, signal.SIGKILL)
        said, told = process.communicate()
    assert process.returncode == 0 and "interrupted" in told, told
    found = json.loads(said)["sweep"]
    assert (found["cases"], found["failed"], found["as_before"]) == (128, 0, len(kept))
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert not (out / ".sweep" / "scratch").exists()
    # A sweep at one go in one process has the same results.
    with opened_store(here, "calib sweep", ()) as (store, _):
        known = read_sweep(spec)
        assert run_sweep(store, Here(), known)["same"] == 0
        write_sweep_page(here / "sweep.html", known, summarise_sweep(store, known, 0))
    same = [(folder / "sweep.parquet").read_bytes() for folder in (out, here)]
    assert same[0] == same[1]
    assert len((out / "timings.csv").read_text().splitlines()) == 129
    assert (out / "sweep.html").read_bytes() == (here / "sweep.html").read_bytes()
