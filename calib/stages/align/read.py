"""From logs and a rig.yaml to an alignment, and to the section `align`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.result import finite_or_none
from calib.core.rig import Geometry, Rig
from calib.io.logs import Log, check_time, read_log
from calib.stages.align.section import Align, AlignCovariance, AlignLogCheck
from calib.stages.align.solve import AlignJudgement, AlignLog, Alignment, LogCheck, Settings, rest_angle
from calib.stages.estimator.noise import grid_px
from calib.stages.estimator.sensors import SENSOR, sensor_values, view_coefficients

PRIOR: dict[str, tuple[float, float]] = {
    "gyro_bias_radps": (0.0, 0.1),
    "accel_bias_x_mps2": (0.0, 0.3),
    "accel_bias_y_mps2": (0.0, 0.3),
    "mount_angle_rad": (0.0, 0.5),
    "gyro_scale": (0.0, 0.02),
    "imu_lever_m": (0.006, 0.02),
    "marker_offset_m": (0.015, 0.003),
    "time_offset_s": (0.025, 0.05),
    "shift_x_m": (0.0, 2e-4),
    "shift_y_m": (0.0, 2e-4),
    "stretch": (0.0, 1e-3),
    "accel_scale_x": (0.0, 0.01),
    "accel_scale_y": (0.0, 0.01),
}
"""Value and deviation of what is known before: data sheets, a ruler, and a printed board's scale."""

_LEAST_SHIFT_M = 1e-5
_LEAST_BIAS_MPS2 = 0.02
_LEAST_SCALE = 5e-4
_FASTEST_RADPS = 45.0
_ABOUT_G = (4.0, 25.0)
_IN_G = (0.85, 1.15)
_DOUBT = {True: 0.02, False: 0.1}
"""Probability that the marker is not where its drawing says: with one written down, and without."""
_ELSEWHERE_M = 3e-3
_MARKER = SENSOR.index("marker_offset_m")


def _column(log: Log, name: str) -> FloatArray:
    return log.columns[name] if name in log.columns else np.full(len(log), np.nan)


def _check_imu(source: str, readings: FloatArray) -> None:
    gz = readings[np.isfinite(readings[:, 2]), 2]
    if len(gz) and not np.ptp(gz) > 0.0:
        raise BadInputError(f"{source}: gz_radps is always {gz[0]:g}, expected the noise of a sensor")
    if len(gz) and float(np.abs(gz).max()) > _FASTEST_RADPS:
        raise BadInputError(
            f"{source}: gz_radps reaches {float(np.abs(gz).max()):.4g}, so it is in deg/s, expected rad/s"
        )
    both = np.isfinite(readings[:, :2]).all(axis=1)
    if not both.any():
        return
    norm = float(np.median(np.hypot(readings[both, 0], readings[both, 1])))
    if _IN_G[0] <= norm <= _IN_G[1]:
        raise BadInputError(
            f"{source}: ax_mps2 and ay_mps2 are {norm:.3g} together, so they are in g, expected m/s^2"
        )
    if not _ABOUT_G[0] <= norm <= _ABOUT_G[1]:
        raise BadInputError(
            f"{source}: ax_mps2 and ay_mps2 are {norm:.4g} together, expected about 9.81 m/s^2: an IMU whose "
            "x and y axes lie in the plane"
        )


def read_align_log(path: Path, image_size_px: tuple[int, int]) -> tuple[AlignLog | None, list[str]]:
    """Pictures and IMU samples of a file, and sentences on what was passed over.

    None where the log has no picture or no IMU sample, of which a sentence says so.

    Raises `BadInputError` for a file that is no log, time that runs backwards, and other units.
    """
    log = read_log(path)
    check_time(log)
    said = log.passed_over()
    pixels = np.stack([_column(log, "u_px"), _column(log, "v_px")], axis=1)
    seen = np.isfinite(pixels).all(axis=1)
    width, height = image_size_px
    inside = seen & (pixels >= -0.5).all(axis=1) & (pixels <= np.array([width, height]) - 0.5).all(axis=1)
    if (seen & ~inside).any():
        count = int((seen & ~inside).sum())
        said.append(f"{log.source}: {count} pictures put the marker outside the image; they count as blank")
    names = ("ax_mps2", "ay_mps2", "gz_radps")
    readings = np.stack([_column(log, name) for name in names], axis=1)
    readings = np.where(np.isfinite(readings), readings, np.nan)
    felt = np.isfinite(readings).any(axis=1)
    if not np.isfinite(readings[:, 2]).any():
        said.append(f"{log.source}: has no gyroscope (gz_radps), which an alignment needs")
        return None, said
    if not inside.any():
        said.append(f"{log.source}: has no picture of the marker (u_px, v_px), which an alignment needs")
        return None, said
    _check_imu(log.source, readings)
    if not np.isfinite(readings[:, :2]).any():
        said.append(f"{log.source}: has no accelerometer; the mount angle stays unknown")
    return AlignLog(log.source, log.t_s[inside], pixels[inside], log.t_s[felt], readings[felt]), said


def _prior(rig: Rig) -> dict[str, tuple[float, float]]:
    values = dict(PRIOR)
    largest = rig.plane.sigma_marker_mm.get("calibration_max") if rig.plane is not None else None
    if largest is not None:
        shift = max(1e-3 * largest / math.sqrt(2.0), _LEAST_SHIFT_M)
        values["shift_x_m"] = values["shift_y_m"] = (0.0, shift)
    known = rig.imu_intrinsics
    if known is None:
        return values
    if known.accel.unit == "m/s2":
        for k, axis in enumerate("xy"):
            bias, scale = known.accel.bias[k], known.accel.scale[k]
            if bias is not None:
                sigma = max(known.accel.sigma.bias[k] or 0.0, _LEAST_BIAS_MPS2)
                values[f"accel_bias_{axis}_mps2"] = (bias, sigma)
            if scale is not None:
                sigma = max(known.accel.sigma.scale[k] or 0.0, _LEAST_SCALE)
                values[f"accel_scale_{axis}"] = (scale - 1.0, sigma)
    gyro = known.gyro
    if gyro is not None and gyro.unit == "rad/s" and gyro.scale[2] is not None:
        values["gyro_scale"] = (gyro.scale[2] - 1.0, max(gyro.sigma.scale[2] or 0.0, _LEAST_SCALE))
    return values


def settings_from_rig(
    rig: Rig, path: Path, logs: Sequence[AlignLog], marker_offset_m: float | None = None
) -> Settings:
    """What is known beforehand, from the rig's file.

    Raises `BadInputError` without a camera or a plane.
    """
    source = shown(path)
    if rig.camera is None:
        raise BadInputError(f"{source}: has no camera, which an alignment needs; run calib intrinsics first")
    plane = rig.current_plane(str(path))
    if plane is None:
        raise BadInputError(f"{source}: has no plane, which an alignment needs; run calib extrinsics first")
    x0, y0, x1, y1 = (rig.geometry or Geometry()).workspace_m
    view = view_coefficients(
        rig.camera.optics,
        np.array(plane.R_CW),
        np.array(plane.t_CW_m),
        (0.5 * (x0 + x1), 0.5 * (y0 + y1)),
    )
    values = _prior(rig)
    if marker_offset_m is not None:
        values["marker_offset_m"] = (marker_offset_m, 1e-3)
    walks = {}
    if rig.imu is not None:
        gyro, accel = rig.imu.gyro_walk_radps2_per_sqrt_Hz[2], rig.imu.accel_walk_mps3_per_sqrt_Hz[:2]
        if gyro is not None:
            walks["gyro_walk"] = gyro
        if any(accel):
            walks["accel_walk"] = max(value or 0.0 for value in accel)
    pixels = np.concatenate([log.pixels for log in logs]) if logs else np.zeros((0, 2))
    return Settings(
        view,
        sensor_values({name: value for name, (value, _) in values.items()}),
        sensor_values({name: sigma for name, (_, sigma) in values.items()}),
        grid_px(pixels),
        **walks,
    )


def with_drawn_marker(found: Alignment, geometry: Geometry) -> tuple[Alignment, list[str]]:
    """An alignment with what the rig's drawing says of the marker's offset d, and a sentence on that.

    Along the straight actuator d and the length are one number. Logs part them only by the angle between
    chord and tangent, to some tenths of a millimetre, since the scales of gyroscope and accelerometer take
    the same share of it. So the drawing counts as one more reading of d, of two kinds: right to its
    deviation, or, with the probability `_DOUBT`, off by about `_ELSEWHERE_M`. Each kind is weighed by how
    well the logs bear it, and mean and covariance are those of the mixture: the further apart drawing and
    logs are, the larger is sigma, until the logs alone are left.
    """
    written = "marker_offset_m" in geometry.model_fields_set
    drawn, sigma = geometry.marker_offset_m, geometry.marker_offset_sigma_m
    value, by = float(found.sensor[_MARKER]), found.covariance[_MARKER]
    doubt, away = _DOUBT[written], drawn - value
    sums = by[_MARKER] + np.array([sigma, math.hypot(sigma, _ELSEWHERE_M)]) ** 2
    likely = np.array([1.0 - doubt, doubt]) * np.exp(-0.5 * away * away / sums) / np.sqrt(sums)
    weight = likely / likely.sum()
    # Both kinds move all quantities along their covariance with d, by these amounts of d per variance.
    pulls = away / sums
    pull = float(weight @ pulls)
    spread = float(weight @ (1.0 / sums) - weight @ (pulls - pull) ** 2)
    sensor = found.sensor + by * pull
    covariance = found.covariance - spread * np.outer(by, by)
    angle, gradient = rest_angle(sensor)
    mixed = replace(
        found,
        sensor=sensor,
        covariance=covariance,
        rest_angle_rad=angle,
        rest_angle_sigma=math.sqrt(float(gradient @ covariance @ gradient)),
    )
    both = (
        f"the marker's offset d: {_mm(drawn, sigma)} as drawn (geometry.marker_offset_m), "
        f"{_mm(value, math.sqrt(float(by[_MARKER])))} by the logs alone, "
        f"{_mm(float(sensor[_MARKER]), math.sqrt(float(covariance[_MARKER, _MARKER])))} together"
    )
    if weight[0] < 0.5:
        return mixed, [f"{both}; drawing and logs contradict each other, and the logs are believed"]
    if not written:
        both += "; lengths err as much as it does, so measure it and write it down: nobody has for this rig"
    return mixed, [both]


def _mm(value_m: float, sigma_m: float) -> str:
    return f"{1e3 * value_m:.2f} +- {1e3 * sigma_m:.2f} mm"


def _log_check(log: LogCheck) -> AlignLogCheck:
    return AlignLogCheck(
        name=log.source,
        duration_s=log.duration_s,
        stretches=log.stretches,
        pictures=log.pictures,
        outliers=log.outliers,
        samples=log.samples,
        camera_rate_hz=finite_or_none(log.camera_rate_hz),
        imu_rate_hz=finite_or_none(log.imu_rate_hz),
        camera_jitter_s=finite_or_none(log.camera_jitter_s),
        imu_jitter_s=finite_or_none(log.imu_jitter_s),
        repeated_stamps=log.repeated,
        missing=log.missing,
        turned_rad=log.turned_rad,
        camera_rms_px=finite_or_none(log.camera_rms_px),
        gyro_rms_radps=finite_or_none(log.gyro_rms_radps),
        accel_rms_mps2=finite_or_none(log.accel_rms_mps2),
    )


def align_section(found: Alignment, judgement: AlignJudgement) -> Align:
    """The `align` section of an alignment."""
    value = dict(zip(SENSOR, found.sensor.tolist(), strict=True))
    sigma = dict(zip(SENSOR, found.sigma.tolist(), strict=True))
    single = (
        "time_offset_s", "mount_angle_rad", "gyro_scale", "gyro_bias_radps", "imu_lever_m", "marker_offset_m",
    )  # fmt: skip
    pairs = {
        "accel_bias_mps2": ("accel_bias_x_mps2", "accel_bias_y_mps2"),
        "accel_scale": ("accel_scale_x", "accel_scale_y"),
        "plane_shift_m": ("shift_x_m", "shift_y_m"),
    }
    values: dict[str, Any] = {name: value[name] for name in single}
    values |= {key: [value[name] for name in names] for key, names in pairs.items()}
    sigmas: dict[str, float | list[float] | None] = {name: sigma[name] for name in single}
    sigmas |= {key: [sigma[name] for name in names] for key, names in pairs.items()}
    sigmas |= {"rest_angle_rad": found.rest_angle_sigma, "plane_stretch": sigma["stretch"]}
    noise = found.noise
    return Align(
        **values,
        rest_angle_rad=found.rest_angle_rad,
        plane_stretch=value["stretch"],
        sigma=sigmas,
        prior_sigma=dict(zip(SENSOR, found.prior.tolist(), strict=True)),
        covariance=AlignCovariance(order=list(SENSOR), values=found.covariance.tolist()),
        jitter_px=noise.jitter_px,
        outlier_share=noise.share,
        accel_noise_mps2=noise.imu[:2].tolist(),
        gyro_noise_radps=float(noise.imu[2]),
        logs=[_log_check(log) for log in found.logs],
        verdict=judgement.verdict,
        reasons=judgement.reasons,
        remarks=judgement.remarks,
        advice=judgement.advice,
    )
