"""The identified model read backwards: forces that hold or move the bellows, and the PWM that gives them.

Without motion the equations of `calib.stages.actuator.dynamics` leave the forces of the pumps as

    P F = N(q, 0),                                                                      (3.43), (3.37)

springs with bending and gravity, for any two lengths. The source's feed-forward (4.6) is a line through
the steady elongation with both motors alike, which holds for stretching without bending only. In
motion

    P F = M(q) ddq + C(q, dq) dq + N(q, dq) - lambda3 z.                                 (3.33), (3.46)

The static force of a pump is turned around on a table of whole and quarter PWM values. It is zero in
the dead zone, so that every force above zero needs a PWM above it, and a falling piece of the printed
polynomials, where there is one, is passed over to the next value that gives more.

The pumps are followed by what was commanded, as no sensor sees the air. Their state is that of
`calib.stages.actuator.pump`: output of the lag, force on the bellows, and commands on their way. It follows
from the commands alone, rounding and saturation included.

Reading the lag backwards. A static force g held for the time T takes the lag from x to g + (x - g) a,
a = exp(-T / tau), so that

    g = (x* - a x) / (1 - a)

takes it to x*. T is a horizon of some ticks and not one: over one tick the inverse multiplies noise by
1 / (1 - a) = 42, over six by 7.5. A force cannot fall faster than the orifice lets the air out. A lag
that is sent below the force then has to come back before the force rises again; so x* is never less
than what the force can have come down to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator import dynamics, kinematics
from calib.stages.actuator.parameters import Plant
from calib.stages.actuator.pump import PWM_MAX, Orifice, Pump, advance_pump, pump_coefficients, static_force_N

PWM_MIN = 0.0
"""Limits of what the microcontroller can put out, 0 V to 12 V, with `PWM_MAX`."""

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
