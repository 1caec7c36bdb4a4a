"""How well readings fit: whole pixels with outliers, and readings of the IMU.

A rounded pixel r says that the tracker's place z ~ N(m, jitter^2) lay in [r - g / 2, r + g / 2] (see
`calib.estimator.rounding`). With Z_u, Z_v the probabilities of both intervals a picture has the likelihood

    p = (1 - e) Z_u Z_v + e / a

where e is the share of pictures that show something else and a the area over which that lies. By
its score and Fisher's information a pixel pulls the fit with w E / jitter and weighs w (1 - V) / jitter^2,
E and V mean and variance of the truncated normal distribution in units of the jitter, and
w = (1 - e) Z_u Z_v / p.

Readings of the IMU have Huber's loss with a far knee.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.estimator.rounding import truncated

__all__ = ["HUBER", "best_jitter_px", "imu_terms", "pixel_terms"]

HUBER = 4.0
"""Knee of the loss of an IMU's reading, in deviations."""

_JITTERS_PX = np.exp(np.linspace(math.log(0.03), math.log(3.0), 47))


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_terms(
    off: FloatArray, jitter: float, grid: float, share: float, area: float, pull: FloatArray,
    weight: FloatArray, good: FloatArray,
) -> float:  # fmt: skip
    """Loss of pictures off by (n, 2) [px]; pull (n, 2), weight (n, 2) and w (n,) are written to.

    A picture that is not finite has no pull and no weight. Without a grid the density at the reading stands
    for Z over one pixel.
    """
    loss = 0.0
    back = share / area
    for n in range(len(off)):
        log_z = 0.0
        known = True
        for k in range(2):
            d = off[n, k]
            pull[n, k], weight[n, k] = 0.0, 0.0
            if not abs(d) < 1e6:
                known = False
            elif grid > 0.0:
                z, mean, variance = truncated((d - 0.5 * grid) / jitter, (d + 0.5 * grid) / jitter)
                log_z += z
                pull[n, k] = mean / jitter
                weight[n, k] = max(1.0 - variance, 1e-3) / (jitter * jitter)
            else:
                log_z += -0.5 * (d / jitter) ** 2 - math.log(jitter * math.sqrt(2.0 * math.pi))
                pull[n, k] = d / (jitter * jitter)
                weight[n, k] = 1.0 / (jitter * jitter)
        if not known:
            good[n] = 0.0
            pull[n, 0], pull[n, 1], weight[n, 0], weight[n, 1] = 0.0, 0.0, 0.0, 0.0
            loss -= math.log(back)
            continue
        inside = (1.0 - share) * math.exp(log_z)
        good[n] = inside / (inside + back)
        loss -= math.log(inside + back)
        for k in range(2):
            pull[n, k] *= good[n]
            weight[n, k] *= good[n]
    return loss


def best_jitter_px(off: FloatArray, grid: float, share: float, area: float) -> float:
    """Jitter that makes pictures off by (n, 2) [px] most likely."""
    pull, weight, good = np.empty(off.shape), np.empty(off.shape), np.empty(len(off))
    losses = np.array([pixel_terms(off, s, grid, share, area, pull, weight, good) for s in _JITTERS_PX])
    k = int(np.argmin(losses))
    if not 0 < k < len(losses) - 1:
        return float(_JITTERS_PX[k])
    a, b, c = losses[k - 1 : k + 2]
    step = math.log(_JITTERS_PX[1] / _JITTERS_PX[0])
    return float(_JITTERS_PX[k] * math.exp(0.5 * step * (a - c) / (a - 2.0 * b + c)))


def imu_terms(off: FloatArray, noise: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Loss of readings off by (n, 3), with pull and weight (n, 3); zero where a reading is missing.

    Parameters
    ----------
    noise : (3,) standard deviations.
    """
    known = np.isfinite(off)
    z = np.where(known, off, 0.0) / noise
    size = np.abs(z)
    inside = size <= HUBER
    loss = float(np.sum(np.where(inside, 0.5 * z * z, HUBER * (size - 0.5 * HUBER))))
    w = np.where(known, np.where(inside, 1.0, HUBER / np.maximum(size, HUBER)), 0.0)
    return loss, w * z / noise, w / (noise * noise)
