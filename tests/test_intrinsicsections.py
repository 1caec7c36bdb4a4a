"""The section imu_intrinsics holds what was found, null for what was not, and is read back."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from imu_poses import G, PoseLog, Sensor, in_counts, pose_log, sphere_poses

from calib.imu.intrinsics import find_intrinsics
from calib.imu.intrinsics_verdict import judge_intrinsics
from calib.intrinsicsections import intrinsics_section
from calib.rig import Rig, rig_text
from calib.rig_imu_intrinsics import ImuIntrinsics

SENSOR = Sensor()


def _section(log: PoseLog, planar: bool = False) -> ImuIntrinsics:
    result = find_intrinsics(log, G, planar)
    section = intrinsics_section(result, judge_intrinsics(result))
    again = Rig.model_validate(yaml.safe_load(rig_text(Rig(imu_intrinsics=section)))).imu_intrinsics
    assert again == section
    return section


@pytest.mark.parametrize("counts", [False, True])
def test_readings_are_corrected_by_what_is_written(counts: bool) -> None:
    sensor = in_counts(SENSOR) if counts else SENSOR
    section = _section(pose_log(sphere_poses(24), sensor, counts=counts))
    assert section.verdict == "ok"
    rng = np.random.default_rng(0)
    w, f = rng.normal(size=(5, 3)), G * rng.normal(size=(5, 3))
    raw = Sensor.readings(sensor, w, f, _Silent())
    assert section.gyro is not None
    for part, readings, truth, size in (
        (section.accel, raw[:, 3:], f, 3e-2),
        (section.gyro, raw[:, :3], w, 2e-3),
    ):
        assert part.unit == ("counts" if counts else {3e-2: "m/s2", 2e-3: "rad/s"}[size])
        found = (readings - np.array(part.bias, dtype=float)) @ np.array(part.matrix).T
        assert found == pytest.approx(truth, abs=size)
        assert set(part.sigma.misalignment_rad) == set(part.misalignment_rad)
    assert set(section.accel.misalignment_rad) == {"yz", "zy", "zx"}
    assert set(section.gyro.misalignment_rad) == {"yz", "zy", "xz", "zx", "xy", "yx"}


class _Silent:
    """A source of random numbers that are all zero."""

    def normal(self, size: tuple[int, int]) -> np.ndarray:
        return np.zeros(size)


def test_sensitivity_is_written_with_its_sigma() -> None:
    S = 3e-4 * np.array([[0.2, 1.0, 0.5], [-1.0, 0.1, 0.3], [0.4, -0.7, 0.2]])
    section = _section(pose_log(sphere_poses(30), Sensor(sensitivity=S)))
    assert section.gyro is not None
    assert np.array(section.gyro.sensitivity) == pytest.approx(S, abs=3e-5)
    assert np.array(section.gyro.sigma.sensitivity).shape == (3, 3)
    f = np.array([0.0, 0.0, 0.0])
    assert section.gyro.bias == pytest.approx((Sensor().gyro_bias + S @ f).tolist(), abs=3e-4)
