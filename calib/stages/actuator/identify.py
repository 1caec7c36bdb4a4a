"""Parameters of the actuator from logs: what is estimated, residuals of simulated motion, and the search."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray, IntArray, robust_sigma
from calib.core.errors import BadInputError
from calib.solve.information import scaled_inverse
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
    creep1_N, creep2_N : z of (3.45). force1_N, force2_N : of the pumps. gap1_N, gap2_N : by how much their
        lags are below the forces, while air leaves at its limit: a lag above a force pulls it along at once,
        so that no fit could tell how far.
    """

    phi_rad: float
    length_m: float
    dphi_radps: float = 0.0
    dlength_mps: float = 0.0
    creep1_N: float = 0.0
    creep2_N: float = 0.0
    force1_N: float = 0.0
    force2_N: float = 0.0
    gap1_N: float = 0.0
    gap2_N: float = 0.0

    def row(self, plant: Plant) -> FloatArray:
        """The row (10,) of `simulate.STATE`."""
        row = state_row(plant, self.phi_rad, self.length_m, (self.force1_N, self.force2_N))
        row[2:4] = bellows(self.dphi_radps, self.dlength_mps, plant.bellows_radius_m)
        lags = self.force1_N - self.gap1_N, self.force2_N - self.gap2_N
        row[4:8] = self.creep1_N, self.creep2_N, *lags
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
DELAY_SIGMA_S = 0.03
STEP = 1e-4
_START_STEP = (1e-4, 1e-5, 1e-3, *(1e-4,) * 7)
_START_SCALE = (0.01, 0.001, 0.1, 0.005, 0.02, 0.02, *(0.05,) * 4)
_START_BELOW = (0.3, 0.02, 30.0, 1.0, 2.0, 2.0, 5.0, 5.0, 0.0, 0.0)
_START_ABOVE = (0.3, 0.02, 30.0, 1.0, 2.0, 2.0, *(5.0,) * 4)
"""Steps, scales and reach on both sides of a guess by `COMPONENTS`."""
_FREE_SIGMA = (3.0, 0.1, 0.2, 0.2)
_PUMPED_SIGMA = (0.5, 0.02, 0.2, 0.2, 0.5, 0.5, 1.0, 1.0)
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
                rows.append((0.01, self.delay_s - 0.5, self.delay_s + 0.5, self.delay_s, DELAY_SIGMA_S))
        starts = []
        for track in self.tracks:
            at, moving = len(rows), track.moving is not None
            sigma = (inf, inf, *(_PUMPED_SIGMA if track.hoses else _FREE_SIGMA))
            of_start = zip(
                astuple(track.start), _START_SCALE, _START_BELOW, _START_ABOVE, sigma, strict=False
            )
            rows += [
                (scale, guess - below, guess + above, guess, deviation if moving else inf)
                for _, (guess, scale, below, above, deviation) in zip(track.unknown, of_start, strict=False)
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


def whitened(track: Track, error: FloatArray) -> FloatArray:
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
        rows = whitened(track, error).reshape(len(xs), -1)
        parts.append(np.where(np.isfinite(rows), rows, FAR))
    parts.append(np.stack([_priors(problem, x) for x in xs]))
    return np.concatenate(parts, axis=1)


def jacobian(problem: Problem, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (rows,) and their derivatives (rows, size) at a vector of unknowns."""
    unknowns, P = problem.unknowns, len(problem.names)
    steps = STEP * np.maximum(np.abs(x), unknowns.scale)
    for at in unknowns.starts:
        steps[at] = _START_STEP[: at.stop - at.start]
    up, down = np.minimum(x + steps, unknowns.high), np.maximum(x - steps, unknowns.low)
    if problem.rough:
        up, down = np.where(up - x >= x - down, up, down), x
    width, sides = up - down, (up,) if problem.rough else (up, down)
    base = problem.values(x)
    moved = [base]
    for i, name in enumerate(problem.names):
        moved += [{**base, name: float(side[i])} for side in sides]
    # Making a plant checks it, which takes as long as a short log: once for all logs of a kind.
    alike: dict[tuple[bool, float], list[tuple[Plant, Pump]]] = {}
    blocks, errors = [], []
    for k, track in enumerate(problem.tracks):
        begin = start_of(problem, x, k)
        kind = track.hoses, track.tick_s
        if kind not in alike:
            alike[kind] = [problem.pair(track, values) for values in moved]
        pairs, starts = alike[kind], [begin] * len(moved)
        at = unknowns.starts[k]
        for i, name in enumerate(track.unknown, at.start):
            starts += [replace(begin, **{name: float(side[i])}) for side in sides]
        delay = unknowns.delays[k]
        pairs = pairs + pairs[:1] * (len(starts) - len(pairs))
        head, rate = heads_of(track, pairs, starts, float(x[delay]), problem.per_tick)
        W = track.whitening
        J = np.zeros((len(track.t_s), 2, unknowns.size))
        moved_to, moved_from = (head[1:], head[:1]) if problem.rough else (head[1::2], head[2::2])
        slope = (moved_to - moved_from) / np.concatenate([width[:P], width[at]])[:, None, None]
        slope = -np.einsum("mij,smj->mis", W, slope)
        J[:, :, :P] = slope[:, :, :P]
        J[:, :, at] = slope[:, :, P:]
        J[:, :, unknowns.offset] = -W
        J[:, :, delay] = whitened(track, rate[0])
        error = whitened(track, track.head - head[0] - x[unknowns.offset])
        good = np.isfinite(error).all() and np.isfinite(J).all()
        blocks.append(J.reshape(-1, unknowns.size) if good else np.zeros((2 * len(track.t_s), unknowns.size)))
        errors.append(np.where(np.isfinite(error), error, FAR).reshape(-1))
    told = unknowns.priors
    priors = np.zeros((len(told), unknowns.size))
    priors[np.arange(len(told)), told] = 1.0 / unknowns.sigma[told]
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
_FAR_OFF = 30.0
"""Deviations, or times what a typical reading is off, from which on one shows another thing than the marker,
where no model comes nearer."""
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


def robust_cost(problem: Problem, r: FloatArray) -> FloatArray:
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
        if robust_cost(problem, residual) < enough:
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
    return end, float(robust_cost(problem, residual)), residual, J


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
    return eliminated(A.T @ A, kept, 1e-12)


def eliminated(H: FloatArray, kept: list[int], floor: float) -> FloatArray:
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


def _left(problem: Problem, residual: FloatArray, solution: Solution) -> float:
    """Share of a solution's robust cost that another model of its logs leaves, without what both miss by far.

    Rows that show another thing in place of the marker cost the same in both, and hide what the others tell.
    """
    rows = problem.spans[-1].stop
    least = np.minimum(np.abs(residual[:rows]), np.abs(solution.residual[:rows]))
    # Where most rows are far off it is the models that err.
    told = least <= _FAR_OFF * max(float(np.median(least)), 1.0)
    one, other = (
        float(robust_cost(of, np.concatenate([r[:rows][told], r[rows:]])))
        for of, r in ((problem, residual), (solution.problem, solution.residual))
    )
    return one / other


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
        best = int(np.argmin(robust_cost(rough, residuals(rough, starts))))
        _, cost, residual, _ = solve(rough, starts[best], 25)
        tried.append((cost, name, values[best], _left(rough, residual, solution)))
    _, name, begin, left = min(tried, key=lambda one: one[0])
    if not left < _BETTER:
        return solution
    found = _again(solution, replace(problem, names=_ordered(names | {name}), held={}), begin, fixed)
    left = _left(found.problem, found.residual, solution)
    if not left < _BETTER or name not in found.values:
        return solution
    width = f"{label_of(name)} of {found.values[name]:.3g} {PARAMETERS[name].unit}"
    law = f"a {width} leaves {100.0 * left:.0f} % of the misfit"
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
    left = _left(best.problem, best.residual, solution)
    if not left < _BETTER:
        return solution
    share = f"{100.0 * left:.0f} %"
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
    minimum = solve(problem, starts[int(np.argmin(robust_cost(problem, residuals(problem, starts))))], 40)
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
    what stays of the creep bends stiffness and damping. Or rate and spring come out as noise has them.
    """
    problem, rate, spring = solution.problem, "lambda1_per_s", "lambda2_N_per_m"
    doubtful = {rate, spring} & {*solution.fixed} or any(label_of(rate) in one for one in at_bounds(solution))
    if spring in problem.names:
        k = problem.names.index(spring)
        sigma = robust_sigma(solution.residual) * math.sqrt(solution.inverse[k, k])
        doubtful = doubtful or solution.x[k] < _CONTRARY * sigma
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
    order = np.argsort(robust_cost(rough, residuals(rough, spread)), kind="stable")[:_REFINED].tolist()
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
# What a solution leaves: whiteness of each log's residuals, and parameters at their bounds.

_LAGS = 20
BAND = 1.96
"""Of the correlation of white residuals, over the root of their number."""


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


def autocorrelation(residual: FloatArray, lags: int) -> FloatArray:
    """Of a log's residuals (rows,), of angle and length (lags, 2) from lag 1 on; far ones are cut."""
    r = residual.reshape(-1, 2)
    z = np.clip(r / np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9), -3.0, 3.0)
    z = z - z.mean(axis=0)
    power = np.maximum(np.sum(z * z, axis=0), 1e-12)
    return np.array([np.sum(z[k:] * z[:-k], axis=0) / power for k in range(1, lags + 1)]).reshape(-1, 2)


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
                float(np.mean(np.abs(c) > BAND / math.sqrt(len(r)))),
                far,
            )
        )
    return tuple(out)


def at_bounds(solution: Solution) -> list[str]:
    """Sentences on the parameters that lie at a bound."""
    out = []
    for name, value in solution.values.items():
        spec = PARAMETERS[name]
        near = 1e-3 * spec.scale
        if value - spec.low < near or spec.high - value < near:
            out.append(f"{label_of(name)} lies at its bound {value:.4g} {spec.unit}".rstrip())
    return out
