"""One tick of the two control schemes: orientation (Fig. 4.1, 4.6) and position (Fig. 4.10).

Each scheme turns a reference and a measurement into one error per bellows, runs one PID controller
for each, adds the feed-forward where there is one, and saturates:

    orientation   e = (s, -s)(phi_ref - phi)            (4.1), s = +1 or -1
    position      e = q_ref - q,  u + u_ff(q_ref)       (4.5), (4.6), (4.8)

The text under (4.1) says that bellows 2 has to extend when phi < phi_ref; the formula drives bellows
1, which agrees with phi = (q1 - q2) / (2 r_B) of (3.3). `sign` is +1 for the formula, -1 for a rig
whose hoses are crossed.

The loop has no memory but that of the controllers: the feed-forward and the saturated values are not
fed back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from calib.control.feedforward import FeedForward, feed_forward
from calib.control.pid import Pid, PidState, saturate
from calib.control.pid import step as step_pid
from calib.errors import BadInputError

__all__ = [
    "Command",
    "LoopState",
    "OrientationControl",
    "PositionControl",
    "step_orientation",
    "step_position",
]


@dataclass(frozen=True)
class OrientationControl:
    """Control of the head's angle alone.

    Attributes
    ----------
    pid : the controller of both bellows.
    sign : of the error of bellows 1 (4.1).
    whole_pwm : send whole numbers to the motors, as the microcontroller does.
    """

    pid: Pid
    sign: int = 1
    whole_pwm: bool = True

    def __post_init__(self) -> None:
        if self.sign not in (1, -1):
            raise BadInputError(f"sign of the orientation error: found {self.sign}, expected 1 or -1")


@dataclass(frozen=True)
class PositionControl:
    """Control of both bellows' lengths.

    Attributes
    ----------
    pid : the controller of both bellows.
    feedforward : None for feedback alone.
    whole_pwm : send whole numbers to the motors, as the microcontroller does.
    """

    pid: Pid
    feedforward: FeedForward | None = field(default_factory=FeedForward)
    whole_pwm: bool = True


@dataclass(frozen=True)
class LoopState:
    """Memory of the two controllers, zeros at the start."""

    first: PidState = field(default_factory=PidState)
    second: PidState = field(default_factory=PidState)


@dataclass(frozen=True)
class Command:
    """Result of a tick for bellows 1 and 2.

    Attributes
    ----------
    pwm : what the motors get.
    feedback : output of the feedback controllers before saturation.
    """

    pwm: tuple[float, float]
    feedback: tuple[float, float]


def _finite(what: str, *values: float) -> None:
    if not all(map(math.isfinite, values)):
        raise BadInputError(f"{what}: found {', '.join(map(str, values))}, expected finite numbers")


def step_orientation(
    control: OrientationControl, state: LoopState, phi_ref_rad: float, phi_rad: float
) -> tuple[LoopState, Command]:
    """One tick of orientation control.

    Parameters
    ----------
    phi_ref_rad, phi_rad : wanted and measured angle of the head [rad].

    Raises `BadInputError` for a measurement that is not a number: a controller must not remember it.
    """
    _finite("angle of the orientation controller", phi_ref_rad, phi_rad)
    error = control.sign * (phi_ref_rad - phi_rad)
    first, u1 = step_pid(control.pid, state.first, error)
    second, u2 = step_pid(control.pid, state.second, -error)
    pwm = (saturate(u1, control.whole_pwm), saturate(u2, control.whole_pwm))
    return LoopState(first, second), Command(pwm, (u1, u2))


def step_position(
    control: PositionControl, state: LoopState, q_ref_m: tuple[float, float], q_m: tuple[float, float]
) -> tuple[LoopState, Command]:
    """One tick of position control.

    Parameters
    ----------
    q_ref_m, q_m : wanted and measured lengths of the bellows [m].

    Raises `BadInputError` for a measurement that is not a number.
    """
    _finite("lengths of the position controller", *q_ref_m, *q_m)
    first, u1 = step_pid(control.pid, state.first, q_ref_m[0] - q_m[0])
    second, u2 = step_pid(control.pid, state.second, q_ref_m[1] - q_m[1])
    extra1, extra2 = 0.0, 0.0
    if control.feedforward is not None:
        extra1 = feed_forward(control.feedforward, q_ref_m[0])
        extra2 = feed_forward(control.feedforward, q_ref_m[1])
    pwm = (saturate(u1 + extra1, control.whole_pwm), saturate(u2 + extra2, control.whole_pwm))
    return LoopState(first, second), Command(pwm, (u1, u2))
