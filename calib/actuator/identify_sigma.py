"""What a fit is worth: standard deviations, correlation, whiteness of residuals, and a log held back.

With weighted derivatives J and information H = J^T J of all unknowns, priors included, white residuals of
variance s^2 would give the covariance s^2 H^-1. Those of a camera with coarse pixels, and of a model that
is not quite right, are coloured. Then the sandwich

    H^-1 (sum_k w_k sum_i g_i g_(i+k)^T) H^-1,   g_i the gradient of row i, w_k = 1 - |k| / (L + 1)

(Newey and West) holds, with the lags L of a third of a second. It scatters itself, so of it and the white
one the larger variance is taken for each parameter; their ratio says how far colour has inflated it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.actuator.identify_fit import Solution, solve, weights
from calib.actuator.identify_problem import Problem, first_guess
from calib.actuator.identify_tracks import Track
from calib.arrays import FloatArray

__all__ = ["Colour", "HeldLog", "Uncertainty", "colour_of", "held_back", "rms_by_track", "uncertainty"]

_SPAN_S = 0.35
_LAGS = 20


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations and correlation of the estimated parameters.

    Attributes
    ----------
    sigma : by name. inflation : by name, how much colour has raised it. covariance, correlation : (P, P).
    scale : robust standard deviation of the whitened residuals, 1 for a perfect model and noise.
    """

    sigma: dict[str, float]
    inflation: dict[str, float]
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
    """RMS of angle [rad] and length [m] on a log, fitted and held back."""

    name: str
    fitted_phi_rad: float
    fitted_length_m: float
    held_phi_rad: float
    held_length_m: float


def _spans(tracks: Sequence[Track]) -> list[slice]:
    out, at = [], 0
    for track in tracks:
        out.append(slice(at, at + 2 * len(track.t_s)))
        at += 2 * len(track.t_s)
    return out


def _inverse(H: FloatArray) -> FloatArray:
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    return np.asarray(np.linalg.pinv(H / np.outer(size, size), rcond=1e-13) / np.outer(size, size))


def uncertainty(solution: Solution) -> Uncertainty:
    """Covariance of the parameters, the larger of the white one and the sandwich."""
    problem, r, J = solution.problem, solution.residual, solution.J
    P = len(problem.names)
    w = weights(r)
    spans = _spans(problem.tracks)
    rows = spans[-1].stop
    scale = max(1.4826 * float(np.median(np.abs(r[:rows]))), 1e-9)
    # The prior is known, the scale of the residuals is not.
    size = np.concatenate([np.full(rows, 1.0 / scale**2), np.ones(len(r) - rows)])
    H = (J * (w * size)[:, None]).T @ J
    inverse = _inverse(H)
    middle = (J[rows:]).T @ J[rows:]
    for track, span in zip(problem.tracks, spans, strict=True):
        g = (J[span] * (w * size * r)[span, None]).reshape(-1, 2, J.shape[1]).sum(axis=1)
        period = float(np.median(np.diff(track.t_s))) if len(track.t_s) > 1 else track.tick_s
        lags = min(max(round(_SPAN_S / max(period, 1e-4)), 1), len(g) // 4)
        middle = middle + g.T @ g
        for k in range(1, lags + 1):
            cross = g[:-k].T @ g[k:]
            middle = middle + (1.0 - k / (lags + 1.0)) * (cross + cross.T)
    # With far rows weighted down, the mean of w r^2 stands for the scale of the others.
    sandwich = (inverse @ middle @ inverse)[:P, :P]
    spread = float(np.mean((w * r**2)[:rows])) / scale**2
    white = inverse[:P, :P] * max(spread, 1.0)
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(white), 1e-300), 1.0))
    covariance = white * np.outer(ratio, ratio)
    sigma = np.sqrt(np.diag(covariance))
    return Uncertainty(
        dict(zip(problem.names, sigma.tolist(), strict=True)),
        dict(zip(problem.names, ratio.tolist(), strict=True)),
        covariance,
        covariance / np.outer(sigma, sigma),
        scale,
    )


def colour_of(solution: Solution) -> tuple[Colour, ...]:
    """Whiteness of each log's whitened residuals, rows that are far off cut at three deviations."""
    out = []
    w = weights(solution.residual)
    for track, span in zip(solution.problem.tracks, _spans(solution.problem.tracks), strict=True):
        r = solution.residual[span].reshape(-1, 2)
        far = float(np.mean((w[span].reshape(-1, 2) < 1.0 / 3.0).any(axis=1)))
        size = np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9)
        z = np.clip(r / size, -3.0, 3.0)
        z = z - z.mean(axis=0)
        power = np.maximum(np.sum(z * z, axis=0), 1e-12)
        lags = min(_LAGS, max(len(z) - 2, 1))
        c = np.stack([np.sum(z[k:] * z[:-k], axis=0) / power for k in range(1, lags + 1)])
        out.append(
            Colour(
                track.name,
                (float(c[0, 0]), float(c[0, 1])),
                float(np.mean(np.abs(c) > 1.96 / math.sqrt(len(z)))),
                far,
            )
        )
    return tuple(out)


def rms_by_track(problem: Problem, residual: FloatArray) -> list[tuple[float, float]]:
    """RMS of angle [rad] and length [m] of each log, rows beyond six deviations left out."""
    out = []
    for track, span in zip(problem.tracks, _spans(problem.tracks), strict=True):
        r = residual[span].reshape(-1, 2)
        size = np.maximum(1.4826 * np.median(np.abs(r)), 1e-9)
        near = (np.abs(r) < 6.0 * size).all(axis=1)
        error = np.linalg.solve(track.whitening[near], r[near][:, :, None])[:, :, 0]
        phi, length = np.sqrt(np.mean(error**2, axis=0)).tolist()
        out.append((phi, length))
    return out


def held_back(solution: Solution) -> list[HeldLog]:
    """Each log predicted by a fit to all others; empty for a single one.

    Of the log that is held back only its start, delay and the camera's offset are estimated. A log that
    alone tells a parameter keeps the others from telling it; that one stays as it was found.
    """
    problem = solution.problem
    if len(problem.tracks) < 2:
        return []
    inside = rms_by_track(problem, solution.residual)
    found = {**problem.held, **solution.values}
    out = []
    for k, track in enumerate(problem.tracks):
        others = [t for i, t in enumerate(problem.tracks) if i != k]
        kinds = {t.hoses for t in others}
        names = tuple(name for name in problem.names if _told_by(name, kinds))
        less = replace(problem, tracks=others, names=names, held=found)
        x, _, _, _ = solve(less, first_guess(less, found), 15)
        alone = replace(problem, tracks=[track], names=(), held={**found, **less.values(x)})
        _, _, residual, _ = solve(alone, first_guess(alone, found), 15)
        (phi, length) = rms_by_track(alone, residual)[0]
        out.append(HeldLog(track.name, *inside[k], phi, length))
    return out


def _told_by(name: str, kinds: set[bool]) -> bool:
    from calib.actuator.identify_parameters import PARAMETERS

    acts = PARAMETERS[name].acts
    return acts == "all" or (acts == "pumps") in kinds
