"""Figures of a pump's identification: both models against the recordings, residuals, the static map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.actuator.identify_pump_models import LAG, ORIFICE, simulate_pump
from calib.identification import PumpFound
from calib.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    SHADE,
    VERMILLION,
    figure_folder,
    look,
    plain,
    save,
    sheet,
)

__all__ = ["write_pump_figures"]

_COLOUR = {LAG: ORANGE, ORIFICE: BLUE}
_MOST = 12


def runs_figure(found: PumpFound, verdict: str) -> Figure:
    """Each recording with both models, simulated from its PWM and its first fifth of a second."""
    records = found.records[:_MOST]
    rows = (len(records) + 2) // 3
    note = (
        "Points: measured. Lines: simulated from the PWM and the first 0.2 s. In each title the RMS of "
        "linear lag / orifice flow, fitted without that file where there are several."
    )
    figure = sheet(2.1 * rows + 0.3, "The pump's models against the recordings", note, verdict)
    grid = figure.add_gridspec(rows, 3)
    handles: dict[str, Artist] = {}
    held = {m: {h.name: h.rms for h in found.held[m]} for m in found.fits}
    for i, record in enumerate(records):
        axes = figure.add_subplot(grid[i // 3, i % 3])
        t = record.t_s - record.t_s[0]
        axes.plot(t, record.value, ".", color=GREY, markersize=2.5, label="measured")
        errors = []
        for model, fit in found.fits.items():
            told = simulate_pump(model, fit.theta, record, fit.shape)
            axes.plot(t, told, color=_COLOUR[model], linewidth=1.1, label=model)
            rms = held[model].get(record.name, float(np.sqrt(np.mean((told - record.value) ** 2))))
            errors.append(f"{rms:.2f}")
        axes.set_title(f"{plain(record.name, 22)}: {' / '.join(errors)}", fontsize=9.5)
        axes.grid(True)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
        if i % 3 == 0:
            axes.set_ylabel(found.unit)
        if i + 3 >= len(records):
            axes.set_xlabel("time (s)")
        lines, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, lines, strict=True))
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=3)
    return figure


def residual_figure(found: PumpFound, verdict: str) -> Figure:
    """Measured minus simulated over time, a panel for each model and a line for each recording."""
    note = (
        "Measured minus simulated. Runs that leave the model are drawn in red: the PWM does not explain them."
    )
    figure = sheet(3.0, "What is left over", note, verdict)
    panels = figure.subplots(1, len(found.fits), squeeze=False, sharey=True)[0]
    gone = {d.name for d in found.departs}
    for axes, (model, fit) in zip(panels, found.fits.items(), strict=True):
        for record in found.records:
            error = record.value - simulate_pump(model, fit.theta, record, fit.shape)
            colour = VERMILLION if record.name in gone else GREY
            axes.plot(record.t_s - record.t_s[0], error, color=colour, linewidth=0.8)
        axes.set_title(model)
        axes.set_xlabel("time (s)")
        axes.grid(True)
    panels[0].set_ylabel(f"error ({found.unit})")
    return figure


def static_figure(found: PumpFound, verdict: str) -> Figure:
    """Settled values over PWM with the fitted maps, and where the recordings settle."""
    note = "Points: settled values; crosses: outliers. Lines: the fitted map. Squares: ends of recordings."
    figure = sheet(3.4, "Static map", note, verdict)
    axes = figure.subplots()
    u = np.linspace(0.0, 255.0, 400)
    for m, colour in zip(found.maps, (BLUE, GREEN, ORANGE, GREY) * len(found.maps), strict=False):
        far = np.isin(m.pwm, m.outliers)
        axes.plot(m.pwm[~far], m.value[~far], "o", color=colour, markersize=4.0)
        axes.plot(m.pwm[far], m.value[far], "x", color=colour, markersize=5.0)
        axes.plot(u, m.of(u), color=colour, linewidth=1.2, label=plain(m.name, 50))
    for group in found.groups:
        axes.plot(group.pwm[1], group.value, "s", color=VERMILLION, markersize=5.0)
        axes.annotate(
            f"{len(group.names)} runs",
            (group.pwm[1], group.value),
            xytext=(-8, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            color=INK,
            bbox={"facecolor": "white", "edgecolor": SHADE, "boxstyle": "round,pad=0.2"},
        )
    axes.set_xlabel("PWM")
    axes.set_ylabel(found.unit)
    axes.grid(True)
    if found.maps:
        axes.legend(loc="lower left")
    return figure


def write_pump_figures(folder: Path, found: PumpFound, verdict: str) -> list[Path]:
    """Write `pump_runs.png` and `pump_residuals.png` of recordings, and `pump_static.png`.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        out = []
        if found.records:
            out.append(save(runs_figure(found, verdict), folder / "pump_runs.png"))
            out.append(save(residual_figure(found, verdict), folder / "pump_residuals.png"))
        if found.maps or found.groups:
            out.append(save(static_figure(found, verdict), folder / "pump_static.png"))
    return out
