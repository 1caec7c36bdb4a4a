"""Constants as rows: units, digits, and standard deviations beside the values they belong to."""

from __future__ import annotations

import math

import pytest

from calib.rigvalues import BLANK, constants, digits, short, unit_of


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("fx_px", "px"), ("rms_mm", "mm"), ("t_CW_m", "m"), ("A_px_per_m", "px/m"), ("k1", ""),
        ("gyro_noise_radps_per_sqrt_Hz", "rad/s/√Hz"), ("Kp_pwm_per_rad", "PWM/rad"), ("tick_s", "s"),
        ("Ki_per_s2", "1/s²"), ("stiffness_N_per_m", "N/m"), ("rate_hz", "Hz"), ("views", ""),
    ],
)  # fmt: skip
def test_unit_is_the_end_of_the_key(key: str, unit: str) -> None:
    assert unit_of(key) == unit


def test_digits_follow_the_standard_deviation() -> None:
    assert digits(273.40956, 0.0435) == "273.410"
    assert digits(273.40956) == "273.41"
    assert digits(math.nan) == digits(None) == BLANK
    assert digits(1234.4, 20.0) == "1234"


def test_short_numbers_have_no_exponent_where_none_is_needed() -> None:
    assert [short(v) for v in (18000.0, 12345.6, 0.98765, 7, 1e-9)] == [
        "18000",
        "12346",
        "0.9877",
        "7",
        "1e-09",
    ]


def test_sigma_goes_with_its_value() -> None:
    rows = {
        (c.section, c.name): c
        for c in constants(
            {
                "camera": {"fx_px": 200.0, "distortion": {"k1": 0.1}, "sigma": {"fx_px": 2.0, "k1": 0.01}},
                "imu": {
                    "bias_mps2": [1.0, None, 3.0],
                    "sigma": {"bias_mps2": [0.1, None, 0.3]},
                    "logs": [{"name": "a", "rate_hz": 1.0}],
                    "verdict": "ok",
                },
                "plain": 3,
            }
        )
    }
    assert rows["camera", "fx_px"].sigma == 2.0 and rows["camera", "fx_px"].share == 0.01
    assert rows["camera", "distortion.k1"].sigma == 0.01
    assert rows["imu", "bias_mps2[2]"].sigma == 0.3 and rows["imu", "bias_mps2[2]"].unit == "m/s²"
    assert set(rows) == {
        ("camera", "fx_px"), ("camera", "distortion.k1"), ("imu", "bias_mps2[0]"), ("imu", "bias_mps2[2]"),
    }  # fmt: skip
