"""`calib replay`: logs of camera and IMU in, lengths, angle and their covariance out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.core.errors import EXIT_POOR, BadInputError, UsageError

if TYPE_CHECKING:
    from calib.stages.estimator.replay import Replayed

__all__ = ["replay"]


def _cell(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _tell(result: Replayed) -> None:
    share = (
        "" if result.driven_share is None else f", driven in {100.0 * result.driven_share:.0f} % of the rows"
    )
    say(f"{result.source}: {result.rows} rows, {result.duration_s:.5g} s, {result.estimator}{share}")
    if result.driven_share is not None and result.driven_share < 0.99:
        rest = 100.0 * (1.0 - result.driven_share)
        say(f"  in {rest:.0f} % of the rows the kinematic model spoke, which explained them better")
    if result.rmse:
        rows = []
        for name, figures in (("this", result.rmse), *((n, f) for n, f in result.others.items())):
            rows.append(
                [name, *(_cell(figures.get(k)) for k in ("q1_mm", "q2_mm", "mean_q_mm", "phi_deg", "nees"))]
            )
        for line in table(["RMSE after 2 s", "q1, mm", "q2, mm", "mean, mm", "phi, deg", "NEES (2)"], rows):
            say(line)
    if result.sensors:
        rows = [
            [
                f"{name} ({check['degrees']})",
                _cell(check["nis"]),
                f"{check['low']:.3g} .. {check['high']:.3g}",
                f"{100 * check['inside']:.1f} %",
                _cell(check["correlation"], 2),
                str(check["gated"]),
            ]
            for name, check in result.sensors.items()
        ]
        head = ["sensor (degrees)", "NIS", "95 % band", "inside", "correlation", "gated"]
        for line in table(head, rows):
            say(line)
    say(f"verdict: {result.verdict}")
    for sentence in (*result.reasons, *result.remarks):
        say(f"  - {sentence}")


def replay(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of camera and IMU.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="States to write, .csv, .parquet or .mcap; with several logs a folder, made if needed.",
        ),
    ] = None,
    states_format: Annotated[
        Literal["csv", "parquet", "mcap"], typer.Option("--format", help="Of the states of several logs.")
    ] = "csv",
    topics: Annotated[
        Path | None,
        typer.Option(help="Which topic of a bag is which column; else NAME.topics.yaml beside the bag."),
    ] = None,
    estimator: Annotated[
        Literal["fused", "baseline"],
        typer.Option(help="The fused filter, or the low-pass pipeline that it replaces."),
    ] = "fused",
    model: Annotated[
        Literal["auto", "kinematic", "driven"],
        typer.Option(
            help="Driven by the commands in the log, kinematic, or (auto) whichever explains the log better."
        ),
    ] = "auto",
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Look at the whole log, forward and backward.")
    ] = False,
    tune: Annotated[
        bool, typer.Option("--tune", help="Learn the noise from these logs; written to the rig's file.")
    ] = False,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Estimate lengths, angle and pose from logs, with standard deviations and what they are worth.

    Exits 1 when the innovations of a log contradict its covariance or a sensor is missing.
    """
    from calib.core.files import check_folder, check_writable, hash_of, make_folder, shown
    from calib.core.result import section_json
    from calib.core.rig import Rig
    from calib.runner.folder import inside, slug
    from calib.stages.estimator.replay import replay_log

    if estimator == "baseline" and (smooth or tune):
        raise UsageError("--estimator baseline: cannot be smoothed or tuned")
    several = len(logs) > 1
    if output is not None:
        (check_folder if several else check_writable)(output)
    if tune:
        check_writable(rig)
    if figures is not None:
        check_folder(figures)
    known = Rig.load(rig, missing_ok=True)
    told: dict[str, Any] = {}
    if tune:
        from calib.stages.estimator.tuning import tuned_section

        with progress_bar("tuning") as progress:
            section = tuned_section(logs, known, rig, progress, topics)
        known.estimator = section
        known.save(rig, {"estimator": {shown(path.name): hash_of(path) for path in logs}})
        told["estimator"] = section_json(section)
        narrate(f"estimator written to {shown(rig)}")
    if output is not None and several:
        make_folder(output)
    results: list[Replayed] = []
    taken: list[str] = []
    for path in logs:
        states = output
        if output is not None and several:
            # Names of logs may hold anything, and two logs in different folders may share one.
            taken.append(slug(path.stem, taken))
            states = output / f"{taken[-1]}_states.{states_format}"
            if states.is_symlink() and not inside(states, output):
                raise BadInputError(f"{shown(states)}: is a link out of {shown(output)}, nothing was written")
        with progress_bar(f"replaying {path.name}") as progress:
            result = replay_log(
                path, known, rig, estimator, smooth, states, progress, figures is not None, model, topics
            )
        results.append(result)
        if states is not None:
            narrate(f"states written to {shown(states)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.estimator.plots import plots

        write_figures(figures, plots(results))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("replay", {**told, "replay": {"logs": [result.as_json() for result in results]}})
    else:
        for result in results:
            _tell(result)
    if any(result.verdict != "ok" for result in results):
        raise typer.Exit(EXIT_POOR)
