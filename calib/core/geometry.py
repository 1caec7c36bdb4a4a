"""Rotations, boxes, and the homography from a plane to pixels, fitted without knowing the camera.

    s (u, v, 1) = H (X, Y, 1)

Start: the direct linear transform on normalised points (Hartley 1997). Then Levenberg-Marquardt on the
distances in pixels; with w = h3 . X the derivatives are du/dh1 = X / w, du/dh3 = -u X / w, and alike
for v. Of the nine entries eight are free, and a step along h itself changes nothing, so it is left
out. H is scaled to a depth s of 1 at the points' centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.errors import BadInputError

_MAX_ITERATIONS = 50
_STEP_PX = 1e-10
"""Where the Gauss-Newton step moves no point by more than this, the minimum is reached."""
_ROUNDING = 1e-12
"""Rounding in the sum of squares must not stop a step that the gradient asks for."""


@dataclass(frozen=True)
class Homography:
    """A fitted homography.

    Attributes
    ----------
    H : (3, 3), metres to pixels, depth 1 at the centroid of the points.
    rms_px : root of the mean squared distance between measured and mapped points.
    """

    H: FloatArray
    rms_px: float


def box_grid(box: Sequence[float] | FloatArray, columns: int, rows: int) -> FloatArray:
    """Places (rows, columns, 2) spread evenly over a box (x0, y0, x1, y1), its borders included."""
    x0, y0, x1, y1 = box
    return np.stack(np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows)), axis=-1)


def in_picture(pixels: FloatArray, image_size_px: tuple[int, int]) -> BoolArray:
    """Whether pixels (..., 2) are known and lie in a picture of this width and height, edges included."""
    return np.asarray(((pixels >= -0.5) & (pixels <= np.array(image_size_px) - 0.5)).all(axis=-1))


def cross_matrices(v: FloatArray) -> FloatArray:
    """Matrices (N, 3, 3) with [v]x w = v x w."""
    S = np.zeros((len(v), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return S - S.transpose(0, 2, 1)


def rotation_exp(delta: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) (Rodrigues), smooth at zero."""
    angle = np.linalg.norm(delta, axis=1)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    S = cross_matrices(delta)
    return np.asarray(np.eye(3) + a[:, None, None] * S + b[:, None, None] * (S @ S))


def apply_homography(H: FloatArray, points: FloatArray) -> FloatArray:
    """Map (..., 2) points by H; points at or beyond the horizon become NaN."""
    mapped = points @ H[:, :2].T + H[:, 2]
    depth = np.where(mapped[..., 2:] > 0.0, mapped[..., 2:], np.nan)
    return np.asarray(mapped[..., :2] / depth)


def _similarities(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre (n, 2) and scale (n,) that bring each weighted set of points to zero mean and unit spread."""
    total = np.maximum(weights.sum(axis=1), 1e-300)
    centre = (points * weights[..., None]).sum(axis=1) / total[:, None]
    spread = (((points - centre[:, None]) ** 2).sum(axis=2) * weights).sum(axis=1) / total
    return centre, 1.0 / np.sqrt(np.maximum(spread, 1e-300))


def linear_homographies(points: FloatArray, pixels: FloatArray, weights: FloatArray) -> FloatArray:
    """Homographies (N, 3, 3) from points (N, M, 2) of a plane to pixels (N, M, 2), by linear least squares.

    Hartley's normalisation makes h33 of the normalised homography the depth of the points' centroid, never
    zero for a plane that was seen, so the eight other entries follow from normal equations.

    Parameters
    ----------
    weights : (N, M) of the points' squared errors, zero for points that do not count.
    """
    N = len(pixels)
    points = np.broadcast_to(points, pixels.shape)
    weights = np.broadcast_to(weights, pixels.shape[:2])
    centre_t, scale_t = _similarities(points, weights)
    centre_p, scale_p = _similarities(pixels, weights)
    x, y = np.moveaxis((points - centre_t[:, None]) * scale_t[:, None, None], 2, 0)
    u, v = np.moveaxis((pixels - centre_p[:, None]) * scale_p[:, None, None], 2, 0)
    design = np.zeros((N, 9, 2, x.shape[1]))
    for row, value in enumerate((x, y, np.ones_like(x))):
        design[:, row, 0] = value
        design[:, row + 3, 1] = value
    design[:, 6, 0], design[:, 6, 1] = -u * x, -v * x
    design[:, 7, 0], design[:, 7, 1] = -u * y, -v * y
    design[:, 8, 0], design[:, 8, 1] = u, v
    normal = (design * weights[:, None, None]).reshape(N, 9, -1) @ design.reshape(N, 9, -1).transpose(0, 2, 1)
    ridge = 1e-15 * np.trace(normal[:, :8, :8], axis1=1, axis2=2)
    h = np.ones((N, 9))
    h[:, :8] = np.linalg.solve(normal[:, :8, :8] + ridge[:, None, None] * np.eye(8), normal[:, :8, 8:])[
        ..., 0
    ]
    to_pixels, from_points = np.zeros((N, 3, 3)), np.zeros((N, 3, 3))
    to_pixels[:, 0, 0] = to_pixels[:, 1, 1] = 1.0 / scale_p
    to_pixels[:, :2, 2] = centre_p
    from_points[:, 0, 0] = from_points[:, 1, 1] = scale_t
    from_points[:, :2, 2] = -centre_t * scale_t[:, None]
    to_pixels[:, 2, 2] = from_points[:, 2, 2] = 1.0
    return to_pixels @ h.reshape(N, 3, 3) @ from_points


def map_jacobian(H: FloatArray, points: FloatArray) -> FloatArray:
    """Derivative of the mapped points by the points, (..., 2, 2)."""
    mapped = points @ H[:, :2].T + H[:, 2]
    depth = mapped[..., 2]
    image = mapped[..., :2] / depth[..., None]
    return np.asarray((H[:2, :2] - image[..., :, None] * H[2, :2]) / depth[..., None, None])


def grouped_variance(residuals: FloatArray, groups: IntArray, parameters: int) -> float:
    """Variance of one coordinate where several residuals may belong to the same point.

    Pictures of a scene that stands still repeat each other's errors, and N copies are not N times the
    information. Residuals of the same point are averaged first: with n_g residuals of mean r_g,
    sigma^2 = sum n_g |r_g|^2 / (2 G - parameters), which is the usual estimate when errors are
    independent and N times as large when they repeat.

    Parameters
    ----------
    residuals : (M, 2) pixels.
    groups : (M,) index of the point, 0 .. G - 1.
    """
    count = np.bincount(groups)
    mean_u = np.bincount(groups, residuals[:, 0]) / count
    mean_v = np.bincount(groups, residuals[:, 1]) / count
    freedom = 2 * len(count) - parameters
    if freedom <= 0:
        return float("nan")
    return float(np.sum(count * (mean_u**2 + mean_v**2)) / freedom)


def _normalising(points: FloatArray) -> FloatArray:
    """Similarity that brings points to zero mean and a mean square radius of 2."""
    centre = points.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)) / 2.0)
    k = 1.0 / spread if spread > 0 else 1.0
    return np.array([[k, 0.0, -k * centre[0]], [0.0, k, -k * centre[1]], [0.0, 0.0, 1.0]])


def _direct_linear(points: FloatArray, pixels: FloatArray) -> FloatArray:
    """The linear estimate on normalised points, Frobenius norm 1, depths positive."""
    M = len(points)
    X = np.column_stack([points, np.ones(M)])
    system = np.zeros((2 * M, 9))
    system[:M, :3], system[:M, 6:] = X, -pixels[:, :1] * X
    system[M:, 3:6], system[M:, 6:] = X, -pixels[:, 1:] * X
    _, singular, V = np.linalg.svd(system, full_matrices=M < 5)
    if singular[7] < 1e-9 * singular[0]:
        raise BadInputError("the points do not fix a homography: too many of them lie on one line")
    H = V[8].reshape(3, 3)
    return np.asarray(H if np.sum(X @ H[2]) > 0 else -H)


def _residuals(h: FloatArray, X: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Residuals (2 M,) and Jacobian (2 M, 9), or None where a point has no positive depth."""
    M = len(X)
    mapped = X @ h.reshape(3, 3).T
    depth = mapped[:, 2:]
    if depth.min() <= 0.0:
        return None
    image = mapped[:, :2] / depth
    J = np.zeros((2 * M, 9))
    J[:M, :3] = J[M:, 3:6] = X / depth
    J[:M, 6:] = -image[:, :1] * X / depth
    J[M:, 6:] = -image[:, 1:] * X / depth
    return (image - pixels).T.ravel(), J


def fit_homography(points: FloatArray, pixels: FloatArray) -> Homography:
    """Homography from points of a plane to pixels that minimises the distances in pixels.

    Parameters
    ----------
    points : (M, 2) metres, M >= 4, not all but one on a line.
    pixels : (M, 2).

    Raises
    ------
    BadInputError
        When there are fewer than four points or they do not fix a homography.
    """
    if len(points) < 4:
        raise BadInputError(f"a plane needs at least 4 points, got {len(points)}")
    from_points, from_pixels = _normalising(points), _normalising(pixels)
    X = np.column_stack([points, np.ones(len(points))]) @ from_points.T
    scaled = pixels @ from_pixels[:2, :2].T + from_pixels[:2, 2]
    px = from_pixels[0, 0]
    h = _direct_linear(X[:, :2], scaled).ravel()
    now = _residuals(h, X, scaled)
    if now is None:
        raise BadInputError(
            "the points do not fix a homography: some would lie beyond the horizon of the others"
        )
    damping = 1e-3
    for _ in range(_MAX_ITERATIONS):
        r, J = now
        normal, gradient = J.T @ J, J.T @ r
        # h h^T fills the one direction in which nothing changes.
        filled = normal + np.trace(normal) * np.outer(h, h)
        if np.abs(J @ np.linalg.solve(filled, gradient)).max() < _STEP_PX * px:
            break
        accepted = None
        while accepted is None and damping < 1e9:
            step = -np.linalg.solve(filled + damping * np.diag(np.diag(normal)), gradient)
            h_trial = (h + step) / np.linalg.norm(h + step)
            trial = _residuals(h_trial, X, scaled)
            if trial is not None and trial[0] @ trial[0] <= (r @ r) * (1 + _ROUNDING):
                accepted = trial
            else:
                damping *= 8.0
        if accepted is None:
            break
        h, now, damping = h_trial, accepted, max(0.1 * damping, 1e-12)
    H = np.linalg.inv(from_pixels) @ h.reshape(3, 3) @ from_points
    depth = H[2] @ np.linalg.solve(from_points, [0.0, 0.0, 1.0])
    return Homography(H / depth, float(np.sqrt(now[0] @ now[0] / len(points))) / px)
