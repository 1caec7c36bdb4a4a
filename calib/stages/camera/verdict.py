"""Whether a calibration can be trusted: one of four verdicts, with reasons and advice.

A low RMS says that the model can be bent to the data, not that the data fix the model. `judge` asks what the
data would have to say if the answer were wrong, and refuses where they cannot object:

ok              the views determine the camera and agree with it
poor            a camera, but known too badly, or over too little of the picture
inconsistent    the views contradict each other or the board's description
unidentifiable  the views do not determine a camera; its numbers mean nothing

The worst finding decides. Remarks never do. Every rule yields findings, each one sentence with the number and
the limit that it is held against. All run without robust loss (points it rejects are left out) and with the
target rigid in the shape that was found for it. Above 100 views the searches (other starts, two cameras) run
on an even sample of 100.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, evenly
from calib.core.verdict import Finding, Severity, Verdict
from calib.core.words import several
from calib.stages.camera import bundle, checks
from calib.stages.camera.model import LeftOut, Observations, scale_of


class Limits:
    """Where a calibration stops being good.

    Attributes
    ----------
    views : views below which nothing is left over to check the answer with.
    leaving_bad, leaving_px : share of the pictures that may be left out, and by how much those that
        disagree have to move directions in the picture, at up to 1000 pixels' width, to count.
    focal_remark, focal_poor, focal_free : relative standard deviation of a focal length. Distances
        told by the camera are off by the same share.
    spread_poor_deg, spread_free_deg : largest angle between two boards. Focal length comes from
        perspective alone, which goes with the tilt.
    area_poor : share of the image that the points span.
    view_poor : share of the image that a typical view spans.
    border_share : standard deviation of projection at the picture's border, over the width; poor where half
        of it is worse.
    centre_poor, centre_remark : offset of the principal point from the image's centre, over its side; of a
        cropped picture it may be larger.
    lens_remark, lens_poor, lens_poor_px : share, and pixels, of the RMS that a richer lens model would
        take away.
    rms_px : residuals above which something is wrong whatever it is, at up to 1000 pixels' width.
    view_bad : RMS of a view over the others'.
    point_factor, point_floor_px, points_poor : a point off by this many medians and pixels is an
        outlier; share of outliers.
    repeated_remark : error that repeats at the same points over what independent errors leave.
    change_times, change_poor_px, change_remark_px : RMS over what it would be if each view had a camera of
        its own, and the part of it that this would take away, px at up to 1000 pixels' width. Public sets
        reach 1.2 times, a board that moves before a rolling shutter 2 to 3, a lens that focuses anew 6.
    change_most_times, change_most_px : the part that is poor where it is so many times the rest.
    decrement : standard deviations that the solver may stop short of a minimum.
    split_ratio, change_ratio : two cameras, in any order and one after the other: the statistic over
        what chance reaches. One camera reaches 1.2 in a hundred sets, two that differ by three
        percent 2 to 50.
    split_sigma, split_least : largest difference of an intrinsic over its standard deviation, and
        the difference of focal length or principal point, as a share of the focal length or
        width, that matters.
    split_px, split_seen_px : distance of where the two cameras show the same direction, root mean square,
        that matters, and that is told, at up to 1000 pixels' width.
    aspect_bad, aspect_remark, aspect_sigma : squares that are not square, as a share, and over its
        standard deviation. Printers stretch by up to half a percent.
    pixel_aspect : fx over fy where the board cannot tell whether it is to blame.
    bow_bad, bow_remark, bow_sigma : departure from flatness over the board's size, and over its
        standard deviation.
    bow_focal, bow_focal_remark : share by which a bend that is there may move the focal length.
    fragile : share by which a bend of half a percent of the size may do so.
    rival_cost, rival_focal : another minimum with a cost up to this much higher and a focal length
        this share away is a rival.
    """

    views = 4
    leaving_bad = 0.2
    leaving_px = 0.1
    focal_remark = 0.015
    focal_poor = 0.03
    focal_free = 0.10
    spread_poor_deg = 12.0
    spread_free_deg = 5.0
    area_poor = 0.20
    view_poor = 0.01
    border_share = 0.01
    centre_poor = 0.15
    centre_remark = 0.10
    lens_remark = 0.1
    lens_poor = 0.33
    lens_poor_px = 0.1
    rms_px = 1.0
    view_bad = 5.0
    point_factor = 8.0
    point_floor_px = 0.5
    points_poor = 0.01
    repeated_remark = 1.6
    change_times = 1.5
    change_poor_px = 0.1
    change_remark_px = 0.03
    change_most_times, change_most_px = 4.0, 0.05
    decrement = 2.0
    split_ratio = 1.5
    change_ratio = 1.3
    split_sigma = 4.0
    split_least = 0.007
    split_px = 0.3
    split_seen_px = 0.1
    aspect_bad = 0.007
    aspect_remark = 0.003
    aspect_sigma = 4.0
    pixel_aspect = 0.02
    bow_bad = 0.010
    bow_remark = 0.005
    bow_sigma = 4.0
    bow_focal = 0.015
    bow_focal_remark = 0.005
    fragile = 0.03
    rival_cost = 1.10
    rival_focal = 0.10


_MORE_TILT = "Tilt the board by 30 degrees or more, about its long and its short side in turn."
_MORE_VIEWS = "Take at least ten pictures with the board tilted in different directions."
_IN_CORNERS = "Take pictures with the board in the picture's corners, or use a simpler model."
_CORNERS = "Take pictures with the board in the picture's corners."
_CLOSER = "Bring the board closer, so that it fills a third of the picture or more, and into its corners."


# ----------------------------------------------------------------------
# Is the camera determined by the views?


def _of_solution(calibration: bundle.Calibration) -> Iterator[Finding]:
    """Enough views and points, and a solver that arrived."""
    views, points = calibration.observations.views, calibration.observations.points
    short = calibration.decrement
    if calibration.termination == "singular":
        text = (
            "The normal equations are singular: the views leave a direction of the parameters entirely free."
        )
        yield Finding("unidentifiable", text, _MORE_TILT)
    elif not calibration.converged and not short < 0.1:
        text = (
            f"The solver stopped ({calibration.termination}) after {calibration.evaluations} evaluations, "
            f"{short:.2g} standard deviations short of a minimum (up to {Limits.decrement:g} does not "
            "matter): the views leave a direction nearly free."
        )
        yield Finding("remark" if short < Limits.decrement else "unidentifiable", text)
    if calibration.degrees_of_freedom <= 0:
        text = (
            f"{points} points in {views} views give no more equations than there are unknowns, "
            "so nothing checks the answer."
        )
        yield Finding("unidentifiable", text, _MORE_VIEWS)
    if views < 2:
        text = "There is only one view of the board, which hardly tells focal length and distance apart."
        yield Finding("unidentifiable", text, _MORE_VIEWS)
    elif views < Limits.views:
        text = (
            f"{views} different views are too few to check one against the others; "
            f"{Limits.views} are the least."
        )
        yield Finding("poor", text, _MORE_VIEWS)


def _of_lens(calibration: bundle.Calibration) -> Iterator[Finding]:
    """The radial curve has to rise over the image."""
    camera, found = calibration.camera, checks.lens_shape(calibration)
    if found.folds_among_points:
        text = (
            "The distortion curve folds over among the points that were seen, so that two directions share "
            "a pixel: distortion has taken the place of something else."
        )
        if camera.model == "rational8":
            yield Finding("poor", text, "Use a simpler lens model.")
        else:
            yield Finding("unidentifiable", text, _MORE_TILT)
    elif not found.one_to_one:
        text = (
            f"The lens model is one-to-one up to {100 * found.reach:.0f} % of the way to the picture's "
            f"corners only ({100 * checks.ONE_TO_ONE_REACH:.0f} is good; points were seen "
            f"{100 * _radius_share(calibration):.0f} % of the way); "
            f"{100 * (1 - found.image_shown):.0f} % of the picture's border cannot be undistorted."
        )
        inside = found.reach <= 1.0 or found.image_shown < 1.0
        yield Finding("poor" if inside else "remark", text, _IN_CORNERS)


def _of_focal(sigma_share: float) -> Iterator[Finding]:
    """Standard deviation of the focal length, inflated."""
    if sigma_share >= Limits.focal_remark:
        known = f"{100 * sigma_share:.1f} %" if sigma_share < 2 else "no better than a factor of two"
        text = (
            f"The focal length is known to {known} (one standard deviation, residuals that are "
            f"not white considered; up to {100 * Limits.focal_poor:.0f} is good, "
            f"{100 * Limits.focal_free:.0f} means that it is free)."
        )
        kind: Severity = "remark" if sigma_share < Limits.focal_poor else "poor"
        yield Finding(kind if sigma_share < Limits.focal_free else "unidentifiable", text, _MORE_TILT)


def _of_richer(fit: bundle.Calibration, wide: bundle.Calibration) -> Iterator[Finding]:
    """Errors that the lens model leaves and five coefficients take away."""
    drop = 1.0 - wide.rms_px / max(fit.rms_px, 1e-300)
    if drop >= Limits.lens_remark:
        text = (
            f"The lens model {fit.camera.model} leaves errors that five coefficients take away: "
            f"the RMS falls from {fit.rms_px:.3f} to {wide.rms_px:.3f} px."
        )
        serious = drop > Limits.lens_poor and fit.rms_px - wide.rms_px > Limits.lens_poor_px
        yield Finding("poor" if serious else "remark", text, "Use a richer lens model.")


def _of_border(
    fit: bundle.Calibration, sturdy: bundle.Calibration, known_sturdy: bundle.Covariance
) -> Iterator[Finding]:
    """Standard deviation of projection at the points of the border that the lens can show.

    The denominator of the rational model counts, unless nothing bounds it.
    """
    known = known_sturdy if fit is sturdy else checks.by_the_views(fit)
    if not np.all(np.isfinite(known.joint)):
        fit, known = sturdy, known_sturdy
    sigma_px = bundle.projection_sigma_px(fit, known, checks.image_outline(fit.camera))
    sigma_px = sigma_px[~np.isnan(sigma_px)]
    limit = Limits.border_share * max(fit.camera.image_size_px)
    if len(sigma_px) and (most := float(sigma_px.max())) > limit:
        median = float(np.median(sigma_px))
        side = max(fit.camera.image_size_px)
        known_to = f"to {most:.1f} px only" if most < side else "without any bound on their error"
        half = f", half of the border is within {median:.1f}" if median < side else ""
        text = (
            f"Somewhere at the picture's border the camera predicts pixels {known_to} (standard deviation; "
            f"{limit:.1f} is good{half})."
        )
        yield Finding("poor" if median > limit else "remark", text, _IN_CORNERS)


def _of_starts(calibration: bundle.Calibration, inflation: float) -> Iterator[Finding]:
    """All starts have to reach one minimum, or clearly worse ones.

    Worse by more than chance is not clear enough where the model itself is in error, so that a minimum
    far away with a cost a tenth higher counts as a rival, too.
    """
    own, chance = calibration.squared_sum, checks.CHI2_95 * (inflation * calibration.sigma_px) ** 2
    fx = calibration.camera.fx_px
    near = max(0.02, 5 * inflation * bundle.covariance(calibration).sigma()["fx_px"] / fx)
    for focal_px, end in sorted(checks.other_starts(calibration), key=lambda one: one[1].cost):
        other = float(end.block.intrinsics[0])
        rms = float(np.sqrt(end.cost / calibration.observations.points))
        apart = abs(other / fx - 1.0)
        text = ""
        if end.cost < own - chance and apart > 1e-3:
            text = (
                f"A start at a focal length of {focal_px:.0f} px ends at fx = {other:.1f} px with RMS "
                f"{rms:.3f} px, below the {calibration.rms_px:.3f} px of fx = {fx:.1f} px: "
                "the answer is not the best one."
            )
        elif end.reason == "converged" and (
            (end.cost < own + chance and apart > near)
            or (end.cost < Limits.rival_cost * own and apart > Limits.rival_focal)
        ):
            text = (
                f"Two cameras fit the views about equally well: fx = {fx:.1f} px with RMS "
                f"{calibration.rms_px:.3f} px and fx = {other:.1f} px with RMS {rms:.3f} px."
            )
        if text:
            yield Finding("unidentifiable", text, _MORE_TILT)
            return


# ----------------------------------------------------------------------
# Are the views good, and do they agree with each other and the board?


def of_faults(observations: Observations) -> Iterator[Finding]:
    """Views that cannot be views of the board at all."""
    faults = checks.view_faults(observations)
    for what in checks.FAULTS:
        some = [name for name, fault in zip(observations.names, faults, strict=True) if fault == what]
        if len(some) == len(faults):
            yield Finding("unidentifiable", f"All views show {what}.")
        elif some:
            text = f"{several(some)} {'shows' if len(some) == 1 else 'show'} {what}."
            yield Finding("inconsistent", text, f"Leave out {several(some)}.")


def of_leaving(
    left_out: Sequence[LeftOut], used: int, kept: bool, moved_px: float = np.inf
) -> Iterator[Finding]:
    """Views that were left out; more than a fifth of them says that something is wrong with the whole.

    Parameters
    ----------
    used : views that agree. kept : whether the others are to stay, as far as they can be used.
    moved_px : by how much those that disagree move directions, over `scale_of` the camera.
    """
    views = [one for one in left_out if one.kind == "view"]
    if kept:
        advice = "Leave it out: calibrate without --keep-all."
        for one in views:
            yield Finding("inconsistent", f"{one.name} does not agree with the others: {one.why}.", advice)
        return
    kinds: tuple[tuple[list[LeftOut], str, Severity], ...] = (
        (views, "left out for disagreeing with the others", "inconsistent"),
        ([o for o in left_out if o.kind in ("unreadable", "size")], "damaged or of another size", "poor"),
    )
    for some, what, severity in kinds:
        if not some:
            continue
        share = len(some) / (used + len(some))
        text = (
            f"{len(some)} of {used + len(some)} pictures {'is' if len(some) == 1 else 'are'} {what}: "
            f"{several([one.name for one in some], 20)}"
        )
        many = share > Limits.leaving_bad and not (some is views and moved_px < Limits.leaving_px)
        advice = ""
        if many:
            text += f"; that is more than {100 * Limits.leaving_bad:.0f} % of them"
            advice = (
                "Give the pictures as one camera took them, with one zoom and focus, and none turned, "
                "cropped or resized by a program or a phone."
            )
        yield Finding(severity if many else "remark", f"{text}.", advice)


def of_copies(copies: Sequence[LeftOut]) -> Iterator[Finding]:
    """Views that were left out for showing the board where another view does."""
    if copies:
        one = len(copies) == 1
        text = (
            f"{several([one.name for one in copies], 20)} {'shows' if one else 'show'} the board where "
            f"another picture does and {'is' if one else 'are'} left out: the same place once more lowers "
            "the standard deviations on paper only."
        )
        yield Finding("remark", text)


# Two views whose boards are parallel say the same about the camera (Zhang 2000, section 4.3), so what
# counts is not how far a board leans from the picture's plane but how far the boards' normals differ
# among themselves; a board that never leans in any view is the worst case of that.

_MOST_NORMALS = 2000


def _of_coverage(calibration: bundle.Calibration) -> Iterator[Finding]:
    """Tilts, size in the picture, and the part of the picture that was covered."""
    observations = calibration.observations
    width, height = calibration.camera.image_size_px
    normals = calibration.block.normals
    # Exact for few views, and to a degree for many.
    some = normals[:: max(1, len(normals) // _MOST_NORMALS)]
    spread_deg = float(np.degrees(np.arccos(np.clip((some @ some.T).min(), -1.0, 1.0))))
    if spread_deg < Limits.spread_poor_deg and len(normals) > 1:
        most_deg = float(np.degrees(np.arccos(np.clip(normals[:, 2], 0.0, 1.0))).max())
        to = "the picture" if most_deg < Limits.spread_poor_deg else "each other"
        text = (
            f"All views show the board nearly parallel to {to}: no two differ in tilt by more than "
            f"{spread_deg:.1f} degrees (at least {Limits.spread_poor_deg:.0f} are needed), and focal "
            "length shows only in boards that are tilted differently."
        )
        yield Finding("unidentifiable" if spread_deg < Limits.spread_free_deg else "poor", text, _MORE_TILT)
    area_share = checks.hull_area(observations.pixels[observations.present]) / (width * height)
    if area_share < Limits.area_poor:
        text = (
            f"All points together span {100 * area_share:.0f} % of the picture "
            f"(at least {100 * Limits.area_poor:.0f} are needed); the lens elsewhere is a guess."
        )
        yield Finding("poor", text, _CLOSER)
    elif (reach := _radius_share(calibration)) < 0.75:
        text = (
            f"Points reach {100 * reach:.0f} % of the way to the picture's corners; "
            "beyond, the distortion is extrapolated."
        )
        yield Finding("remark", text, _CORNERS)
    areas = [checks.hull_area(p[on]) for p, on in zip(observations.pixels, observations.present, strict=True)]
    view_share = float(np.median(areas)) / (width * height)
    if view_share < Limits.view_poor:
        text = (
            f"The board fills only {100 * view_share:.1f} % of a typical picture "
            f"(at least {100 * Limits.view_poor:.0f} are needed)."
        )
        yield Finding("poor", text, _CLOSER)


def _radius_share(calibration: bundle.Calibration) -> float:
    """Largest distance of a point from the principal point over that of the image's farthest corner."""
    camera, observations = calibration.camera, calibration.observations
    seen = observations.pixels[observations.present]
    return float(np.linalg.norm(seen - camera.centre_px, axis=1).max() / camera.farthest_px)


def _of_order(calibration: bundle.Calibration) -> Iterator[Finding]:
    """Points listed mirrored in some of the views."""
    mirrored = _mirrored(calibration)
    if mirrored.any() and not mirrored.all():
        fewer = mirrored if mirrored.mean() <= 0.5 else ~mirrored
        names = [calibration.observations.names[i] for i in np.flatnonzero(fewer)]
        text = (
            f"{several(names)} {'shows' if len(names) == 1 else 'show'} the board mirrored with respect to "
            "the other views: the points are listed in another order."
        )
        yield Finding("inconsistent", text, "Give the points of all views in the same order.")


def _mirrored(calibration: bundle.Calibration) -> BoolArray:
    """Which views (N,) show the board's back."""
    # By its normal and the way to it: beside a wide lens a board's front may face away from the picture.
    block = calibration.block
    return np.asarray(np.einsum("ni,ni->n", block.R_CT[:, :, 2], block.t_CT_m) < 0.0)


def _of_centre(calibration: bundle.Calibration, known: bundle.Covariance) -> Iterator[Finding]:
    """The principal point far from the picture's centre: the picture is cropped, or something is wrong.

    Views of a cropped picture tell where the principal point is, and show the board all over the picture. Of
    a picture whose size is not as stated they show it about the principal point.
    """
    camera, observations = calibration.camera, calibration.observations
    width, height = size = camera.image_size_px
    seen = observations.pixels[observations.present]
    away_px, away_of_seen_px = (
        np.abs(camera.centre_px - middle)
        for middle in (0.5 * (np.array(size) - 1), 0.5 * (seen.min(axis=0) + seen.max(axis=0)))
    )
    k = int(np.argmax(away_px / size))
    off = float(away_px[k] / size[k])
    if off <= Limits.centre_remark:
        return
    told = away_px[k] > checks.CERTAIN * known.sigma().get(("cx_px", "cy_px")[k], 0.0)
    if _mirrored(calibration).all() and width != height:
        why, usual = "u and v may be swapped", 0.0
    elif told and away_of_seen_px[k] > 0.5 * away_px[k]:
        why, usual = "the picture is cropped", np.inf
    else:
        why, usual = "the picture's size is wrong, or the views do not tell it", Limits.centre_poor
    text = (
        f"The principal point ({camera.cx_px:.0f}, {camera.cy_px:.0f}) is {100 * off:.0f} % of the "
        f"picture's side away from its centre (up to {100 * Limits.centre_poor:.0f} is usual): {why}."
    )
    yield Finding("poor" if off > usual else "remark", text)


def _of_misfit(calibration: bundle.Calibration) -> Iterator[Finding]:
    """Residuals too large, bad views, bad points, and errors that repeat."""
    names, present = calibration.observations.names, calibration.observations.present
    distance, rms = np.linalg.norm(calibration.residuals_px, axis=2), calibration.view_rms_px
    typical = float(np.median(rms))
    bad = rms > max(Limits.view_bad * quiet_rms(rms), Limits.point_floor_px)
    if bad.any():
        worse, good = [i for i in np.argsort(-rms).tolist() if bad[i]], float(np.median(rms[~bad]))
        text = (
            f"{several([f'{names[i]} ({rms[i]:.2f} px)' for i in worse], 4)} "
            f"{'does' if len(worse) == 1 else 'do'} not fit the other views, whose RMS is {good:.2f} px: "
            "misplaced corners, another board, or motion during the exposure."
        )
        advice = f"Leave out {several([names[i] for i in worse], 4)}, or look at the corners there."
        yield Finding("inconsistent", text, advice)
    limit = Limits.rms_px * scale_of(calibration.camera.image_size_px)
    if typical > limit:
        text = (
            f"The RMS error of a typical view is {typical:.2f} px (at most {limit:.1f} is good): "
            "the corners, the board's description or the lens model is wrong."
        )
        advice = "Look at the corners, check the number of squares and try a richer lens model."
        yield Finding("inconsistent" if typical > 3 * limit else "poor", text, advice)
    yield from _of_points(distance, present & ~bad[:, None], names)
    if (repeated := repeated_errors(calibration)) > Limits.repeated_remark:
        yield Finding("remark", f"{_REPEATED.format(repeated)}.")


def far_points(
    distance: FloatArray,
    there: BoolArray,
    typical: float,
    floor_px: FloatArray | float = Limits.point_floor_px,
) -> BoolArray:
    """Points (N, M), of those that are there, far off beside the others of their view and a typical one.

    `floor_px` (N,) is how far off a point of a view has to be at least.
    """
    own = np.array([np.median(d[on]) if on.any() else 0.0 for d, on in zip(distance, there, strict=True)])
    limit = np.maximum(Limits.point_factor * np.maximum(own, typical), floor_px)
    return np.asarray(there & (np.nan_to_num(distance) > limit[:, None]))


def quiet_rms(rms: FloatArray) -> float:
    """Typical RMS of the quieter half of views (n,), as a bad one drags the camera and raises the others'."""
    return float(np.median(np.sort(rms)[: (len(rms) + 1) // 2]))


def _of_points(distance: FloatArray, fine: BoolArray, names: tuple[str, ...]) -> Iterator[Finding]:
    """Points (N, M) of good views whose residuals are far above those of their view, and of all."""
    bad = far_points(distance, fine, float(np.median(distance[fine])))
    count = int(bad.sum())
    if count:
        share = count / int(fine.sum())
        where = several([names[i] for i in np.flatnonzero(bad.any(axis=1))])
        text = (
            f"{count} point{'s lie' if count > 1 else ' lies'} more than {Limits.point_factor:.0f} times the "
            f"median error off, in {where} ({100 * share:.1f} % of all; at most "
            f"{100 * Limits.points_poor:.0f} is good)."
        )
        many = share > Limits.points_poor
        advice = "Look at the corners with the largest errors, or use a robust loss." if many else ""
        yield Finding("poor" if many else "remark", text, advice)


def repeated_errors(calibration: bundle.Calibration) -> float:
    """RMS over the target's points of the mean residual over views, in the target's axes.

    Over what it would be if the views' errors were independent.
    """
    observations = calibration.observations
    if not observations.same_target or observations.views < 4:
        return 1.0
    # Directions of the target's axes in the picture, turned back, lengths left out.
    U, _, Vt = np.linalg.svd(calibration.block.R_CT[:, :2, :2])
    turned = np.einsum("nmi,nij->nmj", np.nan_to_num(calibration.residuals_px), U @ Vt)
    count = np.maximum(observations.present.sum(axis=0), 1)
    mean = turned.sum(axis=0) / count[:, None]
    spread = float((turned**2).sum() / max(2 * observations.points, 1))
    return float(np.sqrt((mean**2 * count[:, None]).mean() / spread)) if spread > 0.0 else 1.0


def _of_change(fit: bundle.Calibration) -> Iterator[Finding]:
    """One camera and one board in all views, not another in each."""
    alone, together = (math.sqrt(2.0) * one for one in checks.alone_px(fit))
    change = math.sqrt(max(together**2 - alone**2, 0.0))
    scale = scale_of(fit.camera.image_size_px)
    if together < Limits.change_times * alone or change < Limits.change_remark_px * scale:
        return
    most = scale * (
        Limits.change_most_px if together > Limits.change_most_times * alone else Limits.change_poor_px
    )
    text = (
        f"The camera or the board changes from picture to picture: each would fit to {alone:.2g} px with a "
        f"camera of its own, all together fit to {together:.2g} px (up to {most:.2g} px of change is good). "
        "A board that moves before a rolling shutter, a sheet that bends, autofocus and image stabilisation "
        "do so."
    )
    advice = (
        "Put the camera and the board down for each picture, on a flat plate, with focus and zoom locked and "
        "stabilisation off."
    )
    yield Finding("poor" if change > most else "remark", text, advice if change > most else "")


_SEPARATELY = "Calibrate the two groups separately, with focus and zoom locked."


def _of_split(found: checks.Split | None, calibration: bundle.Calibration) -> Iterator[Finding]:
    """One camera, or two."""
    if found is None or found.ratio < (Limits.change_ratio if found.in_order else Limits.split_ratio):
        return
    shift = {name: abs(found.difference[name]) / max(found.sigma[name], 1e-300) for name in found.difference}
    camera, names = calibration.camera, calibration.observations.names
    width, larger = max(camera.image_size_px), scale_of(camera.image_size_px)
    scale = {"fx_px": camera.fx_px, "fy_px": camera.fy_px, "cx_px": width, "cy_px": width}
    # Distortion alone tells no two cameras apart; it follows the part of the picture that was seen.
    telling = [
        name
        for name, value in scale.items()
        if shift.get(name, 0.0) > Limits.split_sigma
        and abs(found.difference[name]) > Limits.split_least * value
        and found.apart_px > Limits.split_px * larger
    ]
    strongest = max(telling or shift, key=lambda name: shift[name])
    if shift[strongest] < Limits.split_sigma or found.apart_px < Limits.split_seen_px * larger:
        return
    by = ", ".join(
        f"{name.removesuffix('_px')} by {found.difference[name]:+.1f} px"
        for name in telling or [one for one in scale if one in shift]
    )
    sure = (
        f"({by}; {strongest.removesuffix('_px')} by {shift[strongest]:.0f} standard deviations; directions "
        f"by {found.apart_px:.1f} px; the RMS falls from {calibration.rms_px:.3f} to "
        f"{found.split_rms_px:.3f} px, {found.ratio:.1f} times what chance explains)"
    )
    second = several([names[i] for i in np.flatnonzero(found.second)], 20)
    if not telling:
        text = (
            f"{second} would have a camera of their own {sure}, but not one "
            f"whose focal length or centre differs for certain by {100 * Limits.split_least:.1f} %, and "
            f"directions by {Limits.split_px:g} px, which would matter."
        )
        yield Finding("remark", text)
        return
    if found.by_distance:
        text = (
            f"Views from near and from far differ about as much as {second} from the others {sure}: the lens "
            "or the board is not quite as its model says."
        )
        yield Finding("remark", text, "Let the board's shape be fitted (--board warp), or try another model.")
        return
    if found.in_order:
        what = "the lens was refocused or zoomed" if {"fx_px", "fy_px"} & set(telling) else "the lens moved"
        text = (
            f"From {names[int(np.argmax(found.second))]} on the camera differs from the one before {sure}: "
            f"{what}, or the camera changed."
        )
    else:
        text = f"The views come from two cameras: {second} from one, the other views from another {sure}."
    yield Finding("inconsistent", text, _SEPARATELY)


_REPEATED = (
    "Errors repeat at the same corners of the board from view to view, {:.1f} times what independent errors "
    "would leave: the printed board is not exactly as described"
)


def of_board(rigid: bundle.Calibration) -> list[Finding]:
    """What a board is whose shape is estimated along, by the fit to the one described."""
    shape, repeated = checks.shape_or_none(rigid), repeated_errors(rigid)
    if findings := list(_of_target(shape, rigid, bends=True)):
        return findings
    if repeated > Limits.repeated_remark:
        return [Finding("remark", f"{_REPEATED.format(repeated)}{_ESTIMATED}.")]
    if shape is None or not shape.allowed:
        return []
    sure = f"{shape.significance:.0f} standard deviations"
    return [Finding("remark", f"The board is not quite as described ({sure}){_ESTIMATED}.")]


_ESTIMATED = "; its shape is estimated along with the camera"


def _of_target(
    found: checks.TargetShape | None, calibration: bundle.Calibration, bends: bool = False
) -> Iterator[Finding]:
    """Squares that are square, on a board that is flat, or `bends` to the shape that is estimated for it."""
    if found is None:
        return
    off = abs(found.aspect)
    allowed = _ESTIMATED if bends else "; sigma allows for it" if found.allowed else ""
    squares = (
        f"the board's squares are {1 + found.aspect:.3f} times as high as wide "
        f"(standard deviation {found.aspect_sigma:.3f})"
    )
    pixel = abs(calibration.camera.fx_px / calibration.camera.fy_px - 1.0)
    if off > Limits.aspect_remark and off > Limits.aspect_sigma * found.aspect_sigma:
        text = f"{squares[0].upper()}{squares[1:]}, not square as said{allowed}."
        advice = "Measure the printed squares along both sides; print without scaling."
        yield Finding("inconsistent" if off > Limits.aspect_bad else "remark", text, advice)
    elif pixel > Limits.pixel_aspect:
        # The board is cleared only where its aspect is known well and is one, as far as that matters.
        one = max(2.5 * found.aspect_sigma, Limits.aspect_remark)
        cleared = found.aspect_sigma < 0.2 * pixel and off < one
        text = f"fx and fy differ by {100 * pixel:.1f} %" + (
            "; boards turned in their plane agree that the pixels, not the squares, are not square."
            if cleared
            else f": the pixels or the squares are not square ({squares}), and these views cannot tell which."
        )
        advice = "" if cleared else "Take pictures with the board turned by 90 degrees in its plane."
        yield Finding("remark" if cleared else "poor", text, advice)
    bend, moved = found.bow_m / found.size_m, abs(found.focal_shift)
    certain = found.bow_significance > Limits.bow_sigma
    if (certain or found.bent) and (bend > Limits.bow_remark or moved > Limits.bow_focal_remark):
        text = (
            f"The board is not flat: it is bent by about {100 * bend:.1f} % of its size ("
            f"{found.bow_significance:.0f} standard deviations; up to {100 * Limits.bow_bad:.0f} % is good), "
            f"which {'would move' if bends else 'moves'} the focal length by {100 * moved:.1f} %{allowed}."
        )
        kind: Severity = "remark"
        if certain and not bends:
            kind = "inconsistent" if bend > Limits.bow_bad else "poor" if moved > Limits.bow_focal else kind
        advice = "Glue the board to a flat plate."
        if not bends:
            advice = f"{advice[:-1]}, or let its shape be estimated (--board auto)."
        yield Finding(kind, text, advice)
    elif not bends and found.focal_per_bow > Limits.fragile:
        text = (
            "The focal length hangs on the board's flatness: a bend of half a percent of its size "
            f"would move it by {100 * found.focal_per_bow:.1f} %."
        )
        yield Finding("remark", text, _MORE_TILT)


# ----------------------------------------------------------------------
# All rules together.

_SAMPLE = 100
_LEFT_OUT_WEIGHT = 0.5
"""Points that a robust loss weighs less are left out of the checks."""


def judge(calibration: bundle.Calibration, findings: Sequence[Finding] = ()) -> Verdict:
    """Judge a calibration by its views alone.

    Parameters
    ----------
    findings : what is there to say already, as of views that were left out.
    """
    faulty, sturdy = list(of_faults(calibration.observations)), None
    every = [*findings, *faulty]
    if all(one.severity != "inconsistent" for one in faulty):
        # Else what is wrong follows from the views that are none.
        more, sturdy = _by_the_rules(calibration)
        # Two cameras that all views tell need not be told of those that agree as well.
        told = any(one.advice == _SEPARATELY for one in every)
        every += [one for one in more if not (told and one.advice == _SEPARATELY)]
    if any(one.advice == _IN_CORNERS for one in every):
        # Which says the same and more.
        every = [replace(one, advice=_IN_CORNERS) if one.advice == _CORNERS else one for one in every]
    verdict = Verdict.of(every)
    # Where views contradict each other, more of them settle nothing.
    if sturdy is None or verdict.word == "inconsistent":
        return verdict
    return Verdict.of([*every, *_next_picture(sturdy, verdict)])


def _by_the_rules(calibration: bundle.Calibration) -> tuple[list[Finding], bundle.Calibration | None]:
    """What the rules find, and the `conditioned` fit where there is one that more views can improve."""
    findings = list(_of_solution(calibration))
    if not np.all(np.isfinite(calibration.block.intrinsics)) or not np.all(np.isfinite(calibration.normal)):
        if not any(one.severity == "unidentifiable" for one in findings):
            findings.append(Finding("unidentifiable", "The solver found no camera that fits the views."))
        return findings, None
    fit = _plain(calibration)
    findings += [*_of_coverage(fit), *_of_order(fit)]
    if fit.degrees_of_freedom <= 0 or fit.observations.views < 2 or not np.all(np.isfinite(fit.normal)):
        return findings, None
    findings += _of_misfit(fit)
    sturdy = checks.conditioned(fit)
    inflation = checks.overdispersion(checks.evidence(sturdy))
    # What a board of another shape moves is a matter of the board, and told of that.
    share = _focal_share(sturdy)
    if calibration.basis is not None:
        # A target that was deformed to fit costs certainty, which the rigid target in its shape hides.
        share = max(share, _focal_share(calibration))
    findings += _of_focal(inflation * share)
    some = _sampled(sturdy)
    findings += _of_starts(some, inflation)
    known = checks.by_the_views(calibration if sturdy is fit else sturdy)
    findings += _of_centre(fit, known)
    # The lens first: a target would bend to make up for a lens that the model cannot follow.
    wide = checks.widened(some)
    shape = checks.target_shape(wide)
    findings += _of_richer(some, wide)
    if calibration.basis is None:
        findings += _of_target(shape, wide)
    if shape is not None:
        wide = checks.straightened(wide, shape.displacement_m)
    findings += [
        *_of_split(checks.best_split(wide), wide),
        *_of_change(wide),
        *_of_border(fit, sturdy, known),
        *_of_lens(fit),
    ]
    return findings, sturdy


def two_cameras(calibration: bundle.Calibration) -> list[Finding]:
    """Whether views come from two cameras, or from one that was refocused on the way."""
    wide = checks.widened(_sampled(checks.conditioned(calibration)))
    return list(_of_split(checks.best_split(wide), wide))


def _plain(calibration: bundle.Calibration) -> bundle.Calibration:
    """The same fit by least squares: a robust loss turned into points left out, the target rigid."""
    observations = calibration.observations
    if calibration.basis is None and calibration.loss == "none":
        return calibration
    kept = np.arange(observations.views)
    if calibration.loss != "none":
        observations = observations.without(calibration.weights < _LEFT_OUT_WEIGHT)
        kept = np.flatnonzero(observations.present.sum(axis=1) >= 4)
        observations = observations.select(kept)
    start = replace(calibration.block.part(kept), deformation=np.zeros(0))
    shaped = calibration.shaped(observations)
    return bundle.refitted(calibration, observations=shaped, start=start, basis=None, loss="none")


def _focal_share(fit: bundle.Calibration) -> float:
    """Larger relative standard deviation of the focal lengths."""
    sigma = bundle.covariance(fit).sigma()
    return max(sigma["fx_px"] / fit.camera.fx_px, sigma["fy_px"] / fit.camera.fy_px)


def _sampled(fit: bundle.Calibration) -> bundle.Calibration:
    views = fit.observations.views
    return fit if views <= _SAMPLE else bundle.refitted(fit, evenly(views, _SAMPLE))


def _next_picture(fit: bundle.Calibration, verdict: Verdict) -> Iterator[Finding]:
    width = max(fit.camera.image_size_px)
    if not 0.2 * width < min(fit.camera.fx_px, fit.camera.fy_px) < 50 * width:
        return
    plan = checks.best_next_view(fit)
    if plan is None:
        return
    best = plan.best
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
    word = (
        "If you take another picture, the most useful" if verdict.ok else "The picture that would help most"
    )
    text = (
        f"{word}: the board {best.where}, {lean}, {size}; "
        f"it would lower the uncertainty by about {100 * (1 - best.remaining):.0f} %."
    )
    yield Finding("remark", "", text)
