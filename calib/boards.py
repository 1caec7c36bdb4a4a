"""board.yaml, and the search for its board in a set of pictures."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.camera.board import Board
from calib.camera.corners import Detection, detect, find_size
from calib.camera.views import View
from calib.errors import BadInputError
from calib.files import read_yaml_mapping, shown
from calib.pictures import Picture, read_picture, same_size
from calib.rig import validation_sentence

__all__ = ["BoardFile", "BoardSearch", "find_boards", "read_board_file"]

Count = Annotated[int, Field(ge=3, le=200, strict=True)]
Metres = Annotated[float, Field(gt=0, lt=10, allow_inf_nan=False, strict=True)]
Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]

_SIZE_SAMPLE = 5
"""Pictures that are asked for the size of an unknown board."""


class BoardFile(BaseModel):
    """board.yaml: the board, and for a plane where it lies.

    `corners` counts inner corners, columns x rows. `first_corner_m` is the world position of corner
    (0, 0), `angle_rad` the direction of the columns axis, `first_corner_px` where a picture shows
    corner (0, 0), for boards that look the same after half a turn.
    """

    model_config = ConfigDict(extra="forbid")

    corners: Annotated[list[Count], Field(min_length=2, max_length=2)] | None = None
    square_m: Metres | None = None
    first_corner_m: Pair | None = None
    angle_rad: Number | None = None
    first_corner_px: Pair | None = None


def read_board_file(folder: Path) -> BoardFile:
    """board.yaml of a folder, all unset where there is none. Raises `BadInputError`."""
    path = folder / "board.yaml"
    if not path.is_file():
        return BoardFile()
    try:
        return BoardFile.model_validate(read_yaml_mapping(path))
    except ValidationError as error:
        raise BadInputError(validation_sentence(path, error)) from error


@dataclass(frozen=True)
class BoardSearch:
    """What a set of pictures shows.

    Attributes
    ----------
    board : the board that was looked for, or found.
    image_size_px : width and height of all pictures.
    views : one for each picture with the board; the names are the files'.
    detections : as `views`.
    without : names of pictures where the board was not found.
    hashes : SHA-256 of every picture by name.
    """

    board: Board
    image_size_px: tuple[int, int]
    views: tuple[View, ...]
    detections: tuple[Detection, ...]
    without: tuple[str, ...]
    hashes: dict[str, str]


def find_boards(
    paths: Sequence[Path],
    corners: tuple[int, int] | None,
    square_m: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BoardSearch:
    """Decode pictures and find the board in each, several at a time.

    Parameters
    ----------
    corners : inner corners, columns and rows; found in the pictures when None.
    square_m : length of a square.
    progress : called with pictures done and pictures in all.

    Raises
    ------
    BadInputError : a picture that cannot be read, pictures of several sizes, or no board in any; when
        another board is there the message says which.
    """
    workers = max(1, min(len(paths), os.cpu_count() or 1))
    total = len(paths)
    # One picture for each thread; OpenCV's own threads would only get in each other's way.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1 if workers > 1 else threads)
    try:
        with ThreadPoolExecutor(workers) as pool:
            pictures = list(pool.map(read_picture, paths))
            size = same_size(pictures)
            found_size = corners or _common_size(pool, pictures)
            if found_size is None:
                raise BadInputError(f"{_names(pictures)}: no checkerboard found in any picture")
            detections: list[Detection | None] = []
            for done, detection in enumerate(
                pool.map(lambda picture: detect(picture.gray, *found_size), pictures), start=1
            ):
                detections.append(detection)
                progress(done, total)
            if not any(detections):
                other = _common_size(pool, pictures)
                wanted = f"no board with {found_size[0]}x{found_size[1]} inner corners found"
                instead = "and no other either" if other is None else f"but one with {other[0]}x{other[1]} was"
                raise BadInputError(f"{_names(pictures)}: {wanted} in {_count(total)}, {instead}")
    finally:
        cv2.setNumThreads(threads)
    board = Board(found_size[0], found_size[1], square_m)
    target = board.points_m()
    pairs = [(p, d) for p, d in zip(pictures, detections, strict=True) if d is not None]
    return BoardSearch(
        board=board,
        image_size_px=size,
        views=tuple(View(p.name, target, d.pixels) for p, d in pairs),
        detections=tuple(d for _, d in pairs),
        without=tuple(p.name for p, d in zip(pictures, detections, strict=True) if d is None),
        hashes={p.name: p.sha256 for p in pictures},
    )


def _common_size(pool: ThreadPoolExecutor, pictures: Sequence[Picture]) -> tuple[int, int] | None:
    """The size of board that most of a few pictures show; the larger one in a tie.

    Seen upright and lying, a board counts the same.
    """
    step = max(1, len(pictures) // _SIZE_SAMPLE)
    sizes = [s for s in pool.map(lambda p: find_size(p.gray), pictures[::step]) if s is not None]
    if not sizes and step > 1:
        sizes = [s for s in pool.map(lambda p: find_size(p.gray), pictures) if s is not None]
    if not sizes:
        return None
    counts = Counter((max(s), min(s)) for s in sizes)
    return max(counts, key=lambda s: (counts[s], s[0] * s[1]))


def _count(pictures: int) -> str:
    return "the picture" if pictures == 1 else f"any of {pictures} pictures"


def _names(pictures: Sequence[Picture]) -> str:
    first, last = shown(pictures[0].name), shown(pictures[-1].name)
    return first if len(pictures) == 1 else f"{first} ... {last}"
