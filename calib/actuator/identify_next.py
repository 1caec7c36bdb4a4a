"""Which experiment to do next: the one that would shrink the worst standard deviation most.

Experiments add their information: S_after = S_now + S_experiment, each with its own start, delay and offsets
eliminated. That of an experiment that was not done yet is that of a simulated one on the identified rig,
with a picture at each tick and the noise of the logs at hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.actuator.identify_fit import Solution, informative
from calib.actuator.identify_parameters import PARAMETERS, candidates, values_of
from calib.actuator.identify_problem import Problem, first_guess, jacobian
from calib.actuator.identify_sigma import Uncertainty
from calib.actuator.identify_tracks import Start, Track, heads_of
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["EXPERIMENTS", "Experiment", "Prospect", "prospects"]

_DURATION_S = 8.0
_TYPICAL = (0.004, 0.0004)


@dataclass(frozen=True)
class Experiment:
    """An open-loop experiment: start, whether the hoses are on, and the commands over time."""

    name: str
    what: str
    start: Start
    hoses: bool
    pwm: FloatArray


@dataclass(frozen=True)
class Prospect:
    """Relative standard deviations after one more experiment, and the worst of them."""

    name: str
    what: str
    relative: dict[str, float]
    worst: str
    worst_relative: float


def EXPERIMENTS(
    rest_length_m: float, tick_s: float, duration_s: float = _DURATION_S
) -> tuple[Experiment, ...]:
    """Static, swing, step, ellipse and elongation, open-loop stand-ins of the source's experiments."""
    n = round(duration_s / tick_s)
    t = tick_s * np.arange(n, dtype=np.float64)
    off, straight = np.zeros((n, 2)), Start(0.0, rest_length_m)
    step = np.where((t >= 0.5) & (t < 0.6 * duration_s), 225.0, 0.0)
    turn = 2.0 * np.pi * t / (0.5 * duration_s)
    ellipse = np.stack([180.0 + 60.0 * np.sin(turn), 180.0 + 60.0 * np.cos(turn)], axis=1)
    stairs = np.array([130.0, 175.0, 215.0, 250.0, 0.0])[np.minimum((5.0 * t / duration_s).astype(int), 4)]
    return (
        Experiment("static", "rest, pumps off", straight, True, off),
        Experiment("swing", "released from 0.5 rad, hoses off", Start(0.5, rest_length_m), False, off),
        Experiment("step", "one pump on, then off", straight, True, np.stack([step, 0.0 * step], axis=1)),
        Experiment("ellipse", "both pumps swept a quarter of a turn apart", straight, True, ellipse),
        Experiment(
            "elongation", "both pumps up in steps, then off", straight, True, np.stack([stairs] * 2, 1)
        ),
    )


def _information(
    problem: Problem, names: tuple[str, ...], values: Mapping[str, float], one: Experiment, noise: FloatArray
) -> FloatArray | None:
    """Information (P, P) about relative changes from one experiment; None where it leaves the model.

    What the experiment brings in that is not asked for, as the pumps' strength, is eliminated.
    """
    tick_s = problem.nominal.pump.tick_s
    n = len(one.pwm)
    t = tick_s * np.arange(1, n, dtype=np.float64)
    W = np.broadcast_to(np.diag(1.0 / noise), (n - 1, 2, 2)).copy()
    track = Track(one.name, tick_s, one.pwm, one.hoses, t, np.zeros((n - 1, 2)), W)
    try:
        head, _ = heads_of(track, problem.nominal, [values], [one.start], 0.0, problem.threads)
    except BadInputError:
        return None
    if not np.isfinite(head).all():
        return None
    track = replace(track, head=head[0])
    mine = candidates(problem.nominal, not one.hoses, one.hoses, False)
    more = tuple(name for name in mine if name not in names and name != "lambda3")
    if any(name.startswith("elongation") for name in names):
        more = tuple(name for name in more if name != "strength1")
    alone = replace(problem, tracks=[track], names=names + more, held=values, delay_s=0.0)
    x = first_guess(alone, values)
    x[alone.layout.start :] = one.start.phi_rad, one.start.length_m
    residual, J = jacobian(alone, x)
    S = informative(alone, np.zeros_like(residual), J, x)
    P = len(names)
    if not more:
        return S
    return np.asarray(
        S[:P, :P] - S[:P, P:] @ np.linalg.pinv(S[P:, P:], rcond=1e-10, hermitian=True) @ S[P:, :P]
    )


def prospects(solution: Solution, known: Uncertainty) -> tuple[Prospect, ...]:
    """All experiments, the most useful first.

    Judged are the parameters that were estimated and those that could not be told for want of excitation,
    lambda3 apart, which no experiment tells from lambda2.
    """
    problem = solution.problem
    values = {**values_of(problem.nominal), **problem.held, **solution.values}
    vague = [n for n in solution.fixed if n != "lambda3" and n in PARAMETERS]
    order = list(PARAMETERS)
    names = tuple(sorted([*problem.names, *vague], key=order.index))
    now = np.zeros((len(names), len(names)))
    at = [names.index(name) for name in problem.names]
    size = np.array([max(abs(values[n]), 0.1 * PARAMETERS[n].scale) for n in problem.names])
    now[np.ix_(at, at)] = np.linalg.pinv(known.covariance / np.outer(size, size), hermitian=True)
    W = np.concatenate([track.whitening for track in problem.tracks])
    inverse = np.linalg.inv(W)
    noise = known.scale * np.sqrt(np.median(np.sum(inverse**2, axis=2), axis=0))
    noise = np.where(np.isfinite(noise) & (noise > 0.0), noise, np.array(_TYPICAL))
    out = []
    rest = problem.nominal.plant.rest_length_m
    for one in EXPERIMENTS(rest, problem.nominal.pump.tick_s):
        gained = _information(problem, names, values, one, noise)
        if gained is None:
            continue
        relative = _relative(now + gained, names)
        worst = max(relative, key=lambda n: relative[n])
        out.append(Prospect(one.name, one.what, relative, worst, relative[worst]))
    return tuple(sorted(out, key=lambda p: (p.worst_relative, sum(p.relative.values()))))


def _relative(S: FloatArray, names: Sequence[str]) -> dict[str, float]:
    """Relative standard deviations of an information matrix; those that nothing bounds count as 10."""
    prior = 1e-2 * np.eye(len(S))
    sigma = np.sqrt(np.diag(np.linalg.inv(S + prior)))
    return {
        name: min(float(s), 10.0) if math.isfinite(s) else 10.0 for name, s in zip(names, sigma, strict=True)
    }
