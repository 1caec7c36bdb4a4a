"""Damping by the logarithmic decrement (3.39), (3.40), from peaks that outliers do not make.

Single readings that stand away from the cubic through their six neighbours are replaced by it. The
extremes of what is left are found once the motion has come back by a fifth of its amplitude, so that
noise makes none, and each is the vertex of a parabola through the rows about it. The amplitude is that from
peak to peak, which does not see an offset that creeps; on the raw curve (3.39) yields about 0.004.

    delta = ln(x_i / x_(i+1)) over a period,   zeta = delta / sqrt(4 pi^2 + delta^2)

delta is the median of the slopes between all pairs of amplitudes (Theil and Sen), with the standard
deviation that the scatter about that line gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray, robust_sigma
from calib.core.errors import BadInputError

_HALF_WINDOW = 3
_FAR = 4.0
_FEWEST = 4
_FLOOR = 10.0
_LARGEST_SHARE = 0.1


@dataclass(frozen=True)
class Decrement:
    """A decaying swing.

    Attributes
    ----------
    zeta, sigma : damping ratio and its standard deviation. frequency_hz : of the swing.
    peak_at_s, peak : (n,) extremes that were used. outliers : readings that were replaced.
    """

    zeta: float
    sigma: float
    frequency_hz: float
    peak_at_s: FloatArray
    peak: FloatArray
    outliers: int


def without_outliers(values: FloatArray) -> tuple[FloatArray, int]:
    """Values (n,) with single ones that stand away from their neighbours replaced, and how many."""
    n = len(values)
    at = np.clip(np.arange(n)[:, None] + np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1), 0, n - 1)
    # A cubic through the other rows of the window follows a swing, which a median does not.
    x = np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1, dtype=np.float64)
    others = np.delete(np.arange(2 * _HALF_WINDOW + 1), _HALF_WINDOW)
    V = np.vander(x[others], 4)
    mid = np.linalg.pinv(V)[-1]
    guess = values[at][:, others] @ mid
    error = values - guess
    scale = robust_sigma(error)
    # A cubic misses a tenth of a fast swing's window.
    local = np.ptp(values[at][:, others], axis=1)
    far = np.abs(error) > np.maximum(np.maximum(_FAR * scale, 0.25 * local), 1e-12)
    # Of neighbours that all look wrong only the worst is.
    worst = np.abs(error) >= np.abs(error)[at].max(axis=1) - 1e-15
    bad = far & worst
    out = values.copy()
    out[bad] = guess[bad]
    return out, int(bad.sum())


def _turns(y: FloatArray, share: float) -> IntArray:
    """Rows of the extremes, each confirmed by a return of `share` times the swing before it."""
    found: list[int] = []
    top = low = 0
    direction = 0
    swing = float(np.ptp(y[: max(len(y) // 8, 8)]))
    for i in range(1, len(y)):
        if y[i] > y[top]:
            top = i
        if y[i] < y[low]:
            low = i
        back = share * swing
        if direction >= 0 and y[top] - y[i] > back:
            found.append(top)
            swing = abs(float(y[top] - y[found[-2]])) if len(found) > 1 else swing
            direction, low = -1, i
            top = i
        elif direction <= 0 and y[i] - y[low] > back:
            found.append(low)
            swing = abs(float(y[low] - y[found[-2]])) if len(found) > 1 else swing
            direction, top = 1, i
            low = i
    return np.array(found, dtype=np.int64)


def _vertex(t: FloatArray, y: FloatArray, i: int, reach: int) -> tuple[float, float]:
    a, b = max(i - reach, 0), min(i + reach + 1, len(y))
    if b - a < 3:
        return float(t[i]), float(y[i])
    c = np.polyfit(t[a:b] - t[i], y[a:b], 2)
    if c[0] == 0.0:
        return float(t[i]), float(y[i])
    at = float(np.clip(-0.5 * c[1] / c[0], t[a] - t[i], t[b - 1] - t[i]))
    return float(t[i]) + at, float(np.polyval(c, at))


def _regular(t: FloatArray, y: FloatArray, at: FloatArray, peak: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Extremes where their neighbours say that they are.

    A vertex that is sought among noisy readings is too high, the more so the smaller the swing. The times of
    the extremes go smoothly, so that of each follows from all, and a parabola about it gives its height.
    """
    k = np.arange(len(at), dtype=np.float64)
    big = np.concatenate([[True], np.abs(np.diff(peak)) > 0.1 * np.abs(np.diff(peak)).max()])
    count = len(big) if bool(big.all()) else max(int(np.argmin(big)), _FEWEST)
    smooth = np.polyval(np.polyfit(k[:count], at[:count], 2 if count > 5 else 1), k[:count])
    half = float(np.median(np.diff(smooth)))
    if float(np.abs(smooth - at[:count]).max()) > 0.3 * half:
        return at, peak
    heights = peak[:count].copy()
    for i, centre in enumerate(smooth.tolist()):
        near = np.abs(t - centre) <= 0.32 * half
        if int(near.sum()) >= 4:
            heights[i] = np.polyval(np.polyfit(t[near] - centre, y[near], 2), 0.0)
    return np.asarray(smooth, dtype=np.float64), heights


def decrement(t_s: FloatArray, phi_rad: FloatArray, noise_rad: float = 0.0) -> Decrement:
    """Damping of a free swing from its angle (n,) at times (n,).

    Parameters
    ----------
    noise_rad : standard deviation of a reading; swings below ten times that are left out,
        since noise makes small extremes larger.

    Raises `BadInputError` when fewer than four extremes stand out.
    """
    y, outliers = without_outliers(np.asarray(phi_rad, dtype=np.float64))
    turns = _turns(y, 0.3)
    reach = max(round(0.25 * float(np.median(np.diff(turns)))), 1) if len(turns) > 1 else 1
    # The first row of a log that begins in a swing stands out and is no extreme.
    turns = turns[turns >= reach]
    if len(turns) < _FEWEST:
        raise BadInputError(f"swing: found {len(turns)} extremes, expected at least {_FEWEST}")
    ends = [_vertex(t_s, y, int(i), reach) for i in turns]
    at, peak = _regular(t_s, y, np.array([e[0] for e in ends]), np.array([e[1] for e in ends]))
    height = np.abs(np.diff(peak))
    floor = max(_FLOOR * noise_rad, _LARGEST_SHARE * float(height.max()))
    small = np.nonzero(height < floor)[0]
    used = int(small[0]) if len(small) else len(height)
    if used < _FEWEST - 1:
        raise BadInputError(f"swing: found {used + 1} extremes above the noise, expected at least {_FEWEST}")
    k = np.arange(used, dtype=np.float64)
    log = np.log(height[:used])
    i, j = np.triu_indices(used, 1)
    slope = float(np.median((log[j] - log[i]) / (k[j] - k[i])))
    scatter = robust_sigma(log - slope * k - np.median(log - slope * k))
    lever = k - k.mean()
    total = max(float(np.sum(lever**2)), 1e-12)
    # The scatter of few peaks may be small by chance; it cannot be less than what the noise makes.
    by_noise = math.sqrt(float(np.sum((lever * noise_rad / height[:used]) ** 2))) / total
    spread = 1.2 * max(scatter / math.sqrt(total), by_noise)
    delta, delta_sigma = -2.0 * slope, 2.0 * spread
    # Whole periods: an offset that creeps makes one half longer than the other.
    half = 0.5 * float(np.median(at[2 : used + 1] - at[: used - 1]))
    norm = math.hypot(delta, 2.0 * math.pi)
    return Decrement(
        delta / norm,
        delta_sigma * (2.0 * math.pi) ** 2 / norm**3,
        0.5 / half,
        at[: used + 1],
        peak[: used + 1],
        outliers,
    )
