"""Control laws: PID with clamping and with back-calculation, feed-forward, computed torque."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator import dynamics
from calib.stages.actuator.parameters import TICK_S
from calib.stages.actuator.pump import PWM_MAX
from calib.stages.control import rig_model
from calib.stages.control.observer import Observer
from calib.stages.control.rig_model import PWM_MIN, Model, Pair

# ----------------------------------------------------------------------
# The discrete PID controller with integrator clamping (4.4, D.1 - D.9).
#
# The backward difference for the derivative and the trapezoidal rule for the integral give
#
#     u_k = u_(k-1) + (Kp + Ki h / 2 + Kd / h) e_k + (-Kp + Ki h / 2 - 2 Kd / h) e_(k-1) + Kd / h e_(k-2)
#
# with the tick h. Its transfer function is (D.6) exactly, so that with a history of zeros it is the
# sum of a proportional, an integral and a derivative term without any memory but the integral:
#
#     u_k = Kp e_k + Ki h (e_0 + ... + e_(k-1) + e_k / 2) + Kd (e_k - e_(k-1)) / h,  e_(-1) = 0.
#
# That is how it is computed here: sums of products instead of differences of outputs.
#
# Three points that the source leaves open, and that decide whether the loop works:
#
# - History. It starts from zeros. Filling it with e_0 leaves out the first step of the proportional
#   term, and with Ki = 0 the output is then wrong by -Kp e_0 for ever.
# - Memory. u_(k-1) is the output before saturation. With the saturated value stored,
#   the recursion forgets what lay beyond the limits: 0.7 rad is then never reached within 5 s. Nor may
#   a feed-forward term be in it, since it would be added again at every tick.
# - Clamping. When u_k lies outside the limits it is computed again with Ki = 0 and the same history
#   (4.1.1), and that value is both the output and the next u_(k-1): the tick adds nothing to the sum.
#
# A controller has one channel for each bellows.


@dataclass(frozen=True)
class Pid:
    """Gains of one channel.

    Attributes
    ----------
    Kp, Ki, Kd : gains [PWM per unit of the error, per second of it, per unit per second].
    clamping : compute outputs beyond the limits again with Ki = 0.
    low, high : limits that clamping goes by [PWM].
    tick_s : period.
    """

    Kp: float
    Ki: float = 0.0
    Kd: float = 0.0
    clamping: bool = False
    low: float = PWM_MIN
    high: float = PWM_MAX
    tick_s: float = TICK_S


ANGLE_PIDS = {
    "p": Pid(1000.0),
    "pid": Pid(1000.0, 1000.0, 10.0),
    "clamping": Pid(1000.0, 1000.0, 10.0, clamping=True),
}
"""Of the angle, by the names of the source's controllers (Figs. 4.2 and 4.4)."""
LENGTHS_PD = Pid(15000.0, 0.0, 150.0)
"""Of the lengths (Fig. 4.12)."""


class Channel:
    """A controller of one bellows with its memory, zeros at the start.

    Attributes
    ----------
    sum : integral [PWM] up to the tick before. e1 : error of that tick.
    """

    def __init__(self, pid: Pid) -> None:
        self.pid, self.sum, self.e1 = pid, 0.0, 0.0

    def step(self, error: float) -> float:
        """u_k [PWM] of (4.4) before saturation, for the error e_k, set-point minus measured value."""
        pid = self.pid
        u = pid.Kp * error + pid.Kd * (error - self.e1) / pid.tick_s + self.sum
        more = 0.5 * pid.tick_s * pid.Ki * (error + self.e1)
        self.e1 = error
        if pid.clamping and not pid.low <= u + more <= pid.high:
            return u
        self.sum += more
        return u + more


def saturate(u: float, low: float = PWM_MIN, high: float = PWM_MAX) -> float:
    """What reaches the motor [PWM]: limited, and a whole number as the PWM register holds one."""
    return math.floor(min(max(u, low), high) + 0.5)


# ----------------------------------------------------------------------
# PID with back-calculation, against the limits of the command and against what the pumps can do.
#
#     v_k = Kp e_k + I_k + Ki h e_k / 2 + Kd (e_k - e_(k-1)) / h,    u_k = limit(v_k)
#     I_(k+1) = I_k + h (Ki e_k + (u_k - v_k) / Tt)
#
# Within the limits this is (4.4), and so computed, with the sum I_k - Ki h e_(k-1) / 2. Beyond them the
# integral follows the limited command with the time constant Tt instead of standing still, as it does in
# the source's clamping (4.1.1). Where Ki = 0 there is no integral: I = 0, as nothing would empty it again.
#
# The limits are not 0 and 255 alone. A bellows deflates slowly while the pump's lag runs ahead of it: a
# command of 0 empties the lag within 2 s, the force needs 5 s, and before the force can be held again the
# lag has to come all the way back. That is what makes the angle overshoot after a jump down, clamping or
# not. Here the command is never below the one that empties the bellows with a share of the rate that the
# orifice allows (`least_pwm`), and the integral follows that limit like the other.


def step_back(channel: Channel, error: float, low: float, high: float, tracking_s: float) -> float:
    """One tick, with Tt = `tracking_s`. Returns the command within its limits [PWM]."""
    v = channel.step(error)
    u = min(max(v, low), high)
    if channel.pid.Ki:
        channel.sum += channel.pid.tick_s * (u - v) / tracking_s
    return u


class BackOrientation:
    """Control of the head's angle with back-calculation, with the memory of both channels and of the pumps.

    Parameters
    ----------
    pid : of both bellows. tracking_s : Tt.
    model : the identified rig; its pumps and limits.
    falling_share : share of the falling rate that a command may ask for; 1 for all of it, infinity for
        fixed limits only.
    sign : of the error of bellows 1.
    """

    def __init__(
        self, pid: Pid, tracking_s: float, model: Model, falling_share: float = 0.4, sign: int = 1
    ) -> None:
        self.tracking_s, self.model = tracking_s, model
        self.falling_share, self.sign = falling_share, sign
        self.pumps = rig_model.pumps_at_rest(model)
        self.channels = Channel(pid), Channel(pid)

    def step(self, phi_ref_rad: float, phi_rad: float) -> Pair:
        """PWM values of one tick."""
        model, error = self.model, self.sign * (phi_ref_rad - phi_rad)
        low, high = (model.low_pwm, model.low_pwm), model.high_pwm
        if math.isfinite(self.falling_share):
            low = rig_model.least_pwm(model, rig_model.ahead(model, self.pumps)[-1], self.falling_share)
        u1, u2 = (
            step_back(channel, e, least, high, self.tracking_s)
            for channel, e, least in zip(self.channels, (error, -error), low, strict=True)
        )
        pwm = saturate(u1, model.low_pwm, high), saturate(u2, model.low_pwm, high)
        self.pumps = rig_model.push(model, self.pumps, pwm)
        return pwm


# ----------------------------------------------------------------------
# Feed-forward from the steady elongation of the bellows (4.6, Fig. 4.11).
#
#     u_ff = 0                                        for q_ref <  0.067 m
#     u_ff = min(255, 5498.1 (q_ref - 0.067) + 110)   for q_ref >= 0.067 m
#
# The straight line is a fit to the steady elongation with both motors at the same voltage, so it
# holds for stretching without bending. It jumps from 0 to 110 at 0.067 m, where the dead zone of the
# pumps ends, reaches 242 at 91 mm and saturates at 93.4 mm.
#
# Its value is added to the output of the feedback controller before saturation and is no part of that
# controller's memory.


@dataclass(frozen=True)
class FeedForward:
    """The line of (4.6).

    Attributes
    ----------
    from_m : shortest length of a bellows that needs any pressure [m].
    offset_pwm : value there [PWM].
    slope_pwm_per_m : increase with the length [PWM/m].
    limit_pwm : largest value [PWM].
    """

    from_m: float = 0.067
    offset_pwm: float = 110.0
    slope_pwm_per_m: float = 5498.1
    limit_pwm: float = 255.0


def feed_forward(parameters: FeedForward, q_ref_m: FloatArray) -> FloatArray:
    """u_ff (...) [PWM] of wanted lengths (...) [m] (4.6)."""
    q = np.asarray(q_ref_m, dtype=np.float64)
    line = parameters.slope_pwm_per_m * (q - parameters.from_m) + parameters.offset_pwm
    return np.where(q < parameters.from_m, 0.0, np.minimum(line, parameters.limit_pwm))


# ----------------------------------------------------------------------
# Computed torque with the observer's state, and the pumps' lag inverted where it can be.
#
# The wanted forces at the time t + T, T the pumps' delay and a horizon, are those of the model in the
# wanted motion, corrected by what the observer says of the real one:
#
#     P F* = M (ddq_ref + Kd (dq_ref - dq^) + Kp (q_ref - q^)) + C dq_ref + N(q_ref, dq_ref)
#            - lambda3 z^ - d^
#
# with the estimates at the time at which the command arrives. Springs and bending are taken at the
# reference and not at the estimate: the bellows are fast (4 Hz and more) and the pumps slow, so that
# cancelling the springs through the pumps would be feedback of the wrong sign. The static error goes to
# zero by d^, which takes the place of an integrator and needs no anti-windup: it is driven by the
# measurements' disagreement with the model under the *limited* commands.
#
# `pwm_for_force` then turns F* into a command. Where F* asks for more than the pumps can do
# the nearest that they can is commanded, which is told.


@dataclass(frozen=True)
class ComputedTorque:
    """Parameters of the law.

    Attributes
    ----------
    horizon_ticks : time in which the pumps are asked to reach the wanted force.
    Kp_per_s2, Kd_per_s : gains on the lengths' errors.
    """

    horizon_ticks: int = 6
    Kp_per_s2: float = 0.0
    Kd_per_s: float = 0.0


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


def wanted_motion(model: Model, q_m: FloatArray) -> WantedMotion:
    """The motion along lengths (n, 2) [m] at the ticks; derivatives by central differences."""
    h = model.tick_s
    q = np.asarray(q_m, dtype=np.float64)
    dq = np.gradient(q, h, axis=0)
    ddq = np.zeros_like(q)
    ddq[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / h**2
    z = rig_model.creep_along(model.plant, h, dq)
    return WantedMotion(q, dq, z, rig_model.moving_force(model.plant, q, dq, ddq, z))


def computed_torque_step(
    control: ComputedTorque, observer: Observer, wanted: WantedMotion, k: int
) -> tuple[Pair, bool]:
    """The command of the tick k, from the estimate with the readings of that tick.

    The second is whether the pumps cannot do what is wanted of them.
    """
    model = observer.model
    y, pumps = observer.look_ahead()
    arrives = wanted.at(k + model.pump.delay_ticks)
    then = wanted.at(k + model.pump.delay_ticks + control.horizon_ticks)
    crept = model.plant.creep_rates[2] * (y[4:6] - wanted.z_N[arrives])
    # A command that is held for T makes the force lead a ramp of slope s by s (T - tau (1 - a)).
    T, lags = control.horizon_ticks * model.tick_s, np.array(model.pump.lags_s)
    lead = lags * -np.expm1(-T / lags) / T
    ramp = wanted.force_N[then] - wanted.force_N[arrives]
    force = wanted.force_N[arrives] + lead * ramp - crept - observer.d_N
    if control.Kp_per_s2 or control.Kd_per_s:
        v = control.Kp_per_s2 * (wanted.q_m[arrives] - y[:2])
        v = v + control.Kd_per_s * (wanted.dq_mps[arrives] - y[2:4])
        force = force + dynamics.mass_matrix(model.plant, y[:2]) @ v
    pwm = rig_model.pwm_for_force(model, pumps, force, control.horizon_ticks)
    F = np.array(pumps.force_N)
    lowest = np.maximum(F - T * rig_model.falling_rate(model, F), 0.0)
    limited = (
        (pwm >= rig_model.pwm_of_force(model, rig_model.largest_force_N(model)))
        | (force < lowest - 1e-3)
        | (force > rig_model.largest_force_N(model))
    )
    u1, u2 = (saturate(u, model.low_pwm, model.high_pwm) for u in pwm.tolist())
    return (u1, u2), bool(limited.any())
