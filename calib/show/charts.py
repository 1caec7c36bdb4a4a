"""Figures for a page that can be touched: data for plotly.js, which the page's own script draws.

A chart is a JSON document: the figure's words, and for each panel its place, axes, traces, shapes and notes
in plotly's terms. Numbers are in base64, each array once: steps of 16 bits from the least to the largest, or
32-bit floats for logarithmic axes. A colour is "@blue", by the name of a hue, or "@0.4", a place on the
scale; the script knows what they are on a light and on a dark page.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np

from calib.core import plot
from calib.core.arrays import AnyArray, FloatArray, runs
from calib.core.writing import make_folder, write_atomically

MOST_POINTS = 400
"""Points of a line, the least and the largest of each stretch: a chart is about twice as many px wide."""
_MOST_DOTS = 900
_MOST_CELLS = 1500
"""Of a map."""
_FEW = 7.0
"""Span of whole numbers below which each has its tick."""
_PX_PER_IN = 80.0
_DASHES = {"line": "solid", "dashed": "dash", "dotted": "dot"}
_SYMBOLS = {
    "points": "circle", "cloud": "square", "crosses": "x-thin-open", "pluses": "cross-thin-open",
    "squares": "square", "diamonds": "diamond", "marks": "line-ns-open",
}  # fmt: skip


def library() -> str:
    """Text of plotly.js, from the package, which takes long to import."""
    found = distribution("plotly").locate_file("plotly/package_data/plotly.min.js")
    return Path(str(found)).read_text(encoding="utf-8")


def write_charts(folder: Path, figures: Mapping[str, plot.Figure]) -> None:
    """Write a chart of each figure into a folder, by its name."""
    if figures:
        make_folder(folder)
    for name, figure in figures.items():
        text = json.dumps(chart(figure), ensure_ascii=True, separators=(",", ":"), allow_nan=False)
        write_atomically(folder / f"{name}.json", text)


def chart(figure: plot.Figure) -> dict[str, Any]:
    """A figure as a JSON document."""
    arrays = _Arrays()
    cells = _cells(figure)
    placed = list(zip(figure.panels, cells, strict=True))
    panels = [_Panel(arrays, panel, cell).document() for panel, cell in placed]
    for k, (panel, cell) in enumerate(placed):
        below = [
            other
            for other, place in enumerate(cells)
            if place[:2] == cell[:2] and place[2] >= cell[3] - 1e-9 and figure.panels[other].x
        ]
        # Panels without a name of x have that of the next one below.
        panels[k]["follows"] = below[0] if not panel.x and below and not panel.bare else None
    return {
        "title": figure.title,
        "note": figure.note,
        "verdict": figure.verdict,
        "height": round(figure.height_in * _PX_PER_IN),
        "panels": panels,
        "arrays": arrays.all,
    }


class _Arrays:
    """Arrays of a chart, each once."""

    def __init__(self) -> None:
        self.all: list[list[Any]] = []
        self._places: dict[tuple[Any, ...], int] = {}

    def __call__(self, values: AnyArray, exact: bool = False) -> dict[str, int]:
        """A reference to an array (n,) or (rows, n); -32768 stands for what is no number."""
        array = np.asarray(values, dtype=np.float64)
        known = np.isfinite(array)
        least, most = (float(array[known].min()), float(array[known].max())) if known.any() else (0.0, 0.0)
        step = (most - least) / 65534.0
        if exact:
            entry: tuple[Any, ...] = ("f4", _text(array, "<f4"))
        else:
            steps = np.full(array.shape, -32768.0)
            steps[known] = (np.rint((array[known] - least) / step) if step > 0.0 else 0.0) - 32767.0
            entry = ("i2", _text(steps, "<i2"), least, step)
        if entry not in self._places:
            self._places[entry] = len(self.all)
            self.all.append(list(entry))
        return {"$": self._places[entry]} | ({"row": array.shape[1]} if array.ndim == 2 else {})


def _text(array: FloatArray, kind: str) -> str:
    return base64.b64encode(array.astype(kind).tobytes()).decode("ascii")


def _cells(figure: plot.Figure) -> list[tuple[float, float, float, float]]:
    """Left, right, top and bottom of each panel as shares of the sheet."""
    letters = np.array([list(row) for row in figure.rows])
    wide = _edges(figure.widths or (1.0,) * letters.shape[1])
    high = _edges(figure.heights or (1.0,) * letters.shape[0])
    places = [np.nonzero(letters == letter) for letter in np.unique(letters[letters != "."])]
    return [(wide[j.min()], wide[j.max() + 1], high[i.min()], high[i.max() + 1]) for i, j in places]


def _edges(sizes: Sequence[float]) -> list[float]:
    return [0.0, *(np.cumsum(sizes) / np.sum(sizes)).tolist()]


def _words(text: str) -> str:
    """Text of any origin as plotly writes it: its signs and lines, and no element."""
    safe = html.escape(text.encode("utf-8", "backslashreplace").decode("utf-8"), quote=False)
    return safe.replace("\n", "<br>")


def _colour(which: plot.Colour) -> str:
    return f"@{which}" if isinstance(which, str) else f"@{which:.3f}"


def _placed(what: Mapping[str, Any]) -> bool:
    """Whether a shape or a note has a place that is a number."""
    return all(math.isfinite(value) for value in what.values() if isinstance(value, float))


class _Panel:
    """A panel on its way into a document."""

    def __init__(self, arrays: _Arrays, panel: plot.Plot, cell: tuple[float, float, float, float]) -> None:
        self._arrays, self._panel, self._cell = arrays, panel, cell
        self._traces: list[dict[str, Any]] = []
        self._shapes: list[dict[str, Any]] = []
        self._notes: list[dict[str, Any]] = []

    def document(self) -> dict[str, Any]:
        panel = self._panel
        for mark in panel.marks:
            self._mark(mark)
        if panel.corner:
            corner = {"xref": "x domain", "yref": "y domain", "x": 0.03, "y": 0.03}
            self._notes.append(
                corner | {"xanchor": "left", "yanchor": "bottom", "text": _words(panel.corner)}
            )
        if panel.empty:
            self._sentence(panel.empty)
        return {
            "title": _words(panel.title),
            "cell": [round(edge, 5) for edge in self._cell],
            "x": self._axis("x"),
            "y": self._axis("y"),
            "equal": panel.equal,
            "bare": panel.bare or bool(panel.empty),
            "legend": _words(panel.legend_title) if panel.legend else None,
            "traces": self._traces,
            "shapes": [one for one in self._shapes if _placed(one)],
            "notes": [one for one in self._notes if _placed(one)],
        }

    def _axis(self, name: str) -> dict[str, Any]:
        panel = self._panel
        title, limits = (panel.x, panel.x_limits) if name == "x" else (panel.y, panel.y_limits)
        axis: dict[str, Any] = {"title": {"text": _words(title)}, "showgrid": name in panel.grid}
        if self._by_asinh(name):
            least = math.floor(math.log10(panel.linear_within))
            tens = [10.0**k for k in range(least, 9)]
            ticks = [*(-ten for ten in reversed(tens)), 0.0, *tens]
            axis |= {
                "tickvals": self._at(name, np.array(ticks)).tolist(),
                "ticktext": [f"{t:g}" for t in ticks],
            }
        elif name in panel.log:
            axis["type"] = "log"
        if name in panel.whole:
            # Between few values there would be ticks at halves, under the numbers of their neighbours.
            axis |= {"tickformat": "d"} | ({"dtick": 1} if self._span(name) < _FEW else {})
        if limits is not None and np.isfinite(limits).all():
            ends = self._at(name, np.array(limits))
            axis["range"] = (np.log10(ends) if axis.get("type") == "log" else ends).tolist()
        if name == "y" and panel.names:
            axis |= {
                "tickvals": list(range(len(panel.names))),
                "ticktext": [_words(one) for one in panel.names],
            }
            axis["range"] = axis.get("range") or [max(len(panel.names), 3) - 0.4, -0.6]
        elif name == "y" and panel.down:
            axis |= {"range": axis["range"][::-1]} if "range" in axis else {"autorange": "reversed"}
        return axis

    def _span(self, name: str) -> float:
        """Of the values of bars and curves along an axis; bars begin at 0."""
        values = [np.zeros(0)]
        for mark in self._panel.marks:
            if isinstance(mark, plot.Curve):
                values.append(np.asarray(mark.x if name == "x" else mark.y, dtype=np.float64))
            elif isinstance(mark, plot.Bars):
                values.append(np.append(mark.length, 0.0) if (name == "x") == mark.across else mark.at)
        along = np.concatenate(values)
        along = along[np.isfinite(along)]
        return float(np.ptp(along)) if len(along) else 0.0

    def _by_asinh(self, name: str) -> bool:
        return name in self._panel.log and self._panel.linear_within > 0.0

    def _at(self, name: str, values: AnyArray) -> FloatArray:
        """Values where the axis has them; a scale that is linear about zero is that of asinh."""
        out = np.asarray(values, dtype=np.float64)
        return np.asarray(np.arcsinh(out / self._panel.linear_within)) if self._by_asinh(name) else out

    def _xy(self, x: AnyArray, y: AnyArray) -> dict[str, Any]:
        ends = (("x", x), ("y", y))
        return {name: self._arrays(self._at(name, values), self._logs(name)) for name, values in ends}

    def _sentence(self, words: str) -> None:
        middle = {"xref": "x domain", "yref": "y domain", "x": 0.5, "y": 0.5, "text": _words(words)}
        self._notes.append(middle | {"font": {"color": "@grey"}})

    def _mark(self, mark: plot.Mark) -> None:
        match mark:
            case plot.Curve():
                self._curve(mark)
            case plot.Ribbon():
                self._ribbon(mark)
            case plot.Band():
                self._band(mark)
            case plot.Rule():
                self._rule(mark)
            case plot.Bars():
                self._bars(mark)
            case plot.Shape():
                self._shape(mark)
            case plot.Field():
                self._field(mark)
            case plot.Arrows():
                self._arrows(mark)
            case plot.Text():
                at = {"xref": "x", "yref": "y", "text": f"<b>{_words(mark.words)}</b>" if mark.bold else ""}
                at["text"] = at["text"] or _words(mark.words)
                x, y = float(self._at("x", np.array(mark.x))), float(self._at("y", np.array(mark.y)))
                x, y = (math.log10(v) if self._logs(n) and v > 0.0 else v for n, v in (("x", x), ("y", y)))
                font = {"color": _colour(mark.colour)}
                self._notes.append(at | {"x": x, "y": y, "xanchor": mark.align, "font": font})

    def _logs(self, name: str) -> bool:
        return name in self._panel.log and not self._by_asinh(name)

    def _curve(self, curve: plot.Curve) -> None:
        x, y, spread = np.asarray(curve.x), np.asarray(curve.y), curve.spread
        line = curve.kind in _DASHES
        trace: dict[str, Any] = {"type": "scatter", "name": _words(curve.label)}
        hue, shade = (
            (curve.colour, "@blue") if isinstance(curve.colour, np.ndarray) else (None, _colour(curve.colour))
        )
        if line:
            if bool(np.all(x[1:] >= x[:-1])) and spread is None:
                x, y = plot.thinned(x, y, MOST_POINTS)
            elif spread is None:
                x, y = plot.every(x, MOST_POINTS), plot.every(y, MOST_POINTS)
            trace |= {"mode": "lines"}
            trace["line"] = {"color": shade, "width": curve.size or 1.4, "dash": _DASHES[curve.kind]}
        else:
            x, y = plot.every(x, _MOST_DOTS), plot.every(y, _MOST_DOTS)
            spread = None if spread is None else plot.every(spread, _MOST_DOTS)
            hue = None if hue is None else plot.every(hue, _MOST_DOTS)
            size = 1.3 * (curve.size or (2.0 if curve.kind == "cloud" else 4.0))
            marker: dict[str, Any] = {"symbol": _SYMBOLS[curve.kind], "size": size}
            if hue is None:
                marker["color"] = shade
            else:
                marker |= {"color": self._arrays(hue), "colorscale": "Viridis", "cmin": 0.0, "cmax": 1.16}
            if curve.kind in ("crosses", "pluses", "marks"):
                marker["line"] = {"width": 1.4, "color": marker["color"]}
            trace |= {"mode": "markers", "marker": marker}
        trace |= self._xy(x, y)
        if spread is not None:
            bars = {"type": "data", "array": self._arrays(spread), "thickness": 1.0, "width": 2.5}
            trace["error_x" if curve.across else "error_y"] = bars
        self._traces.append(trace)

    def _ribbon(self, ribbon: plot.Ribbon) -> None:
        """Down along the lower edge and back along the upper one, stretches of numbers each by itself."""
        x, low, high = ribbon.x, ribbon.low, ribbon.high
        size = -(-len(x) // MOST_POINTS)
        if size > 1:
            starts = np.arange(0, len(x), size)
            x = x[starts]
            low, high = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
        known = np.isfinite(low) & np.isfinite(high)
        label = _words(ribbon.label)
        for begin, end in runs(known):
            part = slice(begin, end)
            trace = {
                "type": "scatter",
                "mode": "lines",
                "line": {"width": 0},
                "name": label,
                "fill": "toself",
            }
            around = np.concatenate([x[part], x[part][::-1]]), np.concatenate([low[part], high[part][::-1]])
            fill = {"fillcolor": _colour(ribbon.colour), "hoverinfo": "skip"}
            self._traces.append(trace | fill | self._xy(*around))
            label = ""

    def _band(self, band: plot.Band) -> None:
        begin, end = self._at(band.axis, np.array([band.begin, band.end])).tolist()
        other = "y" if band.axis == "x" else "x"
        shape = {"type": "rect", f"{band.axis}0": begin, f"{band.axis}1": end, f"{other}0": 0, f"{other}1": 1}
        shape |= {f"{band.axis}ref": band.axis, f"{other}ref": f"{other} domain", "line": {"width": 0}}
        shade = {"fillcolor": _colour(band.colour), "layer": "below", "opacity": 0.6 if band.hatched else 1.0}
        self._shapes.append(shape | shade)
        if band.word:
            limits = self._panel.x_limits if band.axis == "x" else self._panel.y_limits
            low, high = (begin, end) if limits is None else self._at(band.axis, np.array(limits)).tolist()
            low, high = sorted((low, high))
            middle = 0.5 * (max(begin, low) + min(end, high))
            if self._logs(band.axis):
                middle = math.log10(middle) if middle > 0.0 else 0.0
            at: dict[str, Any] = {"xref": "x domain", "yref": "y domain", "x": 0.98, "y": 0.97}
            at |= {f"{band.axis}ref": band.axis, band.axis: middle, "text": _words(band.word)}
            at |= {"xanchor": "right"} if band.axis == "y" else {"yanchor": "top"}
            self._notes.append(at | {"font": {"color": "@grey"}})

    def _rule(self, rule: plot.Rule) -> None:
        at = float(self._at(rule.axis, np.array(rule.at)))
        other = "y" if rule.axis == "x" else "x"
        shape = {"type": "line", f"{rule.axis}0": at, f"{rule.axis}1": at, f"{other}0": 0, f"{other}1": 1}
        shape |= {f"{rule.axis}ref": rule.axis, f"{other}ref": f"{other} domain"}
        self._shapes.append(
            shape | {"line": {"color": _colour(rule.colour), "width": 1.2, "dash": _DASHES[rule.kind]}}
        )

    def _bars(self, bars: plot.Bars) -> None:
        hue = bars.colour
        shade: Any = self._arrays(hue) if isinstance(hue, np.ndarray) else _colour(hue)
        marker: dict[str, Any] = {"color": shade}
        if isinstance(hue, np.ndarray):
            marker |= {"colorscale": "Viridis", "cmin": 0.0, "cmax": 1.16}
        at, length = np.asarray(bars.at, dtype=np.float64), np.asarray(bars.length, dtype=np.float64)
        ends = self._xy(length, at) if bars.across else self._xy(at, length)
        kind = {"type": "bar", "orientation": "h" if bars.across else "v", "width": bars.width, "name": ""}
        self._traces.append(kind | ends | {"marker": marker})

    def _shape(self, shape: plot.Shape) -> None:
        points = np.vstack([shape.points, shape.points[:1]])
        edge = "rgba(0,0,0,0)" if shape.edge is None else _colour(shape.edge)
        line = {"color": edge, "width": 1.2, "dash": _DASHES[shape.kind]}
        trace = {"type": "scatter", "mode": "lines", "name": "", "line": line, "hoverinfo": "skip"}
        if shape.fill is not None:
            trace |= {"fill": "toself", "fillcolor": f"{_colour(shape.fill)}/{shape.opacity:g}"}
        self._traces.append(trace | self._xy(points[:, 0], points[:, 1]))

    def _field(self, field: plot.Field) -> None:
        """A map coloured by its values; by their logarithms where they span decades."""
        step = max(1, math.ceil(math.sqrt(field.values.size / _MOST_CELLS)))
        x, y = (axis[..., ::step] if axis.ndim == 1 else axis[::step, ::step] for axis in (field.x, field.y))
        values = field.known[::step, ::step]
        if field.nothing or not np.isfinite(values).any():
            self._sentence(field.nothing or "no value is known here")
            return
        low, high = field.scale or (float(np.nanmin(values)), float(np.nanmax(values)))
        steep = low > 0.0 and high > plot.STEEP * low and not field.even
        shades = np.log10(values) if steep else values
        ends = (math.log10(low), math.log10(high)) if steep else (low, high)
        colours: dict[str, Any] = {"colorscale": "@rising", "showscale": bool(field.bar)}
        if field.bar:
            tens = [m * 10.0**k for k in range(-9, 9) for m in (1.0, 2.0, 5.0) if low <= m * 10.0**k <= high]
            bar: dict[str, Any] = {"title": {"text": _words(field.bar), "side": "right"}, "thickness": 12}
            if steep:
                bar |= {"tickvals": [math.log10(t) for t in tens], "ticktext": [f"{t:g}" for t in tens]}
            colours["colorbar"] = bar
        told = f"%{{text}} {_words(field.unit)}<extra></extra>"
        if x.ndim == 1 and y.ndim == 1:
            trace: dict[str, Any] = {"type": "contour", "name": "", "zmin": ends[0], "zmax": ends[1]}
            trace |= {"x": self._arrays(x), "y": self._arrays(y), "hovertemplate": told}
            trace |= {"z": self._arrays(shades), "text": "@powers" if steep else "@values"}
            trace |= {
                "contours": {"coloring": "heatmap"},
                "ncontours": 9,
                "line": {"width": 0.6, "color": "@ink"},
            }
            self._traces.append(trace | colours)
            return
        x, y = np.broadcast_arrays(x, y)
        known = np.isfinite(values)
        marker: dict[str, Any] = {"symbol": "square", "size": 9, "color": self._arrays(shades[known])}
        marker |= {"cmin": ends[0], "cmax": ends[1]} | colours
        dots: dict[str, Any] = {"type": "scatter", "mode": "markers", "name": "", "marker": marker}
        dots |= {"hovertemplate": told, "text": "@powers" if steep else "@values"}
        self._traces.append(dots | self._xy(x[known], y[known]))

    def _arrows(self, arrows: plot.Arrows) -> None:
        at, along = arrows.known
        if len(at) == 0:
            return
        ends = np.stack([at, at + arrows.times * along, np.full(at.shape, np.nan)], axis=1).reshape(-1, 2)
        heads = np.tile([0.0, 7.0, 0.0], len(at))
        hue = _colour(arrows.colour)
        marker = {"symbol": "arrow", "angleref": "previous", "size": self._arrays(heads), "color": hue}
        trace = {"type": "scatter", "mode": "lines+markers", "line": {"color": hue, "width": 1.4}, "name": ""}
        lengths = np.hypot(*along.T)
        text = np.repeat([f"{length:.3g} {_words(arrows.unit)}" for length in lengths.tolist()], 3).tolist()
        told = {"text": text, "hovertemplate": "%{text}<extra></extra>"}
        self._traces.append(trace | {"marker": marker} | told | self._xy(ends[:, 0], ends[:, 1]))
