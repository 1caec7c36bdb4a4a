"""One camera or two: do some views come from another camera, or from the same lens refocused?

A set mixed from two cameras can fit one at a low RMS, because every view's pose bends to the
camera's will. Splitting the views always lowers the cost, also where there is one camera, so the fall
has to be compared with what it would be by chance. With the quadratic evidence of each view
(`calib.camera.evidence`) a split costs next to nothing:

1. views are reassigned between two cameras until stable, from several starts (k-means with each
   view's own metric); and, for a lens that was moved on the way, all splits in order are tried;
2. the statistic is T2 = fall of the cost / (phi^2 sigma^2), with sigma^2 from the residuals after the
   split and phi^2 the overdispersion of the views *within* the two groups, so that residuals that are
   not white do not pass for a second camera;
3. the same search on made-up scores of one camera, drawn from each view's own information, tells what
   T2 chance reaches.

The lens model is first widened to five coefficients, where that helps, and the target takes the shape
that fits best: a lens that the model cannot follow, or a bent board, makes views disagree by where and
how the board lies in them, which is not a second camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.bundle import Calibration, calibrate
from calib.camera.evidence import Evidence, evidence, scaled_inverse
from calib.camera.projection import jacobian
from calib.camera.starts import held

__all__ = ["Split", "best_change", "best_split", "straightened", "widened"]

_REPLICATES = 16
_QUANTILE = 3.5
"""Standard deviations above the replicates' mean that chance is said to reach."""
_STARTS = 10
_ROUNDS = 15
_MAX_ITERATIONS = 40
_WORTH = 3.0
"""Fall of the cost, in variances, that a coefficient has to bring."""
_LEAST = 3
"""Views that a group needs."""
_PRIOR = {"fx_px": 0.3, "fy_px": 0.3, "cx_px": 0.15, "cy_px": 0.15, "skew_px": 0.05}
"""How far two cameras may differ, over the focal length; coefficients of distortion by one."""


@dataclass(frozen=True)
class Split:
    """The best division of the views into two groups.

    Attributes
    ----------
    second : (N,) True for the views of the smaller or later group.
    statistic : T2, see the module.
    chance : what T2 reaches with one camera: mean and 3.5 standard deviations of replicates.
    rms_px, split_rms_px : before and after.
    difference : intrinsics of the second group less those of the first, by name.
    sigma : its standard deviation with the overdispersion within the groups, by name.
    """

    second: BoolArray
    statistic: float
    chance: float
    rms_px: float
    split_rms_px: float
    difference: dict[str, float]
    sigma: dict[str, float]

    @property
    def ratio(self) -> float:
        """T2 over what chance reaches."""
        return self.statistic / max(self.chance, 1e-9)


def widened(calibration: Calibration) -> Calibration:
    """The same views with k1, k2, p1, p2 and k3 free, where the model is poorer and that helps."""
    camera, fixed = calibration.camera, held(calibration)
    if camera.model in ("brown5", "rational8") or fixed not in ((), ("skew_px",)):
        return calibration
    rich = calibrate(
        calibration.observations,
        camera.image_size_px,
        "brown5",
        skew="skew_px" in calibration.free_names,
        start=calibration.block,
        max_iterations=_MAX_ITERATIONS,
    )
    # Coefficients that explain nothing only blur the difference of two cameras.
    worth = _WORTH * (len(rich.free) - len(calibration.free)) * calibration.sigma_px**2
    return rich if rich.squared_sum < calibration.squared_sum - worth else calibration


def straightened(calibration: Calibration, displacement_m: FloatArray) -> Calibration:
    """The same views of a target whose points are moved by `displacement_m` (1 or N, M, 3).

    A target that would then lie behind the camera tells nothing; the calibration is left as it is.
    """
    moved = calibrate(
        calibration.observations.displaced(displacement_m),
        calibration.camera.image_size_px,
        calibration.camera.model,
        skew="skew_px" in calibration.free_names,
        fixed=held(calibration),
        start=calibration.block,
        max_iterations=_MAX_ITERATIONS,
    )
    in_front = jacobian(moved.block, moved.observations, moved.free, None) is not None
    return moved if in_front else calibration


@dataclass(frozen=True)
class _Problem:
    """Scores and information of the views in units of the prior, sigma one."""

    S: FloatArray
    b: FloatArray
    cost: float
    freedom: int


def _groups(problem: _Problem, second: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums S (T, 2, G, G) and b (T, 2, G) and best shifts d (T, 2, G) of divisions (T, N)."""
    N, G = problem.b.shape
    member = np.stack([~second, second], axis=1).astype(np.float64)
    flat = member.reshape(-1, N)
    S = (flat @ problem.S.reshape(N, -1)).reshape(-1, 2, G, G)
    b = (flat @ problem.b).reshape(-1, 2, G)
    d = -np.linalg.solve(S + np.eye(G), b[..., None])[..., 0]
    return S, b, np.asarray(d, dtype=np.float64)


def _reassigned(problem: _Problem, second: BoolArray) -> BoolArray:
    """Divisions (T, N) after moving every view to the camera that suits it until nothing moves."""
    N = len(problem.b)
    for _ in range(_ROUNDS):
        _, _, d = _groups(problem, second)
        # Cost under the second less that under the first; (d2 - d1)' S (d1 + d2) = d2' S d2 - d1' S d1.
        apart, both = d[:, 1] - d[:, 0], d[:, 1] + d[:, 0]
        pushed = np.tensordot(both, problem.S, axes=(1, 1))
        better = 2 * apart @ problem.b.T + np.einsum("tng,tg->tn", pushed, apart)
        rank = np.argsort(np.argsort(better, axis=1), axis=1)
        new = ((better < 0) | (rank < _LEAST)) & (rank < N - _LEAST)
        if np.array_equal(new, second):
            break
        second = new
    return second


def _statistic(problem: _Problem, second: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """T2, fall of the cost and phi^2 of divisions (T, N), each (T,)."""
    N, G = problem.b.shape
    S, b, d = _groups(problem, second)
    fall = -(b * d).sum(axis=(1, 2))
    variance = np.maximum(problem.cost - fall, 1e-12 * problem.cost) / problem.freedom
    inverse = np.linalg.inv(S + np.eye(G))
    own = np.where(second[..., None], d[:, 1, None], d[:, 0, None])
    score = problem.b + np.einsum("ngh,tnh->tng", problem.S, own)
    metric = np.where(second[..., None, None], inverse[:, 1, None], inverse[:, 0, None])
    scatter = np.einsum("tng,tngh,tnh->t", score, metric, score, optimize=True)
    phi2 = scatter / (2 * G * variance) * N / max(N - G, 1)
    return fall / (variance * np.maximum(phi2, 1.0)), fall, phi2


def _problem(found: Evidence, calibration: Calibration) -> tuple[_Problem, FloatArray]:
    focal, longest = calibration.camera.fx_px, max(calibration.camera.image_size_px)
    width = {"cx_px": longest, "cy_px": longest}
    scale = np.array(
        [_PRIOR.get(name, 1.0) * width.get(name, focal if name in _PRIOR else 1.0) for name in found.names]
    )
    S = found.S * scale[:, None] * scale / found.sigma_px**2
    b = found.b * scale / found.sigma_px**2
    freedom = max(calibration.degrees_of_freedom - len(scale), 1)
    return _Problem(S, b, float(found.cost.sum()) / found.sigma_px**2, freedom), scale


def _beginnings(problem: _Problem, rng: np.random.Generator) -> BoolArray:
    """Divisions to begin with: in order, along the views' main disagreement, and at random, (T, N)."""
    N, G = problem.b.shape
    order = np.arange(N)
    starts = [order >= cut for cut in np.unique(np.linspace(_LEAST, N - _LEAST, 3).astype(np.int64))]
    own = np.linalg.solve(problem.S + np.eye(G), problem.b[..., None])[..., 0]
    weights = problem.S.sum(axis=0)
    _, vectors = np.linalg.eigh(weights)
    for k in range(1, 4):
        along = own @ vectors[:, -min(k, G)]
        starts.append(along > np.median(along))
    starts.extend(rng.permutation(N) < N // 2 for _ in range(_STARTS - len(starts)))
    return np.array(starts)


def _replicates(problem: _Problem, rng: np.random.Generator) -> list[_Problem]:
    """Scores as one camera would give them, centred on its solution."""
    values, vectors = np.linalg.eigh(problem.S)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    inverse = scaled_inverse(problem.S.sum(axis=0))
    made = []
    for _ in range(_REPLICATES):
        b = np.einsum("ngh,nh->ng", root, rng.standard_normal(problem.b.shape))
        b = b - problem.S @ (inverse @ b.sum(axis=0))
        made.append(_Problem(problem.S, b, float(problem.freedom), problem.freedom))
    return made


def _reach(statistics: list[float]) -> float:
    return float(np.mean(statistics) + _QUANTILE * np.std(statistics, ddof=1))


def _described(
    problem: _Problem, scale: FloatArray, calibration: Calibration, second: BoolArray, chance: float
) -> Split:
    statistic, fall, phi2 = (float(value[0]) for value in _statistic(problem, second[None]))
    S, _, d = _groups(problem, second[None])
    points = calibration.observations.points
    variance = calibration.sigma_px**2
    inverse = np.linalg.inv(S[0] + np.eye(len(scale)))
    left = max(problem.cost - fall, 0.0) / problem.freedom * max(phi2, 1.0)
    # Rounding makes a variance of next to nothing negative.
    sigma = scale * np.sqrt(np.maximum(np.diag(inverse[0] + inverse[1]), 0.0) * left)
    difference = scale * (d[0, 1] - d[0, 0])
    names = calibration.free_names
    return Split(
        second,
        statistic,
        chance,
        calibration.rms_px,
        float(np.sqrt(max(problem.cost - fall, 0.0) * variance / points)),
        dict(zip(names, difference.tolist(), strict=True)),
        dict(zip(names, sigma.tolist(), strict=True)),
    )


def best_split(calibration: Calibration, seed: int = 0) -> Split | None:
    """The two groups of views that differ most, or None below six views.

    Parameters
    ----------
    calibration : best `widened` and `straightened`, without robust loss.
    seed : of the random starts and the replicates.
    """
    if calibration.observations.views < 2 * _LEAST:
        return None
    rng = np.random.default_rng(seed)
    problem, scale = _problem(evidence(calibration), calibration)
    second = _reassigned(problem, _beginnings(problem, rng))
    statistics = _statistic(problem, second)[0]
    best = second[int(np.argmax(statistics))]
    reached = []
    for made in _replicates(problem, rng):
        ends = _reassigned(made, _beginnings(made, rng)[:6])
        reached.append(float(_statistic(made, ends)[0].max()))
    chance = _reach(reached)
    if best.sum() > len(best) / 2:
        best = ~best
    return _described(problem, scale, calibration, best, chance)


def best_change(calibration: Calibration, seed: int = 1) -> Split | None:
    """The view from which on the camera differs most from before, or None below six views."""
    N = calibration.observations.views
    if N < 2 * _LEAST:
        return None
    rng = np.random.default_rng(seed)
    problem, scale = _problem(evidence(calibration), calibration)
    cuts = np.unique(np.linspace(_LEAST, N - _LEAST, 60).astype(np.int64))
    second = np.arange(N) >= cuts[:, None]
    statistics = _statistic(problem, second)[0]
    chance = _reach([float(_statistic(made, second)[0].max()) for made in _replicates(problem, rng)])
    return _described(problem, scale, calibration, second[int(np.argmax(statistics))], chance)
