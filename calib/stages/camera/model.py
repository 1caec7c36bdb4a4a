"""The camera model, views of a target, and residuals with their Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal, Self

import numpy as np

from calib.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from calib.core.geometry import box_grid

# ----------------------------------------------------------------------
# The checkerboard: inner corners on a plane, in metres.
#
# Corner (column i, row j) has index `j * columns + i` and lies at `(i, j) * square_m`. Seen from the
# printed side the columns axis, turned by a quarter clockwise, gives the rows axis, so that with the
# image's axes (u right, v down) the grid is never mirrored and the board's z axis points away from the
# camera.


@dataclass(frozen=True)
class Board:
    """A checkerboard with `columns` x `rows` inner corners and squares of `square_m` metres."""

    columns: int
    rows: int
    square_m: float

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def half_turn_looks_the_same(self) -> bool:
        """Whether the colours repeat after half a turn: no picture tells the first corner from the last.

        The square at (i, j) of columns + 1 by rows + 1 squares has the colour (i + j) mod 2; half a
        turn moves it to a square of colour (columns + rows - i - j) mod 2.
        """
        return (self.columns + self.rows) % 2 == 0

    def points_m(self) -> FloatArray:
        """Inner corners on the board's plane, shape (columns * rows, 2), metres, row by row."""
        rows, columns = np.mgrid[0 : self.rows, 0 : self.columns]
        return np.stack([columns.ravel(), rows.ravel()], axis=1) * float(self.square_m)


# ----------------------------------------------------------------------
# Correspondences between points of a plane and pixels: one view, and many views packed for vector code.


@dataclass(frozen=True)
class View:
    """One picture of a planar target.

    Attributes
    ----------
    name : name of the picture, for reports.
    target_m : (M, 2) points on the target's plane, metres.
    pixels : (M, 2) where the picture shows them, distorted pixels, (0, 0) at the centre of the
        top-left pixel, u right, v down.
    measured : (M,) False for points that the picture does not show well enough to count; all True
        when None. They keep their place, so that views of one board stay comparable.
    """

    name: str
    target_m: FloatArray
    pixels: FloatArray
    measured: BoolArray | None = None

    def counted(self) -> tuple[FloatArray, FloatArray]:
        """Target and pixels of the points that were measured."""
        kept = slice(None) if self.measured is None else self.measured
        return self.target_m[kept], self.pixels[kept]


@dataclass(frozen=True)
class LeftOut:
    """A file, a picture or points of it that are there and not used.

    Attributes
    ----------
    name : of the file or view.
    why : the rest of a sentence that begins with the name.
    kind : "file" (no picture), "unreadable", "size" (another one than the others'), "no board", "copy" (shows
        the board where another view does), "view" or "points" (do not agree with the others).
    """

    name: str
    why: str
    kind: Literal["file", "unreadable", "size", "no board", "copy", "view", "points"]

    def __str__(self) -> str:
        return f"{self.name}: {self.why}"


@dataclass(frozen=True)
class Observations:
    """All views as arrays, padded to the largest number of points M.

    Attributes
    ----------
    names : N names.
    target_m : (1, M, 3) when every view shows the same points, else (N, M, 3); z is zero on a flat
        target.
    pixels : (N, M, 2).
    present : (N, M), False for padding and for points that were not measured or were rejected.
    """

    names: tuple[str, ...]
    target_m: FloatArray
    pixels: FloatArray
    present: BoolArray

    @staticmethod
    def of(target_m: FloatArray, pixels: FloatArray) -> Observations:
        """Nameless views (N, M, 2) of points (M, 3), which all of them show."""
        present = np.ones(pixels.shape[:2], dtype=np.bool_)
        return Observations(("",) * len(pixels), target_m[None], pixels, present)

    @property
    def views(self) -> int:
        """Number of views N."""
        return len(self.names)

    @property
    def points(self) -> int:
        """Number of points over all views, padding left out."""
        return int(self.present.sum())

    @property
    def complete(self) -> bool:
        """Whether every view shows every point."""
        return bool(self.present.all())

    @property
    def same_target(self) -> bool:
        """Whether the target's points are the same in every view."""
        return bool(self.target_m.shape[0] == 1)

    def select(self, views: slice | IntArray | Sequence[int]) -> Observations:
        """The views at these indices, in this order, or a run of views, which is not copied."""
        names = self.names[views] if isinstance(views, slice) else tuple(self.names[i] for i in views)
        target = self.target_m if self.same_target else self.target_m[views]
        return Observations(names, target, self.pixels[views], self.present[views])

    def displaced(self, displacement_m: FloatArray) -> Observations:
        """The same pixels of a target whose points are moved by `displacement_m` (M, 3)."""
        return Observations(self.names, self.target_m + displacement_m, self.pixels, self.present)

    def without(self, rejected: BoolArray) -> Observations:
        """The same views with the points where `rejected` (N, M) is True left out."""
        return Observations(self.names, self.target_m, self.pixels, self.present & ~rejected)


def pack(views: Sequence[View]) -> Observations:
    """Views as one set of padded arrays; the target is shared when all views have the same one."""
    counts = [len(view.pixels) for view in views]
    size = max(counts)
    first = views[0].target_m
    shared = all(v.target_m is first or np.array_equal(v.target_m, first) for v in views)
    pixels = np.zeros((len(views), size, 2))
    present = np.zeros((len(views), size), dtype=np.bool_)
    target = np.zeros((1 if shared else len(views), size, 3))
    for i, view in enumerate(views):
        pixels[i, : counts[i]] = view.pixels
        present[i, : counts[i]] = True if view.measured is None else view.measured
        if not shared or i == 0:
            target[0 if shared else i, : counts[i], :2] = view.target_m
    return Observations(tuple(v.name for v in views), target, pixels, present)


# ----------------------------------------------------------------------
# The camera model: pinhole with skew and Brown's or the rational distortion, or a fisheye lens.
#
# A point (X, Y, Z) of the camera's frame is seen at
#
#     x = X / Z,  y = Y / Z,  r2 = x^2 + y^2
#     L  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
#     xd = x L + 2 p1 x y + p2 (r2 + 2 x^2)
#     yd = y L + p1 (r2 + 2 y^2) + 2 p2 x y
#     u  = fx xd + skew yd + cx,  v = fy yd + cy
#
# which is (2.4), (2.5) and (B.1) of the source document for k1, k2 alone, and OpenCV's model with a
# skew added (Zhang 2000). The printed (2.7), gamma = f_w tan(psi), mixes units: skew is in pixels.
#
# A fisheye lens (Kannala and Brandt 2006, four coefficients, OpenCV's `fisheye`) is a polynomial of the angle
# from the axis instead, and sees points with Z <= 0 as well:
#
#     theta  = atan2(rho, Z),  rho = sqrt(X^2 + Y^2)
#     theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
#     xd = X theta_d / rho,  yd = Y theta_d / rho

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of the distortion coefficients everywhere, OpenCV's."""

MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "radial2": ("k1", "k2"),
    "radial3": ("k1", "k2", "k3"),
    "fisheye4": ("k1", "k2", "k3", "k4"),
    "brown5": ("k1", "k2", "p1", "p2", "k3"),
    "rational8": COEFFICIENTS,
}
"""Coefficients that each model frees, from the simplest to the richest."""

FISHEYE = "fisheye4"
"""The model whose coefficients are those of a polynomial of the angle."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes
    ----------
    model : a key of `MODELS`.
    image_size_px : (width, height).
    fx_px, fy_px, skew_px, cx_px, cy_px : entries of K (2.5), pixels.
    distortion : (8,) coefficients in the order of `COEFFICIENTS`, dimensionless.
    """

    model: str
    image_size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    skew_px: float
    cx_px: float
    cy_px: float
    distortion: FloatArray = field(default_factory=lambda: np.zeros(len(COEFFICIENTS)))

    @property
    def fisheye(self) -> bool:
        """Whether the coefficients are those of the fisheye model."""
        return self.model == FISHEYE

    @property
    def ideal(self) -> bool:
        """Whether the model has no distortion at all."""
        return not (self.fisheye or np.any(self.distortion))

    @property
    def centre_px(self) -> FloatArray:
        """Principal point (2,)."""
        return np.array([self.cx_px, self.cy_px])

    @property
    def farthest_px(self) -> float:
        """Distance of the picture's farthest corner from the principal point."""
        centre, last = self.centre_px, np.array(self.image_size_px) - 1.0
        return float(np.linalg.norm(np.maximum(centre, last - centre)))

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (2.5), shape (3, 3), pixels."""
        return np.array(
            [[self.fx_px, self.skew_px, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )


def scale_of(image_size_px: tuple[int, int]) -> float:
    """How many times larger than at up to 1000 pixels' width errors in pixels may be."""
    return max(1.0, max(image_size_px) / 1000)


_SMALL = 1e-9
"""Radius below which a direction is the axis, rad."""
_BEHIND = 0.05
"""Angle from straight behind the camera that no lens sees, rad."""


def angle_curve(theta: AnyArray, distortion: FloatArray) -> tuple[AnyArray, AnyArray]:
    """theta_d of the fisheye model and its derivative by theta, any shape, in the precision of the input."""
    k1, k2, _, _, k3, k4, _, _ = distortion.astype(theta.dtype)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return theta_d, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _by_angle(
    x: FloatArray, y: FloatArray, z: FloatArray, distortion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distorted normalised coordinates of points in a fisheye lens's frame, any shape."""
    rho = np.maximum(np.hypot(x, y), _SMALL * np.abs(z))
    scale = angle_curve(np.arctan2(rho, z), distortion)[0] / rho
    return x * scale, y * scale


def distort(
    x: FloatArray, y: FloatArray, distortion: FloatArray, fisheye: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Distorted from undistorted normalised coordinates, any shape."""
    if fisheye:
        return _by_angle(x, y, np.ones_like(x), distortion)
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xy = x * y
    xd = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    return xd, yd


def project(camera: Camera, points_C: FloatArray) -> FloatArray:
    """Pixels of points in the camera's frame.

    Parameters
    ----------
    points_C : (..., 3) with positive Z; a fisheye lens takes any.

    Returns
    -------
    (..., 2) distorted pixels.
    """
    x, y, z = np.moveaxis(points_C, -1, 0)
    if camera.fisheye:
        xd, yd = _by_angle(x, y, z, camera.distortion)
    else:
        xd, yd = distort(x / z, y / z, camera.distortion)
    u = camera.fx_px * xd + camera.skew_px * yd + camera.cx_px
    v = camera.fy_px * yd + camera.cy_px
    return np.stack([u, v], axis=-1)


def distorted_normalised(camera: Camera, pixels: AnyArray) -> AnyArray:
    """Normalised distorted coordinates (..., 2) of pixels (..., 2), in the precision of the input."""
    kind = pixels.dtype.type
    y = (pixels[..., 1] - kind(camera.cy_px)) / kind(camera.fy_px)
    x = (pixels[..., 0] - kind(camera.cx_px) - kind(camera.skew_px) * y) / kind(camera.fx_px)
    return np.stack([x, y], axis=-1)


def undistort(camera: Camera, pixels: FloatArray, iterations: int = 30) -> FloatArray:
    """Normalised undistorted coordinates (x, y) of distorted pixels, by Newton's method.

    Where the distortion folds over and no answer exists the result is NaN, and where a fisheye lens shows
    what is beside the camera or behind it.

    Parameters
    ----------
    pixels : (..., 2) distorted pixels.

    Returns
    -------
    (..., 2) normalised coordinates.
    """
    if camera.fisheye:
        ahead = rays(camera, pixels)
        return np.where(ahead[..., 2:] > 0.0, ahead[..., :2] / np.maximum(ahead[..., 2:], 1e-300), np.nan)
    xd, yd = np.moveaxis(distorted_normalised(camera, pixels), -1, 0)
    x, y = xd.copy(), yd.copy()
    with np.errstate(all="ignore"):
        now = _Ratios.of(x, y, 1.0, camera.distortion)
        for _ in range(iterations):
            ex, ey = xd - now.xd, yd - now.yd
            det = now.xd_x * now.yd_y - now.cross**2
            # A step longer than the radius would leap over the fold of a barrel distortion.
            step_x, step_y = (now.yd_y * ex - now.cross * ey) / det, (now.xd_x * ey - now.cross * ex) / det
            limit = 0.5 * np.hypot(xd, yd) + 0.1
            scale = np.minimum(1.0, limit / np.maximum(np.hypot(step_x, step_y), 1e-300))
            x = x + scale * step_x
            y = y + scale * step_y
            now = _Ratios.of(x, y, 1.0, camera.distortion)
            if not np.any(np.hypot(step_x, step_y) > 1e-14):
                break
        solved = np.hypot(xd - now.xd, yd - now.yd) < 1e-10
        # Both eigenvalues positive: beyond the fold the picture of the point's antipode has none.
        solved &= (now.xd_x * now.yd_y > now.cross**2) & (now.xd_x + now.yd_y > 0.0)
        solved &= np.hypot(x, y) < fold_radius(camera)[0]
    return np.where(solved[..., None], np.stack([x, y], axis=-1), np.nan)


def rays(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Directions (..., 3) of length one in the camera's frame of distorted pixels (..., 2).

    NaN where the lens model shows nothing. Those of a fisheye lens go on behind the camera.
    """
    if not camera.fisheye:
        ideal = undistort(camera, pixels)
        toward = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
        return np.asarray(toward / np.linalg.norm(toward, axis=-1, keepdims=True))
    xd, yd = np.moveaxis(distorted_normalised(camera, pixels), -1, 0)
    radius = np.hypot(xd, yd)
    theta = _angle_of(camera, radius)
    around = np.sin(theta) / np.maximum(radius, _SMALL)
    return np.stack([xd * around, yd * around, np.cos(theta)], axis=-1)


def _angle_of(camera: Camera, radius: FloatArray) -> FloatArray:
    """theta of theta_d, by Newton's method kept between bounds; NaN beyond where theta_d grows."""
    last, most = fold_angle(camera)
    goal = np.where(radius < most, radius, 0.0)
    low, high = np.zeros_like(goal), np.full_like(goal, last)
    theta = np.minimum(goal, 0.5 * last)
    for _ in range(_BISECTIONS):
        theta_d, slope = angle_curve(theta, camera.distortion)
        error = theta_d - goal
        low, high = np.where(error <= 0.0, theta, low), np.where(error >= 0.0, theta, high)
        after = theta - error / np.maximum(slope, _SMALL)
        after = np.where((after < low) | (after > high), 0.5 * (low + high), after)
        moved = np.max(np.abs(after - theta), initial=0.0)
        theta = after
        if moved < 1e-15:
            break
    return np.where(radius < most, theta, np.nan)


_BISECTIONS = 60
"""Halvings of an interval that reach its rounding."""


# ----------------------------------------------------------------------
# How far a lens model is one-to-one. Beyond a fold of its radial curve two directions share a pixel; what
# lies beyond a pole of the rational model comes into the picture from the other side.


def focal_px(camera: Camera) -> float:
    """Geometric mean of the focal lengths."""
    return float(np.sqrt(camera.fx_px * camera.fy_px))


def corner_radius(camera: Camera) -> float:
    """Largest normalised radius of the picture's corners, distorted, and no farther than `ahead_radius`."""
    width, height = camera.image_size_px
    corners = distorted_normalised(camera, box_grid((0.0, 0.0, width - 1.0, height - 1.0), 2, 2))
    return min(float(np.hypot(*corners.T).max()), ahead_radius(camera))


def ahead_radius(camera: Camera) -> float:
    """theta_d of a right angle, beyond which a fisheye lens shows nothing that is ahead of the camera.

    Infinite for other lenses, and where theta_d stops growing before.
    """
    right = np.array(0.5 * np.pi)
    if not camera.fisheye or fold_angle(camera)[0] < right:
        return np.inf
    return float(angle_curve(right, camera.distortion)[0])


def _first_root(polynomial: Any) -> float:
    """The least positive root, infinite where there is none."""
    roots = polynomial.trim().roots()
    real = roots[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))) & (roots.real > 0)].real
    return float(real.min()) if len(real) else np.inf


def fold_angle(camera: Camera) -> tuple[float, float]:
    """Where theta_d of a fisheye lens stops growing, at most straight behind: theta and theta_d."""
    k1, k2, _, _, k3, k4, _, _ = camera.distortion
    fold = _first_root(np.polynomial.Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
    theta = min(float(np.sqrt(fold)), np.pi)
    return theta, float(angle_curve(np.array(theta), camera.distortion)[0])


def fold_radius(camera: Camera) -> tuple[float, float]:
    """Where the radial curve r L(r) stops rising, at a fold or a pole: radii r and r L(r).

    Normalised; infinite where it rises for ever, the distorted radius also at a pole. With L = N / D in
    rho = r^2 the slope vanishes where N D + 2 rho (N' D - N D') = 0.
    A fisheye lens has the tangent of `fold_angle` for r, infinite from a right angle on.
    """
    if camera.fisheye:
        theta, theta_d = fold_angle(camera)
        return float(np.tan(theta)) if theta < 0.5 * np.pi else np.inf, theta_d
    return _fold_of_ratio(*camera.distortion.tolist())


@lru_cache(maxsize=64)
def _fold_of_ratio(*distortion: float) -> tuple[float, float]:
    """The same of k1, k2, p1 ... k6; asked of one camera again and again."""
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    N, D = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    rho = np.polynomial.Polynomial([0, 1])

    fold, pole = _first_root(N * D + 2 * rho * (N.deriv() * D - N * D.deriv())), _first_root(D)
    if pole < fold:
        return float(np.sqrt(pole)), np.inf
    radius = float(np.sqrt(fold))
    return radius, radius * float(N(fold) / D(fold)) if np.isfinite(fold) else np.inf


def one_to_one_reach(camera: Camera) -> float:
    """How far the radial curve is one-to-one, over the distance of the picture's farthest corner.

    Both the picture and the ideal one that undistortion makes of it have to lie inside.
    """
    return float(min(fold_radius(camera)) / corner_radius(camera))


# ----------------------------------------------------------------------
# Residuals of all views and their Jacobian, for the bundle adjustment.
#
# For the point X of the target, p = R X + t in the camera's frame, x = p1 / p3, y = p2 / p3, distorted
# and projected as above. With a = du/dp (3,) the derivatives are, for a rotation
# exp(delta) R on the left,
#
#     du/d(delta) = (R X) x a,   du/dt = a,   du/dw_k = a . R B_k
#
# where the target is X + sum_k w_k B_k when it is allowed to deform. The fisheye model takes p without
# dividing by p3: with m = theta_d / rho and d^2 = rho^2 + p3^2,
#
#     d(p_i m)/dp_j = m [i = j] + p_i p_j (theta_d' p3 / d^2 - m) / rho^2
#     d(p_i m)/dp3  = -p_i theta_d' / d^2
#
# All arrays are kept with the point last, so that each line of code runs over all views and points at once.

INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px", *COEFFICIENTS)
"""Order of the vector of intrinsics."""


@dataclass(frozen=True)
class Block:
    """What the residuals depend on.

    Attributes
    ----------
    intrinsics : (13,) in the order of `INTRINSICS`.
    R_CT, t_CT_m : (N, 3, 3) and (N, 3), pose of the target in the camera's frame.
    deformation : (K,) weights of the target's deformation, metres; none of a rigid one.
    fisheye : `Camera.fisheye`.
    """

    intrinsics: FloatArray
    R_CT: FloatArray
    t_CT_m: FloatArray
    deformation: FloatArray = field(default_factory=lambda: np.zeros(0))
    fisheye: bool = False

    @staticmethod
    def of(camera: Camera, R_CT: FloatArray, t_CT_m: FloatArray) -> Block:
        """A camera before a rigid target with these poses."""
        return Block(vector_from_camera(camera), R_CT, t_CT_m, fisheye=camera.fisheye)

    @property
    def posed(self) -> BoolArray:
        """Which views (N,) have a pose."""
        known = np.isfinite(self.R_CT).all(axis=(1, 2)) & np.isfinite(self.t_CT_m).all(axis=1)
        return np.asarray(known)

    @property
    def normals(self) -> FloatArray:
        """Normals (N, 3) of the target's planes, away from the camera.

        A mirrored list of points turns a board's back to the camera; its plane leans the same way.
        """
        return np.asarray(self.R_CT[:, :, 2] * np.where(self.R_CT[:, 2, 2:] < 0.0, -1.0, 1.0))

    def part(self, views: slice | IntArray | Sequence[int]) -> Block:
        """The same with the poses of some views only."""
        return replace(self, R_CT=self.R_CT[views], t_CT_m=self.t_CT_m[views])


def free_intrinsics(model: str, skew: bool, fixed: tuple[str, ...] = ()) -> IntArray:
    """Indices into `INTRINSICS` that the model estimates."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px") + (("skew_px",) if skew else ()) + MODELS[model]
    return np.array([INTRINSICS.index(name) for name in names if name not in fixed], dtype=np.int64)


def camera_from_vector(model: str, image_size_px: tuple[int, int], intrinsics: FloatArray) -> Camera:
    """A camera from the vector of intrinsics."""
    fx, fy, cx, cy, skew = (float(value) for value in intrinsics[:5])
    return Camera(model, image_size_px, fx, fy, skew, cx, cy, intrinsics[5:].copy())


def vector_from_camera(camera: Camera) -> FloatArray:
    """The vector of intrinsics (13,) of a camera."""
    five = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew_px]
    return np.concatenate([five, camera.distortion])


@dataclass(frozen=True)
class _Ratios:
    """Points (N, M) seen by a lens that distorts x = p1 / p3 and y = p2 / p3."""

    x: FloatArray
    y: FloatArray
    inverse: FloatArray | float
    over: FloatArray | float
    radial: FloatArray
    xd: FloatArray
    yd: FloatArray
    xd_x: FloatArray
    cross: FloatArray
    yd_y: FloatArray

    @classmethod
    def of(cls, x: FloatArray, y: FloatArray, inverse: FloatArray | float, distortion: FloatArray) -> Self:
        """Of undistorted x and y, and 1 / p3."""
        k1, k2, t1, t2, k3, k4, k5, k6 = distortion
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3))
        over: FloatArray | float = 1.0
        radial = numerator
        if k4 or k5 or k6:
            over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            radial = numerator * over
            slope = (slope - radial * (k4 + r2 * (2.0 * k5 + r2 * (3.0 * k6)))) * over
        xd = x * radial
        yd = y * radial
        if t1 or t2:
            xd = xd + 2.0 * t1 * xy + t2 * (r2 + 2.0 * xx)
            yd = yd + t1 * (r2 + 2.0 * yy) + 2.0 * t2 * xy
        # Derivatives of the distorted by the undistorted normalised coordinates; symmetric.
        xd_x = radial + 2.0 * xx * slope + (2.0 * t1 * y + 6.0 * t2 * x if t1 or t2 else 0.0)
        yd_y = radial + 2.0 * yy * slope + (6.0 * t1 * y + 2.0 * t2 * x if t1 or t2 else 0.0)
        cross = 2.0 * xy * slope + (2.0 * t1 * x + 2.0 * t2 * y if t1 or t2 else 0.0)
        return cls(x, y, inverse, over, radial, xd, yd, xd_x, cross, yd_y)

    def by_coefficient(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Derivatives of (xd, yd) by one distortion coefficient."""
        x, y = self.x, self.y
        r2 = x * x + y * y
        if name == "p1":
            return 2.0 * x * y, r2 + 2.0 * y * y
        if name == "p2":
            return r2 + 2.0 * x * x, 2.0 * x * y
        power = {"k1": 1, "k2": 2, "k3": 3, "k4": 1, "k5": 2, "k6": 3}[name]
        factor = r2 if power == 1 else r2 * r2 if power == 2 else r2 * r2 * r2
        factor = factor * self.over
        if name in ("k4", "k5", "k6"):
            factor = -factor * self.radial
        return x * factor, y * factor

    def by_point(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """Derivatives of xd and of yd by p1, p2 and p3."""
        a, b, c = self.xd_x * self.inverse, self.cross * self.inverse, self.yd_y * self.inverse
        return (a, b, -(self.x * a + self.y * b)), (b, c, -(self.x * b + self.y * c))


@dataclass(frozen=True)
class _Angles:
    """Points (N, M) seen by a fisheye lens; `toward` are p1 / rho and p2 / rho, `by` rows of d(xd, yd)/dp."""

    theta: FloatArray
    toward: tuple[FloatArray, FloatArray]
    xd: FloatArray
    yd: FloatArray
    by: tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]

    @classmethod
    def of(cls, p1: FloatArray, p2: FloatArray, p3: FloatArray, distortion: FloatArray) -> Self | None:
        """None where a point is straight behind the camera."""
        rho = np.maximum(np.hypot(p1, p2), _SMALL * np.abs(p3))
        theta = np.arctan2(rho, p3)
        if theta.max() > np.pi - _BEHIND:
            return None
        theta_d, slope = angle_curve(theta, distortion)
        m, d2 = theta_d / rho, rho * rho + p3 * p3
        bend, along = (slope * p3 / d2 - m) / (rho * rho), -slope / d2
        cross = p1 * p2 * bend
        by = (m + p1 * p1 * bend, cross, p1 * along), (cross, m + p2 * p2 * bend, p2 * along)
        return cls(theta, (p1 / rho, p2 / rho), p1 * m, p2 * m, by)

    def by_coefficient(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Derivatives of (xd, yd) by one distortion coefficient."""
        power = {"k1": 3, "k2": 5, "k3": 7, "k4": 9}.get(name)
        factor = np.zeros_like(self.theta) if power is None else self.theta**power
        return self.toward[0] * factor, self.toward[1] * factor

    def by_point(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
        """Derivatives of xd and of yd by p1, p2 and p3."""
        return self.by


def jacobian(
    block: Block, observations: Observations, free: IntArray, basis: FloatArray | None
) -> FloatArray | None:
    """Jacobian and residuals stacked, (N, G + 7, 2 M), or None where a point is behind the camera.

    Rows: free intrinsics and deformation (G together), rotation (3), translation (3), and last the
    residual, projected minus measured. Columns: all u, then all v. Points that are not present are
    zero throughout.

    Parameters
    ----------
    free : indices into `INTRINSICS`.
    basis : (K, 3, M) displacements of the target's points, or (N, K, 3, M) where views have points of their
        own; None for a rigid target.
    """
    points = observations.pixels.shape[1]
    target = observations.target_m.transpose(0, 2, 1)
    if basis is not None:
        target = target + np.tensordot(block.deformation, basis, axes=(0, basis.ndim - 3))
    # (n, 3, M) and (N, 3, 3): R X without the translation.
    rotated = block.R_CT @ target
    p1, p2, p3 = np.moveaxis(rotated + block.t_CT_m[:, :, None], 1, 0)
    if not observations.complete:
        p3 = np.where(observations.present, p3, 1.0)
    lens: _Angles | _Ratios | None = None
    if block.fisheye:
        lens = _Angles.of(p1, p2, p3, block.intrinsics[5:])
    elif p3.min() > 0.0:
        inverse = 1.0 / p3
        lens = _Ratios.of(p1 * inverse, p2 * inverse, inverse, block.intrinsics[5:])
    if lens is None:
        return None
    fx, fy, cx, cy, skew = block.intrinsics[:5]
    xd, yd = lens.xd, lens.yd
    shared = len(free) + (0 if basis is None else basis.shape[-3])
    out = np.empty((observations.views, shared + 7, 2, points))
    for row, index in enumerate(free):
        u, v = out[:, row, 0], out[:, row, 1]
        name = INTRINSICS[index]
        if name in ("fx_px", "cx_px", "skew_px"):
            u[:] = xd if name == "fx_px" else yd if name == "skew_px" else 1.0
            v[:] = 0.0
        elif name in ("fy_px", "cy_px"):
            u[:] = 0.0
            v[:] = yd if name == "fy_px" else 1.0
        else:
            dx, dy = lens.by_coefficient(name)
            np.multiply(fx, dx, out=u)
            if skew:
                u += skew * dy
            np.multiply(fy, dy, out=v)
    pose = out[:, shared : shared + 6]
    q1, q2, q3 = rotated[:, 0], rotated[:, 1], rotated[:, 2]
    for row, (by_x, by_y) in enumerate(zip(*lens.by_point(), strict=True)):
        np.multiply(fx, by_x, out=pose[:, 3 + row, 0])
        if skew:
            pose[:, 3 + row, 0] += skew * by_y
        np.multiply(fy, by_y, out=pose[:, 3 + row, 1])
    for side in (0, 1):
        turn1, turn2, turn3, a1, a2, a3 = (pose[:, row, side] for row in range(6))
        np.multiply(q2, a3, out=turn1)
        turn1 -= q3 * a2
        np.multiply(q3, a1, out=turn2)
        turn2 -= q1 * a3
        np.multiply(q1, a2, out=turn3)
        turn3 -= q2 * a1
        if basis is not None:
            in_target = np.einsum("ncm,ncd->ndm", pose[:, 3:, side], block.R_CT)
            out[:, len(free) : shared, side] = np.einsum(
                "ndm,kdm->nkm" if basis.ndim == 3 else "ndm,nkdm->nkm", in_target, basis
            )
    residual_u, residual_v = out[:, shared + 6, 0], out[:, shared + 6, 1]
    residual_u[:] = fx * xd + skew * yd + cx - observations.pixels[..., 0]
    residual_v[:] = fy * yd + cy - observations.pixels[..., 1]
    if not observations.complete:
        out *= observations.present[:, None, None, :]
    return out.reshape(observations.views, shared + 7, 2 * points)


def point_derivatives(camera: Camera, points_C: FloatArray, free: IntArray) -> FloatArray:
    """Derivatives of the pixels of points (n, 3) in the camera's frame, and last the pixels, (n, 2, P + 7).

    By the P intrinsics `free`, a small rotation and a translation; all NaN where one is behind the camera.
    """
    n = len(points_C)
    here = Block.of(camera, np.eye(3)[None], np.zeros((1, 3)))
    rows = jacobian(here, Observations.of(points_C, np.zeros((1, n, 2))), free, None) if n else None
    if rows is None:
        return np.full((n, 2, len(free) + 7), np.nan)
    return np.asarray(rows[0].reshape(-1, 2, n).transpose(2, 1, 0))
