"""Panels in a grid: nothing cut or overlapping, like the constrained layout, and small ticks that stay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from figure_checks import complaints
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from calib.arrays import FloatArray
from calib.report.layout import PanelLayout
from calib.report.style import look, sheet

RECT = (0.008, 0.008, 0.984, 0.85)


def _grid(rows: int, columns: int, legend: bool = False, **options: Any) -> Figure:
    """Panels with curves of quite different sizes, so that their labels are, too."""
    figure = sheet(1.9 * rows, "A title", "a note")
    panels = figure.subplots(rows, columns, squeeze=False, **options)
    for k, axes in enumerate(panels.flat):
        x = np.linspace(0.0, 10.0 ** (k % 4), 50)
        axes.plot(x, 10.0 ** (2 - k) * np.sin(x), label=f"curve {k}")
        axes.set_ylabel("a value (unit)")
        axes.grid(True)
        if k < columns:
            axes.set_title("above")
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    if legend:
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _places(figure: Figure) -> FloatArray:
    return np.array([axes.get_position(original=True).extents for axes in figure.axes])


@pytest.mark.parametrize(
    ("rows", "columns", "legend", "options"),
    [
        (1, 1, False, {}),
        (3, 1, True, {"sharex": True}),
        (2, 3, True, {}),
        (3, 2, True, {"sharex": True, "gridspec_kw": {"width_ratios": [1.5, 1.0]}}),
    ],
)
def test_words_lie_on_the_sheet_and_apart_as_with_the_constrained_layout(
    rows: int, columns: int, legend: bool, options: dict[str, Any]
) -> None:
    with look():
        figure, other = (_grid(rows, columns, legend, **options) for _ in range(2))
        assert isinstance(figure.get_layout_engine(), PanelLayout)
        assert complaints(figure) == []
        head = 1.0 - other.get_layout_engine()._rect[3]
        rect = (0.008, 0.008, 0.984, 1.0 - head)
        other.set_layout_engine(ConstrainedLayoutEngine(rect=rect, wspace=0.03, hspace=0.03))
        FigureCanvasAgg(other).draw()
    ours, theirs = _places(figure), _places(other)
    assert np.max(np.abs(ours - theirs)) < 0.04
    widths = ours[:, 2] - ours[:, 0]
    ratios = np.tile(options.get("gridspec_kw", {}).get("width_ratios", [1.0] * columns), rows)
    assert np.allclose(widths / widths[0], ratios / ratios[0])


def test_a_second_drawing_changes_nothing() -> None:
    with look():
        figure = _grid(2, 2, True)
        FigureCanvasAgg(figure).draw()
        before = _places(figure)
        FigureCanvasAgg(figure).draw()
    assert np.allclose(before, _places(figure), atol=2e-3)


def test_colour_bars_and_equal_scales_go_the_other_way() -> None:
    with look():
        figure = sheet(3.0, "A map")
        left, right = figure.subplots(1, 2)
        drawn = left.imshow(np.arange(12.0).reshape(3, 4))
        figure.colorbar(drawn, ax=left)
        right.plot([0.0, 1.0], [0.0, 1.0])
        right.set_aspect("equal")
        assert complaints(figure) == []


def test_small_ticks_of_a_wide_scale_become_marks_at_the_same_places() -> None:
    with look():
        figure = sheet(4.0, "Scales")
        wide, narrow = figure.subplots(1, 2)
        for axes, most in ((wide, 1e4), (narrow, 5.0)):
            axes.plot([1.0, most], [1.0, 2.0])
            axes.set_xscale("log")
        wanted = wide.xaxis.get_minorticklocs()
        low, high = wide.get_xlim()
        FigureCanvasAgg(figure).draw()
    assert len(wide.xaxis.get_minorticklocs()) == 0
    (marks,) = [line for line in wide.artists + wide.lines if len(line.get_xdata()) > 2]
    assert np.array_equal(marks.get_xdata(), wanted[(wanted >= low) & (wanted <= high)])
    assert len(narrow.xaxis.get_minorticklocs()) > 0
