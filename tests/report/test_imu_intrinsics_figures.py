"""Figures of an IMU's intrinsics: complete, repeatable and legible, also where little is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept
from imu_poses import AXES, G, Sensor, pose_log, sphere_poses, tilts

from calib.imu.intrinsics import Intrinsics, PoseLog, find_intrinsics
from calib.report import imu_intrinsics_figures
from calib.report.imu_intrinsics_figures import write_imu_intrinsics_figures


def _sphere() -> Intrinsics:
    return find_intrinsics(pose_log(sphere_poses(24), Sensor()), G)


def _plane() -> Intrinsics:
    return find_intrinsics(pose_log(tilts(np.radians(np.arange(0, 360, 45))), Sensor()), G)


def _few() -> Intrinsics:
    return find_intrinsics(pose_log(sphere_poses(3), Sensor()), G)


def _no_gyro() -> Intrinsics:
    log = pose_log(sphere_poses(6), Sensor())
    return find_intrinsics(PoseLog("log", AXES[3:], log.t_s, log.values[:, 3:]), G)


@pytest.mark.parametrize("make", [_sphere, _plane, _few, _no_gyro])
def test_every_word_can_be_read(make: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert callable(make)
    with kept(monkeypatch, imu_intrinsics_figures) as figures:
        write_imu_intrinsics_figures(tmp_path, make(), "poor")
        assert set(figures) == {"imu_poses.png", "imu_residuals.png"}
        for name, figure in figures.items():
            assert complaints(figure) == [], name
            assert any("poor" in text.get_text() for text in drawn_texts(figure))


def test_files_repeat_and_hold_a_picture(tmp_path: Path) -> None:
    result = _sphere()
    first = write_imu_intrinsics_figures(tmp_path / "a", result)
    for path, again in zip(first, write_imu_intrinsics_figures(tmp_path / "b", result), strict=True):
        assert path.read_bytes() == again.read_bytes()
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.shape[1] > 1000
        assert picture.std() > 10.0
