"""Draw figures, one file each, with an index of what they were drawn from; each says that it is simulated."""

from __future__ import annotations

import html
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG

from calib.core.plot import Arrows, Curve, Figure, Mark, Plot, Shape, Text, circle, every, rectangle
from calib.core.writing import make_folder, write_atomically
from calib.show.draw import draw, look
from thesis.book import Drawing
from thesis.runs import Values

_MOST_POINTS = 700
"""Of a curve; a sheet is not finer."""
_STYLE = (
    "body{font:15px/1.4 sans-serif;margin:1.5rem;color:#1d2730}"
    "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(20rem,1fr));gap:1.5rem}"
    "figure{margin:0}img{width:100%;height:auto;border:1px solid #d3d8dd}"
    "figcaption{font-size:13px;color:#66727d}"
)


def _scheme(drawing: Drawing, values: Values) -> Plot:
    """Boxes, sums and wires, the wires with values of a run."""
    marks: list[Mark] = []
    for wire, *label in drawing.wires:
        points = np.array(wire, dtype=np.float64)
        before, end = points[-2:-1], points[-1:]
        marks.append(Curve(points[:-1, 0], points[:-1, 1], colour="ink"))
        marks.append(Arrows(before, end - before, colour="ink"))
        if label:
            words, (x, y) = label
            marks.append(Text(x, y, words.format(**values), "blue"))
    for (x, y), (wide, high), words in drawing.boxes:
        marks.append(Shape(rectangle(x - 0.5 * wide, y - 0.5 * high, wide, high)))
        marks.append(Text(x, y, words))
    for (x, y), sign in drawing.sums:
        marks += [Shape(circle(x, y, 0.3)), Text(x, y, sign)]
    low, high = (
        edge(np.concatenate([wire for wire, *_ in drawing.wires]), axis=0) for edge in (np.min, np.max)
    )
    limits = ((low[0] - 0.4, high[0] + 0.4), (low[1] - 0.6, high[1] + 0.9))
    return Plot("", "", marks, "", *limits, equal=True, bare=True)


def _thin(mark: Mark) -> Mark:
    if not isinstance(mark, Curve):
        return mark
    spread = None if mark.spread is None else every(mark.spread, _MOST_POINTS)
    return replace(mark, x=every(mark.x, _MOST_POINTS), y=every(mark.y, _MOST_POINTS), spread=spread)


def titled(drawing: Drawing) -> str:
    """The title with the figure's number."""
    return f"Figure {drawing.number}, simulated. {drawing.title}"


def figure(drawing: Drawing, plot: Plot | None, values: Values) -> Figure:
    """The sheet of a figure: number, title and "simulated" above, notes under them, curves below."""
    note = f"Simulated: {drawing.source}. {drawing.note.format(**values)}"
    panel = _scheme(drawing, values) if plot is None else replace(plot, marks=tuple(map(_thin, plot.marks)))
    return Figure(titled(drawing), note, (panel,), 5.6 if plot is not None and plot.equal else 4.2)


def _svg(drawn: Figure, drawing: Drawing) -> bytes:
    """A figure as SVG, without dates and with names of its parts that do not change."""
    buffer = io.BytesIO()
    sheet = draw(drawn)
    FigureCanvasSVG(sheet)
    about = {"Title": titled(drawing), "Description": f"Simulated: {drawing.source}."}
    with look(), mpl.rc_context({"svg.hashsalt": drawing.path.removesuffix(".svg"), "svg.fonttype": "path"}):
        sheet.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, **about})
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
    make_folder(folder)
    rows: list[dict[str, Any]] = []
    for one in drawings:
        plot, values = one.make()
        write_atomically(folder / one.path, _svg(figure(one, plot, values), one))
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
