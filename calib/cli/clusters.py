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


def check_places(scheduler: str | None, workers: int | None) -> None:
    """Raise `UsageError` where both are given."""
    if scheduler is not None and workers is not None:
        raise UsageError("--workers: an existing cluster has its own workers, give --scheduler alone")


@contextmanager
def opened_out(output: Path, verb: str, outputs: tuple[str, ...]) -> Iterator[Store]:
    """The output folder, see `opened_store`; says so where the last run there was interrupted."""
    from calib.runner.outcomes import opened_store

    with opened_store(output, verb, outputs) as (store, interrupted):
        if interrupted:
            narrate("the last run here was interrupted; going on where it stopped")
        yield store


@contextmanager
def processes(store: Store, scheduler: str | None, workers: int | None, retries: int) -> Iterator[Processes]:
    """The processes to work in: this machine's own, or those of a scheduler."""
    from calib.core.workers import processors
    from calib.runner.processes import connected, local

    with (
        connected(scheduler, narrate)
        if scheduler
        else local(workers or processors(), retries, store.scratch) as made
    ):
        yield made
