"""A figure as data: curves and bands over one pair of axes, in the units of the labels."""

from __future__ import annotations

from dataclasses import dataclass

from calib.core.arrays import FloatArray

KINDS = ("line", "dashed", "dotted", "points", "bars")


@dataclass(frozen=True)
class Curve:
    """A curve.

    Attributes
    ----------
    label : in the legend; empty for none.
    x, y : (n,) values.
    kind : of `KINDS`; "bars" are points with error bars.
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
    log_y, equal, down : kinds of axes; `down` lets y grow downwards.
    y_limits : shown range of y, None for all.
    """

    x: str
    y: str
    curves: tuple[Curve, ...]
    bands: tuple[Band, ...] = ()
    log_y: bool = False
    equal: bool = False
    down: bool = False
    y_limits: tuple[float, float] | None = None
