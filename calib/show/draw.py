"""Figures on paper: the look that all of them share, how each mark of `calib.core.plot` is drawn, and files.

Figures are made with matplotlib's `Figure` and its Agg canvas, never with pyplot: no window system, no global
state, and the same numbers give the same bytes. A machine's own matplotlib settings are set aside while a
figure is drawn. The hues are Okabe and Ito's, which colour-blind readers can tell apart; maps run from light
to dark in one hue, so that they survive a black-and-white printer.
"""

from __future__ import annotations

import io
import math
import textwrap
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from itertools import count
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager, patheffects
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure as Drawing
from matplotlib.font_manager import FontProperties
from matplotlib.ft2font import FT2Font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.textpath import text_to_path
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from calib.core import plot
from calib.core.arrays import FloatArray
from calib.core.result import Result
from calib.core.writing import Kind, begins, make_folder, write_atomically

HUES = {name: light for name, (light, _) in plot.HUES.items()}
_HATCHES: dict[object, tuple[str, str]] = {"ochre": ("//", HUES["orange"]), "shade": ("///", HUES["silver"])}
_INK, _GREY = HUES["ink"], HUES["grey"]
_RISING = LinearSegmentedColormap.from_list(
    "rising", ["#f6fafd", "#dfecf5", "#c0dbec", "#98c5e1", "#68a9d1", "#3f8dc0", "#2173ad"]
)
"""From light to dark with the value, never so dark that black lines drown in it."""

_FONT = "DejaVu Sans"
_DPI = 130
_LINE_IN, _TITLE_IN = 0.19, 0.235
_TAG_IN = 2.15
"""Width that is kept free for the verdict."""
_HALO = (patheffects.withStroke(linewidth=3.0, foreground="white"),)

_LOOK: dict[Any, Any] = {
    # Names of pictures may hold what looks like a formula.
    "text.parse_math": False,
    "font.family": [_FONT],
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelcolor": _INK,
    "axes.edgecolor": _GREY,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.xmargin": 0.02,
    "grid.color": "#d3d8dd",
    "grid.linewidth": 0.6,
    "text.color": _INK,
    "xtick.color": _GREY,
    "ytick.color": _GREY,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
}


@contextmanager
def look() -> Iterator[None]:
    """Draw and save figures inside of this: matplotlib's defaults with the shared look on top."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_LOOK)
        yield


def draw(figure: plot.Figure) -> Drawing:
    """A figure drawn by matplotlib: white, title and note above, panels below, labels under them."""
    with look():
        wide_in = plot.WIDTH_IN - 0.3
        bad = figure.verdict != "ok"
        titles = _lines(plain(figure.title), 13, True, wide_in - bad * _TAG_IN)
        notes = _lines(plain(figure.note), 10, False, wide_in)
        head_in = 0.26 + _TITLE_IN * len(titles) + _LINE_IN * len(notes)
        high_in = figure.height_in + head_in
        below = (0.008, 0.008, 0.984, 1.0 - head_in / high_in - 0.008)
        layout = ConstrainedLayoutEngine(rect=below, wspace=0.03, hspace=0.03)
        drawing = Drawing(figsize=(plot.WIDTH_IN, high_in), dpi=_DPI, layout=layout, facecolor="white")
        left, top = 0.13 / plot.WIDTH_IN, 1.0 - 0.12 / high_in
        drawing.text(left, top, "\n".join(titles), fontsize=13, weight="bold", va="top", linespacing=1.3)
        top -= (_TITLE_IN * len(titles) + 0.04) / high_in
        drawing.text(left, top, "\n".join(notes), color=_GREY, va="top", linespacing=1.3)
        if bad:
            drawing.text(
                1.0 - left, 1.0 - 0.15 / high_in, plain(f"verdict: {figure.verdict}"), fontsize=10.5,
                weight="bold", color="white", ha="right", va="top",
                bbox={"facecolor": HUES["red"], "edgecolor": "none", "boxstyle": "round,pad=0.3"},
            )  # fmt: skip
        placed = _places(drawing, figure)
        for axes, panel in zip(placed, figure.panels, strict=True):
            _panel(axes, panel)
        _legend(drawing, [axes for axes in placed if axes.get_legend() is None])
        if any(panel.equal for panel in figure.panels):
            # Room for labels is first measured around panels that do not have their shape yet.
            layout.execute(drawing)
        return drawing


def plots(result: Result) -> dict[str, Drawing]:
    """The figures of a result by their names, drawn: `plots(rig.camera)["coverage"]`.

    Raises `BadInputError` for a section that was read from a file.
    """
    from calib.stages import stage

    # Reading the evidence first says so where there is none.
    made = stage(result.stage) if result.evidence is not None and result.stage else None
    figures = {} if made is None or made.plots is None else made.plots(result)
    return {name.split("_", 1)[-1]: draw(figure) for name, figure in figures.items()}


FIGURE = Kind("a figure", (".png",), begins(b"\x89PNG"))


def save(figure: plot.Figure, path: Path) -> Path:
    """Write a figure as PNG, atomically and without dates: the same figure gives the same bytes."""
    canvas: Any = FigureCanvasAgg(draw(figure))
    buffer = io.BytesIO()
    with look():
        canvas.print_png(buffer, metadata={"Software": None})
    write_atomically(path, buffer.getvalue(), FIGURE)
    return path


def write_figures(folder: Path, figures: Mapping[str, plot.Figure]) -> list[Path]:
    """Draw figures into files of their names in a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    make_folder(folder)
    return [save(figure, folder / f"{name}.png") for name, figure in figures.items()]


# ----------------------------------------------------------------------
# Panels.


def _places(drawing: Drawing, figure: plot.Figure) -> list[Axes]:
    """Axes for each panel, in the figure's order."""
    placed = drawing.subplot_mosaic(
        "\n".join(figure.rows), width_ratios=figure.widths or None, height_ratios=figure.heights or None
    )
    return [placed[name] for name in sorted(placed)]


def _panel(axes: Axes, panel: plot.Plot) -> None:
    """Scales and limits first, for some marks are placed by them."""
    axes.set_title(plain(panel.title))
    axes.set_xlabel(plain(panel.x))
    axes.set_ylabel(plain(panel.y))
    scales: tuple[tuple[Literal["x", "y"], Any], ...] = (("x", axes.set_xscale), ("y", axes.set_yscale))
    for name, scale in scales:
        if name in panel.log and panel.linear_within:
            scale("symlog", linthresh=panel.linear_within)
        elif name in panel.log:
            scale("log")
        if name in panel.grid and not panel.empty:
            axes.grid(axis=name)
    if panel.x_limits is not None:
        axes.set_xlim(panel.x_limits)
    if panel.names:
        axes.set_yticks(range(len(panel.names)), [plain(name) for name in panel.names])
        axes.set_ylim(-0.6, max(len(panel.names), 3) - 0.4)
        axes.tick_params(axis="y", length=0)
    if panel.y_limits is not None:
        axes.set_ylim(panel.y_limits)
    if panel.down or panel.names:
        axes.invert_yaxis()
    if panel.equal:
        fixed = panel.x_limits is not None and panel.y_limits is not None
        axes.set_aspect("equal", adjustable="box" if fixed else "datalim", anchor="N")
    for order, mark in zip(count(1), panel.marks):
        _mark(axes, mark, 2.0 + 0.01 * order)
    wide, high = _size_in(axes)
    for name, axis, most in (("x", axes.xaxis, 1.5 * wide), ("y", axes.yaxis, 3.0 * high)):
        if not (name == "y" and panel.names):
            _ticks(axis, panel.linear_within, name in panel.whole, int(np.clip(round(most), 5, 10)))
    if not panel.x:
        axes.tick_params(axis="x", labelbottom=False)
    if panel.bare:
        axes.set_axis_off()
    if panel.legend:
        place: Any = panel.legend
        columns = 1 + (len(axes.get_legend_handles_labels()[1]) > 3)
        title = panel.legend_title or None
        axes.legend(loc=place, ncols=columns, title=title, title_fontsize=9.0, handlelength=1.4)
    if panel.corner:
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9}
        words = plain(panel.corner)
        axes.text(0.04, 0.04, words, transform=axes.transAxes, fontsize=9, va="bottom", bbox=box, zorder=8.0)
    if panel.empty:
        _empty(axes, panel.empty)
        axes.set_xticks([])
        axes.set_yticks([])


def _size_in(axes: Any) -> tuple[float, float]:
    """Width and height of a panel in inches, about, with the labels beside it."""
    figure = axes.figure
    cell = axes.get_subplotspec().get_position(figure)
    wide, high = cell.width * figure.get_figwidth(), cell.height * figure.get_figheight()
    if axes.get_aspect() != "auto" and axes.get_adjustable() == "box":
        shape = abs(np.ptp(axes.get_xlim()) / np.ptp(axes.get_ylim()))
        wide, high = min(wide, high * shape), min(high, wide / shape)
    return wide, high


def _empty(axes: Axes, sentence: str) -> None:
    """A panel with nothing to draw says why."""
    words = "\n".join(textwrap.wrap(plain(sentence), int(np.clip(9.0 * _size_in(axes)[0], 12, 40))))
    axes.text(
        0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=_GREY, fontsize=11,
        zorder=9.0, bbox={"facecolor": "white", "edgecolor": "#d3d8dd", "boxstyle": "round,pad=0.6"},
    )  # fmt: skip


def _ticks(axis: Axis, linear_within: float, whole: bool, most: int) -> None:
    """Ticks at round numbers, written as plain ones."""
    low, high = sorted(axis.get_view_interval())
    if axis.get_scale() == "linear":
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10], integer=whole))
        return
    if axis.get_scale() == "symlog":
        least, reach = math.floor(math.log10(linear_within)), max(-low, high)
        tens = [10.0**k for k in range(least, 9) if 10.0**k <= 1.3 * reach]
        axis.set_ticks([*(-ten for ten in reversed(tens)), 0.0, *tens])
        axis.minorticks_off()
    else:
        some = (1.0,) if high > 40.0 * low else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(10.0, subs=some, numticks=most + 2))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _: f"{value:g}")


def _legend(drawing: Drawing, panels: list[Axes]) -> None:
    """What the panels' colours mean, each once, under all of them."""
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    widest_in = max(_width_pt(label, 9.0, False) for label in handles) / 72.0 + 0.55
    most = max(1, min(7, int((plot.WIDTH_IN - 0.3) / widest_in)))
    below = drawing.legend(
        handles.values(), handles, loc="outside lower center", ncols=min(most, len(handles)), handlelength=1.6
    )
    for mark in below.legend_handles:
        if isinstance(mark, Line2D):
            mark.set_markersize(max(4.0, mark.get_markersize()))


# ----------------------------------------------------------------------
# Marks.

_STYLES = {"line": "-", "dashed": "--", "dotted": ":"}
_MARKERS = {
    "points": "o", "cloud": "s", "crosses": "x", "pluses": "+", "squares": "s", "diamonds": "D", "marks": "|"
}  # fmt: skip


def colour(which: plot.Colour) -> Any:
    """A hue by its name, or a shade from dark violet to green, never as light as the paper."""
    return HUES[which] if isinstance(which, str) else mpl.colormaps["viridis"](0.86 * which)


def _colours(which: plot.Colour | FloatArray) -> Any:
    return [colour(float(one)) for one in which] if isinstance(which, np.ndarray) else colour(which)


def _mark(axes: Axes, mark: plot.Mark, z: float) -> None:
    match mark:
        case plot.Curve():
            _curve(axes, mark, z)
        case plot.Ribbon():
            axes.fill_between(
                mark.x, mark.low, mark.high, color=colour(mark.colour), linewidth=0.0,
                label=plain(mark.label) or None, zorder=1.0,
            )  # fmt: skip
        case plot.Band():
            _band(axes, mark)
        case plot.Rule():
            line = axes.axvline if mark.axis == "x" else axes.axhline
            strong = 0.8 if mark.colour in ("grey", "ink") and mark.kind == "line" else 1.4
            line(mark.at, color=colour(mark.colour), linestyle=_STYLES[mark.kind], linewidth=strong, zorder=z)
        case plot.Bars():
            shade: Any = {"color": _colours(mark.colour), "edgecolor": "white", "linewidth": 0.5, "zorder": z}
            if mark.across:
                axes.barh(mark.at, mark.length, height=mark.width, **shade)
            else:
                axes.bar(mark.at, mark.length, width=mark.width, **shade)
        case plot.Shape():
            _shape(axes, mark, z)
        case plot.Field():
            _field(axes, mark)
        case plot.Arrows():
            _arrows(axes, mark, z)
        case plot.Text():
            axes.text(
                mark.x, mark.y, plain(mark.words), color=colour(mark.colour), ha=mark.align, va="center",
                fontsize=9.0, weight="bold" if mark.bold else "normal", zorder=z,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
            )  # fmt: skip


def _curve(axes: Axes, curve: plot.Curve, z: float) -> None:
    label = plain(curve.label) or None
    if curve.kind in _STYLES:
        style: Any = {"linestyle": _STYLES[curve.kind], "linewidth": curve.size or 1.3}
    elif curve.kind == "cloud":
        # Squares of whole pixels, whose edges take no room in a file.
        style = {"marker": "s", "markersize": curve.size or 1.6, "markeredgewidth": 0.0, "antialiased": False}
    else:
        size = curve.size or 4.0
        open_ = curve.kind in ("crosses", "pluses", "marks")
        style = {"marker": _MARKERS[curve.kind], "markersize": size, "markeredgewidth": 1.4 if open_ else 0.4}
        if not open_:
            style["markeredgecolor"] = "white" if size >= 5.0 else "none"
    if isinstance(curve.colour, np.ndarray):
        edge = style["markeredgecolor"]
        axes.scatter(
            curve.x, curve.y, s=style["markersize"] ** 2, c=_colours(curve.colour), marker=style["marker"],
            linewidths=0.4, edgecolors=edge, label=label, zorder=z,
        )  # fmt: skip
        return
    if curve.kind not in _STYLES:
        style["linestyle"] = "none"
    if curve.spread is None:
        axes.plot(curve.x, curve.y, color=colour(curve.colour), label=label, zorder=z, **style)
        return
    bars: Any = {"xerr" if curve.across else "yerr": curve.spread}
    axes.errorbar(
        curve.x, curve.y, **bars, color=colour(curve.colour), label=label, zorder=z, capsize=2.5,
        elinewidth=0.9, **style,
    )  # fmt: skip


def _band(axes: Axes, band: plot.Band) -> None:
    hatch, edge = _HATCHES[band.colour] if band.hatched else (None, "none")
    fill: Any = {"facecolor": colour(band.colour), "edgecolor": edge, "hatch": hatch, "linewidth": 0.0}
    span = axes.axvspan if band.axis == "x" else axes.axhspan
    span(band.begin, band.end, zorder=0.4, **fill)
    if band.word:
        low, high = sorted(axes.get_xlim() if band.axis == "x" else axes.get_ylim())
        middle = 0.5 * (max(band.begin, low) + min(band.end, high))
        if band.axis == "x":
            place: Any = {"x": middle, "y": 0.94, "ha": "center", "transform": axes.get_xaxis_transform()}
        else:
            place = {"x": 0.985, "y": middle, "ha": "right", "transform": axes.get_yaxis_transform()}
        axes.text(s=plain(band.word), va="center", color=_GREY, **place)


def _shape(axes: Axes, shape: plot.Shape, z: float) -> None:
    hatch, edge = None, "none" if shape.edge is None else colour(shape.edge)
    if shape.hatched:
        hatch, edge = _HATCHES[shape.fill]
    face = "none" if shape.fill is None else (*mpl.colors.to_rgb(colour(shape.fill)), shape.opacity)
    outline = Polygon(
        shape.points, closed=True, facecolor=face, edgecolor=edge, hatch=hatch, zorder=z,
        linestyle=_STYLES[shape.kind], linewidth=0.5 if shape.hatched else 1.2,
    )  # fmt: skip
    axes.add_patch(outline)


def _arrows(axes: Axes, arrows: plot.Arrows, z: float) -> None:
    """Arrows, and above the upper right corner, level with the title, one of a round length."""
    at, vectors = arrows.known
    if len(at) == 0:
        return
    drawn = axes.quiver(
        *at.T, *vectors.T, angles="xy", scale_units="xy", scale=1.0 / arrows.times, units="inches",
        width=0.013, headwidth=4.0, headlength=4.5, headaxislength=4.0, minlength=0.6,
        color=colour(arrows.colour), zorder=z,
    )  # fmt: skip
    longest = float(np.quantile(np.hypot(*vectors.T), 0.98))
    wide, high = _size_in(axes)
    # Above a narrow panel there is no room beside the title, which tells how long the arrows are.
    if arrows.unit and longest > 0.0 and wide > 0.7 * high:
        length = plot.round_down(1.3 * longest)
        left, right = sorted(axes.get_xlim())
        start = 1.0 - length * arrows.times / (right - left)
        axes.quiverkey(
            drawn, start, 1.0 + 0.17 / high, length, f"{length:g} {arrows.unit}", labelpos="W", labelsep=0.05
        )


# ----------------------------------------------------------------------
# Maps.


def _field(axes: Axes, field: plot.Field) -> None:
    """Filled contours with their values on the lines, hatched where unknown; a sentence if there are none."""
    known = field.known
    finite = known[np.isfinite(known)]
    x, y = field.x, field.y
    if len(finite) < known.size:
        whole = plot.rectangle(float(x.min()), float(y.min()), float(np.ptp(x)), float(np.ptp(y)))
        _shape(axes, plot.Shape(whole, "shade", hatched=True), 0.4)
    if field.nothing:
        flat = np.where(np.isfinite(known), 0.25, np.nan)
        axes.pcolormesh(x, y, flat, cmap=_RISING, vmin=0.0, vmax=1.0, zorder=1.0)
        _empty(axes, field.nothing)
        return
    levels = contour_levels(finite, even=field.even) if field.levels is None else field.levels
    norm: Normalize = BoundaryNorm(levels, _RISING.N)
    if field.scale is not None:
        low, high = field.scale
        norm = LogNorm(low, high) if 0.0 < low < high / plot.STEEP else Normalize(0.0, high)
        levels = np.unique(np.maximum(levels, 0.5 * low)) if isinstance(norm, LogNorm) else levels
    filled = axes.contourf(x, y, known, levels=levels, cmap=_RISING, norm=norm, zorder=1.0)
    inside = levels[(levels > finite.min()) & (levels < finite.max())]
    outlined = inside if field.outlined is None else field.outlined
    if len(outlined):
        lines = axes.contour(x, y, known, levels=outlined, colors=_INK, linewidths=0.7, zorder=1.5)
        if field.outlined is None:
            _label(axes, lines)
    if field.bar:
        bar = axes.figure.colorbar(filled, ax=axes, fraction=0.045, pad=0.02, shrink=0.92)
        bar.set_ticks(levels.tolist(), labels=[f"{level:g}" for level in levels])
        bar.set_label(plain(field.bar))


def contour_levels(values: FloatArray, *, even: bool = False) -> FloatArray:
    """Round levels that enclose all finite values: by 1-2-5 where these span decades, else evenly spaced."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    if low > 0.0 and high > plot.STEEP * low and not even:
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        steps = ("1", "2", "5") if high / low < 3e3 else ("1",)
        # One decade more on both sides: logarithms of round numbers may be off by their last digit.
        levels = [float(f"{step}e{k}") for k in range(first - 1, last + 2) for step in steps]
        inside = [level for level in levels if low < level < high]
        under = [level for level in levels if level <= low]
        over = [level for level in levels if level >= high]
        return np.array([under[-1], *inside, over[0]])
    return np.asarray(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high), dtype=np.float64)


def _label(axes: Axes, lines: ContourSet) -> None:
    """Values on contour lines, left out where they would run into each other or over the border."""
    corner, other = axes.transAxes.transform([(0.0, 0.0), (1.0, 1.0)])
    kept: list[tuple[float, float]] = []
    for text in axes.clabel(lines, inline=False, fontsize=9, fmt=lambda value: f"{value:g}"):
        # As a share of the panel, which the layout moves but hardly reshapes.
        u, v = (axes.transData.transform(text.get_position()) - corner) / (other - corner)
        if not (0.06 < u < 0.94 and 0.06 < v < 0.94) or any(
            abs(u - a) < 0.07 and abs(v - b) < 0.06 for a, b in kept
        ):
            text.remove()
            continue
        kept.append((u, v))
        text.set(path_effects=_HALO, color=_INK, zorder=3.0)


# ----------------------------------------------------------------------
# Words.


def _lines(words: str, size: float, bold: bool, width_in: float) -> list[str]:
    """The words broken into lines that fit into a width, as the font is drawn."""
    lines: list[str] = []
    for word in words.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _width_pt(longer, size, bold) > 72.0 * width_in:
            lines.append(word)
        else:
            lines[-1:] = [longer]
    return lines


@lru_cache(2000)
def _width_pt(words: str, size: float, bold: bool) -> float:
    font = FontProperties(family=_FONT, size=size, weight="bold" if bold else "normal")
    return float(text_to_path.get_text_width_height_descent(words, font, ismath=False)[0])


@cache
def _font() -> FT2Font:
    return font_manager.get_font(font_manager.findfont(_FONT))


def plain(text: str) -> str:
    """Text of any origin as one whose every sign can be drawn; those that the font lacks become escapes."""
    out = []
    for sign in unicodedata.normalize("NFC", text):
        if sign != "\n" and (not sign.isprintable() or _font().get_char_index(ord(sign)) == 0):
            sign = sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        out.append(sign)
    return "".join(out)
