"""`calib board`: the PDF, and boards that do not fit."""

from __future__ import annotations

import json

import pytest
import yaml


def test_the_default_board(calib, tmp_path) -> None:
    ended = calib("board", cwd=tmp_path)
    assert ended.code == 0
    data = (tmp_path / "board.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    told = ended.out.splitlines()
    assert yaml.safe_load("\n".join(told[-2:])) == {"corners": [7, 5], "square_m": 0.02}
    calib("board", "-o", "again.pdf", cwd=tmp_path)
    assert (tmp_path / "again.pdf").read_bytes() == data


def test_json_and_other_units(calib, tmp_path) -> None:
    ended = calib("board", "--square", "0.75in", "--page", "Letter", "--json", "-o", tmp_path / "b.pdf")
    document = json.loads(ended.out)
    assert document["square_m"] == pytest.approx(0.01905)
    assert document["page"] == "Letter"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--corners", "20x20", "--square", "50mm"), "does not fit on A4: the largest square that fits is"),
        (("--square", "0.01mm"), "a square needs a side of at least 0.5 mm"),
    ],
)
def test_boards_that_cannot_be_printed(calib, tmp_path, words: tuple[str, ...], says: str) -> None:
    ended = calib("board", *words, cwd=tmp_path)
    assert ended.code == 3
    assert says in ended.sentence
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written(calib, tmp_path) -> None:
    for place, says in ((tmp_path, "is a folder"), (tmp_path / "no" / "b.pdf", "there is no folder")):
        ended = calib("board", "-o", place)
        assert ended.code == 3
        assert says in ended.sentence
