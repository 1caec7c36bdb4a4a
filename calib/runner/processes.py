"""Where tasks are carried out: in this process, in others of this machine, or on a Dask cluster.

Nobody listens on a port of this machine. Dask has no time limit, and its nanny does not start a process again
that died while it was being started, so that it is asked for where there is a cluster.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import logging
import os
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

from calib.core import __version__
from calib.core.errors import BadInputError, package, pip_install
from calib.core.files import one_line
from calib.core.workers import Failure, Pool, Task, guarded
from calib.runner.cache import program


def _words(error: BaseException) -> str:
    return one_line(" ".join(str(error).split()))[:200] or type(error).__name__


class Here:
    """Carries out each task at once, in this process."""

    def __init__(self) -> None:
        self._ended: list[tuple[Task, Any]] = []

    @property
    def free(self) -> bool:
        """Whether another task can be started."""
        return not self._ended

    def start(self, task: Task) -> None:
        """Carry out a task to its end."""
        self._ended.append((task, guarded(task.function, task.arguments)))

    def finished(self) -> Iterator[tuple[Task, Any]]:
        """The task that was carried out."""
        ended, self._ended = self._ended, []
        yield from ended


_LIBRARIES = (
    "calib.cli.main",
    "calib.cli.app",
    "calib.core.rig",
    "scipy.optimize",
    "scipy.signal",
    "numba",
    "calib.show.charts",
)
"""What most stages need and takes long to load; the first of them sets up the others."""


def local(count: int, retries: int = 0, scratch: Path | None = None) -> Pool:
    """Processes of this machine, see `Pool`; `scratch` takes temporary files, which who is killed leaves."""
    return Pool(count, retries, partial(_begin, scratch))


def _begin(scratch: Path | None, ahead: bool) -> None:
    tempfile.tempdir = None if scratch is None else str(scratch)
    for name in _LIBRARIES if ahead else ():
        # The stage that needs it says so.
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


# ----------------------------------------------------------------------
# Workers of a Dask cluster. Dask gives a task whose worker has died to another one, and gives it up after as
# many deaths as its scheduler allows. It knows no time limit, so that one is kept on the worker: what hangs
# cannot be stopped from within Python, and is left behind in a process that ends some seconds later.

_CONNECT_S = 10.0
_LOOK_UP_S = 0.02
_GATHER_S = 60.0
_LEAVE_S = 5.0
_GRACE_S = 60.0
_AGAIN = "what is done is kept, and the same command goes on from there"
_turn = threading.Lock()
"""Memory is measured, and OpenCV's threads are set, for a whole process."""


class _OtherProgramError(Exception):
    """A worker would work with another program than the one that asks."""


def _limited(expected: str, limit_s: float, function: Callable[..., Any], *arguments: Any) -> Any:
    """What the function returns, or a `Failure`; by the same program as all others, and not for ever."""
    with _turn:
        if program() != expected:
            raise _OtherProgramError
        wait_s = min(limit_s, 0.5 * threading.TIMEOUT_MAX)
        # Where a library holds the interpreter itself nothing can be answered, and the process ends without.
        _end_process(wait_s + _GRACE_S)
        work = futures.ThreadPoolExecutor(1).submit(guarded, function, arguments)
        if not futures.wait([work], wait_s).done:
            _end_process(_LEAVE_S)
            return Failure("over")
        faulthandler.cancel_dump_traceback_later()
        return work.result()


def _end_process(seconds: float) -> None:
    """End this process then, whatever it is doing: the clock is a thread that needs no interpreter."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=_nowhere())


@cache
def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)


class Cluster:
    """The workers of a Dask scheduler, see `connected`."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._busy: dict[Any, Task] = {}

    @property
    def free(self) -> bool:
        """Whether another task can be started: one for each thread of the workers."""
        with self._answering():
            threads = sum(int(count) for count in self._client.nthreads().values())
        return len(self._busy) < max(1, threads)

    def start(self, task: Task) -> None:
        """Hand a task to the scheduler."""
        with self._answering():
            words = (program(), task.limit_s, task.function, *task.arguments)
            self._busy[self._client.submit(_limited, *words, pure=False)] = task

    def finished(self) -> Iterator[tuple[Task, Any]]:
        """Wait until a task has ended; those that have, with results or a `Failure`. None if none is left."""
        while self._busy and not any(future.done() for future in self._busy):
            with self._answering():
                time.sleep(_LOOK_UP_S)
        for future in [one for one in self._busy if one.done()]:
            with self._answering():
                result = self._result(future)
            yield self._busy.pop(future), result

    @staticmethod
    def _result(future: Any) -> Any:
        from distributed import KilledWorker

        try:
            return future.result(timeout=_GATHER_S)
        except KilledWorker:
            return Failure("died")
        except _OtherProgramError as error:
            raise BadInputError(
                "a worker has another calib, or other libraries, than this one, and results would not be "
                f"those of one program; {_AGAIN}"
            ) from error

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Raise `BadInputError` where the scheduler is gone, which has many names."""
        try:
            yield
            gone = self._client.status != "running"
        except BadInputError:
            raise
        except Exception as error:
            raise self._gone() from error
        if gone:
            raise self._gone()

    def _gone(self) -> BadInputError:
        return BadInputError(f"the scheduler at {self._address} does not answer any more; {_AGAIN}")


@contextmanager
def connected(address: str, tell: Callable[[str], None]) -> Iterator[Cluster]:
    """The workers of the scheduler at an address; `tell` gets what is to be said of them.

    Raises `BadInputError` where no scheduler answers, it has no workers, or they run another program.
    """
    told = one_line(address)[:200]
    with _quiet():
        distributed = needed("distributed")
        try:
            client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise BadInputError(f"{told}: no scheduler answers there within {_CONNECT_S:g} s") from error
        except Exception as error:  # what else is wrong with an address, or with another version at its end
            raise BadInputError(f"{told}: cannot be talked to: {_words(error)}") from error
        with client:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_S)
            except TimeoutError as error:
                raise BadInputError(
                    f"{told}: the scheduler has no workers; start some with dask worker"
                ) from error
            try:
                found = client.run(survey)
            except Exception as error:  # a worker's failure comes here as it was there
                raise BadInputError(
                    f"{told}: the workers cannot run calib {__version__}: {_words(error)}; install it there"
                ) from error
            for sentence in remarks(found):
                tell(sentence)
            if not address.startswith("tls://"):
                tell(
                    f"{told}: whoever reaches this scheduler can run any program on it and on its workers; "
                    "use tls:// with certificates where others share the network"
                )
            several = [name for name, threads in client.nthreads().items() if threads > 1]
            if several:
                tell(
                    f"{len(several)} workers have several threads, and a process works on one task at a "
                    "time; start them with --nthreads 1"
                )
            yield Cluster(client, told)


def needed(name: str) -> Any:
    """A module by its name. Raises `BadInputError` where it is not installed."""
    return package(name, f"needs {name}: {pip_install('fleet')}")


def survey() -> tuple[str, str, str]:
    """Version, program and threads of BLAS of this process; runs on each worker."""
    return __version__, program(), os.environ.get("OPENBLAS_NUM_THREADS", "")


def remarks(found: dict[str, tuple[str, str, str]]) -> Iterator[str]:
    """Sentences on the workers. Raises `BadInputError` for one with another program than this one."""
    for address, (version, theirs, _) in sorted(found.items()):
        if theirs != program():
            what = (
                f"calib {version}, and this is {__version__}"
                if version != __version__
                else "another source of calib, or another Python, NumPy, SciPy or OpenCV than is here"
            )
            raise BadInputError(
                f"worker {one_line(address)}: has {what}; results would not be those of one program"
            )
    loose = sum(threads != "1" for _, _, threads in found.values())
    if loose:
        yield (
            f"{loose} of {len(found)} workers were started without OPENBLAS_NUM_THREADS=1; the last "
            "digits of their results may depend on that"
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask logs every connection that breaks; here that is a part of the work."""
    before = logging.root.manager.disable
    if os.environ.get("CALIB_DEBUG") != "1":
        logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
