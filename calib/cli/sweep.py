"""`calib sweep`: controllers, scenarios and filters over plants and gains; a table and a page out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.clusters import (
    OutOption,
    RetriesOption,
    SchedulerOption,
    WorkersOption,
    at_work,
)
from calib.cli.common import JsonOption, document, narrate, progress_bar, say, table
from calib.core.errors import EXIT_POOR

if TYPE_CHECKING:
    from calib.runner.sweep import SweepSummary


def sweep(
    spec: Annotated[Path, typer.Argument(help="YAML with base, grid, draws and measure.")],
    output: OutOption,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
    retries: RetriesOption = 2,
    timeout: Annotated[
        str,
        typer.Option(
            "--timeout", metavar="TIME", help="The most time that a case gets; one that needs more is a row."
        ),
    ] = "10min",
    as_json: JsonOption = False,
) -> None:
    """Run a controller, a scenario or a filter on the simulated rig over many plants and settings.

    The first measure decides; the least of it is best, or what is near the value that was asked for. A case
    that fails is a row. Exits 1 when one has failed.
    """
    from calib.core.files import shown
    from calib.core.units import parse_duration_s
    from calib.runner.outcomes import TIMINGS
    from calib.runner.sweep import read_sweep, run_sweep, summarise_sweep
    from calib.show.fleet import SWEEP_PAGE, write_sweep_page

    limit_s = parse_duration_s(timeout, "--timeout")
    known = read_sweep(spec)
    outputs = ("sweep.parquet", SWEEP_PAGE, TIMINGS)
    with at_work(output, "calib sweep", outputs, scheduler, workers, retries) as (store, pool):
        with progress_bar("cases") as progress:
            counts = run_sweep(store, pool, known, progress, limit_s)
        summary = summarise_sweep(store, known, counts["same"])
        write_sweep_page(output / SWEEP_PAGE, known, summary)
    if as_json:
        document("sweep", {"sweep": {**asdict(summary), "clouds": None}})
    else:
        _tell(summary)
        say(f"{shown(output)}: sweep.parquet and sweep.html")
    narrate("simulated: a model of a rig, not the rig")
    if summary.failed:
        raise typer.Exit(EXIT_POOR)


def _tell(summary: SweepSummary) -> None:
    parts = [f"{summary.cases} cases"]
    if summary.as_before:
        parts.append(f"{summary.as_before} as before")
    if summary.failed:
        parts.append(f"{summary.failed} failed, the first: {summary.why}")
    say("; ".join(parts))
    for title, points in (("best", summary.best[:5]), ("worst", summary.worst[:5])):
        if not points:
            continue
        names = list(points[0].parameters)
        head = [title, *names, f"{summary.measure}, median", "worst draw"]
        rows = [
            [
                f"#{point.point}",
                *(_text(value) for value in point.parameters.values()),
                f"{point.median:.4g}",
                f"{point.worst:.4g}",
            ]
            for point in points
        ]
        for line in table(head, rows):
            say(line)


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
