"""Clusters for tests of fleets: workers that are threads of this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from calib.runner import engine as worker
from calib.runner.engine import Cluster

__all__ = ["in_threads"]


@contextmanager
def in_threads(workers: int, program: str = "") -> Iterator[Cluster]:
    """A cluster without processes of its own."""
    from distributed import Client, LocalCluster

    options = {"threads_per_worker": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=workers, **options) as cluster, Client(cluster) as client:
        worker._settled.set()
        yield Cluster(client, "", program)
