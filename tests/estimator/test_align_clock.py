"""Even times of whole logs: counting through repeated stamps, gaps and jitter."""

from __future__ import annotations

import numpy as np
import pytest

from calib.arrays import FloatArray
from calib.estimator.align_clock import even_times_of


def _stamped(taken: FloatArray, jitter: float, repeated: float, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    t = np.maximum.accumulate(taken + jitter * rng.standard_normal(len(taken)))
    for i in np.flatnonzero(rng.random(len(t)) < repeated):
        t[i] = t[max(i - 1, 0)]
    return t


@pytest.mark.parametrize("seed", range(5))
def test_jitter_and_repeated_stamps_leave_microseconds(seed: int) -> None:
    taken = 3.0 + 0.0100003 * np.arange(4000)
    found = even_times_of(_stamped(taken, 4e-4, 0.002, seed))
    # The line through 4000 stamps has the deviation 2 * 0.4 ms / sqrt(4000) at its ends; four of that.
    assert np.abs(found.t_s - taken).max() < 4 * 2 * 4e-4 / np.sqrt(4000)
    # Its slope has the deviation 0.4 ms sqrt(12 / 4000^3), and four of that are allowed.
    assert found.period_s == pytest.approx(0.0100003, abs=4 * 4e-4 * np.sqrt(12 / 4000**3))
    assert found.jitter_s == pytest.approx(4e-4, rel=0.1)
    assert found.missing == 0
    assert found.repeated > 0


def test_missing_samples_are_counted() -> None:
    taken = np.arange(3000) / 60.0
    keep = np.ones(3000, dtype=bool)
    keep[500:524] = False
    keep[np.random.default_rng(1).integers(600, 2900, 30)] = False
    found = even_times_of(_stamped(taken[keep], 2e-4, 0.0, 2))
    assert found.missing == int((~keep).sum())
    assert np.abs(found.t_s - taken[keep]).max() < 5e-5


def test_a_clock_that_wanders_is_followed() -> None:
    taken = 0.01 * np.arange(12000)
    wander = 3e-3 * np.sin(2.0 * np.pi * taken / 90.0)
    found = even_times_of(_stamped(taken + wander, 4e-4, 0.0, 3))
    # The blocks' medians follow it; without them the line would leave millimetres of seconds.
    middle = slice(500, -500)
    assert np.abs(found.t_s - taken - wander)[middle].max() < 4e-4


def test_stamps_that_are_not_steady_stay() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.001, 0.05, 400))
    found = even_times_of(t)
    assert np.isnan(found.period_s)
    assert np.array_equal(found.t_s, t)
    assert np.array_equal(even_times_of(t[:4]).t_s, t[:4])


def test_short_stretches_are_counted_too() -> None:
    taken = 3602.0 + 0.01 * np.arange(120)
    for seed in range(300):
        found = even_times_of(_stamped(taken, 4e-4, 0.005, seed))
        assert found.missing == 0
        assert np.abs(found.t_s - taken).max() < 6 * 2 * 4e-4 / np.sqrt(120)
