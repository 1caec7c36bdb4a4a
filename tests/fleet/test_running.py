"""A fleet in this process: what is done, what is left alone, and what is told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from fleet_clusters import in_threads

from calib.runner import engine as worker
from calib.runner import fleet as running
from calib.runner.engine import Cluster
from calib.runner.fleet import opened_store, run_fleet
from calib.runner.task import Answer, FleetOptions, Manifest, Outcome, RigSpec, program

pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""


@pytest.fixture(scope="module")
def here() -> Iterator[Cluster]:
    with in_threads(1, program()) as cluster:
        yield cluster


def test_failures_are_rows_and_what_is_there_is_left_alone(here: Cluster, tmp_path: Path) -> None:
    specs = []
    for k in range(5):
        images = tmp_path / f"rig{k}" / "images"
        images.mkdir(parents=True)
        (images / "a.png").write_bytes(b"no picture %d" % k)
        specs.append(RigSpec(f"rig{k}", str(images.parent), str(k)))
    specs.append(RigSpec("gone", str(tmp_path / "none")))
    manifest, said = Manifest(tuple(specs), ()), list[str]()
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        store.scratch.mkdir()
        first = run_fleet(store, here, manifest, FleetOptions(), 1, tell=said.append)
        assert first.by_status == {"failed": 6} and first.as_before == 0
        assert any(sentence.startswith("gone: failed (") for sentence in said) and len(said) == 6
        found = store.outcome("rig2")
        assert found is not None and found.serial == "2" and found.code == 3
        # Bad input is bad input again; a folder that was not there may be there now.
        (tmp_path / "rig1" / "images" / "a.png").write_bytes(b"another")
        again = run_fleet(store, here, manifest, FleetOptions(), 1)
        assert again.as_before == 4 and again.by_status == {"failed": 2} and again.done == 6
        assert not list(store.scratch.iterdir())


def slow_calibrate(spec: RigSpec, options: FleetOptions, known: str, scratch: str) -> Answer:
    """As `calibrate_rig` for a rig without anything in it; one never ends."""
    if spec.name == "endless":
        threading.Event().wait(5.0)
    return Answer(Outcome(spec.name, spec.serial, spec.source, "ok", 0), {})


def test_a_rig_that_hangs_is_a_row(here: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "calibrate_rig", slow_calibrate)
    monkeypatch.setattr(worker, "_end_process", lambda seconds: None)
    monkeypatch.setattr(worker, "_LEAVE_S", 0.01)
    manifest = Manifest(tuple(RigSpec(name, "/x") for name in ("a", "endless", "b")), ())
    with opened_store(tmp_path / "out", "calib fleet", ()) as (store, _):
        store.scratch.mkdir()
        counts = run_fleet(store, here, manifest, FleetOptions(), 1, limit_s=0.5)
        found = store.outcome("endless")
    worker._leaving.clear()
    assert counts.by_status == {"ok": 2, "lost": 1}
    assert found is not None and found.key == ""
    assert found.sentence == "was not done after 0.5 s, which is the --timeout of a rig"
