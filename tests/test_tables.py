"""Correspondence tables and corner files: what is read, and one clear sentence for what is not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.camera.model import Board
from calib.stages.camera.read import read_table, read_vnl

HEADER = "view,x_m,y_m,u_px,v_px\n"
FOUR = "a,0,0,10,10\na,0.02,0,20,10\na,0,0.02,10,20\na,0.02,0.02,20.5,21\n"


@pytest.fixture
def write(tmp_path: Path):
    def _write(content: str | bytes, name: str = "points.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return _write


def test_columns_in_any_order_with_strangers_comments_and_blanks(write) -> None:
    text = (
        "\ufeff# made by hand\n\nv_px, u_px ,note,view, x_m,y_m\n"
        '1,2,"a, quoted note",left 1.png,3,4\r\n'
        "\n5,6,,left 1.png,7,8\n# between\n9,10,x,left 1.png,1e-1,-1E+1\n.5,-2.,x,left 1.png, 13 ,+14\n"
    )
    (view,) = read_table(write(text))
    assert view.name == "left 1.png"
    assert view.target_m.tolist() == [[3, 4], [7, 8], [0.1, -10], [13, 14]]
    assert view.pixels.tolist() == [[2, 1], [6, 5], [10, 9], [-2, 0.5]]


def test_numbers_come_back_bit_for_bit(write) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(256, 4)) * 10.0 ** rng.integers(-12, 6, (256, 4))
    rows = "".join(f"v,{','.join(repr(float(value)) for value in point)}\n" for point in points)
    (view,) = read_table(write(HEADER + rows))
    assert np.array_equal(np.hstack([view.target_m, view.pixels]), points)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty; expected a header view,x_m,y_m,u_px,v_px"),
        ("\n# nothing\n", "is empty"),
        (HEADER, "has a header but no points"),
        ("view,x_m,y_m,u_px\n" + FOUR, "line 1: the header lacks v_px"),
        ("x,y,u,v\n", "line 1: the header lacks view, x_m, y_m, u_px, v_px"),
        ("view;x_m;y_m;u_px;v_px\n", "separated by commas, found 'view;x_m"),
        ("view,x_m,y_m,u_px,v_px,u_px\n", "the header has u_px more than once"),
        (FOUR, "line 1: the header lacks"),
        (HEADER + FOUR + "a,1,1,nan,3\n", "line 6: u_px is 'nan', expected a finite number"),
        (HEADER + FOUR + "a,1,1,3,inf\n", "line 6: v_px is 'inf'"),
        (HEADER + FOUR + "a,1,1,3,1e999\n", "line 6: v_px is '1e999'"),
        (HEADER + FOUR + "a,one,1,3,4\n", "line 6: x_m is 'one'"),
        (HEADER + FOUR + "a,1_0,1,3,4\n", "line 6: x_m is '1_0'"),
        (HEADER + FOUR + "a,1,,3,4\n", "line 6: y_m is empty"),
        (HEADER + FOUR + " ,1,1,3,4\n", "line 6: view is empty"),
        (HEADER + FOUR + "a,1,1,3\n", "line 6: has 4 values, expected 5"),
        (HEADER + FOUR + "a,1,1,3,4,5\n", "line 6: has 6 values, expected 5"),
        (HEADER + FOUR + 'a,"1,1,3,4\n', "line 6: not a line of comma-separated values"),
        (HEADER + "b,1,1,3,4\n" + FOUR, r"view b \(from line 2\) has 1 points, expected at least 4"),
        (
            HEADER + FOUR + "a,0.020,0,99,99\n",
            r"line 6: the point x_m = 0.02, y_m = 0 of view a was given in line 3",
        ),
        (HEADER + FOUR + "\u00e4,1,1,3,\u00b5\n", "line 6: v_px is '\u00b5'"),
        (HEADER.encode() + b"\xff\xfe\n", r"line 2 is not UTF-8 text \(byte 0xff\)"),
        (HEADER.encode("utf-16"), "line 1 has a zero byte|not UTF-8"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "not UTF-8 text|zero byte"),
        (HEADER + "a" * 70000, "line 2 has more than 65536 characters"),
    ],
)
def test_a_bad_table_is_answered_with_file_and_line(write, content: str | bytes, words: str) -> None:
    path = write(content)
    with pytest.raises(BadInputError, match=words) as caught:
        read_table(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


BOARD = Board(3, 2, 0.02)
SIX = np.array([[10.0, 10], [20, 11], [30, 12], [9, 20], [19, 21], [29, 22]])


def corners(name: str, pixels: np.ndarray, level: str = " 0") -> str:
    return "".join(f"{name} {u:.6f} {v:.6f}{level}\n" for u, v in pixels)


def test_a_corner_file_is_read_row_by_row(write) -> None:
    text = (
        "#!/usr/bin/vnl-something\n## generated\n# filename x y level\n"
        + "none.png - - -\nshort.png - -\n"
        + corners("b.png", SIX)
        + "# between\n\n"
        + corners("a.png", SIX + 5, " 2")
    )
    views = read_vnl(write(text, "corners.vnl"), 3, 2, 0.02)
    assert [view.name for view in views] == ["b.png", "a.png"]
    assert np.array_equal(views[0].target_m, BOARD.points_m())
    assert np.array_equal(views[0].pixels, SIX)
    assert np.array_equal(views[1].pixels, SIX + 5)


def test_corners_that_were_not_seen_are_left_out(write) -> None:
    rows = corners("a", SIX).splitlines()
    rows[1], rows[4] = "a - - -", "a 19 21 -1"
    (view,) = read_vnl(write("# filename x y level\n" + "\n".join(rows), "c.vnl"), 3, 2, 0.02)
    kept = [0, 2, 3, 5]
    assert np.array_equal(view.target_m, BOARD.points_m()[kept])
    assert np.array_equal(view.pixels, SIX[kept])
    nothing = "".join("b - - -\n" for _ in range(6))
    (view,) = read_vnl(write("# filename x y level\n" + nothing + corners("a", SIX), "d.vnl"), 3, 2, 0.02)
    assert view.name == "a"


def test_a_mirrored_grid_is_named_anew_and_shows_the_same_corners(write) -> None:
    flipped = SIX.reshape(2, 3, 2)[:, ::-1].reshape(-1, 2)
    (view,) = read_vnl(write("# filename x y level\n" + corners("a", flipped), "c.vnl"), 3, 2, 0.02)
    assert np.array_equal(view.target_m, BOARD.points_m())
    assert np.array_equal(view.pixels, SIX)
    rows = corners("a", flipped).splitlines()
    rows[0] = "a - - -"
    (view,) = read_vnl(write("# filename x y level\n" + "\n".join(rows), "d.vnl"), 3, 2, 0.02)
    assert np.array_equal(view.pixels, SIX[[0, 1, 3, 4, 5]])
    assert np.array_equal(view.target_m, BOARD.points_m()[[0, 1, 3, 4, 5]])


LEGEND = "# filename x y level\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is empty; expected a legend"),
        ("a 1 2 0\n", "line 1: no legend before the data"),
        ("# name u v\n", "line 1: the legend is 'name u v', expected '# filename x y level'"),
        (LEGEND, "no picture in it has a board"),
        (LEGEND + "a - - -\n", "no picture in it has a board"),
        (LEGEND + corners("a", SIX[:5]), r"line 2: a has 5 corners, expected 3x2 = 6"),
        (LEGEND + corners("b", SIX) + corners("a", SIX) + corners("a", SIX), r"line 8: a has 12 corners"),
        (LEGEND + corners("a", SIX[:5]) + "a 1 x 0\n", "line 7: y is 'x', expected a finite number"),
        (LEGEND + corners("a", SIX[:5]) + "a nan 1 0\n", "line 7: x is 'nan'"),
        (LEGEND + corners("a", SIX[:5]) + "a 1 1 high\n", "line 7: level is 'high'"),
        (LEGEND + corners("a", SIX[:5]) + "a 1 1 0 7\n", "line 7: has 5 values, expected 4"),
        (LEGEND + corners("a", SIX[:5]) + "a 1\n", "line 7: has 2 values, expected 4"),
        (LEGEND + corners("a", SIX[:3]) + "a - - -\n" * 3, "line 2: a has 3 corners that were seen"),
        (LEGEND + "a - - -\n" * 2, "line 2: a has 2 corners, expected"),
        ("# x y filename\n1 2\n", "line 2: has 2 values, expected 3"),
        (LEGEND.encode() + b"\0\0", "line 2 has a zero byte"),
    ],
)
def test_a_bad_corner_file_is_answered_with_file_and_line(write, content: str | bytes, words: str) -> None:
    path = write(content, "corners.vnl")
    with pytest.raises(BadInputError, match=words) as caught:
        read_vnl(path, 3, 2, 0.02)
    assert str(caught.value).startswith(f"{path}: ")
