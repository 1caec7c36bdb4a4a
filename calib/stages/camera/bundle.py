"""A camera fitted to all views of a target: start, Levenberg-Marquardt, fit, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.geometry import cross_matrices, linear_homographies, rotation_exp
from calib.stages.camera.model import (
    FISHEYE,
    INTRINSICS,
    Block,
    Camera,
    Observations,
    camera_from_vector,
    free_intrinsics,
    jacobian,
    point_derivatives,
    rays,
    undistort,
)

# ----------------------------------------------------------------------
# Levenberg-Marquardt over the poses of all views and what they share, with the poses eliminated.
#
# Minimised is the sum of squared pixel residuals over intrinsics s (shared by all views, with the
# target's deformation if it has one) and one pose z_i for each view. The normal matrix has the shape
#
#     [ U    W_1 ... W_N ]        U = sum_i U_i   (G x G)
#     [ W_1' V_1         ]        V_i             (6 x 6)
#     [ ...       ...    ]
#     [ W_N'         V_N ]
#
# so the poses are eliminated, (U - sum_i W_i V_i^-1 W_i') ds = -(g_s - sum_i W_i V_i^-1 g_i), and the
# cost of an iteration is linear in the number of views.
#
# The search ends when the Newton decrement sqrt(g' H^-1 g) is below 10^-5 of the residuals' standard
# deviation: the step that is left is then a hundred-thousandth of a standard deviation in every
# direction of the parameter space, flat or steep. A limit on iterations is a failure, and named so.
#
# A robust loss is minimised by the same iteration with the weights rho'(r^2) of its points.

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


@dataclass(frozen=True)
class Minimum:
    """Where `minimise` stopped: the block, the problem linearised there, and why it stopped."""

    block: Block
    at: Linearised | None
    reason: str
    evaluations: int
    decrement: float

    @property
    def cost(self) -> float:
        """Value of the loss, infinite behind the camera."""
        return np.inf if self.at is None else self.at.cost


def _moved(block: Block, free: IntArray, shared: FloatArray, poses: FloatArray) -> Block:
    intrinsics = block.intrinsics.copy()
    intrinsics[free] += shared[: len(free)]
    return replace(
        block,
        intrinsics=intrinsics,
        R_CT=rotation_exp(poses[:, :3]) @ block.R_CT,
        t_CT_m=block.t_CT_m + poses[:, 3:],
        deformation=block.deformation + shared[len(free) :],
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
    G = len(free) + (0 if basis is None else basis.shape[-3])
    views, points = observations.views, observations.pixels.shape[1]
    products = np.empty((views, G + 7, G + 7))
    residuals = np.empty((views, 2, points))
    chunk = max(1, _CHUNK // ((G + 7) * points))
    for first in range(0, views, chunk):
        part = slice(first, first + chunk)
        some = basis[part] if basis is not None and basis.ndim == 4 else basis
        J = jacobian(block.part(part), observations.select(part), free, some)
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


# ----------------------------------------------------------------------
# Homographies of the views of a plane, and the poses that they give with a known camera.
#
# A view's homography H = [h1 h2 h3] maps the target's plane to pixels and equals s K [r1 r2 t] (2.9
# with the K that its printed form lacks).


def homographies(observations: Observations) -> FloatArray:
    """Homography from the target's plane (metres) to pixels for each view, shape (N, 3, 3)."""
    present = observations.present.astype(np.float64)
    return linear_homographies(observations.target_m[..., :2], observations.pixels, present)


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


def poses_with_camera(camera: Camera, observations: Observations) -> Block:
    """A known camera with the poses of the views, linear; NaN where the lens cannot show such pixels."""
    ideal = undistort(camera, observations.pixels)
    usable = np.isfinite(ideal).all(axis=2) & observations.present
    enough = usable.sum(axis=1) >= 4
    seen = Observations(
        observations.names, observations.target_m, np.nan_to_num(ideal), usable | ~enough[:, None]
    )
    # Points that a wrong lens puts at random have no pose; callers look for what is not finite.
    with np.errstate(all="ignore"):
        R_CT, t_CT_m = poses_from_homographies(np.eye(3), homographies(seen))
    R_CT[~enough], t_CT_m[~enough] = np.nan, np.nan
    return Block.of(camera, R_CT, t_CT_m)


# ----------------------------------------------------------------------
# A camera fitted to all views of a target (2.10, B.2): the fit, its residuals, and refitted poses.

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
    scale_px : of the robust loss.
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
    scale_px: float
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

    def shaped(self, observations: Observations) -> Observations:
        """Views of the target in the shape that was found for it."""
        if self.basis is None:
            return observations
        return observations.displaced(np.tensordot(self.block.deformation, self.basis, axes=1).T)

    @property
    def weights(self) -> FloatArray:
        """Weights (N, M) of the robust loss, one without."""
        residuals = np.nan_to_num(self.residuals_px.transpose(0, 2, 1))
        return loss_weights(residuals, self.loss, self.scale_px)

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


# Where to start. The cost has wrong minima: of the focal length, and of each view's tilt, since a distant
# plane looks almost as it does leaning the other way along the line of sight, and in a narrow field a lens
# outweighs the difference. So the lens comes first, by what holds at any focal length and tilt: without it
# the views are homographies of the target. Then the focal length, by which the axes of all targets are most
# nearly orthonormal (Zhang 2000), then k1 and k2, a few steps, and each view leaning the other way where that
# agrees better.

_DIVISIONS = np.linspace(-1.0, 0.6, 17)
"""Values of d in x / (1 + d |x|^2), a lens about the picture's centre, in units of its larger side."""
_FOCALS = np.geomspace(0.2, 40.0, 90)
"""Focal lengths, over the picture's larger side."""
_WIDE_STARTS = np.geomspace(0.15, 1.5, 6)
"""Those to begin a fisheye lens with; 1 / pi shows half a sphere."""
_FIRST_ITERATIONS, _TILTINGS = 16, 2
_ANGLES_AS_LENGTHS = {
    "rational8": {"k1": 7 / 9, "k2": 64 / 945, "k4": 10 / 9, "k5": 5 / 21},
    "fisheye4": {},
}
"""Coefficients of a lens that shows angles as lengths: of the rational model the Pade approximant
atan(r) / r = (1 + 7/9 r2 + 64/945 r2^2) / (1 + 10/9 r2 + 5/21 r2^2), right to a percent up to 60 degrees."""


def equidistant_start(
    observations: Observations,
    image_size_px: tuple[int, int],
    focal_px: float,
    model: str = "rational8",
) -> Block:
    """A lens that shows angles as lengths, as wide ones nearly do, and the poses of the views it then has.

    Poses are NaN where it cannot show a view.

    Parameters
    ----------
    model : "rational8" or "fisheye4".
    """
    intrinsics = _centred(image_size_px, focal_px)
    for name, value in _ANGLES_AS_LENGTHS[model].items():
        intrinsics[INTRINSICS.index(name)] = value
    return poses_with_camera(camera_from_vector(model, image_size_px, intrinsics), observations)


def _centred(image_size_px: tuple[int, int], focal_px: float) -> FloatArray:
    """Intrinsics (13,) of a lens without distortion about the picture's centre."""
    intrinsics = np.zeros(len(INTRINSICS))
    intrinsics[:4] = focal_px, focal_px, 0.5 * (image_size_px[0] - 1), 0.5 * (image_size_px[1] - 1)
    return intrinsics


def first_block(
    observations: Observations, image_size_px: tuple[int, int], model: str, free: IntArray
) -> Block:
    """Where to start without a guess, after a few steps; a lens of ratios has at most two coefficients."""
    steps = partial(minimise, observations=observations, max_iterations=_FIRST_ITERATIONS, tolerance=ENOUGH)
    if model == FISHEYE:
        starts = [
            equidistant_start(observations, image_size_px, share * max(image_size_px), FISHEYE)
            for share in _WIDE_STARTS
        ]
        ends = [steps(start, free=free) for start in starts if start.posed.all()]
        best = min(ends, key=lambda one: one.cost, default=None)
        if best is not None and best.at is not None:
            return best.block
        return replace(_straight_start(observations, image_size_px), fisheye=True)
    first = free[np.isin(free, free_intrinsics("radial2", True))]
    found = steps(_with_lens(_straight_start(observations, image_size_px), observations, first), free=first)
    for _ in range(_TILTINGS):
        found = steps(_best_tilts(found, observations), free=first)
    return found.block


def _straight_start(observations: Observations, image_size_px: tuple[int, int]) -> Block:
    """Focal length and poses from homographies by the lens that makes them fit best, without that lens."""
    size, present = max(image_size_px), observations.present.astype(np.float64)
    centre = _centred(image_size_px, 1.0)[2:4]
    seen = (observations.pixels - centre) / size
    plane = np.broadcast_to(observations.target_m[..., :2], seen.shape)

    def without_lens(division: float) -> tuple[FloatArray, float]:
        stretch = 1.0 + division * np.sum(seen**2, axis=2, keepdims=True)
        H = linear_homographies(plane, seen / stretch, present)
        mapped = plane @ H[..., :2].transpose(0, 2, 1) + H[:, None, :, 2]
        # Brought back to the picture, so that a lens that shrinks it gains nothing.
        off = mapped[..., :2] / mapped[..., 2:] * stretch - seen
        return H, float(np.sum(off**2 * present[..., None]))

    costs = np.array([without_lens(division)[1] for division in _DIVISIONS])
    k = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    left, least, right = costs[k - 1 : k + 2]
    bend = left - 2 * least + right
    # The vertex of a parabola through the three; a finer grid finds no other start.
    part = np.clip(0.5 * (left - right) / bend, -1.0, 1.0) if 0.0 < bend < np.inf else 0.0
    H = without_lens(_DIVISIONS[k] + part * (_DIVISIONS[1] - _DIVISIONS[0]))[0]
    focal = min(_FOCALS, key=lambda share: _mismatch(H / [[share], [share], [1.0]]))
    R_CT, t_CT_m = poses_from_homographies(np.diag([focal, focal, 1.0]), H)
    return Block(_centred(image_size_px, focal * size), R_CT, t_CT_m)


def _mismatch(axes: FloatArray) -> float:
    """How far the first two columns (N, 3, 3) are from orthonormal ones, mean over views, dimensionless."""
    a, b = axes[:, :, 0], axes[:, :, 1]
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    return float(np.mean(((aa - bb) ** 2 + 4 * ab**2) / (aa + bb) ** 2))


def _with_lens(start: Block, observations: Observations, free: IntArray) -> Block:
    """The start with k1 and k2 by linear least squares, where they are free and the views tell them."""
    lens = np.array([INTRINSICS.index("k1"), INTRINSICS.index("k2")])
    at = linearise(start, observations, lens, None) if np.isin(lens, free).all() else None
    if at is None:
        return start
    normal, gradient = at.normal[:, :2, :2].sum(axis=0), at.gradient[:, :2].sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    if np.linalg.cond(normal / scale / scale[:, None]) < _WELL_CONDITIONED:
        start.intrinsics[lens] = -np.linalg.solve(normal, gradient)
    return start


def _best_tilts(found: Minimum, observations: Observations) -> Block:
    """The block with each view leaning the other way along its line of sight where it then agrees better."""
    block, present = found.block, observations.present[..., None]
    middle = (observations.target_m * present).sum(axis=1) / present.sum(axis=1)
    place = np.einsum("nij,nj->ni", block.R_CT, middle) + block.t_CT_m
    sight = place / np.linalg.norm(place, axis=1, keepdims=True)
    axes = block.R_CT[..., :2] - 2 * sight[..., None] * (sight[:, None] @ block.R_CT[..., :2])
    R_CT = np.concatenate([axes, np.cross(axes[..., 0], axes[..., 1])[..., None]], axis=2)
    mirrored = replace(block, R_CT=R_CT, t_CT_m=place - np.einsum("nij,nj->ni", R_CT, middle))
    none = np.zeros(0, dtype=np.int64)
    other = minimise(mirrored, observations, none, max_iterations=_FIRST_ITERATIONS, tolerance=ENOUGH)
    if other.at is None or found.at is None:
        return block
    better = (other.at.residuals**2).sum(axis=(1, 2)) < (found.at.residuals**2).sum(axis=(1, 2))
    return replace(
        block,
        R_CT=np.where(better[:, None, None], other.block.R_CT, block.R_CT),
        t_CT_m=np.where(better[:, None], other.block.t_CT_m, block.t_CT_m),
    )


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
    loss : "none", "huber" or "cauchy"; its scale is the median of the plain fit's residuals.
    start : where to start; `first_block` by default, and where it is a start of another kind of lens.
        Coefficients that the model lacks are not taken.
    tolerance : see `minimise`.
    """
    free = free_intrinsics(model, skew, fixed)
    if start is None or start.fisheye != (model == FISHEYE):
        # A lens of angles and one of ratios have nothing but poses in common.
        start = first_block(observations, image_size_px, model, free)
    known = np.isin(np.arange(len(INTRINSICS)), free_intrinsics(model, True))
    start = replace(start, intrinsics=np.where(known, start.intrinsics, 0.0))
    deformations = 0 if basis is None else len(basis)
    if len(start.deformation) != deformations:
        start = replace(start, deformation=np.zeros(deformations))
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
        scale_px=scale_px,
        normal=normal,
        termination=found.reason,
        evaluations=evaluations,
        decrement=found.decrement,
        loss=loss,
    )


def refitted(
    calibration: Calibration,
    index: IntArray | None = None,
    *,
    model: str | None = None,
    start: Block | None = None,
    **changes: Any,
) -> Calibration:
    """The calibration again from where it is, with what is held, board and loss alike but for the changes.

    Parameters
    ----------
    index : of the views to go by; all by default. model : another lens model.
    start : where to start, of the views to go by. changes : further arguments of `calibrate`.
    """
    camera, block, observations = calibration.camera, calibration.block, calibration.observations
    if index is not None:
        observations, block = observations.select(index), block.part(index)
    same = {"basis": calibration.basis, "loss": calibration.loss, "fixed": held(calibration)}
    return calibrate(
        changes.pop("observations", observations),
        camera.image_size_px,
        model or camera.model,
        skew="skew_px" in calibration.free_names,
        start=block if start is None else start,
        **(same | changes),
    )


def held(calibration: Calibration) -> tuple[str, ...]:
    """Names of intrinsics that the model has and the calibration does not estimate."""
    every = free_intrinsics(calibration.camera.model, True)
    return tuple(INTRINSICS[i] for i in every if i not in calibration.free)


def refit_poses(calibration: Calibration, observations: Observations) -> FloatArray:
    """Residuals (N, M, 2) of other views of the same target with this camera and only poses fitted.

    NaN throughout a view that cannot be fitted.
    """
    residuals = np.full(observations.pixels.shape, np.nan)
    start = poses_with_camera(calibration.camera, observations)
    usable = np.flatnonzero(start.posed)
    if len(usable) == 0:
        return residuals
    seen = calibration.shaped(observations.select(usable))
    found = minimise(start.part(usable), seen, np.zeros(0, dtype=np.int64), tolerance=ENOUGH)
    if found.at is not None:
        residuals[usable] = np.where(seen.present[..., None], found.at.residuals.transpose(0, 2, 1), np.nan)
    return residuals


# ----------------------------------------------------------------------
# Standard deviations of a calibration: intrinsics, poses, and projection over the image.
#
# With the normal matrix H of the adjustment and the residuals' variance sigma^2, the covariance of all
# parameters is sigma^2 H^-1. Its block of the intrinsics is the inverse of the Schur complement S, and for
# view i
#
#     cov(z_i) = V_i^-1 + E_i S^-1 E_i',   cov(s, z_i) = -S^-1 E_i',   E_i = V_i^-1 W_i'.
#
# Projection uncertainty asks how far a point that is fixed in the scene would move in the picture if
# the pictures were taken again (mrcal's question). New pictures change the intrinsics and, with them,
# all poses; a common rigid motion g = (omega, tau) of the poses, taken in the camera's frame, is
# invisible and only says where the camera thinks it stands. It is taken as the motion that best
# explains the change of the poses, weighted by what each view knows,
#
#     g = (sum_i G_i' V_i G_i)^-1 sum_i G_i' V_i dz_i,   G_i = [[1, 0], [-[t_i]x, 1]],
#
# and the point p of the camera's frame then moves by omega x p + tau before it is projected.


@dataclass(frozen=True)
class Covariance:
    """Covariance of a calibration's parameters.

    Attributes
    ----------
    names : the estimated intrinsics, in order.
    intrinsics : (P, P); infinite where the data leave a direction free.
    joint : (P + 6, P + 6) of the intrinsics and the common motion g (rad, m).
    distance_m : median distance of the targets' centres, where projection uncertainty is quoted.
    """

    names: tuple[str, ...]
    intrinsics: FloatArray
    joint: FloatArray
    distance_m: float

    def sigma(self) -> dict[str, float]:
        """Standard deviation of each estimated intrinsic by name."""
        variance = np.diag(self.intrinsics)
        # Where rounding leaves no positive variance the data do not bound it.
        bounded = np.sqrt(np.where(variance >= 0.0, variance, np.inf))
        return dict(zip(self.names, bounded.tolist(), strict=True))


def covariance(
    calibration: Calibration, variance_px2: float | None = None, shifts: Sequence[FloatArray] = ()
) -> Covariance:
    """Covariance of the intrinsics and the common motion, everything else that was estimated following.

    Parameters
    ----------
    variance_px2 : variance of one measured coordinate; from the residuals by default.
    shifts : (P,) each, one standard deviation of what else may move the intrinsics, and the poses with them.
    """
    variance = calibration.sigma_px**2 if variance_px2 is None else variance_px2
    H = calibration.normal
    P = len(calibration.free)
    G = P + len(calibration.block.deformation)
    V, W, U = H[:, G:, G:], H[:, :G, G:], H[:, :G, :G].sum(axis=0)
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
            np.diag(np.full(P + 6, np.inf)),
            distance,
        )
    F = common_motion(V, t)
    of_shared = -np.einsum("nab,nbg->ag", F, E)
    own = np.einsum("nab,nbc,ndc->ad", F, V_inverse, F)
    shared = variance * S_inverse
    for shift in shifts:
        shared[:P, :P] += np.outer(shift, shift)
    joint = np.zeros((P + 6, P + 6))
    joint[:P, :P] = shared[:P, :P]
    joint[P:, :P] = (of_shared @ shared)[:, :P]
    joint[:P, P:] = joint[P:, :P].T
    joint[P:, P:] = of_shared @ shared @ of_shared.T + variance * own
    return Covariance(calibration.free_names, shared[:P, :P], joint, distance)


def common_motion(V: FloatArray, t_CT_m: FloatArray) -> FloatArray:
    """F (N, 6, 6) of g = sum_i F_i dz_i, from the poses' information (N, 6, 6) and places (N, 3)."""
    motion = np.zeros_like(V)
    motion[:, :3, :3] = motion[:, 3:, 3:] = np.eye(3)
    motion[:, 3:, :3] = -cross_matrices(t_CT_m)
    weighted = motion.transpose(0, 2, 1) @ V
    return np.linalg.solve((weighted @ motion).sum(axis=0), weighted)


def joint_jacobian(calibration: Calibration, points_C: FloatArray) -> FloatArray:
    """Derivative (n, 2, P + 6) of the pixels of points (n, 3) by the intrinsics and the common motion g."""
    return point_derivatives(calibration.camera, points_C, calibration.free)[..., :-1]


def projection_sigma_px(calibration: Calibration, found: Covariance, pixels: FloatArray) -> FloatArray:
    """Standard deviation of projection at these pixels (n, 2), in pixels, shape (n,).

    Of points at the targets' median distance. The root of the larger eigenvalue of the 2 x 2 covariance:
    the worst direction. NaN where the lens cannot show the pixel.
    """
    points = found.distance_m * rays(calibration.camera, pixels)
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
