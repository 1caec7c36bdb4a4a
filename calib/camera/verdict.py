"""Whether a calibration can be trusted: one of four verdicts, with reasons and advice.

A low RMS says that the model can be bent to the data, not that the data fix the model. `judge` asks
what the data would have to say if the answer were wrong, and refuses where they cannot object:

ok              the views determine the camera and agree with it
poor            a camera, but known too badly, or over too little of the picture
inconsistent    the views contradict each other or the board's description
unidentifiable  the views do not determine a camera; its numbers mean nothing

The worst finding decides. Remarks never do. All checks run on the unique views, without robust loss
(points it rejects are left out) and with the target rigid in the shape that was found for it.
Above 100 views the searches (other starts, profile, two cameras) run on an even sample of 100.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib.arrays import FloatArray
from calib.camera import reasons, reasons_fit
from calib.camera.board_shape import target_shape
from calib.camera.bundle import Calibration
from calib.camera.covariance import Covariance, covariance, projection_sigma_px
from calib.camera.coverage import Coverage, coverage, inside_hull, lens_shape, repeated_views
from calib.camera.evidence import evidence, overdispersion
from calib.camera.findings import INCONSISTENT, OK, REMARK, UNIDENTIFIABLE, VERDICTS, Finding, Limits
from calib.camera.misfit import misfit, screen
from calib.camera.next_view import best_next_view
from calib.camera.starts import conditioned, focal_interval, other_starts, resolved
from calib.camera.two_cameras import best_change, best_split, straightened, widened

__all__ = ["Judgement", "judge"]

_SAMPLE = 100
_LEFT_OUT_WEIGHT = 0.5
"""Points that a robust loss weighs less are left out of the checks."""


@dataclass(frozen=True)
class Judgement:
    """Verdict on a calibration.

    Attributes
    ----------
    verdict : "ok", "poor", "inconsistent" or "unidentifiable".
    reasons : sentences that explain a verdict other than ok, the worst first.
    remarks : sentences about what does not matter enough.
    advice : what to do, in order; last the picture to take next.
    numbers : what the sentences are made from, by name, as far as it is finite.
    """

    verdict: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    advice: tuple[str, ...]
    numbers: dict[str, float] = field(default_factory=dict)


def judge(
    calibration: Calibration, found: Covariance | None = None, limits: Limits | None = None
) -> Judgement:
    """Judge a calibration by its views alone.

    Parameters
    ----------
    found : its covariance, for the ratio of standard deviations that copies of views make; optional.
    """
    limits = Limits() if limits is None else limits
    observations = calibration.observations
    numbers: dict[str, float] = {"views": observations.views}
    findings = reasons.of_screening(screen(observations), observations.names)
    if any(one.kind == INCONSISTENT for one in findings):
        # What else is wrong follows from the views that are none.
        return _concluded(findings, None, numbers)
    if not np.all(np.isfinite(calibration.block.intrinsics)) or not np.all(np.isfinite(calibration.normal)):
        findings += reasons_fit.of_solution(calibration, observations.views, limits)
        if not any(one.kind == UNIDENTIFIABLE for one in findings):
            findings.append(Finding(UNIDENTIFIABLE, "The solver found no camera that fits the views."))
        return _concluded(findings, None, numbers)
    fit, copies = _without_copies(_plain(calibration), found, limits, numbers)
    findings += copies + reasons_fit.of_solution(calibration, fit.observations.views, limits)
    covered = coverage(fit)
    findings += reasons.of_coverage(covered, fit, limits)
    if fit.degrees_of_freedom <= 0 or fit.observations.views < 2 or not np.all(np.isfinite(fit.normal)):
        return _concluded(findings, None, numbers)
    left = misfit(fit, limits.view_bad, limits.point_factor, limits.point_floor_px)
    findings += reasons.of_misfit(left, fit, limits)
    sturdy = conditioned(fit)
    if sturdy is not fit:
        share = _focal_share(fit, covariance(fit), 1.0)
        findings += reasons_fit.of_denominator(share, limits)
    # A target that was deformed to fit costs certainty, which the rigid target in its shape hides.
    least = 0.0
    if calibration.basis is not None:
        least = _focal_share(calibration, covariance(calibration) if found is None else found, 1.0)
    findings += _uncertainty(sturdy, covered, least, limits, numbers)
    findings += _contradictions(sturdy, limits, numbers)
    lens = lens_shape(fit)
    findings += reasons_fit.of_lens(lens, fit, covered.radius_share)
    numbers.update(
        rms_px=fit.rms_px,
        worst_view_rms_px=float(left.view_rms_px.max()),
        repeated_error=left.repeated,
        lens_least_slope=lens.image_slope,
    )
    return _concluded(findings, sturdy, numbers)


def _plain(calibration: Calibration) -> Calibration:
    """The same fit by least squares: a robust loss turned into points left out, the target rigid."""
    observations = calibration.observations
    if calibration.basis is None and calibration.loss == "none":
        return calibration
    if calibration.loss != "none":
        observations = observations.without(calibration.weights < _LEFT_OUT_WEIGHT)
        kept = np.flatnonzero(observations.present.sum(axis=1) >= 4)
        observations = observations.select(kept)
    else:
        kept = np.arange(observations.views)
    if calibration.basis is not None:
        observations = observations.displaced(
            np.tensordot(calibration.block.deformation, calibration.basis, axes=1).T
        )
    block = calibration.block
    start = replace(block, R_CT=block.R_CT[kept], t_CT_m=block.t_CT_m[kept], deformation=np.zeros(0))
    bare = replace(
        calibration,
        observations=observations,
        block=start,
        basis=None,
        loss="none",
    )
    return resolved(bare, np.arange(len(kept)))


def _without_copies(
    fit: Calibration, found: Covariance | None, limits: Limits, numbers: dict[str, float]
) -> tuple[Calibration, list[Finding]]:
    """One view of each place, refitted."""
    width = fit.camera.image_size_px[0]
    first = repeated_views(fit, float(np.clip(2 * fit.sigma_px, 0.3, 0.004 * width)))
    unique = np.flatnonzero(first == np.arange(len(first)))
    numbers["unique_views"] = len(unique)
    if len(unique) == len(first):
        return fit, []
    single = resolved(fit, unique)
    ratio = np.nan
    if found is not None and "fx_px" in found.names and single.degrees_of_freedom > 0:
        ratio = covariance(single).sigma()["fx_px"] / found.sigma()["fx_px"]
    return single, reasons.of_copies(first, fit.observations.names, ratio, limits)


def _uncertainty(
    fit: Calibration,
    covered: Coverage,
    least_share: float,
    limits: Limits,
    numbers: dict[str, float],
) -> list[Finding]:
    """Standard deviations, profile, starts."""
    known = covariance(fit)
    inflation = overdispersion(evidence(fit))
    share = max(_focal_share(fit, known, inflation), inflation * least_share)
    width = max(fit.camera.image_size_px)
    inside = _inside(covered)
    projection = np.inf
    if len(inside):
        spread = inflation * projection_sigma_px(fit, known, inside)
        bounded = spread[~np.isnan(spread)]
        projection = float(np.median(bounded)) if len(bounded) else np.inf
    findings = []
    interval = None
    if "fx_px" in known.names:
        some = _sampled(fit)
        own = covariance(some).sigma()["fx_px"]
        interval = focal_interval(some, own, inflation)
        ends = other_starts(some)
        findings += reasons_fit.of_starts(ends, some, own, inflation, limits)
        lowest = min((end.cost for end in ends), default=np.inf)
        numbers["lowest_start_cost_share"] = lowest / max(some.squared_sum, 1e-300)
        numbers["fx_low_px"], numbers["fx_high_px"] = interval.low_px, interval.high_px
    findings += reasons_fit.of_focal(share, interval, limits)
    findings += reasons_fit.of_projection(projection, width, limits)
    numbers.update(
        sigma_inflation=inflation,
        focal_sigma_share=share,
        projection_sigma_px=projection,
        tilt_spread_deg=covered.spread_deg,
        weaker_tilt_spread_deg=covered.weaker_spread_deg,
        tilt_median_deg=float(np.median(covered.tilts_deg)),
        distance_ratio=float(covered.distances_m.max() / max(covered.distances_m.min(), 1e-12)),
        area_share=covered.area_share,
        cells_share=covered.cells_share,
        radius_share=covered.radius_share,
    )
    return findings


def _focal_share(fit: Calibration, known: Covariance, inflation: float) -> float:
    """Larger relative standard deviation of the focal lengths, inflated; zero where they are held."""
    sigma = known.sigma()
    shares = [sigma[name] / getattr(fit.camera, name) for name in ("fx_px", "fy_px") if name in sigma]
    return inflation * float(max(shares, default=0.0))


def _contradictions(fit: Calibration, limits: Limits, numbers: dict[str, float]) -> list[Finding]:
    """Two cameras, a refocused lens, a board that is not what it is said to be."""
    some = _sampled(fit)
    # The lens first: a target would bend to make up for a lens that the model cannot follow.
    wide = widened(some)
    findings = reasons_fit.of_richer(some, wide, limits)
    shape = target_shape(wide)
    findings += reasons.of_target(shape, wide, limits)
    if shape is not None:
        numbers.update(
            board_aspect=1 + shape.aspect,
            board_aspect_sigma=shape.aspect_sigma,
            board_bow_m=shape.bow_m,
            focal_share_per_half_percent_bow=shape.focal_per_bow,
        )
        wide = straightened(wide, shape.displacement_m)
    change, split = best_change(wide), best_split(wide)
    if change is not None:
        numbers["change_ratio"] = change.ratio
    if split is not None:
        numbers["split_ratio"] = split.ratio
    late = reasons.of_split(change, True, wide, limits)
    mixed = reasons.of_split(split, False, wide, limits)
    # A split in order is found by both; what matters is told, and then what chance explains less.
    if late and mixed and change is not None and split is not None:
        if late[0].kind != mixed[0].kind:
            return findings + [one for one in late + mixed if one.kind != REMARK]
        return findings + (mixed if split.ratio > change.ratio else late)
    return findings + late + mixed


def _sampled(fit: Calibration) -> Calibration:
    views = fit.observations.views
    if views <= _SAMPLE:
        return fit
    return resolved(fit, np.unique(np.linspace(0, views - 1, _SAMPLE).astype(np.int64)))


def _inside(covered: Coverage) -> FloatArray:
    """Grid of pixels inside of the hull of what was seen."""
    low, high = covered.hull_px.min(axis=0), covered.hull_px.max(axis=0)
    u, v = np.meshgrid(np.linspace(low[0], high[0], 14), np.linspace(low[1], high[1], 12))
    grid = np.stack([u.ravel(), v.ravel()], axis=1)
    return grid[inside_hull(grid, covered.hull_px)]


def _concluded(findings: list[Finding], fit: Calibration | None, numbers: dict[str, float]) -> Judgement:
    """The worst finding decides; reasons in order of weight."""
    weights = [VERDICTS.index(one.kind) for one in findings if one.kind != REMARK]
    verdict = VERDICTS[max(weights, default=0)]
    failing = sorted((f for f in findings if f.kind != REMARK), key=lambda f: -VERDICTS.index(f.kind))
    advice: list[str] = []
    for one in [*failing, *(f for f in findings if f.kind == REMARK)]:
        if one.advice and one.advice not in advice:
            advice.append(one.advice)
    # Where views contradict each other, more of them settle nothing.
    if fit is not None and verdict != INCONSISTENT:
        advice.extend(_next_picture(fit, verdict))
    return Judgement(
        verdict,
        tuple(f.text for f in failing),
        tuple(f.text for f in findings if f.kind == REMARK),
        tuple(advice),
        {name: float(value) for name, value in numbers.items() if np.isfinite(value)},
    )


def _next_picture(fit: Calibration, verdict: str) -> list[str]:
    width = max(fit.camera.image_size_px)
    if not 0.2 * width < min(fit.camera.fx_px, fit.camera.fy_px) < 50 * width:
        return []
    best = best_next_view(fit, evidence(fit).S.sum(axis=0))
    if best is None:
        return []
    lean = (
        f"tilted by {best.tilt_deg:.0f} degrees with its {best.away} edge away from the camera"
        if best.away
        else "parallel to the picture"
    )
    size = (
        "close, so that it spans about 60 % of the picture"
        if best.span_share > 0.5
        else "at about a third of the picture's size"
    )
    gain = 100 * (1 - best.remaining)
    word = (
        "The picture that would help most"
        if verdict != OK
        else "If you take another picture, the most useful"
    )
    return [
        f"{word}: the board {best.where}, {lean}, {size}; "
        f"it would lower the uncertainty by about {gain:.0f} %."
    ]
