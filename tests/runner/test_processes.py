"""Processes that carry out tasks: what dies, hangs or raises is one task less, here and on a Dask cluster."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pool_tasks
import psutil
import pytest

from calib.core.errors import BadInputError
from calib.core.workers import Failure, Task, run_tasks
from calib.runner import processes
from calib.runner.processes import Cluster, connected, local


def _outcomes(on: Any, *tasks: Task) -> dict[str, Any]:
    return {task.name: result for task, result in run_tasks(on, tasks)}


def _listening() -> list[Any]:
    here = psutil.Process()
    ours = (here, *here.children(recursive=True))
    return [one for process in ours for one in process.net_connections() if one.status == "LISTEN"]


def _workers() -> list[psutil.Process]:
    found = []
    for child in psutil.Process().children():
        # One that ends meanwhile is none.
        with suppress(psutil.NoSuchProcess):
            if "spawn_main" in "".join(child.cmdline()):
                found.append(child)
    return found


def test_one_task_takes_no_other_with_it(tmp_path: Path) -> None:
    """One dies once, one each time, one raises, and one holds the interpreter beyond its time."""
    before = _listening()
    with local(2, retries=1, scratch=tmp_path) as pool:
        found = _outcomes(
            pool,
            Task("first", pool_tasks.scratch, ()),
            Task("dies", pool_tasks.die, ()),
            Task("dies once", pool_tasks.die_once, (str(tmp_path / "was here"),)),
            Task("hangs", pool_tasks.hold_the_interpreter, (), 0.3),
            Task("raises", pool_tasks.fail, ("why",)),
            Task("last", pool_tasks.scratch, ()),
        )
        assert _listening() == before, "a port is a door for all users of the machine"
        workers = _workers()
    assert found == {
        "first": str(tmp_path),
        "dies": Failure("died"),
        "dies once": "alive",
        "hangs": Failure("over"),
        "raises": Failure("raised"),
        "last": str(tmp_path),
    }
    assert isinstance(found["raises"].error, ValueError) and "in fail" in found["raises"].error.__notes__[0]
    assert not any(worker.is_running() for worker in workers)


_PARENT = """
import os, sys, pool_tasks
from calib.core.workers import Pool, Task
with Pool(1) as pool:
    pool.start(Task("child", pool_tasks.tell, (sys.argv[1],)))
    list(pool.finished())
open(sys.argv[1], "w").close()
"""
"""A script as people write them: the child must not run it again."""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a process ends with its task")
def test_processes_die_with_their_parent(tmp_path: Path, project_root: Path) -> None:
    """In the middle of a task, when the parent is killed and cannot say so."""
    script, told = tmp_path / "parent.py", tmp_path / "child"
    script.write_text(_PARENT)
    os.mkfifo(told)
    environment = {**os.environ, "PYTHONPATH": f"{project_root}:{project_root / 'tests'}"}
    parent = subprocess.Popen([sys.executable, str(script), str(told)], env=environment)
    child = psutil.Process(int(told.read_text()))
    parent.kill()
    parent.wait()
    child.wait(timeout=10)


@pytest.fixture
def threads() -> Any:
    """Workers of a Dask cluster that are threads of this process."""
    distributed = pytest.importorskip("distributed")
    options = {"threads_per_worker": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(n_workers=1, **options) as cluster, distributed.Client(cluster) as client:
        yield client


@pytest.mark.filterwarnings("default")
def test_tasks_of_a_cluster(threads: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[float] = []
    monkeypatch.setattr(processes, "_end_process", ended.append)
    found = _outcomes(
        Cluster(threads, "x"),
        Task("raises", pool_tasks.fail, ("why",)),
        Task("hangs", pool_tasks.sleep, (1.0,), 0.2),
        Task("well", pool_tasks.sleep, (0.0,)),
    )
    assert found == {
        "raises": Failure("raised"),
        "hangs": Failure("over"),
        "well": "slept",
    }
    assert processes._LEAVE_S in ended, "a process with something left in it does no other task"
    monkeypatch.setattr(processes, "_limited", pool_tasks.refuse)
    with pytest.raises(BadInputError, match="another calib, or other libraries"):
        _outcomes(Cluster(threads, "x"), Task("one", pool_tasks.sleep, (0.0,)))
    threads.close()
    with pytest.raises(BadInputError, match="the scheduler at x does not answer any more"):
        _outcomes(Cluster(threads, "x"), Task("one", pool_tasks.sleep, (0.0,)))


def test_who_is_at_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(processes, "_CONNECT_S", 0.5)
    with socket.socket() as taken:
        # Bound but not listening: whoever connects is refused.
        taken.bind(("127.0.0.1", 0))
        for where, said in (
            (f"tcp://127.0.0.1:{taken.getsockname()[1]}", "no scheduler answers there within 0.5 s"),
            ("nonsense://x:1", "cannot be talked to|no scheduler answers"),
        ):
            with pytest.raises(BadInputError, match=said), connected(where, print):
                pass
    version, program, _ = processes.survey()
    with pytest.raises(BadInputError, match=r"worker a: has calib 0\.0\.1"):
        list(processes.remarks({"a": ("0.0.1", "x", "1")}))
    (sentence,) = processes.remarks({"a": (version, program, "")})
    assert "1 of 1 workers were started without OPENBLAS_NUM_THREADS=1" in sentence
