"""A figure of the source as data: its curves from runs of our own, and what they were computed from.

Nothing is drawn here. A `Plot` has curves over one pair of axes, a `Diagram` boxes and the wires between
them; `thesis.source_figures` draws both. All values are in the units of the labels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.core.arrays import FloatArray

__all__ = ["KINDS", "Band", "Box", "Curve", "Diagram", "Drawn", "Plot", "Wire", "drawn"]

KINDS = ("line", "dashed", "dotted", "points", "bars")
"""How a curve is drawn; "bars" are points with error bars."""


@dataclass(frozen=True)
class Curve:
    """A curve.

    Attributes
    ----------
    label : in the legend; empty for none.
    x, y : (n,) values, floats. kind : of `KINDS`.
    colour : number of the hue; -1 is ink, for references.
    spread : (n,) half lengths of the error bars of "bars".
    """

    label: str
    x: FloatArray
    y: FloatArray
    kind: str = "line"
    colour: int = 0
    spread: FloatArray | None = None


@dataclass(frozen=True)
class Band:
    """A grey stretch along x or y, with a word in it."""

    begin: float
    end: float
    word: str = ""
    along_y: bool = False


@dataclass(frozen=True)
class Plot:
    """Curves over one pair of axes.

    Attributes
    ----------
    x, y : labels of the axes. curves, bands : what is drawn.
    source : one sentence about the runs behind it. note : what can be read from it, a sentence or two.
    numbers : the same as values by name. log_y, equal, down : kinds of axes; `down` lets y grow downwards.
    y_limits : shown range of y, None for all.
    """

    x: str
    y: str
    curves: tuple[Curve, ...]
    source: str
    note: str = ""
    bands: tuple[Band, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    log_y: bool = False
    equal: bool = False
    down: bool = False
    y_limits: tuple[float, float] | None = None

    def curve(self, label: str) -> Curve:
        """The curve with this label."""
        return next(one for one in self.curves if one.label == label)


@dataclass(frozen=True)
class Box:
    """A block with its centre and size; `round` for a sum."""

    x: float
    y: float
    words: str
    wide: float = 1.5
    high: float = 0.8
    round: bool = False


@dataclass(frozen=True)
class Wire:
    """A line through points (n, 2) with an arrow at its end; `at` is where its words are."""

    points: tuple[tuple[float, float], ...]
    words: str = ""
    at: tuple[float, float] = (np.nan, np.nan)


@dataclass(frozen=True)
class Diagram:
    """Blocks and wires, the wires with the values of one tick of a run."""

    boxes: tuple[Box, ...]
    wires: tuple[Wire, ...]
    source: str
    note: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """A figure of the source: its number, words for a file's name, a title, and what computes it."""

    number: str
    words: str
    title: str
    make: Callable[[], Plot | Diagram]

    @property
    def stem(self) -> str:
        """Name of its file without ending, such as figure_3_12_bellows_after_release."""
        return f"figure_{self.number.replace('.', '_')}_{self.words}"


def drawn(number: str, words: str, title: str) -> Callable[[Callable[[], Plot | Diagram]], Drawn]:
    """Turn a function that computes a figure's data into the `Drawn`."""

    def made(make: Callable[[], Plot | Diagram]) -> Drawn:
        return Drawn(number, words, title, make)

    return made
