"""Many items at once: order, errors, and whether processes or threads do the work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import pytest

from calib import workers
from calib.workers import Workers, processors


def _place(shared: list[int], i: int) -> tuple[int, int]:
    time.sleep(0.002 * (shared[i] % 3))
    return shared[i], os.getpid()


def _fails(shared: list[int], i: int) -> int:
    return shared[i] // (i - 5)


@pytest.mark.parametrize("large", [False, True])
def test_results_come_in_the_order_of_the_items(large: bool) -> None:
    shared = list(range(100, 140))
    with Workers(shared, 40, large) as pool:
        assert [value for value, _ in pool.in_order(_place, range(40))] == shared
        # A pool serves more than once.
        assert [value for value, _ in pool.in_order(_place, [3, 1])] == [103, 101]


@pytest.mark.skipif(sys.platform != "linux" or processors() < 2, reason="no second process to fork")
def test_forks_only_where_it_is_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with Workers([0] * 8, 8) as pool:
        assert os.getpid() not in {process for _, process in pool.in_order(_place, range(8))}
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    with Workers([0] * 8, 8) as pool:
        assert {process for _, process in pool.in_order(_place, range(8))} == {os.getpid()}


@pytest.mark.parametrize("items", [2, 8])
def test_an_error_comes_through_and_leaves_opencv_as_it_was(items: int) -> None:
    before = cv2.getNumThreads()
    with pytest.raises(ZeroDivisionError), Workers([1] * 8, items) as pool:
        list(pool.in_order(_fails, [5] * items))
    assert cv2.getNumThreads() == before


def test_processors_are_those_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert processors() >= 1
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(workers.os, "cpu_count", lambda: None)
    assert processors() == 1


@pytest.mark.skipif(sys.platform != "linux" or processors() < 2, reason="no second process to fork")
def test_no_worker_outlives_its_parent(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import os, signal, time\n"
        "from calib.workers import Workers\n"
        "def number(shared, i):\n"
        "    time.sleep(0.01)\n"
        "    return os.getpid()\n"
        "with Workers(None, 8) as pool:\n"
        "    print(*set(pool.in_order(number, range(8))), flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=False
    )
    # That it ended at all is the point: it ends when no worker holds the pipe any more.
    assert done.returncode == -signal.SIGKILL
    assert done.stdout.split()
