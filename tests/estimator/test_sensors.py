"""The sensors' models: against the simulated sensors, and their gradients against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib.actuator.kinematics import forward
from calib.arrays import FloatArray
from calib.estimator import sensors
from calib.twin.camera_sensor import Tracker, marker_pixels
from calib.twin.imu_sensor import Imu, ImuNoise, measure
from calib.twin.rig import nominal_view
from calib.twin.sensors import HeadMotion

SPREAD = np.array(
    [
        0.7,
        0.01,
        10.0,
        0.5,
        300.0,
        10.0,
        0.01,
        0.1,
        0.1,
        0.1,
        0.02,
        0.005,
        0.003,
        0.02,
        1e-3,
        1e-3,
        0.02,
        0.01,
        0.01,
    ]
)
MIDDLE = np.zeros(19)
MIDDLE[1], MIDDLE[11], MIDDLE[12] = 0.07, 0.006, 0.015


def view() -> FloatArray:
    seen = nominal_view()
    return sensors.view_coefficients(seen.camera, seen.R_CW, seen.t_CW_m)


def states(count: int) -> FloatArray:
    """Random motions, straight and nearly straight ones among them."""
    out = MIDDLE + SPREAD * np.random.default_rng(4).uniform(-1.0, 1.0, (count, 19))
    out[0] = MIDDLE
    out[1:8, 0] = 10.0 ** -np.arange(1.0, 15.0, 2.0)
    return np.asarray(out)


def readings(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    """All five readings (5,) and their gradients (5, 19)."""
    by = np.empty((5, 19))
    u, v = sensors.marker(view(), state, by[0], by[1])
    ax, ay = sensors.accelerometer(9.81, 0.002, state, by[2], by[3])
    return np.array([u, v, ax, ay, sensors.gyroscope(state, by[4])]), by


def test_gradients_agree_with_differences() -> None:
    for state in states(60):
        _, by = readings(state)
        for k in range(19):
            h = 1e-4 * SPREAD[k]
            step = h * (np.arange(19) == k)
            low2, low, high, high2 = (readings(state + a * step)[0] for a in (-2.0, -1.0, 1.0, 2.0))
            difference = (low2 - high2 + 8.0 * (high - low)) / (12.0 * h)
            np.testing.assert_allclose(by[:, k], difference, rtol=1e-6, atol=1e-6 * np.abs(by).max())


def test_marker_agrees_with_the_simulated_camera() -> None:
    rows = states(40)
    rows[:, 13:] = 0.0
    rows[:, 12] = 0.015
    r = 0.0126
    q = np.stack([rows[:, 1] + r * rows[:, 0], rows[:, 1] - r * rows[:, 0]], axis=1)
    pixels, _ = sensors.marker_rows(view(), rows)
    np.testing.assert_allclose(pixels, marker_pixels(nominal_view(), Tracker(), q, r), rtol=0, atol=1e-9)
    for row, pose in zip(rows, forward(q, r), strict=True):
        np.testing.assert_allclose(sensors.head_position(row[0], row[1]), pose[:2], atol=1e-15)


def test_a_late_picture_shows_an_earlier_head() -> None:
    state = states(20)[-1]
    state[13] = 0.003
    then = state.copy()
    then[13] = 0.0
    for k in (0, 1):
        then[k] = state[k] - 0.003 * state[k + 2] + 0.5 * 0.003**2 * state[k + 4]
    np.testing.assert_allclose(readings(state)[0][:2], readings(then)[0][:2], atol=1e-10)


def test_accelerometer_and_gyroscope_agree_with_the_simulated_imu() -> None:
    rows = states(40)
    rows[:, 9] = 0.05
    rows[:, 17], rows[:, 18] = 0.004, -0.003
    rows[:, 10] = -0.01
    rows[:, 11] = 0.006
    rows[:, 6:9] = 0.01, 0.05, -0.04
    imu = replace(
        Imu(), mount_angle_rad=0.05, lever_m=(0.002, 0.006), gyro_scale=(0.0, 0.0, -0.01),
        accel_scale=(0.004, -0.003, 0.0), gyro_step_radps=0.0, accel_step_mps2=0.0,
        accel_range_mps2=1e6, gyro_range_radps=1e6,
    )  # fmt: skip
    n = len(rows)
    noise = ImuNoise(
        np.zeros(n), np.zeros(n), np.tile([0.0, 0.0, 0.01], (n, 1)), np.tile([0.05, -0.04, 0.0], (n, 1)),
        np.zeros(n),
    )  # fmt: skip
    motion = _head_motion(rows)
    force, rate = measure(imu, noise, slice(0, n), motion)
    mine = np.array([readings(row)[0] for row in rows])
    np.testing.assert_allclose(mine[:, 2:4], force[:, :2], rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(mine[:, 4], rate[:, 2], atol=1e-12)


def _head_motion(rows: FloatArray) -> HeadMotion:
    """Motion of the head by differences of its position along a parabola in phi and l."""
    h = 1e-4

    def place(t: float) -> FloatArray:
        phi = rows[:, 0] + t * rows[:, 2] + 0.5 * t * t * rows[:, 4]
        length = rows[:, 1] + t * rows[:, 3] + 0.5 * t * t * rows[:, 5]
        return np.asarray(forward(np.stack([length + 0.01 * phi, length - 0.01 * phi], axis=1), 0.01)[:, :2])

    five = [place(k * h) for k in (-2, -1, 0, 1, 2)]
    a = (-five[0] + 16.0 * five[1] - 30.0 * five[2] + 16.0 * five[3] - five[4]) / (12.0 * h * h)
    return HeadMotion(rows[:, 0], rows[:, 2], rows[:, 4], five[2], a)


def test_marker_is_inverted() -> None:
    for state in states(30)[:, :]:
        still = state.copy()
        still[2:6] = 0.0
        u, v = readings(still)[0][:2]
        phi, length, found = sensors.invert_marker(view(), still[6:], u, v, 0.0, 0.07)
        assert found
        assert phi == pytest.approx(still[0], abs=1e-9)
        assert length == pytest.approx(still[1], abs=1e-11)


def test_marker_out_of_reach_is_not_found() -> None:
    assert not sensors.invert_marker(view(), MIDDLE[6:], 1e7, -1e7, 0.0, 0.07)[2]


def test_behind_the_camera_there_is_no_pixel() -> None:
    state = MIDDLE.copy()
    away = view()
    away[8] = -1.0
    made: Callable[..., tuple[float, float]] = sensors.marker
    assert np.isnan(made(away, state, np.empty(19), np.empty(19))).all()


def test_named_values_become_a_vector() -> None:
    values = sensors.sensor_values({"marker_offset_m": 0.02, "stretch": 0.1})
    assert values[6] == 0.02 and values[10] == 0.1 and np.count_nonzero(values) == 2
