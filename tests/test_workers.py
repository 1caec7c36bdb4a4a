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
import numpy as np
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


def _odd(shared: object, i: int) -> object:
    if i == 3:
        raise _UnpicklableError(lambda: i)
    return (lambda: i) if i == 5 else i


class _UnpicklableError(Exception):
    pass


def _dies(shared: object, i: int) -> int:
    if i == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return i


forked = pytest.mark.skipif(
    sys.platform != "linux" or processors() < 2,
    reason="not part of the project and not here: a second processor",
)


@forked
def test_what_cannot_be_sent_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with Workers(None, 8) as pool:
        with pytest.raises(RuntimeError, match="_UnpicklableError"):
            list(pool.in_order(_odd, range(4)))
        with pytest.raises((AttributeError, TypeError), match="pickle"):
            list(pool.in_order(_odd, [0, 1, 5]))
        # What was left of those rounds is in nobody's way.
        assert list(pool.in_order(_odd, [0, 1, 2, 4])) == [0, 1, 2, 4]


@forked
def test_a_worker_that_the_system_ends_is_no_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    with pytest.raises(MemoryError, match="-9"), Workers(None, 8) as pool:
        list(pool.in_order(_dies, range(8)))


@forked
def test_an_error_in_the_middle_ends_the_process_in_silence(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import time\n"
        "from calib.workers import Workers\n"
        "def slow(shared, i):\n"
        "    time.sleep(0.01)\n"
        "try:\n"
        "    with Workers(None, 8) as pool:\n"
        "        for _ in pool.in_order(slow, range(8)):\n"
        "            raise ValueError\n"
        "except ValueError:\n"
        "    pass\n"
    )
    for _ in range(10):
        done = subprocess.run([sys.executable, str(script)], capture_output=True, timeout=60, check=True)
        assert not done.stderr


def test_no_more_processors_than_allowed() -> None:
    from calib.workers import at_most

    before = processors()
    with at_most(1):
        assert processors() == 1
        with at_most(64):
            assert processors() == 1
    assert processors() == before


def _uses_opencv(_: None, i: int) -> int:
    cv2.GaussianBlur(np.zeros((40, 40), dtype=np.uint8), (3, 3), 1.0)
    return threading.get_native_id() + 0 * i


@forked
def test_no_thread_is_on_its_way_out_when_processes_are_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lock that such a thread holds would stay locked in the forked process for ever."""
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    for _ in range(40):
        with Workers(None, 8, large=True) as pool:
            threads = set(pool.in_order(_uses_opencv, range(8)))
        with Workers(None, 8) as pool:
            assert not threads & {int(path.name) for path in Path("/proc/self/task").iterdir()}
            assert pool._forks
