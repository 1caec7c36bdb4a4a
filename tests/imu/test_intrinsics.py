"""The whole calibration of a log: truth recovered, rests counted, thresholds compared, a real recording."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imu_poses import AXES, G, PoseLog, Sensor, in_counts, pose_log, sphere_poses, tilts
from outside import outside

from calib.errors import BadInputError
from calib.imu.intrinsics import count_poses, find_intrinsics

SENSOR = Sensor()


@pytest.mark.parametrize("counts", [False, True])
def test_a_known_sensor_is_recovered_within_its_deviations(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    result = find_intrinsics(pose_log(sphere_poses(24), sensor, 1, counts), G)
    assert (len(result.rests), result.poses, result.planar) == (24, 24, False)
    accel = result.accel
    assert accel is not None
    truth = np.concatenate([sensor.accel_bias, sensor.accel_scale, sensor.accel_angles])
    assert np.abs((accel.parameters - truth) / accel.sigma).max() < 4.0
    assert accel.sigma[3:6].max() < 2e-4 * sensor.accel_scale.max()


def test_the_threshold_with_the_least_residual_wins() -> None:
    log = pose_log(sphere_poses(20), SENSOR)
    values = log.values.copy()
    # Between rests the sensor creeps, slowly enough for a high threshold to take it for rest.
    values[2300:2450, 3:] += 0.04 * np.sin(0.2 * np.arange(150))[:, None] + 0.05
    result = find_intrinsics(replace(log, values=values), G)
    assert {trial.multiple for trial in result.trials} == {2, 3, 4, 5, 6, 8, 10, 15, 20, 30}
    most = max(trial.poses for trial in result.trials)
    able = [trial for trial in result.trials if trial.poses >= 0.9 * most]
    taken = next(trial for trial in result.trials if trial.multiple == result.multiple)
    assert taken.rms_mps2 == min(trial.rms_mps2 for trial in able)


def test_a_plane_is_seen_or_asked_for() -> None:
    log = pose_log(tilts(np.radians(np.arange(0, 360, 45))), SENSOR)
    seen = find_intrinsics(log, G)
    asked = find_intrinsics(log, G, planar=True)
    columns = [2, 3, 4]
    alone = find_intrinsics(replace(log, axes=("gz", "ax", "ay"), values=log.values[:, columns]), G)
    for result in (seen, asked, alone):
        assert result.planar
        assert result.accel is not None
        truth = np.concatenate([SENSOR.accel_bias[:2], SENSOR.accel_scale[:2], SENSOR.accel_angles[:1]])
        # The axes' lean out of the plane counts by its square.
        assert np.abs(result.accel.parameters - truth).max() < 2e-3
    assert (seen.asked, asked.asked) == (False, True)
    assert np.isnan(alone.lean_rad)
    assert seen.lean_rad == pytest.approx(0.03, abs=0.02)


def test_a_log_without_a_gyroscope_calibrates_the_accelerometer() -> None:
    log = pose_log(sphere_poses(20), SENSOR)
    result = find_intrinsics(replace(log, axes=AXES[3:], values=log.values[:, 3:]), G)
    assert result.accel is not None
    assert result.gyro is None
    assert not result.has_gyro


def test_turns_over_missing_readings_are_not_used() -> None:
    log = pose_log(sphere_poses(20), SENSOR)
    t = log.t_s.copy()
    kept = np.ones(len(t), dtype=bool)
    kept[2100:2102] = False
    kept[2610:2650] = False
    t[6200:] += 3600.0
    result = find_intrinsics(PoseLog("log", AXES, t[kept], log.values[kept]), G)
    assert [gap.split for gap in result.sampling.gaps] == [False, False, True]
    assert result.turns_lost >= 1
    assert result.accel is not None
    assert np.abs(result.accel.scale - SENSOR.accel_scale).max() < 1e-3
    assert result.gyro is not None
    assert np.abs(result.gyro.scale - SENSOR.gyro_scale).max() < 2e-3


def test_few_rests_give_no_accelerometer() -> None:
    result = find_intrinsics(pose_log(sphere_poses(4), SENSOR), G)
    assert result.accel is None
    assert (len(result.rests), result.poses) == (4, 4)


def test_never_at_rest_is_refused() -> None:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(size=(90, 6)), axis=0)
    with pytest.raises(BadInputError, match="never at rest"):
        find_intrinsics(PoseLog("log", AXES, 0.01 * np.arange(90), values), G)
    with pytest.raises(BadInputError, match="has no ay"):
        find_intrinsics(PoseLog("log", ("ax", "az"), 0.01 * np.arange(90), values[:, :2]), G)


def test_poses_are_counted_once() -> None:
    up = np.array([[1.0, 0.0], [np.cos(0.05), np.sin(0.05)], [0.0, 1.0], [1.0, 0.0]])
    assert count_poses(up) == 2


def test_the_xsens_recording_of_imu_tk(shared_data: Path) -> None:
    folder = outside(shared_data / "imu_tk")
    tables = []
    for name in ("xsens_gyro.mat.gz", "xsens_acc.mat.gz"):
        with gzip.open(folder / name, "rt") as stream:
            tables.append(np.loadtxt(stream))
    values = np.hstack([table[:, 1:] for table in tables])
    result = find_intrinsics(PoseLog("xsens", AXES, tables[1][:, 0], values, "counts", "counts"), 9.81744)
    accel, gyro = result.accel, result.gyro
    assert accel is not None
    assert gyro is not None
    assert accel.scale == pytest.approx(np.array([414.42, 412.05, 414.61]), rel=1e-3)
    assert accel.bias == pytest.approx(np.array([33124, 33275, 32364]), abs=3.0)
    assert accel.rms_mps2 <= 0.00165
    assert len(result.rests) >= 35
    assert gyro.scale == pytest.approx(np.full(3, 4770.0), rel=0.005)
    assert gyro.bias.sensitivity is not None
    assert gyro.rms_rad < 0.003
