"""Robust z against the fleet: identities, outliers that are found, and how often chance is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.runner.fleet import limit_of, robust_z, spread_of


def test_own_sigma_takes_its_part_of_the_spread_and_of_z() -> None:
    x = np.array([-1.0, 0.0, 1.0])
    found = spread_of(x, np.array([1.0, 1.0, 1.0]))
    assert found.between**2 + 1.0 == pytest.approx(found.scale**2)
    # A rig that is itself poorly known stands out less at the same distance.
    z = robust_z(np.array([1.0, 1.0]), np.array([1.0, 5.0]), found)
    assert z[0] == pytest.approx(1.0 / found.scale) and 0.0 < z[1] < z[0]


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=40),
    st.floats(0.1, 10.0),
    st.floats(-1e3, 1e3),
)
def test_z_does_not_depend_on_units(values: list[float], factor: float, shift: float) -> None:
    x = np.round(np.array(values), 3)
    sigma = np.full(len(x), 0.25)
    z = robust_z(x, sigma, spread_of(x, sigma))
    y, bars = factor * x + shift, factor * sigma
    np.testing.assert_allclose(robust_z(y, bars, spread_of(y, bars)), z, rtol=1e-5, atol=1e-5)


def test_chance_alone_is_beyond_the_limit_in_about_one_fleet_of_twenty() -> None:
    rng = np.random.default_rng(5)
    trials, constants = 250, 12
    for rigs in (20, 200):
        limit, false = limit_of(rigs, constants), 0
        for _ in range(trials):
            sigma = rng.uniform(0.3, 1.0, (constants, rigs))
            x = 5.0 + rng.standard_normal((constants, rigs)) + sigma * rng.standard_normal((constants, rigs))
            z = [robust_z(x[k], sigma[k], spread_of(x[k], sigma[k])) for k in range(constants)]
            false += bool((np.abs(z) > limit).any())
        # 5 % plus what the subtraction of the rigs' own sigma adds; three deviations of so many trials.
        assert false / trials < 0.05 + 0.03 + 3.0 * np.sqrt(0.05 * 0.95 / trials)
    assert limit_of(8, 1) > limit_of(50, 1) > 3.5 and limit_of(5000, 9) > limit_of(5000, 1)


def test_a_fifth_of_bad_rigs_does_not_hide_itself() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal(100)
    x[:20] += 12.0
    sigma = np.full(100, 0.1)
    z = robust_z(x, sigma, spread_of(x, sigma))
    limit = limit_of(100, 10)
    assert (np.abs(z[:20]) > limit).all() and not (np.abs(z[20:]) > limit).any()
