"""The rate of the angle in the plane of a sensor that is not exactly in plane.

The angle is phi = atan2(uy, ux) with u the up vector in the sensor's axes, which an accelerometer at rest
measures (2.1). The vertical stands still in the world, so in the sensor, which turns at w = (gx, gy, gz),

    du/dt = u x w,   that is   dux/dt = uy gz - uz gy,   duy/dt = uz gx - ux gz,

and with s = ux^2 + uy^2

    dphi/dt = (ux duy/dt - uy dux/dt) / s = -gz + uz (gx ux + gy uy) / s.

In plane uz is zero and the rate is -gz. Out of plane the other two axes count, and the more the smaller
s is; where s is zero the angle itself is not defined. Below `LEAST` s is therefore held there, which
takes the second term to zero with ux and uy instead of to infinity.

The up vector must not follow the sensor's own acceleration, and not lag behind its turning either. So
the specific force is turned into a frame that follows the gyroscope alone, where gravity stands still
but for the gyroscope's bias, is low-passed there, and turned back (Laidig and Seel: VQF, Information
Fusion 91, 2023, section 3.2). The low-pass is a Butterworth filter of order two at sqrt(2) / (2 pi tau)
Hz, 0.075 Hz for tau = 3 s: of a swing at 4 Hz it lets 1 / 2800 through. Until tau has passed it is the
mean so far. Of a gyro bias b the up vector is left b tau behind, 0.9 degrees at 0.3 degrees/s.

A bias of gx and gy reaches the rate by the factor |uz| / sqrt(s), which is small for a sensor that is
nearly in plane: only gz has to be as well calibrated as without the second term.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.signal import butter

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError

__all__ = ["LEAST", "TAU_S", "in_plane", "planar_rate", "up_vector"]

LEAST = 0.01
"""s below which the angle counts as undefined: the sensor's plane is within 6 degrees of level."""

TAU_S = 3.0


def _three(name: str, values: FloatArray) -> FloatArray:
    if values.ndim != 2 or values.shape[1] != 3:
        raise BadInputError(f"{name}: found an array {values.shape}, expected (n, 3)")
    return np.ascontiguousarray(values, dtype=np.float64)


def planar_rate(gyro_radps: FloatArray, up: FloatArray, least: float = LEAST) -> FloatArray:
    """Rate (n,) [rad/s] of atan2(uy, ux), exact where ux^2 + uy^2 is at least `least`.

    Parameters
    ----------
    gyro_radps : (n, 3) rates about the sensor's axes.
    up : (n, 3) unit up vectors in the sensor's axes, as from `up_vector`.

    Raises
    ------
    BadInputError for other shapes and for `least` that is not positive.
    """
    if not least > 0.0:
        raise BadInputError(f"least ux^2 + uy^2: found {least:g}, expected more than zero")
    gx, gy, gz = _three("rates", gyro_radps).T
    ux, uy, uz = _three("up vectors", up).T
    if len(gx) != len(ux):
        raise BadInputError(f"found {len(gx)} rates and {len(ux)} up vectors, expected as many of each")
    return np.asarray(-gz + uz * (gx * ux + gy * uy) / np.maximum(ux * ux + uy * uy, least))


def in_plane(up: FloatArray, least: float = 0.5) -> BoolArray:
    """Where (n,) ux^2 + uy^2 is at least `least`: 0.5 is a tilt of the plane by up to 45 degrees."""
    ux, uy, _ = _three("up vectors", up).T
    return np.asarray(ux * ux + uy * uy >= least)


@njit(cache=True, nogil=True)
def _follow(
    force: FloatArray,
    gyro: FloatArray,
    period: float,
    b: FloatArray,
    a: FloatArray,
    settle: int,
    out: FloatArray,
) -> None:
    """Fills `out` with unit up vectors; the frame's quaternion is q = (w, x, y, z)."""
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    mean = np.zeros(3)
    first, second, still = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(len(force)):
        if k > 0:
            # Rates are taken as straight between the samples.
            rx = 0.5 * (gyro[k, 0] + gyro[k - 1, 0]) * period
            ry = 0.5 * (gyro[k, 1] + gyro[k - 1, 1]) * period
            rz = 0.5 * (gyro[k, 2] + gyro[k - 1, 2]) * period
            turn = math.sqrt(rx * rx + ry * ry + rz * rz)
            c = math.cos(0.5 * turn)
            s = 0.5 if turn < 1e-9 else math.sin(0.5 * turn) / turn
            i, j, m = s * rx, s * ry, s * rz
            w, x, y, z = (
                w * c - x * i - y * j - z * m,
                w * i + x * c + y * m - z * j,
                w * j - x * m + y * c + z * i,
                w * m + x * j - y * i + z * c,
            )
            n = math.sqrt(w * w + x * x + y * y + z * z)
            w, x, y, z = w / n, x / n, y / n, z / n
        R = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
        for axis in range(3):
            row = R[axis]
            f = row[0] * force[k, 0] + row[1] * force[k, 1] + row[2] * force[k, 2]
            if k < settle:
                mean[axis] += (f - mean[axis]) / (k + 1)
                still[axis] = mean[axis]
                # The state in which the low-pass has always seen this mean.
                first[axis] = (1.0 - b[0]) * mean[axis]
                second[axis] = (b[2] - a[2]) * mean[axis]
            else:
                value = b[0] * f + first[axis]
                first[axis] = b[1] * f - a[1] * value + second[axis]
                second[axis] = b[2] * f - a[2] * value
                still[axis] = value
        length = math.sqrt(still[0] ** 2 + still[1] ** 2 + still[2] ** 2)
        for axis in range(3):
            value = R[0][axis] * still[0] + R[1][axis] * still[1] + R[2][axis] * still[2]
            out[k, axis] = value / length if length > 0.0 else 0.0


def up_vector(
    force_mps2: FloatArray, gyro_radps: FloatArray, period_s: float, tau_s: float = TAU_S
) -> FloatArray:
    """Unit up vectors (n, 3) in the sensor's axes, from samples up to each; zeros without any force.

    Parameters
    ----------
    force_mps2, gyro_radps : (n, 3) finite readings on an even grid.
    period_s : of the grid.
    tau_s : time constant of the low-pass, at least one period.

    Raises
    ------
    BadInputError for other shapes, values that are not finite, and times that make no filter.
    """
    force, gyro = _three("specific forces", force_mps2), _three("rates", gyro_radps)
    if len(force) != len(gyro):
        raise BadInputError(f"found {len(force)} specific forces and {len(gyro)} rates, expected as many")
    if not 0.0 < period_s <= tau_s < math.inf:
        raise BadInputError(
            f"up vector: found a period of {period_s:g} s and a time constant of {tau_s:g} s, expected "
            "0 < period <= time constant"
        )
    if not (np.isfinite(force).all() and np.isfinite(gyro).all()):
        raise BadInputError("up vector: a reading is not finite, expected numbers")
    cutoff = min(math.sqrt(2.0) / (2.0 * math.pi * tau_s), 0.45 / period_s)
    b, a = butter(2, cutoff, fs=1.0 / period_s)
    out = np.empty_like(force)
    settle = max(round(tau_s / period_s), 1)
    _follow(force, gyro, period_s, np.asarray(b), np.asarray(a), settle, out)
    return out
