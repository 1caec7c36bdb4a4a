"""Figures of a validation: what was measured, with the curves of the models over it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.report.style import (
    BLUE,
    CLOUD,
    FOR_EACH_DPI,
    GREEN,
    GREY,
    ORANGE,
    figure_folder,
    look,
    number,
    plain,
    save,
    sheet,
)
from calib.validating import IMPROVED, NOMINAL, ORIGINAL, QUANTITIES, Comparison

__all__ = ["model_figure", "write_validate_figures"]

_MOST_S = 20.0
_COLOURS = {ORIGINAL: ORANGE, NOMINAL: GREEN, IMPROVED: BLUE}
_SCALES = {
    "q1": (1e3, "length of bellows 1 (mm)"),
    "q2": (1e3, "length of bellows 2 (mm)"),
    "phi": (1.0, "angle (rad)"),
}


def _known(one: Comparison) -> list[str]:
    """Models whose motion lasts as long as the log."""
    return [name for name, curves in one.simulated.items() if np.isfinite(curves).all()]


def _note(one: Comparison) -> str:
    parts = [
        f"{name} {number(1e3 * errors['q1'].rms, 'mm')}, {number(1e3 * errors['q2'].rms, 'mm')}, "
        f"{number(errors['phi'].rms, 'rad')}"
        for name, errors in ((name, one.errors[name]) for name in _known(one))
    ]
    parts += [f"{name} unknown, it ends before the log" for name in one.simulated if name not in _known(one)]
    return (
        "Points: from the log. Lines: simulated from commands and start alone. RMS of q1, q2 and phi: "
        + "; ".join(parts)
        + "."
    )


def model_figure(one: Comparison) -> Figure:
    """Bellows and angle of one log, measured and simulated, and beside them the errors."""
    figure = sheet(6.6, f"Model against log: {plain(one.name, 50)}", _note(one), dpi=FOR_EACH_DPI)
    panels = figure.subplots(3, 2, squeeze=False, sharex=True, gridspec_kw={"width_ratios": [1.5, 1.0]})
    some = one.t_s <= _MOST_S
    t = one.t_s[some]
    for row, name in enumerate(QUANTITIES):
        scale, unit = _SCALES[name]
        seen = scale * one.measured[some, row]
        left, right = panels[row]
        left.plot(t, seen, color=GREY, label="measured", **CLOUD)
        for model in _known(one):
            told = scale * one.simulated[model][some, row]
            left.plot(t, told, color=_COLOURS[model], linewidth=1.1, label=model)
            right.plot(t, seen - told, color=_COLOURS[model], linewidth=0.9)
        left.set_ylabel(unit)
        for axes in (left, right):
            axes.grid(True)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.yaxis.set_major_locator(MaxNLocator(4))
    panels[0, 0].set_title("Curves")
    panels[0, 1].set_title("Measured less simulated")
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, markerscale=2.0
    )
    return figure


def write_validate_figures(folder: Path, compared: Sequence[Comparison]) -> list[Path]:
    """Write a figure for each log and return their paths."""
    figure_folder(folder)
    paths = []
    with look():
        for k, one in enumerate(compared, start=1):
            name = "validate_model.png" if len(compared) == 1 else f"validate_model_{k}.png"
            paths.append(save(model_figure(one), folder / name))
    return paths
