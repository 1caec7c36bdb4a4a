"""The time axis of a log: when its samples were taken, from time stamps that are measurements of a clock.

A sensor takes sample k at o + k T + w(k), where w wanders slowly. A stamp adds jitter to that, samples go
missing, and a sample that waited in a buffer bears the stamp of the one before it. Three things follow
from the stamps, in this order.

Places k. The samples missing before the i-th one, k - i, can only grow, and are the running median of
round((t_i - o) / T) - i. Chunk by chunk is counted on from the line through those just before it, so that the
count is held to the stamps: one late stamp adds no sample, however many there are. Chunks are as long as the
line foretells the next one to a quarter of a period, and shorter where the clock bends. Where samples come in
bursts, as from a buffer that is read now and then, the count goes by bursts. The last sample of one was taken
up to a period before it was read, and the times are those of the bursts that were read at once.

A clock with steps of about a period lets several samples bear one stamp, or leaves out every few steps. Where
all stamps are whole steps apart, and stay within one of an even line, that is no lack of samples: they are
spread over the step that they share, and counted with its width in mind.

Wander w. Deviations of the stamps from the line are averaged over blocks of W samples. Jitter asks for long
blocks and a clock that wanders, or a loop whose delays add up, for short ones; W is where the means of
neighbouring blocks differ least (Allan's variance of two samples). Where single stamps are better than any
mean, W is 1, and the times are the stamps. Where the means differ as jitter alone makes them, by the variance
of one sample over W, nothing wanders.

Steadiness. Stamps that stay within a quarter of a period of their line are a steady sensor's. Those of others
stay as they are. What needs even samples gets those of a steady sensor as they are, and those of others on
straight lines between them, at even times that span what the stamps do.

So the axis spans what the stamps span, and no sample is moved by more than the jitter of its stamp. Gaps of
more than `SPLIT_S` cut the axis into stretches, each with its own line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, robust_sigma

SPLIT_S = 1.0
"""Gaps that are longer are not filled."""

_FIRST, _CHUNK, _RECENT = 32, 256, 512
_FAR = 5.0
_BLOCKS = (1, 2, 5, 10, 20, 50, 100, 300)
"""Lengths of blocks that the wander may be averaged over."""
_NOMINAL = 0.01
_SURE = 8.0
"""Standard deviations, about, by which blocks' means must be further apart than jitter makes them."""
_NEGLIGIBLE_S = 2e-6
_LEAST_SAMPLES = 8
_UNEVEN = 0.25
"""Deviation of the stamps of a steady sensor, in periods, at most."""
_LATE = 0.05
"""Stamps of a short stretch that may be off by more than half a period."""
_LATER = 0.15
"""By how much more than half a period bursts must be late for a missing sample to be counted: they are read
up to a period after their last sample was taken."""
_AT_ONCE = 0.05
"""Share of bursts that are taken to be read at once, or sooner for jitter."""
_WHEN_FULL = 0.26
"""Robust deviation, in periods, of bursts from their line where they are read when a buffer is full; of those
that are read at any time within a period it is 0.37."""
_WINDOW = 11
_LOOKS = 7
"""Looks, at most, at whether gaps are in their places."""
_LAG, _LONG_LAG = 8, 64
COARSE = 0.3, 2.5
_WHOLE, _ALMOST, _OTHERS, _WITHIN = 0.02, 0.85, 12, 1.3
"""Steps of a clock, in periods, that are looked for; how far from whole ones stamps may be apart; steps that
are nearly a period; how many unlike the usual one are enough to tell; by how many stamps leave a line."""
_CLOSE, _BURSTS = 0.25, 0.25
"""Steps below this share of the mean one are within a burst; where so many steps are, bursts are the rule."""
_GAP = 2.5
"""Steps, in usual ones, from which on samples are missing whatever the jitter."""


@dataclass(frozen=True)
class Gap:
    """Samples that are missing: when, for how long [s], how many, and whether the axis is split there."""

    at_s: float
    duration_s: float
    missing: int
    split: bool


@dataclass(frozen=True)
class Part:
    """Readings of a stretch at even steps.

    Attributes
    ----------
    t_s : (m,) times [s].
    values : (m, axes), on straight lines where samples are missing or the sensor is not steady.
    rows : (k,) samples that are in it, and `places` (k,) where they are in `values`.
    """

    t_s: FloatArray
    values: FloatArray
    rows: IntArray
    places: IntArray


@dataclass(frozen=True)
class TimeAxis:
    """When the samples of one sensor were taken.

    Attributes
    ----------
    stamps_s : (n,) time stamps [s], which do not go back.
    t_s : (n,) times [s], which do not go back either.
    places : (n,) number of each sample in its stretch, from 0, with gaps where samples are missing.
    starts : (stretches,) first sample of each stretch.
    even : (stretches,) whether its samples were taken at even steps.
    period_s : of the sensor; the mean step where it is not steady, NaN where no time passes.
    jitter_s : robust standard deviation of the stamps about the times.
    steady : whether most samples are of steady stretches.
    repeated : stamps that are that of the sample before.
    burst : samples of the longest burst, 1 where they do not come in bursts.
    """

    stamps_s: FloatArray
    t_s: FloatArray
    places: IntArray
    starts: IntArray
    even: BoolArray
    period_s: float
    jitter_s: float
    steady: bool
    repeated: int
    burst: int = 1

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return 1.0 / self.period_s

    @property
    def nominal_hz(self) -> float:
        """The rate that a sensor of this one was set to, to 1 %: of whole Hz or whole ms the nearer one."""
        rate = self.rate_hz
        if not 0.0 < rate < math.inf:
            return rate
        whole = [one for one in (round(rate), 1e3 / max(round(1e3 / rate), 1)) if one > 0]
        best = min(whole, key=lambda one: abs(one - rate))
        return float(best) if abs(best / rate - 1.0) < _NOMINAL else rate

    @property
    def shift_sigma_s(self) -> float:
        """Standard deviation [s] by which all times may be off together, from the jitter of the stamps."""
        steps = np.diff(self.stamps_s, append=math.inf)
        if self.steady:
            # Of a burst the last stamp alone tells.
            last = steps > _CLOSE * self.period_s
            return robust_sigma((self.stamps_s - self.t_s)[last]) / math.sqrt(last.sum())
        # The times are the stamps; steps, but for gaps, have twice their variance.
        usual = steps[steps < _GAP * np.median(steps)]
        return float(np.std(usual)) / math.sqrt(2.0 * len(usual)) if len(usual) else 0.0

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Where samples are missing, in order of time."""
        new = np.zeros(len(self.t_s), dtype=np.bool_)
        new[self.starts[1:]] = True
        skipped = np.diff(self.places, prepend=self.places[:1])
        out = []
        for i in np.flatnonzero(new | (skipped > 1)).tolist():
            step = float(self.t_s[i] - self.t_s[i - 1])
            count = max(round(step / self.period_s) - 1, 1) if new[i] else int(skipped[i]) - 1
            out.append(Gap(float(self.t_s[i - 1]), step, count, bool(new[i])))
        return tuple(out)

    @property
    def missing(self) -> int:
        """Samples missing in gaps that do not split the axis."""
        return sum(gap.missing for gap in self.gaps if not gap.split)

    def parts(self, values: FloatArray) -> tuple[Part, ...]:
        """Readings (n, axes) of these samples stretch by stretch at even steps."""
        out = []
        for (first, last), even in zip(_stretches(self.starts, len(self.t_s)), self.even, strict=True):
            t, places, held = self.t_s[first:last], self.places[first:last], values[first:last]
            known, wanted, times = places.astype(np.float64), np.arange(int(places[-1]) + 1.0), t
            if not even and t[-1] > t[0]:
                span, count = t[-1] - t[0], max(round((t[-1] - t[0]) / self.period_s), 1)
                known, times = t, np.linspace(t[0], t[-1], count + 1)
                places, wanted = np.rint((t - t[0]) / span * count).astype(np.int64), times
            if not even or len(wanted) != len(known):
                times = np.interp(wanted, known, t)
                held = np.stack([np.interp(wanted, known, column) for column in held.T], axis=1)
            out.append(Part(times, np.ascontiguousarray(held), np.arange(first, last), places))
        return tuple(out)


def time_axis(stamps_s: FloatArray) -> TimeAxis:
    """The time axis of samples with these stamps (n,) [s], which do not go back."""
    t = np.asarray(stamps_s, dtype=np.float64)
    steps = np.diff(t)
    rising = steps[steps > 0.0]
    usual = float(np.median(rising)) if len(rising) else 0.0
    starts = np.flatnonzero(np.concatenate([[True], steps > max(SPLIT_S, 5.0 * usual)])[: len(t)])
    times, places = t.copy(), np.zeros(len(t), dtype=np.int64)
    samples, weighted, even, burst = 0, 0.0, np.zeros(len(starts), dtype=np.bool_), 1
    for k, (first, last) in enumerate(_stretches(starts, len(t))):
        places[first:last] = np.arange(last - first)
        stretch = _fit_stretch(t[first:last])
        if stretch is not None:
            times[first:last], places[first:last], period, longest = stretch
            even[k], burst = True, max(burst, longest)
            weighted, samples = weighted + period * (last - first), samples + last - first
    steady = 2 * samples > len(t)
    if not samples and len(t) > 1:
        within = np.delete(steps, starts[1:] - 1)
        weighted, samples = float(within.sum()), len(within)
    period = weighted / samples if weighted > 0.0 else math.nan
    jitter = robust_sigma(t - times) if len(t) else 0.0
    burst = burst if steady else 1
    return TimeAxis(t, times, places, starts, even, period, jitter, steady, int((steps == 0.0).sum()), burst)


def clock_step_s(stamps_s: FloatArray) -> float:
    """Longest step of which all stamps (n,) [s] are whole ones apart, 0 for none; an even sensor's period."""
    apart = np.diff(np.unique(stamps_s))
    if len(apart) < _LEAST_SAMPLES:
        return 0.0
    least = float(np.median(apart[apart < 1.2 * apart.min()]))
    near = apart[apart < 20.0 * least] / least
    whole = (k for k in range(1, 5) if np.abs(k * near - np.rint(k * near)).max() < k * _WHOLE)
    return least / next(whole, math.inf)


def _coarse_clock(t: FloatArray) -> tuple[float, float] | None:
    """Step of the clock of a stretch and its samples' period, where these are about as long; else None."""
    step = clock_step_s(t) if len(t) >= 2 * _LONG_LAG else 0.0
    if step == 0.0:
        return None
    steps, apart = np.diff(t), t[_LONG_LAG:] - t[:-_LONG_LAG]
    usual = apart[np.abs(apart - np.median(apart)) <= 1.5 * step]
    period = float(usual.sum()) / max(len(usual), 1) / _LONG_LAG
    if not COARSE[0] * period <= step <= COARSE[1] * period:
        return None
    # Such steps with a double one now and then are a sensor's of which every so many samples are missing.
    if _ALMOST * period < step < period and steps.min() > 0.0:
        return None
    # Where samples are missing at random the stamps leave an even line, given some unusual steps to do so.
    others = int((np.abs(steps - np.median(steps)) > 0.5 * step).sum())
    size = max(_OTHERS * len(steps) // max(others, 1), _LONG_LAG)
    whole = len(t) // size * size
    off = (t[:whole] - period * np.arange(whole)).reshape(-1, size)
    return (step, period) if whole and np.mean(np.ptp(off, axis=1) < _WITHIN * step) > 0.5 else None


def _spread_stamps(t: FloatArray, step: float) -> FloatArray:
    """Stamps of a clock with this step, those that are one spread over it."""
    first = np.flatnonzero(np.diff(t, prepend=-math.inf) > 0.0)
    count = np.diff(first, append=len(t))
    rank = np.arange(len(t)) - np.repeat(first, count)
    return np.asarray(t + step * ((rank + 0.5) / np.repeat(count, count) - 0.5))


def _stretches(starts: IntArray, n: int) -> Iterator[tuple[int, int]]:
    """First sample of each stretch, and the one behind its last."""
    return pairwise([*starts.tolist(), n])


class _Anchors(NamedTuple):
    """By which stamps the samples of a stretch are counted.

    Attributes
    ----------
    t : (n,) stamps, those that share a step of a coarse clock spread over it.
    anchors : (m,) samples that are counted by, the last of each burst where samples come in bursts.
    periods : to try [s].
    size : samples, on average, over which an anchor's stamp may be off.
    window : anchors at a time.
    """

    t: FloatArray
    anchors: IntArray
    periods: list[float]
    size: float
    window: int

    @property
    def bursts(self) -> bool:
        return len(self.anchors) < len(self.t)


def _choose_anchors(t: FloatArray, steps: FloatArray) -> _Anchors:
    everyone, coarse = np.arange(len(t)), _coarse_clock(t)
    if coarse is not None:
        step, period = coarse
        return _Anchors(
            _spread_stamps(t, step), everyone, [period], 2.0 + 2.0 * step / period, 2 * _LONG_LAG + 1
        )
    anchors = _anchors(t)
    # One burst may hold a sample more than the next: over few of them that counts, over many what is missing.
    lags = [lag for lag in (_LAG, _LONG_LAG) if lag < len(anchors) < len(t)]
    periods = [_burst_period(t, anchors, lag) for lag in lags] or [_rough_period(t, steps)]
    return _Anchors(t, anchors, periods, len(t) / len(anchors), _WINDOW)


def _fit_stretch(t: FloatArray) -> tuple[FloatArray, IntArray, float, int] | None:
    """Times, places, period and longest burst of a stretch; None for a sensor that is not steady."""
    steps = np.diff(t)
    steps = steps[steps > 1e-6]
    if len(t) < _LEAST_SAMPLES or len(steps) < _LEAST_SAMPLES // 2:
        return None
    by = _choose_anchors(t, steps)
    t, anchors, count = by.t, by.anchors, np.diff(by.anchors, prepend=-1)
    lined_up = _first_line(by)
    if lined_up is None:
        return None
    k, origin, period, wander = _settle_gaps(by, *lined_up)
    # Samples of a burst come before its last; what is missing is missing before the burst.
    places = np.arange(len(t)) + np.repeat(k - anchors, count).astype(np.int64)
    times = origin + period * places + np.interp(places, k, wander)
    if by.bursts:
        late = t[anchors] - (origin + period * k) - wander
        # Read as a buffer is full they are late by no more than the stamps of single samples. Else the least
        # late ones tell when their last samples were taken. None was before the reading before.
        full = robust_sigma(t[anchors] - (origin + period * k)) < _WHEN_FULL * period
        times += np.median(late) if full else np.quantile(late, _AT_ONCE)
        before = np.concatenate([[-math.inf], t[anchors[:-1]]])
        times = np.maximum(times, np.repeat(before, count))
    times = np.maximum.accumulate(times)
    off = np.abs(times[anchors] - t[anchors]) / (by.size * period)
    return None if _is_wrong(off, len(t)) else (times, places - places[0], period, int(count.max()))


def _first_line(by: _Anchors) -> tuple[FloatArray, float, float] | None:
    """Numbers k (m,) of the anchors on a line, its origin and period; None where they are on none."""
    later = _LATER if by.bursts else 0.0
    lines: list[tuple[tuple[float, float, float], FloatArray]] = []
    # A gap at the end of the first chunk is counted in the wrong place and bends its line.
    for period, held in product(by.periods, (False, True)):
        if by.bursts or not lines:
            t = by.t[by.anchors]
            k = _count_samples(t, by.anchors, period, _UNEVEN * by.size, by.window, later, held)
            lines += [] if k is None else [(_fit_line(k, t), k)]
    if not lines:
        return None
    (origin, period, _), k = min(lines, key=lambda one: one[0][2])
    return (k, origin, period) if period > 0.0 else None


def _settle_gaps(
    by: _Anchors, k: FloatArray, origin: float, period: float
) -> tuple[FloatArray, float, float, FloatArray]:
    """Numbers k (m,) of the anchors with gaps in their places, the line's origin and period, wander (m,)."""
    t, anchors = by.t, by.anchors
    far = 0.5 + _LATER if by.bursts else 0.5 * by.size
    for look in range(_LOOKS):
        even = origin + period * k
        wander = _wander(even, t[anchors] - even)
        off = (t[anchors] - even - wander) / period
        if by.bursts:
            off -= np.quantile(off, _AT_ONCE) + 0.5
        off = np.where(np.abs(off) > far, np.rint(off), 0.0)
        moved = _with_gaps_in_place(k - anchors, off) + anchors
        if by.size == 1.0:
            moved = _without_steps(moved, (t - origin) / period - moved)
        if look == _LOOKS - 1 or np.array_equal(moved, k):
            break
        # Gaps in their wrong places bend the line, so that the next look sees more of them.
        k = moved
        origin, period, _ = _fit_line(k, t[anchors])
    return k, origin, period, wander


def _is_wrong(off: FloatArray, samples: int) -> bool:
    """Whether stamps that are off their times by `off` (m,) periods tell that the line is wrong."""
    wrong = off > 0.5
    # A late stamp stands alone; where neighbours are off as well, or the samples are few, the line is wrong.
    if _running_median(wrong.astype(np.float64)).any() or (samples < _RECENT and wrong.mean() > _LATE):
        return True
    # Of few stamps that are their own times none tells a late one from a wrong line.
    return bool(samples < 2 * _FIRST and off.max() > (_UNEVEN if np.median(off) > 1e-6 else 1e-3))


def _rough_period(t: FloatArray, steps: FloatArray) -> float:
    """Over several samples jitter counts for less; where one of them is missing the time is far longer."""
    rough = float(np.median(steps))
    apart = (t[_LAG:] - t[:-_LAG]) / _LAG if len(t) > 2 * _LAG else steps
    apart = apart[np.abs(apart / rough - 1.0) < 0.5 / _LAG]
    return float(np.median(apart)) if len(apart) else rough


def _burst_period(t: FloatArray, lasts: IntArray, lag: int) -> float:
    """The usual time per sample from the last of a burst to that of the one so many bursts on."""
    return float(np.median((t[lasts[lag:]] - t[lasts[:-lag]]) / (lasts[lag:] - lasts[:-lag])))


def _anchors(t: FloatArray) -> IntArray:
    """Samples (m,) whose stamps are counted by: all, or the last of each burst where bursts are the rule."""
    everyone = np.arange(len(t))
    if len(t) < 2 * _LONG_LAG:
        return everyone
    # A low quantile, so that gaps within a short stretch do not make all its steps look close.
    mean = float(np.quantile(t[_LONG_LAG:] - t[:-_LONG_LAG], 0.1)) / _LONG_LAG
    close = np.diff(t) < _CLOSE * mean
    lasts = np.flatnonzero(np.append(~close, True))
    return lasts if close.mean() >= _BURSTS and len(lasts) >= _FIRST else everyone


def _running_median(values: FloatArray, window: int = _WINDOW) -> FloatArray:
    if len(values) < window:
        return values
    half = window // 2
    padded = np.concatenate([values[:half][::-1], values, values[-half:][::-1]])
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, window), axis=1))


def _round_to_line(
    t: FloatArray, i: IntArray, origin: float, period: float, window: int, later: float
) -> FloatArray:
    """Number k (n,) on the line of each of the samples i (n,), rising as they do or faster."""
    behind = np.rint(_running_median((t - origin) / period - i, window) - later)
    if bool(np.all(behind[1:] >= behind[:-1])):
        return behind + i
    from scipy.optimize import isotonic_regression

    # Samples that were all late, as after a loop that stalled, are outweighed by those that follow.
    return np.asarray(np.rint(isotonic_regression(behind).x) + i)


def _fit_line(k: FloatArray, t: FloatArray) -> tuple[float, float, float]:
    """Origin, period and robust deviation of stamps (n,) over numbers (n,)."""
    use = np.ones(len(t), dtype=np.bool_)
    origin, period, spread = float(t[0]), 1.0, 0.0
    for _ in range(4):
        middle, at = float(k[use].mean()), float(t[use].mean())
        apart = k[use] - middle
        period = float(apart @ (t[use] - at) / max(float(apart @ apart), 1e-300))
        origin = at - period * middle
        off = t - origin - period * k
        spread = max(robust_sigma(off[use]), 1e-7)
        again = np.abs(off) <= _FAR * spread
        if again.sum() < _LEAST_SAMPLES // 2 or np.array_equal(again, use):
            break
        use = again
    return origin, period, spread


def _count_samples(
    t: FloatArray, i: IntArray, period: float, uneven: float, window: int, later: float, held: bool
) -> FloatArray | None:
    """Numbers k (n,) of the samples i (n,), by `window` of them at a time; None where they are not steady.

    Each chunk is counted on from the line through those before it. Where the period is `held` it is still the
    given one after the first chunk. `later` : as `_LATER`.
    """
    k = np.zeros(len(t))
    first = slice(0, window - _WINDOW + 1)
    origin, nominal = float(np.median(t[first] - period * i[first])), period
    done, chunk = 0, max(_FIRST, 2 * window - _FIRST)
    while done < len(t):
        end = min(done + chunk, len(t))
        since = max(done - window, 0)
        counted = _round_to_line(t[since:end], i[since:end], origin, period, window, later)
        # Numbers that are known stay; those after them go on rising.
        k[done:end] = counted[done - since :]
        if done:
            k[done:end] += max(k[done - 1] + i[done] - i[done - 1] - k[done], 0.0)
        last = slice(max(end - window, done), end)
        off = t[last] - origin - period * k[last]
        if chunk > max(_FIRST, 2 * window - _FIRST) and abs(float(np.median(off))) > uneven * period:
            # The clock bends: it is looked less far ahead, from a line that reaches less far back.
            chunk //= 2
            recent = slice(max(done - 2 * chunk, 0), done)
            origin, period, _ = _fit_line(k[recent], t[recent])
            if not period > 0.0:
                return None
            continue
        recent = slice(max(end - 2 * chunk, 0), end)
        origin, period, spread = _fit_line(k[recent], t[recent])
        if held and not done and end < len(t):
            origin, period = float(np.median(t[recent] - nominal * k[recent])), nominal
        if not 0.5 * nominal < period < 2.0 * nominal or spread > uneven * period:
            return None
        # The last ones are looked at once more, with those that follow.
        done, chunk = end if end == len(t) else end - window, min(2 * chunk, max(_CHUNK, 3 * window))
    return k


def _with_gaps_in_place(missing: FloatArray, off: FloatArray) -> FloatArray:
    """Samples missing before each (n,), which only grow, where stamps are `off` (n,) whole samples.

    The running median knows a gap to some samples only.
    """
    wanted, missing = missing + off, np.concatenate([[-math.inf], missing, [math.inf]])
    for i in (np.flatnonzero(off > 0.0) + 1)[::-1].tolist():
        missing[i] = max(missing[i], min(wanted[i - 1], missing[i + 1]))
    for i in (np.flatnonzero(off < 0.0) + 1).tolist():
        missing[i] = min(missing[i], max(wanted[i - 1], missing[i - 1]))
    return missing[1:-1]


def _without_steps(k: FloatArray, off: FloatArray) -> FloatArray:
    """Numbers k (n,) of samples, where stamps, `off` (n,) samples late, step by a whole one and stay there.

    Where its jitter is small, what a clock wanders is followed closely enough to hide such steps.
    """
    middle, half = _running_median(off), _WINDOW // 2
    spread = robust_sigma(off - middle)
    if len(k) < 2 * _WINDOW or _FAR * spread > 0.5:
        return k
    medians = middle[half:-half]
    step = medians[_WINDOW:] - medians[:-_WINDOW]
    here = np.diff(off)[_WINDOW - 1 :][: len(step)]
    k, last = k.copy(), 0
    for i in np.flatnonzero((np.abs(step) > 0.5) & (step * here > 0.5 * np.abs(step))).tolist():
        # Another one within the window is seen better once this one is away.
        whole, at = float(np.rint(here[i])), i + _WINDOW
        if at - last >= _WINDOW and k[at] + whole > k[at - 1]:
            k[at:] += whole
            last = at
    return k


def _wander(even: FloatArray, off: FloatArray) -> FloatArray:
    """What the clock is off its line (n,), from the deviations (n,) of the stamps at the times `even`.

    Zero where the blocks' means differ by no more than jitter makes them.
    """
    lag = max(min(_LONG_LAG, len(off) // 2), 1)
    ahead = off[lag:] - off[:-lag]
    slope = float(np.median(ahead))
    # At its ends the running median lags behind a slope.
    trend = slope / lag * np.arange(len(off))
    middle = trend + _running_median(off - trend)
    spread = robust_sigma(off - middle)
    most = _FAR * spread + _WINDOW / lag * float(np.median(np.abs(ahead - slope)))
    off = np.clip(off, middle - most, middle + most)
    best, least, by, jitter, wanders = 1, math.inf, off, 0.0, False
    for size in _BLOCKS:
        if len(off) < 3 * size:
            break
        means = _block_means(off, size)
        apart = 0.5 * float(np.mean(np.diff(means) ** 2))
        jitter = apart if size == 1 else jitter
        wanders |= apart * size > (1.0 + _SURE / math.sqrt(len(means))) * jitter
        if apart < least:
            best, least, by = size, apart, means
    if not wanders or float(np.abs(by).max()) < _NEGLIGIBLE_S:
        return np.zeros(len(off))
    return np.asarray(np.interp(even, _block_means(even, best), by))


def _block_means(values: FloatArray, size: int) -> FloatArray:
    edges = np.linspace(0, len(values), len(values) // size + 1).astype(np.int64)[:-1]
    return np.asarray(np.add.reduceat(values, edges) / np.diff(edges, append=len(values)))
