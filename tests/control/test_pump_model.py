"""The controller's own pumps are the plant's, and reading them backwards reaches what was asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE, UNLIKE
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.pump import pump_at_rest, step_pump
from calib.control.inverse_model import Model, largest_force_N
from calib.control.pump_model import (
    PumpEstimate,
    ahead,
    falling_rate,
    least_pwm,
    pumps_at_rest,
    push,
    pwm_for_force,
)
from calib.errors import BadInputError

commands = st.lists(st.tuples(st.floats(0, 255), st.floats(0, 255)), min_size=1, max_size=40)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@given(pwm=commands)
def test_it_follows_the_pumps_of_the_plant(model: Model, pwm: list[tuple[float, float]]) -> None:
    mine, plant = pumps_at_rest(model), pump_at_rest(model.pump)
    for pair in pwm:
        mine, plant = push(model, mine, pair), step_pump(model.pump, plant, pair)
        assert mine.force_N == pytest.approx(plant.force_N, abs=1e-12)
        assert mine.waiting_pwm == plant.waiting_pwm


@given(pwm=commands)
def test_looking_ahead_is_what_happens(pwm: list[tuple[float, float]]) -> None:
    state = pumps_at_rest(UNLIKE)
    for pair in pwm:
        state = push(UNLIKE, state, pair)
    seen = ahead(UNLIKE, state)
    assert len(seen) == 1 + UNLIKE.pump.delay_ticks
    for expected in seen[1:]:
        state = push(UNLIKE, state, (255.0, 0.0))
        assert state.force_N == expected.force_N


def test_strengths_scale_the_forces() -> None:
    state = pumps_at_rest(UNLIKE)
    for _ in range(600):
        state = push(UNLIKE, state, (220.0, 220.0))
    assert state.force_N[0] / state.force_N[1] == pytest.approx(0.9 / 1.1, rel=1e-6)


@given(
    start=st.tuples(st.floats(0.3, 1.5), st.floats(0.3, 1.5)),
    up=st.floats(-0.02, 0.08),
    ticks=st.integers(1, 12),
)
def test_a_force_within_reach_is_reached(start: tuple[float, float], up: float, ticks: int) -> None:
    model = NOMINAL
    state = PumpEstimate(start, start, ())
    T = ticks * model.tick_s
    rise = (largest_force_N(model) - np.array(start)) * (1.0 - math.exp(-T / model.pump.lag_s))
    wanted = np.array(start) + np.clip(up, -0.4 * T, 0.9 * rise.min())
    pwm = pwm_for_force(model, state, wanted, ticks)
    still = Model(model.plant, model.pump.__class__(delay_ticks=0))
    for _ in range(ticks):
        state = push(still, state, (float(pwm[0]), float(pwm[1])))
    # What the table of the static map is worth.
    assert state.force_N == pytest.approx(wanted, abs=1e-3)


def test_a_fall_beyond_the_orifice_keeps_the_lag_at_the_force() -> None:
    state = PumpEstimate((1.0, 1.0), (1.0, 1.0), ())
    still = Model(NOMINAL.plant, NOMINAL.pump.__class__(delay_ticks=0))
    for _ in range(60):
        pwm = pwm_for_force(NOMINAL, state, np.zeros(2), 6)
        state = push(still, state, (float(pwm[0]), float(pwm[1])))
    # As fast as the air leaves, with a lag that has not run ahead by more than a horizon of it.
    assert state.force_N[0] == pytest.approx(1.0 - 0.4 * 1.0, abs=0.01)
    assert state.force_N[0] - state.lag_N[0] < 0.4 * 6 / 60 + 1e-9


def test_a_pump_of_which_nothing_is_wanted_is_off() -> None:
    empty = PumpEstimate((0.0, 0.0), (0.0, 0.0), ())
    assert pwm_for_force(NOMINAL, empty, np.array([0.0, 0.01]), 6).tolist() == [0.0, 0.0]
    # While a force is wanted the motor is not switched off, and gives the same: none.
    full = PumpEstimate((1.0, 1.0), (1.0, 1.0), ())
    assert np.all(pwm_for_force(NOMINAL, full, np.array([0.5, 0.5]), 6) > 99.0)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
def test_the_least_command_lets_the_force_fall_by_its_share(model: Model) -> None:
    F = 1.2
    state = PumpEstimate((F, F), (F, F), ())
    low = least_pwm(model, state, 0.0)
    still = Model(model.plant, model.pump.__class__(delay_ticks=0, deflation=model.pump.deflation))
    held = push(still, state, low)
    assert held.force_N[0] == pytest.approx(F, abs=1e-3)
    fast = push(still, state, least_pwm(model, state, 1.0))
    rate = float(falling_rate(model, np.array(F)))
    assert (F - fast.force_N[0]) / model.tick_s == pytest.approx(rate, rel=0.05)
    assert least_pwm(model, state, 0.0) > least_pwm(model, state, 0.5) > least_pwm(model, state, 1.0)


def test_a_horizon_needs_a_tick() -> None:
    with pytest.raises(BadInputError, match="horizon: found 0 ticks"):
        pwm_for_force(NOMINAL, pumps_at_rest(NOMINAL), np.zeros(2), 0)
