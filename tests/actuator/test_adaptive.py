"""The adaptive integrators agree with each other and with a solver of their own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from source_model import acceleration

from adaptive import Method, simulate_adaptive, swing_adaptive
from calib.core.arrays import FloatArray
from calib.stages.actuator.parameters import Plant, pumps_connected
from calib.stages.actuator.pump import Pump, RateLimit, delayed, static_force_N
from calib.stages.actuator.simulate import state_row


@pytest.mark.parametrize("method", ["RK45", "Radau", "LSODA"])
def test_methods_agree(method: Method) -> None:
    plant, times = Plant(), np.linspace(0.0, 0.5, 11)
    exact = swing_adaptive(plant, state_row(plant, 0.5), times, rtol=1e-12, atol=1e-14)
    other = swing_adaptive(plant, state_row(plant, 0.5), times, method, 1e-9, 1e-11)
    assert np.abs(other.q_m - exact.q_m).max() < 1e-7


def test_reference_equations_give_the_same_swing() -> None:
    """The same swing from M, C, N and tau in plain numpy."""
    plant, times = Plant(gravity_mps2=(0.0, 9.81)), np.linspace(0.0, 0.3, 7)
    start = state_row(plant, 0.6, force_N=(0.2, 0.0))
    l1, l2, _ = plant.creep_rates

    def slope(_: float, y: FloatArray) -> FloatArray:
        ddq = acceleration(plant, y[:2], y[2:4], y[4:], start[8:])
        return np.concatenate([y[2:4], ddq, -l1 * y[4:] + l2 * y[2:4]])

    y = solve_ivp(slope, (0.0, 0.3), start[:6], method="DOP853", t_eval=times, rtol=1e-10, atol=1e-12).y
    motion = swing_adaptive(plant, start, times)
    assert np.abs(motion.q_m - y[:2].T).max() < 1e-9
    assert np.all(motion.force_N == [0.2, 0.0])


def test_pumps_as_differential_equations() -> None:
    """The closed form of lag and rate limit against the block diagram integrated in tiny steps."""
    pump, plant = Pump(deflation=RateLimit()), pumps_connected()
    pwm = np.repeat([[255.0, 180.0], [120.0, 0.0]], 40, axis=0)
    motion = simulate_adaptive(plant, pump, pwm, rtol=1e-8, atol=1e-10)
    force, lag = np.zeros(2), np.zeros(2)
    h = pump.tick_s / 2000
    for k, g in enumerate(static_force_N(pump, delayed(pump, pwm))):
        for _ in range(2000):
            lag = lag + h * (g - lag) / pump.lag_s
            force = np.maximum(lag, force - 0.4 * h)
        assert motion.force_N[k + 1] == pytest.approx(force, abs=2e-5)
