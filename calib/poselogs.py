"""Readings of an IMU in many poses: from a log, or from a file of each sensor as imu_tk keeps them.

imu_tk's files have lines of four numbers, time in seconds and x, y, z, in raw counts or in SI, and may be
compressed with gzip. The gyroscope's readings are put on the accelerometer's times by straight lines
where they have others.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.files import as_text, read_bytes, shown
from calib.imu.intrinsics import PoseLog
from calib.imu.static import AXES, is_gyro
from calib.imulogs import ACCEL_UNITS, GYRO_UNITS
from calib.logs import ROWS_MISSING, Log, check_time, read_log

__all__ = ["pose_log", "read_pose_files", "read_pose_log"]

_COLUMN = {axis: f"{axis}_{'radps' if axis[0] == 'g' else 'mps2'}" for axis in AXES}
_FASTEST_RADPS = 45.0
_LARGEST_BIAS_RADPS = 0.35
_ABOUT_G = (7.5, 12.5)
_MOST_BYTES = 500_000_000
_ODD_COUNTS = 150.0


def _check_changes(source: str, axes: tuple[str, ...], values: FloatArray, planar: bool) -> None:
    if len(values) < 2:
        raise BadInputError(f"{source}: has {len(values)} IMU sample, expected rests in many poses")
    if not values.any():
        raise BadInputError(f"{source}: all IMU readings are zero, expected noise and gravity")
    for axis, column in zip(axes, values.T, strict=True):
        if float(np.ptp(column)) == 0.0:
            hint = "; give --planar to do without it" if axis in ("az", "gx", "gy") and not planar else ""
            raise BadInputError(
                f"{source}: {axis} is stuck at {column[0]:g}, expected readings that follow the poses{hint}"
            )


def _check_accel(source: str, accel: FloatArray, unit: str) -> None:
    """The length of the specific force is about g most of the time, if two axes lie in the plane too."""
    if unit == "counts":
        return
    length = float(np.median(np.linalg.norm(accel, axis=1)))
    if unit == "m/s2" and accel.shape[1] == 2 and length < 0.7:
        # Two axes may be far from the vertical; only what cannot be m/s^2 is named.
        return
    if unit == "m/s2" and 0.7 <= length <= 1.3:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g}, so it is in g, expected m/s^2; "
            "give --acc-unit g"
        )
    if length > _ODD_COUNTS:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g}, so it is in raw counts, expected m/s^2; "
            "give --acc-unit counts"
        )
    if not _ABOUT_G[0] <= length <= _ABOUT_G[1] and accel.shape[1] == 3:
        raise BadInputError(
            f"{source}: the specific force is mostly {length:.4g} m/s^2, expected about 9.81; see --acc-unit"
        )


def _check_gyro(source: str, gyro: FloatArray, unit: str) -> None:
    """No sensor that is put from pose to pose turns this fast or rests at such a rate."""
    if unit == "counts":
        return
    largest, middle = float(np.abs(gyro).max()), float(np.abs(np.median(gyro, axis=0)).max())
    why = ""
    if largest > _FASTEST_RADPS:
        why = f"reaches {largest:.4g} rad/s"
    elif middle > _LARGEST_BIAS_RADPS:
        why = f"has a bias of {middle:.3g} rad/s"
    if not why:
        return
    other = "counts" if middle > _ODD_COUNTS else "deg/s"
    if unit == other:
        raise BadInputError(f"{source}: the gyroscope {why}, which none does; see --gyro-unit")
    raise BadInputError(
        f"{source}: the gyroscope {why}, which none does that is put from pose to pose; if it is in {other}, "
        f"give --gyro-unit {other}"
    )


def _made(
    source: str,
    axes: tuple[str, ...],
    t_s: FloatArray,
    values: FloatArray,
    units: tuple[str, str],
    planar: bool,
) -> PoseLog:
    """The readings in SI or counts, looked at. With `planar` only what lies in the plane is kept."""
    accel_unit, gyro_unit = units
    if planar:
        kept = [k for k, axis in enumerate(axes) if axis not in ("gx", "gy")]
        # A lean of the plane is read from az; stuck, it tells nothing.
        kept = [k for k in kept if axes[k] != "az" or float(np.ptp(values[:, k])) > 0.0]
        axes, values = tuple(axes[k] for k in kept), values[:, kept]
    gyro = is_gyro(axes)
    factor = np.where(gyro, GYRO_UNITS.get(gyro_unit, 1.0), ACCEL_UNITS.get(accel_unit, 1.0))
    values = values * factor
    _check_changes(source, axes, values, planar)
    in_plane = [axis in ("ax", "ay") or (axis == "az" and not planar) for axis in axes]
    _check_accel(source, values[:, in_plane], accel_unit)
    if gyro.any():
        _check_gyro(source, values[:, gyro], gyro_unit)
    return PoseLog(
        source,
        axes,
        t_s,
        values,
        "counts" if accel_unit == "counts" else "m/s2",
        "counts" if gyro_unit == "counts" else "rad/s",
    )


def pose_log(log: Log, acc_unit: str = "m/s2", gyro_unit: str = "rad/s", planar: bool = False) -> PoseLog:
    """The IMU's readings of a log; with the unit "counts" its columns are taken as they are.

    Raises
    ------
    BadInputError for a log without an accelerometer or without readings, whose time runs backwards, with
    an axis that never changes, and for units that are obviously others.
    """
    named = [axis for axis in AXES if _COLUMN[axis] in log.columns]
    axes = tuple(axis for axis in named if bool(np.isfinite(log.columns[_COLUMN[axis]]).any()))
    if not named:
        raise BadInputError(f"{log.source}: has no IMU, expected columns as ax_mps2, ay_mps2 and gz_radps")
    if not axes:
        raise BadInputError(
            f"{log.source}: the IMU's columns {', '.join(_COLUMN[a] for a in named)} hold no number"
        )
    if "ax" not in axes or "ay" not in axes:
        raise BadInputError(f"{log.source}: has no accelerometer, expected columns ax_mps2 and ay_mps2")
    rows = log.sampled(*(_COLUMN[axis] for axis in axes))
    if len(rows) == 0:
        raise BadInputError(
            f"{log.source}: no row has all of {', '.join(_COLUMN[a] for a in axes)}, expected them together"
        )
    check_time(log)
    values = np.stack([log.columns[_COLUMN[axis]][rows] for axis in axes], axis=1)
    return _made(log.source, axes, log.t_s[rows], values, (acc_unit, gyro_unit), planar)


def read_pose_log(
    path: Path, acc_unit: str = "m/s2", gyro_unit: str = "rad/s", planar: bool = False
) -> tuple[PoseLog, Sequence[str]]:
    """`pose_log` of a file, and sentences about what was passed over in it."""
    log = read_log(path)
    said = log.passed_over(ROWS_MISSING)
    return pose_log(log, acc_unit, gyro_unit, planar), said


def _unpacked(path: Path) -> bytes:
    data = read_bytes(path)
    if data[:2] != b"\x1f\x8b":
        return data
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            out = stream.read(_MOST_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise BadInputError(f"{shown(path)}: is not a gzip file that can be read: {error}") from error
    if len(out) > _MOST_BYTES:
        raise BadInputError(f"{shown(path)}: unpacks to more than {_MOST_BYTES / 1e6:g} MB")
    return out


def _four_numbers(path: Path) -> FloatArray:
    """Lines of time, x, y, z as an array (n, 4); rows that say nan or inf are left out."""
    text = as_text(path, _unpacked(path))
    rows: list[list[float]] = []
    at: list[int] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith(("#", "%")):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 4:
            raise BadInputError(
                f"{shown(path)}, line {number}: is {shown(line[:40])!r}, expected four numbers: t, x, y, z"
            )
        if all(np.isfinite(row)):
            rows.append(row)
            at.append(number)
    if not rows:
        raise BadInputError(f"{shown(path)}: has no readings, expected lines of t, x, y, z")
    values = np.array(rows)
    back = np.flatnonzero(np.diff(values[:, 0]) < 0.0)
    if len(back):
        i = int(back[0])
        raise BadInputError(
            f"{shown(path)}, line {at[i + 1]}: the time goes back from {values[i, 0]:.6f} to "
            f"{values[i + 1, 0]:.6f}, expected time to run forward"
        )
    return values


def read_pose_files(
    accel: Path,
    gyro: Path | None = None,
    acc_unit: str = "m/s2",
    gyro_unit: str = "rad/s",
    planar: bool = False,
) -> tuple[PoseLog, Sequence[str]]:
    """Readings from a file of the accelerometer, and one of the gyroscope, and sentences about them.

    Raises `BadInputError` as `pose_log`, for lines that are not four numbers, and for files of different
    times.
    """
    a = _four_numbers(accel)
    source = shown(accel)
    said: list[str] = []
    if gyro is None:
        return _made(source, ("ax", "ay", "az"), a[:, 0], a[:, 1:], (acc_unit, gyro_unit), planar), said
    w = _four_numbers(gyro)
    rates = w[:, 1:]
    if len(w) != len(a) or not np.array_equal(w[:, 0], a[:, 0]):
        inside = (a[:, 0] >= w[0, 0]) & (a[:, 0] <= w[-1, 0])
        if inside.sum() < 0.5 * len(a):
            raise BadInputError(
                f"{shown(gyro)}: runs from {w[0, 0]:g} to {w[-1, 0]:g} s, expected the times of {source}, "
                f"{a[0, 0]:g} to {a[-1, 0]:g} s"
            )
        a = a[inside]
        rates = np.stack([np.interp(a[:, 0], w[:, 0], column) for column in w.T[1:]], axis=1)
        said.append(f"{shown(gyro)}: has other times than {source}; put on those by straight lines")
    values = np.hstack([rates, a[:, 1:]])
    return _made(source, AXES, a[:, 0], values, (acc_unit, gyro_unit), planar), said
