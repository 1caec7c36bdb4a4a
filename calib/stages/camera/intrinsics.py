"""From views of a target to a judged camera: model choice, rejection, fit, covariance, verdict."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.workers import Workers
from calib.stages.camera.bundle import Calibration, Covariance, calibrate, covariance, refit_poses
from calib.stages.camera.checks import best_of_starts, lens_shape, screen
from calib.stages.camera.model import MODELS, Block, Observations, View, free_intrinsics, pack
from calib.stages.camera.verdict import Judgement, judge, of_screening

# ----------------------------------------------------------------------
# Choosing a lens model and a board model by views that were held back.
#
# A richer model always fits the views it was fitted to better. Each candidate is therefore fitted to
# some views and judged on the others, where only the six numbers of a view's pose are fitted anew.
# Among the candidates whose error on held-back views cannot be told from the best one's (a paired
# comparison over views) the simplest is taken.

BOARDS = ("rigid", "warp", "released")
"""Board models: flat with nominal corners; a paraboloid of two bows; every corner free."""

_FOLDS = 6
_MAX_ITERATIONS = 40
_ENOUGH = 1e-2
"""Of a standard deviation: far more than a comparison of held-back views needs."""
_SIGNIFICANT = 2.0
"""Standard errors by which a richer model has to win."""


@dataclass(frozen=True)
class Candidate:
    """One model on views held back.

    Attributes
    ----------
    name : of the lens model or board model.
    parameters : number of shared parameters.
    fitted_rms_px : RMS over all views when fitted to all of them.
    held_back_rms_px : RMS over views held back; NaN where a fold could not be fitted.
    per_view_px2 : (N,) mean squared residual vector of each view while it was held back.
    """

    name: str
    parameters: int
    fitted_rms_px: float
    held_back_rms_px: float
    per_view_px2: FloatArray


def board_basis(target_m: FloatArray, kind: str) -> FloatArray | None:
    """Displacements (K, 3, M) by which a board may differ from the nominal plane.

    Parameters
    ----------
    target_m : (M, 3) nominal points, metres.
    kind : "rigid" (None), "warp" (two bows across the board, mrcal's model, K = 2, the weights are
        the heights of the middle over the edges), or "released" (every corner free but for a rigid
        motion and the size of the whole, which no picture shows; K = 3 M - 7).
    """
    if kind == "rigid":
        return None
    middle = 0.5 * (target_m.max(axis=0) + target_m.min(axis=0))
    X = target_m - middle
    M = len(X)
    if kind == "warp":
        half = np.maximum(0.5 * np.ptp(target_m, axis=0), 1e-300)
        basis = np.zeros((2, 3, M))
        basis[0, 2] = 1.0 - (X[:, 0] / half[0]) ** 2
        basis[1, 2] = 1.0 - (X[:, 1] / half[1]) ** 2
        return basis
    gauge = np.zeros((7, M, 3))
    for axis in range(3):
        gauge[axis, :, axis] = 1.0
        gauge[3 + axis] = np.cross(np.eye(3)[axis], X)
    gauge[6] = X
    rows = gauge.reshape(7, 3 * M)
    kept = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), full_matrices=True)[2][7:]
    return kept.reshape(-1, M, 3).transpose(0, 2, 1)


def _folds(views: int) -> list[IntArray]:
    """Indices of the views held back in each fold, interleaved so that a sequence is spread over folds."""
    count = min(_FOLDS, views)
    return [np.arange(first, views, count, dtype=np.int64) for first in range(count)]


@dataclass(frozen=True)
class _Judges:
    """What every fold has in common; `fits` are those to all views, which a fold starts from."""

    fits: Sequence[Calibration]
    folds: Sequence[IntArray]
    skew: bool
    fixed: tuple[str, ...]


def _on_held_back(fits: Sequence[Calibration], skew: bool, fixed: tuple[str, ...]) -> FloatArray:
    """Mean squared residual vector (len(fits), N) of each view by a camera that has not seen it."""
    if not fits:
        return np.zeros((0, 0))
    views = fits[0].observations.views
    folds = _folds(views)
    squared = np.full((len(fits), views), np.nan)
    jobs = [(i, k) for i in range(len(fits)) for k in range(len(folds))]
    with Workers(_Judges(fits, folds, skew, fixed), len(jobs)) as workers:
        for (i, k), found in zip(jobs, workers.in_order(_on_fold, jobs), strict=True):
            squared[i, folds[k]] = found
    return squared


# As in the whole calibration, what is not finite is looked for; a thread does not inherit that.
@np.errstate(all="ignore")
def _on_fold(judges: _Judges, job: tuple[int, int]) -> FloatArray:
    """The same for the views of one fold, NaN where the others do not make a camera."""
    whole, held = judges.fits[job[0]], judges.folds[job[1]]
    observations = whole.observations
    kept = np.setdiff1d(np.arange(observations.views, dtype=np.int64), held)
    fit = calibrate(
        observations.select(kept),
        whole.camera.image_size_px,
        whole.camera.model,
        skew=judges.skew,
        fixed=judges.fixed,
        basis=whole.basis,
        loss=whole.loss,
        start=Block(
            whole.block.intrinsics, whole.block.R_CT[kept], whole.block.t_CT_m[kept], whole.block.deformation
        ),
        max_iterations=_MAX_ITERATIONS,
        tolerance=_ENOUGH,
    )
    # A direction that a fold leaves flat makes "iterations" usual for rich models; its error counts.
    if fit.termination in ("behind the camera", "singular"):
        return np.full(len(held), np.nan)
    residuals = refit_poses(fit, observations.select(held))
    of_point = np.sum(residuals**2, axis=2)
    known = np.isfinite(of_point)
    total = np.where(known, of_point, 0.0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _candidate(name: str, fit: Calibration, per_view: FloatArray) -> Candidate:
    counts = fit.observations.present.sum(axis=1)
    mean = float(np.sqrt(np.sum(per_view * counts) / counts.sum()))
    return Candidate(name, len(fit.free) + len(fit.block.deformation), fit.rms_px, mean, per_view)


def candidates_by_model(
    observations: Observations,
    image_size_px: tuple[int, int],
    *,
    skew: bool = False,
    fixed: tuple[str, ...] = (),
    loss: str = "none",
    models: Sequence[str] = tuple(MODELS),
) -> list[tuple[Candidate, Calibration]]:
    """Every lens model fitted to all views and judged on views held back, the simplest first.

    A model that the views are too few for is left out.
    """
    fits: list[Calibration] = []
    start: Block | None = None
    for model in models:
        if 2 * observations.points < len(free_intrinsics(model, skew, fixed)) + 6 * observations.views + 1:
            continue
        fit = calibrate(
            observations,
            image_size_px,
            model,
            skew=skew,
            fixed=fixed,
            loss=loss,
            start=start,
            max_iterations=_MAX_ITERATIONS,
            tolerance=_ENOUGH,
        )
        if fit.termination in ("behind the camera", "singular"):
            continue
        start = fit.block
        fits.append(fit)
    held = _on_held_back(fits, skew, fixed)
    return [(_candidate(fit.camera.model, fit, held[i]), fit) for i, fit in enumerate(fits)]


def candidates_by_board(
    rigid: Calibration, skew: bool, kinds: Sequence[str] = BOARDS
) -> list[tuple[Candidate, Calibration]]:
    """The same camera model with each board model, judged on views held back.

    Only for targets whose points are the same in every view; otherwise the rigid board alone.
    """
    observations, size = rigid.observations, rigid.camera.image_size_px
    names: list[str] = []
    fits: list[Calibration] = []
    for kind in kinds:
        if kind != "rigid" and not observations.same_target:
            continue
        basis = board_basis(observations.target_m[0], kind)
        shared = len(rigid.free) + (0 if basis is None else len(basis))
        # A released board needs each corner in several views held in, three at the least.
        if kind == "released" and (
            observations.views < 6 or 2 * observations.points < 2 * (shared + 6 * observations.views)
        ):
            continue
        fit = rigid
        if basis is not None:
            fit = calibrate(
                observations,
                size,
                rigid.camera.model,
                skew=skew,
                basis=basis,
                loss=rigid.loss,
                start=rigid.block,
            )
        if fit.termination in ("behind the camera", "singular"):
            continue
        names.append(kind)
        fits.append(fit)
    held = _on_held_back(fits, skew, ())
    return [(_candidate(names[i], fit, held[i]), fit) for i, fit in enumerate(fits)]


def simplest_good(candidates: Sequence[Candidate]) -> int:
    """Index of the simplest candidate that the richer ones do not beat on views held back.

    The difference of mean squared residuals is compared with its standard error over views.
    """
    chosen = 0
    for index in range(1, len(candidates)):
        better = candidates[chosen].per_view_px2 - candidates[index].per_view_px2
        if not np.all(np.isfinite(candidates[index].per_view_px2)):
            continue
        if not np.all(np.isfinite(candidates[chosen].per_view_px2)):
            chosen = index
            continue
        error = np.std(better, ddof=1) / np.sqrt(len(better)) if len(better) > 1 else np.inf
        if np.mean(better) > _SIGNIFICANT * error:
            chosen = index
    return chosen


# ----------------------------------------------------------------------
# From views of a target to a judged camera: model choice, rejection, fit, covariance, verdict.

_REJECT_SIGMAS = 5.0
_REJECT_SHARE = 0.3
"""A view that loses more of its points than this is left out whole."""
_HOPELESS = 0.02
"""RMS over the picture's larger side from which on the points belong to no camera at all."""
_LOWER = 1.0 - 1e-6
"""Cost of another start over that of the fit below which the fit is not the best one."""


@dataclass(frozen=True)
class Choices:
    """What a user decides.

    Attributes
    ----------
    model : a key of `model.MODELS`, or "auto" for the choice by views held back.
    skew : estimate the skew.
    loss : one of `levenberg.LOSSES`.
    board : one of `selection.BOARDS`, or "auto" for the choice by views held back.
    reject : leave out points that lie far off, and say which.
    """

    model: str = "auto"
    skew: bool = False
    loss: str = "none"
    board: str = "rigid"
    reject: bool = False


@dataclass(frozen=True)
class Intrinsics:
    """A camera, what it is worth, and how it was chosen.

    Attributes
    ----------
    calibration, covariance, judgement : the fit, its error bars, and the verdict on it.
    models, boards : what was compared on views held back; empty where nothing was.
    board : the board model used.
    rejected : one sentence for each point or view left out.
    seconds : wall time of "solve" (model choice included), "covariance" and "judge".
    """

    calibration: Calibration
    covariance: Covariance
    judgement: Judgement
    models: tuple[Candidate, ...]
    boards: tuple[Candidate, ...]
    board: str
    rejected: tuple[str, ...]
    seconds: dict[str, float]


def _refuse_unusable(views: Sequence[View], choices: Choices) -> None:
    """Raise `BadInputError` where no answer could follow from these views."""
    if not views:
        raise BadInputError("there are no views to calibrate from")
    if choices.skew and len(views) < 3:
        raise BadInputError(f"a camera with skew needs at least 3 views, found {len(views)}")
    for view in views:
        target_m, pixels = view.counted()
        if len(pixels) < 4:
            raise BadInputError(f"view {view.name}: has {len(pixels)} points, expected at least 4")
        for points, where in ((target_m, "on the target"), (pixels, "in the picture")):
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if spread[1] <= 1e-6 * spread[0]:
                raise BadInputError(f"view {view.name}: all its points lie on one line {where}")
    total = sum(len(view.counted()[1]) for view in views)
    if choices.model != "auto":
        unknown = len(free_intrinsics(choices.model, choices.skew)) + 6 * len(views)
        if 2 * total <= unknown:
            raise BadInputError(
                f"{len(views)} views with {total} points cannot fix the {unknown} unknowns of the model "
                f"{choices.model}"
            )


def _chosen_model(
    observations: Observations, image_size_px: tuple[int, int], choices: Choices, fixed: tuple[str, ...]
) -> tuple[str, Calibration | None, tuple[Candidate, ...]]:
    """The lens model, a fit of it to start from, and the comparison that chose it."""
    if choices.model != "auto":
        return choices.model, None, ()
    if observations.views < 3:
        return ("radial2" if observations.views == 2 else "pinhole"), None, ()
    found = candidates_by_model(
        observations, image_size_px, skew=choices.skew, fixed=fixed, loss=choices.loss
    )
    if not found:
        return "radial2", None, ()
    # A lens that folds the picture where points were seen is none, however well it fits.
    sound = [one for one in found if lens_shape(one[1]).seen_slope > 0.0] or found
    best, fit = sound[simplest_good([candidate for candidate, _ in sound])]
    return best.name, fit, tuple(candidate for candidate, _ in found)


def _outliers(fit: Calibration) -> tuple[BoolArray, list[str]]:
    """Points to leave out (N, M) and a sentence for each, from a fit with a robust loss."""
    distance = np.linalg.norm(fit.residuals_px, axis=2)
    present = fit.observations.present
    # The median of a Rayleigh distribution is 1.1774 sigma.
    sigma = float(np.median(distance[present])) / 1.1774
    far = present & (np.nan_to_num(distance) > _REJECT_SIGMAS * sigma)
    share = far.sum(axis=1) / present.sum(axis=1)
    sentences: list[str] = []
    for i, name in enumerate(fit.observations.names):
        if share[i] > _REJECT_SHARE:
            far[i] = present[i]
            sentences.append(
                f"{name}: left out whole; {share[i]:.0%} of its points lie more than "
                f"{_REJECT_SIGMAS:g} sigma off"
            )
            continue
        for j in np.flatnonzero(far[i]):
            u, v = fit.observations.pixels[i, j]
            sentences.append(
                f"{name}: point {j} at ({u:.1f}, {v:.1f}) left out; it lies {distance[i, j]:.2f} px off, "
                f"{distance[i, j] / sigma:.0f} sigma"
            )
    return far, sentences


def _without(observations: Observations, rejected: BoolArray) -> Observations:
    left = observations.without(rejected)
    return left.select(np.flatnonzero(left.present.sum(axis=1) >= 4))


# Views that belong to no camera overflow; what is not finite is looked for at each stage.
@np.errstate(all="ignore")
def calibrate_camera(
    views: Sequence[View], image_size_px: tuple[int, int], choices: Choices = Choices()
) -> Intrinsics:
    """Calibrate a camera and judge the result.

    One view leaves the principal point at the picture's centre. Raises `BadInputError` where no
    answer could follow; an answer that the data do not support comes with its verdict instead.
    """
    _refuse_unusable(views, choices)
    began = time.perf_counter()
    observations = pack(views)
    fixed = ("cx_px", "cy_px") if observations.views == 1 else ()
    rejected: list[str] = []
    if choices.reject:
        model = "radial2" if choices.model == "auto" else choices.model
        robust = calibrate(observations, image_size_px, model, skew=choices.skew, fixed=fixed, loss="cauchy")
        far, rejected = _outliers(robust)
        observations = _without(observations, far)
        if observations.views < 1:
            raise BadInputError("no view is left after leaving out points that lie far off")
    model, start, models = _chosen_model(observations, image_size_px, choices, fixed)
    fit = calibrate(
        observations,
        image_size_px,
        model,
        skew=choices.skew,
        fixed=fixed,
        loss=choices.loss,
        start=None if start is None else start.block,
    )
    board = choices.board
    boards: tuple[Candidate, ...] = ()
    if board != "rigid":
        fit, board, boards = _with_board(fit, choices)
    if fit.termination == "behind the camera":
        raise _no_camera(observations, "a solution has points behind the camera")
    solved = time.perf_counter()
    sigma = covariance(fit)
    covered = time.perf_counter()
    judgement = _judged(fit, sigma)
    if judgement.numbers.get("lowest_start_cost_share", 1.0) < _LOWER:
        better = best_of_starts(fit)
        if better is not fit:
            fit, sigma = better, covariance(better)
            judgement = _judged(fit, sigma)
    judged = time.perf_counter()
    seconds = {"solve": solved - began, "covariance": covered - solved, "judge": judged - covered}
    return Intrinsics(fit, sigma, judgement, models, boards, board, tuple(rejected), seconds)


def _judged(fit: Calibration, sigma: Covariance) -> Judgement:
    try:
        return judge(fit, sigma)
    except (np.linalg.LinAlgError, ValueError, IndexError) as error:
        # Points that no camera sees on a flat board leave the checks without a linear system to solve.
        if fit.rms_px < _HOPELESS * max(fit.camera.image_size_px):
            raise
        raise _no_camera(fit.observations, f"the best leaves an RMS of {fit.rms_px:.0f} px") from error


def _no_camera(observations: Observations, what: str) -> BadInputError:
    """The error for views that no camera fits, with those named that are no views of a flat target."""
    found = of_screening(screen(observations), observations.names)
    why = found[0].text if found else "Expected views of one flat target, each point with its own pixel."
    return BadInputError(f"no camera fits these views: {what}. {why}")


def _with_board(rigid: Calibration, choices: Choices) -> tuple[Calibration, str, tuple[Candidate, ...]]:
    """The same camera with the board model that was asked for, or that views held back prefer."""
    if not rigid.observations.same_target:
        raise BadInputError(f"--board {choices.board} needs the same points of the target in every view")
    if choices.board == "auto" and rigid.observations.views < 3:
        return rigid, "rigid", ()
    if choices.board == "auto":
        found = candidates_by_board(rigid, choices.skew, BOARDS)
        best = simplest_good([candidate for candidate, _ in found])
        return found[best][1], found[best][0].name, tuple(candidate for candidate, _ in found)
    observations = rigid.observations
    basis = board_basis(observations.target_m[0], choices.board)
    if basis is not None and 2 * observations.points <= len(basis) + len(rigid.free) + 6 * observations.views:
        raise BadInputError(
            f"--board {choices.board} has more unknowns than {observations.views} views can fix"
        )
    fit = calibrate(
        observations,
        rigid.camera.image_size_px,
        rigid.camera.model,
        skew=choices.skew,
        basis=basis,
        loss=choices.loss,
        start=rigid.block,
    )
    return fit, choices.board, ()
