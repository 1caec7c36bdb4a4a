"""`calib align`: motion logs in, time offset, mount angle, scales and biases of camera and IMU out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, say, table
from calib.core.errors import EXIT_POOR, BadInputError

if TYPE_CHECKING:
    from calib.stages.align.section import Align
    from calib.stages.align.solve import AlignLog

__all__ = ["align"]


def _cells(value: float, sigma: float | None, factor: float) -> list[str]:
    """A value and its deviation with as many digits as the latter leaves."""
    value *= factor
    if sigma is None or not sigma > 0.0:
        return [f"{value:.6g}", "-"]
    sigma *= factor
    places = max(0, 1 - math.floor(math.log10(sigma)))
    return [f"{value:.{places}f}", f"{sigma:.{places}f}"]


def _tell(section: Align) -> None:
    degree = math.degrees(1.0)
    rows = []
    for words, key, index, factor in (
        ("time offset of pictures, ms", "time_offset_s", None, 1e3),
        ("angle read at rest at phi = 0, degrees", "rest_angle_rad", None, degree),
        ("mount angle, degrees", "mount_angle_rad", None, degree),
        ("gyro scale error, %", "gyro_scale", None, 1e2),
        ("gyro bias, deg/s", "gyro_bias_radps", None, degree),
        ("accel bias x, m/s^2", "accel_bias_mps2", 0, 1.0),
        ("accel bias y, m/s^2", "accel_bias_mps2", 1, 1.0),
        ("accel scale error x, %", "accel_scale", 0, 1e2),
        ("accel scale error y, %", "accel_scale", 1, 1e2),
        ("marker offset d, mm", "marker_offset_m", None, 1e3),
        ("IMU along the head, mm", "imu_lever_m", None, 1e3),
        ("shift of the plane x, mm", "plane_shift_m", 0, 1e3),
        ("shift of the plane y, mm", "plane_shift_m", 1, 1e3),
        ("stretch of the plane, %", "plane_stretch", None, 1e2),
    ):
        value, sigma = getattr(section, key), section.sigma.get(key)
        if index is not None:
            value, sigma = value[index], sigma[index] if isinstance(sigma, list) else None
        rows.append([words, *_cells(value, sigma if isinstance(sigma, float) else None, factor)])
    for line in table(["", "value", "sigma"], rows):
        say(line)
    noise = section.accel_noise_mps2
    say(
        f"noise: tracker {section.jitter_px:.2g} px before rounding, {100.0 * section.outlier_share:.2g} % "
        f"outliers, accel {noise[0]:.2g} and {noise[1]:.2g} m/s^2, gyro {section.gyro_noise_radps:.2g} rad/s"
    )
    told = []
    for log in section.logs:
        jitter = [log.camera_jitter_s, log.imu_jitter_s]
        told.append(
            [
                log.name,
                f"{log.duration_s:.4g}",
                str(log.pictures),
                str(log.outliers),
                str(log.samples),
                " / ".join("-" if value is None else f"{1e3 * value:.2g}" for value in jitter),
                f"{math.degrees(log.turned_rad):.2g}",
                "-" if log.camera_rms_px is None else f"{log.camera_rms_px:.2g}",
            ]
        )
    head = ["log", "s", "pictures", "outliers", "IMU", "jitter, ms", "phi, deg RMS", "px RMS"]
    for line in table(head, told):
        say(line)
    say(f"verdict: {section.verdict}")
    for sentence in (*section.reasons, *section.remarks, *section.advice):
        say(f"  - {sentence}")


def align(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Logs of the rig in motion, static ones as well.")
    ],
    marker_offset: Annotated[
        str | None,
        typer.Option("--marker-offset", help="Marker beyond the head, such as 15mm, measured to 1 mm."),
    ] = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find time offset, mount angle, scales and biases between camera and IMU from logs in motion.

    A free swing shows the time offset, slow motion to large angles all the rest. Writes the section align
    of the rig's file. Exits 1 when the verdict is not ok.
    """
    from calib.core.files import check_folder, check_writable, hash_of, shown
    from calib.core.result import section_json
    from calib.core.rig import Geometry, read_rig, write_rig
    from calib.core.units import parse_length_m
    from calib.stages.align.read import align_section, read_align_log, settings_from_rig, with_drawn_marker
    from calib.stages.align.solve import align as find
    from calib.stages.align.solve import judge_align

    marker_offset_m = None if marker_offset is None else parse_length_m(marker_offset, "--marker-offset")
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    # Without a camera or a plane no log needs to be read.
    settings_from_rig(before, rig, [])
    assert before.camera is not None
    width, height = before.camera.image_size_px
    read: list[AlignLog] = []
    hashes: dict[str, str] = {}
    said: list[str] = []
    for path in logs:
        log, sentences = read_align_log(path, (width, height))
        said += sentences
        if log is None:
            continue
        name = shown(path.name)
        if name in hashes:
            name = f"{name} ({len(read) + 1})"
        read.append(replace(log, source=name))
        hashes[name] = hash_of(path)
    if not read:
        raise BadInputError(said[-1])
    for sentence in said:
        narrate(sentence)
    found = find(read, settings_from_rig(before, rig, read, marker_offset_m))
    for sentence in found.said:
        narrate(sentence)
    remarks: list[str] = []
    judgement = judge_align(found)
    if marker_offset_m is None:
        found, remarks = with_drawn_marker(found, before.geometry or Geometry())
    section = align_section(found, replace(judgement, remarks=[*judgement.remarks, *remarks]))
    write_rig(rig, before.model_copy(update={"align": section}), {"align": hashes})
    narrate(f"align written to {shown(rig)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.align.plots import plots

        write_figures(figures, plots(found, section.verdict))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        document("align", {"align": section_json(section)})
    else:
        _tell(section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)
