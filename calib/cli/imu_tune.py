"""`calib imu tune`: logs in, gains of the angle filter out, with what they are worth beside 3/3."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from calib.cli.common import (
    AccUnitOption,
    FiguresOption,
    GyroUnitOption,
    JsonOption,
    RigOption,
    document,
    narrate,
    say,
    table,
)
from calib.errors import EXIT_POOR, BadInputError

if TYPE_CHECKING:
    from calib.rig_filter import OrientationFilter

__all__ = ["tune"]

_SAME_RATE = 0.02


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(values: list[float] | None) -> str:
    return "-" if values is None else f"{values[0]:.3f} .. {values[1]:.3f}"


def _pole(pole: list[float]) -> str:
    return f"{pole[0]:.4f}" + (f"{pole[1]:+.4f}i" if pole[1] else "")


def _tell(section: OrientationFilter) -> None:
    rows, judged = [], []
    for name, one in section.candidates.items():
        if "prior" not in name:
            rows.append(
                [
                    name,
                    f"{one.Kp_per_s:.4g}",
                    f"{one.Ki_per_s2:.4g}",
                    "  ".join(_pole(pole) for pole in one.poles),
                    _number(one.bandwidth_hz),
                    _number(one.noise_gain),
                    _number(one.bias_peak_s),
                    _number(one.settling_s),
                    _number(one.lag_s),
                ]
            )
        judged.append(
            [
                name,
                _degrees(one.rmse_deg),
                _interval(one.interval_deg),
                _interval(one.less_interval_deg) if name != "3/3" else "",
                "" if name == "3/3" or one.confidence is None else f"{one.confidence:.1%}",
                _degrees(one.whole_rmse_deg),
            ]
        )
    head = [
        "gains",
        "Kp, 1/s",
        "Ki, 1/s2",
        "poles",
        "band, Hz",
        "noise",
        "bias peak, s",
        "settles, s",
        "lag, s",
    ]
    for line in table(head, rows):
        say(line)
    say("noise: variance of the angle over that of the accelerometer's; bias peak: angle per rate's bias")
    head = ["held-out error, deg", "RMSE", "95 % interval", "less 3/3", "surely", "whole log"]
    for line in table(head, judged):
        say(line)
    say(
        f"judged over {section.judged_s:.5g} s; each half by gains of the other; densities from "
        f"{section.densities_from}"
    )
    for log in section.logs:
        by = f"judged by {log.reference}" if log.reference else "no reference"
        say(f"{log.name}: {log.duration_s:.5g} s in {log.pieces} piece(s), {log.samples} samples, {by}")
    say(
        f"recommended: {section.recommended}, Kp {section.Kp_per_s:.4g} 1/s, Ki {section.Ki_per_s2:.4g} 1/s2 "
        f"at {section.rate_hz:.5g} Hz"
    )
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks):
        say(f"  - {sentence}")


def tune(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig in motion.")],
    reference: Annotated[
        Literal["auto", "truth", "camera", "onchip", "none"],
        typer.Option(
            help="Angle to judge by: true_phi_rad, the camera's through the rig's plane, onchip_phi_rad, or "
            "none for the log's own smoothed angle. auto: truth or camera where there is one."
        ),
    ] = "auto",
    rate: Annotated[
        Literal["plane", "up"],
        typer.Option(help="Rate of the angle: -gz, or of the up vector for a sensor that is not in plane."),
    ] = "plane",
    figures: FiguresOption = None,
    acc_unit: AccUnitOption = "m/s2",
    gyro_unit: GyroUnitOption = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Tune the angle filter on logs, judge it on parts it was not tuned on, and keep 3/3 unless it wins.

    Uses the sections imu, camera and plane of the rig's file where they are, and writes its section
    orientation_filter. Exits 1 when the logs do not allow a judgement.
    """
    import numpy as np

    from calib.files import check_folder, check_writable, shown
    from calib.imu.tuning import tune as find
    from calib.rig import hash_of, identity, read_rig, section_json, write_rig
    from calib.sections import camera_from_section, current_plane
    from calib.tunelogs import Reading, TuneLog, read_tune_log, sensor_noise
    from calib.tunesections import filter_section

    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    hashes: dict[str, str] = {}
    how = Reading(acc_unit, gyro_unit, rate == "up", reference)
    if reference in ("auto", "camera"):
        plane = current_plane(before, str(rig))
        if plane is not None and before.camera is not None:
            how = replace(how, camera=camera_from_section(before.camera), A_inverse=np.array(plane.A_inverse))
    read: list[TuneLog] = []
    for path in logs:
        log = read_tune_log(path, how)
        for sentence in log.said:
            narrate(sentence)
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        # What is written to the rig's file does not depend on the folder.
        read.append(replace(log, source=name, pieces=tuple(replace(p, source=name) for p in log.pieces)))
        hashes[name] = hash_of(path)
        first = read[0].sampling.rate_hz
        if abs(log.sampling.rate_hz / first - 1.0) > _SAME_RATE:
            raise BadInputError(
                f"{shown(path)}: is sampled at {log.sampling.rate_hz:.4g} Hz, expected {first:.4g} Hz as in "
                f"{read[0].source}"
            )
    if before.imu is not None:
        hashes["imu"] = identity(before.imu)
    if before.camera is not None and before.plane is not None and any(o.reference == "camera" for o in read):
        hashes |= {"camera": identity(before.camera), "plane": identity(before.plane)}
    noise, densities_from = sensor_noise(before, read)
    pieces = [piece for log in read for piece in log.pieces]
    result = find(pieces, noise)
    section = filter_section(result, read, densities_from, rate == "up")
    write_rig(rig, before.model_copy(update={"orientation_filter": section}), {"orientation_filter": hashes})
    narrate(f"orientation_filter written to {shown(rig)}")
    if figures is not None:
        from calib.report.tune_figures import write_tune_figures

        write_tune_figures(figures, result, pieces, section)
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu tune", {"orientation_filter": section_json(section)})
    else:
        _tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)
