"""A pump's identification as a section: verdicts, what is not explained, what the simulation reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identifytrials import FLOW_TRUTH, LAG_TRUTH, pump_records

from calib.actuator.identify_pump_models import LAG, ORIFICE, PumpRecord, Shape
from calib.errors import BadInputError
from calib.identification import PumpFound, identify_pump
from calib.pumpsections import judge_pump, pump_section, unexplained
from calib.pumptables import PumpTable, Settled
from calib.rig import Rig

PATH = Path("rig.yaml")
U = np.arange(100.0, 256.0, 5.0)


def _table(record: PumpRecord, unit: str = "kPa") -> PumpTable:
    return PumpTable(unit, record, (), ())


@pytest.fixture(scope="module")
def found() -> PumpFound:
    settled = Settled("static", U, 25.0 * Shape(90.0, 40.0).of(U) + 0.05 * np.sin(7.0 * U))
    tables = [_table(r) for r in pump_records(LAG, LAG_TRUTH, 3)]
    return identify_pump([*tables, PumpTable("kPa", None, (settled,), ())])


def test_a_pump_that_is_a_lag_is_found_to_be_one(found: PumpFound) -> None:
    section = pump_section(found, Rig(), PATH)
    assert section.lag_s == pytest.approx(0.5, rel=0.02)
    assert section.delay_ticks == 4.0
    assert section.identified is not None
    assert section.identified.better == LAG
    # The recordings' own map is a line through zero, and the data say so.
    assert found.fits[LAG].shape == Shape()
    static = section.identified.static["static"]
    assert static.dead_pwm == pytest.approx(90.0, abs=4.0)
    assert set(section.identified.models) == {LAG, ORIFICE}


def test_what_the_pwm_does_not_explain_makes_it_poor(found: PumpFound) -> None:
    t = 0.02 * np.arange(250)
    pwm = np.where(t > 0.03, 255.0, 0.0)
    y = 25.0 * -np.expm1(-np.maximum(t - 0.1, 0.0) / 0.5)
    runs = [PumpRecord(f"run{k}", t, pwm, y + 0.02 * np.sin(40.0 * t + k)) for k in range(3)]
    runs.append(PumpRecord("odd", t, pwm, y + 6.0 * np.clip(t - 2.0, 0.0, 1.0)))
    odd = identify_pump([_table(r) for r in runs])
    said = unexplained(odd)
    assert "settle apart: 3 at 25.0 kPa" in said[0]
    assert "odd leaves the model" in said[1]
    assert "while the PWM stood still" in said[1]
    assert judge_pump(odd)[0] == "poor"
    assert odd.main_group is not None
    assert odd.held_rms(LAG, odd.main_group.names) < odd.held_rms(LAG)


def test_settled_values_alone_and_tables_that_say_nothing() -> None:
    settled = Settled("static", U, 25.0 * Shape(90.0, 40.0).of(U) + 0.05 * np.sin(7.0 * U))
    alone = identify_pump([PumpTable("kPa", None, (settled,), ())])
    verdict, _, remarks = judge_pump(alone)
    assert verdict in ("ok", "poor")
    assert any("neither dead time nor lag" in sentence for sentence in remarks)
    t = 0.02 * np.arange(50)
    flat = PumpRecord("flat", t, np.full(50, 255.0), np.full(50, -38.0))
    with pytest.raises(BadInputError, match="neither PWM nor value ever changes"):
        identify_pump([_table(flat)])
    other = _table(pump_records(ORIFICE, FLOW_TRUTH, 1)[0], "N")
    with pytest.raises(BadInputError, match="tables in N and kPa"):
        identify_pump([_table(flat), other])
