"""A camera fitted to all views of a target (2.10, B.2): the fit, its residuals, and refitted poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.levenberg import ENOUGH, MAX_ITERATIONS, TOLERANCE, linearise, loss_weights, minimise
from calib.camera.model import Camera
from calib.camera.projection import (
    INTRINSICS,
    Block,
    camera_from_vector,
    free_intrinsics,
    vector_from_camera,
)
from calib.camera.views import Observations
from calib.camera.zhang import initial_guess, poses_with_camera

__all__ = ["Calibration", "calibrate", "refit_poses", "starting_block"]

_WELL_CONDITIONED = 1e6


@dataclass(frozen=True)
class Calibration:
    """A camera fitted to views.

    Attributes
    ----------
    camera : the intrinsics found.
    free : indices into `projection.INTRINSICS` of what was estimated.
    block : intrinsics, poses and deformation as the solver holds them.
    basis : (K, 3, M) of the target's deformation, or None.
    residuals_px : (N, M, 2) projected minus measured; NaN where there is no point.
    weights : (N, M) of the robust loss, one without.
    normal : (N, G + 6, G + 6) weighted normal matrix of each view at the solution.
    termination : "converged", "stalled", "iterations", "singular" or "behind the camera".
    evaluations : evaluations of the Jacobian.
    decrement : sqrt(g' H^-1 g) at the end, over the standard deviation of the residuals.
    """

    camera: Camera
    free: IntArray
    block: Block
    basis: FloatArray | None
    observations: Observations
    residuals_px: FloatArray
    weights: FloatArray
    normal: FloatArray
    termination: str
    evaluations: int
    decrement: float
    loss: str = "none"

    @property
    def converged(self) -> bool:
        """Whether the gradient test was met."""
        return self.termination == "converged"

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the estimated intrinsics."""
        return tuple(INTRINSICS[i] for i in self.free)

    @property
    def squared_sum(self) -> float:
        """Sum of squared residuals, pixels squared, without weights; NaN where no camera was found."""
        if not np.isfinite(self.residuals_px).any():
            return float("nan")
        return float(np.nansum(self.residuals_px**2))

    @property
    def rms_px(self) -> float:
        """sqrt(mean |residual vector|^2) over points, as OpenCV reports it."""
        return float(np.sqrt(self.squared_sum / self.observations.points))

    @property
    def view_rms_px(self) -> FloatArray:
        """RMS of each view, (N,)."""
        return np.asarray(np.sqrt(np.nanmean(np.sum(self.residuals_px**2, axis=2), axis=1)))

    @property
    def mean_error_px(self) -> float:
        """Mean distance between measured and projected points, as the source document reports it."""
        return float(np.nanmean(np.hypot(self.residuals_px[..., 0], self.residuals_px[..., 1])))

    @property
    def degrees_of_freedom(self) -> int:
        """Measured coordinates less estimated parameters."""
        parameters = len(self.free) + len(self.block.deformation) + 6 * self.observations.views
        return 2 * self.observations.points - parameters

    @property
    def sigma_px(self) -> float:
        """Standard deviation of one measured coordinate, estimated from the residuals.

        With a robust loss: Huber's estimate, from the weighted residuals and the share of points
        that the loss leaves at full weight.
        """
        freedom = max(self.degrees_of_freedom, 1)
        if self.loss == "none":
            return float(np.sqrt(self.squared_sum / freedom))
        squared = np.nansum(self.residuals_px**2, axis=2)
        used = self.observations.present
        psi = np.sum((self.weights**2 * squared)[used])
        share = np.mean(self.weights[used])
        return float(np.sqrt(psi / freedom) / share)


def starting_block(
    observations: Observations, image_size_px: tuple[int, int], skew: bool, free: IntArray | None = None
) -> Block:
    """Zhang's closed form as a start, with k1 and k2 by linear least squares where they are free."""
    guess = initial_guess(observations, image_size_px, skew)
    intrinsics = np.zeros(len(INTRINSICS))
    intrinsics[:5] = guess.K[0, 0], guess.K[1, 1], guess.K[0, 2], guess.K[1, 2], guess.K[0, 1]
    start = Block(intrinsics, guess.R_CT, guess.t_CT_m, np.zeros(0))
    lens = np.array([INTRINSICS.index("k1"), INTRINSICS.index("k2")])
    if free is None or not np.isin(lens, free).all():
        return start
    at = linearise(start, observations, lens, None)
    if at is None:
        return start
    normal, gradient = at.normal[:, :2, :2].sum(axis=0), at.gradient[:, :2].sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    if np.linalg.cond(normal / scale / scale[:, None]) < _WELL_CONDITIONED:
        intrinsics[lens] = -np.linalg.solve(normal, gradient)
    return start


def calibrate(
    observations: Observations,
    image_size_px: tuple[int, int],
    model: str,
    *,
    skew: bool = False,
    fixed: tuple[str, ...] = (),
    basis: FloatArray | None = None,
    loss: str = "none",
    start: Block | None = None,
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
) -> Calibration:
    """Fit a camera to views of a target.

    Parameters
    ----------
    model : a key of `model.MODELS`.
    skew : whether the skew is estimated; otherwise it is zero.
    fixed : names of intrinsics held at the start's values.
    basis : (K, 3, M) deformation of the target, which then has to be the same in all views.
    loss : one of `levenberg.LOSSES`; its scale is the median of the plain fit's residuals.
    start : where to start; Zhang's closed form by default.
    tolerance : see `minimise`.
    """
    free = free_intrinsics(model, skew, fixed)
    if start is None:
        start = starting_block(observations, image_size_px, skew, free)
    if basis is not None and len(start.deformation) != len(basis):
        start = Block(start.intrinsics, start.R_CT, start.t_CT_m, np.zeros(len(basis)))
    if basis is None and len(start.deformation):
        start = Block(start.intrinsics, start.R_CT, start.t_CT_m, np.zeros(0))
    found = minimise(start, observations, free, basis, max_iterations=max_iterations, tolerance=tolerance)
    evaluations, scale_px = found.evaluations, 1.0
    if loss != "none":
        for _ in range(3):
            if found.at is None:
                break
            distance = np.hypot(found.at.residuals[:, 0], found.at.residuals[:, 1])
            # The median of a Rayleigh distribution is 1.1774 sigma.
            scale_px = max(float(np.median(distance[observations.present])) / 1.1774, 1e-9)
            found = minimise(
                found.block, observations, free, basis, loss, scale_px, max_iterations, tolerance
            )
            evaluations += found.evaluations
    camera = camera_from_vector(model, image_size_px, found.block.intrinsics)
    G, M = len(free) + len(found.block.deformation), observations.pixels.shape[1]
    if found.at is None:
        normal = np.full((observations.views, G + 6, G + 6), np.nan)
        residuals = np.full((observations.views, 2, M), np.nan)
    else:
        normal, residuals = found.at.normal, found.at.residuals
    return Calibration(
        camera=camera,
        free=free,
        block=found.block,
        basis=basis,
        observations=observations,
        residuals_px=np.where(observations.present[..., None], residuals.transpose(0, 2, 1), np.nan),
        weights=loss_weights(residuals, loss, scale_px),
        normal=normal,
        termination=found.reason,
        evaluations=evaluations,
        decrement=found.decrement,
        loss=loss,
    )


def refit_poses(calibration: Calibration, observations: Observations) -> FloatArray:
    """Residuals (N, M, 2) of other views of the same target with this camera and only poses fitted.

    NaN throughout a view that cannot be fitted.
    """
    residuals = np.full(observations.pixels.shape, np.nan)
    R_CT, t_CT_m = poses_with_camera(calibration.camera, observations)
    usable = np.flatnonzero(np.isfinite(R_CT).all(axis=(1, 2)) & np.isfinite(t_CT_m).all(axis=1))
    if len(usable) == 0:
        return residuals
    seen = observations.select(usable)
    if calibration.basis is not None:
        shape = np.tensordot(calibration.block.deformation, calibration.basis, axes=1)
        seen = seen.displaced(shape.T)
    start = Block(vector_from_camera(calibration.camera), R_CT[usable], t_CT_m[usable], np.zeros(0))
    found = minimise(start, seen, np.zeros(0, dtype=np.int64), tolerance=ENOUGH)
    if found.at is not None:
        residuals[usable] = np.where(seen.present[..., None], found.at.residuals.transpose(0, 2, 1), np.nan)
    return residuals
