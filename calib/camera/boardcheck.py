"""Is a refined grid a whole checkerboard? What a texture, or a part of a larger board, gets wrong."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from calib.arrays import BoolArray, FloatArray, GrayImage
from calib.camera.cornerfit import fit_corners, frames_of
from calib.camera.lattice import extrapolated, looks_like_corners
from calib.camera.refine import Refined, misshape, part_around, square_px
from calib.camera.saddles import sample

__all__ = ["Surroundings", "fault_of", "surroundings"]

_UNREFINED_SHARE = 0.1
_MISFIT = 0.08
"""Largest typical distance of a corner from where the others place it, in squares."""
_MEDIAN_RESIDUAL = 0.25
_LEAST_AMPLITUDE = 2.5
"""Grey levels."""
_CONTINUES = 0.4
"""Least amplitude of a further corner over the median of the grid."""
_WORST_RESIDUAL = 0.3
_REACH_PX = 10
_ITERATIONS = 8
_UNEVEN_SHARE = 0.4
"""Largest share of squares that a shadow's edge may cross."""
_LEAST_STEP = 0.38
"""Least step between neighbouring squares over the step at the corners."""
_FLAT = 0.6
"""Largest difference between the quarters of a square, over the step from dark to bright."""

_Float32 = npt.NDArray[np.float32]


def _turns_alike(points: FloatArray) -> bool:
    """Whether every square is convex and turns the same way."""
    a, b = points[:-1, :-1], points[:-1, 1:]
    c, d = points[1:, 1:], points[1:, :-1]
    sides = [b - a, c - b, d - c, a - d]
    for one, two in zip(sides, sides[1:] + sides[:1], strict=True):
        if np.any(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0] <= 0):
            return False
    return True


def _squares_are_plain(smooth: _Float32, grid: Refined) -> bool:
    """Whether the squares between the corners alternate and are of one tone each."""
    p = grid.points
    corners = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]])
    middle = corners.mean(axis=0)
    quarters = sample(smooth, 0.5 * (corners + middle))
    tone = quarters.mean(axis=0)
    i, j = np.indices(tone.shape)
    bright = grid.sign * (1 - 2 * ((i + j) % 2)) > 0
    step = 2.0 * float(np.median(np.abs(grid.amplitude)))
    amplitude = np.abs(grid.amplitude)
    local = 0.5 * (amplitude[:-1, :-1] + amplitude[1:, :-1] + amplitude[:-1, 1:] + amplitude[1:, 1:])
    if bright.any() and (~bright).any():
        # Each square against the neighbours that share a side with it, which have the other colour.
        signed = np.where(bright, tone, -tone)
        across, down = signed[:, 1:] + signed[:, :-1], signed[1:] + signed[:-1]
        if min(across.min(initial=np.inf), down.min(initial=np.inf)) < _LEAST_STEP * float(local.min()):
            return False
    uneven = quarters.max(axis=0) - quarters.min(axis=0)
    return bool(np.mean(uneven > _FLAT * np.maximum(local, 0.25 * step)) < _UNEVEN_SHARE)


def fault_of(gray: GrayImage, grid: Refined) -> str | None:
    """What speaks against a grid being a checkerboard, in a few words; None when nothing does."""
    height, width = gray.shape
    square = square_px(grid.points)
    shape = grid.refined.shape
    if np.any(grid.points < -0.5) or np.any(grid.points > np.array([width, height]) - 0.5):
        return "corners outside the picture"
    if np.sum(~grid.refined) > _UNREFINED_SHARE * grid.refined.size:
        return "corners that are none"
    if np.median(np.abs(grid.amplitude)) < _LEAST_AMPLITUDE:
        return "too little contrast"
    if np.median(grid.residual) > _MEDIAN_RESIDUAL:
        return "corners of another shape"
    if not grid.misfit_px < _MISFIT * square:
        return "corners off the grid"
    if not _turns_alike(grid.points):
        return "a folded grid"
    if min(shape) >= 2 and not _squares_are_plain(_smoothed(gray, square), grid):
        return "squares that are not plain"
    return None


def _smoothed(gray: GrayImage, square: float) -> _Float32:
    return np.asarray(cv2.blur(gray.astype(np.float32), (3, 3)) if square > 12.0 else gray.astype(np.float32))


@dataclass(frozen=True)
class Surroundings:
    """What is beyond the four sides of a grid's arrays: top, bottom, left, right.

    Attributes
    ----------
    continues : whether another row of corners follows.
    seen : whether the picture shows where that row would be.
    """

    continues: tuple[bool, bool, bool, bool]
    seen: tuple[bool, bool, bool, bool]


def surroundings(gray: GrayImage, grid: Refined) -> Surroundings:
    """Look for another row of corners on each side.

    A part of a larger board is not the board: which part it is cannot be told.
    """
    nothing = (False, False, False, False)
    place = extrapolated(grid.points)
    place[1:-1, 1:-1] = grid.points
    for v, v1 in ((0, 1), (-1, -2)):
        for u, u1 in ((0, 1), (-1, -2)):
            place[v, u] = place[v, u1] + place[v1, u] - place[v1, u1]
    part = part_around(gray, place)
    if part is None:
        return Surroundings(nothing, nothing)
    image, local = part.image, part.points
    frames = frames_of(local)
    rows, columns = local.shape[:2]
    outside = np.ones((rows, columns), dtype=np.bool_)
    outside[1:-1, 1:-1] = False
    outside[:: rows - 1, :: columns - 1] = False
    low, high = np.array([1.0, 1.0]), np.array(image.shape[::-1]) - 2.0
    inside = outside & np.all((local > low) & (local < high), axis=-1)
    i, j = np.indices((rows, columns))
    parity = (1.0 - 2.0 * ((i + j) % 2)) * grid.sign
    least = _CONTINUES * float(np.median(np.abs(grid.amplitude)))
    along, across = frames.along.reshape(local.shape), frames.across.reshape(local.shape)
    half_step, unlike = looks_like_corners(image, local, along, across)
    chosen = np.flatnonzero((inside & (parity * half_step > 0.5 * least) & (unlike < 1.0)).ravel())
    found: BoolArray = np.zeros(rows * columns, dtype=np.bool_)
    if len(chosen):
        fit = fit_corners(image, local.reshape(-1, 2)[chosen], frames.take(chosen), _ITERATIONS, _REACH_PX)
        square = np.minimum(np.linalg.norm(frames.along, axis=1), np.linalg.norm(frames.across, axis=1))
        near = np.linalg.norm(fit.points - local.reshape(-1, 2)[chosen], axis=1) < 0.3 * square[chosen]
        strong = parity.ravel()[chosen] * fit.amplitude > least
        found[chosen] = fit.converged & near & strong & (misshape(fit, part.noise) < _WORST_RESIDUAL)
    hit = found.reshape(rows, columns)
    lines = (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1])
    count = [int(inside[line].sum()) for line in lines]
    hits = [int(hit[line].sum()) for line in lines]
    top, bottom, left, right = (n >= 2 and h >= max(2, 0.5 * n) for h, n in zip(hits, count, strict=True))
    above, below, before, after = (n >= 2 for n in count)
    return Surroundings((top, bottom, left, right), (above, below, before, after))
