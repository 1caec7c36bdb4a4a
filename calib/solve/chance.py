"""Tail probabilities of the F and t distributions, for tests of hypotheses.

SciPy has them too; its `special` takes as long to load as a camera takes to calibrate.
"""

from __future__ import annotations

from math import lgamma

import numpy as np

from calib.core.arrays import FloatArray

_TERMS = 300
_TINY = 1e-300
_log_gamma = np.vectorize(lgamma, otypes=[np.float64])


def _beta_share(a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
    """The regularised incomplete beta function I_x(a, b), by its continued fraction (DLMF 8.17.22)."""
    mirrored = x > (a + 1.0) / (a + b + 2.0)
    a, b, x = np.where(mirrored, b, a), np.where(mirrored, a, b), np.where(mirrored, 1.0 - x, x)
    # Lentz's method: numerator and denominator of successive convergents.
    c, d = np.ones_like(x), 1.0 / np.maximum(1.0 - (a + b) * x / (a + 1.0), _TINY)
    fraction = d
    for m in range(1, _TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        before = fraction
        for term in (even, odd):
            d = 1.0 / _away_from_zero(1.0 + term * d)
            c = _away_from_zero(1.0 + term / c)
            fraction = fraction * c * d
        if np.all(np.abs(fraction - before) <= 1e-15 * np.abs(fraction)):
            break
    with np.errstate(divide="ignore"):
        logarithm = _log_gamma(a + b) - _log_gamma(a) - _log_gamma(b) + a * np.log(x) + b * np.log1p(-x)
    share = np.exp(logarithm) * fraction / a
    return np.asarray(np.where(mirrored, 1.0 - share, share))


def _away_from_zero(value: FloatArray) -> FloatArray:
    return np.asarray(np.where(np.abs(value) < _TINY, _TINY, value))


def tail_of_f(d1: FloatArray | float, d2: float, ratio: FloatArray | float) -> FloatArray:
    """Probability that F with d1 and d2 degrees of freedom exceeds a ratio; arrays broadcast."""
    one, two, F = np.broadcast_arrays(np.float64(d1), np.float64(d2), np.float64(np.maximum(ratio, 0.0)))
    return _beta_share(0.5 * two, 0.5 * one, two / (two + one * F))


def tail_of_t(freedom: float, t: float) -> float:
    """Probability that Student's t exceeds t."""
    half = 0.5 * float(tail_of_f(1.0, freedom, t * t))
    return half if t >= 0 else 1.0 - half
