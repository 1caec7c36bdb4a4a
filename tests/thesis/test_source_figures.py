"""Figures that correspond to the source's: legible, labelled, the same bytes again, with an index."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from figure_checks import complaints, drawn_texts

from calib.core.errors import BadInputError
from calib.show.style import look
from thesis.album import ALBUM
from thesis.drawn import Drawn, Plot
from thesis.source_figures import source_figure, write_source_figures

SOME = [one for one in ALBUM if one.number in ("3.5", "3.17", "4.3", "4.10", "4.16")]


def _legible(one: Drawn) -> None:
    data = one.make()
    with look():
        figure = source_figure(one, data)
        assert complaints(figure) == [], one.number
        words = " ".join(text.get_text() for text in drawn_texts(figure))
    assert f"Figure {one.number}, simulated." in words.replace("\n", " ")
    if isinstance(data, Plot):
        assert data.x in words and data.y in words
        assert all(curve.label in words for curve in data.curves)


@pytest.mark.parametrize("one", SOME, ids=[one.number for one in SOME])
def test_a_figure_is_legible_and_says_that_it_is_simulated(one: Drawn) -> None:
    _legible(one)


@pytest.mark.slow
@pytest.mark.parametrize("one", ALBUM, ids=[one.number for one in ALBUM])
def test_every_figure_is_legible(one: Drawn) -> None:
    _legible(one)


def test_files_index_and_the_same_bytes_again(tmp_path: Path) -> None:
    first, again = (write_source_figures(tmp_path / name, SOME[:2]) for name in ("a", "b"))
    assert [path.name for path in first] == [
        "figure_3_5_inverse_series_error.svg",
        "figure_3_17_spring_force_at_steady_angle.svg",
        "figures.json",
        "index.html",
    ]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(first, again, strict=True))
    svg = first[0].read_text()
    assert "Figure 3.5, simulated." in svg and "<dc:date>" not in svg
    assert len(svg) < 300_000
    rows = json.loads(first[2].read_text())["figures"]
    assert [row["number"] for row in rows] == ["3.5", "3.17"]
    assert all(row["simulated"] and row["drawn_from"] and row["numbers"] for row in rows)
    page = first[3].read_text()
    assert re.findall(r'<img src="([^"]+)"', page) == [row["file"] for row in rows]


def test_progress_is_told_and_a_file_is_no_folder(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    write_source_figures(tmp_path / "a", SOME[:1], lambda done, total: told.append((done, total)))
    assert told == [(0, 1)]
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInputError, match="is a file"):
        write_source_figures(tmp_path / "file", SOME[:1])
