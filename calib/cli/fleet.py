"""`calib fleet` and `calib sweep`: many rigs, or many cases of a simulated one, on many processes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import JsonOption, document, narrate, progress_bar, say, say_table
from calib.core.errors import EXIT_POOR, UsageError
from calib.core.files import shown
from calib.core.units import parse_duration_s
from calib.core.words import BLANK, counted, short

if TYPE_CHECKING:
    from calib.core.workers import Processes
    from calib.runner.fleet import FleetSummary
    from calib.runner.outcomes import Store
    from calib.runner.sweep import SweepSummary

# ----------------------------------------------------------------------
# What both share: their options, and the processes themselves.

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


def _timeout(one: str) -> Any:
    """The option of the most time that one rig or case gets."""
    words = f"The most time that a {one} gets; one that needs more is a row."
    return typer.Option("--timeout", metavar="TIME", help=words)


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


# ----------------------------------------------------------------------
# `calib fleet`: many rigs from a manifest; a table, a page, and each rig's own results out.


def fleet(
    manifest: Annotated[
        Path,
        typer.Argument(help="CSV or YAML with name, path (or URL) and perhaps serial of each rig."),
    ],
    output: OutOption,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
    retries: RetriesOption = 2,
    timeout: Annotated[str, _timeout("rig")] = "1h",
    allow_scheme: Annotated[
        list[str] | None,
        typer.Option(
            "--allow-scheme",
            metavar="SCHEME",
            help="Kind of URL to fetch beside file, gs, https and s3, as http; may be repeated.",
        ),
    ] = None,
    allow_private: Annotated[
        bool, typer.Option("--allow-private", help="Fetch from servers of private networks, too.")
    ] = False,
    pages: Annotated[bool, typer.Option("--pages", help="Make the page of each rig as well.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate many rigs on many processes, and compare them with each other.

    A rig that fails is a row and does not end the run; rigs whose results are there are not done again.
    Exits 1 when a rig is not ok.
    """
    from calib.runner.fleet import (
        SCHEMES,
        Allowed,
        FleetOptions,
        check_apart,
        finish,
        read_manifest,
        run_fleet,
        twice_told,
    )
    from calib.runner.outcomes import TIMINGS
    from calib.show.fleet import PAGE, write_fleet_page

    limit_s = parse_duration_s(timeout, "--timeout")
    known = read_manifest(manifest)
    if known.ignored:
        narrate(f"{shown(manifest)}: not used: {', '.join(known.ignored)}")
    for sentence in twice_told(known.rigs):
        narrate(f"{shown(manifest)}: {sentence}")
    check_apart(output, known.rigs)
    outputs = ("fleet.parquet", PAGE, TIMINGS)
    with at_work(output, "calib fleet", outputs, scheduler, workers, retries) as (store, pool):
        options = FleetOptions(pages, allowed=Allowed((*SCHEMES, *(allow_scheme or ())), allow_private))
        with progress_bar("rigs") as progress:
            counts = run_fleet(store, pool, known, options, progress, narrate, limit_s)
        summary = finish(store, known)
        write_fleet_page(output / PAGE, summary)
    if as_json:
        document("fleet", {"fleet": _as_json(summary, counts["same"])})
    else:
        _tell_fleet(summary, counts["same"], output)
    narrate(f"page written to {output / PAGE}")
    if any(verdict != "ok" for verdict in summary.verdicts):
        raise typer.Exit(EXIT_POOR)


def _as_json(summary: FleetSummary, as_before: int) -> dict[str, Any]:
    return {
        "rigs": summary.rigs,
        "simulated": summary.simulated,
        "verdicts": summary.verdicts,
        "as_before": as_before,
        "stages": summary.stages,
        "constants": [
            {
                "name": one.name,
                "unit": one.unit,
                "rigs": one.spread.count,
                "median": one.spread.median,
                "spread": one.spread.scale,
                "between_rigs": one.spread.between,
                "own_sigma": one.spread.own,
                "outliers": one.standing_out,
                "drift_per_serial": None if one.drift is None else one.drift.slope,
                "drift_sigma": None if one.drift is None else one.drift.sigma,
                "drifts": one.drifts,
            }
            for one in summary.constants
        ],
        "to_look_at": [asdict(look) for look in summary.looks],
    }


_MOST_TOLD = 20


def _tell_fleet(summary: FleetSummary, as_before: int, output: Path) -> None:
    words = ", ".join(f"{count} {verdict}" for verdict, count in summary.verdicts.items())
    simulated = f"; simulated: {summary.simulated}" if summary.simulated else ""
    before = f"; {as_before} as before" if as_before else ""
    say(f"{counted(summary.rigs, 'rig')}: {words}{simulated}{before}")
    rows = []
    for one in summary.constants:
        if one.standing_out or one.drifts:
            drift = "" if one.drift is None else f"{one.drift.slope:.3g} ± {one.drift.sigma:.2g}"
            rows.append(
                [
                    one.name,
                    f"{one.spread.median:.6g}",
                    f"{one.spread.scale:.2g}",
                    str(one.standing_out),
                    drift if one.drifts else "",
                ]
            )
    if rows:
        say_table(["constant", "median", "spread", "outliers", "drift per number"], rows)
    if summary.remark:
        say(summary.remark[0].lower() + summary.remark[1:-1])
    for look in summary.looks[:_MOST_TOLD]:
        say(f"look at {look.name}: {look.verdict}{', ' if look.why else ''}{look.why}")
    if summary.to_look_at > _MOST_TOLD:
        say(f"... and {summary.to_look_at - _MOST_TOLD} more, in the page")
    say(f"{shown(output)}: fleet.parquet, fleet.html and a folder for each rig in rigs/")


# ----------------------------------------------------------------------
# `calib sweep`: controllers, scenarios and filters over plants and gains; a table and a page out.


def sweep(
    spec: Annotated[
        Path, typer.Argument(help="YAML with base, grid, draws and measure; calib docs sweep shows one.")
    ],
    output: OutOption,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
    retries: RetriesOption = 2,
    timeout: Annotated[str, _timeout("case")] = "10min",
    as_json: JsonOption = False,
) -> None:
    """Run a controller, a scenario or a filter on the simulated rig over many plants and settings.

    The first measure decides; the least of it is best, or what is near the value that was asked for. A case
    that fails is a row. Exits 1 when one has failed.
    """
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
        _tell_sweep(summary)
        say(f"{shown(output)}: sweep.parquet and sweep.html")
    narrate("simulated: a model of a rig, not the rig")
    if summary.failed:
        raise typer.Exit(EXIT_POOR)


_MEASURES = 5
"""For a terminal; the page has them all."""


def _tell_sweep(summary: SweepSummary) -> None:
    parts = [counted(summary.cases, "case")]
    if summary.as_before:
        parts.append(f"{summary.as_before} as before")
    if summary.first:
        parts.append(f"{summary.failed} failed, the first: {summary.first.told()}: {summary.why}")
    say("; ".join(parts))
    if not summary.best and summary.cases > summary.failed:
        say(f"no case has a value of {summary.measure}")
    for title, points in (("best", summary.best[:5]), ("worst", summary.worst[:5])):
        if not points:
            continue
        head = summary.heads(title)[: len(points[0].parameters) + 2 + _MEASURES]
        say_table(head, [[f"#{one.point}", *map(_text, one.cells)][: len(head)] for one in points])


def _text(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return short(value) if math.isfinite(value) else BLANK
