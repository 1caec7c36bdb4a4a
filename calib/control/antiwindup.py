"""PID with back-calculation, against the limits of the command and against what the pumps can do.

    v_k = Kp e_k + I_k + Ki h e_k / 2 + Kd (e_k - e_(k-1)) / h,    u_k = limit(v_k)
    I_(k+1) = I_k + h (Ki e_k + (u_k - v_k) / Tt)

Within the limits this is (4.4) exactly, the recursion of `calib.control.pid`. Beyond them the integral
follows the limited command with the time constant Tt instead of standing still, as it does in the
source's clamping (4.1.1).

The limits are not 0 and 255 alone. A bellows deflates slowly while the pump's lag runs ahead of it: a
command of 0 empties the lag within 2 s, the force needs 5 s, and before the force can be held again the
lag has to come all the way back. That is what makes the angle overshoot after a jump down, clamping or
not. Here the command is never below the one that empties the bellows with a share of the rate that the
orifice allows (`pump_model.least_pwm`), and the integral follows that limit like the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from calib.control.inverse_model import Model
from calib.control.pid import TICK_S, saturate
from calib.control.pump_model import PumpEstimate, ahead, least_pwm, pumps_at_rest, push
from calib.errors import BadInputError

__all__ = [
    "BackCalculation",
    "BackOrientation",
    "BackOrientationState",
    "BackState",
    "start_back_orientation",
    "step_back",
    "step_back_orientation",
]


@dataclass(frozen=True)
class BackCalculation:
    """Gains of one channel.

    Attributes
    ----------
    Kp, Ki, Kd : as in `pid.Pid`.
    tracking_s : Tt.
    tick_s : period.

    Raises `BadInputError` for gains that are not finite and times that are not positive or, for Tt,
    shorter than a tick: the integral would overshoot the limit.
    """

    Kp: float
    Ki: float = 0.0
    Kd: float = 0.0
    tracking_s: float = 4.0
    tick_s: float = TICK_S

    def __post_init__(self) -> None:
        for name, gain in (("Kp", self.Kp), ("Ki", self.Ki), ("Kd", self.Kd)):
            if not math.isfinite(gain):
                raise BadInputError(f"{name}: found {gain}, expected a finite gain")
        if not 0.0 < self.tick_s < math.inf:
            raise BadInputError(f"tick of the controller: found {self.tick_s:g} s, expected a positive time")
        if not self.tick_s <= self.tracking_s < math.inf:
            raise BadInputError(
                f"back-calculation time: found {self.tracking_s:g} s, expected at least a tick "
                f"({self.tick_s:.3g} s)"
            )


@dataclass(frozen=True)
class BackState:
    """What one tick hands to the next: the integral [PWM] and the error of the tick before."""

    integral: float = 0.0
    e1: float = 0.0


def step_back(
    control: BackCalculation, state: BackState, error: float, low: float, high: float
) -> tuple[BackState, float]:
    """One tick. Returns the next state and the command within its limits [PWM]."""
    h = control.tick_s
    v = control.Kp * error + state.integral + 0.5 * h * control.Ki * error
    v += control.Kd * (error - state.e1) / h
    u = min(max(v, low), high)
    integral = state.integral + h * (control.Ki * error + (u - v) / control.tracking_s)
    return BackState(integral, error), u


@dataclass(frozen=True)
class BackOrientation:
    """Control of the head's angle with back-calculation.

    Attributes
    ----------
    control : of both bellows.
    model : the identified rig; its pumps and limits.
    falling_share : share of the falling rate that a command may ask for; 1 for all of it, infinity for
        fixed limits only.
    sign : of the error of bellows 1, as in `loop.OrientationControl`.
    whole_pwm : send whole numbers to the motors.

    Raises `BadInputError` for another sign and a share that is negative.
    """

    control: BackCalculation
    model: Model
    falling_share: float = 0.4
    sign: int = 1
    whole_pwm: bool = True

    def __post_init__(self) -> None:
        if self.sign not in (1, -1):
            raise BadInputError(f"sign of the orientation error: found {self.sign}, expected 1 or -1")
        if not self.falling_share >= 0.0:
            raise BadInputError(
                f"share of the falling rate: found {self.falling_share:g}, expected 0 or more"
            )


@dataclass(frozen=True)
class BackOrientationState:
    """Memory of both channels, and the pumps as they follow from the commands."""

    pumps: PumpEstimate
    first: BackState = field(default_factory=BackState)
    second: BackState = field(default_factory=BackState)


def start_back_orientation(control: BackOrientation) -> BackOrientationState:
    """Zeros, pumps off."""
    return BackOrientationState(pumps_at_rest(control.model))


def step_back_orientation(
    control: BackOrientation, state: BackOrientationState, phi_ref_rad: float, phi_rad: float
) -> tuple[BackOrientationState, tuple[float, float]]:
    """One tick: the next state and the PWM values.

    Raises `BadInputError` for a measurement that is not a number.
    """
    if not (math.isfinite(phi_ref_rad) and math.isfinite(phi_rad)):
        raise BadInputError(
            f"angle of the orientation controller: found {phi_ref_rad}, {phi_rad}, expected finite numbers"
        )
    model, error = control.model, control.sign * (phi_ref_rad - phi_rad)
    low = (model.low_pwm, model.low_pwm)
    if math.isfinite(control.falling_share):
        low = least_pwm(model, ahead(model, state.pumps)[-1], control.falling_share)
    first, u1 = step_back(control.control, state.first, error, low[0], model.high_pwm)
    second, u2 = step_back(control.control, state.second, -error, low[1], model.high_pwm)
    pwm = (
        saturate(u1, control.whole_pwm, model.low_pwm, model.high_pwm),
        saturate(u2, control.whole_pwm, model.low_pwm, model.high_pwm),
    )
    return BackOrientationState(push(model, state.pumps, pwm), first, second), pwm
