"""Closed-form initial guess of a camera from views of a plane (Zhang 2000).

A view's homography H = [h1 h2 h3] maps the target's plane to pixels and equals s K [r1 r2 t] (2.9
with the K that its printed form lacks). r1 and r2 are orthonormal, so that with B = K^-T K^-1

    h1^T B h2 = 0,   h1^T B h1 = h2^T B h2

are two equations linear in B for each view. Five unknown ratios of B (skew included) need three
views, four (no skew) need two, and two (principal point held at the image's centre) need one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.model import Camera, undistort
from calib.camera.views import Observations

__all__ = [
    "InitialGuess",
    "closed_form_intrinsics",
    "homographies",
    "initial_guess",
    "poses_from_homographies",
    "poses_with_camera",
]


@dataclass(frozen=True)
class InitialGuess:
    """K (3, 3) and the pose of each view: rotations R_CT (N, 3, 3) and translations t_CT_m (N, 3)."""

    K: FloatArray
    R_CT: FloatArray
    t_CT_m: FloatArray


def _similarity(points: FloatArray, present: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre (n, 2) and scale (n,) that bring each set of points to zero mean and unit spread."""
    count = present.sum(axis=1)
    centre = (points * present[..., None]).sum(axis=1) / count[:, None]
    spread = (((points - centre[:, None]) ** 2).sum(axis=2) * present).sum(axis=1) / count
    return centre, 1.0 / np.sqrt(np.maximum(spread, 1e-300))


def homographies(observations: Observations) -> FloatArray:
    """Homography from the target's plane (metres) to pixels for each view, shape (N, 3, 3).

    Hartley's normalisation makes h33 of the normalised homography the depth of the target's
    centroid, never zero for a target that was seen, so the eight other entries follow from normal
    equations.
    """
    present = observations.present.astype(np.float64)
    views = observations.views
    target = np.broadcast_to(observations.target_m[..., :2], observations.pixels.shape)
    centre_t, scale_t = _similarity(target, present)
    centre_p, scale_p = _similarity(observations.pixels, present)
    x, y = np.moveaxis((target - centre_t[:, None]) * scale_t[:, None, None], 2, 0)
    u, v = np.moveaxis((observations.pixels - centre_p[:, None]) * scale_p[:, None, None], 2, 0)
    one = np.ones_like(x)
    design = np.zeros((views, 9, 2, x.shape[1]))
    for row, value in enumerate((x, y, one)):
        design[:, row, 0] = value
        design[:, row + 3, 1] = value
    design[:, 6, 0], design[:, 6, 1] = -u * x, -v * x
    design[:, 7, 0], design[:, 7, 1] = -u * y, -v * y
    design[:, 8, 0], design[:, 8, 1] = u, v
    if not observations.complete:
        design *= present[:, None, None]
    rows = design.reshape(views, 9, -1)
    normal = rows @ rows.transpose(0, 2, 1)
    ridge = 1e-15 * np.trace(normal[:, :8, :8], axis1=1, axis2=2)
    left = normal[:, :8, :8] + ridge[:, None, None] * np.eye(8)
    h = np.ones((views, 9))
    h[:, :8] = np.linalg.solve(left, normal[:, :8, 8:])[..., 0]
    H = h.reshape(views, 3, 3)
    to_pixels = np.zeros((views, 3, 3))
    to_pixels[:, 0, 0] = to_pixels[:, 1, 1] = 1.0 / scale_p
    to_pixels[:, :2, 2] = centre_p
    to_pixels[:, 2, 2] = 1.0
    from_target = np.zeros((views, 3, 3))
    from_target[:, 0, 0] = from_target[:, 1, 1] = scale_t
    from_target[:, :2, 2] = -centre_t * scale_t[:, None]
    from_target[:, 2, 2] = 1.0
    return to_pixels @ H @ from_target


def _constraint(H: FloatArray, i: int, j: int) -> FloatArray:
    """Row v_ij of Zhang's system, (N, 6): h_i^T B h_j = v_ij . (B11, B12, B22, B13, B23, B33)."""
    a, b = H[:, :, i], H[:, :, j]
    return np.stack(
        [
            a[:, 0] * b[:, 0],
            a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0],
            a[:, 1] * b[:, 1],
            a[:, 2] * b[:, 0] + a[:, 0] * b[:, 2],
            a[:, 2] * b[:, 1] + a[:, 1] * b[:, 2],
            a[:, 2] * b[:, 2],
        ],
        axis=1,
    )


def closed_form_intrinsics(H: FloatArray, image_size_px: tuple[int, int], unknowns: str) -> FloatArray | None:
    """K from homographies, or None where noise or geometry leave no real solution.

    Parameters
    ----------
    H : (N, 3, 3).
    unknowns : "skew" (all of B), "no skew", or "centre" (principal point at the image's centre).
    """
    width, height = image_size_px
    size = 0.5 * (width + height)
    # Pixels about the image's centre and of order one condition the system.
    normalise = np.array(
        [[1 / size, 0, -0.5 * (width - 1) / size], [0, 1 / size, -0.5 * (height - 1) / size], [0, 0, 1]]
    )
    Hn = normalise @ H
    Hn = Hn / np.linalg.norm(Hn, axis=(1, 2), keepdims=True)
    system = np.concatenate([_constraint(Hn, 0, 1), _constraint(Hn, 0, 0) - _constraint(Hn, 1, 1)])
    kept = {"skew": [0, 1, 2, 3, 4, 5], "no skew": [0, 2, 3, 4, 5], "centre": [0, 2, 5]}[unknowns]
    if len(system) < len(kept) - 1:
        return None
    b = np.zeros(6)
    b[kept] = np.linalg.eigh(system[:, kept].T @ system[:, kept])[1][:, 0]
    B = np.array([[b[0], b[1], b[3]], [b[1], b[2], b[4]], [b[3], b[4], b[5]]]) * np.sign(b[0] or 1.0)
    if np.linalg.eigvalsh(B)[0] <= 0.0:
        return None
    # B = K^-T K^-1 = L L^T with L lower triangular, hence K = L^-T up to scale.
    K = np.linalg.inv(np.linalg.cholesky(B)).T
    K = np.linalg.inv(normalise) @ (K / K[2, 2])
    return np.asarray(K / K[2, 2])


def poses_from_homographies(K: FloatArray, H: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and translations (N, 3) of the target in the camera's frame.

    The two measured axes are made orthonormal symmetrically, so that neither is preferred.
    """
    M = np.linalg.solve(K, H)
    # The target is in front of the camera.
    M = M * np.where(M[:, 2, 2] < 0, -1.0, 1.0)[:, None, None]
    a, b, t = M[:, :, 0], M[:, :, 1], M[:, :, 2]
    scale = np.sqrt(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    half = (a + b) / np.linalg.norm(a + b, axis=1, keepdims=True)
    r3 = np.cross(a, b)
    r3 = r3 / np.linalg.norm(r3, axis=1, keepdims=True)
    across = np.cross(r3, half)
    r1 = (half - across) / np.sqrt(2.0)
    r2 = (half + across) / np.sqrt(2.0)
    return np.stack([r1, r2, r3], axis=2), t / scale[:, None]


def poses_with_camera(camera: Camera, observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Poses of the views seen by a known camera, linear; NaN where the lens cannot show such pixels."""
    ideal = undistort(camera, observations.pixels)
    usable = np.isfinite(ideal).all(axis=2) & observations.present
    enough = usable.sum(axis=1) >= 4
    seen = Observations(
        observations.names, observations.target_m, np.nan_to_num(ideal), usable | ~enough[:, None]
    )
    R_CT, t_CT_m = poses_from_homographies(np.eye(3), homographies(seen))
    R_CT[~enough], t_CT_m[~enough] = np.nan, np.nan
    return R_CT, t_CT_m


def _mismatch(K: FloatArray, H: FloatArray) -> float:
    """How far K^-1 H is from two orthonormal columns, mean over views of a dimensionless error."""
    M = np.linalg.solve(K, H)
    a, b = M[:, :, 0], M[:, :, 1]
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    return float(np.mean(((aa - bb) ** 2 + 4 * ab**2) / (aa + bb) ** 2))


def initial_guess(observations: Observations, image_size_px: tuple[int, int], skew: bool) -> InitialGuess:
    """Intrinsics without distortion and the poses of all views, as a start for the bundle adjustment.

    Zhang's closed form with as many unknowns as the views allow; where that has no plausible answer
    the principal point is held at the centre, and where that fails too the focal length of a scan
    that makes the target's axes most nearly orthonormal is taken.
    """
    H = homographies(observations)
    width, height = image_size_px
    longest = float(max(width, height))
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    attempts = (["skew"] if skew and observations.views >= 3 else []) + (
        ["no skew"] if observations.views >= 2 else []
    )
    K = None
    for unknowns in [*attempts, "centre"]:
        K = closed_form_intrinsics(H, image_size_px, unknowns)
        if K is not None and _plausible(K, longest, centre):
            break
        K = None
    if K is None:
        focal = longest * np.geomspace(0.3, 10.0, 60)
        candidates = [np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1.0]]) for f in focal]
        K = min(candidates, key=lambda candidate: _mismatch(candidate, H))
    if not skew:
        K[0, 1] = 0.0
    R_CT, t_CT_m = poses_from_homographies(K, H)
    return InitialGuess(K, R_CT, t_CT_m)


def _plausible(K: FloatArray, longest: float, centre: FloatArray) -> bool:
    """Focal lengths between a fifth and fifty times the image, principal point near the image."""
    focal = np.array([K[0, 0], K[1, 1]])
    near = np.abs(K[:2, 2] - centre) < longest
    return bool(
        np.all(np.isfinite(K))
        and np.all(focal > 0.2 * longest)
        and np.all(focal < 50 * longest)
        and near.all()
    )
