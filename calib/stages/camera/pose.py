"""Pose of a plane in front of a known camera, and how it hangs on the camera's parameters.

A point X of the plane is at p = R X + t in the camera's frame and is seen at pixel g(c, p), with the
intrinsics c as in `calib.stages.camera.model`. The pose minimises |r|^2 with r = g - pixels, by
Levenberg-Marquardt over a rotation vector w, R = exp(w) R0, and t:

    dp/dw = -[R X]x,  dp/dt = I,  J = dg/d(w, t),  C = dg/dc

At the minimum J^T r = 0 whatever c is, hence by the implicit function theorem, with the curvature of
g times the residual neglected (Gauss-Newton),

    d(w, t)/dc = -(J^T J)^-1 J^T C

A plane seen with little perspective fits nearly as well when tilted the other way. Both are tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.geometry import apply_homography, fit_homography, grouped_variance
from calib.stages.camera.model import (
    INTRINSICS,
    Block,
    Camera,
    Observations,
    jacobian,
    undistort,
    vector_from_camera,
)

_EVERY_INTRINSIC = np.arange(len(INTRINSICS))
_MAX_ITERATIONS = 100
_STEP_PX = 1e-9
"""Where the Gauss-Newton step moves no point by more than this, the minimum is reached."""
_ROUNDING = 1e-12
"""Rounding in the sum of squares must not stop a step that the gradient asks for."""


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
    termination : "converged", "no lower cost" or "iteration limit".
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


def rotation(w: FloatArray) -> FloatArray:
    """Rotation matrix exp([w]x) of a rotation vector (Rodrigues), smooth at zero."""
    angle = np.linalg.norm(w)
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * half * half * W @ W)


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
    of `model.INTRINSICS`; NaN where a point is behind the camera.
    """
    if camera.fisheye:
        return _by_jacobian(camera, points_C)
    k1, k2, p1, p2, k3, k4, k5, k6 = camera.distortion
    Z = points_C[:, 2]
    x, y = points_C[:, 0] / Z, points_C[:, 1] / Z
    r2 = x * x + y * y
    over = 1.0 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    L = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over
    slope = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - L * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) * over
    xd = x * L + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * L + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    xd_x = L + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yd_y = L + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y

    M = len(points_C)
    lens = np.zeros((M, 2, 8))
    by_L = np.stack([r2, r2 * r2, r2**3], axis=1) * over[:, None]
    for column, power in ((0, 0), (1, 1), (4, 2)):
        lens[:, 0, column], lens[:, 1, column] = x * by_L[:, power], y * by_L[:, power]
    lens[:, 0, 2], lens[:, 1, 2] = 2 * x * y, r2 + 2 * y * y
    lens[:, 0, 3], lens[:, 1, 3] = r2 + 2 * x * x, 2 * x * y
    for power in range(3):
        lens[:, 0, 5 + power] = -x * L * by_L[:, power]
        lens[:, 1, 5 + power] = -y * L * by_L[:, power]

    focal = np.array([[camera.fx_px, camera.skew_px], [0.0, camera.fy_px]])
    by_xy = focal @ np.stack([xd_x, cross, cross, yd_y], axis=1).reshape(M, 2, 2)
    by_point = np.zeros((M, 2, 3))
    by_point[:, :, :2] = by_xy / Z[:, None, None]
    by_point[:, :, 2] = -(by_xy @ np.stack([x, y], axis=1)[..., None])[..., 0] / Z[:, None]
    by_camera = np.zeros((M, 2, 13))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = xd, yd
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, 0, 4] = yd
    by_camera[:, :, 5:] = focal @ lens
    pixels = np.stack([xd, yd], axis=1) @ focal.T + np.array([camera.cx_px, camera.cy_px])
    return pixels, by_point, by_camera


def _by_jacobian(camera: Camera, points_C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same from the rows of the bundle adjustment."""
    M = len(points_C)
    here = Block(vector_from_camera(camera), np.eye(3)[None], np.zeros((1, 3)), np.zeros(0), camera.fisheye)
    seen = Observations(("",), points_C[None], np.zeros((1, M, 2)), np.ones((1, M), dtype=np.bool_))
    rows = jacobian(here, seen, _EVERY_INTRINSIC, None)
    if rows is None:
        nothing = np.full((M, 2, len(INTRINSICS)), np.nan)
        return nothing[..., 0], nothing[..., :3], nothing
    # Intrinsics, rotation, translation, and last the pixels themselves.
    by = rows[0].reshape(-1, 2, M).transpose(2, 1, 0)
    count = len(INTRINSICS)
    return by[..., -1], by[..., count + 3 : count + 6], by[..., :count]


def pose_derivatives(
    camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, world_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pixels (M, 2) of world points (M, 2), and derivatives by world point, pose and intrinsics.

    Shapes of the derivatives: (M, 2, 2), (M, 2, 6), (M, 2, 13).
    """
    rotated = world_m @ R_CW[:, :2].T
    pixels, by_point, by_camera = projection_with_derivatives(camera, rotated + t_CW_m)
    # a . (w x q) = w . (q x a): row by row of by_point.
    by_w = np.cross(rotated[:, None, :], by_point)
    return pixels, by_point @ R_CW[:, :2], np.concatenate([by_w, by_point], axis=2), by_camera


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
    fits = [_minimise(camera, R, t, world_m, pixels) for R, t in starts]
    found = [fit for fit in fits if fit is not None]
    if not found:
        raise BadInputError("no pose of the plane puts all of its points in front of the camera")
    found.sort(key=lambda fit: fit.cost)
    best = found[0]
    other = None
    if len(found) == 2 and np.linalg.norm(found[1].R - best.R) > 1e-5:
        other = (found[1].cost, found[1].R, found[1].t)
    _, _, by_pose, by_camera = pose_derivatives(camera, best.R, best.t, world_m)
    J, C = by_pose.reshape(-1, 6), by_camera.reshape(-1, 13)
    unit = 1.0 / np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv((J * unit).T @ (J * unit)) * unit * unit[:, None]
    own = np.arange(len(world_m)) if groups is None else groups
    variance = grouped_variance(best.residuals, own, 6)
    return Pose(
        best.R,
        best.t,
        best.residuals,
        inverse * variance,
        -inverse @ (J.T @ C),
        float(np.sqrt(variance)),
        best.termination,
        other,
    )


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


@dataclass(frozen=True)
class _Fit:
    R: FloatArray
    t: FloatArray
    residuals: FloatArray
    cost: float
    termination: str


def _minimise(
    camera: Camera, R: FloatArray, t: FloatArray, world_m: FloatArray, pixels: FloatArray
) -> _Fit | None:
    """Levenberg-Marquardt from (R, t), or None where the start has points behind the camera."""

    def evaluate(R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        if np.min(world_m @ R[2, :2] + t[2]) <= 0.0:
            return None
        seen, _, by_pose, _ = pose_derivatives(camera, R, t, world_m)
        return (seen - pixels).ravel(), by_pose.reshape(-1, 6)

    now = evaluate(R, t)
    if now is None:
        return None
    damping, termination = 1e-3, "iteration limit"
    for _ in range(_MAX_ITERATIONS):
        r, J = now
        normal, gradient = J.T @ J, J.T @ r
        if np.abs(J @ np.linalg.solve(normal, gradient)).max() < _STEP_PX:
            termination = "converged"
            break
        accepted = None
        while accepted is None and damping < 1e12:
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
            R_trial, t_trial = rotation(step[:3]) @ R, t + step[3:]
            trial = evaluate(R_trial, t_trial)
            if trial is not None and trial[0] @ trial[0] <= (r @ r) * (1 + _ROUNDING):
                accepted = trial
            else:
                damping *= 8.0
        if accepted is None:
            termination = "no lower cost"
            break
        R, t, now, damping = R_trial, t_trial, accepted, max(0.1 * damping, 1e-15)
    residuals = now[0].reshape(-1, 2)
    # Products of many rotations drift from orthonormality by rounding only; remove even that.
    U, _, Vt = np.linalg.svd(R)
    return _Fit(U @ Vt, t, residuals, float(now[0] @ now[0]), termination)


def plane_map(camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, pixels: FloatArray) -> FloatArray:
    """World points (..., 2) seen at distorted pixels (..., 2), NaN beyond the horizon or the lens's fold."""
    A = np.column_stack([R_CW[:, :2], t_CW_m])
    return apply_homography(np.linalg.inv(A), undistort(camera, pixels))
