"""Two models of a pump with its chamber, from PWM to the pressure (or force) that a sensor sees.

u(t) is the PWM value, T_d the dead time, s(u) the shape of the static map with s(255) = 1 and P its
level, so that g(t) = P s(u(t - T_d)) is what the pump would settle at.

`LAG`, the linear first-order lag of (3.5), with a limit R on the rising rate where data need one:

    dp/dt = min((g - p) / tau, R)

`ORIFICE`. Valves let the air in only, through a passage whose laminar and turbulent drops of pressure add
up, and it leaks out through another. The sensor sits in a hose of small volume beside the chamber:

    g - p = a w + b w^2            w = 2 (g - p) / (a + sqrt(a^2 + 4 b (g - p))), 0 for g < p
    dp/dt = w - p / T_leak - c (p - z),   dz/dt = (p - z) / T_z

with p the pressure in the hose, z that in the chamber, and w in units of pressure per second. It is the
law of `calib.actuator.pump.Orifice` on the way in. While the pump has never run, hose and chamber are
taken for shut off from each other, as a valve leaves them.

Commands are held between their time stamps. A step of the simulation gets their mean over the step, so
that results are smooth in T_d. The steps are at most `STEP_S` and shorter for stiffer parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.actuator.pump import PWM_MAX
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["LAG", "MODELS", "ORIFICE", "STEP_S", "Parameter", "PumpRecord", "Shape", "simulate_pump"]

LAG, ORIFICE = "linear lag", "orifice flow"
STEP_S = 2e-3
_START_S = 0.2
_FREE = 1e6
_PRIOR = 0.15
"""What the first measured value counts for a start, in samples."""


@dataclass(frozen=True)
class Parameter:
    """One number of a model: unit, where a search starts, its bounds, and the value that switches it off.

    A unit of "y" is that of the measured values, and `start` and bounds are then multiples of their range.
    """

    name: str
    unit: str
    start: float
    low: float
    high: float
    off: float | None = None


_COMMON = (Parameter("dead_time_s", "s", 0.05, 0.0, 0.5), Parameter("level", "y", 1.0, 0.05, 20.0))
MODELS: dict[str, tuple[Parameter, ...]] = {
    LAG: (
        *_COMMON,
        Parameter("lag_s", "s", 0.6, 0.005, 30.0),
        Parameter("rising_limit_per_s", "y", 0.5, 0.05, 200.0, _FREE),
    ),
    ORIFICE: (
        *_COMMON,
        Parameter("laminar_s", "s", 0.2, 0.0, 30.0, 0.0),
        Parameter("turbulent_s2", "1/y", 0.2, 1e-5, 100.0),
        Parameter("leak_s", "s", 10.0, 0.02, 1000.0, _FREE),
        Parameter("hose_per_s", "1/s", 50.0, 0.0, 100.0, 0.0),
        Parameter("chamber_s", "s", 0.05, 0.01, 3.0, 1.0),
    ),
}
"""Parameters of each model in the order of the vectors that `simulate_pump` takes."""


@dataclass(frozen=True)
class PumpRecord:
    """One recording: time [s], PWM 0 .. 255, and the measured pressure or force, each (n,)."""

    name: str
    t_s: FloatArray
    pwm: FloatArray
    value: FloatArray

    def __post_init__(self) -> None:
        if not len(self.t_s) == len(self.pwm) == len(self.value) or len(self.t_s) < 10:
            raise BadInputError(f"{self.name}: found {len(self.t_s)} rows, expected at least 10")
        if not np.all(np.diff(self.t_s) > 0.0):
            raise BadInputError(f"{self.name}: found time that stands still or runs backward")


@dataclass(frozen=True)
class Shape:
    """Static map over its level: 0 below `dead_pwm`, then 1 - exp(-(u - dead) / scale) over that at 255.

    An infinite `scale_pwm` is a straight line from the dead zone to 255.
    """

    dead_pwm: float = 0.0
    scale_pwm: float = math.inf

    def of(self, pwm: FloatArray) -> FloatArray:
        """s(u) of PWM values (n,)."""
        over = np.clip(np.asarray(pwm, dtype=np.float64), 0.0, PWM_MAX) - self.dead_pwm
        over, most = np.maximum(over, 0.0), PWM_MAX - self.dead_pwm
        if not math.isfinite(self.scale_pwm):
            return np.asarray(over / most)
        return np.asarray(np.expm1(-over / self.scale_pwm) / math.expm1(-most / self.scale_pwm))


_STRAIGHT = Shape()


def _drive(record: PumpRecord, shape: Shape, dead_time_s: float, step_s: float, steps: int) -> FloatArray:
    """Mean of s(u(t - T_d)) over each step (steps,)."""
    t, s = record.t_s - record.t_s[0], shape.of(record.pwm)
    area = np.concatenate([[0.0], np.cumsum(s[:-1] * np.diff(t))])
    edges = step_s * np.arange(steps + 1, dtype=np.float64) - dead_time_s
    # Before the first row its command is taken to have been held.
    whole = np.interp(edges, t, area) + np.where(edges < 0.0, s[0] * edges, 0.0)
    return np.asarray(np.diff(whole) / step_s)


@njit(cache=True, nogil=True, error_model="numpy")
def _lag(g: FloatArray, step_s: float, p: float, z: float, theta: FloatArray, out: FloatArray) -> None:
    share, most = -math.expm1(-step_s / theta[2]), theta[3] * step_s
    p += z
    out[0] = p
    for k in range(len(g)):
        p += min((theta[1] * g[k] - p) * share, most)
        out[k + 1] = p


@njit(cache=True, nogil=True, error_model="numpy")
def _flow(theta: FloatArray, g: float, p: float, z: float, opened: float) -> float:
    a, b = theta[2], theta[3]
    drop = g - p
    w = 2.0 * drop / (a + math.sqrt(a * a + 4.0 * b * drop)) if drop > 0.0 else 0.0
    return float(w - p / theta[4] - opened * theta[5] * (p - z))


@njit(cache=True, nogil=True, error_model="numpy")
def _orifice(g: FloatArray, step_s: float, p: float, z: float, theta: FloatArray, out: FloatArray) -> None:
    z += p
    out[0] = p
    opened = 0.0
    for k in range(len(g)):
        # Opens within a step or a few, and not at once, so that the result is smooth in the dead time.
        opened = min(1.0, opened + 4.0 * g[k])
        drive = theta[1] * g[k]
        p_half = p + 0.5 * step_s * _flow(theta, drive, p, z, opened)
        z_half = z + 0.5 * step_s * opened * (p - z) / theta[6]
        p += step_s * _flow(theta, drive, p_half, z_half, opened)
        z += step_s * opened * (p_half - z_half) / theta[6]
        out[k + 1] = p


def _step_s(model: str, theta: FloatArray, span: float) -> float:
    """A step that the midpoint rule is stable and fair with."""
    if model == LAG:
        return STEP_S
    a, b = float(theta[2]), float(theta[3])
    # The steepest slope of w over p that matters is where the drop is a hundredth of the range.
    slope = 1.0 / max(math.sqrt(a * a + 0.04 * b * span), 1e-3)
    return min(STEP_S, 0.8 / (slope + float(theta[5]) + 1.0 / float(theta[6])))


def simulate_pump(
    model: str,
    theta: FloatArray,
    record: PumpRecord,
    shape: Shape = _STRAIGHT,
    start_s: float = _START_S,
) -> FloatArray:
    """Pressure (n,) at the record's times, simulated from its PWM and its beginning alone.

    The start is the first measured value plus what explains the first `start_s` best: of the state itself
    for the lag, of the chamber for the orifice. Nothing measured later is used.

    Parameters
    ----------
    theta : values in the order of `MODELS[model]`.
    """
    t = record.t_s - record.t_s[0]
    span = max(float(np.ptp(record.value)), 1e-9)
    step = _step_s(model, theta, span)
    steps = max(math.ceil(float(t[-1]) / step), 1)
    g = _drive(record, shape, float(theta[0]), step, steps)
    run = _lag if model == LAG else _orifice
    grid = step * np.arange(steps + 1, dtype=np.float64)
    first = float(record.value[0])
    out = np.empty(steps + 1)

    def at(offset: float) -> FloatArray:
        run(g, step, first, offset, theta, out)
        return np.asarray(np.interp(t, grid, out))

    head = t <= start_s
    base = at(0.0)
    if int(head.sum()) < 3:
        return base
    # The beginning is all but linear in the offset.
    nudge = 0.02 * span
    by = (at(nudge)[head] - base[head]) / nudge
    error = (record.value - base)[head]
    return at(float(by @ error) / (float(by @ by) + _PRIOR))
