"""Simulating the actuator with fixed steps in time with the controller's ticks.

Classical Runge-Kutta with `substeps` steps per tick, compiled (`kernel`). A command that is
given at a tick acts `delay_ticks` later and is constant within a tick, so no step ever spans a jump.
The default of 17 steps per tick at 60 Hz is 0.98 ms; the bellows' lengths then agree with an
adaptive method at 1e-12 to well within a micrometre.

A step that is too large for the stiffness is refused beforehand, by the roots of the plant linearised
about the straight rest and the longest elongation and Runge-Kutta's region of stability; a motion
that leaves the model is refused when it does, never returned as NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.actuator.arc import LARGEST_ANGLE_RAD
from calib.actuator.dynamics import coefficients, linearised
from calib.actuator.kernel import STATE, run
from calib.actuator.parameters import Plant
from calib.actuator.pump import Pump, delayed, pump_at_rest, pump_coefficients, static_force_N
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = [
    "SUBSTEPS",
    "Motion",
    "RigState",
    "check_start",
    "largest_step_s",
    "rig_at_rest",
    "simulate",
    "state_row",
    "swing",
    "tick",
]

SUBSTEPS = 17
"""Steps per tick: 0.98 ms at 60 Hz."""

_STRETCHED_M = 0.0266
"""Elongation at 12 V, where the stiffness is greatest in use."""


@dataclass(frozen=True)
class Motion:
    """States over time.

    Attributes
    ----------
    t_s : (n,) times [s].
    states : (n, 10) rows as named in `kernel.STATE`.
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


@dataclass(frozen=True)
class RigState:
    """Plant and pumps at a tick: a row of `kernel.STATE` and the commands on their way, oldest first."""

    row: FloatArray
    waiting_pwm: tuple[tuple[float, float], ...]


def state_row(
    plant: Plant,
    phi_rad: float = 0.0,
    length_m: float | None = None,
    force_N: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """A row (10,) of `kernel.STATE` at rest at an angle and a length (the rest length by default).

    Raises `BadInputError` where a bellows would have no length.
    """
    l = plant.rest_length_m if length_m is None else length_m  # noqa: E741  the source's symbol
    turned = plant.bellows_radius_m * phi_rad
    row = np.array([l + turned, l - turned, 0.0, 0.0, 0.0, 0.0, *force_N, *force_N])
    check_start(row)
    return row


def rig_at_rest(plant: Plant, pump: Pump, phi_rad: float = 0.0, length_m: float | None = None) -> RigState:
    """The rig before the first command: pumps off, plant at rest at an angle and a length."""
    off = pump_at_rest(pump)
    return RigState(state_row(plant, phi_rad, length_m, off.force_N), off.waiting_pwm)


def check_start(row: FloatArray) -> None:
    """Raise `BadInputError` unless a row (10,) of `kernel.STATE` is finite with positive lengths."""
    if row.shape != (len(STATE),) or not np.all(np.isfinite(row)):
        raise BadInputError(f"start: found shape {row.shape}, expected {len(STATE)} finite numbers")
    if not min(row[0], row[1]) > 0.0:
        raise BadInputError(
            f"start: found bellows of {row[0]:.6g} m and {row[1]:.6g} m, expected positive lengths"
        )


def _stable_step_s(A: FloatArray) -> float:
    """Largest step that keeps Runge-Kutta from blowing up modes that decay or swing by themselves."""

    def grows(h: float) -> bool:
        w = h * modes
        gain = np.abs(1.0 + w * (1.0 + w / 2.0 * (1.0 + w / 3.0 * (1.0 + w / 4.0))))
        return bool(np.any(gain > 1.0 + 1e-9))

    roots = np.linalg.eigvals(A)
    modes = roots[(np.abs(roots) > 0.0) & (roots.real <= 1e-9 * np.abs(roots).max())]
    if len(modes) == 0:
        return math.inf
    # Rounding may leave an undamped root on the right of the axis; it belongs on it.
    modes = np.minimum(modes.real, 0.0) + 1j * modes.imag
    high = 3.0 / float(np.abs(modes).max())
    low = 0.1 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return low


@lru_cache(maxsize=256)
def _largest_step_straight_s(plant: Plant) -> float:
    lengths = (plant.rest_length_m, plant.rest_length_m + _STRETCHED_M)
    return min(_stable_step_s(linearised(plant, np.full(2, q))) for q in lengths)


def largest_step_s(plant: Plant, q_m: FloatArray | None = None) -> float:
    """Largest stable step [s] at rest, at the longest elongation and, if given, at the lengths (2,).

    Steps that are accurate are a tenth of it and less.
    """
    step = _largest_step_straight_s(plant)
    if q_m is None:
        return step
    return min(step, _stable_step_s(linearised(plant, q_m)))


def _check_step(plant: Plant, step_s: float) -> None:
    if not 0.0 < step_s < math.inf:
        raise BadInputError(f"step: found {step_s:g} s, expected a positive time")
    largest = _largest_step_straight_s(plant)
    if step_s > largest:
        raise BadInputError(
            f"step: {step_s:.4g} s is too large for this stiffness and damping, "
            f"expected at most {largest:.4g} s"
        )


def _run(
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


def _check_counts(substeps: int, every: int, ticks: int) -> None:
    if substeps < 1 or every < 1:
        raise BadInputError(f"steps: found {substeps} per tick, every {every}, expected 1 or more")
    if ticks < 1:
        raise BadInputError("pwm: found no rows, expected at least one tick")


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
    _check_counts(substeps, stride, len(rows))
    h = pump.tick_s / substeps
    _check_step(plant, h)
    states = _run(plant, pump, begin.row, static_force_N(pump, rows), pump.tick_s, substeps, stride)
    t = h * stride * np.arange(len(states) + 1, dtype=np.float64)
    return Motion(t, np.vstack([begin.row, states]))


def tick(
    plant: Plant, pump: Pump, state: RigState, pwm: tuple[float, float], substeps: int = SUBSTEPS
) -> tuple[RigState, FloatArray]:
    """One tick of a closed loop: the state after it and the rows (substeps, 10) of all its steps."""
    queue = (*state.waiting_pwm, pwm)
    _check_counts(substeps, 1, 1)
    _check_step(plant, pump.tick_s / substeps)
    force = static_force_N(pump, np.array(queue[:1]))
    rows = _run(plant, pump, state.row, force, pump.tick_s, substeps, 1)
    return RigState(rows[-1], queue[1:]), rows


def swing(plant: Plant, start: FloatArray, duration_s: float, step_s: float = 1e-3, every: int = 1) -> Motion:
    """Motion under the constant forces in the row `start` (10,), with fixed steps; zero for a free swing.

    The duration is rounded to whole steps. Raises `BadInputError` as `simulate`.
    """
    check_start(start)
    _check_step(plant, step_s)
    steps = round(duration_s / step_s)
    _check_counts(1, every, steps // max(every, 1))
    static = np.tile(start[8:10], (steps, 1))
    held = np.concatenate([start[:6], start[8:10], start[8:10]])
    states = _run(plant, Pump(), held, static, step_s, 1, every)
    return Motion(step_s * every * np.arange(len(states) + 1, dtype=np.float64), np.vstack([held, states]))
