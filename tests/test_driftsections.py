"""The document of the drift comparison, and gains from the rig's file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calib.driftsections import drift_document, sampling_remarks, tuned_filter
from calib.imu.drift import analyse_drift
from calib.imu.mahony import Mahony
from calib.imu.tracks import DriftLog, Tuned
from calib.rig import Rig, read_rig
from calib.rig_filter import OrientationFilter

NONE = np.zeros(0)


def _log(t: np.ndarray, source: str = "log.csv") -> DriftLog:
    rng = np.random.default_rng(0)
    values = np.array([2e-3, 0.02, 0.02]) * rng.normal(size=(len(t), 3)) + [0.006, 9.8, 0.2]
    return DriftLog(source, ("gz", "ax", "ay"), t, values, NONE, NONE, NONE, NONE)


def test_the_document_is_in_degrees() -> None:
    result = analyse_drift(_log(0.01 * np.arange(6000)), Tuned(Mahony(1.0, 0.25)))
    found = drift_document([result], {"log.csv": "00"}, Tuned(Mahony(1.0, 0.25)), ["said"])
    methods = found["logs"][0]["methods"]
    measures = {m.name: m for m in result.measures}
    for name, m in measures.items():
        assert methods[name]["slope_degps"] == pytest.approx(math.degrees(m.slope.value))
        assert methods[name]["interval_degps"][0] <= methods[name]["slope_degps"]
    assert methods["gyroscope alone"]["slope_degps"] == pytest.approx(-math.degrees(0.006), rel=0.05)
    assert math.isnan(methods["MM 3/3"]["allan_100s_deg"])
    assert found["methods"]["MM tuned"]["logs"] == 1
    assert found["tuned"] == {"Kp_per_s": 1.0, "Ki_per_s2": 0.25, "rate_of_angle": "-gz"}
    assert found["provenance"] == {"inputs": {"log.csv": "00"}}
    assert "slope alone does not rank filters" in found["note"]
    assert "tuned" not in drift_document([result], {}, None)


def test_gaps_and_repeats_are_sentences() -> None:
    t = 0.01 * np.arange(6000)
    t[4000:] += 3600.0
    rows = np.sort(np.concatenate([np.delete(np.arange(6000), [1000, 1001]), np.arange(150, 1350, 100)]))
    whole = _log(t)
    log = DriftLog("a.csv", whole.axes, t[rows], whole.values[rows], NONE, NONE, NONE, NONE)
    said = sampling_remarks(analyse_drift(log))
    assert said[0].startswith("a.csv: split at a gap of 3600 s after 39.99 s")
    assert said[1].startswith("a.csv: 2 samples missing in 1 gap(s), the longest 30 ms after 9.99 s")
    assert said[2].startswith("a.csv: 12 rows (0.20%) repeat the one before")
    assert sampling_remarks(analyse_drift(_log(0.01 * np.arange(3000)))) == []


def test_a_sensor_that_lies_flat_is_told() -> None:
    rng = np.random.default_rng(0)
    values = 0.02 * rng.normal(size=(3000, 4)) + [0.006, 0.3, 0.2, 9.8]
    flat = DriftLog("a.csv", ("gz", "ax", "ay", "az"), 0.01 * np.arange(3000), values, NONE, NONE, NONE, NONE)
    said = sampling_remarks(analyse_drift(flat))
    assert len(said) == 1
    assert said[0].startswith("a.csv: gravity is 88 degrees out of the sensor's x-y plane")


def test_the_tuned_filter(tmp_path: Path) -> None:
    assert tuned_filter(read_rig(tmp_path / "none.yaml")) is None
    section = {"Kp_per_s": 1.5, "Ki_per_s2": 0.5, "rate_hz": 100.0, "recommended": "tuned"}
    section |= {"recommended_by": "reference", "rate_of_angle": "up vector", "verdict": "ok"}
    rig = Rig(orientation_filter=OrientationFilter.model_validate(section))
    assert tuned_filter(rig) == Tuned(Mahony(1.5, 0.5), up_vector=True)
