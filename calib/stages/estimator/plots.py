"""Figures of a replay: states with their 2-sigma bands, innovations, and the baseline beside them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.core.arrays import FloatArray
from calib.show.style import (
    BLUE,
    CLOUD,
    FOR_EACH_DPI,
    GREY,
    INK,
    ORANGE,
    SHADE,
    SIGMA,
    VERMILLION,
    empty,
    figure_folder,
    look,
    plain,
    save,
    sheet,
)
from calib.stages.estimator.kinematic import OUT

if TYPE_CHECKING:
    from calib.stages.estimator.replay import Replayed

_BASELINE = len(OUT)
_TRUTH = len(OUT) + 3
_MOST_POINTS = 3000
"""Of each sensor's innovations in the figure; more of them only make it black."""
_QUANTITIES = (
    ("bellows 1 (mm)", "q1_m", "sigma_q1_m", 0, 1e3),
    ("bellows 2 (mm)", "q2_m", "sigma_q2_m", 1, 1e3),
    ("angle (degrees)", "phi_rad", "sigma_phi_rad", 2, float(np.degrees(1.0))),
)


def _named(trace: FloatArray, name: str) -> FloatArray:
    return np.asarray(trace[:, OUT.index(name)])


def _limits(axes: Axes, values: FloatArray) -> None:
    """Limits by what happens after the start, whose bands would press all else flat."""
    finite = values[np.isfinite(values)]
    if len(finite):
        low, high = np.percentile(finite, [0.5, 99.5])
        room = max(0.25 * (high - low), 1e-6)
        axes.set_ylim(float(low - room), float(high + room))


def state_figure(result: Replayed) -> Figure:
    """Lengths and angle over time with their bands, the baseline and the truth where it is known."""
    trace = result.trace
    note = (
        f"Blue: estimate with its 2{SIGMA} band. Orange: the source's pipeline with its 1 Hz low-pass. "
        "Black: truth, where the log knows it. Red marks: pictures that were gated out."
    )
    figure = sheet(6.6, plain(f"States: {result.source}", 90), note, result.verdict, FOR_EACH_DPI)
    panels = figure.subplots(3, 1, sharex=True)
    t = _named(trace, "t_s")
    for axes, (label, name, sigma, k, factor) in zip(panels, _QUANTITIES, strict=True):
        value, spread = factor * _named(trace, name), factor * _named(trace, sigma)
        axes.fill_between(t, value - 2.0 * spread, value + 2.0 * spread, color=SHADE, linewidth=0.0)
        other, truth = factor * trace[:, _BASELINE + k], factor * trace[:, _TRUTH + k]
        if np.isfinite(other).any():
            axes.plot(t, other, color=ORANGE, linewidth=0.9, label="baseline")
        if np.isfinite(truth).any():
            axes.plot(t, truth, color=INK, linewidth=1.4, label="truth")
        axes.plot(t, value, color=BLUE, linewidth=0.9, label="estimate")
        gated = _named(trace, "gated_camera") == 1.0
        if gated.any():
            axes.plot(
                t[gated], value[gated], color=VERMILLION, linestyle="none", marker="|", label="gated picture"
            )
        _limits(axes, value)
        axes.set_ylabel(label)
        axes.grid(True)
        axes.yaxis.set_major_locator(MaxNLocator(5))
    # NaN where there is no driven model.
    handed_over = _named(trace, "driven_weight") < 0.5
    if handed_over.any():
        for axes in panels:
            axes.fill_between(
                t, 0.0, 1.0, where=handed_over, transform=axes.get_xaxis_transform(), color=ORANGE,
                alpha=0.12, linewidth=0.0, label="kinematic model speaks",
            )  # fmt: skip
    panels[-1].set_xlabel("time (s)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def innovation_figure(result: Replayed) -> Figure:
    """Innovations of each sensor over their standard deviation, gated ones marked."""
    trace = result.trace
    note = (
        f"An honest covariance keeps 95 % within the grey band of 2{SIGMA}, without a pattern. "
        "Red: gated out and not used; marks at the edge lie beyond it."
    )
    figure = sheet(6.6, plain(f"Innovations: {result.source}", 90), note, result.verdict, FOR_EACH_DPI)
    panels = figure.subplots(3, 1, sharex=True)
    t = _named(trace, "t_s")
    for axes, (label, columns, gate) in zip(
        panels,
        (
            ("camera u, v", ("e_u", "e_v"), "gated_camera"),
            ("accelerometer x, y", ("e_ax", "e_ay"), "gated_accel"),
            ("gyroscope z", ("e_gz",), "gated_gyro"),
        ),
        strict=True,
    ):
        axes.axhspan(-2.0, 2.0, color=SHADE, linewidth=0.0)
        axes.set_ylim(-6.0, 6.0)
        axes.set_ylabel(label)
        axes.grid(True, axis="y")
        gated = _named(trace, gate) == 1.0
        if not np.isfinite(_named(trace, columns[0])).any():
            empty(axes, "not sampled", 20)
            continue
        for name, colour in zip(columns, (BLUE, GREY), strict=False):
            value = np.clip(_named(trace, name), -5.8, 5.8)
            some = np.nonzero(~gated & np.isfinite(value))[0]
            some = some[:: max(1, len(some) // _MOST_POINTS)]
            axes.plot(t[some], value[some], color=colour, **CLOUD)
            axes.plot(t[gated], value[gated], color=VERMILLION, linestyle="none", marker="x", markersize=4.0)
    panels[-1].set_xlabel("time (s)")
    return figure


def error_figure(result: Replayed) -> Figure:
    """Errors against the truth with the 2-sigma band, the baseline's beside them."""
    trace = result.trace
    note = f"Grey: 2{SIGMA} of the estimate. Blue: its error. Orange: the error of the source's pipeline."
    figure = sheet(6.6, plain(f"Errors: {result.source}", 90), note, result.verdict, FOR_EACH_DPI)
    panels = figure.subplots(3, 1, sharex=True)
    t = _named(trace, "t_s")
    for axes, (label, name, sigma, k, factor) in zip(panels, _QUANTITIES, strict=True):
        truth = trace[:, _TRUTH + k]
        spread = 2.0 * factor * _named(trace, sigma)
        axes.fill_between(t, -spread, spread, color=SHADE, linewidth=0.0)
        other = factor * (trace[:, _BASELINE + k] - truth)
        axes.plot(t, other, color=ORANGE, linewidth=0.9, label="baseline")
        error = factor * (_named(trace, name) - truth)
        axes.plot(t, error, color=BLUE, linewidth=0.9, label="estimate")
        _limits(axes, np.concatenate([error, other]))
        axes.set_ylabel(label)
        axes.grid(True)
    panels[-1].set_xlabel("time (s)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def write_replay_figures(folder: Path, results: list[Replayed]) -> list[Path]:
    """Write `replay_<log>_states.png`, `_innovations.png` and, with a truth, `_errors.png`."""
    figure_folder(folder)
    out = []
    with look():
        for k, result in enumerate(results):
            stem = Path(result.source).stem
            if sum(Path(other.source).stem == stem for other in results) > 1:
                stem = f"{stem}_{k + 1}"
            out.append(save(state_figure(result), folder / f"replay_{stem}_states.png"))
            if np.isfinite(result.trace[:, 13:18]).any():
                out.append(save(innovation_figure(result), folder / f"replay_{stem}_innovations.png"))
            if np.isfinite(result.trace[:, _TRUTH]).any():
                out.append(save(error_figure(result), folder / f"replay_{stem}_errors.png"))
    return out
