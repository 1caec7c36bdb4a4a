"""`calib validate`: the models against logs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import (
    AccUnitOption,
    ColumnsOption,
    FiguresOption,
    GyroUnitOption,
    JsonOption,
    RigOption,
    document,
    narrate,
    say,
    table,
)
from calib.core.errors import UsageError
from calib.core.stage import LogOptions

if TYPE_CHECKING:
    from calib.stages.actuator.validate import Comparison

_UNITS = {"q1": (1e3, "mm"), "q2": (1e3, "mm"), "phi": (1.0, "rad")}


def _cell(value: float | None, form: str = ".3g") -> str:
    return "-" if value is None or value != value else f"{value:{form}}"


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
    logs: list[Path], states: list[Path] | None, truth: bool, no_pwm: bool, rig: Path, options: LogOptions
) -> list[Comparison]:
    from calib.core.rig import Rig
    from calib.stages.actuator.validate import IMPROVED, validate_log

    known, out = Rig.load(rig, missing_ok=True), []
    for k, path in enumerate(logs):
        one, said = validate_log(path, known, rig, states[k] if states else None, truth, no_pwm, options)
        for sentence in said:
            narrate(sentence)
        out.append(one)
    if IMPROVED not in out[0].errors:
        narrate(f"{rig} has no section known, actuator or pump: the improved model has nominal parameters")
    return out


def _validate_arm(logs: list[Path], rig: Path, options: Any, as_json: bool) -> None:
    """Free-run errors of the section arm on logs of pressures and poses."""
    from calib.core.errors import BadInputError
    from calib.core.files import shown
    from calib.core.rig import Rig
    from calib.stages.arm.stage import validate as held

    known = Rig.load(rig)
    if known.arm is None:
        raise BadInputError(f"{shown(rig)}: has no arm yet; run calib identify arm first")
    errors, said = held(logs, known, options)
    for sentence in said:
        narrate(sentence)
    told = {
        name: {
            "angle_rad": one.angle_rad,
            "chord_m": one.chord_m,
            "angle_by_pressure_rad": one.by_pressure_rad,
            "pressure_kpa": one.pressure_kpa,
        }
        for name, one in errors.items()
    }
    if as_json:
        finite = {n: {k: x if math.isfinite(x) else None for k, x in one.items()} for n, one in told.items()}
        document("validate", {"validate": {"arm": finite}})
        return
    scales = (math.degrees(1.0), 1e3, math.degrees(1.0), 1.0)
    rows = [
        [name, *(_cell(x * k, ".2f") for x, k in zip(one.values(), scales, strict=True))]
        for name, one in told.items()
    ]
    head = ["free run, RMS", "angle, deg", "chord, mm", "angle by pressure, deg", "pressure, kPa"]
    for line in table(head, rows):
        say(line)


def validate(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs to hold the models against.")],
    states: Annotated[
        list[Path] | None,
        typer.Option(help="States of calib replay to use instead of the pictures, for the logs in turn."),
    ] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Take the true columns of a simulated log.")] = False,
    no_pwm: Annotated[
        bool, typer.Option("--no-pwm", help="Logs without commands are swings with the hoses off.")
    ] = False,
    acc_unit: AccUnitOption = None,
    gyro_unit: GyroUnitOption = None,
    columns: ColumnsOption = None,
    load: Annotated[
        list[str] | None,
        typer.Option(help="Mass at the tip of an arm's logs, NAME=MASS.", metavar="NAME=MASS"),
    ] = None,
    day: Annotated[
        list[str] | None, typer.Option(help="Day of an arm's logs, NAME=DAY.", metavar="NAME=DAY")
    ] = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Hold the models against logs.

    A log's commands are played to the original model of the source, to the improved one with nominal
    parameters, and to that with the sections actuator and pump, from the estimator's state at its start.
    Logs of pressures are played to the section arm, from the first readings alone.
    Exits 0 whatever comes of it.
    """
    from calib.core.files import shown
    from calib.core.writing import check_figures
    from calib.io.columns import is_arm_log
    from calib.io.logs import columns_of

    if states and len(states) != len(logs):
        raise UsageError(f"--states: {len(states)} files for {len(logs)} logs, expected one for each")
    if truth and states:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    if figures is not None:
        check_figures(figures)
    options = LogOptions(acc_unit, gyro_unit, columns)
    if all(is_arm_log(columns_of(path, options) or ()) for path in logs):
        from calib.stages.arm.stage import Options

        _validate_arm(
            logs, rig, Options(columns=columns, load=tuple(load or ()), day=tuple(day or ())), as_json
        )
        return
    compared = _compared(logs, states, truth, no_pwm, rig, options)
    result: dict[str, Any] = {"logs": [_log_json(one) for one in compared]}
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.actuator.plots import validate_plots

        result["figures"] = [path.name for path in write_figures(figures, validate_plots(compared))]
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("validate", {"validate": result})
        return
    for one in compared:
        _tell_log(one)
