"""What a fit is worth: deviations, logs held back, and what the next experiment would add.

With weighted derivatives J and information H = J^T J of all unknowns, priors included, white residuals of
variance s^2 would give the covariance s^2 H^-1. Those of a camera with coarse pixels, and of a model that
is not quite right, are coloured. Then the sandwich

    H^-1 (sum_k w_k sum_i g_i g_(i+k)^T) H^-1,   g_i the gradient of row i, w_k = 1 - |k| / (L + 1)

(Newey and West) holds, with lags L of a third of a second or, where residuals stay alike for longer, up to
the first at which they do not. It scatters itself, so of it and the white one the larger variance is taken
for each parameter; their ratio says how far colour has inflated it.

Both hold for a model that is right in the mean. One of another structure, as of a rig with dry friction or
hysteresis, fits each stretch of a log with other parameters. With the information H_s and the gradient g_s
of a stretch, parameter i of it alone is off by d = -g_s,i / h, h = (H_s - H_s H^-1 H_s)_ii, all others
following, with the variance 1 / h, raised as above. Where these scatter by more, their variance T_i
between stretches (DerSimonian and Laird) is added: that of another stretch, and that of the fit,

    T + sum_s sum_i T_i (H^-1 H_s e_i) (H^-1 H_s e_i)^T.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, robust_sigma
from calib.core.errors import BadInputError
from calib.solve.information import scaled_inverse
from calib.stages.actuator.identify import (
    BAND,
    DELAY_SIGMA_S,
    NO_CREEP,
    PARAMETERS,
    Problem,
    Solution,
    Start,
    Track,
    autocorrelation,
    candidates,
    eliminated,
    first_guess,
    heads_of,
    informative,
    jacobian,
    residuals,
    robust_cost,
    solve,
    values_of,
    weights,
)

_SPAN_S, _LONGEST_S = 0.35, 10.0
_STRETCHES = 5
"""Of each log: a swing that has died away within two thirds of its log is told in three."""
_SCATTERS = 0.01
"""Probability of such a scatter by chance, below which it is believed."""


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
        apart = np.flatnonzero((c < BAND / math.sqrt(len(g))).all(axis=1))
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
    first = robust_cost(problem, residual * kept)
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
        after = robust_cost(problem, found * kept[at])
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
        first[k] = robust_cost(less, residuals(less, solution.x[places][None]))[0]
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
    out[:some, :some] = eliminated(S, [*range(P), *range(P + m, len(S))], 1e-10)
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
    out = np.diag([0.0] * P + [DELAY_SIGMA_S**-2] * _SHARED)
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
