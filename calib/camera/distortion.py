"""What lens distortion does to the picture, and what neglecting it costs.

The displacement at the pixel mu of the undistorted picture is mu_distorted - mu with (B.1): where the
lens puts what an ideal lens would put at mu. Its length is the map of Fig. B.2.

The kinds are named as photographers do. The printed text has them the wrong way round: k1 > 0
magnifies more towards the border and is pincushion, k1 < 0 is barrel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.homography import apply_homography, fit_homography
from calib.camera.model import Camera, distort, project
from calib.camera.plane_sigma import visible, workspace_grid
from calib.camera.pose import projection_with_derivatives
from calib.camera.undistortion import InversePolynomial, fit_inverse, fold_radius, pixel_grid
from calib.errors import BadInputError

__all__ = [
    "DistortionReport",
    "PlaneCost",
    "PlaneView",
    "Region",
    "analyse_distortion",
    "central_region",
    "displacement_field",
    "distortion_kind",
    "projection_sigma_px",
]

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


@dataclass(frozen=True)
class PlaneCost:
    """Errors of positions over the workspace when the lens is taken for ideal.

    Attributes
    ----------
    max_mm, mean_mm : with the plane calibrated with the lens and read without it.
    refitted_max_mm, refitted_mean_mm : with a homography fitted to the distorted pixels of the
        workspace, the best that any map without a lens can do there.
    """

    max_mm: float
    mean_mm: float
    refitted_max_mm: float
    refitted_mean_mm: float


@dataclass(frozen=True)
class DistortionReport:
    """What distortion does and costs.

    Attributes
    ----------
    kind : see `distortion_kind`.
    max_px, mean_px : length of the displacement over the whole picture.
    region_px : box that `region_*` are taken over.
    region_max_px, region_mean_px : the same over the region of interest.
    monotonic : whether the radial curve rises throughout the picture.
    fold_px, corner_px : distance from the principal point at which the radial curve stops rising
        (infinite if never), and of the corner farthest from it; distorted, of the mean focal length.
    region_sigma_px : standard deviation of projection over the region at its least, from the
        covariance of the intrinsics; None where that is not known.
    plane : cost on the plane, None where no plane is known or none of it is seen.
    inverse : polynomial that undoes the distortion.
    verdict, reasons : "negligible" or "matters", and why.
    """

    kind: str
    max_px: float
    mean_px: float
    region_px: Region
    region_max_px: float
    region_mean_px: float
    monotonic: bool
    fold_px: float
    corner_px: float
    region_sigma_px: float | None
    plane: PlaneCost | None
    inverse: InversePolynomial
    verdict: str
    reasons: tuple[str, ...]


def displacement_field(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Displacement mu_distorted - mu (..., 2) in pixels at pixels (..., 2) of the undistorted picture "
    "(B.1)."""
    y = (pixels[..., 1] - camera.cy_px) / camera.fy_px
    x = (pixels[..., 0] - camera.cx_px - camera.skew_px * y) / camera.fx_px
    xd, yd = distort(x, y, camera.distortion)
    return np.asarray(np.stack([xd - x, yd - y], axis=-1) @ camera.K[:2, :2].T)


def central_region(image_size_px: tuple[int, int]) -> Region:
    """The source document's region of interest, the central 160x120 of 316x208 pixels, to scale."""
    box = []
    for size, part in zip(image_size_px, (160 / 316, 120 / 208), strict=True):
        count = max(1, round(size * part))
        first = (size - count) // 2
        box.append((float(first), float(first + count - 1)))
    (u0, u1), (v0, v1) = box
    return u0, v0, u1, v1


def distortion_kind(camera: Camera) -> str:
    """Name of the distortion: none, barrel, pincushion, mustache, or decentering.

    With k1 and k2 alone the signs decide, as in the source document (errata B.1): both positive is
    pincushion, both negative barrel, different signs mustache, whether or not the curve turns within
    this picture. With more coefficients the radial curve decides over the radii of this picture:
    magnification that rises outwards is pincushion, that falls is barrel, and that turns by more than
    a hundredth of a pixel is mustache. Decentering alone has no radial curve.
    """
    k1, k2, p1, p2, *more = camera.distortion
    if not np.any(camera.distortion):
        return "none"
    if not (k1 or k2 or any(more)):
        return "decentering"
    if not (p1 or p2 or any(more)):
        if k1 * k2 < 0:
            return "mustache"
        return "pincushion" if k1 + k2 > 0 else "barrel"
    r = np.linspace(0.0, min(_corner_radius(camera), fold_radius(camera)[0]), 500)[1:]
    radial = camera.distortion.copy()
    radial[2:4] = 0.0
    steps = np.diff(distort(r, np.zeros_like(r), radial)[0] / r)
    rise, fall = float(steps[steps > 0].sum()), float(-steps[steps < 0].sum())
    seen_px = r[-1] * _focal(camera)
    if max(rise, fall) * seen_px < 1e-9:
        # The numerator and the denominator of the rational model cancel.
        return "decentering" if p1 or p2 else "none"
    if min(rise, fall) * seen_px > _TURN_PX:
        return "mustache"
    return "pincushion" if rise > fall else "barrel"


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.fx_px * camera.fy_px))


def _corner_radius(camera: Camera) -> float:
    """Largest normalised radius of the picture's corners."""
    width, height = camera.image_size_px
    v = np.array([0.0, 0.0, height - 1.0, height - 1.0])
    u = np.array([0.0, width - 1.0, 0.0, width - 1.0])
    y = (v - camera.cy_px) / camera.fy_px
    x = (u - camera.cx_px - camera.skew_px * y) / camera.fx_px
    return float(np.hypot(x, y).max())


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
        y = (at[:, 1] - camera.cy_px) / camera.fy_px
        x = (at[:, 0] - camera.cx_px - camera.skew_px * y) / camera.fx_px
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        _, by_point, by_camera = projection_with_derivatives(camera, rays)
        return np.cross(rays[:, None, :], by_point), by_camera

    by_turn, by_camera = derivatives(pixel_grid(camera.image_size_px, most=400).reshape(-1, 2))
    turn = np.linalg.lstsq(by_turn.reshape(-1, 3), by_camera.reshape(-1, 13), rcond=None)[0]
    by_turn, by_camera = derivatives(pixels)
    left = by_camera - by_turn @ turn
    variance = np.einsum("nik,kl,nil->n", left, covariance, left)
    return np.asarray(np.sqrt(np.maximum(0.5 * variance, 0.0)))


def analyse_distortion(
    camera: Camera,
    camera_covariance: FloatArray | None = None,
    *,
    plane: PlaneView | None = None,
    region_px: Region | None = None,
    tolerance_px: float = 0.01,
) -> DistortionReport:
    """Displacement, kind, cost and inverse of a camera's distortion.

    Distortion is called negligible only where neglecting it costs less than the calibration's own
    standard deviation: on the plane in mm if the plane and its sigma are known, else at every pixel of
    the region. Where no sigma is known it matters.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, or None.
    region_px : region of interest; by default the box around the plane's workspace in the picture,
        without a plane `central_region`.
    tolerance_px : of the inverse polynomial.

    Raises
    ------
    BadInputError
        When `region_px` is empty or not inside the picture.
    """
    width, height = camera.image_size_px
    cost, around = (None, None) if plane is None else _on_plane(camera, plane)
    region = region_px or around or central_region(camera.image_size_px)
    if not (0 <= region[0] <= region[2] <= width - 1 and 0 <= region[1] <= region[3] <= height - 1):
        raise BadInputError(
            f"the region {list(region)} is not a box [u0, v0, u1, v1] inside the picture of {width}x{height} "
            "px"
        )
    whole = np.linalg.norm(displacement_field(camera, pixel_grid(camera.image_size_px)), axis=-1)
    at = pixel_grid(camera.image_size_px, region).reshape(-1, 2)
    inside = np.linalg.norm(displacement_field(camera, at), axis=1)
    sigma = None
    if camera_covariance is not None and np.all(np.isfinite(camera_covariance)):
        sigma = projection_sigma_px(camera, camera_covariance, at)
    _, fold = fold_radius(camera)
    corner = _corner_radius(camera)
    verdict, reasons = _judge(inside, sigma, plane, cost)
    return DistortionReport(
        kind=distortion_kind(camera),
        max_px=float(whole.max()),
        mean_px=float(whole.mean()),
        region_px=region,
        region_max_px=float(inside.max()),
        region_mean_px=float(inside.mean()),
        monotonic=corner < fold,
        fold_px=fold * _focal(camera),
        corner_px=corner * _focal(camera),
        region_sigma_px=None if sigma is None else float(sigma.min()),
        plane=cost,
        inverse=fit_inverse(camera, tolerance_px),
        verdict=verdict,
        reasons=reasons,
    )


def _on_plane(camera: Camera, plane: PlaneView) -> tuple[PlaneCost | None, Region | None]:
    """Cost over the workspace, and the box around it in the picture."""
    points = workspace_grid(plane.workspace_m, 21)
    points = points[visible(camera, plane.R_CW, plane.t_CW_m, points)]
    if len(points) < 4 or np.linalg.matrix_rank(points - points.mean(axis=0)) < 2:
        return None, None
    H = np.column_stack([plane.R_CW[:, :2], plane.t_CW_m])
    pixels = project(camera, np.column_stack([points, np.ones(len(points))]) @ H.T)
    unaware = apply_homography(np.asarray(np.linalg.inv(camera.K @ H), dtype=np.float64), pixels)
    error_mm = 1e3 * np.linalg.norm(unaware - points, axis=1)
    fitted = fit_homography(points, pixels).H
    refitted = apply_homography(np.asarray(np.linalg.inv(fitted), dtype=np.float64), pixels)
    refitted_mm = 1e3 * np.linalg.norm(refitted - points, axis=1)
    size = np.array(camera.image_size_px) - 1.0
    u0, v0 = np.maximum(pixels.min(axis=0), 0.0)
    u1, v1 = np.minimum(pixels.max(axis=0), size)
    cost = PlaneCost(
        float(error_mm.max()), float(error_mm.mean()), float(refitted_mm.max()), float(refitted_mm.mean())
    )
    return cost, (float(u0), float(v0), float(u1), float(v1))


def _judge(
    inside: FloatArray, sigma: FloatArray | None, plane: PlaneView | None, cost: PlaneCost | None
) -> tuple[str, tuple[str, ...]]:
    if inside.max() == 0.0:
        return "negligible", (
            "the camera's model has no distortion; whether the lens has none shows in the residuals",
        )
    if cost is not None and plane is not None and plane.sigma_mm is not None:
        small = cost.max_mm < plane.sigma_mm
        reason = (
            f"neglecting the lens costs up to {cost.max_mm:.3f} mm on the plane, "
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
        return "matters", (
            f"the displacement reaches {inside.max():.2f} px in the region and no sigma is known to hold it "
            "against",
        )
    return ("negligible" if small else "matters"), (reason,)
