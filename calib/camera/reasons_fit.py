"""From numbers to sentences: is the camera determined by the views?

Every function takes what one module measured and returns findings, each one sentence with the number
and the limit it is held against. `calib.camera.reasons` does the same for the views themselves.
"""

from __future__ import annotations

import numpy as np

from calib.camera.bundle import Calibration
from calib.camera.coverage import Lens
from calib.camera.findings import POOR, REMARK, UNIDENTIFIABLE, Finding, Limits
from calib.camera.starts import FocalInterval, Start

__all__ = [
    "MORE_TILT",
    "of_denominator",
    "of_focal",
    "of_lens",
    "of_projection",
    "of_richer",
    "of_solution",
    "of_starts",
]

MORE_TILT = "Tilt the board by 30 degrees or more, about its long and its short side in turn."
_MORE_VIEWS = "Take at least ten pictures with the board tilted in different directions."
_IN_CORNERS = "Take pictures with the board in the picture's corners, or use a simpler model."

_CHI2_95 = 3.84


def of_solution(calibration: Calibration, unique: int, limits: Limits) -> list[Finding]:
    """Enough views and points, and a solver that arrived."""
    out = []
    views, points = calibration.observations.views, calibration.observations.points
    short = calibration.decrement
    if calibration.termination == "behind the camera":
        text = "No camera was found that has all points of the board in front of it."
        out.append(Finding(UNIDENTIFIABLE, text))
    elif calibration.termination == "singular":
        text = (
            "The normal equations are singular: the views leave a direction of the parameters entirely free."
        )
        out.append(Finding(UNIDENTIFIABLE, text, MORE_TILT))
    elif not calibration.converged and not short < 0.1:
        text = (
            f"The solver stopped ({calibration.termination}) after {calibration.evaluations} evaluations, "
            f"{short:.2g} standard deviations short of a minimum (up to {limits.decrement:g} does not "
            "matter): the views leave a direction nearly free."
        )
        out.append(Finding(REMARK if short < limits.decrement else UNIDENTIFIABLE, text))
    if calibration.degrees_of_freedom <= 0:
        text = (
            f"{points} points in {views} views give no more equations than there are unknowns, "
            "so nothing checks the answer."
        )
        out.append(Finding(UNIDENTIFIABLE, text, _MORE_VIEWS))
    if unique < 2:
        text = "There is only one view of the board, which hardly tells focal length and distance apart."
        out.append(Finding(UNIDENTIFIABLE, text, _MORE_VIEWS))
    elif unique < limits.views:
        text = (
            f"{unique} different views are too few to check one against the others; "
            f"{limits.views} are the least."
        )
        out.append(Finding(POOR, text, _MORE_VIEWS))
    return out


def of_lens(found: Lens, calibration: Calibration, reach: float) -> list[Finding]:
    """The radial curve has to rise over the image, and the focal length has to be a lens's."""
    camera = calibration.camera
    width = max(camera.image_size_px)
    out = []
    if found.seen_slope <= 0.0:
        text = (
            "The distortion curve folds over among the points that were seen, so that two directions share "
            "a pixel: distortion has taken the place of something else."
        )
        rational = camera.model == "rational8"
        kind = POOR if rational else UNIDENTIFIABLE
        out.append(Finding(kind, text, "Use a simpler lens model." if rational else MORE_TILT))
    elif found.image_shown < 1.0 or found.image_slope <= 0.0:
        lost = 100 * (1 - found.image_shown)
        text = (
            f"The distortion curve folds over inside of the picture: {lost:.0f} % of its border cannot be "
            f"undistorted (up to 10 is good; points were seen {100 * reach:.0f} % of the way to the corners)."
        )
        out.append(Finding(POOR if lost > 10.0 else REMARK, text, _IN_CORNERS))
    focal = min(camera.fx_px, camera.fy_px)
    if not 0.25 * width < focal < 30 * width:
        text = (
            f"The focal length of {focal:.1f} px is {focal / width:.2f} times the picture's width; "
            "lenses that this model suits have 0.25 to 30."
        )
        free = not 0.15 * width < focal < 100 * width
        out.append(Finding(UNIDENTIFIABLE if free else POOR, text, MORE_TILT))
    return out


def of_focal(sigma_share: float, interval: FocalInterval | None, limits: Limits) -> list[Finding]:
    """Standard deviation of the focal length, inflated, and its interval from the profile."""
    out = []
    if not sigma_share < limits.focal_remark:
        known = f"{100 * sigma_share:.1f} %" if sigma_share < 2 else "no better than a factor of two"
        text = (
            f"The focal length is known to {known} (one standard deviation, residuals that are not white "
            f"considered; up to {100 * limits.focal_poor:.0f} is good, {100 * limits.focal_free:.0f} means "
            "that it is free)."
        )
        kind = REMARK if sigma_share < limits.focal_poor else POOR
        out.append(Finding(kind if sigma_share < limits.focal_free else UNIDENTIFIABLE, text, MORE_TILT))
    if interval is None:
        return out
    if interval.lower_cost:
        text = "Moving the focal length lowers the cost: the solver had not found the minimum."
        out.append(Finding(UNIDENTIFIABLE, text, MORE_TILT))
    elif not interval.bounded:
        text = (
            f"The views fit a focal length of {_range(interval)} about as well as the "
            f"{interval.fx_px:.0f} px found: its 95 % interval has no end."
        )
        out.append(Finding(UNIDENTIFIABLE, text, MORE_TILT))
    elif interval.half_width_share > 2 * limits.focal_poor:
        text = (
            f"Focal lengths from {interval.low_px:.1f} to {interval.high_px:.1f} px fit the views about "
            f"equally well (95 % interval; {200 * limits.focal_poor:.0f} % to either side is good)."
        )
        free = interval.half_width_share > 2 * limits.focal_free
        out.append(Finding(UNIDENTIFIABLE if free else POOR, text, MORE_TILT))
    return out


def _range(interval: FocalInterval) -> str:
    if interval.low_px > 0.0:
        return f"any value above {interval.low_px:.0f} px"
    return f"any value below {interval.high_px:.0f} px" if np.isfinite(interval.high_px) else "any value"


def of_denominator(sigma_share: float, limits: Limits) -> list[Finding]:
    """What the rational model's denominator costs the focal length when it is free as well."""
    if sigma_share < limits.focal_poor:
        return []
    known = f"{100 * sigma_share:.1f} %" if sigma_share < 2 else "no better than a factor of two"
    text = (
        f"The coefficients k4, k5 and k6 are not determined; with them free the focal length is known to "
        f"{known} (up to {100 * limits.focal_free:.0f} does not matter, as distortion makes up for it)."
    )
    return [Finding(REMARK if sigma_share < limits.focal_free else POOR, text, "Use a simpler lens model.")]


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
    return [Finding(POOR if serious else REMARK, text, "Use a richer lens model.")]


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
    return [Finding(POOR, text, "Take more pictures, with the board tilted and close.")]


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
            return [Finding(UNIDENTIFIABLE, text, MORE_TILT)]
        equal = end.cost < own + chance and apart > max(0.02, 5 * inflation * sigma_fx_px / fx)
        rival = end.cost < limits.rival_cost * own and apart > limits.rival_focal
        if (equal or rival) and end.termination == "converged":
            text = (
                f"Two cameras fit the views about equally well: fx = {fx:.1f} px with RMS "
                f"{calibration.rms_px:.3f} px and fx = {other:.1f} px with RMS {rms:.3f} px."
            )
            return [Finding(UNIDENTIFIABLE, text, MORE_TILT)]
    return []
