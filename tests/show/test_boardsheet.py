"""The printed board against what a PDF renderer makes of it, measured in pixels at a known resolution."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.show.boardsheet import MARKER_SHARE, PAGES_MM, board_pdf

DPI = 200
PX_PER_MM = DPI / 25.4


@pytest.fixture(scope="module")
def pdftoppm() -> str:
    tool = shutil.which("pdftoppm")
    if tool is None:
        pytest.skip("pdftoppm is not installed (Debian package poppler-utils)")
    return tool


def _raster(tool: str, pdf: bytes, folder: Path) -> np.ndarray:
    (folder / "board.pdf").write_bytes(pdf)
    command = [tool, "-r", str(DPI), "-gray", "-png", "-singlefile", "board.pdf", "board"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert done.stderr == "", "the renderer complains about the file"
    return cv2.imread(str(folder / "board.png"), cv2.IMREAD_GRAYSCALE)


@pytest.mark.few(1, 2)
@pytest.mark.parametrize(
    ("columns", "rows", "square_m", "page", "across"),
    [
        (7, 5, 0.020, "A4", True),
        (7, 5, 0.020, "Letter", True),
        (5, 8, 0.0185, "A4", False),
        (9, 6, 0.025, "A4", True),
    ],
)
def test_squares_and_ruler_have_their_size(
    pdftoppm: str, tmp_path: Path, columns: int, rows: int, square_m: float, page: str, across: bool
) -> None:
    picture = _raster(pdftoppm, board_pdf(columns, rows, square_m, page), tmp_path)
    size = sorted(PAGES_MM[page], reverse=across)
    np.testing.assert_allclose(picture.shape[::-1], np.array(size) * PX_PER_MM, atol=1.0)

    found, corners = cv2.findChessboardCornersSB(picture, (columns, rows))
    assert found
    corners = corners.reshape(rows, columns, 2)
    if corners[0, 0, 0] > corners[-1, -1, 0]:
        corners = corners[::-1, ::-1]
    # The pitch by a straight line through all corners, along and across.
    along = np.polyfit(np.tile(np.arange(columns), rows), corners[..., 0].ravel(), 1)[0]
    down = np.polyfit(np.repeat(np.arange(rows), columns), corners[..., 1].ravel(), 1)[0]
    expected = square_m * 1000 * PX_PER_MM
    assert along == pytest.approx(expected, rel=1e-3)
    assert down == pytest.approx(expected, rel=1e-3)
    upper_left = corners[0, 0] - 0.5 * expected
    assert picture[round(upper_left[1]), round(upper_left[0])] < 50, "the upper left square is black"

    below = picture[round(corners[-1, 0, 1] + 1.2 * expected) :, : round(115 * PX_PER_MM)]
    dark = below < 160
    line = int(np.argmax(dark.sum(axis=1)))  # the ruler's base line is the longest dark run
    columns_dark = np.flatnonzero(dark[line])
    assert (columns_dark[-1] - columns_dark[0]) / PX_PER_MM == pytest.approx(100.0, abs=0.25)
    ticks = np.flatnonzero(np.diff((255.0 - below[line - round(1.2 * PX_PER_MM)] > 60).astype(int)) == 1)
    assert len(ticks) == 101
    assert np.diff(ticks).mean() == pytest.approx(PX_PER_MM, rel=2e-3)


def _rectangles(pdf: bytes) -> np.ndarray:
    return np.array([[float(v) for v in m.split()[:4]] for m in re.findall(rb"^[-\d. ]+ re$", pdf, re.M)])


def _page_mm(pdf: bytes) -> np.ndarray:
    box = re.search(rb"/MediaBox \[([-\d. ]+)\]", pdf)
    assert box is not None
    return np.array([float(value) for value in box.group(1).split()])[2:] * 25.4 / 72


@pytest.mark.parametrize("page", sorted(PAGES_MM))
@pytest.mark.parametrize(("columns", "rows"), [(2, 2), (7, 5), (20, 3)])
def test_every_board_that_fits_lies_inside_the_printable_page(columns: int, rows: int, page: str) -> None:
    for square_mm in (3.0, 8.0, 12.5):
        pdf = board_pdf(columns, rows, square_mm / 1000, page)
        black = _rectangles(pdf)
        width, height = _page_mm(pdf)
        assert len(black) == ((columns + 1) * (rows + 1) + 1) // 2
        np.testing.assert_allclose(black[:, 2:], square_mm)
        assert black[:, 0].min() >= 6.0
        assert (black[:, 0] + black[:, 2]).max() <= width - 6.0 + 1e-6
        assert (black[:, 1] + black[:, 3]).max() <= height - 6.0 + 1e-6
        assert black[:, 1].min() >= 24.0 - 1e-6, "white between the squares and the ruler"


@pytest.mark.parametrize(
    ("square_m", "words"),
    [(-0.02, "-20 mm"), (float("nan"), "nan mm"), (0.0, "0 mm"), (0.1, "the largest square that fits")],
)
def test_impossible_boards_are_refused(square_m: float, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        board_pdf(7, 5, square_m)


def test_the_file_is_the_same_every_time_and_its_table_of_objects_is_right() -> None:
    pdf = board_pdf(7, 5, 0.02)
    assert pdf == board_pdf(7, 5, 0.02)
    assert b"Date" not in pdf
    start = re.search(rb"startxref\n(\d+)\n%%EOF\n$", pdf)
    assert start is not None
    table = pdf[int(start.group(1)) :]
    assert table.startswith(b"xref\n")
    offsets = [int(line) for line in re.findall(rb"^(\d{10}) 00000 n $", table, re.M)]
    for number, offset in enumerate(offsets, start=1):
        assert pdf[offset:].startswith(b"%d 0 obj\n" % number)
    length = re.search(rb"/Length (\d+) >>\nstream\n", pdf)
    assert length is not None
    assert pdf[length.end() + int(length.group(1)) :].startswith(b"\nendstream")


def test_opencv_reads_the_printed_markers(pdftoppm: str, tmp_path: Path) -> None:
    """As its own layout of today numbers them, at the size that the sheet says."""
    picture = _raster(pdftoppm, board_pdf(8, 5, 0.02, "A4", "5X5_100"), tmp_path)
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((9, 6), 0.02, MARKER_SHARE * 0.02, markers)
    corners, ids, _, found = cv2.aruco.CharucoDetector(board).detectBoard(picture)
    assert sorted(ids.ravel()) == list(range(40))
    assert sorted(found.ravel()) == list(range(27))
    at = board.getChessboardCorners()[ids.ravel(), :2] * 1000 * PX_PER_MM
    away = corners.reshape(-1, 2) - at
    assert np.abs(away - away.mean(axis=0)).max() < 1.0
