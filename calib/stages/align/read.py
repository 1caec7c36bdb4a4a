"""Readings of logs and what is known beforehand, for an alignment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.io.logs import Log, blank_clipped
from calib.io.sensor_faults import held_places
from calib.stages.align.solve import ASIDE_M, AlignLog, Settings
from calib.stages.estimator.noise import grid_px
from calib.stages.estimator.sensors import QUANTITIES, sensor_values, view_coefficients

PRIOR = {name: (one.usual, one.unaligned) for name, one in QUANTITIES.items()}
"""Value and deviation of what is known before."""

_LEAST_SHIFT_M = 1e-5
_LEAST_BIAS_MPS2 = 0.02
_LEAST_SCALE = 5e-4
_ABOUT_G = (4.0, 25.0)
_ACCEL = ("ax_mps2", "ay_mps2")


def align_log(log: Log) -> tuple[AlignLog | None, list[str]]:
    """Pictures and IMU samples of a log, and sentences on what was passed over.

    None where the log has no picture or no gyroscope, of which a sentence says so.

    Raises `BadInputError` for time that runs backwards, and sensors that are stuck or contradict each other.
    """
    heard, log = log.passed, blank_clipped(log)
    camera = log.signals("u_px", "v_px") if len(log.sampled("u_px", "v_px")) else None
    if not len(log.sampled("gz_radps")):
        has = "has no gyroscope (gz_radps), which an alignment needs"
        return None, [f"{log.source}: {has}{log.where_else('gz_radps')}"]
    if camera is None:
        has = "has no picture of the marker (u_px, v_px), which an alignment needs"
        return None, [f"{log.source}: {has}{log.where_else('u_px', 'v_px')}"]
    imu = log.signals("gz_radps", optional=_ACCEL, partly=True)
    imu.refuse_stuck(*imu.names)
    imu.refuse_mirrored()
    readings = np.full((len(imu), 3), np.nan)
    for k, name in enumerate((*_ACCEL, "gz_radps")):
        if name in imu.names:
            readings[:, k] = imu[name]
    both = np.isfinite(readings[:, :2]).all(axis=1)
    held = held_places(log)
    remarks = [f"{log.source}: {held}; leave u_px and v_px blank where no picture is new"] if held else []
    remarks += [f"{log.source}: {one}" for one in log.passed.sentences if one not in heard.sentences]
    if not both.any():
        remarks.append(f"{log.source}: has no accelerometer; the mount angle stays unknown")
    else:
        norm = float(np.median(np.hypot(readings[both, 0], readings[both, 1])))
        if not _ABOUT_G[0] <= norm <= _ABOUT_G[1]:
            raise BadInputError(
                f"{log.source}: ax_mps2 and ay_mps2 are {norm:.4g} together, expected about 9.81 m/s^2: an "
                "IMU whose x and y axes lie in the plane"
            )
    return AlignLog(log.source, camera.stamps_s, camera.values, imu.stamps_s, readings), remarks


def _prior(rig: Rig) -> dict[str, tuple[float, float]]:
    values = dict(PRIOR)
    if (shifts := rig.shift_sigma_m) is not None:
        aside, shift = (max(sigma, _LEAST_SHIFT_M) for sigma in shifts)
        values["shift_x_m"], values["shift_y_m"] = (0.0, math.hypot(aside, ASIDE_M)), (0.0, shift)
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
    """What is known beforehand, from the rig's file, which has a camera and a plane.

    Raises `BadInputError` for a plane of another camera.
    """
    plane = rig.current_plane(path)
    assert rig.camera is not None
    assert plane is not None
    view = view_coefficients(rig.camera.optics, np.array(plane.R_CW), np.array(plane.t_CW_m), rig.middle_m)
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
        aside_sigma_m=tuple(max(sigma, _LEAST_SHIFT_M) for sigma in rig.shift_sigma_m or ()),
        turn_sigma_rad=plane.sigma.get("rotation_z_rad") or 0.0,
        **walks,
    )
