"""White noise N, bias instability B and random walk K fitted to Allan variances.

The squares theta = (N^2, B^2, K^2) enter the variances linearly (`calib.imu.allan`), with a covariance
that depends on theta itself. So weighted least squares are repeated with the covariance of the last
estimate, over averaging times in octaves up to a quarter of the log. What has to be explained:

- which terms there are. White noise is always there. B and K are added one at a time, the one with the
  larger z = theta / sigma first, and only where z exceeds `LEAST_Z` with the covariance that holds
  without the term. Otherwise the log is too short to support it, and it gets an upper bound;
- where the fit begins. Filters in the sensor and coarse steps change the variance at the shortest times.
  While the fit is worse than chance would have it once in ten thousand, the shortest time is left out.

Intervals are those of log theta, which keeps them positive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.errors import BadInputError
from calib.imu.allan import (
    KINDS,
    allan_variance,
    bounds,
    covariance_forms,
    degrees_of_freedom,
    design,
    octaves,
    spaced,
)

__all__ = ["LEAST_SAMPLES", "LEAST_Z", "Allan", "Term", "analyse", "model_variance"]

LEAST_Z = 3.0
LEAST_SAMPLES = 64
_ONE_SIDED_95 = 1.6448536269514722
_TWO_SIDED_95 = 1.959963984540054
_WORST_CHANCE = 1e-4
_FEWEST = 4
_SHORTEST_S = 1.0
"""The fit begins no later than here, so that what it calls white noise is noise of at least 1 Hz."""


@dataclass(frozen=True)
class Term:
    """A coefficient of the noise model, in the unit of its kind.

    Attributes
    ----------
    supported : whether the log shows it.
    value, sigma, low, high : estimate, standard deviation and 95 % interval; NaN where not supported.
    below : 95 % upper bound where not supported, otherwise NaN.
    """

    supported: bool
    value: float
    sigma: float
    low: float
    high: float
    below: float


@dataclass(frozen=True)
class Allan:
    """Allan deviation of one axis and what explains it.

    Attributes
    ----------
    tau_s, deviation, low, high, freedom : (j,) averaging times, deviation, 1-sigma bounds, degrees of
        freedom.
    N, B, K : coefficients in unit/sqrt(Hz), unit, unit sqrt(Hz); 1/sqrt(Hz) is sqrt(s).
    theta : (3,) squares of the supported ones, zero for the others.
    walk_within : K^2 that the log cannot exclude, one sigma above its estimate, or K^2 if supported.
    fit_s : shortest and longest averaging time of the fit.
    chance : probability of residuals at least as large, were the model right.
    """

    tau_s: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    freedom: FloatArray
    N: Term
    B: Term
    K: Term
    theta: FloatArray
    walk_within: float
    fit_s: tuple[float, float]
    chance: float


@dataclass(frozen=True)
class _Fit:
    theta: FloatArray
    covariance: FloatArray
    active: BoolArray
    chance: float


def model_variance(theta: FloatArray, tau_s: FloatArray) -> FloatArray:
    """Contributions (j, 3) of N, B and K to avar(tau)."""
    return np.asarray(
        np.stack([1.0 / tau_s, np.full_like(tau_s, 2.0 * math.log(2.0) / math.pi), tau_s / 3.0], axis=1)
        * theta
    )


def _least_squares(
    variance: FloatArray, D: FloatArray, C: FloatArray, active: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """theta (3,) and its covariance (3, 3), zero for inactive terms."""
    # Variances span decades; relative ones keep the matrix well conditioned.
    size = np.sqrt(np.diag(C))
    L = np.linalg.cholesky(C / np.outer(size, size) + 1e-9 * np.eye(len(size)))
    W = np.linalg.solve(L, D[:, active] / size[:, None])
    scale = np.linalg.norm(W, axis=0)
    inverse = np.linalg.inv((W / scale).T @ (W / scale)) / np.outer(scale, scale)
    theta, covariance = np.zeros(3), np.zeros((3, 3))
    theta[active] = inverse @ (W.T @ np.linalg.solve(L, variance / size))
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
    size = np.sqrt(np.diag(C))
    residual = (variance - D @ theta) / size
    chi2 = float(residual @ np.linalg.solve(C / np.outer(size, size) + 1e-9 * np.eye(len(size)), residual))
    return float(chdtrc(max(len(variance) - terms, 1), chi2))


def _select(variance: FloatArray, m: IntArray, G: FloatArray) -> _Fit:
    """The fit with the terms that the variances support."""
    D = design(m)
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


def _term(fit: _Fit, k: int, variance: FloatArray, D: FloatArray, G: FloatArray, unit: float) -> Term:
    square, nan = float(fit.theta[k]), math.nan
    if fit.active[k] and square > 0.0:
        spread = math.sqrt(float(fit.covariance[k, k]))
        value = math.sqrt(square)
        sigma, factor = 0.5 * spread / value, math.exp(0.5 * _TWO_SIDED_95 * spread / square)
        value *= unit
        return Term(True, value, unit * sigma, value / factor, value * factor, nan)
    below = _unsupported(fit, k, variance, D, G, _ONE_SIDED_95)
    return Term(False, nan, nan, nan, nan, unit * math.sqrt(below))


def _unsupported(
    fit: _Fit, k: int, variance: FloatArray, D: FloatArray, G: FloatArray, times_sigma: float
) -> float:
    """Upper bound of the square of a term that was not taken up.

    B and K are hard to tell apart, so the bound is the larger one of those with the other and without.
    """
    C = _covariance(G, fit.theta)
    found = []
    for others in (fit.active, np.array([True, False, False])):
        wider = others.copy()
        wider[k] = True
        estimate, covariance = _least_squares(variance, D, C, wider)
        found.append(max(float(estimate[k]), 0.0) + times_sigma * math.sqrt(float(covariance[k, k])))
    return max(found)


def analyse(parts: Sequence[FloatArray], period_s: float) -> Allan:
    """Allan deviation of one axis, and N, B, K where the log supports them.

    Parameters
    ----------
    parts : readings (n_i,) of uninterrupted parts.
    period_s : tau0.

    Raises
    ------
    BadInputError for a longest part of less than `LEAST_SAMPLES`, and for readings that never change.
    """
    lengths = [len(part) for part in parts]
    longest = max(lengths, default=0)
    if longest < LEAST_SAMPLES:
        raise BadInputError(f"readings: found {longest} in a row, expected at least {LEAST_SAMPLES}")
    m_fit, m_all = octaves(longest), spaced(longest)
    variance = allan_variance(parts, m_fit)
    if not bool(np.all(variance > 0.0)):
        raise BadInputError("readings: never change, expected noise")
    G = covariance_forms(m_fit, lengths)
    least = min(len(m_fit) - _FEWEST, max(0, math.floor(math.log2(max(_SHORTEST_S / period_s, 1.0)))))
    first, fit = 0, _select(variance, m_fit, G)
    for skipped in range(1, least + 1):
        if fit.chance > _WORST_CHANCE:
            break
        first, fit = skipped, _select(variance[skipped:], m_fit[skipped:], G[skipped:, skipped:])
    used = (variance[first:], design(m_fit[first:]), G[first:, first:])
    root = math.sqrt(period_s)
    units = (root, 1.0, 1.0 / root)
    terms = [_term(fit, k, *used, units[k]) for k in range(len(KINDS))]
    walk = float(fit.theta[2])
    if not terms[2].supported:
        walk = _unsupported(fit, 2, *used, 1.0)
    everywhere = allan_variance(parts, m_all)
    freedom = degrees_of_freedom(m_all, lengths, fit.theta)
    low, high = bounds(everywhere, freedom)
    return Allan(
        tau_s=period_s * m_all.astype(np.float64),
        deviation=np.sqrt(everywhere),
        low=low,
        high=high,
        freedom=freedom,
        N=terms[0],
        B=terms[1],
        K=terms[2],
        theta=fit.theta * np.array(units) ** 2,
        walk_within=walk / period_s,
        fit_s=(period_s * float(m_fit[first]), period_s * float(m_fit[-1])),
        chance=fit.chance,
    )
