"""Simulating the actuator with SciPy's adaptive integrators: slow, and the yardstick of the fast steps.

The mechanics are those of `kernel.derivative`. With pumps `solve_ivp` is restarted at each tick, where
the command jumps; the pumps' forces do not depend on the mechanics and are known as functions of
time within a tick (`pump.advance`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from open_loop import Motion
from scipy.integrate import solve_ivp

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.kinematics import LARGEST_ANGLE_RAD
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import (
    Pump,
    PumpCoefficients,
    advance_pump,
    delayed,
    pump_coefficients,
    static_force_N,
)
from calib.stages.actuator.simulate import RigState, check_start, derivative, rig_at_rest

Method = Literal["RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA"]

Slope = Callable[[Any, FloatArray], FloatArray]


class _LeavesTheModel:
    """Event: the shorter bellows loses its length, or the actuator curls up."""

    terminal = True

    def __init__(self, bellows_radius_m: float) -> None:
        self.radius = bellows_radius_m

    def __call__(self, _: Any, y: FloatArray) -> float:
        turn = abs(float(y[0] - y[1])) / (2.0 * self.radius)
        return min(float(min(y[0], y[1])), self.radius * (LARGEST_ANGLE_RAD - turn))


def _solve(
    slope: Slope,
    y0: FloatArray,
    t_s: FloatArray,
    method: Method,
    rtol: float,
    atol: float,
    leaves: _LeavesTheModel,
) -> FloatArray:
    """States (n, 6) at the times (n,)."""
    span = (float(t_s[0]), float(t_s[-1]))
    solution = solve_ivp(slope, span, y0, method=method, t_eval=t_s, rtol=rtol, atol=atol, events=leaves)
    if solution.status == 1 and solution.t_events is not None:
        raise BadInputError(
            f"simulation: at {float(solution.t_events[0][0]):.4g} s a bellows has no length left or the "
            f"actuator curls up beyond {LARGEST_ANGLE_RAD:g} rad; expected smaller forces"
        )
    states = np.asarray(solution.y, dtype=np.float64).T
    if not solution.success or not np.all(np.isfinite(states)):
        raise BadInputError(f"simulation: the adaptive integrator stopped ({solution.message.rstrip('.')})")
    return states


def swing_adaptive(
    plant: Plant,
    start: FloatArray,
    t_s: FloatArray,
    method: Method = "DOP853",
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Motion:
    """Motion under the constant forces in the row `start` (10,), at the rising times `t_s` (n,) [s].

    The first time is that of the start. Raises `BadInputError` where the motion leaves the model
    or the integrator gives up.
    """
    check_start(start)
    c = coefficients(plant)
    F1, F2 = float(start[8]), float(start[9])
    times = np.asarray(t_s, dtype=np.float64)
    leaves = _LeavesTheModel(c.r)
    states = _solve(lambda _, y: derivative(c, y, F1, F2), start[:6], times, method, rtol, atol, leaves)
    return Motion(times, np.hstack([states, np.tile(start[[8, 9, 8, 9]], (len(times), 1))]))


def _pumps(
    pumps: tuple[PumpCoefficients, PumpCoefficients], row: FloatArray, g: FloatArray, t: float
) -> FloatArray:
    """lag1, lag2, force1, force2 [N] at the time t after the tick that began with `row`."""
    (lag1, _, force1), (lag2, _, force2) = (
        advance_pump(p, float(row[6 + i]), float(row[8 + i]), float(g[i]), math.exp(-0.5 * t / p.lag_s), t)
        for i, p in enumerate(pumps)
    )
    return np.array([lag1, lag2, force1, force2])


def simulate_adaptive(
    plant: Plant,
    pump: Pump,
    pwm: FloatArray,
    start: RigState | None = None,
    method: Method = "DOP853",
    rtol: float = 1e-10,
    atol: float = 1e-12,
) -> Motion:
    """As `open_loop.simulate`, one row per tick, by `solve_ivp` from tick to tick.

    Parameters
    ----------
    pwm : (n, 2) commands, row k given at the time k tick_s.
    start : at rest and straight by default.

    Raises
    ------
    BadInputError where the motion leaves the model or the integrator gives up.
    """
    begin = rig_at_rest(plant, pump) if start is None else start
    check_start(begin.row)
    rows = delayed(pump, pwm, np.array(begin.waiting_pwm, dtype=np.float64).reshape(-1, 2))
    c, p = coefficients(plant), pump_coefficients(pump)
    leaves = _LeavesTheModel(c.r)

    def after(row: FloatArray, g: FloatArray) -> FloatArray:
        def slope(t: float, y: FloatArray) -> FloatArray:
            _, _, F1, F2 = _pumps(p, row, g, t).tolist()
            return derivative(c, y, F1, F2)

        span = np.array([0.0, pump.tick_s])
        end = _solve(slope, row[:6], span, method, rtol, atol, leaves)[-1]
        return np.concatenate([end, _pumps(p, row, g, pump.tick_s)])

    states = [begin.row]
    for g in static_force_N(pump, rows):
        states.append(after(states[-1], g))
    return Motion(pump.tick_s * np.arange(len(states), dtype=np.float64), np.array(states))
