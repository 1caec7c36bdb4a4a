"""Gains that start from a prior: against a Kalman filter written out, and how soon the bias is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.gains import Noise, predicted_sigma, riccati
from calib.imu.mahony import Mahony, MahonyState
from calib.imu.mahony_batch import filter_log
from calib.imu.mahony_kalman import Prior, filter_from_prior

DT = 0.01
NOISE = Noise(math.radians(0.05), 2e-4, math.radians(0.1))


def test_is_the_kalman_filter_of_angle_and_bias() -> None:
    rng = np.random.default_rng(0)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.02, 299))])
    acc, w = 0.02 * rng.normal(size=300), 0.1 * rng.normal(size=300)
    found = filter_from_prior(NOISE, Prior(), t, acc, w, MahonyState(0.1, 0.02))
    x, P = np.array([0.1, 0.02]), np.diag([0.1**2, 0.05**2])
    h = np.array([1.0, 0.0])
    for k in range(1, 300):
        dt = t[k] - t[k - 1]
        F = np.array([[1.0, dt], [0.0, 1.0]])
        S = h @ P @ h + NOISE.accel**2 / dt
        gain = P @ h / S
        x = x + gain * (acc[k] - h @ x)
        P = P - np.outer(gain, h @ P)
        x = F @ x + [w[k] * dt, 0.0]
        P = F @ P @ F.T + np.diag([NOISE.gyro**2, NOISE.walk**2]) * dt
        assert found.phi_rad[k] == pytest.approx(x[0], abs=1e-12)
        assert found.integral_radps[k] == pytest.approx(x[1], abs=1e-12)
        assert found.sigma_bias_radps[k] == pytest.approx(math.sqrt(P[1, 1]), rel=1e-9)


def test_settles_to_riccatis_gains() -> None:
    t = DT * np.arange(30_000)
    found = filter_from_prior(NOISE, Prior(), t, np.zeros(len(t)), np.zeros(len(t)))
    settled = riccati(NOISE, DT)
    assert found.Kp_per_s[-1] == pytest.approx(settled.Kp, rel=1e-3)
    assert found.Ki_per_s2[-1] == pytest.approx(settled.Ki, rel=1e-3)
    assert found.sigma_phi_rad[-1] == pytest.approx(predicted_sigma(settled, NOISE, DT), rel=1e-3)


def test_a_bias_is_known_after_a_second_and_as_well_as_the_filter_says() -> None:
    rng = np.random.default_rng(1)
    t = DT * np.arange(101)
    errors, slow = [], []
    for _ in range(200):
        bias = 0.05 * rng.normal()
        acc = NOISE.accel / math.sqrt(DT) * rng.normal(size=101)
        w = bias + NOISE.gyro / math.sqrt(DT) * rng.normal(size=101)
        found = filter_from_prior(NOISE, Prior(), t, acc, w, MahonyState(0.1 * rng.normal()))
        errors.append((found.integral_radps[-1] + bias) / found.sigma_bias_radps[-1])
        settled = riccati(NOISE, DT)
        slow.append(abs(filter_log(settled, t, acc, w)[1][-1] + bias))
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)
    assert found.sigma_bias_radps[-1] < 0.2 * np.sqrt(np.mean(np.square(slow)))


def test_repeated_stamps_and_turns() -> None:
    t = np.repeat(DT * np.arange(500), 2)
    turn = 3.0 * t
    found = filter_from_prior(NOISE, Prior(), t, np.angle(np.exp(1j * turn)), np.full(1000, 3.0))
    assert np.abs(found.phi_rad[200:] - turn[200:]).max() < 0.05
    assert found.phi_rad[-1] > 4.0 * math.pi


def test_bad_logs() -> None:
    for t, acc in (([0.0, -1.0], [0.0, 0.0]), ([0.0, 1.0], [0.0, math.nan])):
        with pytest.raises(BadInputError, match="expected finite readings"):
            filter_from_prior(NOISE, Prior(), np.array(t), np.array(acc), np.zeros(2))
    with pytest.raises(BadInputError, match="as many of each"):
        filter_from_prior(NOISE, Prior(), np.zeros(2), np.zeros(3), np.zeros(3))
    assert Mahony() == Mahony(3.0, 3.0)
