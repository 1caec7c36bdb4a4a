"""The shared look: text that cannot break a figure, numbers in words, and the checks of other tests."""

from __future__ import annotations

import numpy as np
import pytest
from figure_checks import complaints
from hypothesis import given
from hypothesis import strategies as st

from calib.show.style import look, number, plain, round_down, sheet


@given(st.text(st.characters(codec=None), max_size=60), st.integers(8, 40))
def test_any_text_becomes_a_label_of_drawable_signs(text: str, most: int) -> None:
    label = plain(text, most)
    assert len(label) <= most
    assert label.isprintable()
    # Nothing is lost where nothing had to change.
    ordinary = "view-01_(a)$b$.png"
    assert plain(ordinary) == ordinary
    assert plain(ordinary, 18) == ordinary


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
