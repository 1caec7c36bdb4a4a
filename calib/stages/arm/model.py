"""A bending arm, assembled from parts that drive, bend and resist, and its free run.

Valve: the pilot x [kPa] integrates the command u, smoothed by the input, against the outlet's pressure p. Its
solenoids open for no less than an error j asks for. It fills from the supply, more slowly the fuller it is,
and drains at D times the rate. Within the overlap d neither port is open; supply and exhaust open over w as x
leaves it. The outlet's line feeds the chamber, p_c. Flows are those of nozzles (ISO 6358, critical ratio .3,
absolute pressures, P_0 of the air):

    du/dt   = (command - u) / t_u
    dx/dt   = r (u - p + j) psi((x + P_0) / (p_s + P_0)) for u > p, D r (u - p - j) for u < p,
              |x - p| <= d + w
    dp/dt   = S o(x - p) (p_s + P_0) psi((p + P_0) / (p_s + P_0)) - E o(p - x) (p + P_0) psi(P_0 / (p + P_0))
              - l p - k (p - p_c),   o(e) = max(e - d, 0) / w
    dp_c/dt = n k (p - p_c)

A valve that has held a pressure makes up for its leak, so the pilot begins where supply opens.

Lag, in place of a valve, as of a pump under PWM: dp/dt = (G u - p) / t, with one time up and another down.

Pump, in place of both: it delivers less the higher the pressure, up to p_m at which it stalls. The chamber
empties through an orifice and seeps:

    dp/dt = F max(u - d, 0) (1 - p / p_m) - E (p + P_0) psi(P_0 / (p + P_0)) - l p

Segment: the chamber of the arm fills, p_f, with the fill time. The angle phi [rad] follows its rest value
with one viscous lag; of an arm that swings the inertia T plays a part and a share z of the lag is left, of
others T = 0 and z = 1. A chamber that first takes up slack bends little up to about the pressure p_t of the
toe, 0 of others. Pressure stiffens, so that the moments of pressure, load and hysteresis bend less
under it. w is a stop, the elastic part of the angle's changes, of at most the hysteresis' range; c creeps
after the angle; s is by how much the chord is too short at the start, as of an arm that was vented, and s' is
that of the chord, which recovers in a time of its own:

    dp_f/dt = (p - p_f) / t_f
    T^2 d2phi/dt2 + z tau dphi/dt = phi_0 + M / (1 + b p_f) + q c + v s - phi
    M = a p_f |p_f| / (|p_f| + p_t) + m g l W(phi) - h w / r
    dw = dphi,  |w| <= r;   dc/dt = (phi - phi_0 - c) / tau_c;   ds/dt = -s exp(e p_f) / tau_s,  s' as s

W = C sin(.55 phi) + D cos(.55 phi) is by how much the moment m g l of a load at the tip of an arm of length l
bends it, whose chord leans by about .55 of the angle: C > 0 of one that stands, C < 0 of one that hangs, D of
one that lies. Chord: L = c_0 + c_1 phi + c_2 phi^2 + x p_f - s', x of a chamber that lengthens the arm by its
pressure, before it bends, and 0 of others.

What differs from day to day is a factor of a, and of D or G: an arm is refitted, its rubber rests, and so do
the valve's springs.

Area, stiffness and lever arm are one number, a, without a known load; with one, C and D tell the stiffness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib.core.arrays import BoolArray, FloatArray
from calib.core.compilation import kernel
from calib.core.units import GRAVITY_MPS2

STEP_S = 0.02
"""Of the free run; a tenth of the fastest lag that pressures and motion capture at 90 Hz show."""
_FINER = 4
"""Steps of the valve in one of these: a port opens within a few milliseconds."""
_BEGINS = 3
"""Steps whose median is the start of a free run."""
_AIR_KPA = 101.3
_CRITICAL = 0.3
NO_JUMP_KPA = 1e-6
"""Jump of a valve whose pilot has none and fills at any pressure, as in files of earlier versions."""
_LEANS = 0.55


@dataclass(frozen=True)
class Scale:
    """Size of what logs hold, in which priors are stated: greatest pressure [kPa], range of the angle [rad],
    greatest chord [m], the angle at rest [rad], and the greatest command [kPa or PWM]; and by how many times
    errors are smaller than what assemblies usually leave."""

    pressure_kpa: float
    angle_rad: float
    chord_m: float
    rest_rad: float
    command: float
    finer: float = 1.0


@dataclass(frozen=True)
class Parameter:
    """One number of a part.

    Attributes
    ----------
    centre, spread : prior; of the logarithm where `positive`, in units of `powers` otherwise.
    identified_by : what a log must hold to tell it.
    powers : of pressure, angle, chord and command of the scale that make its unit.
    either_way : a size from which on the prior is that of a logarithm, whatever the sign.
    """

    name: str
    unit: str
    centre: float
    spread: float
    identified_by: str
    positive: bool = False
    powers: tuple[int, int, int, int] = (0, 0, 0, 0)
    either_way: float = 0.0

    def value(self, z: float, scale: Scale) -> float:
        """The number at z standard deviations of the prior from its centre."""
        if self.positive:
            return self._size(scale) * self.centre * math.exp(self.spread * z)
        if self.either_way:
            return self.either_way * math.sinh(math.asinh(self.centre / self.either_way) + self.spread * z)
        offset = scale.rest_rad if self.name == "rest_rad" else 0.0
        return offset + self._size(scale) * (self.centre + self.spread * z)

    def times(self, z: float, factor: float, scale: Scale) -> float:
        """Standard deviations of the number at z times a factor."""
        if self.positive:
            return z + math.log(factor) / self.spread
        return (factor * self.value(z, scale) / self._size(scale) - self.centre) / self.spread

    def _size(self, scale: Scale) -> float:
        p, a, c, u = self.powers
        return float(scale.pressure_kpa**p * scale.angle_rad**a * scale.chord_m**c * scale.command**u)


@dataclass(frozen=True)
class Part:
    """A part of an assembly.

    Attributes
    ----------
    off : values with which it plays no part; empty for one that is needed.
    drives : whether it makes the pressure from the command. An assembly has one such part.
    """

    name: str
    parameters: tuple[Parameter, ...]
    off: Mapping[str, float] = field(default_factory=dict)
    drives: bool = False


_P, _A = (1, 0, 0, 0), (0, 1, 0, 0)
_STEPS = "steps of the command up and down"
_SLOW = "slow motion over the range"
PARTS = (
    Part(
        "valve",
        (
            Parameter("pilot_per_s", "1/s", 1.0, 0.5, _STEPS, True),
            Parameter("pilot_drains", "", 1.0, 0.3, _STEPS, True),
            Parameter("pilot_jump_kpa", "kPa", 0.07, 0.5, "small steps of the command", True, powers=_P),
            Parameter("overlap_kpa", "kPa", 0.1, 0.6, "commands that change sign", True, powers=_P),
            Parameter("opening_kpa", "kPa", 0.03, 0.7, "commands that change sign", True, powers=_P),
            Parameter("supply_per_s", "1/s", 1.2, 0.4, "steps up", True),
            Parameter("exhaust_per_s", "1/s", 1.5, 0.4, "steps down", True),
            Parameter("supply_kpa", "kPa", 1.0, 0.12, "long steps up", True, powers=_P),
            Parameter("line_per_s", "1/s", 4.0, 0.6, _STEPS, True),
            Parameter("line_to_chamber", "", 0.7, 0.6, _STEPS, True),
            Parameter("leak_per_s", "1/s", 0.3, 0.5, "holds", True),
            Parameter("input_s", "s", 0.03, 0.7, "commands that switch fast", True),
        ),
        drives=True,
    ),
    Part(
        "lag",
        (
            Parameter("kpa_per_command", "kPa", 1.0, 0.3, "long steps", True, powers=(1, 0, 0, -1)),
            Parameter("rises_s", "s", 1.0, 0.7, "steps up", True),
            Parameter("falls_s", "s", 1.0, 0.7, "steps down", True),
        ),
        drives=True,
    ),
    Part(
        "pump",
        (
            Parameter("delivers_per_s", "kPa/s", 1.5, 0.8, "steps up", True, powers=(1, 0, 0, -1)),
            Parameter("dead_command", "", 0.1, 0.1, "small commands", powers=(0, 0, 0, 1)),
            Parameter("stalls_kpa", "kPa", 2.0, 0.5, "long steps", True, powers=_P),
            Parameter("orifice_per_s", "1/s", 0.3, 0.8, "steps down", True),
            Parameter("seeps_per_s", "1/s", 0.3, 0.8, "steps down to zero", True),
        ),
        drives=True,
    ),
    Part(
        "segment",
        (
            Parameter("rest_rad", "rad", -0.1, 0.05, "rest", powers=_A),
            Parameter("bends_rad_per_kpa", "rad/kPa", 1.8, 0.6, _SLOW, powers=(-1, 1, 0, 0)),
            Parameter("fill_s", "s", 0.3, 0.6, _STEPS, True),
            Parameter("lag_s", "s", 1.8, 0.4, _STEPS, True),
        ),
    ),
    Part(
        "inertia",
        (
            Parameter("swings_s", "s", 0.15, 0.6, _STEPS, True),
            Parameter("damps", "", 0.1, 1.0, _STEPS, True),
        ),
        {"swings_s": 0.0, "damps": 1.0},
    ),
    Part(
        "toe",
        (Parameter("toe_kpa", "kPa", 0.2, 1.0, _SLOW, True, powers=_P),),
        {"toe_kpa": 0.0},
    ),
    Part(
        "stiffening",
        (Parameter("stiffens_per_kpa", "1/kPa", 0.8, 0.6, _SLOW, True, powers=(-1, 0, 0, 0)),),
        {"stiffens_per_kpa": 0.0},
    ),
    Part(
        "hysteresis",
        (
            Parameter("hysteresis_rad", "rad", 0.05, 0.04, "reversals", powers=_A),
            Parameter("hysteresis_range_rad", "rad", 0.14, 0.25, "reversals of many sizes", True, powers=_A),
        ),
        {"hysteresis_rad": 0.0, "hysteresis_range_rad": 1.0},
    ),
    Part(
        "creep",
        (
            Parameter("creep", "", 0.05, 0.1, "holds of a minute"),
            Parameter("creep_s", "s", 20.0, 0.5, "holds of a minute", True),
        ),
        {"creep": 0.0, "creep_s": 1.0},
    ),
    Part(
        "settling",
        (
            Parameter("settling_rad_per_m", "rad/m", 7.0, 5.0, "vented starts", powers=(0, 1, -1, 0)),
            Parameter("settling_s", "s", 4.0, 0.5, "vented starts", True),
            Parameter("settling_per_kpa", "1/kPa", 1.2, 0.8, "vented starts", powers=(-1, 0, 0, 0)),
        ),
        {"settling_rad_per_m": 0.0, "settling_s": 1.0, "settling_per_kpa": 0.0},
    ),
    Part(
        "load",
        (
            Parameter("compliance_rad_per_Nm", "rad/(N m)", 0.2, 0.7, "a known load", either_way=0.1),
            Parameter("compliance_across_rad_per_Nm", "rad/(N m)", 0.0, 0.7, "a known load", either_way=0.1),
        ),
        {"compliance_rad_per_Nm": 0.0, "compliance_across_rad_per_Nm": 0.0},
    ),
    Part(
        "chord",
        (
            Parameter("chord_m", "m", 1.0, 0.02, "the tip's position", powers=(0, 0, 1, 0)),
            Parameter("chord_m_per_rad", "m/rad", -0.05, 0.05, _SLOW, powers=(0, -1, 1, 0)),
            Parameter("chord_m_per_rad2", "m/rad²", -0.07, 0.05, _SLOW, powers=(0, -2, 1, 0)),
            Parameter("lengthens_s", "s", 4.0, 0.5, "vented starts", True),
            Parameter("lengthens_per_kpa", "1/kPa", 1.2, 0.8, "vented starts", powers=(-1, 0, 0, 0)),
        ),
    ),
    Part(
        "extension",
        (Parameter("extends_m_per_kpa", "m/kPa", 0.0, 0.05, _STEPS, powers=(-1, 0, 1, 0)),),
        {"extends_m_per_kpa": 0.0},
    ),
)
"""In the order of the parameters."""

PARAMETERS = tuple(one for part in PARTS for one in part.parameters)
DRIVES = {part.name: tuple(one.name for one in part.parameters) for part in PARTS if part.drives}
"""Parameters of the parts that make the pressure."""
CHORD = tuple(one.name for part in PARTS if part.name in ("chord", "extension") for one in part.parameters)
SEGMENT = tuple(one.name for part in PARTS if not part.drives for one in part.parameters)
COMPLIANCE = tuple(one.name for part in PARTS if part.name == "load" for one in part.parameters)
DAILY = {"pilot_drains": 0.1, "kpa_per_command": 0.1, "delivers_per_s": 0.1, "bends_rad_per_kpa": 0.15}
"""Parameters that differ from day to day, and standard deviations of the logarithms of a day's factors."""
Days = Mapping[str, Mapping[str, float]]
"""Factors of parameters by day."""


@dataclass(frozen=True)
class Trial:
    """A log on a regular grid of `STEP_S`.

    Attributes
    ----------
    name, day : of the log; trials of one day share its factors. load_kg : at the tip.
    t_s : (n,). command : (n,) kPa, or PWM, means over the steps; empty where it was not logged.
    pressure_kpa : (n,) of the driven chamber, empty where it was not logged.
    angle_rad, chord_m : (n,) of the tip, empty without motion capture.
    pwm : whether the command is a PWM value in place of a pressure.
    unseen : rows (n,) between poses that are far apart, None without any.
    """

    name: str
    day: str
    load_kg: float
    t_s: FloatArray
    command: FloatArray
    pressure_kpa: FloatArray
    angle_rad: FloatArray
    chord_m: FloatArray
    pwm: bool = False
    unseen: BoolArray | None = None

    @cached_property
    def begins(self) -> tuple[float, float, float]:
        """What pressure [kPa], angle [rad] and chord [m] start from; 0 where they were not logged.

        A single reading may be none.
        """
        kpa, rad, m = (
            float(np.median(values[:_BEGINS])) if len(values) else 0.0
            for values in (self.pressure_kpa, self.angle_rad, self.chord_m)
        )
        return kpa, rad, m


@kernel()
def _nozzle(ratio: float) -> float:
    """psi of ISO 6358 at a ratio of absolute pressures."""
    if ratio >= 1.0:
        return 0.0
    beyond = max(ratio - _CRITICAL, 0.0) / (1.0 - _CRITICAL)
    return math.sqrt(1.0 - beyond * beyond)


@kernel()
def _valve(command: FloatArray, start_kpa: float, q: FloatArray) -> FloatArray:
    rate, drains, jump, overlap, opening, supply, exhaust, source, line, ratio, leak, input_s = q
    out = np.empty(len(command))
    outlet = chamber = start_kpa
    ahead = overlap
    step_s = STEP_S / _FINER
    flow = step_s * line
    held = 1.0 + ratio * flow
    smooth, follows = command[0], 1.0 - math.exp(-step_s / input_s)
    for k in range(len(command)):
        out[k] = outlet
        for _ in range(_FINER):
            smooth += follows * (command[k] - smooth)
            error = smooth - outlet
            pilot = rate * (error + math.copysign(jump, error))
            if error < 0.0:
                pilot *= drains
            elif jump > NO_JUMP_KPA:
                pilot *= _nozzle((outlet + ahead + _AIR_KPA) / (source + _AIR_KPA))
            ahead += step_s * pilot
            ahead = min(max(ahead, -overlap - opening), overlap + opening)
            # Implicit in the pressures, as ports and line are fast: flows over the drops that drive them.
            fills = empties = 0.0
            if ahead > overlap and outlet < source:
                gone = (outlet + _AIR_KPA) / (source + _AIR_KPA)
                full = supply * (source + _AIR_KPA) * _nozzle(gone) / max(source - outlet, 1e-3)
                fills = full * (ahead - overlap) / opening
            elif ahead < -overlap and outlet > 0.0:
                full = exhaust * (outlet + _AIR_KPA) * _nozzle(_AIR_KPA / (outlet + _AIR_KPA))
                empties = full / max(outlet, 1e-3) * (-ahead - overlap) / opening
            was = outlet
            outlet = (outlet + step_s * fills * source + flow * chamber / held) / (
                1.0 + step_s * (fills + empties + leak) + flow - flow * ratio * flow / held
            )
            chamber = (chamber + ratio * flow * outlet) / held
            ahead -= outlet - was
    return out


@kernel()
def _lag(command: FloatArray, start_kpa: float, q: FloatArray) -> FloatArray:
    level, rises_s, falls_s = q
    out = np.empty(len(command))
    pressure = start_kpa
    for k in range(len(command)):
        out[k] = pressure
        ahead = level * command[k] - pressure
        pressure += ahead * (1.0 - math.exp(-STEP_S / (rises_s if ahead > 0.0 else falls_s)))
    return out


@kernel()
def _pump(command: FloatArray, start_kpa: float, q: FloatArray) -> FloatArray:
    delivers, dead, stalls, orifice, seeps = q
    out = np.empty(len(command))
    pressure = start_kpa
    step_s = STEP_S / _FINER
    for k in range(len(command)):
        out[k] = pressure
        flow = delivers * max(command[k] - dead, 0.0)
        for _ in range(_FINER):
            inside = max(pressure, 0.0) + _AIR_KPA
            leaves = orifice * inside * _nozzle(_AIR_KPA / inside) / max(pressure, 1e-2)
            # Implicit, over the drop that drives the flow.
            pressure = (pressure + step_s * flow) / (1.0 + step_s * (flow / stalls + leaves + seeps))
    return out


@kernel()
def load_bends(angle_rad: float, compliance: float, across: float) -> float:
    """By how much a moment of 1 N m of a load at the tip, across the straight arm, bends it [rad]."""
    lean = _LEANS * angle_rad
    return compliance * math.sin(lean) + across * math.cos(lean)


@kernel()
def _segment(pressure: FloatArray, angle: float, chord: float, q: FloatArray, moment: float) -> FloatArray:
    (
        rest,
        linear,
        fill,
        lag,
        swings,
        damps,
        toe,
        stiffens,
        stop,
        reach,
        creep,
        creep_s,
        vented,
        settling_s,
        sooner,
    ) = q[:15]
    compliance, across, c0, c1, c2, lengthens_s, longer, extends = q[15:]
    out = np.empty((len(pressure), 2))
    short = lacks = c0 + c1 * angle + c2 * angle * angle + extends * pressure[0] - chord
    elastic, crept = 0.0, 0.0
    inside, rate = pressure[0], 0.0
    squared = max(swings, 0.02) ** 2
    follows, fills = 1.0 - math.exp(-STEP_S / lag), 1.0 - math.exp(-STEP_S / fill)
    for k in range(len(pressure)):
        out[k, 0] = angle
        out[k, 1] = c0 + c1 * angle + c2 * angle * angle + extends * inside - lacks
        inside += fills * (pressure[k] - inside)
        weighs = moment * load_bends(angle, compliance, across)
        bends = linear * inside
        if toe > 0.0:
            bends *= abs(inside) / (abs(inside) + toe)
        bends += weighs - stop * elastic / reach
        aim = rest + bends / max(1.0 + stiffens * inside, 0.1)
        lacking = aim + creep * crept + vented * short - angle
        change = follows * lacking
        if swings > 0.0:
            rate = (squared * rate + STEP_S * lacking) / (squared + STEP_S * damps * lag)
            change = STEP_S * rate
        angle += change
        elastic = min(max(elastic + change, -reach), reach)
        crept += STEP_S / creep_s * (angle - rest - crept)
        short -= STEP_S / settling_s * short * math.exp(min(sooner * inside, 5.0))
        lacks -= STEP_S / lengthens_s * lacks * math.exp(min(longer * inside, 5.0))
    return out


def parameters_on_day(day: str, values: Mapping[str, float], days: Days) -> dict[str, float]:
    """Parameters on a day; on one that was not seen their factors are the means of those that were."""
    seen = [days[day]] if day in days else list(days.values())
    logs = {name: [math.log(one.get(name, 1.0)) for one in seen] for name in DAILY if seen}
    return dict(values) | {
        name: values[name] * math.exp(sum(of) / len(of)) for name, of in logs.items() if name in values
    }


def drive_run(trial: Trial, values: Mapping[str, float]) -> FloatArray:
    """Pressure [kPa] (n,) that follows from a trial's command and from its first readings alone.

    The drive is the one whose parameters are among `values`.
    """
    name = next(one for one, names in DRIVES.items() if names[0] in values)
    q = np.array([values[one] for one in DRIVES[name]])
    run = {"valve": _valve, "lag": _lag, "pump": _pump}[name]
    return np.asarray(run(trial.command, trial.begins[0], q))


def segment_run(
    trial: Trial, values: Mapping[str, float], pressure_kpa: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angle [rad] and chord [m], each (n,), that follow from a pressure (n,) and from the first poses."""
    q = np.array([values[name] for name in SEGMENT])
    moment = trial.load_kg * GRAVITY_MPS2 * values["chord_m"]
    out = _segment(pressure_kpa, *trial.begins[1:], q, moment)
    return out[:, 0], out[:, 1]


@dataclass(frozen=True)
class Assembly:
    """Parts by name, without those that play no part."""

    parts: tuple[str, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Parameters of its parts."""
        return tuple(one.name for part in PARTS if part.name in self.parts for one in part.parameters)

    @property
    def off(self) -> dict[str, float]:
        """Values of parameters whose parts are left out."""
        return {k: v for part in PARTS if part.name not in self.parts for k, v in part.off.items()}

    def values(self, z: FloatArray, scale: Scale) -> dict[str, float]:
        """Parameters at z (parameters,) standard deviations of their priors."""
        mine = set(self.names)
        found = zip(PARAMETERS, z.tolist(), strict=True)
        return {one.name: one.value(x, scale) for one, x in found if one.name in mine} | self.off

    def without(self, *names: str) -> Assembly:
        """The same without some parts."""
        return Assembly(tuple(one for one in self.parts if one not in names))

    def driven_by(self, name: str) -> Assembly:
        """The same with another drive."""
        return Assembly((name, *self.without(*DRIVES).parts))


def data_scale(trials: Sequence[Trial]) -> Scale:
    """Size of what trials hold; that of a pressure without one is of the command, under a pump of the air."""
    commands = [one.command for one in trials if len(one.command)]
    pressures = [one.pressure_kpa for one in trials if len(one.pressure_kpa)]
    angles = np.concatenate([one.angle_rad for one in trials])
    chords = np.concatenate([one.chord_m for one in trials])
    low, high = (float(x) for x in np.percentile(angles, (1.0, 99.5))) if len(angles) else (0.0, 1.0)
    command = max((float(x.max()) for x in commands), default=1.0)
    logged = [float(x.max()) for x in pressures] + [command] * (not all(one.pwm for one in trials))
    return Scale(
        max(logged, default=_AIR_KPA),
        high - low,
        float(chords.max()) if len(chords) else 1.0,
        low,
        command,
    )
