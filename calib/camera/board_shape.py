"""Is the target what it is said to be: flat, its squares square?

A wrong target leaves residuals that repeat from view to view in the target's own frame. Five
deformations that a printed sheet really shows are tried at once, as shared parameters that rest at
zero: the height of the squares over their width, shear, a bow along each axis and a twist. One
Gauss-Newton step from the solution, poses and intrinsics following, gives each with its standard
deviation; the problem is close to linear in deformations that are small beside the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.bundle import Calibration
from calib.camera.evidence import evidence, gain, overdispersion, scaled_inverse

__all__ = ["DEFORMATIONS", "TargetShape", "target_shape"]

DEFORMATIONS = ("aspect", "shear", "bow_x", "bow_y", "twist")


@dataclass(frozen=True)
class TargetShape:
    """Deformation of the target that explains the residuals best.

    Attributes
    ----------
    aspect, aspect_sigma : height of what is said to be a square over its width, less one.
    bow_m : largest departure from flatness between the target's middle and its border.
    bow_significance : square root of the Wald statistic of the three bows, over its degrees of freedom.
    size_m : longer side of the target.
    rms_drop : share by which the RMS would fall with all five deformations.
    focal_shift : share by which fx would move.
    focal_per_bow : share by which fx moves for a bow of half a percent of the target's size.
    values, sigma : (5,) in the order of `DEFORMATIONS`; slopes, and metres for bows and twist.
    displacement_m : (1 or N, M, 3) of the target's points, all five together.
    """

    aspect: float
    aspect_sigma: float
    bow_m: float
    bow_significance: float
    size_m: float
    rms_drop: float
    focal_shift: float
    focal_per_bow: float
    values: FloatArray
    sigma: FloatArray
    displacement_m: FloatArray


def _basis(calibration: Calibration) -> tuple[FloatArray, float]:
    """Displacements (1 or N, 5, 3, M) of the points, and half the target's longer side."""
    target = calibration.observations.target_m
    present = np.broadcast_to(calibration.observations.present, calibration.observations.pixels.shape[:2])
    used = np.broadcast_to(target, (*present.shape, 3))[present]
    low, high = used[:, :2].min(axis=0), used[:, :2].max(axis=0)
    half = 0.5 * float((high - low).max())
    x, y = np.moveaxis(target[..., :2] - 0.5 * (low + high), 2, 0)
    basis = np.zeros((target.shape[0], 5, 3, target.shape[1]))
    basis[:, 0, 1] = y
    basis[:, 1, 0] = y
    basis[:, 2, 2] = 1.0 - (x / half) ** 2
    basis[:, 3, 2] = 1.0 - (y / half) ** 2
    basis[:, 4, 2] = x * y / half**2
    return basis, half


def target_shape(calibration: Calibration) -> TargetShape | None:
    """Deformation of the target; None where the data are too few to say."""
    if calibration.degrees_of_freedom <= 2 * len(DEFORMATIONS) or len(calibration.free) == 0:
        return None
    basis, half = _basis(calibration)
    found = evidence(calibration, basis, DEFORMATIONS)
    P = found.intrinsics
    S, b = found.S.sum(axis=0), found.b.sum(axis=0)
    inverse = scaled_inverse(S, 1e-12)
    step = -inverse @ b
    left = max(calibration.squared_sum - float(gain(S, b)), 0.0)
    freedom = max(calibration.degrees_of_freedom - len(DEFORMATIONS), 1)
    inflation = overdispersion(found)
    # Noise after the deformations are taken out, lest they hide in their own residuals.
    cov = inverse * (left / freedom) * inflation**2
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    bows = step[P + 2 :]
    wald = float(bows @ np.linalg.pinv(cov[P + 2 :, P + 2 :], hermitian=True) @ bows)
    fx_at = found.names.index("fx_px") if "fx_px" in found.names else -1
    fx = calibration.camera.fx_px
    coupling = -scaled_inverse(S[:P, :P]) @ S[:P, P:] if fx_at >= 0 else np.zeros((1, 5))
    row = coupling[fx_at] if fx_at >= 0 else coupling[0]
    return TargetShape(
        aspect=float(step[P]),
        aspect_sigma=float(sigma[P]),
        bow_m=_departure(bows, basis[:, 2:, 2]),
        bow_significance=float(np.sqrt(wald / 3)),
        size_m=2 * half,
        rms_drop=1.0 - float(np.sqrt(left / max(calibration.squared_sum, 1e-300))),
        focal_shift=float(step[fx_at] / fx) if fx_at >= 0 else 0.0,
        focal_per_bow=float(np.abs(row[2:4]).max() * 0.01 * half / fx),
        values=step[P:],
        sigma=sigma[P:],
        displacement_m=np.tensordot(step[P:], basis, axes=(0, 1)).transpose(0, 2, 1),
    )


def _departure(bows: FloatArray, shapes: FloatArray) -> float:
    """Range of the bent surface over the points, metres."""
    z = np.tensordot(bows, shapes, axes=(0, 1))
    return float(z.max() - z.min())
