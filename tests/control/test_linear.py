"""Linear loops against the nonlinear simulation, SciPy's dlsim, and the recursion of the controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from calib.actuator.integrate import RigState, simulate
from calib.control.inverse_model import Model, feed_forward_pwm, holding_force
from calib.control.linear import (
    System,
    bent_rest,
    closed_loop,
    delay,
    firmware_sensing,
    gain,
    pid_system,
    pump_slope,
    response,
    rig_system,
    series,
    side_by_side,
    spectral_radius,
)
from calib.control.pid import Pid, PidState
from calib.control.pid import step as step_pid
from calib.control.tuning import orientation_loop, position_loop
from calib.errors import BadInputError

H = NOMINAL.tick_s


def _through(system: System, u: np.ndarray) -> np.ndarray:
    x, out = np.zeros(len(system.A)), []
    for row in u:
        out.append(system.C @ x + system.D @ row)
        x = system.A @ x + system.B @ row
    return np.array(out)


@pytest.mark.parametrize("gains", [(1000, 1000, 10), (500, 0, 0), (200, 0, 5), (300, 90, 0)])
def test_the_controller_as_a_system_is_its_recursion(gains: tuple[float, float, float]) -> None:
    pid = Pid(*gains)
    errors = np.random.default_rng(3).normal(size=200)
    state, expected = PidState(), []
    for e in errors.tolist():
        state, u = step_pid(pid, state, e)
        expected.append(u)
    system = pid_system(pid)
    assert len(system.A) == (gains[1] != 0) + (gains[2] != 0)
    assert _through(system, errors[:, None])[:, 0] == pytest.approx(np.array(expected), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("phi", [0.2, 0.5])
def test_a_step_of_the_closed_loop_against_scipy(phi: float) -> None:
    loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0, 5.0), tuple(bent_rest(NOMINAL, phi)))
    closed = closed_loop(loop)
    u = np.ones((400, 1))
    _, expected, _ = signal.dlsim((closed.A, closed.B, closed.C, closed.D, H), u)
    # Our own recursion of the open loop with the feedback around it.
    x, y = np.zeros(len(loop.A)), []
    for _ in range(400):
        out = float((loop.C @ x)[0])
        y.append(out)
        x = loop.A @ x + loop.B @ np.array([1.0 - out])
    assert np.array(y) == pytest.approx(np.asarray(expected)[:, 0], abs=1e-9)
    # With an integrator the angle ends at the set-point.
    assert y[-1] == pytest.approx(1.0, abs=2e-3)


def test_the_frequency_response_against_scipy() -> None:
    system = pid_system(Pid(470.0, 100.0, 5.0))
    w = np.linspace(0.01, 3.0, 50)
    _, expected = signal.dfreqresp((system.A, system.B, system.C, system.D, H), w)
    assert response(system, w / H)[:, 0, 0] == pytest.approx(expected, rel=1e-9)
    late = response(series(system, delay(3, H)), w / H)[:, 0, 0]
    assert late == pytest.approx(expected * np.exp(-3j * w), rel=1e-9)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize("q", [(0.075, 0.075), (0.085, 0.073)])
def test_small_steps_of_the_rig_are_those_of_the_simulation(model: Model, q: tuple[float, float]) -> None:
    at = np.array(q)
    F, pwm = holding_force(model.plant, at), feed_forward_pwm(model, at)
    row = np.array([*at, 0.0, 0.0, 0.0, 0.0, *F, *F])
    start = RigState(row, ((float(pwm[0]), float(pwm[1])),) * model.pump.delay_ticks)
    step = np.array([0.5, 0.0])
    motion = simulate(model.plant, model.pump, np.tile(pwm + step, (90, 1)), start)
    still = simulate(model.plant, model.pump, np.tile(pwm, (90, 1)), start)
    linear = _through(rig_system(model, at), np.tile(step, (90, 1)))
    moved = (motion.q_m - still.q_m)[:90]
    assert linear == pytest.approx(moved, abs=0.02 * float(np.abs(moved).max()))


def test_delays_and_series() -> None:
    u = np.random.default_rng(0).normal(size=(20, 1))
    assert _through(delay(3, H), u)[3:] == pytest.approx(u[:-3])
    assert _through(delay(0, H), u) == pytest.approx(u)
    both = side_by_side(delay(1, H), gain(np.array([[2.0]]), H))
    out = _through(both, np.hstack([u, u]))
    assert out[1:, 0] == pytest.approx(u[:-1, 0])
    assert out[:, 1] == pytest.approx(2.0 * u[:, 0])
    assert spectral_radius(gain(np.eye(2), H)) == 0.0


def test_what_the_firmware_sees() -> None:
    """The difference at once, the mean two ticks late and through the source's filter."""
    u = np.random.default_rng(1).normal(size=(300, 2))
    seen = _through(firmware_sensing(NOMINAL), u)
    assert seen[:, 0] - seen[:, 1] == pytest.approx(u[:, 0] - u[:, 1], abs=1e-9)
    b, a = signal.butter(1, 1.0, fs=60.0)
    mean = signal.lfilter(b, a, np.concatenate([[0.0, 0.0], u.mean(axis=1)]))[:300]
    assert seen.mean(axis=1) == pytest.approx(mean, abs=1e-9)


def test_the_slope_of_an_idle_pump_is_zero() -> None:
    q = bent_rest(NOMINAL, 0.4)
    slope = pump_slope(NOMINAL, q)
    assert slope[0] > 0.0 and slope[1] == 0.0
    step = (holding_force(NOMINAL.plant, q)[0], feed_forward_pwm(NOMINAL, q)[0])
    assert step[0] > 0.0 and 100.0 < step[1] < 255.0


@given(phi=st.floats(-0.85, 0.85))
def test_a_bent_rest_is_at_rest(phi: float) -> None:
    q = bent_rest(NOMINAL, phi)
    assert (q[0] - q[1]) / (2 * NOMINAL.plant.bellows_radius_m) == pytest.approx(phi, abs=1e-12)
    F = holding_force(NOMINAL.plant, q)
    idle = 1 if phi >= 0.0 else 0
    assert F[idle] == pytest.approx(0.0, abs=1e-9)
    assert F[1 - idle] >= -1e-9


def test_no_rest_at_a_full_turn() -> None:
    with pytest.raises(BadInputError, match="found 20 rad, at which no length is at rest"):
        bent_rest(NOMINAL, 20.0)


def test_the_head_projection_has_no_linear_model_here() -> None:
    head = replace(NOMINAL, plant=replace(NOMINAL.plant, force_projection="head"))
    with pytest.raises(BadInputError, match="force_projection is 'head'"):
        rig_system(head, np.array([0.07, 0.07]))


def test_a_position_loop_sees_static_errors_as_one_over_one_plus_gain() -> None:
    pid, q = Pid(15000.0), (0.078, 0.078)
    closed = closed_loop(position_loop(NOMINAL, pid, q))
    end = closed.C @ np.linalg.solve(np.eye(len(closed.A)) - closed.A, closed.B) + closed.D
    rig = rig_system(NOMINAL, np.array(q))
    dc = rig.C @ np.linalg.solve(np.eye(len(rig.A)) - rig.A, rig.B)
    assert end == pytest.approx(np.linalg.solve(np.eye(2) + 15000.0 * dc, 15000.0 * dc), rel=1e-6)
