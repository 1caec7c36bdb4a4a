"""From numbers to sentences: what each check means for the verdict.

Every function takes what one module measured and returns findings, each one sentence with the number
and the limit it is held against.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import IntArray
from calib.camera.board_shape import TargetShape
from calib.camera.bundle import Calibration
from calib.camera.coverage import Coverage, Lens
from calib.camera.finding import INCONSISTENT, POOR, REMARK, UNIDENTIFIABLE, Finding, listed
from calib.camera.limits import Limits
from calib.camera.misfit import Misfit
from calib.camera.screening import Screening
from calib.camera.starts import FocalInterval, Start
from calib.camera.two_cameras import Split

__all__ = [
    "of_copies",
    "of_coverage",
    "of_focal",
    "of_lens",
    "of_misfit",
    "of_screening",
    "of_solution",
    "of_split",
    "of_starts",
    "of_target",
]

_MORE_TILT = "Tilt the board by 30 degrees or more, about its long and its short side in turn."


def of_screening(found: Screening, names: tuple[str, ...]) -> list[Finding]:
    """Views that cannot be views of the board at all."""
    out = []
    for which, what, advice in (
        (found.few, "fewer than four points", "Leave out {}."),
        (found.on_a_line, "only points on one line", "Leave out {}."),
        (
            found.not_a_plane,
            "points that no camera can see on a flat board: they are listed in another order or come from another board",
            "Leave out {} or look at their corners and at the board's number of squares.",
        ),
    ):
        some = [names[i] for i in np.flatnonzero(which)]
        if not some:
            continue
        everything = len(some) == len(names)
        who = "All views" if everything else listed(some)
        verb = "shows" if len(some) == 1 else "show"
        out.append(
            Finding(
                UNIDENTIFIABLE if everything else INCONSISTENT,
                f"{who} {verb} {what}.",
                "" if everything else advice.format(listed(some)),
            )
        )
    return out


def of_copies(first: IntArray, names: tuple[str, ...], ratio: float, limits: Limits) -> list[Finding]:
    """Views that show the board where another view does."""
    copies = np.flatnonzero(first != np.arange(len(first)))
    if len(copies) == 0:
        return []
    text = (
        f"{listed([f'{names[i]} (as {names[first[i]]})' for i in copies], 4)} "
        f"{'show' if len(copies) > 1 else 'shows'} the board where another view does and count{'' if len(copies) > 1 else 's'} once"
    )
    if np.isfinite(ratio) and ratio > 1.05:
        text += f"; with the copies the standard deviations come out {ratio:.1f} times too small"
    many = len(first) - len(copies) <= limits.repeat_share * len(first)
    return [Finding(POOR if many else REMARK, text + ".", "Remove the copies." if many else "")]


def of_solution(calibration: Calibration, unique: int, limits: Limits) -> list[Finding]:
    """Enough views and points, and a solver that arrived."""
    out = []
    views, points = calibration.observations.views, calibration.observations.points
    if calibration.termination == "behind the camera":
        out.append(
            Finding(UNIDENTIFIABLE, "No camera was found that has all points of the board in front of it.")
        )
    elif calibration.termination == "singular":
        out.append(
            Finding(
                UNIDENTIFIABLE,
                "The views leave a direction of the parameters entirely free: the normal equations are singular.",
            )
        )
    elif not calibration.converged and not calibration.decrement < 0.1:
        # A fall of the cost by the square of this many standard deviations is still to be had.
        out.append(
            Finding(
                REMARK if calibration.decrement < limits.decrement else UNIDENTIFIABLE,
                f"The solver stopped ({calibration.termination}) after {calibration.evaluations} evaluations "
                f"{calibration.decrement:.2g} standard deviations short of a minimum: the views leave a direction nearly free.",
            )
        )
    if calibration.degrees_of_freedom <= 0:
        out.append(
            Finding(
                UNIDENTIFIABLE,
                f"{points} points in {views} views give no more equations than there are unknowns; nothing checks the answer.",
                "Take more pictures.",
            )
        )
    if unique < 2:
        out.append(
            Finding(
                UNIDENTIFIABLE,
                "There is only one view of the board; focal length and distance cannot be told apart well from one view.",
                "Take at least ten pictures with the board tilted in different directions.",
            )
        )
    elif unique < limits.views:
        out.append(
            Finding(
                POOR,
                f"{unique} different views are too few to check one against the others; {limits.views} are the least.",
                "Take at least ten pictures with the board tilted in different directions.",
            )
        )
    return out


def of_coverage(found: Coverage, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Tilts, distances and the part of the image that was covered."""
    out = []
    width, height = calibration.camera.image_size_px
    tilt = float(found.tilts_deg.max())
    if found.spread_deg < limits.spread_poor_deg and len(found.tilts_deg) > 1:
        kind = UNIDENTIFIABLE if found.spread_deg < limits.spread_free_deg else POOR
        same = "parallel to the picture" if tilt < limits.spread_poor_deg else "parallel to each other"
        out.append(
            Finding(
                kind,
                f"All views show the board nearly {same}: no two differ in tilt by more than {found.spread_deg:.1f} degrees "
                f"(at least {limits.spread_poor_deg:.0f} are needed), and focal length is seen only in tilted boards.",
                _MORE_TILT,
            )
        )
    if found.outside_share > 0.0:
        share = 100 * found.outside_share
        out.append(
            Finding(
                INCONSISTENT if share > 1.0 else POOR,
                f"{share:.1f} % of the points lie outside of the picture of {width}x{height} pixels: the image size is wrong, or u and v are swapped.",
                "Check the image size.",
            )
        )
    if found.area_share < limits.area_poor:
        out.append(
            Finding(
                POOR,
                f"All points together span {100 * found.area_share:.0f} % of the picture (at least {100 * limits.area_poor:.0f} are needed); "
                "the lens elsewhere is a guess.",
                "Bring the board closer and into every corner of the picture.",
            )
        )
    if found.view_share < limits.view_poor:
        out.append(
            Finding(
                POOR,
                f"The board fills only {100 * found.view_share:.1f} % of a typical picture (at least {100 * limits.view_poor:.0f} are needed).",
                "Bring the board closer, so that it fills a third of the picture or more.",
            )
        )
    elif found.area_share >= limits.area_poor and found.radius_share < 0.75:
        out.append(
            Finding(
                REMARK,
                f"Points reach out to {100 * found.radius_share:.0f} % of the way to the picture's corners; beyond, the distortion is extrapolated.",
                "Take pictures with the board in the picture's corners.",
            )
        )
    some = found.mirrored.any()
    if some and not found.mirrored.all():
        fewer = found.mirrored if found.mirrored.mean() <= 0.5 else ~found.mirrored
        names = [calibration.observations.names[i] for i in np.flatnonzero(fewer)]
        out.append(
            Finding(
                INCONSISTENT,
                f"{listed(names)} show the board mirrored with respect to the other views: their points are listed in another order.",
                "Give the points of all views in the same order.",
            )
        )
    offset = [
        abs(calibration.camera.cx_px - 0.5 * (width - 1)) / width,
        abs(calibration.camera.cy_px - 0.5 * (height - 1)) / height,
    ]
    off = max(offset)
    if off > limits.centre_remark:
        swapped = found.mirrored.all() and abs(width - height) > 0.1 * width
        out.append(
            Finding(
                POOR if off > limits.centre_poor or swapped else REMARK,
                f"The principal point ({calibration.camera.cx_px:.0f}, {calibration.camera.cy_px:.0f}) is {100 * off:.0f} % of the picture's side away "
                f"from its centre (up to {100 * limits.centre_poor:.0f} is usual): "
                + (
                    "u and v may be swapped."
                    if swapped
                    else "the picture is cropped, its size is wrong, or the views do not fix it."
                ),
            )
        )
    return out


def of_lens(found: Lens, calibration: Calibration, reach: float) -> list[Finding]:
    """The radial curve has to rise over the image."""
    camera = calibration.camera
    width = max(camera.image_size_px)
    out = []
    if found.seen_slope <= 0.0:
        out.append(
            Finding(
                POOR if camera.model == "rational8" else UNIDENTIFIABLE,
                "The distortion curve folds over inside of the radii where points were seen: two directions share a pixel, "
                "so distortion has taken the place of something else.",
                "Use a simpler model." if camera.model == "rational8" else _MORE_TILT,
            )
        )
    elif found.image_shown < 1.0 or found.image_slope <= 0.0:
        out.append(
            Finding(
                POOR if found.image_shown < 0.9 else REMARK,
                f"The distortion curve folds over inside of the picture: {100 * (1 - found.image_shown):.0f} % of its border cannot be undistorted "
                f"(points were seen out to {100 * reach:.0f} % of the way to its corners).",
                "Take pictures with the board in the picture's corners, or use a simpler model.",
            )
        )
    focal = min(camera.fx_px, camera.fy_px)
    if not 0.25 * width < focal < 30 * width:
        out.append(
            Finding(
                UNIDENTIFIABLE if not 0.15 * width < focal < 100 * width else POOR,
                f"The focal length of {focal:.1f} px is {focal / width:.2f} times the picture's width; lenses of this model have 0.25 to 30.",
                _MORE_TILT,
            )
        )
    return out


def of_focal(
    sigma_share: float,
    interval: FocalInterval | None,
    projection_px: float,
    width: int,
    limits: Limits,
) -> list[Finding]:
    """Uncertainty of the focal length and of projection, inflated."""
    out = []
    free, poor = 100 * limits.focal_free, 100 * limits.focal_poor
    if not sigma_share < limits.focal_poor:
        kind = POOR if sigma_share < limits.focal_free else UNIDENTIFIABLE
        text = f"{100 * sigma_share:.1f} %" if sigma_share < 10 else "more than the focal length itself"
        out.append(
            Finding(
                kind,
                f"The focal length is known to {text} (one standard deviation, inflated for residuals that are not white; "
                f"{poor:.1f} is good, above {free:.0f} it is not determined).",
                _MORE_TILT,
            )
        )
    if interval is not None:
        half = interval.half_width_share
        if interval.lower_cost:
            out.append(
                Finding(
                    UNIDENTIFIABLE,
                    "Moving the focal length lowers the cost: the solver had not found the minimum.",
                    _MORE_TILT,
                )
            )
        elif not np.isfinite(half):
            side = (
                f"any value above {interval.low_px:.0f} px"
                if interval.low_px > 0
                else f"any value below {interval.high_px:.0f} px"
            )
            if interval.low_px <= 0 and not np.isfinite(interval.high_px):
                side = "any value"
            out.append(
                Finding(
                    UNIDENTIFIABLE,
                    f"The views fit a focal length of {side} about as well as the {interval.fx_px:.0f} px found: the 95 % interval is unbounded.",
                    _MORE_TILT,
                )
            )
        elif half > 2 * limits.focal_poor:
            out.append(
                Finding(
                    UNIDENTIFIABLE if half > 2 * limits.focal_free else POOR,
                    f"Focal lengths from {interval.low_px:.1f} to {interval.high_px:.1f} px fit the views about equally well (95 % interval).",
                    _MORE_TILT,
                )
            )
    limit = limits.projection_share * width
    if not projection_px <= limit:
        out.append(
            Finding(
                POOR,
                f"Where points were seen the camera predicts pixels to {projection_px:.2f} px only (median standard deviation; {limit:.2f} is good).",
                "Take more pictures, tilted and close.",
            )
        )
    return out


def of_starts(
    ends: list[Start], calibration: Calibration, sigma_fx: float, inflation: float, limits: Limits
) -> list[Finding]:
    """All starts have to reach one minimum, or clearly worse ones."""
    own, variance = calibration.squared_sum, (inflation * calibration.sigma_px) ** 2
    fx = calibration.camera.fx_px
    for end in sorted(ends, key=lambda one: one.cost):
        other = float(end.block.intrinsics[0])
        rms = float(np.sqrt(end.cost / calibration.observations.points))
        apart = abs(other / fx - 1.0)
        if end.cost < own - 3.84 * variance and apart > 1e-3:
            return [
                Finding(
                    UNIDENTIFIABLE,
                    f"Starting at a focal length of {end.focal_px:.0f} px the fit ends at fx = {other:.1f} with RMS {rms:.3f} px, below the "
                    f"{calibration.rms_px:.3f} px of fx = {fx:.1f}: the answer is not the best one.",
                    _MORE_TILT,
                )
            ]
        close = end.cost < own + 3.84 * variance and apart > max(0.02, 5 * inflation * sigma_fx / fx)
        rival = end.cost < limits.rival_cost * own and apart > limits.rival_focal
        if (close or rival) and end.termination == "converged":
            return [
                Finding(
                    UNIDENTIFIABLE,
                    f"Two cameras fit the views about equally well: fx = {fx:.1f} (RMS {calibration.rms_px:.3f} px) and fx = {other:.1f} (RMS {rms:.3f} px).",
                    _MORE_TILT,
                )
            ]
    return []


def of_misfit(found: Misfit, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Residuals too large, bad views, bad points."""
    out = []
    names = calibration.observations.names
    bad = np.flatnonzero(found.bad_views)
    good = (
        float(np.median(found.view_rms_px[~found.bad_views]))
        if (~found.bad_views).any()
        else found.typical_px
    )
    if len(bad):
        ordered = bad[np.argsort(-found.view_rms_px[bad])]
        detail = [f"{names[i]} ({found.view_rms_px[i]:.2f} px)" for i in ordered]
        one = len(bad) == 1
        out.append(
            Finding(
                INCONSISTENT,
                f"{listed(detail, 4)} {'does' if one else 'do'} not fit the other views, whose RMS is {good:.2f} px: "
                "misplaced corners, another board, or the board or the camera moved during the exposure.",
                f"Leave out {listed([names[i] for i in ordered], 4)} or look at {'its' if one else 'their'} corners.",
            )
        )
    else:
        worse = np.flatnonzero(found.view_rms_px > max(limits.view_remark * found.typical_px, 0.1))
        if len(worse):
            out.append(
                Finding(
                    REMARK,
                    f"{listed([f'{names[i]} ({found.view_rms_px[i]:.2f} px)' for i in worse], 4)}: RMS more than {limits.view_remark:.0f} times "
                    f"that of a typical view ({found.typical_px:.2f} px).",
                )
            )
    limit = limits.rms_px * max(1.0, max(calibration.camera.image_size_px) / 1000)
    typical = found.typical_px
    if typical > limit:
        out.append(
            Finding(
                INCONSISTENT if typical > 3 * limit else POOR,
                f"The RMS error of a typical view is {typical:.2f} px (at most {limit:.1f} is good): the corners, the board's description or the lens model are wrong.",
                "Look at the corners drawn into the pictures, check the number of squares and try a richer model.",
            )
        )
    count = int(found.bad_points.sum())
    if count:
        share = count / max(found.points, 1)
        views = [names[i] for i in np.flatnonzero(found.bad_points.any(axis=1))]
        points = f"{count} point{'s are' if count > 1 else ' is'}"
        out.append(
            Finding(
                POOR if share > limits.points_poor else REMARK,
                f"{points} more than {limits.point_factor:.0f} times the median error away from where the camera expects them, in {listed(views)} "
                f"({100 * share:.1f} % of all; at most {100 * limits.points_poor:.0f} is good).",
                "Use a robust loss, or look at these corners." if share > limits.points_poor else "",
            )
        )
    return out


def of_split(found: Split | None, in_order: bool, calibration: Calibration, limits: Limits) -> list[Finding]:
    """One camera, or two."""
    if found is None or found.ratio < limits.split_ratio:
        return []
    shift = {name: found.difference[name] / max(found.sigma[name], 1e-300) for name in found.difference}
    strongest = max(shift, key=lambda name: abs(shift[name]))
    if abs(shift[strongest]) < limits.split_sigma:
        return []
    camera = calibration.camera
    width = max(camera.image_size_px)
    apart = max(
        abs(found.difference.get(name, 0.0)) / scale
        for name, scale in (
            ("fx_px", camera.fx_px),
            ("fy_px", camera.fy_px),
            ("cx_px", width),
            ("cy_px", width),
        )
    )
    names = calibration.observations.names
    differing = ", ".join(
        f"{name.removesuffix('_px')} {found.difference[name]:+.1f} px"
        for name in ("fx_px", "cx_px", "cy_px")
        if name in shift
    )
    evidence = (
        f"({differing}; {strongest.removesuffix('_px')} by {abs(shift[strongest]):.0f} standard deviations; RMS {found.rms_px:.3f} falls to "
        f"{found.split_rms_px:.3f} px, {found.ratio:.1f} times what chance explains)"
    )
    second = np.flatnonzero(found.second)
    if in_order:
        text = f"From {names[int(second[0])]} on the camera is another one than before {evidence}: the lens was refocused or zoomed, or the camera was changed."
    else:
        text = f"The views come from two cameras: {listed([names[i] for i in second], 20)} from one, the others from another {evidence}."
    if apart < limits.split_least:
        return [Finding(REMARK, text)]
    return [Finding(INCONSISTENT, text, "Calibrate the two groups separately, with focus and zoom locked.")]


def of_target(found: TargetShape | None, calibration: Calibration, limits: Limits) -> list[Finding]:
    """Squares that are square on a board that is flat."""
    if found is None:
        return []
    out = []
    off = abs(found.aspect)
    if off > limits.aspect_remark and off > limits.aspect_sigma * found.aspect_sigma:
        out.append(
            Finding(
                INCONSISTENT if off > limits.aspect_bad else REMARK,
                f"The board's squares are {1 + found.aspect:.3f} times as high as wide (standard deviation {found.aspect_sigma:.3f}), not square as said.",
                "Measure the printed squares along both sides; print without scaling.",
            )
        )
    pixel = calibration.camera.fx_px / calibration.camera.fy_px - 1.0
    if abs(pixel) > limits.pixel_aspect and not out:
        # The board is cleared only where its aspect is known well and is one.
        cleared = found.aspect_sigma < 0.2 * abs(pixel) and off < 2.5 * found.aspect_sigma
        out.append(
            Finding(
                REMARK if cleared else POOR,
                f"fx and fy differ by {100 * abs(pixel):.1f} %"
                + (
                    "; boards turned in their plane agree that it is the pixels, not the squares, that are not square."
                    if cleared
                    else f": the pixels or the board's squares are not square ({1 + found.aspect:.3f} times as high as wide, "
                    f"standard deviation {found.aspect_sigma:.3f}), and these views cannot tell which."
                ),
                "" if cleared else "Take pictures with the board turned by 90 degrees in its plane.",
            )
        )
    share = found.bow_m / found.size_m
    if share > limits.bow_remark and found.bow_significance > limits.bow_sigma:
        out.append(
            Finding(
                INCONSISTENT if share > limits.bow_bad else REMARK,
                f"The board is not flat: it is bent by about {1e3 * found.bow_m:.1f} mm over {1e3 * found.size_m:.0f} mm "
                f"({found.bow_significance:.0f} standard deviations), which moves the focal length by {100 * abs(found.focal_shift):.1f} %.",
                "Glue the board to a flat plate.",
            )
        )
    return out
