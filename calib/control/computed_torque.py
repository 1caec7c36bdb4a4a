"""Computed torque with the observer's state, and the pumps' lag inverted where it can be.

The wanted forces at the time t + T, T the pumps' delay and a horizon, are those of the model in the
wanted motion, corrected by what the observer says of the real one:

    P F* = M (ddq_ref + Kd (dq_ref - dq^) + Kp (q_ref - q^)) + C dq_ref + N(q_ref, dq_ref)
           - lambda3 z^ - d^

with the estimates at the time at which the command arrives. Springs and bending are taken at the
reference and not at the estimate: the bellows are fast (4 Hz and more) and the pumps slow, so that
cancelling the springs through the pumps would be feedback of the wrong sign. The static error goes to
zero by d^, which takes the place of an integrator and needs no anti-windup: it is driven by the
measurements' disagreement with the model under the *limited* commands.

`calib.control.pump_model` then turns F* into a command. Where F* asks for more than the pumps can do
the nearest that they can is commanded; `limited` tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.actuator.dynamics import mass_matrix
from calib.arrays import FloatArray
from calib.control.inverse_model import Model, creep_along, largest_force_N, moving_force, pwm_of_force
from calib.control.observer import Observer, ObserverState, look_ahead
from calib.control.pid import saturate
from calib.control.pump_model import falling_rate, pwm_for_force
from calib.errors import BadInputError

__all__ = ["ComputedTorque", "TorqueCommand", "WantedMotion", "step", "wanted_motion"]


@dataclass(frozen=True)
class ComputedTorque:
    """Parameters of the law.

    Attributes
    ----------
    horizon_ticks : time in which the pumps are asked to reach the wanted force.
    Kp_per_s2, Kd_per_s : gains on the lengths' errors.
    whole_pwm : send whole numbers to the motors.

    Raises `BadInputError` for a horizon of less than a tick and for gains that are negative.
    """

    horizon_ticks: int = 6
    Kp_per_s2: float = 0.0
    Kd_per_s: float = 0.0
    whole_pwm: bool = True

    def __post_init__(self) -> None:
        if self.horizon_ticks < 1:
            raise BadInputError(f"horizon: found {self.horizon_ticks} ticks, expected at least 1")
        for name in ("Kp_per_s2", "Kd_per_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise BadInputError(f"{name}: found {getattr(self, name):g}, expected zero or more")


@dataclass(frozen=True)
class WantedMotion:
    """A reference at the ticks with the forces that the model needs for it.

    Attributes
    ----------
    q_m, dq_mps, z_N, force_N : (n, 2); the last row stands for all later ticks.
    """

    q_m: FloatArray
    dq_mps: FloatArray
    z_N: FloatArray
    force_N: FloatArray

    def at(self, k: int) -> int:
        """Row of the tick k."""
        return min(k, len(self.q_m) - 1)


@dataclass(frozen=True)
class TorqueCommand:
    """Result of a tick: what the motors get, and whether the pumps can do what was wanted of them."""

    pwm: tuple[float, float]
    wanted_N: tuple[float, float]
    limited: tuple[bool, bool]


def wanted_motion(model: Model, q_m: FloatArray) -> WantedMotion:
    """The motion along lengths (n, 2) [m] at the ticks; derivatives by central differences."""
    h = model.tick_s
    q = np.asarray(q_m, dtype=np.float64)
    if len(q) < 3:
        raise BadInputError(f"reference: found {len(q)} ticks, expected at least 3")
    dq = np.gradient(q, h, axis=0)
    ddq = np.zeros_like(q)
    ddq[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / h**2
    z = creep_along(model.plant, h, dq)
    return WantedMotion(q, dq, z, moving_force(model.plant, q, dq, ddq, z))


def step(
    control: ComputedTorque, observer: Observer, state: ObserverState, wanted: WantedMotion, k: int
) -> TorqueCommand:
    """The command of the tick k, from the estimate with the readings of that tick."""
    model = observer.model
    y, pumps = look_ahead(observer, state)
    arrives = wanted.at(k + model.pump.delay_ticks)
    then = wanted.at(k + model.pump.delay_ticks + control.horizon_ticks)
    crept = model.plant.creep_rates[2] * (y[4:6] - wanted.z_N[arrives])
    # A command that is held for T makes the force lead a ramp of slope s by s (T - tau (1 - a)).
    T, lag = control.horizon_ticks * model.tick_s, model.pump.lag_s
    lead = lag * -math.expm1(-T / lag) / T
    ramp = wanted.force_N[then] - wanted.force_N[arrives]
    force = wanted.force_N[arrives] + lead * ramp - crept - state.d_N
    if control.Kp_per_s2 or control.Kd_per_s:
        v = control.Kp_per_s2 * (wanted.q_m[arrives] - y[:2])
        v = v + control.Kd_per_s * (wanted.dq_mps[arrives] - y[2:4])
        force = force + mass_matrix(model.plant, y[:2]) @ v
    pwm = pwm_for_force(model, pumps, force, control.horizon_ticks)
    F = np.array(pumps.force_N)
    lowest = np.maximum(F - T * falling_rate(model, F), 0.0)
    limited = (
        (pwm >= pwm_of_force(model, largest_force_N(model)))
        | (force < lowest - 1e-3)
        | (force > largest_force_N(model))
    )
    u1, u2 = (saturate(u, control.whole_pwm, model.low_pwm, model.high_pwm) for u in pwm.tolist())
    return TorqueCommand((u1, u2), (float(force[0]), float(force[1])), (bool(limited[0]), bool(limited[1])))
