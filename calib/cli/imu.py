"""`calib imu`: the verbs about the IMU."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    telling,
)
from calib.core.errors import EXIT_POOR, BadInputError, UsageError

if TYPE_CHECKING:
    from calib.stages.imu.drift import LogDrift
    from calib.stages.imu.section import Imu, ImuIntrinsics, OrientationFilter
    from calib.stages.imu.tracks import DriftLog

# ----------------------------------------------------------------------
# `calib imu static`: logs of an IMU at rest in, its bias, noise and drift out.


def _cells(
    values: list[float | None], sigma: list[float | None] | None, below: list[float | None] | None
) -> list[str]:
    cells = []
    for k, value in enumerate(values):
        limit = None if below is None else below[k]
        deviation = None if sigma is None else sigma[k]
        if value is None:
            cells.append("-" if limit is None else f"< {limit:.2g}")
        else:
            cells.append(f"{value:.4g}" + ("" if deviation is None else f" +- {deviation:.1g}"))
    return cells


def _tell(section: Imu) -> None:
    rows = []
    for name, key in (
        ("gyro bias, rad/s", "gyro_bias_radps"),
        ("gyro noise N, rad/s/sqrt(Hz)", "gyro_noise_radps_per_sqrt_Hz"),
        ("gyro instability B, rad/s", "gyro_instability_radps"),
        ("gyro random walk K, rad/s^2/sqrt(Hz)", "gyro_walk_radps2_per_sqrt_Hz"),
        ("accel mean, m/s^2", "accel_mean_mps2"),
        ("accel noise N, m/s^2/sqrt(Hz)", "accel_noise_mps2_per_sqrt_Hz"),
        ("accel instability B, m/s^2", "accel_instability_mps2"),
        ("accel random walk K, m/s^3/sqrt(Hz)", "accel_walk_mps3_per_sqrt_Hz"),
    ):
        rows.append([name, *_cells(getattr(section, key), section.sigma.get(key), section.below.get(key))])
    for line in table([f"{section.rate_hz:.5g} Hz", "x", "y", "z"], rows):
        say(line)
    say("+- is one standard deviation; < is a 95 % bound where the logs are too short for an estimate")
    say("accel mean holds gravity: one pose does not tell it from a bias")
    sampled, drifts = [], []
    for log in section.logs:
        sampled.append(
            [
                log.name,
                f"{log.rest_s:.5g} of {log.duration_s:.5g}",
                f"{log.rate_hz:.5g}",
                f"{1e3 * log.jitter_s:.3g}",
                str(log.missing),
                str(log.splits),
                f"{log.repeated_rows} / {log.repeated_stamps}",
            ]
        )
        pairs = ((log.gyro_degps, log.gyro_sigma_degps), (log.onchip_degps, log.onchip_sigma_degps))
        drifts.append([log.name, *(_cells([value], [deviation], None)[0] for value, deviation in pairs)])
    head = ["log", "at rest, s", "rate, Hz", "jitter, ms", "missing", "split", "repeated rows / stamps"]
    for line in table(head, sampled):
        say(line)
    found = [section.drift.get(name) for name in ("gyro", "onchip")]
    drifts.append(["mean", *("-" if one is None else f"{one.mean_degps:.4g}" for one in found)])
    drifts.append(
        [
            "spread from log to log",
            *("-" if one is None or one.spread_degps is None else f"{one.spread_degps:.2g}" for one in found),
        ]
    )
    for line in table(["drift of the angle, deg/s", "gyroscope, -gz", "on the chip"], drifts):
        say(line)
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks, *section.advice):
        say(f"  - {sentence}")


def static(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig at rest.")],
    figures: FiguresOption = None,
    imu_yaml: Annotated[
        Path | None, typer.Option("--imu-yaml", help="Kalibr's imu.yaml to write as well.")
    ] = None,
    acc_unit: AccUnitOption = "m/s2",
    gyro_unit: GyroUnitOption = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find bias, noise densities and drift of an IMU from logs at rest, and whether they were at rest.

    Writes the section imu of the rig's file. Exits 1 when the verdict is not ok.
    """
    from calib.core.files import check_folder, check_writable, hash_of, shown, write_atomically
    from calib.core.result import section_json
    from calib.core.rig import read_rig, write_rig
    from calib.stages.imu.read import read_rest_log
    from calib.stages.imu.results import imu_section, kalibr_imu
    from calib.stages.imu.static import RestLog, analyse_static, judge

    for path in (rig, imu_yaml):
        if path is not None:
            check_writable(path)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    read: list[RestLog] = []
    hashes: dict[str, str] = {}
    for path in logs:
        log, said = read_rest_log(path, acc_unit, gyro_unit)
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        # What is written to the rig's file does not depend on the folder.
        read.append(replace(log, source=name))
        hashes[name] = hash_of(path)
        for sentence in said:
            narrate(sentence)
    result = analyse_static(read)
    section = imu_section(result, judge(result))
    write_rig(rig, before.model_copy(update={"imu": section}), {"imu": hashes})
    narrate(f"imu written to {shown(rig)}")
    if imu_yaml is not None:
        write_atomically(imu_yaml, kalibr_imu(section))
        narrate(f"Kalibr's imu.yaml written to {shown(imu_yaml)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.imu.plots import static_plots

        write_figures(figures, static_plots(result, section.verdict))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu static", {"imu": section_json(section)})
    else:
        _tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


# ----------------------------------------------------------------------
# `calib imu intrinsics`: rests of an IMU in many poses in, its bias, scale and misalignment out.


def _cell(value: float | None, sigma: float | None, factor: float = 1.0) -> str:
    """A value with as many digits as its deviation leaves it."""
    if value is None:
        return "-"
    value *= factor
    if sigma is None or not sigma > 0.0:
        return f"{value:.6g}"
    sigma *= factor
    places = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{places}f} +- {sigma:.{places}f}"


def _intrinsics_tell(section: ImuIntrinsics) -> None:
    rows = []
    for name, part, inverse in (("accel", section.accel, "m/s^2"), ("gyro", section.gyro, "rad/s")):
        if part is None:
            continue
        unit = part.unit.replace("m/s2", "m/s^2")
        scale = f"{unit} per {inverse}" if unit != inverse else "ratio"
        for words, values, sigma in (
            (f"{name} bias, {unit}", part.bias, part.sigma.bias),
            (f"{name} scale, {scale}", part.scale, part.sigma.scale),
        ):
            rows.append([words, *(_cell(v, s) for v, s in zip(values, sigma, strict=True))])
    for line in table(["", "x", "y", "z"], rows):
        say(line)
    rows = []
    for name, part in (("accel", section.accel), ("gyro", section.gyro)):
        for key, value in (part.misalignment_rad if part is not None else {}).items():
            assert part is not None
            rows.append([f"{name} {key}", _cell(value, part.sigma.misalignment_rad.get(key), 1e3)])
    if rows:
        for line in table(["misalignment", "mrad"], rows):
            say(line)
    say("+- is one standard deviation")
    span = (
        f"{section.rests} rests, {section.rest_s:.4g} s, in {section.poses} poses more than 5 degrees apart"
    )
    say(f"{span}; threshold {section.threshold:g} times the spread at rest")
    if section.accel.rms_mps2 is not None:
        say(f"rests differ from {section.gravity_mps2:g} m/s^2 by {section.accel.rms_mps2:.3g} (RMS)")
        if section.accel.disagreement_mps2:
            say(f"beyond their noise they disagree by {section.accel.disagreement_mps2:.2g} m/s^2 (in sigma)")
    if section.gyro is not None:
        missed = math.degrees(section.gyro.rms_rad)
        say(f"{section.gyro.turns} turns miss the direction of gravity by {missed:.2g} degrees (RMS)")
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks, *section.advice):
        say(f"  - {sentence}")


def intrinsics(
    log: Annotated[
        Path | None, typer.Argument(metavar="LOG", help="Log of rests in many poses, turns between.")
    ] = None,
    accel: Annotated[
        Path | None, typer.Option("--accel", help="Instead of LOG: lines of t x y z, may be gzipped.")
    ] = None,
    gyro: Annotated[Path | None, typer.Option("--gyro", help="The gyroscope's file beside --accel.")] = None,
    gravity: Annotated[
        float, typer.Option("--gravity", help="Gravity where the log was taken, m/s^2.")
    ] = 9.80665,
    planar: Annotated[
        bool, typer.Option("--planar", help="Calibrate ax, ay and gz alone, from tilts about z.")
    ] = False,
    figures: FiguresOption = None,
    acc_unit: Annotated[
        Literal["m/s2", "g", "counts"], typer.Option("--acc-unit", help="Unit of ax, ay, az in the input.")
    ] = "m/s2",
    gyro_unit: Annotated[
        Literal["rad/s", "deg/s", "counts"],
        typer.Option("--gyro-unit", help="Unit of gx, gy, gz in the input."),
    ] = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find bias, scale and misalignment of an IMU from rests in many poses.

    Let it lie for 30 s, then put it down in 24 poses or more: each axis up and down, and between axes; each
    held still for 3 s. On a rig that moves in a plane: upright, 10 s at rest, then tilts about z by 45
    degrees at a time through the circle. Writes the section imu_intrinsics of the rig's file. Exits 1
    when the verdict is not ok.
    """
    from calib.core.files import check_folder, check_writable, hash_of, shown
    from calib.core.result import section_json
    from calib.core.rig import read_rig, write_rig
    from calib.stages.imu.intrinsics import find_intrinsics, judge_intrinsics
    from calib.stages.imu.read import read_pose_files, read_pose_log
    from calib.stages.imu.results import intrinsics_section

    if not 1.0 <= gravity <= 30.0:
        raise UsageError(f"--gravity is {gravity:g}, expected about 9.81 m/s^2")
    if (log is None) == (accel is None) or (gyro is not None and accel is None):
        raise UsageError("give a LOG, or --accel FILE with --gyro FILE beside it")
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    if accel is not None:
        read, said = read_pose_files(accel, gyro, acc_unit, gyro_unit, planar)
    else:
        assert log is not None
        read, said = read_pose_log(log, acc_unit, gyro_unit, planar)
    for sentence in said:
        narrate(sentence)
    result = find_intrinsics(read, gravity, planar)
    section = intrinsics_section(result, judge_intrinsics(result))
    hashes = {shown(path.name): hash_of(path) for path in (log, accel, gyro) if path is not None}
    write_rig(rig, before.model_copy(update={"imu_intrinsics": section}), {"imu_intrinsics": hashes})
    narrate(f"imu_intrinsics written to {shown(rig)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.imu.plots import intrinsics_plots

        write_figures(figures, intrinsics_plots(result, section.verdict))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu intrinsics", {"imu_intrinsics": section_json(section)})
    else:
        _intrinsics_tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


# ----------------------------------------------------------------------
# `calib imu tune`: logs in, gains of the angle filter out, with what they are worth beside 3/3.

_SAME_RATE = 0.02


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(values: list[float] | None) -> str:
    return "-" if values is None else f"{values[0]:.3f} .. {values[1]:.3f}"


def _pole(pole: list[float]) -> str:
    return f"{pole[0]:.4f}" + (f"{pole[1]:+.4f}i" if pole[1] else "")


def _tune_tell(section: OrientationFilter) -> None:
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

    from calib.core.files import check_folder, check_writable, hash_of, shown
    from calib.core.result import identity, section_json
    from calib.core.rig import read_rig, write_rig
    from calib.stages.imu.read import Reading, TuneLog, read_tune_log, sensor_noise
    from calib.stages.imu.results import filter_section
    from calib.stages.imu.tuning import tune as find

    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    hashes: dict[str, str] = {}
    how = Reading(acc_unit, gyro_unit, rate == "up", reference)
    if reference in ("auto", "camera"):
        plane = before.current_plane(str(rig))
        if plane is not None and before.camera is not None:
            how = replace(how, camera=before.camera.optics, A_inverse=np.array(plane.A_inverse))
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
        from calib.show.draw import write_figures
        from calib.stages.imu.plots import tune_plots

        write_figures(figures, tune_plots(result, pieces, section))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu tune", {"orientation_filter": section_json(section)})
    else:
        _tune_tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


# ----------------------------------------------------------------------
# `calib imu drift`: the same logs through every way of getting the angle, and how each drifts.


def _drift_cell(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else "-"


def _drift_tell(section: dict[str, Any]) -> None:
    head = ["offset, deg", "slope, deg/s", "+- 95 %", "Allan 1 s", "100 s, deg", "RMSE, deg", "lag, ms"]
    for log in section["logs"]:
        say(
            f"{log['name']}: {log['duration_s']:.5g} s at {log['rate_hz']:.5g} Hz, {log['judged_s']:.5g} s "
            f"judged, {log['moving_s']:.5g} s in motion; {log['about']}"
        )
        rows = []
        for name, m in log["methods"].items():
            low, high = m["interval_degps"]
            rows.append(
                [
                    name,
                    _drift_cell(m["offset_deg"]),
                    _drift_cell(m["slope_degps"]),
                    _drift_cell(0.5 * (high - low), 2),
                    _drift_cell(m["allan_1s_deg"]),
                    _drift_cell(m["allan_100s_deg"]),
                    _drift_cell(m["rmse_deg"]),
                    _drift_cell(m["lag_ms"])
                    if abs(m["lag_ms"]) >= 0.05 or math.isnan(m["lag_ms"])
                    else "0.0",
                ]
            )
        for line in table(["", *head], rows):
            say(line)
        for sentence in (*log["skipped"], *log["remarks"]):
            say(f"  - {sentence}")
    if len(section["logs"]) > 1:
        rows = [
            [name, _drift_cell(one["mean_degps"], 4), _drift_cell(one["spread_degps"]), str(one["logs"])]
            for name, one in section["methods"].items()
        ]
        for line in table(["slope over the logs, deg/s", "mean", "spread", "logs"], rows):
            say(line)
    for sentence in section["remarks"]:
        say(f"  - {sentence}")
    say(
        "intervals allow for errors that hang together in time (white noise on a process of order one or a "
        "random walk, by restricted likelihood); RMSE is in motion, without the constant mount offset; a "
        "positive lag is late"
    )
    say(f"note: {section['note']}")


def drift(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig, at rest or in motion.")
    ],
    figures: FiguresOption = None,
    peers: Annotated[
        bool, typer.Option("--peers/--no-peers", help="Run the filters of the extra peers as well.")
    ] = True,
    acc_unit: AccUnitOption = "m/s2",
    gyro_unit: GyroUnitOption = "rad/s",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Compare how the angle drifts by the chip, the sensors alone, the MM filter and filters of others.

    Tuned gains are read from the rig's file, to which nothing is written.
    """
    from calib.core.files import check_folder, hash_of, shown
    from calib.core.rig import read_rig
    from calib.stages.imu.drift import analyse_drift
    from calib.stages.imu.read import read_drift_log
    from calib.stages.imu.results import drift_document, tuned_filter

    if figures is not None:
        check_folder(figures)
    tuned = tuned_filter(read_rig(rig))
    hashes: dict[str, str] = {}
    remarks: list[str] = []
    read: list[DriftLog] = []
    for path in logs:
        log, said = read_drift_log(path, acc_unit, gyro_unit)
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        read.append(replace(log, source=name))
        hashes[name] = hash_of(path)
        remarks += said
    results: list[LogDrift] = [analyse_drift(log, tuned, peers, narrate) for log in read]
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.imu.plots import drift_plots

        write_figures(figures, drift_plots(results))
        narrate(f"figures in {shown(figures)}")
    section = drift_document(results, hashes, tuned, remarks)
    if as_json:
        document("imu drift", {"drift": section})
    else:
        _drift_tell(section)


# ----------------------------------------------------------------------
# `calib imu`: the verbs that are about the IMU.

imu = typer.Typer(
    help="Understand an IMU: its bias, its noise, its drift.", no_args_is_help=True, rich_markup_mode=None
)


@imu.callback()
def _imu() -> None:
    # With a callback the name of the verb stays even while there is one alone.
    pass


imu.command("static")(static)
imu.command("intrinsics")(intrinsics)
imu.command("drift")(drift)
imu.command("tune")(telling(tune))
