"""Held-out errors of filters, compared by a block bootstrap.

The errors of an angle are correlated over seconds, so that samples are no independent witnesses. A
circular block bootstrap (Politis and Romano, in Exploring the Limits of Bootstrap, 1992) draws runs of a
tenth of the log, 2 to 60 s. All filters are drawn with the same runs: what they have in common cancels
in their difference.

With m runs, about ten, the spread of the draws is too small and not well known. Runs about their common mean
lose a share 1 / m of the variance, and a variance from overlapping runs has 1.5 m degrees of freedom
(Kuensch, Annals of Statistics 17, 1989). So deviations from the estimate are widened by

    sqrt(m / (m - 1)) t(1.5 m) / z,   t and z the 97.5 % points of Student's and the normal distribution,

and intervals of an error, which is a scale, are those of its logarithm, turned about the estimate: an error
that was found too small was found with too small a spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t

from calib.arrays import FloatArray, IntArray
from calib.imu.mahony import Mahony

__all__ = ["CONFIDENCE", "Candidate", "Row", "compared", "rms"]

CONFIDENCE = 0.95
_RESAMPLES = 2000
_FINEST_S = 0.5
_MOST_BLOCKS = 600
_SEED = 20


@dataclass(frozen=True)
class Candidate:
    """A filter and its held-out errors.

    Attributes
    ----------
    name : "3/3", "tuned", "riccati", or one of these "from a prior".
    gains : those that would be used, of the settled filter.
    rmse_rad, low_rad, high_rad : held-out error and its 95 % interval.
    less_rad, less_low_rad, less_high_rad : error less that of 3/3, and its 95 % interval.
    confidence : share of the resamples in which it is less, NaN where nothing was judged.
    whole_rad : error of `gains` on the whole logs, which for "tuned" they were tuned on.
    """

    name: str
    gains: Mahony
    rmse_rad: float
    low_rad: float
    high_rad: float
    less_rad: float
    less_low_rad: float
    less_high_rad: float
    confidence: float
    whole_rad: float

    @property
    def wins(self) -> bool:
        """Whether its error is less than that of 3/3 with 95 %."""
        return self.confidence >= CONFIDENCE


@dataclass(frozen=True)
class Row:
    """A filter's errors (n_i,) in each piece, NaN where it is not judged, and its error on the whole."""

    name: str
    gains: Mahony
    errors_rad: Sequence[FloatArray]
    whole_rad: float


def _block_sums(errors: Sequence[FloatArray], size: int) -> tuple[FloatArray, FloatArray]:
    """Sums of squares and counts in consecutive blocks of `size` samples."""
    totals, counts = [], []
    for e in errors:
        known = np.isfinite(e)
        starts = np.arange(0, len(e), size)
        totals.append(np.add.reduceat(np.where(known, e, 0.0) ** 2, starts))
        counts.append(np.add.reduceat(known.astype(np.float64), starts))
    return np.concatenate(totals), np.concatenate(counts)


def _resampled(blocks: int, length: int) -> IntArray:
    """Numbers of the blocks (resamples, blocks) in runs of `length`, round the end."""
    rng = np.random.default_rng(_SEED)
    runs = -(-blocks // length)
    first = rng.integers(0, blocks, size=(_RESAMPLES, runs))
    at = (first[:, :, None] + np.arange(length)) % blocks
    return np.asarray(at.reshape(_RESAMPLES, -1)[:, :blocks])


def _widening(runs: float) -> float:
    """By how much deviations of the draws from the estimate are too small, for a number of runs."""
    m = max(runs, 2.0)
    return math.sqrt(m / (m - 1.0)) * float(t.ppf(0.975, 1.5 * m) / norm.ppf(0.975))


def rms(errors: Sequence[FloatArray]) -> float:
    """Root mean square of errors in several pieces, NaN not counted."""
    whole = np.concatenate(errors)
    return math.sqrt(float(np.nanmean(whole**2)))


def compared(rows: Sequence[Row], dt_s: float) -> tuple[tuple[Candidate, ...], float]:
    """Candidates of held-out errors, and the length of the bootstrap's blocks [s]; 3/3 comes first.

    Parameters
    ----------
    rows : all with errors of the same samples.
    """
    judged_s = dt_s * sum(int(np.isfinite(errors).sum()) for errors in rows[0].errors_rad)
    size = max(round(max(_FINEST_S, judged_s / _MOST_BLOCKS) / dt_s), 1)
    block_s = min(max(judged_s / 10.0, 2.0), 60.0)
    tables = [_block_sums(row.errors_rad, size) for row in rows]
    length = min(max(round(block_s / (size * dt_s)), 1), len(tables[0][0]))
    at = _resampled(len(tables[0][0]), length)
    drawn = [
        np.sqrt(total[at].sum(axis=1) / np.maximum(count[at].sum(axis=1), 1.0)) for total, count in tables
    ]
    base, wide = rms(rows[0].errors_rad), _widening(len(tables[0][0]) / length)
    out = []
    for row, draws in zip(rows, drawn, strict=True):
        rmse = rms(row.errors_rad)
        off = wide * (np.log(np.maximum(draws, 1e-300)) - math.log(max(rmse, 1e-300)))
        high, low = (rmse * np.exp(-np.quantile(off, [0.025, 0.975]))).tolist()
        less = rmse - base
        apart = less + wide * (draws - drawn[0] - less)
        less_low, less_high = np.quantile(apart, [0.025, 0.975]).tolist()
        confidence = float((apart < 0.0).mean())
        out.append(
            Candidate(
                row.name, row.gains, rmse, low, high, less, less_low, less_high, confidence, row.whole_rad
            )
        )
    return tuple(out), block_s
