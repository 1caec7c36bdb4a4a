"""NEES, NIS and whiteness of numbers whose distribution is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from calib.arrays import FloatArray
from calib.estimator.consistency import Tally, chi_square_band, correlation_band, nees
from calib.estimator.setup import OUT

R = 0.0125


def made(count: int, seed: int = 0, inflation: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Output rows with errors of a known covariance of length and angle, and the truth."""
    rng = np.random.default_rng(seed)
    C = np.array([[1e-8, 3e-8], [3e-8, 4e-6]])
    error = rng.multivariate_normal([0.0, 0.0], C, count)
    out = np.full((count, len(OUT)), np.nan)
    out[:, 0] = 0.01 * np.arange(count)
    length, phi = 0.07 + error[:, 0], 0.2 + error[:, 1]
    out[:, 1], out[:, 2], out[:, 5] = length + R * phi, length - R * phi, phi
    for k, sign in ((10, 1.0), (11, -1.0)):
        out[:, k] = np.sqrt(C[0, 0] + R**2 * C[1, 1] + 2.0 * sign * R * C[0, 1]) * inflation
    out[:, 12] = np.sqrt(C[1, 1]) * inflation
    for column in ("nis_camera", "nis_accel"):
        out[:, OUT.index(column)] = rng.chisquare(2, count)
    e = rng.standard_normal((count, 5))
    out[:, OUT.index("e_u") : OUT.index("e_u") + 5] = e
    out[:, OUT.index("nis_gyro")] = e[:, 4] ** 2
    out[:, OUT.index("gated_camera") : OUT.index("gated_camera") + 3] = 0.0
    out[:, OUT.index("log_likelihood")] = 1.0
    out[:, OUT.index("flags")] = 0.0
    truth = np.tile([0.07 + R * 0.2, 0.07 - R * 0.2, 0.2], (count, 1))
    return out, truth


def test_nees_of_an_honest_covariance_is_two() -> None:
    out, truth = made(20_000)
    values = nees(out, truth[:, :2], truth[:, 2], R)
    low, high = chi_square_band(2, len(values))
    assert low < values.mean() < high
    out, truth = made(20_000, inflation=0.5)
    assert nees(out, truth[:, :2], truth[:, 2], R).mean() == pytest.approx(8.0, rel=0.05)


def test_bands_are_those_of_chi_square() -> None:
    low, high = chi_square_band(2, 100)
    assert low == pytest.approx(chi2.ppf(0.025, 200) / 100)
    assert high == pytest.approx(chi2.ppf(0.975, 200) / 100)
    assert correlation_band(10_000) == pytest.approx(0.0196)


def test_tally_of_blocks_is_that_of_the_whole() -> None:
    out, truth = made(3000)
    whole, parts = Tally(R), Tally(R)
    whole.add(out, truth)
    for a, b in ((0, 1), (1, 500), (500, 500), (500, 3000)):
        parts.add(out[a:b], truth[a:b])
    assert whole.rmse() == pytest.approx(parts.rmse())
    for name in ("camera", "accel", "gyro"):
        one, other = whole.check(name), parts.check(name)
        assert one is not None and other is not None
        assert one.nis == pytest.approx(other.nis)
        assert one.correlation == pytest.approx(other.correlation)
        assert one.low < one.nis < one.high
        assert abs(one.correlation) < 2.0 * one.bound
        assert one.inside == pytest.approx(0.95, abs=0.02)
    assert whole.log_likelihood == pytest.approx(3000.0)


def test_coloured_innovations_are_seen() -> None:
    out, _ = made(3000)
    column = OUT.index("e_u")
    out[1:, column] = 0.8 * out[:-1, column] + 0.6 * out[1:, column]
    tally = Tally(R)
    tally.add(out)
    check = tally.check("camera")
    assert check is not None and check.correlation > 5.0 * check.bound
    assert tally.rmse() == {}


def test_a_sensor_that_never_spoke_has_no_verdict() -> None:
    out, _ = made(500)
    out[:, OUT.index("gated_gyro")] = np.nan
    tally = Tally(R)
    tally.add(out)
    assert tally.check("gyro") is None
