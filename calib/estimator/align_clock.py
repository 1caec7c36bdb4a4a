"""Even times for the samples of a whole log: a line through all time stamps of a sensor.

A sensor that samples at a steady rate takes its k-th sample at o + k T. Its stamps have jitter, and a
sample that waited in a buffer bears the stamp of the one before it. Which k a stamp belongs to follows by
counting: k - i, the samples missing before the i-th row, can only grow, and is the running median of
round((t_i - o) / T) - i. Chunk by chunk is counted on from the line through those just before it, so that a
clock that wanders does not lose count; stamps that are far off are left out of the fit. Where the clock
wanders about the line through all, the medians of blocks of the deviations are followed.

`calib.estimator.clock` does the same from the past alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray

__all__ = ["EvenTimes", "even_times_of"]

_FIRST, _CHUNK, _RECENT = 32, 256, 512
_FAR = 5.0
_BLOCK = 300
_LEAST_SAMPLES = 8
_UNEVEN = 0.25
_WINDOW = 11
_LAG = 8


@dataclass(frozen=True)
class EvenTimes:
    """Times of samples and how their stamps lay about them.

    Attributes
    ----------
    t_s : (n,) times; the stamps where the sampling is not steady.
    period_s : NaN where it is not steady.
    jitter_s : robust standard deviation of the stamps.
    repeated : stamps that are that of the sample before. missing : samples that are not there.
    """

    t_s: FloatArray
    period_s: float
    jitter_s: float
    repeated: int
    missing: int


def _running_median(values: FloatArray) -> FloatArray:
    if len(values) < _WINDOW:
        return values
    half = _WINDOW // 2
    padded = np.concatenate([values[:half][::-1], values, values[-half:][::-1]])
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, _WINDOW), axis=1))


def _counted(t: FloatArray, origin: float, period: float) -> FloatArray:
    """Number k (n,) of each sample on the line, strictly rising."""
    i = np.arange(len(t), dtype=np.float64)
    behind = np.rint((t - origin) / period) - i
    return np.asarray(np.rint(np.maximum.accumulate(_running_median(behind))) + i)


def _line(k: FloatArray, t: FloatArray) -> tuple[float, float, float]:
    """Origin, period and robust deviation of stamps (n,) over numbers (n,)."""
    use = np.ones(len(t), dtype=np.bool_)
    origin, period, spread = float(t[0]), 1.0, 0.0
    for _ in range(4):
        middle = float(k[use].mean())
        slope, at = np.polyfit(k[use] - middle, t[use], 1)
        origin, period = float(at - slope * middle), float(slope)
        off = t - origin - period * k
        spread = max(1.4826 * float(np.median(np.abs(off[use]))), 1e-7)
        again = np.abs(off) <= _FAR * spread
        if again.sum() < _LEAST_SAMPLES // 2 or np.array_equal(again, use):
            break
        use = again
    return origin, period, spread


def _all_counted(t: FloatArray, period: float) -> tuple[FloatArray, bool]:
    """Numbers k (n,) of all samples, and whether they are steady.

    Each chunk is counted on from the line through those before it.
    """
    k = np.zeros(len(t))
    origin, nominal, done = float(t[0]), period, 0
    while done < len(t):
        end = min(done + min(max(done, _FIRST), _CHUNK), len(t))
        since = max(done - _WINDOW, 0)
        counted = _counted(t[since:end], origin, period)
        # Numbers that are known stay; those after them go on rising.
        k[done:end] = counted[done - since :]
        if done:
            behind = k[done - 1] + 1.0 - k[done]
            k[done:end] += max(behind, 0.0)
        recent = slice(max(end - _RECENT, 0), end)
        origin, period, spread = _line(k[recent], t[recent])
        if not 0.5 * nominal < period < 2.0 * nominal or spread > _UNEVEN * period:
            return k, False
        done = end
    return k, True


def even_times_of(stamps: FloatArray) -> EvenTimes:
    """Even times of samples with these stamps (n,) [s], which do not go back."""
    t = np.asarray(stamps, dtype=np.float64)
    repeated = int((np.diff(t) == 0.0).sum())
    steps = np.diff(t)
    steps = steps[steps > 1e-6]
    as_they_are = EvenTimes(t, math.nan, 0.0, repeated, 0)
    if len(t) < _LEAST_SAMPLES or len(steps) < _LEAST_SAMPLES // 2:
        return as_they_are
    rough = float(np.median(steps))
    # Over several samples jitter counts for less; where one of them is missing the time is far longer.
    apart = (t[_LAG:] - t[:-_LAG]) / _LAG if len(t) > 2 * _LAG else steps
    apart = apart[np.abs(apart / rough - 1.0) < 0.5 / _LAG]
    k, steady = _all_counted(t, float(np.median(apart)) if len(apart) else rough)
    if not steady:
        return as_they_are
    origin, period, spread = _line(k, t)
    even = origin + period * k
    even += _wander(even, t - even, spread)
    jitter = 1.4826 * float(np.median(np.abs(t - even)))
    return EvenTimes(even, period, jitter, repeated, int(k[-1] - k[0]) + 1 - len(t))


def _wander(even: FloatArray, off: FloatArray, spread: float) -> FloatArray:
    """What the clock is off the line (n,), zero where that is within the jitter."""
    blocks = len(off) // _BLOCK
    if blocks < 3:
        return np.zeros(len(off))
    pieces: list[IntArray] = list(np.array_split(np.arange(len(off)), blocks))
    at = np.array([even[piece].mean() for piece in pieces])
    medians = np.array([np.median(off[piece]) for piece in pieces])
    if float(np.abs(medians).max()) <= 6.0 * 1.25 * spread / math.sqrt(_BLOCK) + 2e-6:
        return np.zeros(len(off))
    return np.asarray(np.interp(even, at, medians))
