"""What a camera is calibrated from: pictures of a board, or correspondences that others have found."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError, CalibError, UsageError
from calib.core.files import PICTURES, check_readable, hash_of, one_line, read_yaml_mapping, shown, to_be
from calib.core.result import Number, Pair
from calib.core.schema import validated
from calib.core.units import plain_number
from calib.core.words import several
from calib.core.workers import Workers
from calib.io.frames import Frames, is_recording, read_frames
from calib.io.pictures import (
    Picture,
    asks_to_turn,
    holds_pictures,
    list_pictures,
    read_picture,
    usual_size,
)
from calib.stages.camera import targets
from calib.stages.camera.checks import hull_area
from calib.stages.camera.choice import most_informative
from calib.stages.camera.corners import Detection, between_fields, detect, find_size
from calib.stages.camera.model import Board, LeftOut, View
from calib.stages.camera.options import Told
from calib.stages.camera.verdict import Limits

# ----------------------------------------------------------------------
# board.yaml, and the search for its board in a set of pictures.

Count = Annotated[int, Field(ge=3, le=200, strict=True)]
Metres = Annotated[Number, Field(ge=1e-5, lt=10)]
Place = Annotated[Number, Field(ge=-1e3, le=1e3)]
Position = Annotated[list[Place], Field(min_length=2, max_length=2)]
Angle = Annotated[Number, Field(ge=-6.2832, le=6.2832)]
Spread = Annotated[Number, Field(ge=0.0, le=0.1)]

BOARD_FILE = "board.yaml"
_SIZE_SAMPLE = 5
"""Pictures that are asked for the size of an unknown board."""


class BoardFile(BaseModel):
    """board.yaml: the board, and for a plane where it lies.

    `corners` counts inner corners, columns x rows. `first_corner_m` is the world position of corner
    (0, 0), `angle_rad` the direction of the columns axis, `first_corner_sigma_m` (of x and y each) and
    `angle_sigma_rad` how well a ruler tells them. `first_corner_px` is where a picture shows corner
    (0, 0), for boards that look the same after half a turn. `dictionary` is that of a ChArUco
    board's markers, as 4X4_50; without it such a board is found by itself. `simulated` says that the
    pictures are renderings.
    """

    model_config = ConfigDict(extra="forbid")

    corners: Annotated[list[Count], Field(min_length=2, max_length=2)] | None = None
    square_m: Metres | None = None
    dictionary: Annotated[str, Field(max_length=40)] | None = None
    first_corner_m: Position | None = None
    angle_rad: Angle | None = None
    first_corner_sigma_m: Spread = 0.0
    angle_sigma_rad: Spread = 0.0
    first_corner_px: Pair | None = None
    simulated: bool = False


def read_board_file(folder: Path) -> BoardFile:
    """board.yaml of a folder, all unset where there is none. Raises `BadInputError`."""
    path = folder / BOARD_FILE
    if not path.exists() and not path.is_symlink():
        return BoardFile()
    file = validated(BoardFile, read_yaml_mapping(path), path)
    if file.dictionary is not None:
        file.dictionary = known_dictionary(file.dictionary, f"{shown(path)}: dictionary")
    return file


def known_dictionary(text: str, where: str, error: type[CalibError] = BadInputError) -> str:
    """OpenCV's name of the dictionary that is meant, as 4x4_50 or DICT_4X4_50.

    Raises `error`, naming `where` it stands.
    """
    name = text.strip().upper().removeprefix("DICT_")
    if name not in targets.DICTIONARIES:
        nearest = get_close_matches(text.upper(), targets.DICTIONARIES, 1, 0.0)[0]
        raise error(
            f"{where}: {one_line(text)[:40]!r} is no dictionary of markers, expected one of OpenCV's, "
            f"as {nearest}"
        )
    return name


def folder_of(source: Path) -> Path:
    """The folder whose board.yaml tells of a source: of pictures or a recording the one that they lie in."""
    return source if source.is_dir() and not is_recording(source) else source.parent


def board_of(sources: Sequence[Path]) -> tuple[BoardFile, dict[str, str]]:
    """What board.yaml tells of the board in these folders or single pictures, and its SHA-256.

    Raises `BadInputError` where two folders tell different boards.
    """
    told, hashes, where = BoardFile(), dict[str, str](), Path()
    for folder in dict.fromkeys(folder_of(source) for source in sources):
        file = read_board_file(folder)
        if file == BoardFile():
            continue
        if hashes and _of_board(file) != _of_board(told):
            raise BadInputError(
                f"{shown(folder / BOARD_FILE)}: tells another board than {shown(where / BOARD_FILE)}; "
                "pictures of different boards cannot be calibrated together"
            )
        if not hashes:
            told, where = file, folder
            hashes[BOARD_FILE] = hash_of(folder / BOARD_FILE)
    return told, hashes


def _of_board(file: BoardFile) -> tuple[object, ...]:
    return file.corners, file.square_m, file.dictionary


_SAME_SQUARE = 1e-3
"""Share by which two statements of a square may differ, .1 mm over a decimetre."""


def another_square(folder: Path, stated: BoardFile) -> tuple[str, str] | None:
    """What the folder above tells of the squares otherwise, and what to do; None where it does not."""
    try:
        above = read_board_file(folder.parent)
    except BadInputError:
        return None
    if stated.corners is None or above.corners is None or sorted(stated.corners) != sorted(above.corners):
        return None
    if stated.square_m is None or above.square_m is None:
        return None
    if abs(above.square_m / stated.square_m - 1.0) < _SAME_SQUARE:
        return None
    here, there = f"{1e3 * stated.square_m:g} mm", f"{1e3 * above.square_m:g} mm"
    where = shown(folder.parent / BOARD_FILE)
    return (
        f"{shown(folder / BOARD_FILE)} says squares of {here}, {where} of {there}, with as many corners: all "
        "lengths on the plane go with the former",
        f"measure a square; where these are two boards, leave square_m out of {where}, which needs none",
    )


@dataclass(frozen=True)
class BoardSearch:
    """What a set of pictures shows.

    Attributes
    ----------
    board : the board that was looked for, or found.
    image_size_px : width and height of all pictures.
    views : one for each picture with the board; the names are the files'.
    left_out : pictures that are not used: unreadable, of another size, or without the board.
    hashes : SHA-256 of every picture that could be read by name.
    layout : of the markers of a ChArUco board, which say which way it lies; None for a plain board.
    several : names of pictures that show more than one board of the size; the one with the largest squares
        is taken.
    """

    board: Board
    image_size_px: tuple[int, int]
    views: tuple[View, ...]
    left_out: tuple[LeftOut, ...]
    hashes: dict[str, str]
    layout: targets.Layout | None = None
    several: tuple[str, ...] = ()


def find_boards(
    paths: Sequence[Path],
    corners: tuple[int, int] | None,
    square_m: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
    image_size_px: tuple[int, int] | None = None,
    dictionary: str | None = None,
    frames: Sequence[Picture] = (),
) -> BoardSearch:
    """Decode pictures and find the board in each, several at a time.

    Pictures that cannot be decoded, and those of another size than `image_size_px` (by default than most
    of them have), are left out.

    Parameters
    ----------
    corners : inner corners, columns and rows; found in the pictures when None.
    square_m : length of a square.
    progress : called with pictures done and pictures in all.
    image_size_px : the size that the pictures have to have, if that is known.
    frames : further pictures, decoded already.
    dictionary : of the markers of a ChArUco board; without it a plain board is looked for first.

    Raises
    ------
    BadInputError : no picture that can be read, none of the size, or no board in any; when another board
        is there the message says which.
    """
    read = {path: _headed(path) for path in paths} | {Path(one.name): one for one in frames}
    pictures = {path: one for path, one in read.items() if isinstance(one, Picture)}
    if not pictures:
        raise next(one for one in read.values() if isinstance(one, BadInputError))
    size_px = image_size_px or usual_size(list(pictures.values()))
    usable = {path: one for path, one in pictures.items() if one.size_px == size_px}
    if not usable:
        which = list(pictures.values())
        (width, height), are = which[0].size_px, "is" if len(which) == 1 else "are"
        raise BadInputError(
            f"{_names(which)}: {are} {width}x{height} px, expected {size_px[0]}x{size_px[1]} px"
        )
    with Workers(_Album(list(usable), list(usable.values())), len(usable)) as workers:
        looking = _Search(workers, list(usable.values()), size_px, square_m, progress)
        try:
            search = looking.run(corners, dictionary)
        except BadInputError as error:
            if len(looking.damaged) < len(usable):
                raise
            raise BadInputError(f"{shown(next(iter(usable)))}: {looking.damaged[0].why}") from error
    without = {one.name: one for one in search.left_out}
    damaged = {one.name for one in search.left_out if one.kind == "unreadable"}
    left_out = [
        _not_read(path, one) if isinstance(one, BadInputError)
        else _of_another_size(one, size_px, len(usable)) if path not in usable
        else without.get(one.name)
        for path, one in read.items()
    ]  # fmt: skip
    left_out += [_of_several(one) for one in pictures.values() if one.count > 1]
    return replace(
        search,
        left_out=tuple(one for one in left_out if one is not None),
        hashes={one.name: one.sha256 for one in pictures.values() if one.name not in damaged},
    )


def _not_read(path: Path, error: BadInputError) -> LeftOut:
    return LeftOut(shown(path.name), str(error).removeprefix(f"{shown(path)}: "), "unreadable")


def _of_another_size(picture: Picture, size_px: tuple[int, int], others: int) -> LeftOut:
    (width, height), (w, h) = picture.size_px, size_px
    turned = ", as if turned by a quarter" if (width, height) == (h, w) else ""
    why = f"is {width}x{height} px{turned}; {others} others are {w}x{h} px"
    return LeftOut(picture.name, why, "size")


def _of_several(picture: Picture) -> LeftOut:
    why = f"holds {picture.count} pictures, of which the first alone is read: write each to a file of its own"
    return LeftOut(picture.name, why, "file")


def _headed(path: Path) -> Picture | BadInputError:
    """A picture without its pixels, or why it cannot be read."""
    try:
        return read_picture(path, pixels=False)
    except BadInputError as error:
        return error


@dataclass(frozen=True)
class _Album:
    """Pictures that workers decode and look into; frames of recordings have their pixels."""

    paths: Sequence[Path]
    pictures: Sequence[Picture]

    def picture(self, i: int) -> Picture | LeftOut:
        """A picture with its pixels, or why it cannot be decoded."""
        one = self.pictures[i]
        if one.gray.size:
            return one
        try:
            again = read_picture(self.paths[i])
        except BadInputError as error:
            return _not_read(self.paths[i], error)
        if again.sha256 != one.sha256:
            raise BadInputError(f"{one.name}: has changed since the work began")
        if again.size_px != one.size_px:
            return LeftOut(one.name, "has another size than its header says", "unreadable")
        return again


_Job = tuple[Callable[..., Any], int | tuple[int, ...], tuple[Any, ...]]
"""What is asked of one picture or of several, and further arguments."""


def _look(album: _Album, job: _Job) -> Any:
    """What is seen, or why the picture cannot be decoded; of several those are looked into that can be."""
    ask, which, more = job
    read = [album.picture(i) for i in ([which] if isinstance(which, int) else which)]
    whole = [one for one in read if isinstance(one, Picture)]
    if not whole:
        return read[0]
    if not isinstance(which, int):
        return ask([one.gray for one in whole], *more)
    seen, second = ask(whole[0].gray, *more), whole[0].second
    if second is not None and isinstance(seen, Detection):
        return between_fields(seen, ask(second, *more))
    return seen


@dataclass
class _Search:
    """The work of `find_boards`."""

    workers: Workers[_Album]
    pictures: Sequence[Picture]
    size_px: tuple[int, int]
    square_m: float
    progress: Callable[[int, int], None]
    done: int = 0
    sizes: dict[int, tuple[int, int] | None] = field(default_factory=dict)
    other: tuple[int, int] | None = None
    damaged: dict[int, LeftOut] = field(default_factory=dict)

    def run(self, corners: tuple[int, int] | None, dictionary: str | None) -> BoardSearch:
        pictures, count = self.pictures, len(self.pictures)
        sample = list(range(0, count, max(1, count // _SIZE_SAMPLE)))
        if dictionary is not None:
            return self._with_markers(corners, self._layout(sample, dictionary), dictionary)
        wanted = corners or self._usual_size(sample)
        found: dict[int, Detection | None] = {}
        # A wrong size is known after a few pictures; looking for it in all of them would take long.
        for part, share in ((sample[:2], 1.0), (sample[2:], 0.5)):
            if wanted is None:
                break
            found |= self._detect(part, wanted)
            other = None if self._are_large(found) else self._common_size(sample, share)
            if other is not None and sorted(other) != sorted(wanted):
                raise BadInputError(_not_found(pictures, wanted, other))
        plain = [i for i in sample if found.get(i)]
        others = [i for i in sample if not found.get(i) and i not in self.damaged]
        if len(plain) < len(others):
            # Tiles of a floor pass for a plain board in some pictures of a board of markers.
            layout = self._layout(others, None)
            jobs = [(targets.shows, i, (layout,)) for i in others]
            if layout is not None and (not plain or sum(map(bool, self._each(jobs, others))) > len(plain)):
                return self._with_markers(corners, layout, layout.dictionary)
        if not plain:
            other_target = self._asked(targets.name_of, sample)
            if other_target is not None:
                raise BadInputError(f"{_names(pictures)}: {_shows(pictures)} {other_target}; {_READS}")
            wanted = wanted or self._common_size(range(count))
        if wanted is None:
            raise BadInputError(
                f"{_names(pictures)}: no checkerboard found in {_count(count)}, expected a whole one with "
                "its white border; --corners COLUMNSxROWS helps where something covers corners of it"
            )
        found |= self._detect([i for i in range(count) if i not in found], wanted)
        if not any(found.values()):
            raise BadInputError(_not_found(pictures, wanted, self._common_size(sample)))
        without = [i for i in range(count) if not found[i] and i not in self.damaged]
        # All are asked for another board only where a few of them show one.
        if self._common_size([i for i in sample if i in without]) is not None:
            other = self._common_size(without, 2 / len(without))
            self.other = None if other is None or sorted(other) == sorted(wanted) else other
        return self._search(Board(*wanted, self.square_m), found, None)

    def _search(
        self, board: Board, found: Mapping[int, Detection | None], layout: targets.Layout | None
    ) -> BoardSearch:
        what = "ChArUco board" if layout else "board"
        why = f"shows no {what} with {board.columns}x{board.rows} inner corners that can be read"
        reasons = dict.fromkeys(found, why)
        if self.other is not None:
            another = f"{why}, but one with {self.other[0]}x{self.other[1]}"
            reasons |= {i: another for i, size in self.sizes.items() if size == self.other}
        target = board.points_m()
        seen = [(picture, detection) for i, picture in enumerate(self.pictures) if (detection := found[i])]
        unread = [i for i, detection in found.items() if layout and not detection and i not in self.damaged]
        mirrored = dict(
            zip(
                unread, self._each([(targets.is_mirrored, i, (layout,)) for i in unread], unread), strict=True
            )
        )
        flipped = f"shows the {what} mirrored, as a selfie camera stores it: flip it back"
        reasons |= {i: flipped for i, is_so in mirrored.items() if is_so}
        return BoardSearch(
            board=board,
            image_size_px=self.size_px,
            views=tuple(View(p.name, target, d.pixels, d.refined) for p, d in seen),
            left_out=tuple(
                self.damaged.get(i) or LeftOut(picture.name, reasons[i], "no board")
                for i, picture in enumerate(self.pictures)
                if found[i] is None
            ),
            hashes={},
            layout=layout,
            several=tuple(picture.name for picture, detection in seen if not detection.alone),
        )

    def _each(self, jobs: Sequence[_Job], which: Sequence[int]) -> Iterator[Any]:
        """What each picture shows, None of one that cannot be decoded."""
        for i, seen in zip(which, self.workers.in_order(_look, jobs), strict=True):
            if isinstance(seen, LeftOut):
                self.damaged[i] = seen
            yield None if isinstance(seen, LeftOut) else seen

    def _asked(self, ask: Callable[..., Any], which: Sequence[int], *more: Any) -> Any:
        """What several pictures together show, None of such that cannot be decoded."""
        seen = next(iter(self.workers.in_order(_look, [(ask, tuple(which), more)])))
        if isinstance(seen, LeftOut):
            self.damaged |= dict.fromkeys(which, seen)
            return None
        return seen

    def _layout(self, sample: Sequence[int], dictionary: str | None) -> targets.Layout | None:
        """What board of markers the sample shows; of a stated dictionary, what any of the pictures does."""
        every = range(len(self.pictures))
        for which in (sample, every) if dictionary else (sample,):
            layout: targets.Layout | None = self._asked(targets.recognise, which, dictionary)
            if layout is not None:
                return layout
        return None

    def _with_markers(
        self, corners: tuple[int, int] | None, layout: targets.Layout | None, dictionary: str
    ) -> BoardSearch:
        pictures, every = self.pictures, range(len(self.pictures))
        if layout is None:
            raise BadInputError(
                f"{_names(pictures)}: no ChArUco board with markers of {dictionary} found in "
                f"{_count(len(every))}"
            )
        if layout.kind == "grid":
            raise BadInputError(
                f"{_names(pictures)}: {_shows(pictures)} a grid of {layout.dictionary} markers, "
                f"{layout.columns}x{layout.rows}; {_READS}"
            )
        seen = self._each([(targets.find_markers, i, (layout.dictionary,)) for i in every], every)
        markers = {i: one for i, one in zip(every, seen, strict=True) if one is not None}
        kept = [targets.in_place(one, layout)[0].ids for one in markers.values()]
        layout = targets.with_rows(layout, kept) or layout
        if corners is not None:
            size, stated = (layout.columns - 1, layout.rows - 1), targets.of_size(layout, corners)
            if stated is None:
                raise BadInputError(_not_found(pictures, corners, size, "a ChArUco board"))
            layout = stated
        board = Board(layout.columns - 1, layout.rows - 1, self.square_m)
        found = dict.fromkeys(every) | self._counted(
            list(markers), [(targets.detect_charuco, i, (one, layout)) for i, one in markers.items()]
        )
        if not any(found.values()):
            raise BadInputError(
                f"{_names(pictures)}: no picture shows 3x3 corners of the ChArUco board "
                f"({layout.dictionary}, {board.columns}x{board.rows} inner corners)"
            )
        return self._search(board, found, layout)

    def _are_large(self, found: Mapping[int, Detection | None]) -> bool:
        """Whether a board is large enough to be meant: texture as small as a stamp passes for any."""
        least = Limits.view_poor * math.prod(self.size_px)
        return any(hull_area(one.pixels) >= least for one in found.values() if one is not None)

    def _detect(self, which: Sequence[int], corners: tuple[int, int]) -> dict[int, Detection | None]:
        return self._counted(which, [(detect, i, corners) for i in which])

    def _counted(self, which: Sequence[int], jobs: Sequence[_Job]) -> dict[int, Detection | None]:
        found: dict[int, Detection | None] = {}
        for i, detection in zip(which, self._each(jobs, which), strict=True):
            found[i] = detection
            self.done += 1
            self.progress(self.done, len(self.pictures))
        return found

    def _common_size(self, which: Sequence[int], share: float = 0.0) -> tuple[int, int] | None:
        """The size of board that most of these pictures show, if a share of them does; the larger in a tie.

        Seen upright and lying, a board counts the same.
        """
        new = [i for i in which if i not in self.sizes]
        self.sizes |= zip(new, self._each([(find_size, i, ()) for i in new], new), strict=True)
        return _most_common([self.sizes[i] for i in which], share * len(which))

    def _usual_size(self, which: Sequence[int]) -> tuple[int, int] | None:
        """As `_common_size`; where less than half of them are sure, those with covered corners count too.

        A hand that lies along a side makes a smaller board of a picture.
        """
        sure = self._common_size(which, 0.5)
        if sure is not None:
            return sure
        others = [i for i in which if self.sizes[i] is None]
        covered = self._each([(find_size, i, (True, True)) for i in others], others)
        return _most_common([*(self.sizes[i] for i in which), *covered], 2) or self._common_size(which)


def _most_common(sizes: Sequence[tuple[int, int] | None], least: float) -> tuple[int, int] | None:
    """The commonest size of at least so many, the larger in a tie."""
    counts = Counter(size for size in sizes if size is not None)
    most = max(counts, key=lambda size: (counts[size], size[0] * size[1]), default=None)
    return None if most is None or counts[most] < least else most


def _not_found(
    pictures: Sequence[Picture], wanted: tuple[int, int], other: tuple[int, int] | None, what: str = "one"
) -> str:
    instead = "and no other either"
    if other is not None:
        instead = (
            f"but {what} with {other[0]}x{other[1]} was: state these, which are one less than the squares"
        )
    return (
        f"{_names(pictures)}: no board with {wanted[0]}x{wanted[1]} inner corners found in "
        f"{_count(len(pictures))}, {instead}"
    )


_READS = (
    "calib reads checkerboards and ChArUco boards, and points of any other flat target from a table "
    "view,x_m,y_m,u_px,v_px"
)


def _shows(pictures: Sequence[Picture]) -> str:
    return "the picture shows" if len(pictures) == 1 else "the pictures show"


def _count(pictures: int) -> str:
    return "the picture" if pictures == 1 else f"any of {pictures} pictures"


def _names(pictures: Sequence[Picture]) -> str:
    first, last = pictures[0].name, pictures[-1].name
    return first if len(pictures) == 1 else f"{first} ... {last}"


# ----------------------------------------------------------------------
# Correspondences that others have found: CSV tables and the corner files of mrgingham and mrcal.
#
# A table has a header and one row per point: `view,x_m,y_m,u_px,v_px`, in any order of columns, with
# further columns kept out of the way. Any planar target will do.
#
# A corner file (.vnl, a vnlog) has a legend `# filename x y level` and one line per corner, row by row of
# the board; a picture without a board has a single line of `-`, and single corners that were not seen
# have `-` too.

COLUMNS = ("view", "x_m", "y_m", "u_px", "v_px")
"""Columns that a correspondence table must have."""

_FEWEST = 4
_LONGEST_LINE = 65536


def _at(path: Path, line: int, what: str) -> BadInputError:
    return BadInputError(f"{shown(path)}: line {line}: {what}")


@dataclass
class _Points:
    """What was read of one view so far: four numbers a row, and the lines; compact, for long tables."""

    values: array[float] = field(default_factory=lambda: array("d"))
    lines: array[int] = field(default_factory=lambda: array("q"))

    def view(self, name: str, path: Path) -> View:
        """The view, or a `BadInputError` for too few points or one that is given twice."""
        where = f"view {shown(name)}"
        if len(self.lines) < _FEWEST:
            raise BadInputError(
                f"{shown(path)}: {where} (from line {self.lines[0]}) has {len(self.lines)} points, "
                f"expected at least {_FEWEST}"
            )
        rows = np.frombuffer(self.values, dtype=np.float64).reshape(-1, 4)
        _, first, index = np.unique(rows[:, :2], axis=0, return_index=True, return_inverse=True)
        again = np.flatnonzero(first[index.ravel()] != np.arange(len(rows)))
        if len(again):
            second = int(again[0])
            x, y = rows[second, :2]
            before = self.lines[int(first[index.ravel()[second]])]
            what = f"the point x_m = {x:g}, y_m = {y:g} of {where} was given in line {before}"
            raise _at(path, self.lines[second], what)
        return View(name, rows[:, :2].copy(), rows[:, 2:].copy())


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file, without their ends; never more than one line in memory.

    Raises `BadInputError` for files that cannot be opened, are not UTF-8 text or have lines of absurd length.
    """
    with to_be("read", path), path.open(encoding="utf-8-sig", errors="surrogateescape") as file:
        for number, text in enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), 1):
            if len(text) == _LONGEST_LINE:
                raise BadInputError(f"{shown(path)}: line {number} has {_LONGEST_LINE} characters or more")
            if "\0" in text:
                raise BadInputError(
                    f"{shown(path)}: line {number} has a zero byte; expected a text file, not binary data"
                )
            if odd := re.search("[\udc80-\udcff]", text):
                byte = ord(odd[0]) - 0xDC00
                raise BadInputError(f"{shown(path)}: line {number} is not UTF-8 text (byte 0x{byte:02x})")
            yield number, text.rstrip("\n")


def _number(text: str, path: Path, line: int, column: str) -> float:
    """A finite decimal number."""
    word = text.strip()
    value = plain_number(word)
    if value is not None and math.isfinite(value):
        return value
    found = "empty" if not word else repr(word[:40])
    raise _at(path, line, f"{column} is {found}, expected a finite number")


def _numbers(text: str, cells: list[str], path: Path, line: int) -> list[float]:
    """The numbers of a row; a good row, as nearly all are, is seen at a glance."""
    try:
        values = [float(cell) for cell in cells]
        if "_" not in text and math.isfinite(sum(values)):
            return values
    except ValueError:
        pass
    return [_number(cell, path, line, column) for cell, column in zip(cells, COLUMNS[1:], strict=True)]


def _cells(text: str, path: Path, line: int) -> list[str]:
    if '"' not in text:
        return text.split(",")
    try:
        return next(csv.reader([text], strict=True, skipinitialspace=True), [])
    except csv.Error as error:
        raise _at(path, line, f"not a line of comma-separated values ({error})") from error


def _header(cells: list[str], path: Path, line: int) -> list[int]:
    """Where each of `COLUMNS` is."""
    names = [cell.strip() for cell in cells]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = ",".join(names)[:80]
        expected = f"{','.join(COLUMNS)} separated by commas"
        raise _at(path, line, f"the header lacks {', '.join(missing)}; expected {expected}, found {found!r}")
    for name in COLUMNS:
        if names.count(name) > 1:
            raise _at(path, line, f"the header has {name} more than once")
    return [names.index(name) for name in COLUMNS]


def read_table(path: Path) -> list[View]:
    """Views of a correspondence table, in the order in which they first appear.

    Rows of different views may be mixed. Blank lines and lines that begin with `#` are passed over.

    Raises
    ------
    BadInputError
        Naming the file and the line: no header, missing columns, text or NaN for a number, a row of
        another length, a point of the target given twice in a view, a view with fewer than four
        points, or a file that is empty or not text.
    """
    views: defaultdict[str, _Points] = defaultdict(_Points)
    where: list[int] = []
    width = 0
    for line, text in _lines(path):
        if not text or text.isspace() or text.lstrip().startswith("#"):
            continue
        cells = _cells(text, path, line)
        if not where:
            where, width = _header(cells, path, line), len(cells)
            continue
        if len(cells) != width:
            raise _at(path, line, f"has {len(cells)} values, expected {width} as in the header")
        name = cells[where[0]].strip()
        if not name:
            raise _at(path, line, "view is empty, expected a name")
        points = views[name]
        points.values.extend(_numbers(text, [cells[i] for i in where[1:]], path, line))
        points.lines.append(line)
    if not where:
        raise BadInputError(
            f"{shown(path)}: is empty; expected a header {','.join(COLUMNS)} and one row per point"
        )
    if not views:
        raise BadInputError(f"{shown(path)}: has a header but no points")
    return [points.view(name, path) for name, points in views.items()]


def read_vnl(path: Path, columns: int, rows: int, square_m: float) -> list[View]:
    """Views of a corner file of mrgingham or mrcal; pictures without a board are left out.

    Corners that a picture lacks (`-`, or mrcal's negative level) are left out of its view; all others
    count alike, whatever their level. A grid that is mirrored against this project's convention (the
    rows axis a quarter turn clockwise from the columns axis as seen) is read with its rows reversed,
    which names the corners differently and changes nothing else.

    Parameters
    ----------
    columns, rows : inner corners of the board; corners follow each other along the columns first.
    square_m : side of a square in metres.

    Raises
    ------
    BadInputError
        Naming the file and the line: no legend, text for a number, a picture whose number of corners
        is not columns * rows or fewer than four, no picture with a board, or a file that is not text.
    """
    board = Board(columns, rows, square_m)
    legend: list[str] = []
    pictures: dict[str, list[tuple[int, float, float]]] = {}
    for line, text in _lines(path):
        stripped = text.strip()
        if stripped.startswith("#"):
            if not legend and not stripped.startswith(("##", "#!")):
                legend = _legend(stripped[1:].split(), path, line)
            continue
        words = stripped.split("#", 1)[0].split()
        if not words:
            continue
        if not legend:
            raise _at(path, line, "no legend before the data, expected '# filename x y level'")
        row = dict(zip(legend, words, strict=False))
        # mrgingham leaves the level out where it found no board.
        if not {"filename", "x", "y"} <= row.keys() or len(words) > len(legend):
            raise _at(path, line, f"has {len(words)} values, expected {len(legend)} as in the legend")
        pictures.setdefault(row["filename"], []).append((line, *_corner(row, path, line)))
    if not legend:
        raise BadInputError(
            f"{shown(path)}: is empty; expected a legend '# filename x y level' and one line per corner"
        )
    views = [view for name, found in pictures.items() if (view := _view(name, found, board, path))]
    if not views:
        raise BadInputError(f"{shown(path)}: no picture in it has a board")
    return views


def _legend(names: list[str], path: Path, line: int) -> list[str]:
    for name in ("filename", "x", "y"):
        if names.count(name) != 1:
            found = " ".join(names)[:80]
            raise _at(path, line, f"the legend is {found!r}, expected '# filename x y level'")
    return names


def _corner(row: dict[str, str], path: Path, line: int) -> tuple[float, float]:
    """Pixel of a corner, NaN where it was not seen."""
    level = row.get("level", row.get("weight", "0"))
    if row["x"] == "-" or row["y"] == "-" or level == "-":
        return math.nan, math.nan
    u, v = _number(row["x"], path, line, "x"), _number(row["y"], path, line, "y")
    if _number(level, path, line, "level") < 0:
        return math.nan, math.nan
    return u, v


def _view(name: str, found: list[tuple[int, float, float]], board: Board, path: Path) -> View | None:
    pixels = np.array([(u, v) for _, u, v in found])
    seen = np.isfinite(pixels[:, 0])
    if not seen.any() and len(found) in (1, board.corners):
        return None
    line, has = found[0][0], f"{shown(name)} has"
    if len(found) != board.corners:
        expected = f"{board.columns}x{board.rows} = {board.corners}"
        raise _at(path, line, f"{has} {len(found)} corners, expected {expected}")
    if seen.sum() < _FEWEST:
        what = f"{has} {int(seen.sum())} corners that were seen, expected at least {_FEWEST}"
        raise _at(path, line, what)
    target = board.points_m()
    if _mirrored(target[seen], pixels[seen]):
        pixels = pixels.reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2)
        seen = np.isfinite(pixels[:, 0])
    return View(name, target[seen], pixels[seen])


def _mirrored(target_m: FloatArray, pixels: FloatArray) -> bool:
    """Whether going from the columns axis to the rows axis turns anticlockwise in the picture."""
    centred = target_m - target_m.mean(axis=0)
    affine = np.linalg.lstsq(centred, pixels - pixels.mean(axis=0), rcond=None)[0]
    return bool(np.linalg.det(affine) < 0.0)


# ----------------------------------------------------------------------
# What a camera is calibrated from: pictures of a board, or correspondences that others have found.

_TABLES = (".csv", ".vnl")
_MOST_BYTES = 500_000_000
"""Largest table; all of its points are held in memory."""
_OUTSIDE_PX = 1.0
"""How far a corner may be found beyond the border of the picture."""
_LARGEST_M = 1e4
_SMALLEST_M = 1e-6
_NO_SQUARE = "the square's length is not given; intrinsics do not depend on it, lengths are in squares"


@dataclass(frozen=True)
class ViewSet:
    """Views to calibrate from.

    Attributes
    ----------
    views : one for each picture with a board.
    image_size_px : width and height.
    hashes : SHA-256 of each input by its name.
    left_out : files that are there and not used.
    remarks : sentences for the person who watches.
    square_known : whether lengths are in metres, not in squares.
    """

    views: tuple[View, ...]
    image_size_px: tuple[int, int]
    hashes: dict[str, str]
    left_out: tuple[LeftOut, ...]
    remarks: tuple[str, ...]
    simulated: bool = False
    square_known: bool = True


def read_views(
    sources: Sequence[Path], told: Told, progress: Callable[[int, int], None] = lambda done, total: None
) -> ViewSet:
    """Views from folders of pictures, single pictures and recordings, or from one table.

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
        if told.corners is not None or told.square_m is not None or told.dictionary is not None:
            raise UsageError(
                f"{shown(path)}: a table holds its target in metres; --corners, --square and --dictionary do "
                "not go with it"
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
    return ViewSet(
        _near_origin(views), told.image_size_px, {shown(path.name): digest}, (), remarks,
        square_known=not remarks,
    )  # fmt: skip


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
    remarks: list[str] = []
    sources = [meant_folder(source, "images", remarks) for source in sources]
    recordings = [read_frames(source, told.topic) for source in sources if is_recording(source)]
    if told.topic is not None and not recordings:
        raise UsageError("--topic: goes with a bag")
    folders = [source for source in sources if not is_recording(source)]
    for folder in folders:
        refuse_recordings(folder)
    paths = list_pictures(folders) if folders else []
    frames = [picture for one in recordings for picture in one.pictures]
    file, hashes = board_of(sources)
    corners = told.corners or (None if file.corners is None else (file.corners[0], file.corners[1]))
    square_m = file.square_m if told.square_m is None else told.square_m
    dictionary = (
        None if told.dictionary is None else known_dictionary(told.dictionary, "--dictionary", UsageError)
    )
    if square_m is None:
        remarks.append(_NO_SQUARE)
    for option, here, there in (
        ("--corners", told.corners, file.corners),
        ("--square", told.square_m, file.square_m),
        ("--dictionary", dictionary, file.dictionary),
    ):
        if here is not None and there is not None and _text(here) != _text(there):
            remarks.append(f"{option}: {_text(here)} is used, not {_text(there)} of board.yaml")
    found = find_boards(
        paths,
        corners,
        1.0 if square_m is None else square_m,
        progress,
        told.image_size_px,
        dictionary or file.dictionary,
        frames,
    )
    if found.layout is not None:
        remarks.append(_of_markers(found.layout))
    elif corners is None:
        remarks.append(f"found a board with {found.board.columns}x{found.board.rows} inner corners")
    remarks.append(f"board found in {len(found.views)} of {len(paths) + len(frames)} pictures")
    if turned := [shown(path.name) for path in paths if asks_to_turn(path)]:
        remarks.append(
            f"{several(turned)}: turning by EXIF is not done; the camera is that of the sensor's own rows"
        )
    views, hashes = found.views, {**found.hashes, **hashes}
    left_out = [*found.left_out, *_no_pictures(folders)]
    for one in recordings:
        views, remark = _of_recording(one, views, found.image_size_px)
        remarks.append(remark)
        names = {picture.name for picture in one.pictures}
        hashes = {name: value for name, value in hashes.items() if name not in names} | {
            one.source: one.sha256
        }
        # Of a recording most frames are left out; the remark counts them.
        left_out = [file for file in left_out if file.name not in names]
    return ViewSet(
        views, found.image_size_px, hashes, tuple(left_out), tuple(remarks), file.simulated,
        square_known=square_m is not None,
    )  # fmt: skip


def _of_recording(
    frames: Frames, views: tuple[View, ...], image_size_px: tuple[int, int]
) -> tuple[tuple[View, ...], str]:
    """The views without those frames of a recording that add little, and what was chosen."""
    names = {picture.name for picture in frames.pictures}
    own = [view for view in views if view.name in names]
    kept = {own[k].name for k in most_informative(own, image_size_px)}
    remark = (
        f"{frames.source}: {frames.count} frames, looked at the sharpest at rest of each of {len(names)} "
        f"stretches, board in {len(own)}, used {len(kept)} that say most of the camera"
    )
    return tuple(view for view in views if view.name not in names or view.name in kept), remark


def refuse_recordings(folder: Path) -> None:
    """Raise `BadInputError` for a folder that holds recordings and no pictures, and is none itself."""
    empty = folder.is_dir() and not is_recording(folder) and not holds_pictures(folder)
    inside = sorted(folder.iterdir()) if empty else []
    for path in filter(is_recording, inside):
        raise BadInputError(
            f"{shown(folder)}: holds no pictures, but {shown(path.name)}; give that recording itself"
        )


def of_still(frames: Frames, search: BoardSearch) -> BoardSearch:
    """What a recording of a board that rests shows: one view, the middle one of those with the board.

    A hand that lays the board, or takes it away, is in the first frames or in the last.
    """
    names = {picture.name for picture in frames.pictures}
    return replace(
        search,
        views=search.views[len(search.views) // 2 :][:1],
        left_out=tuple(one for one in search.left_out if one.name not in names),
        hashes={frames.source: frames.sha256},
    )


def meant_folder(source: Path, inside: str, remarks: list[str]) -> Path:
    """The folder of pictures that is meant where the folder of a rig is given; says so in `remarks`."""
    place = source / inside
    if not source.is_dir() or is_recording(source) or not place.is_dir() or holds_pictures(source):
        return source
    remarks.append(f"{shown(source)}: holds no pictures itself; taking those in {shown(place)}")
    return place


def _no_pictures(sources: Sequence[Path]) -> list[LeftOut]:
    """Files of folders that are not read at all."""
    inside = [path for source in sources if source.is_dir() for path in sorted(source.iterdir())]
    kinds = ", ".join(kind[1:] for kind in PICTURES)
    recording = "is a recording; give it by itself, not its folder"
    return [
        LeftOut(shown(path.name), recording if is_recording(path) else f"is no picture ({kinds})", "file")
        for path in inside
        if path.is_file()
        and path.suffix.lower() not in PICTURES
        and not path.name.startswith(".")
        and path.name != BOARD_FILE
    ]


def _of_markers(layout: targets.Layout) -> str:
    text = (
        f"found a ChArUco board with {layout.columns - 1}x{layout.rows - 1} inner corners and markers of "
        f"{layout.dictionary}"
    )
    if layout.first_white:
        text += "; a marker in its top left square, as OpenCV before 4.6 printed boards (legacy pattern)"
    return text


def _text(value: Sequence[int] | float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g} m" if isinstance(value, float | int) else "x".join(str(part) for part in value)
