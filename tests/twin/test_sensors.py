"""Sensors of the simulated rig against OpenCV, differences of the path, and the errors asked for."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from open_loop import swing
from scipy.signal import butter, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation
from source_model import inverse_series

from calib.core.geometry import apply_homography
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.kinematics import forward, forward_jacobian, forward_jacobian_rate
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.simulate import derivative, state_row
from calib.stages.control.references import Ellipse
from calib.stages.estimator.baseline import Baseline, BaselineSetup, undistorting_nothing
from calib.stages.estimator.kinematic import Rows
from calib.twin.rig import nominal_view
from calib.twin.sensors import (
    HeadMotion,
    Imu,
    ImuNoise,
    Tracker,
    draw_imu_noise,
    draw_tracker_noise,
    head_motion,
    marker_pixels,
    measure,
    onchip_angle_rad,
    stamps,
    states_between,
    stream,
    track,
)
from calib.twin.simulate import WORKSPACE_M


def test_the_motion_of_a_swing_is_that_of_its_path() -> None:
    plant = Plant()
    h = 1e-4
    fine = swing(plant, state_row(plant, 0.5, 0.07), 0.6, h)
    motion = head_motion(coefficients(plant), fine.states)
    inner = slice(200, -200)
    for value, rate in (
        (motion.phi_rad[:, None], motion.dphi_radps[:, None]),
        (motion.dphi_radps[:, None], motion.ddphi_radps2[:, None]),
    ):
        slope = (value[2:] - value[:-2]) / (2.0 * h)
        assert np.abs(slope - rate[1:-1])[inner].max() < 2e-4 * np.abs(rate).max()
    path = forward(fine.states[:, :2], plant.bellows_radius_m)[:, :2]
    second = (path[2:] - 2.0 * path[1:-1] + path[:-2]) / (h * h)
    assert np.abs(second - motion.acceleration_mps2[1:-1])[inner].max() < 2e-3
    # As much as gravity, as a swing at 4 Hz must be.
    assert 8.0 < np.abs(motion.acceleration_mps2[1000:]).max() < 25.0


def test_stamps_jitter_repeat_and_never_run_backwards() -> None:
    t = 0.01 * np.arange(200_000)
    stamped = stamps(t, 4e-4, 0.01, stream(0, 9))
    steps = np.diff(stamped)
    assert np.all(steps >= 0.0)
    # A repeated stamp makes a zero step; nothing else does at this jitter.
    share = float(np.mean(steps == 0.0))
    assert share == pytest.approx(0.01, abs=4.0 * np.sqrt(0.01 / len(t)))
    own = np.concatenate([[True], steps > 0.0])
    assert np.std((stamped - t)[own]) == pytest.approx(4e-4, rel=0.02)
    assert abs(float(np.mean((stamped - t)[own]))) < 5e-6
    assert np.array_equal(np.rint(stamped * 1e6) * 1e-6, stamped)
    assert stamped[0] >= 0.0


VIEW, RADIUS_M = nominal_view(), 0.0126
CLEAN = Tracker(latency_s=0.0, jitter_px=0.0, grid_px=0.0, outliers=0.0, dropouts=0.0, stamp_jitter_s=0.0)
FRAMES = np.arange(60_000) / 60.0


def _bellows(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    length, half = rng.uniform(0.065, 0.09, n), RADIUS_M * rng.uniform(-0.7, 0.7, n)
    return np.stack([length + half, length - half], axis=1)


def _still(tracker: Tracker, seed: int = 0, frames: np.ndarray = FRAMES) -> np.ndarray:
    noise = draw_tracker_noise(tracker, frames, seed)
    q = np.full((len(frames), 2), 0.0712)
    return track(VIEW, tracker, noise, slice(0, len(frames)), q, RADIUS_M)


def test_the_marker_is_where_opencv_projects_it() -> None:
    q = _bellows(300)
    x, y, phi = forward(q, RADIUS_M).T
    # (A.1): 15 mm beyond the head along its tangent.
    marker = np.stack([x + 0.015 * np.sin(phi), y + 0.015 * np.cos(phi), np.zeros_like(x)], axis=1)
    d = VIEW.camera.distortion[:5]
    expected, _ = cv2.projectPoints(marker, cv2.Rodrigues(VIEW.R_CW)[0], VIEW.t_CW_m, VIEW.camera.K, d)
    assert np.allclose(marker_pixels(VIEW, CLEAN, q, RADIUS_M), expected[:, 0], rtol=0.0, atol=1e-8)
    assert np.abs(np.ptp(expected[:, 0], axis=0)).min() > 20.0


def test_frames_are_exposed_earlier_than_they_are_read() -> None:
    noise = draw_tracker_noise(replace(CLEAN, latency_s=0.03), FRAMES, 0)
    assert np.allclose(FRAMES - noise.exposed_s, 0.03, atol=1e-12)
    assert np.allclose(noise.stamp_s, FRAMES, atol=1e-6)


def test_jitter_has_the_deviation_asked_for() -> None:
    error = _still(replace(CLEAN, jitter_px=0.3)) - _still(CLEAN)
    assert np.std(error, axis=0) == pytest.approx([0.3, 0.3], rel=0.02)
    assert abs(float(np.corrcoef(error.T)[0, 1])) < 0.02


def test_outliers_have_the_share_and_distance_asked_for() -> None:
    away = np.linalg.norm(_still(replace(CLEAN, outliers=0.02)) - _still(CLEAN), axis=1)
    bad = away > 1e-9
    assert float(bad.mean()) == pytest.approx(0.02, abs=4.0 * math.sqrt(0.02 / len(FRAMES)))
    assert away[bad].min() >= 5.0
    assert away[bad].max() <= 20.0
    assert away[bad].mean() == pytest.approx(12.5, abs=0.5)


def test_the_same_seed_gives_the_same_frames_and_portions_the_same_as_the_whole() -> None:
    tracker, q = Tracker(), _bellows(600)
    noise = draw_tracker_noise(tracker, FRAMES[:600], 7)
    whole = track(VIEW, tracker, noise, slice(0, 600), q, RADIUS_M)
    again = draw_tracker_noise(tracker, FRAMES[:600], 7)
    portions = [
        track(VIEW, tracker, again, slice(i, i + 100), q[i : i + 100], RADIUS_M) for i in range(0, 600, 100)
    ]
    assert np.array_equal(whole, np.concatenate(portions), equal_nan=True)
    other = draw_tracker_noise(tracker, FRAMES[:600], 8)
    assert not np.array_equal(noise.offset_px, other.offset_px)


ZERO = (0.0, 0.0, 0.0)
CLEAN_IMU_SENSOR = Imu(
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


def _still_imu_sensor(phi: np.ndarray) -> HeadMotion:
    zero, flat = np.zeros_like(phi), np.zeros((len(phi), 2))
    return HeadMotion(phi, zero, zero, flat)


def _read(imu: Imu, motion: HeadMotion, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    n = len(motion.phi_rad)
    return measure(imu, draw_imu_noise(imu, n / imu.rate_hz, seed), slice(0, n), motion)


def test_its_axes_are_right_handed_and_x_points_to_the_base() -> None:
    # One motion at a time through phi = 0: up (-y) acceleration adds to x, +x acceleration to y.
    flat = np.zeros(1)
    up = HeadMotion(flat, flat, flat, np.array([[0.0, -2.0]]))
    right = HeadMotion(flat, flat, flat, np.array([[3.0, 0.0]]))
    turning = HeadMotion(flat, np.ones(1), flat, np.zeros((1, 2)))
    assert _read(CLEAN_IMU_SENSOR, up)[0][0] == pytest.approx([11.81, 0.0, 0.0])
    assert _read(CLEAN_IMU_SENSOR, right)[0][0] == pytest.approx([9.81, 3.0, 0.0])
    assert _read(CLEAN_IMU_SENSOR, turning)[1][0] == pytest.approx([0.0, 0.0, -1.0])


def test_it_feels_the_acceleration_of_its_own_place_minus_gravity() -> None:
    plant, h = Plant(), 1e-4
    fine = swing(plant, state_row(plant, 0.5, 0.07), 0.6, h)
    motion = head_motion(coefficients(plant), fine.states)
    imu = replace(CLEAN_IMU_SENSOR, mount_angle_rad=0.1, lever_m=(0.004, 0.009), rate_hz=1.0 / h)
    force, rate = _read(imu, motion)
    # The sensor's place, rotated by SciPy: phi > 0 turns from y to x, which is negative about z.
    R_WH = Rotation.from_rotvec(np.outer(motion.phi_rad, [0.0, 0.0, -1.0])).as_matrix()
    path = forward(fine.states[:, :2], plant.bellows_radius_m)[:, :2]
    place = path + (R_WH @ np.array([0.004, 0.009, 0.0]))[:, :2]
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


def test_readings_are_whole_steps_within_the_range() -> None:
    imu = replace(CLEAN_IMU_SENSOR, gyro_step_radps=Imu().gyro_step_radps, accel_step_mps2=0.01916)
    fast = HeadMotion(
        np.linspace(-1.0, 1.0, 101),
        np.linspace(-60.0, 60.0, 101),
        np.zeros(101),
        np.linspace(-80.0, 80.0, 202).reshape(101, 2),
    )
    force, rate = _read(imu, fast)
    for values, step, limit in (
        (force, 0.01916, 39.24),
        (rate, math.radians(0.0305), math.radians(2000.0)),
    ):
        assert np.abs(values / step - np.rint(values / step)).max() < 1e-9
        assert limit - step < np.abs(values).max() <= limit * (1.0 + 1e-12)
    exact, _ = _read(replace(CLEAN_IMU_SENSOR, accel_range_mps2=1e3), fast)
    inside = np.abs(exact) < 39.0
    assert np.abs(force - exact)[inside].max() <= 0.5 * 0.01916 + 1e-12


def test_scale_bias_noise_and_walk_have_the_values_asked_for() -> None:
    n, rate_hz = 200_000, 100.0
    still = _still_imu_sensor(np.full(n, 0.3))
    imu = replace(
        CLEAN_IMU_SENSOR,
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
    walking = draw_imu_noise(replace(CLEAN_IMU_SENSOR, gyro_walk=1e-3), n / rate_hz, 1)
    # Over a lag of T the bias walks by density * sqrt(T).
    lag = 100
    walked = (walking.gyro[lag:] - walking.gyro[:-lag]).std()
    assert walked == pytest.approx(1e-3 * math.sqrt(lag / rate_hz), rel=0.05)


def _drift_degps(noise: ImuNoise) -> float:
    return math.degrees(float(np.polyfit(noise.taken_s, noise.onchip_rad, 1)[0]))


def test_the_chips_own_angle_drifts_as_in_the_source() -> None:
    drifts = np.array([_drift_degps(draw_imu_noise(Imu(), 30.0, seed)) for seed in range(300)])
    assert drifts.mean() == pytest.approx(0.145, abs=4.0 * drifts.std() / math.sqrt(len(drifts)))
    # Inconsistent from log to log, by about the spread asked for.
    assert drifts.std() == pytest.approx(0.4 * 0.145, rel=0.15)
    noise = draw_imu_noise(Imu(), 30.0, 5)
    angle = onchip_angle_rad(Imu(), noise, slice(0, 3000), _still_imu_sensor(np.full(3000, 0.2)))
    assert np.abs(angle - noise.onchip_rad - 0.22).max() <= math.radians(0.5 / 16.0) + 1e-12
    steps = np.degrees(angle) * 16.0
    assert np.abs(steps - np.rint(steps)).max() < 1e-9


def test_the_same_seed_gives_the_same_bytes() -> None:
    still = _still_imu_sensor(np.full(1000, 0.1))
    first, second, other = _read(Imu(), still, 4), _read(Imu(), still, 4), _read(Imu(), still, 5)
    assert [a.tobytes() for a in first] == [a.tobytes() for a in second]
    assert first[0].tobytes() != other[0].tobytes()
    # A longer log begins with the same noise of the first axis as a shorter one has drawn.
    assert np.array_equal(draw_imu_noise(Imu(), 2.0, 4).taken_s[:100], draw_imu_noise(Imu(), 1.0, 4).taken_s)


RADIUS_M_KERNEL = 0.0126
NODE_S = 1.0 / 300.0


def test_a_swing_between_nodes_is_that_of_a_fine_simulation() -> None:
    plant = Plant()
    fine = swing(plant, state_row(plant, 0.5), 1.0, NODE_S / 16, every=1)
    between = states_between(NODE_S, fine.states[::16].copy(), fine.t_s)
    error = np.abs(between - fine.states)
    assert error[:, :2].max() < 1.2e-8
    assert error[:, 2:4].max() < 1.2e-5
    assert error[:, 4:6].max() < 1e-4
    assert np.array_equal(between[::16], fine.states[::16])


@pytest.mark.parametrize("bend", [1.0, 1e-3, 1e-9, 0.0])
def test_accelerations_are_those_of_the_jacobian_and_its_rate(bend: float) -> None:
    rng = np.random.default_rng(2)
    n = 200
    half = RADIUS_M_KERNEL * bend * rng.uniform(-1.5, 1.5, n)
    length = rng.uniform(0.05, 0.1, n)
    states = np.zeros((n, 10))
    states[:, 0], states[:, 1] = length + half, length - half
    states[:, 2:4] = 0.3 * rng.normal(size=(n, 2))
    states[:, 8:] = rng.uniform(0.0, 1.5, (n, 2))
    c = coefficients(replace(Plant(), bellows_radius_m=RADIUS_M_KERNEL))
    ddq = np.array([derivative(c, y[:6], *y[8:])[2:4] for y in states])
    q, dq = states[:, :2], states[:, 2:4]
    motion = head_motion(c, states)
    J, rate = forward_jacobian(q, RADIUS_M_KERNEL), forward_jacobian_rate(q, dq, RADIUS_M_KERNEL)
    expected = np.einsum("nij,nj->ni", J, ddq) + np.einsum("nij,nj->ni", rate, dq)
    assert np.allclose(motion.phi_rad, forward(q, RADIUS_M_KERNEL)[:, 2], rtol=0.0, atol=1e-12)
    assert np.allclose(motion.dphi_radps, np.einsum("nij,nj->ni", J, dq)[:, 2], rtol=1e-12)
    assert np.allclose(motion.ddphi_radps2, expected[:, 2], rtol=1e-10, atol=1e-8)
    assert np.allclose(motion.acceleration_mps2, expected[:, :2], rtol=1e-10, atol=1e-9)


RADIUS_M_FEEDBACK, D_M = 0.0126, 0.015
TO_PLANE = undistorting_nothing(VIEW.camera, VIEW.R_CW, VIEW.t_CW_m, WORKSPACE_M)
H = np.linalg.inv(TO_PLANE)


def _frames(pixels: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """phi, q1, q2 at each tick for an angle filter that takes the accelerometer's angle at once."""
    setup = BaselineSetup(TO_PLANE, RADIUS_M_FEEDBACK, 0.065, D_M, 100.0, Kp=100.0, Ki=0.0)
    felt = 9.81 * np.stack([np.cos(phi), np.sin(phi), 0.0 * phi], axis=1)
    rows = Rows(np.zeros(len(phi)), np.column_stack([pixels, felt]), np.full(len(phi), 3))
    return Baseline(setup).run(rows)[:, [3, 1, 2]]


def test_it_is_homography_offset_lowpass_and_series() -> None:
    rng = np.random.default_rng(0)
    pixels = np.array([160.0, 120.0]) + 10.0 * rng.normal(size=(300, 2))
    phi = 0.3 * rng.normal(size=300)
    marker = apply_homography(np.linalg.inv(H), pixels)
    head = marker - D_M * np.stack([np.sin(phi), np.cos(phi)], axis=1)
    b, a = butter(1, 1.0, fs=60.0)
    low = np.stack([lfilter(b, a, x, zi=lfilter_zi(b, a) * x[0])[0] for x in head.T], axis=1)
    expected = inverse_series(np.column_stack([low, phi]), RADIUS_M_FEEDBACK)
    seen = _frames(pixels, phi)
    assert np.allclose(seen[:, 0], phi, atol=1e-14)
    assert np.allclose(seen[:, 1:], expected, rtol=0.0, atol=1e-13)


def test_at_rest_it_finds_the_bellows_within_the_error_of_the_lens() -> None:
    q = Ellipse().bellows_m(np.linspace(0.0, 20.0, 41), RADIUS_M_FEEDBACK)
    phi = (q[:, 0] - q[:, 1]) / (2.0 * RADIUS_M_FEEDBACK)
    pixels = marker_pixels(nominal_view(), Tracker(), q, RADIUS_M_FEEDBACK)
    error = [
        1e3 * (_frames(np.repeat([p], 3, axis=0), np.full(3, angle))[-1, 1:] - wanted)
        for p, angle, wanted in zip(pixels, phi, q, strict=True)
    ]
    # Neglecting the lens costs some tenths of a millimetre; a wrong sign or offset would cost tens.
    assert 0.05 < np.abs(error).max() < 1.5
