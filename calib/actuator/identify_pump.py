"""Fitting a pump's models to recordings, what the fit is worth, and what it does not explain.

Robust non-linear least squares (soft L1) on simulated minus measured pressure, all recordings at once,
from several starts. A simulation runs free: it sees the PWM and the first fifth of a second of the
measured values, nothing else. What is left over is the models' error and not noise, so it is coloured;
standard deviations are therefore those of a sandwich, H^-1 (sum g g^T) H^-1, with the gradient g summed
over whole recordings, or over stretches of a second where there are fewer than four recordings.

A parameter that can be switched off (a limit, a leak, a hose) is taken only if the data ask for it, by two
measures. One that they do not ask for lowers the robust cost all the same, by lambda chi^2_1 / 2, where
lambda = g^2 / h with the variance g^2 of its gradient and its curvature h; lambda is 1 for white noise, and
much more for what a model misses, which is the same all along a recording. It is measured: fitted without a
recording, the parameters raise the cost of what is left out by lambda each, over all recordings together.
So k parameters have to lower the cost by more than lambda chi^2_k(0.95) / 2. And they have to lower it by
`_WORTH` for each extra: the start is read off noisy values, and taking up its error, an extra that the truth
has not lowers the cost of a simulated pump by 2 %, not by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from calib.actuator.identify_pump_models import LAG, MODELS, ORIFICE, PumpRecord, Shape, simulate_pump
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["Held", "PumpFit", "cross_validate", "fit_pump", "rms_ahead", "rms_of"]

_WORTH = 0.03
_CONFIDENCE = 0.95
_AGAIN = 10
_SCALE_SHARE = 0.01
_AHEAD_S = 0.5
_FEWEST_CLUSTERS = 4
_STEP = 1e-4
_FREE = 1e6


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


@dataclass(frozen=True)
class Held:
    """Errors on a recording that was not fitted: free run, and `_AHEAD_S` ahead of measured values."""

    name: str
    rms: float
    ahead: float


@dataclass(frozen=True)
class _Problem:
    """Recordings and the scales of a fit."""

    model: str
    records: Sequence[PumpRecord]
    shape: Shape
    span: float

    @property
    def unit(self) -> dict[str, float]:
        return {"y": self.span, "1/y": 1.0 / self.span}

    def nominal(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Starts and bounds, in SI and in the unit of the values."""
        rows = [
            [x * self.unit.get(p.unit, 1.0) for x in (p.start, p.low, p.high)] for p in MODELS[self.model]
        ]
        start, low, high = np.array(rows).T
        return start, low, high

    def residual(self, theta: FloatArray) -> FloatArray:
        return np.concatenate(
            [simulate_pump(self.model, theta, r, self.shape) - r.value for r in self.records]
        )

    def off(self) -> FloatArray:
        return np.array([math.nan if p.off is None else p.off for p in MODELS[self.model]])


def _solve(
    problem: _Problem, theta: FloatArray, free: list[int], most: int = 40, without: slice | None = None
) -> tuple[FloatArray, float, FloatArray]:
    """Least squares over some parameters: values, robust cost per sample, and the weighted Jacobian.

    `without` leaves some rows out.
    """
    start, low, high = problem.nominal()
    scale = np.maximum(np.abs(start), 1e-3)[free]

    def full(x: FloatArray) -> FloatArray:
        out = theta.copy()
        out[free] = x
        return out

    def rows(x: FloatArray) -> FloatArray:
        out = problem.residual(full(x)) / (_SCALE_SHARE * problem.span)
        return out if without is None else np.delete(out, without)

    inside = np.clip(theta[free], low[free] + 1e-9 * scale, high[free] - 1e-9 * scale)
    found = least_squares(
        rows,
        inside,
        bounds=(low[free], high[free]),
        x_scale=scale,
        loss="soft_l1",
        diff_step=np.full(len(free), _STEP),
        max_nfev=most,
        xtol=1e-6,
        ftol=1e-7,
    )
    return full(found.x), float(found.cost) / len(found.fun), np.asarray(found.jac, dtype=np.float64)


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
    problem: _Problem, theta: FloatArray, free: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scaled residuals, their derivatives by the free parameters, and the weights of the robust loss."""
    scale = _SCALE_SHARE * problem.span
    base = problem.residual(theta) / scale
    _, low, high = problem.nominal()
    J = np.empty((len(base), len(free)))
    for column, k in enumerate(free):
        h = _STEP * max(abs(theta[k]), 1e-2 * (high[k] - low[k]) if theta[k] == 0.0 else 0.0)
        moved = theta.copy()
        moved[k] += h if moved[k] + h <= high[k] else -h
        J[:, column] = (problem.residual(moved) / scale - base) / (moved[k] - theta[k])
    return base, J, np.asarray(1.0 / np.sqrt(1.0 + base * base))


def _inverse(H: FloatArray) -> FloatArray:
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.asarray(np.linalg.pinv(H / np.outer(size, size), rcond=1e-12) / np.outer(size, size))


def _by_chance(problem: _Problem, theta: FloatArray, free: list[int], extras: int) -> float:
    """How much a number of parameters that are not needed lowers the cost per sample, at most in 95 %."""
    base = problem.residual(theta) / (_SCALE_SHARE * problem.span)
    rise = 0.0
    for s in _clusters(problem):
        moved, _, _ = _solve(problem, theta, free, _AGAIN, s)
        left_out = problem.residual(moved)[s] / (_SCALE_SHARE * problem.span)
        rise += float(np.sum(np.sqrt(1.0 + left_out**2) - np.sqrt(1.0 + base[s] ** 2)))
    lam = max(rise, 0.0) / len(free) / len(base)
    return 0.5 * lam * float(chi2.ppf(_CONFIDENCE, extras))


def _covariance(problem: _Problem, theta: FloatArray, free: list[int]) -> FloatArray:
    """Sandwich covariance of the free parameters under the robust loss."""
    base, J, weight = _slopes(problem, theta, free)
    H = (J * weight[:, None]).T @ J
    G = [J[s].T @ (weight[s] * base[s]) for s in _clusters(problem)]
    middle = sum((np.outer(g, g) for g in G), np.zeros_like(H)) * (len(G) / max(len(G) - 1, 1))
    inverse = _inverse(H)
    return np.asarray(inverse @ middle @ inverse)


def _check(records: Sequence[PumpRecord]) -> float:
    if not records:
        raise BadInputError("pump: found no recording with values over time, expected at least one")
    span = float(max(np.ptp(r.value) for r in records))
    quiet = [r.name for r in records if not np.ptp(r.pwm) and np.ptp(r.value) < 0.02 * max(span, 1e-12)]
    if len(quiet) == len(records) or span <= 0.0:
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
        free = [k for k in range(len(names)) if start[k] != off[k] and not _tied(model, names[k], start)]
        theta, cost, _ = _solve(problem, start, free)
    else:
        theta, cost, free = _search(problem, nominal, off, fixed)
    covariance = _covariance(problem, theta, free)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    residual = problem.residual(theta)
    return PumpFit(
        model,
        theta,
        tuple(names[k] for k in free),
        {names[k]: float(s) for k, s in zip(free, sigma, strict=True)},
        covariance / np.outer(safe, safe),
        float(np.sqrt(np.mean(residual**2))),
        cost,
        problem.shape,
        fixed,
    )


def _tied(model: str, name: str, theta: FloatArray) -> bool:
    """Whether a parameter does nothing because another is switched off."""
    return model == ORIFICE and name == "chamber_s" and float(theta[5]) == 0.0


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
            theta, value, _ = _solve(problem, begin, always)
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
            theta, value, _ = _solve(problem, begin, wider)
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
                if group in c and all(_within(names, g, free) for g in c if g != group)
            }
            with_it = min(more, key=lambda c: more[c])
            gain = max(1.0 - more[with_it] / cost, 0.0)
            bound = max(chances.get(with_it, 0.0) / cost, _WORTH)
            why = f"it would lower the cost by {100.0 * gain:.2g} %, where {100.0 * bound:.2g} % say nothing"
            fixed |= dict.fromkeys(group, f"off: {why if gain <= bound else 'it is not bounded'}")
    return best, cost, free


def _within(names: list[str], group: tuple[str, ...], free: list[int]) -> bool:
    return names.index(group[0]) in free


def _vague(problem: _Problem, theta: FloatArray, free: list[int], off: FloatArray) -> bool:
    """Whether a parameter that infinity switches off cannot be told from infinity."""
    sigma = np.sqrt(np.maximum(np.diag(_covariance(problem, theta, free)), 0.0))
    return any(
        off[k] == _FREE and not s <= 0.7 * abs(theta[k]) for k, s in zip(free, sigma.tolist(), strict=True)
    )


def rms_of(fit: PumpFit, record: PumpRecord) -> float:
    """RMS of the free run on a recording."""
    error = simulate_pump(fit.model, fit.theta, record, fit.shape) - record.value
    return float(np.sqrt(np.mean(error**2)))


def rms_ahead(fit: PumpFit, record: PumpRecord, ahead_s: float = _AHEAD_S) -> float:
    """RMS of predictions a time ahead of a measured value, begun anew ten times in it."""
    t = record.t_s
    begin, errors = float(t[0]), []
    while begin + ahead_s < float(t[-1]):
        # A tenth of a second before the beginning gives the start, as with a whole recording.
        rows = np.nonzero((t >= begin - 0.1) & (t <= begin + ahead_s))[0]
        if len(rows) >= 10:
            part = PumpRecord(record.name, t[rows], record.pwm[rows], record.value[rows])
            known = float(begin - t[rows[0]]) if begin > float(t[0]) else 0.04
            told = simulate_pump(fit.model, fit.theta, part, fit.shape, known)
            late = t[rows] >= begin + 0.9 * ahead_s
            errors.append((told - part.value)[late])
        begin += 0.1 * ahead_s
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else math.nan


def cross_validate(fit: PumpFit, records: Sequence[PumpRecord]) -> list[Held]:
    """Each recording predicted by a fit to all others; empty for a single one."""
    out = []
    for k, held in enumerate(records):
        others = [r for i, r in enumerate(records) if i != k]
        if not others:
            return []
        again = fit_pump(others, fit.model, fit.shape, fit.theta)
        out.append(Held(held.name, rms_of(again, held), rms_ahead(again, held)))
    return out
