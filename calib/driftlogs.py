"""Readings of an IMU from logs in which it may move, in SI, with what is wrong about them said.

A sensor in motion is no measure of its own units, so the calmest tenth of the log is looked at: there
the specific force is about g. The gyroscope has to turn about as far as the accelerometer's angle within
a second; in deg/s it turns 57 times as far. Where the log is at rest throughout, the limits of its noise
and bias hold as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.rest import MOST_GYRO_RADPS
from calib.imu.tracks import DriftLog
from calib.imulogs import ACCEL_UNITS, GYRO_UNITS
from calib.logs import ROWS_MISSING, Log, check_time, read_log

__all__ = ["drift_log", "read_drift_log"]

_COLUMN = {f"a{x}": f"a{x}_mps2" for x in "xyz"} | {f"g{x}": f"g{x}_radps" for x in "xyz"}
_ORDER = ("gx", "gy", "gz", "ax", "ay", "az")
_NEEDED = ("gz", "ax", "ay")
_FASTEST_RADPS = 45.0
_LARGEST_BIAS_RADPS = 0.35
_ABOUT_G = (7.0, 13.0)
_CALM = 0.1
_WINDOW = 50
_FARTHER = 12.0
_LEAST_TURN_RAD = 0.05
_REST_RAD = 0.02


def _axes(log: Log) -> tuple[str, ...]:
    named = [axis for axis in _ORDER if _COLUMN[axis] in log.columns]
    if not named:
        raise BadInputError(
            f"{log.source}: has no IMU, expected columns as gz_radps, ax_mps2 and ay_mps2 beside t_s"
        )
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_COLUMN[axis]]).any()))
    lacking = [axis for axis in _NEEDED if axis not in axes]
    if lacking:
        raise BadInputError(
            f"{log.source}: has no readings in {', '.join(_COLUMN[axis] for axis in lacking)}, expected "
            "gz_radps, ax_mps2 and ay_mps2"
        )
    return axes


def _check_changes(log: Log, axes: tuple[str, ...], values: FloatArray) -> tuple[str, ...]:
    """The axes that never change, of those that the angle does not need."""
    if len(values) < 2:
        raise BadInputError(f"{log.source}: has {len(values)} IMU sample, expected a log of some seconds")
    if not values.any():
        raise BadInputError(f"{log.source}: all IMU readings are zero, expected noise and gravity")
    stuck = tuple(axis for axis, span in zip(axes, np.ptp(values, axis=0), strict=True) if span == 0.0)
    for axis in _NEEDED:
        if axis in stuck:
            at = float(values[0, axes.index(axis)])
            raise BadInputError(
                f"{log.source}: {axis} never changes, it is stuck at {at:.6g}; expected noise of a sensor"
            )
    return stuck


def _windows(values: FloatArray) -> FloatArray:
    size = min(_WINDOW, len(values))
    count = len(values) // size
    return values[: count * size].reshape(count, size, -1)


def _check_force(log: Log, axes: tuple[str, ...], calm: FloatArray) -> None:
    which = [k for k, axis in enumerate(axes) if axis[0] == "a"]
    norm = float(np.median(np.linalg.norm(calm[:, :, which], axis=2)))
    if 0.85 <= norm <= 1.15:
        raise BadInputError(
            f"{log.source}: the specific force is {norm:.4g} where the log is calm, so it is in g, expected "
            "m/s^2; give --acc-unit g"
        )
    if len(which) == 3 and not _ABOUT_G[0] <= norm <= _ABOUT_G[1]:
        kind = "raw counts" if norm > 150.0 else "no unit that is known here"
        raise BadInputError(
            f"{log.source}: the specific force is {norm:.4g} where the log is calm ({kind}), expected about "
            "9.81 m/s^2"
        )


def _turning(axes: tuple[str, ...], values: FloatArray, t_s: FloatArray) -> tuple[float, float, float]:
    """RMS [rad] within windows of a second of the accelerometer's angle and of -gz summed up, and the
    spread of the accelerometer's angle over the whole log."""
    phi = np.unwrap(np.arctan2(values[:, axes.index("ay")], values[:, axes.index("ax")]))
    turned = np.concatenate([[0.0], np.cumsum(-values[1:, axes.index("gz")] * np.diff(t_s))])
    period = max(float(np.median(np.diff(t_s))), 1e-6)
    size = min(max(round(1.0 / period), 4), len(phi))
    count = len(phi) // size
    by_acc, by_gyro = (
        float(np.median(x[: count * size].reshape(count, size).std(axis=1))) for x in (phi, turned)
    )
    return by_acc, by_gyro, float(phi.std())


def _check_rates(
    log: Log, axes: tuple[str, ...], values: FloatArray, calm: FloatArray, t_s: FloatArray
) -> None:
    which = [k for k, axis in enumerate(axes) if axis[0] == "g"]
    largest = float(np.abs(values[:, which]).max())
    quiet = float(np.median(calm[:, :, which].std(axis=1), axis=0).max())
    bias = float(np.abs(np.median(calm[:, :, which], axis=(0, 1))).max())
    by_acc, by_gyro, spread = _turning(axes, values, t_s)
    at_rest = spread < _REST_RAD
    why = ""
    if largest > _FASTEST_RADPS:
        why = f"reaches {largest:.4g}"
    elif by_gyro > max(_LEAST_TURN_RAD, _FARTHER * by_acc):
        why = f"turns {by_gyro / max(by_acc, 1e-6):.3g} times as far as the accelerometer's angle"
    elif at_rest and bias > _LARGEST_BIAS_RADPS:
        why = f"has a bias of {bias:.3g}"
    elif at_rest and quiet > MOST_GYRO_RADPS:
        why = f"is never quieter than {quiet:.3g}"
    if why:
        raise BadInputError(
            f"{log.source}: the gyroscope {why}, which no gyroscope does in rad/s; if it is in deg/s, give "
            "--gyro-unit deg/s"
        )


def drift_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s") -> tuple[DriftLog, tuple[str, ...]]:
    """The IMU's readings and the angles of a log in SI, and sentences about axes that were left out.

    Raises
    ------
    BadInputError for a log without gz, ax and ay, whose time runs backwards, whose readings never change,
    and for units that are obviously others.
    """
    axes = _axes(log)
    rows = log.sampled(*(_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    factor = np.array([(GYRO_UNITS[gyro_unit] if a[0] == "g" else ACCEL_UNITS[acc_unit]) for a in axes])
    values = np.stack([log.columns[_COLUMN[axis]][rows] for axis in axes], axis=1) * factor
    t_s = log.t_s[rows]
    stuck = _check_changes(log, axes, values)
    windows = _windows(values)
    # Relative to each axis's own middle, so that units play no part.
    loud = windows.std(axis=1)
    loud = (loud / np.maximum(np.median(loud, axis=0), 1e-12)).max(axis=1)
    calm = windows[np.argsort(loud, kind="stable")[: max(math.ceil(_CALM * len(windows)), 1)]]
    _check_force(log, axes, calm)
    _check_rates(log, axes, values, calm, t_s)
    said = []
    if stuck:
        keep = [k for k, axis in enumerate(axes) if axis not in stuck]
        for axis in stuck:
            at = float(values[0, axes.index(axis)])
            said.append(f"{log.source}: {axis} never changes, it is stuck at {at:.6g}; left out")
        axes, values = tuple(axes[k] for k in keep), values[:, keep]
    chip, true = log.sampled("onchip_phi_rad"), log.sampled("true_phi_rad")
    empty = np.zeros(0)
    return DriftLog(
        log.source,
        axes,
        t_s,
        values,
        log.t_s[chip],
        log.columns["onchip_phi_rad"][chip] if len(chip) else empty,
        log.t_s[true],
        log.columns["true_phi_rad"][true] if len(true) else empty,
    ), tuple(said)


def read_drift_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s"
) -> tuple[DriftLog, Sequence[str]]:
    """`drift_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    found, more = drift_log(log, acc_unit, gyro_unit)
    return found, [*said, *more]
