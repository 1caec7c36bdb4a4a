"""Samples on ticks: jittered stamps, dropouts, duplicates, gaps, and other rates."""

from __future__ import annotations

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.lowpass.filters import on_ticks, sampling_rate_hz

T = np.arange(600) / 60.0
X = np.stack([np.arange(600.0), -np.arange(600.0)], axis=1)


def test_jittered_stamps_change_nothing() -> None:
    t = T + np.random.default_rng(0).uniform(-0.3, 0.3, 600) / 60.0
    ticks = on_ticks(np.sort(t), X, 60.0)
    assert len(ticks.pieces) == 1
    assert np.array_equal(ticks.longest.values, X)
    assert (ticks.held, ticks.dropped) == (0, 0)


def test_a_missing_sample_is_held() -> None:
    kept = np.delete(np.arange(600), [100, 101, 400])
    ticks = on_ticks(T[kept], X[kept], 60.0)
    values = ticks.longest.values
    assert len(values) == 600
    assert values[99:103, 0].tolist() == [99.0, 99.0, 99.0, 102.0]
    assert np.nonzero(ticks.longest.held)[0].tolist() == [100, 101, 400]


def test_of_duplicates_the_last_counts() -> None:
    rows = np.sort(np.append(np.arange(600), [50, 50, 599]))
    values = np.arange(603.0)[:, None]
    ticks = on_ticks(T[rows], values, 60.0)
    assert ticks.dropped == 3
    assert len(ticks.longest.values) == 600
    assert ticks.longest.values[50, 0] == 52.0
    assert ticks.longest.values[-1, 0] == 602.0


def test_a_long_gap_splits_and_a_short_one_does_not() -> None:
    t = np.concatenate([T[:200], T[200:] + 3600.0])
    ticks = on_ticks(t, X, 60.0)
    assert [len(piece.t_s) for piece in ticks.pieces] == [200, 400]
    assert ticks.longest.t_s[0] == pytest.approx(3600.0 + 200 / 60.0)
    assert ticks.held == 0
    assert len(on_ticks(np.concatenate([T[:200], T[200:] + 0.5]), X, 60.0).pieces) == 1


def test_half_the_rate_holds_every_second_tick() -> None:
    ticks = on_ticks(T[::2], X[::2], 60.0)
    assert ticks.held == 299
    assert ticks.longest.values[1::2, 0].tolist() == ticks.longest.values[:-1:2, 0].tolist()


def test_rates_and_what_has_none() -> None:
    assert sampling_rate_hz(T) == pytest.approx(60.0)
    assert sampling_rate_hz(np.sort(np.append(T, T))) == pytest.approx(60.0)
    for t in (np.array([1.0]), np.array([1.0, 1.0])):
        with pytest.raises(BadInputError, match="has no two samples at different times"):
            sampling_rate_hz(t)
    with pytest.raises(BadInputError, match="has no samples"):
        on_ticks(np.zeros(0), np.zeros((0, 2)), 60.0)
    assert len(on_ticks(np.array([5.0]), np.ones((1, 2)), 60.0).longest.t_s) == 1
