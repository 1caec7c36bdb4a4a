"""Figures of an IMU: at rest, in poses, its drift, the tuning of its filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from calib.core.arrays import FloatArray, IntArray
from calib.show.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    RISING,
    RULE,
    SHADE,
    SIGMA,
    SKY,
    VERMILLION,
    empty,
    figure_folder,
    look,
    number,
    plain,
    save,
    sheet,
    view_colours,
)
from calib.stages.imu.allan import model_variance
from calib.stages.imu.drift import LogDrift
from calib.stages.imu.intrinsics import Accelerometer, Intrinsics
from calib.stages.imu.mahony import Mahony, filter_log, wrapped
from calib.stages.imu.section import OrientationFilter
from calib.stages.imu.static import AxisNoise, Static
from calib.stages.imu.tuning import Piece, Tuning, frontier

# ----------------------------------------------------------------------
# Figures of an IMU at rest: Allan deviation with what explains it, readings over time, drift by log.

_UNIT = {"g": "rad/s", "a": "m/s\N{SUPERSCRIPT TWO}"}
_DENSITY = {"g": "rad/s/\N{SQUARE ROOT}Hz", "a": "m/s\N{SUPERSCRIPT TWO}/\N{SQUARE ROOT}Hz"}
_WALK = {"g": "rad/s\N{SUPERSCRIPT TWO}/\N{SQUARE ROOT}Hz", "a": "m/s\N{SUPERSCRIPT THREE}/\N{SQUARE ROOT}Hz"}
_RAISED = (
    "\N{SUPERSCRIPT ZERO}\N{SUPERSCRIPT ONE}\N{SUPERSCRIPT TWO}\N{SUPERSCRIPT THREE}\N{SUPERSCRIPT FOUR}"
    "\N{SUPERSCRIPT FIVE}\N{SUPERSCRIPT SIX}\N{SUPERSCRIPT SEVEN}\N{SUPERSCRIPT EIGHT}\N{SUPERSCRIPT NINE}"
)
_MOST_POINTS = 2500
_TAU = "\N{GREEK SMALL LETTER TAU}"


def _panels(figure: Figure, result: Static) -> list[tuple[Axes, int]]:
    """An axes for each axis of the sensor, gyroscope above, and its number."""
    kinds = [kind for kind in "ga" if any(axis[0] == kind for axis in result.axes)]
    grid = figure.add_gridspec(len(kinds), 3)
    panels = []
    for k, axis in enumerate(result.axes):
        axes = figure.add_subplot(grid[kinds.index(axis[0]), "xyz".index(axis[1])])
        panels.append((axes, k))
    return panels


def _power(value: float, _position: object = None) -> str:
    """A power of ten in plain signs."""
    exponent = round(float(np.log10(value)))
    signs = str.maketrans("-0123456789", "\N{SUPERSCRIPT MINUS}" + _RAISED)
    return f"10{str(exponent).translate(signs)}"


def _logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(10.0, numticks=7))
        axis.set_minor_formatter(NullFormatter())
        axis.set_major_formatter(FuncFormatter(_power))
    axes.grid(True, which="major")


def _rows(result: Static) -> int:
    return len({axis[0] for axis in result.axes})


def _coefficients(noise: AxisNoise) -> str:
    """What was found, a line each."""
    assert noise.allan is not None
    kind, lines = noise.axis[0], []
    for name, term, unit in (
        ("N", noise.allan.N, _DENSITY[kind]),
        ("B", noise.allan.B, _UNIT[kind]),
        ("K", noise.allan.K, _WALK[kind]),
    ):
        if term.supported:
            lines.append(f"{name} {number(term.value, unit)}")
        else:
            lines.append(f"{name} < {number(term.below, unit, 2)}")
    return "\n".join(lines)


def allan_figure(result: Static, verdict: str = "ok") -> Figure:
    """Overlapping Allan deviation of each axis, its 1-sigma bounds, and the fitted N, B and K."""
    note = (
        f"Grey: 1{SIGMA} bounds. White noise N falls with the root of the averaging time {_TAU}, bias "
        "instability B is level, a random walk K of the bias rises. A line is drawn for what the logs show; "
        "\N{LESS-THAN SIGN} is a bound of 95 % for what they are too short for."
    )
    figure = sheet(2.75 * _rows(result) + 0.25, "Allan deviation at rest", note, verdict)
    legend: dict[str, Artist] = {}
    for axes, k in _panels(figure, result):
        noise = result.noise[k]
        axes.set_title(noise.axis)
        if noise.allan is None:
            empty(axes, "never changes", 18)
            axes.set_xticks([])
            axes.set_yticks([])
            continue
        a = noise.allan
        _logarithmic(axes)
        axes.fill_between(a.tau_s, a.low, a.high, color=SHADE, linewidth=0.0)
        axes.plot(a.tau_s, a.low, color=GREY, linewidth=0.5)
        axes.plot(a.tau_s, a.high, color=GREY, linewidth=0.5)
        parts = np.sqrt(model_variance(a.theta, a.tau_s))
        low, high = float(np.nanmin(a.low)), float(np.nanmax(a.high))
        for index, (name, colour) in enumerate((("N", BLUE), ("B", GREEN), ("K", VERMILLION))):
            if a.theta[index] > 0.0:
                axes.plot(a.tau_s, parts[:, index], color=colour, linewidth=1.1, linestyle="--", label=name)
        fitted = (a.tau_s >= 0.999 * a.fit_s[0]) & (a.tau_s <= 1.001 * a.fit_s[1])
        whole = np.sqrt((parts**2).sum(axis=1))
        axes.plot(a.tau_s[fitted], whole[fitted], color=ORANGE, linewidth=2.2, label="fitted")
        axes.plot(
            a.tau_s, a.deviation, color=INK, linewidth=1.2, marker="o", markersize=2.2, label="measured"
        )
        axes.set_ylim(low / 12.0, high * 1.6)
        axes.set_xlabel(f"{_TAU} (s)")
        if axes.get_subplotspec().is_first_col():  # type: ignore[union-attr]  # made from a grid above
            axes.set_ylabel(
                f"{'rate' if noise.axis[0] == 'g' else 'specific force'} ({_UNIT[noise.axis[0]]})"
            )
        axes.text(
            0.04,
            0.04,
            _coefficients(noise),
            transform=axes.transAxes,
            fontsize=9,
            va="bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9},
        )
        legend |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    shown = [label for label in ("measured", "fitted", "N", "B", "K") if label in legend]
    if shown:
        figure.legend([legend[label] for label in shown], shown, loc="outside lower center", ncols=5)
    return figure


def _thinned(values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Places and values of which no extreme is lost: least and largest of each bin."""
    n = len(values)
    size = max(1, 2 * n // _MOST_POINTS)
    if size <= 2:
        return np.arange(n), values
    count = n // size
    bins = values[: count * size].reshape(count, size)
    at = size * np.arange(count) + size // 2
    return np.repeat(at, 2), np.stack([bins.min(axis=1), bins.max(axis=1)], axis=1).ravel()


def signal_figure(result: Static, number_of_log: int = 0, verdict: str = "ok") -> Figure:
    """Readings of one log over time, means over a second, and where it moves."""
    log = result.logs[number_of_log]
    moved = len(log.motions)
    note = "Grey: readings, the extremes of each bin. Blue: means over a second. " + (
        f"Red: {moved} stretch(es) taken for motion and left out." if moved else "No motion was found."
    )
    figure = sheet(2.2 * _rows(result), plain(f"Readings at rest: {log.source}", 90), note, verdict)
    period = log.sampling.period_s
    zero = float(log.parts[0].t_s[0])
    for axes, k in _panels(figure, result):
        name = result.axes[k]
        axes.set_title(name)
        axes.grid(True)
        for part in log.parts:
            at, values = _thinned(part.values[:, k])
            axes.plot(part.t_s[at] - zero, values, color="#b9c0c7", linewidth=0.5)
            size = max(1, round(1.0 / period))
            count = len(part.values) // size
            if count:
                means = part.values[: count * size, k].reshape(count, size).mean(axis=1)
                middle = part.t_s[0] - zero + period * size * (np.arange(count) + 0.5)
                axes.plot(middle, means, color=BLUE, linewidth=1.0)
        for motion in log.motions:
            axes.axvspan(motion.from_s - zero, motion.to_s - zero, color=VERMILLION, alpha=0.25, linewidth=0)
        axes.set_xlabel("time (s)")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
        if axes.get_subplotspec().is_first_col():  # type: ignore[union-attr]  # made from a grid above
            axes.set_ylabel(f"{'rate' if name[0] == 'g' else 'specific force'} ({_UNIT[name[0]]})")
    return figure


def drift_figure(result: Static, verdict: str = "ok") -> Figure:
    """Drift of the angle in each log, by the gyroscope and by the chip (Fig. 2.4)."""
    note = (
        f"Slope of -gz integrated, and of the angle that the chip reports, with 2{SIGMA}. The line is the "
        "mean of the logs, the band their standard deviation. A slope alone does not rank filters."
    )
    figure = sheet(3.4, "Drift of the angle, log by log", note, verdict)
    panels = figure.subplots(1, 2)
    number_of = np.arange(1, len(result.logs) + 1)
    for axes, title, drifts in (
        (panels[0], "Gyroscope alone", [log.gyro for log in result.logs]),
        (panels[1], "On the chip", [log.onchip for log in result.logs]),
    ):
        axes.set_title(title)
        have = [(i, drift) for i, drift in zip(number_of.tolist(), drifts, strict=True) if drift is not None]
        if not have:
            empty(axes, "not logged, or the logs move", 30)
            axes.set_xticks([])
            axes.set_yticks([])
            continue
        slope = np.degrees([drift.slope_radps for _, drift in have])
        sigma = np.nan_to_num(np.degrees([drift.sigma_radps for _, drift in have]))
        mean = float(slope.mean())
        if len(have) > 1:
            spread = float(slope.std(ddof=1))
            axes.axhspan(mean - spread, mean + spread, color=SHADE, linewidth=0)
        axes.axhline(mean, color=GREY, linewidth=1.0)
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.errorbar(
            [i for i, _ in have], slope, yerr=2.0 * sigma, color=BLUE, linestyle="none", marker="o", capsize=3
        )
        axes.set_xlim(0.4, len(result.logs) + 0.6)
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        axes.set_xlabel("log")
        axes.set_ylabel("slope (degrees/s)")
        axes.grid(True, axis="y")
    return figure


def write_imu_figures(folder: Path, result: Static, verdict: str = "ok") -> list[Path]:
    """Write `imu_allan.png`, `imu_drift.png` and `imu_static_1.png`, ... for each log."""
    figure_folder(folder)
    with look():
        out = [save(allan_figure(result, verdict), folder / "imu_allan.png")]
        out.append(save(drift_figure(result, verdict), folder / "imu_drift.png"))
        out += [
            save(signal_figure(result, i, verdict), folder / f"imu_static_{i + 1}.png")
            for i in range(len(result.logs))
        ]
    return out


# ----------------------------------------------------------------------
# Figures of an IMU's intrinsics: where the poses lie, and what rests and turns are off by.

_MPS2 = "mm/s\N{SUPERSCRIPT TWO}"
_DEGREE = "\N{DEGREE SIGN}"


def _bare(axes: Axes, limit: float) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _disc(axes: Axes, u: FloatArray, sign: float) -> int:
    """The half of the sphere with z up or down, in Lambert's equal-area projection; how many are on it."""
    here = u[sign * u[:, 2] > 0.0] if sign > 0.0 else u[u[:, 2] <= 0.0]
    for degrees in (30.0, 60.0, 90.0):
        radius = math.sqrt(2.0) * math.sin(math.radians(degrees) / 2.0)
        face = SHADE if degrees == 90.0 else "none"
        axes.add_patch(
            Circle((0, 0), radius, facecolor=face, edgecolor=RULE, zorder=0.5 if degrees == 90.0 else 1)
        )
    for label, at in (("x", (1, 0)), ("-x", (-1, 0)), ("y", (0, 1)), ("-y", (0, -1))):
        axes.text(1.09 * at[0], 1.09 * at[1], label, ha="center", va="center", color=GREY)
    axes.text(0.03, 0.03, "z" if sign > 0.0 else "-z", color=GREY)
    if len(here):
        scale = 1.0 / np.sqrt(1.0 + sign * here[:, 2])
        axes.plot(
            here[:, 0] * scale, here[:, 1] * scale, color=BLUE, marker="o", markersize=6, linestyle="none",
            alpha=0.8, markeredgecolor="white",
        )  # fmt: skip
    _bare(axes, 1.2)
    return len(here)


def _circle(axes: Axes, accel: Accelerometer) -> None:
    axes.add_patch(Circle((0, 0), 1.0, facecolor=SHADE, edgecolor=RULE, zorder=0.5))
    for label, at in (("x", (1, 0)), ("-x", (-1, 0)), ("y", (0, 1)), ("-y", (0, -1))):
        axes.text(1.12 * at[0], 1.12 * at[1], label, ha="center", va="center", color=GREY)
    for u in accel.directions:
        axes.plot([0, u[0]], [0, u[1]], color=RULE, linewidth=0.8)
    axes.plot(*accel.directions.T, color=BLUE, marker="o", markersize=6, linestyle="none", alpha=0.8)
    _bare(axes, 1.25)


def pose_figure(result: Intrinsics, verdict: str = "ok") -> Figure:
    """Which way was up in each rest, in the sensor's frame."""
    note = (
        f"Each point is a rest: the direction in the sensor's frame that was up. {len(result.rests)} rests "
        f"show {result.poses} poses."
    )
    if not result.planar:
        note += f" Rings are 30{_DEGREE}, 60{_DEGREE} and 90{_DEGREE} from the z axis; areas are true."
    figure = sheet(4.3, "Poses of the IMU", note, verdict)
    accel = result.accel
    if accel is None:
        axes = figure.subplots()
        empty(axes, "too few rests to tell their poses")
        axes.set_xticks([])
        axes.set_yticks([])
    elif result.planar:
        axes = figure.subplots()
        axes.set_title("In the plane of x and y")
        _circle(axes, accel)
    else:
        panels = figure.subplots(1, 2)
        for axes, sign, words in ((panels[0], 1.0, "up"), (panels[1], -1.0, "down")):
            count = _disc(axes, accel.directions, sign)
            axes.set_title(f"z axis {words}: {count} rests")
    return figure


def _rest_panel(axes: Axes, result: Intrinsics) -> None:
    accel = result.accel
    axes.set_title("Length of the specific force less g, rest by rest")
    axes.set_xlabel("time (s)")
    axes.set_ylabel(f"residual ({_MPS2})")
    if accel is None:
        empty(axes, "too few rests for a fit")
        return
    at = [0.5 * (rest.from_s + rest.to_s) for rest in result.rests]
    axes.axhline(0.0, color=INK, linewidth=0.6)
    axes.errorbar(
        at, 1e3 * accel.residual_mps2, yerr=2e3 * accel.deviation_mps2, color=BLUE, marker="o", markersize=4,
        linestyle="none", capsize=2, elinewidth=0.8,
    )  # fmt: skip
    axes.grid(True, axis="y")


def _threshold_panel(axes: Axes, result: Intrinsics) -> None:
    axes.set_title("Threshold by residual")
    axes.set_xlabel("multiple of the spread at rest")
    axes.set_ylabel(f"residual RMS ({_MPS2})")
    found = [trial for trial in result.trials if math.isfinite(trial.rms_mps2)]
    if not found:
        empty(axes, "too few rests to compare thresholds", 24)
        return
    axes.plot(
        [trial.multiple for trial in found], [1e3 * trial.rms_mps2 for trial in found], color=INK, marker="o",
        markersize=4, linewidth=1.0,
    )  # fmt: skip
    taken = next((trial for trial in found if trial.multiple == result.multiple), None)
    if taken is not None:
        axes.plot(taken.multiple, 1e3 * taken.rms_mps2, color=VERMILLION, marker="o", markersize=8)
    axes.set_ylim(0.0, 1.15e3 * max(trial.rms_mps2 for trial in found))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.grid(True)


def _turn_panel(axes: Axes, result: Intrinsics) -> None:
    axes.set_title("Gravity missed after each turn")
    axes.set_xlabel("turn")
    axes.set_ylabel("angle (degrees)")
    if result.gyro is None:
        empty(axes, "no gyroscope, or no turn", 24)
        return
    missed = np.degrees(np.linalg.norm(result.gyro.residual_rad, axis=1))
    axes.bar(np.arange(1, len(missed) + 1), missed, color=BLUE, width=0.7)
    axes.axhline(math.degrees(result.gyro.rms_rad), color=VERMILLION, linewidth=1.2)
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(True, axis="y")


def residual_figure(result: Intrinsics, verdict: str = "ok") -> Figure:
    """What rests and turns are off by, and the threshold that was taken."""
    note = f"Bars: 2{SIGMA} of a rest. "
    if result.accel is not None:
        rms = number(1e3 * result.accel.rms_mps2, _MPS2)
        note += f"The rests differ from g by {rms} (RMS). Red: the threshold taken, and the RMS of the turns."
    figure = sheet(5.4, "Residuals of rests and turns", note, verdict)
    grid = figure.add_gridspec(2, 2)
    _rest_panel(figure.add_subplot(grid[0, :]), result)
    _threshold_panel(figure.add_subplot(grid[1, 0]), result)
    _turn_panel(figure.add_subplot(grid[1, 1]), result)
    return figure


def write_imu_intrinsics_figures(folder: Path, result: Intrinsics, verdict: str = "ok") -> list[Path]:
    """Write `imu_poses.png` and `imu_residuals.png`."""
    figure_folder(folder)
    with look():
        return [
            save(pose_figure(result, verdict), folder / "imu_poses.png"),
            save(residual_figure(result, verdict), folder / "imu_residuals.png"),
        ]


# ----------------------------------------------------------------------
# Figures of the drift comparison: angles over a log at rest (Fig. 2.4), in motion (Fig. 2.6), slopes.

_COLOUR = {
    "on the chip": ORANGE,
    "gyroscope alone": VERMILLION,
    "accelerometer alone": GREY,
    "MM 3/3": BLUE,
    "MM tuned": PURPLE,
    "MM 3/3 with up vector": SKY,
}
_WINDOW_S = 12.0
_DRIFT_FIGURES_MOST_POINTS = 3000
_MOST_LEGEND = 8
_PM = "\N{PLUS-MINUS SIGN}"
_DRAWN_IN_MOTION = ("accelerometer alone", "gyroscope alone", "MM 3/3", "MM tuned", "VQF")


def _drift_figures_thinned(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    step = max(len(t) // _DRIFT_FIGURES_MOST_POINTS, 1)
    return t[::step], y[::step]


def _at_rest(axes: Axes, name: str, logs: Sequence[LogDrift], colours: Sequence[Any]) -> bool:
    """Change of the angle by one method, a line for each log; whether there was any."""
    drawn = False
    for log, colour in zip(logs, colours, strict=True):
        tracks = [track for track in log.tracks if track.name == name]
        if not tracks:
            continue
        first = None
        for k, phi in enumerate(tracks[0].phi_rad):
            change = np.degrees(phi - log.truth_rad[k]) if log.truth_rad is not None else np.degrees(phi)
            period = log.sampling.period_s
            t = log.start_s[k] - log.start_s[0] + period * np.arange(len(change), dtype=np.float64)
            known = np.isfinite(change)
            if not known.any():
                continue
            if first is None:
                first = float(np.mean(change[known][: max(round(1.0 / period), 1)]))
            axes.plot(
                *_drift_figures_thinned(t, change - first),
                color=colour,
                linewidth=1.0,
                label=plain(log.source, 24) if k == 0 else None,
            )
            drawn = True
    return drawn


def drift_over_time(logs: Sequence[LogDrift]) -> Figure:
    """Angles since each log's start, a panel for each method and a line for each log (Fig. 2.4)."""
    names = list(dict.fromkeys(track.name for log in logs for track in log.tracks))
    rows = (len(names) + 2) // 3
    note = (
        "Angle since the start of each log, less the true angle where it has one. Each panel has its own "
        "scale. A slope alone does not rank filters: the MM filter rejects a constant gyro bias entirely."
    )
    figure = sheet(2.1 * rows + (0.3 if len(logs) > 1 else 0.0), "Drift of the angle", note)
    grid = figure.add_gridspec(rows, 3)
    colours: list[Any] = view_colours(len(logs)) if len(logs) > 1 else [BLUE]
    handles: dict[str, Artist] = {}
    for i, name in enumerate(names):
        axes = figure.add_subplot(grid[i // 3, i % 3])
        axes.set_title(name)
        if not _at_rest(axes, name, logs, colours):
            empty(axes, "nothing to draw", 18)
        axes.grid(True)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlabel("time (s)")
        if i % 3 == 0:
            axes.set_ylabel("angle (degrees)")
        handles |= {label: line for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    if 1 < len(handles) <= _MOST_LEGEND:
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=4)
    return figure


def slopes(logs: Sequence[LogDrift]) -> Figure:
    """Slope of each method in each log with its interval."""
    names = list(dict.fromkeys(m.name for log in logs for m in log.measures))
    note = (
        "Slope of the angle's error in each log, with 95 % intervals; logs from top to bottom. The scale is "
        f"linear within {_PM}0.01 degrees/s and logarithmic beyond."
    )
    figure = sheet(0.9 + 0.34 * len(names), "Slope by method", note)
    axes = figure.subplots()
    colours: list[Any] = view_colours(len(logs)) if len(logs) > 1 else [BLUE]
    for i, name in enumerate(names):
        for j, (log, colour) in enumerate(zip(logs, colours, strict=True)):
            for m in log.measures:
                if m.name != name or not np.isfinite(m.slope.value):
                    continue
                at = i + 0.6 * ((j + 0.5) / len(logs) - 0.5)
                value = np.degrees(m.slope.value)
                half = np.nan_to_num(np.degrees(m.slope.high - m.slope.low) / 2.0)
                axes.errorbar(
                    [value],
                    [at],
                    xerr=[half],
                    color=colour,
                    linestyle="none",
                    marker="o",
                    markersize=4,
                    capsize=2,
                )
    axes.axvline(0.0, color=INK, linewidth=0.7)
    axes.set_xscale("symlog", linthresh=0.01, linscale=1.0)
    reach = max(abs(edge) for edge in axes.get_xlim())
    ticks = [
        tick for tick in (-10.0, -1.0, -0.1, -0.01, 0.0, 0.01, 0.1, 1.0, 10.0) if abs(tick) <= 1.3 * reach
    ]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("slope (degrees/s)")
    axes.grid(True, axis="x")
    return figure


def _liveliest(log: LogDrift) -> tuple[int, slice]:
    """The part and the window in which it moves most, by the accelerometer-free angle."""
    period = log.sampling.period_s
    tracks = {track.name: track for track in log.tracks}
    best, found = -1.0, (0, slice(0, 0))
    for k, phi in enumerate(tracks["MM 3/3"].phi_rad):
        size = min(max(round(_WINDOW_S / period), 2), len(phi))
        for start in range(0, len(phi) - size + 1, max(size // 4, 1)):
            spread = float(phi[start : start + size].std())
            if spread > best:
                best, found = spread, (k, slice(start, start + size))
    return found


def in_motion(log: LogDrift) -> Figure:
    """Angles of sensors and filters while the log moves most, and their errors (Fig. 2.6)."""
    note = "The twelve seconds that move most. Below: error against the true angle, less its mean there."
    truth = log.truth_rad
    if truth is None:
        note = "The twelve seconds that move most. The log has no true angle. Below: difference from MM 3/3."
    figure = sheet(4.9, plain(f"In motion: {log.source}", 90), note)
    above, below = figure.subplots(2, 1, sharex=True)
    k, where = _liveliest(log)
    period = log.sampling.period_s
    t = log.start_s[k] - log.start_s[0] + period * np.arange(where.start, where.stop)
    tracks = {track.name: np.degrees(track.phi_rad[k][where]) for track in log.tracks}
    against = tracks["MM 3/3"] if truth is None else np.degrees(truth[k][where])
    widths = {"MM 3/3": 1.6, "MM tuned": 1.4}
    for name in _DRAWN_IN_MOTION:
        if name not in tracks:
            continue
        colour = _COLOUR.get(name, GREEN)
        turn = 360.0 * np.rint(np.nanmedian(tracks[name] - tracks["MM 3/3"]) / 360.0)
        angle = tracks[name] - turn
        above.plot(t, angle, color=colour, linewidth=widths.get(name, 0.9), label=name)
        error = angle - against
        if truth is None and name == "MM 3/3":
            continue
        if truth is not None and np.isfinite(error).any():
            error = error - np.nanmean(error)
        below.plot(t, error, color=colour, linewidth=widths.get(name, 0.9))
    if truth is not None:
        above.plot(t, against, color=INK, linewidth=1.0, linestyle="--", label="truth")
    above.set_ylabel("angle (degrees)")
    below.set_ylabel("error (degrees)" if truth is not None else "difference (degrees)")
    below.set_xlabel("time (s)")
    for axes in (above, below):
        axes.grid(True)
        axes.yaxis.set_major_locator(MaxNLocator(5))
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure


def write_drift_figures(folder: Path, logs: Sequence[LogDrift]) -> list[Path]:
    """Write `drift_angles.png`, `drift_slopes.png`, and `drift_motion_1.png`, ... for logs that move.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        out = [save(drift_over_time(logs), folder / "drift_angles.png")]
        if any(np.isfinite(m.slope.value) for log in logs for m in log.measures):
            out.append(save(slopes(logs), folder / "drift_slopes.png"))
        out += [
            save(in_motion(log), folder / f"drift_motion_{i + 1}.png")
            for i, log in enumerate(logs)
            if log.moving_s > 0.0
        ]
    return out


# ----------------------------------------------------------------------
# Figures of a tuning: errors over the plane of gains, what gains cost, and the errors over time.

_TUNE_FIGURES_COLOUR = {"3/3": VERMILLION, "tuned": GREEN, "riccati": ORANGE}
_MARK = {"3/3": "s", "tuned": "o", "riccati": "D"}
_TUNE_FIGURES_MOST_POINTS = 3000


def _tick(value: float, _: float | None) -> str:
    return f"{value:g}"


def _tune_figures_logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(_tick)
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True)


def _pairs(result: Tuning) -> list[tuple[str, Mahony]]:
    return [(one.name, one.gains) for one in result.candidates if one.name in _TUNE_FIGURES_COLOUR]


def gains_figure(result: Tuning, dt_s: float, verdict: str = "ok") -> Figure:
    """Error on the whole logs over Kp and Ki, and noise against settling, lag and the peak of a bias."""
    note = (
        "Left: error on the whole logs. Middle: each dot is a pair of gains, the line those that none beats "
        "in noise and settling at once. Right: their lag, and the angle that a bias leaves at most."
    )
    figure = sheet(3.9, f"Gains of the angle filter: {result.recommended.name}", note, verdict)
    left, middle, right = figure.subplots(1, 3)
    f = frontier(result.noise, dt_s)
    if result.surface is None:
        empty(left, "nothing to judge by", 18)
    else:
        s = result.surface
        Kp = np.repeat(s.Kp[:, None], len(s.damping), axis=1)
        Ki = Kp**2 / (4.0 * s.damping[None, :] ** 2)
        error = np.degrees(s.rmse_rad)
        error = np.clip(np.where(np.isfinite(error), error, error.min() * 8.0), None, error.min() * 8.0)
        levels = error.min() * np.geomspace(1.0, 8.0, 13)
        left.contourf(Kp, Ki, error, levels=levels, cmap=RISING, extend="max")
        left.contour(Kp, Ki, error, levels=levels[1:2], colors=[INK], linewidths=0.9)
        left.set_title(f"Least {error.min():.3f} deg; line: 19 % more")
    _tune_figures_logarithmic(left)
    left.set_xlabel("Kp (1/s)")
    left.set_ylabel("Ki (1/s\N{SUPERSCRIPT TWO})")
    settles = np.isfinite(f.settling_s)
    middle.plot(f.noise_gain[settles], f.settling_s[settles], color="#b9c0c7", marker=".", linestyle="none")
    best = np.flatnonzero(f.best & settles)
    best = best[np.argsort(f.noise_gain[best])]
    middle.plot(f.noise_gain[best], f.settling_s[best], color=BLUE, linewidth=2.0)
    _tune_figures_logarithmic(middle)
    middle.set_xlabel("noise gain (variance)")
    middle.set_ylabel("settling to 2 % (s)")
    middle.set_title("Noise and settling")
    right.plot(f.lag_s, f.bias_peak_s, color="#b9c0c7", marker=".", linestyle="none")
    _tune_figures_logarithmic(right)
    right.set_xlabel("lag of a step (s)")
    right.set_ylabel("peak per bias (s)")
    right.set_title("Lag and bias")
    for name, gains in _pairs(result):
        # The grid's nearest pair stands for it: the facts change slowly.
        k = int(np.argmin(np.log(f.Kp / gains.Kp) ** 2 + np.log(f.Ki / max(gains.Ki, 1e-9)) ** 2))
        style = {"color": _TUNE_FIGURES_COLOUR[name], "marker": _MARK[name], "markeredgecolor": "white"}
        left.plot([gains.Kp], [max(gains.Ki, 1e-9)], markersize=8, linestyle="none", label=name, **style)
        middle.plot([f.noise_gain[k]], [f.settling_s[k]], markersize=8, linestyle="none", **style)
        right.plot([f.lag_s[k]], [f.bias_peak_s[k]], markersize=8, linestyle="none", **style)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def errors_figure(result: Tuning, pieces: Sequence[Piece], verdict: str = "ok") -> Figure:
    """Angle of the longest piece, and the errors of 3/3 and of the tuned or recommended pair."""
    k = int(np.argmax([len(piece.t_s) for piece in pieces]))
    piece, own = pieces[k], result.smoothed[k]
    if result.judge == "reference" and piece.reference_rad is not None:
        target, by = piece.reference_rad + result.offset_rad[k], "the reference"
    elif own is not None:
        target, by = own.phi_rad, "the log's own smoothed angle"
    else:
        target, by = np.full(len(piece.t_s), np.nan), "nothing"
    figure = sheet(4.6, plain(f"Errors over time: {piece.source}", 80), f"Against {by}.", verdict)
    above, below = figure.subplots(2, 1, sharex=True)
    every = max(1, len(piece.t_s) // _TUNE_FIGURES_MOST_POINTS)
    rows = slice(None, None, every)
    t = piece.t_s[rows]
    above.plot(t, np.degrees(np.unwrap(piece.phi_acc_rad))[rows], color="#b9c0c7", linewidth=0.6)
    above.plot(t, np.degrees(target)[rows], color=INK, linewidth=1.2)
    above.set_ylabel("angle (degrees)")
    above.set_title(f"Grey: accelerometer; black: {by}")
    for name, gains in _pairs(result)[:2]:
        phi = filter_log(gains, piece.t_s, piece.phi_acc_rad, piece.rate_radps)[0]
        error = np.degrees(wrapped(phi - target))
        if np.isfinite(error).any():
            below.plot(t, error[rows], color=_TUNE_FIGURES_COLOUR[name], linewidth=1.0, label=name)
    below.axhline(0.0, color=GREY, linewidth=0.6)
    below.set_ylabel("error (degrees)")
    below.set_xlabel("time (s)")
    handles, labels = below.get_legend_handles_labels()
    if handles:
        below.legend(handles, labels, loc="upper right", ncols=2)
    for axes in (above, below):
        axes.grid(True)
    return figure


def write_tune_figures(
    folder: Path, result: Tuning, pieces: Sequence[Piece], section: OrientationFilter
) -> list[Path]:
    """Write `tune_gains.png` and `tune_errors.png` into a folder made if needed."""
    figure_folder(folder)
    with look():
        return [
            save(gains_figure(result, 1.0 / section.rate_hz, section.verdict), folder / "tune_gains.png"),
            save(errors_figure(result, pieces, section.verdict), folder / "tune_errors.png"),
        ]
