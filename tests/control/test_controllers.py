"""Controllers: PID, limits and anti-windup, feed-forward, the model read backwards, the observer."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from control_models import MODELS, NOMINAL, ORIFICE, UNLIKE
from hypothesis import assume, given
from hypothesis import strategies as st
from open_loop import simulate, tick
from scipy.signal import dlsim, dlti, lfilter
from source_model import acceleration

from calib.stages.actuator.parameters import pumps_connected
from calib.stages.actuator.pump import static_force_N
from calib.stages.actuator.simulate import rig_at_rest
from calib.stages.control.laws import (
    Channel,
    ComputedTorque,
    FeedForward,
    Pid,
    computed_torque_step,
    feed_forward,
    step_back,
    wanted_motion,
)
from calib.stages.control.observer import Observer, design_observer, marker_jacobian, marker_position
from calib.stages.control.references import Ellipse
from calib.stages.control.rig_model import (
    Model,
    PumpEstimate,
    ahead,
    feed_forward_pwm,
    force_of_pwm,
    holding_force,
    largest_force_N,
    moving_force,
    pumps_at_rest,
    push,
    pwm_for_force,
    pwm_of_force,
    static_stiffness,
)


def _outputs(pid: Pid, errors: list[float]) -> np.ndarray:
    channel = Channel(pid)
    return np.array([channel.step(error) for error in errors])


def test_it_is_the_transfer_function_of_the_appendix() -> None:
    Kp, Ki, Kd, h = 1000.0, 1000.0, 10.0, 1.0 / 60.0
    e = np.random.default_rng(1).normal(size=200)
    # (D.6): Kp + Ki h / 2 (z + 1) / (z - 1) + Kd / h (z - 1) / z, over the common denominator z (z - 1).
    numerator = (
        Kp * np.array([1.0, -1.0, 0.0])
        + 0.5 * Ki * h * np.array([1.0, 1.0, 0.0])
        + Kd / h * np.array([1.0, -2.0, 1.0])
    )
    _, by_z = dlsim(dlti(numerator, [1.0, -1.0, 0.0], dt=h), e)
    ours = _outputs(Pid(Kp, Ki, Kd), e.tolist())
    assert np.allclose(ours, by_z[:, 0], rtol=1e-10, atol=1e-8)
    # (D.9) as a filter.
    b = [Kp + 0.5 * Ki * h + Kd / h, -Kp + 0.5 * Ki * h - 2.0 * Kd / h, Kd / h]
    assert np.allclose(ours, lfilter(b, [1.0, -1.0], e), rtol=1e-10, atol=1e-8)


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=60))
def test_clamping_drops_the_integral_where_the_output_is_out_of_range(errors: list[float]) -> None:
    """Against the incremental form of (4.4), which remembers the output, however far beyond the limits."""
    pid = Pid(1000.0, 1000.0, 10.0, clamping=True)
    channel, u, e1, e2 = Channel(pid), 0.0, 0.0, 0.0

    def moved(Ki: float, e0: float) -> float:
        a, b = 0.5 * Ki * pid.tick_s, pid.Kd / pid.tick_s
        return u + (pid.Kp + a + b) * e0 + (a - pid.Kp - 2.0 * b) * e1 + b * e2

    for e0 in errors:
        whole = moved(pid.Ki, e0)
        assume(min(abs(whole), abs(whole - 255.0)) > 1e-6)
        u = whole if 0.0 <= whole <= 255.0 else moved(0.0, e0)
        e1, e2 = e0, e1
        assert channel.step(e0) == pytest.approx(u, abs=1e-8)


errors = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60)


@given(errors=errors, tracking_s=st.floats(0.02, 5.0))
def test_commands_stay_within_their_limits(errors: list[float], tracking_s: float) -> None:
    channel = Channel(Pid(1000.0, 1000.0, 10.0))
    for error in errors:
        assert 10.0 <= step_back(channel, error, 10.0, 200.0, tracking_s) <= 200.0


def test_without_an_integral_none_follows_the_limits() -> None:
    """Nothing would empty it again: a PD that was beyond its limits once would be off for ever."""
    channel = Channel(Pid(100.0, 0.0, 1.0))
    for _ in range(100):
        step_back(channel, 3.0, 0.0, 255.0, 0.5)
    step_back(channel, 1.0, 0.0, 255.0, 0.5)
    assert step_back(channel, 1.0, 0.0, 255.0, 0.5) == pytest.approx(100.0)


def test_a_constant_error_beyond_the_limit_settles_the_integral() -> None:
    """At rest Ki e = (v - u) / Tt: the integral stops a known way beyond the limit, it does not wind up."""
    channel = Channel(Pid(100.0, 50.0, 0.0))
    for _ in range(3000):
        assert step_back(channel, 3.0, 0.0, 255.0, 0.5) == 255.0
    v = channel.step(3.0)
    assert v - 255.0 == pytest.approx(0.5 * 50.0 * 3.0, rel=1e-9)


LINE = FeedForward()


def test_values_of_the_text() -> None:
    assert feed_forward(LINE, math.nextafter(0.067, 0.0)) == 0.0
    assert feed_forward(LINE, 0.067) == 110.0
    assert feed_forward(LINE, 0.091) == pytest.approx(241.95, abs=0.01)
    assert feed_forward(LINE, 0.09336) < 255.0
    assert feed_forward(LINE, 0.09338) == 255.0
    assert feed_forward(LINE, 1.0) == 255.0


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


@given(q=lengths, dq=rates, ddq=rates, z=rates)
def test_moving_forces_are_the_inverse_of_accelerations(
    q: tuple[float, float], dq: tuple[float, float], ddq: tuple[float, float], z: tuple
) -> None:
    plant = replace(pumps_connected(), gravity_mps2=(0.0, 9.81))
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


commands = st.lists(st.tuples(st.floats(0, 255), st.floats(0, 255)), min_size=1, max_size=40)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@given(pwm=commands)
def test_it_follows_the_pumps_of_the_plant(model: Model, pwm: list[tuple[float, float]]) -> None:
    mine, plant = pumps_at_rest(model), rig_at_rest(model.plant, model.pump)
    for pair in pwm:
        mine, (plant, _) = push(model, mine, pair), tick(model.plant, model.pump, plant, pair)
        # One step in a tick here, many there: where the valve of an orifice closes they differ.
        assert mine.force_N == pytest.approx(plant.row[8:], abs=2e-5)
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


R = NOMINAL.plant.bellows_radius_m


@given(q1=st.floats(0.05, 0.1), q2=st.floats(0.05, 0.1))
def test_its_jacobian_by_differences(q1: float, q2: float) -> None:
    eps, q = 1e-6, np.array([q1, q2])
    sides = [marker_position(q + e, R, 0.015) - marker_position(q - e, R, 0.015) for e in eps * np.eye(2)]
    assert np.stack(sides, axis=1) / (2 * eps) == pytest.approx(marker_jacobian(q, R, 0.015), abs=1e-6)


def _commands(ticks: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.repeat(rng.uniform(100.0, 250.0, size=(ticks // 20, 2)).round(), 20, axis=0)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
def test_without_readings_it_is_the_simulation(model: Model) -> None:
    pwm = _commands(300)
    truth = simulate(model.plant, model.pump, pwm, rig_at_rest(model.plant, model.pump))
    observer = design_observer(model)
    for k, row in enumerate(pwm.tolist()):
        # Forces go in straight lines between ticks here, along curves there.
        assert observer.y[:2] == pytest.approx(truth.q_m[k], abs=3e-5)
        observer.predict((row[0], row[1]))


def _follow(
    pwm: np.ndarray, truth: np.ndarray, noise_m: float, bias: float, push: float = 0.0
) -> list[Observer]:
    """Observers tick by tick along a simulated motion, the marker two ticks late."""
    rng, out = np.random.default_rng(11), []
    observer = design_observer(NOMINAL, latency_s=2.0 / 60.0)
    for k, row in enumerate(pwm.tolist()):
        q, dq = truth[max(k - 2, 0), :2], truth[k, 2:4]
        marker = marker_position(q, R, observer.marker_offset_m) + noise_m * rng.normal(size=2)
        if k % 50 == 49:
            marker += push
        rate = (dq[0] - dq[1]) / (2 * R) + bias + 0.003 * rng.normal()
        observer.correct((float(marker[0]), float(marker[1])), rate)
        out.append(copy(observer))
        observer.predict((row[0], row[1]))
    return out


def test_it_finds_the_bias_and_is_better_than_its_readings() -> None:
    pwm = _commands(900)
    truth = simulate(NOMINAL.plant, NOMINAL.pump, pwm).states
    found = _follow(pwm, truth, 2.5e-4, 0.03)
    error = np.array([s.y[:2] for s in found])[300:] - truth[300:900, :2]
    # The marker alone gives lengths to 2.5e-4 / sqrt(2) straight, and more than that bent.
    assert float(np.sqrt(np.mean(error**2))) < 2e-4
    assert np.mean([s.bias_radps for s in found[800:]]) == pytest.approx(0.03, abs=3e-3)


def test_an_unknown_force_is_found() -> None:
    """A plant with a pump 10 % weaker: d makes up for the missing force."""
    weak = Model(NOMINAL.plant, NOMINAL.pump, (0.9, 1.0))
    pwm = np.full((600, 2), 210.0)
    static = NOMINAL.pump.static.force_N(np.array([210.0]))[0]
    from calib.stages.actuator.dynamics import coefficients
    from calib.stages.actuator.pump import pump_coefficients
    from calib.stages.actuator.simulate import STATE, run

    out = np.empty((600, len(STATE)))
    row = rig_at_rest(weak.plant, weak.pump).row
    forces = np.tile([0.9 * static, static], (600, 1))
    forces[:2] = 0.0
    assert run(coefficients(weak.plant), pump_coefficients(weak.pump), row, forces, 1 / 60, 17, 17, out) < 0
    truth = np.vstack([row, out])
    found = _follow(pwm, truth, 1e-5, 0.0)
    assert found[-1].d_N == pytest.approx([-0.1 * static, 0.0], abs=0.01)


def test_outliers_are_not_believed_and_a_lost_estimate_comes_back() -> None:
    pwm = _commands(600)
    truth = simulate(NOMINAL.plant, NOMINAL.pump, pwm).states
    clean = np.array([s.y[:2] for s in _follow(pwm, truth, 1e-4, 0.0)])
    dirty = np.array([s.y[:2] for s in _follow(pwm, truth, 1e-4, 0.0, push=0.02)])
    assert np.abs(clean - dirty).max() < 2e-4
    observer = design_observer(NOMINAL, latency_s=2.0 / 60.0)
    x, y = marker_position(np.array([0.08, 0.08]), R, 0.015).tolist()
    for _ in range(10):
        observer.correct((x, y), math.nan)
        assert observer.y[0] == pytest.approx(0.065)
    observer.correct((x, y), math.nan)
    assert observer.y[0] > 0.066


def _ellipse(model: Model, ticks: int) -> np.ndarray:
    return Ellipse().bellows_m(model.tick_s * np.arange(ticks), model.plant.bellows_radius_m)


def _commands_computed_torque(model: Model, q: np.ndarray, control: ComputedTorque) -> np.ndarray:
    """Commands when the model is the truth: the observer needs no readings."""
    observer, wanted = design_observer(model), wanted_motion(model, q)
    out = []
    for k in range(len(q)):
        pwm, _ = computed_torque_step(control, observer, wanted, k)
        out.append(pwm)
        observer.predict(pwm)
    return np.array(out)


@pytest.mark.few(2)
@pytest.mark.parametrize(("model", "horizon"), [(NOMINAL, 1), (NOMINAL, 12), (ORIFICE, 6)])
def test_with_a_perfect_model_the_ellipse_is_drawn(model: Model, horizon: int) -> None:
    """Whole PWM values and all: 0.03 mm, where PD with feed-forward is 0.8 mm off on the same plant."""
    q = _ellipse(model, 700)
    pwm = _commands_computed_torque(model, q, ComputedTorque(horizon))
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
