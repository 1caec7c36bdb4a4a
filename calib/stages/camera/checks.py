"""What the views of a calibration say: repeats, evidence, other minima, two cameras, what to take next."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray, evenly
from calib.core.geometry import box_grid, rotation_exp
from calib.solve.information import scaled_inverse
from calib.stages.camera import bundle, model

# ----------------------------------------------------------------------
# Where views show the board, which of them show it where others do, and how far the lens is one-to-one.

_DIRECTIONS = 72
_PER_SIDE = 9
"""Pixels, with both corners, of each side of the picture's outline."""
ONE_TO_ONE_REACH = 1.05
"""How far a lens has to be one-to-one, over the distance of the picture's farthest corner."""
_MAX_PAIRED = 2000
"""Views above which repeats are sought among the first ones only."""
_SAME_PX, _SAME_SHARE = 0.3, 0.004
"""Motion of a board that is none, and as a share of the picture's width the most that noise may pass for."""


@dataclass(frozen=True)
class Lens:
    """Shape of the distortion over the image.

    Attributes
    ----------
    folds_among_points : whether the lens folds over, or has a pole, at an angle that was seen.
    image_shown : share of points along the image's border that the model can show at all.
    reach : `model.one_to_one_reach`.
    """

    folds_among_points: bool
    image_shown: float
    reach: float

    @property
    def one_to_one(self) -> bool:
        """Whether no two directions share a pixel, over the whole picture and a margin."""
        return not self.folds_among_points and self.image_shown == 1.0 and self.reach > ONE_TO_ONE_REACH


def hull(points: FloatArray) -> FloatArray:
    """Extreme points (H, 2) of a set (n, 2) in 72 directions, in order around it: its hull to a percent."""
    angle = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    extreme = np.argmax(np.stack([np.cos(angle), np.sin(angle)], axis=1) @ points.T, axis=1)
    kept = np.flatnonzero(np.diff(extreme, prepend=extreme[-1]) != 0)
    return np.asarray(points[extreme[kept]] if len(kept) else points[extreme[:1]])


def hull_area(points: FloatArray) -> float:
    """Area of the hull of points (n, 2)."""
    corners = hull(points)
    x, y = corners[:, 0], corners[:, 1]
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def target_box(calibration: bundle.Calibration) -> FloatArray:
    """Corners (4, 3) of the box around all points of the target, on its plane."""
    observations = calibration.observations
    target = np.broadcast_to(observations.target_m, (*observations.pixels.shape[:2], 3))
    used = target[observations.present]
    (x0, y0), (x1, y1) = used[:, :2].min(axis=0), used[:, :2].max(axis=0)
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def cell_of(
    pixels: FloatArray, image_size_px: tuple[int, int], columns: int, rows: int
) -> tuple[IntArray, IntArray]:
    """Column and row of the cell of the picture in which each pixel (n, 2) lies."""
    column = np.clip((pixels[:, 0] + 0.5) / image_size_px[0] * columns, 0, columns - 1).astype(np.int64)
    row = np.clip((pixels[:, 1] + 0.5) / image_size_px[1] * rows, 0, rows - 1).astype(np.int64)
    return column, row


def repeated_views(observations: model.Observations, width_px: int) -> IntArray:
    """For each view the one that others show the board in the same place as, often itself, (N,).

    The same place: the points that both show, at least half of the poorer view's, are apart by no more than
    their noise may do, root mean square. A quadratic in the pixels, as a change of pose is to first order,
    tells a board that moved from noise. Needs no camera, as copies must not help to choose one.
    """
    N, M = observations.present.shape
    first = np.arange(N)
    places = np.broadcast_to(observations.target_m[..., 0] + 1j * observations.target_m[..., 1], (N, M))
    there, point = np.unique(places[observations.present], return_inverse=True)
    if len(there) > 4 * M:
        # Most views have points of their own.
        return first
    pixels = np.full((N, len(there), 2), np.nan)
    pixels[np.nonzero(observations.present)[0], point] = observations.pixels[observations.present]
    counts = observations.present.sum(axis=1)
    kept: list[int] = []
    for i in np.argsort(-counts, kind="stable")[:_MAX_PAIRED]:
        apart = pixels[kept] - pixels[i]
        common = np.isfinite(apart[..., 0])
        shared = common.sum(axis=1)
        squared = np.where(common[..., None], apart, 0.0)
        near = np.sum(squared**2, axis=(1, 2)) < (3 * _SAME_SHARE * width_px) ** 2 * shared
        for k in np.flatnonzero(near & (shared >= np.maximum(0.5 * counts[i], 4))):
            if _same_place(apart[k, common[k]], pixels[i, common[k]], width_px):
                first[i] = kept[k]
                break
        else:
            kept.append(int(i))
    return first


def _same_place(apart: FloatArray, pixels: FloatArray, width_px: int) -> bool:
    """Whether differences (n, 2) of pixels (n, 2) come from noise and next to no motion."""
    u, v = ((pixels - pixels.mean(axis=0)) / max(float(np.ptp(pixels)), 1e-9)).T
    basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    motion = basis @ np.linalg.lstsq(basis, apart, rcond=None)[0]
    # Each of the two views has its noise.
    noise = np.sqrt(np.sum((apart - motion) ** 2) / (4 * max(len(apart) - 6, 1)))
    moved = float(np.sqrt(np.mean(np.sum(motion**2, axis=1))))
    return moved < float(np.clip(2 * noise, _SAME_PX, max(_SAME_SHARE * width_px, _SAME_PX)))


def image_outline(camera: model.Camera) -> FloatArray:
    """Pixels (n, 2) along the image's border, or nearer where only they show what is ahead.

    The corners of a fisheye lens's picture often show nothing.
    """
    width, height = camera.image_size_px
    outside = np.ones((_PER_SIDE, _PER_SIDE), dtype=np.bool_)
    outside[1:-1, 1:-1] = False
    border = box_grid((0.0, 0.0, width - 1.0, height - 1.0), _PER_SIDE, _PER_SIDE)[outside]
    if not camera.fisheye:
        return border
    centre = camera.centre_px
    radius = np.linalg.norm(model.distorted_normalised(camera, border), axis=1)
    # Rounding must not put the last ones beside the camera.
    share = np.minimum(1.0, (1.0 - 1e-9) * model.ahead_radius(camera) / radius)
    return np.asarray(centre + (border - centre) * share[:, None])


def lens_shape(calibration: bundle.Calibration) -> Lens:
    """Whether the distortion is monotonic over the angles that were seen and over the image."""
    camera = calibration.camera
    last = model.fold_angle(camera)[0] if camera.fisheye else np.arctan(model.fold_radius(camera)[0])
    border = model.rays(camera, image_outline(camera))
    return Lens(
        folds_among_points=bool(seen_angles(calibration).max() >= last),
        image_shown=float(np.isfinite(border).all(axis=1).mean()),
        reach=model.one_to_one_reach(camera),
    )


def seen_angles(calibration: bundle.Calibration) -> FloatArray:
    """Angles (n,) from the optical axis of all points, rad."""
    x, y, z = points_C(calibration).T
    return np.asarray(np.arctan2(np.hypot(x, y), z))


def points_C(calibration: bundle.Calibration) -> FloatArray:
    """All points (n, 3) in the camera's frame, metres."""
    block, observations = calibration.block, calibration.observations
    every = observations.target_m @ block.R_CT.transpose(0, 2, 1) + block.t_CT_m[:, None]
    return np.asarray(every[observations.present])


# ----------------------------------------------------------------------
# Residuals over the picture: chance points every way, what is left unexplained agrees with its neighbours.

_LEAST_IN_CELL = 6
"""Points from which a cell's mean residual says something."""


@dataclass(frozen=True)
class Means:
    """Mean residuals of cells of the picture.

    Attributes
    ----------
    at, mean : (n, 2) centres of the cells and mean residuals, px.
    by_chance : (n,) radius that 95 % of such means stay within when the errors are chance, px.
    outside : (n,) which do not.
    reach_px : what an arrow may take without running into the next cell's.
    """

    at: FloatArray
    mean: FloatArray
    by_chance: FloatArray
    outside: BoolArray
    reach_px: float


def cell_means(fit: bundle.Calibration, at: FloatArray, vectors: FloatArray, weights: FloatArray) -> Means:
    """Means over about 8 x 6 cells, with the weights of a robust loss where there is one."""
    width, height = fit.camera.image_size_px
    columns = 8 if width >= height else max(3, round(8 * width / height))
    rows = max(2, round(columns * height / width))
    column, row = cell_of(at, (width, height), columns, rows)
    cell = row * columns + column
    used = np.bincount(cell, minlength=rows * columns) >= _LEAST_IN_CELL
    total = np.stack([np.bincount(cell, weights * vectors[:, k], rows * columns) for k in (0, 1)], axis=1)
    weight = np.bincount(cell, weights, rows * columns)[used]
    mean = total[used] / weight[:, None]
    centre = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
    # 95 % of two-dimensional Gaussian vectors are shorter than 2.448 standard deviations.
    by_chance = 2.448 * fit.sigma_px / np.sqrt(weight)
    return Means(
        at=centre[used] * [width / columns, height / rows] - 0.5,
        mean=mean,
        by_chance=by_chance,
        outside=np.hypot(mean[:, 0], mean[:, 1]) > by_chance,
        reach_px=0.6 * min(width / columns, height / rows),
    )


# ----------------------------------------------------------------------
# Views that cannot be views of the plane, told from the correspondences alone.
#
# A plane seen through a lens follows a homography up to distortion, a smooth bulge of at most a tenth of
# the board's extent in the picture, or near the border of a fisheye's, where a homography has its horizon,
# any smooth map. Points in another order, from another board or on one line do not, and one such view can
# keep a whole calibration from finding a camera.

FAULTS = (
    "fewer than four points",
    "only points on one line",
    "points that no camera sees on a flat board: listed in another order, or from another board",
)
"""What a view may show that is no view of the plane."""
_FLAT = 2e-3
"""Smaller over larger extent of a set of points below which they lie on a line."""
_OFF_PLANE, _OFF_SMOOTH = 0.2, 0.15
"""Departure from a homography, and from a cubic map, over the extent in the picture."""
_ONE_SIDE = 0.3
"""Points where that map shows the board's front, less those where it shows its back, over all."""
_CUBIC = 20
"""Points that tell a cubic map, twice its terms."""


def _flatness(points: FloatArray, present: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Smaller over larger, and larger, standard deviation of sets of points (N, M, 2), each (N,)."""
    count = np.maximum(present.sum(axis=1), 1)
    weight = present[..., None] / count[:, None, None]
    off = (points - (points * weight).sum(axis=1, keepdims=True)) * present[..., None]
    scatter = np.einsum("nmi,nmj->nij", off, off) / count[:, None, None]
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter), 0.0))
    return values[:, 0] / np.maximum(values[:, 1], 1e-300), values[:, 1]


def _smooth(target_m: FloatArray, pixels: FloatArray, most_px: float) -> bool:
    """Whether a cubic map that hardly folds takes points (M, 2) to pixels (M, 2), to so much [px] RMS."""
    x, y = ((target_m - target_m.mean(axis=0)) / np.ptp(target_m, axis=0).max()).T
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    terms = np.stack([x**i * y**j for i, j in powers], axis=1)
    by_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], axis=1)
    by_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], axis=1)
    found = np.linalg.lstsq(terms, pixels, rcond=None)[0]
    (a, b), (c, d) = (by_x @ found).T, (by_y @ found).T
    turns = np.sign(a * d - b * c)
    off = ((pixels - terms @ found) ** 2).sum(axis=1)
    return bool(abs(turns.mean()) > _ONE_SIDE and off.mean() < most_px**2)


def view_faults(observations: model.Observations) -> list[str]:
    """Of each view the one of `FAULTS` that it has, or ""."""
    present, pixels = observations.present, observations.pixels
    target = np.broadcast_to(observations.target_m, (*present.shape, 3))
    few = present.sum(axis=1) < 4
    flatness, extent = _flatness(pixels, present)
    line = (_flatness(target[..., :2], present)[0] < _FLAT) | (flatness < _FLAT)
    off_plane = np.zeros(observations.views, dtype=np.bool_)
    usable = np.flatnonzero(~few & ~line)
    if len(usable):
        chosen = observations.select(usable)
        H = bundle.homographies(chosen)
        plane = np.broadcast_to(chosen.target_m[..., :2], chosen.pixels.shape)
        mapped = np.einsum("nij,nmj->nmi", H[..., :2], plane) + H[:, None, :, 2]
        depth = np.where(np.abs(mapped[..., 2:]) > 1e-12, mapped[..., 2:], 1e-12)
        off = np.where(chosen.present, ((mapped[..., :2] / depth - chosen.pixels) ** 2).sum(axis=2), 0.0)
        rms = np.sqrt(off.sum(axis=1) / chosen.present.sum(axis=1))
        off_plane[usable] = rms > _OFF_PLANE * np.maximum(extent[usable], 1e-300)
        for i in np.flatnonzero(off_plane & (present.sum(axis=1) >= _CUBIC)):
            seen = present[i]
            off_plane[i] = not _smooth(target[i, seen, :2], pixels[i, seen], _OFF_SMOOTH * extent[i])
    return list(np.select([few, line, off_plane], FAULTS, ""))


# ----------------------------------------------------------------------
# What each view says about the intrinsics, its own pose eliminated.
#
# To second order about the solution, the cost of view i when the shared parameters move by d and the
# view's pose follows is
#
#     c_i(d) = c_i + 2 b_i' d + d' S_i d,   S_i = U_i - W_i V_i^-1 W_i',   b_i = g_i - W_i V_i^-1 g_zi
#
# with the blocks of `calib.stages.camera.bundle`. Views are independent given d, so that any question about
# groups of views (one camera or two, early or late, with or without a view) is answered by sums of
# S_i and b_i: the cost of a group falls by b' S^-1 b, b and S summed over the group.
#
# Deformations of the target enter as further shared parameters that rest at zero.


class Solution(NamedTuple):
    """Where the cost of all views together is least.

    Attributes
    ----------
    step, inverse : (G,) of the shared parameters, and (G, G) their covariance over a coordinate's variance.
    fall : of the cost.
    variance : of a coordinate, once the cost has fallen.
    """

    step: FloatArray
    inverse: FloatArray
    fall: float
    variance: float


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

    def of(self, views: IntArray | BoolArray) -> Evidence:
        """The same of some views."""
        rows = ("S", "b", "cost", "measured")
        return replace(self, **{name: getattr(self, name)[views] for name in rows})

    def solved(self, floor: float = 1e-13) -> Solution:
        """One camera for all views, one step away; `floor` as of `scaled_inverse`."""
        S, b = self.S.sum(axis=0), self.b.sum(axis=0)
        inverse, fall = scaled_inverse(S, floor), float(gain(S, b))
        freedom = int((self.measured - 6).sum()) - len(b)
        left = max(float(self.cost.sum()) - fall, 0.0) / max(freedom, 1)
        return Solution(-inverse @ b, inverse, fall, left)

    def cost_at(self, d: FloatArray) -> FloatArray:
        """c_i(d), (N,)."""
        return np.asarray(self.cost + 2 * self.b @ d + np.einsum("g,ngh,h->n", d, self.S, d))

    def of_the_camera(self) -> Evidence:
        """The same about the intrinsics, the target's deformation eliminated from all views together."""
        P = self.intrinsics
        S = self.S.sum(axis=0)
        follow = np.concatenate([np.eye(P), -S[:P, P:] @ scaled_inverse(S[P:, P:])], axis=1)
        return replace(self, names=self.names[:P], S=follow @ self.S @ follow.T, b=self.b @ follow.T)


def eliminated(normal: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """S (N, G, G) and b (N, G) of views, their poses eliminated, from `bundle.Linearised`."""
    V, W = normal[:, -6:, -6:], normal[:, :-6, -6:]
    right = np.concatenate([W.transpose(0, 2, 1), gradient[:, -6:, None]], axis=2)
    solved = W @ np.linalg.solve(V, right)
    S = normal[:, :-6, :-6] - solved[..., :-1]
    return 0.5 * (S + S.transpose(0, 2, 1)), gradient[:, :-6] - solved[..., -1]


def _linearised(calibration: bundle.Calibration, basis: FloatArray | None) -> bundle.Linearised:
    observations = calibration.shaped(calibration.observations)
    at_rest = replace(calibration.block, deformation=np.zeros(0 if basis is None else basis.shape[-3]))
    at = bundle.linearise(
        at_rest, observations, calibration.free, basis, calibration.loss, calibration.scale_px
    )
    if at is None:
        raise ValueError("the calibration has points behind the camera")
    return at


def evidence(
    calibration: bundle.Calibration, basis: FloatArray | None = None, names: tuple[str, ...] = ()
) -> Evidence:
    """Information of each view about the free intrinsics and, with `basis`, the target's deformation.

    Parameters
    ----------
    basis : (K, 3, M) or (N, K, 3, M) displacements of the target's points in metres; where the calibration
        has deformed the target already, from there.
    names : K names of the deformations.

    Raises
    ------
    ValueError : the calibration has points behind the camera.
    """
    at = _linearised(calibration, basis)
    S, b = eliminated(at.normal, at.gradient)
    return Evidence(
        names=calibration.free_names + names,
        intrinsics=len(calibration.free),
        S=S,
        b=b,
        cost=(at.residuals**2).sum(axis=(1, 2)),
        measured=2 * calibration.observations.present.sum(axis=1),
        sigma_px=calibration.sigma_px,
    )


class LeftOut(NamedTuple):
    """What the views say of intrinsics that a calibration leaves out, everything else following.

    Attributes
    ----------
    chi2 : of one step to them, with a degree of freedom for each, the views' overdispersion included.
    moved_px : root mean square change of the directions seen, in the picture.
    shear_chi2 : by how much a sheared board lowers the cost more than they do, over the variance.
    """

    chi2: float
    moved_px: float
    shear_chi2: float


def left_out(calibration: bundle.Calibration, *names: str) -> LeftOut:
    """What a calibration without these intrinsics leaves out."""
    freed = _freed(calibration, *names)
    found = evidence(freed)
    one = found.solved()
    # Scatter of the views about the step, where the intrinsics are taken out.
    about = replace(found, b=found.b + found.S @ one.step, sigma_px=math.sqrt(one.variance))
    variance = one.variance * overdispersion(about) ** 2
    at = [found.names.index(name) for name in names]
    chi2 = one.step[at] @ scaled_inverse(variance * one.inverse[np.ix_(at, at)]) @ one.step[at]
    sheared = evidence(calibration, _basis(calibration)[0][..., 1:2, :, :], ("shear",)).solved()
    shear_chi2 = (sheared.fall - one.fall) / max(variance, 1e-300)
    return LeftOut(float(chi2), apart_px(freed, one.step), shear_chi2)


def _freed(calibration: bundle.Calibration, *names: str) -> bundle.Calibration:
    """The calibration as if these intrinsics had been estimated."""
    more = [model.INTRINSICS.index(name) for name in names]
    return replace(calibration, free=np.union1d(calibration.free, more))


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


def _root(found: Evidence) -> FloatArray:
    """Root L (G, G) of the covariance L L' of the shared parameters, over the variance of a coordinate."""
    values, vectors = np.linalg.eigh(scaled_inverse(found.S.sum(axis=0)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


_TOLD = 1e-3
"""What a view tells of a direction, over what all views do, below which it is silent there."""


def components(
    S: FloatArray, score: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """What views tell of independent directions, their squared scores there, and where they tell any, (N, G).

    Where a view is silent they are one and zero.

    Parameters
    ----------
    S, score : (N, G, G) and (N, G) of the views.
    root : (G, G) or (N, G, G), L^-T of the information L L' that S is held against.
    """
    told, Q = np.linalg.eigh(np.swapaxes(root, -1, -2) @ S @ root)
    counts = told > _TOLD
    y2 = np.einsum("ngk,ng->nk", root @ Q, score) ** 2
    return np.where(counts, told, 1.0), np.where(counts, y2, 0.0), counts


def alone_px(calibration: bundle.Calibration) -> tuple[float, float]:
    """Standard deviations of a coordinate: if every view had a camera of its own, with a skew, and as it is.

    Of all views but the one that would gain most, as one bad view is no change in the others. One step of
    each view's parameters, in the directions of which it tells anything.
    """
    found = evidence(_freed(calibration, "skew_px"))
    told, y2, counts = components(found.S, found.b, _root(found))
    fall = (y2 / told).sum(axis=1)
    others = np.arange(len(fall)) != np.argmax(fall)
    measured, cost = int((found.measured - 6)[others].sum()), found.cost[others]

    def deviation(squares: FloatArray, unknowns: int) -> float:
        return math.sqrt(max(float(squares.sum()), 0.0) / max(measured - unknowns, 1))

    return deviation(cost - fall[others], int(counts[others].sum())), deviation(cost, len(calibration.free))


# ----------------------------------------------------------------------
# Is the target what it is said to be: flat, its squares square?
#
# A wrong target leaves residuals that repeat from view to view in the target's own frame. Five
# deformations that a printed sheet really shows are tried at once, as shared parameters that rest at
# zero: the height of the squares over their width, shear, a bow along each axis and a twist. One
# Gauss-Newton step from the solution, poses and intrinsics following, gives each with its standard
# deviation; the problem is close to linear in deformations that are small beside the distance.

CERTAIN = 4.0
"""Standard deviations of a deformation, or of a change from view to view, beyond which it is there."""
_ALLOWED = 2.5
"""The same, beyond which sigma allows for a deformation. A board 0.3 % higher than wide shows at three of its
deviations in fifteen views, where it moves fy by six of those of a square one."""
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
    focal_shift : share by which fx would move.
    focal_per_bow : share by which fx moves for a bow of half a percent of the target's size.
    values, sigma : (5,) in the order of `DEFORMATIONS`; slopes, and metres for bows and twist.
    displacement_m : (M, 3) or (N, M, 3) of the target's points, all five together.
    """

    aspect: float
    aspect_sigma: float
    bow_m: float
    bow_significance: float
    size_m: float
    focal_shift: float
    focal_per_bow: float
    values: FloatArray
    sigma: FloatArray
    displacement_m: FloatArray

    @property
    def significance(self) -> float:
        """Standard deviations of the most significant deformation."""
        return float(np.max(np.abs(self.values) / np.maximum(self.sigma, 1e-300)))

    @property
    def certain(self) -> bool:
        """Whether the target is not what it is said to be."""
        return self.significance > CERTAIN

    @property
    def allowed(self) -> bool:
        """Whether sigma allows for another target than the one described."""
        return self.significance > _ALLOWED

    @property
    def bent(self) -> bool:
        """Whether it is not flat."""
        return bool(np.any(np.abs(self.values[2:]) > CERTAIN * self.sigma[2:]))


def _basis(calibration: bundle.Calibration) -> tuple[FloatArray, float]:
    """Displacements (5, 3, M) or (N, 5, 3, M) of the points, and half the target's longer side."""
    target, box = calibration.observations.target_m, target_box(calibration)
    low, high = box[0, :2], box[2, :2]
    half = 0.5 * float((high - low).max())
    x, y = np.moveaxis(target[..., :2] - 0.5 * (low + high), 2, 0)
    basis = np.zeros((target.shape[0], 5, 3, target.shape[1]))
    basis[:, 0, 1] = y
    basis[:, 1, 0] = y
    basis[:, 2, 2] = 1.0 - (x / half) ** 2
    basis[:, 3, 2] = 1.0 - (y / half) ** 2
    basis[:, 4, 2] = x * y / half**2
    return basis[0] if len(basis) == 1 else basis, half


def target_shape(calibration: bundle.Calibration) -> TargetShape | None:
    """Deformation of the target; None where the data are too few to say."""
    if calibration.degrees_of_freedom <= 2 * len(DEFORMATIONS):
        return None
    basis, half = _basis(calibration)
    found = evidence(calibration, basis, DEFORMATIONS)
    P, S = found.intrinsics, found.S.sum(axis=0)
    step, inverse, _, variance = found.solved(1e-12)
    # Noise after the deformations are taken out, lest they hide in their own residuals.
    cov = inverse * variance * overdispersion(found) ** 2
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    bows = step[P + 2 :]
    wald = float(bows @ np.linalg.pinv(cov[P + 2 :, P + 2 :], hermitian=True) @ bows)
    fx_at, fx = found.names.index("fx_px"), calibration.camera.fx_px
    row = (-scaled_inverse(S[:P, :P]) @ S[:P, P:])[fx_at]
    return TargetShape(
        aspect=float(step[P]),
        aspect_sigma=float(sigma[P]),
        bow_m=float(np.ptp(np.tensordot(bows, basis[..., 2:, 2, :], axes=(0, basis.ndim - 3)))),
        bow_significance=float(np.sqrt(wald / 3)),
        size_m=2 * half,
        focal_shift=float(step[fx_at] / fx),
        focal_per_bow=float(np.abs(row[2:4]).max() * 0.01 * half / fx),
        values=step[P:],
        sigma=sigma[P:],
        displacement_m=np.tensordot(step[P:], basis, axes=(0, basis.ndim - 3)).swapaxes(-1, -2),
    )


def shape_or_none(calibration: bundle.Calibration) -> TargetShape | None:
    """The target's shape where it follows from the views."""
    try:
        return target_shape(calibration) if np.all(np.isfinite(calibration.normal)) else None
    except (np.linalg.LinAlgError, ValueError):
        return None


def certain_shape(calibration: bundle.Calibration) -> TargetShape | None:
    """The target's shape where it is certainly another than the one described."""
    shape = shape_or_none(calibration)
    return shape if shape is not None and shape.certain else None


def drift(calibration: bundle.Calibration) -> FloatArray | None:
    """RMS change (P,) of the intrinsics about their mean, where they run evenly from view to view; else None.

    As of a lens that warms up, or one refocused by too little to tell two cameras apart. The target keeps one
    shape, which is estimated along. A change of which some view alone is the evidence is none.
    """
    views = calibration.observations.views
    if views < _LEAST_IN_ALL:
        return None
    found = evidence(calibration, _basis(calibration)[0], DEFORMATIONS)
    t = np.linspace(-1.0, 1.0, views)
    step, certain = _step(found, t)
    others = (np.arange(views) != i for i in range(views))
    if not certain or not all(_step(found.of(kept), t[kept])[1] for kept in others):
        return None
    return step / math.sqrt(3.0)


def _step(found: Evidence, t: FloatArray) -> tuple[FloatArray, bool]:
    """Change (P,) of the intrinsics for one unit of t (N,), and whether some of it is certain."""
    P, G = found.intrinsics, len(found.names)
    # All parameters, and the intrinsics once more in proportion to t.
    A = np.concatenate([np.tile(np.eye(G), (len(t), 1, 1)), t[:, None, None] * np.eye(P, G)], axis=1)
    S, b = A @ found.S @ A.transpose(0, 2, 1), (A @ found.b[..., None])[..., 0]
    one = replace(found, S=S, b=b).solved(1e-12)
    # Scatter of the views about what they run along.
    about = replace(found, b=found.b + np.einsum("ngh,nh->ng", found.S, one.step @ A))
    sigma = np.sqrt(np.maximum(np.diag(one.inverse)[-P:], 0.0) * one.variance) * overdispersion(about)
    return one.step[-P:], bool(np.any(np.abs(one.step[-P:]) > CERTAIN * sigma))


def scatter_beyond(found: Evidence, inflation: float) -> list[FloatArray]:
    """One standard deviation each, (P,), of what scatters the views by more than an even inflation allows.

    Autofocus, image stabilisation and a rolling shutter change the camera from view to view, in some
    directions only. The views' scores, each freed from what its own leverage takes away (Bell and McCaffrey,
    Survey Methodology 28, 2002), are held against the inflated covariance; what they scatter more along an
    eigenvector counts, as the mean over these views and as many even ones as there are parameters.

    Parameters
    ----------
    found : of the camera, without the target's deformation.
    inflation : `overdispersion` of it.
    """
    views, P = found.b.shape
    root = _root(found)
    left, Q = np.linalg.eigh(np.eye(P) - root.T @ found.S @ root)
    score = Q.transpose(0, 2, 1) @ (found.b @ root)[..., None] / np.sqrt(np.maximum(left, 1e-9))[..., None]
    even = max(inflation * found.sigma_px, 1e-300)
    score = (Q @ score)[..., 0] / even
    scatter, directions = np.linalg.eigh(score.T @ score)
    excess = np.maximum((scatter - 1.0) * views / (views + P), 0.0)
    return [shift for shift in even * (root @ directions * np.sqrt(excess)).T if shift.any()]


_PRINTED = 0.002
"""Standard deviation of a square's height over its width; printers stretch by up to half a percent."""


def misprinted(
    calibration: bundle.Calibration, inflation: float, values: FloatArray | None
) -> list[FloatArray]:
    """One standard deviation each, (P + 6,), of what a board not as described moves: intrinsics and poses.

    Boards that are all upright in the picture hardly tell their squares' height from fy. It is estimated from
    the views and from what printers do; its mean or its deviation, whichever is larger, moves the others.

    Parameters
    ----------
    values : (5,) of `TargetShape` where sigma allows for it; they hold the mean then.
    """
    own = _basis(calibration)[0]
    basis = own if calibration.basis is None else np.concatenate([calibration.basis, own])
    at = _linearised(calibration, basis)
    views, b = eliminated(at.normal, at.gradient)
    S, K = views.sum(axis=0), len(DEFORMATIONS)
    follow = np.concatenate([-scaled_inverse(S[:-K, :-K]) @ S[:-K, -K:], np.eye(K)])
    aspect = follow[:, 0]
    variance = max((inflation * calibration.sigma_px) ** 2, 1e-300)
    left = 1.0 / (float(aspect @ S @ aspect) / variance + _PRINTED**-2)
    mean = left * float(aspect @ b.sum(axis=0)) / variance if values is None else 0.0
    shared = [aspect * max(math.sqrt(left), abs(mean))]
    if values is not None:
        shared.append(follow @ values)
    V, W = at.normal[:, -6:, -6:], at.normal[:, :-6, -6:]
    poses = -np.linalg.solve(V, np.stack([one @ W for one in shared], axis=-1))
    motions = (bundle.common_motion(V, calibration.block.t_CT_m) @ poses).sum(axis=0).T
    P = len(calibration.free)
    return [np.concatenate([one[:P], motion]) for one, motion in zip(shared, motions, strict=True)]


TELL_SHAPE = 4
"""Views from which on the board's shape is told from the poses."""


def by_the_views(calibration: bundle.Calibration) -> bundle.Covariance:
    """The covariance by which the views really scatter.

    Blur, print and lens leave errors that are smooth over a view, so that views disagree by more than the
    noise of their corners would let them: two to three times as much on real pictures, and more in some
    directions than in others. A board that is not as described moves the camera by as much as it would if the
    board's shape were estimated too, and one that changes from view to view is another by as much.
    """
    try:
        found = evidence(calibration, calibration.basis).of_the_camera()
        inflation = overdispersion(found)
        shifts = scatter_beyond(found, inflation)
        enough = calibration.observations.views >= TELL_SHAPE
        # A board whose every corner is estimated has its aspect, too.
        few = len(calibration.block.deformation) <= len(DEFORMATIONS)
        tells = enough and calibration.basis is None
        shape, ran = (shape_or_none(calibration), drift(calibration)) if tells else (None, None)
        values = shape.values if shape is not None and shape.allowed else None
        moved = misprinted(calibration, inflation, values) if enough and few else []
    except (np.linalg.LinAlgError, ValueError):
        inflation, shifts, moved, ran = 1.0, [], [], None
    variance = (inflation * calibration.sigma_px) ** 2
    known = bundle.covariance(calibration, variance, shifts)
    if ran is not None:
        # What changes is the camera: it may be turned for that, but no pose is nearer than it was.
        moved.append(np.concatenate([ran, turn_for(calibration, ran)[0], np.zeros(3)]))
    joint = known.joint + sum(np.outer(one, one) for one in moved)
    return replace(known, intrinsics=joint[: len(known.names), : len(known.names)], joint=joint)


# ----------------------------------------------------------------------
# Whether the minimum that was found is the minimum: other starts.
#
# The local covariance of a calibration is a statement about the bottom of one valley. It cannot see another
# one as deep, nor that a flat valley goes on and on; minimising from other starts does. (The profile of the
# cost over the focal length, which was taken as well, changed none of 150 verdicts from hopeless to good.)
#
# The rational model comes here `conditioned`: its denominator trades with the numerator at next to no
# cost, and the searches would never end.

FOCAL_STARTS = (0.4, 0.7, 1.1, 1.8, 4.0)
FISHEYE_STARTS = (0.2, 0.3, 0.45, 0.8)
"""Focal lengths of the starts, over the longer side of the image."""

CHI2_95 = 3.84
_MAX_ITERATIONS = 60
_MAX_VIEWS = 60
_NEARLY = 1.02
"""Cost of five coefficients over that of the rational model below which they do."""


def conditioned(calibration: bundle.Calibration) -> bundle.Calibration:
    """The same views without the freedom of the rational model's denominator; other models as they are.

    The denominator trades with the numerator at next to no cost, so that what it leaves undetermined
    says nothing about the camera. Where five coefficients do nearly as well they take its place, else
    the denominator is held at its values.
    """
    loose = [model.INTRINSICS.index(name) for name in ("k4", "k5", "k6")]
    kept = np.flatnonzero(~np.isin(calibration.free, loose))
    if calibration.camera.fisheye or len(kept) == len(calibration.free):
        return calibration
    if all(name in calibration.free_names for name in ("k1", "k2", "p1", "p2", "k3")):
        intrinsics = calibration.block.intrinsics.copy()
        intrinsics[model.INTRINSICS.index("k1") :] = 0.0
        start = replace(calibration.block, intrinsics=intrinsics)
        simpler = bundle.refitted(calibration, model="brown5", start=start, max_iterations=_MAX_ITERATIONS)
        if simpler.converged and simpler.squared_sum < _NEARLY * calibration.squared_sum:
            return simpler
    rows = np.concatenate([kept, np.arange(len(calibration.free), calibration.normal.shape[1])])
    normal = calibration.normal[:, rows][:, :, rows]
    return replace(calibration, free=calibration.free[kept], normal=normal)


def other_starts(calibration: bundle.Calibration) -> list[tuple[float, bundle.Minimum]]:
    """Focal lengths of starts, and where they ended.

    They go from 0.4 to 4 image widths, of a fisheye lens from 0.2 to 0.8, with principal points about the
    centre.
    """
    rng = np.random.default_rng(0)
    observations, camera = calibration.observations, calibration.camera
    width, height = camera.image_size_px
    H = bundle.homographies(observations)
    free, begun = calibration.free, np.zeros(len(model.INTRINSICS))
    ends = []
    for share in FISHEYE_STARTS if camera.fisheye else FOCAL_STARTS:
        focal = share * max(width, height)
        jitter = rng.uniform(-0.08, 0.08, 2) * (width, height)
        begun[:4] = focal, focal, 0.5 * (width - 1) + jitter[0], 0.5 * (height - 1) + jitter[1]
        guess = calibration.block.intrinsics.copy()
        guess[free] = begun[free]
        begin = model.camera_from_vector(camera.model, camera.image_size_px, guess)
        if camera.fisheye:
            start = bundle.poses_with_camera(begin, observations)
        else:
            start = model.Block.of(begin, *bundle.poses_from_homographies(begin.K, H))
        if start.posed.all():
            found = bundle.minimise(start, observations, free, max_iterations=_MAX_ITERATIONS)
            if found.at is not None:
                ends.append((focal, found))
    return ends


def best_of_starts(calibration: bundle.Calibration) -> bundle.Calibration:
    """The calibration, or the one that another start leads to if its cost is lower by more than chance.

    More than chance: by more than 3.84 times the residuals' variance. Above 60 views the starts are
    tried on an even sample of them. A robust loss or a deformed target is returned as it is.
    """
    if calibration.basis is not None or calibration.loss != "none":
        return calibration
    some, chance = calibration, CHI2_95 * calibration.sigma_px**2
    if calibration.observations.views > _MAX_VIEWS:
        index = evenly(calibration.observations.views, _MAX_VIEWS)
        some = replace(
            calibration,
            observations=calibration.observations.select(index),
            block=calibration.block.part(index),
            residuals_px=calibration.residuals_px[index],
            normal=calibration.normal[index],
        )
        # On a sample the fit to all views is not the best, by about its number of parameters.
        chance *= len(calibration.free)
    ends = other_starts(some)
    if not ends:
        return calibration
    best = min((end for _, end in ends), key=lambda end: end.cost)
    if best.cost > _cost(some) - chance:
        return calibration
    camera, start = calibration.camera, best.block
    if some is not calibration:
        found = model.camera_from_vector(camera.model, camera.image_size_px, start.intrinsics)
        start = bundle.poses_with_camera(found, calibration.observations)
        if not start.posed.all():
            return calibration
    better = bundle.refitted(calibration, start=start)
    return better if _cost(better) < _cost(calibration) - CHI2_95 * better.sigma_px**2 else calibration


def _cost(calibration: bundle.Calibration) -> float:
    """Sum of squared residuals, infinite where the fit has none."""
    return calibration.squared_sum if np.all(np.isfinite(calibration.normal)) else float("inf")


# ----------------------------------------------------------------------
# One camera or two: do some views come from another camera, or from the same lens refocused?
#
# A set mixed from two cameras can fit one at a low RMS, because every view's pose bends to the
# camera's will. Splitting the views always lowers the cost, also where there is one camera, so the fall
# has to be compared with what it would be by chance. With the quadratic evidence of each view
# (above) a split costs next to nothing:
#
# 1. views are reassigned between two cameras until stable, from several starts (k-means with each
#    view's own metric); and, for a lens that was moved on the way, all splits in order are tried, of which
#    the best is taken where hardly any other is better;
# 2. the statistic is T2 = fall of the cost / (phi^2 sigma^2), with sigma^2 from the residuals after the
#    split and phi^2 the overdispersion of the views *within* the two groups, so that residuals that are
#    not white do not pass for a second camera;
# 3. the same search on made-up scores of one camera, drawn from each view's own information, tells what
#    T2 chance reaches.
#
# The lens model is first widened to five coefficients, where that helps, and the target takes the shape
# that fits best: a lens that the model cannot follow, or a bent board, makes views disagree by where and
# how the board lies in them, which is not a second camera.

_REPLICATES = 16
_QUANTILE = 3.5
"""Standard deviations above the replicates' mean that chance is said to reach."""
_STARTS = 10
_ROUNDS = 15
_TWO_CAMERAS_MAX_ITERATIONS = 40
_WORTH = 3.0
"""Fall of the cost, in variances, that a coefficient has to bring."""
_LEAST = 3
"""Views that a group needs."""
_LEAST_IN_ALL = 8
"""Of fewer any three may differ from the rest by what is odd about each."""
_IN_ORDER = 0.9
"""Statistic of a split in order over that of any, each over its chance, from which on it is taken."""
_AS_WELL = 0.8
"""Statistic of a split by distance over that of the best, from which on distance explains it."""
_ODD_VIEWS = 6
"""Views without each of which the finding has to stand."""
_PRIOR = {"fx_px": 0.3, "fy_px": 0.3, "cx_px": 0.15, "cy_px": 0.15, "skew_px": 0.05}
"""How far two cameras may differ, over the focal length; coefficients of distortion by one."""


@dataclass(frozen=True)
class Split:
    """The best division of the views into two groups.

    Attributes
    ----------
    second : (N,) True for the views of the smaller or later group.
    ratio : T2, see above, over what it reaches with one camera, by mean and 3.5 standard deviations of
        replicates.
    split_rms_px : RMS after it.
    apart_px : root mean square distance, over the directions that were seen, of where the two cameras show
        them, one turned to meet the other.
    difference : intrinsics of the second group less those of the first, by name.
    sigma : its standard deviation with the overdispersion within the groups, by name.
    by_distance : whether near and far views differ about as much, as with a lens or a board that the model
        does not follow.
    """

    second: BoolArray
    ratio: float
    split_rms_px: float
    apart_px: float
    difference: dict[str, float]
    sigma: dict[str, float]
    by_distance: bool = False

    @property
    def in_order(self) -> bool:
        """Whether the second group are all views from one on."""
        return bool(np.array_equal(self.second, np.sort(self.second)))


def widened(calibration: bundle.Calibration) -> bundle.Calibration:
    """The same views with k1, k2, p1, p2 and k3 free, where the model is poorer and that helps."""
    if calibration.camera.model in ("brown5", "rational8", model.FISHEYE):
        return calibration
    rich = bundle.refitted(calibration, model="brown5", max_iterations=_TWO_CAMERAS_MAX_ITERATIONS)
    # Coefficients that explain nothing only blur the difference of two cameras.
    worth = _WORTH * (len(rich.free) - len(calibration.free)) * calibration.sigma_px**2
    return rich if rich.squared_sum < calibration.squared_sum - worth else calibration


def straightened(calibration: bundle.Calibration, displacement_m: FloatArray) -> bundle.Calibration:
    """The same views of a target whose points are moved by `displacement_m` (1 or N, M, 3).

    A target that would then lie behind the camera tells nothing; the calibration is left as it is.
    """
    straight = calibration.observations.displaced(displacement_m)
    moved = bundle.refitted(calibration, observations=straight, max_iterations=_TWO_CAMERAS_MAX_ITERATIONS)
    return calibration if moved.termination == "behind the camera" else moved


@dataclass(frozen=True)
class _Problem:
    """Scores and information of the views in units of the prior, sigma one."""

    S: FloatArray
    b: FloatArray
    cost: float
    freedom: int


def _groups(problem: _Problem, second: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums S (T, 2, G, G) and b (T, 2, G) and best shifts d (T, 2, G) of divisions (T, N)."""
    N, G = problem.b.shape
    member = np.stack([~second, second], axis=1).astype(np.float64)
    flat = member.reshape(-1, N)
    S = (flat @ problem.S.reshape(N, -1)).reshape(-1, 2, G, G)
    b = (flat @ problem.b).reshape(-1, 2, G)
    d = -np.linalg.solve(S + np.eye(G), b[..., None])[..., 0]
    return S, b, np.asarray(d, dtype=np.float64)


def _reassigned(problem: _Problem, second: BoolArray, least: int) -> BoolArray:
    """Divisions (T, N) after moving every view to the camera that suits it until nothing moves.

    Each camera keeps `least` views.
    """
    N = len(problem.b)
    for _ in range(_ROUNDS):
        _, _, d = _groups(problem, second)
        # Cost under the second less that under the first; (d2 - d1)' S (d1 + d2) = d2' S d2 - d1' S d1.
        apart, both = d[:, 1] - d[:, 0], d[:, 1] + d[:, 0]
        pushed = np.tensordot(both, problem.S, axes=(1, 1))
        better = 2 * apart @ problem.b.T + np.einsum("tng,tg->tn", pushed, apart)
        rank = np.argsort(np.argsort(better, axis=1), axis=1)
        new = ((better < 0) | (rank < least)) & (rank < N - least)
        if np.array_equal(new, second):
            break
        second = new
    return second


def _statistic(problem: _Problem, second: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """T2, fall of the cost and phi^2 of divisions (T, N), each (T,)."""
    N, G = problem.b.shape
    S, b, d = _groups(problem, second)
    fall = -(b * d).sum(axis=(1, 2))
    variance = np.maximum(problem.cost - fall, 1e-12 * problem.cost) / problem.freedom
    inverse = np.linalg.inv(S + np.eye(G))
    own = np.where(second[..., None], d[:, 1, None], d[:, 0, None])
    score = problem.b + np.einsum("ngh,tnh->tng", problem.S, own)
    metric = np.where(second[..., None, None], inverse[:, 1, None], inverse[:, 0, None])
    scatter = np.einsum("tng,tngh,tnh->t", score, metric, score, optimize=True)
    phi2 = scatter / (2 * G * variance) * N / max(N - G, 1)
    return fall / (variance * np.maximum(phi2, 1.0)), fall, phi2


def _problem(found: Evidence, calibration: bundle.Calibration) -> tuple[_Problem, FloatArray]:
    focal, longest = calibration.camera.fx_px, max(calibration.camera.image_size_px)
    width = {"cx_px": longest, "cy_px": longest}
    scale = np.array(
        [_PRIOR.get(name, 1.0) * width.get(name, focal if name in _PRIOR else 1.0) for name in found.names]
    )
    S = found.S * scale[:, None] * scale / found.sigma_px**2
    b = found.b * scale / found.sigma_px**2
    freedom = max(calibration.degrees_of_freedom - len(scale), 1)
    return _Problem(S, b, float(found.cost.sum()) / found.sigma_px**2, freedom), scale


def _beginnings(problem: _Problem, rng: np.random.Generator) -> BoolArray:
    """Divisions to begin with: in order, along the views' main disagreement, and at random, (T, N)."""
    N, G = problem.b.shape
    order = np.arange(N)
    starts = [order >= cut for cut in np.unique(np.linspace(_LEAST, N - _LEAST, 3).astype(np.int64))]
    own = np.linalg.solve(problem.S + np.eye(G), problem.b[..., None])[..., 0]
    weights = problem.S.sum(axis=0)
    _, vectors = np.linalg.eigh(weights)
    for k in range(1, 4):
        along = own @ vectors[:, -min(k, G)]
        starts.append(along > np.median(along))
    starts.extend(rng.permutation(N) < N // 2 for _ in range(_STARTS - len(starts)))
    return np.array(starts)


def _replicates(problem: _Problem, rng: np.random.Generator) -> list[_Problem]:
    """Scores as one camera would give them, centred on its solution."""
    values, vectors = np.linalg.eigh(problem.S)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    scores = [np.einsum("ngh,nh->ng", root, rng.standard_normal(problem.b.shape)) for _ in range(_REPLICATES)]
    return [_centred(replace(problem, b=b, cost=float(problem.freedom))) for b in scores]


def _centred(problem: _Problem) -> _Problem:
    """The same about the solution of all views."""
    d = scaled_inverse(problem.S.sum(axis=0)) @ problem.b.sum(axis=0)
    return replace(problem, b=problem.b - problem.S @ d)


def _sturdy(problem: _Problem, search: Callable[[_Problem], FloatArray]) -> FloatArray:
    """Least of what a search finds without one of the oddest views, or without the two oddest of ten or more.

    A bad picture or two, each with a camera of its own, must not make innocent views a second camera.
    """
    odd = np.argsort(-_statistic(problem, np.eye(len(problem.b), dtype=np.bool_))[1])[:_ODD_VIEWS]
    without = [odd[k : k + 1] for k in range(len(odd))] + ([odd[:2]] if len(problem.b) >= 10 else [])
    return np.asarray(np.min([search(_without(problem, some)) for some in without], axis=0))


def _described(
    problem: _Problem, scale: FloatArray, calibration: bundle.Calibration, second: BoolArray, ratio: float
) -> Split:
    _, fall, phi2 = (float(value[0]) for value in _statistic(problem, second[None]))
    S, _, d = _groups(problem, second[None])
    points = calibration.observations.points
    variance = calibration.sigma_px**2
    inverse = np.linalg.inv(S[0] + np.eye(len(scale)))
    left = max(problem.cost - fall, 0.0) / problem.freedom * max(phi2, 1.0)
    # Rounding makes a variance of next to nothing negative.
    sigma = scale * np.sqrt(np.maximum(np.diag(inverse[0] + inverse[1]), 0.0) * left)
    difference = scale * (d[0, 1] - d[0, 0])
    names = calibration.free_names
    return Split(
        second,
        ratio,
        float(np.sqrt(max(problem.cost - fall, 0.0) * variance / points)),
        apart_px(calibration, difference),
        dict(zip(names, difference.tolist(), strict=True)),
        dict(zip(names, sigma.tolist(), strict=True)),
    )


def turn_for(calibration: bundle.Calibration, difference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The turn (3,) [rad] that undoes most of a change of the free intrinsics, and the pixels left (2 n,)."""
    used = points_C(calibration)
    J = bundle.joint_jacobian(calibration, used[:: max(1, len(used) // 500)])
    P = len(difference)
    moved, turned = (J[..., :P] @ difference).ravel(), J[..., P : P + 3].reshape(-1, 3)
    turn = -np.linalg.lstsq(turned, moved, rcond=None)[0]
    return np.asarray(turn, dtype=np.float64), np.asarray(moved + turned @ turn, dtype=np.float64)


def apart_px(calibration: bundle.Calibration, difference: FloatArray) -> float:
    """Root mean square change of the pixels seen by a change of the free intrinsics, and the best turn."""
    return float(np.sqrt(2 * np.mean(turn_for(calibration, difference)[1] ** 2)))


def _without(problem: _Problem, odd: IntArray) -> _Problem:
    """The same without some views, centred on the others' solution."""
    kept = ~np.isin(np.arange(len(problem.b)), odd)
    part = replace(problem, S=problem.S[kept], b=problem.b[kept], cost=problem.cost * kept.mean())
    return _centred(part)


def best_split(calibration: bundle.Calibration) -> Split | None:
    """The two groups of views that differ most, or None below eight views.

    Parameters
    ----------
    calibration : best `widened` and `straightened`, without robust loss.
    """
    if calibration.observations.views < _LEAST_IN_ALL:
        return None
    rng = np.random.default_rng(0)
    problem, scale = _problem(evidence(calibration), calibration)

    def search(made: _Problem, starts: int, least: int) -> tuple[list[BoolArray], FloatArray]:
        """The best division of any, and the best in order, and their statistics (2,)."""
        views = len(made.b)
        at = np.unique(np.linspace(least, views - least, 60).astype(np.int64))
        kinds = _reassigned(made, _beginnings(made, rng)[:starts], least), np.arange(views) >= at[:, None]
        found = [_statistic(made, kind)[0] for kind in kinds]
        best = [kind[int(np.argmax(one))] for kind, one in zip(kinds, found, strict=True)]
        return best, np.array([one.max() for one in found])

    divisions, statistics = search(problem, _STARTS, _LEAST)
    replicates = [search(made, 6, _LEAST)[1] for made in _replicates(problem, rng)]
    chances = np.mean(replicates, axis=0) + _QUANTILE * np.std(replicates, axis=0, ddof=1)
    statistics = np.minimum(statistics, _sturdy(problem, lambda one: search(one, 6, 2)[1]))
    # Of few divisions less is reached by chance.
    ordered = bool(statistics[1] / chances[1] > _IN_ORDER * statistics[0] / chances[0])
    best, k = divisions[ordered], int(ordered)
    if not ordered and best.sum() > len(best) / 2:
        best = ~best
    ratio = float(statistics[k]) / max(float(chances[k]), 1e-9)
    far = np.argsort(np.argsort(np.linalg.norm(calibration.block.t_CT_m, axis=1)))
    at = np.arange(_LEAST, len(best) - _LEAST + 1)
    explained = float(_statistic(problem, far >= at[:, None])[0].max())
    by_distance = explained > _AS_WELL * float(_statistic(problem, best[None])[0][0])
    return replace(_described(problem, scale, calibration, best, ratio), by_distance=by_distance)


# ----------------------------------------------------------------------
# Which picture to take next: the one that takes most of the uncertainty away.
#
# A candidate view adds its information S_c (its pose eliminated, as above) to the sum S of the views taken.
# What is left is measured by tr(R (S + S_c)^-1), where R is the mean information of reference views that fill
# the whole picture: the expected squared error, in pixels, of explaining a new view anywhere in the picture
# with this camera (optimal design, criterion V).

_EDGES = {"right": 0.0, "bottom": 90.0, "left": 180.0, "top": 270.0}
"""Directions of a picture's edges, from right over down, degrees."""
_PLACES = (0.22, 0.5, 0.78)
_GRID = 6
_NEW_SHARE = 0.04
"""RMS distance of a pose's points to those of a view, over the picture's width, below which it repeats."""


@dataclass(frozen=True)
class Candidate:
    """A picture to take.

    Attributes
    ----------
    where : part of the picture, in words with a preposition.
    tilt_deg : angle between the board and the picture's plane.
    away : edge of the board (as the picture shows it) that leans away, or "" without tilt.
    span_share : diagonal of the board over the diagonal of the picture.
    remaining : root of the expected squared error after it over that before.
    R_CT, t_m : (3, 3) and (3,) pose of the board, from coordinates whose origin is its middle.
    """

    where: str
    tilt_deg: float
    away: str
    span_share: float
    remaining: float
    R_CT: FloatArray
    t_m: FloatArray


@dataclass(frozen=True)
class Plan:
    """What further views would be worth.

    Attributes
    ----------
    candidates : poses that fit into the picture and that no view has yet, the most useful first.
    calibration : of the views so far.
    target_m : (M, 3) points all over the target, their origin its middle.
    information, reference : (G, G) of the views so far, and of a view anywhere in the picture.
    """

    candidates: tuple[Candidate, ...]
    calibration: bundle.Calibration
    target_m: FloatArray
    information: FloatArray
    reference: FloatArray

    @property
    def best(self) -> Candidate:
        """The most useful of all."""
        return self.candidates[0]

    def remaining(self, R_CT: FloatArray, t_m: FloatArray) -> float:
        """`Candidate.remaining` of a view with this pose."""
        S = _information(self.calibration, self.target_m, R_CT[None], t_m[None])
        return 1.0 if S is None else float(_remaining(self.information, self.reference, S)[0])


def _words(column: int, row: int) -> str:
    across, down = ("left", "", "right")[column], ("top", "", "bottom")[row]
    if not across and not down:
        return "in the middle of the picture"
    if across and down:
        return f"in the {down} {across} corner of the picture"
    return f"at the {across or down} edge of the picture"


def tilted(tilt_deg: float, away: str) -> FloatArray:
    """Rotation (3, 3) of a board whose edge `away` in the picture leans away from the camera."""
    azimuth = np.radians(_EDGES.get(away, 0.0))
    axis = np.array([[np.sin(azimuth), -np.cos(azimuth), 0.0]])
    return np.asarray(rotation_exp(np.radians(tilt_deg) * axis)[0])


def best_next_view(calibration: bundle.Calibration) -> Plan | None:
    """Of about a hundred poses of the board those that fit into the picture, the most useful first.

    A pose that a view has is left out unless there is no other: the same picture once more lowers sigma on
    paper only.
    """
    information = evidence(calibration).S.sum(axis=0)
    camera = calibration.camera
    width, height = camera.image_size_px
    box = target_box(calibration)
    extent = box.max(axis=0) - box.min(axis=0)
    flat = box_grid((-0.5, -0.5, 0.5, 0.5), _GRID, _GRID).reshape(-1, 2)
    target = np.column_stack([flat, np.zeros(len(flat))]) * extent
    diagonal = float(np.hypot(extent[0], extent[1]))
    rotations, translations = [], []
    kinds: list[tuple[str, float, str, float]] = []
    for row, v in enumerate(_PLACES):
        for column, u in enumerate(_PLACES):
            ray = model.undistort(camera, np.array([u * (width - 1), v * (height - 1)]))
            if not np.all(np.isfinite(ray)):
                continue
            for span in (0.35, 0.6):
                distance = camera.fx_px * diagonal / (span * np.hypot(width, height))
                for away in ("", *_EDGES):
                    tilt_deg = 35.0 if away else 0.0
                    rotations.append(tilted(tilt_deg, away))
                    translations.append(distance * np.array([ray[0], ray[1], 1.0]))
                    kinds.append((_words(column, row), tilt_deg, away, span))
    if not kinds or not np.all(np.isfinite(information)):
        return None
    R, t = np.array(rotations), np.array(translations)
    points = target @ R.transpose(0, 2, 1) + t[:, None]
    ahead = points[..., 2].min(axis=1) > 0.05 * diagonal
    pixels = model.project(camera, np.where(ahead[:, None, None], points, [0.0, 0.0, 1.0]))
    inside = ((pixels > 0) & (pixels < [width - 1, height - 1])).all(axis=(1, 2))
    # A view half outside of the picture is no advice, except where no other fits.
    kept = np.flatnonzero(ahead & inside & np.isfinite(pixels).all(axis=(1, 2)))
    if len(kept) == 0:
        return None
    new = ~_repeats(calibration, target + box.mean(axis=0), pixels[kept])
    S = _information(calibration, target, R[kept], t[kept])
    if S is None:
        return None
    reference = S.mean(axis=0)
    remaining = _remaining(information, reference, S)
    candidates = tuple(
        Candidate(*kinds[int(kept[i])], float(remaining[i]), R[kept[i]], t[kept[i]])
        for i in np.argsort(remaining, kind="stable")
        if new[i] or not new.any()
    )
    return Plan(candidates, calibration, target, information, reference)


def _repeats(calibration: bundle.Calibration, target: FloatArray, pixels: FloatArray) -> BoolArray:
    """Which views (n, M, 2) show the points (M, 3) of the target where a view of the calibration does.

    A target that is turned by half counts as the same.
    """
    block, camera = calibration.block, calibration.camera
    points = target @ block.R_CT.transpose(0, 2, 1) + block.t_CT_m[:, None]
    seen = model.project(camera, np.concatenate([points, points[:, ::-1]]))
    squared = ((pixels[:, None] - seen) ** 2).sum(axis=-1).mean(axis=-1)
    return np.asarray((squared < (_NEW_SHARE * camera.image_size_px[0]) ** 2).any(axis=1))


def _remaining(information: FloatArray, reference: FloatArray, S: FloatArray) -> FloatArray:
    """Root (n,) of the expected squared error after views with information S (n, G, G) over that before."""
    # A direction that nothing has measured yet is held by a hundredth of one view.
    base = information + 0.01 * reference
    before = float(np.trace(reference @ scaled_inverse(base)))
    after = np.array([np.trace(reference @ scaled_inverse(base + added)) for added in S])
    return np.asarray(np.sqrt(np.maximum(after, 0.0) / max(before, 1e-300)))


def _information(
    calibration: bundle.Calibration, target: FloatArray, R: FloatArray, t: FloatArray
) -> FloatArray | None:
    """Information (n, G, G) of made-up views of the target about the intrinsics."""
    M = len(target)
    made = model.Observations.of(target, np.zeros((len(R), M, 2)))
    at = bundle.linearise(model.Block.of(calibration.camera, R, t), made, calibration.free, None)
    if at is None:
        return None
    # As many points as the target has in a view, spread as they are.
    share = calibration.observations.points / calibration.observations.views / M
    return share * eliminated(at.normal, at.gradient)[0]
