"""The gyroscope's fit: recovery, bias by pose, axes that are swapped, and whether sigma is what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imu_poses import AXES, G, PoseLog, Sensor, in_counts, motion, pose_log, sphere_poses, tilts
from scipy.special import stdtrit

import calib.imu.intrinsics
from calib.imu.gyroscope import GYRO_ANGLES
from calib.imu.intrinsics import find_intrinsics

SENSOR = Sensor()
TRUTH = np.concatenate([SENSOR.gyro_scale, SENSOR.gyro_angles])


@pytest.mark.parametrize("counts", [False, True])
def test_scale_and_misalignment_are_recovered(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    quiet = replace(sensor, accel_noise=1e-4, gyro_noise=1e-5)
    gyro = find_intrinsics(pose_log(sphere_poses(24), quiet, counts=counts), G).gyro
    assert gyro is not None
    assert gyro.scale / quiet.gyro_scale == pytest.approx(np.ones(3), abs=2e-5)
    assert gyro.angles == pytest.approx(quiet.gyro_angles, abs=2e-5)
    assert gyro.bias.sensitivity is None
    assert gyro.initial_bias == pytest.approx(quiet.gyro_bias, rel=1e-3)
    T = gyro.matrix * gyro.scale
    for (i, j, sign), angle in zip(GYRO_ANGLES.values(), gyro.angles, strict=True):
        assert T[i, j] == pytest.approx(sign * angle)


def test_in_a_plane_the_scale_of_z_alone_is_fitted() -> None:
    sensor = replace(SENSOR, accel_angles=np.zeros(3), gyro_angles=np.zeros(6))
    log = pose_log(tilts(np.radians(np.arange(0, 720, 45))), sensor)
    result = find_intrinsics(log, G)
    assert result.planar
    gyro = result.gyro
    assert gyro is not None
    assert abs(gyro.scale[2] - 0.993) < 3.0 * gyro.scale_sigma[2]
    assert gyro.scale_sigma[2] < 5e-4
    assert np.isnan(gyro.scale[:2]).all()
    assert np.isnan(gyro.angles).all()


def test_a_bias_that_follows_the_pose_is_told_from_one_that_does_not() -> None:
    S = 3e-4 * np.array([[0.2, 1.0, 0.5], [-1.0, 0.1, 0.3], [0.4, -0.7, 0.2]])
    poses = sphere_poses(30)
    following = find_intrinsics(pose_log(poses, replace(SENSOR, sensitivity=S)), G).gyro
    constant = find_intrinsics(pose_log(poses, SENSOR), G).gyro
    assert following is not None
    assert constant is not None
    assert constant.bias.sensitivity is None
    assert following.bias.sensitivity is not None
    assert following.bias.sensitivity_sigma is not None
    assert np.abs((following.bias.sensitivity - S) / following.bias.sensitivity_sigma).max() < 4.0
    assert np.abs((following.bias.bias - SENSOR.gyro_bias) / following.bias.sigma).max() < 4.0
    assert following.rms_rad < 1.5 * constant.rms_rad
    error = np.concatenate([following.scale, following.angles]) - TRUTH
    assert np.abs(error / np.concatenate([following.scale_sigma, following.angle_sigma])).max() < 4.0


def test_swapped_and_mirrored_axes_are_named() -> None:
    log = pose_log(sphere_poses(20), SENSOR)
    assert find_intrinsics(log, G).foreign is None
    P = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for swap in (P, -np.eye(3)):
        values = np.hstack([log.values[:, :3] @ swap, log.values[:, 3:]])
        found = find_intrinsics(replace(log, values=values), G).foreign
        assert found is not None
        assert found.tolist() == swap.tolist()


def test_turns_about_one_axis_leave_the_others_unknown() -> None:
    log = pose_log(tilts(np.radians([0, 90, 180, 270, 45, 135, 225, 315])), SENSOR)
    poses = find_intrinsics(replace(log, accel_unit="counts", values=log.values), G)
    assert not poses.planar
    assert poses.gyro is None or not np.isfinite(poses.gyro.scale_sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("planar", [False, True])
def test_reported_deviations_are_those_of_many_repetitions(
    monkeypatch: pytest.MonkeyPatch, planar: bool
) -> None:
    monkeypatch.setattr(calib.imu.intrinsics, "MULTIPLES", (4.0,))
    flat = replace(SENSOR, accel_angles=np.array([0.011, 0.0, 0.0]), gyro_angles=np.zeros(6))
    sensor = flat if planar else SENSOR
    poses = tilts(np.radians(np.arange(0, 720, 45))) if planar else sphere_poses(24)
    free = [2] if planar else list(range(9))
    truth = np.concatenate([sensor.gyro_scale, sensor.gyro_angles])[free]
    t, w, f = motion(poses)
    errors, sigmas = [], []
    for seed in range(200):
        values = sensor.readings(w, f, np.random.default_rng(seed))
        gyro = find_intrinsics(PoseLog("log", AXES, t, values), G).gyro
        assert gyro is not None
        errors.append(np.concatenate([gyro.scale, gyro.angles])[free] - truth)
        sigmas.append(np.concatenate([gyro.scale_sigma, gyro.angle_sigma])[free])
    error, sigma = np.array(errors), np.array(sigmas)
    reported = np.sqrt((sigma**2).mean(axis=0))
    assert error.std(axis=0) / reported == pytest.approx(np.ones(len(free)), abs=0.15)
    dof = (len(poses) - 1) * (1 if planar else 2) - len(free)
    inside = np.abs(error) < stdtrit(dof, 0.975) * sigma
    # Of one parameter 200 repetitions tell the share to 0.015.
    assert inside.mean() == pytest.approx(0.95, abs=0.035 if planar else 0.02)
