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
    say(f"{one.name}: {len(one.t_s)} poses over {one.t_s[-1] - one.t_s[0]:.4g} s from {one.how}, {hoses}")
    rows = []
    for quantity, (scale, unit) in _UNITS.items():
        for model, errors in one.errors.items():
            error = errors[quantity]
            gained = one.improvement_percent(quantity) if model == "improved" else None
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
    from calib.claims.book import BOOK, count

    rows = [
        [
            one.claim.id,
            one.claim.where,
            one.claim.kind,
            one.finding.outcome.value,
            one.finding.ours + (" (simulated)" if one.finding.simulated else ""),
        ]
        for one in examined
    ]
    for line in _left(["claim", "where", "kind", "outcome", "our figure"], rows):
        say(line)
    for one in examined:
        printed = "" if one.claim.printed == "-" else f"; printed: {one.claim.printed}"
        say(f"{one.claim.id}: {one.claim.says}{printed}")
        say(f"  {one.finding.outcome.value}: {one.finding.how}")
    found = ", ".join(f"{number} {outcome.value}" for outcome, number in count(examined).items())
    say(f"{len(examined)} of {len(BOOK)} claims: {found}")
    say(
        "plant and data claims are shown on a simulated rig whose parameters were chosen to resemble the text"
    )


def _log_json(one: Comparison) -> dict[str, Any]:
    return {
        "log": one.name,
        "pose_from": one.how,
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
        "smaller_by_percent": {quantity: one.improvement_percent(quantity) for quantity in _UNITS},
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
        narrate(f"{rig} has no section actuator or pump: only the original model is compared")
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

    A log's commands are played to the nominal model and to that of the sections actuator and pump, from
    the log's start; without LOG the book of claims is examined. Exits 0 whatever comes of it.
    """
    from calib.files import check_folder, shown

    paths = logs or []
    if not paths and (states or truth or no_pwm or figures is not None):
        raise UsageError("--states, --truth, --no-pwm and --figures: need a LOG")
    if states and len(states) != len(paths):
        raise UsageError(f"--states: {len(states)} files for {len(paths)} logs, expected one for each")
    if truth and states:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    if figures is not None:
        check_folder(figures)
    compared = _compared(paths, states, truth, no_pwm, rig)
    if figures is not None:
        from calib.report.validate_figures import write_validate_figures

        write_validate_figures(figures, compared)
        narrate(f"figures in {shown(figures)}")
    examined: tuple[Examined, ...] = ()
    if claims or not paths:
        from calib.claims.book import examine

        with progress_bar("examining") as progress:
            examined = examine(progress=progress)
    if as_json:
        document("validate", {"validate": _whole_json(compared, examined)})
        return
    for one in compared:
        _tell_log(one)
    if examined:
        _tell_claims(examined)


def _whole_json(compared: list[Comparison], examined: tuple[Examined, ...]) -> dict[str, Any]:
    told: dict[str, Any] = {"logs": [_log_json(one) for one in compared]}
    if examined:
        from calib.claims.book import BOOK, count, rows

        told["claims"] = rows(examined)
        told["outcomes"] = {outcome.value: number for outcome, number in count(examined).items()}
        told["not_examined"] = len(BOOK) - len(examined)
    return told
