"""Figures of a pump's identification: legible and complete."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, kept
from identifytrials import LAG_TRUTH, pump_records

from calib.actuator.identify_pump_models import LAG, Shape
from calib.identification import identify_pump
from calib.pumptables import PumpTable, Settled
from calib.report import identify_pump_figures
from calib.report.identify_pump_figures import write_pump_figures


def test_every_word_can_be_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    u = np.arange(100.0, 256.0, 5.0)
    settled = Settled("static", u, 25.0 * Shape(90.0, 40.0).of(u) + 0.05 * np.sin(7.0 * u))
    tables = [PumpTable("kPa", r, (), ()) for r in pump_records(LAG, LAG_TRUTH, 2)]
    found = identify_pump([*tables, PumpTable("kPa", None, (settled,), ())])
    with kept(monkeypatch, identify_pump_figures) as figures:
        write_pump_figures(tmp_path, found, "poor")
        assert list(figures) == ["pump_runs.png", "pump_residuals.png", "pump_static.png"]
        for name, figure in figures.items():
            assert complaints(figure) == [], name
