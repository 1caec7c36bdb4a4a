"""The pumps as a controller follows them: no sensor sees the air, but what was commanded is known.

The state is that of `calib.actuator.pump`: output of the lag, force on the bellows, and commands on their
way. It follows from the commands alone, rounding and saturation included.

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

import numpy as np

from calib.actuator.pump import Orifice, advance, pump_coefficients
from calib.arrays import FloatArray
from calib.control.inverse_model import Model, force_of_pwm, pwm_of_force
from calib.errors import BadInputError

__all__ = [
    "PumpEstimate",
    "ahead",
    "falling_rate",
    "least_pwm",
    "pumps_at_rest",
    "push",
    "pwm_for_force",
]

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


def _arriving(model: Model, pwm: Pair) -> Pair:
    g1, g2 = force_of_pwm(model, np.array(pwm)).tolist() if any(pwm) else (0.0, 0.0)
    return g1, g2


def _after(model: Model, state: PumpEstimate, pwm: Pair) -> tuple[Pair, Pair]:
    p, dt = pump_coefficients(model.pump), model.tick_s
    decay = math.exp(-0.5 * dt / model.pump.lag_s)
    g = _arriving(model, pwm)
    x1, _, F1 = advance(p, state.lag_N[0], state.force_N[0], g[0], decay, dt)
    x2, _, F2 = advance(p, state.lag_N[1], state.force_N[1], g[1], decay, dt)
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
    return np.minimum(np.full_like(F, law.falling_N_per_s), F / model.pump.lag_s + law.falling_N_per_s)


def least_pwm(model: Model, state: PumpEstimate, share: float) -> Pair:
    """Commands (2,) below which the lag would run ahead of a force that cannot fall any faster.

    A lag at rest at F - share R tau falls with the share R of the rate there, R that of `falling_rate`.

    Parameters
    ----------
    state : of the pumps when the command arrives, the last of `ahead`.
    share : 0 holds the force, 1 lets it fall as fast as it can.
    """
    F = np.array(state.force_N)
    floor = np.maximum(F - share * model.pump.lag_s * falling_rate(model, F), 0.0)
    low = pwm_of_force(model, floor).tolist()
    return low[0], low[1]


def pwm_for_force(model: Model, state: PumpEstimate, wanted_N: FloatArray, horizon_ticks: int) -> FloatArray:
    """Commands (2,) [PWM], not rounded, that take the forces to `wanted_N` (2,) in some ticks.

    Parameters
    ----------
    state : of the pumps when the command arrives.

    While a force is wanted a command stays above the dead zone even where it gives none for a moment: the
    same force, without switching the motor off and on. A pump of which nothing is wanted is off.

    Raises `BadInputError` for a horizon of less than a tick.
    """
    if horizon_ticks < 1:
        raise BadInputError(f"horizon: found {horizon_ticks} ticks, expected at least 1")
    T = horizon_ticks * model.tick_s
    F = np.array(state.force_N)
    # With an orifice the lag acts on the force itself.
    x = F if isinstance(model.pump.deflation, Orifice) else np.array(state.lag_N)
    target = np.maximum(np.asarray(wanted_N), F - T * falling_rate(model, F))
    a = math.exp(-T / model.pump.lag_s)
    pwm = pwm_of_force(model, (target - a * x) / (1.0 - a))
    edge = pwm_of_force(model, np.full(2, 1e-9))
    idle = (np.asarray(wanted_N) < _IDLE_N) & (F < _IDLE_N)
    return np.where(idle, model.low_pwm, np.maximum(pwm, edge))
