"""Corners of a checkerboard in a picture: found, refined and in one order for every picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray, GrayImage
from calib.camera.boardcheck import fault_of, surroundings
from calib.camera.ordering import canonical_turn, orderings
from calib.camera.refine import Refined, refine, square_px
from calib.camera.search import fallback_stages, lattice_stages
from calib.camera.size import board_sizes
from calib.errors import BadInputError

__all__ = ["Detection", "detect", "find_size", "orderings"]

_LEAST_RANGE = 6
"""Grey levels between the darkest and the brightest pixel of a picture that may show a board."""


@dataclass(frozen=True)
class Detection:
    """A checkerboard found in a picture.

    Corner (column i, row j) has index j * columns + i. The grid is not mirrored: the rows axis is
    clockwise from the columns axis as seen. Where the colours tell turns of the board apart, the
    square outward of corner (0, 0) is dark; else the columns axis points right in the picture to
    within 90 degrees (45 on square boards).

    Attributes
    ----------
    pixels : (rows * columns, 2), (0, 0) at the centre of the top-left pixel, u right, v down.
    columns, rows : inner corners.
    detector : name of the stage that found the board.
    sigma_px : (rows * columns,) standard deviation of one coordinate of a corner, from its own fit.
    refined : (rows * columns,) False where the corner itself could not be measured: `pixels` then has
        its place between the others and must not be taken for a measurement.
    square_px : median side of the squares.
    contrast : median half step from dark to bright, grey levels.
    misfit_px : typical distance of a corner from where the others, by a smooth fit, place it.
    """

    pixels: FloatArray
    columns: int
    rows: int
    detector: str
    sigma_px: FloatArray
    refined: BoolArray
    square_px: float
    contrast: float
    misfit_px: float


def _checked(gray: GrayImage) -> bool:
    """Whether there is anything to look at. Raises `BadInputError` on what is no grey picture."""
    if gray.ndim != 2 or gray.dtype != np.uint8:
        raise BadInputError(
            f"a picture for the corner search has shape {gray.shape} and type {gray.dtype}; expected two "
            "dimensions of uint8"
        )
    return min(gray.shape) >= 8 and int(gray.max()) - int(gray.min()) >= _LEAST_RANGE


def _ordered(grid: Refined, columns: int, rows: int, detector: str) -> Detection | None:
    turn = canonical_turn(grid.points, grid.amplitude, columns, rows)
    if turn is None:
        return None
    return Detection(
        pixels=np.ascontiguousarray(np.rot90(grid.points, turn)).reshape(-1, 2),
        columns=columns,
        rows=rows,
        detector=detector,
        sigma_px=np.rot90(grid.sigma_px, turn).ravel(),
        refined=np.rot90(grid.refined, turn).ravel(),
        square_px=square_px(grid.points),
        contrast=float(np.median(np.abs(grid.amplitude))),
        misfit_px=grid.misfit_px,
    )


def _best_of(gray: GrayImage, grids: Sequence[FloatArray]) -> Refined | None:
    """The grid that passes every test; of several the one with the largest squares."""
    best: Refined | None = None
    for points in grids:
        grid = refine(gray, points)
        if grid is None or fault_of(gray, grid) is not None or any(surroundings(gray, grid).continues):
            continue
        if best is None or square_px(grid.points) > square_px(best.points):
            best = grid
    return best


def detect(gray: GrayImage, columns: int, rows: int) -> Detection | None:
    """Find a board of `columns` x `rows` inner corners, at any angle, to a small fraction of a pixel.

    The first stage whose grid is whole and passes the tests ends the search. Refinement starts each
    corner anew from where the others place it, so it matters little which stage that is.

    Parameters
    ----------
    gray : (H, W) of uint8.
    columns, rows : inner corners, each at least 3.

    Returns
    -------
    None where no such board is seen whole, or only as a part of a larger one.

    Raises
    ------
    BadInputError
        On a board of fewer than 3 x 3 corners or a picture that is not (H, W) of uint8.
    """
    if min(columns, rows) < 3:
        raise BadInputError(
            f"a board of {columns}x{rows} inner corners cannot be found; expected at least 3x3"
        )
    if not _checked(gray):
        return None
    fragments = False
    for stages in (lattice_stages, fallback_stages):
        for stage in stages(gray, columns, rows):
            found = stage.search()
            fragments |= found.fragments
            grid = _best_of(gray, found.grids)
            if grid is not None:
                return _ordered(grid, columns, rows, stage.name)
        if not fragments:
            break
    return None


def find_size(gray: GrayImage | Sequence[GrayImage]) -> tuple[int, int] | None:
    """Inner corners (columns, rows), columns >= rows, of the board in one or more pictures.

    Of several pictures the size that most of them show; of sizes shown equally often the larger.
    """
    pictures = [gray] if isinstance(gray, np.ndarray) else list(gray)
    return board_sizes([picture for picture in pictures if _checked(picture)])
