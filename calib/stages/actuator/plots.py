"""Figures of an identification, of a pump and of a validation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.core.arrays import FloatArray
from calib.show.style import (
    BLUE,
    CLOUD,
    FOR_EACH_DPI,
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
    number,
    plain,
    save,
    sheet,
)
from calib.stages.actuator.identify import PARAMETERS, StiffnessFit
from calib.stages.actuator.identify_pump import LAG, ORIFICE, simulate_pump
from calib.stages.actuator.results import Identified
from calib.stages.actuator.stage import PumpFound, simulated_heads
from calib.stages.actuator.validate import IMPROVED, NOMINAL, ORIGINAL, QUANTITIES, Comparison

# ----------------------------------------------------------------------
# Figures of an identification: simulated against measured, residuals, parameters, the springs' law.

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


# ----------------------------------------------------------------------
# Figures of a pump's identification: both models against the recordings, residuals, the static map.

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


def pump_residual_figure(found: PumpFound, verdict: str) -> Figure:
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
            out.append(save(pump_residual_figure(found, verdict), folder / "pump_residuals.png"))
        if found.maps or found.groups:
            out.append(save(static_figure(found, verdict), folder / "pump_static.png"))
    return out


# ----------------------------------------------------------------------
# Figures of a validation: what was measured, with the curves of the models over it.

_VALIDATE_FIGURES_MOST_S = 20.0
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
    some = one.t_s <= _VALIDATE_FIGURES_MOST_S
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
