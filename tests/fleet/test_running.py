"""A fleet in this process: what is done, what is left alone, and what is told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from calib.fleet import engine
from calib.fleet.cluster import Cluster
from calib.fleet.manifest import Manifest, RigSpec
from calib.fleet.running import run_fleet
from calib.fleet.store import opened_store
from calib.fleet.task import FleetOptions, program

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""


@pytest.fixture(scope="module")
def here() -> Iterator[Cluster]:
    options = {
        "n_workers": 1,
        "threads_per_worker": 1,
        "processes": False,
        "dashboard_address": "127.0.0.1:0",
    }
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        engine._settled.set()
        yield Cluster(client, "", program())


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
