"""Readings of an IMU at rest from logs, in SI, with what is wrong about them said in a sentence.

A sensor at rest feels g, so that specific forces in g or in raw counts give themselves away, and no
sensor turns faster or is louder at rest than the limits below, so that deg/s do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.rest import MOST_GYRO_RADPS, quiet_spread
from calib.imu.sampling import Part
from calib.imu.static import AXES, RestLog, is_gyro
from calib.logs import ROWS_MISSING, Log, check_time, read_log

__all__ = ["ACCEL_UNITS", "GYRO_UNITS", "read_rest_log", "rest_log"]

ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665}
GYRO_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180.0}

_COLUMN = {axis: f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES}
_FASTEST_RADPS = 45.0
_LARGEST_BIAS_RADPS = 0.35
_ABOUT_G = (8.3, 11.3)


def _axes(log: Log) -> tuple[str, ...]:
    named = [axis for axis in AXES if _COLUMN[axis] in log.columns]
    if not named:
        raise BadInputError(
            f"{log.source}: has no IMU, expected columns as gz_radps, ax_mps2 and ay_mps2 beside t_s"
        )
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_COLUMN[axis]]).any()))
    if not axes:
        raise BadInputError(
            f"{log.source}: the IMU's columns {', '.join(_COLUMN[a] for a in named)} hold no number"
        )
    return axes


def _check_changes(log: Log, axes: tuple[str, ...], values: FloatArray) -> None:
    if len(values) < 2:
        raise BadInputError(f"{log.source}: has {len(values)} IMU sample, expected a log of minutes at rest")
    if not values.any():
        raise BadInputError(f"{log.source}: all IMU readings are zero, expected noise and gravity")
    if not np.ptp(values, axis=0).any():
        raise BadInputError(
            f"{log.source}: no IMU reading ever changes ({', '.join(axes)}), expected noise of a sensor"
        )


def _check_units(log: Log, axes: tuple[str, ...], values: FloatArray, t_s: FloatArray) -> None:
    gyro = is_gyro(axes)
    middle = np.median(values, axis=0)
    if int((~gyro).sum()) == 3:
        norm = float(np.median(np.linalg.norm(values[:, ~gyro], axis=1)))
        if 0.85 <= norm <= 1.15:
            raise BadInputError(
                f"{log.source}: the specific force at rest is {norm:.4g}, so it is in g, expected m/s^2; "
                "give --acc-unit g"
            )
        if not _ABOUT_G[0] <= norm <= _ABOUT_G[1]:
            kind = "raw counts" if norm > 150.0 else "no unit that is known here"
            raise BadInputError(
                f"{log.source}: the specific force at rest is {norm:.4g} ({kind}), expected about 9.81 m/s^2"
            )
    if not gyro.any():
        return
    rates = values[:, gyro]
    period = max(float(np.median(np.diff(t_s))), 1e-6)
    places = np.arange(len(rates))
    quiet = float(quiet_spread((Part(0.0, rates, places, places),), period).max())
    largest, bias = float(np.abs(rates).max()), float(np.abs(middle[gyro]).max())
    why = ""
    if largest > _FASTEST_RADPS:
        why = f"reaches {largest:.4g}"
    elif bias > _LARGEST_BIAS_RADPS:
        why = f"has a bias of {bias:.3g}"
    elif quiet > MOST_GYRO_RADPS:
        why = f"is never quieter than {quiet:.3g}"
    if why:
        raise BadInputError(
            f"{log.source}: the gyroscope {why}, which no gyroscope at rest does in rad/s; if it is in "
            "deg/s, give --gyro-unit deg/s"
        )


def rest_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s") -> RestLog:
    """The IMU's readings of a log in SI.

    Raises
    ------
    BadInputError for a log without an IMU or without readings, whose time runs backwards, whose readings
    never change, and for units that are obviously others.
    """
    axes = _axes(log)
    rows = log.sampled(*(_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    factor = np.where(is_gyro(axes), GYRO_UNITS[gyro_unit], ACCEL_UNITS[acc_unit])
    values = np.stack([log.columns[_COLUMN[axis]][rows] for axis in axes], axis=1) * factor
    t_s = log.t_s[rows]
    _check_changes(log, axes, values)
    _check_units(log, axes, values, t_s)
    chip = log.sampled("onchip_phi_rad")
    angle = log.columns["onchip_phi_rad"][chip] if len(chip) else np.zeros(0)
    return RestLog(log.source, axes, t_s, values, log.t_s[chip], angle)


def read_rest_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s"
) -> tuple[RestLog, Sequence[str]]:
    """`rest_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    return rest_log(log, acc_unit, gyro_unit), said
