"""Gains: those of a covariance recursion, stable with every delay, and right for noise of their own kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.estimator.gains import MOST_DELAY_TICKS, TickNoise, design

NOISE = TickNoise(8.6e-3, 4.3e-4, 2e-3, 0.025)
T = 1.0 / 60.0


def test_the_angles_gains_are_the_limit_of_the_time_varying_filter() -> None:
    gains = design(NOISE, 60.0, 0.025, 0.0475)
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    Q = np.diag([(NOISE.gyro_radps * T) ** 2 + 1.1e-3**2 * T, 2e-4**2 * T**3])
    R = np.diag([NOISE.camera_rad, NOISE.accel_rad]) ** 2
    P = np.eye(2)
    for _ in range(20_000):
        P = F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        P = P - K @ H @ P
    np.testing.assert_allclose(K[0], [gains.camera_phi, gains.accel_phi], rtol=1e-6)
    # The bias takes the same share of both corrections.
    np.testing.assert_allclose(K[1] / K[0], gains.bias, rtol=1e-6)


@pytest.mark.parametrize("ticks", [0.0, 0.4, 1.5, 3.0, float(MOST_DELAY_TICKS)])
@pytest.mark.parametrize("share", [0.85, 1.0])
def test_the_length_is_stable_with_every_delay(ticks: float, share: float) -> None:
    """Also where the chord is a good deal shorter than the arc, which lowers the gain."""
    gains = design(NOISE, 60.0, ticks * T, 0.0475)
    assert gains.delay_ticks == pytest.approx(ticks)
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), share * np.array([[1.0, -ticks]])
    K = np.array([[gains.moving_length], [gains.moving_rate]])
    assert np.abs(np.linalg.eigvals(F - K @ H @ F)).max() < 0.99
    for gain in (
        gains.camera_phi,
        gains.accel_phi,
        gains.bias,
        gains.rest_length,
        gains.rate_decay,
        gains.slow,
    ):
        assert 0.0 < gain < 1.0


def test_better_pictures_count_for_more() -> None:
    plain = design(NOISE, 60.0, 0.025, 0.0475)
    sharp = design(replace(NOISE, camera_rad=2e-3, camera_m=1e-4), 60.0, 0.025, 0.0475)
    assert sharp.camera_phi > 1.5 * plain.camera_phi
    assert sharp.rest_length > 1.5 * plain.rest_length
    assert sharp.moving_m < 0.5 * plain.moving_m


@pytest.mark.parametrize(("rate", "delay"), [(0.0, 0.01), (60.0, 0.2), (60.0, -0.01)])
def test_refuses_what_no_controller_has(rate: float, delay: float) -> None:
    with pytest.raises(BadInputError, match="expected"):
        design(NOISE, rate, delay, 0.0475)
