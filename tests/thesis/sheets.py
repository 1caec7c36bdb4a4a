"""Draw figures, one file each, with an index of what they were drawn from; each says that it is simulated."""

from __future__ import annotations

import html
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

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
from thesis.book import Drawing
from thesis.plot import Band, Curve, Plot
from thesis.runs import Values

_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)
_STYLES = {"line": "-", "dashed": "--", "dotted": ":"}
_MOST_POINTS = 700
"""Of a curve; a sheet is not finer."""
_STYLE = (
    "body{font:15px/1.4 sans-serif;margin:1.5rem;color:#1d2730}"
    "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(20rem,1fr));gap:1.5rem}"
    "figure{margin:0}img{width:100%;height:auto;border:1px solid #d3d8dd}"
    "figcaption{font-size:13px;color:#66727d}"
)


def _draw_curve(axes: Axes, curve: Curve) -> None:
    thin = slice(None, None, max(len(curve.x) // _MOST_POINTS, 1))
    x, y = curve.x[thin], curve.y[thin]
    look: dict[str, Any] = {
        "color": INK if curve.colour < 0 else _COLOURS[curve.colour % len(_COLOURS)],
        "label": curve.label or None,
    }
    if curve.kind == "bars":
        axes.errorbar(x, y, yerr=curve.spread, fmt="o", markersize=4, capsize=3, **look)
    elif curve.kind == "points":
        axes.plot(x, y, "o", markersize=5.0 if len(x) <= 40 else 2.2, markeredgewidth=0.0, **look)
    else:
        axes.plot(x, y, linestyle=_STYLES[curve.kind], linewidth=1.4, **look)


def _draw_band(axes: Axes, band: Band) -> None:
    low, high = axes.get_ylim() if band.along_y else axes.get_xlim()
    begin, end = max(band.begin, low), min(band.end, high)
    middle = 0.5 * (begin + end)
    if band.along_y:
        axes.axhspan(begin, end, color=SHADE, zorder=0.5, linewidth=0.0)
        across, place, side = axes.get_yaxis_transform(), (0.985, middle), "right"
    else:
        axes.axvspan(begin, end, color=SHADE, zorder=0.5, linewidth=0.0)
        across, place, side = axes.get_xaxis_transform(), (middle, 0.94), "center"
    axes.text(*place, band.word, transform=across, ha=side, va="center", color=GREY)


def _draw_plot(figure: Figure, plot: Plot) -> None:
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
    else:
        axes.margins(x=0.01)
    if plot.down:
        axes.invert_yaxis()
    axes.autoscale_view()
    for band in plot.bands:
        _draw_band(axes, band)
    axes.set(xlabel=plot.x, ylabel=plot.y)
    axes.grid(True)
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        columns = min(len(labels), 5)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, handlelength=1.8)


def _draw_scheme(figure: Figure, drawing: Drawing, values: Values) -> None:
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
    for wire, *label in drawing.wires:
        points = np.array(wire)
        axes.plot(points[:-1, 0], points[:-1, 1], color=INK, linewidth=1.2)
        axes.annotate("", points[-1], points[-2], arrowprops=arrow)
        if label:
            words, at = label
            axes.text(*at, words.format(**values), ha="center", va="center", fontsize=9, color=BLUE)
    for (x, y), (wide, high), words in drawing.boxes:
        corner = (x - 0.5 * wide, y - 0.5 * high)
        axes.add_patch(Rectangle(corner, wide, high, facecolor=SHADE, edgecolor=INK))
        axes.text(x, y, words, ha="center", va="center", fontsize=9.5)
    for centre, sign in drawing.sums:
        axes.add_patch(Circle(centre, 0.3, facecolor="white", edgecolor=INK))
        axes.text(*centre, sign, ha="center", va="center", fontsize=9.5)
    x, y = np.concatenate([wire for wire, *_ in drawing.wires]).T
    axes.set_xlim(x.min() - 0.4, x.max() + 0.4)
    axes.set_ylim(y.min() - 0.6, y.max() + 0.9)


def titled(drawing: Drawing) -> str:
    """The title with the figure's number."""
    return f"Figure {drawing.number}, simulated. {drawing.title}"


def draw(drawing: Drawing, plot: Plot | None, values: Values) -> Figure:
    """The sheet of a figure: number, title and "simulated" above, notes under them, curves below."""
    note = plain(f"Simulated: {drawing.source}. {drawing.note.format(**values)}")
    figure = sheet(5.6 if plot is not None and plot.equal else 4.2, titled(drawing), note)
    if plot is None:
        _draw_scheme(figure, drawing, values)
    else:
        _draw_plot(figure, plot)
    return figure


def _svg(figure: Figure, drawing: Drawing) -> bytes:
    """A figure as SVG, without dates and with names of its parts that do not change."""
    buffer = io.BytesIO()
    FigureCanvasSVG(figure)
    about = {"Title": titled(drawing), "Description": f"Simulated: {drawing.source}."}
    with mpl.rc_context({"svg.hashsalt": drawing.path.removesuffix(".svg"), "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, **about})
    return buffer.getvalue()


def _index_page(drawings: Sequence[Drawing]) -> str:
    parts = []
    for one in drawings:
        title, source = html.escape(one.title), html.escape(one.source)
        parts.append(
            f'<figure><a href="{one.path}"><img src="{one.path}" alt="{title}" loading="lazy"></a>'
            f"<figcaption><b>{one.number}</b> {title}. Drawn from: {source}.</figcaption></figure>"
        )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Figures, simulated</title>'
        f"<style>{_STYLE}</style><h1>Figures of the source, drawn from simulated runs</h1>"
        f"<p>{len(drawings)} figures. None shows a measurement.</p><main>{''.join(parts)}</main></html>\n"
    )


def write_figures(folder: Path, drawings: Sequence[Drawing]) -> list[Path]:
    """Compute and draw figures into a folder made if needed, with `figures.json` and `index.html`.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    rows: list[dict[str, Any]] = []
    with look():
        for one in drawings:
            plot, values = one.make()
            write_atomically(folder / one.path, _svg(draw(one, plot, values), one))
            rows.append(
                {
                    "number": one.number, "title": one.title, "file": one.path, "simulated": True,
                    "drawn_from": one.source, "note": one.note.format(**values), "values": values,
                }
            )  # fmt: skip
    table, page = folder / "figures.json", folder / "index.html"
    write_atomically(table, (json.dumps({"schema": 1, "figures": rows}, indent=1) + "\n").encode())
    write_atomically(page, _index_page(drawings).encode())
    return [*(folder / one.path for one in drawings), table, page]
