"""Compiled integration of rates of rotation over many turns."""

from __future__ import annotations

import numpy as np
from numba import njit

from calib.arrays import FloatArray, IntArray

__all__ = ["turn_directions"]


@njit(cache=True, nogil=True)
def _rate(q: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """dq/dt = q * (0, w) / 2."""
    out[0] = 0.5 * (-q[1] * w[0] - q[2] * w[1] - q[3] * w[2])
    out[1] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1])
    out[2] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2])
    out[3] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0])


@njit(cache=True, nogil=True)
def turn_directions(
    rates: FloatArray,
    M: FloatArray,
    starts: IntArray,
    stops: IntArray,
    before: FloatArray,
    period_s: float,
    out: FloatArray,
) -> None:
    """Directions that are fixed in the world, as the sensor sees them after each turn.

    Parameters
    ----------
    rates : (n, 3); the rate of rotation is M rate, linear between readings.
    starts, stops : (k,) first and last reading of each turn.
    before : (k, 3) vectors before the turns.
    out : (k, 3) vectors after them.
    """
    w0, wm, w1 = np.zeros(3), np.zeros(3), np.zeros(3)
    q, trial = np.zeros(4), np.zeros(4)
    k1, k2, k3, k4 = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(4)
    h = period_s
    for turn in range(len(starts)):
        q[0], q[1], q[2], q[3] = 1.0, 0.0, 0.0, 0.0
        for i in range(3):
            w1[i] = 0.0
            for j in range(3):
                w1[i] += M[i, j] * rates[starts[turn], j]
        for row in range(starts[turn], stops[turn]):
            for i in range(3):
                w0[i] = w1[i]
                w1[i] = 0.0
                for j in range(3):
                    w1[i] += M[i, j] * rates[row + 1, j]
                wm[i] = 0.5 * (w0[i] + w1[i])
            _rate(q, w0, k1)
            for i in range(4):
                trial[i] = q[i] + 0.5 * h * k1[i]
            _rate(trial, wm, k2)
            for i in range(4):
                trial[i] = q[i] + 0.5 * h * k2[i]
            _rate(trial, wm, k3)
            for i in range(4):
                trial[i] = q[i] + h * k3[i]
            _rate(trial, w1, k4)
            norm = 0.0
            for i in range(4):
                q[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
                norm += q[i] * q[i]
            norm = norm**0.5
            for i in range(4):
                q[i] /= norm
        # v_after = R(q)^T v_before, q turning vectors of the sensor after into those before.
        s, x, y, z = q[0], q[1], q[2], q[3]
        a, b, c = before[turn, 0], before[turn, 1], before[turn, 2]
        out[turn, 0] = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + s * z) * b + 2 * (x * z - s * y) * c
        out[turn, 1] = 2 * (x * y - s * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + s * x) * c
        out[turn, 2] = 2 * (x * z + s * y) * a + 2 * (y * z - s * x) * b + (1 - 2 * (x * x + y * y)) * c
