"""The model read backwards agrees with the model read forwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from control_models import MODELS, NOMINAL
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.dynamics import acceleration
from calib.actuator.integrate import SUBSTEPS, rig_at_rest, simulate
from calib.actuator.parameters import pumps_connected
from calib.actuator.pump import Pump, static_force_N
from calib.control.inverse_model import (
    Model,
    creep_along,
    feed_forward_pwm,
    force_of_pwm,
    holding_force,
    largest_force_N,
    moving_force,
    pwm_of_force,
    static_stiffness,
)
from calib.errors import BadInputError

lengths = st.tuples(st.floats(0.055, 0.095), st.floats(0.055, 0.095))
rates = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))


@pytest.mark.parametrize("model", MODELS)
@given(share=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)))
def test_a_force_comes_back_from_its_pwm(model: Model, share: tuple[float, float]) -> None:
    force = np.array(share) * largest_force_N(model)
    pwm = pwm_of_force(model, force)
    assert np.all((pwm >= 0.0) & (pwm <= 255.0))
    # The table is a quarter of a PWM value fine; the printed polynomial jumps at its dead zone.
    back = force_of_pwm(model, pwm)
    floor = static_force_N(model.pump, np.array([100.0]))[0] * 1.1
    assert np.all((np.abs(back - force) < 1e-3) | (force < floor))


def test_no_force_needs_no_pwm_and_too_much_gets_all() -> None:
    assert pwm_of_force(NOMINAL, np.array([0.0, -1.0])).tolist() == [0.0, 0.0]
    # (2.13) has its greatest elongation just below 12 V.
    most = pwm_of_force(NOMINAL, np.array([9.0, 2.1]))
    assert most.tolist() == [253.5, 253.5]
    assert force_of_pwm(NOMINAL, most) == pytest.approx(largest_force_N(NOMINAL))
    # The least force is just above the dead zone.
    assert np.all(pwm_of_force(NOMINAL, np.full(2, 1e-6)) > 99.0)


def test_limits_of_the_command_limit_the_forces() -> None:
    narrow = replace(NOMINAL, low_pwm=20.0, high_pwm=200.0)
    assert pwm_of_force(narrow, np.array([0.0, 5.0])).tolist() == [20.0, 200.0]
    assert np.all(largest_force_N(narrow) < largest_force_N(NOMINAL))
    assert force_of_pwm(narrow, np.array([0.0, 255.0])) == pytest.approx(
        static_force_N(narrow.pump, np.array([20.0, 200.0]))
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"low_pwm": 200.0, "high_pwm": 100.0}, "found 200 to 100"),
        ({"high_pwm": 256.0}, "found 0 to 256"),
        ({"low_pwm": -1.0}, "found -1 to 255"),
        ({"high_pwm": float("nan")}, "found 0 to nan"),
        ({"high_pwm": 200.5}, "whole numbers"),
        ({"high_pwm": 90.0}, "give no force yet"),
        ({"strength": (1.0, 0.0)}, "strength of pump 2: found 0"),
    ],
)
def test_models_that_cannot_be(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        replace(NOMINAL, **change)


@given(q=lengths, dq=rates, ddq=rates, z=rates)
@pytest.mark.parametrize("projection", ["virtual_work", "head"])
def test_moving_forces_are_the_inverse_of_accelerations(
    projection: str, q: tuple[float, float], dq: tuple[float, float], ddq: tuple[float, float], z: tuple
) -> None:
    plant = replace(pumps_connected(), force_projection=projection, gravity_mps2=(0.0, 9.81))
    rows = [np.array(value) for value in (q, dq, 10.0 * np.array(ddq), z)]
    force = moving_force(plant, rows[0], rows[1], rows[2], rows[3])
    assert acceleration(plant, rows[0], rows[1], rows[3], force) == pytest.approx(rows[2], abs=1e-9)


@given(q=lengths)
def test_the_stiffness_is_the_derivative_of_the_holding_force(q: tuple[float, float]) -> None:
    plant, at, eps = replace(pumps_connected(), gravity_mps2=(1.0, 9.81)), np.array(q), 1e-7
    # The spring has a corner at the rest length.
    if np.min(np.abs(at - plant.rest_length_m)) < 1e-5:
        return
    columns = [
        (holding_force(plant, at + eps * e) - holding_force(plant, at - eps * e)) / (2 * eps)
        for e in np.eye(2)
    ]
    assert static_stiffness(plant, at) == pytest.approx(np.stack(columns, axis=1), rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("q", [(0.07, 0.07), (0.085, 0.085), (0.085, 0.072), (0.071, 0.082)])
def test_the_feed_forward_holds_what_it_is_for(q: tuple[float, float]) -> None:
    """Commanded for long, the map ends at the wanted lengths, also bent, where the line of (4.6) does not."""
    pwm = feed_forward_pwm(NOMINAL, np.array(q))
    motion = simulate(NOMINAL.plant, NOMINAL.pump, np.tile(pwm, (900, 1)))
    assert motion.q_m[-1] == pytest.approx(np.array(q), abs=2e-6)


def test_creep_along_a_ramp_is_the_closed_form() -> None:
    plant, h = pumps_connected(), 1.0 / 60.0
    l1, l2, _ = plant.creep_rates
    t = h * np.arange(200)
    z = creep_along(plant, h, np.tile([0.01, -0.02], (200, 1)))
    expected = l2 / l1 * (1.0 - np.exp(-l1 * t))[:, None] * np.array([0.01, -0.02])
    assert z == pytest.approx(expected, abs=1e-12)


def test_creep_agrees_with_the_simulation() -> None:
    pwm = np.full((300, 2), 200.0)
    fine = simulate(NOMINAL.plant, NOMINAL.pump, pwm, rig_at_rest(NOMINAL.plant, Pump()), every=1)
    z = creep_along(NOMINAL.plant, NOMINAL.tick_s / SUBSTEPS, fine.dq_mps)
    assert np.abs(z - fine.z_N).max() < 2e-4 * np.abs(fine.z_N).max()


def test_no_creep_no_force() -> None:
    plant = replace(pumps_connected(), creep=None)
    assert not creep_along(plant, 0.01, np.ones((5, 2))).any()
