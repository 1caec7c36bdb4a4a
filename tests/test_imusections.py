"""The section imu and Kalibr's imu.yaml hold what was found, and say what was not."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from calib.imu.static import AXES, RestLog, Static, analyse_static
from calib.imu.static_verdict import judge
from calib.imusections import imu_section, kalibr_imu
from calib.rig import Rig, rig_text


def _result(axes: tuple[str, ...] = AXES, walk: float = 0.0, n: int = 12_000) -> Static:
    rng = np.random.default_rng(0)
    values = 1e-3 * rng.normal(size=(n, len(axes))) + walk * np.cumsum(
        rng.normal(size=(n, len(axes))), axis=0
    )
    return analyse_static([RestLog("a.csv", axes, 0.01 * np.arange(n), values, np.zeros(0), np.zeros(0))])


def test_the_section_is_read_back() -> None:
    result = _result()
    section = imu_section(result, judge(result))
    again = Rig.model_validate(yaml.safe_load(rig_text(Rig(imu=section)))).imu
    assert again == section
    for k, noise in enumerate(result.noise):
        key = "gyro_noise_radps_per_sqrt_Hz" if k < 3 else "accel_noise_mps2_per_sqrt_Hz"
        assert noise.allan is not None
        assert getattr(section, key)[k % 3] == noise.allan.N.value
        assert section.sigma[key][k % 3] == noise.allan.N.sigma
        assert section.sigma["gyro_bias_radps" if k < 3 else "accel_mean_mps2"][k % 3] == noise.sigma
    assert section.gyro_walk_radps2_per_sqrt_Hz == [None, None, None]
    assert all(value is not None for value in section.below["gyro_walk_radps2_per_sqrt_Hz"])
    assert section.drift["gyro"].logs == 1


def test_kalibr_gets_the_worst_axis_in_continuous_time() -> None:
    # 1e-3 at 100 Hz is a density of 1e-4.
    result = _result(walk=1e-4)
    section = imu_section(result, judge(result))
    text = kalibr_imu(section)
    document = yaml.safe_load(text)
    assert set(document) == {
        "accelerometer_noise_density",
        "accelerometer_random_walk",
        "gyroscope_noise_density",
        "gyroscope_random_walk",
        "rostopic",
        "update_rate",
    }
    assert document["gyroscope_noise_density"] == pytest.approx(1e-4, rel=0.1)
    assert document["gyroscope_random_walk"] == pytest.approx(1e-4 * np.sqrt(100.0), rel=0.4)
    assert "upper bound" not in text
    assert document["update_rate"] == pytest.approx(100.0)


def test_what_was_not_shown_or_logged_is_said() -> None:
    result = _result(("gz",), n=3000)
    section = imu_section(result, judge(result))
    assert section.gyro_bias_radps[:2] == [None, None]
    assert section.accel_mean_mps2 == [None, None, None]
    text = kalibr_imu(section)
    assert "gyroscope_random_walk" in text
    assert "an upper bound: the log is too short to show it" in text
    assert "accelerometer" not in text
