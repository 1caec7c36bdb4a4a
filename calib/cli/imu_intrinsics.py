"""`calib imu intrinsics`: rests of an IMU in many poses in, its bias, scale and misalignment out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, say, table
from calib.errors import EXIT_POOR, UsageError

if TYPE_CHECKING:
    from calib.rig_imu_intrinsics import ImuIntrinsics

__all__ = ["intrinsics"]


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


def _tell(section: ImuIntrinsics) -> None:
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
    from calib.files import check_folder, check_writable, shown
    from calib.imu.intrinsics import find_intrinsics
    from calib.imu.intrinsics_verdict import judge_intrinsics
    from calib.intrinsicsections import intrinsics_section
    from calib.poselogs import read_pose_files, read_pose_log
    from calib.rig import hash_of, read_rig, section_json, write_rig

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
        from calib.report.imu_intrinsics_figures import write_imu_intrinsics_figures

        write_imu_intrinsics_figures(figures, result, section.verdict)
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("imu intrinsics", {"imu_intrinsics": section_json(section)})
    else:
        _tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)
