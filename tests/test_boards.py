"""The search for a board in a set of pictures: order, early answers, memory, and what board.yaml tells."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from calib.core import workers
from calib.core.errors import BadInputError
from calib.stages.camera import read as boards
from calib.stages.camera.read import board_of, find_boards


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
    assert found.without == ()
    assert list(found.hashes) == [path.name for path in paths]


def test_few_pixels_in_memory_change_nothing(shipped: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    expected = find_boards(shipped[:3], None, 0.02)
    monkeypatch.setattr(boards, "_KEPT_PIXELS", 316 * 208)
    found = find_boards(shipped[:3], None, 0.02)
    assert found.hashes == expected.hashes
    for view, other in zip(found.views, expected.views, strict=True):
        np.testing.assert_array_equal(view.pixels, other.pixels)


def test_a_picture_that_changes_meanwhile(
    shipped: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copies = [Path(shutil.copy(path, tmp_path)) for path in shipped[:2]]
    monkeypatch.setattr(boards, "_KEPT_PIXELS", 0)

    def change(done: int, total: int) -> None:
        shutil.copy(shipped[5], copies[1])

    monkeypatch.setattr(workers, "processors", lambda: 1)
    monkeypatch.setattr(boards, "same_size", lambda pictures: change(0, 0) or pictures[0].size_px)
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
