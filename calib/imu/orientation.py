"""How far an estimated orientation is from a true one, as BROAD counts it.

Quaternions (n, 4) are w, x, y, z and turn sensor into world, whose z axis points up. The error
e = q_true conj(q_estimate) is seen in the world frame. Split there into a turn about a horizontal axis
and one about the vertical,

    inclination = 2 atan2(|(x, y)|, |(w, z)|),   heading = 2 atan2(|z|, |w|),

so that the first is the angle between the two up vectors and the second is what gravity cannot show.
Without a magnetometer only the inclination is judged. (Laidig, Caruso, Cereatti, Seel: BROAD, Data
6(7):72, 2021, section 4.) The arc tangents equal the arc cosines given there and keep their digits near
zero.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError

__all__ = [
    "conjugate",
    "heading_error",
    "inclination_error",
    "product",
    "rms_in_motion",
    "total_error",
    "up_in_sensor",
]


def _checked(q: FloatArray) -> FloatArray:
    if q.ndim != 2 or q.shape[1] != 4:
        raise BadInputError(f"quaternions: found an array {q.shape}, expected (n, 4)")
    return q


def product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Hamilton's product (n, 4) of quaternions p and q, each (n, 4).

    Raises `BadInputError` for other shapes.
    """
    w, x, y, z = _checked(p).T
    a, b, c, d = _checked(q).T
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )


def conjugate(q: FloatArray) -> FloatArray:
    """The opposite turns (n, 4) of unit quaternions."""
    return np.asarray(_checked(q) * np.array([1.0, -1.0, -1.0, -1.0]))


def up_in_sensor(q: FloatArray) -> FloatArray:
    """The world's up vector (n, 3) in the sensor's axes: what an accelerometer at rest feels, over g."""
    w, x, y, z = _checked(q).T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


def _error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    if len(estimate) != len(truth):
        raise BadInputError(
            f"orientations: found {len(estimate)} estimates and {len(truth)} true ones, expected as many"
        )
    return np.asarray(np.abs(product(truth, conjugate(estimate))))


def inclination_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Angle (n,) [rad] between the up vectors, 0 to pi; NaN where either is NaN."""
    w, x, y, z = _error(estimate, truth).T
    return np.asarray(2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)))


def heading_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Turn (n,) [rad] about the vertical, 0 to pi."""
    w, _, _, z = _error(estimate, truth).T
    return np.asarray(2.0 * np.arctan2(z, w))


def total_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Angle (n,) [rad] of the whole turn between the two, 0 to pi."""
    w, x, y, z = _error(estimate, truth).T
    return np.asarray(2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), w))


def rms_in_motion(error_rad: FloatArray, moving: BoolArray) -> float:
    """Root mean square of the errors (n,) where it moves and the truth is known, NaN for none."""
    counted = error_rad[moving & np.isfinite(error_rad)]
    return math.sqrt(float(np.mean(counted**2))) if len(counted) else math.nan
