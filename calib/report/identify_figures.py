"""Figures of an identification: simulated against measured, residuals, parameters, the springs' law."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.actuator.identify_parameters import PARAMETERS
from calib.actuator.identify_stiffness import StiffnessFit
from calib.actuatorsections import Identified
from calib.arrays import FloatArray
from calib.identification import simulated_heads
from calib.report.style import (
    BLUE,
    CLOUD,
    GREEN,
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

__all__ = ["write_identify_figures", "write_stiffness_figure"]

_MOST_LOGS = 6
_MOST_S = 20.0
_LAGS = 30


def _tidy(axes: Axes) -> None:
    axes.grid(True)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(4))


def motion_figure(found: Identified) -> Figure:
    """Angle and length of each log, measured and simulated with the identified parameters."""
    tracks = list(found.solution.problem.tracks)[:_MOST_LOGS]
    note = (
        "Points: from the logs. Lines: simulated with the identified parameters from the commands and the "
        f"start alone. At most the first {_MOST_S:g} s of {_MOST_LOGS} logs."
    )
    figure = sheet(1.75 * len(tracks) + 0.3, "Simulated against measured", note, found.judgement.verdict)
    panels = figure.subplots(len(tracks), 2, squeeze=False, sharex="row")
    for row, (track, head) in enumerate(zip(tracks, simulated_heads(found.solution), strict=False)):
        some = track.t_s <= _MOST_S
        for column, (scale, unit) in enumerate(((1.0, "angle (rad)"), (1e3, "length (mm)"))):
            axes = panels[row, column]
            seen, told = scale * track.head[some, column], scale * head[some, column]
            axes.plot(track.t_s[some], seen, color=GREY, label="measured", **CLOUD)
            axes.plot(track.t_s[some], told, color=BLUE, linewidth=1.0, label="simulated")
            spread = max(float(np.ptp(told)), 1e-3 * scale)
            # A picture with another thing in place of the marker is far away; the curve is what counts.
            axes.set_ylim(float(told.min()) - 0.3 * spread, float(told.max()) + 0.3 * spread)
            axes.set_ylabel(unit)
            _tidy(axes)
            if column == 0:
                axes.set_title(plain(track.name, 40))
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, markerscale=2.0
    )
    return figure


def residual_figure(found: Identified) -> Figure:
    """Correlation of each log's residuals with themselves, and how they are distributed."""
    problem = found.solution.problem
    note = (
        "Residuals over their standard deviation. Left: correlation with the rows after, white ones stay "
        "within the grey band (95 %). Right: their distribution beside that of a normal one."
    )
    figure = sheet(3.2, "Residuals", note, found.judgement.verdict)
    left, right = figure.subplots(1, 2)
    at, rows, shortest = 0, [], 10**9
    for track in problem.tracks:
        r = found.solution.residual[at : at + 2 * len(track.t_s)].reshape(-1, 2)
        at += 2 * len(track.t_s)
        z = r / np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9)
        rows.append(z)
        shortest = min(shortest, len(z))
        cut = np.clip(z, -3.0, 3.0)
        cut = cut - cut.mean(axis=0)
        power = np.sum(cut * cut, axis=0)
        for column, colour in ((0, BLUE), (1, ORANGE)):
            c = [float(np.sum(cut[k:, column] * cut[:-k, column]) / power[column]) for k in range(1, _LAGS)]
            left.plot(range(1, _LAGS), c, color=colour, linewidth=0.8)
    left.axhspan(-1.96 / np.sqrt(shortest), 1.96 / np.sqrt(shortest), color=SHADE, zorder=0)
    left.set_xlabel("lag (rows)")
    left.set_ylabel("correlation")
    left.plot([], [], color=BLUE, label="first component")
    left.plot([], [], color=ORANGE, label="second component")
    whole = np.concatenate(rows).ravel()
    right.hist(np.clip(whole, -5.0, 5.0), bins=50, density=True, color=SHADE, edgecolor=GREY, linewidth=0.5)
    x = np.linspace(-5.0, 5.0, 201)
    right.plot(
        x, np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi), color=VERMILLION, linewidth=1.0, label="normal"
    )
    right.set_xlabel("residual / deviation")
    right.set_ylabel("density")
    for axes in (left, right):
        _tidy(axes)
        axes.legend(loc="upper right")
    return figure


def parameter_figure(found: Identified) -> Figure:
    """Relative deviation of each parameter now and after one more experiment."""
    names = list(found.solution.problem.names)
    note = "Standard deviation over value. Blue: from these logs. Points: with one more experiment of 8 s."
    figure = sheet(0.9 + 0.36 * len(names), f"What is known of the parameters ({SIGMA} / value)", note)
    axes = figure.subplots()
    values = found.solution.values
    for row, name in enumerate(names):
        now = 100.0 * found.uncertainty.sigma[name] / max(abs(values[name]), 1e-12)
        axes.barh(row, now, height=0.6, color=SHADE, edgecolor=BLUE, linewidth=0.8)
    for one, colour, mark in zip(
        found.prospects, (VERMILLION, GREEN, ORANGE, GREY, INK), ("o", "s", "^", "v", "x"), strict=False
    ):
        after = [100.0 * one.relative.get(name, np.nan) for name in names]
        axes.plot(after, range(len(names)), mark, color=colour, markersize=4.0, label=one.name)
    axes.set_yticks(range(len(names)), [f"{n} ({PARAMETERS[n].symbol})" for n in names])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("%")
    axes.grid(True, axis="x")
    if found.prospects:
        figure.legend(loc="outside lower center", ncols=5)
    return figure


def damping_figure(found: Identified) -> Figure:
    """Swings with the peaks that the logarithmic decrement took."""
    free = [t for t in found.solution.problem.tracks if t.name in found.decrements][:_MOST_LOGS]
    note = "Peaks that were used for the damping by the logarithmic decrement (3.39), (3.40)."
    figure = sheet(1.9 * max(len(free), 1), "Damping by peaks", note, found.judgement.verdict)
    panels = figure.subplots(max(len(free), 1), 1, squeeze=False)
    if not free:
        empty(panels[0, 0], "no free swing with enough peaks")
    for axes, track in zip(panels[:, 0], free, strict=False):
        d, of_fit = found.decrements[track.name]
        fitted = "" if of_fit is None else f", that of the fit {of_fit:.4f}"
        axes.plot(track.t_s, track.head[:, 0], color=GREY, linewidth=0.7)
        axes.plot(d.peak_at_s, d.peak, "o", color=VERMILLION, markersize=4.0)
        top = 1.3 * float(np.abs(d.peak).max())
        axes.set_ylim(-top, top)
        axes.set_title(f"{plain(track.name, 30)}: zeta {d.zeta:.4f} +- {d.sigma:.1g}{fitted}")
        axes.set_ylabel("angle (rad)")
        _tidy(axes)
    panels[-1, 0].set_xlabel("time (s)")
    return figure


def write_identify_figures(folder: Path, found: Identified) -> list[Path]:
    """Write `identify_` `motion.png`, `residuals.png`, `parameters.png` and `damping.png`.

    The last only where a log is a free swing. Raises `BadInputError` where they cannot be written.
    """
    figure_folder(folder)
    with look():
        out = [
            save(motion_figure(found), folder / "identify_motion.png"),
            save(residual_figure(found), folder / "identify_residuals.png"),
            save(parameter_figure(found), folder / "identify_parameters.png"),
        ]
        if found.decrements:
            out.append(save(damping_figure(found), folder / "identify_damping.png"))
    return out


def write_stiffness_figure(
    folder: Path, elongation_m: FloatArray, force_N: FloatArray, fits: Sequence[StiffnessFit], best: int
) -> Path:
    """Write `identify_stiffness.png`: force (Fig. 3.9) and stiffness (Fig. 3.10) over elongation."""
    figure_folder(folder)
    with look():
        figure = sheet(3.2, "Springs", "Laws through zero; the thick one is used.")
        left, right = figure.subplots(1, 2)
        x = np.linspace(0.0, 1.05 * float(np.max(np.abs(elongation_m))), 200)[1:]
        left.plot(1e3 * elongation_m, force_N, "o", color=INK, markersize=4.0, label="measured")
        some = np.abs(elongation_m) > 1e-9
        right.plot(
            1e3 * elongation_m[some], force_N[some] / elongation_m[some], "o", color=INK, markersize=4.0
        )
        for k, (fit, colour) in enumerate(zip(fits, (ORANGE, BLUE, GREEN), strict=False)):
            width = 2.0 if k == best else 0.9
            left.plot(1e3 * x, fit.force_N(x), color=colour, linewidth=width, label=f"order {fit.order}")
            right.plot(1e3 * x, fit.force_N(x) / x, color=colour, linewidth=width)
        left.set_ylabel("force (N)")
        right.set_ylabel("stiffness (N/m)")
        for axes in (left, right):
            axes.set_xlabel("elongation (mm)")
            _tidy(axes)
        left.legend(loc="upper left")
        return save(figure, folder / "identify_stiffness.png")
