"""The observer on the model that it knows: what it sees, what it believes, what it leaves out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.integrate import rig_at_rest, simulate
from calib.actuator.kinematics import forward, marker_from_head
from calib.control.inverse_model import Model
from calib.control.observer import (
    Observer,
    ObserverNoise,
    ObserverState,
    correct,
    design_observer,
    look_ahead,
    marker_jacobian,
    marker_of,
    predict,
    start_observer,
)
from calib.errors import BadInputError

R = NOMINAL.plant.bellows_radius_m
NAN = (math.nan, math.nan)


@given(q1=st.floats(0.05, 0.1), q2=st.floats(0.05, 0.1))
def test_the_marker_is_that_of_the_kinematics(q1: float, q2: float) -> None:
    pose = forward(np.array([q1, q2]), R)
    assert marker_of(q1, q2, R, 0.015) == pytest.approx(marker_from_head(pose[:2], pose[2], 0.015).tolist())


@given(q1=st.floats(0.05, 0.1), q2=st.floats(0.05, 0.1))
def test_its_jacobian_by_differences(q1: float, q2: float) -> None:
    eps, J = 1e-6, marker_jacobian(q1, q2, R, 0.015)
    by1 = np.subtract(marker_of(q1 + eps, q2, R, 0.015), marker_of(q1 - eps, q2, R, 0.015)) / (2 * eps)
    by2 = np.subtract(marker_of(q1, q2 + eps, R, 0.015), marker_of(q1, q2 - eps, R, 0.015)) / (2 * eps)
    assert np.stack([by1, by2], axis=1) == pytest.approx(J, abs=1e-6)


def _commands(ticks: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.repeat(rng.uniform(100.0, 250.0, size=(ticks // 20, 2)).round(), 20, axis=0)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
def test_without_readings_it_is_the_simulation(model: Model) -> None:
    pwm = _commands(300)
    truth = simulate(model.plant, model.pump, pwm, rig_at_rest(model.plant, model.pump))
    observer = design_observer(model)
    state = start_observer(observer)
    for k, row in enumerate(pwm.tolist()):
        # Forces go in straight lines between ticks here, along curves there.
        assert state.y[:2] == pytest.approx(truth.q_m[k], abs=3e-5)
        state = predict(observer, state, (row[0], row[1]))


def test_looking_ahead_is_predicting() -> None:
    observer = design_observer(NOMINAL)
    state = start_observer(observer)
    for row in _commands(60).tolist():
        state = predict(observer, state, (row[0], row[1]))
    y, pumps = look_ahead(observer, state)
    for _ in range(NOMINAL.pump.delay_ticks):
        state = predict(observer, state, (255.0, 255.0))
    assert y == pytest.approx(state.y, abs=1e-12)
    assert pumps.force_N == state.pumps.force_N


def _follow(
    observer: Observer, pwm: np.ndarray, truth: np.ndarray, noise_m: float, bias: float, push: float = 0.0
) -> list[ObserverState]:
    """Estimates along a simulated motion, the marker two ticks late."""
    rng = np.random.default_rng(11)
    state, out = start_observer(observer), []
    for k, row in enumerate(pwm.tolist()):
        q, dq = truth[max(k - 2, 0), :2], truth[k, 2:4]
        marker = np.array(marker_of(q[0], q[1], R, observer.marker_offset_m)) + noise_m * rng.normal(size=2)
        if k % 50 == 49:
            marker += push
        rate = (dq[0] - dq[1]) / (2 * R) + bias + 0.003 * rng.normal()
        state = correct(observer, state, (float(marker[0]), float(marker[1])), rate)
        out.append(state)
        state = predict(observer, state, (row[0], row[1]))
    return out


def test_it_finds_the_bias_and_is_better_than_its_readings() -> None:
    pwm = _commands(900)
    truth = simulate(NOMINAL.plant, NOMINAL.pump, pwm).states
    observer = design_observer(NOMINAL, latency_s=2.0 / 60.0)
    found = _follow(observer, pwm, truth, 2.5e-4, 0.03)
    error = np.array([s.y[:2] for s in found])[300:] - truth[300:900, :2]
    # The marker alone gives lengths to 2.5e-4 / sqrt(2) straight, and more than that bent.
    assert float(np.sqrt(np.mean(error**2))) < 2e-4
    assert np.mean([s.bias_radps for s in found[800:]]) == pytest.approx(0.03, abs=3e-3)


def test_an_unknown_force_is_found() -> None:
    """A plant with a pump 10 % weaker: d makes up for the missing force."""
    weak = Model(NOMINAL.plant, NOMINAL.pump, (0.9, 1.0))
    pwm = np.full((600, 2), 210.0)
    static = NOMINAL.pump.static.force_N(np.array([210.0]))[0]
    from calib.actuator.dynamics import coefficients
    from calib.actuator.kernel import STATE, run
    from calib.actuator.pump import pump_coefficients

    out = np.empty((600, len(STATE)))
    row = rig_at_rest(weak.plant, weak.pump).row
    forces = np.tile([0.9 * static, static], (600, 1))
    forces[:2] = 0.0
    assert run(coefficients(weak.plant), pump_coefficients(weak.pump), row, forces, 1 / 60, 17, 17, out) < 0
    truth = np.vstack([row, out])
    found = _follow(design_observer(NOMINAL, latency_s=2.0 / 60.0), pwm, truth, 1e-5, 0.0)
    assert found[-1].d_N == pytest.approx([-0.1 * static, 0.0], abs=0.01)


def test_outliers_are_not_believed_and_a_lost_estimate_comes_back() -> None:
    pwm = _commands(600)
    truth = simulate(NOMINAL.plant, NOMINAL.pump, pwm).states
    observer = design_observer(NOMINAL, latency_s=2.0 / 60.0)
    clean = np.array([s.y[:2] for s in _follow(observer, pwm, truth, 1e-4, 0.0)])
    dirty = np.array([s.y[:2] for s in _follow(observer, pwm, truth, 1e-4, 0.0, push=0.02)])
    assert np.abs(clean - dirty).max() < 2e-4
    state = start_observer(observer)
    away = marker_of(0.08, 0.08, R, 0.015)
    for _ in range(10):
        state = correct(observer, state, away, math.nan)
        assert state.y[0] == pytest.approx(0.065)
    assert correct(observer, state, away, math.nan).y[0] > 0.066


def test_nothing_read_nothing_changed() -> None:
    observer = design_observer(NOMINAL)
    state = predict(observer, start_observer(observer), (200.0, 150.0))
    same = correct(observer, state, NAN, math.nan)
    assert np.array_equal(same.y, state.y) and same.bias_radps == state.bias_radps


def test_noisier_sensors_are_believed_less() -> None:
    good = design_observer(NOMINAL, ObserverNoise(marker_m=1e-4)).gain
    poor = design_observer(NOMINAL, ObserverNoise(marker_m=1e-3)).gain
    assert good[0, 0] > poor[0, 0] > 0.0


def test_noise_that_cannot_be() -> None:
    with pytest.raises(BadInputError, match="observer marker_m: found 0"):
        ObserverNoise(marker_m=0.0)
