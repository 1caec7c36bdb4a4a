"""What is said of the error of an angle: its slope with an interval, its lag, its Allan deviation.

**Slope.** An ordinary straight line with one slope and an offset for each stretch. The error of an angle
is no white noise: an integrated rate walks at random, a filter forgets slowly. So the stretches are cut
into about 128 blocks, and the blocks' means r about the line are taken for white noise on a process of
order one, whose limit is the random walk,

    cov(r_i, r_j) = s^2 ((1 - a) [i = j] + a (1 - rho^2) rho^|i-j|),

the second term being the covariance of the means of a walk for rho = 1 (min(i, j) would be that of single
samples, whose steps are larger by the root of 3 / 2).

Every pair of a grid of (rho, a) is given its restricted likelihood (Patterson and Thompson, Biometrika
58, 1971), which does not take what the line has fitted for evidence of calm, with the s^2 that suits it
best, and its variance of the slope, w' cov w for the weights w of the line. Where the log does not decide
between pairs, the most doubtful counts: the largest deviation among those whose log-likelihood is within
`_SUPPORT` of the highest. The interval is Student's for the number of blocks.

A slope that itself wanders, as that of a gyroscope's bias does, has no interval from one log: the spread
over several logs shows it.

**Lag.** Both angles are freed from what is slower than some seconds, the estimate is moved against the
truth by whole samples, and a parabola through the highest correlation and its neighbours gives the
fraction. Drift and offsets so play no part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import uniform_filter1d
from scipy.special import stdtrit

from calib.arrays import FloatArray
from calib.imu.allan import allan_variance

__all__ = ["Slope", "allan_at", "lag_s", "slope_of"]

_BLOCKS = 128
_FEWEST_BLOCKS = 8
_RHO = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
_SHARE = (0.02, 0.1, 0.3, 0.6, 0.9, 1.0)
_SUPPORT = 1.0
_SLOW_S = 4.0
_FARTHEST_S = 0.5
_LEAST_CORRELATION = 0.5


@dataclass(frozen=True)
class Slope:
    """Slope [rad/s], its standard deviation and its 95 % interval; NaN where it cannot be told.

    `rho` is the coefficient from block to block that the deviation rests on, `block_s` their length.
    """

    value: float
    sigma: float
    low: float
    high: float
    rho: float
    block_s: float


def _line(stretches: Sequence[FloatArray]) -> float:
    """Slope per sample with one offset for each stretch."""
    top, below = 0.0, 0.0
    for y in stretches:
        k = np.arange(len(y), dtype=np.float64)
        k -= k.mean()
        top += float(k @ y)
        below += float(k @ k)
    return top / below if below > 0.0 else math.nan


@lru_cache(maxsize=512)
def _covariance(count: int, size: int, rho: float, share: float) -> FloatArray:
    """Covariance of the means of `count` blocks of `size` samples for s^2 = 1."""
    k = np.arange(count)
    if rho >= 1.0:
        # A walk of variance 1 / size per sample, averaged within each block.
        slow = np.minimum.outer(k, k) + (size + 1.0) / (2.0 * size)
        slow[k, k] = k + (size + 1.0) * (2.0 * size + 1.0) / (6.0 * size * size)
    else:
        slow = (1.0 - rho * rho) * rho ** np.abs(np.subtract.outer(k, k)).astype(np.float64)
    return np.asarray((1.0 - share) * np.eye(count) + share * slow)


def _judged(means: Sequence[FloatArray], size: int, rho: float, share: float) -> tuple[float, float]:
    """Restricted log-likelihood, and variance of the slope per block."""
    J, below = (
        sum(len(mean) for mean in means),
        sum(len(mean) * (len(mean) ** 2 - 1) / 12.0 for mean in means),
    )
    logs, weight = 0.0, 0.0
    tt, ty, yy = 0.0, 0.0, 0.0
    for mean in means:
        k = np.arange(len(mean), dtype=np.float64)
        k -= k.mean()
        G = _covariance(len(mean), size, rho, share)
        L = np.linalg.cholesky(G)
        one, t, y = solve_triangular(L, np.stack([np.ones_like(k), k, mean], axis=1), lower=True).T
        logs += 2.0 * float(np.log(np.diag(L)).sum()) + math.log(float(one @ one))
        # Each stretch's own offset goes out first.
        t, y = t - one * (one @ t) / (one @ one), y - one * (one @ y) / (one @ one)
        tt, ty, yy = tt + float(t @ t), ty + float(t @ y), yy + float(y @ y)
        weight += float(k @ G @ k) / below**2
    free = J - len(means) - 1
    scale = max(yy - ty * ty / tt, 0.0) / free
    if scale <= 0.0:
        return math.inf, 0.0
    return -0.5 * (logs + math.log(tt) + free * math.log(scale)), scale * weight


def slope_of(stretches: Sequence[FloatArray], period_s: float) -> Slope:
    """Common slope of the stretches (n_i,) [rad] at one period, each with an offset of its own.

    NaN without two samples in a stretch; without an interval where they give too few blocks.
    """
    nan = math.nan
    long = [y for y in stretches if len(y) >= 2]
    if not long:
        return Slope(nan, nan, nan, nan, nan, nan)
    value = _line(long) / period_s
    size = max(sum(len(y) for y in long) // _BLOCKS, 1)
    means = [y[: len(y) // size * size].reshape(-1, size).mean(axis=1) for y in long if len(y) >= 2 * size]
    free = sum(len(mean) for mean in means) - len(means) - 1
    if free < _FEWEST_BLOCKS:
        return Slope(value, nan, nan, nan, nan, nan)
    means = [mean - mean.mean() for mean in means]
    pairs = [(rho, share) for rho in _RHO for share in (_SHARE if rho > 0.0 else _SHARE[:1])]
    judged = [(*_judged(means, size, rho, share), rho) for rho, share in pairs]
    most = max(likely for likely, _, _ in judged)
    variance, rho = max((v, rho) for likely, v, rho in judged if likely >= most - _SUPPORT)
    block_s = size * period_s
    sigma = math.sqrt(variance) / block_s
    half = float(stdtrit(free, 0.975)) * sigma
    return Slope(value, sigma, value - half, value + half, rho, block_s)


def allan_at(stretches: Sequence[FloatArray], period_s: float, tau_s: float) -> float:
    """Overlapping Allan deviation of the angles [rad] averaged over tau; NaN where all are too short."""
    m = np.array([max(round(tau_s / period_s), 1)], dtype=np.int64)
    if not any(len(y) >= 2 * int(m[0]) for y in stretches):
        return math.nan
    return math.sqrt(float(allan_variance(list(stretches), m)[0]))


def _quick(y: FloatArray, period_s: float) -> FloatArray:
    """What is faster than some seconds."""
    size = min(max(round(_SLOW_S / period_s), 3), len(y))
    return np.asarray(y - uniform_filter1d(y, size, mode="nearest"))


def lag_s(
    estimate: Sequence[FloatArray],
    truth: Sequence[FloatArray],
    period_s: float,
    farthest_s: float = _FARTHEST_S,
) -> float:
    """How much later [s] the estimate comes than the truth; negative where it is ahead.

    Parameters
    ----------
    estimate, truth : pairs of stretches (n_i,) at one period.
    farthest_s : lags that are tried, on both sides.

    Returns
    -------
    NaN where the two hardly resemble each other, or are most alike at the end of what was tried.
    """
    M = max(round(farthest_s / period_s), 2)
    lags = np.arange(-M, M + 1)
    both, own, theirs = np.zeros(len(lags)), np.zeros(len(lags)), 0.0
    for e, t in zip(estimate, truth, strict=True):
        n = len(t)
        if n < 4 * M:
            continue
        quick_e, quick_t = _quick(e, period_s), _quick(t, period_s)[M : n - M]
        theirs += float(quick_t @ quick_t)
        for i, lag in enumerate(lags.tolist()):
            moved = quick_e[M + lag : n - M + lag]
            both[i] += float(moved @ quick_t)
            own[i] += float(moved @ moved)
    if not (theirs > 0.0 and own.min() > 0.0):
        return math.nan
    c = both / np.sqrt(own * theirs)
    i = int(np.argmax(c))
    if i in (0, len(c) - 1) or c[i] < _LEAST_CORRELATION:
        return math.nan
    bend = c[i - 1] - 2.0 * c[i] + c[i + 1]
    fraction = 0.5 * (c[i - 1] - c[i + 1]) / bend if bend < 0.0 else 0.0
    return float((lags[i] + fraction) * period_s)
