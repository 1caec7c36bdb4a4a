"""One log of two recordings of a motion: the pictures' times on the IMU's clock, whatever both clocks are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from calib.core.arrays import BoolArray, FloatArray, integral
from calib.core.errors import BadInputError
from calib.core.rig import Geometry, Rig
from calib.io.logs import Log
from calib.stages.imu.read import angle_from_marker

# ----------------------------------------------------------------------
# Both saw the head turn: the camera its angle phi (or, without a plane, the marker's way along its main
# direction), the gyroscope its rate. Both are differenced over `_OVER` steps of a grid and held against each
# other at all lags,
#
#     left(lag) = sum (r_camera(t) - r_imu(t + lag))^2 / sum r_camera(t)^2,
#
# over the time that both share there; of the marker's way, whose scale nobody knows, after the best factor.
# A lag at which more than half of motion or time lies outside the IMU's says nothing. A swing repeats after
# each period but for its size, so that the next best lag has to leave twice as much.

_STEP_S, _OVER = 0.01, 10
_GAP_S = 0.15
_MOST_LEFT, _APART = 0.4, 0.5
"""Share of the motion that may be left, and of what the next best lag leaves."""
_BESIDE_S = 0.1
_LONGEST_S = 6.0 * 3600.0
DRIFT_S = 0.004
"""Between the halves of a recording, beyond which it is told."""


@dataclass(frozen=True)
class Clocks:
    """How two clocks stand to each other.

    Attributes
    ----------
    offset_s : to be added to the pictures' times. drift_s : by how much more in the second half than in the
        first; None where one of them does not tell.
    left, next_left : shares of the motion that are left at this offset, and at the next best one.
    """

    offset_s: float
    drift_s: float | None
    left: float
    next_left: float


def _on_grid(t_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Times of a grid, rates there, and whether they are between samples that are close together."""
    at = np.arange(t_s[0], t_s[-1], _STEP_S)
    after = np.clip(np.searchsorted(t_s, at, side="right"), 1, len(t_s) - 1)
    near = t_s[after] - t_s[after - 1] < _GAP_S
    smooth = np.interp(at, t_s, values)
    rate = (smooth[_OVER:] - smooth[:-_OVER]) / (_OVER * _STEP_S)
    middle = _OVER // 2
    return at[middle : middle + len(rate)], rate, near[_OVER:] & near[:-_OVER]


def _shares(seen: FloatArray, known: BoolArray, felt: FloatArray, scaled: bool) -> FloatArray:
    """left (n,) at the lags 1 - len(seen) .. len(felt) - 1 of grids; 1 where too little is shared."""
    seen = np.where(known, seen - seen[known].mean(), 0.0)
    both = correlate(felt, seen)
    there, rows = np.ones(len(felt)), known.astype(np.float64)
    own, other = correlate(there, seen**2), correlate(felt**2, rows)
    enough = (own > 0.5 * float((seen**2).sum())) & (correlate(there, rows) > 0.5 * float(rows.sum()))
    off = (
        own - 2.0 * both + other
        if scaled
        else own - np.divide(both**2, other, out=0.0 * own, where=other > 0)
    )
    return np.asarray(np.divide(np.maximum(off, 0.0), own, out=np.ones(len(own)), where=enough))


def clocks(
    camera_s: FloatArray, way: FloatArray, imu_s: FloatArray, gz_radps: FloatArray, scaled: bool
) -> Clocks | None:
    """How two clocks stand to each other by a motion that both saw; None where it does not tell.

    Parameters
    ----------
    camera_s, way : (n,) times and angle phi [rad], or with `scaled` False any measure of the motion.
    imu_s, gz_radps : (m,) times and rates.
    """
    at, seen, known = _on_grid(camera_s, way)
    felt_s, felt, _ = _on_grid(imu_s, -integral(imu_s, gz_radps - np.median(gz_radps)))
    if known.sum() < 10 * _OVER or len(felt) < 10 * _OVER:
        return None

    def offset(known: BoolArray) -> tuple[float, float, float]:
        left = _shares(seen, known, felt, scaled)
        k = int(np.argmin(left))
        beside = round(_BESIDE_S / _STEP_S)
        others = np.concatenate([left[: max(k - beside, 0)], left[k + beside + 1 :], [1.0]])
        part = 0.0
        if 0 < k < len(left) - 1:
            a, b, c = left[k - 1 : k + 2].tolist()
            part = 0.5 * (a - c) / (a - 2.0 * b + c) if a - 2.0 * b + c > 0.0 else 0.0
        lag_s = (k + part - (len(seen) - 1)) * _STEP_S
        return lag_s + float(felt_s[0] - at[0]), float(left[k]), float(others.min())

    whole, left, following = offset(known)
    if left > min(_MOST_LEFT, _APART * following):
        return None
    first = np.arange(len(at)) < len(at) // 2
    parts = (known & first, known & ~first)
    halves = [offset(part) for part in parts if part.sum() >= 10 * _OVER]
    clear = len(halves) == 2 and all(one[1] <= min(_MOST_LEFT, _APART * one[2]) for one in halves)
    return Clocks(whole, halves[1][0] - halves[0][0] if clear else None, left, following)


def _way(camera: Log, rig: Rig, rig_name: str) -> tuple[FloatArray, FloatArray, bool]:
    """Times, angle or way along the marker's main direction, and whether it is an angle."""
    pictures = camera.signals("u_px", "v_px")
    plane = rig.current_plane(rig_name)
    if plane is None or rig.camera is None:
        moved = pictures.values - pictures.values.mean(axis=0)
        return pictures.t_s, moved @ np.linalg.svd(moved, full_matrices=False)[2][0], False
    marker = plane.to_world(pictures.values, rig.camera)
    phi = angle_from_marker(marker, (rig.geometry or Geometry()).marker_offset_m)
    fine = np.isfinite(phi)
    return pictures.t_s[fine], phi[fine], True


def joined(
    camera: Log, board: Log, rig: Rig, rig_name: str, one_clock: bool
) -> tuple[Log, Clocks | None, int]:
    """The board's log with the camera's marker in it, how the clocks stand, and pictures that are left out.

    Parameters
    ----------
    rig : whose camera and plane, where it has them, make an angle of the marker.
    one_clock : whether both logs have the same clock already.

    Raises `BadInputError` for logs without pictures or gyroscope, and for motion that tells no offset.
    """
    for log, names, what in ((camera, ("u_px", "v_px"), "pictures"), (board, ("gz_radps",), "gyroscope")):
        if not len(log.sampled(*names)):
            raise BadInputError(f"{log.source}: has no {what}, expected {' and '.join(names)}")
        if float(np.ptp(log.t_s)) > _LONGEST_S:
            raise BadInputError(
                f"{log.source}: lasts {np.ptp(log.t_s):.0f} s, expected {_LONGEST_S:.0f} s at most"
            )
    found, offset_s = None, 0.0
    if not one_clock:
        gyro = board.signals("gz_radps")
        camera_s, way, scaled = _way(camera, rig, rig_name)
        found = clocks(camera_s, way, gyro.t_s, gyro["gz_radps"], scaled)
        if found is None:
            raise BadInputError(
                f"{camera.source}: its motion and that of {board.source} do not tell one offset of their "
                "clocks, expected quick turns of different sizes at uneven times that both recorded, or with "
                "camera and plane in rig.yaml a swing; where both have one clock say --same-clock"
            )
        offset_s = found.offset_s
    rows = camera.sampled("u_px", "v_px")
    moved = camera.t_s[rows] + offset_s
    inside = (moved >= board.t_s[0]) & (moved <= board.t_s[-1])
    if not inside.any():
        raise BadInputError(f"{camera.source}: none of its pictures is within the time of {board.source}")
    rows, moved = rows[inside], moved[inside]
    own = ("u_px", "v_px")
    carried = [name for name in board.columns if name not in own]
    t = np.concatenate([moved, board.t_s])
    order = np.argsort(t, kind="stable")
    blank = {"camera": np.full(len(moved), np.nan), "board": np.full(len(board), np.nan)}
    columns = {name: np.concatenate([camera.columns[name][rows], blank["board"]])[order] for name in own}
    columns |= {name: np.concatenate([blank["camera"], board.columns[name]])[order] for name in carried}
    log = Log(board.source, t[order], columns, np.arange(len(t)))
    return log, found, int((~inside).sum())
