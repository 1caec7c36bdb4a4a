"""Schemes with values on their wires: the values belong together."""

from __future__ import annotations

from itertools import pairwise

import pytest

from thesis.drawn import Diagram, Drawn
from thesis.drawn_schemes import clamping, with_feedforward


def _diagram(figure: Drawn) -> Diagram:
    made = figure.make()
    assert isinstance(made, Diagram)
    return made


def test_every_wire_goes_straight_and_words_have_a_place() -> None:
    for figure in (clamping, with_feedforward):
        for wire in _diagram(figure).wires:
            for (x0, y0), (x1, y1) in pairwise(wire.points):
                assert (x0 == x1) != (y0 == y1)
            assert not wire.words or wire.at[0] == wire.at[0]


def test_the_values_of_the_tick_add_up() -> None:
    numbers = _diagram(clamping).numbers
    assert numbers["phi_rad"] + numbers["error_rad"] == pytest.approx(0.7)
    assert numbers["sent1_pwm"] == min(max(round(numbers["u1_pwm"]), 0), 255)
    both = _diagram(with_feedforward).numbers
    for i in (1, 2):
        assert both[f"sent{i}_pwm"] == pytest.approx(both[f"total{i}_pwm"], abs=0.51)
