"""Figures as data: their names and curves."""

from __future__ import annotations

import numpy as np
import pytest

from thesis.drawn import KINDS, Curve, Diagram, Drawn, Plot, drawn


def _plot() -> Plot:
    t = np.linspace(0.0, 1.0, 5)
    return Plot("time (s)", "x (mm)", (Curve("a", t, t), Curve("b", t, 2.0 * t)), "nothing")


def test_a_figure_has_the_name_of_its_number_and_words() -> None:
    one = drawn("3.12", "bellows_after_release", "Bellows")(_plot)
    assert isinstance(one, Drawn)
    assert one.stem == "figure_3_12_bellows_after_release"
    assert isinstance(one.make(), Plot)


def test_curves_are_found_by_their_label() -> None:
    assert _plot().curve("b").y[-1] == 2.0
    with pytest.raises(StopIteration):
        _plot().curve("c")


def test_a_diagram_needs_no_numbers() -> None:
    assert dict(Diagram((), (), "nothing").numbers) == {}
    assert len(set(KINDS)) == len(KINDS)
