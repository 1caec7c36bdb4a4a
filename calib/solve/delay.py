"""By how much one record of a motion is later than another, from the motion that both show.

What is late, y, and what is not, x, are held against each other at delays d by the sums of x y, x^2 and y^2
about straight lines or means,

    left(d) = min over a of sum (y(t) - a x(t - d))^2 / sum y(t)^2,

with a = 1 where both have one scale. A delay that puts most of the motion outside the time of x, as a twitch
at the start, explains none of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, integral


def moments(
    late_s: FloatArray,
    late: FloatArray,
    t_s: FloatArray,
    other: FloatArray,
    delays_s: FloatArray,
    fewest: int,
) -> FloatArray:
    """Sums (k, 3) of x y, x^2 and y^2 about straight lines, at each delay; 0 where fewer samples are shared.

    Parameters
    ----------
    late_s, late : times and values y (m,). t_s, other : of x (n,). delays_s : (k,).
    """
    sums = np.zeros((len(delays_s), 3))
    for row, delay in zip(sums, delays_s.tolist(), strict=True):
        inside = (late_s - delay >= t_s[0]) & (late_s - delay <= t_s[-1])
        if int(inside.sum()) < fewest:
            continue
        t, y = late_s[inside], late[inside]
        x = np.interp(t - delay, t_s, other)
        line = np.stack([np.ones(len(t)), t - t.mean()], axis=1)
        norms = (line * line).sum(axis=0)
        x = x - line @ (line.T @ x / norms)
        y = y - line @ (line.T @ y / norms)
        row[:] = x @ y, x @ x, y @ y
    return sums


def shares(sums: FloatArray, most: float = np.inf, least: float = 0.5) -> tuple[FloatArray, FloatArray]:
    """Factors a (k,) and the shares of the late one's squares that are left (k,), of sums (k, 3).

    Parameters
    ----------
    most : factor in size between both, or its reciprocal, at most; 1 for one scale, infinite for
        any of either sign.
    least : share of the late one's motion below which a delay explains none.
    """
    cross, own, total = sums.T
    a = np.divide(cross, own, out=np.zeros(len(sums)), where=own > 0.0)
    a = np.clip(a, 1.0 / most, most) if most < np.inf else a
    seen = total > max(least * float(total.max(initial=0.0)), 0.0)
    explained = np.divide(a * (2.0 * cross - a * own), total, out=np.zeros(len(sums)), where=seen)
    return a, np.maximum(1.0 - explained, 0.0)


def vertex(before: float, least: float, after: float) -> float:
    """Where, in steps from the middle one, the parabola through three values is least; 0 for a line."""
    bend = before - 2.0 * least + after
    return 0.5 * (before - after) / bend if bend > 0.0 else 0.0


# ----------------------------------------------------------------------
# Of an angle, after that of an IMU.

_USUAL_S, _LONG_S = np.arange(-0.02, 0.1201, 0.001), np.arange(-0.02, 0.8001, 0.005)
_FEWEST = 30
_CLEAR = 0.25
"""Share of an angle that a long delay leaves, at most."""


def _rough_delay(late_s: FloatArray, late_rad: FloatArray, t_s: FloatArray, turned_rad: FloatArray) -> float:
    """The delay [s], to 5 ms, that leaves the least; 0 where that is a usual one, or leaves hardly less."""
    # Of a swing a period early the rest has the same shape and is larger.
    left = shares(moments(late_s, late_rad, t_s, turned_rad, _LONG_S, _FEWEST), 1.0)[1]
    k, usual = int(np.argmin(left)), float(left[: int(np.searchsorted(_LONG_S, _USUAL_S[-1]))].min())
    return float(_LONG_S[k]) if left[k] < min(_CLEAR, 0.5 * usual) else 0.0


def estimate_delay(
    late_s: FloatArray, late_rad: FloatArray, t_s: FloatArray, phi_rad: FloatArray, turned_rad: FloatArray
) -> float:
    """By how much [s] one angle (m,) is later than another (n,), from -20 to 800 ms; 0 for standing still.

    The delay of least variance of the difference; between the two neighbours it is that of the parabola.

    Parameters
    ----------
    turned_rad : (n,) what the gyroscope has turned, which says where to look.
    """
    seen = np.isfinite(late_rad)
    at, late = late_s[seen], late_rad[seen]
    middle = _rough_delay(at, late, t_s, turned_rad)
    delays = middle + _USUAL_S[:41] if middle else _USUAL_S
    known = (at > t_s[0] + float(delays[-1]) + 0.01) & (at < t_s[-1] - 0.03)
    if int(known.sum()) < _FEWEST:
        return middle
    at, late = at[known], late[known]
    variance = np.array([float((late - np.interp(at - d, t_s, phi_rad)).var()) for d in delays.tolist()])
    k = int(np.argmin(variance))
    # A minimum at the end, or one that stands out by nothing, tells no delay.
    if k in (0, len(delays) - 1) or float(variance.max()) < 1.02 * float(variance[k]):
        return middle
    return float(delays[k] + 0.001 * vertex(*variance[k - 1 : k + 2].tolist()))


# ----------------------------------------------------------------------
# Of two recordings, each with its clock. Both are differenced over `_OVER` steps of a grid, and an offset is
# looked for at the delays at which more than half of motion and time is shared. A swing repeats after each
# period but for its size, so that every other delay has to leave twice as much: also those that share less,
# since a recording that begins late shares little at the true one. Where the marker's place on the head is
# not known sizes differ by a factor, and a size tells the period only where no factor up to `_SCALE` makes
# up for it. Clocks that seem to drift by more than clocks do are swings that are held against others.

_STEP_S, _OVER = 0.01, 10
_PARTS = np.arange(-4, 5) / 5.0
_WEIGHTS = (1.0 - np.abs(_PARTS)) / 5.0
_GAP_S = 0.15
_MOST_LEFT, _APART, _ROUGHLY_APART = 0.4, 0.5, 0.95
"""Share of the motion that may be left, and of what the next best delay leaves, without and with a factor."""
_BESIDE_S = 0.1
_NEAR = 3
"""Steps by which a factor moves the best delay."""
_SCALE = 1.2
_RIVAL, _RIVAL_S = 0.3, 0.8
"""Share of one record's motion, and time, that a delay has to share to count against another."""
_NOTHING, _TINY = 1e-6, 1e-300
_DRIFT_S, _DRIFT = 0.02, 2e-3
"""Drift of clocks from half to half, and its share of a half, at most."""


@dataclass(frozen=True)
class Clocks:
    """How two clocks stand to each other.

    Attributes
    ----------
    offset_s : to be added to the pictures' times. drift_s : by how much more in the second half than in the
        first; None where one of them does not tell.
    left, next_left : shares of the motion that are left at this offset, and at the next best one.
    """

    offset_s: float
    drift_s: float | None
    left: float
    next_left: float


def _grid_rates(
    t_s: FloatArray, values: FloatArray, others_s: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Times of a grid, rates there, and whether they are between samples that are close together.

    Straight lines between the other record's samples (at `others_s`) weigh what happens between them by a
    triangle, as wide as two of its steps, and so are these values: else its motion is the smaller one, as
    that of a swing is a period later.
    """
    at = np.arange(t_s[0], t_s[-1], _STEP_S)
    after = np.clip(np.searchsorted(t_s, at, side="right"), 1, len(t_s) - 1)
    near = t_s[after] - t_s[after - 1] < _GAP_S
    step_s = float(np.median(np.diff(others_s)))
    smooth = sum(
        weight * np.interp(at + part * step_s, t_s, values)
        for part, weight in zip(_PARTS.tolist(), _WEIGHTS.tolist(), strict=True)
    )
    rate = (smooth[_OVER:] - smooth[:-_OVER]) / (_OVER * _STEP_S)
    middle = _OVER // 2
    return at[middle : middle + len(rate)], rate, near[_OVER:] & near[:-_OVER]


def _unexplained_shares(
    seen: FloatArray, known: BoolArray, felt: FloatArray, most: float
) -> tuple[FloatArray, BoolArray]:
    """left (n,) at the delays 1 - len(seen) .. len(felt) - 1 of grids, and where half is shared.

    Where too little is shared to say anything, all is left. `most` as in `shares`.
    """
    # Most users of this module never come here; the package takes 24 MB and a tenth of a second.
    from scipy.signal import correlate

    seen = np.where(known, seen - seen[known].mean(), 0.0)
    there, rows = np.ones(len(felt)), known.astype(np.float64)
    cross, own = correlate(felt, seen), correlate(felt**2, rows)
    total, shared = correlate(there, seen**2), correlate(there, rows)
    part, own_part = (one / max(float(one.max()), _TINY) for one in (total, own))
    counts = (np.maximum(part, own_part) > _RIVAL) & (shared * _STEP_S > _RIVAL_S)
    # Sums of nothing are rounding errors, of which any share is explained.
    counts &= np.minimum(part, own_part) > _NOTHING
    sums = np.stack([cross, own, total], axis=1)
    sums[~counts] = 0.0
    half = counts & (part > 0.5) & (shared > 0.5 * float(rows.sum()))
    return np.minimum(shares(sums, most, least=0.0)[1], 1.0), half


def clocks(
    camera_s: FloatArray, way: FloatArray, imu_s: FloatArray, gz_radps: FloatArray, scaled: bool
) -> Clocks | None:
    """How two clocks stand to each other by a motion that both saw; None where it does not tell.

    Parameters
    ----------
    camera_s, way : (n,) times and angle phi [rad], or with `scaled` False any measure of the motion.
    imu_s, gz_radps : (m,) times and rates.
    """
    at, seen, known = _grid_rates(camera_s, way, imu_s)
    felt_s, felt, _ = _grid_rates(imu_s, -integral(imu_s, gz_radps - np.median(gz_radps)), camera_s)
    if known.sum() < 10 * _OVER or len(felt) < 10 * _OVER:
        return None

    beside = round(_BESIDE_S / _STEP_S)

    def rival(left: FloatArray, k: int) -> float:
        return float(np.concatenate([left[: max(k - beside, 0)], left[k + beside + 1 :], [1.0]]).min())

    def offset(known: BoolArray) -> tuple[float, float, float, bool]:
        """Offset, what it and its next leave, and whether that is clear."""
        left, half = _unexplained_shares(seen, known, felt, 1.0 if scaled else np.inf)
        k = int(np.argmin(np.where(half, left, np.inf)))
        following = rival(left, k)
        clear = float(left[k]) <= min(_MOST_LEFT, _APART * following)
        if scaled and clear:
            roughly = _unexplained_shares(seen, known, felt, _SCALE)[0]
            least = float(roughly[max(k - _NEAR, 0) : k + _NEAR + 1].min())
            clear = least <= _ROUGHLY_APART * rival(roughly, k)
        part = vertex(*left[k - 1 : k + 2].tolist()) if 0 < k < len(left) - 1 else 0.0
        lag_s = (k + part - (len(seen) - 1)) * _STEP_S
        return lag_s + float(felt_s[0] - at[0]), float(left[k]), following, clear

    whole, left, following, clear = offset(known)
    if not clear:
        return None
    first = np.arange(len(at)) < len(at) // 2
    parts = (known & first, known & ~first)
    halves = [offset(part) for part in parts if part.sum() >= 10 * _OVER]
    told = len(halves) == 2 and all(clear for *_, clear in halves)
    drift_s = halves[1][0] - halves[0][0] if told else None
    if drift_s is not None and abs(drift_s) > max(_DRIFT_S, _DRIFT * float(np.ptp(at)) / 2.0):
        return None
    return Clocks(whole, drift_s, left, following)
