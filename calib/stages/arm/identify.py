"""Fit an assembly to trials, and predict each trial from a fit to the others.

Least squares over whole free runs with the parameters' priors, in steps: the segment from the measured
pressure, with little weight on the chord, then the chord alone, then the drive from the command with the
segment as it is, so that what the models of chord and valve miss does not bend the arm's. Without a measured
pressure all is fitted from the command at once. Errors of a free run
stay alike for seconds, so a sample counts as 1/`_ALIKE` of a reading. Days differ by factors with priors of
their own. Standard deviations are the larger of the posterior's and of the jackknife's over trials, as trials
differ by more than their samples tell.

A trial is held back from all: fits to the others begin at the priors, or where another fit to the same others
has ended.

Baselines are trained on the same trials: linear ARX by least squares, run free, and one lag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from calib.core.arrays import BoolArray, FloatArray, IntArray, blocks, rms
from calib.stages.arm.model import (
    CHORD,
    DAILY,
    DRIVES,
    PARAMETERS,
    PARTS,
    SEGMENT,
    STEP_S,
    Assembly,
    Days,
    Scale,
    Trial,
    data_scale,
    drive_run,
    parameters_on_day,
    segment_run,
)

_BY_ANGLE, _BY_CHORD = ("angle_by_pressure_rad", "angle_rad"), ("chord_m",)
_TRIED = {"toe": _BY_ANGLE, "inertia": _BY_ANGLE, "extension": _BY_CHORD}
"""Parts that are taken where they predict held trials better, by the first of these that there is."""
FULL = Assembly(tuple(part.name for part in PARTS if part.name not in ("lag", "pump", *_TRIED)))
WORTH = ("stiffening", "hysteresis", "creep", "settling", "load")
"""Parts whose worth is measured by leaving them out."""
_SIGMA = {"pressure_kpa": 0.03, "angle_rad": 0.027, "chord_m": 0.0045}
"""Of their scale: what assemblies of this kind leave."""
_LOOSE = 1.5
"""Times the chord's, while it helps to tell the segment."""
_ALIKE, _EVERY = 300, 5
"""Samples of one error, and of which one is looked at. Errors on held trials of a real arm have an integral
time of 2 to 7 s about their mean over the trial, and of 4 to 37 s with it."""
_STEP = 0.03
"""Of the differences, in deviations of the priors; smaller ones see the valve's ports open and close."""
_ORDERS, _ARX_STEPS_S = (8, 15), (0.1, 0.2)
_LAGS_S = tuple(np.geomspace(0.1, 10.0, 25).tolist())


@dataclass(frozen=True)
class Fit:
    """An assembly fitted to trials.

    Attributes
    ----------
    z : (parameters,) in deviations of the priors. covariance : (parameters, parameters) the posterior's.
    days : factors of each day.
    """

    assembly: Assembly
    scale: Scale
    z: FloatArray
    covariance: FloatArray
    days: Days

    @property
    def sigma(self) -> FloatArray:
        """(parameters,) the posterior's deviations in those of the priors."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def values(self) -> dict[str, float]:
        """Parameters by name."""
        return self.assembly.values(self.z, self.scale)


@dataclass(frozen=True)
class Quantity:
    """What is predicted: which column of a trial, from which other one, its words and scale in tables."""

    source: str
    target: str
    words: str
    title: str
    scale: float


QUANTITIES = {
    "angle_rad": Quantity("command", "angle_rad", "angle", "angle from the command, deg", math.degrees(1.0)),
    "chord_m": Quantity("command", "chord_m", "chord", "chord from the command, mm", 1e3),
    "angle_by_pressure_rad": Quantity(
        "pressure_kpa", "angle_rad", "angle by pressure", "angle from the pressure, deg", math.degrees(1.0)
    ),
}
Errors = Mapping[str, float]
"""RMS of a free run by quantity, that of the pressure [kPa] too; NaN where something was not logged."""


@dataclass(frozen=True)
class Identification:
    """What trials tell of an arm.

    Attributes
    ----------
    fit, sigma : to all trials, and standard deviations by name that hold between trials.
    held : by trial. others : held errors of other assemblies and of baselines, by name and trial.
    coverage : share of the samples of left-out trials in the 95 % interval that the others' errors give.
    prospects : by kind of trial, what it would leave of the parameters' deviations.
    """

    trials: tuple[Trial, ...]
    fit: Fit
    sigma: Mapping[str, float]
    held: Mapping[str, Errors]
    others: Mapping[str, Mapping[str, Errors]]
    coverage: float
    prospects: Mapping[str, Mapping[str, float]]

    @property
    def models(self) -> dict[str, Mapping[str, Errors]]:
        """Held errors of the assembly and of what it is compared with, by name and trial."""
        return {"assembly": self.held, **self.others}


def _segment_residuals(
    trial: Trial, values: Mapping[str, float], pressure_kpa: FloatArray
) -> dict[str, FloatArray]:
    if not (len(trial.angle_rad) and len(pressure_kpa)):
        return {}
    angle, chord = segment_run(trial, values, pressure_kpa)
    seen = slice(None) if trial.unseen is None else ~trial.unseen
    return {"angle_rad": (angle - trial.angle_rad)[seen], "chord_m": (chord - trial.chord_m)[seen]}


def residuals_by_pressure(trial: Trial, values: Mapping[str, float]) -> dict[str, FloatArray]:
    """Simulated less measured values of the segment under the measured pressure, where poses were seen."""
    return _segment_residuals(trial, values, trial.pressure_kpa)


def residuals_by_command(trial: Trial, values: Mapping[str, float]) -> dict[str, FloatArray]:
    """Simulated less measured values of drive and segment under the command."""
    if not len(trial.command):
        return {}
    run = drive_run(trial, values)
    off = {"pressure_kpa": run - trial.pressure_kpa} if len(trial.pressure_kpa) else {}
    return off | _segment_residuals(trial, values, run)


_Model = Callable[[Trial, Mapping[str, float]], dict[str, FloatArray]]


class _Problem:
    """Squared errors of trials as functions of z: parameters in deviations of their priors, then factors."""

    def __init__(self, trials: Sequence[Trial], assembly: Assembly, scale: Scale) -> None:
        self.trials, self.assembly, self.scale = trials, assembly, scale
        days = sorted({one.day for one in trials})
        self.daily = [(day, name) for day in days for name in DAILY if name in assembly.names]
        alike = math.sqrt(_ALIKE / _EVERY) / scale.finer
        self.sizes = {name: share * getattr(scale, name) * alike for name, share in _SIGMA.items()}

    def indices(self, *names: str) -> IntArray:
        """These parameters and their factors, where the assembly has them."""
        mine = set(self.assembly.names) & set(names)
        every = [p.name for p in PARAMETERS] + [name for _, name in self.daily]
        return np.array([k for k, name in enumerate(every) if name in mine])

    def days(self, z: FloatArray) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {one.day: {} for one in self.trials}
        for (day, name), x in zip(self.daily, z[len(PARAMETERS) :].tolist(), strict=True):
            out[day][name] = math.exp(DAILY[name] * x)
        return out

    def rows(self, model: _Model, z: FloatArray, free: IntArray, x: FloatArray) -> FloatArray:
        """Deviations x of the free entries from their priors, and scaled errors."""
        full = z.copy()
        full[free] = x
        values = self.assembly.values(full[: len(PARAMETERS)], self.scale)
        days, rows = self.days(full), [x]
        for one in self.trials:
            errors = model(one, parameters_on_day(one.day, values, days))
            rows += [error[::_EVERY] / self.sizes[name] for name, error in errors.items()]
        return np.asarray(np.clip(np.nan_to_num(np.concatenate(rows), nan=1e3), -1e3, 1e3))

    def slopes(self, model: _Model, z: FloatArray, free: IntArray, x: FloatArray) -> FloatArray:
        """Derivatives of `rows` by x."""
        sides = [
            self.rows(model, z, free, x + h) - self.rows(model, z, free, x - h)
            for h in _STEP * np.eye(len(x))
        ]
        return np.stack(sides, axis=1) / (2.0 * _STEP)

    def loosely(self, of: str, times: float) -> _Problem:
        """The same with larger errors of one kind."""
        other = copy(self)
        other.sizes = self.sizes | {of: times * self.sizes[of]}
        return other

    def solve(self, model: _Model, z: FloatArray, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """z with its free entries where errors and deviations are least, and their covariance."""
        rows, slopes = partial(self.rows, model, z, free), partial(self.slopes, model, z, free)
        found, out = least_squares(rows, z[free], jac=slopes, max_nfev=25, ftol=1e-3), z.copy()
        J = np.asarray(found.jac)
        out[free] = found.x
        return out, np.asarray(np.linalg.inv(J.T @ J), dtype=np.float64)


def fit(trials: Sequence[Trial], assembly: Assembly, scale: Scale, start: Fit | None = None) -> Fit:
    """The assembly with the smallest squared errors and deviations from its priors."""
    problem, count = _Problem(trials, assembly, scale), len(PARAMETERS)
    z = np.zeros(count + len(problem.daily))
    if start is not None:
        z[:count] = start.z
        z[count:] = [
            math.log(start.days.get(day, {}).get(name, 1.0)) / DAILY[name] for day, name in problem.daily
        ]
    drive = problem.indices(*(name for names in DRIVES.values() for name in names))
    segment, chord = problem.indices(*SEGMENT), problem.indices(*CHORD)
    covariance = np.eye(len(z))
    loose = problem.loosely("chord_m", _LOOSE)
    together = not any(len(one.pressure_kpa) and len(one.angle_rad) for one in trials)
    steps = [
        (loose, residuals_by_pressure, segment),
        (problem, residuals_by_pressure, chord),
        (loose, residuals_by_command, drive),
    ]
    if together:
        steps = [
            (loose, residuals_by_command, np.concatenate([drive, segment])),
            (problem, residuals_by_command, chord),
        ]
    for weighed, model, free in steps:
        if model is residuals_by_pressure or any(len(trial.command) for trial in trials):
            z, own = weighed.solve(model, z, free)
            covariance[free], covariance[:, free] = 0.0, 0.0
            covariance[np.ix_(free, free)] = own
    found, days = z[:count].copy(), problem.days(z)
    for k, one in enumerate(PARAMETERS):
        if one.name in DAILY and one.name in assembly.names:
            # What all days share is the parameter's.
            logs = [math.log(day[one.name]) for day in days.values()]
            shared = math.exp(sum(logs) / len(logs))
            found[k] = one.times(found[k], shared, scale)
            for day in days.values():
                day[one.name] /= shared
    return Fit(assembly, scale, found, covariance[:count, :count], days)


_NONE = np.zeros(0)


def parameter_errors(values: Mapping[str, float], trial: Trial) -> Errors:
    """Free-run errors on a trial, of parameters by name on its day."""
    off = residuals_by_command(trial, values)
    bent = residuals_by_pressure(trial, values).get("angle_rad", _NONE)
    names = ("angle_rad", "chord_m", "pressure_kpa")
    return {name: rms(off.get(name, _NONE)) for name in names} | {"angle_by_pressure_rad": rms(bent)}


def fit_errors(made: Fit, trial: Trial) -> Errors:
    """Free-run errors of a fit on a trial."""
    return parameter_errors(parameters_on_day(trial.day, made.values, made.days), trial)


# ----------------------------------------------------------------------
# Baselines.


_Pair = tuple[FloatArray, ...]
_Error = Callable[[Sequence[_Pair], _Pair], float]


def _arx_rows(u: FloatArray, y: FloatArray, order: int) -> FloatArray:
    k = np.arange(order, len(y))
    past = [y[k - i] for i in range(1, order + 1)] + [u[k - i] for i in range(1, order + 1)]
    return np.column_stack([*past, np.ones(len(k))])


def _arx_error(order: int, train: Sequence[_Pair], test: _Pair) -> float:
    """Free-run RMS of ARX, begun from the first measured values."""
    rows = np.concatenate([_arx_rows(u, y, order) for u, y in train])
    weights = np.linalg.lstsq(rows, np.concatenate([y[order:] for _, y in train]), rcond=None)[0]
    u, y = test
    out = y.copy()
    # An unstable model does not leave thrice the range that it has seen.
    low = min(float(one.min()) for _, one in train)
    high = max(float(one.max()) for _, one in train)
    low, high = low - (high - low), high + (high - low)
    for k in range(order, len(y)):
        past = np.concatenate([out[k - order : k][::-1], u[k - order : k][::-1], [1.0]])
        out[k] = min(max(float(weights @ past), low), high)
    return rms(out - y)


def _lag_error(train: Sequence[_Pair], test: _Pair) -> float:
    """Free-run RMS of one linear lag, its time the best of a grid."""

    def lagged(u: FloatArray, lag_s: float) -> FloatArray:
        from scipy.signal import lfilter

        a = math.exp(-STEP_S / lag_s)
        return np.asarray(lfilter([1.0 - a], [1.0, -a], u, zi=[a * u[0]])[0])

    best = (math.inf, 0.0, np.zeros(2))
    for lag_s in _LAGS_S:
        rows = np.concatenate([np.stack([lagged(u, lag_s), np.ones(len(u))], axis=1) for u, _ in train])
        y = np.concatenate([y for _, y in train])
        line = np.linalg.lstsq(rows, y, rcond=None)[0]
        best = min(best, (rms(rows @ line - y), lag_s, line), key=lambda one: one[0])
    u, y = test
    return rms(np.stack([lagged(u, best[1]), np.ones(len(u))], axis=1) @ best[2] - y)


def _baseline_errors(error: _Error, train: Sequence[Trial], trial: Trial, step_s: float = STEP_S) -> Errors:
    out, size = {}, round(step_s / STEP_S)
    for name, one in QUANTITIES.items():
        pairs = [
            tuple(blocks(getattr(of, column), size).mean(axis=1) for column in (one.source, one.target))
            for of in (*train, trial)
            if len(getattr(of, one.source)) and len(getattr(of, one.target))
        ]
        used = len(getattr(trial, one.source)) and len(getattr(trial, one.target)) and len(pairs) > 1
        out[name] = error(pairs[:-1], pairs[-1]) if used else math.nan
    return out


def baselines(trials: Sequence[Trial]) -> dict[str, dict[str, Errors]]:
    """Held errors of ARX and of a lag by name and trial.

    They are trained on the others of the same day where there are two at least, as they know no days.
    """
    out: dict[str, dict[str, Errors]] = {}
    for trial in trials:
        others = [one for one in trials if one is not trial]
        same = [one for one in others if one.day == trial.day and one.load_kg == trial.load_kg]
        train = same if len(same) > 1 else others
        for step_s in _ARX_STEPS_S:
            for order in _ORDERS:
                name = f"ARX {order} at {1.0 / step_s:g} Hz"
                errors = _baseline_errors(partial(_arx_error, order), train, trial, step_s)
                out.setdefault(name, {})[trial.name] = errors
        out.setdefault("a lag", {})[trial.name] = _baseline_errors(_lag_error, train, trial)
    return out


# ----------------------------------------------------------------------
# Held trials, deviations between trials, parts.


def held_fits(
    trials: Sequence[Trial], assembly: Assembly, scale: Scale, starts: Mapping[str, Fit] | None = None
) -> dict[str, Fit]:
    """Fits to all trials but one, by the name of that one; `starts` are other fits to the same."""
    return {
        one.name: fit(
            [other for other in trials if other is not one], assembly, scale, (starts or {}).get(one.name)
        )
        for one in trials
    }


def _held_errors(trials: Sequence[Trial], held: Mapping[str, Fit]) -> dict[str, Errors]:
    """Errors on each trial of the fit to the others, by name."""
    return {one.name: fit_errors(held[one.name], one) for one in trials}


def _deviations(made: Fit, held: Mapping[str, Fit]) -> dict[str, float]:
    """Standard deviations of the parameters: the posterior's or the jackknife's, the larger."""
    n, out = len(held), {}
    mine = made.assembly.names
    for k, parameter in enumerate(PARAMETERS):
        name = parameter.name
        if name not in mine:
            continue
        half = 0.5 * made.sigma[k]
        spread = parameter.value(made.z[k] + half, made.scale) - parameter.value(made.z[k] - half, made.scale)
        others = np.array([one.values[name] for one in held.values()])
        between = math.sqrt((n - 1) / n * float(np.sum((others - others.mean()) ** 2))) if n > 1 else 0.0
        out[name] = max(abs(spread), between)
    return out


def half_width(errors: Sequence[float]) -> float:
    """Half the 95 % interval of a further trial's samples, from the RMS errors of held trials.

    Degrees of freedom by how much the mean squares differ from trial to trial (Satterthwaite 1946): trials
    that are all alike tell their deviation, a single bad one among good ones makes it uncertain. At most two
    a trial, its offset and its gain: a few trials may be alike by chance.
    """
    squares = np.array([x * x for x in errors if math.isfinite(x)])
    if len(squares) < 2:
        return math.nan
    mean = float(squares.mean())
    freedom = len(squares) * 2.0 * mean**2 / max(float(squares.var(ddof=1)), 1e-9 * mean**2)
    return float(stdtrit(min(max(freedom, 1.0), 2.0 * len(squares)), 0.975)) * math.sqrt(mean)


_FINER = (3.0, 10.0)
_WORTHWHILE = 0.8
"""Held error with smaller errors, of that with the usual ones, that speaks for them."""


def _mean_held_error(
    trials: Sequence[Trial], held: Mapping[str, Fit], quantities: Sequence[str] = _BY_ANGLE
) -> float:
    """Geometric mean error of the held trials in the first quantity that there is, infinite without one.

    By default that is the angle by what drives the segment most closely.

    A trial that alone holds its load or day is far off whatever the parts, and outweighs no other.
    """
    errors = _held_errors(trials, held).values()
    for name in quantities:
        values = [one[name] for one in errors if math.isfinite(one[name])]
        if values:
            return math.exp(sum(math.log(max(x, 1e-9)) for x in values) / len(values))
    return math.inf


def _fit_without_each(
    trials: Sequence[Trial], assembly: Assembly, scale: Scale
) -> tuple[Scale, dict[str, Fit]]:
    """Fits to all trials but one, and the scale of errors that predicts these best.

    The usual errors are those of arms that creep, stick and settle. One that follows its pressure closely
    tells so by its held trials, and the priors give way to them.
    """

    best = last = held_fits(trials, assembly, scale)
    least = _WORTHWHILE * _mean_held_error(trials, best)
    for finer in _FINER:
        other = replace(scale, finer=finer)
        last = held_fits(trials, assembly, other, last)
        if (reached := _mean_held_error(trials, last)) <= least:
            scale, best, least = other, last, reached
    return scale, best


def inside_interval(values: Mapping[str, float], trial: Trial, half_rad: float) -> BoolArray:
    """Which samples (n,) of a trial's angle a free run meets to half an interval.

    From the command, or from the pressure of a trial without one, as in `angle_error`.
    """
    off = residuals_by_command(trial, values) or residuals_by_pressure(trial, values)
    return np.asarray(np.abs(off.get("angle_rad", _NONE)) <= half_rad)


def angle_error(errors: Errors) -> float:
    """RMS of the angle from the command, or from the pressure of a trial without one; NaN without a pose."""
    by = errors["angle_rad"]
    return by if math.isfinite(by) else errors["angle_by_pressure_rad"]


def _coverage(trials: Sequence[Trial], held: Mapping[str, Fit], errors: Mapping[str, Errors]) -> float:
    inside = [_NONE > 0.0]
    for one in trials:
        wide = half_width([angle_error(errors[other.name]) for other in trials if other is not one])
        if math.isfinite(wide):
            made = held[one.name]
            inside.append(inside_interval(parameters_on_day(one.day, made.values, made.days), one, wide))
    every = np.concatenate(inside)
    return float(every.mean()) if len(every) else math.nan


# ----------------------------------------------------------------------
# Which kind of trial to record next: what it would leave of the deviations, recorded twice.

_PLANNED_S = 60.0
_VENTED = 0.04
"""By how much of its chord a vented arm starts too short."""


def _plans(made: Fit) -> dict[str, Trial]:
    """Kinds of trials, the commands as shares of the greatest, and masses at the tip."""
    t = STEP_S * np.arange(round(_PLANNED_S / STEP_S), dtype=np.float64)
    steps = np.random.default_rng(0).uniform(size=20)[(t // 3.0).astype(int)]
    stairs = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25])[(t // 8.0).astype(int) % 8]
    rests = np.where(t % 20.0 < 10.0, 0.0, 1.0)
    kinds = {
        "warm-up cycles": (np.where(t % 3.0 < 1.5, 1.0, 0.0), 0.0, 0.0),
        "rests of 10 s": (rests, 0.0, 0.0),
        "a vented start": (rests, 0.0, _VENTED),
        "a slow staircase with holds": (stairs, 0.0, 0.0),
        "open-loop steps": (steps, 0.0, 0.0),
        "steps with 100 g": (steps, 0.1, 0.0),
        "steps with 200 g": (steps, 0.2, 0.0),
    }
    rest = made.values["rest_rad"]
    length = sum(made.values[name] * rest**k for k, name in enumerate(_CURVE))
    return {
        name: Trial(
            name, "", load_kg, t, made.scale.command * share, np.zeros(len(t)), np.full(len(t), rest),
            np.full(len(t), length * (1.0 - short)),
        )
        for name, (share, load_kg, short) in kinds.items()
    }  # fmt: skip


_CURVE = ("chord_m", "chord_m_per_rad", "chord_m_per_rad2")


def prospects(made: Fit) -> dict[str, dict[str, float]]:
    """What two more trials of a kind would leave of the posterior's deviations, by kind and parameter.

    A load plays its part too, as no log without a known one tells its compliance. The trials are of another
    day, whose factors have their priors.
    """
    parts = {*made.assembly.parts, "load"}
    assembly = Assembly(tuple(part.name for part in PARTS if part.name in parts))
    free = np.array([k for k, one in enumerate(PARAMETERS) if one.name in assembly.names])
    now = made.covariance[np.ix_(free, free)]
    out = {}
    for name, trial in _plans(made).items():
        problem = _Problem([trial], assembly, made.scale)
        z = np.append(made.z, np.zeros(len(problem.daily)))
        some = np.append(free, np.arange(len(made.z), len(z)))
        known = np.eye(len(some))
        known[: len(free), : len(free)] = np.linalg.inv(now)
        J = problem.slopes(residuals_by_command, z, some, z[some])[len(some) :]
        after = np.diag(np.linalg.inv(known + 2.0 * J.T @ J))[: len(free)]
        left = np.sqrt(after / np.diag(now))
        out[name] = {PARAMETERS[k].name: float(x) for k, x in zip(free, left, strict=True)}
    return out


@dataclass(frozen=True)
class _Choice:
    """The assembly that predicts held trials best.

    Attributes
    ----------
    held, errors : fits to all trials but one and their errors on it, by its name.
    others : held errors of assemblies that predict worse, by what is in them.
    """

    assembly: Assembly
    scale: Scale
    held: Mapping[str, Fit]
    errors: Mapping[str, Errors]
    others: Mapping[str, Mapping[str, Errors]]


def _choose_assembly(trials: Sequence[Trial], assembly: Assembly, drive: str, other_drive: str) -> _Choice:
    """The assembly with the one or the other drive, and with those of `_TRIED` that predict better."""
    assembly = assembly.driven_by(drive)
    scale, held = _fit_without_each(trials, assembly, data_scale(trials))
    errors = _held_errors(trials, held)
    others: dict[str, Mapping[str, Errors]] = {}
    if any(len(one.command) for one in trials):
        driven = assembly.driven_by(other_drive)
        fits = held_fits(trials, driven, scale, held)
        by_other = _held_errors(trials, fits)
        if mean_error(by_other, "angle_rad") <= _WORTHWHILE * mean_error(errors, "angle_rad"):
            others[f"a {drive} for the {other_drive}"] = errors
            assembly, held, errors = driven, fits, by_other
        else:
            others[f"a {other_drive} for the {drive}"] = by_other
    for name, by in _TRIED.items() if any(len(one.angle_rad) for one in trials) else ():
        more = Assembly((*assembly.parts, name))
        reached = _mean_held_error(trials, held_fits(trials, more, scale), by)
        if reached < _WORTHWHILE * _mean_held_error(trials, held, by):
            others[f"without {name}"] = errors
            assembly = more
            scale, held = _fit_without_each(trials, assembly, replace(scale, finer=1.0))
            errors = _held_errors(trials, held)
    return _Choice(assembly, scale, held, errors, others)


def identify(
    trials: Sequence[Trial],
    compare: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Identification:
    """Fit the assembly, hold each trial back, and compare other assemblies and baselines.

    Parameters
    ----------
    compare : whether the parts' worth is measured, which takes as long again for each.
    """
    assembly = FULL if any(one.load_kg > 0.0 for one in trials) else FULL.without("load")
    # A regulator that follows its command is none of the valves that integrate, and a lag is no orifice.
    drive, other_drive = ("lag", "pump") if any(one.pwm for one in trials) else ("valve", "lag")
    if len(trials) == 1:
        progress(1, 2)
        made = fit(trials, assembly.driven_by(drive), data_scale(trials))
        progress(2, 2)
        return Identification(tuple(trials), made, _deviations(made, {}), {}, {}, math.nan, prospects(made))
    chosen = _choose_assembly(trials, assembly, drive, other_drive)
    assembly, scale, held, others = chosen.assembly, chosen.scale, chosen.held, dict(chosen.others)
    parts = [name for name in WORTH if name in assembly.parts] if compare else []
    steps = 2 + len(parts)
    progress(1, steps)
    made = fit(trials, assembly, scale)
    progress(2, steps)
    for k, name in enumerate(parts):
        fits = held_fits(trials, assembly.without(name), scale, held)
        others[f"without {name}"] = _held_errors(trials, fits)
        progress(3 + k, steps)
    others |= baselines(trials)
    coverage = _coverage(trials, held, chosen.errors)
    sigma = _deviations(made, held)
    return Identification(tuple(trials), made, sigma, chosen.errors, others, coverage, prospects(made))


def best_baseline(found: Identification, quantity: str) -> str:
    """Name of the ARX with the smallest mean error of a quantity of `QUANTITIES`."""
    arx = [name for name in found.others if name.startswith("ARX")]
    return min(arx, key=lambda name: mean_error(found.others[name], quantity), default="")


def mean_error(errors: Mapping[str, Errors], quantity: str) -> float:
    """Mean over the trials that have it, NaN without one."""
    values = [one[quantity] for one in errors.values() if math.isfinite(one[quantity])]
    return sum(values) / len(values) if values else math.nan


def gain_over_baseline(
    found: Identification, baseline: str, quantity: str, level: float = 0.95
) -> tuple[float, float]:
    """By how much smaller the mean held error is than a baseline's, and half its paired interval at a level.

    Both are shares of the baseline's mean; the half is NaN for fewer than two trials.
    """
    pairs = [(found.others[baseline][name][quantity], one[quantity]) for name, one in found.held.items()]
    less = np.array([a - b for a, b in pairs if math.isfinite(a) and math.isfinite(b)])
    mean = mean_error(found.others[baseline], quantity)
    if not len(less):
        return math.nan, math.nan
    n = len(less)
    t = float(stdtrit(n - 1, 0.5 * (1.0 + level))) if n > 1 else math.nan
    half = t * float(less.std(ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return float(less.mean()) / mean, half / mean
