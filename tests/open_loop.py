"""The plant with its pumps and without sensors, in fixed steps: open loop, tick by tick, free swings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.kinematics import LARGEST_ANGLE_RAD
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import Pump, delayed, pump_coefficients, static_force_N
from calib.stages.actuator.simulate import (
    STATE,
    SUBSTEPS,
    RigState,
    check_start,
    largest_step_s,
    rig_at_rest,
    run,
)


@dataclass(frozen=True)
class Motion:
    """States over time.

    Attributes
    ----------
    t_s : (n,) times [s].
    states : (n, 10) rows as named in `calib.stages.actuator.simulate.STATE`.
    """

    t_s: FloatArray
    states: FloatArray

    @property
    def q_m(self) -> FloatArray:
        """Lengths of the bellows (n, 2) [m]."""
        return self.states[:, 0:2]

    @property
    def dq_mps(self) -> FloatArray:
        """Their rates (n, 2) [m/s]."""
        return self.states[:, 2:4]

    @property
    def z_N(self) -> FloatArray:
        """Creep forces (n, 2) [N]."""
        return self.states[:, 4:6]

    @property
    def force_N(self) -> FloatArray:
        """Forces of the pumps (n, 2) [N]."""
        return self.states[:, 8:10]


def _check_step(plant: Plant, step_s: float) -> None:
    largest = largest_step_s(plant)
    if step_s > largest:
        raise BadInputError(
            f"step: {step_s:.4g} s is too large for this stiffness and damping, "
            f"expected at most {largest:.4g} s"
        )


def _stepped(
    plant: Plant, pump: Pump, row: FloatArray, static_N: FloatArray, tick_s: float, substeps: int, every: int
) -> FloatArray:
    out = np.empty((len(static_N) * substeps // every, len(STATE)))
    stopped = run(coefficients(plant), pump_coefficients(pump), row, static_N, tick_s, substeps, every, out)
    if stopped >= 0:
        h = tick_s / substeps
        raise BadInputError(
            f"simulation: at {(stopped + 1) * h:.4g} s a bellows has no length left or the actuator curls up "
            f"beyond {LARGEST_ANGLE_RAD:g} rad; expected smaller forces, or steps below {h:.4g} s"
        )
    return out


def simulate(
    plant: Plant,
    pump: Pump,
    pwm: FloatArray,
    start: RigState | None = None,
    substeps: int = SUBSTEPS,
    every: int | None = None,
) -> Motion:
    """Open loop with fixed steps.

    Parameters
    ----------
    pwm : (n, 2) commands, row k given at the time k tick_s.
    start : at rest and straight by default.
    substeps : steps per tick.
    every : steps between two rows of the result, a whole tick by default.

    Returns
    -------
    `Motion` whose first row is the start.

    Raises
    ------
    BadInputError for a step too large for the stiffness and a motion that leaves the model.
    """
    begin = rig_at_rest(plant, pump) if start is None else start
    check_start(begin.row)
    rows = delayed(pump, pwm, np.array(begin.waiting_pwm, dtype=np.float64).reshape(-1, 2))
    stride = substeps if every is None else every
    h = pump.tick_s / substeps
    _check_step(plant, h)
    states = _stepped(plant, pump, begin.row, static_force_N(pump, rows), pump.tick_s, substeps, stride)
    t = h * stride * np.arange(len(states) + 1, dtype=np.float64)
    return Motion(t, np.vstack([begin.row, states]))


def tick(
    plant: Plant, pump: Pump, state: RigState, pwm: tuple[float, float], substeps: int = SUBSTEPS
) -> tuple[RigState, FloatArray]:
    """One tick of a closed loop: the state after it and the rows (substeps, 10) of all its steps."""
    queue = (*state.waiting_pwm, pwm)
    _check_step(plant, pump.tick_s / substeps)
    force = static_force_N(pump, np.array(queue[:1]))
    rows = _stepped(plant, pump, state.row, force, pump.tick_s, substeps, 1)
    return RigState(rows[-1], queue[1:]), rows


def swing(plant: Plant, start: FloatArray, duration_s: float, step_s: float = 1e-3, every: int = 1) -> Motion:
    """Motion under the constant forces in the row `start` (10,), with fixed steps; zero for a free swing.

    The duration is rounded to whole steps. Raises `BadInputError` as `simulate`.
    """
    check_start(start)
    _check_step(plant, step_s)
    steps = round(duration_s / step_s)
    static = np.tile(start[8:10], (steps, 1))
    held = np.concatenate([start[:6], start[8:10], start[8:10]])
    states = _stepped(plant, Pump(), held, static, step_s, 1, every)
    return Motion(step_s * every * np.arange(len(states) + 1, dtype=np.float64), np.vstack([held, states]))
