"""How one constant is spread over a fleet, and which rigs stand out.

With m the median and s = 1.4826 MAD of the values x_i, the spread between rigs is tau^2 = max(s^2 -
median(sigma_i^2), 0), since the standard deviations sigma_i of the calibrations have widened s, and

    z_i = (x_i - m) / sqrt(tau^2 + sigma_i^2)

is what a rig is judged by: a value that is poorly known does not stand out by that alone. When more than
half of the values are equal, s is 0 and 1.2533 times the mean absolute deviation takes its place
(Iglewicz and Hoaglin 1993, 3.4).

Of a fleet without outliers some z is large by chance. The limit is such that in n rigs times k constants
one is beyond it with a probability of 5 %. The MAD is known from n rigs about as well as a standard
deviation from 0.37 n (its efficiency, Rousseeuw and Croux 1993), hence Student's t of so many degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray

__all__ = ["FEWEST", "Spread", "limit_of", "robust_z", "spread_of"]

FEWEST = 8
"""Fewer rigs say nothing about what is usual."""

_TO_SIGMA = 1.482602218505602
_MEAN_TO_SIGMA = 1.2533141373155001
_EFFICIENCY = 0.37
_CHANCE = 0.05
_LEAST_LIMIT = 3.5
_NOISE = 1e-12


@dataclass(frozen=True)
class Spread:
    """Of one constant over the rigs.

    Attributes
    ----------
    count : rigs that have it. median, low, high : and the least and greatest value.
    scale : robust standard deviation of the values. between : of it what the calibrations do not explain.
    own : median of the rigs' own standard deviations, NaN where none is known.
    """

    count: int
    median: float
    low: float
    high: float
    scale: float
    between: float
    own: float


def spread_of(x: FloatArray, sigma: FloatArray) -> Spread:
    """Spread of values (n,) with standard deviations (n,), NaN where not known."""
    known = np.isfinite(x)
    x, sigma = x[known], sigma[known]
    if len(x) == 0:
        nan = float("nan")
        return Spread(0, nan, nan, nan, nan, nan, nan)
    m = float(np.median(x))
    off = np.abs(x - m)
    s = _TO_SIGMA * float(np.median(off))
    if s <= _NOISE * abs(m):
        s = _MEAN_TO_SIGMA * float(off.mean())
    if s <= _NOISE * abs(m):
        s = 0.0
    bars = sigma[np.isfinite(sigma)]
    own = float(np.median(bars)) if len(bars) else float("nan")
    between = float(np.sqrt(max(s**2 - (own**2 if len(bars) else 0.0), 0.0)))
    return Spread(len(x), m, float(x.min()), float(x.max()), s, between, own)


def robust_z(x: FloatArray, sigma: FloatArray, spread: Spread) -> FloatArray:
    """z (n,) of values, NaN where there is none, 0 where nothing differs."""
    own = np.where(np.isfinite(sigma), sigma, 0.0)
    # Without a spread between rigs their own standard deviations alone are no measure: they may be zero.
    scale = np.sqrt(spread.between**2 + own**2)
    scale = np.where(scale > 0.0, scale, spread.scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (x - spread.median) / scale
    return np.where(np.isfinite(x), np.nan_to_num(z, nan=0.0, posinf=0.0, neginf=0.0), np.nan)


def limit_of(rigs: int, constants: int) -> float:
    """|z| beyond which a rig stands out."""
    from scipy.special import stdtrit

    degrees = max(_EFFICIENCY * (rigs - 1), 1.0)
    tail = 0.5 * _CHANCE / max(rigs * constants, 1)
    return max(_LEAST_LIMIT, -float(stdtrit(degrees, tail)))
