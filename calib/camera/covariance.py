"""Standard deviations of a calibration: intrinsics, poses, and projection over the image.

With the normal matrix H of `calib.camera.levenberg` and the residuals' variance sigma^2, the covariance of
all parameters is sigma^2 H^-1. Its block of the intrinsics is the inverse of the Schur complement S,
and for view i

    cov(z_i) = V_i^-1 + E_i S^-1 E_i',   cov(s, z_i) = -S^-1 E_i',   E_i = V_i^-1 W_i'.

Projection uncertainty asks how far a point that is fixed in the scene would move in the picture if
the pictures were taken again (mrcal's question). New pictures change the intrinsics and, with them,
all poses; a common rigid motion g = (omega, tau) of the poses, taken in the camera's frame, is
invisible and only says where the camera thinks it stands. It is taken as the motion that best
explains the change of the poses, weighted by what each view knows,

    g = (sum_i G_i' V_i G_i)^-1 sum_i G_i' V_i dz_i,   G_i = [[1, 0], [-[t_i]x, 1]],

and the point p of the camera's frame then moves by omega x p + tau before it is projected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.bundle import Calibration
from calib.camera.model import undistort
from calib.camera.projection import Block, jacobian
from calib.camera.views import Observations

__all__ = ["Covariance", "covariance", "joint_jacobian", "projection_sigma_px", "residual_inflation"]


@dataclass(frozen=True)
class Covariance:
    """Covariance of a calibration's parameters.

    Attributes
    ----------
    names : the estimated intrinsics, in order.
    intrinsics : (P, P); infinite where the data leave a direction free.
    deformation : (K,) standard deviations of the target's deformation, metres.
    poses : (N, 6, 6) rotation vector (rad, left of R_CT) and translation (m) of each view.
    joint : (P + 6, P + 6) of the intrinsics and the common motion g (rad, m).
    distance_m : median distance of the targets' centres, where projection uncertainty is quoted.
    """

    names: tuple[str, ...]
    intrinsics: FloatArray
    deformation: FloatArray
    poses: FloatArray
    joint: FloatArray
    distance_m: float

    def sigma(self) -> dict[str, float]:
        """Standard deviation of each estimated intrinsic by name."""
        variance = np.diag(self.intrinsics)
        # Where rounding leaves no positive variance the data do not bound it.
        bounded = np.sqrt(np.where(variance >= 0.0, variance, np.inf))
        return dict(zip(self.names, bounded.tolist(), strict=True))


def _skew(v: FloatArray) -> FloatArray:
    """Matrices (N, 3, 3) with [v]x w = v x w."""
    S = np.zeros((len(v), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return S - S.transpose(0, 2, 1)


def covariance(calibration: Calibration, variance_px2: float | None = None) -> Covariance:
    """Covariance of everything that was estimated.

    Parameters
    ----------
    variance_px2 : variance of one measured coordinate; from the residuals by default.
    """
    variance = calibration.sigma_px**2 if variance_px2 is None else variance_px2
    H = calibration.normal
    P = len(calibration.free)
    G = P + len(calibration.block.deformation)
    V, W, U = H[:, G:, G:], H[:, :G, G:], H[:, :G, :G].sum(axis=0)
    views = len(H)
    t = calibration.block.t_CT_m
    distance = float(np.median(np.linalg.norm(t, axis=1)))
    try:
        V_inverse = np.linalg.inv(V)
        E = V_inverse @ W.transpose(0, 2, 1)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(U), 1e-300))
        S = (U - np.einsum("ngk,nkh->gh", W, E)) * scale * scale[:, None]
        if np.linalg.eigvalsh(S)[0] <= 1e-15:
            raise np.linalg.LinAlgError
        S_inverse = np.linalg.inv(S) * scale * scale[:, None]
    except np.linalg.LinAlgError:
        return Covariance(
            calibration.free_names,
            np.diag(np.full(P, np.inf)),
            np.full(G - P, np.inf),
            np.full((views, 6, 6), np.inf),
            np.diag(np.full(P + 6, np.inf)),
            distance,
        )
    poses = V_inverse + E @ S_inverse @ E.transpose(0, 2, 1)
    motion = np.zeros((views, 6, 6))
    motion[:, :3, :3] = motion[:, 3:, 3:] = np.eye(3)
    motion[:, 3:, :3] = -_skew(t)
    weighted = motion.transpose(0, 2, 1) @ V
    total = (weighted @ motion).sum(axis=0)
    # g = sum_i F_i dz_i with F_i = total^-1 G_i' V_i; dz_i = -E_i ds + its own noise.
    F = np.linalg.solve(total, weighted)
    of_shared = -np.einsum("nab,nbg->ag", F, E)
    own = np.einsum("nab,nbc,ndc->ad", F, V_inverse, F)
    joint = np.zeros((P + 6, P + 6))
    joint[:P, :P] = S_inverse[:P, :P]
    joint[P:, :P] = (of_shared @ S_inverse)[:, :P]
    joint[:P, P:] = joint[P:, :P].T
    joint[P:, P:] = of_shared @ S_inverse @ of_shared.T + own
    return Covariance(
        calibration.free_names,
        variance * S_inverse[:P, :P],
        np.sqrt(variance * np.diag(S_inverse)[P:]),
        variance * poses,
        variance * joint,
        distance,
    )


def joint_jacobian(calibration: Calibration, points_C: FloatArray) -> FloatArray:
    """Derivative (n, 2, P + 6) of the pixels of points (n, 3) by the intrinsics and the common motion g."""
    n = len(points_C)
    one = Observations(
        names=("",), target_m=points_C[None], pixels=np.zeros((1, n, 2)), present=np.ones((1, n), np.bool_)
    )
    here = Block(calibration.block.intrinsics, np.eye(3)[None], np.zeros((1, 3)), np.zeros(0))
    J = jacobian(here, one, calibration.free, None)
    if J is None:
        return np.full((n, 2, len(calibration.free) + 6), np.nan)
    return J[0, :-1].reshape(-1, 2, n).transpose(2, 1, 0)


def projection_sigma_px(
    calibration: Calibration, found: Covariance, pixels: FloatArray, distance_m: float | None = None
) -> FloatArray:
    """Standard deviation of projection at these pixels (n, 2), in pixels, shape (n,).

    The root of the larger eigenvalue of the 2 x 2 covariance: the worst direction. NaN where the
    lens cannot show the pixel.

    Parameters
    ----------
    distance_m : distance of the point that is looked at; the targets' median by default.
    """
    ideal = undistort(calibration.camera, pixels)
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    distance = found.distance_m if distance_m is None else distance_m
    points = distance * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    seen = np.isfinite(points).all(axis=1)
    sigma = np.full(len(pixels), np.nan)
    if not np.all(np.isfinite(found.joint)):
        return np.where(seen, np.inf, np.nan)
    if not seen.any():
        return sigma
    J = joint_jacobian(calibration, points[seen])
    cov = J @ found.joint @ J.transpose(0, 2, 1)
    mean = 0.5 * (cov[:, 0, 0] + cov[:, 1, 1])
    sigma[seen] = np.sqrt(mean + np.hypot(0.5 * (cov[:, 0, 0] - cov[:, 1, 1]), cov[:, 0, 1]))
    return sigma


def residual_inflation(calibration: Calibration) -> float:
    """Factor on all standard deviations for residuals that are not white within a view.

    The sandwich estimate: the spread of the views' own scores about what white residuals would
    give, over the intrinsics. One, never less, where residuals are white.
    """
    P = len(calibration.free)
    G = P + len(calibration.block.deformation)
    H = calibration.normal
    block, obs = calibration.block, calibration.observations
    J = jacobian(block, obs, calibration.free, calibration.basis)
    if J is None or P == 0 or obs.views < 2:
        return 1.0
    V_inverse = np.linalg.inv(H[:, G:, G:])
    E = V_inverse @ H[:, :G, G:].transpose(0, 2, 1)
    root = np.sqrt(np.tile(calibration.weights, 2))
    gradient = np.einsum("nqm,nm->nq", J[:, :-1] * root[:, None], J[:, -1] * root)
    score = gradient[:, :G] - np.einsum("ngk,nk->ng", E.transpose(0, 2, 1), gradient[:, G:])
    S = H[:, :G, :G].sum(axis=0) - np.einsum("ngk,nkh->gh", H[:, :G, G:], E)
    meat = score.T @ score * obs.views / max(obs.views - G / 2.0, 1.0)
    expected = calibration.sigma_px**2 * S
    try:
        ratio = np.trace(np.linalg.solve(expected, meat)) / G
    except np.linalg.LinAlgError:
        return 1.0
    return float(np.sqrt(max(ratio, 1.0)))
