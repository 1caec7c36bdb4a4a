"""Verdicts with reasons that name what is wrong, for logs of many kinds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imu_poses import AXES, G, PoseLog, Sensor, in_counts, pose_log, sphere_poses, tilts
from scipy.spatial.transform import Rotation

from calib.imu.intrinsics import find_intrinsics
from calib.imu.intrinsics_verdict import IntrinsicsJudgement, judge_intrinsics, protocol

SENSOR = Sensor()


def _judge(log: PoseLog, gravity_mps2: float = G, planar: bool = False) -> IntrinsicsJudgement:
    return judge_intrinsics(find_intrinsics(log, gravity_mps2, planar))


def _up(pose: Rotation) -> np.ndarray:
    return np.asarray(pose.inv().apply([0.0, 0.0, 1.0]))


@pytest.fixture(scope="module")
def good() -> PoseLog:
    return pose_log(sphere_poses(24), SENSOR)


def test_many_poses_are_ok(good: PoseLog) -> None:
    assert _judge(good) == IntrinsicsJudgement("ok", (), (), ())


@pytest.mark.parametrize(("axis", "sign", "word"), [(2, 1.0, "up"), (0, -1.0, "down"), (1, 1.0, "up")])
def test_a_side_that_lacks_is_named(axis: int, sign: float, word: str) -> None:
    poses = [pose for pose in sphere_poses(40) if sign * _up(pose)[axis] < 0.2]
    found = _judge(pose_log(poses, SENSOR))
    assert found.verdict == "poor"
    name = "xyz"[axis]
    assert any(f"no rest with the {name} axis {word}: the nearest is" in reason for reason in found.reasons)
    assert f"add rests with the {name} axis {word}" in found.advice


def test_a_cap_of_the_sphere_is_unidentifiable() -> None:
    poses = [pose for pose in sphere_poses(90) if _up(pose)[2] > 0.8]
    found = _judge(pose_log(poses, SENSOR))
    assert found.verdict == "unidentifiable"
    mixed = next(reason for reason in found.reasons if reason.startswith("the poses do not tell"))
    assert "bias of z" in mixed
    assert "scale of z apart" in mixed
    assert any("no rest with the z axis down: the nearest is 1" in reason for reason in found.reasons)
    counts = _judge(pose_log(poses, in_counts(SENSOR), counts=True))
    assert counts.verdict == "unidentifiable"
    assert not any(reason.startswith("no rest with") for reason in counts.reasons)
    assert protocol(planar=False) in found.advice


def test_too_few_rests_are_unidentifiable() -> None:
    for count in (1, 3):
        found = _judge(pose_log(sphere_poses(count), SENSOR))
        assert found.verdict == "unidentifiable"
        assert "fewer than the 6 that bias and scale need" in found.reasons[0]


def test_as_many_parameters_as_rests_are_poor() -> None:
    found = _judge(pose_log(tilts(np.radians([0, 90, 180, 270])), SENSOR))
    assert found.verdict == "poor"
    assert any("nothing is left to check them by" in reason for reason in found.reasons)


def test_a_plane_says_what_it_takes_for_granted() -> None:
    found = _judge(pose_log(tilts(np.radians(np.arange(0, 720, 45))), SENSOR))
    assert found.verdict == "ok"
    assert any("ax, ay and gz alone are calibrated" in remark for remark in found.remarks)
    assert any("taken to stand upright; by az it leans" in remark for remark in found.remarks)
    arc = _judge(pose_log(tilts(np.radians([-40, -20, 0, 20, 40, 10])), SENSOR), planar=True)
    assert arc.verdict == "unidentifiable"
    assert protocol(planar=True) in arc.advice


@pytest.mark.slow
def test_axes_and_units_that_contradict_are_inconsistent(good: PoseLog) -> None:
    swapped = np.hstack([good.values[:, [1, 0, 2]] * [1, -1, 1], good.values[:, 3:]])
    found = _judge(replace(good, values=swapped))
    assert found.verdict == "inconsistent"
    assert "gx measures y, gy measures -x, gz measures z" in found.reasons[0]
    mirrored = np.hstack([-good.values[:, :3], good.values[:, 3:]])
    assert "that mirrors it" in _judge(replace(good, values=mirrored)).reasons[0]
    moon = _judge(good, 1.62)
    assert moon.verdict == "inconsistent"
    assert "check --acc-unit and --gravity" in moon.advice
    fast = np.hstack([1.8 * good.values[:, :3], good.values[:, 3:]])
    assert "check --gyro-unit" in _judge(replace(good, values=fast)).advice
    other = np.hstack([np.roll(good.values[:, :3], 300, axis=0), good.values[:, 3:]])
    assert _judge(replace(good, values=other)).verdict == "inconsistent"


def test_a_rest_that_was_pushed_is_named(good: PoseLog) -> None:
    values = good.values.copy()
    # The rest from 32 to 35 s, a push that is as steady as the rest itself.
    values[3200:3500, 3:] *= 1.01
    found = _judge(replace(good, values=values))
    assert found.verdict == "poor"
    assert any(reason.startswith("the rest from 3") for reason in found.reasons)


def test_a_start_in_motion_is_poor(good: PoseLog) -> None:
    found = _judge(replace(good, t_s=good.t_s[2050:], values=good.values[2050:]))
    assert found.verdict == "poor"
    assert "the log does not begin at rest" in found.reasons[0]


def test_gaps_and_repeated_rows_are_said(good: PoseLog) -> None:
    t = good.t_s.copy()
    t[6350:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(len(t)), [900, 901]), np.arange(100, 700, 100)]))
    found = _judge(replace(good, t_s=t[rows], values=good.values[rows]))
    assert found.verdict == "ok"
    said = " | ".join(found.remarks)
    assert "split at a gap of 3600 s after 63.49 s" in said
    assert "2 samples missing in 1 gap(s), the longest 30 ms after 8.99 s" in said
    assert "6 rows (0.04%) repeat the one before; dropped" in said


def test_without_a_gyroscope_or_turns_that_is_said(good: PoseLog) -> None:
    alone = _judge(replace(good, axes=AXES[3:], values=good.values[:, 3:]))
    assert alone.verdict == "ok"
    assert alone.remarks == ("without gx, gy and gz the gyroscope is not calibrated",)
