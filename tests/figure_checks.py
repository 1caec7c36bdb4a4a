"""Whether a figure can be read: its words are on the sheet, large enough, and not on top of each other."""

from __future__ import annotations

from itertools import combinations
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.text import Text

from calib.core.plot import Arrows, Bars, Curve, Field, Figure, Mark, Ribbon, Shape
from calib.show.draw import draw, look

WIDTH_PX, SMALLEST_PX = 1000.0, 11.5
"""Width at which a figure has to be legible, and the size of letters that still is."""


def drawn_texts(figure: Drawing) -> list[Text]:
    """All texts that reach the sheet when the figure is drawn."""
    found: list[Text] = []
    draw = Text.draw

    def noted(self: Text, renderer: Any) -> None:
        if self.get_visible() and self.get_text().strip():
            found.append(self)
        draw(self, renderer)

    Text.draw = noted
    try:
        with look():
            FigureCanvasAgg(figure).draw()
    finally:
        Text.draw = draw
    return found


def _box(text: Text) -> tuple[float, float, float, float]:
    """Left, bottom, right, top in pixels; of a slanted text only a square in its middle."""
    box = text.get_window_extent()
    if abs(text.get_rotation() % 90.0) > 1.0:
        u, v = 0.5 * (box.x0 + box.x1), 0.5 * (box.y0 + box.y1)
        return u - 6.0, v - 6.0, u + 6.0, v + 6.0
    return box.x0, box.y0, box.x1, box.y1


def words_of(figure: Figure) -> str:
    """All words of a figure, as they are drawn but without line breaks."""
    return " ".join(text.get_text().replace("\n", " ") for text in drawn_texts(draw(figure)))


def complaints(figure: Figure) -> list[str]:
    """What is wrong with a figure: panels without anything in them, and words that are hard to read."""
    out = [
        f"panel {k} is empty"
        for k, panel in enumerate(figure.panels, start=1)
        if not panel.empty and not any(_something(mark) for mark in panel.marks)
    ]
    return out + complaints_of(draw(figure))


def _something(mark: Mark) -> bool:
    """Whether a mark shows data."""
    values = {Curve: "y", Ribbon: "low", Bars: "length", Shape: "points", Field: "values", Arrows: "vectors"}
    return any(isinstance(mark, kind) and getattr(mark, name).size for kind, name in values.items())


def complaints_of(figure: Drawing) -> list[str]:
    """What makes the words of a drawing hard to read, empty where nothing does."""
    texts = drawn_texts(figure)
    width, height = figure.bbox.width, figure.bbox.height
    out = []
    boxes = [_box(text) for text in texts]
    for text, (left, bottom, right, top) in zip(texts, boxes, strict=True):
        if left < -1 or bottom < -1 or right > width + 1 or top > height + 1:
            out.append(f"{text.get_text()!r} runs off the sheet")
        if text.get_fontsize() * figure.dpi / 72.0 * WIDTH_PX / width < SMALLEST_PX:
            out.append(f"{text.get_text()!r} is too small")
    out += [f"{text.get_text()!r} is a formula in the raw" for text in texts if "\\math" in text.get_text()]
    for (one, a), (other, b) in combinations(zip(texts, boxes, strict=True), 2):
        across = min(a[2], b[2]) - max(a[0], b[0])
        down = min(a[3], b[3]) - max(a[1], b[1])
        if across > 2.0 and down > 2.0:
            out.append(f"{one.get_text()!r} lies on {other.get_text()!r}")
    return out
