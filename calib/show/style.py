"""The look that all figures share, their layout, and how they reach the disk."""

from __future__ import annotations

import io
import math
import textwrap
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.ft2font import FT2Font
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.textpath import text_to_path
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray
from PIL import Image

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown, write_atomically

# ----------------------------------------------------------------------
# Panels of a figure laid out in a regular grid, from one look at their labels.
#
# matplotlib's constrained layout measures every label twice and solves for all edges at once. A plain grid
# needs no solver: each column is as wide as the widest labels beside it leave room for, each row as high.
# Where the guess from which the labels were measured was far off, they are measured again. Anything else
# (colour bars, equal scales, nested grids) goes the constrained layout's way.

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


# ----------------------------------------------------------------------
# The look that all figures share, and how they reach the disk.
#
# Figures are made with `Figure` and the Agg canvas, never with pyplot: no window system, no global
# state, and the same numbers give the same bytes. A machine's own matplotlib settings are set aside
# while a figure is drawn. The hues are Okabe and Ito's, which colour-blind readers can tell apart;
# maps run from light to dark in one hue, so that they survive a black-and-white printer.

INK, GREY, SHADE, RULE = "#1d2730", "#66727d", "#e9ecef", "#d3d8dd"
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE = "#E69F00", "#56B4E9", "#CC79A7"

RISING = LinearSegmentedColormap.from_list(
    "rising", ["#f6fafd", "#dfecf5", "#c0dbec", "#98c5e1", "#68a9d1", "#3f8dc0", "#2173ad"]
)
"""From light to dark with the value, never so dark that black lines drown in it."""

SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
WIDTH_IN = 9.2
_DPI = 130
FOR_EACH_DPI = 90
"""Figures of which there are many are coarser, so that a page has room for them."""
CLOUD: dict[str, Any] = {
    "linestyle": "none", "marker": "s", "markersize": 1.6, "markeredgewidth": 0.0, "antialiased": False
}  # fmt: skip
"""Look of some thousand dots: squares of whole pixels, whose edges take no room in a file."""
_COARSE_SHARE = 0.95
_NEARLY_WHITE = 252
_COLOURS = 128
_STEPS = (32, 64, 96, 128, 160, 192, 224, 248)
"""Where the steps of a channel begin, for figures for each log."""
_LINE_IN = 0.19
_TAG_IN = 2.15
"""Width that is kept free for the verdict."""

_LOOK: dict[Any, Any] = {
    # Names of pictures may hold what looks like a formula.
    "text.parse_math": False,
    "font.family": ["DejaVu Sans"],
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 10.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.facecolor": "white",
    "axes.axisbelow": True,
    "axes.grid": False,
    "axes.formatter.useoffset": False,
    "figure.facecolor": "white",
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "hatch.linewidth": 0.6,
    "hatch.color": "#b9c0c7",
}


@contextmanager
def look() -> Iterator[None]:
    """Draw and save figures inside of this: matplotlib's defaults with the shared look on top."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_LOOK)
        yield


def sheet(height_in: float, title: str, note: str = "", verdict: str = "ok", dpi: int = _DPI) -> Figure:
    """A white figure with a bold title and a line of plain words under it, panels laid out below.

    Parameters
    ----------
    height_in : height of the panels together, without title and note.
    verdict : anything but "ok" is shown in the corner, so that the figure cannot be taken for a good one.
    dpi : `FOR_EACH_DPI` for a figure of which there is one for each log.
    """
    # Letters take whole pixels, so that lines grow longer where those are large.
    wide_in = (WIDTH_IN - 0.3) * (1.0 if dpi == _DPI else _COARSE_SHARE)
    titles = _lines(title, 13, True, wide_in - (verdict != "ok") * _TAG_IN)
    notes = _lines(note, 10, False, wide_in)
    head_in = 0.26 + 0.235 * len(titles) + _LINE_IN * len(notes)
    whole_in = height_in + head_in
    below = (0.008, 0.008, 0.984, 1.0 - head_in / whole_in - 0.008)
    figure = Figure(figsize=(WIDTH_IN, whole_in), dpi=dpi, layout=PanelLayout(below, 0.03))
    left, top = 0.13 / WIDTH_IN, whole_in - 0.12
    figure.text(
        left, top / whole_in, "\n".join(titles), fontsize=13, fontweight="bold", va="top", linespacing=1.3
    )
    figure.text(
        left,
        (top - 0.235 * len(titles) - 0.04) / whole_in,
        "\n".join(notes),
        fontsize=10,
        color=GREY,
        va="top",
        linespacing=1.3,
    )
    if verdict != "ok":
        figure.text(
            1.0 - left,
            (top - 0.03) / whole_in,
            plain(f"verdict: {verdict}"),
            fontsize=10.5,
            fontweight="bold",
            color="white",
            ha="right",
            va="top",
            bbox={"facecolor": VERMILLION, "edgecolor": "none", "boxstyle": "round,pad=0.3"},
        )
    return figure


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
    font = FontProperties(family="DejaVu Sans", size=size, weight="bold" if bold else "normal")
    return float(text_to_path.get_text_width_height_descent(words, font, ismath=False)[0])


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, atomically and without dates: the same figure gives the same bytes.

    Of as few colours as are told apart, which makes it a quarter as large; of the figures for each log
    those are fewer still.
    """
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    rows, columns = canvas.get_width_height()[::-1]
    pixels = np.frombuffer(canvas.buffer_rgba(), dtype=np.uint8).reshape(rows, columns, 4)[:, :, :3]
    few = _few_hues(pixels) if figure.dpi == FOR_EACH_DPI else _few_colours(Image.fromarray(pixels.copy()))
    write_atomically(path, _png(few))
    return path


def _few_colours(picture: Image.Image) -> Image.Image:
    """A picture with a palette."""
    few = picture.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.putpalette(_white_paper(np.array(few.getpalette(), dtype=np.uint8).reshape(-1, 3)))
    return few


def _white_paper(colours: NDArray[np.uint8]) -> bytes:
    """A palette (n, 3) in which what is nearly white is white."""
    return (
        np.where(colours.min(axis=1, keepdims=True) >= _NEARLY_WHITE, 255, colours).astype(np.uint8).tobytes()
    )


def _few_hues(pixels: NDArray[np.uint8]) -> Image.Image:
    """Lines and letters (rows, columns, 3) with few steps from each hue to the paper.

    Colours of one cell of a coarse grid become their mean; the few hues of a figure lie in cells of their
    own, and so does white.
    """
    step = np.searchsorted(_STEPS, np.arange(256), side="right").astype(np.uint16)
    levels = len(_STEPS) + 1
    red, green, blue = (step[pixels[:, :, k]] for k in range(3))
    cell = (red * levels + green) * levels + blue
    count = np.bincount(cell.ravel(), minlength=levels**3)
    used = np.nonzero(count)[0]
    sums = [np.bincount(cell.ravel(), pixels[:, :, k].ravel(), levels**3)[used] for k in range(3)]
    colours = np.stack(sums, axis=-1) / count[used][:, None]
    most = np.argsort(-count[used], kind="stable")[:256]
    nearest = np.argmin(np.sum((colours[:, None] - colours[None, most]) ** 2, axis=-1), axis=1)
    place = np.zeros(levels**3, dtype=np.uint8)
    place[used] = nearest
    few = Image.frombytes("P", (pixels.shape[1], pixels.shape[0]), place[cell].tobytes())
    few.putpalette(_white_paper(np.rint(colours[most]).astype(np.uint8)))
    return few


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="png", compress_level=6)
    return buffer.getvalue()


def figure_folder(folder: Path) -> Path:
    """The folder, made if it is not there. Raises `BadInputError` where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise BadInputError(f"{shown(folder)}: is a file, expected a folder for figures") from error
    except OSError as error:
        raise BadInputError(
            f"{shown(folder)}: no folder for figures can be made here: {error.strerror or error}"
        ) from error
    return folder


@cache
def _font() -> FT2Font:
    return font_manager.get_font(font_manager.findfont("DejaVu Sans"))


def plain(text: str, most: int = 0) -> str:
    """Text of any origin as a label whose every sign can be drawn.

    Signs that the font lacks and control characters are shown as escapes; with `most`, the middle of
    a longer text is left out.
    """
    out = []
    for sign in unicodedata.normalize("NFC", text):
        if not sign.isprintable() or _font().get_char_index(ord(sign)) == 0:
            sign = sign.encode("unicode_escape", "backslashreplace").decode("ascii")
        out.append(sign)
    whole = "".join(out)
    if most and len(whole) > most:
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


def round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a positive value; 1 for others."""
    if not (math.isfinite(value) and value > 0.0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value) + 1e-12)
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9) or step == 1.0)


def view_colours(count: int) -> list[tuple[float, float, float, float]]:
    """One colour for each view in order, dark violet to green: never as light as the paper."""
    shades = mpl.colormaps["viridis"]
    return [shades(0.86 * i / max(count - 1, 1)) for i in range(count)]


def empty(axes: Axes, sentence: str, width: int = 40) -> None:
    """A panel with nothing to draw says why."""
    axes.text(
        0.5,
        0.5,
        "\n".join(textwrap.wrap(sentence, width)),
        transform=axes.transAxes,
        ha="center",
        va="center",
        color=GREY,
        fontsize=11,
        bbox={"facecolor": "white", "edgecolor": RULE, "boxstyle": "round,pad=0.6"},
        zorder=9,
    )
