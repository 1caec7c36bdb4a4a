"""Levenberg-Marquardt over the poses of all views and what they share, with the poses eliminated.

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
from calib.camera.projection import Block, jacobian
from calib.camera.views import Observations

__all__ = [
    "ENOUGH",
    "LOSSES",
    "MAX_ITERATIONS",
    "TOLERANCE",
    "Linearised",
    "Minimum",
    "linearise",
    "loss_weights",
    "minimise",
    "rotation_exp",
]

LOSSES = ("none", "huber", "cauchy")

TOLERANCE = 1e-5
"""Newton decrement that ends the search, in standard deviations."""
MAX_ITERATIONS = 300
ENOUGH = 1e-2
"""Tolerance where only the residuals count: they are then right to a part in 10^4."""
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


def loss_weights(residuals: FloatArray, loss: str, scale_px: float) -> FloatArray:
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
            J *= np.sqrt(np.tile(loss_weights(residuals[part], loss, scale_px), 2))[:, None]
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
    max_iterations: int = MAX_ITERATIONS,
    tolerance: float = TOLERANCE,
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
                if step is None:
                    # Damped again the same would follow, without an end.
                    return Minimum(block, at, "singular", evaluations, decrement)
                decrement = _decrement(at, G, step, freedom)
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
