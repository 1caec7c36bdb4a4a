"""N, B and K from known noise: recovered within their intervals, and only where the log shows them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from calib.errors import BadInputError
from calib.imu.allan_fit import analyse, model_variance

RATE_HZ = 100.0


def _readings(n: int, N: float, K: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = np.cumsum(K / np.sqrt(RATE_HZ) * rng.normal(size=n))
    return 0.01 + N * np.sqrt(RATE_HZ) * rng.normal(size=n) + walk


def test_white_noise_is_recovered_and_nothing_is_made_up() -> None:
    N, z, inside, made_up = 1e-3, [], 0, 0
    for seed in range(60):
        found = analyse([_readings(6000, N, 0.0, seed)], 1.0 / RATE_HZ)
        z.append((found.N.value - N) / found.N.sigma)
        inside += found.N.low <= N <= found.N.high
        made_up += found.K.supported + found.B.supported
    assert abs(np.mean(z)) < 0.5
    assert 0.75 < np.std(z) < 1.3
    assert inside >= 52
    assert made_up <= 3


@pytest.mark.slow
def test_a_random_walk_is_recovered_from_a_long_log() -> None:
    N, K, inside, values = 1e-3, 1e-3, 0, []
    for seed in range(40):
        found = analyse([_readings(60_000, N, K, seed)], 1.0 / RATE_HZ)
        assert found.K.supported
        inside += found.K.low <= K <= found.K.high
        values.append(found.K.value / K)
    assert inside >= 35
    assert np.median(values) == pytest.approx(1.0, abs=0.1)


def test_what_a_short_log_cannot_show_gets_a_bound() -> None:
    N, K, held = 1e-3, 1e-4, 0
    for seed in range(40):
        found = analyse([_readings(6000, N, K, seed)], 1.0 / RATE_HZ)
        held += found.K.supported or found.K.below > K
        assert found.K.supported or np.isnan(found.K.value)
        assert found.walk_within > 0.0
    assert held >= 36


def test_flicker_noise_is_taken_for_bias_instability() -> None:
    # White noise of variance 1 at the period tau0 has the two-sided density tau0. Filtered by
    # (1 - 1/z)^(-1/2) it has 1 / (2 pi f) at low frequencies, which is B^2 / (2 pi f) with B = 1.
    B, n, rng = 2e-3, 60_000, np.random.default_rng(5)
    k = np.arange(1, n)
    kernel = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
    size = 1 << 17
    white = rng.normal(size=n)
    flicker = np.fft.irfft(np.fft.rfft(kernel, size) * np.fft.rfft(white, size), size)[:n]
    found = analyse([B * flicker + 1e-3 * np.sqrt(RATE_HZ) * rng.normal(size=n)], 1.0 / RATE_HZ)
    assert found.B.supported
    assert found.B.value == pytest.approx(B, rel=0.2)


def test_the_fit_begins_where_a_filter_in_the_sensor_ends() -> None:
    rng, N = np.random.default_rng(6), 1e-3
    smooth = lfilter([0.25], [1.0, -0.75], N * np.sqrt(RATE_HZ) * rng.normal(size=60_000))
    found = analyse([smooth], 1.0 / RATE_HZ)
    assert found.fit_s[0] >= 0.08
    assert found.N.value == pytest.approx(N, rel=0.05)


def test_the_curve_and_its_bounds() -> None:
    found = analyse([_readings(6000, 1e-3, 0.0, 1)], 1.0 / RATE_HZ)
    assert np.all((found.low < found.deviation) & (found.deviation < found.high))
    assert np.all(np.diff(found.freedom) < 0.0)
    whole = np.sqrt(model_variance(found.theta, found.tau_s).sum(axis=1))
    assert np.allclose(whole[:10], found.deviation[:10], rtol=0.1)


def test_what_cannot_be_analysed() -> None:
    with pytest.raises(BadInputError, match="found 10 in a row, expected at least 64"):
        analyse([np.arange(10.0)], 0.01)
    with pytest.raises(BadInputError, match="never change"):
        analyse([np.ones(100)], 0.01)
