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
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.ft2font import FT2Font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.textpath import text_to_path

from calib.errors import BadInputError
from calib.files import shown, write_atomically

__all__ = [
    "BLUE",
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


def sheet(height_in: float, title: str, note: str = "", verdict: str = "ok") -> Figure:
    """A white figure with a bold title and a line of plain words under it, panels laid out below.

    Parameters
    ----------
    height_in : height of the panels together, without title and note.
    verdict : anything but "ok" is shown in the corner, so that the figure cannot be taken for a good one.
    """
    wide_in = WIDTH_IN - 0.3
    titles = _lines(
        title,
        FontProperties(family="DejaVu Sans", size=13, weight="bold"),
        wide_in - (verdict != "ok") * _TAG_IN,
    )
    notes = _lines(note, FontProperties(family="DejaVu Sans", size=10), wide_in)
    head_in = 0.26 + 0.235 * len(titles) + _LINE_IN * len(notes)
    whole_in = height_in + head_in
    below = (0.008, 0.008, 0.984, 1.0 - head_in / whole_in - 0.008)
    panels = ConstrainedLayoutEngine(rect=below, wspace=0.03, hspace=0.03)
    figure = Figure(figsize=(WIDTH_IN, whole_in), dpi=_DPI, layout=panels)
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


def _lines(words: str, font: FontProperties, width_in: float) -> list[str]:
    """The words broken into lines that fit into a width, as the font is drawn."""
    lines: list[str] = []
    for word in words.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if (
            lines
            and text_to_path.get_text_width_height_descent(longer, font, ismath=False)[0] > 72.0 * width_in
        ):
            lines.append(word)
        else:
            lines[-1:] = [longer]
    return lines


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, atomically and without dates: the same figure gives the same bytes."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    panels = figure.get_layout_engine()
    if panels is not None:
        # Laid out here, the figure is not drawn once more for the layout's sake.
        panels.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())
    return path


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
