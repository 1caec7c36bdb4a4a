"""`calib sweep` as a person types it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fleet_clusters import in_threads
from fleet_processes import COMMAND, all_gone, done, first_worker, started, until, workers

from calib.runner.fleet import opened_store
from calib.runner.sweep import read_sweep, run_sweep, summarise_sweep
from calib.show.fleet import write_sweep_page

pytest.importorskip("distributed")


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


def _table(out: Path) -> Any:
    """All columns but the times."""
    from pyarrow import parquet

    return parquet.read_table(out / "sweep.parquet").drop_columns(["seconds"])


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
    assert all_gone(children)
    assert not (out / "sweep.parquet").exists()
    kept = {path: path.stat().st_mtime_ns for path in (out / ".fleet" / "outcomes").glob("*.json")}
    assert 2 <= len(kept) < 16
    # The next run goes on, and a worker is killed on the way: nothing is lost, nothing is done again.
    with started(environment, "sweep", spec, "-o", out, "--workers", 2, "--json") as process:
        victim = first_worker(process)
        until(lambda: done(out) > len(kept), process)
        os.kill(victim, signal.SIGKILL)
        said, told = process.communicate()
    assert process.returncode == 0 and "interrupted" in told, told
    found = json.loads(said)["sweep"]
    assert (found["cases"], found["failed"], found["as_before"]) == (128, 0, 8 * len(kept))
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert not (out / ".fleet" / "scratch").exists()
    # A sweep at one go in one process has the same results.
    with in_threads(1) as cluster, opened_store(here, "calib sweep", ()) as (store, _):
        store.scratch.mkdir()
        known = read_sweep(spec)
        assert run_sweep(store, cluster, known, 0) == 0
        write_sweep_page(here / "sweep.html", known, summarise_sweep(store, known, 0))
    assert _table(out).equals(_table(here)) and _table(out).num_rows == 128
    assert (out / "sweep.html").read_bytes() == (here / "sweep.html").read_bytes()
