"""What the verbs that work on many processes share: their options, and the processes themselves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.common import narrate
from calib.core.errors import UsageError

if TYPE_CHECKING:
    from calib.core.workers import Processes
    from calib.runner.outcomes import Store

OutOption = Annotated[
    Path, typer.Option("-o", "--output", help="Folder for the results; a later run goes on from it.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler to work on, as tls://host:8786."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", min=1, max=512, help="Processes on this machine. [default: one per processor]"),
]
RetriesOption = Annotated[
    int,
    typer.Option("--retries", min=0, max=10, help="How often a task is tried again after its process died."),
]


@contextmanager
def at_work(
    output: Path,
    verb: str,
    outputs: tuple[str, ...],
    scheduler: str | None,
    workers: int | None,
    retries: int,
) -> Iterator[tuple[Store, Processes]]:
    """The output folder, see `opened_store`, and the processes: this machine's own, or those of a scheduler.

    Raises `UsageError` where both a scheduler and a number of workers are given.
    """
    from calib.core.workers import processors
    from calib.runner.outcomes import opened_store
    from calib.runner.processes import connected, local

    if scheduler is not None and workers is not None:
        raise UsageError("--workers: an existing cluster has its own workers, give --scheduler alone")
    with opened_store(output, verb, outputs) as (store, interrupted):
        if interrupted:
            narrate("the last run here was interrupted; going on where it stopped")
        with (
            connected(scheduler, narrate)
            if scheduler
            else local(workers or processors(), retries, store.scratch) as pool
        ):
            yield store, pool
