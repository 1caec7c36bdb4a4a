"""The smoothed angle of a log: nearer to the truth than any filter, and as near as it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armlogs import swung

from calib.errors import BadInputError
from calib.imu.mahony import Mahony
from calib.imu.mahony_batch import filter_log
from calib.imu.smoother import SHORTEST_S, smooth_log

N, K = math.radians(0.01), 1e-4


def _spread(error: np.ndarray) -> float:
    return float((error - error.mean()).std())


@pytest.mark.parametrize("seed", range(4))
def test_beats_the_filter_on_a_swung_arm(seed: int) -> None:
    arm = swung(seed)
    found = smooth_log(arm.t_s, arm.phi_acc, -arm.gz, N, K)
    filtered = filter_log(Mahony(), arm.t_s, arm.phi_acc, -arm.gz)[0]
    assert _spread(found.phi_rad - arm.phi) < 0.3 * _spread(filtered - arm.phi)
    assert found.bias_radps == pytest.approx(0.005, abs=2e-3)


def test_a_straight_model_is_met_with_the_deviation_that_it_says() -> None:
    ratios, noise = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        t = 0.01 * np.arange(3000)
        phi = 0.3 * np.sin(0.5 * t)
        bias = 0.05 * rng.normal()
        rate = 0.15 * np.cos(0.5 * t) + bias + N / 0.1 * rng.normal(size=3000)
        # The rate of a sample holds for the step before it.
        rate[1:] += np.diff(phi) / 0.01 - 0.15 * np.cos(0.5 * t[1:])
        acc = phi + 0.02 * rng.normal(size=3000)
        found = smooth_log(t, acc, rate, N, K)
        ratios.append(np.sqrt(np.mean((found.phi_rad - phi) ** 2)) / found.sigma_rad)
        noise.append(found.accel_noise)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.35)
    assert np.median(noise) == pytest.approx(0.02 * 0.1, rel=0.5)


def test_finds_the_lever_and_what_the_rate_lacks() -> None:
    arm = swung(5, duration_s=60.0, amplitude_rad=0.8, lever_m=0.3)
    found = smooth_log(arm.t_s, arm.phi_acc, -arm.gz, N, K)
    assert abs(found.lever_m[0]) == pytest.approx(0.3, abs=0.05)
    wrong = -arm.gz + 0.2 * np.random.default_rng(0).normal(size=len(arm.t_s))
    assert smooth_log(arm.t_s, arm.phi_acc, wrong, N, K).gyro_noise > 3.0 * found.gyro_noise


def test_turns_and_a_gap() -> None:
    t = 0.01 * np.arange(3000)
    t[1500:] += 0.4
    phi = 1.5 * t
    found = smooth_log(t, np.angle(np.exp(1j * phi)), np.full(3000, 1.5), N, K)
    assert np.abs(found.phi_rad - phi).max() < 0.02


def test_needs_some_seconds() -> None:
    t = 0.01 * np.arange(300)
    with pytest.raises(BadInputError, match=f"expected at least {SHORTEST_S:g} s"):
        smooth_log(t, np.zeros(300), np.zeros(300), N, K)
