"""Constants of the fused estimator: folded as the tick unfolds them, refused where they do not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from estimatorlogs import NOISE
from firmware_rigs import header, rig

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.estimator.constant_gain import design, tick_noise
from calib.stages.estimator.kinematic import Setup, Start
from calib.stages.estimator.sensors import sensor_values, view_coefficients
from calib.stages.firmware.constants import Known, fused_group
from calib.stages.firmware.literals import Group, literals, values
from calib.twin.pictures import CAMERA, PLANE


def _values(whole: Rig, rate_hz: float = 60.0) -> dict[str, float]:
    return values(literals((_group(whole, rate_hz),)))


def _group(whole: Rig, rate_hz: float = 60.0) -> Group:
    return fused_group(Known(whole, "rig.yaml"), rate_hz, header("fused").camera.plane)


def _with(section: str, **changes: object) -> Rig:
    whole = rig("fused")
    return whole.model_copy(update={section: getattr(whole, section).model_copy(update=changes)})


@pytest.mark.parametrize("alpha", [0.0, 0.05, -1.2, 2.5])
def test_the_accelerometers_map_undoes_bias_scale_and_mount(alpha: float) -> None:
    whole = _with("align", mount_angle_rad=alpha, accel_scale=[0.01, -0.02], accel_bias_mps2=[0.2, -0.1])
    c = _values(whole)
    phi = 0.4
    force = 9.81 * np.array([math.cos(phi + alpha), math.sin(phi + alpha)])
    reading = force * np.array([1.01, 0.98]) + np.array([0.2, -0.1])
    A, B = (
        c[f"CALIB_FUSED_ACCEL_{i}1"] * reading[0]
        + c[f"CALIB_FUSED_ACCEL_{i}2"] * reading[1]
        - c[f"CALIB_FUSED_ACCEL_{i}"]
        for i in (1, 2)
    )
    gain = c["CALIB_FUSED_ACCEL_GAIN"]
    assert np.array([A, B]) == pytest.approx(gain * np.array([math.cos(phi), math.sin(phi)]), abs=1e-6 * gain)


def test_the_gyroscopes_map_undoes_bias_and_scale() -> None:
    c = _values(_with("align", gyro_scale=0.01, gyro_bias_radps=0.02))
    reading = -1.01 * 1.5 + 0.02
    half = c["CALIB_FUSED_HALF_BIAS_RAD"] - c["CALIB_FUSED_HALF_DT_S"] * reading
    assert half == pytest.approx(0.5 * 1.5 / 60.0, rel=1e-6)


@pytest.mark.parametrize(
    ("late_ticks", "remembered", "part"), [(0.0, 0, 0.0), (0.3, 1, 0.7), (2.0, 2, 0.0), (7.5, 8, 0.5)]
)
def test_the_age_of_a_picture_in_parts_of_a_tick(late_ticks: float, remembered: int, part: float) -> None:
    c = _values(_with("align", time_offset_s=late_ticks / 60.0))
    assert c["CALIB_FUSED_TICKS"] == remembered
    assert c["CALIB_FUSED_PART"] == pytest.approx(part, abs=1e-6)
    assert c["CALIB_FUSED_DELAY_TICKS"] == pytest.approx(late_ticks, abs=1e-6)


def test_without_tuned_gains_they_are_for_the_noise_of_the_alignment() -> None:
    """As `calib.stages.estimator.constant_gain` finds it from the set-up, to second order in the angle."""
    whole = _with("align", jitter_px=0.3, imu_lever_m=0.006)
    whole = whole.model_copy(update={"estimator": None})
    group, c = _group(whole), _values(whole)
    assert group.notes[-1] == "Gains for the noise in align."
    assert _group(rig("fused")).notes[-1] == "Gains of estimator.constant_gain."
    section = whole.align
    assert section is not None
    noise = NOISE.copy()
    noise[0], noise[3], noise[4] = 0.3, section.accel_noise_mps2[0], section.gyro_noise_radps
    values_ = {"marker_offset_m": section.marker_offset_m, "imu_lever_m": 0.006}
    start = Start(sensor_values(values_), np.zeros(13), np.array([0.0, 0.065, 0.0, 0.0, 0.0, 0.0]))
    view = view_coefficients(CAMERA, np.array(PLANE.R_CW), np.array(PLANE.t_m))
    gains = design(
        tick_noise(Setup(view, noise, start, 0.0126)), 60.0, 0.025, 0.0325 + section.marker_offset_m
    )
    for name, wanted in (
        ("MOVING_LENGTH", gains.moving_length),
        ("REST_LENGTH", gains.rest_length),
        ("ACCEL_GAIN", gains.accel_phi),
        ("PHI_PER_M", gains.camera_phi / gains.lever_m),
    ):
        assert c[f"CALIB_FUSED_{name}"] == pytest.approx(wanted, rel=0.03)


def test_pictures_from_before_are_refused_and_a_little_early_counts_as_now() -> None:
    assert _values(_with("align", time_offset_s=-0.002))["CALIB_FUSED_DELAY_TICKS"] == 0.0
    assert _values(_with("align", time_offset_s=8.3 / 60.0))["CALIB_FUSED_DELAY_TICKS"] == 8.0
    with pytest.raises(BadInputError, match="expected pictures that are 0 to 8 ticks late"):
        _values(_with("align", time_offset_s=0.2))


def test_gains_of_another_tick_are_not_taken() -> None:
    notes = _group(rig("fused"), 100.0).notes
    assert notes[-1].endswith("Those of estimator.constant_gain are for another tick.")
    plain = _values(rig("fused").model_copy(update={"estimator": None}), 100.0)
    assert _values(rig("fused"), 100.0) == plain


def test_what_the_rig_lacks_is_named() -> None:
    group = fused_group(Known(rig(), "rig.yaml"), 60.0, None)
    assert group.notes == ("Fused estimator: none. rig.yaml lacks plane and align.",)
    assert _group(rig()).notes == ("Fused estimator: none. rig.yaml lacks align.",)
    assert _values(rig()) == {"CALIB_HAS_FUSED": 0.0}
