"""The shared look: text that cannot break a figure, numbers in words, and the checks of other tests."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from calib.errors import BadInputError
from calib.report.style import (
    BLUE,
    FOR_EACH_DPI,
    GREEN,
    GREY,
    INK,
    ORANGE,
    SHADE,
    VERMILLION,
    figure_folder,
    look,
    number,
    plain,
    round_down,
    save,
    sheet,
    view_colours,
)


@given(st.text(st.characters(codec=None), max_size=60), st.integers(8, 40))
def test_any_text_becomes_a_label_of_drawable_signs(text: str, most: int) -> None:
    label = plain(text, most)
    assert len(label) <= most
    assert label.isprintable()
    # Nothing is lost where nothing had to change.
    ordinary = "view-01_(a)$b$.png"
    assert plain(ordinary) == ordinary
    assert plain(ordinary, 18) == ordinary


def test_labels_are_drawn_as_they_are(tmp_path: Path) -> None:
    words = "$\\frac{1}{2$ a$b$ _x^{ \udcff \u5199\u771f"
    with look():
        figure = sheet(2.0, plain(words), "note " + plain(words))
        figure.subplots().set_title(plain(words))
        assert any(
            text.get_text() == "$\\frac{1}{2$ a$b$ _x^{ \\udcff \\u5199\\u771f"
            for text in drawn_texts(figure)
        )
        save(figure, tmp_path / "a.png")


def test_settings_of_the_machine_do_not_matter(tmp_path: Path) -> None:
    def draw(name: str) -> bytes:
        with look():
            figure = sheet(2.0, "A title", "A note")
            figure.subplots().plot([1, 2], [3, 4])
            return save(figure, tmp_path / name).read_bytes()

    first = draw("a.png")
    with mpl.rc_context({"font.size": 30.0, "axes.facecolor": "black", "lines.linewidth": 9.0}):
        assert draw("b.png") == first
        assert mpl.rcParams["font.size"] == 30.0


def test_long_words_at_the_head_wrap_within_the_sheet() -> None:
    with look():
        figure = sheet(
            2.0, "Quite a long title " * 9, "and a note that goes on and on " * 12, "unidentifiable"
        )
        assert complaints(figure) == []


def test_the_checks_see_what_is_wrong() -> None:
    with look():
        figure = sheet(2.0, "A title")
        axes = figure.subplots()
        axes.text(0.5, 0.5, "one thing", transform=axes.transAxes)
        axes.text(0.51, 0.5, "another", transform=axes.transAxes)
        axes.text(0.1, 0.1, "tiny", fontsize=4, transform=axes.transAxes)
        axes.text(0.95, 0.9, "a text that leaves the sheet", transform=axes.transAxes, in_layout=False)
        found = " ".join(complaints(figure))
    assert "'one thing' lies on 'another'" in found
    assert "'tiny' is too small" in found
    assert "'a text that leaves the sheet' runs off the sheet" in found


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.12345, "0.123 px"),
        (99.99, "100.0 px"),
        (12345.6, "12346 px"),
        (0.0, "0 px"),
        (2.5e-7, "2.50e-07 px"),
        (-3.14159, "-3.14 px"),
        (np.inf, "not bounded"),
        (np.nan, "not bounded"),
    ],
)
def test_numbers_in_words(value: float, words: str) -> None:
    assert number(value, "px") == words


@given(st.floats(1e-200, 1e200))
def test_round_numbers_are_below_and_near(value: float) -> None:
    found = round_down(value)
    assert found <= value * (1 + 1e-6)
    assert found > value / 2.6
    assert f"{found:.0e}"[0] in "125"


def test_colours_of_views_are_all_darker_than_paper() -> None:
    for count in (1, 2, 400):
        colours = np.array(view_colours(count))[:, :3]
        assert len(colours) == count
        assert (colours @ [0.299, 0.587, 0.114]).max() < 0.75


def test_a_folder_without_permission_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(BadInputError, match="no folder for figures can be made here: Permission denied"):
        figure_folder(tmp_path / "figures")


def test_a_figure_for_each_log_keeps_its_hues_apart(tmp_path: Path) -> None:
    hues = (INK, GREY, SHADE, BLUE, VERMILLION, GREEN, ORANGE)
    with look():
        figure = sheet(3.0, "Hues", dpi=FOR_EACH_DPI)
        axes = figure.subplots()
        for k, hue in enumerate(hues):
            axes.plot([0.0, 1.0], [k, k], color=hue, linewidth=9.0)
        path = save(figure, tmp_path / "a.png")
    with Image.open(path) as drawn:
        assert drawn.mode == "P"
        seen = {colour for count, colour in drawn.convert("RGB").getcolors(1 << 16) if count > 1000}
    for hue in (*hues, "#ffffff"):
        wanted = np.array([int(hue[k : k + 2], 16) for k in (1, 3, 5)])
        assert min(np.abs(np.array(colour) - wanted).max() for colour in seen) <= 4, hue
