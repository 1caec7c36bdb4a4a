"""Whether a calibration can be trusted: one of four verdicts, with reasons and advice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.verdict import Finding, Severity, Verdict
from calib.stages.camera.bundle import (
    Calibration,
    Covariance,
    covariance,
    projection_sigma_px,
    refitted,
)
from calib.stages.camera.checks import (
    ONE_TO_ONE_REACH,
    Coverage,
    Lens,
    Misfit,
    Screening,
    Split,
    Start,
    TargetShape,
    best_next_view,
    best_split,
    conditioned,
    coverage,
    evidence,
    image_outline,
    inside_hull,
    lens_shape,
    misfit,
    other_starts,
    overdispersion,
    screen,
    straightened,
    target_shape,
    widened,
)
from calib.stages.camera.model import Camera, LeftOut

# ----------------------------------------------------------------------
# What a check has found about a calibration, and the limits that a finding is held against.


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names for a sentence, the rest counted."""
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join(names[:most]) + f" and {len(names) - most} more"


@dataclass(frozen=True)
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
    projection_share : standard deviation of projection inside of what was seen, over the width.
    border_share : the same at the picture's border; poor where half of it is worse.
    centre_poor, centre_remark : offset of the principal point from the image's centre, over its side.
    lens_remark, lens_poor, lens_poor_px : share, and pixels, of the RMS that a richer lens model would
        take away.
    rms_px : residuals above which something is wrong whatever it is, at up to 1000 pixels' width.
    view_bad, view_remark : RMS of a view over the others'.
    point_factor, point_floor_px, points_poor : a point off by this many medians and pixels is an
        outlier; share of outliers.
    heavy_remark : share of the squared residuals that the worst percent of points may hold.
    repeated_remark : error that repeats at the same points over what independent errors leave.
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

    views: int = 4
    leaving_bad: float = 0.2
    leaving_px: float = 0.1
    focal_remark: float = 0.015
    focal_poor: float = 0.03
    focal_free: float = 0.10
    spread_poor_deg: float = 12.0
    spread_free_deg: float = 5.0
    area_poor: float = 0.20
    view_poor: float = 0.01
    projection_share: float = 0.002
    border_share: float = 0.01
    centre_poor: float = 0.15
    centre_remark: float = 0.10
    lens_remark: float = 0.1
    lens_poor: float = 0.33
    lens_poor_px: float = 0.1
    rms_px: float = 1.0
    view_bad: float = 5.0
    view_remark: float = 3.0
    point_factor: float = 8.0
    point_floor_px: float = 0.5
    points_poor: float = 0.01
    heavy_remark: float = 0.2
    repeated_remark: float = 1.6
    decrement: float = 2.0
    split_ratio: float = 1.5
    change_ratio: float = 1.3
    split_sigma: float = 4.0
    split_least: float = 0.007
    split_px: float = 0.3
    split_seen_px: float = 0.1
    aspect_bad: float = 0.007
    aspect_remark: float = 0.003
    aspect_sigma: float = 4.0
    pixel_aspect: float = 0.02
    bow_bad: float = 0.010
    bow_remark: float = 0.005
    bow_sigma: float = 4.0
    bow_focal: float = 0.015
    bow_focal_remark: float = 0.005
    fragile: float = 0.03
    rival_cost: float = 1.10
    rival_focal: float = 0.10


def scale_of(camera: Camera) -> float:
    """How many times larger than at up to 1000 pixels' width errors in pixels may be."""
    return max(1.0, max(camera.image_size_px) / 1000)


# ----------------------------------------------------------------------
# From numbers to sentences: is the camera determined by the views?
#
# Every function takes what one module measured and returns findings, each one sentence with the number
# and the limit it is held against. `calib.stages.camera.verdict` does the same for the views themselves.

MORE_TILT = "Tilt the board by 30 degrees or more, about its long and its short side in turn."
_MORE_VIEWS = "Take at least ten pictures with the board tilted in different directions."
_IN_CORNERS = "Take pictures with the board in the picture's corners, or use a simpler model."

_CHI2_95 = 3.84


def of_solution(calibration: Calibration, different: int, limits: Limits) -> list[Finding]:
    """Enough views and points, and a solver that arrived."""
    out = []
    views, points = calibration.observations.views, calibration.observations.points
    short = calibration.decrement
    if calibration.termination == "behind the camera":
        text = "No camera was found that has all points of the board in front of it."
        out.append(Finding("unidentifiable", text))
    elif calibration.termination == "singular":
        text = (
            "The normal equations are singular: the views leave a direction of the parameters entirely free."
        )
        out.append(Finding("unidentifiable", text, MORE_TILT))
    elif not calibration.converged and not short < 0.1:
        text = (
            f"The solver stopped ({calibration.termination}) after {calibration.evaluations} evaluations, "
            f"{short:.2g} standard deviations short of a minimum (up to {limits.decrement:g} does not "
            "matter): the views leave a direction nearly free."
        )
        out.append(Finding("remark" if short < limits.decrement else "unidentifiable", text))
    if calibration.degrees_of_freedom <= 0:
        text = (
            f"{points} points in {views} views give no more equations than there are unknowns, "
            "so nothing checks the answer."
        )
        out.append(Finding("unidentifiable", text, _MORE_VIEWS))
    if different < 2:
        text = "There is only one view of the board, which hardly tells focal length and distance apart."
        out.append(Finding("unidentifiable", text, _MORE_VIEWS))
    elif different < limits.views:
        text = (
            f"{different} different views are too few to check one against the others; "
            f"{limits.views} are the least."
        )
        out.append(Finding("poor", text, _MORE_VIEWS))
    return out


def of_lens(found: Lens, calibration: Calibration, reach: float) -> list[Finding]:
    """The radial curve has to rise over the image, and the focal length has to be a lens's."""
    camera = calibration.camera
    width = max(camera.image_size_px)
    out = []
    if found.folds_among_points:
        text = (
            "The distortion curve folds over among the points that were seen, so that two directions share "
            "a pixel: distortion has taken the place of something else."
        )
        rational = camera.model == "rational8"
        kind: Severity = "poor" if rational else "unidentifiable"
        out.append(Finding(kind, text, "Use a simpler lens model." if rational else MORE_TILT))
    elif not found.one_to_one:
        text = (
            f"The lens model is one-to-one up to {100 * found.reach:.0f} % of the way to the picture's "
            f"corners only ({100 * ONE_TO_ONE_REACH:.0f} is good; points were seen {100 * reach:.0f} % of "
            f"the way); {100 * (1 - found.image_shown):.0f} % of the picture's border cannot be undistorted."
        )
        inside = found.reach <= 1.0 or found.image_shown < 1.0
        out.append(Finding("poor" if inside else "remark", text, _IN_CORNERS))
    focal = min(camera.fx_px, camera.fy_px)
    # A fisheye lens of 0.16 shows all directions within the width; its circle may be smaller than that.
    shortest = 0.1 if camera.fisheye else 0.25
    if not shortest * width < focal < 30 * width:
        text = (
            f"The focal length of {focal:.1f} px is {focal / width:.2f} times the picture's width; "
            f"lenses that this model suits have {shortest:g} to 30."
        )
        free = not 0.6 * shortest * width < focal < 100 * width
        out.append(Finding("unidentifiable" if free else "poor", text, MORE_TILT))
    return out


def _known(sigma_share: float) -> str:
    return f"{100 * sigma_share:.1f} %" if sigma_share < 2 else "no better than a factor of two"


def of_focal(sigma_share: float, limits: Limits) -> list[Finding]:
    """Standard deviation of the focal length, inflated."""
    if sigma_share < limits.focal_remark:
        return []
    text = (
        f"The focal length is known to {_known(sigma_share)} (one standard deviation, residuals that are not "
        f"white considered; up to {100 * limits.focal_poor:.0f} is good, {100 * limits.focal_free:.0f} means "
        "that it is free)."
    )
    kind: Severity = "remark" if sigma_share < limits.focal_poor else "poor"
    return [Finding(kind if sigma_share < limits.focal_free else "unidentifiable", text, MORE_TILT)]


def of_denominator(sigma_share: float, limits: Limits) -> list[Finding]:
    """What the rational model's denominator costs the focal length when it is free as well."""
    if sigma_share < limits.focal_poor:
        return []
    text = (
        f"The coefficients k4, k5 and k6 are not determined; with them free the focal length is known to "
        f"{_known(sigma_share)} (up to {100 * limits.focal_free:.0f} does not matter, as distortion makes up "
        "for it)."
    )
    return [
        Finding("remark" if sigma_share < limits.focal_free else "poor", text, "Use a simpler lens model.")
    ]


def of_richer(fit: Calibration, wide: Calibration, limits: Limits) -> list[Finding]:
    """Errors that the lens model leaves and five coefficients take away."""
    drop = 1.0 - wide.rms_px / max(fit.rms_px, 1e-300)
    if drop < limits.lens_remark:
        return []
    text = (
        f"The lens model {fit.camera.model} leaves errors that five coefficients take away: "
        f"the RMS falls from {fit.rms_px:.3f} to {wide.rms_px:.3f} px."
    )
    serious = drop > limits.lens_poor and fit.rms_px - wide.rms_px > limits.lens_poor_px
    return [Finding("poor" if serious else "remark", text, "Use a richer lens model.")]


def of_projection(sigma_px: float, width: int, limits: Limits) -> list[Finding]:
    """Standard deviation of projection, inflated, where points were seen."""
    limit = limits.projection_share * width
    if sigma_px <= limit:
        return []
    text = (
        f"Where points were seen the camera predicts pixels to {sigma_px:.2f} px only "
        f"(median standard deviation; {limit:.2f} is good)."
    )
    if not np.isfinite(sigma_px):
        text = "Where points were seen nothing bounds the error of the pixels that the camera predicts."
    return [Finding("poor", text, "Take more pictures, with the board tilted and close.")]


def of_border(sigma_px: FloatArray, width: int, limits: Limits) -> list[Finding]:
    """Standard deviation of projection, inflated, at points (n,) along the picture's border."""
    limit, median, most = limits.border_share * width, float(np.median(sigma_px)), float(sigma_px.max())
    if most <= limit:
        return []
    known = f"to {most:.1f} px only" if np.isfinite(most) else "without any bound on their error"
    text = (
        f"Somewhere at the picture's border the camera predicts pixels {known} (standard deviation; "
        f"{limit:.1f} is good, half of the border is within {median:.1f})."
    )
    return [Finding("poor" if median > limit else "remark", text, _IN_CORNERS)]


def of_starts(
    ends: list[Start], calibration: Calibration, sigma_fx_px: float, inflation: float, limits: Limits
) -> list[Finding]:
    """All starts have to reach one minimum, or clearly worse ones.

    Worse by more than chance is not clear enough where the model itself is in error, so that a minimum
    far away with a cost a tenth higher counts as a rival, too.
    """
    own, chance = calibration.squared_sum, _CHI2_95 * (inflation * calibration.sigma_px) ** 2
    fx = calibration.camera.fx_px
    for end in sorted(ends, key=lambda one: one.cost):
        other = float(end.block.intrinsics[0])
        rms = float(np.sqrt(end.cost / calibration.observations.points))
        apart = abs(other / fx - 1.0)
        if end.cost < own - chance and apart > 1e-3:
            text = (
                f"A start at a focal length of {end.focal_px:.0f} px ends at fx = {other:.1f} px with RMS "
                f"{rms:.3f} px, below the {calibration.rms_px:.3f} px of fx = {fx:.1f} px: "
                "the answer is not the best one."
            )
            return [Finding("unidentifiable", text, MORE_TILT)]
        equal = end.cost < own + chance and apart > max(0.02, 5 * inflation * sigma_fx_px / fx)
        rival = end.cost < limits.rival_cost * own and apart > limits.rival_focal
        if (equal or rival) and end.termination == "converged":
            text = (
                f"Two cameras fit the views about equally well: fx = {fx:.1f} px with RMS "
                f"{calibration.rms_px:.3f} px and fx = {other:.1f} px with RMS {rms:.3f} px."
            )
            return [Finding("unidentifiable", text, MORE_TILT)]
    return []


# ----------------------------------------------------------------------
# From numbers to sentences: are the views good, and do they agree with each other and the board?
#
# Every function takes what one module measured and returns findings, each one sentence with the number
# and the limit it is held against. `calib.stages.camera.verdict` does the same for the fit.

_CORNERS = "Take pictures with the board in the picture's corners."
_CLOSER = "Bring the board closer, so that it fills a third of the picture or more, and into its corners."


def of_screening(found: Screening, names: tuple[str, ...]) -> list[Finding]:
    """Views that cannot be views of the board at all."""
    out = []
    for which, what in (
        (found.few, "fewer than four points"),
        (found.on_a_line, "only points on one line"),
        (
            found.not_a_plane,
            "points that no camera sees on a flat board: listed in another order, or from another board",
        ),
    ):
        some = [names[i] for i in np.flatnonzero(which)]
        if len(some) == len(names):
            out.append(Finding("unidentifiable", f"All views show {what}."))
        elif some:
            text = f"{listed(some)} {'shows' if len(some) == 1 else 'show'} {what}."
            out.append(Finding("inconsistent", text, f"Leave out {listed(some)}."))
    return out


def of_leaving(
    left_out: Sequence[LeftOut],
    used: int,
    kept: bool,
    moved_px: float = np.inf,
    limits: Limits | None = None,
) -> list[Finding]:
    """Views that were left out; more than a fifth of them says that something is wrong with the whole.

    Parameters
    ----------
    used : views that agree. kept : whether the others are used all the same.
    moved_px : by how much those that disagree move directions, over `scale_of` the camera.
    """
    limits = Limits() if limits is None else limits
    views = [one for one in left_out if one.kind == "view"]
    if kept:
        advice = "Leave it out: calibrate without --keep-all."
        return [
            Finding("inconsistent", f"{one.name}, used all the same: {one.why}.", advice) for one in views
        ]
    out = []
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
            f"{listed([one.name for one in some], 20)}"
        )
        many = share > limits.leaving_bad and not (some is views and moved_px < limits.leaving_px)
        if many:
            text += f"; that is more than {100 * limits.leaving_bad:.0f} % of them"
        out.append(Finding(severity if many else "remark", f"{text}."))
    return out


def of_copies(copies: Sequence[LeftOut]) -> list[Finding]:
    """Views that were left out for showing the board where another view does."""
    if not copies:
        return []
    one = len(copies) == 1
    text = (
        f"{listed([one.name for one in copies], 20)} {'shows' if one else 'show'} the board where another "
        f"picture does and {'is' if one else 'are'} left out: the same place once more lowers the standard "
        "deviations on paper only."
    )
    return [Finding("remark", text)]


def of_coverage(found: Coverage, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Tilts, size in the picture, the part of the picture that was covered, and its centre."""
    out = []
    if found.spread_deg < limits.spread_poor_deg and len(found.tilts_deg) > 1:
        to = "the picture" if float(found.tilts_deg.max()) < limits.spread_poor_deg else "each other"
        text = (
            f"All views show the board nearly parallel to {to}: no two differ in tilt by more than "
            f"{found.spread_deg:.1f} degrees (at least {limits.spread_poor_deg:.0f} are needed), and focal "
            "length shows only in boards that are tilted differently."
        )
        kind: Severity = "unidentifiable" if found.spread_deg < limits.spread_free_deg else "poor"
        out.append(Finding(kind, text, MORE_TILT))
    if found.area_share < limits.area_poor:
        text = (
            f"All points together span {100 * found.area_share:.0f} % of the picture "
            f"(at least {100 * limits.area_poor:.0f} are needed); the lens elsewhere is a guess."
        )
        out.append(Finding("poor", text, _CLOSER))
    elif found.radius_share < 0.75:
        text = (
            f"Points reach {100 * found.radius_share:.0f} % of the way to the picture's corners; "
            "beyond, the distortion is extrapolated."
        )
        out.append(Finding("remark", text, _CORNERS))
    if found.view_share < limits.view_poor:
        text = (
            f"The board fills only {100 * found.view_share:.1f} % of a typical picture "
            f"(at least {100 * limits.view_poor:.0f} are needed)."
        )
        out.append(Finding("poor", text, _CLOSER))
    return out + _of_order(found, calibration) + _of_frame(found, calibration, limits)


def _of_order(found: Coverage, calibration: Calibration) -> list[Finding]:
    """Views whose points are listed mirrored."""
    if found.mirrored.all() or not found.mirrored.any():
        return []
    fewer = found.mirrored if found.mirrored.mean() <= 0.5 else ~found.mirrored
    names = [calibration.observations.names[i] for i in np.flatnonzero(fewer)]
    text = (
        f"{listed(names)} {'shows' if len(names) == 1 else 'show'} the board mirrored with respect to the "
        "other views: the points are listed in another order."
    )
    return [Finding("inconsistent", text, "Give the points of all views in the same order.")]


def _of_frame(found: Coverage, calibration: Calibration, limits: Limits) -> list[Finding]:
    """The picture's size and the principal point in it."""
    out = []
    camera = calibration.camera
    width, height = camera.image_size_px
    if found.outside_share > 0.0:
        text = (
            f"{100 * found.outside_share:.1f} % of the points lie outside of the picture of {width}x{height} "
            "pixels: its size is wrong, or u and v are swapped."
        )
        kind: Severity = "inconsistent" if found.outside_share > 0.01 else "poor"
        out.append(Finding(kind, text, "Check the image size and the order of u and v."))
    off = max(
        abs(camera.cx_px - 0.5 * (width - 1)) / width,
        abs(camera.cy_px - 0.5 * (height - 1)) / height,
    )
    if off > limits.centre_remark:
        swapped = bool(found.mirrored.all()) and width != height
        why = "u and v may be swapped" if swapped else "the picture is cropped, or its size is wrong"
        text = (
            f"The principal point ({camera.cx_px:.0f}, {camera.cy_px:.0f}) is {100 * off:.0f} % of the "
            f"picture's side away from its centre (up to {100 * limits.centre_poor:.0f} is usual): {why}."
        )
        out.append(Finding("poor" if off > limits.centre_poor or swapped else "remark", text))
    return out


def of_misfit(found: Misfit, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Residuals too large, bad views, bad points."""
    names = calibration.observations.names
    out = []
    worse = np.flatnonzero(found.bad_views)
    if len(worse):
        worse = worse[np.argsort(-found.view_rms_px[worse])]
        rest = found.view_rms_px[~found.bad_views]
        good = float(np.median(rest)) if len(rest) else found.typical_px
        detail = listed([f"{names[i]} ({found.view_rms_px[i]:.2f} px)" for i in worse], 4)
        text = (
            f"{detail} {'does' if len(worse) == 1 else 'do'} not fit the other views, whose RMS is "
            f"{good:.2f} px: misplaced corners, another board, or motion during the exposure."
        )
        advice = f"Leave out {listed([names[i] for i in worse], 4)}, or look at the corners there."
        out.append(Finding("inconsistent", text, advice))
    else:
        odd = np.flatnonzero(found.view_rms_px > max(limits.view_remark * found.typical_px, 0.1))
        if len(odd):
            detail = listed([f"{names[i]} ({found.view_rms_px[i]:.2f} px)" for i in odd], 4)
            text = (
                f"{detail}: RMS more than {limits.view_remark:.0f} times that of a typical view "
                f"({found.typical_px:.2f} px)."
            )
            out.append(Finding("remark", text))
    limit = limits.rms_px * scale_of(calibration.camera)
    if found.typical_px > limit:
        text = (
            f"The RMS error of a typical view is {found.typical_px:.2f} px (at most {limit:.1f} is good): "
            "the corners, the board's description or the lens model is wrong."
        )
        advice = "Look at the corners, check the number of squares and try a richer lens model."
        out.append(Finding("inconsistent" if found.typical_px > 3 * limit else "poor", text, advice))
    count = int(found.bad_points.sum())
    if count:
        share = count / max(found.points, 1)
        where = listed([names[i] for i in np.flatnonzero(found.bad_points.any(axis=1))])
        text = (
            f"{count} point{'s lie' if count > 1 else ' lies'} more than {limits.point_factor:.0f} times the "
            f"median error off, in {where} ({100 * share:.1f} % of all; at most "
            f"{100 * limits.points_poor:.0f} is good)."
        )
        many = share > limits.points_poor
        advice = "Use a robust loss, or look at these corners." if many else ""
        out.append(Finding("poor" if many else "remark", text, advice))
    return out + _of_pattern(found, limits)


def _of_pattern(found: Misfit, limits: Limits) -> list[Finding]:
    """Residuals that are not what independent normal noise leaves."""
    out = []
    if found.repeated > limits.repeated_remark:
        text = (
            f"Errors repeat at the same corners of the board from view to view, {found.repeated:.1f} times "
            "what independent errors would leave: the printed board is not exactly as described."
        )
        out.append(Finding("remark", text))
    if found.heavy_share > limits.heavy_remark:
        text = (
            f"The worst percent of the points holds {100 * found.heavy_share:.0f} % of the squared error "
            "(five is normal)."
        )
        out.append(Finding("remark", text, "Use a robust loss, or look at these corners."))
    return out


def of_split(found: Split | None, calibration: Calibration, limits: Limits) -> list[Finding]:
    """One camera, or two."""
    if found is None or found.ratio < (limits.change_ratio if found.in_order else limits.split_ratio):
        return []
    shift = {name: abs(found.difference[name]) / max(found.sigma[name], 1e-300) for name in found.difference}
    camera, names = calibration.camera, calibration.observations.names
    width = max(camera.image_size_px)
    scale = {"fx_px": camera.fx_px, "fy_px": camera.fy_px, "cx_px": width, "cy_px": width}
    # Distortion alone tells no two cameras apart; it follows the part of the picture that was seen.
    telling = [
        name
        for name, value in scale.items()
        if shift.get(name, 0.0) > limits.split_sigma
        and abs(found.difference[name]) > limits.split_least * value
        and found.apart_px > limits.split_px * scale_of(camera)
    ]
    strongest = max(telling or shift, key=lambda name: shift[name])
    if shift[strongest] < limits.split_sigma or found.apart_px < limits.split_seen_px * scale_of(camera):
        return []
    by = ", ".join(
        f"{name.removesuffix('_px')} by {found.difference[name]:+.1f} px"
        for name in telling or [one for one in scale if one in shift]
    )
    sure = (
        f"({by}; {strongest.removesuffix('_px')} by {shift[strongest]:.0f} standard deviations; directions "
        f"by {found.apart_px:.1f} px; the RMS falls from {found.rms_px:.3f} to {found.split_rms_px:.3f} px, "
        f"{found.ratio:.1f} times what chance explains)"
    )
    second = np.flatnonzero(found.second)
    if not telling:
        text = (
            f"{listed([names[i] for i in second], 20)} would have a camera of their own {sure}, but not one "
            f"whose focal length or centre differs for certain by {100 * limits.split_least:.1f} %, and "
            f"directions by {limits.split_px:g} px, which would matter."
        )
        return [Finding("remark", text)]
    if found.in_order:
        what = "the lens was refocused or zoomed" if {"fx_px", "fy_px"} & set(telling) else "the lens moved"
        text = (
            f"From {names[int(second[0])]} on the camera differs from the one before {sure}: {what}, or the "
            "camera changed."
        )
    else:
        text = (
            f"The views come from two cameras: {listed([names[i] for i in second], 20)} from one, "
            f"the other views from another {sure}."
        )
    advice = "Calibrate the two groups separately, with focus and zoom locked."
    return [Finding("inconsistent", text, advice)]


def of_target(found: TargetShape | None, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Squares that are square, on a board that is flat."""
    if found is None:
        return []
    out = []
    off = abs(found.aspect)
    squares = (
        f"the board's squares are {1 + found.aspect:.3f} times as high as wide "
        f"(standard deviation {found.aspect_sigma:.3f})"
    )
    pixel = abs(calibration.camera.fx_px / calibration.camera.fy_px - 1.0)
    if off > limits.aspect_remark and off > limits.aspect_sigma * found.aspect_sigma:
        text = f"{squares[0].upper()}{squares[1:]}, not square as said."
        advice = "Measure the printed squares along both sides; print without scaling."
        out.append(Finding("inconsistent" if off > limits.aspect_bad else "remark", text, advice))
    elif pixel > limits.pixel_aspect:
        # The board is cleared only where its aspect is known well and is one.
        cleared = found.aspect_sigma < 0.2 * pixel and off < 2.5 * found.aspect_sigma
        text = f"fx and fy differ by {100 * pixel:.1f} %" + (
            "; boards turned in their plane agree that the pixels, not the squares, are not square."
            if cleared
            else f": the pixels or the squares are not square ({squares}), and these views cannot tell which."
        )
        advice = "" if cleared else "Take pictures with the board turned by 90 degrees in its plane."
        out.append(Finding("remark" if cleared else "poor", text, advice))
    return out + _of_flatness(found, limits)


def _of_flatness(found: TargetShape, limits: Limits) -> list[Finding]:
    """A bend that is there, or views that could not bear one."""
    bend, moved = found.bow_m / found.size_m, abs(found.focal_shift)
    certain = found.bow_significance > limits.bow_sigma
    if certain and (bend > limits.bow_remark or moved > limits.bow_focal_remark):
        text = (
            f"The board is not flat: it is bent by about {1e3 * found.bow_m:.1f} mm over "
            f"{1e3 * found.size_m:.0f} mm ({found.bow_significance:.0f} standard deviations; up to "
            f"{100 * limits.bow_bad:.0f} % is good), which moves the focal length by {100 * moved:.1f} %."
        )
        kind: Severity = (
            "inconsistent" if bend > limits.bow_bad else "poor" if moved > limits.bow_focal else "remark"
        )
        return [
            Finding(kind, text, "Glue the board to a flat plate, or let its shape be fitted (--board warp).")
        ]
    if found.focal_per_bow > limits.fragile:
        text = (
            "The focal length hangs on the board's flatness: a bend of half a percent of its size "
            f"({5 * found.size_m:.1f} mm) would move it by {100 * found.focal_per_bow:.1f} %."
        )
        return [Finding("remark", text, MORE_TILT)]
    return []


# ----------------------------------------------------------------------
# Whether a calibration can be trusted: one of four verdicts, with reasons and advice.
#
# A low RMS says that the model can be bent to the data, not that the data fix the model. `judge` asks
# what the data would have to say if the answer were wrong, and refuses where they cannot object:
#
# ok              the views determine the camera and agree with it
# poor            a camera, but known too badly, or over too little of the picture
# inconsistent    the views contradict each other or the board's description
# unidentifiable  the views do not determine a camera; its numbers mean nothing
#
# The worst finding decides. Remarks never do. All checks run without robust loss (points it rejects are
# left out) and with the target rigid in the shape that was found for it.
# Above 100 views the searches (other starts, two cameras) run on an even sample of 100.

_SAMPLE = 100
_LEFT_OUT_WEIGHT = 0.5
"""Points that a robust loss weighs less are left out of the checks."""


def judge(
    calibration: Calibration,
    found: Covariance | None = None,
    limits: Limits | None = None,
    findings: Sequence[Finding] = (),
) -> Verdict:
    """Judge a calibration by its views alone.

    Parameters
    ----------
    found : its covariance, where it is at hand.
    findings : what is there to say already, as of views that were left out.
    """
    limits = Limits() if limits is None else limits
    observations = calibration.observations
    unusable = of_screening(screen(observations), observations.names)
    findings = [*findings, *unusable]
    if any(one.severity == "inconsistent" for one in unusable):
        # What else is wrong follows from the views that are none.
        return _concluded(findings, None)
    if not np.all(np.isfinite(calibration.block.intrinsics)) or not np.all(np.isfinite(calibration.normal)):
        findings += of_solution(calibration, observations.views, limits)
        if not any(one.severity == "unidentifiable" for one in findings):
            findings.append(Finding("unidentifiable", "The solver found no camera that fits the views."))
        return _concluded(findings, None)
    fit = _plain(calibration)
    findings += of_solution(calibration, fit.observations.views, limits)
    covered = coverage(fit)
    findings += of_coverage(covered, fit, limits)
    if fit.degrees_of_freedom <= 0 or fit.observations.views < 2 or not np.all(np.isfinite(fit.normal)):
        return _concluded(findings, None)
    found_misfit = misfit(fit, limits.view_bad, limits.point_factor, limits.point_floor_px)
    findings += of_misfit(found_misfit, fit, limits)
    sturdy = conditioned(fit)
    if sturdy is not fit:
        share = _focal_share(fit, covariance(fit), 1.0)
        findings += of_denominator(share, limits)
    # A target that was deformed to fit costs certainty, which the rigid target in its shape hides.
    least = 0.0
    if calibration.basis is not None:
        least = _focal_share(calibration, covariance(calibration) if found is None else found, 1.0)
    findings += _uncertainty(sturdy, covered, least, limits)
    findings += _contradictions(sturdy, limits)
    border = _border_sigma_px(fit, sturdy)
    if len(border):
        findings += of_border(border, max(fit.camera.image_size_px), limits)
    findings += of_lens(lens_shape(fit), fit, covered.radius_share)
    return _concluded(findings, sturdy)


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
    return refitted(calibration, observations=observations, start=start, basis=None, loss="none")


def _uncertainty(
    fit: Calibration,
    covered: Coverage,
    least_share: float,
    limits: Limits,
) -> list[Finding]:
    """Standard deviations and other starts."""
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
    findings = of_focal(share, limits)
    if "fx_px" in known.names:
        some = _sampled(fit)
        own = covariance(some).sigma()["fx_px"]
        findings += of_starts(other_starts(some), some, own, inflation, limits)
    return findings + of_projection(projection, width, limits)


def _border_sigma_px(fit: Calibration, sturdy: Calibration) -> FloatArray:
    """Standard deviation of projection, inflated, at the points of the border that the lens can show.

    The denominator of the rational model counts, unless nothing bounds it.
    """
    known = covariance(fit)
    if not np.all(np.isfinite(known.joint)):
        fit, known = sturdy, covariance(sturdy)
    sigma = overdispersion(evidence(fit)) * projection_sigma_px(fit, known, image_outline(fit.camera))
    return np.asarray(sigma[~np.isnan(sigma)])


def _focal_share(fit: Calibration, known: Covariance, inflation: float) -> float:
    """Larger relative standard deviation of the focal lengths, inflated; zero where they are held."""
    sigma = known.sigma()
    shares = [sigma[name] / getattr(fit.camera, name) for name in ("fx_px", "fy_px") if name in sigma]
    return inflation * float(max(shares, default=0.0))


def _contradictions(fit: Calibration, limits: Limits) -> list[Finding]:
    """Two cameras, a refocused lens, a board that is not what it is said to be."""
    some = _sampled(fit)
    # The lens first: a target would bend to make up for a lens that the model cannot follow.
    wide = widened(some)
    findings = of_richer(some, wide, limits)
    shape = target_shape(wide)
    findings += of_target(shape, wide, limits)
    if shape is not None:
        wide = straightened(wide, shape.displacement_m)
    return findings + of_split(best_split(wide), wide, limits)


def two_cameras(calibration: Calibration) -> list[Finding]:
    """Whether views come from two cameras, or from one that was refocused on the way."""
    wide = widened(_sampled(conditioned(calibration)))
    return of_split(best_split(wide), wide, Limits())


def _sampled(fit: Calibration) -> Calibration:
    views = fit.observations.views
    if views <= _SAMPLE:
        return fit
    return refitted(fit, np.unique(np.linspace(0, views - 1, _SAMPLE).astype(np.int64)))


def _inside(covered: Coverage) -> FloatArray:
    """Grid of pixels inside of the hull of what was seen."""
    low, high = covered.hull_px.min(axis=0), covered.hull_px.max(axis=0)
    u, v = np.meshgrid(np.linspace(low[0], high[0], 14), np.linspace(low[1], high[1], 12))
    grid = np.stack([u.ravel(), v.ravel()], axis=1)
    return grid[inside_hull(grid, covered.hull_px)]


def _concluded(findings: list[Finding], fit: Calibration | None) -> Verdict:
    if any(one.advice == _IN_CORNERS for one in findings):
        # Which says the same and more.
        findings = [replace(one, advice=_IN_CORNERS) if one.advice == _CORNERS else one for one in findings]
    verdict = Verdict.of(findings)
    # Where views contradict each other, more of them settle nothing.
    if fit is not None and verdict.word != "inconsistent":
        return Verdict.of([*findings, *_next_picture(fit, verdict)])
    return verdict


def _next_picture(fit: Calibration, verdict: Verdict) -> list[Finding]:
    width = max(fit.camera.image_size_px)
    if not 0.2 * width < min(fit.camera.fx_px, fit.camera.fy_px) < 50 * width:
        return []
    plan = best_next_view(fit, evidence(fit).S.sum(axis=0))
    if plan is None:
        return []
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
    gain = 100 * (1 - best.remaining)
    word = (
        "The picture that would help most"
        if not verdict.ok
        else "If you take another picture, the most useful"
    )
    text = (
        f"{word}: the board {best.where}, {lean}, {size}; "
        f"it would lower the uncertainty by about {gain:.0f} %."
    )
    return [Finding("remark", "", text)]
