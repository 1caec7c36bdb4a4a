"""How a log was sampled: rate, jitter, gaps, repeated rows and stamps, steps, readings at their limit.

Samples are taken evenly, but their time stamps are not: they jitter, and a sample that waited in a
buffer bears the stamp of the one before it. So readings are put on an even grid by counting. A group of
c samples with one stamp takes c places, and where the next stamp comes later than these fill, the
difference in whole periods is missing. A row that repeats both stamp and readings is one sample written
twice, and is dropped.

Up to `SPLIT_S` a gap is filled with readings on the straight line between its ends, which keeps the
time axis right; at longer ones the log is split.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.errors import BadInputError

__all__ = ["SPLIT_S", "Gap", "Part", "Sampling", "regular_parts"]

SPLIT_S = 1.0
_G = 9.80665
_GYRO_RANGES = tuple(math.radians(r) for r in (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0))
_ACCEL_RANGES = tuple(g * _G for g in (2.0, 4.0, 8.0, 16.0, 32.0))
_AT_LIMIT_IN_A_ROW = 3


@dataclass(frozen=True)
class Gap:
    """Samples that are missing: when, for how long [s], how many, and whether the log is split there."""

    at_s: float
    duration_s: float
    missing: int
    split: bool


@dataclass(frozen=True)
class Part:
    """Readings on an even grid.

    Attributes
    ----------
    start_s : time of the first.
    values : (n, axes), filled ones included.
    rows : (k,) rows of the log that are in it, and `places` (k,) where they are in `values`.
    """

    start_s: float
    values: FloatArray
    rows: IntArray
    places: IntArray


@dataclass(frozen=True)
class Sampling:
    """What is known of the sampling.

    Attributes
    ----------
    samples : that were used.
    period_s, rate_hz : of the even grid.
    jitter_s : robust standard deviation of the time stamps about the grid.
    repeated_rows, repeated_stamps : rows dropped, and stamps that occur again with other readings.
    gaps : in order of time.
    step : (axes,) quantisation step in the axis's unit, NaN where none is seen.
    at_limit : (axes,) readings at the end of a usual range, several in a row.
    """

    samples: int
    duration_s: float
    period_s: float
    rate_hz: float
    jitter_s: float
    repeated_rows: int
    repeated_stamps: int
    gaps: tuple[Gap, ...]
    step: FloatArray
    at_limit: IntArray

    @property
    def missing(self) -> int:
        """Samples missing in gaps that were filled."""
        return sum(gap.missing for gap in self.gaps if not gap.split)


def _period_s(t: FloatArray, source: str) -> float:
    """The period that most samples keep."""
    dt = np.diff(t)
    forward = dt[dt > 0.0]
    if len(forward) == 0:
        raise BadInputError(f"{source}: all {len(t)} IMU samples have the time {t[0]:g} s")
    rough = float(np.median(forward))
    # The median of jittering steps is off by far more than the mean of many; gaps are kept out of it.
    near = dt[dt < 1.5 * rough]
    if len(near) < 0.5 * len(dt):
        return rough
    smooth = _places(t, rough)[0]
    inside = np.diff(smooth) == 1
    lengths = np.diff(np.flatnonzero(np.concatenate([[True], ~inside, [True]])))
    ends = np.cumsum(lengths)
    longest = int(np.argmax(lengths))
    first, last = int(ends[longest] - lengths[longest]), int(ends[longest]) - 1
    if last - first < 20:
        return rough
    k = np.arange(last - first + 1, dtype=np.float64)
    return float(np.polyfit(k, t[first : last + 1] - t[first], 1)[0])


def _places(t: FloatArray, period_s: float) -> tuple[IntArray, IntArray]:
    """Place (n,) of each sample on the grid, and how many are missing before it (n,)."""
    new = np.concatenate([[True], np.diff(t) > 0.0])
    first = np.flatnonzero(new)
    count = np.diff(np.concatenate([first, [len(t)]]))
    missing = np.zeros(len(t), dtype=np.int64)
    whole = np.rint(np.diff(t[first]) / period_s).astype(np.int64)
    missing[first[1:]] = np.maximum(whole - count[:-1], 0)
    # Late stamps look like a gap that the next, shorter steps take back.
    taken_back = np.maximum(count[:-1] - whole, 0)
    for i in np.flatnonzero(missing).tolist():
        if missing[i] <= 5:
            group = int(np.searchsorted(first, i))
            missing[i] -= min(missing[i], int(taken_back[group : group + 2 * int(missing[i]) + 1].sum()))
    return np.cumsum(1 + missing) - 1, missing


def _step(values: FloatArray) -> float:
    """Quantisation step: the least distance of readings, where all are whole multiples of it apart."""
    levels = np.unique(values)
    if not 3 <= len(levels) <= 0.25 * len(values) + 3:
        return math.nan
    apart = np.diff(levels)
    digits = 1e-7 * float(np.abs(levels).max())
    least = float(apart[apart > digits].min(initial=math.inf))
    whole = apart[apart > digits] / least
    if not math.isfinite(least) or float(np.abs(whole - np.rint(whole)).max()) > 0.05:
        return math.nan
    return float((levels[-1] - levels[0]) / np.rint(whole).sum())


def _at_limit(values: FloatArray, gyro: bool) -> int:
    """Readings at the end of a usual range, in runs of at least `_AT_LIMIT_IN_A_ROW`."""
    count = 0
    for extreme in (float(values.max()), float(values.min())):
        ends = _GYRO_RANGES if gyro else _ACCEL_RANGES
        if not any(0.999 * end <= abs(extreme) <= 1.0005 * end for end in ends):
            continue
        at = np.concatenate([[False], values == extreme, [False]]).astype(np.int64)
        starts, stops = np.flatnonzero(np.diff(at) == 1), np.flatnonzero(np.diff(at) == -1)
        runs = stops - starts
        count += int(runs[runs >= _AT_LIMIT_IN_A_ROW].sum())
    return count


def regular_parts(
    t_s: FloatArray, values: FloatArray, gyro: BoolArray, source: str = "log"
) -> tuple[Sampling, tuple[Part, ...]]:
    """Readings on an even grid, in parts without long gaps, and how they were sampled.

    Parameters
    ----------
    t_s : (n,) time stamps that do not go back.
    values : (n, axes) finite readings.
    gyro : (axes,) which axes are rates of rotation; the others are specific forces.

    Raises
    ------
    BadInputError for fewer than two samples, and for stamps that are all the same.
    """
    if len(t_s) < 2:
        raise BadInputError(f"{source}: has {len(t_s)} IMU sample(s), expected a log at rest")
    again = (np.diff(t_s) == 0.0) & np.all(np.diff(values, axis=0) == 0.0, axis=1)
    rows = np.flatnonzero(np.concatenate([[True], ~again]))
    t, kept = t_s[rows], values[rows]
    period = _period_s(t, source)
    places, missing = _places(t, period)
    gaps, parts, jitter = [], [], []
    cuts = [0]
    for i in np.flatnonzero(missing).tolist():
        split = bool(missing[i] * period > SPLIT_S)
        gaps.append(Gap(float(t[i - 1]), float(t[i] - t[i - 1]), int(missing[i]), split))
        if split:
            cuts.append(i)
    for start, stop in zip(cuts, [*cuts[1:], len(t)], strict=True):
        local = places[start:stop] - places[start]
        grid = np.arange(int(local[-1]) + 1)
        filled = kept[start:stop]
        if len(grid) != stop - start:
            filled = np.stack([np.interp(grid, local, column) for column in filled.T], axis=1)
        parts.append(Part(float(t[start]), np.ascontiguousarray(filled), rows[start:stop], local))
        jitter.append(t[start:stop] - period * local)
    about = np.concatenate([late - np.median(late) for late in jitter])
    sampling = Sampling(
        samples=len(t),
        duration_s=period * sum(len(part.values) for part in parts),
        period_s=period,
        rate_hz=1.0 / period,
        jitter_s=float(1.4826 * np.median(np.abs(about))),
        repeated_rows=int(again.sum()),
        repeated_stamps=int((np.diff(t) == 0.0).sum()),
        gaps=tuple(gaps),
        step=np.array([_step(column) for column in kept.T]),
        at_limit=np.array(
            [_at_limit(column, bool(g)) for column, g in zip(kept.T, gyro, strict=True)], dtype=np.int64
        ),
    )
    return sampling, tuple(parts)
