"""Work on many items at once, on all processors that this process may use.

Forked workers see what the process holds without copying it, and are not held up by the interpreter's
lock, as threads are. A process may fork safely only while it has one Python thread, so that elsewhere,
and on systems where forking is not safe at all, threads do the work.

A process here is a loop at a pipe and does one task at a time, so that one which dies, or does not come to an
end, is one task less and no more. A pool of `concurrent.futures` breaks as a whole when a process of it dies;
one that ends in the middle of its work, as after Ctrl-C, now and then never ends; and its processes outlive a
parent that is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import wait as wait_for_futures
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Generic, Literal, Protocol, TypeVar

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

_PR_SET_PDEATHSIG = 1

_most: list[int] = []
_starting = threading.Lock()
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
    threads = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        _most.pop()


# ----------------------------------------------------------------------
# Tasks, and the processes of this machine that carry them out.


@dataclass(frozen=True)
class Task:
    """A call `function(*arguments)` under a name that is unique, with the time [s] that it has.

    `function` is one of a module. A task may be begun more than once, so that it must not have effects that
    count.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    limit_s: float = math.inf


@dataclass(frozen=True)
class Failure:
    """In place of a task's result.

    Attributes
    ----------
    how : its process "died", its time was "over", or it "raised" an exception. error : that exception.
    """

    how: Literal["died", "over", "raised"]
    error: Exception | None = field(default=None, compare=False)


class Processes(Protocol):
    """What carries out tasks, some at a time."""

    @property
    def free(self) -> bool:
        """Whether another task can be started."""

    def start(self, task: Task) -> None:
        """Start a task."""

    def finished(self) -> Iterator[tuple[Task, Any]]:
        """Wait until a task has ended; those that have, with results or a `Failure`. None if none is left."""


def run_tasks(processes: Processes, tasks: Iterable[Task]) -> Iterator[tuple[Task, Any]]:
    """Tasks with their results in the order in which they end; no more are in hand than can be under way."""
    waiting = iter(tasks)
    while True:
        while processes.free and (task := next(waiting, None)) is not None:
            processes.start(task)
        ended = list(processes.finished())
        if not ended:
            return
        yield from ended


def guarded(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """What the function returns, or a `Failure`."""
    try:
        return function(*arguments)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return Failure("raised", error)


def _serve(channel: Connection, parent: int, begin: Callable[[bool], None] | None, ahead: bool) -> None:
    """Life of a process: calls in, results out, until the other end closes."""
    # Ctrl-C reaches all processes of a terminal; the first one answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":
        # In the middle of a task, too, and where brothers and sisters hold the pipe's other end open.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
        if os.getppid() != parent:
            os._exit(1)
    if begin is not None:
        begin(ahead)
    with contextlib.suppress(EOFError, OSError):
        while True:
            result = guarded(*channel.recv())
            try:
                channel.send(result)
            except OSError:
                raise
            except Exception as error:
                # What cannot be pickled is told in words.
                told = result.error if isinstance(result, Failure) else error
                channel.send(Failure("raised", RuntimeError(repr(told))))


class Pool:
    """A few processes of this machine; use with `with`, whose end kills them.

    Parameters
    ----------
    retries : how often a task is tried again after its process has died.
    begin : a function that each process calls first, with whether it was started ahead of its first task.
    forked : whether processes are forked, so that `begin` is handed on as it is. They cannot fork then.
    """

    def __init__(
        self, count: int, retries: int = 0, begin: Callable[[bool], None] | None = None, forked: bool = False
    ) -> None:
        self._count, self._retries, self._begin, self._forked = max(1, count), retries, begin, forked
        self._idle: list[tuple[Connection, BaseProcess]] = []
        self._busy: dict[Connection, tuple[BaseProcess, Task, float]] = {}
        self._deaths: Counter[str] = Counter()

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        ours = self._idle + [(channel, busy[0]) for channel, busy in self._busy.items()]
        # Whoever works still does so for nobody.
        for _channel, process in ours:
            process.kill()
        for channel, process in ours:
            process.join()
            channel.close()
        self._idle, self._busy = [], {}

    @property
    def free(self) -> bool:
        """Whether another task can be started."""
        return len(self._busy) < self._count

    def start(self, task: Task) -> None:
        """Hand a task to an idle process, or to a new one; with the first, another is made ready."""
        first = not (self._idle or self._busy)
        channel, process = self._idle.pop() if self._idle else self._made(ahead=False)
        self._busy[channel] = process, task, time.monotonic() + task.limit_s
        # That a process is gone shows when its answer is read.
        with contextlib.suppress(OSError):
            channel.send((task.function, task.arguments))
        if first and self._count > 1 and not self._forked:
            # Starting Python and its libraries takes longer than most tasks do.
            self._idle.append(self._made(ahead=True))

    def _made(self, ahead: bool) -> tuple[Connection, BaseProcess]:
        context: Any = multiprocessing.get_context("fork" if self._forked else "spawn")
        channel, theirs = context.Pipe()
        words = (theirs, os.getpid(), self._begin, ahead)
        process: BaseProcess = context.Process(target=_serve, args=words, daemon=self._forked)
        with warnings.catch_warnings(), contextlib.nullcontext() if self._forked else _no_script():
            # Python 3.12 counts the idle threads of a BLAS library, which survive a fork.
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            process.start()
        # Only the process holds this end now, so that its death closes the pipe.
        theirs.close()
        return channel, process

    def finished(self) -> Iterator[tuple[Task, Any]]:
        """Wait until a task has ended; those that have, with results or a `Failure`. None if none is left."""
        ended: list[tuple[Task, Any]] = []
        while self._busy and not ended:
            # The wait is a short one, again and again, so that Ctrl-C is answered.
            ready = wait(self._busy, timeout=_LOOK_UP_S)
            for channel, (process, task, until) in list(self._busy.items()):
                if channel not in ready and time.monotonic() < until:
                    continue
                del self._busy[channel]
                result = _received(channel) if channel in ready else Failure("over")
                how = result.how if isinstance(result, Failure) else "well"
                if how in ("died", "over"):
                    process.kill()
                    process.join()
                    channel.close()
                else:
                    self._idle.append((channel, process))
                if how == "died" and self._deaths[task.name] < self._retries:
                    self._deaths[task.name] += 1
                    self.start(task)
                else:
                    ended.append((task, result))
        yield from ended


@contextlib.contextmanager
def _no_script() -> Iterator[None]:
    """Hide the script that runs: a process that is spawned would run it again before its first task."""
    with _starting:
        script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script


def _received(channel: Connection) -> Any:
    try:
        return channel.recv()
    except (EOFError, OSError):
        return Failure("died")


# ----------------------------------------------------------------------
# Many items in their order, by forked processes or by threads.


def _may_fork(items: int) -> bool:
    return (
        items >= _FEWEST_TO_FORK
        and processors() > 1
        and sys.platform == "linux"
        and {thread.name for thread in threading.enumerate()} <= {threading.main_thread().name, WATCHER}
        and not multiprocessing.current_process().daemon
        and _have_left()
    )


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


_inherited: list[Any] = []


def _inherit(shared: object, _: bool) -> None:
    _inherited.append(shared)


def _on_inherited(work: Callable[[Any, S], T], item: S) -> T:
    return work(_inherited[0], item)


class Workers(Generic[Shared]):
    """Calls `work(shared, item)` for many items at once.

    Parameters
    ----------
    shared : what all calls have in common; forked workers see it as it is when they start.
    items : how many items there are about to be.

    `work` has to be a function of a module, and items and results have to be picklable. OpenCV's own
    threads are off meanwhile: they would only get in the way.
    """

    def __init__(self, shared: Shared, items: int) -> None:
        self._shared = shared
        self._forks = _may_fork(items)
        self._count = max(1, min(items, processors()))
        self._pool = Pool(self._count, begin=partial(_inherit, shared), forked=True)
        self._rounds = 0

    def __enter__(self) -> Workers[Shared]:
        self._threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        cv2.setNumThreads(self._threads)
        self._pool.__exit__()

    def in_order(self, work: Callable[[Shared, S], T], items: Iterable[S]) -> Iterator[T]:
        """Results in the order of the items.

        Raises what `work` raises, and `MemoryError` when the system ends a worker.
        """
        return self._by_processes(work, list(items)) if self._forks else self._by_threads(work, items)

    def _by_threads(self, work: Callable[[Shared, S], T], items: Iterable[S]) -> Iterator[T]:
        pool = ThreadPoolExecutor(self._count, initializer=lambda: _leaving.add(threading.get_native_id()))
        try:
            futures = [pool.submit(work, self._shared, item) for item in items]
            futures.reverse()
            while futures:
                # Ctrl-C that comes just before a long wait is answered only at its end.
                while not wait_for_futures([futures[-1]], timeout=_LOOK_UP_S).done:
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
        self._rounds += 1
        names = [f"{self._rounds} {i}" for i in range(len(items))]
        tasks = (Task(name, _on_inherited, (work, item)) for name, item in zip(names, items, strict=True))
        results, due = dict[str, T](), iter(names)
        name = next(due, "")
        for task, result in run_tasks(self._pool, tasks):
            if isinstance(result, Failure):
                raise result.error or MemoryError("a worker process has died")
            results[task.name] = result
            while name in results:
                yield results.pop(name)
                name = next(due, "")
