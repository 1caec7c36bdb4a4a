"""The discrete PID controller in its incremental form, with integrator clamping (4.4, D.1 - D.9).

The backward difference for the derivative and the trapezoidal rule for the integral give

    u_k = u_(k-1) + (Kp + Ki h / 2 + Kd / h) e_k + (-Kp + Ki h / 2 - 2 Kd / h) e_(k-1) + Kd / h e_(k-2)

with the tick h. Its transfer function is (D.6) exactly, so that with a history of zeros it is the
sum of a proportional, an integral and a derivative term without any memory but the integral:

    u_k = Kp e_k + Ki h (e_0 + ... + e_(k-1) + e_k / 2) + Kd (e_k - e_(k-1)) / h,  e_(-1) = 0.

Three points that the source leaves open, and that decide whether the loop works:

- History. It starts from zeros. Filling it with e_0 leaves out the first step of the proportional
  term, and with Ki = 0 the output is then wrong by -Kp e_0 for ever.
- Memory. u_(k-1) is the output of this recursion before saturation. With the saturated value stored,
  the recursion forgets what lay beyond the limits: 0.7 rad is then never reached within 5 s. Nor may
  a feed-forward term be in it, since it would be added again at every tick.
- Clamping. When u_k lies outside the limits it is computed again with Ki = 0 and the same history
  (4.1.1), and that value is both the output and the next u_(k-1).

A controller here has one channel; `calib.control.loop` runs one for each bellows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.actuator.pump import PWM_MAX
from calib.errors import BadInputError

__all__ = ["PWM_MIN", "TICK_S", "Pid", "PidState", "saturate", "step"]

PWM_MIN = 0.0
"""Limits of what the microcontroller can put out, 0 V to 12 V, with `PWM_MAX`."""

TICK_S = 1.0 / 60.0
"""Period of the controller (4.1)."""


@dataclass(frozen=True)
class Pid:
    """Gains of one channel.

    Attributes
    ----------
    Kp, Ki, Kd : gains [PWM per unit of the error, per second of it, per unit per second].
    clamping : compute outputs beyond the limits again with Ki = 0.
    low, high : limits that clamping goes by [PWM].
    tick_s : period.

    Raises `BadInputError` for gains that are not finite, a period that is not positive, or limits in
    the wrong order.
    """

    Kp: float
    Ki: float = 0.0
    Kd: float = 0.0
    clamping: bool = False
    low: float = PWM_MIN
    high: float = PWM_MAX
    tick_s: float = TICK_S

    def __post_init__(self) -> None:
        for name, gain in (("Kp", self.Kp), ("Ki", self.Ki), ("Kd", self.Kd)):
            if not math.isfinite(gain):
                raise BadInputError(f"{name}: found {gain}, expected a finite gain")
        if not 0.0 < self.tick_s < math.inf:
            raise BadInputError(f"tick of the controller: found {self.tick_s:g} s, expected a positive time")
        if not self.low < self.high:
            raise BadInputError(
                f"limits of the controller: found {self.low:g} to {self.high:g}, expected low < high"
            )


@dataclass(frozen=True)
class PidState:
    """What one tick hands to the next; zeros at the start.

    Attributes
    ----------
    u : output of the tick before, not saturated [PWM].
    e1, e2 : errors of the tick before and the one before that.
    """

    u: float = 0.0
    e1: float = 0.0
    e2: float = 0.0


def _increment(Kp: float, Ki: float, Kd: float, h: float, error: float, state: PidState) -> float:
    """u_k - u_(k-1) of (4.4)."""
    integral, derivative = 0.5 * Ki * h, Kd / h
    return (
        (Kp + integral + derivative) * error
        + (integral - Kp - 2.0 * derivative) * state.e1
        + derivative * state.e2
    )


def step(pid: Pid, state: PidState, error: float) -> tuple[PidState, float]:
    """One tick of (4.4), and of (4.8) for Ki = 0.

    Parameters
    ----------
    error : e_k, set-point minus measured value.

    Returns
    -------
    The next state, and u_k before saturation [PWM].
    """
    u = state.u + _increment(pid.Kp, pid.Ki, pid.Kd, pid.tick_s, error, state)
    if pid.clamping and not pid.low <= u <= pid.high:
        u = state.u + _increment(pid.Kp, 0.0, pid.Kd, pid.tick_s, error, state)
    return PidState(u, error, state.e1), u


def saturate(u: float, whole: bool = True, low: float = PWM_MIN, high: float = PWM_MAX) -> float:
    """What reaches the motor [PWM]: limited, and a whole number as the PWM register holds one."""
    limited = min(max(u, low), high)
    return math.floor(limited + 0.5) if whole else limited
