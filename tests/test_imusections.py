"""The section imu and Kalibr's imu.yaml hold what was found, and say what was not."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from calib.imu.static import AXES, RestLog, Static, analyse_static
from calib.imu.static_verdict import judge
from calib.imusections import imu_section, kalibr_imu


def _result(axes: tuple[str, ...] = AXES, walk: float = 0.0, n: int = 12_000) -> Static:
    rng = np.random.default_rng(0)
    values = 1e-3 * rng.normal(size=(n, len(axes))) + walk * np.cumsum(
        rng.normal(size=(n, len(axes))), axis=0
    )
    return analyse_static([RestLog("a.csv", axes, 0.01 * np.arange(n), values, np.zeros(0), np.zeros(0))])


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
