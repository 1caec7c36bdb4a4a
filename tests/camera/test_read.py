"""Views from pictures, tables and corner files: order, checks, and one clear sentence for what is wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.core import workers
from calib.core.errors import BadInputError
from calib.stages.camera import read as boards
from calib.stages.camera.model import Board
from calib.stages.camera.options import Told
from calib.stages.camera.read import (
    board_of,
    find_boards,
    read_table,
    read_views,
    read_vnl,
    refuse_recordings,
)

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
        ("view,x_m,y_m,u_px\n" + FOUR, "line 1: the header lacks v_px"),
        ("view,x_m,y_m,u_px,v_px,u_px\n", "the header has u_px more than once"),
        (HEADER + FOUR + "a,1,1,3,inf\n", "line 6: v_px is 'inf'"),
        (HEADER + FOUR + "a,1_0,1,3,4\n", "line 6: x_m is '1_0'"),
        (HEADER + FOUR + "a,1,1,3\n", "line 6: has 4 values, expected 5"),
        (HEADER + "b,1,1,3,4\n" + FOUR, r"view b \(from line 2\) has 1 points, expected at least 4"),
        (HEADER.encode() + b"\xff\xfe\n", r"line 2 is not UTF-8 text \(byte 0xff\)"),
        (HEADER + "a" * 70000, "line 2 has 65536 characters or more"),
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
        (LEGEND, "no picture in it has a board"),
        (LEGEND + corners("b", SIX) + corners("a", SIX) + corners("a", SIX), r"line 8: a has 12 corners"),
        (LEGEND + corners("a", SIX[:5]) + "a 1 1 high\n", "line 7: level is 'high'"),
        (LEGEND + corners("a", SIX[:3]) + "a - - -\n" * 3, "line 2: a has 3 corners that were seen"),
        (LEGEND.encode() + b"\0\0", "line 2 has a zero byte"),
    ],
)
def test_a_bad_corner_file_is_answered_with_file_and_line(write, content: str | bytes, words: str) -> None:
    path = write(content, "corners.vnl")
    with pytest.raises(BadInputError, match=words) as caught:
        read_vnl(path, 3, 2, 0.02)
    assert str(caught.value).startswith(f"{path}: ")


SIZE = (640, 480)


def test_a_table_beyond_the_memory_is_refused_by_its_size(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("view,x_m,y_m,u_px,v_px\n")
    with path.open("r+b") as stream:
        # A file with holes takes no room on the disk.
        stream.truncate(2_000_000_000)
    with pytest.raises(BadInputError, match="is larger than 500 MB"):
        read_views([path], Told(image_size_px=SIZE))


@pytest.fixture(scope="module")
def shipped(project_root: Path) -> list[Path]:
    return sorted((project_root / "images").glob("view*.png"))


def test_views_come_in_the_order_of_the_pictures(shipped: list[Path]) -> None:
    done: list[tuple[int, int]] = []
    paths = [shipped[i] for i in (3, 0, 2)]
    found = find_boards(paths, (7, 5), 0.02, lambda *progress: done.append(progress))
    assert [view.name for view in found.views] == [path.name for path in paths]
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert found.image_size_px == (316, 208)
    assert found.board.square_m == 0.02
    assert found.left_out == ()
    assert list(found.hashes) == [path.name for path in paths]


def test_a_board_under_a_thumb_in_every_picture(shipped: list[Path], tmp_path: Path) -> None:
    found = find_boards(shipped[:3], (7, 5), 0.02)
    # Under a hand along a side the third is sure of a board of 5x5.
    hidden = ([0], [28], [6, 13, 20, 27, 34])
    for path, view, corners in zip(shipped, found.views, hidden, strict=False):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        radius_px = 0.8 * np.linalg.norm(view.pixels[1] - view.pixels[0])
        for u, v in view.pixels[corners]:
            cv2.circle(picture, (round(u), round(v)), round(radius_px), 140, -1)
        cv2.imwrite(str(tmp_path / path.name), picture)
    covered = find_boards(sorted(tmp_path.iterdir()), None, 0.02)
    assert (covered.board.columns, covered.board.rows) == (7, 5)
    assert [len(view.counted()[0]) for view in covered.views] == [34] * 2
    assert [one.name for one in covered.left_out] == [shipped[2].name]


def test_pictures_of_another_board_say_which(shipped: list[Path], tmp_path: Path) -> None:
    board = np.kron(np.indices((5, 7)).sum(axis=0) % 2, np.full((24, 24), 200)) + 20
    picture = np.pad(board, ((40, 48), (60, 88)), constant_values=220).astype(np.uint8)
    others = [tmp_path / name for name in ("a.png", "b.png")]
    for shift, path in enumerate(others):
        cv2.imwrite(str(path), cv2.GaussianBlur(np.roll(picture, 9 * shift), (0, 0), 1.0))
    found = find_boards([*shipped[:3], *others], None, 0.02)
    assert len(found.views) == 3
    why = "shows no board with 7x5 inner corners that can be read, but one with 6x4"
    assert [str(one) for one in found.left_out] == [f"{path.name}: {why}" for path in others]


def test_a_file_of_several_pictures_is_named(shipped: list[Path], tmp_path: Path) -> None:
    pages = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in shipped[:3]]
    assert cv2.imwritemulti(str(tmp_path / "all.tiff"), pages)
    found = find_boards([tmp_path / "all.tiff"], (7, 5), 0.02)
    assert [view.name for view in found.views] == ["all.tiff"]
    assert "all.tiff: holds 3 pictures, of which the first alone is read" in str(found.left_out[0])


def test_damaged_pictures_are_named(shipped: list[Path], tmp_path: Path) -> None:
    copies = [Path(shutil.copy(path, tmp_path)) for path in shipped[:6]]
    whole = copies[1].read_bytes()
    # Its header and its end are there, and nonsense between them.
    copies[1].write_bytes(whole[:2000] + b"x" * (len(whole) - 2100) + whole[-100:])
    copies[3].write_bytes(b"")
    for corners in ((7, 5), None):
        found = find_boards(copies, corners, 0.02)
        assert [view.name for view in found.views] == [copies[i].name for i in (0, 2, 4, 5)]
        assert [(one.name, one.kind) for one in found.left_out] == [
            (copies[i].name, "unreadable") for i in (1, 3)
        ]
        assert list(found.hashes) == [copies[i].name for i in (0, 2, 4, 5)]
    for corners, dictionary in (((7, 5), None), (None, None), (None, "4X4_50")):
        with pytest.raises(BadInputError, match=rf"{copies[1].name}: is a damaged PNG"):
            find_boards([copies[1]], corners, 0.02, dictionary=dictionary)


def test_a_picture_that_changes_meanwhile(
    shipped: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies = [Path(shutil.copy(path, tmp_path)) for path in shipped[:2]]

    def change(done: int, total: int) -> None:
        shutil.copy(shipped[5], copies[1])

    monkeypatch.setattr(workers, "processors", lambda: 1)
    monkeypatch.setattr(boards, "usual_size", lambda pictures: change(0, 0) or pictures[0].size_px)
    with pytest.raises(BadInputError, match=r"view02\.png: has changed since the work began"):
        find_boards(copies, (7, 5), 0.02)


def test_a_wrong_size_is_known_after_two_pictures(
    shipped: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = []
    detect = boards.detect

    def counted(gray, columns, rows):
        searched.append((columns, rows))
        return detect(gray, columns, rows)

    monkeypatch.setattr(boards, "detect", counted)
    monkeypatch.setattr(workers, "processors", lambda: 1)
    with pytest.raises(BadInputError, match=r"no board with 9x6 .* any of 17 pictures, but one with 7x5 was"):
        find_boards(shipped, (9, 6), 0.02)
    assert searched == [(9, 6)] * 2


def test_texture_as_small_as_a_stamp_is_no_board_of_a_wrong_size(shared_data: Path) -> None:
    """An `8x6 board` of a hundredth of the picture was found in eight of these."""
    pictures = sorted((shared_data / "opencv_left").glob("*.jpg"))
    with pytest.raises(BadInputError, match=r"no board with 8x6 .* any of 13 pictures, but one with 9x6 was"):
        find_boards(pictures, (8, 6), 0.025)


def test_a_bag_that_is_a_folder_is_a_recording_with_its_board_beside_it(tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    bag.mkdir()
    for name in ("metadata.yaml", "drive_0.mcap"):
        (bag / name).write_text("")
    (tmp_path / "board.yaml").write_text("corners: [8, 5]\n")
    assert board_of([bag])[0].corners == [8, 5]
    refuse_recordings(bag)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(BadInputError, match=r"drive: holds no pictures, but drive_0\.mcap"):
        refuse_recordings(bag)


def test_the_board_of_several_folders(tmp_path: Path) -> None:
    one, two, none = (tmp_path / name for name in ("one", "two", "none"))
    for folder in (one, two, none):
        folder.mkdir()
    (one / "board.yaml").write_text("corners: [7, 5]\nsquare_m: 0.02\n")
    (two / "board.yaml").write_text("{square_m: 0.02, corners: [7, 5]}\n")
    told, hashes = board_of([none, one, two / "view.png"])
    assert (told.corners, told.square_m) == ([7, 5], 0.02)
    assert list(hashes) == ["board.yaml"]
    (two / "board.yaml").write_text("corners: [7, 6]\n")
    with pytest.raises(BadInputError, match=r"two/board\.yaml: tells another board than .*one/board\.yaml"):
        board_of([one, two])
