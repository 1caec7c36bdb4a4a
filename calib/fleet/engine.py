"""Many calls of one function on a cluster, in bounded memory and through the death of its processes.

A few tasks for each process are under way at a time; a result is handed on and forgotten before the next
task goes out, so that memory here does not depend on how many there are. Dask gives a task whose process
has died to another one, and counts: after as many deaths as are allowed it is given up (KilledWorker).
It counts for every task that the process had, also for those that only waited there, so that a task
which was given up is tried once more at the end with nothing beside it. Only what fails then is lost.

A process that dies in the moment in which it has been started is not started again: its nanny still waits
for it (distributed 2026.8). Hence the pause before the first task of a process, and new processes in place
of those that stay away.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from calib.errors import BadInputError
from calib.files import one_line
from calib.fleet.cluster import Cluster
from calib.fleet.extra import needed
from calib.fleet.worker import Stranger, call

__all__ = ["LIMIT_S", "Broken", "Lost", "Task", "run_tasks"]

LIMIT_S = 3600.0
"""Time that a task has."""

_AHEAD = 2
"""Tasks under way for each process: one that runs and one that waits, so that none idles."""
_LOOK_S = 0.01
_COUNT_S = 3.0
_NO_WORKERS_S = 60.0
_AWAY_S = 20.0
_GATHER_S = 60.0
_MOST_CANCELLED = 5


@dataclass(frozen=True)
class Task:
    """Arguments of a call under a name that is unique among all."""

    name: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Lost:
    """A task whose process died each time that it was tried."""

    tries: int


@dataclass(frozen=True)
class Broken:
    """A task that raised what it should not have."""

    words: str


def run_tasks(
    cluster: Cluster,
    function: Callable[..., Any],
    tasks: Iterable[Task],
    done: Callable[[Task, Any], None],
    retries: int = 2,
    limit_s: float = LIMIT_S,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Call `function(*task.arguments)` for each task and `done(task, result)` in the order in which they end.

    Parameters
    ----------
    function : of a module, and without effects that count: a task may be run more than once.
    done : gets `Lost`, `Broken` or `Overdue` in place of a result; what it keeps is what this takes of
        memory.
    limit_s : time [s] that a task has from when it is begun.
    tell : gets sentences about workers that are not used.

    Raises `BadInputError` when the scheduler is gone, or has had no workers for a minute, or none that work
    with this program.
    """
    suspects: list[Task] = []

    def first(task: Task, result: Any) -> None:
        if isinstance(result, Lost):
            suspects.append(task)
        else:
            done(task, result)

    run = _Run(cluster, function, limit_s, tell)
    run.all(iter(tasks), first, None)
    for task in suspects:

        def last(one: Task, result: Any) -> None:
            done(one, Lost(2 * (retries + 1)) if isinstance(result, Lost) else result)

        run.all(iter([task]), last, 1)


@dataclass
class _Run:
    """What is known of the workers while tasks are run."""

    cluster: Cluster
    function: Callable[..., Any]
    limit_s: float
    tell: Callable[[str], None]
    strangers: set[str] = field(default_factory=set)

    def all(self, tasks: Iterator[Task], done: Callable[[Task, Any], None], most: int | None) -> None:
        """Run tasks with at most so many under way, by default a few for each process."""
        cluster, label = self.cluster, uuid.uuid4().hex[:12]
        completed = needed("distributed").as_completed(loop=cluster.client.loop)
        under_way: dict[Any, tuple[Task, Any]] = {}
        room, counted, seen = 1, -_COUNT_S, time.monotonic()
        complete = seen
        exhausted, again, tries, cancelled = False, deque[Task](), Counter[str](), Counter[str]()
        try:
            while True:
                now = time.monotonic()
                if now - counted > _COUNT_S:
                    counted = now
                    _check_connection(cluster)
                    processes = sum(cluster.processes().values())
                    seen = now if processes else seen
                    complete = now if processes >= cluster.wanted else complete
                    if now - complete > _AWAY_S:
                        cluster.grow(cluster.wanted - processes)
                        complete = now
                    if now - seen > _NO_WORKERS_S:
                        raise BadInputError(f"{_name(cluster)} has had no workers for a minute; {_AGAIN}")
                    room = most or _AHEAD * max(1, processes)
                while len(under_way) < room and (again or not exhausted):
                    task = again.popleft() if again else next(tasks, None)
                    if task is None:
                        exhausted = True
                        break
                    future = self._submitted(task, f"calib-{label}-{tries[task.name]}-{task.name}")
                    under_way[future.key] = task, future
                    completed.add(future)
                    del future
                if not under_way:
                    return
                if not completed.has_ready():
                    time.sleep(_LOOK_S)
                    continue
                future = next(completed)
                result = _result(cluster, future)
                if result is _NOT_YET:
                    completed.add(future)
                    continue
                task, _ = under_way.pop(future.key)
                future.release()
                del future
                if result is _CANCELLED or isinstance(result, Stranger):
                    tries[task.name] += 1
                    again.append(task)
                    if isinstance(result, Stranger):
                        self._refuse(result.worker)
                        continue
                    cancelled[task.name] += 1
                    if cancelled[task.name] > _MOST_CANCELLED:
                        raise _gone(cluster)
                    continue
                done(task, result)
                del result
        finally:
            for _, future in under_way.values():
                future.release()

    def _submitted(self, task: Task, key: str) -> Any:
        words: dict[str, Any] = {"key": key, "pure": False}
        if self.strangers:
            # Only a wish: a task that can go nowhere else would wait for ever.
            words |= {"workers": sorted(self._known()), "allow_other_workers": True}
        arguments = (self.cluster.program, self.limit_s, self.function, *task.arguments)
        try:
            return self.cluster.client.submit(call, *arguments, **words)
        except Exception as error:  # a connection that is gone has many names
            raise _gone(self.cluster) from error

    def _known(self) -> set[str]:
        return set(self.cluster.processes()) - self.strangers

    def _refuse(self, worker: str) -> None:
        if not self.cluster.address:
            raise BadInputError(f"calib, or a library, was changed while it was at work; {_AGAIN}")
        if worker not in self.strangers:
            self.strangers.add(worker)
            self.tell(f"worker {one_line(worker)}: has another calib, or other libraries, and is not used")
        if not self._known():
            raise BadInputError(f"{_name(self.cluster)} has only workers with another program; {_AGAIN}")


_AGAIN = "what is done is kept, and the same command goes on from there"
_NOT_YET, _CANCELLED = object(), object()


def _name(cluster: Cluster) -> str:
    return f"the scheduler at {cluster.address}" if cluster.address else "the local cluster"


def _gone(cluster: Cluster) -> BadInputError:
    return BadInputError(f"{_name(cluster)} does not answer any more; {_AGAIN}")


def _check_connection(cluster: Cluster) -> None:
    if cluster.client.status != "running":
        raise _gone(cluster)


def _result(cluster: Cluster, future: Any) -> Any:
    status = future.status
    if status in ("cancelled", "lost", "pending"):
        # The process that held the result has died, and it is made again; or the scheduler knows the task no
        # more, as after it has been started anew, and it has to be told again.
        _check_connection(cluster)
        return _CANCELLED if status == "cancelled" else _NOT_YET
    try:
        return future.result(timeout=_GATHER_S)
    except needed("distributed").KilledWorker:
        return Lost(0)
    except TimeoutError:
        _check_connection(cluster)
        return _NOT_YET
    except Exception as error:
        _check_connection(cluster)
        if type(error).__name__ in ("FutureCancelledError", "CancelledError"):
            return _CANCELLED
        words = " ".join(str(error).split())[:200]
        return Broken(f"{type(error).__name__}{': ' if words else ''}{words}")
