"""Steady angles and forces, steps and deflation."""

from __future__ import annotations

import numpy as np
import pytest

from calib.stages.actuator.pump import ElongationForce
from thesis.drawn import Drawn, Plot
from thesis.drawn_pumps import (
    bent_runs,
    deflation,
    spring_force,
    steady_angle,
    steady_angles,
    steps_against_model,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_the_steady_angle_rises_with_the_voltage_and_the_accelerometer_sees_it() -> None:
    seen, true = steady_angles()
    assert np.all(np.diff(true) > 0.0) and true[0] < 0.01 and 0.85 < true[-1] < 0.95
    assert np.ptp(seen.mean(axis=1) - true) < 0.01
    made = _plot(steady_angle)
    assert np.all(made.curves[0].spread < 0.05)  # type: ignore[operator]  # bars have one


def test_forces_are_in_balance_at_rest() -> None:
    made = _plot(spring_force)
    pump, spring, other, bending = (
        made.curve(label).y
        for label in (
            "driving pump",
            "spring of the driven bellows (3.38)",
            "spring of the other",
            "k phi^2 of (3.44)",
        )
    )
    assert pump == pytest.approx(spring + bending, abs=0.01)
    assert other == pytest.approx(bending, abs=0.01)
    assert pump[-1] == pytest.approx(float(ElongationForce().force_N(np.array(255.0))), rel=1e-3)
    assert len(bent_runs()) == len(pump)


def test_the_model_is_a_little_short_of_the_softer_rig() -> None:
    made = _plot(steps_against_model)
    assert [len(c.x) for c in made.curves] == [480] * 8
    ends = [float(np.median(c.y[-60:])) for c in made.curves]
    assert all(solid > dashed - 0.5 for solid, dashed in zip(ends[2::2], ends[3::2], strict=True))
    assert -1.5 < made.numbers["off_12V_mm"] < -0.5


def test_deflation_takes_five_seconds_and_half_of_it_with_the_printed_limit() -> None:
    made = _plot(deflation)
    assert made.numbers["deflation_0p4_s"] == pytest.approx(5.05, abs=0.05)
    assert made.numbers["deflation_orifice_s"] == pytest.approx(5.05, abs=0.1)
    assert made.numbers["deflation_2_s"] == pytest.approx(2.6, abs=0.1)
    limited = made.curve("falling limit of 0.4 N/s")
    assert limited.y.min() > -0.05 and limited.y[limited.x >= 13.0].max() < 0.3
    orifice, line = made.curve("rig with an orifice").y, limited.y
    halfway = np.argmin(np.abs(limited.x - 7.5))
    assert orifice[halfway] < line[halfway] - 3.0
