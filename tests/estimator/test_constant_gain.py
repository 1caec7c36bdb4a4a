"""The fused estimator with constant gains: exact without noise, robust, stable, near the full filter."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated, truth
from pydantic import TypeAdapter
from ticks import Ticks, run_gains, ticks_of

from calib.stages.estimator.baseline import Baseline, BaselineSetup, undistorting_nothing
from calib.stages.estimator.constant_gain import (
    MOST_DELAY_TICKS,
    TickNoise,
    design,
    tick_noise,
)
from calib.stages.estimator.kinematic import Setup
from calib.stages.estimator.section import EstimatorGain
from calib.stages.estimator.sensors import head_position

NOISE = TickNoise(8.6e-3, 4.3e-4, 2e-3, 0.025)
T = 1.0 / 60.0


def _setup() -> Setup:
    return setup_for(simulated("static", 0)[0], 0)


def _gains(setup: Setup, delay_ticks: float = 1.5) -> EstimatorGain:
    return design(NOISE, 60.0, delay_ticks * T, 0.0325 + float(setup.start.sensor[6]))


def _made(setup: Setup, phi: np.ndarray, length: np.ndarray, old_phi: np.ndarray, old: np.ndarray) -> Ticks:
    """Ticks of a head without acceleration, with pictures of older angles and lengths."""
    d = float(setup.start.sensor[6])
    places = np.array(
        [
            np.array(head_position(p, one)) + d * np.array([math.sin(p), math.cos(p)])
            for p, one in zip(old_phi, old, strict=True)
        ]
    )
    accel = 9.81 * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    return Ticks(T * np.arange(len(phi)), places, accel, np.gradient(phi, T))


def test_a_head_at_rest_is_found_exactly() -> None:
    setup = _setup()
    phi, length = np.full(3000, 0.6), np.full(3000, 0.081)
    out = run_gains(_gains(setup), setup, _made(setup, phi, length, phi, length))
    np.testing.assert_allclose(out[-1, :2], [0.6, 0.081], atol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.7, 1.0, 2.3])
def test_the_age_of_a_picture_is_allowed_for(delay: float) -> None:
    """A slow swing and a steady stretch are followed without lag, whatever part of a tick it is."""
    setup = _setup()
    k = np.arange(1500.0)

    def phi(at: np.ndarray) -> np.ndarray:
        return np.asarray(0.5 * np.sin(0.02 * at))

    def length(at: np.ndarray) -> np.ndarray:
        return np.asarray(0.068 + 2e-5 * at)

    made = _made(setup, phi(k), length(k), phi(k - delay), length(k - delay))
    out = run_gains(_gains(setup, delay), setup, made)
    assert np.abs(out[600:, 0] - phi(k)[600:]).max() < 2e-4
    assert np.abs(out[600:, 1] - length(k)[600:]).max() < 1e-5


def test_outliers_are_left_out_and_a_jump_starts_afresh() -> None:
    setup = _setup()
    phi, length = np.zeros(600), np.full(600, 0.07)
    made = _made(setup, phi, length, phi, length)
    made.marker_m[200:204] += 0.02
    made.marker_m[400:] = _made(setup, phi, length + 0.02, phi, length + 0.02).marker_m[400:]
    out = run_gains(_gains(setup), setup, made)
    np.testing.assert_allclose(out[150:400, 1], 0.07, atol=1e-9)
    assert abs(out[405, 1] - 0.07) < 1e-9
    np.testing.assert_allclose(out[420:, 1], 0.09, atol=1e-4)


@pytest.mark.parametrize("lost", ["picture", "imu"])
def test_without_one_sensor_the_other_carries_on(lost: str) -> None:
    setup = _setup()
    k = np.arange(900.0)
    phi, length = 0.3 * np.sin(0.01 * k), np.full(900, 0.07)
    made = _made(setup, phi, length, phi, length)
    if lost == "picture":
        made.marker_m[450:] = np.nan
    else:
        made.rate_radps[450:] = np.nan
    out = run_gains(_gains(setup, 0.0), setup, made)
    assert np.isfinite(out).all()
    assert np.abs(out[450:, 0] - phi[450:]).max() < (5e-3 if lost == "picture" else 0.02)
    assert np.abs(out[450:, 1] - 0.07).max() < 1e-4


@pytest.mark.parametrize("name", ["static", "swing", "ellipse", "elongation"])
def test_beats_the_low_pass_on_a_log(name: str) -> None:
    """tests/bench/constant_gain.py has the means over many rigs."""
    rig, log = simulated(name, 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    gains = design(tick_noise(setup), 60.0, float(setup.start.sensor[7]), 0.0475)
    out = run_gains(gains, setup, ticks_of(setup, rows, mean_rate=True), mean_rate=True)
    known = np.flatnonzero(rows.kinds & 1)
    late, r, true = rows.t_s[known] > 0.5, setup.bellows_radius_m, truth(log)[known]
    errors = np.stack([out[:, 1] + r * out[:, 0], out[:, 1] - r * out[:, 0]], axis=1)[late] - true[late, :2]
    view = rig.view
    place = undistorting_nothing(view.camera, view.R_CW, view.t_CW_m, (-0.06, 0.04, 0.06, 0.11))
    other = Baseline(BaselineSetup(place, r)).run(rows)[known][late]
    low_pass = other[:, 1:3] - true[late, :2]
    assert np.abs(errors).mean() < 0.5 * np.abs(low_pass).mean()
    assert np.degrees(np.sqrt(np.mean((out[:, 0] - true[:, 2])[late] ** 2))) < 0.25


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


def test_gains_of_a_precise_and_late_camera_stand_in_the_file() -> None:
    """A length is then corrected by more than its residual."""
    gains = design(TickNoise(3e-5 / 0.0475, 3e-5, NOISE.gyro_radps, NOISE.accel_rad), 60.0, 7.9 * T, 0.0475)
    assert gains.moving_length > 1.0
    assert TypeAdapter(EstimatorGain).validate_python(asdict(gains)).moving_length == gains.moving_length


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
