"""`calib validate`: the models against logs, and the book of claims."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.errors import UsageError

if TYPE_CHECKING:
    from calib.claims.book import Examined
    from calib.validating import Comparison

__all__ = ["validate"]

_UNITS = {"q1": (1e3, "mm"), "q2": (1e3, "mm"), "phi": (1.0, "rad")}


def _cell(value: float | None, form: str = ".3g") -> str:
    return "-" if value is None or value != value else f"{value:{form}}"


def _left(head: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a table of words, every column to the left."""
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    return [
        "  " + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in [head, *rows]
    ]


def _tell_log(one: Comparison) -> None:
    hoses = "pumps connected" if one.hoses else "hoses off"
    say(
        f"{one.name}: {len(one.t_s)} poses over {one.t_s[-1] - one.t_s[0]:.4g} s from {one.how}, {hoses}, "
        f"start by {'the estimator' if one.start == 'estimator' else one.start}"
    )
    rows = []
    for quantity, (scale, unit) in _UNITS.items():
        for model, errors in one.errors.items():
            error = errors[quantity]
            gained = None if model == "original" else one.improvement_percent(quantity, model)
            rows.append(
                [
                    f"{quantity}, {unit}, {model}",
                    _cell(scale * error.norm),
                    _cell(scale * error.rms),
                    _cell(error.fit_percent, ".1f"),
                    _cell(gained, ".1f"),
                ]
            )
    for line in table(["error of", "L2 norm", "RMS", "fit, %", "smaller by, %"], rows):
        say(line)
    if any(error.norm != error.norm for errors in one.errors.values() for error in errors.values()):
        say("  - a simulated motion leaves the model before the log ends, its errors are not known")
    if one.replaced:
        say(f"  - {one.replaced} rows stood away from their neighbours and were replaced by them")


def _tell_claims(examined: tuple[Examined, ...]) -> None:
    from calib.claims.book import BOOK, by_basis, count
    from calib.claims.outcome import Outcome

    rows = [
        [
            one.claim.id,
            one.claim.where,
            one.claim.kind,
            one.claim.basis,
            one.finding.outcome.value,
            one.finding.ours + (" (simulated)" if one.finding.simulated else ""),
        ]
        for one in examined
    ]
    for line in _left(["claim", "where", "kind", "basis", "outcome", "our figure"], rows):
        say(line)
    for one in examined:
        printed = "" if one.claim.printed == "-" else f"; printed: {one.claim.printed}"
        say(f"{one.claim.id}: {one.claim.says}{printed}")
        say(f"  {one.finding.outcome.value}: {one.finding.how}")
    found = ", ".join(f"{number} {outcome.value}" for outcome, number in count(examined).items())
    say(f"{len(examined)} of {len(BOOK)} claims: {found}")
    words = {
        "equations": "from the equations alone",
        "printed": "from printed numbers",
        "twin": "on the simulated rig, with other figures fixed beforehand",
        "chosen": "on the simulated rig, this very figure among those it was chosen by",
    }
    for basis, outcomes in by_basis(examined).items():
        say(
            f"  {sum(outcomes.values()):2d} {words[basis]}: {outcomes[Outcome.REPRODUCED]} reproduced, "
            f"{outcomes[Outcome.REFUTED]} refuted, {outcomes[Outcome.UNMEASURED]} open"
        )


def _log_json(one: Comparison) -> dict[str, Any]:
    return {
        "log": one.name,
        "pose_from": one.how,
        "start_from": one.start,
        "pumps_connected": one.hoses,
        "poses": len(one.t_s),
        "duration_s": float(one.t_s[-1] - one.t_s[0]),
        "replaced_rows": one.replaced,
        "models": {
            model: {
                quantity: {
                    f"norm_{'rad' if quantity == 'phi' else 'm'}": error.norm,
                    f"rms_{'rad' if quantity == 'phi' else 'm'}": error.rms,
                    "fit_percent": error.fit_percent,
                }
                for quantity, error in errors.items()
            }
            for model, errors in one.errors.items()
        },
        "smaller_by_percent": {
            model: {quantity: one.improvement_percent(quantity, model) for quantity in _UNITS}
            for model in one.errors
            if model != "original"
        },
    }


def _compared(
    logs: list[Path], states: list[Path] | None, truth: bool, no_pwm: bool, rig: Path
) -> list[Comparison]:
    from calib.rig import read_rig
    from calib.validating import IMPROVED, validate_log

    known, out = read_rig(rig), []
    for k, path in enumerate(logs):
        one, said = validate_log(path, known, rig, states[k] if states else None, truth, no_pwm)
        for sentence in said:
            narrate(sentence)
        out.append(one)
    if out and IMPROVED not in out[0].errors:
        narrate(f"{rig} has no section actuator or pump: the improved model has nominal parameters")
    return out


def validate(
    logs: Annotated[
        list[Path] | None, typer.Argument(metavar="[LOG...]", help="Logs to hold the models against.")
    ] = None,
    claims: Annotated[
        bool, typer.Option("--claims", help="Examine the book of claims too, as is done without LOG.")
    ] = False,
    states: Annotated[
        list[Path] | None,
        typer.Option(help="States of calib replay to use instead of the pictures, for the logs in turn."),
    ] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Take the true columns of a simulated log.")] = False,
    no_pwm: Annotated[
        bool, typer.Option("--no-pwm", help="Logs without commands are swings with the hoses off.")
    ] = False,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Hold the models against logs, and compute every claim of the source again.

    A log's commands are played to the original model of the source, to the improved one with nominal
    parameters, and to that with the sections actuator and pump, from the estimator's state at its start;
    without LOG the book of claims is examined, and --figures draws what corresponds to the source's figures
    from simulated runs. Exits 0 whatever comes of it.
    """
    from calib.files import check_folder, shown

    paths = logs or []
    if not paths and (states or truth or no_pwm):
        raise UsageError("--states, --truth and --no-pwm: need a LOG")
    if states and len(states) != len(paths):
        raise UsageError(f"--states: {len(states)} files for {len(paths)} logs, expected one for each")
    if truth and states:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    if figures is not None:
        check_folder(figures)
    compared = _compared(paths, states, truth, no_pwm, rig)
    examined: tuple[Examined, ...] = ()
    drawn: list[str] = []
    if figures is not None and compared:
        from calib.report.validate_figures import write_validate_figures

        drawn += [path.name for path in write_validate_figures(figures, compared)]
        narrate(f"figures in {shown(figures)}")
    if figures is not None and (claims or not paths):
        from calib.claims.album import ALBUM
        from calib.report.source_figures import write_source_figures

        with progress_bar("drawing") as progress:
            drawn += [path.name for path in write_source_figures(figures, ALBUM, progress)]
        narrate(f"{len(ALBUM)} simulated figures in {shown(figures)}, index.html shows them all")
    if claims or not paths:
        from calib.claims.book import examine

        with progress_bar("examining") as progress:
            examined = examine(progress=progress)
    if as_json:
        told = _whole_json(compared, examined)
        document("validate", {"validate": {**told, "figures": drawn} if drawn else told})
        return
    for one in compared:
        _tell_log(one)
    if examined:
        _tell_claims(examined)


def _whole_json(compared: list[Comparison], examined: tuple[Examined, ...]) -> dict[str, Any]:
    told: dict[str, Any] = {"logs": [_log_json(one) for one in compared]}
    if examined:
        from calib.claims.book import BOOK, by_basis, count, rows

        told["claims"] = rows(examined)
        told["outcomes"] = {outcome.value: number for outcome, number in count(examined).items()}
        told["by_basis"] = {
            basis: {outcome.value: number for outcome, number in outcomes.items()}
            for basis, outcomes in by_basis(examined).items()
        }
        told["not_examined"] = len(BOOK) - len(examined)
    return told
