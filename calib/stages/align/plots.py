"""Figures of an alignment: residuals before and after, and the camera's rate against the gyroscope's."""

from __future__ import annotations

import math
from pathlib import Path

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
    number,
    plain,
    save,
    sheet,
)
from calib.stages.align.solve import Alignment, Trace
from calib.stages.estimator.sensors import SENSOR

_MPS2 = "m/s\N{SUPERSCRIPT TWO}"
_MOST_POINTS = 3000


def _traces(found: Alignment, log: int) -> list[Trace]:
    return [trace for trace in found.traces if trace.log == log]


def _limit(values: list[FloatArray]) -> float:
    """Half the height of a panel: all but the farthest hundredth."""
    whole = np.concatenate([value[np.isfinite(value)] for value in values])
    return 1.2 * float(np.percentile(np.abs(whole), 99.0)) if len(whole) else 1.0


def _cloud(axes: Axes, t: FloatArray, values: FloatArray, limit: float, colour: str, label: str) -> None:
    step = max(1, len(t) // _MOST_POINTS)
    known = np.isfinite(values)
    t, values = t[known][::step], np.clip(values[known][::step], -0.98 * limit, 0.98 * limit)
    axes.plot(t, values, color=colour, label=label, **CLOUD)


def residual_figure(found: Alignment, log: int, verdict: str = "ok") -> Figure:
    """Residuals of one log with the sensors as assumed beforehand and as found."""
    source = found.logs[log].source
    note = (
        "Measured minus predicted by the fitted motion. Orange: with the time offset and the scales assumed "
        "beforehand, without mount angle and biases. Blue: with those found. Red crosses: pictures taken for "
        "something else. Points at the edge lie beyond it."
    )
    figure = sheet(7.4, plain(f"Residuals: {source}", 90), note, verdict, FOR_EACH_DPI)
    panels = figure.subplots(4, 1, sharex=True)
    traces = _traces(found, log)
    if not traces:
        for axes in panels:
            empty(axes, "no stretch of this log was used")
        return figure
    zero = min(float(trace.imu_s[0]) for trace in traces)
    rows = (
        ("u (px)", "camera", 0),
        ("v (px)", "camera", 1),
        (f"along y ({_MPS2})", "imu", 1),
        ("rate (rad/s)", "imu", 2),
    )
    for axes, (label, sensor, channel) in zip(panels, rows, strict=True):
        axes.set_ylabel(label)
        axes.grid(True, axis="y")
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.yaxis.set_major_locator(MaxNLocator(5))
        before = [getattr(trace, f"{sensor}_before")[:, channel] for trace in traces]
        after = [getattr(trace, f"{sensor}_after")[:, channel] for trace in traces]
        if not any(np.isfinite(value).any() for value in after):
            empty(axes, "not sampled", 20)
            continue
        limit = _limit([*before, *after])
        axes.set_ylim(-limit, limit)
        for trace, old, new in zip(traces, before, after, strict=True):
            t = getattr(trace, f"{sensor}_s") - zero
            _cloud(axes, t, old, limit, ORANGE, "before")
            good = trace.good > 0.5 if sensor == "camera" else np.ones(len(t), dtype=np.bool_)
            _cloud(axes, t[good], new[good], limit, BLUE, "after")
            bad = np.clip(new[~good], -0.95 * limit, 0.95 * limit)
            axes.plot(t[~good], bad, color=VERMILLION, linestyle="none", marker="x", markersize=4.5)
    panels[-1].set_xlabel("time (s)")
    return figure


def correlation_figure(found: Alignment, verdict: str = "ok") -> Figure:
    """Correlation of the camera's rate with the gyroscope's over the time offset, and what was found."""
    at = SENSOR.index("time_offset_s")
    offset, sigma = float(found.sensor[at]), float(found.sigma[at])
    note = (
        "Rate of phi that pictures four frames apart show, against that of the gyroscope over the same time. "
        f"The line is the time offset of the whole fit, the band its 2{SIGMA}; with one {SIGMA} it is "
        f"{number(1e3 * offset, 'ms', 4)} \N{PLUS-MINUS SIGN} {number(1e3 * sigma, 'ms', 2)}."
    )
    figure = sheet(3.4, "When the camera and the gyroscope see the same motion", note, verdict)
    axes = figure.subplots()
    shown = found.correlation
    axes.set_xlabel("pictures later than the gyroscope (ms)")
    axes.set_ylabel("correlation")
    if not np.isfinite(shown.value).any():
        empty(axes, "too few pictures")
        return figure
    low, high = 1e3 * float(shown.offset_s[0]), 1e3 * float(shown.offset_s[-1])
    axes.axvspan(max(1e3 * (offset - 2.0 * sigma), low), min(1e3 * (offset + 2.0 * sigma), high), color=SHADE)
    axes.axvline(min(max(1e3 * offset, low), high), color=VERMILLION, linewidth=1.2)
    axes.plot(1e3 * shown.offset_s, shown.value, color=BLUE, linewidth=1.4)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.set_xlim(low, high)
    axes.grid(True)
    top = float(np.nanmax(shown.value))
    axes.set_ylim(min(-0.1, 1.1 * float(np.nanmin(shown.value))), max(0.1, 1.1 * top))
    if not math.isfinite(sigma) or sigma > 0.01:
        axes.set_title("the logs do not show the time offset")
    return figure


def write_align_figures(folder: Path, found: Alignment, verdict: str = "ok") -> list[Path]:
    """Write `align_correlation.png` and `align_residuals_1.png`, ... for each log."""
    figure_folder(folder)
    with look():
        out = [save(correlation_figure(found, verdict), folder / "align_correlation.png")]
        out += [
            save(residual_figure(found, k, verdict), folder / f"align_residuals_{k + 1}.png")
            for k in range(len(found.logs))
        ]
    return out
