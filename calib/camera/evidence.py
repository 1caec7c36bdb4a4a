"""What each view says about the intrinsics, its own pose eliminated.

To second order about the solution, the cost of view i when the shared parameters move by d and the
view's pose follows is

    c_i(d) = c_i + 2 b_i' d + d' S_i d,   S_i = U_i - W_i V_i^-1 W_i',   b_i = g_i - W_i V_i^-1 g_zi

with the blocks of `calib.camera.bundle`. Views are independent given d, so that any question about
groups of views (one camera or two, early or late, with or without a view) is answered by sums of
S_i and b_i: the cost of a group falls by b' S^-1 b, b and S summed over the group.

Deformations of the target enter as further shared parameters that rest at zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.bundle import Calibration
from calib.camera.projection import INTRINSICS, jacobian

__all__ = ["Evidence", "evidence", "gain", "overdispersion", "scaled_inverse"]


@dataclass(frozen=True)
class Evidence:
    """Quadratic cost of every view about a calibration.

    Attributes
    ----------
    names : G names of the shared parameters: free intrinsics, then deformations.
    intrinsics : how many of them are intrinsics.
    S : (N, G, G) information of each view, pixels squared per unit squared.
    b : (N, G) half the gradient of each view's cost.
    cost : (N,) sums of squared residuals, pixels squared.
    measured : (N,) measured coordinates of each view.
    sigma_px : standard deviation of one coordinate.
    """

    names: tuple[str, ...]
    intrinsics: int
    S: FloatArray
    b: FloatArray
    cost: FloatArray
    measured: IntArray
    sigma_px: float

    def camera_only(self) -> Evidence:
        """The same about the intrinsics alone, the target rigid."""
        P = self.intrinsics
        return Evidence(
            self.names[:P], P, self.S[:, :P, :P], self.b[:, :P], self.cost, self.measured, self.sigma_px
        )


def evidence(
    calibration: Calibration, basis: FloatArray | None = None, names: tuple[str, ...] = ()
) -> Evidence:
    """Information of each view about the free intrinsics and, with `basis`, the target's deformation.

    Parameters
    ----------
    basis : (1 or N, K, 3, M) displacements of the target's points in metres, view by view.
    names : K names of the deformations.
    """
    block, observations = calibration.block, calibration.observations
    if calibration.basis is not None:
        shape = np.tensordot(block.deformation, calibration.basis, axes=1)
        observations = observations.displaced(shape.T)
    J = jacobian(block, observations, calibration.free, None)
    if J is None:
        raise ValueError("the calibration has points behind the camera")
    views, P = observations.views, len(calibration.free)
    shared, poses, residuals = J[:, :P], J[:, P : P + 6], J[:, -1]
    if basis is not None:
        # du/dX = a R with a = du/dt, the last three rows of the pose.
        a = poses[:, 3:].reshape(views, 3, 2, -1)
        in_target = np.einsum("ncsm,ncd->ndsm", a, block.R_CT)
        spread = np.broadcast_to(basis, (views, *basis.shape[1:]))
        rows = np.einsum("ndsm,nkdm->nksm", in_target, spread)
        shared = np.concatenate([shared, rows.reshape(views, basis.shape[1], -1)], axis=1)
    V = poses @ poses.transpose(0, 2, 1)
    W = shared @ poses.transpose(0, 2, 1)
    right = np.concatenate([W.transpose(0, 2, 1), (poses @ residuals[..., None])], axis=2)
    solved = np.linalg.solve(V, right)
    G = shared.shape[1]
    S = shared @ shared.transpose(0, 2, 1) - W @ solved[..., :G]
    b = (shared @ residuals[..., None] - W @ solved[..., G:])[..., 0]
    return Evidence(
        names=tuple(INTRINSICS[i] for i in calibration.free) + names,
        intrinsics=P,
        S=0.5 * (S + S.transpose(0, 2, 1)),
        b=b,
        cost=(residuals**2).sum(axis=1),
        measured=2 * observations.present.sum(axis=1),
        sigma_px=calibration.sigma_px,
    )


def scaled_inverse(S: FloatArray, floor: float = 1e-13) -> FloatArray:
    """Pseudo-inverse of symmetric matrices (..., G, G) after scaling their diagonals to one.

    Directions that hold less than `floor` of the scaled information are left out.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 1e-300))
    values, vectors = np.linalg.eigh(S * scale[..., :, None] * scale[..., None, :])
    kept = values > floor * np.maximum(values[..., -1:], 1e-300)
    inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    middle = (vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(middle * scale[..., :, None] * scale[..., None, :])


def gain(S: FloatArray, b: FloatArray) -> FloatArray:
    """Fall of the cost b' S^-1 b when groups (..., G, G), (..., G) may choose their own parameters."""
    return np.asarray(np.einsum("...g,...gh,...h->...", b, scaled_inverse(S), b))


def overdispersion(found: Evidence) -> float:
    """Factor on standard deviations for views that disagree more than white residuals would.

    The sandwich estimate: the views' own scores against what they should scatter by. Never below one.
    """
    views, G = found.b.shape
    if views < 2 or G == 0:
        return 1.0
    S = found.S.sum(axis=0)
    scatter = found.b.T @ found.b * views / max(views - G / 2.0, 1.0)
    ratio = np.trace(scaled_inverse(S) @ scatter) / (G * found.sigma_px**2)
    return float(np.sqrt(max(ratio, 1.0)))
