"""Stretches in which a sensor is held still, found by the spread of its specific forces.

A reading is at rest where the spread in a window about it,

    zeta = sqrt(var_x^2 + var_y^2 + var_z^2),

is below a multiple of what it is while the sensor lies still at the start of the log (Tedaldi, Pretto and
Menegatti, ICRA 2014, eq. 12). Which multiple is right depends on the sensor and on the table; whoever fits
a model to the rests tries those of `MULTIPLES` and keeps the one with the least residual.

Where the log does not begin at rest, its quietest windows are the measure instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.imu.sampling import Part

__all__ = ["MULTIPLES", "WINDOW_S", "Quiet", "Rest", "Spread", "find_rests", "quiet_level", "spread"]

MULTIPLES = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0)
WINDOW_S = 1.0
_LEAST_REST_S = 1.0
_FEWEST = 21
_LEAST_INITIAL_S = 3.0
_QUIET_QUANTILE = 0.03
_TIMES_QUIET = 12.0
_BATCH_S = 0.25


@dataclass(frozen=True)
class Spread:
    """zeta about each reading of each part, and the window's length in samples."""

    zeta: tuple[FloatArray, ...]
    window: int
    period_s: float


@dataclass(frozen=True)
class Quiet:
    """What zeta is at rest, and how long the rest at the start of the log is; 0 s where there is none."""

    zeta: float
    initial_s: float


@dataclass(frozen=True)
class Rest:
    """A stretch at rest.

    Attributes
    ----------
    part, start, stop : number of the part, first sample, and the one behind the last.
    from_s, to_s : the same as time stamps.
    mean : (d,) of the readings.
    scatter : (d,) long-run variance of a reading: that of a mean of n readings is scatter / n.
    """

    part: int
    start: int
    stop: int
    from_s: float
    to_s: float
    mean: FloatArray
    scatter: FloatArray

    @property
    def samples(self) -> int:
        """Number of readings."""
        return self.stop - self.start

    @property
    def duration_s(self) -> float:
        """Length in seconds."""
        return self.to_s - self.from_s


def _moving_variance(values: FloatArray, size: int) -> FloatArray:
    """Variance (n - size + 1, d) in each window."""
    centred = values - values.mean(axis=0)
    zero = np.zeros((1, values.shape[1]))
    first = np.concatenate([zero, np.cumsum(centred, axis=0)])
    second = np.concatenate([zero, np.cumsum(centred**2, axis=0)])
    mean = (first[size:] - first[:-size]) / size
    return np.asarray(np.maximum((second[size:] - second[:-size]) / size - mean**2, 0.0))


def spread(parts: tuple[Part, ...], columns: list[int], period_s: float) -> Spread:
    """zeta of the given columns; infinite in parts that are shorter than a window.

    Parameters
    ----------
    parts : readings on an even grid.
    columns : those of the accelerometer.
    """
    size = max(_FEWEST, round(WINDOW_S / period_s) | 1)
    out = []
    for part in parts:
        zeta = np.full(len(part.values), math.inf)
        if len(part.values) >= size:
            inner = np.sqrt((_moving_variance(part.values[:, columns], size) ** 2).sum(axis=1))
            half = size // 2
            zeta[half : half + len(inner)] = inner
            zeta[:half], zeta[half + len(inner) :] = inner[0], inner[-1]
        out.append(zeta)
    return Spread(tuple(out), size, period_s)


def quiet_level(s: Spread, step: FloatArray) -> Quiet:
    """What zeta is at rest, from the start of the log where that is still.

    Parameters
    ----------
    step : (d,) quantisation steps, NaN for none; no reading is known better than its step.
    """
    zeta = np.concatenate([one[np.isfinite(one)] for one in s.zeta])
    floor = float(np.linalg.norm(np.nan_to_num(step) ** 2 / 12.0))
    if len(zeta) == 0:
        return Quiet(floor, 0.0)
    quietest = max(float(np.quantile(zeta, _QUIET_QUANTILE)), floor)
    moves = np.flatnonzero(s.zeta[0] > _TIMES_QUIET * quietest)
    initial = int(moves[0]) if len(moves) else len(s.zeta[0])
    if initial * s.period_s >= _LEAST_INITIAL_S:
        return Quiet(max(float(np.median(s.zeta[0][:initial])), floor), initial * s.period_s)
    return Quiet(1.3 * quietest, 0.0)


def _scatter(values: FloatArray, period_s: float) -> FloatArray:
    """Long-run variance (d,): that of means over a batch times its length, which counts correlation."""
    size = max(1, round(_BATCH_S / period_s))
    count = len(values) // size
    if count < 3:
        return np.asarray(values.var(axis=0, ddof=1))
    means = values[: count * size].reshape(count, size, -1).mean(axis=1)
    # Differences of neighbours, as a drift over the rest is no noise of its mean.
    return np.asarray(size * (np.diff(means, axis=0) ** 2).mean(axis=0) / 2.0)


def find_rests(parts: tuple[Part, ...], columns: list[int], s: Spread, threshold: float) -> tuple[Rest, ...]:
    """Stretches of at least a second in which zeta stays below the threshold, in order of time."""
    least = max(_FEWEST, round(_LEAST_REST_S / s.period_s))
    rests = []
    for number, (part, zeta) in enumerate(zip(parts, s.zeta, strict=True)):
        still = np.concatenate([[False], zeta <= threshold, [False]]).astype(np.int64)
        starts, stops = np.flatnonzero(np.diff(still) == 1), np.flatnonzero(np.diff(still) == -1)
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
            if stop - start < least:
                continue
            values = part.values[start:stop][:, columns]
            at = part.start_s + s.period_s * np.array([start, stop])
            rests.append(
                Rest(
                    number,
                    start,
                    stop,
                    float(at[0]),
                    float(at[1]),
                    values.mean(axis=0),
                    _scatter(values, s.period_s),
                )
            )
    return tuple(rests)
