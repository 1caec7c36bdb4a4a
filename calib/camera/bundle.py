"""Bundle adjustment of a camera over all views of a target (2.10, B.2), by Levenberg-Marquardt.

Minimised is the sum of squared pixel residuals over intrinsics s (shared by all views, with the
target's deformation if it has one) and one pose z_i for each view. The normal matrix has the shape

    [ U    W_1 ... W_N ]        U = sum_i U_i   (G x G)
    [ W_1' V_1         ]        V_i             (6 x 6)
    [ ...       ...    ]
    [ W_N'         V_N ]

so the poses are eliminated, (U - sum_i W_i V_i^-1 W_i') ds = -(g_s - sum_i W_i V_i^-1 g_i), and the
cost of an iteration is linear in the number of views.

The search ends when the Newton decrement sqrt(g' H^-1 g) is below 10^-5 of the residuals' standard
deviation: the step that is left is then a hundred-thousandth of a standard deviation in every
direction of the parameter space, flat or steep. A limit on iterations is a failure, and named so.

A robust loss is minimised by the same iteration with the weights rho'(r^2) of its points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.camera.model import Camera
from calib.camera.projection import (
    INTRINSICS,
    Block,
    camera_from_vector,
    free_intrinsics,
    jacobian,
    vector_from_camera,
)
from calib.camera.views import Observations
from calib.camera.zhang import initial_guess, poses_with_camera

__all__ = [
    "LOSSES",
    "Calibration",
    "Linearised",
    "Minimum",
    "calibrate",
    "linearise",
    "minimise",
    "refit_poses",
    "rotation_exp",
    "starting_block",
]

LOSSES = ("none", "huber", "cauchy")

_DECREMENT = 1e-5
_MAX_ITERATIONS = 300
_ENOUGH = 1e-2
"""Tolerance where only the residuals count: they are then right to a part in 10^4."""
_WELL_CONDITIONED = 1e6
_LEVEL_STEPS = 4
"""Steps that may leave the cost as it is."""
_FINEST_PX = 1e-4
"""Residuals of made-up data can be zero; rounding is then the only noise, well below this."""
_ROUNDING = 1.0 + 1e-12
"""A cost that differs by less is the same cost."""
_CHUNK = 80_000
"""Jacobian entries of a chunk of views, halved: about 1.3 MB."""
_TUNING = {"huber": 1.345, "cauchy": 2.385}
"""95 % efficiency on Gaussian residuals."""


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
        """Sum of squared residuals, pixels squared, without weights."""
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


def rotation_exp(delta: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) (Rodrigues), smooth at zero."""
    angle = np.linalg.norm(delta, axis=1)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    S = np.zeros((len(delta), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -delta[:, 2], delta[:, 1], -delta[:, 0]
    S -= S.transpose(0, 2, 1)
    return np.asarray(np.eye(3) + a[:, None, None] * S + b[:, None, None] * (S @ S))


@dataclass(frozen=True)
class Minimum:
    """Where `minimise` stopped: the block, the problem linearised there, and why it stopped."""

    block: Block
    at: Linearised | None
    reason: str
    evaluations: int
    decrement: float


def _moved(block: Block, free: IntArray, shared: FloatArray, poses: FloatArray) -> Block:
    intrinsics = block.intrinsics.copy()
    intrinsics[free] += shared[: len(free)]
    return Block(
        intrinsics,
        rotation_exp(poses[:, :3]) @ block.R_CT,
        block.t_CT_m + poses[:, 3:],
        block.deformation + shared[len(free) :],
    )


def _weights(residuals: FloatArray, loss: str, scale_px: float) -> FloatArray:
    """Weights rho'(s) of points (N, M) from residuals (N, 2, M)."""
    if loss == "none":
        return np.ones((len(residuals), residuals.shape[2]))
    distance = np.hypot(residuals[:, 0], residuals[:, 1]) / (_TUNING[loss] * scale_px)
    if loss == "huber":
        return 1.0 / np.maximum(distance, 1.0)
    return 1.0 / (1.0 + distance**2)


def _loss_sum(residuals: FloatArray, loss: str, scale_px: float) -> float:
    if loss == "none":
        return float(np.vdot(residuals, residuals))
    squared = residuals[:, 0] ** 2 + residuals[:, 1] ** 2
    c2 = (_TUNING[loss] * scale_px) ** 2
    if loss == "huber":
        return float(np.where(squared <= c2, squared, 2 * np.sqrt(c2 * squared) - c2).sum())
    return float((c2 * np.log1p(squared / c2)).sum())


@dataclass(frozen=True)
class Linearised:
    """The problem about a block.

    Attributes
    ----------
    normal : (N, G + 6, G + 6) weighted J J' of each view.
    gradient : (N, G + 6) weighted J r of each view.
    residuals : (N, 2, M) without weights, zero where there is no point.
    cost : value of the loss.
    """

    normal: FloatArray
    gradient: FloatArray
    residuals: FloatArray
    cost: float


def linearise(
    block: Block,
    observations: Observations,
    free: IntArray,
    basis: FloatArray | None,
    loss: str = "none",
    scale_px: float = 1.0,
) -> Linearised | None:
    """Normal equations of all views at `block`, or None where a point is behind the camera.

    Views are taken a chunk at a time, so that a chunk's Jacobian stays in the processor's cache.
    """
    G = len(free) + (0 if basis is None else len(basis))
    views, points = observations.views, observations.pixels.shape[1]
    products = np.empty((views, G + 7, G + 7))
    residuals = np.empty((views, 2, points))
    chunk = max(1, _CHUNK // ((G + 7) * points))
    for first in range(0, views, chunk):
        part = slice(first, first + chunk)
        J = jacobian(block.part(part), observations.part(part), free, basis)
        if J is None:
            return None
        residuals[part] = J[:, -1].reshape(-1, 2, points)
        if loss != "none":
            J *= np.sqrt(np.tile(_weights(residuals[part], loss, scale_px), 2))[:, None]
        np.matmul(J, J.transpose(0, 2, 1), out=products[part])
    return Linearised(
        products[:, :-1, :-1], products[:, :-1, -1], residuals, _loss_sum(residuals, loss, scale_px)
    )


def _solve_step(at: Linearised, G: int, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """Step (G,), (N, 6) of the damped normal equations, or None where they are singular."""
    V, W, U = at.normal[:, G:, G:], at.normal[:, :G, G:], at.normal[:, :G, :G].sum(axis=0)
    if damping:
        V = V * (1.0 + damping * np.eye(6))
        U = U * (1.0 + damping * np.eye(G))
    right = np.concatenate([W.transpose(0, 2, 1), at.gradient[:, G:, None]], axis=2)
    try:
        eliminated = np.linalg.solve(V, right)
        if G == 0:
            return np.zeros(0), -eliminated[..., 0]
        reduced = W.transpose(1, 0, 2).reshape(G, -1) @ eliminated.reshape(-1, G + 1)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(U), 1e-300))
        S = (U - reduced[:, :G]) * scale * scale[:, None]
        step = -scale * np.linalg.solve(S, scale * (at.gradient[:, :G].sum(axis=0) - reduced[:, G]))
    except np.linalg.LinAlgError:
        return None
    poses = -eliminated[..., G] - eliminated[..., :G] @ step
    if not (np.all(np.isfinite(step)) and np.all(np.isfinite(poses))):
        return None
    return step, poses


def minimise(
    block: Block,
    observations: Observations,
    free: IntArray,
    basis: FloatArray | None = None,
    loss: str = "none",
    scale_px: float = 1.0,
    max_iterations: int = _MAX_ITERATIONS,
    tolerance: float = _DECREMENT,
) -> Minimum:
    """Levenberg-Marquardt from `block`; the problem linearised where it stopped comes with the answer.

    `tolerance` is the relative Newton decrement to reach, in standard deviations.
    """
    G = len(free) + (0 if basis is None else len(basis))
    freedom = max(2 * observations.points - G - 6 * observations.views, 1)
    at = linearise(block, observations, free, basis, loss, scale_px)
    if at is None:
        return Minimum(block, None, "behind the camera", 1, np.inf)
    damping, evaluations, decrement, level = 1e-6, 1, np.inf, 0
    while True:
        step = _solve_step(at, G, damping)
        if step is not None:
            decrement = _decrement(at, G, step, freedom)
            if decrement < tolerance and damping > 0.0:
                # Damping shortens steps along flat valleys, so the test is made without it.
                step, damping = _solve_step(at, G, 0.0), 0.0
                decrement = np.inf if step is None else _decrement(at, G, step, freedom)
            if decrement < tolerance:
                return Minimum(block, at, "converged", evaluations, decrement)
        if evaluations >= max_iterations:
            return Minimum(block, at, "iterations", evaluations, decrement)
        accepted = None
        if step is not None:
            trial = _moved(block, free, *step)
            accepted = linearise(trial, observations, free, basis, loss, scale_px)
            evaluations += 1
        if accepted is not None and np.isfinite(accepted.cost) and accepted.cost <= at.cost * _ROUNDING:
            level += accepted.cost >= at.cost * (2.0 - _ROUNDING)
            block, at = trial, accepted
            damping = damping * 0.01 if damping > 1e-13 else 0.0
        else:
            # So near, a full step only fails to lower the cost where rounding is reached.
            level += damping == 0.0 and decrement < 1e-3
            damping = max(10.0 * damping, 1e-13)
        if damping > 1e10 or level > _LEVEL_STEPS:
            # No step lowers the cost: rounding is reached, or there is no minimum to be found.
            reason = "converged" if decrement < 1e-3 else "singular" if step is None else "stalled"
            return Minimum(block, at, reason, evaluations, decrement)


def _decrement(at: Linearised, G: int, step: tuple[FloatArray, FloatArray], freedom: int) -> float:
    """Newton decrement over the residuals' standard deviation.

    The sign is dropped: with a nearly singular normal matrix rounding can turn it.
    """
    slope = at.gradient[:, :G].sum(axis=0) @ step[0] + np.vdot(at.gradient[:, G:], step[1])
    return float(np.sqrt(abs(slope) / max(at.cost / freedom, _FINEST_PX**2)))


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
    max_iterations: int = _MAX_ITERATIONS,
    tolerance: float = _DECREMENT,
) -> Calibration:
    """Fit a camera to views of a target.

    Parameters
    ----------
    model : a key of `model.MODELS`.
    skew : whether the skew is estimated; otherwise it is zero.
    fixed : names of intrinsics held at the start's values.
    basis : (K, 3, M) deformation of the target, which then has to be the same in all views.
    loss : one of `LOSSES`; its scale is the median of the plain fit's residuals.
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
        weights=_weights(residuals, loss, scale_px),
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
    found = minimise(start, seen, np.zeros(0, dtype=np.int64), tolerance=_ENOUGH)
    if found.at is not None:
        residuals[usable] = np.where(seen.present[..., None], found.at.residuals.transpose(0, 2, 1), np.nan)
    return residuals
