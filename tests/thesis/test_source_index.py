"""The index of the source's figures: words of any kind are shown as they are."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

from thesis.source_index import Entry, write_index


class _Words(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.words: list[str] = []

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_titles_are_escaped_in_the_page_and_whole_in_the_table(tmp_path: Path) -> None:
    entry = Entry("3.1", "a < b & c", "figure_3_1_a.svg", "runs <one> & two", "nothing", {"x": 1.5})
    table, page = write_index(tmp_path, [entry])
    told = json.loads(table.read_text())
    assert told["schema"] == 1
    assert told["figures"][0] == {
        "number": "3.1",
        "title": "a < b & c",
        "file": "figure_3_1_a.svg",
        "simulated": True,
        "drawn_from": "runs <one> & two",
        "note": "nothing",
        "numbers": {"x": 1.5},
    }
    parser = _Words()
    parser.feed(page.read_text())
    words = "".join(parser.words)
    assert "a < b & c" in words and "runs <one> & two" in words and "None shows a measurement" in words
