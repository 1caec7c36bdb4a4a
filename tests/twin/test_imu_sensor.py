"""The IMU against the path of its own place, and each of its errors against what was asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.parameters import free_swing
from calib.stages.actuator.simulate import state_row, swing
from calib.twin.sensors import (
    HeadMotion,
    Imu,
    ImuNoise,
    draw_imu_noise,
    head_motion,
    measure,
    onchip_angle_rad,
)

ZERO = (0.0, 0.0, 0.0)
CLEAN = Imu(
    mount_angle_rad=0.0,
    lever_m=(0.0, 0.0),
    gyro_scale=ZERO,
    accel_scale=ZERO,
    gyro_bias_radps=ZERO,
    accel_bias_mps2=ZERO,
    gyro_noise=0.0,
    accel_noise=0.0,
    gyro_walk=0.0,
    accel_walk=0.0,
    gyro_step_radps=0.0,
    accel_step_mps2=0.0,
    stamp_jitter_s=0.0,
    duplicated_stamps=0.0,
)


def _still(phi: np.ndarray) -> HeadMotion:
    zero, flat = np.zeros_like(phi), np.zeros((len(phi), 2))
    return HeadMotion(phi, zero, zero, flat, flat)


def _read(imu: Imu, motion: HeadMotion, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    n = len(motion.phi_rad)
    return measure(imu, draw_imu_noise(imu, n / imu.rate_hz, seed), slice(0, n), motion)


def test_at_rest_it_reads_gravity_at_its_angle() -> None:
    phi = np.linspace(-1.2, 1.2, 49)
    for mount in (0.0, 0.3):
        force, rate = _read(replace(CLEAN, mount_angle_rad=mount), _still(phi))
        assert np.allclose(np.arctan2(force[:, 1], force[:, 0]), phi + mount, atol=1e-12)
        assert np.allclose(np.linalg.norm(force, axis=1), 9.81)
        assert np.array_equal(rate, np.zeros((49, 3)))


def test_its_axes_are_right_handed_and_x_points_to_the_base() -> None:
    # One motion at a time through phi = 0: up (-y) acceleration adds to x, +x acceleration to y.
    flat = np.zeros(1)
    up = HeadMotion(flat, flat, flat, np.zeros((1, 2)), np.array([[0.0, -2.0]]))
    right = HeadMotion(flat, flat, flat, np.zeros((1, 2)), np.array([[3.0, 0.0]]))
    turning = HeadMotion(flat, np.ones(1), flat, np.zeros((1, 2)), np.zeros((1, 2)))
    assert _read(CLEAN, up)[0][0] == pytest.approx([11.81, 0.0, 0.0])
    assert _read(CLEAN, right)[0][0] == pytest.approx([9.81, 3.0, 0.0])
    assert _read(CLEAN, turning)[1][0] == pytest.approx([0.0, 0.0, -1.0])


def test_it_feels_the_acceleration_of_its_own_place_minus_gravity() -> None:
    plant, h = free_swing(), 1e-4
    fine = swing(plant, state_row(plant, 0.5, 0.07), 0.6, h)
    motion = head_motion(coefficients(plant), fine.states)
    imu = replace(CLEAN, mount_angle_rad=0.1, lever_m=(0.004, 0.009), rate_hz=1.0 / h)
    force, rate = _read(imu, motion)
    # The sensor's place, rotated by SciPy: phi > 0 turns from y to x, which is negative about z.
    R_WH = Rotation.from_rotvec(np.outer(motion.phi_rad, [0.0, 0.0, -1.0])).as_matrix()
    place = motion.position_m + (R_WH @ np.array([0.004, 0.009, 0.0]))[:, :2]
    second = (place[2:] - 2.0 * place[1:-1] + place[:-2]) / (h * h)
    f_W = np.column_stack([second - np.array([0.0, 9.81]), np.zeros(len(second))])
    # At phi = 0 the columns of R_HS are the sensor's axes in the head's: (0, -1, 0), (1, 0, 0), (0, 0, 1).
    R_HS = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    mounted = Rotation.from_rotvec([0.0, 0.0, -0.1]).as_matrix()
    expected = np.einsum("nij,ni->nj", R_WH[1:-1] @ R_HS @ mounted, f_W)
    inner = slice(200, -200)
    assert np.abs(force[1:-1] - expected)[inner].max() < 3e-3
    slope = (motion.phi_rad[2:] - motion.phi_rad[:-2]) / (2.0 * h)
    assert np.abs(rate[1:-1, 2] + slope)[inner].max() < 1e-4 * np.abs(slope).max()


def test_in_a_swing_the_accelerometer_angle_is_badly_wrong() -> None:
    plant = free_swing()
    fine = swing(plant, state_row(plant, 0.5), 1.0, 1e-3, every=10)
    motion = head_motion(coefficients(plant), fine.states)
    force, _ = _read(CLEAN, motion)
    error = np.arctan2(force[:, 1], force[:, 0]) - motion.phi_rad
    assert np.abs(error).max() > 0.3


def test_readings_are_whole_steps_within_the_range() -> None:
    imu = replace(CLEAN, gyro_step_radps=Imu().gyro_step_radps, accel_step_mps2=0.01916)
    fast = HeadMotion(
        np.linspace(-1.0, 1.0, 101),
        np.linspace(-60.0, 60.0, 101),
        np.zeros(101),
        np.zeros((101, 2)),
        np.linspace(-80.0, 80.0, 202).reshape(101, 2),
    )
    force, rate = _read(imu, fast)
    for values, step, limit in (
        (force, 0.01916, 39.24),
        (rate, math.radians(0.0305), math.radians(2000.0)),
    ):
        assert np.abs(values / step - np.rint(values / step)).max() < 1e-9
        assert limit - step < np.abs(values).max() <= limit * (1.0 + 1e-12)
    exact, _ = _read(replace(CLEAN, accel_range_mps2=1e3), fast)
    inside = np.abs(exact) < 39.0
    assert np.abs(force - exact)[inside].max() <= 0.5 * 0.01916 + 1e-12


def test_scale_bias_noise_and_walk_have_the_values_asked_for() -> None:
    n, rate_hz = 200_000, 100.0
    still = _still(np.full(n, 0.3))
    imu = replace(
        CLEAN,
        gyro_bias_radps=(0.01, -0.02, 0.03),
        accel_scale=(0.01, -0.02, 0.5),
        accel_bias_mps2=(0.1, 0.2, 0.3),
        gyro_noise=2e-4,
        accel_noise=1.5e-3,
    )
    force, rate = _read(imu, still)
    assert rate.mean(axis=0) == pytest.approx([0.01, -0.02, 0.03], abs=5.0 * 2e-3 / math.sqrt(n))
    assert rate.std(axis=0) == pytest.approx([2e-3] * 3, rel=0.01)
    assert force.std(axis=0) == pytest.approx([1.5e-2] * 3, rel=0.01)
    true = 9.81 * np.array([math.cos(0.3), math.sin(0.3), 0.0])
    expected = true * np.array([1.01, 0.98, 1.5]) + np.array([0.1, 0.2, 0.3])
    assert force.mean(axis=0) == pytest.approx(expected, abs=5.0 * 1.5e-2 / math.sqrt(n))
    walking = draw_imu_noise(replace(CLEAN, gyro_walk=1e-3), n / rate_hz, 1)
    # Over a lag of T the bias walks by density * sqrt(T).
    lag = 100
    walked = (walking.gyro[lag:] - walking.gyro[:-lag]).std()
    assert walked == pytest.approx(1e-3 * math.sqrt(lag / rate_hz), rel=0.05)


def test_samples_come_at_their_rate_with_duplicated_stamps() -> None:
    noise = draw_imu_noise(replace(Imu(), duplicated_stamps=0.05), 100.0, 0)
    assert len(noise.taken_s) == 10_000
    assert noise.taken_s[-1] == pytest.approx(99.99)
    assert float(np.mean(np.diff(noise.stamp_s) == 0.0)) == pytest.approx(0.05, abs=0.01)
    assert len(draw_imu_noise(Imu(), 0.1, 0).taken_s) == 10
    assert len(draw_imu_noise(Imu(), 0.0, 0).taken_s) == 0


def _drift_degps(noise: ImuNoise) -> float:
    return math.degrees(float(np.polyfit(noise.taken_s, noise.onchip_rad, 1)[0]))


def test_the_chips_own_angle_drifts_as_in_the_source() -> None:
    drifts = np.array([_drift_degps(draw_imu_noise(Imu(), 30.0, seed)) for seed in range(300)])
    assert drifts.mean() == pytest.approx(0.145, abs=4.0 * drifts.std() / math.sqrt(len(drifts)))
    # Inconsistent from log to log, by about the spread asked for.
    assert drifts.std() == pytest.approx(0.4 * 0.145, rel=0.15)
    noise = draw_imu_noise(Imu(), 30.0, 5)
    angle = onchip_angle_rad(Imu(), noise, slice(0, 3000), _still(np.full(3000, 0.2)))
    assert np.abs(angle - noise.onchip_rad - 0.22).max() <= math.radians(0.5 / 16.0) + 1e-12
    steps = np.degrees(angle) * 16.0
    assert np.abs(steps - np.rint(steps)).max() < 1e-9


def test_the_same_seed_gives_the_same_bytes() -> None:
    still = _still(np.full(1000, 0.1))
    first, second, other = _read(Imu(), still, 4), _read(Imu(), still, 4), _read(Imu(), still, 5)
    assert [a.tobytes() for a in first] == [a.tobytes() for a in second]
    assert first[0].tobytes() != other[0].tobytes()
    # A longer log begins with the same noise of the first axis as a shorter one has drawn.
    assert np.array_equal(draw_imu_noise(Imu(), 2.0, 4).taken_s[:100], draw_imu_noise(Imu(), 1.0, 4).taken_s)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rate_hz": 0.0}, "imu rate_hz: found 0"),
        ({"gyro_noise": -1.0}, "imu gyro_noise: found -1"),
        ({"accel_range_mps2": 0.0}, "imu accel_range_mps2"),
        ({"duplicated_stamps": 1.0}, "imu duplicated_stamps"),
        ({"mount_angle_rad": 20.0}, "imu mount_angle_rad: found 20, expected -3.14 to 3.14"),
        ({"lever_m": (0.0, 6.0)}, "imu lever_m: found .0.0, 6.0., expected 2 numbers of at most 0.5"),
        ({"gyro_bias_radps": (0.0, 0.0)}, "expected 3 numbers"),
        ({"accel_scale": (math.nan, 0.0, 0.0)}, "imu accel_scale"),
    ],
)
def test_what_no_sensor_has(change: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Imu(**change)
