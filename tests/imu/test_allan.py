"""Allan variance against published numbers and allantools; its covariance against Monte Carlo."""

from __future__ import annotations

import allantools
import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.allan import (
    allan_variance,
    bounds,
    covariance_forms,
    degrees_of_freedom,
    design,
    octaves,
    spaced,
)


def _nbs14() -> np.ndarray:
    n, out = 1234567890, []
    for _ in range(1000):
        out.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return np.array(out)


def test_the_published_set() -> None:
    found = np.sqrt(allan_variance([_nbs14()], np.array([1, 10, 100])))
    assert found == pytest.approx([0.2922319, 0.09159953, 0.03241343], rel=2e-7)


@pytest.mark.parametrize("walk", [0.0, 0.3])
def test_the_same_as_allantools(walk: float) -> None:
    rng = np.random.default_rng(1)
    y = 5.0 + rng.normal(size=5000) + walk * np.cumsum(rng.normal(size=5000))
    m = spaced(len(y))
    _, theirs, _, _ = allantools.oadev(y, rate=100.0, data_type="freq", taus=m / 100.0)
    assert np.allclose(np.sqrt(allan_variance([y], m)), theirs, rtol=1e-10)


def test_a_log_in_parts_gives_the_mean_over_its_second_differences() -> None:
    rng = np.random.default_rng(2)
    long, short, m = rng.normal(size=400), rng.normal(size=60), np.array([1, 8, 40])
    both = allan_variance([long, short, np.zeros(1)], m)
    one, other = allan_variance([long], m), allan_variance([short], m)
    assert np.isnan(other[2])
    M1, M2 = 401 - 2 * m, np.maximum(61 - 2 * m, 0)
    assert np.allclose(both, (one * M1 + np.nan_to_num(other) * M2) / (M1 + M2))
    with pytest.raises(BadInputError, match="found 0, expected 1 or more"):
        allan_variance([long], np.array([0]))


def test_averaging_factors() -> None:
    assert octaves(100).tolist() == [1, 2, 4, 8, 16]
    found = spaced(1000)
    assert found[0] == 1
    assert found[-1] <= 333
    assert len(set(found.tolist())) == len(found)


@pytest.mark.parametrize(("kind", "alpha"), [(0, 0), (1, -1), (2, -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(kind: int, alpha: int) -> None:
    theta = np.zeros(3)
    theta[kind] = 0.7
    for n in (1000, 50_000):
        # Their sums leave out what discrete samples add below sixteen.
        m = np.array([16, 50, 100, n // 4])
        theirs = [
            allantools.edf_greenhall(alpha, 2, int(k), n + 1, overlapping=True, modified=False) for k in m
        ]
        assert np.allclose(degrees_of_freedom(m, [n], theta), theirs, rtol=0.05)


def test_for_white_noise_they_are_those_of_the_handbook() -> None:
    n, m = 3000, np.array([1, 2, 3, 5, 20])
    theirs = [allantools.edf_simple(n + 1, int(k), 0) for k in m]
    assert np.allclose(degrees_of_freedom(m, [n], np.array([1.0, 0.0, 0.0])), theirs, rtol=0.02)


@pytest.mark.parametrize(("white", "walk"), [(1.0, 0.0), (0.0, 1.0), (1.0, 0.1)])
def test_the_covariance_of_variances_is_met(white: float, walk: float) -> None:
    rng, n, m = np.random.default_rng(3), 300, np.array([2, 8, 9, 32])
    found = []
    for _ in range(4000):
        y = white * rng.normal(size=n)
        if walk:
            # The mean of a walk over a sample, not its value at the end.
            fine = np.cumsum(rng.normal(size=10 * n)) / np.sqrt(10.0)
            y = y + walk * fine.reshape(n, 10).mean(axis=1)
        found.append(allan_variance([y], m))
    theta = np.array([white**2, 0.0, walk**2])
    expected = np.einsum("ijpq,p,q->ij", covariance_forms(m, [n]), theta, theta)
    size = np.sqrt(np.diag(expected))
    assert np.allclose(np.mean(found, axis=0), design(m) @ theta, rtol=0.03)
    assert np.allclose(
        np.cov(np.array(found).T) / np.outer(size, size), expected / np.outer(size, size), atol=0.1
    )


def test_bounds_hold_two_thirds_of_the_time() -> None:
    rng, n, m = np.random.default_rng(4), 400, np.array([1, 10, 50])
    freedom = degrees_of_freedom(m, [n], np.array([1.0, 0.0, 0.0]))
    inside = np.zeros(3)
    for _ in range(1500):
        low, high = bounds(allan_variance([rng.normal(size=n)], m), freedom)
        inside += (low < 1.0 / np.sqrt(m)) & (1.0 / np.sqrt(m) < high)
    assert np.allclose(inside / 1500, 0.683, atol=0.05)
