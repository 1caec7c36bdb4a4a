"""board.yaml, and the search for its board in a set of pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calib.arrays import GrayImage
from calib.camera.board import Board
from calib.camera.corners import Detection, detect, find_size
from calib.camera.views import View
from calib.errors import BadInputError
from calib.files import read_yaml_mapping, shown
from calib.pictures import Picture, read_picture, same_size
from calib.rig import hash_of, validation_sentence
from calib.workers import Workers

__all__ = [
    "BOARD_FILE",
    "BoardFile",
    "BoardSearch",
    "board_of",
    "find_boards",
    "read_board_file",
]

Count = Annotated[int, Field(ge=3, le=200, strict=True)]
Metres = Annotated[float, Field(ge=1e-5, lt=10, allow_inf_nan=False, strict=True)]
Place = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False, strict=True)]
Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Position = Annotated[list[Place], Field(min_length=2, max_length=2)]
Pixel = Annotated[list[Number], Field(min_length=2, max_length=2)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832, allow_inf_nan=False, strict=True)]

BOARD_FILE = "board.yaml"
_SIZE_SAMPLE = 5
"""Pictures that are asked for the size of an unknown board."""
_KEPT_PIXELS = 250_000_000
"""Pixels that are kept in memory; further pictures are read twice."""


class BoardFile(BaseModel):
    """board.yaml: the board, and for a plane where it lies.

    `corners` counts inner corners, columns x rows. `first_corner_m` is the world position of corner
    (0, 0), `angle_rad` the direction of the columns axis, `first_corner_px` where a picture shows
    corner (0, 0), for boards that look the same after half a turn.
    """

    model_config = ConfigDict(extra="forbid")

    corners: Annotated[list[Count], Field(min_length=2, max_length=2)] | None = None
    square_m: Metres | None = None
    first_corner_m: Position | None = None
    angle_rad: Angle | None = None
    first_corner_px: Pixel | None = None


def read_board_file(folder: Path) -> BoardFile:
    """board.yaml of a folder, all unset where there is none. Raises `BadInputError`."""
    path = folder / BOARD_FILE
    if not path.exists() and not path.is_symlink():
        return BoardFile()
    try:
        return BoardFile.model_validate(read_yaml_mapping(path))
    except ValidationError as error:
        raise BadInputError(validation_sentence(path, error)) from error


def board_of(sources: Sequence[Path]) -> tuple[BoardFile, dict[str, str]]:
    """What board.yaml tells of the board in these folders or single pictures, and its SHA-256.

    Raises `BadInputError` where two folders tell different boards.
    """
    told, hashes, where = BoardFile(), dict[str, str](), Path()
    for folder in dict.fromkeys(source if source.is_dir() else source.parent for source in sources):
        file = read_board_file(folder)
        if file == BoardFile():
            continue
        if hashes and (file.corners, file.square_m) != (told.corners, told.square_m):
            raise BadInputError(
                f"{shown(folder / BOARD_FILE)}: tells another board than {shown(where / BOARD_FILE)}; "
                "pictures of different boards cannot be calibrated together"
            )
        if not hashes:
            told, where = file, folder
            hashes[BOARD_FILE] = hash_of(folder / BOARD_FILE)
    return told, hashes


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
    image_size_px: tuple[int, int] | None = None,
) -> BoardSearch:
    """Decode pictures and find the board in each, several at a time.

    Parameters
    ----------
    corners : inner corners, columns and rows; found in the pictures when None.
    square_m : length of a square.
    progress : called with pictures done and pictures in all.
    image_size_px : the size that the pictures have to have, if that is known.

    Raises
    ------
    BadInputError : a picture that cannot be read, pictures of several sizes, or no board in any; when
        another board is there the message says which.
    """
    pictures = _read(paths)
    with Workers(_Album(paths, pictures), len(paths)) as workers:
        return _Search(workers, pictures, square_m, progress).run(corners, image_size_px)


def _read(paths: Sequence[Path]) -> list[Picture]:
    """All pictures; the pixels only of as many as memory surely has room for."""
    kept, pictures = 0, []
    with Workers(None, len(paths), large=True) as workers:
        for picture in workers.in_order(_picture, paths):
            kept += picture.gray.size
            pictures.append(picture if kept <= _KEPT_PIXELS else picture.without_pixels())
    return pictures


def _picture(_: None, path: Path) -> Picture:
    return read_picture(path)


@dataclass(frozen=True)
class _Album:
    """Pictures that workers look into, and where to find those that are not in memory."""

    paths: Sequence[Path]
    pictures: Sequence[Picture]

    def gray(self, i: int) -> GrayImage:
        if self.pictures[i].gray.size:
            return self.pictures[i].gray
        again = read_picture(self.paths[i])
        if again.sha256 != self.pictures[i].sha256:
            raise BadInputError(f"{self.pictures[i].name}: has changed since the work began")
        return again.gray


def _detection(album: _Album, what: tuple[int, tuple[int, int]]) -> Detection | None:
    i, corners = what
    return detect(album.gray(i), *corners)


def _size(album: _Album, i: int) -> tuple[int, int] | None:
    return find_size(album.gray(i))


@dataclass
class _Search:
    """The work of `find_boards`."""

    workers: Workers[_Album]
    pictures: Sequence[Picture]
    square_m: float
    progress: Callable[[int, int], None]
    done: int = 0
    sizes: dict[int, tuple[int, int] | None] = field(default_factory=dict)

    def run(self, corners: tuple[int, int] | None, expected_px: tuple[int, int] | None) -> BoardSearch:
        pictures = self.pictures
        size_px = same_size(pictures)
        if expected_px is not None and size_px != expected_px:
            raise BadInputError(
                f"{_names(pictures)}: {_is_or_are(pictures)} {size_px[0]}x{size_px[1]} px, "
                f"expected {expected_px[0]}x{expected_px[1]} px"
            )
        count = len(pictures)
        sample = list(range(0, count, max(1, count // _SIZE_SAMPLE)))
        wanted = corners or self._common_size(sample) or self._common_size(range(count))
        if wanted is None:
            raise BadInputError(f"{_names(pictures)}: no checkerboard found in {_count(count)}")
        found: dict[int, Detection | None] = {}
        # A wrong size is known after a few pictures; looking for it in all of them would take long.
        for part, share in ((sample[:2], 1.0), (sample[2:], 0.5)):
            found |= self._detect(part, wanted)
            other = None if any(found.values()) else self._common_size(sample, share)
            if other is not None and sorted(other) != sorted(wanted):
                raise BadInputError(_not_found(pictures, wanted, other))
        found |= self._detect([i for i in range(count) if i not in found], wanted)
        if not any(found.values()):
            raise BadInputError(_not_found(pictures, wanted, self._common_size(sample)))
        board = Board(*wanted, self.square_m)
        target = board.points_m()
        seen = [(picture, detection) for i, picture in enumerate(pictures) if (detection := found[i])]
        return BoardSearch(
            board=board,
            image_size_px=size_px,
            views=tuple(View(p.name, target, d.pixels, d.refined) for p, d in seen),
            detections=tuple(detection for _, detection in seen),
            without=tuple(picture.name for i, picture in enumerate(pictures) if found[i] is None),
            hashes={picture.name: picture.sha256 for picture in pictures},
        )

    def _detect(self, which: Sequence[int], corners: tuple[int, int]) -> dict[int, Detection | None]:
        found: dict[int, Detection | None] = {}
        detections = self.workers.in_order(_detection, [(i, corners) for i in which])
        for i, detection in zip(which, detections, strict=True):
            found[i] = detection
            self.done += 1
            self.progress(self.done, len(self.pictures))
        return found

    def _common_size(self, which: Sequence[int], share: float = 0.0) -> tuple[int, int] | None:
        """The size of board that most of these pictures show, if a share of them does; the larger in a tie.

        Seen upright and lying, a board counts the same.
        """
        new = [i for i in which if i not in self.sizes]
        sizes = self.workers.in_order(_size, new)
        self.sizes |= zip(new, sizes, strict=True)
        counts = Counter((max(s), min(s)) for i in which if (s := self.sizes[i]) is not None)
        most = max(counts, key=lambda s: (counts[s], s[0] * s[1]), default=None)
        return None if most is None or counts[most] < share * len(which) else most


def _not_found(pictures: Sequence[Picture], wanted: tuple[int, int], other: tuple[int, int] | None) -> str:
    instead = "and no other either" if other is None else f"but one with {other[0]}x{other[1]} was"
    return (
        f"{_names(pictures)}: no board with {wanted[0]}x{wanted[1]} inner corners found in "
        f"{_count(len(pictures))}, {instead}"
    )


def _is_or_are(pictures: Sequence[Picture]) -> str:
    return "is" if len(pictures) == 1 else "are"


def _count(pictures: int) -> str:
    return "the picture" if pictures == 1 else f"any of {pictures} pictures"


def _names(pictures: Sequence[Picture]) -> str:
    first, last = pictures[0].name, pictures[-1].name
    return first if len(pictures) == 1 else f"{first} ... {last}"
