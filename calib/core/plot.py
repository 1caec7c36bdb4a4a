"""A figure as a value: what is drawn, in the units of its labels, without a drawing library.

A `Figure` is a sheet with a title, a line of plain words and panels. A `Plot` is a panel: marks over a pair
of axes, later ones on top of earlier ones. `calib.show.draw` draws them; other media may draw the same value.

A colour is the name of a hue, or a place from 0 to 1 on a scale for things in an order, such as views.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.core.arrays import AnyArray, FloatArray
from calib.core.files import one_line

Colour = str | float
"""A place, or the name of one of `HUES`."""
KINDS = ("line", "dashed", "dotted", "points", "cloud", "crosses", "pluses", "squares", "diamonds", "marks")
"""How a curve is drawn: as a line, as markers, as dots of a pixel ("cloud") or as short strokes ("marks")."""

Limits = tuple[float, float]

HUES = {
    "ink": ("#1d2730", "#e8ecef"), "grey": ("#66727d", "#a7b2bb"), "silver": ("#b9c0c7", "#6c7780"),
    "shade": ("#e9ecef", "#2f3941"), "blue": ("#0072B2", "#4da9e0"), "sky": ("#56B4E9", "#8fd0f7"),
    "ice": ("#e1eef7", "#20384a"), "green": ("#009E73", "#2fc79b"), "mint": ("#dff1ea", "#1c3d32"),
    "orange": ("#E69F00", "#f0b429"), "ochre": ("#fdeccc", "#4a3a14"), "peach": ("#f6cfb2", "#6b4426"),
    "red": ("#D55E00", "#ff8a4c"), "purple": ("#CC79A7", "#e19cc4"), "grid": ("#d3d8dd", "#36414a"),
    "paper": ("#ffffff", "#1b2227"),
}  # fmt: skip
"""Each hue on a light and on a dark page: Okabe and Ito's, which colour-blind readers can tell apart."""

SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
WIDTH_IN = 9.2
"""Width of every figure, in inches of its letters."""
MOST_POINTS = 3000
"""More points of a curve than this cannot be told apart."""
STEEP = 12.0
"""From this ratio of largest to smallest value on, the levels of a map are spaced by factors."""
_NEARLY_FLAT = 1e-3
"""A map whose values differ by less than this share has no contours worth drawing."""


@dataclass(frozen=True)
class Curve:
    """A line or markers through (n,) values `x`, `y`; NaN leaves a gap.

    Attributes
    ----------
    label : in the legend; empty for none. kind : of `KINDS`.
    colour : (n,) places on the scale colour each marker by itself.
    size : width of the line or size of the markers in points, 0 for what is usual.
    spread : (n,) half lengths of error bars along y, or `across`, along x.
    """

    x: AnyArray
    y: AnyArray
    label: str = ""
    kind: str = "line"
    colour: Colour | FloatArray = "blue"
    size: float = 0.0
    spread: FloatArray | None = None
    across: bool = False


@dataclass(frozen=True)
class Ribbon:
    """What lies between (n,) values `low` and `high` over `x`."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    label: str = ""
    colour: Colour = "shade"


@dataclass(frozen=True)
class Band:
    """A stretch of one axis, over all of the other, with a word in it; hatched where nothing was observed."""

    axis: Literal["x", "y"]
    begin: float
    end: float
    word: str = ""
    colour: Colour = "shade"
    hatched: bool = False


@dataclass(frozen=True)
class Rule:
    """A straight line through the panel at a value of one axis."""

    axis: Literal["x", "y"]
    at: float
    colour: Colour = "grey"
    kind: str = "line"


@dataclass(frozen=True)
class Bars:
    """Bars from 0 to (n,) `length` at (n,) places, `across` from left to right, `width` of them thick."""

    at: AnyArray
    length: AnyArray
    width: float = 0.8
    colour: Colour | FloatArray = "blue"
    across: bool = False


@dataclass(frozen=True)
class Shape:
    """A closed outline through (n, 2) points, filled where it has a colour for that."""

    points: FloatArray
    fill: Colour | None = None
    edge: Colour | None = "ink"
    kind: str = "line"
    opacity: float = 1.0
    hatched: bool = False


@dataclass(frozen=True)
class Field:
    """A map of (rows, columns) values over `x` (columns,) and `y` (rows,), or over such grids of both.

    Attributes
    ----------
    unit : of the values, for sentences. bar : label of a colour bar; empty for none.
    levels : of the contours; by default round ones, by factors where the values span decades and not `even`.
    outlined : levels that lines are drawn at; by default all, with their values written on them.
    scale : lowest and highest value of the colours, for panels that are to be compared.
    """

    x: FloatArray
    y: FloatArray
    values: FloatArray
    unit: str = ""
    bar: str = ""
    levels: FloatArray | None = None
    outlined: FloatArray | None = None
    even: bool = False
    scale: Limits | None = None

    @property
    def known(self) -> FloatArray:
        """The values, NaN where one is not finite."""
        return np.where(np.isfinite(self.values), self.values, np.nan)

    @property
    def nothing(self) -> str:
        """Why there are no contours to draw; empty where there are."""
        finite = self.values[np.isfinite(self.values)]
        if len(finite) == 0:
            unbounded = np.isinf(self.values).any()
            return "not bounded" if unbounded else "nothing to show: no value is known here"
        if float(np.ptp(finite)) <= _NEARLY_FLAT * max(abs(float(finite.max())), 1e-12):
            return f"{number(float(finite.mean()), self.unit)} everywhere"
        return ""


@dataclass(frozen=True)
class Arrows:
    """Arrows from (n, 2) places along (n, 2) vectors, drawn `times` as long, with a key in `unit`."""

    at: FloatArray
    vectors: FloatArray
    times: float = 1.0
    unit: str = ""
    colour: Colour = "blue"

    @property
    def known(self) -> tuple[FloatArray, FloatArray]:
        """Places and vectors (m, 2) of those that are finite."""
        some = np.isfinite(self.at).all(axis=1) & np.isfinite(self.vectors).all(axis=1)
        return self.at[some], self.vectors[some]


@dataclass(frozen=True)
class Text:
    """Words at a place of the axes; `align` says whether it is their "left", "center" or "right"."""

    x: float
    y: float
    words: str
    colour: Colour = "ink"
    align: str = "center"
    bold: bool = False


Mark = Curve | Ribbon | Band | Rule | Bars | Shape | Field | Arrows | Text


@dataclass(frozen=True)
class Plot:
    """A panel.

    Attributes
    ----------
    x, y : names of the axes with their units. Without a name of x its numbers are left to the panel below.
    x_limits, y_limits : shown ranges, None for all that is drawn.
    log : axes, of "xy", with a logarithmic scale, linear from -`linear_within` to it where that is not 0.
    whole : axes whose ticks are whole numbers. grid : axes whose ticks have lines.
    equal : both axes have the same scale. down : y grows downwards.
    names : of the places 0, 1, ... of y, from top to bottom, in place of numbers.
    legend : a corner of the panel for its labels, with `legend_title`; by default they are below the figure.
    corner : words in the lower left corner. empty : a sentence in the middle, why there is nothing.
    bare : without axes.
    """

    x: str = ""
    y: str = ""
    marks: Sequence[Mark] = ()
    title: str = ""
    x_limits: Limits | None = None
    y_limits: Limits | None = None
    log: str = ""
    linear_within: float = 0.0
    whole: str = ""
    grid: str = "xy"
    equal: bool = False
    down: bool = False
    names: tuple[str, ...] = ()
    legend: str = ""
    legend_title: str = ""
    corner: str = ""
    empty: str = ""
    bare: bool = False


@dataclass(frozen=True)
class Figure:
    """A sheet of panels.

    Attributes
    ----------
    title, note : a line in bold, and plain words under it. verdict : shown where it is not "ok".
    height_in : of the panels together, in inches at a width of `WIDTH_IN`.
    columns : in which the panels stand, row by row. mosaic : rows of letters, A for the first panel, where
        panels take several places, such as ("AB", "AC"). widths, heights : of columns and rows, relative.
    """

    title: str
    note: str
    panels: Sequence[Plot]
    height_in: float
    verdict: str = "ok"
    columns: int = 1
    mosaic: tuple[str, ...] = ()
    widths: tuple[float, ...] = ()
    heights: tuple[float, ...] = ()

    @property
    def rows(self) -> tuple[str, ...]:
        """A letter for each place of each row, A for the first panel, "." where there is none."""
        names = "".join(chr(ord("A") + k) for k in range(len(self.panels)))
        names += "." * (-len(names) % self.columns)
        return self.mosaic or tuple(names[k : k + self.columns] for k in range(0, len(names), self.columns))


def judged(figures: Mapping[str, Figure], verdict: str) -> dict[str, Figure]:
    """Figures by their names, each with the verdict on what it shows."""
    return {name: replace(figure, verdict=verdict) for name, figure in figures.items()}


def rectangle(left: float, top: float, width: float, height: float) -> FloatArray:
    """Corners (4, 2)."""
    right, bottom = left + width, top + height
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def circle(x: float, y: float, radius: float) -> FloatArray:
    """Points (181, 2) of a circle."""
    return np.array([x, y]) + radius * _ROUND


def ellipse(x: float, y: float, covariance: FloatArray, sigmas: float) -> FloatArray:
    """Points (181, 2) that are `sigmas` standard deviations of a 2 x 2 covariance away."""
    values, vectors = np.linalg.eigh(covariance)
    root: FloatArray = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.array([x, y]) + sigmas * _ROUND @ root.T


_ROUND = np.column_stack(
    [np.cos(np.linspace(0.0, 2.0 * np.pi, 181)), np.sin(np.linspace(0.0, 2.0 * np.pi, 181))]
)


def histogram(values: FloatArray, bins: int, low: float, high: float, density: bool = False) -> Bars:
    """Bars of how many values (n,) lie in each of `bins` of equal width from `low` to `high`."""
    count, edges = np.histogram(values, bins, (low, high), density=density)
    return Bars(0.5 * (edges[1:] + edges[:-1]), count.astype(np.float64), float(edges[1] - edges[0]))


def spaced(count: int) -> FloatArray:
    """Places (count,) of as many things on the scale of colours."""
    return np.arange(count) / max(count - 1, 1)


def thinned(x: AnyArray, y: AnyArray, most: int = MOST_POINTS) -> tuple[AnyArray, AnyArray]:
    """At most about `most` points of a line (n,): least and largest of each stretch, in their order."""
    size = -(-2 * len(y) // most)
    if size <= 2:
        return x, y
    starts = np.arange(0, len(y), size)
    padded = np.full(len(starts) * size, np.nan)
    padded[: len(y)] = y
    rows = padded.reshape(-1, size)
    least = np.where(np.isnan(rows), np.inf, rows).argmin(axis=1)
    largest = np.where(np.isnan(rows), -np.inf, rows).argmax(axis=1)
    kept = (starts[:, None] + np.sort(np.column_stack([least, largest]), axis=1)).ravel()
    return x[kept], y[kept]


def every(values: AnyArray, most: int = MOST_POINTS) -> AnyArray:
    """Every so many of (n, ...) values, at most `most` of them."""
    return values[:: max(1, -(-len(values) // most))]


def central(values: FloatArray, outside: float, room: float) -> Limits | None:
    """Limits that a few outliers do not widen: without a percentage at both ends, with a share as room."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return None
    low, high = np.percentile(finite, [outside, 100.0 - outside])
    margin = max(room * float(high - low), 1e-9 * float(np.abs(finite).max())) or 1.0
    return float(low) - margin, float(high) + margin


def magnified(reach: float, longest: float) -> float:
    """How many times, to two digits, `longest` fits into `reach`; 1 where there is nothing to magnify."""
    ratio = reach / longest if longest > 0.0 else 1.0
    if not (math.isfinite(ratio) and ratio > 0.0):
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(ratio)) - 1)
    return float(f"{max(math.floor(ratio / unit), 1) * unit:.2g}")


def round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a positive value; 1 for others."""
    if not (math.isfinite(value) and value > 0.0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value) + 1e-12)
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9) or step == 1.0)


def short(text: str, most: int) -> str:
    """Text of any origin as a label of one line, without its middle where it is longer than `most`."""
    whole = one_line(text)
    if len(whole) > most:
        tail = (most - 1) // 2
        whole = f"{whole[: most - 1 - tail]}…{whole[len(whole) - tail :]}"
    return whole


def number(value: float, unit: str = "", digits: int = 3) -> str:
    """A value to `digits` significant digits with its unit, or "not bounded"."""
    if not math.isfinite(value):
        return "not bounded"
    if value == 0.0:
        text = "0"
    elif 1e-4 <= abs(value) < 1e6:
        places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        text = f"{value:.{places}f}"
    else:
        text = f"{value:.{digits - 1}e}"
    return f"{text} {unit}".rstrip()
