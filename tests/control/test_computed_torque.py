"""Computed torque on the model it knows, without the twin."""

from __future__ import annotations

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE

from calib.actuator.integrate import simulate
from calib.control.computed_torque import ComputedTorque, step, wanted_motion
from calib.control.inverse_model import Model
from calib.control.observer import design_observer, predict, start_observer
from calib.control.setpoints import Ellipse, PolynomialElongation
from calib.errors import BadInputError


def _ellipse(model: Model, ticks: int) -> np.ndarray:
    return Ellipse().bellows_m(model.tick_s * np.arange(ticks), model.plant.bellows_radius_m)


def _commands(model: Model, q: np.ndarray, control: ComputedTorque) -> np.ndarray:
    """Commands when the model is the truth: the observer needs no readings."""
    observer, wanted = design_observer(model), wanted_motion(model, q)
    state, out = start_observer(observer), []
    for k in range(len(q)):
        command = step(control, observer, state, wanted, k)
        out.append(command.pwm)
        state = predict(observer, state, command.pwm)
    return np.array(out)


@pytest.mark.parametrize(("model", "horizon"), [(NOMINAL, 1), (NOMINAL, 12), (ORIFICE, 6)])
def test_with_a_perfect_model_the_ellipse_is_drawn(model: Model, horizon: int) -> None:
    """Whole PWM values and all: 0.03 mm, where PD with feed-forward is 0.8 mm off on the same plant."""
    q = _ellipse(model, 700)
    pwm = _commands(model, q, ComputedTorque(horizon))
    assert np.all((pwm >= 0) & (pwm <= 255) & (pwm == np.round(pwm)))
    truth = simulate(model.plant, model.pump, pwm)
    error = 1e3 * (q - truth.q_m[:700])[120:]
    assert float(np.sqrt(np.mean(error**2))) < 0.05
    assert float(np.abs(error).max()) < 0.2


def test_the_wanted_forces_are_those_of_the_simulation() -> None:
    """Along a simulated motion the wanted forces are the ones that drove it."""
    pwm = 170.0 + 60.0 * np.sin(np.arange(900) / 60.0)[:, None] * np.array([1.0, -0.7])
    truth = simulate(NOMINAL.plant, NOMINAL.pump, pwm)
    wanted = wanted_motion(NOMINAL, truth.q_m)
    inner = slice(60, -60)
    assert wanted.force_N[inner] == pytest.approx(truth.force_N[inner], abs=8e-3)


def test_after_the_reference_its_end_is_held() -> None:
    q = PolynomialElongation().bellows_m(NOMINAL.tick_s * np.arange(300))
    wanted = wanted_motion(NOMINAL, q)
    assert wanted.at(10) == 10 and wanted.at(5000) == 299


def test_it_tells_when_the_pumps_cannot() -> None:
    q = np.full((60, 2), 0.064)
    q[30:] = 0.12
    observer, wanted = design_observer(NOMINAL), wanted_motion(NOMINAL, q)
    state = start_observer(observer)
    assert step(ComputedTorque(), observer, state, wanted, 0).limited == (True, True)
    command = step(ComputedTorque(), observer, state, wanted, 40)
    assert command.limited == (True, True) and min(command.pwm) > 250.0
    easy = wanted_motion(NOMINAL, np.full((60, 2), 0.07))
    assert step(ComputedTorque(60), observer, state, easy, 0).limited == (False, False)


def test_gains_act_on_the_error() -> None:
    q = np.full((60, 2), 0.075)
    observer, wanted = design_observer(NOMINAL), wanted_motion(NOMINAL, q)
    state = start_observer(observer)
    plain = step(ComputedTorque(60), observer, state, wanted, 0)
    pulled = step(ComputedTorque(60, Kp_per_s2=1000.0), observer, state, wanted, 0)
    # M is 4.15 g per bellows straight, plus its share in turning, which cancels between equal errors.
    extra = np.subtract(pulled.wanted_N, plain.wanted_N)
    assert extra == pytest.approx([1000.0 * 0.01 * 0.0166 / 2] * 2, rel=1e-6)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"horizon_ticks": 0}, "horizon: found 0 ticks"),
        ({"Kp_per_s2": -1.0}, "Kp_per_s2: found -1"),
        ({"Kd_per_s": float("nan")}, "Kd_per_s: found nan"),
    ],
)
def test_parameters_that_cannot_be(words: dict[str, float], sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        ComputedTorque(**words)


def test_a_reference_needs_three_ticks() -> None:
    with pytest.raises(BadInputError, match="found 2 ticks"):
        wanted_motion(NOMINAL, np.full((2, 2), 0.07))
