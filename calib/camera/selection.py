"""Choosing a lens model and a board model by views that were held back.

A richer model always fits the views it was fitted to better. Each candidate is therefore fitted to
some views and judged on the others, where only the six numbers of a view's pose are fitted anew.
Among the candidates whose error on held-back views cannot be told from the best one's (a paired
comparison over views) the simplest is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.bundle import Calibration, calibrate, refit_poses
from calib.camera.model import MODELS
from calib.camera.projection import Block, free_intrinsics
from calib.camera.views import Observations
from calib.workers import Workers

__all__ = [
    "BOARDS",
    "Candidate",
    "board_basis",
    "candidates_by_board",
    "candidates_by_model",
    "simplest_good",
]

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
