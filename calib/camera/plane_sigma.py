"""Standard deviation of a marker's position on the plane, from all that is uncertain.

A marker at X is seen at the pixel m = g(c, e, X), with intrinsics c and pose e = (w, t). The position
read from m solves that for X, so that errors in c, e and m move it by

    dX = G_X^-1 (dm - G_c dc - G_e de)

The pose was itself estimated with these intrinsics, de = E dc + de_noise with E = de/dc of
`calib.camera.pose`. Much of an error in c is absorbed that way, and leaving E out would overstate it:

    from the intrinsics    G_X^-1 (G_c + G_e E) dc
    from the plane's fit   G_X^-1 G_e de_noise
    from whole pixels      G_X^-1 dm,  dm uniform over a pixel, variance 1/12 px^2

The three are independent as long as the plane's pictures were not among those of the intrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.model import Camera
from calib.camera.pose import Pose, plane_map, pose_derivatives

__all__ = ["QUANTISATION_VARIANCE_PX2", "PositionSigma", "position_sigma", "visible", "workspace_grid"]

QUANTISATION_VARIANCE_PX2 = 1.0 / 12.0
"""Variance of an error that is uniform over one pixel."""


@dataclass(frozen=True)
class PositionSigma:
    """Standard deviations of a marker's position, one row per place and the columns x and y.

    Attributes
    ----------
    points_m : (N, 2) places on the plane; rows of places that the picture does not show are NaN in
        all other arrays.
    intrinsics_mm : (N, 2), or None where the covariance of the intrinsics is not known.
    plane_mm, quantisation_mm : (N, 2).
    """

    points_m: FloatArray
    intrinsics_mm: FloatArray | None
    plane_mm: FloatArray
    quantisation_mm: FloatArray

    @property
    def calibration_mm(self) -> FloatArray:
        """Intrinsics and plane together, (N, 2): what the calibration alone leaves open."""
        if self.intrinsics_mm is None:
            return self.plane_mm
        return np.asarray(np.hypot(self.intrinsics_mm, self.plane_mm))

    @property
    def total_mm(self) -> FloatArray:
        """Everything together, (N, 2)."""
        return np.asarray(np.hypot(self.calibration_mm, self.quantisation_mm))


def workspace_grid(workspace_m: tuple[float, float, float, float], side: int = 9) -> FloatArray:
    """A grid of side x side places over the box (x0, y0, x1, y1), shape (side^2, 2), metres."""
    x0, y0, x1, y1 = workspace_m
    x, y = np.meshgrid(np.linspace(x0, x1, side), np.linspace(y0, y1, side))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def visible(camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, points_m: FloatArray) -> BoolArray:
    """Which places (N, 2) of the plane the picture shows, (N,): in front, inside, and not folded over."""
    shown = np.asarray(points_m @ R_CW[2, :2] + t_CW_m[2] > 0.0)
    if not shown.any():
        return shown
    pixels = pose_derivatives(camera, R_CW, t_CW_m, points_m[shown])[0]
    width, height = camera.image_size_px
    inside = np.all((pixels >= -0.5) & (pixels <= np.array([width, height]) - 0.5), axis=1)
    back = np.full(pixels.shape, np.nan)
    back[inside] = plane_map(camera, R_CW, t_CW_m, pixels[inside])
    size = np.linalg.norm(t_CW_m)
    result = shown.copy()
    returned = np.linalg.norm(back - points_m[shown], axis=1)
    result[shown] = returned < 1e-6 * size
    return result


def position_sigma(
    camera: Camera, camera_covariance: FloatArray | None, pose: Pose, points_m: FloatArray
) -> PositionSigma:
    """Standard deviations in mm of positions read from the picture.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, zero rows for what was not
        estimated; None where it is not known.
    points_m : (N, 2) places on the plane.
    """
    seen = visible(camera, pose.R_CW, pose.t_CW_m, points_m)
    _, by_world, by_pose, by_camera = pose_derivatives(camera, pose.R_CW, pose.t_CW_m, points_m[seen])
    to_world = 1e3 * np.linalg.inv(by_world)

    def deviation(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
        rows = to_world @ jacobian
        result = np.full(points_m.shape, np.nan)
        variance = np.einsum("nik,kl,nil->ni", rows, covariance, rows)
        # Rounding may leave a covariance negative by its last digit.
        result[seen] = np.sqrt(np.maximum(variance, 0.0))
        return result

    intrinsics = None
    if camera_covariance is not None and not np.all(np.isfinite(camera_covariance)):
        intrinsics = np.where(seen[:, None], np.inf, np.nan) * np.ones(2)
    elif camera_covariance is not None:
        intrinsics = deviation(by_camera + by_pose @ pose.by_intrinsics, camera_covariance)
    pixel = np.broadcast_to(np.eye(2), by_world.shape)
    return PositionSigma(
        points_m,
        intrinsics,
        deviation(by_pose, pose.covariance),
        deviation(pixel, QUANTISATION_VARIANCE_PX2 * np.eye(2)),
    )
