"""Work on many items at once, on all processors that this process may use.

Forked workers see what the process holds without copying it, and are not held up by the interpreter's
lock, as threads are. A process may fork safely only while it has one Python thread, so that elsewhere,
and on systems where forking is not safe at all, threads do the work.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Any, Generic, TypeVar

import cv2

__all__ = ["Workers", "processors"]

Shared = TypeVar("Shared")
S = TypeVar("S")
T = TypeVar("T")

_LOOK_UP_S = 0.2
_FEWEST_TO_FORK = 4
"""Starting processes for fewer items takes longer than they save."""

_PR_SET_PDEATHSIG = 1

_held: Any = None


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _hold(shared: object, parent: int) -> None:
    global _held  # noqa: PLW0603  a worker process serves one pool and keeps what it shares here
    _held = shared
    # Ctrl-C reaches all processes of a terminal; the first one answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A worker waits for work on a pipe that it holds open itself: it has to be told of its parent's end.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:
        os._exit(1)


def _on_held(work: Callable[[Any, S], T], item: S) -> T:
    return work(_held, item)


def _may_fork(items: int) -> bool:
    return (
        items >= _FEWEST_TO_FORK
        and processors() > 1
        and sys.platform == "linux"
        and threading.active_count() == 1
    )


class Workers(Generic[Shared]):
    """Calls `work(shared, item)` for many items at once.

    Parameters
    ----------
    shared : what all calls have in common; forked workers see it as it is when they start.
    items : how many items there are about to be.
    large : whether results are large; then threads do the work, which need not send them.

    `work` has to be a function of a module, and items and results have to be picklable. OpenCV's own
    threads are off meanwhile: they would only get in the way.
    """

    def __init__(self, shared: Shared, items: int, large: bool = False) -> None:
        self._shared = shared
        self._forks = not large and _may_fork(items)
        count = max(1, min(items, processors()))
        self._pool: Executor
        if self._forks:
            self._pool = ProcessPoolExecutor(
                count, multiprocessing.get_context("fork"), initializer=_hold, initargs=(shared, os.getpid())
            )
        else:
            self._pool = ThreadPoolExecutor(count)

    def __enter__(self) -> Workers[Shared]:
        self._threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # After an error or Ctrl-C nobody waits for the work still under way.
        self._pool.shutdown(wait=kind is None, cancel_futures=True)
        cv2.setNumThreads(self._threads)

    def in_order(self, work: Callable[[Shared, S], T], items: Iterable[S]) -> Iterator[T]:
        """Results in the order of the items.

        The wait is a short one, again and again: Ctrl-C that comes just before a long one is answered
        only at its end.
        """
        with warnings.catch_warnings():
            # Python 3.12 counts the idle threads of a BLAS library, which survive a fork.
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            if self._forks:
                futures = [self._pool.submit(_on_held, work, item) for item in items]
            else:
                futures = [self._pool.submit(work, self._shared, item) for item in items]
        futures.reverse()
        while futures:
            while not wait([futures[-1]], timeout=_LOOK_UP_S).done:
                pass
            yield futures.pop().result()
