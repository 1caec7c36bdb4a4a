"""`calib fleet`: many rigs from a manifest; a table, a page, and each rig's own results out."""

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
    from calib.runner.fleet import FleetSummary


def fleet(
    manifest: Annotated[
        Path,
        typer.Argument(help="CSV or YAML with name, path (or URL) and perhaps serial of each rig."),
    ],
    output: OutOption,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
    retries: RetriesOption = 2,
    timeout: Annotated[
        str,
        typer.Option(
            "--timeout", metavar="TIME", help="The most time that a rig gets; one that needs more is a row."
        ),
    ] = "1h",
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
    from calib.core.files import shown
    from calib.core.units import parse_duration_s
    from calib.runner.fleet import check_apart, finish, run_fleet
    from calib.runner.outcomes import TIMINGS
    from calib.runner.rigs import SCHEMES, Allowed, FleetOptions, read_manifest, twice_told
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
        _tell(summary, counts["same"], output)
    narrate(f"page written to {output / PAGE}")
    if any(verdict != "ok" for verdict in summary.verdicts):
        raise typer.Exit(EXIT_POOR)


def _as_json(summary: FleetSummary, as_before: int) -> dict[str, Any]:
    return {
        "rigs": summary.rigs,
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


def _tell(summary: FleetSummary, as_before: int, output: Path) -> None:
    from calib.core.files import shown

    words = ", ".join(f"{count} {verdict}" for verdict, count in summary.verdicts.items())
    say(f"{summary.rigs} rigs: {words}" + (f"; {as_before} as before" if as_before else ""))
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
        for line in table(["constant", "median", "spread", "outliers", "drift per number"], rows):
            say(line)
    for look in summary.looks[:_MOST_TOLD]:
        say(f"look at {look.name}: {look.verdict}{', ' if look.why else ''}{look.why}")
    if summary.to_look_at > _MOST_TOLD:
        say(f"... and {summary.to_look_at - _MOST_TOLD} more, in the page")
    say(f"{shown(output)}: fleet.parquet, fleet.html and a folder for each rig in rigs/")
