"""What a camera is calibrated from: pictures of a board, or correspondences that others have found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.boards import board_of, find_boards
from calib.camera.views import View
from calib.errors import BadInputError, UsageError
from calib.files import check_readable, shown
from calib.pictures import list_pictures
from calib.rig import hash_of
from calib.tables import read_table, read_vnl

__all__ = ["Told", "ViewSet", "read_views"]

_TABLES = (".csv", ".vnl")
_MOST_BYTES = 500_000_000
"""Largest table; all of its points are held in memory."""
_OUTSIDE_PX = 1.0
"""How far a corner may be found beyond the border of the picture."""
_LARGEST_M = 1e4
_SMALLEST_M = 1e-6
_NO_SQUARE = "the square's length is not given; intrinsics do not depend on it, lengths are in squares"


@dataclass(frozen=True)
class Told:
    """What the command line says of the board and the pictures; None where it says nothing."""

    corners: tuple[int, int] | None = None
    square_m: float | None = None
    image_size_px: tuple[int, int] | None = None


@dataclass(frozen=True)
class ViewSet:
    """Views to calibrate from.

    Attributes
    ----------
    views : one for each picture with a board.
    image_size_px : width and height.
    hashes : SHA-256 of each input by its name.
    without : names of pictures without a board.
    remarks : sentences for the person who watches.
    """

    views: tuple[View, ...]
    image_size_px: tuple[int, int]
    hashes: dict[str, str]
    without: tuple[str, ...]
    remarks: tuple[str, ...]


def read_views(
    sources: Sequence[Path], told: Told, progress: Callable[[int, int], None] = lambda done, total: None
) -> ViewSet:
    """Views from folders of pictures and single pictures, or from one table.

    Raises `BadInputError` for what cannot be read, and `UsageError` for options that do not go with
    these sources.
    """
    tables = [source for source in sources if source.suffix.lower() in _TABLES and not source.is_dir()]
    if not tables:
        return _from_pictures(sources, told, progress)
    if len(sources) > 1:
        raise UsageError(f"{shown(tables[0])}: a table is given alone, without pictures or other tables")
    return _from_table(tables[0], told)


def _from_table(path: Path, told: Told) -> ViewSet:
    if check_readable(path) > _MOST_BYTES:
        raise BadInputError(f"{shown(path)}: is larger than {_MOST_BYTES / 1e6:g} MB")
    digest = hash_of(path)
    if told.image_size_px is None:
        raise UsageError(
            f"{shown(path)}: a table does not tell the size of the pictures; give --image-size, as 640x480"
        )
    remarks: tuple[str, ...] = ()
    if path.suffix.lower() == ".csv":
        if told.corners is not None or told.square_m is not None:
            raise UsageError(
                f"{shown(path)}: a table holds its target in metres; --corners and --square do not go with it"
            )
        views = read_table(path)
    else:
        if told.corners is None:
            raise UsageError(
                f"{shown(path)}: a .vnl file does not tell the board; give --corners and --square"
            )
        if told.square_m is None:
            remarks = (_NO_SQUARE,)
        views = read_vnl(path, *told.corners, 1.0 if told.square_m is None else told.square_m)
    for view in views:
        _check_inside(path, view, told.image_size_px)
        _check_extent(path, view)
    return ViewSet(_near_origin(views), told.image_size_px, {shown(path.name): digest}, (), remarks)


def _check_inside(path: Path, view: View, image_size_px: tuple[int, int]) -> None:
    upper = np.array(image_size_px) - 1 + _OUTSIDE_PX
    outside = np.flatnonzero(((view.pixels < -_OUTSIDE_PX) | (view.pixels > upper)).any(axis=1))
    if len(outside):
        u, v = view.pixels[outside[0]]
        raise BadInputError(
            f"{shown(path)}: view {shown(view.name)}: {len(outside)} of {len(view.pixels)} points lie "
            f"outside a picture of {image_size_px[0]}x{image_size_px[1]} px, as ({u:g}, {v:g}); "
            "expected --image-size to be that of the pictures"
        )


def _check_extent(path: Path, view: View) -> None:
    largest = float(np.abs(view.target_m).max())
    extent = float(np.ptp(view.target_m, axis=0).max())
    if largest > _LARGEST_M or extent < _SMALLEST_M:
        what = f"lies {largest:.3g} m away" if largest > _LARGEST_M else f"measures {extent:.3g} m"
        raise BadInputError(
            f"{shown(path)}: view {shown(view.name)}: its target {what}, expected metres, "
            f"from {_SMALLEST_M:g} to {_LARGEST_M:g}"
        )


def _near_origin(views: Sequence[View]) -> tuple[View, ...]:
    """The same views; a target that lies far from its own origin is moved there, which changes no camera.

    Rotating about a distant origin would cost the digits that tell the points apart.
    """
    every = np.concatenate([view.target_m for view in views])
    middle = 0.5 * (every.min(axis=0) + every.max(axis=0))
    if np.abs(middle).max() < 10.0 * np.ptp(every, axis=0).max():
        return tuple(views)
    return tuple(replace(view, target_m=view.target_m - middle) for view in views)


def _from_pictures(sources: Sequence[Path], told: Told, progress: Callable[[int, int], None]) -> ViewSet:
    paths = list_pictures(sources)
    file, hashes = board_of(sources)
    corners = told.corners or (None if file.corners is None else (file.corners[0], file.corners[1]))
    square_m = file.square_m if told.square_m is None else told.square_m
    remarks = []
    if square_m is None:
        remarks.append(_NO_SQUARE)
    for option, here, there in (
        ("--corners", told.corners, file.corners),
        ("--square", told.square_m, file.square_m),
    ):
        if here is not None and there is not None and _text(here) != _text(there):
            remarks.append(f"{option}: {_text(here)} is used, not {_text(there)} of board.yaml")
    found = find_boards(paths, corners, 1.0 if square_m is None else square_m, progress, told.image_size_px)
    if corners is None:
        remarks.append(f"found a board with {found.board.columns}x{found.board.rows} inner corners")
    remarks.append(f"board found in {len(found.views)} of {len(paths)} pictures")
    return ViewSet(
        found.views, found.image_size_px, {**found.hashes, **hashes}, found.without, tuple(remarks)
    )


def _text(value: Sequence[int] | float) -> str:
    return f"{value:g} m" if isinstance(value, float | int) else "x".join(str(part) for part in value)
