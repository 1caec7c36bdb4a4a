"""Tick, IMU, angle filter and low-pass: what is folded in, and where the numbers come from."""

from __future__ import annotations

import math

import numpy as np
import pytest
from firmware_rigs import header, rig
from scipy.signal import butter

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.firmware.constants import Known, motion_groups
from calib.stages.firmware.header import header_of
from calib.stages.firmware.literals import literals, values


def _of(kind: str) -> dict[str, float]:
    return values(literals(motion_groups(Known(rig(kind), "rig.yaml"))))


def test_defaults_are_the_sources() -> None:
    c = _of("nominal")
    assert c["CALIB_MM_KP_DT"] == pytest.approx(3.0 / 60.0)
    assert c["CALIB_MM_KI_DT2"] == pytest.approx(3.0 / 3600.0)
    b, a = butter(1, 1.0, fs=60.0)
    assert c["CALIB_LOWPASS_SINGLE_G"] == pytest.approx(b[0], abs=5e-8)
    assert c["CALIB_LOWPASS_1_A1"] == pytest.approx(a[1], abs=5e-8)
    assert (c["CALIB_MARKER_OFFSET_M"], c["CALIB_BELLOWS_RADIUS_M"]) == pytest.approx((0.015, 0.0126))


def test_a_calibrated_rig_gives_its_own() -> None:
    c = _of("full")
    assert c["CALIB_MM_KP_DT"] == pytest.approx(2.2 / 60.0)
    assert c["CALIB_MM_KI_DT2"] == pytest.approx(1.4 / 3600.0)
    # A rate w is read as (1 + scale) w.
    assert c["CALIB_MM_DT_S"] == pytest.approx(1.0 / 60.0 / 1.02)
    assert c["CALIB_MM_GYRO_BIAS_DT_RAD"] == pytest.approx(0.013 / 60.0 / 1.02)
    assert c["CALIB_IMU_MOUNT_ANGLE_RAD"] == pytest.approx(0.05)
    assert c["CALIB_MARKER_OFFSET_M"] == pytest.approx(0.0147)
    assert (c["CALIB_TIME_OFFSET_TICKS"], c["CALIB_BELLOWS_RADIUS_M"]) == pytest.approx((2, 0.0131))


@pytest.mark.parametrize("phi", [-1.2, 0.0, 0.7])
def test_the_accelerometers_angle_is_right_at_every_angle(phi: float) -> None:
    """Biases and scales by themselves, not only what they make of the angle at rest."""
    c = _of("full")
    alpha = c["CALIB_IMU_MOUNT_ANGLE_RAD"]
    ax = 1.004 * 9.81 * math.cos(phi + alpha) + 0.1
    ay = 0.997 * 9.81 * math.sin(phi + alpha) + 0.1
    x = ax - c["CALIB_IMU_ACCEL_BIAS_X_MPS2"]
    y = (ay - c["CALIB_IMU_ACCEL_BIAS_Y_MPS2"]) * c["CALIB_IMU_ACCEL_RATIO"]
    assert math.atan2(y, x) - alpha == pytest.approx(phi, abs=1e-6)


def test_the_state_variable_form_is_the_section() -> None:
    """Impulse responses of the pipeline's form and of the difference equation that the header prints."""
    c = _of("full")
    A1, A2, A3 = (c[f"CALIB_LOWPASS_PAIR1_A{i}"] for i in (1, 2, 3))
    b, a = (
        [c[f"CALIB_LOWPASS_1_B{i}"] for i in range(3)],
        [1.0, c["CALIB_LOWPASS_1_A1"], c["CALIB_LOWPASS_1_A2"]],
    )
    from scipy.signal import lfilter

    impulse = np.zeros(400)
    impulse[0] = 1.0
    s1 = s2 = 0.0
    found = []
    for x in impulse:
        v3 = x - s2
        v1, y = A1 * s1 + A2 * v3, s2 + A2 * s1 + A3 * v3
        s1, s2 = 2.0 * v1 - s1, 2.0 * y - s2
        found.append(y)
    assert np.abs(np.array(found) - lfilter(b, a, impulse)).max() < 1e-7


@pytest.mark.parametrize(("offset_s", "ticks"), [(0.0, 0), (-0.004, 0), (0.02, 1), (0.1, 6)])
def test_the_time_offset_in_whole_ticks(offset_s: float, ticks: int) -> None:
    align = rig("full").align
    assert align is not None
    moved = rig("full").model_copy(update={"align": align.model_copy(update={"time_offset_s": offset_s})})
    c = values(literals(motion_groups(Known(moved, "rig.yaml"))))
    assert c["CALIB_TIME_OFFSET_TICKS"] == ticks
    assert ticks / 60.0 + c["CALIB_TIME_OFFSET_REST_S"] == pytest.approx(offset_s, abs=1e-8)


@pytest.mark.parametrize("offset_s", [-0.05, 0.5])
def test_an_offset_that_no_memory_holds_is_refused(offset_s: float) -> None:
    align = rig("full").align
    assert align is not None
    moved = rig("full").model_copy(update={"align": align.model_copy(update={"time_offset_s": offset_s})})
    with pytest.raises(BadInputError, match=r"align\.time_offset_s is .* expected 0 to 8 ticks"):
        header_of(moved, "rig.yaml")


def test_the_bias_of_the_imu_at_rest_is_used_without_align() -> None:
    imu = {
        "rate_hz": 100.0,
        "gyro_bias_radps": [0.0, 0.0, 0.021],
        **{
            f"{kind}_{what}": [0.1, 0.1, 0.1]
            for kind, whats in (
                (
                    "gyro",
                    ("noise_radps_per_sqrt_Hz", "instability_radps", "walk_radps2_per_sqrt_Hz", "step_radps"),
                ),
                (
                    "accel",
                    ("noise_mps2_per_sqrt_Hz", "instability_mps2", "walk_mps3_per_sqrt_Hz", "step_mps2"),
                ),
            )
            for what in whats
        },
        "accel_mean_mps2": [9.8, 0.0, 0.0],
        "verdict": "ok",
    }
    known = Known(Rig.model_validate({"imu": imu}), "rig.yaml")
    c = values(literals(motion_groups(known)))
    assert c["CALIB_IMU_GYRO_BIAS_RADPS"] == pytest.approx(0.021)
    assert c["CALIB_MM_GYRO_BIAS_DT_RAD"] == pytest.approx(0.021 / 60.0)
    assert "imu.gyro_bias_radps" not in " ".join(group.defaults for group in header("full").groups)
