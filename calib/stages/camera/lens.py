"""What lens distortion does to the picture and costs on the plane, and a cheap inverse of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calib.core.arrays import AnyArray, BoolArray, FloatArray
from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography, box_grid, fit_homography, rotation_exp
from calib.core.result import finite_or_none
from calib.stages.camera.bundle import Covariance
from calib.stages.camera.model import (
    INTRINSICS,
    Camera,
    camera_from_vector,
    corner_radius,
    distort,
    distorted_normalised,
    focal_px,
    fold_radius,
    one_to_one_reach,
    project,
    rays,
    undistort,
    vector_from_camera,
)
from calib.stages.camera.plane import visible
from calib.stages.camera.pose import plane_pixels, projection_with_derivatives
from calib.stages.camera.section import InverseLens, Lens

# ----------------------------------------------------------------------
# Undistortion that a microcontroller can afford: a polynomial fitted to the inverse of the lens model.
#
# (B.1) has no inverse in closed form, but over the radii of one picture a short polynomial replaces it.
# In normalised distorted coordinates w = (xd, yd), with rho = |w|^2, the radial part is undone by
#
#     x = w P(|w|^2),   P(rho) = 1 + c1 rho + c2 rho^2 + ...
#
# Decentering (p1, p2) is added by the model after the radial part, so it is taken off first, where the
# point was found so far; the second line is repeated a few times, once or twice for a usual lens:
#
#     x <- w P(|w|^2)
#     x <- v P(|v|^2),   v = w - T(x),   T(x) = (2 p1 x y + p2 (r2 + 2 x^2), p1 (r2 + 2 y^2) + 2 p2 x y)
#
# The coefficients minimise the largest error over the picture (Lawson's reweighted least squares), and
# the shortest polynomial that is good enough is taken.

_MOST_COEFFICIENTS, _MOST_STEPS = 10, 6
_REWEIGHTINGS = 40
_INVERSE_TOLERANCE_PX = 0.01
_ROTATION_STEPS = 8
_STEEPEST = float(np.tan(np.radians(75.0)))
"""Undistorted radius up to which a fisheye lens is undone: no polynomial follows the tangent to its pole at a
right angle."""
_MOST_PIXELS = 200_000
"""Larger pictures are checked on a grid of about this many pixels, their borders included."""


def pixel_grid(
    image_size_px: tuple[int, int],
    region_px: tuple[float, float, float, float] | None = None,
    most: int = _MOST_PIXELS,
) -> FloatArray:
    """Centres of the pixels of a picture, or of a box (u0, v0, u1, v1) with its borders, (rows, columns, 2).

    Every pixel where there are no more than `most`, else evenly spaced ones that include the borders.
    """
    width, height = image_size_px
    u0, v0, u1, v1 = box = region_px or (0.0, 0.0, width - 1.0, height - 1.0)
    columns, rows = round(u1 - u0) + 1, round(v1 - v0) + 1
    shrink = min(1.0, (most / (columns * rows)) ** 0.5)
    across, down = (max(2, round(n * shrink)) if n > 1 else 1 for n in (columns, rows))
    return box_grid(box, across, down)


def undistort_by_polynomial(camera: Camera, inverse: InverseLens, distorted: AnyArray) -> AnyArray:
    """Normalised undistorted coordinates (..., 2) of distorted ones, in the precision of the input."""
    kind = distorted.dtype.type
    p1, p2, two = kind(camera.distortion[2]), kind(camera.distortion[3]), kind(2)
    xd, yd = distorted[..., 0], distorted[..., 1]
    x, y = _times_radial(inverse.radial, xd, yd)
    for _ in range(inverse.decentering_steps):
        r2, xy = x * x + y * y, two * x * y
        u = xd - (p1 * xy + p2 * (r2 + two * x * x))
        v = yd - (p1 * (r2 + two * y * y) + p2 * xy)
        x, y = _times_radial(inverse.radial, u, v)
    return np.stack([x, y], axis=-1)


def _times_radial(radial: Sequence[float], x: AnyArray, y: AnyArray) -> tuple[AnyArray, AnyArray]:
    rho = x * x + y * y
    P = np.zeros_like(rho)
    for coefficient in (*reversed(radial), 1.0):
        P = P * rho + rho.dtype.type(coefficient)
    return x * P, y * P


def fit_inverse(camera: Camera) -> InverseLens:
    """The shortest inverse polynomial within 0.01 px of the exact inverse, else the best found.

    Where the lens model folds over inside the picture, or bends more than ten
    coefficients can follow, the tolerance is not reached and `max_error_px` says by how much: the largest
    distance from the exact inverse over the share of the picture that is `covered`, in undistorted pixels,
    computed in single precision as a microcontroller does. It is None where nothing is.
    """
    width, height = camera.image_size_px
    pixels = pixel_grid(camera.image_size_px, (-0.5, -0.5, width - 0.5, height - 0.5)).reshape(-1, 2)
    ideal = undistort(camera, pixels)
    steepest = _STEEPEST if camera.fisheye else np.inf
    seen = np.isfinite(ideal).all(axis=1) & (np.hypot(*ideal.T) < steepest)
    covered, least = float(np.mean(seen)), np.inf
    best = InverseLens(radial=[], decentering_steps=0, max_error_px=None, covered=covered)
    if not seen.any():
        return best
    ideal = ideal[seen]
    distorted = distorted_normalised(camera, pixels[seen].astype(np.float32))

    def checked(radial: list[float], steps: int) -> tuple[InverseLens, float]:
        trial = best.model_copy(update={"radial": radial, "decentering_steps": steps})
        off = (undistort_by_polynomial(camera, trial, distorted) - ideal) @ camera.K[:2, :2].T
        error = float(np.sqrt(np.max(np.sum(off**2, axis=1))))
        return trial.model_copy(update={"max_error_px": finite_or_none(error)}), error

    most = _MOST_STEPS if np.any(camera.distortion[2:4]) else 0
    largest = float(np.sqrt(np.max(np.sum(ideal**2, axis=1))))
    with np.errstate(over="ignore", invalid="ignore"):
        for count in range(_MOST_COEFFICIENTS + 1):
            trial, error = checked(_minimax(camera, largest, count), most)
            if error < least:
                best, least = trial, error
            if least <= _INVERSE_TOLERANCE_PX:
                break
        # Fewer steps where they do, and never more than help.
        for steps in range(most):
            trial, error = checked(best.radial, steps)
            if error <= max(_INVERSE_TOLERANCE_PX, 1.02 * least):
                return trial
    return best


def _minimax(camera: Camera, largest: float, count: int) -> list[float]:
    """The c1, c2, ... with nearly the least largest error over undistorted radii up to `largest`."""
    r = np.linspace(0.0, largest, 40 * (count + 5))[1:]
    w = radial_curve(camera, r)
    if count == 0 or np.array_equal(r, w):
        return []
    rho = w * w
    top = float(rho.max())
    powers = (rho[:, None] / top) ** np.arange(1, count + 1) * w[:, None]
    unit = 1.0 / np.sqrt(np.sum(powers**2, axis=0))
    weight = np.full(len(r), 1.0 / len(r))
    best, least = np.zeros(count), np.inf
    for _ in range(_REWEIGHTINGS):
        root = np.sqrt(weight)
        solution = unit * np.linalg.lstsq(powers * unit * root[:, None], (r - w) * root, rcond=None)[0]
        error = np.abs(powers @ solution - (r - w))
        if error.max() < least:
            best, least = solution, float(error.max())
        if least < 1e-12:
            break
        weight = weight * error
        weight = weight / weight.sum()
    return [float(c) for c in best / top ** np.arange(1.0, count + 1)]


# ----------------------------------------------------------------------
# What lens distortion does to the picture, and what neglecting it costs.
#
# The displacement at the pixel mu of the undistorted picture is mu_distorted - mu with (B.1): where the
# lens puts what an ideal lens would put at mu. Its length is the map of Fig. B.2.
#
# The kinds are named as photographers do. The printed text has them the wrong way round: k1 > 0
# magnifies more towards the border and is pincushion, k1 < 0 is barrel.

_TURN_PX = 0.01
"""A turn of the radial curve smaller than this is not seen as a change of direction."""

Region = tuple[float, float, float, float]
"""A box (u0, v0, u1, v1) in pixels, borders included."""


@dataclass(frozen=True)
class PlaneView:
    """The actuator's plane as far as distortion is concerned.

    Attributes
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    workspace_m : box (x0, y0, x1, y1) where the marker can be.
    sigma_mm : standard deviation of a position that the calibration alone leaves open, at worst over
        the workspace; None where it is not known.
    """

    R_CW: FloatArray
    t_CW_m: FloatArray
    workspace_m: tuple[float, float, float, float]
    sigma_mm: float | None = None


def radial_curve(camera: Camera, r: FloatArray) -> FloatArray:
    """Distorted of undistorted normalised radii, any shape, the radial part of the model alone."""
    radial = camera.distortion.copy()
    radial[2:4] = 0.0
    return distort(r, np.zeros_like(r), radial, camera.fisheye)[0]


def displacement_field(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Displacement mu_distorted - mu (..., 2) at pixels (..., 2) of the undistorted picture (B.1), pixels."""
    x, y = np.moveaxis(distorted_normalised(camera, pixels), -1, 0)
    xd, yd = distort(x, y, camera.distortion, camera.fisheye)
    return np.asarray(np.stack([xd - x, yd - y], axis=-1) @ camera.K[:2, :2].T)


def central_region(image_size_px: tuple[int, int]) -> Region:
    """The source document's region of interest, the central 160x120 of 316x208 pixels, to scale."""
    size = np.array(image_size_px)
    count = np.maximum(1.0, np.round(size * (160 / 316, 120 / 208)))
    u0, v0 = ((size - count) // 2).tolist()
    return u0, v0, u0 + float(count[0]) - 1.0, v0 + float(count[1]) - 1.0


def distortion_kind(camera: Camera) -> str:
    """Name of the distortion: none, barrel, pincushion, mustache, or decentering.

    With k1 and k2 alone the signs decide, as in the source document (errata B.1): both positive is
    pincushion, both negative barrel, different signs mustache, whether or not the curve turns within
    this picture. With more coefficients the radial curve decides over the radii of this picture:
    magnification that rises outwards is pincushion, that falls is barrel, and that turns by more than
    a hundredth of a pixel is mustache. Decentering alone has no radial curve.
    """
    k1, k2, p1, p2, *more = camera.distortion
    if camera.ideal:
        return "none"
    if camera.fisheye:
        more = [1.0]
    if not (k1 or k2 or any(more)):
        return "decentering"
    if not (p1 or p2 or any(more)):
        if k1 * k2 < 0:
            return "mustache"
        return "pincushion" if k1 + k2 > 0 else "barrel"
    # A pole itself has no value.
    r = np.linspace(0.0, min(corner_radius(camera), 0.999 * fold_radius(camera)[0]), 500)[1:]
    steps = np.diff(radial_curve(camera, r) / r)
    rise, fall = float(steps[steps > 0].sum()), float(-steps[steps < 0].sum())
    seen_px = r[-1] * focal_px(camera)
    if max(rise, fall) * seen_px < 1e-9:
        # The numerator and the denominator of the rational model cancel.
        return "decentering" if p1 or p2 else "none"
    if min(rise, fall) * seen_px > _TURN_PX:
        return "mustache"
    return "pincushion" if rise > fall else "barrel"


def projection_sigma_px(camera: Camera, covariance: FloatArray, pixels: FloatArray) -> FloatArray:
    """Standard deviation (N,) of where a far point is projected, root mean square of the two axes.

    An error of the intrinsics that a small rotation of the camera would make good is no error: every
    use of a camera first finds how it stands. The rotation that fits best over the picture is taken
    off before the covariance is propagated (mrcal's implied transformation, rotation only).

    Parameters
    ----------
    covariance : (13, 13) in the order of `projection.INTRINSICS`.
    pixels : (N, 2) of the undistorted picture.
    """

    def derivatives(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        rays = np.column_stack([distorted_normalised(camera, at), np.ones(len(at))])
        _, by_point, by_camera = projection_with_derivatives(camera, rays)
        return np.cross(rays[:, None, :], by_point), by_camera

    by_turn, by_camera = derivatives(pixel_grid(camera.image_size_px, most=400).reshape(-1, 2))
    turn = np.linalg.lstsq(by_turn.reshape(-1, 3), by_camera.reshape(-1, 13), rcond=None)[0]
    by_turn, by_camera = derivatives(pixels)
    left = by_camera - by_turn @ turn
    variance = np.einsum("nik,kl,nil->n", left, covariance, left)
    return np.asarray(np.sqrt(np.maximum(0.5 * variance, 0.0)))


def far_difference_px(before: Camera, after: Camera, pixels: FloatArray) -> FloatArray:
    """Where `after` shows far points that `before` shows at these pixels, less the pixels, (N, 2).

    The rotation between both that fits best over the picture is taken off, as in `projection_sigma_px`; it
    is found by Gauss-Newton steps. NaN where one of the lenses shows nothing.

    Parameters
    ----------
    pixels : (N, 2), distorted.
    """
    grid = pixel_grid(before.image_size_px, most=400).reshape(-1, 2)
    toward, R = rays(before, grid), np.eye(3)
    for _ in range(_ROTATION_STEPS):
        shown, by_point, _ = projection_with_derivatives(after, toward @ R.T)
        known = np.isfinite(shown).all(axis=1) & np.isfinite(by_point).all(axis=(1, 2))
        if known.sum() < 3:
            return np.full(pixels.shape, np.nan)
        # R (I + [w]) d: the point moves by w x d.
        by_turn = np.cross((toward @ R.T)[known, None, :], by_point[known])
        turn = np.linalg.lstsq(by_turn.reshape(-1, 3), (grid - shown)[known].ravel(), rcond=None)[0]
        R = rotation_exp(np.asarray(turn, dtype=np.float64)[None])[0] @ R
    return project(after, rays(before, pixels) @ R.T) - pixels


def analyse_distortion(
    camera: Camera,
    camera_covariance: FloatArray | None = None,
    *,
    plane: PlaneView | None = None,
    region_px: Region | None = None,
) -> Lens:
    """The section of a camera's distortion, its evidence the camera: displacement, kind, cost and inverse.

    Distortion is called negligible only where neglecting it costs less than the calibration's own
    standard deviation: on the plane in mm if the plane and its sigma are known, else at every pixel of
    the region. Where no sigma is known it matters.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, or None.
    region_px : region of interest; by default the box around the plane's workspace in the picture,
        without a plane `central_region`.

    Raises
    ------
    BadInputError
        When `region_px` is empty or not inside the picture.
    """
    width, height = camera.image_size_px
    cost, around = ({}, None) if plane is None else _on_plane(camera, plane)
    region = region_px or around or central_region(camera.image_size_px)
    if not (0 <= region[0] <= region[2] <= width - 1 and 0 <= region[1] <= region[3] <= height - 1):
        raise BadInputError(
            f"the region {list(region)} is not a box [u0, v0, u1, v1] inside the picture of {width}x{height} "
            "px"
        )
    everywhere, at = (_once(camera, pixel_grid(camera.image_size_px, box)) for box in (None, region))
    whole, inside = (
        np.linalg.norm(displacement_field(camera, pixels), axis=1) for pixels in (everywhere, at)
    )
    sigma = None
    if camera_covariance is not None and np.all(np.isfinite(camera_covariance)):
        sigma = projection_sigma_px(camera, camera_covariance, at)
    effect, why = _judge(inside, sigma, plane, cost)
    return Lens(
        kind=distortion_kind(camera),
        max_px=float(whole.max()),
        mean_px=float(whole.mean()),
        region_px=[float(value) for value in region],
        region_max_px=float(inside.max()),
        region_mean_px=float(inside.mean()),
        monotonic=one_to_one_reach(camera) > 1.0,
        region_sigma_px=None if sigma is None else float(sigma.min()),
        **cost,
        inverse=fit_inverse(camera),
        effect=effect,
        verdict="ok",
        remarks=[why],
    ).with_evidence(camera)


def shown_once(camera: Camera, pixels: FloatArray) -> BoolArray:
    """Which ideal pixels (..., 2) the lens model shows once only, and not far outside of the picture."""
    x, y = np.moveaxis(distorted_normalised(camera, pixels), -1, 0)
    once = np.hypot(x, y) < fold_radius(camera)[0]
    # Next to a pole displacements have no bound.
    x, y = np.where(once, x, 0.0), np.where(once, y, 0.0)
    xd, yd = distort(x, y, camera.distortion, camera.fisheye)
    return np.asarray(once & (np.hypot(xd, yd) < 2.0 * corner_radius(camera)))


def _once(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Those of ideal pixels (rows, columns, 2) that are shown once, (n, 2); all where none is."""
    kept = shown_once(camera, pixels)
    return pixels[kept] if kept.any() else pixels.reshape(-1, 2)


def _on_plane(camera: Camera, plane: PlaneView) -> tuple[dict[str, Any], Region | None]:
    """Cost over the workspace by the section's keys, and the box around it in the picture."""
    points = box_grid(plane.workspace_m, 21, 21).reshape(-1, 2)
    points = points[visible(camera, plane.R_CW, plane.t_CW_m, points)]
    if len(points) < 4 or np.linalg.matrix_rank(points - points.mean(axis=0)) < 2:
        return {}, None
    pixels = plane_pixels(camera, plane.R_CW, plane.t_CW_m, points)
    error_mm, refitted_mm = (
        1e3 * np.linalg.norm(apply_homography(np.asarray(np.linalg.inv(H)), pixels) - points, axis=1)
        for H in (
            camera.K @ np.column_stack([plane.R_CW[:, :2], plane.t_CW_m]),
            fit_homography(points, pixels).H,
        )
    )
    size = np.array(camera.image_size_px) - 1.0
    u0, v0 = np.maximum(pixels.min(axis=0), 0.0)
    u1, v1 = np.minimum(pixels.max(axis=0), size)
    cost = {
        "plane_max_mm": float(error_mm.max()),
        "plane_mean_mm": float(error_mm.mean()),
        "refitted_max_mm": float(refitted_mm.max()),
        "refitted_mean_mm": float(refitted_mm.mean()),
    }
    return cost, (float(u0), float(v0), float(u1), float(v1))


def _judge(
    inside: FloatArray, sigma: FloatArray | None, plane: PlaneView | None, cost: Mapping[str, float]
) -> tuple[Literal["negligible", "matters"], str]:
    if inside.max() == 0.0:
        return (
            "negligible",
            "the camera's model has no distortion; whether the lens has none shows in the residuals",
        )
    if cost and plane is not None and plane.sigma_mm is not None:
        small = cost["plane_max_mm"] < plane.sigma_mm
        reason = (
            f"neglecting the lens costs up to {cost['plane_max_mm']:.3f} mm on the plane, "
            f"{'less' if small else 'not less'} than the calibration's own sigma of {plane.sigma_mm:.3f} mm"
        )
    elif sigma is not None:
        small = bool(np.all(inside < sigma))
        worst = int(np.argmax(inside / np.maximum(sigma, 1e-12)))
        reason = (
            f"the displacement is {inside[worst]:.3f} px in the region where the calibration's own sigma is "
            f"{sigma[worst]:.3f} px"
        )
    else:
        return (
            "matters",
            f"the displacement reaches {inside.max():.2f} px in the region and no sigma is known to hold it "
            "against",
        )
    return ("negligible" if small else "matters"), reason


# ----------------------------------------------------------------------
# What figures show of a lens.


def ideal_pixels(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Where a lens without distortion shows what is seen at pixels (n, 2)."""
    ideal = undistort(camera, pixels)
    return np.asarray(np.column_stack([ideal, np.ones(len(ideal))]) @ camera.K[:2].T)


def radial_displacement(camera: Camera, radius_px: FloatArray) -> FloatArray:
    """Displacement along the radius at ideal radii, the radial part of the model alone, pixels."""
    r = radius_px / focal_px(camera)
    return np.asarray(focal_px(camera) * (radial_curve(camera, r) - r))


def radial_sigma(camera: Camera, covariance: Covariance, radius_px: FloatArray) -> FloatArray:
    """Standard deviation of `radial_displacement` to first order, infinite where views do not bound it."""
    if not np.all(np.isfinite(covariance.intrinsics)):
        return np.full(len(radius_px), np.inf)
    vector = vector_from_camera(camera)

    def displacement(step: FloatArray) -> FloatArray:
        moved = camera_from_vector(camera.model, camera.image_size_px, vector + step)
        return radial_displacement(moved, radius_px)

    rows = []
    for name, sigma in covariance.sigma().items():
        step = np.zeros(len(vector))
        step[INTRINSICS.index(name)] = 1e-4 * sigma or 1e-9
        rows.append((displacement(step) - displacement(-step)) / (2.0 * step.sum()))
    J = np.array(rows).reshape(-1, len(radius_px))
    variance = np.einsum("pr,pq,qr->r", J, covariance.intrinsics, J)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
