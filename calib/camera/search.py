"""Candidates for a checkerboard, stage by stage, the cheap and sure stages first.

The first stages look for grids of saddle points in copies of the picture, from a small one, where
large squares stay and noise goes, up to one of twice the size for squares of a few pixels. OpenCV's
finders follow: the classic one, the sector-based one (SB) and SB with an exhaustive search, which
take long where there is no board and are asked only when the first stages saw most of one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from calib.arrays import FloatArray, GrayImage
from calib.camera.gridmodel import predict
from calib.camera.lattice import Lattice, find_lattices
from calib.camera.saddles import find_saddles

__all__ = [
    "Found",
    "Level",
    "Stage",
    "complete",
    "fallback_stages",
    "lattice_levels",
    "lattice_stages",
    "resized",
]

_COARSE_PIXELS = 120_000
_LARGEST_PIXELS = 6_000_000
_ENLARGE_BELOW_PIXELS = 700_000
_ENLARGE_TWICE_BELOW_PIXELS = 90_000
_OPENCV_PIXELS = 1_300_000
_SEEN_SHARE = 0.8
"""Least share of a grid's corners that must be seen; the others are looked for where they should be."""
_MIN_SIDE_PX = 16
_FRAGMENT = 0.5
"""Share of the board's corners, in a grid with holes, from which on OpenCV's finders are asked too."""


@dataclass(frozen=True)
class Level:
    """A copy of the picture, `zoom` times its size; u = (x + 1/2) / zoom - 1/2."""

    image: GrayImage
    zoom: float

    def to_picture(self, points: FloatArray) -> FloatArray:
        """Pixels of the picture from pixels of the copy."""
        return np.asarray((points + 0.5) / self.zoom - 0.5)


@dataclass(frozen=True)
class Found:
    """What a stage saw: grids (r, c, 2) of the picture to try, and whether a broken grid is there."""

    grids: list[FloatArray]
    fragments: bool = False


@dataclass(frozen=True)
class Stage:
    """One way of looking."""

    name: str
    search: Callable[[], Found]


def resized(gray: GrayImage, zoom: float) -> Level:
    """A copy of the picture; `zoom` is 1 / n or n for a whole n."""
    if zoom == 1.0:
        return Level(gray, 1.0)
    if zoom > 1.0:
        copy = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        return Level(np.asarray(copy, dtype=np.uint8), zoom)
    n = round(1.0 / zoom)
    height, width = gray.shape[0] // n, gray.shape[1] // n
    copy = cv2.resize(gray[: height * n, : width * n], (width, height), interpolation=cv2.INTER_AREA)
    return Level(np.asarray(copy, dtype=np.uint8), zoom)


def lattice_levels(gray: GrayImage) -> list[float]:
    """Zooms at which to look for grids of saddle points, in order."""
    zooms: list[float] = []
    n = 1
    while gray.size / n**2 > _COARSE_PIXELS:
        n *= 2
    while n >= 1:
        if gray.size / n**2 <= _LARGEST_PIXELS:
            zooms.append(1.0 / n)
        n //= 2
    if gray.size < _ENLARGE_BELOW_PIXELS:
        zooms.append(2.0)
    if gray.size < _ENLARGE_TWICE_BELOW_PIXELS:
        zooms.append(4.0)
    return zooms


def complete(lattice: Lattice) -> FloatArray | None:
    """Points of a lattice with the few unseen corners where the others place them, or None."""
    seen = lattice.seen
    if seen.all():
        return lattice.points
    if seen.mean() < _SEEN_SHARE:
        return None
    prediction = predict(lattice.points, seen)
    if prediction is None:
        return None
    return np.where(seen[..., None], lattice.points, prediction.points)


def lattice_stages(gray: GrayImage, columns: int, rows: int) -> list[Stage]:
    """Stages that join saddle points of copies of the picture."""

    def stage(zoom: float) -> Stage:
        def search() -> Found:
            level = resized(gray, zoom)
            grids, fragments = [], False
            for lattice in find_lattices(find_saddles(level.image), least=max(4, columns * rows // 4)):
                shape = lattice.points.shape[:2]
                fits = sorted(shape) == sorted((rows, columns))
                points = complete(lattice) if fits else None
                if points is not None:
                    grids.append(level.to_picture(points))
                within = all(a <= b for a, b in zip(sorted(shape), sorted((rows, columns)), strict=True))
                share = int(lattice.seen.sum()) / (columns * rows)
                fragments |= points is None and within and share >= _FRAGMENT
            return Found(grids, fragments)

        return Stage(f"saddles x{zoom:g}", search)

    return [stage(zoom) for zoom in lattice_levels(gray)]


_Finder = Callable[[GrayImage, tuple[int, int]], FloatArray | None]


def _classic(image: GrayImage, size: tuple[int, int]) -> FloatArray | None:
    found, corners = cv2.findChessboardCorners(
        image, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return np.asarray(corners, dtype=np.float64) if found else None


def _sector_based(image: GrayImage, size: tuple[int, int], flags: int = 0) -> FloatArray | None:
    found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    return np.asarray(corners, dtype=np.float64) if found else None


def _exhaustive(image: GrayImage, size: tuple[int, int]) -> FloatArray | None:
    return _sector_based(
        image, size, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    )


def fallback_stages(gray: GrayImage, columns: int, rows: int) -> list[Stage]:
    """OpenCV's finders, on the picture or a copy of a size that they can do quickly."""
    if min(gray.shape) < _MIN_SIDE_PX or min(columns, rows) < 3:
        return []
    n = 1
    while gray.size / n**2 > _OPENCV_PIXELS:
        n += 1
    plain = 1.0 / n
    finders = (("classic", _classic), ("SB", _sector_based), ("SB exhaustive", _exhaustive))

    def stage(name: str, finder: _Finder) -> Stage:
        def search() -> Found:
            level = resized(gray, plain)
            try:
                corners = finder(level.image, (columns, rows))
            except cv2.error:
                # Some pictures are too small for a finder's own filters.
                return Found([])
            if corners is None or corners.size != 2 * columns * rows:
                return Found([])
            return Found([level.to_picture(_not_mirrored(corners.reshape(rows, columns, 2)))])

        return Stage(f"{name} x{plain:g}", search)

    return [stage(name, finder) for name, finder in finders]


def _not_mirrored(grid: FloatArray) -> FloatArray:
    along, across = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    a, b = along.mean(axis=0), across.mean(axis=0)
    return grid if a[0] * b[1] - a[1] * b[0] > 0 else np.asarray(grid[:, ::-1])
