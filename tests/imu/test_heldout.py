"""Held-out errors and their bootstrap: what is known beforehand is found."""

from __future__ import annotations

import numpy as np
import pytest

from calib.imu.heldout import Row, compared, rms
from calib.imu.mahony import Mahony


def _coloured(rng: np.random.Generator, n: int, scale: float, kept: float = 0.98) -> np.ndarray:
    out = np.empty(n)
    value = rng.normal()
    for k, step in enumerate((rng.normal(size=n) * np.sqrt(1.0 - kept**2)).tolist()):
        value = kept * value + step
        out[k] = value
    return scale * out


def _rows(errors: list[list[np.ndarray]]) -> list[Row]:
    return [Row(f"{k}", Mahony(), e, rms(e)) for k, e in enumerate(errors)]


def test_equal_filters_win_as_rarely_as_they_should() -> None:
    wins = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        pair = [[_coloured(rng, 3000, 1.0)] for _ in range(2)]
        wins += compared(_rows(pair), 0.01)[0][1].wins
    # 5 % nominally; more than 10 of 100 come in one of a hundred such tests.
    assert wins <= 10


def test_interval_covers_the_error() -> None:
    inside = 0
    for seed in range(120):
        errors = [_coloured(np.random.default_rng(seed), 3000, 2.0, 0.9)]
        one = compared(_rows([errors]), 0.01)[0][0]
        inside += one.low_rad < 2.0 < one.high_rad
    # 95 % nominally; of ten runs of a coloured log it is about 92 %.
    assert inside >= 106


def test_half_the_error_wins_and_missing_samples_do_not_count() -> None:
    rng = np.random.default_rng(0)
    base = [_coloured(rng, 2000, 1.0), _coloured(rng, 1000, 1.0)]
    base[0][100:300] = np.nan
    (first, better), block_s = compared(_rows([base, [0.5 * e for e in base]]), 0.01)
    assert block_s == pytest.approx(2.8)
    assert better.rmse_rad == pytest.approx(0.5 * first.rmse_rad)
    assert better.less_rad == pytest.approx(-0.5 * first.rmse_rad)
    assert better.less_low_rad < better.less_rad < better.less_high_rad < 0.0
    assert (better.wins, better.confidence, first.wins) == (True, 1.0, False)
    known = np.concatenate(base)
    assert first.rmse_rad == pytest.approx(np.sqrt(np.nanmean(known**2)))
