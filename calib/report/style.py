"""The look that all figures share, and how they reach the disk.

Figures are made with `Figure` and the Agg canvas, never with pyplot: no window system, no global
state, and the same numbers give the same bytes. A machine's own matplotlib settings are set aside
while a figure is drawn. The hues are Okabe and Ito's, which colour-blind readers can tell apart;
maps run from light to dark in one hue, so that they survive a black-and-white printer.
"""

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
from matplotlib.textpath import text_to_path
from numpy.typing import NDArray
from PIL import Image

from calib.errors import BadInputError
from calib.files import shown, write_atomically
from calib.report.layout import PanelLayout

__all__ = [
    "BLUE",
    "CLOUD",
    "FOR_EACH_DPI",
    "GREEN",
    "GREY",
    "INK",
    "ORANGE",
    "PURPLE",
    "RISING",
    "SHADE",
    "SIGMA",
    "SKY",
    "VERMILLION",
    "WIDTH_IN",
    "empty",
    "figure_folder",
    "look",
    "number",
    "plain",
    "round_down",
    "save",
    "sheet",
    "view_colours",
]

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
