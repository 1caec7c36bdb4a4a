"""From views of a target to a judged camera: model choice, triage, fit, covariance, verdict."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.verdict import Finding, Verdict
from calib.core.workers import Workers
from calib.solve.chance import tail_of_t
from calib.stages.camera import checks
from calib.stages.camera.bundle import (
    Calibration,
    Covariance,
    calibrate,
    covariance,
    equidistant_start,
    projection_sigma_px,
    refit_poses,
    refitted,
)
from calib.stages.camera.model import (
    FISHEYE,
    MODELS,
    Block,
    LeftOut,
    Observations,
    View,
    free_intrinsics,
    pack,
    scale_of,
)
from calib.stages.camera.options import BY_DEFAULT, Choices
from calib.stages.camera.triage import Triage, triage, turned_views
from calib.stages.camera.verdict import (
    Limits,
    judge,
    of_board,
    of_copies,
    of_faults,
    of_leaving,
    repeated_errors,
    two_cameras,
)

# ----------------------------------------------------------------------
# Choosing a lens model and a board model by views that were held back.
#
# A richer model always fits the views it was fitted to better. Each candidate is therefore fitted to
# some views and judged on the others, where only the six numbers of a view's pose are fitted anew.
# The simplest candidate is taken that no richer one beats: by the logarithms of the ratios of the views'
# errors (a paired t test; a view that no model explains, or one alone, weighs no more than another), and
# by pixels. A lens model that is not one-to-one over the picture, or whose projection is anybody's guess at
# its border, is no candidate, however well it fits where points were seen.

BOARDS = ("rigid", "warp", "released")
"""Board models: flat with nominal corners; a paraboloid of two bows; every corner free."""

_FOLDS = 6
_MANY = 40
"""Views from which on evidence tells the rational model's error on views held back to about a percent."""
_ROUGHLY: dict[str, Any] = {"max_iterations": 40, "tolerance": 1e-2}
"""How far a fit goes: a hundredth of a standard deviation, far more than a comparison of views needs."""
_CHANCE = 0.023
"""Probability of a win by chance below which a richer model wins; two standard errors of many views."""
_GAIN_PX = 0.005
"""Error that a richer model has to take away in a typical view, at up to 1000 pixels' width."""
_WORSE = 1.2
"""Held-back error over that of the best candidate above which a model is not taken, significance or not."""
_HOPELESS_RATIO = 3.0
"""Held-back error of the sound models over that of the others above which they give way."""
_LESS, _SAME = 0.95, 1.01
"""RMS of the rational model over the simpler ones' below which it is worth more starts, and over the least of
its own below which a fit without a pole is preferred."""
_EQUIDISTANT = (0.3, 0.5)
"""Focal lengths of wide lenses to start from, over the picture's larger side."""
_WIDE = float(np.radians(40.0))
"""Angle from the axis from which on a fisheye lens is tried; below it the radial models follow its curve."""
_SKEW_SIGMAS, _SKEW_PX = 3.0, 0.01
"""Standard deviations, and pixels by which directions move at up to 1000 pixels' width, that make a skew."""
_SOUND = 3
_BORDER_SHARE = 0.05
"""Standard deviation of projection at the picture's border, over the width, above which a lens is a guess."""


class LensModel(NamedTuple):
    """A key of `model.MODELS`, and whether the skew is estimated."""

    model: str
    skew: bool = False

    def __str__(self) -> str:
        return f"{self.model}, skew" if self.skew else self.model

    @staticmethod
    def of(fit: Calibration) -> LensModel:
        """That of a fit."""
        return LensModel(fit.camera.model, "skew_px" in fit.free_names)


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
    soundness : 3 when the lens is one-to-one over the picture and known to its border, 2 when it is
        one-to-one there, 1 when it is where points were seen, 0 when it folds among them.
    """

    name: str
    parameters: int
    fitted_rms_px: float
    held_back_rms_px: float
    per_view_px2: FloatArray
    soundness: int = _SOUND

    @property
    def flaw(self) -> str:
        """Why it is no candidate, "" where it is one."""
        if self.soundness == _SOUND:
            return ""
        known = "not known at the picture's border"
        return known if self.soundness == _SOUND - 1 else "not one-to-one over the picture"


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


def _on_held_back(fits: Sequence[Calibration]) -> FloatArray:
    """Mean squared residual vector (len(fits), N) of each view by a camera that has not seen it.

    What each view says about the camera (`checks.evidence`) tells it without another fit. Not so for a robust
    loss, and the rational model, whose numerator and denominator move far together at next to no cost. Of
    many views that one is fitted to parts only where it has a chance: where it shows the views that it was
    fitted to better than the best of the others shows those held back.
    """
    if not fits:
        return np.zeros((0, 0))
    views = fits[0].observations.views
    # Interleaved, so that a sequence is spread over the folds.
    folds = [np.arange(views)[first::_FOLDS] for first in range(min(_FOLDS, views))]
    squared = np.array([_by_evidence(fit, folds) for fit in fits])
    gain_px2 = (_GAIN_PX * scale_of(fits[0].camera.image_size_px)) ** 2
    rational = np.array([fit.camera.model == "rational8" for fit in fits])
    goal = np.median(squared[~rational], axis=1).min(initial=np.inf) - gain_px2
    bent = [
        i
        for i, fit in enumerate(fits)
        if fit.loss != "none"
        or (rational[i] and (views < _MANY or not np.median(fit.view_rms_px**2) >= goal))
    ]
    jobs = [(i, fold) for i in bent for fold in folds]
    with Workers(fits, len(jobs)) as workers:
        for (i, fold), found in zip(jobs, workers.in_order(_on_fold, jobs), strict=True):
            squared[i, fold] = found
    return squared


def _by_evidence(fit: Calibration, folds: Sequence[IntArray]) -> FloatArray:
    """The same (N,) to second order about the fit to all views."""
    found = checks.evidence(fit, fit.basis)
    squared = np.empty(len(found.cost))
    for fold in folds:
        others = found.of(np.setdiff1d(np.arange(len(squared)), fold))
        squared[fold] = found.cost_at(others.solved().step)[fold]
    return squared / np.maximum(found.measured / 2, 1)


# As in the whole calibration, what is not finite is looked for; a thread does not inherit that.
@np.errstate(all="ignore")
def _on_fold(fits: Sequence[Calibration], job: tuple[int, IntArray]) -> FloatArray:
    """The same for the views of one fold, NaN where the others do not make a camera."""
    whole, held = fits[job[0]], job[1]
    observations = whole.observations
    kept = np.setdiff1d(np.arange(observations.views, dtype=np.int64), held)
    fit = refitted(whole, kept, **_ROUGHLY)
    # A direction that a fold leaves flat makes "iterations" usual for rich models; its error counts.
    if fit.termination in ("behind the camera", "singular"):
        return np.full(len(held), np.nan)
    residuals = refit_poses(fit, observations.select(held))
    of_point = np.sum(residuals**2, axis=2)
    known = np.isfinite(of_point)
    total = np.where(known, of_point, 0.0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _soundness(fit: Calibration) -> int:
    """`Candidate.soundness` of a lens."""
    shape = checks.lens_shape(fit)
    if not shape.one_to_one:
        return int(not shape.folds_among_points)
    border = projection_sigma_px(fit, covariance(fit), checks.image_outline(fit.camera))
    return _SOUND if np.all(border < _BORDER_SHARE * max(fit.camera.image_size_px)) else 2


def _candidate(name: str, fit: Calibration, per_view: FloatArray, soundness: int = 3) -> Candidate:
    counts = fit.observations.present.sum(axis=1)
    mean = float(np.sqrt(np.sum(per_view * counts) / counts.sum()))
    return Candidate(name, len(fit.free) + len(fit.block.deformation), fit.rms_px, mean, per_view, soundness)


def candidates_by_model(
    observations: Observations,
    image_size_px: tuple[int, int],
    *,
    skew: bool = False,
    loss: str = "none",
) -> list[tuple[Candidate, Calibration]]:
    """Every lens model fitted to all views and judged on views held back, the simplest first.

    A model that the views are too few for is left out, and a fisheye lens where no view is wide.
    """
    fits: list[Calibration] = []

    def fitted(model: str, start: Block | None) -> Calibration | None:
        if 2 * observations.points < len(free_intrinsics(model, skew)) + 6 * observations.views + 1:
            return None
        fit = calibrate(observations, image_size_px, model, skew=skew, loss=loss, start=start, **_ROUGHLY)
        return None if fit.termination in ("behind the camera", "singular") else fit

    order = list(MODELS)
    # The pinhole comes last: it tilts boards to make up for the lens, and richer models stay where it led.
    for model in [one for one in order if one not in ("pinhole", FISHEYE)]:
        fit = fitted(model, fits[-1].block if fits else None)
        if fit is not None and model == "rational8" and not skew:
            fit = _sturdier(fit, fits)
        fits += [] if fit is None else [fit]
    pinhole = fitted("pinhole", fits[0].block if fits else None)
    fits += [] if pinhole is None else [pinhole]
    if any(map(_wide, fits)):
        fit = fitted(FISHEYE, None)
        fits += [] if fit is None else [fit]
    fits.sort(key=lambda one: order.index(one.camera.model))
    held = _on_held_back(fits)
    return [
        (_candidate(str(LensModel.of(fit)), fit, held[i], _soundness(fit)), fit) for i, fit in enumerate(fits)
    ]


def _wide(fit: Calibration) -> bool:
    """Whether points were seen far from the axis, or a lens folds among them to follow a wide one.

    The rational model folds by noise alone.
    """
    folds = fit.camera.model != "rational8" and checks.lens_shape(fit).folds_among_points
    return bool(checks.seen_angles(fit).max() > _WIDE) or folds


def _sturdier(fit: Calibration, simpler: Sequence[Calibration]) -> Calibration:
    """The rational model from other starts, where it is worth them and it or a simpler one folds."""
    sound = [checks.lens_shape(one).one_to_one for one in simpler]
    least = min((one.rms_px for one, good in zip(simpler, sound, strict=True) if good), default=np.inf)
    if not fit.rms_px < _LESS * least or (all(sound) and checks.lens_shape(fit).one_to_one):
        return fit
    return _of_other_starts(fit, simpler)


def _of_other_starts(fit: Calibration, simpler: Sequence[Calibration]) -> Calibration:
    """The rational model from more starts: one without a pole in the picture if it fits as well.

    Its cost has many minima. A simpler model that folds leads into a wrong one, and noise alone makes some
    with a pole in the picture, next to a zero that hides it.
    """
    observations, size = fit.observations, fit.camera.image_size_px
    fitted = partial(refitted, fit, **_ROUGHLY)
    starts = [equidistant_start(observations, size, share * max(size)) for share in _EQUIDISTANT]
    starts = [start for start in starts if start.posed.all()]
    if simpler:
        starts.append(fitted(start=simpler[-1].block, fixed=("k6",)).block)
    fits = [fit, *(fitted(start=start) for start in starts)]
    fits = [one for one in fits if np.isfinite(one.rms_px)]
    least = min((one.rms_px for one in fits), default=np.inf)
    return min(
        fits,
        key=lambda one: (one.rms_px > _SAME * least, not checks.lens_shape(one).one_to_one, one.rms_px),
        default=fit,
    )


def candidates_by_board(rigid: Calibration) -> list[tuple[Candidate, Calibration]]:
    """The same camera model with each board model, judged on views held back.

    Only for targets whose points are the same in every view; otherwise the rigid board alone.
    """
    observations = rigid.observations
    fits: dict[str, Calibration] = {}
    for kind in BOARDS:
        if kind != "rigid" and not observations.same_target:
            continue
        basis = board_basis(observations.target_m[0], kind)
        shared = len(rigid.free) + (0 if basis is None else len(basis))
        # A released board needs each corner in several views held in, three at the least.
        if kind == "released" and (
            observations.views < 6 or 2 * observations.points < 2 * (shared + 6 * observations.views)
        ):
            continue
        fit = rigid if basis is None else refitted(rigid, basis=basis, fixed=())
        if fit.termination not in ("behind the camera", "singular"):
            fits[kind] = fit
    held = _on_held_back(list(fits.values()))
    return [(_candidate(kind, fit, one), fit) for (kind, fit), one in zip(fits.items(), held, strict=True)]


def simplest_good(candidates: Sequence[Candidate], scale: float = 1.0) -> int:
    """Index of the simplest candidate that the richer ones do not beat on views held back.

    Parameters
    ----------
    scale : `scale_of` the picture.
    """
    chosen = 0
    for index in range(1, len(candidates)):
        if _beats(candidates[index], candidates[chosen], _GAIN_PX * scale):
            chosen = index
    return chosen


def chosen_lens(candidates: Sequence[Candidate], scale: float = 1.0) -> int:
    """Index of the simplest good lens model among the sound ones.

    A sound model that leaves far larger errors than one that is not gives way: a lens that is known where
    points were seen is worth more than one that is right nowhere, and the verdict says what it is.
    """
    usable = [
        one.held_back_rms_px for one in candidates if one.soundness and np.isfinite(one.held_back_rms_px)
    ]
    for least in (3, 2, 1):
        index = [i for i, one in enumerate(candidates) if one.soundness >= least]
        if index:
            best = index[simplest_good([candidates[i] for i in index], scale)]
            if not candidates[best].held_back_rms_px > _HOPELESS_RATIO * min(usable, default=np.inf):
                return best
    return simplest_good(candidates, scale)


def _beats(richer: Candidate, simpler: Candidate, gain_px: float) -> bool:
    """Whether a richer model is better by more than chance, and by more than a few thousandths of a pixel."""
    a, b = richer.per_view_px2, simpler.per_view_px2
    if not np.all(np.isfinite(a)):
        return False
    if not np.all(np.isfinite(b)):
        return True
    typical = float(np.median(b) - np.median(a))
    if not typical > gain_px**2:
        return False
    if (
        np.median(b) > _WORSE**2 * np.median(a)
        and simpler.held_back_rms_px > _WORSE * richer.held_back_rms_px
    ):
        return True
    if len(a) < 2:
        return False
    ratio = np.log(np.maximum(b, 1e-300) / np.maximum(a, 1e-300))
    error = float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    return tail_of_t(len(ratio) - 1, float(np.mean(ratio)) / max(error, 1e-300)) < _CHANCE


# ----------------------------------------------------------------------
# From views of a target to a judged camera: model choice, triage, fit, covariance, verdict.

_HOPELESS = 0.02
"""RMS over the picture's larger side from which on the points belong to no camera at all."""
_ROUGH = "radial2"
_TRIAGES = 3
"""Times that a model is chosen; bad views can make the first choice wrong."""
_FEW_ODD = 2
"""Most views that are no second camera."""


@dataclass(frozen=True)
class Intrinsics:
    """A camera, what it is worth, and how it was chosen.

    Attributes
    ----------
    calibration, covariance, verdict : the fit, its error bars by the scatter of the views, and whether to
        trust it.
    models, boards : what was compared on views held back; empty where nothing was.
    board : the board model used.
    left_out : files, views and points that are not used, and why.
    seconds : wall time of "solve" (model choice included), "covariance" and "judge".
    """

    calibration: Calibration
    covariance: Covariance
    verdict: Verdict
    models: tuple[Candidate, ...]
    boards: tuple[Candidate, ...]
    board: str
    left_out: tuple[LeftOut, ...]
    seconds: dict[str, float]


def _usable(views: Sequence[View], choices: Choices) -> tuple[Observations, list[LeftOut]]:
    """Views that can be views of a plane, and the others.

    Where all show points that no camera sees on a plane, they are used. Raises `BadInputError` where no
    answer could follow from what is left.
    """
    if not views:
        raise BadInputError("there are no views to calibrate from")
    everything = pack(views)
    faults = checks.view_faults(everything)
    for allowed in ("", checks.FAULTS[-1]):
        kept = [i for i, fault in enumerate(faults) if fault in ("", allowed)]
        if kept:
            break
    left_out = [
        LeftOut(views[i].name, f"shows {why}", "view") for i, why in enumerate(faults) if i not in kept
    ]
    if not kept:
        raise BadInputError(f"view {left_out[0]}")
    if choices.skew and len(kept) < 3:
        raise BadInputError(f"a camera with skew needs at least 3 views, found {len(kept)}")
    usable = everything.select(kept)
    if choices.model != "auto":
        unknown = len(free_intrinsics(choices.model, bool(choices.skew))) + 6 * len(kept)
        if 2 * usable.points <= unknown:
            raise BadInputError(
                f"{len(kept)} views with {usable.points} points cannot fix the {unknown} unknowns of the "
                f"model {choices.model}"
            )
    return usable, left_out


def _chosen_model(
    observations: Observations,
    image_size_px: tuple[int, int],
    choices: Choices,
) -> tuple[LensModel, Calibration | None, tuple[Candidate, ...]]:
    """The lens model, a fit of it to start from, and the comparison that chose it."""
    asked = bool(choices.skew)
    if choices.model == "rational8" and observations.views >= 3:
        simpler = calibrate(observations, image_size_px, "brown5", skew=asked, loss=choices.loss, **_ROUGHLY)
        fit = refitted(simpler, model="rational8", **_ROUGHLY)
        if not checks.lens_shape(fit).one_to_one:
            fit = _of_other_starts(fit, [simpler])
        return LensModel(choices.model, asked), fit, ()
    if choices.model != "auto":
        return LensModel(choices.model, asked), None, ()
    if observations.views < 3:
        return LensModel("radial2" if observations.views == 2 else "pinhole", asked), None, ()

    def compared(skew: bool) -> tuple[list[Candidate], list[Calibration], int]:
        found = candidates_by_model(observations, image_size_px, skew=skew, loss=choices.loss)
        candidates = [one for one, _ in found]
        return candidates, [fit for _, fit in found], chosen_lens(candidates, scale_of(image_size_px))

    candidates, fits, best = compared(asked)
    if not fits:
        return LensModel("radial2", asked), None, ()
    decentred = next((i for i, fit in enumerate(fits) if fit.camera.model == "brown5"), best)
    if best < decentred and not _worse(candidates[decentred], candidates[best]) and _decentred(fits[best]):
        best = decentred
    if choices.skew is None and _skewed(fits[best]):
        others, other_fits, other = compared(True)
        # Decentering that a lens lacks must not pass for skew.
        lenses = ("brown5", other_fits[other].camera.model) if other_fits else ()
        same = [fit for fit in fits if fit.camera.model in lenses]
        if same and all(map(_skewed, same)) and not _worse(others[other], candidates[best]):
            return LensModel.of(other_fits[other]), other_fits[other], (*candidates, *others)
        candidates += others
    return LensModel.of(fits[best]), fits[best], tuple(candidates)


def _decentred(fit: Calibration) -> bool:
    """Whether the views show a decentering that a radial lens leaves out, and that matters.

    It passes for another principal point, at an error in each view that is lost in the noise.
    """
    if fit.camera.fisheye or "p1" in fit.free_names:
        return False
    found = checks.left_out(fit, "p1", "p2")
    by_chance = np.exp(-0.5 * found.chi2)
    return bool(by_chance < _CHANCE and found.moved_px > _SKEW_PX * scale_of(fit.camera.image_size_px))


def _skewed(fit: Calibration) -> bool:
    """Whether the views show a skew that a fit without one leaves out, and that matters."""
    found = checks.left_out(fit, "skew_px")
    return (
        found.chi2 > _SKEW_SIGMAS**2
        and found.moved_px > _SKEW_PX * scale_of(fit.camera.image_size_px)
        and found.shear_chi2 < _SKEW_SIGMAS**2
    )


def _worse(candidate: Candidate, other: Candidate) -> bool:
    """Whether a candidate is the less sound one, or predicts a typical view less well."""
    ratio = np.log(candidate.per_view_px2 / other.per_view_px2)
    return candidate.soundness < other.soundness or not np.mean(ratio) <= 0.0


# Views that belong to no camera overflow; what is not finite is looked for at each stage.
@np.errstate(all="ignore")
def calibrate_camera(
    views: Sequence[View],
    image_size_px: tuple[int, int],
    choices: Choices = BY_DEFAULT,
    left_out: Sequence[LeftOut] = (),
) -> Intrinsics:
    """Calibrate a camera and judge the result.

    Copies of a view, and views and points that do not agree with the others, are left out. One view leaves
    the principal point at the picture's centre. Raises `BadInputError` where no answer could follow; an
    answer that the data do not support comes with its verdict instead.

    Parameters
    ----------
    left_out : files that were left out before; the verdict considers how many.
    """
    began = time.perf_counter()
    everything, unusable = _usable(views, choices)
    everything, copies = without_copies(everything, image_size_px)
    unusable += copies
    sorted_out, models = _sorted_out(everything, image_size_px, choices)
    of_all = sorted_out.everything
    turned = turned_views(_on_its_board(of_all))
    by_name = {one.name for one in turned}
    if turned and not choices.keep_all:
        everything = everything.select(np.flatnonzero(~np.isin(everything.names, list(by_name))))
        sorted_out, models = _sorted_out(everything, image_size_px, choices)
    shaped, bent = everything, choices.board != "auto"
    if not bent:
        rigid = sorted_out
        sorted_out, models, shaped, bent = _on_the_board_seen(everything, rigid, models, choices)
        of_all = of_all if turned or sorted_out is rigid else sorted_out.everything
    odd = [*turned, *(one for one in sorted_out.left_out if one.name not in by_name)]
    leaving = [*left_out, *unusable, *odd]
    agree = sorted_out.calibration.observations.views
    moved_px = _moved_px(replace(sorted_out, everything=of_all))
    findings = list(of_leaving(leaving, agree, choices.keep_all, moved_px))
    if sorted_out.left_out and not _alone_odd(sorted_out):
        several = two_cameras(sorted_out.everything)
        if any(one.severity == "inconsistent" for one in findings):
            findings += several
        elif any(one.severity == "inconsistent" for one in several):
            # Of two cameras that share the views neither is the odd one, and no view is to blame.
            lens, start, models = _chosen_model(shaped, image_size_px, choices)
            first = None if start is None else start.block
            fit = calibrate(shaped, image_size_px, lens.model, skew=lens.skew, start=first)
            sorted_out = Triage.of_all(fit)
            leaving = [*left_out, *unusable, *turned]
            findings = [*of_leaving(leaving, everything.views, choices.keep_all), *several]
    not_used = [*left_out, *unusable] if choices.keep_all else leaving
    fit = sorted_out.calibration
    if choices.keep_all:
        fit = sorted_out.everything
    if choices.loss != "none":
        fit = refitted(fit, loss=choices.loss)
    fit = _of_target(fit, everything)
    board = _with_board(fit, choices) if bent else _Board(fit, fit, "rigid", ())
    fit = board.fit
    if fit.termination == "behind the camera":
        raise _no_camera(fit.observations, "a solution has points behind the camera")
    solved = time.perf_counter()
    sigma = checks.by_the_views(fit)
    covered = time.perf_counter()
    findings += of_copies(copies)
    of_shape = [] if board.name == "rigid" else of_board(board.flat)
    verdict = _judged(fit, [*findings, *of_shape])
    if verdict.word == "unidentifiable":
        # Views that do not tell the camera do not tell the board's shape either.
        better = checks.best_of_starts(board.flat if choices.board == "auto" else fit)
        if better is not fit:
            fit, board, sigma = better, board._replace(name="rigid"), checks.by_the_views(better)
            verdict = _judged(fit, findings)
    judged = time.perf_counter()
    seconds = {"solve": solved - began, "covariance": covered - solved, "judge": judged - covered}
    return Intrinsics(fit, sigma, verdict, models, board.compared, board.name, tuple(not_used), seconds)


def without_copies(
    observations: Observations, image_size_px: tuple[int, int]
) -> tuple[Observations, list[LeftOut]]:
    """One view of each place of the board, and the others by name.

    Of the views with most points that is the one with the least residuals of a rough fit, or else the first.
    """
    first = checks.repeated_views(observations, max(image_size_px))
    if len(np.unique(first)) == len(first):
        return observations, []
    fit = calibrate(observations, image_size_px, _ROUGH, **_ROUGHLY)
    rms = np.nan_to_num(np.round(fit.view_rms_px, 6))
    order = np.lexsort((rms, -observations.present.sum(axis=1)))
    place, best = np.unique(first[order], return_index=True)
    own = dict(zip(place.tolist(), order[best].tolist(), strict=True))
    names = observations.names
    copies = [
        LeftOut(names[i], f"shows the board where {names[own[k]]} does", "copy")
        for i, k in enumerate(first.tolist())
        if own[k] != i
    ]
    return observations.select(sorted(own.values())), copies


def _on_its_board(fit: Calibration) -> Calibration:
    """The fit to a board of the shape that all views tell, or the same.

    A bow or a stretch moves the principal point of a view with its tilt, as another camera or a picture that
    was turned does.
    """
    shape = checks.certain_shape(fit)
    return fit if shape is None else checks.straightened(fit, shape.displacement_m)


def _on_the_board_seen(
    everything: Observations, found: Triage, models: tuple[Candidate, ...], choices: Choices
) -> tuple[Triage, tuple[Candidate, ...], Observations, bool]:
    """The views that agree, and their lens model, on a board of the shape that they tell.

    With all views of that board, and whether it is another than the one described. The bend of a board passes
    for a lens's, and bad views hide behind the errors of a wrong board.
    """
    shaped, bent = everything, False
    for _ in range(_TRIAGES):
        fit = _of_target(found.calibration, everything)
        board = _with_board(checks.widened(fit) if choices.model == "auto" else fit, choices)
        if board.name == "rigid":
            break
        bent, straight = True, board.fit.shaped(everything)
        again, models_again = _sorted_out(straight, fit.camera.image_size_px, choices)
        if len(_gone(again)) > max(len(_gone(found)), Limits.leaving_bad * everything.views):
            break
        settled = _gone(again) == _gone(found)
        shaped, found, models = straight, again, models_again
        if settled:
            break
    return found, models, shaped, bent


def _screened(fit: Calibration) -> Triage:
    """The views that agree: on a board as it is described, or of another shape where more agree on that."""
    found = triage(fit)
    everything, gone = fit.observations, _gone(found)
    for source in (fit, found.calibration) if gone else ():
        shape = checks.certain_shape(source)
        other = None if shape is None else triage(checks.straightened(fit, shape.displacement_m))
        leaving = _gone(other) if other else gone
        if other is None or len(leaving) >= len(gone):
            continue
        kept = np.flatnonzero(~np.isin(everything.names, list(leaving)))
        some = everything.select(kept)
        seen = some.without(some.present & ~other.calibration.observations.present)
        rigid = refitted(replace(fit, observations=everything), kept, observations=seen)
        found, gone = Triage(rigid, fit, other.left_out, other.scale_px), leaving
    return found


def _alone_odd(found: Triage) -> bool:
    """Whether one or two views leave and the others agree as well as views of one camera do.

    Where those few differ by much, views that agree may seem to share a second camera with them.
    """
    if len(_gone(found)) > _FEW_ODD:
        return False
    alone, together = checks.alone_px(_on_its_board(found.calibration))
    return together < Limits.change_times * alone


def _moved_px(found: Triage) -> float:
    """By how much all views and those that agree put directions apart, over `scale_of` the camera."""
    every, some = found.everything, found.calibration
    difference = (every.block.intrinsics - some.block.intrinsics)[some.free]
    return checks.apart_px(some, difference) / scale_of(some.camera.image_size_px)


def _sorted_out(
    everything: Observations,
    image_size_px: tuple[int, int],
    choices: Choices,
) -> tuple[Triage, tuple[Candidate, ...]]:
    """The views that agree, by the model that views held back choose among them."""
    fixed = ("cx_px", "cy_px") if everything.views == 1 else ()

    observations, before = everything, None
    for _ in range(_TRIAGES):
        lens, start, models = _chosen_model(observations, image_size_px, choices)
        if lens == before:
            break
        # The start has the poses of the views that the model was chosen by, which may be fewer.
        first = start.block if start is not None and observations is everything else None
        fit = calibrate(everything, image_size_px, lens.model, skew=lens.skew, fixed=fixed, start=first)
        found = Triage.of_all(fit) if fit.termination == "behind the camera" else _screened(fit)
        if not found.left_out or choices.model != "auto":
            break
        observations, before = found.calibration.observations, lens
    return found, models


def _judged(fit: Calibration, findings: Sequence[Finding]) -> Verdict:
    try:
        return judge(fit, findings)
    except (np.linalg.LinAlgError, ValueError, IndexError) as error:
        # Points that no camera sees on a flat board leave the checks without a linear system to solve.
        if fit.rms_px < _HOPELESS * max(fit.camera.image_size_px):
            raise
        raise _no_camera(fit.observations, f"the best leaves an RMS of {fit.rms_px:.0f} px") from error


def _no_camera(observations: Observations, what: str) -> BadInputError:
    """The error for views that no camera fits, with those named that are no views of a flat target."""
    found = next(of_faults(observations), None)
    why = found.text if found else "Expected views of one flat target, each point with its own pixel."
    return BadInputError(f"no camera fits these views: {what}. {why}")


def _of_target(fit: Calibration, everything: Observations) -> Calibration:
    """The same views of the target as it is described."""
    seen = fit.observations
    if seen.target_m is everything.target_m or not seen.same_target:
        return fit
    described = Observations(seen.names, everything.target_m, seen.pixels, seen.present)
    return refitted(fit, observations=described)


def _gone(found: Triage) -> set[str]:
    """Names of the views that leave."""
    return {one.name for one in found.left_out if one.kind == "view"}


class _Board(NamedTuple):
    """A fit to the board as described, one with a model of its shape, its name, and what was compared."""

    flat: Calibration
    fit: Calibration
    name: str
    compared: tuple[Candidate, ...]


def _with_board(flat: Calibration, choices: Choices) -> _Board:
    """The same camera with the board model that was asked for, or that views held back prefer."""
    observations = flat.observations
    as_described = _Board(flat, flat, "rigid", ())
    if choices.board == "rigid":
        return as_described
    if choices.board == "auto":
        if observations.views < checks.TELL_SHAPE or not observations.same_target:
            return as_described
        shape, chance = checks.shape_or_none(flat), checks.CERTAIN / np.sqrt(observations.target_m.shape[1])
        refuted = (shape is not None and shape.certain) or repeated_errors(flat) ** 2 > 1.0 + chance
        if not refuted and (shape is None or not shape.allowed):
            return as_described
        found = candidates_by_board(flat)
        if not found or found[0][1] is not flat:
            # Without a camera there is nothing to compare with.
            return as_described
        compared = tuple(one for one, _ in found)
        best = simplest_good(compared, scale_of(flat.camera.image_size_px))
        if refuted:
            # No reason is left to prefer the simplest, nor to count against a shape that it is known no
            # better than the corners are, which moves the camera by little.
            noise = np.log1p([one.parameters / (2 * observations.points) for one in compared])
            best = int(np.argmin(np.array([np.mean(np.log(one.per_view_px2)) for one in compared]) - noise))
        alone, together = checks.alone_px(found[best][1])
        # What changes from view to view is no shape of one board.
        best = 0 if together > Limits.change_times * alone else best
        return _Board(flat, found[best][1], compared[best].name, compared)
    if not observations.same_target:
        raise BadInputError(f"--board {choices.board} needs the same points of the target in every view")
    basis = board_basis(observations.target_m[0], choices.board)
    if basis is not None and 2 * observations.points <= len(basis) + len(flat.free) + 6 * observations.views:
        raise BadInputError(
            f"--board {choices.board} has more unknowns than {observations.views} views can fix"
        )
    return _Board(flat, refitted(flat, basis=basis, loss=choices.loss, fixed=()), choices.board, ())
