"""The actuator's plane: from pixels to millimetres and back, and how far to trust it.

With the camera K and the pose R, t of the world in the camera's frame the plane Z = 0 is seen by

    s (u, v, 1) = A (X, Y, 1),   A = K [R1 R2 t]                                        (2.9)
    (X, Y, 1) = s A^-1 (u, v, 1),   1 / s = A^-1_31 u + A^-1_32 v + A^-1_33             (2.11, 2.12)

where (u, v) are pixels freed of lens distortion. The printed (2.9) lacks the K; with it (2.11) and
(2.12) are exact. A keeps its metric scale, so s is the depth in metres.

A plane comes with a verdict: "ok"; "poor" where something is wrong enough to look into;
"unidentifiable" where the pictures do not hold the answer; "inconsistent" where they contradict each
other because the camera or the board moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.homography import Homography, apply_homography, fit_homography
from calib.camera.model import Camera, project, undistort
from calib.camera.plane_checks import PictureFit, compare_pictures, judge, refuse_unusable
from calib.camera.plane_sigma import PositionSigma, position_sigma, visible, workspace_grid
from calib.camera.pose import Pose, fit_pose, plane_map
from calib.camera.views import View

__all__ = [
    "Plane",
    "calibrate_plane",
    "plane_scale",
    "to_pixels",
    "to_world",
    "to_world_without_undistortion",
]


@dataclass(frozen=True)
class Plane:
    """A calibrated plane.

    Attributes
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    A : (3, 3), homography (2.9) from metres to ideal pixels; s is the depth in metres.
    covariance : (6, 6) of (rotation vector on the left, t) from the noise of the corners, rad and m.
    rms_px, mean_error_px : reprojection error over all corners.
    rms_mm, mean_error_mm : distance on the plane between where corners are and where they are read.
    sigma_px : standard deviation of one pixel coordinate, from the residuals.
    points : corners used, over all pictures.
    pictures : fit of each picture.
    corners_m, corners_px, residuals_px : (M, 2) of all pictures in turn: places on the plane, where the
        pictures show them, and projected minus measured.
    workspace_m : box (x0, y0, x1, y1) over which the uncertainty is reported.
    sigma : standard deviations of a marker's position over the workspace.
    direct : homography from metres to distorted pixels, fitted without intrinsics.
    direct_difference_mm : (N,) distance between the two maps at `sigma.points_m`.
    verdict, reasons : "ok", "poor", "unidentifiable" or "inconsistent", and why it is not ok.
    notes : remarks that do not lower the verdict.
    """

    R_CW: FloatArray
    t_CW_m: FloatArray
    A: FloatArray
    covariance: FloatArray
    rms_px: float
    mean_error_px: float
    rms_mm: float
    mean_error_mm: float
    sigma_px: float
    points: int
    pictures: tuple[PictureFit, ...]
    corners_m: FloatArray
    corners_px: FloatArray
    residuals_px: FloatArray
    workspace_m: tuple[float, float, float, float]
    sigma: PositionSigma
    direct: Homography
    direct_difference_mm: FloatArray
    verdict: str
    reasons: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def A_inverse(self) -> FloatArray:
        """A^-1 of (2.11), (3, 3), ideal pixels to metres."""
        return np.asarray(np.linalg.inv(self.A), dtype=np.float64)


def plane_scale(plane: Plane, ideal_pixels: FloatArray) -> FloatArray:
    """The scale s of (2.12), depth in metres, for undistorted pixels (..., 2); NaN beyond the horizon."""
    last = plane.A_inverse[2]
    denominator = ideal_pixels @ last[:2] + last[2]
    return np.asarray(1.0 / np.where(denominator > 0.0, denominator, np.nan))


def to_world_without_undistortion(plane: Plane, pixels: FloatArray) -> FloatArray:
    """World positions (..., 2) in metres by (2.11) and (2.12) alone, as if the lens were ideal."""
    inverse = plane.A_inverse
    mapped = pixels @ inverse[:2, :2].T + inverse[:2, 2]
    return np.asarray(plane_scale(plane, pixels)[..., None] * mapped)


def to_world(plane: Plane, camera: Camera, pixels: FloatArray) -> FloatArray:
    """World positions (..., 2) in metres of distorted pixels (..., 2): undistort, then (2.11), (2.12).

    NaN beyond the plane's horizon and where the lens model shows no such pixel.
    """
    x, y = np.moveaxis(undistort(camera, pixels), -1, 0)
    u = camera.fx_px * x + camera.skew_px * y + camera.cx_px
    v = camera.fy_px * y + camera.cy_px
    return to_world_without_undistortion(plane, np.stack([u, v], axis=-1))


def to_pixels(plane: Plane, camera: Camera, world_m: FloatArray) -> FloatArray:
    """Distorted pixels (..., 2) of world positions (..., 2), NaN behind the camera."""
    points_C = world_m @ plane.R_CW[:, :2].T + plane.t_CW_m
    front = points_C[..., 2] > 0.0
    points_C = np.where(front[..., None], points_C, 1.0)
    return np.where(front[..., None], project(camera, points_C), np.nan)


def calibrate_plane(
    camera: Camera,
    camera_covariance: FloatArray | None,
    views: Sequence[View],
    *,
    workspace_m: tuple[float, float, float, float] | None = None,
    camera_rms_px: float | None = None,
) -> Plane:
    """Fit one pose of the world's plane to all pictures of it, taken by a camera that stands still.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, zero rows for what was not
        estimated; None where it is not known.
    views : pictures with `target_m` in the world's plane, see `placement.world_points_m`.
    workspace_m : box (x0, y0, x1, y1) over which the uncertainty is reported; by default the box
        around the corners, which the source document takes for the marker's range.
    camera_rms_px : RMS of the camera's own calibration, to compare this one with.

    Raises
    ------
    BadInputError
        With fewer than four different points, points on a line, numbers that are not finite, or a
        mirrored plane.
    """
    refuse_unusable(views)
    world_m = np.concatenate([view.target_m for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    groups = _same_points(world_m)
    pose = fit_pose(camera, world_m, pixels, groups)
    pictures, comparison = compare_pictures(camera, views, pose)
    pose = replace(pose, covariance=pose.covariance * comparison.inflation)

    box = workspace_m
    if box is None:
        low, high = world_m.min(axis=0), world_m.max(axis=0)
        box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    sigma = position_sigma(camera, camera_covariance, pose, workspace_grid(box))
    direct = fit_homography(world_m, pixels, groups)
    verdict, reasons, notes = judge(camera, views, pose, comparison, sigma, box, camera_rms_px)

    error_px = np.linalg.norm(pose.residuals_px, axis=1)
    read_m = plane_map(camera, pose.R_CW, pose.t_CW_m, pixels)
    error_mm = 1e3 * np.linalg.norm(read_m - world_m, axis=1)
    error_mm = error_mm[np.isfinite(error_mm)]
    return Plane(
        R_CW=pose.R_CW,
        t_CW_m=pose.t_CW_m,
        A=camera.K @ np.column_stack([pose.R_CW[:, :2], pose.t_CW_m]),
        covariance=pose.covariance,
        rms_px=float(np.sqrt(np.mean(error_px**2))),
        mean_error_px=float(np.mean(error_px)),
        rms_mm=float(np.sqrt(np.mean(error_mm**2))),
        mean_error_mm=float(np.mean(error_mm)),
        sigma_px=pose.sigma_px,
        points=len(world_m),
        pictures=pictures,
        corners_m=world_m,
        corners_px=pixels,
        residuals_px=pose.residuals_px,
        workspace_m=box,
        sigma=sigma,
        direct=direct,
        direct_difference_mm=_difference_mm(camera, pose, direct, sigma.points_m),
        verdict=verdict,
        reasons=reasons,
        notes=notes,
    )


def _same_points(world_m: FloatArray) -> IntArray:
    """Index of the different world points (to a nanometre) that each row belongs to."""
    keys = np.round(world_m * 1e9).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def _difference_mm(camera: Camera, pose: Pose, direct: Homography, points_m: FloatArray) -> FloatArray:
    """How far apart the two maps put the marker that is at each of the places, (N,); NaN out of sight."""
    difference = np.full(len(points_m), np.nan)
    seen = visible(camera, pose.R_CW, pose.t_CW_m, points_m)
    pixels = project(camera, points_m[seen] @ pose.R_CW[:, :2].T + pose.t_CW_m)
    other = apply_homography(np.asarray(np.linalg.inv(direct.H), dtype=np.float64), pixels)
    difference[seen] = 1e3 * np.linalg.norm(other - points_m[seen], axis=1)
    return difference
