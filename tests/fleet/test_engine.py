"""Many tasks on a cluster: all come back, a few are under way at a time, and processes may die."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fleet_clusters import in_threads
from fleet_tasks import dies_in, double, faulty, noted

from calib.errors import BadInputError
from calib.fleet import engine
from calib.fleet.cluster import Cluster, connected
from calib.fleet.engine import Broken, Lost, Task, run_tasks

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""


@pytest.fixture(scope="module")
def here() -> Iterator[Cluster]:
    """Two workers that are threads of this process."""
    with in_threads(2) as cluster:
        yield cluster


def _tasks(count: int, *more: Any) -> Iterator[Task]:
    for k in range(count):
        yield Task(f"task {k}", (k, *more))


def _let_go(cluster: Cluster) -> None:
    """Nothing is held on the cluster; letting go takes a turn of its loop."""
    until = time.monotonic() + 20.0
    while cluster.client.futures and time.monotonic() < until:
        time.sleep(0.01)
    assert not cluster.client.futures


def test_all_come_back_once_and_few_are_under_way(here: Cluster) -> None:
    asked, found, ahead = 0, dict[str, Any](), list[int]()

    def tasks() -> Iterator[Task]:
        nonlocal asked
        for task in _tasks(60):
            asked += 1
            yield task

    def done(task: Task, result: Any) -> None:
        assert task.name not in found
        found[task.name] = result
        ahead.append(asked - len(found))

    run_tasks(here, double, tasks(), done)
    assert found == {f"task {k}": 2 * k for k in range(60)}
    assert max(ahead) <= 2 * 2
    _let_go(here)


def test_what_raises_is_a_result(here: Cluster) -> None:
    found: dict[str, Any] = {}
    run_tasks(here, faulty, _tasks(6), lambda task, result: found.__setitem__(task.name, result))
    assert found["task 3"] == Broken("ArithmeticError: three is too much")
    assert found["task 5"] == 10 and len(found) == 6


def test_nothing_to_do(here: Cluster) -> None:
    run_tasks(here, double, iter(()), lambda task, result: pytest.fail("there was no task"))


def test_what_goes_wrong_with_a_result_ends_the_run_and_lets_go(here: Cluster) -> None:
    def done(task: Task, result: Any) -> None:
        raise BadInputError("disk full")

    with pytest.raises(BadInputError, match="disk full"):
        run_tasks(here, double, _tasks(20), done)
    _let_go(here)


def test_no_workers_for_long(here: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_NO_WORKERS_S", 0.2)
    monkeypatch.setattr(engine, "_COUNT_S", 0.05)
    options = {"n_workers": 0, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
        pytest.raises(BadInputError, match=r"has had no workers .* goes on from there"),
    ):
        run_tasks(Cluster(client, "", ""), double, _tasks(3), lambda task, result: None)


def test_a_scheduler_that_goes_away(here: Cluster) -> None:
    options = {"n_workers": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    cluster = distributed.LocalCluster(**options)
    client = distributed.Client(cluster, set_as_default=False, timeout=2)
    try:

        def done(task: Task, result: Any) -> None:
            client.close()

        with pytest.raises(BadInputError, match="does not answer any more"):
            run_tasks(Cluster(client, "tcp://there", ""), double, _tasks(50), done)
    finally:
        client.close()
        cluster.close()


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two processes of which each task may kill one."""
    place = tmp_path_factory.mktemp("cluster")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
        with connected(None, 2, place / "scratch", 1) as cluster:
            yield cluster
    assert not (place / "scratch").exists()


@pytest.mark.slow
def test_who_kills_its_process_is_lost_and_those_beside_it_are_not(processes: Cluster) -> None:
    found: dict[str, Any] = {}
    deadly = (4, 9)
    run_tasks(
        processes, dies_in, _tasks(14, deadly, 0.05), lambda t, r: found.__setitem__(t.name, r), retries=1
    )
    assert {name for name, result in found.items() if isinstance(result, Lost)} == {"task 4", "task 9"}
    assert all(found[f"task {k}"] == 2 * k for k in range(14) if k not in deadly)
    assert found["task 4"] == Lost(4)


@pytest.mark.slow
def test_a_process_that_is_killed_loses_nothing(processes: Cluster, tmp_path: Path) -> None:
    found: dict[str, Any] = {}

    def kill() -> None:
        while len(list(tmp_path.iterdir())) < 6:
            time.sleep(0.01)
        newest = max(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        os.kill(int(newest.name.split("-")[1]), signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    run_tasks(
        processes, noted, _tasks(20, str(tmp_path), 0.1), lambda t, r: found.__setitem__(t.name, r), retries=1
    )
    killer.join()
    assert found == {f"task {k}": 2 * k for k in range(20)}
    # The one that was under way has begun twice, and hardly any other.
    assert 21 <= len(list(tmp_path.iterdir())) <= 23
