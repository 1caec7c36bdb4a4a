"""An IMU's intrinsics from one log: rests in many poses with turns between them.

The rests are found with one threshold after another, the accelerometer is fitted to each set of them, and
the one with the least residual wins (Tedaldi, Pretto and Menegatti, ICRA 2014, algorithm 1). Thresholds
that lose poses are left out of the contest. With its rests the gyroscope is fitted.

A rig that moves in a plane has two axes of the accelerometer in it and turns about z: the same code with
bias and scale of x and y, the angle between them, and the scale of gz. That is taken where the log has
these columns alone, or where all rests of a log in m/s^2 lie in the plane of x and y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.accelerometer import LEAST_SPAN, Accelerometer, fit_accelerometer
from calib.imu.gyroscope import Gyroscope, fit_gyroscope, foreign_axes
from calib.imu.rests import MULTIPLES, Quiet, Rest, Spread, find_rests, quiet_level, spread
from calib.imu.sampling import Part, Sampling, regular_parts
from calib.imu.static import is_gyro
from calib.imu.turns import Turns

__all__ = ["Intrinsics", "PoseLog", "Trial", "count_poses", "find_intrinsics"]

_POSE_RAD = math.radians(5.0)
_IN_PLANE = math.sin(math.radians(15.0))
_PLANE_SPREAD = math.cos(math.radians(30.0))
_LONGEST_FILLED_S = 0.1
_KEPT = 0.9


@dataclass(frozen=True)
class PoseLog:
    """Readings of a log with rests in many poses.

    Attributes
    ----------
    source : name for messages.
    axes : those of `calib.imu.static.AXES` that it has.
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings.
    accel_unit, gyro_unit : "m/s2" or "counts", "rad/s" or "counts".
    """

    source: str
    axes: tuple[str, ...]
    t_s: FloatArray
    values: FloatArray
    accel_unit: str = "m/s2"
    gyro_unit: str = "rad/s"


@dataclass(frozen=True)
class Trial:
    """One threshold: how many rests and poses it gives, and their residual with lost freedom counted."""

    multiple: float
    rests: int
    poses: int
    rms_mps2: float


@dataclass(frozen=True)
class Intrinsics:
    """What a log tells of an IMU.

    Attributes
    ----------
    planar, asked : whether two axes were calibrated, and whether that was asked for.
    lean_rad : about how far the plane leans by az, NaN where that is not known.
    quiet : spread at rest, and the rest at the start.
    multiple : of the threshold that won among `trials`.
    rests, poses : stretches at rest, and how many poses more than 5 degrees apart they show.
    accel : None for fewer rests than bias and scale need.
    gyro : None without turns, the axes of a gyroscope, or poses that tell the accelerometer.
    foreign : (3, 3) signed permutation where the gyroscope's axes are not the accelerometer's.
    turns_lost : turns not used, as readings are missing in them.
    has_gyro : whether the log has the gyroscope's axes that are needed.
    """

    log: PoseLog
    gravity_mps2: float
    planar: bool
    asked: bool
    lean_rad: float
    sampling: Sampling
    quiet: Quiet
    multiple: float
    trials: tuple[Trial, ...]
    rests: tuple[Rest, ...]
    poses: int
    accel: Accelerometer | None
    gyro: Gyroscope | None
    foreign: FloatArray | None
    turns_lost: int
    has_gyro: bool


def count_poses(directions: FloatArray) -> int:
    """How many of the unit vectors (n, d) are more than 5 degrees from each one counted before."""
    kept: list[FloatArray] = []
    for u in directions:
        if all(float(u @ v) < math.cos(_POSE_RAD) for v in kept):
            kept.append(u)
    return len(kept)


def _in_plane(rests: Sequence[Rest], columns: list[int]) -> bool:
    """Whether the rests lie in the plane of x and y, and turn in it."""
    if len(columns) != 3 or len(rests) < 3:
        return False
    means = np.stack([rest.mean for rest in rests])
    u = means / np.maximum(np.linalg.norm(means, axis=1), 1e-300)[:, None]
    apart = float((u @ u.T).min())
    return bool(np.abs(u[:, 2]).max() < _IN_PLANE and apart < _PLANE_SPREAD)


def _columns(log: PoseLog, planar: bool) -> list[int]:
    names = ("ax", "ay") if planar or "az" not in log.axes else ("ax", "ay", "az")
    missing = [name for name in names if name not in log.axes]
    if missing:
        raise BadInputError(
            f"{log.source}: has no {' and no '.join(missing)}, expected an accelerometer of at least x and y"
        )
    return [log.axes.index(name) for name in names]


def _contest(
    parts: tuple[Part, ...], columns: list[int], s: Spread, quiet: Quiet, gravity_mps2: float, si: bool
) -> tuple[tuple[Trial, ...], Trial, tuple[Rest, ...], Accelerometer | None]:
    """All thresholds, the one that wins, its rests and its fit."""
    tried: list[tuple[Trial, tuple[Rest, ...], Accelerometer | None]] = []
    for multiple in MULTIPLES:
        rests = find_rests(parts, columns, s, multiple * quiet.zeta)
        accel = None
        if len(rests) >= 2 * len(columns):
            accel = fit_accelerometer(rests, gravity_mps2, si)
        poses, rms = 0, math.inf
        if accel is not None:
            poses = count_poses(accel.directions)
            if accel.dof > 0:
                rms = accel.rms_mps2 * math.sqrt(len(rests) / accel.dof)
        elif rests and si:
            means = np.stack([rest.mean for rest in rests])
            poses = count_poses(means / np.maximum(np.linalg.norm(means, axis=1), 1e-300)[:, None])
        else:
            poses = min(len(rests), 1)
        tried.append((Trial(multiple, len(rests), poses, rms), rests, accel))
    most = max(trial.poses for trial, _, _ in tried)
    able = [one for one in tried if one[0].poses >= _KEPT * most]
    trial, rests, accel = min(able, key=lambda one: (one[0].rms_mps2, one[0].multiple))
    return tuple(one[0] for one in tried), trial, rests, accel


def _scatter(values: FloatArray) -> FloatArray:
    """Variance (3,) of a reading by differences, which a slow drift does not enter."""
    return np.asarray((np.diff(values, axis=0) ** 2).mean(axis=0) / 2.0)


def _turns(
    log: PoseLog,
    parts: tuple[Part, ...],
    rests: tuple[Rest, ...],
    columns: list[int],
    quiet: Quiet,
    period_s: float,
) -> tuple[Turns, int]:
    """Turns between rests, and how many could not be used."""
    names = ("gx", "gy", "gz") if len(columns) == 3 else ("", "", "gz")
    gyros, offsets = [], np.concatenate([[0], np.cumsum([len(part.values) for part in parts])])
    for part in parts:
        gyro = np.zeros((len(part.values), 3))
        for k, name in enumerate(names):
            if name:
                gyro[:, k] = part.values[:, log.axes.index(name)]
        gyros.append(gyro)
    first, last, before, after, lost = [], [], [], [], 0
    longest = max(2, round(_LONGEST_FILLED_S / period_s))
    for i in range(len(rests) - 1):
        a, b = rests[i], rests[i + 1]
        if a.part != b.part:
            lost += 1
            continue
        places = parts[a.part].places
        inside = places[(places >= a.stop - 1) & (places <= b.start)]
        if len(inside) < 2 or int(np.diff(inside).max()) > longest:
            lost += 1
            continue
        first.append(int(offsets[a.part]) + a.stop - 1)
        last.append(int(offsets[a.part]) + b.start)
        before.append(i)
        after.append(i + 1)
    held = [gyros[rest.part][rest.start : rest.stop] for rest in rests]
    initial = 0 if quiet.initial_s > 0.0 else int(np.argmax([rest.duration_s for rest in rests]))
    turns = Turns(
        gyro=np.ascontiguousarray(np.concatenate(gyros)),
        accel=np.concatenate([part.values[:, columns] for part in parts]),
        first=np.array(first, dtype=np.int64),
        last=np.array(last, dtype=np.int64),
        before=np.array(before, dtype=np.int64),
        after=np.array(after, dtype=np.int64),
        rests=rests,
        gyro_mean=np.stack([values.mean(axis=0) for values in held]),
        gyro_scatter=np.stack([_scatter(values) for values in held]),
        initial=initial,
        period_s=period_s,
    )
    return turns, lost


def find_intrinsics(log: PoseLog, gravity_mps2: float = 9.80665, planar: bool = False) -> Intrinsics:
    """Calibrate an accelerometer, and a gyroscope where the log has one.

    Parameters
    ----------
    log : begins at rest, for the gyroscope's bias; then rests of a second or more in many poses.
    gravity_mps2 : g where the log was taken.
    planar : calibrate x, y and gz alone.

    Raises
    ------
    BadInputError for a log without the accelerometer's axes, shorter than a second, or never at rest.
    """
    columns = _columns(log, planar)
    gyro_axes = is_gyro(log.axes)
    sampling, parts = regular_parts(log.t_s, log.values, gyro_axes, log.source)
    si = log.accel_unit != "counts"
    s = spread(parts, columns, sampling.period_s)
    quiet = quiet_level(s, sampling.step[columns])
    asked, lean = planar, math.nan
    if si and not planar and len(columns) == 3:
        planar = _in_plane(find_rests(parts, columns, s, 6.0 * quiet.zeta), columns)
    if planar or len(columns) == 2:
        planar = True
        columns = _columns(log, True)
        s = spread(parts, columns, sampling.period_s)
        quiet = quiet_level(s, sampling.step[columns])
    trials, won, rests, accel = _contest(parts, columns, s, quiet, gravity_mps2, si)
    if not rests:
        raise BadInputError(
            f"{log.source}: is never at rest for a second, expected rests in many poses and turns between"
        )
    if planar and si and "az" in log.axes:
        k = log.axes.index("az")
        z = np.concatenate([parts[rest.part].values[rest.start : rest.stop, k] for rest in rests])
        lean = math.asin(min(1.0, abs(float(z.mean())) / gravity_mps2))
    needed = ("gz",) if planar else ("gx", "gy", "gz")
    has_gyro = all(name in log.axes for name in needed)
    gyro, foreign, lost = None, None, 0
    # Directions of an accelerometer that is not told would be blamed on the gyroscope.
    if has_gyro and accel is not None and accel.span >= LEAST_SPAN:
        turns, lost = _turns(log, parts, rests, columns, quiet, sampling.period_s)
        if len(turns.first):
            gyro_si = log.gyro_unit != "counts"
            gyro = fit_gyroscope(turns, accel, gyro_si)
            foreign = foreign_axes(turns, accel, gyro, gyro_si)
    return Intrinsics(
        log=log,
        gravity_mps2=gravity_mps2,
        planar=planar,
        asked=asked,
        lean_rad=lean,
        sampling=sampling,
        quiet=quiet,
        multiple=won.multiple,
        trials=trials,
        rests=rests,
        poses=won.poses,
        accel=accel,
        gyro=gyro,
        foreign=foreign,
        turns_lost=lost,
        has_gyro=has_gyro,
    )
