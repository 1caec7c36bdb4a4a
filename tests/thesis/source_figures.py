"""Figures that correspond to those of the source, one file each, with an index of what they were drawn from.

The data come from `thesis.album`; every figure says that it is simulated.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch

from calib.core.files import write_atomically
from calib.show.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SHADE,
    SKY,
    VERMILLION,
    figure_folder,
    look,
    plain,
    sheet,
)
from thesis.drawn import Curve, Diagram, Drawn, Plot
from thesis.source_index import Entry, write_index

__all__ = ["source_figure", "write_source_figures"]

_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)
_STYLES = {"line": "-", "dashed": "--", "dotted": ":"}
_HIGH_IN = 4.2
_SQUARE_IN = 5.6
_MOST_POINTS = 700
"""Of a curve; a sheet is not finer."""


def _thinned(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    step = max(len(curve.x) // _MOST_POINTS, 1)
    return curve.x[::step], curve.y[::step]


def _draw_curve(axes: Axes, curve: Curve) -> None:
    colour = INK if curve.colour < 0 else _COLOURS[curve.colour % len(_COLOURS)]
    label = curve.label or None
    x, y = _thinned(curve)
    if curve.kind == "bars":
        axes.errorbar(x, y, yerr=curve.spread, fmt="o", color=colour, markersize=4, capsize=3, label=label)
    elif curve.kind == "points":
        size = 5.0 if len(x) <= 40 else 2.2
        axes.plot(x, y, "o", color=colour, markersize=size, markeredgewidth=0.0, label=label)
    else:
        axes.plot(x, y, color=colour, linestyle=_STYLES[curve.kind], linewidth=1.4, label=label)


def _bands(axes: Axes, plot: Plot) -> None:
    for band in plot.bands:
        low, high = axes.get_ylim() if band.along_y else axes.get_xlim()
        begin, end = max(band.begin, low), min(band.end, high)
        middle = 0.5 * (begin + end)
        if band.along_y:
            axes.axhspan(begin, end, color=SHADE, zorder=0.5, linewidth=0.0)
            across, place = axes.get_yaxis_transform(), (0.985, middle)
        else:
            axes.axvspan(begin, end, color=SHADE, zorder=0.5, linewidth=0.0)
            across, place = axes.get_xaxis_transform(), (middle, 0.94)
        side = "right" if band.along_y else "center"
        axes.text(*place, band.word, transform=across, ha=side, va="center", color=GREY)


def _plot(figure: Figure, plot: Plot) -> None:
    axes = figure.subplots()
    for curve in plot.curves:
        _draw_curve(axes, curve)
    if plot.log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    if plot.y_limits is not None:
        axes.set_ylim(*plot.y_limits)
    if plot.equal:
        axes.set_aspect("equal", adjustable="datalim")
    if plot.down:
        axes.invert_yaxis()
    if not plot.equal:
        axes.margins(x=0.01)
    axes.autoscale_view()
    _bands(axes, plot)
    axes.set_xlabel(plot.x)
    axes.set_ylabel(plot.y)
    axes.grid(True)
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        figure.legend(
            handles, labels, loc="outside lower center", ncols=min(len(labels), 5), handlelength=1.8
        )


def _diagram(figure: Figure, diagram: Diagram) -> None:
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    for wire in diagram.wires:
        points = np.array(wire.points)
        axes.plot(points[:-1, 0], points[:-1, 1], color=INK, linewidth=1.2)
        axes.annotate(
            "",
            points[-1],
            points[-2],
            arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0},
        )
        if wire.words:
            axes.text(*wire.at, wire.words, ha="center", va="center", fontsize=9, color=BLUE)
    for box in diagram.boxes:
        if box.round:
            axes.add_patch(Circle((box.x, box.y), 0.5 * box.high, facecolor="white", edgecolor=INK))
        else:
            corner = (box.x - 0.5 * box.wide, box.y - 0.5 * box.high)
            axes.add_patch(
                FancyBboxPatch(
                    corner, box.wide, box.high, boxstyle="square,pad=0", facecolor=SHADE, edgecolor=INK
                )
            )
        axes.text(box.x, box.y, box.words, ha="center", va="center", fontsize=9.5)
    x = [p[0] for w in diagram.wires for p in w.points]
    y = [p[1] for w in diagram.wires for p in w.points]
    axes.set_xlim(min(x) - 0.4, max(x) + 0.4)
    axes.set_ylim(min(y) - 0.6, max(y) + 0.9)


def source_figure(one: Drawn, data: Plot | Diagram) -> Figure:
    """The sheet of a figure: number, title and "simulated" above, notes under them, curves below."""
    note = f"Simulated: {data.source}. {data.note}".strip()
    high = _SQUARE_IN if isinstance(data, Plot) and data.equal else _HIGH_IN
    figure = sheet(high, f"Figure {one.number}, simulated. {one.title}", plain(note))
    if isinstance(data, Plot):
        _plot(figure, data)
    else:
        _diagram(figure, data)
    return figure


def _save(figure: Figure, path: Path, title: str, words: str) -> Path:
    """Write a figure as SVG, without dates and with names of its parts that do not change."""
    buffer = io.BytesIO()
    FigureCanvasSVG(figure)
    told = {"Date": None, "Creator": None, "Title": title, "Description": words}
    with mpl.rc_context({"svg.hashsalt": path.stem, "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata=told)
    write_atomically(path, buffer.getvalue())
    return path


def write_source_figures(
    folder: Path, album: Sequence[Drawn], progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Compute and draw figures into a folder made if needed, with `figures.json` and `index.html`.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    entries: list[Entry] = []
    paths = []
    with look():
        for done, one in enumerate(album):
            if progress is not None:
                progress(done, len(album))
            data = one.make()
            title, words = f"Figure {one.number}, simulated. {one.title}", f"Simulated: {data.source}."
            path = _save(source_figure(one, data), folder / f"{one.stem}.svg", title, words)
            paths.append(path)
            entries.append(
                Entry(one.number, one.title, path.name, data.source, data.note, dict(data.numbers))
            )
    return [*paths, *write_index(folder, entries)]
