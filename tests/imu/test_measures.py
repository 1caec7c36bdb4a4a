"""The slope's interval holds for noise of several kinds, the lag to a fraction of a sample."""

from __future__ import annotations

from collections.abc import Callable

import allantools
import numpy as np
import pytest
from scipy.signal import lfilter

from calib.imu.measures import allan_at, lag_s, slope_of

Noise = Callable[[np.random.Generator, int], np.ndarray]


def _white(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.normal(size=n)


def _forgetting(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.asarray(lfilter([1.0], [1.0, -0.99], rng.normal(size=n)))


def _walk(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.cumsum(rng.normal(size=n))


def _both(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.normal(size=n) + 0.03 * np.cumsum(rng.normal(size=n))


def test_the_slope_is_that_of_a_straight_line() -> None:
    t = 0.01 * np.arange(5000)
    y = 0.3 + 0.02 * t + _white(np.random.default_rng(0), 5000)
    assert slope_of([y], 0.01).value == pytest.approx(np.polyfit(t, y, 1)[0], rel=1e-9)
    # Each stretch has an offset of its own.
    pieces = [0.02 * t[:2000] + 5.0, 0.02 * t[2000:] - 7.0]
    assert slope_of(pieces, 0.01).value == pytest.approx(0.02, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [_white, _forgetting, _walk, _both])
@pytest.mark.parametrize("n", [1000, 6000])
def test_the_interval_holds_the_slope(noise: Noise, n: int) -> None:
    rng = np.random.default_rng(n)
    held, naive, values = 0, 0, []
    for _ in range(120):
        y = 0.5 * 0.01 * np.arange(n) + noise(rng, n)
        slope = slope_of([y], 0.01)
        held += slope.low <= 0.5 <= slope.high
        values.append(slope.value)
        t = 0.01 * (np.arange(n) - 0.5 * (n - 1))
        white = np.std(y - y.mean() - slope.value * t) / np.sqrt((t * t).sum())
        naive += abs(slope.value - 0.5) <= 1.96 * white
    # 0.95 less the four deviations of 120 tries is 0.87; mixed noise on a short log is the hardest.
    assert held >= (0.80 if noise is _both else 0.87) * 120
    if noise in (_forgetting, _walk):
        assert naive < 0.5 * 120
    # The interval is not bought by being useless.
    assert np.median(np.abs(values)) < 1e3


def test_a_certain_slope_and_one_that_is_not() -> None:
    rng = np.random.default_rng(1)
    sigmas = [slope_of([_white(rng, 6000)], 0.01).sigma for _ in range(15)]
    walk = slope_of([_walk(rng, 6000)], 0.01)
    ordinary = np.sqrt(12.0 / 6000) / 60.0
    # Slow noise that the log cannot exclude makes it larger.
    assert 0.8 * ordinary < np.median(sigmas) < 4.0 * ordinary
    assert walk.rho == 1.0
    # A walk of one per sample ends sqrt(6000) away in 60 s; a straight line's slope has 6 / 5 of that.
    assert walk.sigma == pytest.approx(np.sqrt(1.2 * 6000) / 60.0, rel=0.35)


def test_logs_that_are_too_short() -> None:
    assert np.isnan(slope_of([], 0.01).value)
    assert np.isnan(slope_of([np.ones(1)], 0.01).value)
    short = slope_of([np.arange(6.0)], 0.5)
    assert short.value == pytest.approx(2.0)
    assert np.isnan(short.sigma)
    still = slope_of([np.zeros(500)], 0.01)
    assert (still.value, still.sigma) == (0.0, 0.0)


def test_allan_deviation_against_allantools() -> None:
    y = _both(np.random.default_rng(2), 30000)
    for tau in (1.0, 100.0):
        _, found, _, _ = allantools.oadev(y, rate=100.0, data_type="freq", taus=[tau])
        assert allan_at([y], 0.01, tau) == pytest.approx(found[0], rel=1e-9)
    assert np.isnan(allan_at([y[:19000]], 0.01, 100.0))
    assert np.isnan(allan_at([], 0.01, 1.0))


@pytest.mark.parametrize("lag", [0.0, 0.0123, -0.0047, 0.1, 0.25])
def test_lag_to_a_fraction_of_a_sample(lag: float) -> None:
    t = 0.01 * np.arange(6000)

    def angle(at: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * np.sin(2.0 * at) + 0.2 * np.sin(9.0 * at + 1.0) + 0.1 * np.sin(3.3 * at))

    noisy = angle(t - lag) + 0.3 + 0.01 * t + 0.01 * np.random.default_rng(0).normal(size=len(t))
    assert lag_s([noisy[:2500], noisy[2500:]], [angle(t[:2500]), angle(t[2500:])], 0.01) == pytest.approx(
        lag, abs=5e-4
    )


def test_a_lag_that_cannot_be_told() -> None:
    rng = np.random.default_rng(0)
    truth = np.sin(0.05 * np.arange(3000))
    assert np.isnan(lag_s([rng.normal(size=3000)], [truth], 0.01))
    assert np.isnan(lag_s([truth], [np.zeros(3000)], 0.01))
    assert np.isnan(lag_s([truth[:50]], [truth[:50]], 0.01))
