"""From numbers to sentences: are the views good, and do they agree with each other and the board?

Every function takes what one module measured and returns findings, each one sentence with the number
and the limit it is held against. `calib.camera.reasons_fit` does the same for the fit.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import IntArray
from calib.camera.board_shape import TargetShape
from calib.camera.bundle import Calibration
from calib.camera.coverage import Coverage
from calib.camera.findings import INCONSISTENT, POOR, REMARK, UNIDENTIFIABLE, Finding, Limits, listed
from calib.camera.misfit import Misfit, Screening
from calib.camera.reasons_fit import MORE_TILT
from calib.camera.two_cameras import Split

__all__ = ["of_copies", "of_coverage", "of_misfit", "of_screening", "of_split", "of_target"]

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
            out.append(Finding(UNIDENTIFIABLE, f"All views show {what}."))
        elif some:
            text = f"{listed(some)} {'shows' if len(some) == 1 else 'show'} {what}."
            out.append(Finding(INCONSISTENT, text, f"Leave out {listed(some)}."))
    return out


def of_copies(first: IntArray, names: tuple[str, ...], ratio: float, limits: Limits) -> list[Finding]:
    """Views that show the board where another view does.

    Parameters
    ----------
    first : (N,) the view that each one repeats, or itself.
    ratio : standard deviation without the copies over that with them.
    """
    copies = np.flatnonzero(first != np.arange(len(first)))
    if len(copies) == 0:
        return []
    who = listed([f"{names[i]} (as {names[first[i]]})" for i in copies], 4)
    one = len(copies) == 1
    verbs = ("shows", "counts") if one else ("show", "count")
    text = f"{who} {verbs[0]} the board where another view does and {verbs[1]} once"
    if ratio > 1.05:
        text += f"; with the copies the standard deviations come out {ratio:.1f} times too small"
    many = len(first) - len(copies) <= limits.repeat_share * len(first)
    return [Finding(POOR if many else REMARK, text + ".", "Remove the copies." if many else "")]


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
        kind = UNIDENTIFIABLE if found.spread_deg < limits.spread_free_deg else POOR
        out.append(Finding(kind, text, MORE_TILT))
    if found.area_share < limits.area_poor:
        text = (
            f"All points together span {100 * found.area_share:.0f} % of the picture "
            f"(at least {100 * limits.area_poor:.0f} are needed); the lens elsewhere is a guess."
        )
        out.append(Finding(POOR, text, _CLOSER))
    elif found.radius_share < 0.75:
        text = (
            f"Points reach {100 * found.radius_share:.0f} % of the way to the picture's corners; "
            "beyond, the distortion is extrapolated."
        )
        out.append(Finding(REMARK, text, _CORNERS))
    if found.view_share < limits.view_poor:
        text = (
            f"The board fills only {100 * found.view_share:.1f} % of a typical picture "
            f"(at least {100 * limits.view_poor:.0f} are needed)."
        )
        out.append(Finding(POOR, text, _CLOSER))
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
    return [Finding(INCONSISTENT, text, "Give the points of all views in the same order.")]


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
        kind = INCONSISTENT if found.outside_share > 0.01 else POOR
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
        out.append(Finding(POOR if off > limits.centre_poor or swapped else REMARK, text))
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
        out.append(Finding(INCONSISTENT, text, advice))
    else:
        odd = np.flatnonzero(found.view_rms_px > max(limits.view_remark * found.typical_px, 0.1))
        if len(odd):
            detail = listed([f"{names[i]} ({found.view_rms_px[i]:.2f} px)" for i in odd], 4)
            text = (
                f"{detail}: RMS more than {limits.view_remark:.0f} times that of a typical view "
                f"({found.typical_px:.2f} px)."
            )
            out.append(Finding(REMARK, text))
    limit = limits.rms_px * max(1.0, max(calibration.camera.image_size_px) / 1000)
    if found.typical_px > limit:
        text = (
            f"The RMS error of a typical view is {found.typical_px:.2f} px (at most {limit:.1f} is good): "
            "the corners, the board's description or the lens model is wrong."
        )
        advice = "Look at the corners, check the number of squares and try a richer lens model."
        out.append(Finding(INCONSISTENT if found.typical_px > 3 * limit else POOR, text, advice))
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
        out.append(Finding(POOR if many else REMARK, text, advice))
    return out + _of_pattern(found, limits)


def _of_pattern(found: Misfit, limits: Limits) -> list[Finding]:
    """Residuals that are not what independent normal noise leaves."""
    out = []
    if found.repeated > limits.repeated_remark:
        text = (
            f"Errors repeat at the same corners of the board from view to view, {found.repeated:.1f} times "
            "what independent errors would leave: the printed board is not exactly as described."
        )
        out.append(Finding(REMARK, text))
    if found.heavy_share > limits.heavy_remark:
        text = (
            f"The worst percent of the points holds {100 * found.heavy_share:.0f} % of the squared error "
            "(five is normal)."
        )
        out.append(Finding(REMARK, text, "Use a robust loss, or look at these corners."))
    return out


def of_split(found: Split | None, in_order: bool, calibration: Calibration, limits: Limits) -> list[Finding]:
    """One camera, or two."""
    if found is None or found.ratio < (limits.change_ratio if in_order else limits.split_ratio):
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
    ]
    strongest = max(telling or shift, key=lambda name: shift[name])
    if shift[strongest] < limits.split_sigma:
        return []
    by = ", ".join(
        f"{name.removesuffix('_px')} by {found.difference[name]:+.1f} px"
        for name in ("fx_px", "cx_px", "cy_px")
        if name in shift
    )
    sure = (
        f"({by}; {strongest.removesuffix('_px')} by {shift[strongest]:.0f} standard deviations; the RMS "
        f"falls from {found.rms_px:.3f} to {found.split_rms_px:.3f} px, {found.ratio:.1f} times what chance "
        "explains)"
    )
    second = np.flatnonzero(found.second)
    if not telling:
        text = (
            f"{listed([names[i] for i in second], 20)} would have a camera of their own {sure}, but no focal "
            f"length or centre that differs for certain by {100 * limits.split_least:.1f} %, which would "
            "matter."
        )
        return [Finding(REMARK, text)]
    if in_order:
        text = (
            f"From {names[int(second[0])]} on the camera differs from the one before {sure}: the lens was "
            "refocused or zoomed, or the camera changed."
        )
    else:
        text = (
            f"The views come from two cameras: {listed([names[i] for i in second], 20)} from one, "
            f"the other views from another {sure}."
        )
    advice = "Calibrate the two groups separately, with focus and zoom locked."
    return [Finding(INCONSISTENT, text, advice)]


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
        out.append(Finding(INCONSISTENT if off > limits.aspect_bad else REMARK, text, advice))
    elif pixel > limits.pixel_aspect:
        # The board is cleared only where its aspect is known well and is one.
        cleared = found.aspect_sigma < 0.2 * pixel and off < 2.5 * found.aspect_sigma
        text = f"fx and fy differ by {100 * pixel:.1f} %" + (
            "; boards turned in their plane agree that the pixels, not the squares, are not square."
            if cleared
            else f": the pixels or the squares are not square ({squares}), and these views cannot tell which."
        )
        advice = "" if cleared else "Take pictures with the board turned by 90 degrees in its plane."
        out.append(Finding(REMARK if cleared else POOR, text, advice))
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
        kind = INCONSISTENT if bend > limits.bow_bad else POOR if moved > limits.bow_focal else REMARK
        return [
            Finding(kind, text, "Glue the board to a flat plate, or let its shape be fitted (--board warp).")
        ]
    if found.focal_per_bow > limits.fragile:
        text = (
            "The focal length hangs on the board's flatness: a bend of half a percent of its size "
            f"({5 * found.size_m:.1f} mm) would move it by {100 * found.focal_per_bow:.1f} %."
        )
        return [Finding(REMARK, text, MORE_TILT)]
    return []
