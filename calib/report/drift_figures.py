"""Figures of the drift comparison: angles over a log at rest (Fig. 2.4), in motion (Fig. 2.6), slopes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.arrays import FloatArray
from calib.imu.drift import LogDrift
from calib.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    empty,
    figure_folder,
    look,
    plain,
    save,
    sheet,
    view_colours,
)

__all__ = ["write_drift_figures"]

_COLOUR = {
    "on the chip": ORANGE,
    "gyroscope alone": VERMILLION,
    "accelerometer alone": GREY,
    "MM 3/3": BLUE,
    "MM tuned": PURPLE,
    "MM 3/3 with up vector": SKY,
}
_WINDOW_S = 12.0
_MOST_POINTS = 3000
_MOST_LEGEND = 8
_PM = "\N{PLUS-MINUS SIGN}"
_DRAWN_IN_MOTION = ("accelerometer alone", "gyroscope alone", "MM 3/3", "MM tuned", "VQF")


def _thinned(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    step = max(len(t) // _MOST_POINTS, 1)
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
                *_thinned(t, change - first),
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
