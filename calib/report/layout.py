"""Panels of a figure laid out in a regular grid, from one look at their labels.

matplotlib's constrained layout measures every label twice and solves for all edges at once. A plain grid
needs no solver: each column is as wide as the widest labels beside it leave room for, each row as high.
Where the guess from which the labels were measured was far off, they are measured again. Anything else
(colour bars, equal scales, nested grids) goes the constrained layout's way.
"""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.ticker import NullLocator

from calib.arrays import FloatArray

__all__ = ["PanelLayout"]

_PAD_IN = 3.0 / 72.0
_LABEL_IN, _TICKS_IN, _DEEP_IN, _TITLE_IN = 0.21, 0.42, 0.2, 0.22
"""Guesses of the room that labels take: names of axes, ticks beside and below, titles."""
_CLOSE = 0.08
_MOST_ROUNDS = 3
_WIDE = 100.0
_LEFT, _RIGHT, _BOTTOM, _TOP = range(4)


class PanelLayout(ConstrainedLayoutEngine):
    """Lays out the panels of a figure within `rect`, left, bottom, width and height in its shares.

    `between` is the room between panels, as a share of the figure; legends "outside lower" are heeded.
    """

    def __init__(self, rect: tuple[float, float, float, float], between: float) -> None:
        super().__init__(rect=rect, wspace=between, hspace=between)
        self._rect, self._between = rect, between

    def execute(self, fig: Figure) -> Any:
        """Lay out the panels; called by matplotlib before a figure is drawn."""
        _light_ticks(fig)
        grid = _plain_grid(fig)
        if grid is None:
            return super().execute(fig)
        spots = [(axes, _spot(axes)) for axes in fig.axes]
        renderer = _renderer(fig)
        room = np.array([fig.get_figwidth(), fig.get_figheight()])
        legends = 0.0
        for legend in fig.legends:
            box = legend.get_tightbbox(renderer)
            legends += 0.0 if box is None else float(box.height) / fig.dpi + 2.0 * _PAD_IN
        x, y, width, height = np.array(self._rect) * np.tile(room, 2)
        area = np.array([x, y + legends, width, height - legends])
        margins = np.array([_guess(axes) for axes, _ in spots])
        sizes = _place(grid, spots, margins, area, room, self._between)
        for _ in range(_MOST_ROUNDS):
            margins = np.array([_measured(axes, renderer) for axes, _ in spots])
            before, sizes = sizes, _place(grid, spots, margins, area, room, self._between)
            if np.all(np.abs(sizes - before) < _CLOSE * before):
                break
        return None


def _light_ticks(figure: Figure) -> None:
    """Small ticks of logarithmic scales as one line of marks for each axis instead of an object for each.

    Scales that span little keep theirs, for some of them have labels.
    """
    found = []
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            if axis.get_scale() == "log" and low > 0.0 and high / low > _WIDE:
                at = np.asarray(axis.get_minorticklocs())
                found.append((axes, axis, at[(at >= low) & (at <= high)]))
    for axes, axis, at in found:
        # Panels that share a scale share what places its ticks: set only when all have been asked.
        axis.set_minor_locator(NullLocator())
        if len(at):
            along = axis is axes.xaxis
            mark: Any = TICKDOWN if along else TICKLEFT
            marks = Line2D(
                at if along else np.zeros(len(at)),
                np.zeros(len(at)) if along else at,
                transform=axes.get_xaxis_transform() if along else axes.get_yaxis_transform(),
                linestyle="none",
                marker=mark,
                markersize=mpl.rcParams["xtick.minor.size"],
                markeredgewidth=mpl.rcParams["xtick.minor.width"],
                color=mpl.rcParams["xtick.color"],
                clip_on=False,
                zorder=2.01,
            )
            marks.set_in_layout(False)
            axes.add_artist(marks)


def _renderer(figure: Figure) -> Any:
    canvas: Any = figure.canvas if isinstance(figure.canvas, FigureCanvasAgg) else FigureCanvasAgg(figure)
    return canvas.get_renderer()


def _spot(axes: Axes) -> SubplotSpec:
    spot = axes.get_subplotspec()
    assert spot is not None
    return spot


def _plain_grid(figure: Figure) -> GridSpec | None:
    """The one grid in which all panels lie, None where there is more to it."""
    grids = []
    for axes in figure.axes:
        spot = axes.get_subplotspec()
        if spot is None or not axes.get_in_layout() or axes.get_aspect() != "auto" or axes.child_axes:
            return None
        if axes.name != "rectilinear":
            return None
        grids.append(spot.get_gridspec())
    if not grids or any(grid is not grids[0] for grid in grids) or not isinstance(grids[0], GridSpec):
        return None
    if figure.subfigs or figure.get_suptitle() or figure.get_supxlabel() or figure.get_supylabel():
        return None
    if any(getattr(legend, "_outside_loc", None) != "lower" for legend in figure.legends):
        return None
    return grids[0]


def _guess(axes: Axes) -> tuple[float, float, float, float]:
    """Room for the labels left, right, below and above a panel, in inches, from which there are."""
    x, y = axes.xaxis.get_tick_params(), axes.yaxis.get_tick_params()
    titled = any(axes.get_title(side) for side in ("left", "center", "right"))
    return (
        _TICKS_IN * bool(y.get("labelleft", True)) + _LABEL_IN * bool(axes.get_ylabel()),
        _TICKS_IN * bool(y.get("labelright", False)),
        _DEEP_IN * bool(x.get("labelbottom", True)) + _LABEL_IN * bool(axes.get_xlabel()),
        _TITLE_IN * titled,
    )


def _measured(axes: Axes, renderer: Any) -> tuple[float, float, float, float]:
    """The same, as it is drawn now."""
    inner = axes.get_position(original=True).transformed(axes.figure.transSubfigure)
    outer = axes.get_tightbbox(renderer, for_layout_only=True)
    if outer is None:
        return 0.0, 0.0, 0.0, 0.0
    dpi = axes.figure.dpi
    return (
        max(0.0, inner.x0 - outer.x0) / dpi,
        max(0.0, outer.x1 - inner.x1) / dpi,
        max(0.0, inner.y0 - outer.y0) / dpi,
        max(0.0, outer.y1 - inner.y1) / dpi,
    )


def _shares(given: Any, count: int) -> FloatArray:
    ratios = np.ones(count) if given is None else np.asarray(given, dtype=np.float64)
    return np.asarray(ratios / ratios.sum())


def _tracks(
    parts: list[tuple[int, int, float, float]], ratios: FloatArray, begin: float, length: float, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Where the columns (or rows) begin and end, inside of the labels.

    `parts` are first and last column, and the room before and after it, for each panel.
    """
    count = len(ratios)
    before, after = np.full(count, _PAD_IN), np.full(count, _PAD_IN)
    before[1:] = after[:-1] = max(_PAD_IN, gap / count)
    extra = np.zeros((2, count))
    for first, last, one, other in parts:
        extra[0, first], extra[1, last] = max(extra[0, first], one), max(extra[1, last], other)
    before, after = before + extra[0], after + extra[1]
    # Labels never take all of the room: a panel that has no size cannot be drawn.
    inner = max(length - float(np.sum(before + after)), 0.2 * length) * ratios
    starts = begin + np.cumsum(before + np.concatenate([[0.0], (inner + after)[:-1]]))
    return starts, starts + inner


def _place(
    grid: GridSpec,
    spots: list[tuple[Axes, SubplotSpec]],
    margins: FloatArray,
    area: FloatArray,
    room: FloatArray,
    between: float,
) -> FloatArray:
    """Give all panels their places; returns their sizes (n, 2) in inches."""
    rows, columns = grid.nrows, grid.ncols
    across = [
        (spot.colspan.start, spot.colspan.stop - 1, float(m[_LEFT]), float(m[_RIGHT]))
        for (_, spot), m in zip(spots, margins, strict=True)
    ]
    down = [
        (spot.rowspan.start, spot.rowspan.stop - 1, float(m[_TOP]), float(m[_BOTTOM]))
        for (_, spot), m in zip(spots, margins, strict=True)
    ]
    left, right = _tracks(
        across, _shares(grid.get_width_ratios(), columns), area[0], area[2], between * room[0]
    )
    above, below = _tracks(down, _shares(grid.get_height_ratios(), rows), 0.0, area[3], between * room[1])
    top, bottom = area[1] + area[3] - above, area[1] + area[3] - below
    sizes = []
    for (axes, _), (c0, c1, *_rest), (r0, r1, *_more) in zip(spots, across, down, strict=True):
        size = right[c1] - left[c0], top[r0] - bottom[r1]
        axes.set_position((left[c0] / room[0], bottom[r1] / room[1], size[0] / room[0], size[1] / room[1]))
        # Setting a place takes a panel out of the layout.
        axes.set_in_layout(True)
        sizes.append(size)
    return np.array(sizes)
