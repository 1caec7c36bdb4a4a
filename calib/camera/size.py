"""How many corners a board of unknown size has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np

from calib.arrays import FloatArray, GrayImage
from calib.camera.boardcheck import fault_of, surroundings
from calib.camera.lattice import extrapolated, find_lattices
from calib.camera.refine import Refined, refine, square_px
from calib.camera.saddles import find_saddles
from calib.camera.search import complete, lattice_levels, resized

__all__ = ["board_size", "board_sizes"]

_LEAST_CORNERS = 9
_ROUNDS = 12
_NARROW = 0.65
"""Largest share of corners that only a small window can fit, in a board that nobody asked for."""
_MISFIT = 0.04
"""Largest misfit, in squares, of a board that nobody asked for."""
_LATTICES = 3
_OPENCV_PIXELS = 1_300_000


def _whole(gray: GrayImage, points: FloatArray) -> Refined | None:
    """Refine a grid and add the rows that follow it, until there are none; None when it is no board.

    A pattern that leaves the picture on every side has no size.
    """
    for _ in range(_ROUNDS):
        if min(points.shape[:2]) < 3:
            return None
        grid = refine(gray, points)
        if grid is None or fault_of(gray, grid) is not None:
            return None
        around = surroundings(gray, grid)
        top, bottom, left, right = around.continues
        if not any(around.continues):
            sure = grid.refined.all() and grid.narrow.mean() < _NARROW
            sure &= grid.misfit_px < _MISFIT * square_px(grid.points)
            return grid if sure and any(around.seen) else None
        wide = extrapolated(grid.points)
        wide[1:-1, 1:-1] = grid.points
        for v, v1 in ((0, 1), (-1, -2)):
            for u, u1 in ((0, 1), (-1, -2)):
                wide[v, u] = wide[v, u1] + wide[v1, u] - wide[v1, u1]
        rows, columns = wide.shape[:2]
        points = wide[
            0 if top else 1 : rows - (0 if bottom else 1), 0 if left else 1 : columns - (0 if right else 1)
        ]
    return None


def board_size(gray: GrayImage) -> tuple[int, int] | None:
    """Size (columns, rows), columns >= rows, of the largest board of one picture."""
    for zoom in lattice_levels(gray):
        level = resized(gray, zoom)
        best: tuple[float, tuple[int, int]] | None = None
        for lattice in find_lattices(find_saddles(level.image), least=6)[:_LATTICES]:
            points = complete(lattice)
            grid = None if points is None else _whole(gray, level.to_picture(points))
            if grid is None or grid.refined.size < _LEAST_CORNERS:
                continue
            span = np.ptp(grid.points.reshape(-1, 2), axis=0)
            area = float(span[0] * span[1])
            if best is None or area > best[0]:
                sides = sorted(grid.refined.shape, reverse=True)
                best = (area, (int(sides[0]), int(sides[1])))
        if best is not None:
            return best[1]
    return _size_by_opencv(gray)


def _size_by_opencv(gray: GrayImage) -> tuple[int, int] | None:
    n = 1
    while gray.size / n**2 > _OPENCV_PIXELS:
        n += 1
    level = resized(gray, 1.0 / n)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(level.image, (3, 3), flags)
    except cv2.error:
        return None
    if not found or corners is None or meta is None:
        return None
    rows, columns = meta.shape[:2]
    if corners.size != 2 * rows * columns:
        return None
    grid = _whole(gray, level.to_picture(np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)))
    if grid is None:
        return None
    sides = sorted(grid.refined.shape, reverse=True)
    return int(sides[0]), int(sides[1])


def board_sizes(pictures: Sequence[GrayImage]) -> tuple[int, int] | None:
    """The size that most pictures show, the larger one in a tie; None when no picture shows a board."""
    counts = Counter(size for size in map(board_size, pictures) if size is not None)
    return max(counts, key=lambda size: (counts[size], size[0] * size[1], size), default=None)
