"""From views of a target to a judged camera: model choice, rejection, fit, covariance, verdict."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray
from calib.camera.bundle import Calibration, calibrate
from calib.camera.covariance import Covariance, covariance
from calib.camera.coverage import lens_shape
from calib.camera.misfit import screen
from calib.camera.projection import free_intrinsics
from calib.camera.reasons import of_screening
from calib.camera.selection import (
    BOARDS,
    Candidate,
    board_basis,
    candidates_by_board,
    candidates_by_model,
    simplest_good,
)
from calib.camera.starts import best_of_starts
from calib.camera.verdict import Judgement, judge
from calib.camera.views import Observations, View, pack
from calib.errors import BadInputError

__all__ = ["Choices", "Intrinsics", "calibrate_camera"]

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
        if len(view.pixels) < 4:
            raise BadInputError(f"view {view.name}: has {len(view.pixels)} points, expected at least 4")
        for points, where in ((view.target_m, "on the target"), (view.pixels, "in the picture")):
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if spread[1] <= 1e-6 * spread[0]:
                raise BadInputError(f"view {view.name}: all its points lie on one line {where}")
    total = sum(len(view.pixels) for view in views)
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
