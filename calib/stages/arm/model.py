"""A bending arm under a pressure valve, assembled from parts, and its free run.

Valve: the pilot x [kPa] integrates the command u against the outlet's pressure p. Within the overlap d
neither port is open; supply and exhaust open as x leaves it. The outlet's line feeds the chamber, p_c:

    dx/dt   = r (u - p),  |x - p| <= (1 + w) d
    dp/dt   = S o(x - p) (p_s - p) - (E o(p - x) + l) p - k (p - p_c),   o(e) = max(e - d, 0) / (w d)
    dp_c/dt = n k (p - p_c)

Segment: the angle phi [rad] follows its rest value with one viscous lag; inertia plays no part at the speeds
of such arms. w is a stop, the elastic part of the angle's changes, of at most the hysteresis' range; c creeps
after the angle; s is by how much the chord is too short at the start, as of an arm that was vented:

    tau dphi/dt = phi_0 + g (a p + b p^2) + C M(phi) - h w / r + q c + v s - phi
    dw = dphi,  |w| <= r;   dc/dt = (phi - phi_0 - c) / tau_c;   ds/dt = -s exp(e p) / tau_s

g is the day's gain. M = m g l sin(.55 phi) is the moment of a load at the tip of an upright arm of length l,
whose chord leans by about .55 of the angle. Chord: L = c_0 + c_1 phi + c_2 phi^2 - s.

Area, stiffness and lever arm are one number, a, without a known load; with one, C separates the stiffness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.core.arrays import FloatArray

STEP_S = 0.02
"""Of the free run; a tenth of the fastest lag that pressures and motion capture at 90 Hz show."""
_OPENING = 0.04
"""w: ports open over this share of the overlap."""
_LEANS = 0.55
_GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True)
class Scale:
    """Size of what logs hold, in which priors are stated: greatest command [kPa], range of the angle [rad],
    greatest chord [m], and the angle at rest [rad]."""

    pressure_kpa: float
    angle_rad: float
    chord_m: float
    rest_rad: float


@dataclass(frozen=True)
class Parameter:
    """One number of a part.

    Attributes
    ----------
    centre, spread : prior; of the logarithm where `positive`, in units of `powers` otherwise.
    powers : of pressure, angle and chord of the scale that make its unit.
    identified_by : what a log must hold to tell it.
    """

    name: str
    unit: str
    centre: float
    spread: float
    positive: bool = False
    powers: tuple[int, int, int] = (0, 0, 0)
    identified_by: str = ""

    def value(self, z: float, scale: Scale) -> float:
        """The number at z standard deviations of the prior from its centre."""
        p, a, c = self.powers
        size = scale.pressure_kpa**p * scale.angle_rad**a * scale.chord_m**c
        if self.positive:
            return size * self.centre * math.exp(self.spread * z)
        offset = scale.rest_rad if self.name == "rest_rad" else 0.0
        return offset + size * (self.centre + self.spread * z)


@dataclass(frozen=True)
class Part:
    """A part of an assembly. `off` are values with which it plays no part; empty for one that is needed."""

    name: str
    parameters: tuple[Parameter, ...]
    off: Mapping[str, float]


_P, _A = (1, 0, 0), (0, 1, 0)
_STEPS = "steps of the command up and down"
_SLOW = "slow motion over the range"
PARTS = (
    Part(
        "valve",
        (
            Parameter("pilot_per_s", "1/s", 1.5, 0.5, True, identified_by=_STEPS),
            Parameter("overlap_kpa", "kPa", 0.15, 0.6, True, _P, identified_by="commands that change sign"),
            Parameter("supply_per_s", "1/s", 1.2, 0.4, True, identified_by="steps up"),
            Parameter("exhaust_per_s", "1/s", 1.5, 0.4, True, identified_by="steps down"),
            Parameter("supply_kpa", "kPa", 1.08, 0.07, True, _P, identified_by="long steps up"),
            Parameter("line_per_s", "1/s", 4.0, 0.6, True, identified_by=_STEPS),
            Parameter("line_to_chamber", "", 1.1, 0.5, True, identified_by=_STEPS),
            Parameter("leak_per_s", "1/s", 0.2, 0.5, True, identified_by="holds"),
        ),
        {},
    ),
    Part(
        "segment",
        (
            Parameter("rest_rad", "rad", -0.1, 0.05, powers=_A, identified_by="rest"),
            Parameter("bends_rad_per_kpa", "rad/kPa", 1.8, 0.6, powers=(-1, 1, 0), identified_by=_SLOW),
            Parameter("lag_s", "s", 1.8, 0.4, True, identified_by=_STEPS),
        ),
        {},
    ),
    Part(
        "quadratic",
        (Parameter("bends_rad_per_kpa2", "rad/kPa²", -0.8, 0.6, powers=(-2, 1, 0), identified_by=_SLOW),),
        {"bends_rad_per_kpa2": 0.0},
    ),
    Part(
        "hysteresis",
        (
            Parameter("hysteresis_rad", "rad", 0.05, 0.04, powers=_A, identified_by="reversals"),
            Parameter(
                "hysteresis_range_rad", "rad", 0.14, 0.25, True, _A, identified_by="reversals of many sizes"
            ),
        ),
        {"hysteresis_rad": 0.0, "hysteresis_range_rad": 1.0},
    ),
    Part(
        "creep",
        (
            Parameter("creep", "", 0.0, 0.1, identified_by="holds of a minute"),
            Parameter("creep_s", "s", 20.0, 0.5, True, identified_by="holds of a minute"),
        ),
        {"creep": 0.0, "creep_s": 1.0},
    ),
    Part(
        "settling",
        (
            Parameter(
                "settling_rad_per_m", "rad/m", 7.0, 5.0, powers=(0, 1, -1), identified_by="vented starts"
            ),
            Parameter("settling_s", "s", 4.0, 0.5, True, identified_by="vented starts"),
            Parameter(
                "settling_per_kpa", "1/kPa", 1.2, 0.8, powers=(-1, 0, 0), identified_by="vented starts"
            ),
        ),
        {"settling_rad_per_m": 0.0, "settling_s": 1.0, "settling_per_kpa": 0.0},
    ),
    Part(
        "load",
        (Parameter("compliance_rad_per_Nm", "rad/(N m)", 0.2, 0.15, identified_by="a known load"),),
        {"compliance_rad_per_Nm": 0.0},
    ),
    Part(
        "chord",
        (
            Parameter("chord_m", "m", 1.0, 0.02, powers=(0, 0, 1), identified_by="the tip's position"),
            Parameter("chord_m_per_rad", "m/rad", -0.05, 0.05, powers=(0, -1, 1), identified_by=_SLOW),
            Parameter("chord_m_per_rad2", "m/rad²", -0.07, 0.05, powers=(0, -2, 1), identified_by=_SLOW),
        ),
        {},
    ),
)
"""In the order of the parameters."""

PARAMETERS = tuple(one for part in PARTS for one in part.parameters)
NAMES = tuple(one.name for one in PARAMETERS)
_VALVE = len(PARTS[0].parameters)
DAY_SPREAD = 0.15
"""Standard deviation of the logarithm of a day's gain: an arm is refitted, its hoses and its rubber rest."""


@dataclass(frozen=True)
class Trial:
    """A log on a regular grid of `STEP_S`.

    Attributes
    ----------
    name, day : of the log; trials of one day share a gain. load_kg : at the tip.
    t_s : (n,). command_kpa : (n,) means over the steps, empty where it was not logged.
    pressure_kpa : (n,) of the driven chamber, empty where it was not logged.
    angle_rad, chord_m : (n,) of the tip, empty without motion capture.
    """

    name: str
    day: str
    load_kg: float
    t_s: FloatArray
    command_kpa: FloatArray
    pressure_kpa: FloatArray
    angle_rad: FloatArray
    chord_m: FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def _valve(command, start_kpa, q, step_s):  # type: ignore[no-untyped-def]
    rate, overlap, supply, exhaust, source, line, ratio, leak = q
    out = np.empty(len(command))
    pilot = outlet = chamber = start_kpa
    width = _OPENING * overlap
    most = overlap + width
    for k in range(len(command)):
        out[k] = outlet
        pilot += step_s * rate * (command[k] - outlet)
        ahead = min(max(pilot - outlet, -most), most)
        pilot = outlet + ahead
        fills = supply * max(ahead - overlap, 0.0) / width
        drains = exhaust * max(-ahead - overlap, 0.0) / width + leak
        # Implicit in both pressures, as the line is fast.
        flow = step_s * line
        held = 1.0 + ratio * flow
        outlet = (outlet + step_s * fills * source + flow * chamber / held) / (
            1.0 + step_s * (fills + drains) + flow - flow * ratio * flow / held
        )
        chamber = (chamber + ratio * flow * outlet) / held
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _segment(pressure, angle, chord, q, gain, moment, step_s):  # type: ignore[no-untyped-def]
    rest, linear, lag, square, stop, reach, creep, creep_s, vented, settling_s, sooner = q[:11]
    compliance, c0, c1, c2 = q[11:]
    out = np.empty((len(pressure), 2))
    short = c0 + c1 * angle + c2 * angle * angle - chord
    elastic, crept = 0.0, 0.0
    follows = 1.0 - math.exp(-step_s / lag)
    for k in range(len(pressure)):
        p = pressure[k]
        out[k, 0] = angle
        out[k, 1] = c0 + c1 * angle + c2 * angle * angle - short
        aim = rest + gain * (linear * p + square * p * p) + compliance * moment * math.sin(_LEANS * angle)
        change = follows * (aim - stop * elastic / reach + creep * crept + vented * short - angle)
        angle += change
        elastic = min(max(elastic + change, -reach), reach)
        crept += step_s / creep_s * (angle - rest - crept)
        short -= step_s / settling_s * short * math.exp(min(sooner * p, 5.0))
    return out


def valve_run(trial: Trial, values: Mapping[str, float]) -> FloatArray:
    """Pressure [kPa] (n,) that follows from a trial's command and from its first reading alone."""
    start = trial.pressure_kpa[0] if len(trial.pressure_kpa) else 0.0
    q = np.array([values[name] for name in NAMES[:_VALVE]])
    return np.asarray(_valve(trial.command_kpa, start, q, STEP_S))


def segment_run(
    trial: Trial, values: Mapping[str, float], pressure_kpa: FloatArray, gain: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Angle [rad] and chord [m], each (n,), that follow from a pressure (n,) and from the first pose alone.

    Parameters
    ----------
    values : parameters by name. gain : of the day.
    """
    q = np.array([values[name] for name in NAMES[_VALVE:]])
    moment = trial.load_kg * _GRAVITY_MPS2 * values["chord_m"]
    out = _segment(pressure_kpa, trial.angle_rad[0], trial.chord_m[0], q, gain, moment, STEP_S)
    return out[:, 0], out[:, 1]


@dataclass(frozen=True)
class Assembly:
    """Parts by name, without those that play no part."""

    parts: tuple[str, ...]

    @property
    def off(self) -> dict[str, float]:
        """Values of parameters whose parts are left out."""
        return {k: v for part in PARTS if part.name not in self.parts for k, v in part.off.items()}

    def values(self, z: FloatArray, scale: Scale) -> dict[str, float]:
        """Parameters at z (parameters,) standard deviations of their priors."""
        found = {one.name: one.value(x, scale) for one, x in zip(PARAMETERS, z.tolist(), strict=True)}
        return found | self.off

    def without(self, *names: str) -> Assembly:
        """The same without some parts."""
        return Assembly(tuple(one for one in self.parts if one not in names))


def scale_of(trials: Sequence[Trial]) -> Scale:
    """Size of what trials hold."""
    pressures = [x for one in trials for x in (one.command_kpa, one.pressure_kpa) if len(x)]
    angles = np.concatenate([one.angle_rad for one in trials])
    chords = np.concatenate([one.chord_m for one in trials])
    low, high = (float(x) for x in np.percentile(angles, (1.0, 99.5))) if len(angles) else (0.0, 1.0)
    return Scale(
        max(float(x.max()) for x in pressures),
        high - low,
        float(chords.max()) if len(chords) else 1.0,
        low,
    )
