"""The section orientation_filter: what it says of a tuning."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from armlogs import swung, write

from calib.imu.gains import DATA_SHEET
from calib.imu.tuning import tune
from calib.rig import Rig, section_json
from calib.rig_filter import OrientationFilter
from calib.tunelogs import Reading, read_tune_log
from calib.tunesections import filter_section


def test_section_of_a_tuning(tmp_path: Path) -> None:
    log = read_tune_log(write(tmp_path / "arm.csv", swung(0)), Reading())
    result = tune(log.pieces, DATA_SHEET)
    section = filter_section(result, [log], "a data sheet")
    assert section.rate_hz == pytest.approx(100.0)
    assert section.candidates["tuned"].rmse_deg == pytest.approx(math.degrees(result.candidates[1].rmse_rad))
    a = np.array([[complex(*pole) for pole in one.poles] for one in section.candidates.values()])
    assert np.all(np.abs(a) < 1.0)
    assert section.logs[0].bias_degps == pytest.approx(math.degrees(0.005), abs=0.1)
    again = OrientationFilter.model_validate(section_json(section))
    assert Rig(orientation_filter=again).orientation_filter == section


def test_a_log_that_is_not_judged(tmp_path: Path) -> None:
    log = read_tune_log(write(tmp_path / "arm.csv", swung(0, 5.0), truth=False), Reading())
    section = filter_section(tune(log.pieces, DATA_SHEET), [log], "a data sheet")
    assert (section.verdict, section.recommended_by, section.block_s) == ("poor", "default", None)
    assert section.candidates["3/3"].rmse_deg is None
