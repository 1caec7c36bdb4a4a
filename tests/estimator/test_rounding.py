"""Moments of truncated normal numbers, and what averaging rounded readings is worth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import truncnorm

from calib.estimator.rounding import truncated, update_terms


@pytest.mark.parametrize("a", [-9.0, -5.0, -1.3, -0.4, -0.05, 0.0, 0.7, 3.0, 5.9, 6.1, 9.0])
@pytest.mark.parametrize("width", [0.01, 0.3, 1.0, 4.0])
def test_moments_agree_with_scipy(a: float, width: float) -> None:
    log_z, mean, variance = truncated(a, a + width)
    expected = truncnorm(a, a + width)
    tail = min(abs(a), abs(a + width)) > 6.0 and a * (a + width) > 0.0
    assert mean == pytest.approx(float(expected.mean()), rel=2e-2 if tail else 1e-6, abs=1e-6)
    assert variance == pytest.approx(float(expected.var()), rel=0.15 if tail else 1e-3)
    z = expected.pdf(a + 0.5 * width)
    middle = a + 0.5 * width
    density = -0.5 * middle * middle - 0.5 * math.log(2.0 * math.pi)
    assert log_z == pytest.approx(density - math.log(float(z)), rel=1e-2, abs=1e-5)


def test_mirrored_intervals_have_mirrored_moments() -> None:
    for a, b in ((0.2, 1.0), (-0.3, 2.0), (7.0, 7.5)):
        one, other = truncated(a, b), truncated(-b, -a)
        assert one[0] == pytest.approx(other[0])
        assert one[1] == pytest.approx(-other[1])
        assert one[2] == pytest.approx(other[2])


def test_without_a_grid_it_is_a_gaussian_reading() -> None:
    y, S, log_l = update_terms(0.4, 0.5, 0.2, 0.0)
    assert (y, S) == (0.4, 0.7)
    assert log_l == pytest.approx(-0.5 * (0.16 / 0.7 + math.log(2.0 * math.pi * 0.7)))


def test_equivalent_reading_gives_the_truncated_moments() -> None:
    spread, jitter, innovation = 0.3, 0.09, 0.35
    S0 = spread + jitter
    y, S, _ = update_terms(innovation, spread, jitter, 1.0)
    root = math.sqrt(S0)
    _, mean, variance = truncated((innovation - 0.5) / root, (innovation + 0.5) / root)
    assert spread / S * y == pytest.approx(spread / S0 * root * mean)
    after = spread - spread**2 / S
    assert after == pytest.approx(spread - (spread / S0) ** 2 * (S0 - variance * S0))


def test_a_wide_interval_says_nothing() -> None:
    y, S, _ = update_terms(0.0, 1e-8, 1e-8, 1.0)
    assert y == 0.0 and S > 1.0


def _average(jitter: float, rounded: bool, trials: int, count: int) -> float:
    """Mean squared error over variance of a constant that is estimated from whole numbers."""
    rng = np.random.default_rng(2)
    total = 0.0
    for _ in range(trials):
        place = rng.uniform(-0.5, 0.5)
        m, P = 0.0, 1.0
        for z in np.rint(place + jitter * rng.standard_normal(count)):
            if rounded:
                y, S, _ = update_terms(z - m, P, jitter**2, 1.0)
            else:
                y, S = z - m, P + jitter**2 + 1.0 / 12.0
            m, P = m + P / S * y, P - P * P / S
        total += (m - place) ** 2 / P
    return total / trials


def test_intervals_are_honest_where_gaussian_noise_of_the_same_variance_is_not() -> None:
    assert _average(0.15, True, 200, 400) < 3.0
    assert _average(0.15, False, 200, 400) > 10.0
    assert 0.6 < _average(0.4, True, 200, 200) < 1.5
