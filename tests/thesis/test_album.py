"""The album: every figure of the list once, in order, each with what it says of itself."""

from __future__ import annotations

import numpy as np
import pytest

from thesis.album import ALBUM
from thesis.drawn import KINDS, Diagram, Drawn, Plot


def _wanted() -> list[str]:
    numbers = ["2.4", "2.6", "2.10", "2.11", "2.12", "3.2", "3.3", "3.4", "3.5"]
    numbers += [f"3.{k}" for k in range(7, 21)] + ["3.23", "3.24"]
    return numbers + [f"4.{k}" for k in range(2, 26)]


def test_every_figure_is_there_once_and_in_order() -> None:
    assert [one.number for one in ALBUM] == _wanted()
    assert len({one.stem for one in ALBUM}) == len(ALBUM)
    assert all(one.stem.replace("_", "").isalnum() for one in ALBUM)


@pytest.mark.parametrize("one", ALBUM, ids=[one.number for one in ALBUM])
def test_curves_are_whole_and_labelled(one: Drawn) -> None:
    data = one.make()
    assert data.source and not data.source.endswith(".") and "nan" not in data.note
    assert data.numbers and all(np.isfinite(value) for value in data.numbers.values())
    if isinstance(data, Diagram):
        assert data.boxes and data.wires
        return
    assert isinstance(data, Plot) and data.curves
    for curve in data.curves:
        assert curve.kind in KINDS and len(curve.x) == len(curve.y) > 0
        assert np.isfinite(curve.x).all() and np.isfinite(curve.y).mean() > 0.5
    labels = [curve.label for curve in data.curves if curve.label]
    assert labels and len(set(labels)) == len(labels)
