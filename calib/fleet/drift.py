"""Whether a constant drifts over the serial numbers of a fleet: a robust straight line with its sigma.

x_i = a + b t_i + noise, with Huber's estimate: residuals beyond 1.345 standard deviations count as such of
that size, so that rigs that stand out do not turn the line. With the residuals r_i over their own scales
c_i = sqrt(tau^2 + sigma_i^2), psi Huber's function and psi' its derivative, the covariance of (a, b) is

    s^2 K^2 [n / (n - 2) mean(psi^2) / mean(psi')^2] (X' X)^-1,    K = 1 + 2 / n (1 - mean(psi')) / mean(psi')

with X the rows (1, t_i) / c_i (Huber and Ronchetti 2009, eqs. 7.83 and 7.84).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.fleet.spread import FEWEST, Spread

__all__ = ["Drift", "drift_limit", "drift_of"]

_HUBER = 1.345
_STEPS = 200
_CHANCE = 0.05
_TO_SIGMA = 1.482602218505602


@dataclass(frozen=True)
class Drift:
    """A line over the serial numbers.

    Attributes
    ----------
    slope, sigma : change of the constant per number. at_middle, middle : value there. count : rigs.
    """

    slope: float
    sigma: float
    at_middle: float
    middle: float
    count: int

    @property
    def z(self) -> float:
        """Slope over its standard deviation; 0 without one."""
        return self.slope / self.sigma if self.sigma > 0.0 else 0.0


def drift_of(serial: FloatArray, x: FloatArray, sigma: FloatArray, spread: Spread) -> Drift | None:
    """The line through values (n,) with standard deviations (n,) over numbers (n,), NaN where not known.

    None with too few rigs, or where serial numbers or values do not differ.
    """
    known = np.isfinite(serial) & np.isfinite(x)
    t, x, own = serial[known], x[known], np.nan_to_num(sigma[known])
    if len(x) < FEWEST or np.ptp(t) <= 0.0 or np.ptp(x) <= 0.0:
        return None
    middle = float(np.median(t))
    c = np.sqrt(spread.between**2 + own**2)
    usual = spread.scale if spread.scale > 0.0 else float(np.ptp(x))
    c = np.where(c > 1e-6 * usual, c, usual)
    # Numbers and values of order one: the sums keep their digits.
    reach = float(np.abs(t - middle).max())
    X = np.stack([np.ones_like(t), (t - middle) / reach], axis=1) / c[:, None]
    y = (x - spread.median) / c
    theta: FloatArray = np.zeros(2)
    s = _scale(y)
    for _ in range(_STEPS):
        r = y - X @ theta
        s = _scale(r)
        if s <= 0.0:
            break
        w = np.minimum(1.0, _HUBER * s / np.maximum(np.abs(r), 1e-300))
        new: FloatArray = np.asarray(
            np.linalg.lstsq(X * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0], dtype=np.float64
        )
        moved = float(np.abs((new - theta) * X.mean(axis=0)).max() / s)
        theta = new
        if moved < 1e-9:
            break
    covariance = _covariance(X, y - X @ theta, s)
    if covariance is None:
        return None
    return Drift(
        float(theta[1]) / reach,
        math.sqrt(covariance[1, 1]) / reach,
        float(theta[0]) + spread.median,
        middle,
        len(x),
    )


def _scale(r: FloatArray) -> float:
    """Robust standard deviation of residuals about zero; two of them are spent on the line."""
    ordered = np.sort(np.abs(r))
    return _TO_SIGMA * float(np.median(ordered[2:] if len(ordered) > 4 else ordered))


def _covariance(X: FloatArray, r: FloatArray, s: float) -> FloatArray | None:
    n = len(r)
    information = X.T @ X
    if s <= 0.0 or np.linalg.cond(information) > 1e12:
        return None
    u = r / s
    psi, slope = np.clip(u, -_HUBER, _HUBER), (np.abs(u) <= _HUBER).mean()
    if slope <= 0.0:
        return None
    K = 1.0 + 2.0 / n * (1.0 - slope) / slope
    variance = (s * K) ** 2 * (n / (n - 2) * float((psi**2).mean())) / slope**2
    return np.asarray(variance * np.linalg.inv(information))


def drift_limit(rigs: int, constants: int) -> float:
    """|slope| over its sigma beyond which a constant drifts, by chance in 5 % of all fleets."""
    from scipy.special import stdtrit

    return -float(stdtrit(max(rigs - 2, 1), 0.5 * _CHANCE / max(constants, 1)))
