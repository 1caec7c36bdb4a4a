"""Drift over serial numbers: recovery, an honest sigma by Monte Carlo, and rigs that stand out."""

from __future__ import annotations

import numpy as np
import pytest

from calib.core.arrays import FloatArray
from calib.runner.fleet import Drift, drift_limit, drift_of, spread_of


def _line(t: FloatArray, x: FloatArray, sigma: FloatArray) -> Drift:
    found = drift_of(t, x, sigma, spread_of(x, sigma))
    assert found is not None
    return found


def _drawn(rng: np.random.Generator, n: int, slope: float, dirty: float) -> Drift:
    t = 5000.0 + np.arange(n)
    sigma = rng.uniform(0.3, 1.0, n)
    x = 273.0 + slope * (t - 5000.0) + rng.standard_normal(n) + sigma * rng.standard_normal(n)
    bad = rng.random(n) < dirty
    x[bad] += 60.0 * rng.choice([-1.0, 1.0], int(bad.sum()))
    return _line(t, x, sigma)


@pytest.mark.parametrize(("n", "dirty"), [(20, 0.0), (100, 0.0), (100, 0.1)])
def test_the_slope_is_as_good_as_its_sigma_says(n: int, dirty: float) -> None:
    rng = np.random.default_rng(n)
    pulls = []
    for _ in range(400):
        found = _drawn(rng, n, 0.02, dirty)
        pulls.append((found.slope - 0.02) / found.sigma)
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(400)
    assert 0.85 < np.std(pulls) < 1.25


def test_a_drift_is_beyond_the_limit_and_chance_is_not() -> None:
    rng = np.random.default_rng(1)
    limit = drift_limit(100, 20)
    assert abs(_drawn(rng, 100, 0.04, 0.05).z) > limit
    still = [abs(_drawn(rng, 100, 0.0, 0.0).z) > limit for _ in range(300)]
    assert np.mean(still) < 0.02


def test_numbers_do_not_have_to_be_small_or_in_order() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(40, dtype=np.float64)
    x = 1e-3 * t + 1e-4 * rng.standard_normal(40)
    sigma = np.full(40, 1e-5)
    near = _line(t, x, sigma)
    mixed = rng.permutation(40)
    far = _line(1e9 + 1000.0 * t[mixed], x[mixed], sigma[mixed])
    assert 1000.0 * far.slope == pytest.approx(near.slope, rel=1e-6)
    assert 1000.0 * far.sigma == pytest.approx(near.sigma, rel=1e-6)
