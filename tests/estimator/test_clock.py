"""Clocks: jitter goes, missing and repeated samples are counted, jumps start them again."""

from __future__ import annotations

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.clock import even_times, new_clock

PERIOD = 0.01


def jittered(count: int = 3000, jitter: float = 4e-4, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    true = 5.0 + 1.0002 * PERIOD * np.arange(count)
    return true, true + jitter * np.random.default_rng(seed).standard_normal(count)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_jitter_is_removed() -> None:
    true, stamps = jittered()
    error = even_times(new_clock(PERIOD), stamps) - true
    assert rms(error[500:]) < 0.15 * 4e-4


def test_missing_samples_are_counted() -> None:
    true, stamps = jittered()
    keep = np.random.default_rng(1).uniform(size=len(true)) > 0.1
    keep[1000:1040] = False
    error = even_times(new_clock(PERIOD), stamps[keep]) - true[keep]
    assert rms(error[500:]) < 0.2 * 4e-4
    assert np.abs(error[500:]).max() < 4e-4


def test_repeated_and_late_stamps_are_not_believed() -> None:
    true, stamps = jittered()
    stamps[700::97] = stamps[699:-1:97]
    stamps[750::301] += 4e-3
    error = even_times(new_clock(PERIOD), stamps) - true
    assert rms(error[500:]) < 0.15 * 4e-4


def test_a_slow_drift_is_followed() -> None:
    true, stamps = jittered(6000)
    drift = 1e-6 * np.cumsum(np.cumsum(np.full(6000, 1e-5)))
    error = even_times(new_clock(PERIOD), stamps + drift) - true - drift
    assert rms(error[1000:]) < 0.3 * 4e-4


def test_jumps_start_the_clock_again() -> None:
    true, stamps = jittered()
    for jump in (3600.0, -3.0, 0.005):
        moved, shifted = true.copy(), stamps.copy()
        moved[1500:] += jump
        shifted[1500:] += jump
        error = even_times(new_clock(PERIOD), shifted) - moved
        assert np.isfinite(error).all()
        assert rms(error[2200:]) < 0.3 * 4e-4


def test_each_time_rests_on_the_past_alone() -> None:
    _, stamps = jittered(400)
    whole = even_times(new_clock(PERIOD), stamps)
    np.testing.assert_array_equal(even_times(new_clock(PERIOD), stamps[:250]), whole[:250])


def test_without_a_period_stamps_stay() -> None:
    _, stamps = jittered(50)
    np.testing.assert_array_equal(even_times(new_clock(np.nan), stamps), stamps)
