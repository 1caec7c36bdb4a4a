"""Figures of an IMU at rest: Allan deviation with what explains it, readings over time, drift by log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from calib.arrays import FloatArray
from calib.imu.allan_fit import model_variance
from calib.imu.static import AxisNoise, Static
from calib.report.style import (
    BLUE,
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

__all__ = ["allan_figure", "drift_figure", "signal_figure", "write_imu_figures"]

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


def _thinned(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places and values of which no extreme is lost: least and largest of each bin."""
    n = len(values)
    size = max(1, 2 * n // _MOST_POINTS)
    if size <= 2:
        return np.arange(n, dtype=np.float64), values
    count = n // size
    bins = values[: count * size].reshape(count, size)
    at = size * (np.arange(count) + 0.5)
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
    zero = min(part.start_s for part in log.parts)
    for axes, k in _panels(figure, result):
        name = result.axes[k]
        axes.set_title(name)
        axes.grid(True)
        for part in log.parts:
            at, values = _thinned(part.values[:, k])
            axes.plot(part.start_s - zero + period * at, values, color="#b9c0c7", linewidth=0.5)
            size = max(1, round(1.0 / period))
            count = len(part.values) // size
            if count:
                means = part.values[: count * size, k].reshape(count, size).mean(axis=1)
                middle = part.start_s - zero + period * size * (np.arange(count) + 0.5)
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
