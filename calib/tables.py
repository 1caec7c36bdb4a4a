"""Correspondences that others have found: CSV tables and the corner files of mrgingham and mrcal.

A table has a header and one row per point: `view,x_m,y_m,u_px,v_px`, in any order of columns, with
further columns kept out of the way. Any planar target will do.

A corner file (.vnl, a vnlog) has a legend `# filename x y level` and one line per corner, row by row of
the board; a picture without a board has a single line of `-`, and single corners that were not seen
have `-` too.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.arrays import FloatArray
from calib.camera.board import Board
from calib.camera.views import View
from calib.errors import BadInputError
from calib.files import shown
from calib.units import plain_number

__all__ = ["COLUMNS", "read_table", "read_vnl"]

COLUMNS = ("view", "x_m", "y_m", "u_px", "v_px")
"""Columns that a correspondence table must have."""

_FEWEST = 4
_LONGEST_LINE = 65536


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
            raise BadInputError(
                f"{shown(path)}: line {self.lines[second]}: the point x_m = {x:g}, y_m = {y:g} of {where} "
                f"was given in line {self.lines[int(first[index.ravel()[second]])]}"
            )
        return View(name, rows[:, :2].copy(), rows[:, 2:].copy())


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file, without their ends; never more than one line in memory.

    Raises
    ------
    BadInputError
        For files that cannot be opened, are not UTF-8 text, or have lines of absurd length.
    """
    try:
        with path.open("rb") as file:
            number = 0
            while raw := file.readline(_LONGEST_LINE):
                number += 1
                if b"\0" in raw:
                    raise BadInputError(
                        f"{shown(path)}: line {number} has a zero byte; expected a text file, not binary data"
                    )
                if len(raw) == _LONGEST_LINE and not raw.endswith(b"\n"):
                    raise BadInputError(
                        f"{shown(path)}: line {number} has more than {_LONGEST_LINE} characters"
                    )
                try:
                    text = raw.decode("utf-8-sig" if number == 1 else "utf-8")
                except UnicodeDecodeError as error:
                    raise BadInputError(
                        f"{shown(path)}: line {number} is not UTF-8 text (byte 0x{raw[error.start]:02x})"
                    ) from error
                yield number, text.rstrip("\r\n")
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error


def _number(text: str, path: Path, line: int, column: str) -> float:
    """A finite decimal number."""
    word = text.strip()
    value = plain_number(word)
    if value is not None and math.isfinite(value):
        return value
    found = "empty" if not word else repr(word[:40])
    raise BadInputError(f"{shown(path)}: line {line}: {column} is {found}, expected a finite number")


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
        raise BadInputError(
            f"{shown(path)}: line {line}: not a line of comma-separated values ({error})"
        ) from error


def _header(cells: list[str], path: Path, line: int) -> list[int]:
    """Where each of `COLUMNS` is."""
    names = [cell.strip() for cell in cells]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        found = ",".join(names)[:80]
        raise BadInputError(
            f"{shown(path)}: line {line}: the header lacks {', '.join(missing)}; "
            f"expected {','.join(COLUMNS)} separated by commas, found {found!r}"
        )
    for name in COLUMNS:
        if names.count(name) > 1:
            raise BadInputError(f"{shown(path)}: line {line}: the header has {name} more than once")
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
    views: dict[str, _Points] = {}
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
            raise BadInputError(
                f"{shown(path)}: line {line}: has {len(cells)} values, expected {width} as in the header"
            )
        name = cells[where[0]].strip()
        if not name:
            raise BadInputError(f"{shown(path)}: line {line}: view is empty, expected a name")
        points = views.get(name)
        if points is None:
            points = views[name] = _Points()
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
            raise BadInputError(
                f"{shown(path)}: line {line}: no legend before the data, expected '# filename x y level'"
            )
        row = dict(zip(legend, words, strict=False))
        # mrgingham leaves the level out where it found no board.
        if not {"filename", "x", "y"} <= row.keys() or len(words) > len(legend):
            raise BadInputError(
                f"{shown(path)}: line {line}: has {len(words)} values, expected {len(legend)} as in the "
                "legend"
            )
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
            raise BadInputError(
                f"{shown(path)}: line {line}: the legend is {' '.join(names)[:80]!r}, expected '# filename x "
                "y "
                "level'"
            )
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
    if len(found) != board.corners:
        raise BadInputError(
            f"{shown(path)}: line {found[0][0]}: {shown(name)} has {len(found)} corners, expected "
            f"{board.columns}x{board.rows} = "
            f"{board.corners}"
        )
    if seen.sum() < _FEWEST:
        raise BadInputError(
            f"{shown(path)}: line {found[0][0]}: {shown(name)} has {int(seen.sum())} corners that were seen, "
            f"expected at least {_FEWEST}"
        )
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
