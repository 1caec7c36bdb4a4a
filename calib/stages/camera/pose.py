"""Pose of a plane in front of a known camera, and how it hangs on the camera's parameters.

A point X of the plane is at p = R X + t in the camera's frame and is seen at pixel g(c, p), with the
intrinsics c as in `calib.stages.camera.model`. The pose minimises |r|^2 with r = g - pixels, by
`bundle.minimise` over a rotation vector w, R = exp(w) R0, and t. With J = dg/d(w, t) and C = dg/dc, J^T r = 0
at the minimum whatever c is, hence by the implicit function theorem, with the curvature of g times the
residual neglected (Gauss-Newton),

    d(w, t)/dc = -(J^T J)^-1 J^T C

A plane seen with little perspective fits nearly as well when tilted the other way. Both are tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography, box_grid, fit_homography, grouped_variance, in_picture
from calib.stages.camera.bundle import linearise, minimise
from calib.stages.camera.model import (
    INTRINSICS,
    Block,
    Camera,
    Observations,
    point_derivatives,
    project,
    undistort,
)

_EVERY_INTRINSIC = np.arange(len(INTRINSICS))
_TOLERANCE = 1e-9
"""Newton decrement that ends the search, in standard deviations."""


@dataclass(frozen=True)
class Pose:
    """A fitted pose of the plane.

    Attributes
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    residuals_px : (M, 2), projected minus measured.
    covariance : (6, 6) of (w, t) from the noise of the pixels; rad and metres.
    by_intrinsics : (6, 13), d(w, t)/dc with c in the order of `projection.INTRINSICS`.
    sigma_px : standard deviation of one pixel coordinate, from the residuals.
    termination : as `Calibration.termination`.
    other : squared residuals (px^2) of the plane tilted the other way, with its R and t; None where
        that leads to the same pose.
    """

    R_CW: FloatArray
    t_CW_m: FloatArray
    residuals_px: FloatArray
    covariance: FloatArray
    by_intrinsics: FloatArray
    sigma_px: float
    termination: str
    other: tuple[float, FloatArray, FloatArray] | None

    @property
    def cost_px2(self) -> float:
        """Sum of squared residuals."""
        return float(np.sum(self.residuals_px**2))

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals."""
        return float(np.sqrt(self.cost_px2 / len(self.residuals_px)))


def projection_with_derivatives(
    camera: Camera, points_C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of points in the camera's frame, with their derivatives.

    Parameters
    ----------
    points_C : (M, 3) with positive Z; a fisheye lens takes any.

    Returns
    -------
    Pixels (M, 2), derivatives by the point (M, 2, 3), and by the intrinsics (M, 2, 13) in the order
    of `model.INTRINSICS`; all NaN where a point is behind the camera.
    """
    by = point_derivatives(camera, points_C, _EVERY_INTRINSIC)
    return by[..., -1], by[..., -4:-1], by[..., : len(INTRINSICS)]


def pose_derivatives(
    camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, world_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives of the pixels of world points (M, 2), by world point, pose and intrinsics.

    Shapes: (M, 2, 2), (M, 2, 6), (M, 2, 13).
    """
    rotated = world_m @ R_CW[:, :2].T
    _, by_point, by_camera = projection_with_derivatives(camera, rotated + t_CW_m)
    # a . (w x q) = w . (q x a): row by row of by_point.
    by_w = np.cross(rotated[:, None, :], by_point)
    return by_point @ R_CW[:, :2], np.concatenate([by_w, by_point], axis=2), by_camera


def fit_pose(camera: Camera, world_m: FloatArray, pixels: FloatArray, groups: IntArray | None = None) -> Pose:
    """Pose of the world's plane Z = 0 that minimises the reprojection error of all points together.

    Parameters
    ----------
    world_m : (M, 2), M >= 4.
    pixels : (M, 2) distorted pixels.
    groups : (M,) which residuals belong to the same point of the plane; each its own by default.

    Raises
    ------
    BadInputError
        When the points do not fix a plane, the camera's lens model cannot show these pixels, or the
        plane is mirrored, which would put the camera behind it.
    """
    starts = _starts(camera, world_m, pixels)
    view = Observations.of(np.column_stack([world_m, np.zeros(len(world_m))]), pixels[None])
    none = np.zeros(0, dtype=np.int64)
    blocks = (Block.of(camera, R[None], t[None]) for R, t in starts)
    fits = [minimise(block, view, none, tolerance=_TOLERANCE) for block in blocks]
    found = sorted(
        ((fit.at.cost, fit.block.R_CT[0], fit.block.t_CT_m[0], fit) for fit in fits if fit.at is not None),
        key=lambda one: one[0],
    )
    if not found:
        raise BadInputError("no pose of the plane puts all of its points in front of the camera")
    _, R, t, best = found[0]
    other = found[1][:3] if len(found) == 2 and np.linalg.norm(found[1][1] - R) > 1e-5 else None
    at = linearise(best.block, view, _EVERY_INTRINSIC, None)
    assert at is not None
    V, W = at.normal[0, -6:, -6:], at.normal[0, :-6, -6:]
    unit = 1.0 / np.sqrt(np.diag(V))
    inverse = np.linalg.inv(V * unit * unit[:, None]) * unit * unit[:, None]
    residuals = at.residuals[0].T
    own = np.arange(len(world_m)) if groups is None else groups
    variance = grouped_variance(residuals, own, 6)
    sigma_px = float(np.sqrt(variance))
    return Pose(R, t, residuals, inverse * variance, -inverse @ W.T, sigma_px, best.reason, other)


def _starts(camera: Camera, world_m: FloatArray, pixels: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """The pose of the linear homography, and the same plane tilted the other way."""
    ideal = undistort(camera, pixels)
    usable = np.isfinite(ideal).all(axis=1)
    if usable.sum() < 4:
        raise BadInputError(
            "the camera's lens model cannot show these pixels: its radial curve folds over inside of them"
        )
    H = fit_homography(world_m[usable], ideal[usable]).H
    if np.linalg.det(H) <= 0.0:
        raise BadInputError(
            "the plane is mirrored: as the camera sees it, the world's y axis must be a quarter turn "
            "clockwise from its x axis (x right, y down)"
        )
    U, singular, Vt = np.linalg.svd(H[:, :2], full_matrices=False)
    r12 = U @ Vt
    R = np.column_stack([r12, np.cross(r12[:, 0], r12[:, 1])])
    t = H[:, 2] / singular.mean()
    # Mirror the plane's axes in the plane across the line of sight; the third axis follows.
    centre = world_m.mean(axis=0)
    at = R[:, :2] @ centre + t
    v = at / np.linalg.norm(at)
    tilted = (np.eye(3) - 2 * np.outer(v, v)) @ R * np.array([1.0, 1.0, -1.0])
    return [(R, t), (tilted, at - tilted[:, :2] @ centre)]


def plane_map(camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, pixels: FloatArray) -> FloatArray:
    """World points (..., 2) seen at distorted pixels (..., 2), NaN beyond the horizon or the lens's fold."""
    A = np.column_stack([R_CW[:, :2], t_CW_m])
    return apply_homography(np.linalg.inv(A), undistort(camera, pixels))


def plane_pixels(camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, world_m: FloatArray) -> FloatArray:
    """The inverse of `plane_map`: distorted pixels of world points (..., 2), NaN behind the camera."""
    points_C = world_m @ R_CW[:, :2].T + t_CW_m
    front = points_C[..., 2:] > 0.0
    return np.where(front, project(camera, np.where(front, points_C, 1.0)), np.nan)


_FEWEST_SEEN = 12
"""Of the 63 places of the grid."""


def homography_with_lens(
    camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, workspace_m: Sequence[float]
) -> FloatArray | None:
    """H (3, 3), metres to pixels, fitted to where camera and lens show a grid over the workspace.

    It spreads what neglecting the lens costs over the workspace (x0, y0, x1, y1), as a calibration without a
    lens does (2.9). None where the camera sees too little of it.
    """
    world = box_grid(workspace_m, 9, 7).reshape(-1, 2)
    pixels = plane_pixels(camera, R_CW, t_CW_m, world)
    seen = in_picture(pixels, camera.image_size_px)
    return fit_homography(world[seen], pixels[seen]).H if seen.sum() >= _FEWEST_SEEN else None
