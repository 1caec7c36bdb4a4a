"""Tasks on many processes: workers, the cluster, tries, time limits."""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import shutil
import threading
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from calib import __version__
from calib.core.errors import BadInputError
from calib.core.files import one_line
from calib.core.writing import make_folder
from calib.runner.task import needed, program

# ----------------------------------------------------------------------
# A task in its process: one at a time, by the same program as all others, and not for ever.
#
# What hangs cannot be stopped from within Python, so that it is left behind: the answer is that it took too
# long, and the process ends some seconds later, when the answer has been fetched. Its nanny starts another.
# Where a library holds the interpreter itself, nothing can be answered, and the process ends without.

_SETTLE_S = 1.0
_LEAVE_S = 10.0
_GRACE_S = 60.0
_turn = threading.Lock()
"""A verb takes over stdout, and memory is measured for the whole process."""
_settled = threading.Event()
_leaving = threading.Event()


@dataclass(frozen=True)
class Overdue:
    """A task that was not done when its time was over."""

    limit_s: float


@dataclass(frozen=True)
class Stranger:
    """A task that was refused, because its worker would work with another program."""

    worker: str


def call(expected: str, limit_s: float, function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, `Overdue` or `Stranger`; not before the worker's nanny knows that it is there.

    Parameters
    ----------
    expected : the program that all work with, "" for any.
    """
    with _turn:
        if _leaving.is_set():
            # The process ends in a moment, and another one gets this task.
            time.sleep(2.0 * _LEAVE_S)
        if expected and program() != expected:
            return Stranger(str(needed("distributed").get_worker().address))
        if not _settled.is_set():
            time.sleep(_SETTLE_S)
            _settled.set()
        return _within(limit_s, function, arguments)


def _within(limit_s: float, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    ended: list[tuple[Any, BaseException | None]] = []

    def work() -> None:
        try:
            ended.append((function(*arguments), None))
        except BaseException as error:
            ended.append((None, error))

    thread = threading.Thread(target=work, daemon=True)
    # More than a clock can count is for ever.
    wait_s = min(limit_s, 0.5 * threading.TIMEOUT_MAX)
    _end_process(wait_s + _GRACE_S)
    thread.start()
    thread.join(wait_s)
    if not ended:
        _leaving.set()
        _end_process(_LEAVE_S)
        return Overdue(limit_s)
    faulthandler.cancel_dump_traceback_later()
    result, error = ended[0]
    if error is not None:
        raise error
    return result


def _end_process(seconds: float) -> None:
    """End this process then, whatever it is doing: the clock is a thread that needs no interpreter."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=_nowhere())


@cache
def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)


# ----------------------------------------------------------------------
# Processes to work in: a cluster of this machine's own, or an existing one by its scheduler's address.
#
# The local cluster has one thread in each process, because a verb takes over stdout and its memory is
# measured for the process; its scheduler lives in this process and keeps short logs, so that its memory
# does not grow with the number of tasks. A process that dies is started again by its nanny. When this
# process dies, however it dies, the others follow it.
#
# Who may talk to a scheduler may run code as the user that started it, and it listens on a port that every
# user of this machine can reach. So both ends show a certificate that is made for this run and is not
# written down, and there are no information pages.

_CONNECT_S = 10.0
_SHORT_LOG = 100


@dataclass(frozen=True)
class Survey:
    """What a worker says of itself."""

    version: str
    program: str
    blas_threads: str


@dataclass(frozen=True)
class Cluster:
    """A connection.

    Attributes
    ----------
    address : of the scheduler, as a person reads it; "" for this machine's own.
    program : that all workers run, see `task.program`.
    remarks : sentences about the workers.
    wanted : threads that there should be, 0 where that is not ours to say. grow : starts so many more.
    """

    client: Any
    address: str
    program: str
    remarks: tuple[str, ...] = ()
    wanted: int = 0
    grow: Callable[[int], None] = lambda _: None

    def processes(self) -> dict[str, int]:
        """Threads of each worker by its address; empty where the scheduler does not answer."""
        try:
            return {str(name): int(count) for name, count in self.client.nthreads().items()}
        except Exception:  # a connection that breaks has many names
            return {}


def survey() -> Survey:
    """What this process would work with; runs on each worker."""
    return Survey(__version__, program(), os.environ.get("OPENBLAS_NUM_THREADS", ""))


def check_survey(found: dict[str, Survey], mine: Survey) -> tuple[str, ...]:
    """Remarks on the workers. Raises `BadInputError` for one with another program than this one."""
    for address, one in sorted(found.items()):
        if one.program != mine.program:
            what = (
                f"calib {one.version}, and this is {mine.version}"
                if one.version != mine.version
                else "another source of calib, or another Python, NumPy, SciPy or OpenCV than is here"
            )
            raise BadInputError(
                f"worker {one_line(address)}: has {what}; results would not be those of one program"
            )
    loose = [address for address, one in found.items() if one.blas_threads != "1"]
    if loose:
        return (
            f"{len(loose)} of {len(found)} workers were started without OPENBLAS_NUM_THREADS=1; the last "
            "digits of their results may depend on that",
        )
    return ()


@contextmanager
def connected(scheduler: str | None, workers: int, scratch: Path, retries: int) -> Iterator[Cluster]:
    """A cluster of `workers` processes, or the one at the address `scheduler`.

    Parameters
    ----------
    scratch : folder for the files of a local cluster, made and removed here.
    retries : how often a task may be tried again after its process has died; an existing scheduler has
        its own setting.

    Raises `BadInputError` where no scheduler answers, it has no workers, or they run another program.
    """
    needed("distributed")
    with _quiet(), _settings(retries):
        if scheduler is None:
            with _local(workers, scratch) as (client, local):

                def grow(missing: int) -> None:
                    local.scale(len(local.worker_spec) + missing)

                yield Cluster(client, "", program(), (), workers, grow)
        else:
            with _existing(scheduler) as cluster:
                yield cluster


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask logs every process that dies and every connection that breaks; here that is a part of the work."""
    before = logging.root.manager.disable
    if os.environ.get("CALIB_DEBUG") != "1":
        logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@contextmanager
def _settings(retries: int) -> Iterator[None]:
    dask = needed("dask")
    wanted = {
        "distributed.scheduler.allowed-failures": retries,
        "distributed.admin.log-length": _SHORT_LOG,
        "distributed.admin.low-level-log-length": _SHORT_LOG,
        "distributed.admin.system-monitor.log-length": _SHORT_LOG,
        "distributed.scheduler.dashboard.tasks.task-stream-length": _SHORT_LOG,
        "distributed.diagnostics.computations.max-history": 1,
        "distributed.diagnostics.erred-tasks.max-history": 1,
        "distributed.worker.profile.enabled": False,
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        "distributed.nanny.http.routes": [],
        # A long solve may hold the interpreter for a while; a process that died is noticed by its connection.
        "distributed.scheduler.worker-ttl": "1 hour",
        "distributed.comm.timeouts.connect": f"{_CONNECT_S:g}s",
    }
    with dask.config.set(wanted):
        yield


@contextmanager
def _local(workers: int, scratch: Path) -> Iterator[tuple[Any, Any]]:
    distributed = needed("distributed")
    needed("cryptography")
    shutil.rmtree(scratch, ignore_errors=True)
    make_folder(scratch)
    options: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "processes": True,
        "host": "127.0.0.1",
        "protocol": "tls://",
        "security": distributed.security.Security.temporary(),
        # Without a place the information pages' server takes the port that all know.
        "dashboard_address": "127.0.0.1:0",
        "scheduler_kwargs": {"dashboard": False},
        "worker_dashboard_address": None,
        "local_directory": str(scratch),
        "silence_logs": logging.CRITICAL + 1,
    }
    try:
        try:
            cluster = distributed.LocalCluster(**options)
        except (OSError, RuntimeError, TimeoutError) as error:
            raise BadInputError(f"the processes could not be started: {_words(error)}") from error
        try:
            with distributed.Client(cluster, timeout=_CONNECT_S, set_as_default=False) as client:
                yield client, cluster
        finally:
            with contextlib.suppress(Exception):
                cluster.close(timeout=10)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def _existing(address: str) -> Iterator[Cluster]:
    told = one_line(address)[:200]
    try:
        client = needed("distributed").Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise BadInputError(f"{told}: no scheduler answers there within {_CONNECT_S:g} s") from error
    except Exception as error:  # what else is wrong with an address, or with another version at its end
        raise BadInputError(f"{told}: cannot be talked to: {_words(error)}") from error
    with client:
        cluster = Cluster(client, told, program())
        began = time.monotonic()
        while not cluster.processes():
            if time.monotonic() - began > _CONNECT_S:
                raise BadInputError(f"{told}: the scheduler has no workers; start some with dask worker")
            time.sleep(0.2)
        try:
            found = client.run(survey)
        except Exception as error:  # a worker's failure comes here as it was there
            raise BadInputError(
                f"{told}: the workers cannot run calib {__version__}: {_words(error)}; install it there"
            ) from error
        remarks = check_survey(found, survey())
        if not address.startswith("tls://"):
            remarks += (
                f"{told}: whoever reaches this scheduler can run any program on it and on its workers; use "
                "tls:// with certificates where others share the network",
            )
        several = [name for name, threads in cluster.processes().items() if threads > 1]
        if several:
            remarks += (
                f"{len(several)} workers have several threads, and a process works on one rig at a time; "
                "start them with --nthreads 1",
            )
        yield Cluster(client, told, program(), remarks)


def _words(error: BaseException) -> str:
    return one_line(" ".join(str(error).split()))[:200] or type(error).__name__


# ----------------------------------------------------------------------
# Many calls of one function on a cluster, in bounded memory and through the death of its processes.
#
# A few tasks for each process are under way at a time; a result is handed on and forgotten before the next
# task goes out, so that memory here does not depend on how many there are. Dask gives a task whose process
# has died to another one, and counts: after as many deaths as are allowed it is given up (KilledWorker).
# It counts for every task that the process had, also for those that only waited there, so that a task
# which was given up is tried once more at the end with nothing beside it. Only what fails then is lost.
#
# A process that dies in the moment in which it has been started is not started again: its nanny still waits
# for it (distributed 2026.8). Hence the pause before the first task of a process, and new processes in
# place
# of those that stay away.

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
