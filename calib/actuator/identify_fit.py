"""Non-linear least squares over several logs, from several starts, with what cannot be told left out.

A batch of candidates spread about the nominal rig costs little more than one, so the search begins with
`CANDIDATES` of them; the best are refined by a trust region within bounds under a soft-L1 loss, which
keeps frames with another thing in place of the marker from pulling.

Which parameters are estimated is decided by the information the logs hold about them, everything else
that is unknown eliminated (S, the Schur complement). In relative changes of the parameters:

- two whose effects are the same up to a factor enter only as a product or ratio; the second is fixed;
- one whose relative standard deviation would be above `VAGUE` is fixed at its nominal value.

Both are looked at where the search starts and again at the solution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from calib.actuator.identify_parameters import PARAMETERS, Nominal, candidates, values_of
from calib.actuator.identify_problem import FAR, Problem, first_guess, jacobian, residuals
from calib.actuator.identify_tracks import Track
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = ["CANDIDATES", "VAGUE", "Solution", "fit_tracks", "informative", "solve", "weights"]

CANDIDATES = 32
VAGUE = 0.5
_SAME = 0.99995
_SOFT = 2.0
_REFINED = 3
_ROUNDS = 4
_MOVES = 4.0

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
    """

    problem: Problem
    x: FloatArray
    residual: FloatArray
    J: FloatArray
    cost: float
    fixed: dict[str, str]
    agreeing: int
    starts: int

    @property
    def values(self) -> dict[str, float]:
        """Estimated parameters by name."""
        return {name: float(v) for name, v in zip(self.problem.names, self.x, strict=False)}


def _robust(r: FloatArray) -> FloatArray:
    """Soft-L1 cost of rows (..., n)."""
    return np.asarray(_SOFT**2 * np.sum(np.sqrt(1.0 + (r / _SOFT) ** 2) - 1.0, axis=-1))


def weights(residual: FloatArray) -> FloatArray:
    """Weight of each residual under the loss."""
    return np.asarray(1.0 / np.sqrt(1.0 + (residual / _SOFT) ** 2))


def solve(
    problem: Problem, x: FloatArray, most: int = 30
) -> tuple[FloatArray, float, FloatArray, FloatArray]:
    """A minimum near x: unknowns, robust cost, residuals and derivatives there."""
    low, high = problem.bounds()
    scales = problem.scales()
    begin = np.clip(x, low + 1e-9 * scales, high - 1e-9 * scales)
    seen: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = at.tobytes()
        if key not in seen:
            seen.clear()
            seen[key] = jacobian(problem, at)
        return seen[key]

    def rows(at: FloatArray) -> FloatArray:
        return both(at)[0]

    def slopes(at: FloatArray) -> FloatArray:
        return both(at)[1]

    found = least_squares(
        rows,
        begin,
        jac=slopes,
        bounds=(low, high),
        x_scale=scales,
        loss="soft_l1",
        f_scale=_SOFT,
        max_nfev=most,
        xtol=1e-8,
        ftol=1e-8,
        gtol=1e-10,
    )
    residual, J = both(np.asarray(found.x, dtype=np.float64))
    return np.asarray(found.x), float(_robust(residual)), residual, J


def informative(problem: Problem, residual: FloatArray, J: FloatArray, x: FloatArray) -> FloatArray:
    """Information (P, P) about relative changes of the parameters, the other unknowns eliminated."""
    P = len(problem.names)
    # Relative changes of magnitudes, so that a product of a positive and a negative one is seen as such.
    size = np.copysign(np.maximum(np.abs(x[:P]), 0.1 * problem.scales()[:P]), x[:P])
    w = weights(residual) if float(np.max(np.abs(residual), initial=0.0)) < FAR else np.ones(len(residual))
    A = J * np.sqrt(w)[:, None]
    A[:, :P] *= size
    H = A.T @ A
    nuisance = H[P:, P:]
    scale = np.sqrt(np.maximum(np.diag(nuisance), 1e-300))
    inverse = np.linalg.pinv(nuisance / np.outer(scale, scale), rcond=1e-12) / np.outer(scale, scale)
    return np.asarray(H[:P, :P] - H[:P, P:] @ inverse @ H[P:, :P])


def _words(name: str) -> str:
    symbol = PARAMETERS[name].symbol
    return symbol if name.startswith(symbol) else f"{name} ({symbol})"


def _left_out(problem: Problem, S: FloatArray, held: Mapping[str, float]) -> tuple[str, str] | None:
    """A parameter that the logs cannot tell, and the sentence about it."""
    names = problem.names
    size = np.sqrt(np.maximum(np.diag(S), 0.0))
    for k, name in enumerate(names):
        if size[k] < 1e-6 * max(float(size.max(initial=0.0)), 1e-300) or size[k] < 1.0 / VAGUE / 10.0:
            return name, f"the logs do not depend on it; kept at {held[name]:.4g}"
    cosine = S / np.outer(size, size)
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if abs(cosine[i, j]) > _SAME:
                how = "a product" if cosine[i, j] > 0.0 else "a ratio"
                if not 0.99 < size[i] / size[j] < 1.01:
                    how = "one combination"
                sentence = f"{_words(names[i])} and {_words(names[j])} enter only as {how}"
                return names[j], f"{sentence}; kept at {held[names[j]]:.4g}"
    sigma = np.sqrt(np.maximum(np.diag(np.linalg.pinv(cosine, rcond=1e-10)), 0.0)) / size
    worst = int(np.argmax(sigma))
    if sigma[worst] > VAGUE:
        return names[worst], (
            f"the logs tell it to {100.0 * sigma[worst]:.0f} % only; kept at {held[names[worst]]:.4g}"
        )
    return None


def _pruned(
    problem: Problem, x: FloatArray, residual: FloatArray, J: FloatArray, fixed: dict[str, str]
) -> tuple[Problem, FloatArray, FloatArray]:
    """The problem without what cannot be told, its unknowns and derivatives."""
    known = {**values_of(problem.nominal), **problem.held}
    while problem.names:
        found = _left_out(problem, informative(problem, residual, J, x), known)
        if found is None:
            break
        name, sentence = found
        k = problem.names.index(name)
        fixed[name] = sentence
        problem = replace(problem, names=tuple(n for n in problem.names if n != name))
        x, J = np.delete(x, k), np.delete(J, k, axis=1)
    return problem, x, J


def _blind(fixed: Mapping[str, str]) -> BadInputError:
    names = ", ".join(name for name in fixed if name != "lambda3")
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


def _spread(problem: Problem, values: Mapping[str, float], seed: int) -> FloatArray:
    """Candidates (`CANDIDATES`, size) about the nominal rig, itself the first."""
    rng = np.random.default_rng(seed)
    x = first_guess(problem, values)
    out = np.tile(x, (CANDIDATES, 1))
    P = len(problem.names)
    out[1:, :P] *= np.exp(rng.uniform(-0.7, 0.7, (CANDIDATES - 1, P)))
    low, high = problem.bounds()
    out[:, :P] = np.clip(out[:, :P], low[:P] * 1.001, high[:P] * 0.999)
    return out


def fit_tracks(
    nominal: Nominal,
    tracks: Sequence[Track],
    static_map: bool = False,
    delay_s: float | None = None,
    delay_sigma_s: float | None = None,
    threads: int = 2,
    seed: int = 0,
    progress: Progress | None = None,
) -> Solution:
    """Estimate all parameters that these logs can tell.

    Parameters
    ----------
    static_map : see `identify_parameters.candidates`.
    delay_s, delay_sigma_s : what is known of the delay of the measured rows.

    Raises
    ------
    BadInputError without logs; when no parameter can be told, with the reason for each.
    """
    if not tracks:
        raise BadInputError("identify: found no log, expected at least one")
    names = candidates(nominal, any(not t.hoses for t in tracks), any(t.hoses for t in tracks), static_map)
    if not any(_moves(track) for track in tracks):
        raise _blind(dict.fromkeys(names, "the rig does not move"))
    known = values_of(nominal)
    problem = Problem(nominal, tracks, names, {}, threads=threads)
    if delay_s is not None:
        problem = replace(problem, delay_s=delay_s)
    if delay_sigma_s is not None:
        problem = replace(problem, delay_sigma_s=max(delay_sigma_s, 1e-5))
    fixed: dict[str, str] = {}
    x = first_guess(problem, known)
    residual, J = jacobian(problem, x)
    # Where the search starts nothing fits yet: all rows count alike there.
    problem, x, J = _pruned(problem, x, np.zeros_like(residual), J, fixed)
    if not problem.names:
        raise _blind(fixed)
    best, agreeing, refined = _search(problem, known, seed, progress)
    for _ in range(_ROUNDS):
        x, cost, residual, J = best
        smaller, x, J = _pruned(problem, x, residual, J, fixed)
        if smaller.names == problem.names:
            break
        problem = smaller
        if not problem.names:
            break
        best = solve(problem, x)
    if not problem.names:
        raise _blind(fixed)
    x, cost, residual, J = best
    return Solution(problem, x, residual, J, cost, fixed, agreeing, refined)


def _search(
    problem: Problem, known: Mapping[str, float], seed: int, progress: Progress | None
) -> tuple[tuple[FloatArray, float, FloatArray, FloatArray], int, int]:
    """The best of several refined starts, how many agree with it, and of how many."""
    spread = _spread(problem, known, seed)
    costs = _robust(residuals(problem, spread))
    order = np.argsort(costs, kind="stable")[:_REFINED].tolist()
    if 0 not in order:
        order.append(0)
    found = []
    for done, k in enumerate(order):
        if progress is not None:
            progress(done, len(order) + 1)
        found.append(solve(problem, spread[k], 25))
    best = min(found, key=lambda one: one[1])
    final = solve(problem, best[0], 40)
    limit = final[1] * 1.01 + 3.0
    return final, sum(one[1] <= limit for one in found), len(order) if math.isfinite(final[1]) else 0
