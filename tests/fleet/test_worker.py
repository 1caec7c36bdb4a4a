"""A task in its process: what it answers, when its time is over, and when the program is another one."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fleet_clusters import in_threads
from fleet_tasks import double, faulty, hangs

from calib.errors import BadInputError
from calib.fleet import worker
from calib.fleet.cluster import connected
from calib.fleet.engine import Task, run_tasks
from calib.fleet.worker import Overdue, call

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """After how many seconds this process would have ended; it does not."""
    found: list[float] = []
    monkeypatch.setattr(worker, "_end_process", found.append)
    monkeypatch.setattr(worker, "_LEAVE_S", 0.01)
    worker._settled.set()
    yield found
    worker._leaving.clear()


def test_what_a_function_returns_and_raises(ends: list[float]) -> None:
    assert call("", 5.0, double, 4) == 8
    assert call(worker.program(), 5.0, double, 4) == 8
    with pytest.raises(ArithmeticError, match="three is too much"):
        call("", 5.0, faulty, 3)
    # Only what holds the interpreter itself would have got so far.
    assert ends == [5.0 + worker._GRACE_S] * 3
    assert call("", 1e300, double, 4) == 8
    assert not worker._leaving.is_set()


def test_time_that_is_over(ends: list[float]) -> None:
    go_on = threading.Event()
    assert call("", 0.05, go_on.wait, 30.0) == Overdue(0.05)
    assert worker._leaving.is_set() and ends[-1] == worker._LEAVE_S
    go_on.set()
    # What comes next waits for the end, which other processes have and this one has not.
    began = time.monotonic()
    assert call("", 5.0, double, 4) == 8
    assert time.monotonic() - began >= worker._LEAVE_S


def _two(cluster: Any, count: int) -> tuple[dict[str, Any], list[str]]:
    found: dict[str, Any] = {}
    said: list[str] = []
    tasks = (Task(f"task {k}", (k,)) for k in range(count))
    run_tasks(cluster, double, tasks, lambda t, r: found.__setitem__(t.name, r), tell=said.append)
    return found, said


def test_a_worker_with_another_program_is_not_used(
    ends: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    with in_threads(2, "this") as local:
        cluster = replace(local, address="tcp://there")
        late = sorted(cluster.processes())[0]
        which = {late: "another"}
        monkeypatch.setattr(worker, "program", lambda: which.get(distributed.get_worker().address, "this"))
        found, said = _two(cluster, 40)
        assert found == {f"task {k}": 2 * k for k in range(40)}
        assert said == [f"worker {late}: has another calib, or other libraries, and is not used"]
        # Where all are of another program there is nobody to turn to.
        monkeypatch.setattr(worker, "program", lambda: "another")
        with pytest.raises(BadInputError, match="the scheduler at tcp://there has only workers with another"):
            _two(cluster, 3)
        with pytest.raises(BadInputError, match="was changed while it was at work; what is done is kept"):
            _two(local, 3)


@pytest.mark.slow
def test_what_hangs_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    found: dict[str, Any] = {}
    with connected(None, 2, tmp_path / "scratch", 0) as cluster:
        tasks = (Task(f"task {k}", (k, (3, 7))) for k in range(10))
        run_tasks(cluster, hangs, tasks, lambda t, r: found.__setitem__(t.name, r), 0, limit_s=2.0)
    assert found["task 3"] == found["task 7"] == Overdue(2.0)
    assert all(found[f"task {k}"] == 2 * k for k in range(10) if k not in (3, 7))
