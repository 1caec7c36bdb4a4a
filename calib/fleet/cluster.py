"""Processes to work in: a cluster of this machine's own, or an existing one by its scheduler's address.

The local cluster has one thread in each process, because a verb takes over stdout and its memory is
measured for the process; its scheduler lives in this process and keeps short logs, so that its memory
does not grow with the number of tasks. A process that dies is started again by its nanny. When this
process dies, however it dies, the others follow it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib import __version__
from calib.errors import BadInputError
from calib.files import make_folder, one_line
from calib.fleet.extra import needed
from calib.fleet.task import program

__all__ = ["Cluster", "Survey", "check_survey", "connected", "survey"]

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
        # A long solve may hold the interpreter for a while; a process that died is noticed by its connection.
        "distributed.scheduler.worker-ttl": "1 hour",
        "distributed.comm.timeouts.connect": f"{_CONNECT_S:g}s",
    }
    with dask.config.set(wanted):
        yield


@contextmanager
def _local(workers: int, scratch: Path) -> Iterator[tuple[Any, Any]]:
    distributed = needed("distributed")
    shutil.rmtree(scratch, ignore_errors=True)
    make_folder(scratch)
    options: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "processes": True,
        "host": "127.0.0.1",
        # Without a place the information pages listen on all of the machine's addresses.
        "dashboard_address": "127.0.0.1:0",
        "worker_dashboard_address": "127.0.0.1:0",
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
        several = [name for name, threads in cluster.processes().items() if threads > 1]
        if several:
            remarks += (
                f"{len(several)} workers have several threads, and a process works on one rig at a time; "
                "start them with --nthreads 1",
            )
        yield Cluster(client, told, program(), remarks)


def _words(error: BaseException) -> str:
    return one_line(" ".join(str(error).split()))[:200] or type(error).__name__
