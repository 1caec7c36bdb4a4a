"""Allan deviation and the noise that explains it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc, chdtri

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError


# Additions may be taken in any order, so that several are done at once.
@kernel(reordered=True)
def _squares(x: FloatArray, m: int) -> float:
    """Sum of (x_(k+2m) - 2 x_(k+m) + x_k)^2 over x (n,), zero where n <= 2 m."""
    total = 0.0
    for k in range(len(x) - 2 * m):
        v = x[k + 2 * m] - 2.0 * x[k + m] + x[k]
        total += v * v
    return total


# ----------------------------------------------------------------------
# Overlapping Allan deviation of rates, with degrees of freedom that follow from a noise model.
#
# With x the running sum of n rates y at the period tau0 (x_0 = 0) and v_k = x_(k+2m) - 2 x_(k+m) + x_k,
#
#     avar(m tau0) = sum_k v_k^2 / (2 m^2 M),   M = n + 1 - 2 m                       (NIST SP 1065, eq. 11)
#
# and of three kinds of noise together (IEEE Std 952-1997, annex C)
#
#     avar(tau) = N^2 / tau + B^2 2 ln 2 / pi + K^2 tau / 3.
#
# Each kind has a generalised autocovariance s(t) of x (Greenhall and Riley 2003), in periods
#
#     N: -|t| / 2,   B: t^2 ln|t| / (2 pi),   K: |t|^3 / 12,
#
# from which those of the second differences follow, R_12(d) = E[v1_i v2_(i+d)], and with them, for
# Gaussian noise,
#
#     cov(avar_1, avar_2) = sum_d count(d) R_12(d)^2 / (2 M_1 M_2 m_1^2 m_2^2),
#
# count(d) being the number of pairs at that lag. It is a quadratic form in (N^2, B^2, K^2) whose
# coefficients depend on the lengths alone (`covariance_forms`). Equivalent degrees of freedom are
# 2 avar^2 / var(avar). From m = 8 on the sum over d is taken in steps of m / 8.
#
# A log in several parts gives the mean over all its second differences, none of which spans a gap.

KINDS = ("N", "B", "K")
"""White noise, bias instability, random walk: the order of the squared coefficients everywhere."""

_ONE_SIGMA_TAIL = 0.15865525393145705
"""Chance of more than one standard deviation of a normal distribution, on one side."""
_FINE = 8
_FARTHEST = 1024
"""Averaging times farther apart than this factor are taken as uncorrelated."""
_TAIL = 1.0
"""How far the sum goes beyond where white noise and random walk end, in the longer averaging time."""


def octaves(n: int) -> IntArray:
    """Averaging factors 1, 2, 4, ... up to a quarter of n samples."""
    count = math.floor(math.log2(max(0.25 * n, 1.0))) + 1
    return np.asarray(2 ** np.arange(count), dtype=np.int64)


def spaced(n: int) -> IntArray:
    """Averaging factors, twelve in a decade, up to a third of n samples."""
    steps = np.arange(int(12 * math.log10(max(n / 3.0, 1.0))) + 1)
    return np.unique(np.floor(10.0 ** (steps / 12) + 1e-9).astype(np.int64))


def allan_variance(parts: Sequence[FloatArray], m: IntArray) -> FloatArray:
    """Overlapping Allan variance (len(m),) of rates, in their unit squared.

    Parameters
    ----------
    parts : rates (n_i,) of each uninterrupted part, one after the other at the same period.
    m : averaging factors, tau = m tau0.

    Returns
    -------
    NaN where no part is as long as 2 m.
    """
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
                total[j] += float(_squares(x, factor))
                count[j] += len(x) - 2 * factor
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / (2.0 * count * m.astype(np.float64) ** 2))


def design(tau: FloatArray) -> FloatArray:
    """avar (len(tau), 3) per unit of (N^2, B^2, K^2)."""
    return np.stack([1.0 / tau, np.full_like(tau, 2.0 * math.log(2.0) / math.pi), tau / 3.0], axis=1)


def _generalised(t: FloatArray) -> FloatArray:
    """s(t) (3, ...) of the kinds."""
    a = np.abs(t)
    log = np.log(np.where(a > 0.0, a, 1.0))
    return np.stack([-0.5 * a, a * a * log / (2.0 * math.pi), a**3 / 12.0])


@lru_cache(maxsize=256)
def _lags(m1: float, m2: float) -> tuple[FloatArray, FloatArray]:
    """Whole lags and R_12 (3, lags) of the kinds there; m1 <= m2, in steps of the sum over lags."""
    reach = _TAIL * m2
    d = np.arange(math.floor(-2.0 * m2 - reach), math.ceil(2.0 * m1 + reach) + 1, dtype=np.float64)
    R = np.zeros((3, len(d)))
    for a, ca in enumerate((1.0, -2.0, 1.0)):
        for b, cb in enumerate((1.0, -2.0, 1.0)):
            R += ca * cb * _generalised(d + b * m2 - a * m1)
    return d, R


def _form(m1: int, m2: int, lengths: Sequence[int]) -> FloatArray:
    """Coefficients (3, 3) of the covariance of the variances at m1 <= m2."""
    scale = max(m1 / _FINE, 1.0)
    d, R = _lags(m1 / scale, m2 / scale)
    d = d * scale
    pairs, all1, all2 = np.zeros(len(d)), 0, 0
    for n in lengths:
        M1, M2 = n + 1 - 2 * m1, n + 1 - 2 * m2
        all1, all2 = all1 + max(M1, 0), all2 + max(M2, 0)
        if M1 > 0 and M2 > 0:
            pairs += np.clip(np.minimum(M1, M2 - d) - np.maximum(0.0, -d), 0.0, None)
    if not (all1 and all2):
        return np.full((3, 3), np.nan)
    # R scales with the averaging times to the power 1, 2 and 3.
    R = R * (scale ** np.arange(1.0, 4.0))[:, None]
    return np.asarray(scale * (R * pairs) @ R.T / (2.0 * all1 * all2 * float(m1) ** 2 * float(m2) ** 2))


def covariance_forms(m: IntArray, lengths: Sequence[int]) -> FloatArray:
    """G (j, j, 3, 3) with cov(avar_i, avar_j) = theta G_ij theta, theta = (N^2, B^2, K^2) in periods.

    Parameters
    ----------
    m : averaging factors.
    lengths : numbers of samples of the parts.
    """
    out = np.zeros((len(m), len(m), 3, 3))
    for i, one in enumerate(m.tolist()):
        for j, other in enumerate(m.tolist()):
            if one <= other <= _FARTHEST * one:
                form = _form(one, other, lengths)
                out[i, j] = out[j, i] = 0.5 * (form + form.T)
    return out


def degrees_of_freedom(m: IntArray, lengths: Sequence[int], theta: FloatArray) -> FloatArray:
    """Equivalent degrees of freedom (len(m),) under (N^2, B^2, K^2), at least one."""
    variance = np.array([theta @ _form(factor, factor, lengths) @ theta for factor in m.tolist()])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.maximum(2.0 * (design(m.astype(np.float64)) @ theta) ** 2 / variance, 1.0))


def bounds(variance: FloatArray, freedom: FloatArray) -> tuple[FloatArray, FloatArray]:
    """1-sigma bounds of the deviation, by the chi-square distribution of its square."""
    upper, lower = chdtri(freedom, 1.0 - _ONE_SIGMA_TAIL), chdtri(freedom, _ONE_SIGMA_TAIL)
    return np.sqrt(variance * freedom / lower), np.sqrt(variance * freedom / upper)


# ----------------------------------------------------------------------
# White noise N, bias instability B and random walk K fitted to Allan variances.
#
# The squares theta = (N^2, B^2, K^2) enter the variances linearly, with a covariance that depends on theta
# itself. So weighted least squares are repeated with the covariance of the last estimate, over averaging
# times in octaves up to a quarter of the log. What has to be explained:
#
# - which terms there are. White noise is always there. B and K are added one at a time, the one with the
#   larger z = theta / sigma first, and only where z exceeds `LEAST_Z` with the covariance that holds
#   without the term. These fewest terms explain the variances, and N is theirs;
# - whether what is slow is B or K. One that is fitted without the other takes up what is of that: K came out
#   up to hundreds of times too large. So the log shows one of them where its z beside both other terms
#   exceeds `LEAST_Z`, and gives the value and the deviation of all three. Otherwise it is too short to tell,
#   and bounds the one by what it is where the other is not there;
# - where the fit begins. Filters in the sensor and coarse steps change the variance at the shortest times.
#   While the fit is worse than chance would have it once in ten thousand, the shortest time is left out, and
#   then two octaves more: what is too little to be seen of noise that a filter has coloured shifted N by 4 to
#   6 of its deviations, and by one or less without these. Where no start is good the fit has all times.

LEAST_Z = 3.0
LEAST_SAMPLES = 64
_ONE_SIDED_95 = 1.6448536269514722
_WORST_CHANCE = 1e-4
_MARGIN = 2
_FEWEST = 4
_SHORTEST_S = 1.5
"""The first time that fits is no later than here: what is called white is noise of about 1 Hz or more."""


@dataclass(frozen=True)
class Term:
    """A coefficient of the noise model, in the unit of its kind.

    Attributes
    ----------
    supported : whether the log shows it.
    value, sigma : estimate and standard deviation, NaN where not supported.
    below : 95 % upper bound where not supported, otherwise NaN.
    """

    supported: bool
    value: float
    sigma: float
    below: float


@dataclass(frozen=True)
class Allan:
    """Allan deviation of one axis and what explains it.

    Attributes
    ----------
    tau_s, deviation, low, high : (j,) averaging times, deviation, 1-sigma bounds.
    N, B, K : coefficients in unit/sqrt(Hz), unit, unit sqrt(Hz); 1/sqrt(Hz) is sqrt(s).
    theta : (3,) squares of the fewest that explain the deviation, zero for the others.
    walk_within : K^2 of theta, or, where it has none, one sigma above what the log allows.
    fit_s : shortest and longest averaging time of the fit.
    chance : probability of residuals at least as large, were the model right.
    """

    tau_s: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    N: Term
    B: Term
    K: Term
    theta: FloatArray
    walk_within: float
    fit_s: tuple[float, float]
    chance: float

    @property
    def told_apart(self) -> bool:
        """Whether what is slow in the noise, if anything is, is known to be B or K."""
        return (self.B.supported or not self.theta[1]) and (self.K.supported or not self.theta[2])


@dataclass(frozen=True)
class _Fit:
    theta: FloatArray
    covariance: FloatArray
    active: BoolArray
    chance: float


def model_variance(theta: FloatArray, tau_s: FloatArray) -> FloatArray:
    """Contributions (j, 3) of N, B and K to avar(tau)."""
    return design(tau_s) * theta


def _whitened(C: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns (j, ...) whose errors have the covariance C, turned and scaled so that theirs is one."""
    # Variances span decades; relative ones keep the matrix well conditioned.
    size = np.sqrt(np.diag(C))
    values, V = np.linalg.eigh(C / np.outer(size, size))
    # Sums over lags that end somewhere leave eigenvalues below zero where a walk ties all times together.
    least = max(1e-9, -float(values[0]))
    return np.asarray(((V.T @ (columns.T / size).T).T / np.sqrt(np.maximum(values, least))).T)


def _least_squares(
    variance: FloatArray, D: FloatArray, C: FloatArray, active: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """theta (3,) and its covariance (3, 3), zero for inactive terms."""
    white = _whitened(C, np.column_stack([D[:, active], variance]))
    W = white[:, :-1]
    scale = np.linalg.norm(W, axis=0)
    inverse = np.linalg.inv((W / scale).T @ (W / scale)) / np.outer(scale, scale)
    theta, covariance = np.zeros(3), np.zeros((3, 3))
    theta[active] = inverse @ (W.T @ white[:, -1])
    covariance[np.ix_(active, active)] = inverse
    return theta, covariance


def _covariance(G: FloatArray, theta: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ijpq,p,q->ij", G, theta, theta))


def _settle(
    variance: FloatArray, D: FloatArray, G: FloatArray, active: BoolArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """theta, its covariance and that of the variances, repeated until theta stays."""
    theta = start
    for _ in range(40):
        C = _covariance(G, theta)
        new, covariance = _least_squares(variance, D, C, active)
        # A square is not negative, and without white noise short times would have no variance.
        new = np.where(active, np.maximum(new, np.where([True, False, False], 0.01 * variance[0], 0.0)), 0.0)
        moved = float(np.max(np.abs(new - theta) * D.max(axis=0) / variance.max()))
        theta = 0.5 * (theta + new) if moved > 0.5 else new
        if moved < 1e-10:
            break
    return theta, covariance, _covariance(G, theta)


def _chance(variance: FloatArray, D: FloatArray, C: FloatArray, theta: FloatArray, terms: int) -> float:
    chi2 = float((_whitened(C, variance - D @ theta) ** 2).sum())
    return float(chdtrc(max(len(variance) - terms, 1), chi2))


def _select(variance: FloatArray, m: IntArray, G: FloatArray) -> _Fit:
    """The fit with the terms that the variances support."""
    D = design(m.astype(np.float64))
    active = np.array([True, False, False])
    theta = np.array([float(variance[0] * m[0]), 0.0, 0.0])
    theta, covariance, C = _settle(variance, D, G, active, theta)
    while not active.all():
        best, best_z = -1, LEAST_Z
        for k in np.flatnonzero(~active).tolist():
            wider = active.copy()
            wider[k] = True
            estimate, spread = _least_squares(variance, D, C, wider)
            z = float(estimate[k] / math.sqrt(spread[k, k]))
            if z > best_z:
                best, best_z = k, z
        if best < 0:
            break
        active[best] = True
        theta, covariance, C = _settle(variance, D, G, active, theta)
    return _Fit(theta, covariance, active, _chance(variance, D, C, theta, int(active.sum())))


def _shown(theta: FloatArray, covariance: FloatArray, k: int, unit: float) -> Term:
    value = math.sqrt(float(theta[k]))
    return Term(True, unit * value, unit * 0.5 * math.sqrt(float(covariance[k, k])) / value, math.nan)


_ALL = np.full(3, True)


def _slow_term(fit: _Fit, k: int, variance: FloatArray, D: FloatArray, G: FloatArray, unit: float) -> Term:
    """B or K, by its number."""
    without, alone = _ALL.copy(), _ALL.copy()
    without[k] = alone[3 - k] = False
    C = _settle(variance, D, G, without, np.where(without, fit.theta, 0.0))[2]
    estimate, spread = _least_squares(variance, D, C, _ALL)
    theta, covariance, _ = _settle(variance, D, G, _ALL, fit.theta)
    if theta[k] > 0.0 and float(estimate[k]) > LEAST_Z * math.sqrt(float(spread[k, k])):
        return _shown(theta, covariance, k, unit)
    theta, covariance, _ = _settle(variance, D, G, alone, np.where(alone, fit.theta, 0.0))
    most = float(theta[k]) + _ONE_SIDED_95 * math.sqrt(float(covariance[k, k]))
    return Term(False, math.nan, math.nan, unit * math.sqrt(most))


def _walk_within(fit: _Fit, variance: FloatArray, D: FloatArray, G: FloatArray) -> float:
    """K^2 one sigma above its estimate, the larger one of those with B and without."""
    C = _covariance(G, fit.theta)
    found = []
    for others in (fit.active, np.array([True, False, False])):
        estimate, covariance = _least_squares(variance, D, C, others | np.array([False, False, True]))
        found.append(max(float(estimate[2]), 0.0) + math.sqrt(float(covariance[2, 2])))
    return max(found)


def analyse(parts: Sequence[FloatArray], period_s: float) -> Allan:
    """Allan deviation of one axis, and N, B, K where the log supports them.

    Parameters
    ----------
    parts : readings (n_i,) of uninterrupted parts, the longest of at least `LEAST_SAMPLES`.
    period_s : tau0.

    Raises `BadInputError` for readings that never change.
    """
    lengths = [len(part) for part in parts]
    m_fit, m_all = octaves(max(lengths)), spaced(max(lengths))
    variance = allan_variance(parts, m_fit)
    if not bool(np.all(variance > 0.0)):
        raise BadInputError("readings: never change, expected noise")
    G = covariance_forms(m_fit, lengths)
    least = min(len(m_fit) - _FEWEST, max(0, math.floor(math.log2(max(_SHORTEST_S / period_s, 1.0)))))

    def since(k: int) -> _Fit:
        return _select(variance[k:], m_fit[k:], G[k:, k:])

    first, fit = 0, since(0)
    if fit.chance <= _WORST_CHANCE:
        start = next((k for k in range(1, least + 1) if since(k).chance > _WORST_CHANCE), 0)
        # Short times that the model explains by themselves are not what is unlike it.
        if (
            start + 1 >= _FEWEST
            and _select(variance[: start + 1], m_fit[: start + 1], G[: start + 1, : start + 1]).chance
            > _WORST_CHANCE
        ):
            start = 0
        # Where none fits it is not the short times that are unlike the model.
        first = max(start, min(start + _MARGIN, len(m_fit) - _FEWEST)) if start else 0
        fit = since(first)
    used = (variance[first:], design(m_fit[first:].astype(np.float64)), G[first:, first:])
    root = math.sqrt(period_s)
    units = (root, 1.0, 1.0 / root)
    terms = [_shown(fit.theta, fit.covariance, 0, units[0])]
    terms += [_slow_term(fit, k, *used, units[k]) for k in (1, 2)]
    walk = float(fit.theta[2]) or _walk_within(fit, *used)
    everywhere = allan_variance(parts, m_all)
    low, high = bounds(everywhere, degrees_of_freedom(m_all, lengths, fit.theta))
    return Allan(
        tau_s=period_s * m_all.astype(np.float64),
        deviation=np.sqrt(everywhere),
        low=low,
        high=high,
        **dict(zip(KINDS, terms, strict=True)),
        theta=fit.theta * np.array(units) ** 2,
        walk_within=walk / period_s,
        fit_s=(period_s * float(m_fit[first]), period_s * float(m_fit[-1])),
        chance=fit.chance,
    )
