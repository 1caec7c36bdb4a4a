"""Curves of the source's figures, in the units of the labels."""

from __future__ import annotations

from calib.core.arrays import FloatArray
from calib.core.plot import Curve, Plot

_HUES = ("blue", "red", "green", "orange", "purple", "sky")


def curve(
    label: str,
    x: FloatArray,
    y: FloatArray,
    kind: str = "line",
    colour: int = 0,
    spread: FloatArray | None = None,
) -> Curve:
    """A curve in the colour of this number; -1 is ink, for references."""
    hue = "ink" if colour < 0 else _HUES[colour % len(_HUES)]
    size = 0.0 if kind != "points" else 5.0 if len(x) <= 40 else 2.2
    return Curve(x, y, label, kind, hue, size, spread)


def curves_of(plot: Plot) -> list[Curve]:
    """What is drawn but for bands."""
    return [mark for mark in plot.marks if isinstance(mark, Curve)]
