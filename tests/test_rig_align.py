"""The section `align`: what the schema refuses."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from calib.rig_align import Align, AlignCovariance

SECTION: dict[str, Any] = {
    "time_offset_s": 0.025,
    "mount_angle_rad": 0.02,
    "rest_angle_rad": 0.016,
    "gyro_scale": 0.006,
    "gyro_bias_radps": 0.006,
    "accel_bias_mps2": [0.05, -0.04],
    "accel_scale": [0.0, 0.0],
    "imu_lever_m": 0.006,
    "marker_offset_m": 0.015,
    "plane_shift_m": [0.0, 0.0],
    "plane_stretch": 0.0,
    "jitter_px": 0.3,
    "outlier_share": 0.003,
    "accel_noise_mps2": [0.015, 0.015],
    "gyro_noise_radps": 0.0025,
    "verdict": "ok",
}


def test_a_whole_section_passes() -> None:
    assert Align.model_validate(SECTION).time_offset_s == 0.025


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("time_offset_s", float("nan")),
        ("time_offset_s", 25.0),
        ("mount_angle_rad", "0.02"),
        ("mount_angle_rad", 90.0),
        ("accel_bias_mps2", [0.05]),
        ("marker_offset_m", 15.0),
        ("sigma", {"time_offset_s": -1.0}),
        ("verdict", "good"),
        ("other", 1.0),
    ],
)
def test_wrong_values_are_refused(key: str, value: object) -> None:
    with pytest.raises(ValidationError):
        Align.model_validate(SECTION | {key: value})


def test_a_covariance_is_square_and_symmetric() -> None:
    AlignCovariance(order=["a", "b"], values=[[1.0, 0.5], [0.5, 1.0]])
    for values in ([[1.0, 0.5]], [[1.0, 0.5], [0.4, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0], [1.0]]):
        with pytest.raises(ValidationError):
            AlignCovariance(order=["a", "b"], values=values)
