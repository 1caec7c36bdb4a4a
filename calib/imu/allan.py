"""Overlapping Allan deviation of rates, with degrees of freedom that follow from a noise model.

With x the running sum of n rates y at the period tau0 (x_0 = 0) and v_k = x_(k+2m) - 2 x_(k+m) + x_k,

    avar(m tau0) = sum_k v_k^2 / (2 m^2 M),   M = n + 1 - 2 m                       (NIST SP 1065, eq. 11)

and of three kinds of noise together (IEEE Std 952-1997, annex C)

    avar(tau) = N^2 / tau + B^2 2 ln 2 / pi + K^2 tau / 3.

Each kind has a generalised autocovariance s(t) of x (Greenhall and Riley 2003), in periods

    N: -|t| / 2,   B: t^2 ln|t| / (2 pi),   K: |t|^3 / 12,

from which those of the second differences follow, R_12(d) = E[v1_i v2_(i+d)], and with them, for
Gaussian noise,

    cov(avar_1, avar_2) = sum_d count(d) R_12(d)^2 / (2 M_1 M_2 m_1^2 m_2^2),

count(d) being the number of pairs at that lag. It is a quadratic form in (N^2, B^2, K^2) whose
coefficients depend on the lengths alone (`covariance_forms`). Equivalent degrees of freedom are
2 avar^2 / var(avar). From m = 8 on the sum over d is taken in steps of m / 8.

A log in several parts gives the mean over all its second differences, none of which spans a gap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from calib.arrays import FloatArray, IntArray
from calib.errors import BadInputError
from calib.imu.kernel import sum_of_squared_differences

__all__ = [
    "KINDS",
    "ONE_SIGMA",
    "allan_variance",
    "bounds",
    "covariance_forms",
    "degrees_of_freedom",
    "design",
    "octaves",
    "spaced",
]

KINDS = ("N", "B", "K")
"""White noise, bias instability, random walk: the order of the squared coefficients everywhere."""

ONE_SIGMA = 0.6826894921370859

_FINE = 8
_FARTHEST = 1024
"""Averaging times farther apart than this factor are taken as uncorrelated."""
_TAIL = 1.0
"""How far the sum goes beyond where white noise and random walk end, in the longer averaging time."""


@dataclass(frozen=True)
class _Lags:
    """R_12 of the kinds (3, d) at lags `d` of averaging times scaled by `scale`."""

    d: FloatArray
    R: FloatArray


def octaves(n: int, share: float = 0.25) -> IntArray:
    """Averaging factors 1, 2, 4, ... up to `share` of n samples."""
    count = math.floor(math.log2(max(share * n, 1.0))) + 1
    return np.asarray(2 ** np.arange(count), dtype=np.int64)


def spaced(n: int, per_decade: int = 12, share: float = 1.0 / 3.0) -> IntArray:
    """Averaging factors at even distances on a logarithmic scale, up to `share` of n samples."""
    most = max(share * n, 1.0)
    steps = np.arange(int(per_decade * math.log10(most)) + 1)
    return np.unique(np.floor(10.0 ** (steps / per_decade) + 1e-9).astype(np.int64))


def allan_variance(parts: Sequence[FloatArray], m: IntArray) -> FloatArray:
    """Overlapping Allan variance (len(m),) of rates, in their unit squared.

    Parameters
    ----------
    parts : rates (n_i,) of each uninterrupted part, one after the other at the same period.
    m : averaging factors, tau = m tau0.

    Returns
    -------
    NaN where no part is as long as 2 m.

    Raises
    ------
    BadInputError for factors below one.
    """
    if len(m) and int(m.min()) < 1:
        raise BadInputError(f"averaging factor: found {int(m.min())}, expected 1 or more")
    total, count = np.zeros(len(m)), np.zeros(len(m))
    for part in parts:
        if len(part) < 2:
            continue
        # A constant rate changes nothing but the digits that are left for the rest.
        x = np.empty(len(part) + 1)
        x[0] = 0.0
        np.cumsum(part - part.mean(), out=x[1:])
        for j, factor in enumerate(m.tolist()):
            if 2 * factor <= len(part):
                total[j] += float(sum_of_squared_differences(x, factor))
                count[j] += len(x) - 2 * factor
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / (2.0 * count * m.astype(np.float64) ** 2))


def design(m: IntArray) -> FloatArray:
    """avar (len(m), 3) per unit of (N^2, B^2, K^2), all in periods of one sample."""
    tau = m.astype(np.float64)
    return np.stack([1.0 / tau, np.full_like(tau, 2.0 * math.log(2.0) / math.pi), tau / 3.0], axis=1)


def _generalised(t: FloatArray) -> FloatArray:
    """s(t) (3, ...) of the kinds."""
    a = np.abs(t)
    log = np.log(np.where(a > 0.0, a, 1.0))
    return np.stack([-0.5 * a, a * a * log / (2.0 * math.pi), a**3 / 12.0])


@lru_cache(maxsize=256)
def _lags(m1: float, m2: float) -> _Lags:
    """R_12 at whole lags; m1 <= m2."""
    reach = _TAIL * m2
    d = np.arange(math.floor(-2.0 * m2 - reach), math.ceil(2.0 * m1 + reach) + 1, dtype=np.float64)
    R = np.zeros((3, len(d)))
    for a, ca in enumerate((1.0, -2.0, 1.0)):
        for b, cb in enumerate((1.0, -2.0, 1.0)):
            R += ca * cb * _generalised(d + b * m2 - a * m1)
    return _Lags(d, R)


def _form(m1: int, m2: int, lengths: Sequence[int]) -> FloatArray:
    """Coefficients (3, 3) of the covariance of the variances at m1 <= m2."""
    scale = max(m1 / _FINE, 1.0)
    lags = _lags(m1 / scale, m2 / scale)
    d = lags.d * scale
    pairs, all1, all2 = np.zeros(len(d)), 0, 0
    for n in lengths:
        M1, M2 = n + 1 - 2 * m1, n + 1 - 2 * m2
        all1, all2 = all1 + max(M1, 0), all2 + max(M2, 0)
        if M1 > 0 and M2 > 0:
            pairs += np.clip(np.minimum(M1, M2 - d) - np.maximum(0.0, -d), 0.0, None)
    if not (all1 and all2):
        return np.full((3, 3), np.nan)
    # R scales with the averaging times to the power 1, 2 and 3.
    R = lags.R * (scale ** np.arange(1.0, 4.0))[:, None]
    return np.asarray(scale * (R * pairs) @ R.T / (2.0 * all1 * all2 * float(m1) ** 2 * float(m2) ** 2))


def covariance_forms(m: IntArray, lengths: Sequence[int], diagonal: bool = False) -> FloatArray:
    """G (j, j, 3, 3) with cov(avar_i, avar_j) = theta G_ij theta, theta = (N^2, B^2, K^2) in periods.

    Parameters
    ----------
    m : averaging factors.
    lengths : numbers of samples of the parts.
    diagonal : return the variances alone, (j, 3, 3).
    """
    if diagonal:
        return np.stack([_form(factor, factor, lengths) for factor in m.tolist()])
    out = np.zeros((len(m), len(m), 3, 3))
    for i, one in enumerate(m.tolist()):
        for j, other in enumerate(m.tolist()):
            if one <= other <= _FARTHEST * one:
                form = _form(one, other, lengths)
                out[i, j] = out[j, i] = 0.5 * (form + form.T)
    return out


def degrees_of_freedom(m: IntArray, lengths: Sequence[int], theta: FloatArray) -> FloatArray:
    """Equivalent degrees of freedom (len(m),) under (N^2, B^2, K^2), at least one."""
    variance = np.einsum("jpq,p,q->j", covariance_forms(m, lengths, diagonal=True), theta, theta)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.maximum(2.0 * (design(m) @ theta) ** 2 / variance, 1.0))


def bounds(
    variance: FloatArray, freedom: FloatArray, confidence: float = ONE_SIGMA
) -> tuple[FloatArray, FloatArray]:
    """Lower and upper bound of the deviation, by the chi-square distribution of its square."""
    tail = 0.5 * (1.0 - confidence)
    upper, lower = chdtri(freedom, 1.0 - tail), chdtri(freedom, tail)
    return np.sqrt(variance * freedom / lower), np.sqrt(variance * freedom / upper)
