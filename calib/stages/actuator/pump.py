"""The two pumps: from a PWM value to the force of the air in the bellows.

Order of (2.13), (3.49) and Fig. 3.22, corrected:

    transport delay in ticks -> saturation to 0 .. 255 -> static force g(u), zero in the dead zone
    -> first-order lag of 0.7 s -> limit on the falling rate.

Play. What follows a command late after each turn acts as a play of the width w: it stays as it is until the
command is w / 2 away. One may lie before the static force, as of valves (a pump that is off gives none), one
behind it, as of rubber whose hysteresis leaves a rest. The source's actuator has neither.

Static force. `ElongationForce` turns (2.13) into a force with the spring law: F = k(eps) eps, so
that the steady elongation is the measured one. The printed 3.376 in (2.13) gives negative lengths;
3.756 gives 26.56 mm at 12 V, as the text says. `PolynomialForce` is (3.49), which is in
millinewton, and zero below PWM 100, where it has a bump of 244 mN. Just above the dead zone (2.13)
dips 0.02 mm below zero; air does not pull, so it is cut at zero.

Deflation. The air leaves through a small orifice only, since the pumps have valves.

- `RateLimit`: the lag's output followed by a limit on the falling rate, 0.4 N/s. The printed -2 N/s
  deflates in 2.6 s, the text says 5 s. For a command g that is constant from the time 0

      x(t) = g + (x0 - g) exp(-t / tau),   F(t) = max(x(t), F0 - R t)

  is exact and not a discretisation: x is monotone and gets slower all the time, so once F has met x
  it never parts from it again.
- `Orifice`: the flow out is driven by the gauge pressure, hence by F. A laminar and a turbulent part
  of the pressure drop add up, F = a w + b w^2, with w the rate in N/s that the outflow takes away:

      w(F) = 2 F / (a + sqrt(a^2 + 4 b F)),   dF/dt = max((g - F) / tau, -w(F)).

  The pump delivers dF/dt + w, which follows from the lag of 0.7 s while it is positive; when it
  would be negative the valve is closed and the orifice alone empties the bellows. Falling is then
  nearly exponential with the time constant a. The steady states and the rise are those of
  `RateLimit`; a = 1.045 s and b = 1.07 s^2/N, which share the pressure at 12 V evenly, give the same
  5.04 s. They are not identified from data.

The force does not depend on the bellows' length, so the pumps can be advanced before the mechanics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.stages.actuator.kinematics import inlined
from calib.stages.actuator.parameters import SUPPLY_V, TICK_S, Stiffness

PWM_MAX = 255.0

RATE_LIMIT, ORIFICE = 0, 1


@dataclass(frozen=True)
class ElongationForce:
    """Static force by way of the steady elongation (2.13).

    Attributes
    ----------
    elongation_mm : coefficients of u^3, u^2, u, 1, u in volt, in millimetres.
    stiffness : spring law that turns the elongation into the force of one bellows.
    supply_V : voltage at PWM 255.
    dead_zone_V : no force below.
    """

    elongation_mm: tuple[float, float, float, float] = (-0.1493, 3.756, -25.87, 54.13)
    stiffness: Stiffness = field(default_factory=Stiffness)
    supply_V: float = SUPPLY_V
    dead_zone_V: float = 4.7

    def force_N(self, pwm: FloatArray) -> FloatArray:
        """Steady force [N] of PWM values 0 .. 255, any shape."""
        u = self.supply_V * pwm / PWM_MAX
        eps = 1e-3 * _polynomial(self.elongation_mm, u)
        eps = np.where(u < self.dead_zone_V, 0.0, np.maximum(eps, 0.0))
        return np.asarray(_polynomial(self.stiffness.coefficients[::-1], eps) * eps)


def _polynomial(coefficients: Sequence[float], x: FloatArray) -> FloatArray:
    """As `np.polyval`, to the last bit, in half the time for the few values of a tick."""
    y = np.asarray(coefficients[0], dtype=np.float64)
    for c in coefficients[1:]:
        y = y * x + c
    return y


@dataclass(frozen=True)
class RateLimit:
    """Deflation at a constant rate at most, `falling_N_per_s` (3.5); infinity switches it off."""

    falling_N_per_s: float = 0.4


@dataclass(frozen=True)
class Orifice:
    """Deflation through the orifice, F = a w + b w^2 with w = -dF/dt.

    Attributes
    ----------
    laminar_s : a, the time constant at small forces.
    turbulent_s2_per_N : b; zero leaves an exponential.
    """

    laminar_s: float = 1.045
    turbulent_s2_per_N: float = 1.07


@dataclass(frozen=True)
class Pump:
    """Both pumps with their hoses and orifices, alike but for their lags.

    Attributes
    ----------
    static : `ElongationForce`.
    deflation : `RateLimit` or `Orifice`.
    lag_s, lag_ratio : time constant of the rise, the geometric mean of both, and that of the second over that
        of the first.
    delay_ticks : ticks from a command to its effect.
    tick_s : period of the commands.
    play_pwm, play_N : widths of the plays before and behind the static force.
    """

    static: ElongationForce = ElongationForce()
    deflation: RateLimit | Orifice = RateLimit()
    lag_s: float = 0.7
    lag_ratio: float = 1.0
    delay_ticks: int = 2
    tick_s: float = TICK_S
    play_pwm: float = 0.0
    play_N: float = 0.0

    @property
    def lags_s(self) -> tuple[float, float]:
        """Time constants of both pumps."""
        share = math.sqrt(self.lag_ratio)
        return self.lag_s / share, self.lag_s * share

    def at(self, tick_s: float) -> Pump:
        """The same pump with commands of another period; its delay in whole ticks of that."""
        if tick_s == self.tick_s:
            return self
        return replace(self, tick_s=tick_s, delay_ticks=round(self.delay_ticks * self.tick_s / tick_s))


class PumpCoefficients(NamedTuple):
    """What `advance_pump` needs of one pump, derived from `Pump`."""

    kind: int
    lag_s: float
    falling: float
    laminar: float
    turbulent: float


def pump_coefficients(pump: Pump) -> tuple[PumpCoefficients, PumpCoefficients]:
    """Coefficients of the compiled kernel, of both pumps."""
    law, (lag1_s, lag2_s) = pump.deflation, pump.lags_s
    if isinstance(law, RateLimit):
        one = PumpCoefficients(RATE_LIMIT, lag1_s, float(law.falling_N_per_s), 1.0, 0.0)
    else:
        one = PumpCoefficients(ORIFICE, lag1_s, 0.0, law.laminar_s, law.turbulent_s2_per_N)
    return one, one._replace(lag_s=lag2_s)


def static_force_N(pump: Pump, pwm: FloatArray) -> FloatArray:
    """Force [N] that PWM values, any shape, settle at: saturation, dead zone, static law.

    Raises `BadInputError` for values that are not finite.
    """
    values = np.asarray(pwm, dtype=np.float64)
    if not np.all(np.isfinite(values)):
        raise BadInputError("pwm: found a value that is not finite, expected numbers")
    return pump.static.force_N(np.clip(values, 0.0, PWM_MAX))


def delayed(pump: Pump, pwm: FloatArray, before: FloatArray | None = None) -> FloatArray:
    """PWM rows (n, 2) as they reach the motors: `delay_ticks` rows later.

    `before` (delay_ticks, 2) holds the commands of the ticks before the first row, zeros by default.
    """
    lead = np.zeros((pump.delay_ticks, 2)) if before is None else before
    return np.concatenate([lead, pwm])[: len(pwm)]


@kernel()
def _follow(half: float, values: FloatArray, held: FloatArray, out: FloatArray) -> None:
    for k in range(len(values)):
        for i in range(values.shape[1]):
            held[i] = min(max(held[i], values[k, i] - half), values[k, i] + half)
            out[k, i] = held[i]


def _behind_play(width: float, values: FloatArray, held: FloatArray) -> FloatArray:
    out = np.empty(values.shape)
    _follow(0.5 * width, np.ascontiguousarray(values, dtype=np.float64), held, out)
    return out


def settling_force_N(
    pump: Pump, pwm: FloatArray, strength: Sequence[float] = (1.0, 1.0), held: FloatArray | None = None
) -> FloatArray:
    """Forces (n, 2) [N] that commands (n, 2), one after the other, settle at behind the plays.

    Parameters
    ----------
    strength : factors on the static forces.
    held : (2, 2), by default zeros: what followed the commands and the forces before, and then at the end.
    """
    held = np.zeros((2, 2)) if held is None else held
    if pump.play_pwm > 0.0:
        pwm = np.where(pwm > 0.0, _behind_play(pump.play_pwm, pwm, held[0]), 0.0)
    force = static_force_N(pump, pwm) * np.asarray(strength)
    return _behind_play(pump.play_N, force, held[1]) if pump.play_N > 0.0 else force


@inlined
def _rise_or_leak(p: PumpCoefficients, force: float, g: float) -> float:
    outflow = 2.0 * force / (p.laminar + math.sqrt(p.laminar * p.laminar + 4.0 * p.turbulent * force))
    return max((g - force) / p.lag_s, -outflow)


@inlined
def _orifice(p: PumpCoefficients, force: float, g: float, dt: float) -> tuple[float, float]:
    """Force after dt / 2 and dt: a Runge-Kutta step and the cubic between its ends."""
    start = max(force, 0.0)
    k1 = _rise_or_leak(p, start, g)
    k2 = _rise_or_leak(p, max(start + 0.5 * dt * k1, 0.0), g)
    k3 = _rise_or_leak(p, max(start + 0.5 * dt * k2, 0.0), g)
    k4 = _rise_or_leak(p, max(start + dt * k3, 0.0), g)
    middle = start + dt / 24.0 * (5.0 * k1 + 4.0 * (k2 + k3) - k4)
    return middle, start + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


@inlined
def advance_pump(
    p: PumpCoefficients, lag: float, force: float, g: float, decay: float, dt: float
) -> tuple[float, float, float]:
    """Lag output after dt [s], and force after dt / 2 and dt [N], of a constant static force g [N].

    `decay` is exp(-dt / (2 lag_s)), which a caller with a fixed step computes once.
    """
    lag_middle = g + (lag - g) * decay
    lag_end = g + (lag_middle - g) * decay
    if p.kind == RATE_LIMIT:
        middle = max(lag_middle, force - p.falling * (0.5 * dt))
        return lag_end, middle, max(lag_end, middle - p.falling * (0.5 * dt))
    middle, end = _orifice(p, force, g, dt)
    return lag_end, middle, end
