"""Control laws: PID, feed-forward, anti-windup, observer, computed torque, and one step of them all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator import dynamics, kinematics
from calib.stages.actuator.parameters import TICK_S, Plant
from calib.stages.actuator.pump import (
    PWM_MAX,
    Orifice,
    Pump,
    advance_pump,
    pump_coefficients,
    static_force_N,
)
from calib.stages.actuator.simulate import derivative, largest_step_s

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

PWM_MIN = 0.0
"""Limits of what the microcontroller can put out, 0 V to 12 V, with `PWM_MAX`."""


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
# The identified model read backwards: forces that hold or move the bellows, and the PWM that gives them.
#
# Without motion the equations of `calib.stages.actuator.dynamics` leave the forces of the pumps as
#
#     P F = N(q, 0),                                                                      (3.43), (3.37)
#
# springs with bending and gravity, for any two lengths. The source's feed-forward (4.6) is a line through
# the steady elongation with both motors alike, which holds for stretching without bending only. In
# motion
#
#     P F = M(q) ddq + C(q, dq) dq + N(q, dq) - lambda3 z.                                 (3.33), (3.46)
#
# The static force of a pump is turned around on a table of whole and quarter PWM values. It is zero in
# the dead zone, so that every force above zero needs a PWM above it, and a falling piece of the printed
# polynomials, where there is one, is passed over to the next value that gives more.

_STEP_PWM = 0.25


@dataclass(frozen=True)
class Model:
    """The identified rig as controllers know it.

    Attributes
    ----------
    plant, pump : as identified.
    strength : factors on the static forces of the two pumps.
    low_pwm, high_pwm : limits of the command [PWM].
    latency_s : from the exposure of a picture to the tick that reads it.
    lowpass : second-order sections (b0, b1, b2, 1, a1, a2) of the board's low-pass; none for the usual one.

    Raises `BadInputError` for limits that the motors do not have or with which no pump gives any force.
    """

    plant: Plant
    pump: Pump
    strength: tuple[float, float] = (1.0, 1.0)
    low_pwm: float = PWM_MIN
    high_pwm: float = PWM_MAX
    latency_s: float = 0.025
    lowpass: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        whole = float(self.low_pwm).is_integer() and float(self.high_pwm).is_integer()
        if not PWM_MIN <= self.low_pwm < self.high_pwm <= PWM_MAX or not whole:
            raise BadInputError(
                f"PWM limits: found {self.low_pwm:g} to {self.high_pwm:g}, expected "
                f"whole numbers, {PWM_MIN:g} <= low < high <= {PWM_MAX:g}"
            )
        for i, strength in enumerate(self.strength):
            if not strength > 0.0:
                raise BadInputError(
                    f"strength of pump {i + 1}: found {strength:g}, expected a positive factor"
                )
        if float(np.max(static_force_N(self.pump, np.array([self.high_pwm])))) <= 0.0:
            raise BadInputError(
                f"PWM limits: at {self.high_pwm:g} the pumps give no force yet, expected a limit above "
                "their dead zone"
            )

    @property
    def tick_s(self) -> float:
        """Period of the commands."""
        return self.pump.tick_s


@lru_cache(maxsize=32)
def _table(pump: Pump, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Rising forces [N] and the PWM values that give them, the first at zero force."""
    pwm = np.unique(np.append(np.arange(low, high, _STEP_PWM), high))
    force = np.maximum.accumulate(static_force_N(pump, pwm))
    rising = np.concatenate([np.diff(force) > 0.0, [False]])
    # The last value of the dead zone, then every value that gives more than all before it.
    keep = np.concatenate([[False], np.diff(force) > 0.0]) | (rising & (force == force[0]))
    if not keep.any():
        keep[-1] = True
    return force[keep], pwm[keep]


def force_of_pwm(model: Model, pwm: FloatArray) -> FloatArray:
    """Force (..., 2) [N] that PWM values (..., 2) settle at, within the limits of the command."""
    limited = np.clip(np.asarray(pwm, dtype=np.float64), model.low_pwm, model.high_pwm)
    return np.asarray(static_force_N(model.pump, limited) * np.array(model.strength))


def largest_force_N(model: Model) -> FloatArray:
    """Greatest steady force (2,) [N] of the pumps."""
    force, _ = _table(model.pump, model.low_pwm, model.high_pwm)
    return np.asarray(force[-1] * np.array(model.strength))


def pwm_of_force(model: Model, force_N: FloatArray) -> FloatArray:
    """PWM values (..., 2) whose steady forces are the nearest to these (..., 2) [N].

    `low_pwm` for no force at all; for one that the pumps do not reach, the value that gives most.
    """
    force, pwm = _table(model.pump, model.low_pwm, model.high_pwm)
    wanted = np.asarray(force_N, dtype=np.float64) / np.array(model.strength)
    found = np.interp(wanted, force, pwm)
    return np.asarray(np.where(wanted <= force[0], model.low_pwm, found))


def holding_force(plant: Plant, q_m: FloatArray) -> FloatArray:
    """Forces (..., 2) [N] that hold the bellows at the lengths (..., 2) [m] after all creep."""
    q = np.asarray(q_m, dtype=np.float64)
    return dynamics.resisting_forces(plant, q, np.zeros_like(q))


def moving_force(
    plant: Plant, q_m: FloatArray, dq_mps: FloatArray, ddq_mps2: FloatArray, z_N: FloatArray
) -> FloatArray:
    """Forces (..., 2) [N] that move the bellows so, with creep forces z (..., 2) [N]; all (..., 2)."""
    q, dq = np.asarray(q_m, dtype=np.float64), np.asarray(dq_mps, dtype=np.float64)
    inertia = np.einsum("...rc,...c->...r", dynamics.mass_matrix(plant, q), np.asarray(ddq_mps2))
    swept = np.einsum("...rc,...c->...r", dynamics.coriolis_matrix(plant, q, dq), dq)
    crept = plant.creep_rates[2] * np.asarray(z_N)
    return np.asarray(inertia + swept + dynamics.resisting_forces(plant, q, dq) - crept)


def creep_along(plant: Plant, tick_s: float, dq_mps: FloatArray) -> FloatArray:
    """Creep forces z (n, 2) [N] along rates (n, 2) [m/s] at evenly spaced times, from zero (3.45).

    Exact for rates that are straight lines between the times.
    """
    l1, l2, _ = plant.creep_rates
    dq = np.asarray(dq_mps, dtype=np.float64)
    z = np.zeros_like(dq)
    if l2 == 0.0:
        return z
    w = l1 * tick_s
    decay = np.exp(-w)
    if w > 1e-6:
        whole = (1.0 - decay) / l1
        late = (1.0 - whole / tick_s) / l1
    else:
        whole, late = tick_s, 0.5 * tick_s
    for k in range(1, len(dq)):
        z[k] = decay * z[k - 1] + l2 * ((whole - late) * dq[k - 1] + late * dq[k])
    return z


def bent_rest(model: Model, phi_rad: float) -> FloatArray:
    """Lengths (2,) [m] at rest at an angle [rad] with one pump alone.

    Raises `BadInputError` for an angle at which no length satisfies this.
    """
    from scipy.optimize import brentq

    plant = model.plant
    r, idle = plant.bellows_radius_m, 1 if phi_rad >= 0.0 else 0

    def rest(l: float) -> float:  # noqa: E741  the source's symbol
        return float(holding_force(plant, kinematics.bellows(phi_rad, l, r))[idle])

    low, high = max(abs(r * phi_rad) * 1.001, 0.2 * plant.rest_length_m), 3.0 * plant.rest_length_m
    if not (low < high and rest(low) < 0.0 < rest(high)):
        raise BadInputError(
            f"angle: found {phi_rad:g} rad, at which no length is at rest with one pump, expected a "
            "smaller one"
        )
    return kinematics.bellows(phi_rad, float(brentq(rest, low, high, xtol=1e-12)), r)


def static_stiffness(plant: Plant, q_m: FloatArray) -> FloatArray:
    """dF/dq (2, 2) [N/m] of `holding_force` at the lengths (2,)."""
    A = dynamics.linearised(plant, q_m)
    return np.asarray(-dynamics.mass_matrix(plant, q_m) @ A[2:4, :2])


def feed_forward_pwm(model: Model, q_ref_m: FloatArray) -> FloatArray:
    """PWM (..., 2) that holds the lengths (..., 2) [m], in both bellows and with bending."""
    return pwm_of_force(model, holding_force(model.plant, q_ref_m))


# ----------------------------------------------------------------------
# The pumps as a controller follows them: no sensor sees the air, but what was commanded is known.
#
# The state is that of `calib.stages.actuator.pump`: output of the lag, force on the bellows, and commands
# on their way. It follows from the commands alone, rounding and saturation included.
#
# Reading the lag backwards. A static force g held for the time T takes the lag from x to g + (x - g) a,
# a = exp(-T / tau), so that
#
#     g = (x* - a x) / (1 - a)
#
# takes it to x*. T is a horizon of some ticks and not one: over one tick the inverse multiplies noise by
# 1 / (1 - a) = 42, over six by 7.5. A force cannot fall faster than the orifice lets the air out. A lag
# that is sent below the force then has to come back before the force rises again; so x* is never less
# than what the force can have come down to.

Pair = tuple[float, float]

_IDLE_N = 0.02
"""Less is noise: 0.4 mm of a nominal bellows."""


@dataclass(frozen=True)
class PumpEstimate:
    """Both pumps at a tick.

    Attributes
    ----------
    lag_N, force_N : output of the lags and forces on the bellows.
    waiting_pwm : commands on their way, oldest first.
    """

    lag_N: Pair = (0.0, 0.0)
    force_N: Pair = (0.0, 0.0)
    waiting_pwm: tuple[Pair, ...] = ()


def pumps_at_rest(model: Model) -> PumpEstimate:
    """Pumps off for long."""
    return PumpEstimate(waiting_pwm=((0.0, 0.0),) * model.pump.delay_ticks)


@lru_cache(maxsize=4096)
def _arriving(model: Model, pwm: Pair) -> Pair:
    g1, g2 = force_of_pwm(model, np.array(pwm)).tolist() if any(pwm) else (0.0, 0.0)
    return g1, g2


def _after(model: Model, state: PumpEstimate, pwm: Pair) -> tuple[Pair, Pair]:
    dt = model.tick_s
    (x1, _, F1), (x2, _, F2) = (
        advance_pump(p, lag, force, g, math.exp(-0.5 * dt / p.lag_s), dt)
        for p, lag, force, g in zip(
            pump_coefficients(model.pump), state.lag_N, state.force_N, _arriving(model, pwm), strict=True
        )
    )
    return (x1, x2), (F1, F2)


def push(model: Model, state: PumpEstimate, pwm: Pair) -> PumpEstimate:
    """State one tick after a new command, which takes effect `delay_ticks` later."""
    queue = (*state.waiting_pwm, pwm)
    lag, force = _after(model, state, queue[0])
    return PumpEstimate(lag, force, queue[1:])


def ahead(model: Model, state: PumpEstimate) -> list[PumpEstimate]:
    """States at the ticks at which the commands on their way have acted one by one, the present first."""
    states = [state]
    for i, pwm in enumerate(state.waiting_pwm):
        lag, force = _after(model, states[-1], pwm)
        states.append(PumpEstimate(lag, force, state.waiting_pwm[i + 1 :]))
    return states


def falling_rate(model: Model, force_N: FloatArray) -> FloatArray:
    """Fastest fall [N/s] at the forces (...) [N]: that of the rate limit or of the orifice."""
    law, F = model.pump.deflation, np.maximum(np.asarray(force_N, dtype=np.float64), 0.0)
    if isinstance(law, Orifice):
        a, b = law.laminar_s, law.turbulent_s2_per_N
        # With the valve open the pump can slow this down, never speed it up.
        return np.asarray(2.0 * F / (a + np.sqrt(a * a + 4.0 * b * F)))
    return np.full_like(F, law.falling_N_per_s)


def least_pwm(model: Model, state: PumpEstimate, share: float) -> Pair:
    """Commands (2,) below which the lag would run ahead of a force that cannot fall any faster.

    A lag at rest at F - share R tau falls with the share R of the rate there, R that of `falling_rate`.

    Parameters
    ----------
    state : of the pumps when the command arrives, the last of `ahead`.
    share : 0 holds the force, 1 lets it fall as fast as it can.
    """
    F = np.array(state.force_N)
    floor = np.maximum(F - share * np.array(model.pump.lags_s) * falling_rate(model, F), 0.0)
    low = pwm_of_force(model, floor).tolist()
    return low[0], low[1]


def pwm_for_force(model: Model, state: PumpEstimate, wanted_N: FloatArray, horizon_ticks: int) -> FloatArray:
    """Commands (2,) [PWM], not rounded, that take the forces to `wanted_N` (2,) in some ticks.

    Parameters
    ----------
    state : of the pumps when the command arrives.

    While a force is wanted a command stays above the dead zone even where it gives none for a moment: the
    same force, without switching the motor off and on. A pump of which nothing is wanted is off.
    """
    T = horizon_ticks * model.tick_s
    F = np.array(state.force_N)
    # With an orifice the lag acts on the force itself.
    x = F if isinstance(model.pump.deflation, Orifice) else np.array(state.lag_N)
    target = np.maximum(np.asarray(wanted_N), F - T * falling_rate(model, F))
    a = np.exp(-T / np.array(model.pump.lags_s))
    pwm = pwm_of_force(model, (target - a * x) / (1.0 - a))
    edge = pwm_of_force(model, np.full(2, 1e-9))
    idle = (np.asarray(wanted_N) < _IDLE_N) & (F < _IDLE_N)
    return np.where(idle, model.low_pwm, np.maximum(pwm, edge))


# ----------------------------------------------------------------------
# PID with back-calculation, against the limits of the command and against what the pumps can do.
#
#     v_k = Kp e_k + I_k + Ki h e_k / 2 + Kd (e_k - e_(k-1)) / h,    u_k = limit(v_k)
#     I_(k+1) = I_k + h (Ki e_k + (u_k - v_k) / Tt)
#
# Within the limits this is (4.4), and so computed, with the sum I_k - Ki h e_(k-1) / 2. Beyond them the
# integral follows the limited command with the time constant Tt instead of standing still, as it does in
# the source's clamping (4.1.1).
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
        self.pumps = pumps_at_rest(model)
        self.channels = Channel(pid), Channel(pid)

    def step(self, phi_ref_rad: float, phi_rad: float) -> Pair:
        """PWM values of one tick."""
        model, error = self.model, self.sign * (phi_ref_rad - phi_rad)
        low, high = (model.low_pwm, model.low_pwm), model.high_pwm
        if math.isfinite(self.falling_share):
            low = least_pwm(model, ahead(model, self.pumps)[-1], self.falling_share)
        u1, u2 = (
            step_back(channel, e, least, high, self.tracking_s)
            for channel, e, least in zip(self.channels, (error, -error), low, strict=True)
        )
        pwm = saturate(u1, model.low_pwm, high), saturate(u2, model.low_pwm, high)
        self.pumps = push(model, self.pumps, pwm)
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
# Lengths, rates, creep and disturbing forces from PWM, marker and gyroscope, on the identified model.
#
#     x = (q, dq, z, d, b):  the plant of `calib.stages.actuator.dynamics` driven by the pumps' forces plus
# d,
#                            dd/dt = noise,  db/dt = noise
#     marker  m = p(q) + offset (sin phi, cos phi), exposed one latency before the tick         (A.1)
#     gyro   -gz = dphi + b
#
# The prediction is the nonlinear model, the correction a constant gain L: that of the stationary Kalman
# filter of the model linearised at one point, sampled at the ticks. The marker's innovation is taken
# against the prediction at the time of the exposure and turned into lengths by the Jacobian there. A
# marker farther away than the gate is not believed.
#
# d takes up what the model does not explain, at rest all of it, which is what makes a controller that
# subtracts it free of static error.

STATES = 9


_MARKER_M, _GYRO_RADPS = 2.5e-4, 0.003
"""Standard deviations of the marker along each axis, and of the mean of a tick's rates."""
_FORCE_N_PER_SQRT_S, _BIAS_RADPS_PER_SQRT_S, _ACCEL_MPS2_PER_SQRT_HZ = 0.03, 3e-3, 0.05
"""Walks of d and b, and density of what pushes the head unseen."""
_GATE_M = 4e-3
"""Largest innovation of a marker that is believed."""
_AT_M = 0.012
"""Elongation at which the gain is designed, in the middle of the workspace."""


class Observer:
    """An observer with its memory, straight at rest with the pumps off at the start.

    Attributes
    ----------
    model : the identified rig.
    gain : (9, 3) L, columns q1, q2 [m] and the gyroscope [rad/s].
    latency_s : from the exposure to the tick that reads the marker. marker_offset_m : of (A.1).
    y : (6,) q, dq, z. d_N : (2,). bias_radps : b.
    pumps : their state.
    """

    def __init__(self, model: Model, gain: FloatArray, latency_s: float, marker_offset_m: float) -> None:
        self.model, self.gain = model, gain
        self.latency_s, self.marker_offset_m = latency_s, marker_offset_m
        self.y = np.array([model.plant.rest_length_m] * 2 + [0.0] * 4)
        self.d_N, self.bias_radps, self.pumps = np.zeros(2), 0.0, pumps_at_rest(model)
        # Lengths at this tick and those before, the newest first.
        self._past_q = np.tile(self.y[:2], (2 + math.ceil(latency_s / model.tick_s), 1))
        self._refused = 0

    def _advanced(self, y: FloatArray, before: PumpEstimate, after: PumpEstimate) -> FloatArray:
        """Plant (6,) after a tick in which the pumps' forces go in a straight line."""
        c, tick_s = dynamics.coefficients(self.model.plant), self.model.tick_s
        steps = max(4, math.ceil(1.5 * tick_s / largest_step_s(self.model.plant)))
        h, d = tick_s / steps, self.d_N
        start, end = np.array(before.force_N) + d, np.array(after.force_N) + d
        for i in range(steps):
            a, b = start + (end - start) * (i / steps), start + (end - start) * ((i + 1) / steps)
            m = 0.5 * (a + b)
            k1 = derivative(c, y, a[0], a[1])
            k2 = derivative(c, y + 0.5 * h * k1, m[0], m[1])
            k3 = derivative(c, y + 0.5 * h * k2, m[0], m[1])
            k4 = derivative(c, y + h * k3, b[0], b[1])
            y = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        return y

    def predict(self, pwm: Pair) -> None:
        """Go on to the next tick after a command, without new readings."""
        pumps = push(self.model, self.pumps, pwm)
        self.y, self.pumps = self._advanced(self.y, self.pumps, pumps), pumps
        self._past_q = np.vstack([self.y[:2], self._past_q[:-1]])

    def look_ahead(self) -> tuple[FloatArray, PumpEstimate]:
        """Plant (6,) and pumps at the tick at which the next command arrives."""
        y, pumps = self.y, ahead(self.model, self.pumps)
        for before, after in pairwise(pumps):
            y = self._advanced(y, before, after)
        return y, pumps[-1]

    def _exposed(self) -> FloatArray:
        late = self.latency_s / self.model.tick_s
        i = min(int(late), len(self._past_q) - 2)
        return np.asarray((1.0 - (late - i)) * self._past_q[i] + (late - i) * self._past_q[i + 1])

    def correct(self, marker_m: Pair, minus_gz_radps: float) -> None:
        """Take a tick's readings.

        Parameters
        ----------
        marker_m : in the plane [m], NaN where nothing was found.
        minus_gz_radps : mean of the tick's samples, NaN without.
        """
        r, offset, innovation = self.model.plant.bellows_radius_m, self.marker_offset_m, np.zeros(3)
        if not math.isnan(marker_m[0] + marker_m[1]):
            q = self._exposed()
            away = np.array(marker_m) - marker_of(q, r, offset)
            # Ten in a row are no outliers: the estimate itself is off.
            if float(np.hypot(*away)) <= _GATE_M or self._refused >= 10:
                innovation[:2] = np.linalg.solve(marker_jacobian(q, r, offset), away)
                self._refused = 0
            else:
                self._refused += 1
        if not math.isnan(minus_gz_radps):
            dphi = 0.5 * float(self.y[2] - self.y[3]) / r
            innovation[2] = minus_gz_radps - dphi - self.bias_radps
        step = self.gain @ innovation
        self.y, self.d_N = self.y + step[:6], self.d_N + step[6:8]
        self.bias_radps += float(step[8])
        self._past_q = self._past_q + step[:2]


def marker_of(q_m: FloatArray, bellows_radius_m: float, offset_m: float) -> FloatArray:
    """The marker (2,) [m] of the lengths (2,) [m] (3.6), (A.1)."""
    head = kinematics.forward(q_m, bellows_radius_m)
    return kinematics.marker_from_head(head[:2], head[2], offset_m)


def marker_jacobian(q_m: FloatArray, bellows_radius_m: float, offset_m: float) -> FloatArray:
    """d(x, y) / d(q1, q2), shape (2, 2), of `marker_of`."""
    phi, J = (
        float(kinematics.angle(q_m, bellows_radius_m)),
        kinematics.forward_jacobian(q_m, bellows_radius_m),
    )
    return np.asarray(J[:2] + offset_m * np.outer([math.cos(phi), -math.sin(phi)], J[2]))


def design_observer(
    model: Model, latency_s: float = 0.025, marker_offset_m: float = kinematics.MARKER_OFFSET_M
) -> Observer:
    """The observer whose gain is the stationary Kalman filter's in the middle of the workspace.

    Raises `BadInputError` where no stationary filter exists.
    """
    from scipy.linalg import LinAlgError, expm, solve_discrete_are

    plant, h = model.plant, model.tick_s
    q = np.full(2, plant.rest_length_m + _AT_M)
    A = np.zeros((STATES, STATES))
    A[:6, :6] = dynamics.linearised(plant, q)
    inverse = np.linalg.inv(dynamics.mass_matrix(plant, q))
    A[2:4, 6:8] = inverse
    pushed = np.zeros(STATES)
    pushed[2:4] = _ACCEL_MPS2_PER_SQRT_HZ**2
    pushed[6:8] = _FORCE_N_PER_SQRT_S**2
    pushed[8] = _BIAS_RADPS_PER_SQRT_S**2
    # Van Loan's block gives transition and noise of a tick together.
    block = expm(h * np.block([[-A, np.diag(pushed)], [np.zeros_like(A), A.T]]))
    Phi = block[STATES:, STATES:].T
    Q = Phi @ block[:STATES, STATES:]
    r = plant.bellows_radius_m
    H = np.zeros((3, STATES))
    H[0, 0] = H[1, 1] = 1.0
    H[2, 2], H[2, 3], H[2, 8] = 0.5 / r, -0.5 / r, 1.0
    to_q = np.linalg.inv(marker_jacobian(q, r, marker_offset_m))
    R = np.zeros((3, 3))
    R[:2, :2] = _MARKER_M**2 * to_q @ to_q.T
    R[2, 2] = _GYRO_RADPS**2
    try:
        P = solve_discrete_are(Phi.T, H.T, 0.5 * (Q + Q.T), R)
    except (LinAlgError, ValueError) as error:
        raise BadInputError(f"observer: has no stationary gain for this plant ({error})") from error
    L = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return Observer(model, np.asarray(L), latency_s, marker_offset_m)


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
    z = creep_along(model.plant, h, dq)
    return WantedMotion(q, dq, z, moving_force(model.plant, q, dq, ddq, z))


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
    pwm = pwm_for_force(model, pumps, force, control.horizon_ticks)
    F = np.array(pumps.force_N)
    lowest = np.maximum(F - T * falling_rate(model, F), 0.0)
    limited = (
        (pwm >= pwm_of_force(model, largest_force_N(model)))
        | (force < lowest - 1e-3)
        | (force > largest_force_N(model))
    )
    u1, u2 = (saturate(u, model.low_pwm, model.high_pwm) for u in pwm.tolist())
    return (u1, u2), bool(limited.any())
