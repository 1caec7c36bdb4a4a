"""Work on many items at once, on all processors that this process may use.

Forked workers see what the process holds without copying it, and are not held up by the interpreter's
lock, as threads are. A process may fork safely only while it has one Python thread, so that elsewhere,
and on systems where forking is not safe at all, threads do the work. A process of `concurrent.futures`
that ends in the middle of its work, as after an error or Ctrl-C, now and then never ends; so each worker
here has a pipe of its own, and no thread stands between.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar, cast

import cv2
import numpy.ma  # noqa: F401  for its loading

from calib.core.command import WATCHER

# np.median and np.unique load it: once here, before the processes fork, instead of once in each.


Shared = TypeVar("Shared")
S = TypeVar("S")
T = TypeVar("T")

_LOOK_UP_S = 0.2
_LAST_BREATH_S = 2.0
_FEWEST_TO_FORK = 4
"""Starting processes for fewer items takes longer than they save."""

_IN_HAND = 2
"""Items that a worker holds, so that it need not wait for the next."""

_PR_SET_PDEATHSIG = 1

_most: list[int] = []
_leaving: set[int] = set()
"""Threads of ours, by the system's numbers, that may still be there."""


def processors() -> int:
    """How many processors this process may use."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([there, *_most])


@contextlib.contextmanager
def at_most(count: int) -> Iterator[None]:
    """Use no more processors than this inside, for a process that is one of many on its machine."""
    _most.append(count)
    try:
        yield
    finally:
        _most.pop()


def _serve(shared: object, pipe: Connection, parent: int) -> None:
    """What a worker process does: items in, results out, until told to end."""
    # Ctrl-C reaches all processes of a terminal; the first one answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # A pipe that brothers and sisters hold open as well does not tell of the parent's end.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:
        os._exit(1)
    while (order := pipe.recv()) is not None:
        ticket, work, item = order
        try:
            pipe.send((ticket, work(shared, item), None))
        except Exception as error:
            error.add_note(traceback.format_exc())
            try:
                pipe.send((ticket, None, error))
            except Exception:
                # An error that cannot be pickled is told in words.
                pipe.send((ticket, None, RuntimeError(repr(error))))


def _may_fork(items: int) -> bool:
    return (
        items >= _FEWEST_TO_FORK
        and processors() > 1
        and sys.platform == "linux"
        and {thread.name for thread in threading.enumerate()} <= {threading.main_thread().name, WATCHER}
        and not multiprocessing.current_process().daemon
        and _have_left()
    )


def _sign() -> None:
    _leaving.add(threading.get_native_id())


def _have_left() -> bool:
    """Wait until threads that Python has done with are gone for the system as well.

    On its way out a thread gives back what libraries keep for it, under their locks: OpenCV's would stay
    locked for ever in a process that is forked at that moment.
    """
    until = time.monotonic() + _LAST_BREATH_S
    while _leaving and time.monotonic() < until:
        _leaving.difference_update([n for n in _leaving if not Path(f"/proc/self/task/{n}").exists()])
        if _leaving:
            time.sleep(1e-4)
    return not _leaving


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
        self._count = max(1, min(items, processors()))
        self._processes: dict[Connection, BaseProcess] = {}
        self._tickets = 0

    def __enter__(self) -> Workers[Shared]:
        self._threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        cv2.setNumThreads(self._threads)
        for process in self._processes.values():
            # Whoever works still does so for nobody.
            process.kill()
        for pipe, process in self._processes.items():
            process.join()
            pipe.close()
        self._processes.clear()

    def in_order(self, work: Callable[[Shared, S], T], items: Iterable[S]) -> Iterator[T]:
        """Results in the order of the items.

        Raises what `work` raises, and `MemoryError` when the system ends a worker.
        """
        return self._by_processes(work, list(items)) if self._forks else self._by_threads(work, items)

    def _by_threads(self, work: Callable[[Shared, S], T], items: Iterable[S]) -> Iterator[T]:
        pool = ThreadPoolExecutor(self._count, initializer=_sign)
        try:
            futures = [pool.submit(work, self._shared, item) for item in items]
            futures.reverse()
            while futures:
                # Ctrl-C that comes just before a long wait is answered only at its end.
                while not wait([futures[-1]], timeout=_LOOK_UP_S).done:
                    pass
                yield futures.pop().result()
        except KeyboardInterrupt:
            # It may have come where the pool holds a lock, so that nothing more is asked of the pool.
            raise
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()

    def _by_processes(self, work: Callable[[Shared, S], T], items: list[S]) -> Iterator[T]:
        self._start()
        first = self._tickets
        self._tickets += len(items)
        waiting = iter(range(len(items)))
        for _ in range(_IN_HAND):
            for pipe in self._processes:
                self._hand(pipe, first, waiting, work, items)
        results: dict[int, T] = {}
        for i in range(len(items)):
            while i not in results:
                for ready in connection.wait(self._processes, timeout=_LOOK_UP_S):
                    pipe = cast("Connection", ready)
                    ticket, result, error = self._answer(pipe)
                    if ticket < first:
                        # Left over from a round that nobody saw to its end.
                        continue
                    if error is not None:
                        raise error
                    results[ticket - first] = result
                    self._hand(pipe, first, waiting, work, items)
            yield results.pop(i)

    def _start(self) -> None:
        if self._processes:
            return
        fork = multiprocessing.get_context("fork")
        with warnings.catch_warnings():
            # Python 3.12 counts the idle threads of a BLAS library, which survive a fork.
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            for _ in range(self._count):
                here, there = fork.Pipe()
                process = fork.Process(target=_serve, args=(self._shared, there, os.getpid()), daemon=True)
                process.start()
                # Only the worker holds this end now, so that its death closes the pipe.
                there.close()
                self._processes[here] = process

    def _hand(
        self, pipe: Connection, first: int, waiting: Iterator[int], work: object, items: list[S]
    ) -> None:
        i = next(waiting, None)
        if i is not None:
            # That a worker is gone shows when its answer is read.
            with contextlib.suppress(BrokenPipeError):
                pipe.send((first + i, work, items[i]))

    def _answer(self, pipe: Connection) -> tuple[int, Any, Exception | None]:
        try:
            answer: tuple[int, Any, Exception | None] = pipe.recv()
        except (EOFError, ConnectionResetError) as gone:
            self._processes[pipe].join()
            raise MemoryError(f"a worker process ended with code {self._processes[pipe].exitcode}") from gone
        return answer
