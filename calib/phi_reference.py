"""The bending angle that the rig's camera sees, as a reference for angles of the IMU.

Of an arc of constant curvature the chord to the head has half of the head's angle (3.10), and the marker
(mx, my) lies d further along the head's tangent (A.1). Both together give

    tan(phi / 2) = mx / (my + d)

whatever the length. Pictures come late; by how much follows from the log: the lag is the one at which
the camera's angle differs least from another angle of the same log.
"""

from __future__ import annotations

import numpy as np

from calib.actuator.kinematics import MARKER_OFFSET_M
from calib.arrays import FloatArray
from calib.camera.homography import apply_homography
from calib.camera.model import Camera, undistort

__all__ = ["angle_from_marker", "angle_from_pixels", "lag_of"]

_LAGS_S = np.arange(-0.02, 0.1201, 0.001)
_FEWEST = 30


def angle_from_marker(marker_m: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Bending angle phi (n,) [rad] of marker positions (n, 2) in the plane [m]."""
    x, y = np.moveaxis(np.asarray(marker_m, dtype=np.float64), -1, 0)
    return np.asarray(2.0 * np.arctan2(x, y + offset_m))


def angle_from_pixels(
    camera: Camera, A_inverse: FloatArray, pixels: FloatArray, offset_m: float = MARKER_OFFSET_M
) -> FloatArray:
    """Bending angle phi (n,) [rad] of the marker in distorted pixels (n, 2), NaN beyond the horizon.

    Parameters
    ----------
    A_inverse : (3, 3) from ideal pixels to metres (2.12).
    """
    rays = undistort(camera, pixels)
    ideal = np.column_stack([rays, np.ones(len(rays))]) @ camera.K[:2].T
    return angle_from_marker(apply_homography(A_inverse, ideal), offset_m)


def lag_of(late_t_s: FloatArray, late_rad: FloatArray, t_s: FloatArray, phi_rad: FloatArray) -> float:
    """By how much [s] one angle (m,) is later than another (n,), from -20 to 120 ms; 0 for standing still.

    The lag of least variance of the difference; between the two neighbours it is that of the parabola.
    """
    known = np.isfinite(late_rad) & (late_t_s > t_s[0] + 0.13) & (late_t_s < t_s[-1] - 0.03)
    if int(known.sum()) < _FEWEST:
        return 0.0
    at, late = late_t_s[known], late_rad[known]
    variance = np.array([float((late - np.interp(at - lag, t_s, phi_rad)).var()) for lag in _LAGS_S.tolist()])
    k = int(np.argmin(variance))
    # A minimum at the end, or one that stands out by nothing, tells no lag.
    if k in (0, len(_LAGS_S) - 1) or float(variance.max()) < 1.02 * float(variance[k]):
        return 0.0
    a, b, c = variance[k - 1 : k + 2].tolist()
    bend = a - 2.0 * b + c
    return float(_LAGS_S[k] + (0.5 * 0.001 * (a - c) / bend if bend > 0.0 else 0.0))
