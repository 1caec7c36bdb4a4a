"""Parameters of the actuator from logs: fit, error bars, verdict, and the next experiment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, rms, robust_sigma
from calib.core.errors import BadInputError
from calib.core.verdict import Finding, Verdict
from calib.solve.information import scaled_inverse, tied_groups
from calib.stages.actuator.kinematics import bellows
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import Creep, Plant
from calib.stages.actuator.pump import ElongationForce, Orifice, Pump, RateLimit
from calib.stages.actuator.section import CREEP, KNOTS, STRENGTHS, label_of
from calib.stages.actuator.simulate import simulate_batch, state_row

# ----------------------------------------------------------------------
# The parameters that an identification can estimate, and how a vector of them becomes a rig.
#
# Names and units are those of the rig's file. All are positive: the creep's lambda1 and lambda2 by their
# bounds, so that with lambda3 < 0 every candidate is passive (3.45). lambda2 and lambda3 enter the motion
# only by their product; lambda3 is among the parameters so that this is found and said, and is then fixed.
#
# The static force of the pumps is either scaled for each bellows (`strength1`, `strength2`), or its map is
# estimated: the steady elongations at 6, 8, 10 and 12 V, which are the cubic of (2.13), with the strength
# of the second pump against the first.

KNOTS_V = (6.0, 8.0, 10.0, 12.0)
"""Voltages at which the static map is estimated (Fig. 2.11)."""


@dataclass(frozen=True)
class Spec:
    """One parameter: unit, bounds, the size of a typical change, and what it acts on.

    `acts` is "all", "free" (swings with the hoses off) or "pumps"; "prior" for one that no log can tell, so
    that it is among the unknowns only with a prior. `symbol` is the source's. `sigma` is that of two rigs
    which were made alike, the prior of what logs tell in part and nobody states, `share` that as a share of
    the value.
    """

    unit: str
    low: float
    high: float
    scale: float
    acts: str
    symbol: str
    sigma: float = math.inf
    share: float = math.inf


PARAMETERS: dict[str, Spec] = {
    "mass_kg": Spec("kg", 1e-4, 10.0, 0.002, "prior", "m"),
    # By a drawing of the head, for the mass as it is stated: their ratio is what swings see.
    "inertia_kgm2": Spec("kg m^2", 1e-8, 0.1, 1e-6, "all", "J", share=0.05),
    "rest_length_m": Spec("m", 5e-3, 1.0, 1e-3, "all", "l_0", 5e-4),
    "stiffness_scale": Spec("", 0.05, 20.0, 0.2, "all", "c_spr"),
    "damping_scale_free_swing": Spec("", 0.01, 200.0, 1.0, "free", "c_dmp"),
    "damping_scale_pumps_connected": Spec("", 0.01, 500.0, 5.0, "pumps", "c_dmp"),
    "bending_N_per_rad2": Spec("N/rad^2", 0.0, 10.0, 0.05, "all", "k_bnd"),
    "lambda1_per_s": Spec("1/s", 0.02, 60.0, 1.0, "all", "lambda1"),
    "lambda2_N_per_m": Spec("N/m", 0.01, 500.0, 3.0, "all", "lambda2"),
    "lambda3": Spec("", -50.0, -0.01, 0.3, "all", "lambda3"),
    "lag_s": Spec("s", 0.01, 10.0, 0.2, "pumps", "tau"),
    # Two pumps of one make, with hoses of other lengths.
    "lag_ratio": Spec("", 0.2, 5.0, 0.1, "pumps", "tau2/tau1", 0.1),
    "strength1": Spec("", 0.05, 10.0, 0.2, "pumps", "strength1"),
    "strength2": Spec("", 0.05, 10.0, 0.2, "pumps", "strength2"),
    "falling_N_per_s": Spec("N/s", 0.01, 50.0, 0.1, "pumps", "R"),
    "laminar_s": Spec("s", 0.01, 50.0, 0.3, "pumps", "a"),
    "turbulent_s2_per_N": Spec("s^2/N", 0.0, 200.0, 0.3, "pumps", "b"),
    "play_pwm": Spec("PWM", 0.0, 120.0, 5.0, "pumps", "w"),
    "play_N": Spec("N", 0.0, 5.0, 0.05, "pumps", "w_F"),
    "elongation_6V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(6 V)"),
    "elongation_8V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(8 V)"),
    "elongation_10V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(10 V)"),
    "elongation_12V_mm": Spec("mm", 0.0, 60.0, 2.0, "pumps", "eps(12 V)"),
}
"""All parameters in the order of tables."""

_PLAYS = {
    "play_pwm": (4.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0),
    "play_N": (0.03, 0.06, 0.09, 0.12, 0.18, 0.25, 0.35, 0.5),
}
"""Plays of the pumps, and widths from which they are sought."""

_OF_PLANT = ("mass_kg", "inertia_kgm2", "rest_length_m", "stiffness_scale", "bending_N_per_rad2")
_OF_PUMP = ("lag_s", "lag_ratio", "play_pwm", "play_N")
"""Parameters that plant and pumps have by the same names."""


@dataclass(frozen=True)
class StrengthForce(ElongationForce):
    """The static force with a factor for each of two pumps."""

    strength: tuple[float, float] = (1.0, 1.0)

    def force_N(self, pwm: FloatArray) -> FloatArray:
        """Steady forces (..., 2) [N] of PWM values (..., 2)."""
        return np.asarray(super().force_N(pwm) * np.array(self.strength))


def elongation_polynomial(elongation_mm: Sequence[float]) -> tuple[float, float, float, float]:
    """Coefficients of u^3 .. 1 through the steady elongations [mm] at `KNOTS_V`."""
    a, b, c, d = np.polyfit(KNOTS_V, np.asarray(elongation_mm, dtype=np.float64), 3).tolist()
    return a, b, c, d


def values_of(nominal: Machine) -> dict[str, float]:
    """All parameters of a rig by name."""
    plant, pump, law = nominal.plant, nominal.pump, nominal.pump.deflation
    limit, orifice = (law if isinstance(law, kind) else kind() for kind in (RateLimit, Orifice))
    return {
        **{name: getattr(plant, name) for name in _OF_PLANT},
        "damping_scale_free_swing": nominal.free_damping_scale,
        "damping_scale_pumps_connected": plant.damping_scale,
        **dict(zip(CREEP, plant.creep_rates, strict=True)),
        **{name: getattr(pump, name) for name in _OF_PUMP},
        **dict(zip(STRENGTHS, nominal.strength, strict=True)),
        **vars(limit),
        **vars(orifice),
        **dict(zip(KNOTS, np.polyval(pump.static.elongation_mm, KNOTS_V).tolist(), strict=True)),
    }


def candidates(
    nominal: Machine, free: bool, pumps: bool, static_map: bool, stated: Mapping[str, float] | None = None
) -> tuple[str, ...]:
    """Parameters that logs of these kinds can tell at all, lambda3 with them.

    Parameters
    ----------
    free, pumps : whether there are swings with the hoses off, and logs with commands.
    static_map : estimate the elongations at `KNOTS_V` instead of the strength of the first pump.
    stated : standard deviations of what a person states; those of deviation zero are fixed.
    """
    stated = stated or {}
    wanted = {"all"} | ({"free"} if free else set()) | ({"pumps"} if pumps else set())
    wanted |= {"prior"} if stated.get("mass_kg") else set()
    names = [name for name, spec in PARAMETERS.items() if spec.acts in wanted and stated.get(name) != 0.0]
    orifice = isinstance(nominal.pump.deflation, Orifice)
    left_out = {"falling_N_per_s"} if orifice else {"laminar_s", "turbulent_s2_per_N"}
    left_out |= {"strength1"} if static_map else set(KNOTS)
    # A play is looked for where a rig without one leaves the logs unexplained.
    left_out |= {name for name in _PLAYS if not getattr(nominal.pump, name) > 0.0}
    return tuple(name for name in names if name not in left_out)


def made(nominal: Machine, values: Mapping[str, float], hoses: bool, tick_s: float) -> tuple[Plant, Pump]:
    """Plant and pump with some parameters changed.

    Parameters
    ----------
    values : by name of `PARAMETERS`; the others keep their nominal value.
    hoses : whether the pumps are connected, which decides on the damping.
    """
    v = {**values_of(nominal), **values}
    static, law = nominal.pump.static, nominal.pump.deflation
    curve = static.elongation_mm
    if any(name in values for name in KNOTS):
        curve = elongation_polynomial([v[name] for name in KNOTS])
    of_plant: dict[str, Any] = {name: v[name] for name in _OF_PLANT}
    of_pump: dict[str, Any] = {name: v[name] for name in _OF_PUMP}
    plant = replace(
        nominal.plant,
        **of_plant,
        damping_scale=v["damping_scale_pumps_connected" if hoses else "damping_scale_free_swing"],
        creep=Creep(*(v[name] for name in CREEP)),
    )
    pump = replace(
        nominal.pump.at(tick_s),
        **of_pump,
        static=StrengthForce(
            curve, static.stiffness, static.supply_V, static.dead_zone_V, (v["strength1"], v["strength2"])
        ),
        deflation=type(law)(**{name: v[name] for name in vars(law)}),
    )
    return plant, pump


# ----------------------------------------------------------------------
# A log as an identification sees it, and what simulated rigs would have shown in its place.
#
# A `Track` holds the commands by ticks and what was measured of the head: angle and length with the square
# root of the inverse of their covariance, so that whitened residuals of a perfect model have deviation one.
#
# The rig is at rest before the first tick, bent and stretched as the start says, or in motion there, with
# rates, creep and forces that are unknown too. Commands before it are zero, or of a start in motion the
# first one. Between ticks the states follow the cubic through values and rates at both ends (4e-5 rad
# at 4 Hz).

SUBSTEPS = 12
"""Steps per tick of 1/60 s: 1.4 ms, of fourth order."""
_ROUGH_SUBSTEPS = 6
"""The same while a minimum is searched."""


@dataclass(frozen=True)
class Start:
    """State before the first tick: angle and length, and what is zero at rest with the pumps off.

    Attributes
    ----------
    phi_rad, length_m, dphi_radps, dlength_mps : of the head.
    creep1_N, creep2_N : z of (3.45). force1_N, force2_N : of the pumps. lag1_N, lag2_N : of their lags, which
        are below the forces while air leaves at its limit.
    """

    phi_rad: float
    length_m: float
    dphi_radps: float = 0.0
    dlength_mps: float = 0.0
    creep1_N: float = 0.0
    creep2_N: float = 0.0
    force1_N: float = 0.0
    force2_N: float = 0.0
    lag1_N: float = 0.0
    lag2_N: float = 0.0

    def row(self, plant: Plant) -> FloatArray:
        """The row (10,) of `simulate.STATE`."""
        row = state_row(plant, self.phi_rad, self.length_m, (self.force1_N, self.force2_N))
        row[2:4] = bellows(self.dphi_radps, self.dlength_mps, plant.bellows_radius_m)
        row[4:8] = self.creep1_N, self.creep2_N, self.lag1_N, self.lag2_N
        return row


COMPONENTS = tuple(field.name for field in fields(Start))
"""Names of a start's values, those of rest first, those that only pumps have last."""


@dataclass(frozen=True)
class Track:
    """One log.

    Attributes
    ----------
    name : for messages. tick_s : period of the commands.
    pwm : (n, 2) commands, row k at the time k tick_s. hoses : whether the pumps are connected.
    t_s : (m,) times of the measured rows. head : (m, 2) angle [rad] and length [m].
    whitening : (m, 2, 2) turns errors of `head` into numbers of deviation one.
    moving : a guess of the start where the log begins in motion, None where it begins at rest.
    source : where the pose comes from: "pictures", "states" or "truth". delay_s : what is known of its delay.
    begin_s : time of the log at which the track begins.
    phi_rad : the angle there, where more than the first rows tell it.
    """

    name: str
    tick_s: float
    pwm: FloatArray
    hoses: bool
    t_s: FloatArray
    head: FloatArray
    whitening: FloatArray
    moving: Start | None = None
    source: str = ""
    delay_s: float = 0.0
    begin_s: float = 0.0
    phi_rad: float | None = None

    def __post_init__(self) -> None:
        m = len(self.t_s)
        if self.head.shape != (m, 2) or self.whitening.shape != (m, 2, 2) or self.pwm.shape[1:] != (2,):
            raise BadInputError(f"{self.name}: found arrays that do not match")
        if m == 0 or len(self.pwm) < 2:
            raise BadInputError(f"{self.name}: found no rows to identify from")

    @property
    def start(self) -> Start:
        """Median of the first five rows, which outliers do not move; of a log in motion its guess."""
        if self.moving is not None:
            return self.moving
        phi, length = np.median(self.head[:5], axis=0).tolist()
        return Start(phi if self.phi_rad is None else self.phi_rad, length)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Values of the start that are not known: of `COMPONENTS` the first 2, 6 or 10."""
        return COMPONENTS[: 2 if self.moving is None else 10 if self.hoses else 6]


def heads_of(
    track: Track,
    pairs: Sequence[tuple[Plant, Pump]],
    starts: Sequence[Start],
    delay_s: float,
    per_tick: int = SUBSTEPS,
) -> tuple[FloatArray, FloatArray]:
    """Angle and length at the track's rows, and their rates, of plants with pumps: (pairs, m, 2) each.

    Parameters
    ----------
    starts : of each pair. delay_s : the rows show the head as it was this much earlier.
    per_tick : steps in 1/60 s.

    A pair whose motion leaves the model is NaN.
    """
    r, pwm = pairs[0][0].bellows_radius_m, track.pwm
    if track.moving is not None:
        # The batch knows no commands before the first; those on their way are put in by hand.
        late = np.maximum(np.arange(len(pwm)) - pairs[0][1].delay_ticks, 0)
        pwm, pairs = pwm[late], [(plant, replace(pump, delay_ticks=0)) for plant, pump in pairs]
    rows = np.stack([start.row(plant) for (plant, _), start in zip(pairs, starts, strict=True)])
    last = float(track.t_s[-1] - delay_s)
    ticks = min(max(int(np.ceil(last / track.tick_s)) + 1, 2), len(track.pwm))
    substeps = max(round(per_tick * 60.0 * track.tick_s), 4)
    states, _ = simulate_batch([p for p, _ in pairs], [u for _, u in pairs], pwm[:ticks], rows, substeps)
    states = np.concatenate([rows[:, None, :], states], axis=1)
    half = 0.5 / r
    y, dy = (
        np.stack([(one - other) * half, 0.5 * (one + other)], axis=-1)
        for one, other in (np.moveaxis(states[..., k : k + 2], -1, 0) for k in (0, 2))
    )
    at = np.clip((track.t_s - delay_s) / track.tick_s, 0.0, float(ticks))
    k = np.minimum(at.astype(np.int64), ticks - 1)
    x = (at - k)[None, :, None]
    h = track.tick_s
    y0, y1, d0, d1 = y[:, k], y[:, k + 1], h * dy[:, k], h * dy[:, k + 1]
    rise = y1 - y0
    curve, bend = 3.0 * rise - 2.0 * d0 - d1, d0 + d1 - 2.0 * rise
    value = y0 + x * (d0 + x * (curve + x * bend))
    rate = (d0 + x * (2.0 * curve + 3.0 * x * bend)) / h
    return np.asarray(value), np.asarray(rate)


# ----------------------------------------------------------------------
# Residuals of simulated against estimated motion and their derivatives, for several logs at once.
#
# Unknowns are the parameters that are estimated, and what each log needs beside them:
#
#     offset_phi, offset_length      of the camera's plane, the same in all logs, small by their priors
#     delay                          of the measured rows; for logs with commands one for all, since there
#                                    it cannot be told from the pumps' dead time, else one for each log
#     phi, length                    before each log's first tick; of a log that begins in motion also
#                                    rates, creep and forces there, bounded by wide priors about a first guess
#
# The whitened residual of a row is r = W (measured - simulated(t - delay) - offset). Derivatives by
# parameters and starts are central differences, which a batch of simulations gives at once; those by the
# delays and offsets are exact.

CAMERA_DELAY_S = 0.025
"""Usual time from the exposure to the tick that reads the result."""

FAR = 1e3
"""Residual of a row that a candidate cannot reach at all."""

_OFFSET_SIGMA = (0.005, 0.0005)
_DELAY_SIGMA_S = 0.03
_STEP = 1e-4
_START_STEP = (1e-4, 1e-5, 1e-3, *(1e-4,) * 7)
_START_SCALE = (0.01, 0.001, 0.1, 0.005, 0.02, 0.02, *(0.05,) * 4)
_START_REACH = (0.3, 0.02, 30.0, 1.0, 2.0, 2.0, *(5.0,) * 4)
"""Steps, scales and bounds by `COMPONENTS`."""
_FREE_SIGMA = (3.0, 0.1, 0.2, 0.2)
_PUMPED_SIGMA = (0.5, 0.02, 0.2, 0.2, *(0.5,) * 4)
"""Priors of the same, without those of angle and length: of free swings and of logs with pumps."""


@dataclass(frozen=True)
class Unknowns:
    """Where the unknowns are and what is known of them before: parameters, offsets, delays, starts.

    Attributes
    ----------
    offset : of the camera's plane. delays : of each log. starts : of each log.
    scale, low, high : (size,) typical changes and bounds.
    mean, sigma : (size,) priors; an infinite deviation says nothing.
    """

    offset: slice
    delays: tuple[int, ...]
    starts: tuple[slice, ...]
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    sigma: FloatArray

    @property
    def size(self) -> int:
        return len(self.mean)

    @property
    def priors(self) -> IntArray:
        """Unknowns that have one, those of the parameters last."""
        some = np.flatnonzero(np.isfinite(self.sigma))
        return np.concatenate([some[some >= self.offset.start], some[some < self.offset.start]])


@dataclass(frozen=True)
class Problem:
    """Logs and what is estimated from them.

    Attributes
    ----------
    names : parameters that are estimated. held : values of others that differ from the nominal ones.
    delay_s : what is known of the rows' delay.
    stated : standard deviations of nominal values that a person states; zero for those that are exact.
    rough : for a search: steps of twice the length, differences to one side.
    """

    nominal: Machine
    tracks: Sequence[Track]
    names: tuple[str, ...]
    held: Mapping[str, float]
    delay_s: float = CAMERA_DELAY_S
    stated: Mapping[str, float] = field(default_factory=dict)
    rough: bool = False

    @property
    def per_tick(self) -> int:
        """Steps of a simulation in 1/60 s."""
        return _ROUGH_SUBSTEPS if self.rough else SUBSTEPS

    @cached_property
    def unknowns(self) -> Unknowns:
        """All unknowns. Logs with commands share a delay, swings have one each."""
        nominal, inf = values_of(self.nominal), math.inf
        rows = [
            (
                spec.scale,
                spec.low,
                spec.high,
                nominal[name],
                self.stated.get(name) or min(spec.sigma, spec.share * nominal[name]),
            )
            for name, spec in ((name, PARAMETERS[name]) for name in self.names)
        ]
        rows += [(sigma, -inf, inf, 0.0, sigma) for sigma in _OFFSET_SIGMA]
        delays: list[int] = []
        for k, track in enumerate(self.tracks):
            before = [
                at for at, one in zip(delays, self.tracks[:k], strict=True) if one.hoses and track.hoses
            ]
            delays.append(before[0] if before else len(rows))
            if not before:
                rows.append((0.01, self.delay_s - 0.5, self.delay_s + 0.5, self.delay_s, _DELAY_SIGMA_S))
        starts = []
        for track in self.tracks:
            at, moving = len(rows), track.moving is not None
            sigma = (inf, inf, *(_PUMPED_SIGMA if track.hoses else _FREE_SIGMA))
            of_start = zip(astuple(track.start), _START_SCALE, _START_REACH, sigma, strict=False)
            rows += [
                (scale, guess - reach, guess + reach, guess, deviation if moving else inf)
                for _, (guess, scale, reach, deviation) in zip(track.unknown, of_start, strict=False)
            ]
            starts.append(slice(at, len(rows)))
        count = len(self.names)
        return Unknowns(slice(count, count + 2), tuple(delays), tuple(starts), *np.array(rows).T)

    def values(self, x: FloatArray) -> dict[str, float]:
        """Parameters by name of a vector of unknowns."""
        return {**self.held, **dict(zip(self.names, x[: len(self.names)].tolist(), strict=True))}

    def pair(self, track: Track, values: Mapping[str, float]) -> tuple[Plant, Pump]:
        """Plant and pumps of a log with some parameters changed."""
        return made(self.nominal, values, track.hoses, track.tick_s)

    @property
    def spans(self) -> list[slice]:
        """Residuals of each log, angle and length of a picture side by side."""
        ends = np.cumsum([0, *(2 * len(track.t_s) for track in self.tracks)]).tolist()
        return [slice(begin, end) for begin, end in pairwise(ends)]


def first_guess(problem: Problem, values: Mapping[str, float]) -> FloatArray:
    """Unknowns with these parameters, offsets zero, usual delays, and starts as they were measured."""
    x = problem.unknowns.mean.copy()
    x[: len(problem.names)] = [values[name] for name in problem.names]
    return x


def start_of(problem: Problem, x: FloatArray, k: int) -> Start:
    """Start of a log in a vector of unknowns."""
    return Start(*x[problem.unknowns.starts[k]].tolist())


def head_of(problem: Problem, x: FloatArray, k: int, track: Track | None = None) -> FloatArray:
    """Angle and length (m, 2) at a log's rows, or at those of a track in its place, without the offsets."""
    track = problem.tracks[k] if track is None else track
    delay_s = float(x[problem.unknowns.delays[k]])
    head, _ = heads_of(track, [problem.pair(track, problem.values(x))], [start_of(problem, x, k)], delay_s)
    return np.asarray(head[0])


def _whitened(track: Track, error: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("mij,...mj->...mi", track.whitening, error))


def _priors(problem: Problem, x: FloatArray) -> FloatArray:
    u = problem.unknowns
    return np.asarray((x[u.priors] - u.mean[u.priors]) / u.sigma[u.priors])


def residuals(problem: Problem, xs: FloatArray) -> FloatArray:
    """Whitened residuals (sets, rows) of vectors of unknowns (sets, size), the priors' at the end.

    The rows are those of the logs in turn, angle and length of a picture side by side (before whitening).
    """
    unknowns, parts = problem.unknowns, []
    values = [problem.values(x) for x in xs]
    for k, track in enumerate(problem.tracks):
        pairs = [problem.pair(track, one) for one in values]
        starts = [start_of(problem, x, k) for x in xs]
        delay = unknowns.delays[k]
        # Candidates of one batch may differ in their delay; rates shift them to their own.
        middle = float(np.mean(xs[:, delay]))
        head, rate = heads_of(track, pairs, starts, middle, problem.per_tick)
        if np.ptp(xs[:, delay]) > 0.0:
            head = head - rate * (xs[:, delay] - middle)[:, None, None]
        error = track.head - head - xs[:, None, unknowns.offset]
        rows = _whitened(track, error).reshape(len(xs), -1)
        parts.append(np.where(np.isfinite(rows), rows, FAR))
    parts.append(np.stack([_priors(problem, x) for x in xs]))
    return np.concatenate(parts, axis=1)


def jacobian(problem: Problem, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (rows,) and their derivatives (rows, size) at a vector of unknowns."""
    unknowns, P = problem.unknowns, len(problem.names)
    steps = _STEP * np.maximum(np.abs(x[:P]), unknowns.scale[:P])
    up = np.minimum(x[:P] + steps, unknowns.high[:P])
    down = np.maximum(x[:P] - steps, unknowns.low[:P])
    start_steps = np.array(_START_STEP)
    if problem.rough:
        up, down = np.where(up - x[:P] >= x[:P] - down, up, down), x[:P]
    width = np.concatenate([up - down, start_steps if problem.rough else 2.0 * start_steps])
    sides = (1.0,) if problem.rough else (1.0, -1.0)
    base = problem.values(x)
    moved = [base]
    for name, *ends in zip(problem.names, up.tolist(), down.tolist(), strict=True):
        moved += [{**base, name: end} for end in ends[: len(sides)]]
    # Making a plant checks it, which takes as long as a short log: once for all logs of a kind.
    alike: dict[tuple[bool, float], list[tuple[Plant, Pump]]] = {}
    blocks, errors = [], []
    for k, track in enumerate(problem.tracks):
        begin = start_of(problem, x, k)
        kind = track.hoses, track.tick_s
        if kind not in alike:
            alike[kind] = [problem.pair(track, values) for values in moved]
        pairs, starts = alike[kind], [begin] * len(moved)
        count = len(track.unknown)
        for name, step in zip(track.unknown, _START_STEP, strict=False):
            starts += [replace(begin, **{name: getattr(begin, name) + s * step}) for s in sides]
        delay = unknowns.delays[k]
        pairs = pairs + pairs[:1] * (len(starts) - len(pairs))
        head, rate = heads_of(track, pairs, starts, float(x[delay]), problem.per_tick)
        W = track.whitening
        J = np.zeros((len(track.t_s), 2, unknowns.size))
        moved_to, moved_from = (head[1:], head[:1]) if problem.rough else (head[1::2], head[2::2])
        slope = (moved_to - moved_from) / width[: P + count, None, None]
        slope = -np.einsum("mij,smj->mis", W, slope)
        J[:, :, :P] = slope[:, :, :P]
        J[:, :, unknowns.starts[k]] = slope[:, :, P:]
        J[:, :, unknowns.offset] = -W
        J[:, :, delay] = _whitened(track, rate[0])
        error = _whitened(track, track.head - head[0] - x[unknowns.offset])
        good = np.isfinite(error).all() and np.isfinite(J).all()
        blocks.append(J.reshape(-1, unknowns.size) if good else np.zeros((2 * len(track.t_s), unknowns.size)))
        errors.append(np.where(np.isfinite(error), error, FAR).reshape(-1))
    at = unknowns.priors
    priors = np.zeros((len(at), unknowns.size))
    priors[np.arange(len(at)), at] = 1.0 / unknowns.sigma[at]
    return np.concatenate([*errors, _priors(problem, x)]), np.vstack([*blocks, priors])


# ----------------------------------------------------------------------
# Non-linear least squares over several logs, from several starts, with what cannot be told left out.
#
# A batch of candidates spread about the nominal rig costs little more than one, so the search begins with
# `CANDIDATES` of them; the best are refined by a trust region within bounds under a soft-L1 loss, which
# keeps frames with another thing in place of the marker from pulling.
#
# Which parameters are estimated is decided by the information the logs hold about them, everything else
# that is unknown eliminated (S, the Schur complement). In relative changes of the parameters:
#
# - two whose effects are the same up to a factor enter only as a product or ratio; the second is fixed;
# - one whose relative standard deviation would be above `VAGUE` is fixed at its nominal value. Where that is
#   more than `_CONTRARY` deviations away the logs tell at least that it is small, as a creep that the rig
#   does not have, and it is fixed where they have it: all others would make up for another value.
#
# Both are looked at where the search starts and again at the solution.

CANDIDATES = 32
_APART, _FASTER = 0.7, 2.0
"""Of the candidates' parameters, by their logarithms; of lags twice as much again towards fast pumps."""
VAGUE = 0.5
_SAME = 0.99995
_CONTRARY = 4.0
_BETTER = 0.9
"""Share of a cost that another law has to come below. Of three rigs each, .55 to .63 where it is the rig's,
1.9 to 2.2 where it is not, and 1.1 to 1.4 where pumps have a play, which neither knows."""
_SOFT = 2.0
_REFINED = 3
_ROUNDS = 4
_MOVES = 4.0

NO_CREEP = "no creep"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Solution:
    """A minimum.

    Attributes
    ----------
    problem : with the names that were estimated in the end. x : all unknowns.
    residual, J : whitened residuals and their derivatives there. cost : robust cost.
    fixed : sentences by parameter for what was left out.
    agreeing, starts : how many of the refined starts came to the same minimum.
    law : what is to be said of the pumps' model, where it is not the nominal one.
    """

    problem: Problem
    x: FloatArray
    residual: FloatArray
    J: FloatArray
    cost: float
    fixed: dict[str, str]
    agreeing: int
    starts: int
    law: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Estimated parameters by name."""
        return {name: float(v) for name, v in zip(self.problem.names, self.x, strict=False)}

    @cached_property
    def weights(self) -> FloatArray:
        """Weight of each residual (rows,) under the robust cost."""
        return weights(self.problem, self.residual)

    @cached_property
    def weighted(self) -> FloatArray:
        """The derivatives (rows, size) times the weights."""
        return self.J * self.weights[:, None]

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse of the information of all unknowns (size, size), for residuals of deviation one."""
        return scaled_inverse(self.weighted.T @ self.J)


def _robust(problem: Problem, r: FloatArray) -> FloatArray:
    """Cost of residuals (..., rows): soft-L1, of the priors the square, which nothing outruns."""
    rows = r.shape[-1] - len(problem.unknowns.priors)
    readings = _SOFT**2 * np.sum(np.sqrt(1.0 + (r[..., :rows] / _SOFT) ** 2) - 1.0, axis=-1)
    return np.asarray(readings + 0.5 * np.sum(r[..., rows:] ** 2, axis=-1))


def weights(problem: Problem, residual: FloatArray) -> FloatArray:
    """Weight of each residual (rows,) under that cost."""
    out = 1.0 / np.sqrt(1.0 + (residual / _SOFT) ** 2)
    out[len(residual) - len(problem.unknowns.priors) :] = 1.0
    return np.asarray(out)


def _compressed(problem: Problem, residual: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (size + 1,) and derivatives (size + 1, size) of the same robust cost and slope.

    A row r of the cost rho(r) counts as one of the size (2 rho)^(1/2). All that a search needs are the
    products of such columns, and their root holds them in few rows.
    """
    w = weights(problem, residual)
    # Of rho = s^2 ((1 + (r/s)^2)^(1/2) - 1) that root is r (2 w / (1 + w))^(1/2), w the weight.
    size = np.sqrt(2.0 * w / (1.0 + w))
    A = np.column_stack([J * (w / size)[:, None], size * residual])
    G = A.T @ A
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    power, V = np.linalg.eigh(G / np.outer(scale, scale))
    root = np.sqrt(np.maximum(power, 0.0))[:, None] * V.T * scale
    return root[:, -1], root[:, :-1]


_Minimum = tuple[FloatArray, float, FloatArray, FloatArray]
"""Unknowns, robust cost, residuals and derivatives."""


class _Enough(Exception):
    """A search has come as far as it was asked to."""


def solve(problem: Problem, x: FloatArray, most: int = 30, enough: float = -math.inf) -> _Minimum:
    """A minimum near x, or the first point of a cost below `enough`."""
    from scipy.optimize import least_squares

    unknowns = problem.unknowns
    low, high, scales = unknowns.low, unknowns.high, unknowns.scale
    begin = np.clip(x, low + 1e-9 * scales, high - 1e-9 * scales)
    seen: dict[bytes, tuple[FloatArray, ...]] = {}
    precision = 1e-5 if problem.rough else 1e-8

    def all_of(at: FloatArray) -> tuple[FloatArray, ...]:
        key = at.tobytes()
        if key not in seen:
            seen.clear()
            residual, J = jacobian(problem, at)
            seen[key] = residual, J, *_compressed(problem, residual, J)
        return seen[key]

    end = begin

    def rows(at: FloatArray) -> FloatArray:
        nonlocal end
        residual, _, few, _ = all_of(at)
        if _robust(problem, residual) < enough:
            end = at
            raise _Enough
        return few

    def slopes(at: FloatArray) -> FloatArray:
        return all_of(at)[3]

    with suppress(_Enough):
        end = least_squares(
            rows,
            begin,
            jac=slopes,
            bounds=(low, high),
            x_scale=scales,
            max_nfev=most,
            xtol=precision,
            ftol=precision,
            gtol=1e-10,
        ).x
    end = np.array(end, dtype=np.float64)
    residual, J, _, _ = all_of(end)
    return end, float(_robust(problem, residual)), residual, J


def informative(
    problem: Problem, residual: FloatArray, J: FloatArray, x: FloatArray, shared: Sequence[int] = ()
) -> FloatArray:
    """Information (P + s, P + s) about relative changes of the parameters, and about the s unknowns that are
    `shared` with other logs; all others are eliminated."""
    P = len(problem.names)
    # Relative changes of magnitudes, so that a product of a positive and a negative one is seen as such.
    size = np.copysign(np.maximum(np.abs(x[:P]), 0.1 * problem.unknowns.scale[:P]), x[:P])
    far = float(np.max(np.abs(residual), initial=0.0)) >= FAR
    w = np.ones(len(residual)) if far else weights(problem, residual)
    A = J * np.sqrt(w)[:, None]
    A[:, :P] *= size
    kept = [*range(P), *shared]
    return _eliminated(A.T @ A, kept, 1e-12)


def _eliminated(H: FloatArray, kept: list[int], floor: float) -> FloatArray:
    """Information about the unknowns that are kept, of that (n, n) about all."""
    gone = [k for k in range(len(H)) if k not in kept]
    own, mixed, rest = H[np.ix_(kept, kept)], H[np.ix_(kept, gone)], H[np.ix_(gone, gone)]
    return np.asarray(own - mixed @ scaled_inverse(rest, floor) @ mixed.T)


def _left_out(
    problem: Problem, S: FloatArray, held: Mapping[str, float], x: FloatArray
) -> tuple[str, str, float] | None:
    """A parameter that the logs cannot tell, why, and the value that it keeps, mostly the held one."""
    names = problem.names
    size = np.sqrt(np.maximum(np.diag(S), 0.0))
    for k, name in enumerate(names):
        if size[k] < 1e-6 * max(float(size.max(initial=0.0)), 1e-300) or size[k] < 1.0 / VAGUE / 10.0:
            return name, "the logs do not depend on it", held[name]
    cosine = S / np.outer(size, size)
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if abs(cosine[i, j]) > _SAME:
                how = "a product" if cosine[i, j] > 0.0 else "a ratio"
                if not 0.99 < size[i] / size[j] < 1.01:
                    how = "one combination"
                sentence = f"{label_of(names[i])} and {label_of(names[j])} enter only as {how}"
                return names[j], sentence, held[names[j]]
    sigma = np.sqrt(np.maximum(np.diag(np.linalg.pinv(cosine, rcond=1e-10)), 0.0)) / size
    worst = int(np.argmax(sigma))
    if not sigma[worst] > VAGUE:
        return None
    name, value = names[worst], float(x[worst])
    away = abs(held[name] - value) / (sigma[worst] * max(abs(value), 0.1 * PARAMETERS[name].scale))
    sentence = f"the logs tell it to {100.0 * sigma[worst]:.0f} % only"
    if away > _CONTRARY:
        return name, f"{sentence}, and that it is not {held[name]:.4g}", value
    return name, sentence, held[name]


def _pruned(
    problem: Problem, x: FloatArray, residual: FloatArray, J: FloatArray, fixed: dict[str, str]
) -> tuple[Problem, FloatArray, FloatArray]:
    """The problem without what cannot be told, its unknowns and derivatives."""
    known = {**values_of(problem.nominal), **problem.held}
    while problem.names:
        found = _left_out(problem, informative(problem, residual, J, x), known, x)
        if found is None:
            break
        name, sentence, value = found
        k = problem.names.index(name)
        fixed[name] = f"{sentence}; kept at {value:.4g}"
        held = problem.held if value == known[name] else {**problem.held, name: value}
        problem = replace(problem, names=tuple(n for n in problem.names if n != name), held=held)
        moves = abs(value - x[k]) > 1e-2 * PARAMETERS[name].scale
        x, J = np.delete(x, k), np.delete(J, k, axis=1)
        if moves:
            # The others have to follow before more is said of them.
            break
    return problem, x, J


def _blind(fixed: Mapping[str, str]) -> BadInputError:
    names = ", ".join(label_of(name) for name in fixed if name != "lambda3")
    if not names:
        return BadInputError(
            "identify: nothing is left to identify: all that these logs could tell is fixed by `known`; "
            "expected a parameter that is not stated"
        )
    return BadInputError(
        f"identify: these logs cannot tell any parameter ({names}); expected logs in which the rig moves"
    )


def _moves(track: Track) -> bool:
    """Whether some second of a log shows more than the noise does; single far readings do not count."""
    z = np.einsum("mij,mj->mi", track.whitening, track.head - np.median(track.head, axis=0))
    power = np.minimum(np.mean(z * z, axis=1), 25.0)
    rows = max(round(1.0 / max(float(np.median(np.diff(track.t_s))), 1e-3)), 5)
    mean = np.convolve(power, np.full(rows, 1.0 / rows), mode="valid")
    return bool(len(mean) and float(mean.max()) > _MOVES)


def _spread(problem: Problem, values: Mapping[str, float]) -> FloatArray:
    """Candidates (`CANDIDATES`, size) about the nominal rig, itself the first."""
    rng = np.random.default_rng(0)
    x = first_guess(problem, values)
    out = np.tile(x, (CANDIDATES, 1))
    P = len(problem.names)
    apart = rng.uniform(-_APART, _APART, (CANDIDATES - 1, P))
    if "lag_s" in problem.names:
        at = problem.names.index("lag_s")
        apart[:, at] = _FASTER * (apart[:, at] - _APART) + apart[:, at]
    out[1:, :P] *= np.exp(apart)
    u = problem.unknowns
    out[:, :P] = np.clip(out[:, :P], u.low[:P] * 1.001, u.high[:P] * 0.999)
    return out


def fit_tracks(
    nominal: Machine,
    tracks: Sequence[Track],
    static_map: bool = False,
    delay_s: float = CAMERA_DELAY_S,
    progress: Progress | None = None,
    stated: Mapping[str, float] | None = None,
    either_law: bool = False,
) -> Solution:
    """Estimate all parameters that these logs can tell.

    Parameters
    ----------
    nominal : what is not estimated, and where the search starts.
    static_map : see `candidates`.
    delay_s : of the measured rows, as far as it is known.
    stated : standard deviations of the values in `nominal` that a person states; zero fixes a value.
    either_law : whether an orifice may take the place of a limited rate, as the law of deflation.

    Raises
    ------
    BadInputError without logs; when no parameter can be told, with the reason for each.
    """
    if not tracks:
        raise BadInputError("identify: found no log, expected at least one")
    free, pumps = any(not t.hoses for t in tracks), any(t.hoses for t in tracks)
    names = candidates(nominal, free, pumps, static_map, stated)
    l1, _, l3 = nominal.plant.creep_rates
    if not l3 < 0.0 < l1 and set(CREEP) & set(names):
        raise BadInputError(
            "actuator: found creep that is not passive to start from, expected lambda1 > 0 > lambda3"
        )
    if not any(_moves(track) for track in tracks):
        raise _blind(dict.fromkeys(names, "the rig does not move"))
    known = values_of(nominal)
    problem = Problem(nominal, tracks, names, {}, delay_s, stated or {})
    fixed: dict[str, str] = {}
    x = first_guess(problem, known)
    residual, J = jacobian(problem, x)
    # Where the search starts nothing fits yet: all rows count alike there.
    problem, x, J = _pruned(problem, x, np.zeros_like(residual), J, fixed)
    if not problem.names:
        raise _blind(fixed)
    best, agreeing, refined = _search(problem, known, progress)
    problem, best = _all_told(problem, best, fixed)
    if not problem.names:
        raise _blind(fixed)
    x, cost, residual, J = best
    found = Solution(problem, x, residual, J, cost, fixed, agreeing, refined)
    if not _explained(found):
        first, found = found, _by_the_better_law(found) if either_law else found
        found = _with_play(found) if found is first or not _explained(found) else found
    return _without_creep(found)


def _all_told(problem: Problem, best: _Minimum, fixed: dict[str, str]) -> tuple[Problem, _Minimum]:
    """The problem without what its minimum shows that the logs cannot tell, and its minimum then."""
    for _ in range(_ROUNDS):
        x, _, residual, J = best
        smaller, x, J = _pruned(problem, x, residual, J, fixed)
        if smaller.names == problem.names:
            break
        problem = smaller
        if not problem.names:
            break
        best = solve(problem, x)
    return problem, best


def _explained(solution: Solution) -> bool:
    """Whether the residuals of all logs with pumps are white: nothing is left for another model of them."""
    return all(
        colour.white
        for colour, track in zip(colour_of(solution), solution.problem.tracks, strict=True)
        if track.hoses
    )


def _reopened(solution: Solution) -> tuple[set[str], dict[str, str]]:
    """Names to estimate by another model, and sentences on those that stay fixed.

    What could not be told by the wrong model may be by the right one.
    """
    fixed = {name: why for name, why in solution.fixed.items() if "enter only" in why}
    return {*solution.problem.names, *solution.fixed} - {*fixed}, fixed


def _ordered(names: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name in PARAMETERS if name in names)


def _with_play(solution: Solution) -> Solution:
    """The solution, or that with a play of the pumps where it explains the logs far better."""
    problem = solution.problem
    if {*_PLAYS} & {*problem.names, *problem.stated}:
        return solution
    names, fixed = _reopened(solution)
    known = values_of(problem.nominal)
    # Without a play others have made up for it: creep, and a lag that grew.
    bases = known, {**known, **problem.held, **solution.values}
    tried = []
    for name, widths in _PLAYS.items():
        rough = replace(problem, names=_ordered(names | {name}), held={}, rough=True)
        values = [{**base, name: width} for base in bases for width in widths]
        starts = np.array([_moved(solution, rough, one) for one in values])
        best = int(np.argmin(_robust(rough, residuals(rough, starts))))
        tried.append((solve(rough, starts[best], 25)[1], name, values[best]))
    cost, name, begin = min(tried, key=lambda one: one[0])
    if not cost < _BETTER * solution.cost:
        return solution
    found = _again(solution, replace(problem, names=_ordered(names | {name}), held={}), begin, fixed)
    if not found.cost < _BETTER * solution.cost or name not in found.values:
        return solution
    width = f"{label_of(name)} of {found.values[name]:.3g} {PARAMETERS[name].unit}"
    law = f"a {width} leaves {100.0 * found.cost / solution.cost:.0f} % of the misfit"
    return replace(found, law="; ".join(one for one in (solution.law, law) if one))


def _by_the_better_law(solution: Solution) -> Solution:
    """The solution with a limited rate, or that with an orifice where it explains the logs far better."""
    problem = solution.problem
    limited, orifice = {"falling_N_per_s"}, {"laminar_s", "turbulent_s2_per_N"}
    # Under the wrong law the rate may not have been told at all.
    names, fixed = _reopened(solution)
    if not limited <= names or (limited | orifice) & {*problem.stated}:
        return solution
    nominal = replace(problem.nominal, pump=replace(problem.nominal.pump, deflation=Orifice()))
    other = replace(problem, nominal=nominal, names=_ordered((names - limited) | orifice), held={})
    known = values_of(nominal)
    near = {**known, **problem.held, **solution.values}
    rough = replace(other, rough=True)
    # The wrong law may have bent the forces so far that no way leads back.
    bases = near, known
    if not min(solve(rough, _moved(solution, rough, one), 25)[1] for one in bases) < solution.cost:
        return solution
    best = min((_again(solution, other, one, fixed) for one in bases), key=lambda one: one.cost)
    if not best.cost < _BETTER * solution.cost:
        return solution
    share = f"{100.0 * best.cost / solution.cost:.0f} %"
    law = f"air leaves by an orifice, which leaves {share} of the misfit (known: pump: deflation decides)"
    return replace(best, law=law)


def _again(
    solution: Solution, problem: Problem, values: Mapping[str, float], fixed: Mapping[str, str]
) -> Solution:
    """The minimum of another problem with the same logs, from values and the solution's starts and delays."""
    why = dict(fixed)
    coarse = _coarse(problem)
    found, *_ = solve(coarse, _moved(solution, coarse, values), 25)
    starts = np.array([_moved(solution, problem, values), _whole(problem, coarse, found)])
    minimum = solve(problem, starts[int(np.argmin(_robust(problem, residuals(problem, starts))))], 40)
    told, (x, cost, residual, J) = _all_told(problem, minimum, why)
    return Solution(told, x, residual, J, cost, why, solution.agreeing, solution.starts, solution.law)


def _moved(solution: Solution, problem: Problem, values: Mapping[str, float]) -> FloatArray:
    """Unknowns of another problem with the same logs: these parameters, the rest from the solution."""
    x = first_guess(problem, values)
    x[len(problem.names) :] = solution.x[len(solution.problem.names) :]
    return x


def _without_creep(solution: Solution) -> Solution:
    """The solution, or where its creep is doubtful that with the usual one or, if logs contradict it, none.

    A rig without creep leaves its rate open: it runs to a bound, where creep is a damper, or is left out, and
    what stays of the creep bends stiffness and damping.
    """
    problem, rate, spring = solution.problem, "lambda1_per_s", "lambda2_N_per_m"
    doubtful = {rate, spring} & {*solution.fixed} or any(label_of(rate) in one for one in _bounds(solution))
    if not doubtful or {*CREEP} & {*problem.stated}:
        return solution
    known = values_of(problem.nominal)
    names, fixed = _reopened(solution)
    names -= {*CREEP}

    def found(stiffness: float, why: dict[str, str]) -> Solution:
        held = {spring: stiffness}
        other = replace(problem, names=_ordered(names), held=held)
        # Swings lock to springs that are off by a turn, and a creep that runs away takes the springs along.
        starts = known, {**known, **solution.values}
        found = (_again(solution, other, values, fixed | why) for values in starts)
        return min(found, key=lambda one: one.cost)

    damping = "the logs do not tell it from damping; kept at"
    usual = found(known[spring], {name: f"{damping} {known[name]:.4g}" for name in (rate, spring)})
    least = PARAMETERS[spring].low
    none = found(least, {spring: f"the logs show {NO_CREEP}; kept at {least:g}"})
    scale = robust_sigma(none.residual)
    contradicted = usual.cost - none.cost > 0.5 * (_CONTRARY * scale) ** 2
    plainer = none if contradicted else usual
    return plainer if plainer.cost < _alike(solution.cost) else solution


def _coarse(problem: Problem) -> Problem:
    """The problem for a search: rough, and what is known beforehand stays at that.

    Far from a minimum readings outweigh all priors. A search that may leave them ends far along a valley, in
    which it hardly comes back: all forces and the mass may grow together, and the springs with their length.
    """
    of = list(zip(problem.names, problem.unknowns.mean.tolist(), problem.unknowns.sigma, strict=False))
    given = {name: mean for name, mean, sigma in of if math.isfinite(sigma)}
    names = tuple(name for name in problem.names if name not in given)
    return replace(problem, names=names, held={**problem.held, **given}, rough=True)


def _whole(problem: Problem, coarse: Problem, x: FloatArray) -> FloatArray:
    """Unknowns of a problem from those of its coarse one."""
    out = first_guess(problem, coarse.values(x))
    out[len(problem.names) :] = x[len(coarse.names) :]
    return out


def _search(
    problem: Problem, known: Mapping[str, float], progress: Progress | None
) -> tuple[_Minimum, int, int]:
    """The best of several refined starts, how many agree with it, and of how many."""
    rough = _coarse(problem)
    spread = _spread(rough, known)
    order = np.argsort(_robust(rough, residuals(rough, spread)), kind="stable")[:_REFINED].tolist()
    if 0 not in order:
        order.append(0)
    best, costs, limit = spread[0], list[float](), math.inf
    for done, k in enumerate(order):
        if progress is not None:
            progress(done, len(order) + 1)
        # A start that comes near the best minimum so far leads there: it needs no end of its own.
        x, cost, _, _ = solve(rough, spread[k], 25, limit if done else -math.inf)
        if not costs or cost < min(costs):
            best, limit = x, _alike(cost)
        costs.append(cost)
    final = solve(problem, _whole(problem, rough, best), 40)
    agreeing = sum(cost <= _alike(min(costs)) for cost in costs)
    return final, agreeing, len(order) if math.isfinite(final[1]) else 0


def _alike(cost: float) -> float:
    """Robust cost below which a search has come to the minimum of this cost."""
    return 1.01 * cost + 3.0


# ----------------------------------------------------------------------
# What a fit is worth: standard deviations, correlation, whiteness of residuals, and a log held back.
#
# With weighted derivatives J and information H = J^T J of all unknowns, priors included, white residuals of
# variance s^2 would give the covariance s^2 H^-1. Those of a camera with coarse pixels, and of a model that
# is not quite right, are coloured. Then the sandwich
#
#     H^-1 (sum_k w_k sum_i g_i g_(i+k)^T) H^-1,   g_i the gradient of row i, w_k = 1 - |k| / (L + 1)
#
# (Newey and West) holds, with lags L of a third of a second or, where residuals stay alike for longer, up to
# the first at which they do not. It scatters itself, so of it and the white one the larger variance is taken
# for each parameter; their ratio says how far colour has inflated it.
#
# Both hold for a model that is right in the mean. One of another structure, as of a rig with dry friction or
# hysteresis, fits each stretch of a log with other parameters. With the information H_s and the gradient g_s
# of a stretch, parameter i of it alone is off by d = -g_s,i / h, h = (H_s - H_s H^-1 H_s)_ii, all others
# following, with the variance 1 / h, raised as above. Where these scatter by more, their variance T_i
# between stretches (DerSimonian and Laird) is added: that of another stretch, and that of the fit,
#
#     T + sum_s sum_i T_i (H^-1 H_s e_i) (H^-1 H_s e_i)^T.

_SPAN_S, _LONGEST_S = 0.35, 10.0
_STRETCHES = 5
"""Of each log: a swing that has died away within two thirds of its log is told in three."""
_SCATTERS = 0.01
"""Probability of such a scatter by chance, below which it is believed."""
_LAGS = 20
_BAND = 1.96
"""Of the correlation of white residuals, over the root of their number."""


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations and correlation of the estimated parameters.

    Attributes
    ----------
    sigma : by name. covariance, correlation : (P, P).
    inflation : by name, how much colour has raised it. scatter : by name, how much on top of that has what
    stretches of the logs disagree on.
    scale : robust standard deviation of the whitened residuals, 1 for a perfect model and noise.
    """

    sigma: dict[str, float]
    inflation: dict[str, float]
    scatter: dict[str, float]
    covariance: FloatArray
    correlation: FloatArray
    scale: float


@dataclass(frozen=True)
class Colour:
    """Whiteness of one log's residuals.

    Attributes
    ----------
    first : correlation with the next row, of angle and length. outside : share of `_LAGS` lags that are
    beyond the 95 % band of white noise, which is about 0.05 then. share_far : rows with a weight below 1/3.
    """

    name: str
    first: tuple[float, float]
    outside: float
    share_far: float

    @property
    def white(self) -> bool:
        """Whether hardly more lags than chance allows are outside."""
        return self.outside <= 0.15


@dataclass(frozen=True)
class HeldLog:
    """RMS of angle [rad] and length [m] on a log, fitted and held back.

    `chance` is the probability that the other logs fit this much worse with the parameters of all logs than
    with their own, where one model makes them all.
    """

    name: str
    fitted_phi_rad: float
    fitted_length_m: float
    held_phi_rad: float
    held_length_m: float
    chance: float


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Of a log's residuals (rows,), of angle and length (lags, 2) from lag 1 on; far ones are cut."""
    r = residual.reshape(-1, 2)
    z = np.clip(r / np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9), -3.0, 3.0)
    z = z - z.mean(axis=0)
    power = np.maximum(np.sum(z * z, axis=0), 1e-12)
    return np.array([np.sum(z[k:] * z[:-k], axis=0) / power for k in range(1, lags + 1)]).reshape(-1, 2)


def uncertainty(solution: Solution) -> Uncertainty:
    """Covariance of the parameters, the larger of the white one and the sandwich."""
    problem, r, J, w = solution.problem, solution.residual, solution.J, solution.weights
    P, spans = len(problem.names), problem.spans
    rows = spans[-1].stop
    scale = max(robust_sigma(r[:rows]), 1e-9)
    # The prior is known, the scale of the residuals is not.
    size = np.concatenate([np.full(rows, 1.0 / scale**2), np.ones(len(r) - rows)])
    H = (J * (w * size)[:, None]).T @ J
    inverse = scaled_inverse(H)
    middle = (J[rows:]).T @ J[rows:]
    for track, span in zip(problem.tracks, spans, strict=True):
        g = (J[span] * (w * size * r)[span, None]).reshape(-1, 2, J.shape[1]).sum(axis=1)
        period = float(np.median(np.diff(track.t_s))) if len(track.t_s) > 1 else track.tick_s
        rows_of_s = 1.0 / max(period, 1e-4)
        c = autocorrelation(r[span], min(round(_LONGEST_S * rows_of_s), len(g) // 4))
        apart = np.flatnonzero((c < _BAND / math.sqrt(len(g))).all(axis=1))
        alike = int(apart[0]) if len(apart) else len(c)
        over = 1 + min(max(round(_SPAN_S * rows_of_s), alike, 1), len(g) // 4)
        # Sums over all windows of a length have Bartlett's weights of the lags below it.
        total = np.cumsum(np.pad(g, ((over, over - 1), (0, 0))), axis=0)
        windows = total[over:] - total[:-over]
        middle = middle + windows.T @ windows / over
    # With far rows weighted down, the mean of w r^2 stands for the scale of the others.
    sandwich = (inverse @ middle @ inverse)[:P, :P]
    spread = float(np.mean((w * r**2)[:rows])) / scale**2
    white = inverse[:P, :P] * max(spread, 1.0)
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(white), 1e-300), 1.0))
    coloured = white * np.outer(ratio, ratio)
    between = _between(solution, w * size, inverse, ratio)
    covariance = coloured + between
    scatter = np.sqrt(1.0 + np.diag(between) / np.maximum(np.diag(coloured), 1e-300))
    # What moves no residual at all is not known exactly, but not at all.
    sigma = np.where(np.diag(H)[:P] > 0.0, np.sqrt(np.diag(covariance)), np.inf)
    return Uncertainty(
        dict(zip(problem.names, sigma.tolist(), strict=True)),
        dict(zip(problem.names, ratio.tolist(), strict=True)),
        dict(zip(problem.names, scatter.tolist(), strict=True)),
        covariance,
        covariance / np.outer(sigma, sigma),
        scale,
    )


def _between(solution: Solution, w: FloatArray, inverse: FloatArray, raised: FloatArray) -> FloatArray:
    """Covariance (P, P) of the parameters by what stretches of the logs disagree on.

    Parameters
    ----------
    w : (rows,) weights of the residuals. inverse : H^-1 of all unknowns.
    raised : (P,) by how much colour raises deviations.
    """
    from scipy.special import chdtrc

    problem, P = solution.problem, len(solution.problem.names)
    matrices, slopes = [], []
    for track, span in zip(problem.tracks, problem.spans, strict=True):
        J, r, some = solution.J[span], solution.residual[span], w[span]
        ends = np.linspace(track.t_s[0], track.t_s[-1], _STRETCHES + 1)[1:-1]
        stretch = np.repeat(np.searchsorted(ends, track.t_s, side="right"), 2)
        for k in range(_STRETCHES):
            rows = stretch == k
            WJ = J[rows] * some[rows, None]
            matrices.append(WJ.T @ J[rows])
            slopes.append(WJ.T @ r[rows])
    H, g = np.array(matrices), np.array(slopes)
    whole = np.einsum("sii->si", H)[:, :P]
    by = np.einsum("ij,sjp->sip", inverse, H[:, :, :P])
    own = whole - np.einsum("sip,sip->sp", H[:, :, :P], by)
    pull = g[:, :P] - np.einsum("sip,i->sp", by, g.sum(axis=0))
    out = np.zeros((P, P))
    for i in range(P):
        told = own[:, i] > 1e-6 * np.maximum(whole[:, i], 1e-300)
        count, h = int(told.sum()), own[told, i] / raised[i] ** 2
        if count < 2:
            continue
        Q = float(np.sum((pull[told, i] / own[told, i]) ** 2 * h))
        if chdtrc(count, Q) > _SCATTERS:
            continue
        # What is the same in all runs cannot be further off than a person states.
        T = min((Q - count) / (h.sum() - np.sum(h**2) / h.sum()), problem.unknowns.sigma[i] ** 2)
        out[i, i] += T
        out += T * by[:, :P, i].T @ by[:, :P, i]
    return out


def colour_of(solution: Solution) -> tuple[Colour, ...]:
    """Whiteness of each log's whitened residuals, rows that are far off cut at three deviations."""
    out = []
    for track, span in zip(solution.problem.tracks, solution.problem.spans, strict=True):
        r = solution.residual[span].reshape(-1, 2)
        far = float(np.mean((solution.weights[span].reshape(-1, 2) < 1.0 / 3.0).any(axis=1)))
        c = autocorrelation(r, min(_LAGS, max(len(r) - 2, 1)))
        out.append(
            Colour(
                track.name,
                (float(c[0, 0]), float(c[0, 1])),
                float(np.mean(np.abs(c) > _BAND / math.sqrt(len(r)))),
                far,
            )
        )
    return tuple(out)


def rms_by_track(problem: Problem, residual: FloatArray, far: float = 6.0) -> list[tuple[float, float]]:
    """RMS of angle [rad] and length [m] of each log, rows beyond so many deviations left out."""
    out = []
    for track, span in zip(problem.tracks, problem.spans, strict=True):
        r = residual[span].reshape(-1, 2)
        size = np.maximum(1.4826 * np.median(np.abs(r)), 1e-9)
        near = (np.abs(r) < far * size).all(axis=1)
        error = np.linalg.solve(track.whitening[near], r[near][:, :, None])[:, :, 0]
        phi, length = np.sqrt(np.mean(error**2, axis=0)).tolist()
        out.append((phi, length))
    return out


def held_back(solution: Solution) -> list[HeldLog]:
    """Each log predicted by a fit to all others; empty for a single one.

    Of the log that is held back only its start, delay and the camera's offset are estimated. A log that
    alone tells a parameter keeps the others from telling it; that one stays as it was found.
    """
    from scipy.special import chdtrc

    problem = solution.problem
    if len(problem.tracks) < 2:
        return []
    inside = rms_by_track(problem, solution.residual)
    found = {**problem.held, **solution.values}
    known, out = uncertainty(solution), []
    raised = known.scale * max(known.inflation.values(), default=1.0)
    for k, (x, told, gain) in enumerate(_without_each(solution)):
        track = problem.tracks[k]
        alone = replace(problem, tracks=[track], names=(), held={**found, **problem.values(x)})
        _, _, residual, _ = solve(alone, x[_places(problem, alone)], 15)
        (phi, length) = rms_by_track(alone, residual)[0]
        worse = max(2.0 * gain / raised**2, 0.0)
        out.append(HeldLog(track.name, *inside[k], phi, length, float(chdtrc(told, worse))))
    return out


_CHORDS = 20
_NEAR = 0.05
"""Relative change of a parameter within which the derivatives of the fit to all logs serve."""
_STILL = 1e-4
"""Robust cost: a step that would gain less is not taken."""


def _without_each(solution: Solution) -> list[tuple[FloatArray, int, float]]:
    """For each log the fit to all others: all unknowns, how many parameters it tells, cost that it gains.

    It lies near the fit to all logs, so the derivatives there serve (a chord method), and one batch of
    simulations moves the fits of all logs at once. One that does not come to rest nearby is sought by itself.
    """
    problem, tracks, J = solution.problem, solution.problem.tracks, solution.J
    u, priors, count = problem.unknowns, problem.unknowns.priors, len(solution.problem.tracks)
    free, kept = np.ones((count, u.size), dtype=bool), np.ones((count, len(J)), dtype=bool)
    for k, span in enumerate(problem.spans):
        kinds = {track.hoses for i, track in enumerate(tracks) if i != k}
        free[k, : len(problem.names)] = [_told_by(name, kinds) for name in problem.names]
        free[k, u.starts[k]] = False
        free[k, u.delays[k]] = u.delays.count(u.delays[k]) > 1
        kept[k, span], kept[k, len(J) - len(priors) :] = False, free[k, priors]
    weighted = solution.weighted
    whole = weighted.T @ J
    curved = [whole - weighted[~rows].T @ J[~rows] for rows in kept]
    xs, residual = np.tile(solution.x, (count, 1)), np.tile(solution.residual, (count, 1))
    first = _robust(problem, residual * kept)
    cost = first.copy()
    going = np.ones(count, dtype=bool)
    rested = ~going
    for _ in range(_CHORDS):
        to = xs.copy()
        for k in np.flatnonzero(going).tolist():
            slope = J.T @ (weights(problem, residual[k]) * residual[k] * kept[k])
            step, gain = _step_within(curved[k], slope, free[k], u.low - xs[k], u.high - xs[k])
            to[k] += step
            rested[k] = gain < _STILL
        going &= ~rested
        at = np.flatnonzero(going)
        if not len(at):
            break
        found = residuals(problem, to[at])
        after = _robust(problem, found * kept[at])
        going[at] = after < cost[at]
        better = at[going[at]]
        xs[better], residual[better], cost[better] = to[better], found[going[at]], after[going[at]]
    size = np.maximum(np.abs(solution.x), u.scale)[: len(problem.names)]
    near = (np.abs(xs - solution.x)[:, : len(problem.names)] < _NEAR * size).all(axis=1)
    for k in np.flatnonzero(~(rested & near)).tolist():
        others = [track for i, track in enumerate(tracks) if i != k]
        names = tuple(name for name, told in zip(problem.names, free[k], strict=False) if told)
        less = replace(problem, tracks=others, names=names, held={**problem.held, **solution.values})
        places = _places(problem, less)
        first[k] = _robust(less, residuals(less, solution.x[places][None]))[0]
        xs[k, places], cost[k], _, _ = solve(less, xs[k, places], 15)
    told = free[:, : len(problem.names)].sum(axis=1).tolist()
    return list(zip(xs, told, (first - cost).tolist(), strict=True))


def _step_within(
    H: FloatArray, slope: FloatArray, free: BoolArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, float]:
    """The step to the minimum of a quadratic cost over what is free and stays within bounds, and its gain."""
    free = free.copy()
    while True:
        at = np.flatnonzero(free)
        step = np.zeros(len(slope))
        step[at] = -scaled_inverse(H[np.ix_(at, at)]) @ slope[at]
        outside = (step < low) | (step > high)
        if not outside.any():
            return step, float(-0.5 * slope @ step)
        free &= ~outside


def _places(problem: Problem, part: Problem) -> IntArray:
    """Where the unknowns of a problem with some of the logs are among those of the one with all."""
    whole, mine = problem.unknowns, part.unknowns
    out = np.empty(mine.size, dtype=np.int64)
    out[: len(part.names)] = [problem.names.index(name) for name in part.names]
    out[mine.offset] = range(whole.offset.start, whole.offset.stop)
    of_track = {id(track): k for k, track in enumerate(problem.tracks)}
    for k, track in enumerate(part.tracks):
        at = of_track[id(track)]
        out[mine.starts[k]] = range(whole.starts[at].start, whole.starts[at].stop)
        out[mine.delays[k]] = whole.delays[at]
    return out


def _told_by(name: str, kinds: set[bool]) -> bool:
    acts = PARAMETERS[name].acts
    return acts in ("all", "prior") or (acts == "pumps") in kinds


# ----------------------------------------------------------------------
# Damping by the logarithmic decrement (3.39), (3.40), from peaks that outliers do not make.
#
# Single readings that stand away from the cubic through their six neighbours are replaced by it. The
# extremes of what is left are found once the motion has come back by a fifth of its amplitude, so that
# noise makes none, and each is the vertex of a parabola through the rows about it. The amplitude is that from
# peak to peak, which does not see an offset that creeps; on the raw curve (3.39) yields about 0.004.
#
#     delta = ln(x_i / x_(i+1)) over a period,   zeta = delta / sqrt(4 pi^2 + delta^2)
#
# delta is the median of the slopes between all pairs of amplitudes (Theil and Sen), with the standard
# deviation that the scatter about that line gives.

_HALF_WINDOW = 3
_FAR = 4.0
_FEWEST = 4
_FLOOR = 10.0
_LARGEST_SHARE = 0.1


@dataclass(frozen=True)
class Decrement:
    """A decaying swing.

    Attributes
    ----------
    zeta, sigma : damping ratio and its standard deviation. frequency_hz : of the swing.
    peak_at_s, peak : (n,) extremes that were used. outliers : readings that were replaced.
    """

    zeta: float
    sigma: float
    frequency_hz: float
    peak_at_s: FloatArray
    peak: FloatArray
    outliers: int


def without_outliers(values: FloatArray) -> tuple[FloatArray, int]:
    """Values (n,) with single ones that stand away from their neighbours replaced, and how many."""
    n = len(values)
    at = np.clip(np.arange(n)[:, None] + np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1), 0, n - 1)
    # A cubic through the other rows of the window follows a swing, which a median does not.
    x = np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1, dtype=np.float64)
    others = np.delete(np.arange(2 * _HALF_WINDOW + 1), _HALF_WINDOW)
    V = np.vander(x[others], 4)
    mid = np.linalg.pinv(V)[-1]
    guess = values[at][:, others] @ mid
    error = values - guess
    scale = robust_sigma(error)
    # A cubic misses a tenth of a fast swing's window.
    local = np.ptp(values[at][:, others], axis=1)
    far = np.abs(error) > np.maximum(np.maximum(_FAR * scale, 0.25 * local), 1e-12)
    # Of neighbours that all look wrong only the worst is.
    worst = np.abs(error) >= np.abs(error)[at].max(axis=1) - 1e-15
    bad = far & worst
    out = values.copy()
    out[bad] = guess[bad]
    return out, int(bad.sum())


def _turns(y: FloatArray, share: float) -> IntArray:
    """Rows of the extremes, each confirmed by a return of `share` times the swing before it."""
    found: list[int] = []
    top = low = 0
    direction = 0
    swing = float(np.ptp(y[: max(len(y) // 8, 8)]))
    for i in range(1, len(y)):
        if y[i] > y[top]:
            top = i
        if y[i] < y[low]:
            low = i
        back = share * swing
        if direction >= 0 and y[top] - y[i] > back:
            found.append(top)
            swing = abs(float(y[top] - y[found[-2]])) if len(found) > 1 else swing
            direction, low = -1, i
            top = i
        elif direction <= 0 and y[i] - y[low] > back:
            found.append(low)
            swing = abs(float(y[low] - y[found[-2]])) if len(found) > 1 else swing
            direction, top = 1, i
            low = i
    return np.array(found, dtype=np.int64)


def _vertex(t: FloatArray, y: FloatArray, i: int, reach: int) -> tuple[float, float]:
    a, b = max(i - reach, 0), min(i + reach + 1, len(y))
    if b - a < 3:
        return float(t[i]), float(y[i])
    c = np.polyfit(t[a:b] - t[i], y[a:b], 2)
    if c[0] == 0.0:
        return float(t[i]), float(y[i])
    at = float(np.clip(-0.5 * c[1] / c[0], t[a] - t[i], t[b - 1] - t[i]))
    return float(t[i]) + at, float(np.polyval(c, at))


def _regular(t: FloatArray, y: FloatArray, at: FloatArray, peak: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Extremes where their neighbours say that they are.

    A vertex that is sought among noisy readings is too high, the more so the smaller the swing. The times of
    the extremes go smoothly, so that of each follows from all, and a parabola about it gives its height.
    """
    k = np.arange(len(at), dtype=np.float64)
    big = np.concatenate([[True], np.abs(np.diff(peak)) > 0.1 * np.abs(np.diff(peak)).max()])
    count = len(big) if bool(big.all()) else max(int(np.argmin(big)), _FEWEST)
    smooth = np.polyval(np.polyfit(k[:count], at[:count], 2 if count > 5 else 1), k[:count])
    half = float(np.median(np.diff(smooth)))
    if float(np.abs(smooth - at[:count]).max()) > 0.3 * half:
        return at, peak
    heights = peak[:count].copy()
    for i, centre in enumerate(smooth.tolist()):
        near = np.abs(t - centre) <= 0.32 * half
        if int(near.sum()) >= 4:
            heights[i] = np.polyval(np.polyfit(t[near] - centre, y[near], 2), 0.0)
    return np.asarray(smooth, dtype=np.float64), heights


def decrement(t_s: FloatArray, phi_rad: FloatArray, noise_rad: float = 0.0) -> Decrement:
    """Damping of a free swing from its angle (n,) at times (n,).

    Parameters
    ----------
    noise_rad : standard deviation of a reading; swings below ten times that are left out,
        since noise makes small extremes larger.

    Raises `BadInputError` when fewer than four extremes stand out.
    """
    y, outliers = without_outliers(np.asarray(phi_rad, dtype=np.float64))
    turns = _turns(y, 0.3)
    if len(turns) < _FEWEST:
        raise BadInputError(f"swing: found {len(turns)} extremes, expected at least {_FEWEST}")
    rows = float(np.median(np.diff(turns)))
    reach = max(round(0.25 * rows), 1)
    ends = [_vertex(t_s, y, int(i), reach) for i in turns]
    at, peak = _regular(t_s, y, np.array([e[0] for e in ends]), np.array([e[1] for e in ends]))
    height = np.abs(np.diff(peak))
    floor = max(_FLOOR * noise_rad, _LARGEST_SHARE * float(height.max()))
    small = np.nonzero(height < floor)[0]
    used = int(small[0]) if len(small) else len(height)
    if used < _FEWEST - 1:
        raise BadInputError(f"swing: found {used + 1} extremes above the noise, expected at least {_FEWEST}")
    k = np.arange(used, dtype=np.float64)
    log = np.log(height[:used])
    i, j = np.triu_indices(used, 1)
    slope = float(np.median((log[j] - log[i]) / (k[j] - k[i])))
    scatter = robust_sigma(log - slope * k - np.median(log - slope * k))
    lever = k - k.mean()
    total = max(float(np.sum(lever**2)), 1e-12)
    # The scatter of few peaks may be small by chance; it cannot be less than what the noise makes.
    by_noise = math.sqrt(float(np.sum((lever * noise_rad / height[:used]) ** 2))) / total
    spread = 1.2 * max(scatter / math.sqrt(total), by_noise)
    delta, delta_sigma = -2.0 * slope, 2.0 * spread
    half = float(np.median(np.diff(at[: used + 1])))
    norm = math.hypot(delta, 2.0 * math.pi)
    return Decrement(
        delta / norm,
        delta_sigma * (2.0 * math.pi) ** 2 / norm**3,
        0.5 / half,
        at[: used + 1],
        peak[: used + 1],
        outliers,
    )


# ----------------------------------------------------------------------
# Stiffness from hanging weights or steady elongations: linear and polynomial, zero at zero (Fig. 3.10).
#
#     F = (k0 + k1 eps + k2 eps^2 + ...) eps
#
# by least squares on the force, with the standard deviation and correlation of the coefficients. The order
# is the one whose force at points left out is best; a higher one has to beat a lower by a twentieth.

_ORDERS = (1, 2, 3)
_HIGHER = 0.95


@dataclass(frozen=True)
class StiffnessFit:
    """A law of one order.

    Attributes
    ----------
    coefficients, sigma : (order,) k0 [N/m], k1 [N/m^2], ...
    correlation : (order, order). rms_N : over the points. left_out_rms_N : over points left out in turn.
    """

    coefficients: FloatArray
    sigma: FloatArray
    correlation: FloatArray
    rms_N: float
    left_out_rms_N: float

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients)

    def force_N(self, elongation_m: FloatArray) -> FloatArray:
        """Force [N] at elongations (n,) [m]."""
        return np.asarray(np.polyval(self.coefficients[::-1], elongation_m) * elongation_m)


def _one(eps: FloatArray, force: FloatArray, order: int) -> StiffnessFit:
    A = np.stack([eps ** (k + 1) for k in range(order)], axis=1)
    size = np.sqrt(np.sum(A * A, axis=0))
    B = A / size
    inverse = np.linalg.inv(B.T @ B)
    k = inverse @ (B.T @ force)
    residual = force - B @ k
    leverage = np.sum((B @ inverse) * B, axis=1)
    left = residual / np.maximum(1.0 - leverage, 1e-6)
    variance = float(residual @ residual) / max(len(eps) - order, 1)
    spread = np.sqrt(variance * np.diag(inverse))
    root = np.sqrt(np.diag(inverse))
    return StiffnessFit(
        k / size,
        spread / size,
        inverse / np.outer(root, root),
        rms(residual),
        rms(left),
    )


def fit_stiffness(name: str, elongation_m: FloatArray, force_N: FloatArray) -> tuple[list[StiffnessFit], int]:
    """Laws of all orders that the points allow, and the index of the one to use.

    Parameters
    ----------
    elongation_m, force_N : (n,) from the rest length on; points at zero say nothing.

    Raises `BadInputError` for fewer than three points, or forces that do not pull with the elongation.
    """
    eps, force = np.asarray(elongation_m, dtype=np.float64), np.asarray(force_N, dtype=np.float64)
    some = np.abs(eps) > 1e-9
    eps, force = eps[some], force[some]
    levels = len(np.unique(np.round(eps, 9)))
    if levels < 3:
        raise BadInputError(f"{name}: has {levels} elongations apart from zero, expected at least 3")
    if not float(eps @ force) > 0.0:
        raise BadInputError(f"{name}: force and elongation have opposite signs, expected the same")
    fits = [_one(eps, force, order) for order in _ORDERS if order < levels]
    best = 0
    for k in range(1, len(fits)):
        if fits[k].left_out_rms_N < _HIGHER * fits[best].left_out_rms_N:
            best = k
    return fits, best


# ----------------------------------------------------------------------
# Which experiment to do next: the one that would shrink the worst standard deviation most.
#
# Experiments add their information: S_after = S_now + S_experiment, each with its own start eliminated. What
# they share with the logs at hand, the offset of the camera's plane and, with commands, the delay, is among
# the unknowns, so that its prior counts once. The information of an experiment that was not done yet is that
# of a simulated one on the identified rig, with a picture at each tick and the noise of the logs at hand.

_TYPICAL = (0.004, 0.0004)


@dataclass(frozen=True)
class Prospect:
    """Relative standard deviations after one more experiment, and the worst of them."""

    name: str
    what: str
    relative: dict[str, float]
    worst: str
    worst_relative: float


def _experiments(
    rest_length_m: float, tick_s: float, noise: FloatArray
) -> Iterator[tuple[Track, Start, str]]:
    """What `calib record --do` has a rig do, by its names there: tracks yet without a head, starts, words.

    Parameters
    ----------
    noise : (2,) standard deviations of angle [rad] and length [m].
    """
    from calib.io.experiments import EXPERIMENTS, MOST_PWM

    for name, one in EXPERIMENTS.items():
        t = tick_s * np.arange(round(one.seconds / tick_s), dtype=np.float64)
        shares = (
            np.zeros((len(t), 2)) if one.command is None else np.array(list(map(one.command, t.tolist())))
        )
        W = np.broadcast_to(np.diag(1.0 / noise), (len(t) - 1, 2, 2)).copy()
        track = Track(name, tick_s, MOST_PWM * shares, not one.by_hand, t[1:], np.zeros((len(t) - 1, 2)), W)
        yield track, Start(0.5 if one.by_hand else 0.0, rest_length_m), f"{one.seconds:g} s, {one.asks}"


def _information(
    problem: Problem, names: tuple[str, ...], values: Mapping[str, float], track: Track, start: Start
) -> FloatArray | None:
    """Information (P + 3, P + 3) about relative changes and what logs share, from one experiment.

    None where it leaves the model. What the experiment brings in that is not asked for, as the pumps'
    strength, is eliminated.
    """
    try:
        head, _ = heads_of(track, [problem.pair(track, values)], [start], 0.0)
    except BadInputError:
        return None
    if not np.isfinite(head).all():
        return None
    track = replace(track, head=head[0])
    mine = candidates(problem.nominal, not track.hoses, track.hoses, False, problem.stated)
    more = tuple(name for name in mine if name not in names and name != "lambda3")
    if any(name.startswith("elongation") for name in names):
        more = tuple(name for name in more if name != "strength1")
    # Priors are in the information so far.
    flat = dict.fromkeys(PARAMETERS, math.inf)
    alone = replace(problem, tracks=[track], names=names + more, held=values, delay_s=0.0, stated=flat)
    x = first_guess(alone, values)
    x[alone.unknowns.starts[0]] = start.phi_rad, start.length_m
    residual, J = jacobian(alone, x)
    shared = _shared(alone)
    J[alone.spans[-1].stop :, shared] = 0.0
    S = informative(alone, np.zeros_like(residual), J, x, shared)
    P, m = len(names), len(more)
    out = np.zeros((P + _SHARED, P + _SHARED))
    some = P + len(shared)
    out[:some, :some] = _eliminated(S, [*range(P), *range(P + m, len(S))], 1e-10)
    return out


_SHARED = 3


def _shared(problem: Problem) -> list[int]:
    """Unknowns that logs share: the offset of the camera's plane, and the delay of those with commands."""
    at = problem.unknowns
    delays = [delay for delay, one in zip(at.delays, problem.tracks, strict=True) if one.hoses]
    return [at.offset.start, at.offset.start + 1, *delays[:1]]


def _at_hand(solution: Solution, known: Uncertainty, size: FloatArray) -> FloatArray:
    """Information (P + 3, P + 3) of the logs at hand, as `_information`: of the parameters that of `known`,
    and what they tell of the rest as white residuals do."""
    problem, P = solution.problem, len(solution.problem.names)
    J = solution.J.copy()
    J[: problem.spans[-1].stop] /= known.scale
    shared = _shared(problem)
    S = informative(problem, solution.residual, J, solution.x, shared)
    mixed, rest = S[:P, P:], S[P:, P:]
    out = np.diag([0.0] * P + [_DELAY_SIGMA_S**-2] * _SHARED)
    out[P : len(S), P : len(S)] = rest
    out[:P, P : len(S)], out[P : len(S), :P] = mixed, mixed.T
    alone = np.linalg.pinv(known.covariance / np.outer(size, size), hermitian=True)
    out[:P, :P] = alone + mixed @ np.linalg.solve(rest, mixed.T)
    return out


def prospects(solution: Solution, known: Uncertainty) -> tuple[Prospect, ...]:
    """All experiments, the most useful first.

    Judged are the parameters that were estimated and those that could not be told for want of excitation,
    lambda3 apart, which no experiment tells from lambda2, and a creep that is not there.
    """
    problem = solution.problem
    values = {**values_of(problem.nominal), **problem.held, **solution.values}
    vague = [n for n, why in solution.fixed.items() if n != "lambda3" and NO_CREEP not in why]
    order = list(PARAMETERS)
    names = tuple(sorted([*problem.names, *vague], key=order.index))
    now = np.zeros((len(names) + _SHARED, len(names) + _SHARED))
    at = [names.index(name) for name in problem.names] + [len(names) + k for k in range(_SHARED)]
    size = np.array([max(abs(values[n]), 0.1 * PARAMETERS[n].scale) for n in problem.names])
    now[np.ix_(at, at)] = _at_hand(solution, known, size)
    W = np.concatenate([track.whitening for track in problem.tracks])
    inverse = np.linalg.inv(W)
    noise = known.scale * np.sqrt(np.median(np.sum(inverse**2, axis=2), axis=0))
    noise = np.asarray(np.where(np.isfinite(noise) & (noise > 0.0), noise, _TYPICAL))
    out = []
    rest = problem.nominal.plant.rest_length_m
    for track, start, what in _experiments(rest, problem.nominal.pump.tick_s, noise):
        gained = _information(problem, names, values, track, start)
        if gained is None:
            continue
        relative = _relative(now + gained, names)
        # What a drawing tells best is no reason for an experiment.
        asked = [name for name in names if math.isinf(PARAMETERS[name].share)] or names
        worst = max(asked, key=lambda n: relative[n])
        out.append(Prospect(track.name, what, relative, worst, relative[worst]))
    return tuple(sorted(out, key=lambda p: (p.worst_relative, sum(p.relative.values()))))


def _relative(S: FloatArray, names: Sequence[str]) -> dict[str, float]:
    """Relative standard deviations of an information matrix; those that nothing bounds count as 10."""
    prior = 1e-2 * np.eye(len(S))
    sigma = np.sqrt(np.diag(np.linalg.inv(S + prior)))[: len(names)]
    return {
        name: min(float(s), 10.0) if math.isfinite(s) else 10.0 for name, s in zip(names, sigma, strict=True)
    }


# ----------------------------------------------------------------------
# What an identification is worth in words: verdict, reasons, remarks and advice.
#
# - unidentifiable: the logs cannot tell a parameter that they should.
# - poor: the model does not explain the logs (residuals far above the noise, a held-back log predicted much
#   worse than fitted), a parameter lies at a bound, or an important one is vague.

_MOST_SCALE = 2.5
_MOST_INFLATION = 8.0
_MOST_HELD, _LEAST_CHANCE = 1.5, 0.01
_MOST_RELATIVE = 0.25
_MOST_SCATTER = 1.5
_SLOW = 1.5
"""Periods of a loop for which a log's commands stand, beyond which it may have sent others in between."""
_STRONG = 0.95
_FAR_ROWS = 0.05
_EXPLAINED = 3e-3, 1.5e-4
"""Angle [rad] and length [m]: a model that misses by less, half a Pixy2's pixel, explains logs of a camera
that sees more as well."""
_MOST_APART_S = 0.04
_PUMPS_APART_S = 0.01
_APART_SIGMA = 5.0


def _bounds(solution: Solution) -> list[str]:
    out = []
    for name, value in solution.values.items():
        spec = PARAMETERS[name]
        near = 1e-3 * spec.scale
        if value - spec.low < near or spec.high - value < near:
            out.append(f"{label_of(name)} lies at its bound {value:.4g} {spec.unit}".rstrip())
    return out


def _of_fit(solution: Solution, known: Uncertainty, colours: Sequence[Colour]) -> list[Finding]:
    advice = "look at what known states: the mass, gravity and the bellows' radius are in all forces"
    out = [Finding("poor", text, advice) for text in _bounds(solution)]

    def poor(text: str) -> None:
        out.append(Finding("poor", text))

    def remark(text: str) -> None:
        out.append(Finding("remark", text))

    missed = rms_by_track(solution.problem, solution.residual, math.inf)
    unlike = remark if (np.array(missed) < _EXPLAINED).all() else poor
    if known.scale > _MOST_SCALE:
        unlike(
            f"the residuals are {known.scale:.1f} times what the sensor's noise explains; the model misses "
            "something, or the camera's jitter is larger than the rig's file says"
        )
    worst = max(known.inflation, key=lambda n: known.inflation[n])
    if known.inflation[worst] > _MOST_INFLATION:
        poor(
            f"the residuals are so coloured that the deviation of {label_of(worst)} had to be raised "
            f"{known.inflation[worst]:.1f} times"
        )
    slow = _slowly_commanded(solution.problem)
    for colour in colours:
        if not colour.white:
            remark(
                f"{colour.name}: residuals are not white ({100.0 * colour.outside:.0f} % of the lags outside "
                f"the 95 % band, {max(colour.first, key=abs):+.2f} from row to row); deviations are raised"
            )
        if colour.name in slow and not colour.white:
            every = f"{1e3 * slow[colour.name]:.3g} ms"
            text = f"{colour.name}: its commands come every {every}; what the pumps got in between is missing"
            advice = "write each command into the log when it is sent, or state known: {pump: {tick_s: ...}}"
            out.append(Finding("remark", text, advice))
        if colour.share_far > _FAR_ROWS:
            unlike(f"{colour.name}: {100.0 * colour.share_far:.0f} % of the poses are far off")
    labels = [label_of(name) for name in solution.problem.names]
    groups = tied_groups(known.correlation, _STRONG)
    if groups:
        texts = "; ".join(", ".join(labels[k] for k in group) for group in groups)
        remark(f"hardly told apart, with correlations beyond {_STRONG:g}: {texts}")
    if solution.starts > 1 and solution.agreeing == 1:
        remark(f"one of {solution.starts} starts alone came to this minimum; there may be others")
    return out


def _slowly_commanded(problem: Problem) -> dict[str, float]:
    """Periods [s] of the commands of logs that hold fewer of them than the pumps are known to get."""
    loop_s = problem.nominal.pump.tick_s
    pumped = [track for track in problem.tracks if track.hoses]
    return {track.name: track.tick_s for track in pumped if track.tick_s > _SLOW * loop_s}


def _one_more(solution: Solution, columns: Iterable[FloatArray]) -> Iterator[tuple[float, float] | None]:
    """What one unknown more would be and its deviation, for derivatives (rows,) of the residuals by it.

    One step of Gauss and Newton in which all other unknowns follow. None where they can make up for it.
    """
    r, w, WJ, inverse = solution.residual, solution.weights, solution.weighted, solution.inverse
    for column in columns:
        b, whole = WJ.T @ column, float(column @ (w * column))
        own = whole - float(b @ inverse @ b)
        slope = float(column @ (w * r) - b @ inverse @ (WJ.T @ r))
        yield (-slope / own, 1.0 / math.sqrt(own)) if own > 1e-6 * whole and own > 0.0 else None


def own_delays(solution: Solution) -> list[tuple[str, float, float]]:
    """By how much each log's rows come later than those of the others [s], and the deviation of that.

    Only of logs that share a delay. Columns that are late in one log alone are otherwise taken for a delay
    between, and for a damping and a creep that are not there.
    """
    problem, J = solution.problem, solution.J
    delays, spans = problem.unknowns.delays, problem.spans
    shared = [k for k, at in enumerate(delays) if delays.count(at) > 1]
    columns = []
    for k in shared:
        column = np.zeros(len(J))
        column[spans[k]] = J[spans[k], delays[k]]
        columns.append(column)
    found = zip(shared, _one_more(solution, columns), strict=True)
    return [(problem.tracks[k].name, *one) for k, one in found if one is not None]


def pump_delay(solution: Solution) -> tuple[float, float] | None:
    """By how much the commands of pump 1 come later than those of pump 2 [s], and the deviation of that.

    None without pumps. A column that is late is otherwise taken for a damping that is not there.
    """
    problem, x = solution.problem, solution.x
    column = np.zeros(len(solution.residual))
    for k, (track, span) in enumerate(zip(problem.tracks, problem.spans, strict=True)):
        if track.hoses:
            n, ends = len(track.pwm), []
            for shift in (1, -1):
                pwm = track.pwm.copy()
                pwm[:, 0] = track.pwm[np.clip(np.arange(n) + shift, 0, n - 1), 0]
                ends.append(head_of(problem, x, k, replace(track, pwm=pwm)))
            slope = (ends[0] - ends[1]) / (2.0 * track.tick_s)
            column[span] = -_whitened(track, slope).reshape(-1)
    return next(iter(_one_more(solution, [column]))) if np.isfinite(column).all() and column.any() else None


@dataclass(frozen=True)
class Moved:
    """A shift of all poses of a log from a time on: by angle [rad] and length [m], in deviations.

    Attributes
    ----------
    from_s : time in the log; zero for all of it. readings : the shift over the noise of one reading.
    """

    name: str
    from_s: float
    phi_rad: float
    length_m: float
    readings: float
    deviations: float


def moved_camera(solution: Solution) -> Moved | None:
    """The clearest shift of a log's pictures from some time on, alike in pixels: of a camera that moved."""
    problem, r, w = solution.problem, solution.residual, solution.weights
    WJ, inverse, found = solution.weighted, solution.inverse, list[Moved]()
    pull = inverse @ (WJ.T @ r)
    for track, span in zip(problem.tracks, problem.spans, strict=True):
        # Sums from each row on, over both whitened readings: of pictures they are u and v.
        by, slope, power = (
            np.cumsum(rows[span].reshape(len(track.t_s), 2, -1)[::-1], axis=0)[::-1]
            for rows in (WJ, w * r, w)
        )
        ends = np.linspace(0.0, len(track.t_s), _MOMENTS + 1)[:-1].astype(int)
        for k in ends if len(problem.tracks) > 1 else ends[1:]:
            own = np.diag(power[k, :, 0]) - by[k] @ inverse @ by[k].T
            size, axes = np.linalg.eigh(own)
            if size[0] > 1e-6 * power[k].max():
                g = slope[k, :, 0] - by[k] @ pull
                shift = -axes @ ((axes.T @ g) / size)
                phi, length = np.linalg.solve(track.whitening[k], shift).tolist()
                at = float(track.t_s[k]) if k else 0.0
                far = math.sqrt(max(float(-shift @ g), 0.0))
                found.append(Moved(track.name, at, phi, length, float(np.linalg.norm(shift)), far))
    return max(found, key=lambda one: one.deviations, default=None)


def by_logs(solution: Solution) -> dict[str, tuple[float, float]]:
    """What logs make of each value that is stated without a deviation, to first order, and the deviation."""
    problem, values = solution.problem, values_of(solution.problem.nominal)
    exact = [name for name, sigma in problem.stated.items() if not sigma and name not in problem.names]
    columns: dict[str, FloatArray] = {}
    for name in exact:
        step = _STEP * max(abs(values[name]), PARAMETERS[name].scale)
        up, down = (
            residuals(replace(problem, held={**problem.held, name: value}), solution.x[None])[0]
            for value in (values[name] + step, values[name] - step)
        )
        if np.any(up != down):
            columns[name] = (up - down) / (2.0 * step)
    found = zip(columns, _one_more(solution, columns.values()), strict=True)
    return {name: (values[name] + one[0], one[1]) for name, one in found if one is not None}


_MOMENTS = 20
_LEAST_READINGS = 0.5
"""Moments of a log at which a camera may have moved; noises of a reading, .2 px, below which it has not."""
_MOVED_RAD, _MOVED_M = math.radians(0.1), 1e-4
"""Turn and growth of the head up to which, before a fine camera, its move does no harm."""
_STATED_OFF = 0.02
_CROSSED, _BENDS_RAD = -0.5, 0.05
_UNLIKE = 1.15
"""Factor by which one of two pumps may be stronger, and the other weaker, than it should."""


def crossed(solution: Solution) -> dict[str, float]:
    """Correlation of angles with those of the model from which the fit began, by the name of a log.

    Only of logs whose pumps push apart. The fit itself makes pumps weak that bend the rig the other way.
    A controller pushes against what unlike pumps bend, so the largest correlation is taken of a model with
    pumps alike and with either one stronger.
    """
    problem, found = solution.problem, {}
    alike = dict(zip(STRENGTHS, problem.nominal.strength, strict=True))
    one, other = STRENGTHS
    for k, track in enumerate(problem.tracks):
        if track.hoses:
            delay_s, start = float(solution.x[problem.unknowns.delays[k]]), start_of(problem, solution.x, k)
            pairs = [
                problem.pair(track, {one: more * alike[one], other: alike[other] / more})
                for more in (1.0, _UNLIKE, 1.0 / _UNLIKE)
            ]
            heads, _ = heads_of(track, pairs, [start] * len(pairs), delay_s)
            both = [np.stack([head[:, 0], track.head[:, 0]]) for head in heads]
            if np.isfinite(both).all() and np.ptp(both[0], axis=1).min() > _BENDS_RAD:
                found[track.name] = max(float(np.corrcoef(pair)[0, 1]) for pair in both)
    return found


def _apart(solution: Solution, known: Uncertainty) -> Iterator[Finding]:
    """What logs contradict: what is known, where the camera is, when rows come, which pump pushes where."""
    raised = known.scale * max(known.inflation.values(), default=1.0)
    stated = values_of(solution.problem.nominal)
    for name, (value, sigma) in by_logs(solution).items():
        off = abs(value - stated[name])
        if off > max(_APART_SIGMA * raised * sigma, _STATED_OFF * abs(stated[name])):
            label, spec = label_of(name), PARAMETERS[name]
            # Far away the first order says no more than that it is another.
            about = (
                f"about {value:.4g} +- {raised * sigma:.2g}" if spec.low <= value <= spec.high else "another"
            )
            text = (
                f"{label} is {stated[name]:.4g} {spec.unit}".rstrip() + f" in known, and {about} by the logs"
            )
            advice = "measure it and the mass again, or state its standard deviation under known"
            yield Finding("inconsistent", text, advice)
    # Logs move what is known beforehand by its deviation or two; a fit that ended beside the rig, or a wrong
    # number, by ten.
    unknowns = solution.problem.unknowns
    for name, value, mean, sigma in zip(
        solution.problem.names, solution.x, unknowns.mean, unknowns.sigma, strict=False
    ):
        if abs(value - mean) > _APART_SIGMA * sigma:
            unit = f" {PARAMETERS[name].unit}".rstrip()
            before, after = f"{mean:.4g} +- {sigma:.2g}{unit}", f"{value:.4g}{unit}"
            text = (
                f"{label_of(name)} is {before} beforehand, and {after} by the fit: another rig's number, or "
                "a fit that ended beside the rig"
            )
            advice = (
                "measure it and the mass again, and look at the stated gravity; where they are right, "
                "identify with some logs left out"
            )
            yield Finding("inconsistent", text, advice)
    moved, slow = moved_camera(solution), _slowly_commanded(solution.problem)
    if (
        moved is not None
        and moved.name not in slow
        and moved.readings > _LEAST_READINGS
        and (abs(moved.phi_rad) > _MOVED_RAD or abs(moved.length_m) > _MOVED_M)
        and moved.deviations > _APART_SIGMA * raised
    ):
        when, then = f"from about {moved.from_s:.1f} s on", "cut the log there, and"
        if not moved.from_s:
            when, then = "against those of the other logs", "keep it apart, and"
        text = (
            f"{moved.name}: its pictures are shifted {when}, as if the head had turned by "
            f"{math.degrees(moved.phi_rad):+.1f} degrees and grown by {1e3 * moved.length_m:+.1f} mm; the "
            "camera, or the marker on the head, has moved, or a pump answers otherwise"
        )
        advice = (
            f"{then} calibrate the plane anew (calib extrinsics) for the pictures after that; where calib "
            "replay finds that pictures and IMU agree, look at the pumps, their hoses and the commands' unit"
        )
        yield Finding("inconsistent", text, advice)
    for name, alike in crossed(solution).items():
        if alike < _CROSSED:
            text = f"{name}: the head bends away from the pump that pushes, correlation {alike:.2f}"
            advice = "look whether pwm1 and pwm2, or the hoses, are swapped, or the pictures are mirrored"
            yield Finding("inconsistent", text, advice)
    far = [
        (abs(late) / sigma, name, late)
        for name, late, sigma in own_delays(solution)
        if abs(late) > max(_MOST_APART_S, _APART_SIGMA * raised * sigma)
    ]
    if far:
        _, name, late = max(far)
        when = "later" if late > 0.0 else "earlier"
        text = (
            f"{name}: its pictures come {1e3 * abs(late):.0f} ms {when} after its commands than those of the "
            "other logs"
        )
        yield Finding("inconsistent", text, "compare the clocks of camera and commands, log by log")
    late, sigma = pump_delay(solution) or (0.0, 1.0)
    if abs(late) > max(_PUMPS_APART_S, _APART_SIGMA * raised * sigma):
        one, other = ("pwm1", "pwm2") if late > 0.0 else ("pwm2", "pwm1")
        text = (
            f"{one} comes about {1e3 * abs(late):.0f} ms after {other}, as the rig answers them; the model "
            "has one dead time for both pumps, so damping and lags are not the rig's"
        )
        yield Finding("inconsistent", text, "check the times of both columns, and hoses and valves")


def _told(solution: Solution, known: Uncertainty) -> Iterator[Finding]:
    """Which parameters logs do not tell, or hardly, and which a person states."""
    for name, why in solution.fixed.items():
        if "enter only" in why:
            yield Finding("remark", why)
        elif NO_CREEP in why:
            yield Finding("remark", f"{label_of(name)}: {why}")
        else:
            text = f"{label_of(name)} is not identifiable from these logs: {why}"
            yield Finding("unidentifiable", text)
    most = max((float(track.pwm.max()) for track in solution.problem.tracks if track.hoses), default=0.0)
    if 0.0 < most <= 100.0 and {*STRENGTHS} <= solution.fixed.keys():
        unit = "unit: percent" if most > 1.0 else "factor: 255"
        text = f"no command exceeds {most:.3g} of 255, below which the pumps give no force"
        said = f"of other units, say pwm1: {{column: pwm1, {unit}}} in columns.yaml, and pwm2 so"
        yield Finding("unidentifiable", text, said)
    fixed = [label_of(name) for name, sigma in solution.problem.stated.items() if not sigma]
    if fixed:
        yield Finding("remark", f"not estimated, for known states it: {', '.join(fixed)}")
    priors = [label_of(name) for name in solution.problem.names if solution.problem.stated.get(name)]
    if priors:
        yield Finding("remark", f"known with a standard deviation, which went in: {', '.join(priors)}")
    for name, value in solution.values.items():
        relative = known.sigma[name] / max(abs(value), 1e-12)
        if relative > _MOST_RELATIVE:
            so = f"known to {100.0 * relative:.0f} % only"
            if relative > 1.0:
                so = f"{value:.3g} +- {known.sigma[name]:.2g}: these logs do not tell it from zero"
            if known.scatter[name] > _MOST_SCATTER:
                times = f"{known.scatter[name]:.1f} times"
                so += f"; stretches of the logs disagree on it, which raised its deviation {times}"
            yield Finding("poor", f"{label_of(name)} is {so}")


def _of_logs(solution: Solution, held: Sequence[HeldLog], next_ones: Sequence[Prospect]) -> Iterator[Finding]:
    """How logs are met that were held back, the law of the pumps, and what to record next."""
    for log in held:
        # A log that alone tells a parameter is predicted badly by the others, who say nothing against it.
        if log.held_phi_rad > _MOST_HELD * log.fitted_phi_rad + 1e-4 and log.chance < _LEAST_CHANCE:
            text = (
                f"{log.name}: held back, its angle is predicted to {1e3 * log.held_phi_rad:.3g} mrad, "
                f"fitted to {1e3 * log.fitted_phi_rad:.3g} mrad, by parameters that the other logs contradict"
            )
            yield Finding("poor", text)
    if solution.law:
        yield Finding("remark", solution.law)
    if not held and len(solution.problem.tracks) == 1:
        yield Finding("remark", "one log alone: nothing is left to check the parameters on")
    if next_ones:
        best = next_ones[0]
        advice = (
            f"calib record PORT -o {best.name}.csv --do {best.name} ({best.what}) would leave "
            f"{label_of(best.worst)} as the least known, to {100.0 * best.worst_relative:.2g} %"
        )
        yield Finding("remark", "", advice)


def judge(
    solution: Solution,
    known: Uncertainty,
    colours: Sequence[Colour],
    held: Sequence[HeldLog],
    next_ones: Sequence[Prospect],
) -> Verdict:
    """Judge an identification from what was computed of it."""
    told, apart = _told(solution, known), _apart(solution, known)
    fit, logs = _of_fit(solution, known, colours), _of_logs(solution, held, next_ones)
    return Verdict.of([*told, *fit, *apart, *logs])
