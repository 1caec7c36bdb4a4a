"""A checkerboard or ChArUco board to print: a page of vector PDF at exact scale, with a ruler to check it.

The page is drawn in millimetres from its lower left corner; the transformation at the head of the
content stream turns them into the 1/72 inch of PDF (ISO 32000-1, 8.3.2). The same arguments give
the same bytes: there is no date, no identifier and no compression in the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2

from calib.core.arrays import runs
from calib.core.errors import BadInputError
from calib.core.writing import Kind, holds
from calib.stages.camera.model import Board
from calib.stages.camera.targets import dictionary_of

PAGES_MM: dict[str, tuple[float, float]] = {"A4": (210.0, 297.0), "Letter": (215.9, 279.4)}
"""Width and height of a page held upright, millimetres."""

_POINTS_PER_MM = 72.0 / 25.4
_UNPRINTABLE_MM = 6.0
"""Border that most printers leave white."""
_FOOTER_MM = 14.0
"""Height of ruler and text above the unprintable border."""
_SMALLEST_GAP_MM = 4.0
"""White between the squares and the footer, without which finders fail."""
_RULER_MM = 100
MARKER_SHARE = 0.75
"""Side of a marker over that of its square."""


@dataclass(frozen=True)
class _Layout:
    """Page size and place of the squares, millimetres; `left`, `bottom` of the board's outer square."""

    width: float
    height: float
    left: float
    bottom: float
    square: float
    margin: float


def _largest_square(columns: int, rows: int, width: float, height: float) -> float:
    """Largest square in millimetres on a page of this size."""
    across = (width - 2.0 * _UNPRINTABLE_MM) / (columns + 1)
    down = (height - 2.0 * _UNPRINTABLE_MM - _FOOTER_MM - _SMALLEST_GAP_MM) / (rows + 1)
    return min(across, down)


def _place(columns: int, rows: int, square: float, width: float, height: float) -> _Layout:
    board_width, board_height = (columns + 1) * square, (rows + 1) * square
    floor = _UNPRINTABLE_MM + _FOOTER_MM
    side = 0.5 * (width - board_width)
    # As much white below the board, towards the footer, as above it, unless the printer's border forbids.
    above = max(0.5 * (height - floor - board_height), _UNPRINTABLE_MM)
    bottom = height - above - board_height
    margin = min(square, side, above, bottom - floor)
    return _Layout(width, height, side, bottom, square, margin)


def _layout(columns: int, rows: int, square: float, page: str) -> _Layout:
    """Upright or across, whichever leaves more white around the squares.

    Raises
    ------
    BadInputError : the board fits neither way.
    """
    upright = PAGES_MM[page]
    sizes = [
        size for size in (upright, upright[::-1]) if square <= _largest_square(columns, rows, *size) + 1e-9
    ]
    if not sizes:
        largest = max(_largest_square(columns, rows, *size) for size in (upright, upright[::-1]))
        raise BadInputError(
            f"a board of {columns}x{rows} inner corners and squares of {square:g} mm does not fit "
            f"on {page}: the largest square that fits is {math.floor(10.0 * largest) / 10.0:g} mm"
        )
    choices = [_place(columns, rows, square, *size) for size in sizes]
    return max(choices, key=lambda choice: (choice.margin, min(choice.left, choice.bottom)))


def _number(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")


def _squares(columns: int, rows: int, layout: _Layout) -> list[str]:
    """Black squares, the upper left one among them."""
    size = layout.square
    commands = []
    for j in range(rows + 1):
        for i in range(j % 2, columns + 1, 2):
            corner = (layout.left + i * size, layout.bottom + (rows - j) * size)
            commands.append(" ".join(_number(value) for value in (*corner, size, size)) + " re")
    return [*commands, "f"]


def _markers(columns: int, rows: int, layout: _Layout, dictionary: str) -> list[str]:
    """Black cells of the markers, numbered row by row in the white squares.

    All are one path, so that renderers leave no seams between cells.
    """
    marks = dictionary_of(dictionary)
    cells = marks.markerSize + 2
    if (columns + 1) * (rows + 1) // 2 > len(marks.bytesList):
        raise BadInputError(
            f"a board of {columns}x{rows} inner corners needs {(columns + 1) * (rows + 1) // 2} markers, "
            f"and {dictionary} has {len(marks.bytesList)}"
        )
    cell = MARKER_SHARE * layout.square / cells
    margin = 0.5 * (1.0 - MARKER_SHARE) * layout.square
    commands: list[str] = []
    places = [(i, j) for j in range(rows + 1) for i in range((j + 1) % 2, columns + 1, 2)]
    for number, (i, j) in enumerate(places):
        black = cv2.aruco.generateImageMarker(marks, number, cells) < 128
        left = layout.left + i * layout.square + margin
        top = layout.bottom + (rows + 1 - j) * layout.square - margin
        for row, line in enumerate(black):
            for first, end in runs(line):
                box = (left + first * cell, top - (row + 1) * cell, (end - first) * cell, cell)
                commands.append(" ".join(_number(value) for value in box) + " re")
    return [*commands, "f"]


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f"{_number(x0)} {_number(y0)} m {_number(x1)} {_number(y1)} l S"


def _text(x: float, y: float, points: float, words: str) -> str:
    escaped = words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    size = _number(points / _POINTS_PER_MM)
    return f"BT /F1 {size} Tf {_number(x)} {_number(y)} Td ({escaped}) Tj ET"


def _ruler(x: float, y: float) -> list[str]:
    """Ruler from x to the right with a tick at every millimetre, numbers under the tens."""
    commands = ["0.1 w", _line(x, y, x + _RULER_MM, y)]
    for k in range(_RULER_MM + 1):
        length = 4.0 if k % 10 == 0 else 3.0 if k % 5 == 0 else 2.0
        commands.append(_line(x + k, y, x + k, y + length))
        if k % 10 == 0:
            label = f"{k} mm" if k == _RULER_MM else str(k)
            commands.append(_text(x + k - 0.7 * len(str(k)), y - 3.0, 7.0, label))
    return commands


def _crop_marks(columns: int, rows: int, layout: _Layout) -> list[str]:
    """Ticks that continue the edges of the white margin outwards, where the whole margin is on the page."""
    if layout.margin < layout.square:
        return []
    left, bottom = layout.left - layout.square, layout.bottom - layout.square
    right = layout.left + (columns + 2) * layout.square
    top = layout.bottom + (rows + 2) * layout.square
    commands = ["0.5 G 0.1 w"]
    for x, outwards in ((left, -1.0), (right, 1.0)):
        for y, upwards in ((bottom, -1.0), (top, 1.0)):
            commands.append(_line(x + outwards, y, x + 4.0 * outwards, y))
            commands.append(_line(x, y + upwards, x, y + 4.0 * upwards))
    return [*commands, "0 G"]


def _document(width_mm: float, height_mm: float, commands: list[str]) -> bytes:
    """A PDF of one page; the catalogue asks viewers not to scale it to the paper."""
    scale = f"{_POINTS_PER_MM:.10f}"
    stream = "\n".join([f"{scale} 0 0 {scale} 0 0 cm", "0 g 0 G", *commands]).encode("ascii")
    box = f"0 0 {_number(width_mm * _POINTS_PER_MM)} {_number(height_mm * _POINTS_PER_MM)}".encode()
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        b"<< /Type /Page /Parent 2 0 R /MediaBox [" + box + b"] /Contents 4 0 R "
        b"/Resources << /Font << /F1 5 0 R >> >> >>",
        b"<< /Length %d >>\nstream\n" % len(stream) + stream + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out = bytearray(b"%PDF-1.6\n")
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(out))
        out += b"%d 0 obj\n" % number + body + b"\nendobj\n"
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)


BOARD_PDF = Kind("a board to print", (".pdf",), holds(b"%PDF", b"(calib board", most=1 << 24))


def board_pdf(
    columns: int, rows: int, square_m: float, page: str = "A4", dictionary: str | None = None
) -> bytes:
    """PDF of a checkerboard with columns x rows inner corners and squares of `square_m` metres.

    With a dictionary of markers it is a ChArUco board as OpenCV 4.6 and later number it.

    The page lies upright or across, whichever leaves more white around the squares: one square where
    it fits, never less than the printer's border and a gap to the ruler below.

    Parameters
    ----------
    page : a key of `PAGES_MM`.

    Returns
    -------
    the file's content; the same arguments give the same bytes.

    Raises
    ------
    BadInputError : squares too small to print, or too large for the page.
    """
    if not square_m >= 0.0005:
        raise BadInputError(f"a square needs a side of at least 0.5 mm, not {square_m * 1000.0:g} mm")
    square = square_m * 1000.0
    layout = _layout(columns, rows, square, page)
    words = [
        f"calib board: {columns} x {rows} inner corners, square {square:g} mm, {page}",
        f"Print at 100 % (actual size); the ruler must measure {_RULER_MM} mm.",
        "Glue it flat onto a stiff plate.",
    ]
    if dictionary is not None:
        marker = f"{MARKER_SHARE * square:g} mm, {dictionary}"
        words[0] = f"calib board --charuco: {columns} x {rows} inner corners, square {square:g} mm, {page}"
        words[2] += f" Markers {marker}, upper left square black."
    elif Board(columns, rows, square_m).half_turn_looks_the_same:
        words[2] += " Half a turn leaves this board unchanged."
    ruler_x, ruler_y = _UNPRINTABLE_MM + 4.0, _UNPRINTABLE_MM + 4.5
    text_x = ruler_x + _RULER_MM + 10.0
    lines = [_text(text_x, ruler_y + 4.0 - 3.2 * k, 7.0, line) for k, line in enumerate(words)]
    commands = [
        *_squares(columns, rows, layout),
        *([] if dictionary is None else _markers(columns, rows, layout, dictionary)),
        *_ruler(ruler_x, ruler_y),
        *lines,
        *_crop_marks(columns, rows, layout),
    ]
    return _document(layout.width, layout.height, commands)
