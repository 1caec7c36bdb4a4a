"""A pump from tables: models of it with its chamber, compared and judged, and the section `pump`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from scipy.special import chdtri

from calib.core.arrays import BoolArray, FloatArray, rms, robust_sigma, runs
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.core.result import finite_or_none, judged, section_json
from calib.core.rig import Rig
from calib.core.verdict import Finding, Verdict
from calib.solve.information import scaled_inverse
from calib.stages.actuator.identify import Progress
from calib.stages.actuator.parameters import SUPPLY_V, TICK_S
from calib.stages.actuator.pump import PWM_MAX
from calib.stages.actuator.section import (
    LAG,
    OF_LAG,
    ORIFICE,
    KnownPump,
    PumpIdentified,
    PumpModel,
    PumpSection,
    SettledRuns,
    StaticMapSection,
)

# ----------------------------------------------------------------------
# Two models of a pump with its chamber, from PWM to the pressure (or force) that a sensor sees.
#
# u(t) is the PWM value, T_d the dead time, s(u) the shape of the static map with s(255) = 1 and P its
# level, so that g(t) = P s(u(t - T_d)) is what the pump would settle at.
#
# `LAG`, the linear first-order lag of (3.5), with a limit R on the rising rate where data need one:
#
#     dp/dt = min((g - p) / tau, R)
#
# `ORIFICE`. Valves let the air in only, through a passage whose laminar and turbulent drops of pressure add
# up, and it leaks out through another. The sensor sits in a hose of small volume beside the chamber:
#
#     g - p = a w + b w^2            w = 2 (g - p) / (a + sqrt(a^2 + 4 b (g - p))), 0 for g < p
#     dp/dt = w - p / T_leak - c (p - z),   dz/dt = (p - z) / T_z
#
# with p the pressure in the hose, z that in the chamber, and w in units of pressure per second. It is the
# law of `calib.stages.actuator.pump.Orifice` on the way in. While the pump has never run, hose and chamber
# are taken for shut off from each other, as a valve leaves them.
#
# Commands are held between their time stamps. The simulation goes from one command's effect to the next,
# exactly for the lag, by steps of Runge and Kutta for the flow, and is smooth in T_d: on a grid of its own,
# whose steps get a command's mean, slopes jump in T_d, and a search ends at one of these kinks.

STEP_S = 2e-3
"""Stable at the bounds of all parameters."""
_DEAD_MOST_S = 0.5
_START_S = 0.2
_TICK_S = 1e-6
"""Times that differ by less are the same."""
_FREE = 1e6
_PRIOR = 0.15
"""What the first measured value counts for a start, in samples."""


@dataclass(frozen=True)
class Parameter:
    """One number of a model: unit, where a search starts, its bounds, and the value that switches it off.

    A unit of "y" is that of the measured values, and `start` and bounds are then multiples of their range, as
    those of "y/s" are.
    """

    name: str
    unit: str
    start: float
    low: float
    high: float
    off: float | None = None


_COMMON = (Parameter("dead_time_s", "s", 0.05, 0.0, _DEAD_MOST_S), Parameter("level", "y", 1.0, 0.05, 20.0))
MODELS: dict[str, tuple[Parameter, ...]] = {
    LAG: (
        *_COMMON,
        Parameter("lag_s", "s", 0.6, 0.005, 30.0),
        Parameter("rising_limit_per_s", "y/s", 0.5, 0.05, 200.0, _FREE),
    ),
    ORIFICE: (
        *_COMMON,
        Parameter("laminar_s", "s", 0.2, 1e-3, 30.0, 0.0),
        Parameter("turbulent_s2", "s^2/y", 0.2, 1e-5, 100.0),
        Parameter("leak_s", "s", 10.0, 0.02, 1000.0, _FREE),
        Parameter("hose_per_s", "1/s", 50.0, 0.1, 100.0, 0.0),
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
class Settled:
    """Settled values (n,) at PWM values (n,), of one mode."""

    name: str
    pwm: FloatArray
    value: FloatArray


@dataclass(frozen=True)
class PumpTable:
    """What a table holds: a recording over time, or settled values by mode; and sentences about it."""

    unit: str
    record: PumpRecord | None
    settled: tuple[Settled, ...]
    said: tuple[str, ...]


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


@kernel()
def _risen(p: float, g: float, lag_s: float, limit: float, for_s: float) -> float:
    """Pressure of the lag after some time under one command."""
    steep_s = max((g - p) / limit - lag_s, 0.0)
    if for_s <= steep_s:
        return p + limit * for_s
    return g + (p + limit * steep_s - g) * math.exp(-(for_s - steep_s) / lag_s)


@kernel()
def _lag(t: FloatArray, s: FloatArray, p: float, z: float, theta: FloatArray, out: FloatArray) -> None:
    p += z
    begin, i = t[0], 0
    for k in range(len(t)):
        g, end = theta[1] * s[k], t[k + 1] + theta[0] if k + 1 < len(t) else math.inf
        while i < len(out) and t[i] <= end:
            out[i] = _risen(p, g, theta[2], theta[3], t[i] - begin)
            i += 1
        if i == len(out):
            break
        p = _risen(p, g, theta[2], theta[3], end - begin)
        begin = end


@kernel()
def _flow(theta: FloatArray, g: float, p: float, z: float, hose: float) -> float:
    a, b = theta[2], theta[3]
    drop = g - p
    w = 2.0 * drop / (a + math.sqrt(a * a + 4.0 * b * drop)) if drop > 0.0 else 0.0
    return float(w - p / theta[4] - hose * (p - z))


@kernel()
def _orifice(t: FloatArray, s: FloatArray, p: float, z: float, theta: FloatArray, out: FloatArray) -> None:
    z += p
    begin, i, hose, fills = t[0], 0, 0.0, 0.0
    for k in range(len(t)):
        if s[k] > 0.0:
            hose, fills = theta[5], 1.0 / theta[6]
        g, last = theta[1] * s[k], k + 1 == len(t)
        end = t[k] + theta[0] + 1.0 if last else t[k + 1] + theta[0]
        # The number of steps does not depend on the dead time: the error would jump with it.
        steps = math.ceil((1.0 if last else t[k + 1] - t[k] + (_DEAD_MOST_S if k == 0 else 0.0)) / STEP_S)
        h = (end - begin) / steps
        for j in range(steps):
            at = begin + j * h
            f1, e1 = _flow(theta, g, p, z, hose), fills * (p - z)
            q, y = p + 0.5 * h * f1, z + 0.5 * h * e1
            f2, e2 = _flow(theta, g, q, y, hose), fills * (q - y)
            q, y = p + 0.5 * h * f2, z + 0.5 * h * e2
            f3, e3 = _flow(theta, g, q, y, hose), fills * (q - y)
            q, y = p + h * f3, z + h * e3
            f4, e4 = _flow(theta, g, q, y, hose), fills * (q - y)
            after = p + h / 6.0 * (f1 + 2.0 * (f2 + f3) + f4)
            z += h / 6.0 * (e1 + 2.0 * (e2 + e3) + e4)
            slope = _flow(theta, g, after, z, hose)
            while i < len(out) and t[i] <= at + h:
                x = (t[i] - at) / h
                out[i] = p + x * (
                    h * f1
                    + x
                    * (
                        3.0 * (after - p)
                        - h * (2.0 * f1 + slope)
                        - x * (2.0 * (after - p) - h * (f1 + slope))
                    )
                )
                i += 1
            p = after
            if i == len(out):
                return
        begin = end


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
    t, s = record.t_s - record.t_s[0], shape.of(record.pwm)
    run = _lag if model == LAG else _orifice
    first = float(record.value[0])

    def at(offset: float, count: int) -> FloatArray:
        out = np.empty(count)
        run(t, s, first, offset, theta, out)
        return out

    head = int(np.sum(t <= start_s + _TICK_S))
    if head < 3:
        return at(0.0, len(t))
    # The beginning is all but linear in the offset.
    base, nudge = at(0.0, head), 0.02 * max(float(np.ptp(record.value)), 1e-9)
    by = (at(nudge, head) - base) / nudge
    return at(float(by @ (record.value[:head] - base)) / (float(by @ by) + _PRIOR), len(t))


# ----------------------------------------------------------------------
# Fitting a pump's models to recordings, what the fit is worth, and what it does not explain.
#
# Robust non-linear least squares (soft L1) on simulated minus measured pressure, all recordings at once,
# from several starts. A simulation runs free: it sees the PWM and the first fifth of a second of the
# measured values, nothing else. What is left over is the models' error and not noise, so it is coloured;
# standard deviations are therefore those of a sandwich, H^-1 (sum g g^T) H^-1, with the gradient g summed
# over whole recordings, or over stretches of a second where there are fewer than four recordings. Where
# recordings differ by more than what counts as one, the robust loss is all but that of a median, and H is
# made by the few rows near it; so none is less than what leaving out each recording in turn says (jackknife).
#
# A parameter that can be switched off (a limit, a leak, a hose) is taken only if the data ask for it, by
# two measures. One that they do not ask for lowers the robust cost all the same, by lambda chi^2_1 / 2,
# where lambda = g^2 / h with the variance g^2 of its gradient and its curvature h; lambda is 1 for white
# noise, and much more for what a model misses, which is the same all along a recording. It is measured:
# fitted without a recording, the parameters raise the cost of what is left out by lambda each, over all
# recordings together. So k parameters have to lower the cost by more than lambda chi^2_k(0.95) / 2. And
# they have to lower it by `_WORTH` for each extra: the start is read off noisy values, and taking up its
# error, an extra that the truth has not lowers the cost of a simulated pump by 2 %, not by chance.

_WORTH = 0.03
_CONFIDENCE = 0.95
_SCALE_SHARE = 0.01
_AHEAD_S = 0.5
_FEWEST_CLUSTERS = 4
_STEP = 1e-4
_MOST, _FARTHEST = 100, 1.0
_STANDS, _NEAR = 1e-9, 1e-3
"""Steps, as parts of each parameter, below which a search has ended, or is near enough to be compared."""
_DEAD_S = 0.05


@dataclass(frozen=True)
class PumpFit:
    """A fitted model.

    Attributes
    ----------
    model : of `MODELS`. theta : all its parameters, in order.
    fitted : names of those that were estimated; sigma : their standard deviations.
    correlation : (n, n) of the fitted ones.
    fixed : sentences by name for those that were not.
    rms : over all samples that were fitted. shape : of the static map.
    """

    model: str
    theta: FloatArray
    fitted: tuple[str, ...]
    sigma: dict[str, float]
    correlation: FloatArray
    rms: float
    cost: float
    shape: Shape
    fixed: dict[str, str] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name."""
        return dict(zip([p.name for p in MODELS[self.model]], self.theta.tolist(), strict=True))

    def settles(self, between: float = 0.0) -> tuple[float, float]:
        """Where a run settles at full PWM, and its deviation.

        Parameters
        ----------
        between : standard deviation of the level from run to run, which its `sigma` has in it.
        """

        def at(theta: FloatArray) -> float:
            if self.model == LAG:
                return float(theta[1])
            # What flows in leaks out, w = p / T_leak.
            _, g, a, b, leak_s, *_ = theta.tolist()
            half = 1.0 + a / leak_s
            return float(2.0 * g / (half + math.sqrt(half * half + 4.0 * b * g / leak_s**2)))

        names = [p.name for p in MODELS[self.model]]
        slopes, spread = np.zeros(len(self.fitted)), np.zeros(len(self.fitted))
        for k, name in enumerate(self.fitted):
            j, more = names.index(name), self.theta.copy()
            more[j] += _STEP * self.theta[j]
            slopes[k] = (at(more) - at(self.theta)) / (_STEP * self.theta[j]) if self.theta[j] else 0.0
            added = between if name == "level" else 0.0
            spread[k] = math.sqrt(max(self.sigma[name] ** 2 - added**2, 0.0))
        part = slopes * spread
        own = math.sqrt(max(float(part @ self.correlation @ part), 0.0))
        return at(self.theta), math.hypot(own, float(slopes[self.fitted.index("level")]) * between)

    def run(self, record: PumpRecord, start_s: float = _START_S) -> FloatArray:
        """Values (n,) of `simulate_pump`."""
        return simulate_pump(self.model, self.theta, record, self.shape, start_s)


@dataclass(frozen=True)
class Held:
    """Errors on a recording that was not fitted: free run, and `_AHEAD_S` ahead of measured values.

    `settles` is by how much it ends above the free run, over its last second; NaN where it does not run near
    full PWM then. `level` is by how much another level would explain the whole run better; NaN where it
    hardly runs at a PWM that tells. `theta`: parameters of the free run. `span`: range of the recording.
    """

    name: str
    theta: FloatArray
    span: float
    rms: float
    ahead: float
    settles: float = math.nan
    level: float = math.nan


@dataclass(frozen=True)
class _Problem:
    """Recordings and the scales of a fit."""

    model: str
    records: Sequence[PumpRecord]
    shape: Shape
    span: float

    @property
    def unit(self) -> dict[str, float]:
        return {"y": self.span, "y/s": self.span, "s^2/y": 1.0 / self.span}

    def nominal(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Starts and bounds, in SI and in the unit of the values."""
        rows = [
            [x * self.unit.get(p.unit, 1.0) for x in (p.start, p.low, p.high)] for p in MODELS[self.model]
        ]
        start, low, high = np.array(rows).T
        return start, low, high

    def residual(self, theta: FloatArray, without: slice | None = None) -> FloatArray:
        """Simulated minus measured, in parts of the range that count as one; `without` leaves rows out."""
        off = np.concatenate(
            [simulate_pump(self.model, theta, r, self.shape) - r.value for r in self.records]
        )
        off /= _SCALE_SHARE * self.span
        return off if without is None else np.delete(off, without)

    def off(self) -> FloatArray:
        return np.array([math.nan if p.off is None else p.off for p in MODELS[self.model]])


def _solve(
    problem: _Problem,
    theta: FloatArray,
    free: list[int],
    stands: float = _STANDS,
    without: slice | None = None,
) -> tuple[FloatArray, float]:
    """Least squares over some parameters: values and robust cost per sample.

    Over logarithms: a level and a resistance that only their quotient is known of lie on a straight line
    there. The search ends where parameters move by less than `stands` of themselves, so that its end does
    not depend on the way. `without` leaves some rows out.
    """
    from scipy.optimize import least_squares

    _, low, high = problem.nominal()
    ratio = [k for k in free if low[k] > 0.0]

    def inward(full: FloatArray) -> FloatArray:
        out = full / _DEAD_S
        out[ratio] = np.log(full[ratio])
        return np.asarray(out[free])

    def outward(x: FloatArray) -> FloatArray:
        out = theta.copy()
        out[free] = _DEAD_S * x
        out[ratio] = np.exp(x[[free.index(k) for k in ratio]])
        return out

    def rows(x: FloatArray) -> FloatArray:
        return problem.residual(outward(x), without)

    def slopes(x: FloatArray) -> FloatArray:
        full = outward(x)
        unit = np.array([full[k] if low[k] > 0.0 else _DEAD_S for k in free])
        return np.asarray(_slopes(problem, full, free, without) * unit)

    least, most = inward(low), inward(high)
    begin = np.clip(inward(np.clip(theta, low, high)), least + 1e-9, most - 1e-9)
    found = least_squares(
        rows,
        begin,
        jac=slopes,
        bounds=(least, most),
        loss="soft_l1",
        max_nfev=_MOST,
        xtol=stands,
        ftol=1e-14 if stands == _STANDS else 1e-6,
        gtol=None,
    )
    return outward(found.x), float(found.cost) / len(found.fun)


def _clusters(problem: _Problem) -> list[slice]:
    """Stretches whose residuals are taken to be independent of each other."""
    out, at = [], 0
    for record in problem.records:
        n = len(record.t_s)
        if len(problem.records) >= _FEWEST_CLUSTERS:
            out.append(slice(at, at + n))
        else:
            pieces = max(int(record.t_s[-1] - record.t_s[0]), 1)
            edges = np.linspace(at, at + n, pieces + 1).astype(int).tolist()
            out += [slice(a, b) for a, b in pairwise(edges)]
        at += n
    return out


def _slopes(
    problem: _Problem, theta: FloatArray, free: list[int], without: slice | None = None
) -> FloatArray:
    """Derivatives of the scaled residuals by the free parameters."""
    start, low, high = problem.nominal()
    columns = []
    for k in free:
        h = _STEP * max(abs(theta[k]), abs(start[k]))
        ahead, behind = theta.copy(), theta.copy()
        ahead[k], behind[k] = min(theta[k] + h, high[k]), max(theta[k] - h, low[k])
        difference = problem.residual(ahead, without) - problem.residual(behind, without)
        columns.append(difference / (ahead[k] - behind[k]))
    return np.column_stack(columns)


def _by_chance(problem: _Problem, theta: FloatArray, free: list[int], extras: int) -> float:
    """How much a number of parameters that are not needed lowers the cost per sample, at most in 95 %."""
    base = problem.residual(theta)
    rise = 0.0
    for s in _clusters(problem):
        moved, _ = _solve(problem, theta, free, _NEAR, s)
        left_out = problem.residual(moved)[s]
        rise += float(np.sum(np.sqrt(1.0 + left_out**2) - np.sqrt(1.0 + base[s] ** 2)))
    lam = max(rise, 0.0) / len(free) / len(base)
    return 0.5 * lam * float(chdtri(extras, 1.0 - _CONFIDENCE))


def _covariance(problem: _Problem, theta: FloatArray, free: list[int]) -> FloatArray:
    """Sandwich covariance of the free parameters under the robust loss."""
    base, J = problem.residual(theta), _slopes(problem, theta, free)
    weight = 1.0 / np.sqrt(1.0 + base * base)
    H = (J * weight[:, None]).T @ J
    G = [J[s].T @ (weight[s] * base[s]) for s in _clusters(problem)]
    middle = sum((np.outer(g, g) for g in G), np.zeros_like(H)) * (len(G) / max(len(G) - 1, 1))
    inverse = scaled_inverse(H, 1e-12)
    return np.asarray(inverse @ middle @ inverse)


def _check(records: Sequence[PumpRecord]) -> float:
    if not records:
        raise BadInputError("pump: found no recording with values over time, expected at least one")
    span = float(max(np.ptp(r.value) for r in records))
    if span <= 0.0:
        names = ", ".join(r.name for r in records)
        raise BadInputError(f"{names}: neither PWM nor the measured value ever changes, expected steps")
    return span


def fit_pump(
    records: Sequence[PumpRecord], model: str, shape: Shape | None = None, start: FloatArray | None = None
) -> PumpFit:
    """Estimate a model of the pump.

    Parameters
    ----------
    model : `LAG` or `ORIFICE`.
    shape : of the static map; a straight line through zero by default.
    start : parameters to search from instead of several starts; those at their off value stay there.

    Raises
    ------
    BadInputError without recordings, or when nothing changes in any of them.
    """
    span = _check(records)
    problem = _Problem(model, records, shape or Shape(), span)
    names = [p.name for p in MODELS[model]]
    nominal, _, _ = problem.nominal()
    off = problem.off()
    fixed: dict[str, str] = {}
    if start is not None:
        free = np.flatnonzero(start != off).tolist()
        theta, cost = _solve(problem, start, free)
    else:
        theta, cost, free = _search(problem, nominal, off, fixed)
    covariance = _covariance(problem, theta, free)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    residual = problem.residual(theta) * _SCALE_SHARE * span
    return PumpFit(
        model,
        theta,
        tuple(names[k] for k in free),
        {names[k]: float(s) for k, s in zip(free, sigma, strict=True)},
        covariance / np.outer(safe, safe),
        rms(residual),
        cost,
        problem.shape,
        fixed,
    )


def _search(
    problem: _Problem, nominal: FloatArray, off: FloatArray, fixed: dict[str, str]
) -> tuple[FloatArray, float, list[int]]:
    """The plain model from several starts, then the set of extras that earns its place."""
    names = [p.name for p in MODELS[problem.model]]
    if problem.model == LAG:
        groups: list[tuple[str, ...]] = [("rising_limit_per_s",)]
        always = [0, 1, 2]
    else:
        groups = [("laminar_s",), ("leak_s",), ("hose_per_s", "chamber_s")]
        always = [0, 1, 3]
    plain = np.where(np.isnan(off), nominal, off)
    best, cost = plain, math.inf
    for factor in (0.3, 1.0, 3.0):
        for dead_time_s in (0.03, 0.1):
            begin = plain.copy()
            begin[always[-1]] *= factor
            begin[0] = dead_time_s
            theta, value = _solve(problem, begin, always, _NEAR)
            if value < cost:
                best, cost = theta, value
    free, first = list(always), best
    scores: dict[tuple[tuple[str, ...], ...], float] = {(): cost}
    chances: dict[tuple[tuple[str, ...], ...], float] = {(): 0.0}
    lowest, chance = cost, 0.0
    for count in range(1, len(groups) + 1):
        for chosen in combinations(groups, count):
            members = [names.index(name) for group in chosen for name in group]
            begin = first.copy()
            begin[members] = nominal[members]
            wider = sorted(always + members)
            theta, value = _solve(problem, begin, wider, _NEAR)
            scores[chosen] = value
            worth = value * (1.0 + _WORTH) ** count
            if worth >= lowest or _vague(problem, theta, wider, off):
                continue
            chances[chosen] = _by_chance(problem, theta, wider, len(members))
            if value + chances[chosen] < cost + chance:
                best, cost, free, lowest, chance = theta, value, wider, worth, chances[chosen]
    for group in groups:
        if names.index(group[0]) not in free:
            more = {
                c: v
                for c, v in scores.items()
                if group in c and all(names.index(g[0]) in free for g in c if g != group)
            }
            with_it = min(more, key=lambda c: more[c])
            gain = max(1.0 - more[with_it] / cost, 0.0)
            bound = max(chances.get(with_it, 0.0) / cost, _WORTH)
            why = f"it would lower the cost by {100.0 * gain:.2g} %, where {100.0 * bound:.2g} % say nothing"
            fixed |= dict.fromkeys(group, f"off: {why if gain <= bound else 'it is not bounded'}")
    best, cost = _solve(problem, best, free)
    return best, cost, free


def _vague(problem: _Problem, theta: FloatArray, free: list[int], off: FloatArray) -> bool:
    """Whether a parameter that infinity switches off cannot be told from infinity."""
    sigma = np.sqrt(np.maximum(np.diag(_covariance(problem, theta, free)), 0.0))
    return any(
        off[k] == _FREE and not s <= 0.7 * abs(theta[k]) for k, s in zip(free, sigma.tolist(), strict=True)
    )


def rms_ahead(fit: PumpFit, record: PumpRecord) -> float:
    """RMS of predictions `_AHEAD_S` ahead of a measured value, begun anew ten times in it."""
    t = record.t_s
    begin, errors = float(t[0]), []
    while begin + _AHEAD_S < float(t[-1]):
        # A tenth of a second before the beginning gives the start, as with a whole recording.
        rows = np.nonzero((t >= begin - 0.1) & (t <= begin + _AHEAD_S))[0]
        if len(rows) >= 10:
            part = PumpRecord(record.name, t[rows], record.pwm[rows], record.value[rows])
            known = float(begin - t[rows[0]]) if begin > float(t[0]) else 0.04
            told = fit.run(part, known)
            late = t[rows] >= begin + 0.9 * _AHEAD_S
            errors.append((told - part.value)[late])
        begin += 0.1 * _AHEAD_S
    return rms(np.concatenate([np.zeros(0), *errors]))


def cross_validate(fit: PumpFit, records: Sequence[PumpRecord]) -> list[Held]:
    """Each recording predicted by a fit to all others; empty for a single one."""
    out = []
    for k, held in enumerate(records):
        others = [r for i, r in enumerate(records) if i != k]
        if not others:
            return []
        again = fit_pump(others, fit.model, fit.shape, fit.theta)
        out.append(held_by(again, held))
    return out


def held_by(fit: PumpFit, record: PumpRecord) -> Held:
    """Errors of a fit on a recording that it has not seen."""
    run, late = fit.run(record), _near_full(record)
    off = record.value - run
    settles = float(np.mean(off[late])) if late is not None else math.nan
    # A controller lowers the PWM of a run whose level is high, so that its end does not tell.
    at = [p.name for p in MODELS[fit.model]].index("level")
    more = fit.theta.copy()
    more[at] *= 1.0 + _LITTLE
    rises = (replace(fit, theta=more).run(record) - run) / (_LITTLE * fit.theta[at])
    tells = float(np.mean(rises**2)) > _FOLLOWS**2
    level = float(rises @ off) / float(rises @ rises) if tells else math.nan
    span = float(np.ptp(record.value))
    return Held(record.name, fit.theta, span, rms(off), rms_ahead(fit, record), settles, level)


def _near_full(record: PumpRecord) -> BoolArray | None:
    """Rows of a run's last second, where it runs at full PWM but for a twentieth then and changes at all."""
    late = record.t_s >= record.t_s[-1] - _SETTLED_S
    full = (
        float(np.median(record.pwm[late])) >= (1.0 - _APART) * PWM_MAX and float(np.ptp(record.value)) > 0.0
    )
    return late if full else None


def with_run_sigma(fit: PumpFit, held: Sequence[Held]) -> tuple[PumpFit, float]:
    """The fit with deviations by runs left out, that of the level for a further run, and what runs add to it.

    None is less than that of the jackknife, sqrt((n - 1) / n sum (theta_i - mean)^2). Runs of one pump settle
    apart for reasons that no PWM tells. How the samples of a run scatter says nothing of that; by how much
    held runs end off their prediction does, or are off it as a whole. NaN for fewer than two.
    """
    if not held:
        return fit, math.nan
    names = [p.name for p in MODELS[fit.model]]
    moved = math.sqrt(len(held) - 1) * np.std([one.theta for one in held], axis=0)
    fit = replace(fit, sigma={k: max(s, float(moved[names.index(k)])) for k, s in fit.sigma.items()})
    told = [[abs(x) for x in (one.settles, one.level) if math.isfinite(x)] for one in held]
    off = [max(one) for one in told if one]
    if len(off) < 2 or "level" not in fit.sigma:
        return fit, math.nan
    between = rms(np.array(off))
    sigma = {**fit.sigma, "level": math.hypot(fit.sigma["level"], between)}
    return replace(fit, sigma=sigma), between


# ----------------------------------------------------------------------
# What a pump's model cannot explain: runs that settle apart at the same PWM, and where runs leave it.

_SETTLED_S = 1.0
_LITTLE, _FOLLOWS = 0.01, 0.5
"""Change of a level, as a part of it, that tells how a run follows it; what of it a run has to follow (RMS)
to tell a level."""
_APART = 0.05
_LONG_S = 0.3
_STEADY_PWM = 3.0
_JUMP_S = 0.1


@dataclass(frozen=True)
class Departure:
    """Where a run leaves the model: time from its start [s], error there after, and whether PWM had moved."""

    name: str
    at_s: float
    error: float
    pwm_moved: bool


def settled_groups(records: Sequence[PumpRecord]) -> tuple[SettledRuns, ...]:
    """Groups of runs by the value of their last second, for runs near full PWM that have settled by then.

    Two groups are apart by more than a twentieth of the largest value. A value that moves by half of that
    within the second, as behind a PWM that was another until then, has not settled.
    """
    ends = []
    for record in records:
        late = _near_full(record)
        if late is not None and _moves(record.value[late]) <= 0.5 * _APART:
            pwm = record.pwm[late]
            value = float(np.median(record.value[late]))
            ends.append((value, record.name, float(np.quantile(pwm, 0.05)), float(pwm.max())))
    ends.sort()
    groups: list[list[tuple[float, str, float, float]]] = []
    for end in ends:
        if groups and end[0] - groups[-1][-1][0] <= _APART * max(abs(e[0]) for e in ends):
            groups[-1].append(end)
        else:
            groups.append([end])
    return tuple(
        SettledRuns(
            value=float(np.mean([e[0] for e in group])),
            spread=float(np.std([e[0] for e in group])),
            pwm=[min(e[2] for e in group), max(e[3] for e in group)],
            files=[e[1] for e in group],
        )
        for group in groups
    )


def _moves(value: FloatArray) -> float:
    """How far values (n,) go from their first fifth to their last, as a part of the latter."""
    some = len(value) // 5 + 1
    begin, end = float(np.median(value[:some])), float(np.median(value[-some:]))
    return abs(end - begin) / max(abs(end), 1e-12)


def departures(fit: PumpFit, records: Sequence[PumpRecord]) -> tuple[Departure, ...]:
    """Runs whose error grows beyond a twentieth of their range and stays there, and when it began."""
    out = []
    for record in records:
        error = record.value - fit.run(record)
        limit = _APART * float(np.ptp(record.value))
        large = np.abs(error) > limit
        # The last stretch of large errors, up to the end of the run.
        small = np.nonzero(~large)[0]
        first = int(small[-1]) + 1 if len(small) else 0
        if first >= len(error) or record.t_s[-1] - record.t_s[first] < _LONG_S:
            continue
        # Back to where the error was last within a quarter of that.
        near = np.nonzero(np.abs(error[: first + 1]) < 0.25 * limit)[0]
        begin = int(near[-1]) if len(near) else first
        before = (record.t_s <= record.t_s[begin]) & (record.t_s > record.t_s[begin] - _LONG_S)
        moved = float(np.ptp(record.pwm[before])) > _STEADY_PWM
        out.append(
            Departure(
                record.name,
                float(record.t_s[begin] - record.t_s[0]),
                float(np.median(error[first:])),
                moved,
            )
        )
    return tuple(out)


def jumps(records: Sequence[PumpRecord]) -> tuple[tuple[str, float, float], ...]:
    """Runs that begin with a jump: name, its size, and the value before it.

    A jump is a rise within a tenth of a second that is more than twice as fast as that of the
    tenth after it, and more than a twentieth of the range. Of a reading that a slow sensor repeats the last
    row counts.
    """
    out = []
    for record in records:
        last = np.append(np.diff(record.value) != 0.0, True)
        t, y = (record.t_s - record.t_s[0])[last], record.value[last]
        found = []
        for k in np.nonzero(t < 0.3)[0].tolist():
            after = np.searchsorted(t, t[k] + 0.4 * _JUMP_S)
            later = np.searchsorted(t, t[k] + 1.4 * _JUMP_S)
            if later >= len(t):
                break
            rise, next_rise = float(y[after] - y[k]), float(y[later] - y[after])
            slope = next_rise / max(float(t[later] - t[after]), 1e-9) * float(t[after] - t[k])
            if rise > 2.0 * max(slope, 0.0) and rise > _APART * float(np.ptp(y)):
                found.append((rise - slope, float(y[k])))
        if found:
            out.append((record.name, *max(found)))
    return tuple(out)


_STAYS = 10
_STILL_RISES = 5e-3
"""Of the range within three samples; a lag of .6 s at 50 Hz rises so at 95 % of its end."""


def ceiling(record: PumpRecord) -> tuple[float, float] | None:
    """The largest value and when a run comes to stay at it without having slowed down; None for others.

    A chamber that fills stays at a reading ever longer, or, with a lag of hardly a sample, comes to its end
    by steps each of a small part of the last.
    """
    t, y = record.t_s - record.t_s[0], record.value
    k, behind = max(runs(y == y.max()), key=lambda one: one[1] - one[0])
    if k < 3 or behind - k < _STAYS:
        return None
    steps = np.diff(y[k - 3 : k + 1])
    if min(steps) <= 0.0 or steps[1] < 0.5 * steps[0] or steps.sum() < _STILL_RISES * float(np.ptp(y)):
        return None
    return float(y[k]), float(t[k])


# ----------------------------------------------------------------------
# The static map of a pump from settled values: dead zone, saturation, and what scatters about them.
#
#     y(u) = Y (1 - exp(-(u - u0) / S)) / (1 - exp(-(255 - u0) / S)) for u > u0, else 0
#
# with the value Y at PWM 255, the dead zone u0 and the scale S of the saturation; the map has reached 95
# % of its end at u0 + 3 S at most. Least squares with soft L1 loss on the magnitudes; standard deviations
# from the scatter of the settled values about the map, those that lie far off counted as outliers and
# named.

_FEWEST = 5
_FAR = 4.0


@dataclass(frozen=True)
class StaticMap:
    """A fitted static map, of settled values (n,) at PWM values (n,) of a table or a part of it."""

    name: str
    fit: StaticMapSection
    pwm: FloatArray
    value: FloatArray

    @property
    def shape(self) -> Shape:
        """Dead zone and saturation."""
        return Shape(self.fit.dead_pwm, self.fit.scale_pwm)

    def of(self, pwm: FloatArray) -> FloatArray:
        """Settled value of PWM values (n,)."""
        return np.asarray(self.fit.end * self.shape.of(pwm))


def fit_static_map(name: str, pwm: FloatArray, value: FloatArray) -> StaticMap:
    """Fit the map to settled values (n,) at PWM values (n,), all of one sign.

    Raises `BadInputError` for fewer than five levels of PWM or values that are all alike.
    """
    from scipy.optimize import least_squares

    u, y = np.asarray(pwm, dtype=np.float64), np.asarray(value, dtype=np.float64)
    if len(np.unique(u)) < _FEWEST:
        raise BadInputError(
            f"{name}: has {len(np.unique(u))} levels of PWM, expected at least {_FEWEST}; rows "
            "that are a second apart are taken for settled values: is the time in seconds?"
        )
    sign = -1.0 if float(np.median(y)) < 0.0 else 1.0
    size = sign * y
    top = float(np.quantile(size, 0.9))
    if not top > 0.0:
        raise BadInputError(f"{name}: the settled values are all zero, expected the pump's effect")

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray((x[0] * Shape(float(x[1]), float(x[2])).of(u) - size) / (0.02 * top))

    low, high = np.array([0.1 * top, 0.0, 3.0]), np.array([5.0 * top, float(u.max()) - 5.0, 400.0])
    best = None
    for dead in (0.3 * float(u.min()), 0.9 * float(u.min())):
        for scale in (15.0, 60.0, 200.0):
            found = least_squares(
                residual,
                np.clip([top, dead, scale], low * 1.01 + 1e-9, high * 0.99),
                bounds=(low, high),
                x_scale=[top, 50.0, 50.0],
                loss="soft_l1",
            )
            if best is None or found.cost < best.cost:
                best = found
    assert best is not None
    end, dead, scale = (float(v) for v in best.x)
    error = residual(best.x)
    scatter = max(robust_sigma(error), 1e-6)
    far = np.abs(error) > _FAR * scatter
    J = np.asarray(best.jac)[~far]
    inside = [k for k in range(3) if low[k] * 1.001 < best.x[k] < high[k] * 0.999]
    sigma = {"end": math.inf, "dead_pwm": math.inf, "scale_pwm": math.inf}
    weight = error[~far]
    noise = float(np.sqrt(np.sum(weight**2) / max(len(weight) - len(inside), 1)))
    H = J[:, inside].T @ J[:, inside]
    if len(J) > len(inside) and np.linalg.cond(H) < 1e14:
        spread = noise * np.sqrt(np.diag(np.linalg.inv(H)))
        for k, s in zip(inside, spread.tolist(), strict=True):
            sigma[("end", "dead_pwm", "scale_pwm")[k]] = s
    reach = -scale * math.log1p(0.95 * math.expm1(-(PWM_MAX - dead) / scale))
    fit = StaticMapSection(
        end=sign * end,
        dead_pwm=dead,
        scale_pwm=scale,
        saturates_pwm=dead + reach,
        scatter=scatter * 0.02 * top,
        sigma={key: finite_or_none(one) for key, one in sigma.items()},
        outliers_pwm=sorted(u[far].tolist()),
    )
    return StaticMap(name, fit, u, y)


# ----------------------------------------------------------------------
# Both models on recordings, and the static maps of settled values.


@dataclass(frozen=True)
class PumpFound:
    """Everything that `calib identify pump` has found.

    Attributes
    ----------
    unit : of the values. records : recordings over time.
    fits, held : by model. asked : errors on recordings that were kept out on purpose, by model.
    between : standard deviation of where a run settles about the fit, by model.
    maps : static maps. groups, departs, leaps : what is not explained.
    """

    unit: str
    records: tuple[PumpRecord, ...]
    fits: dict[str, PumpFit]
    held: dict[str, list[Held]]
    asked: dict[str, list[Held]]
    between: dict[str, float]
    maps: tuple[StaticMap, ...]
    groups: tuple[SettledRuns, ...]
    departs: tuple[Departure, ...]
    leaps: tuple[tuple[str, float, float], ...]
    said: tuple[str, ...]

    @property
    def main_group(self) -> SettledRuns | None:
        """The largest group of runs, None where all settle alike or too few do."""
        if len(self.groups) < 2:
            return None
        return max(self.groups, key=lambda g: len(g.files))

    def held_rms(self, model: str, names: Sequence[str] | None = None) -> float | None:
        """RMS over recordings that were not fitted, each counting alike; None without any."""
        some = [h.rms for h in self.held[model] if names is None or h.name in names]
        return rms(np.array(some)) if some else None

    def settles(self, model: str) -> tuple[float, float, int, int] | None:
        """Where a further run settles at full PWM, half its 95 % interval, and how many of the held runs end
        inside that which the others give, of how many; None where fewer than three were held.

        Three deviations hold 95 % of any distribution with one peak (Vysochanskij and Petunin 1980). Where
        another model that meets the held runs as well settles is inside.
        """
        ends = [h.settles for h in self.held[model] if math.isfinite(h.settles)]
        if len(ends) < _FEWEST_RUNS or "level" not in self.fits[model].sigma:
            return None
        inside = sum(
            abs(end)
            <= 3.0 * math.hypot(*(other for j, other in enumerate(ends) if j != k)) / math.sqrt(len(ends) - 1)
            for k, end in enumerate(ends)
        )
        at, sigma = self.fits[model].settles(self.between[model])
        as_good = _AS_GOOD * (self.held_rms(model) or 0.0)
        elsewhere = max(
            abs(fit.settles()[0] - at) for m, fit in self.fits.items() if (self.held_rms(m) or 0.0) <= as_good
        )
        return at, math.hypot(3.0 * sigma, elsewhere), inside, len(ends)

    @property
    def better(self) -> str | None:
        """The model with the smaller error on recordings not fitted; None without recordings."""
        if not self.fits:
            return None
        return min(self.fits, key=lambda m: self.held_rms(m) or self.fits[m].rms)


def _chosen_shape(records: Sequence[PumpRecord], maps: Sequence[StaticMap], sign: float) -> Shape:
    """The static map's shape that lets the plain lag fit best: a straight line, or one of the tables'.

    The records' values are `sign` times the tables'.
    """
    rising = [m for m in maps if sign * m.fit.end * float(np.median([r.value[-1] for r in records])) > 0.0]
    shapes = [Shape(), *(m.shape for m in rising)]
    if len(shapes) == 1:
        return shapes[0]
    # Judged by the model that a drop of the PWM can tell anything about.
    costs = [fit_pump(records, LAG, shape).cost for shape in shapes]
    return shapes[int(np.argmin(costs))]


def identify_pump(
    tables: Sequence[PumpTable], kept_out: Sequence[PumpTable] = (), progress: Progress | None = None
) -> PumpFound:
    """Dead time, lag, static map and flow of a pump, both models compared on recordings not fitted.

    Parameters
    ----------
    kept_out : tables that are predicted and not fitted.

    Raises
    ------
    BadInputError for tables of different units, and where nothing changes in any.
    """
    units = {table.unit for table in (*tables, *kept_out)}
    if len(units) != 1:
        raise BadInputError(f"pump: found tables in {' and '.join(sorted(units))}, expected one unit")
    said = [sentence for table in tables for sentence in table.said]
    records = []
    for table in tables:
        record = table.record
        if record is None:
            continue
        if not np.ptp(record.pwm) and float(np.ptp(record.value)) < 1e-9:
            said.append(f"{record.name}: neither PWM nor value ever changes; left out")
            continue
        records.append(record)
    outside = [table.record for table in kept_out if table.record is not None]
    # The models' flow goes in: what a vacuum pump draws out is counted downward.
    sign = -1.0 if records and all(float(np.mean(r.value)) < 0.0 for r in records) else 1.0
    if sign < 0.0:
        said.append("values are below zero, as behind a vacuum pump: what follows counts downward from zero")
        records, outside = ([replace(r, value=-r.value) for r in some] for some in (records, outside))
    settled = [part for table in tables for part in table.settled]
    maps = [fit_static_map(part.name, part.pwm, part.value) for part in settled]
    if not records and not maps:
        raise BadInputError("pump: neither PWM nor value ever changes in these tables, expected steps")
    fits: dict[str, PumpFit] = {}
    held: dict[str, list[Held]] = {}
    asked: dict[str, list[Held]] = {}
    between: dict[str, float] = {}
    if records:
        shape = _chosen_shape(records, maps, sign)
        for done, model in enumerate(MODELS):
            if progress is not None:
                progress(done, len(MODELS))
            fits[model] = fit_pump(records, model, shape)
            held[model] = cross_validate(fits[model], records)
            fits[model], between[model] = with_run_sigma(fits[model], held[model])
            asked[model] = [held_by(fits[model], r) for r in outside]
    return PumpFound(
        units.pop(),
        tuple(records),
        fits,
        held,
        asked,
        between,
        tuple(maps),
        settled_groups(records) if records else (),
        departures(fits[ORIFICE], records) if records else (),
        jumps(records),
        tuple(said),
    )


# ----------------------------------------------------------------------
# What was found of a pump, judged and as the section `pump` of rig.yaml.

_MOST_SHARE = 0.05
_FEWEST_RUNS = 3
_AS_GOOD = 1.25
"""Between errors of models on held runs that do not say which is right: of five runs a third is chance."""
_MOST_VAGUE = 0.5
_PASSAGE = ("laminar_s", "turbulent_s2", "hose_per_s", "chamber_s")
"""What may be vague: parts of the passage make up for each other."""
_SETTLED = 0.95
"""Runs of a pump behind an orifice that end there have a lag a seventh longer than settled ones."""


def unexplained(found: PumpFound) -> list[Finding]:
    """What no function of the PWM explains, and what to do about it."""
    out, unit = list[Finding](), found.unit

    def add(text: str, advice: str) -> None:
        out.append(Finding("poor", text, advice))

    main = found.main_group
    if main is not None:
        parts = [
            f"{len(g.files)} at {g.value:.1f} {unit} ({', '.join(g.files)}; "
            f"PWM {g.pwm[0]:.0f} .. {g.pwm[1]:.0f})"
            for g in found.groups
        ]
        add(
            f"runs near full PWM settle apart: {'; '.join(parts)}; PWM does not say which",
            "identify one group at a time: supply, valve and load differ between them",
        )
    for d in found.departs:
        moved = "after the PWM had moved" if d.pwm_moved else "while the PWM stood still"
        add(
            f"{d.name} leaves the model {d.at_s:.2f} s after its start, {moved}, by {d.error:+.2f} {unit}",
            "look for a leak, a valve or a load that changed there; record it again, or cut it off before",
        )
    for name, size, before in found.leaps:
        add(
            f"{name} begins with a jump of {size:.1f} {unit} within 0.1 s from {before:.2f} {unit}, as if "
            "the chamber had been under pressure behind a closed valve",
            "let the chamber empty before a recording begins",
        )
    for record in found.records:
        if (end := ceiling(record)) is not None:
            add(
                f"{record.name} rises to {end[0]:.4g} {unit} within {end[1]:.2f} s and stays exactly there, "
                "without having slowed down: the sensor is at the end of its range, or a valve opened",
                "record with less pressure, or with a sensor of a wider range",
            )
    for m in found.maps:
        if m.fit.outliers_pwm:
            values = ", ".join(f"{u:g}" for u in m.fit.outliers_pwm)
            add(
                f"{m.name}: the settled values at PWM {values} lie off the map by more than four scatters",
                "measure those again, and wait until they have settled",
            )
    return out


def judge_pump(found: PumpFound) -> Verdict:
    """What nothing explains, how recordings that were not fitted are met, and what is hardly known."""
    remarks = [Finding("remark", text) for text in found.said]
    return Verdict.of([*unexplained(found), *remarks, *_of_better(found)])


def _of_better(found: PumpFound) -> Iterator[Finding]:
    """Findings on the better model; without a recording there is none."""
    better = found.better
    if better is None:
        yield Finding(
            "remark",
            "settled values alone: neither dead time nor lag can be told, expected a recording over time",
        )
        return
    fit = found.fits[better]
    span = max(float(np.ptp(r.value)) for r in found.records)
    told = {model: found.fits[model] for model in dict.fromkeys((better, LAG))}
    alone = found.held_rms(better) is None
    if alone:
        yield Finding("remark", "one recording alone: no error on recordings not fitted")
    on = "on the one recording" if alone else "on recordings not fitted"
    off = {model: found.held_rms(model) or one.rms for model, one in told.items()}
    misses = [(on, better, off[better], span)]
    misses += [(f"on {h.name}, kept out,", better, h.rms, max(h.span, span)) for h in found.asked[better]]
    misses += [(on, LAG, off[LAG], span)] if better != LAG else []
    for where, model, error, of in misses:
        share = error / of
        if share > _MOST_SHARE:
            text = f"{where} the {model} is off by {error:.2f} {found.unit} (RMS), "
            text += f"{100.0 * share:.0f} % of the range"
            advice = "record each run from an empty chamber, with the same supply and load"
            if model != better:
                # Lag and dead time of that one go into the section.
                text += ", so that lag and delay are not told"
                advice = "record steps of the PWM up alone, from an empty chamber"
            yield Finding("poor", text, advice)
    for model, name in ((model, name) for model, one in told.items() for name in one.sigma):
        value, sigma = abs(told[model].values[name]), told[model].sigma[name]
        # Of the lag, lag and dead time go into the section, whichever model is better. A dead time near
        # zero is known well enough where it moves the rise by little.
        enough = _MOST_SHARE * found.fits[LAG].values["lag_s"] if name == "dead_time_s" else 0.0
        vague = sigma > max(_MOST_VAGUE * value, enough)
        if name not in _PASSAGE and vague and (model == better or name in OF_LAG):
            known = f"known to {100.0 * sigma / value:.0f} % only" if sigma < value else "not told by these"
            yield Finding(
                "poor",
                f"{name} of the {model} is {known}: {value:.3g} +- {sigma:.2g}",
                "record steps of the PWM up and down, from rest, at 50 Hz or more",
            )
    most = found.fits[LAG].values["level"]
    ends = [float(np.median(r.value[-5:])) for r in found.records if _near_full(r) is not None]
    if better != LAG and ends and max(ends) < _SETTLED * most:
        yield Finding(
            "poor",
            f"the runs end at {100.0 * max(ends) / most:.0f} % of the {most:.3g} {found.unit} at which the "
            f"{LAG} settles, and the {better} meets them better: lag and delay are those of that part alone",
            "record each run until its value stays",
        )
    settles = found.settles(better)
    if settles is not None:
        level, half, inside, count = settles
        yield Finding(
            "remark",
            f"a further run settles at {level:.1f} +- {half:.2g} {found.unit} at full PWM (95 %); "
            f"of {count} runs that were held back {inside} end inside what the others give",
        )
    if fit.shape.dead_pwm == 0.0:
        yield Finding(
            "remark",
            "dead zone and shape of the static map are not told by these recordings; it is taken as a "
            "straight line through zero (settled values at several PWM tell it)",
        )


def _model(found: PumpFound, name: str) -> PumpModel:
    fit, main = found.fits[name], found.main_group
    held = found.held[name]
    return PumpModel(
        parameters={n: v for n, v in fit.values.items() if n in fit.sigma},
        sigma={n: finite_or_none(s) for n, s in fit.sigma.items()},
        fixed=fit.fixed,
        fitted_rms=fit.rms,
        held_rms=found.held_rms(name),
        level_between_runs=finite_or_none(found.between[name]),
        held_rms_in_main_group=None if main is None else found.held_rms(name, main.files),
        held_by_file={h.name: h.rms for h in held},
        ahead_by_file={h.name: finite_or_none(h.ahead) for h in held},
    )


def of_lag(model: PumpModel, tick_s: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Lag and dead time of the linear model by their keys of the section, and their standard deviations."""
    value, sigma = model.parameters, model.sigma
    late_s = sigma.get("dead_time_s")
    late = None if late_s is None else late_s / tick_s
    return (
        {"lag_s": value["lag_s"], "delay_ticks": round(value["dead_time_s"] / tick_s)},
        {"lag_s": sigma.get("lag_s"), "delay_ticks": late},
    )


def pump_section(found: PumpFound, rig: Rig) -> PumpSection:
    """The section, with lag and dead time of the linear model where a recording tells them.

    Levels in kPa are no forces: they stay under `identified`. What logs have told of forces stays.
    """
    before: dict[str, Any] = {} if rig.pump is None else section_json(rig.pump)
    stated = rig.known.pump if rig.known is not None and rig.known.pump is not None else KnownPump()
    update = judged(judge_pump(found))
    sigma: dict[str, Any] = before.get("sigma", {})
    models = {name: _model(found, name) for name in found.fits}
    if models:
        values, deviations = of_lag(models[LAG], stated.tick_s or before.get("tick_s", TICK_S))
        update, sigma = update | values, sigma | deviations
        shape = found.fits[LAG].shape
        dead = shape.dead_pwm
        if dead > 0.0:
            of = [m for m in found.maps if m.shape == shape]
            supply = stated.supply_V or before.get("supply_V", SUPPLY_V)
            update["dead_zone_V"] = supply * dead / PWM_MAX
            wide = of[0].fit.sigma["dead_pwm"] if of else None
            sigma["dead_zone_V"] = None if wide is None else supply * wide / PWM_MAX
    identified = PumpIdentified.model_validate(
        {
            "unit": found.unit,
            "models": models,
            "better": found.better,
            "static": {m.name: m.fit for m in found.maps},
            "groups": found.groups,
            "unexplained": [one.text for one in unexplained(found)],
        }
    )
    return PumpSection.model_validate(before | update | {"sigma": sigma, "identified": identified})
