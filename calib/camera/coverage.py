"""How varied the views of a calibration are: tilts, distances, image covered, pictures taken twice.

Two views whose boards are parallel say the same about the camera (Zhang 2000, section 4.3), so what
counts is not how far a board leans from the picture's plane but how far the boards' normals differ
among themselves; a board that never leans in any view is the worst case of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.camera.bundle import Calibration
from calib.camera.model import Camera, distort, undistort

__all__ = [
    "Coverage",
    "Lens",
    "coverage",
    "hull",
    "image_outline",
    "inside_hull",
    "lens_shape",
    "repeated_views",
    "target_box",
]

_DIRECTIONS = 72
_MAX_PAIRED = 2000
"""Views above which repeats are sought among the first ones only."""


@dataclass(frozen=True)
class Coverage:
    """Diversity of the views.

    Attributes
    ----------
    mirrored : (N,) views that show the target's back: its points are listed mirrored.
    tilts_deg : (N,) angle between the board's normal and the optical axis.
    spread_deg : largest angle between the normals of two views.
    weaker_spread_deg : standard deviation of the normals along their weaker direction.
    distances_m : (N,) from the camera to the board's middle.
    area_share : area of the hull of all points over the image's area.
    view_share : median over views of the hull of one view over the image's area.
    cells_share : share of the cells of a 6 x 5 grid over the image that hold a point.
    empty : which of 3 x 3 parts of the image (rows from the top) hold no point.
    radius_share : largest distance of a point from the principal point over that of the image's
        farthest corner.
    outside_share : share of points more than one pixel outside the image.
    hull_px : (H, 2) hull of all points.
    """

    mirrored: BoolArray
    tilts_deg: FloatArray
    spread_deg: float
    weaker_spread_deg: float
    distances_m: FloatArray
    area_share: float
    view_share: float
    cells_share: float
    empty: BoolArray
    radius_share: float
    outside_share: float
    hull_px: FloatArray


@dataclass(frozen=True)
class Lens:
    """Shape of the distortion over the image.

    Attributes
    ----------
    seen_slope : least derivative of distorted by undistorted radius over the radii that were seen,
        relative to the centre.
    image_slope : the same out to the image's corners; zero or less where the lens folds over.
    image_shown : share of points along the image's border that the model can show at all.
    """

    seen_slope: float
    image_slope: float
    image_shown: float


def hull(points: FloatArray) -> FloatArray:
    """Extreme points (H, 2) of a set (n, 2) in 72 directions, in order around it: its hull to a percent."""
    angle = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    extreme = np.argmax(np.stack([np.cos(angle), np.sin(angle)], axis=1) @ points.T, axis=1)
    kept = np.flatnonzero(np.diff(extreme, prepend=extreme[-1]) != 0)
    return np.asarray(points[extreme[kept]] if len(kept) else points[extreme[:1]])


def _area(corners: FloatArray) -> float:
    x, y = corners[:, 0], corners[:, 1]
    return float(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def inside_hull(points: FloatArray, corners: FloatArray) -> BoolArray:
    """Which points (n, 2) lie inside a convex polygon (H, 2)."""
    side = np.roll(corners, -1, axis=0) - corners
    offset = points[:, None] - corners
    turn = side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]
    return np.asarray(np.all(turn >= -1e-9, axis=1) | np.all(turn <= 1e-9, axis=1))


def target_box(calibration: Calibration) -> FloatArray:
    """Corners (4, 3) of the box around all points of the target, on its plane."""
    observations = calibration.observations
    target = np.broadcast_to(observations.target_m, (*observations.pixels.shape[:2], 3))
    used = target[observations.present]
    (x0, y0), (x1, y1) = used[:, :2].min(axis=0), used[:, :2].max(axis=0)
    return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])


def coverage(calibration: Calibration) -> Coverage:
    """Diversity of the views of a calibration and the part of the image that they cover."""
    observations, camera, block = calibration.observations, calibration.camera, calibration.block
    width, height = camera.image_size_px
    pixels = observations.pixels[observations.present]
    outline = hull(pixels)
    areas = [_area(hull(p[on])) for p, on in zip(observations.pixels, observations.present, strict=True)]
    cells = _cells(pixels, camera, 6, 5)
    normals = block.R_CT[:, :, 2]
    # A mirrored list of points turns the board's back to the camera; its plane leans the same way.
    normals = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    middle = block.R_CT @ target_box(calibration).mean(axis=0) + block.t_CT_m
    centre = np.array([camera.cx_px, camera.cy_px])
    corner = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=np.float64)
    outside = (pixels < -1.0) | (pixels > np.array([width, height], dtype=np.float64))
    return Coverage(
        mirrored=block.R_CT[:, 2, 2] < 0.0,
        tilts_deg=np.degrees(np.arccos(np.clip(normals[:, 2], 0.0, 1.0))),
        spread_deg=_widest_angle_deg(normals),
        weaker_spread_deg=_weaker_spread_deg(normals),
        distances_m=np.linalg.norm(middle, axis=1),
        area_share=_area(outline) / (width * height),
        view_share=float(np.median(areas)) / (width * height),
        cells_share=float(np.mean(cells)),
        empty=~_cells(pixels, camera, 3, 3),
        radius_share=float(
            np.linalg.norm(pixels - centre, axis=1).max() / np.linalg.norm(corner - centre, axis=1).max()
        ),
        outside_share=float(outside.any(axis=1).mean()),
        hull_px=outline,
    )


def _cells(pixels: FloatArray, camera: Camera, columns: int, rows: int) -> BoolArray:
    width, height = camera.image_size_px
    column = np.clip((pixels[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    row = np.clip((pixels[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    hit = np.zeros((rows, columns), dtype=np.bool_)
    hit[row, column] = True
    return hit


def _widest_angle_deg(normals: FloatArray) -> float:
    """Largest angle between two normals, exact for few views and to a degree for many."""
    some = normals[:: max(1, len(normals) // _MAX_PAIRED)]
    return float(np.degrees(np.arccos(np.clip((some @ some.T).min(), -1.0, 1.0))))


def _weaker_spread_deg(normals: FloatArray) -> float:
    if len(normals) < 2:
        return 0.0
    singular = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False)
    # The third is the curvature of the sphere, the second the weaker direction on it.
    return float(np.degrees(singular[1] / np.sqrt(len(normals) - 1)))


def repeated_views(calibration: Calibration, limit_px: float) -> IntArray:
    """For each view the first view that shows the board in the same place, or its own index, (N,).

    The same place: the corners of the target's box are seen within `limit_px`, root mean square.
    Found from the poses, so that views of different points of a target can be compared.
    """
    block, camera = calibration.block, calibration.camera
    first = np.arange(len(block.R_CT))
    count = min(len(first), _MAX_PAIRED)
    seen = target_box(calibration) @ block.R_CT[:count].transpose(0, 2, 1) + block.t_CT_m[:count, None]
    # Without distortion, which may fold over outside of the image; the pixels are off by little.
    flat = (seen[..., :2] / np.maximum(seen[..., 2:], 1e-9)).reshape(count, 8)
    flat = flat * np.sqrt(abs(camera.fx_px * camera.fy_px))
    square = (flat**2).sum(axis=1)
    apart = np.maximum(square[:, None] + square - 2 * flat @ flat.T, 0.0) / 4
    near = (apart < limit_px**2 + 1e-12 * square.max()) & (np.arange(count) < np.arange(count)[:, None])
    for i in np.flatnonzero(near.any(axis=1)):
        first[i] = first[int(np.argmax(near[i]))]
    return first


def image_outline(camera: Camera, per_side: int = 9) -> FloatArray:
    """Pixels (4 * (per_side - 1), 2) along the image's border."""
    width, height = camera.image_size_px
    u, v = np.linspace(0, width - 1, per_side), np.linspace(0, height - 1, per_side)
    top = np.stack([u[:-1], np.zeros(per_side - 1)], axis=1)
    right = np.stack([np.full(per_side - 1, width - 1.0), v[:-1]], axis=1)
    return np.concatenate([top, right, [width - 1, height - 1] - top, [width - 1, height - 1] - right])


def lens_shape(calibration: Calibration) -> Lens:
    """Whether the distortion is monotonic over the radii that were seen and over the image."""
    camera, block, observations = calibration.camera, calibration.block, calibration.observations
    points = observations.target_m @ block.R_CT.transpose(0, 2, 1) + block.t_CT_m[:, None]
    radii = np.hypot(points[..., 0], points[..., 1]) / np.maximum(points[..., 2], 1e-9)
    seen = float(radii[observations.present].max())
    border = undistort(camera, image_outline(camera))
    shown = np.isfinite(border).all(axis=1)
    reach = float(np.hypot(*border[shown].T).max()) if shown.any() else seen
    image_slope = _least_slope(camera, max(reach, seen))
    return Lens(
        seen_slope=_least_slope(camera, seen),
        image_slope=image_slope if shown.all() else min(image_slope, 0.0),
        image_shown=float(shown.mean()),
    )


def _least_slope(camera: Camera, radius: float) -> float:
    """Least slope of the radial curve up to an undistorted radius."""
    r = np.linspace(0.0, radius, 201)
    radial = camera.distortion.copy()
    radial[2:4] = 0.0
    distorted, _ = distort(r, np.zeros_like(r), radial)
    return float(np.min(np.diff(distorted) / np.diff(r)))
