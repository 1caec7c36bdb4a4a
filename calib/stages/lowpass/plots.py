"""Figures of the low-pass: its gain, delay and step response, and a log before and after it (Fig. 2.10)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import NullFormatter

from calib.core.arrays import FloatArray
from calib.show.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    VERMILLION,
    empty,
    figure_folder,
    look,
    number,
    plain,
    save,
    sheet,
)
from calib.stages.lowpass.filters import (
    Filter,
    Spectrum,
    decibels,
    filter_signal,
    frequency_response,
    group_delay_s,
    step_response,
)
from calib.stages.lowpass.section import LowPass
from calib.stages.lowpass.stage import Positions

_WINDOW_S = 12.0
"""Length of a log that is drawn: its livelier part."""
_LOWEST_DB = -80.0


def write_lowpass_figures(
    folder: Path, filter_: Filter, section: LowPass, seen: Positions | None = None
) -> list[Path]:
    """Draw a filter, and with a log what it does to it, into a folder made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        out = [save(_response(filter_, section), folder / "lowpass_response.png")]
        if seen is not None:
            out.append(save(_on_log(filter_, section, seen), folder / "lowpass_log.png"))
        return out


def _title(section: LowPass) -> str:
    return f"{section.family}, order {section.order}, {section.cutoff_hz:g} Hz at {section.rate_hz:g} Hz"


def _response(filter_: Filter, section: LowPass) -> Figure:
    """Gain, group delay, step response and poles."""
    overshoot = (
        f"overshoots by {section.step['overshoot']:.1%}" if section.step["overshoot"] else "no overshoot"
    )
    note = (
        f"Slow motion arrives {number(section.dc_delay_s, 's')} late. A step rises in "
        f"{number(section.step['rise_s'], 's')} and stays within 2 % after "
        f"{number(section.step['settling_s'], 's')}; {overshoot}. Coefficients rounded to single precision."
    )
    figure = sheet(6.2, f"Low-pass: {_title(section)}", note, section.verdict)
    (gain, delay), (step, poles) = figure.subplots(2, 2)
    rate, cut = section.rate_hz, section.cutoff_hz
    f = np.geomspace(min(0.02 * cut, 1e-3 * rate), 0.4999 * rate, 800)
    _gain(gain, f, filter_, section)
    delay.plot(f, group_delay_s(filter_.sections, f, rate), color=BLUE, linewidth=2.0)
    delay.axvline(cut, color=VERMILLION, linewidth=1.4, linestyle="--")
    _logarithmic(delay)
    delay.set_xlim(f[0], 0.5 * rate)
    delay.set_ylim(0.0, 1.15 * max(section.largest_delay_s, section.dc_delay_s))
    delay.set_xlabel("frequency (Hz)")
    delay.set_ylabel("delay (s)")
    delay.set_title(f"Group delay: {number(section.dc_delay_s, 's')} at 0 Hz; red: cut-off")
    delay.grid()
    answer = step_response(filter_.sections, rate)
    last = max(1.6 * section.step["settling_s"], 8.0 / rate)
    step.axhspan(0.98, 1.02, color="#dff1ea", zorder=0)
    step.axhline(1.0, color=GREY, linewidth=0.8)
    step.plot(answer.t_s, answer.values, color=BLUE, linewidth=2.0)
    step.set_xlim(0.0, last)
    step.set_ylim(0.0, 1.08 + section.step["overshoot"])
    step.set_xlabel("time after the step (s)")
    step.set_ylabel("answer to a step of 1")
    step.set_title("Step response; green: within 2 %")
    step.grid()
    _poles(poles, section)
    return figure


def _plain_tick(value: float, _: float | None) -> str:
    return f"{value:g}"


def _logarithmic(axes: Axes) -> None:
    """A frequency axis whose ticks are plain numbers."""
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(_plain_tick)
    axes.xaxis.set_minor_formatter(NullFormatter())


def _gain(axes: Axes, f: FloatArray, filter_: Filter, section: LowPass) -> None:
    gain = decibels(frequency_response(filter_.sections, f, section.rate_hz))
    axes.plot(f, gain, color=BLUE, linewidth=2.0)
    axes.axvline(section.cutoff_hz, color=VERMILLION, linewidth=1.4, linestyle="--")
    if section.log is not None:
        grid = [value for axis in section.log.axes.values() for value in axis.quantisation_hz]
        if grid:
            axes.axvspan(min(grid), max(grid), color="#fdeccc", zorder=0)
    _logarithmic(axes)
    axes.set_xlim(f[0], 0.5 * section.rate_hz)
    axes.set_ylim(_LOWEST_DB, 5.0)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("gain (dB)")
    shaded = section.log is not None and any(a.quantisation_hz for a in section.log.axes.values())
    axes.set_title("Gain; red: cut-off" + ("; shaded: pixel grid crossed" if shaded else ""))
    axes.grid()


def _poles(axes: Axes, section: LowPass) -> None:
    """Poles in the z plane, drawn around the part of the unit circle where they lie."""
    z = np.array(section.poles)
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor=GREY, linewidth=1.2))
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    reach = 1.35 * max(float(np.abs(z[:, 1]).max()), 1.0 - float(z[:, 0].min()), 0.02)
    reach = min(reach, 1.1)
    axes.scatter(z[:, 0], z[:, 1], marker="x", s=60, color=VERMILLION, linewidths=2.0, zorder=3)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(1.0 - 1.6 * reach, 1.0 + 0.6 * reach)
    axes.set_ylim(-reach, reach)
    axes.set_xlabel("real part")
    axes.set_ylabel("imaginary part")
    axes.set_title("Poles; grey: unit circle")
    axes.grid()


def log_window(t_s: FloatArray, values: FloatArray, length_s: float = _WINDOW_S) -> slice:
    """The window of a length [s] in which coordinates (n, 2) reach farthest, in half-window steps."""
    if t_s[-1] - t_s[0] <= 1.25 * length_s:
        return slice(0, len(t_s))
    count = int(np.searchsorted(t_s, t_s[0] + length_s))
    starts = range(0, len(t_s) - count + 1, max(1, count // 2))
    best = max(starts, key=lambda i: float(np.ptp(values[i : i + count], axis=0).max()))
    return slice(best, best + count)


def _on_log(filter_: Filter, section: LowPass, seen: Positions) -> Figure:
    """Each coordinate before and after the filter, and its spectrum."""
    told = section.log
    assert told is not None
    parts = [
        f"{name} from {number(axis.jitter_before, told.unit)} to {number(axis.jitter_after, told.unit)}"
        for name, axis in told.axes.items()
    ]
    note = (
        f"{plain(told.name, 60)}. Jitter (standard deviation): {', '.join(parts)}. The filtered line is "
        f"{number(section.dc_delay_s, 's')} late and starts without a transient."
    )
    figure = sheet(6.2, f"A log before and after the low-pass: {_title(section)}", note, section.verdict)
    panels = figure.subplots(2, 2, width_ratios=[1.75, 1.0])
    piece = seen.ticks.longest
    scale = 1e3 if seen.unit == "m" else 1.0
    window = log_window(piece.t_s, piece.values)
    filtered = filter_signal(filter_.sections, piece.values)
    for i, (name, of) in enumerate(zip(seen.names, seen.spectra, strict=True)):
        left, right = panels[i]
        t = piece.t_s[window]
        left.plot(t, scale * piece.values[window, i], color=BLUE, linewidth=0.9)
        left.plot(t, scale * filtered[window, i], color=ORANGE, linewidth=2.2)
        left.set_xlim(t[0], t[-1])
        _without_outliers(left, scale * piece.values[window, i])
        left.set_xlabel("time (s)")
        left.set_ylabel(f"{name} ({told.unit})")
        left.set_title(f"{name}; blue: as logged, orange: filtered")
        left.grid()
        _spectrum(right, of, filter_, scale, name, told.unit)
    return figure


def _without_outliers(axes: Axes, values: FloatArray) -> None:
    """Limits that a few outliers do not widen."""
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.12 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)


def _spectrum(axes: Axes, of: Spectrum, filter_: Filter, scale: float, name: str, unit: str) -> None:
    """Amplitude density of motion and jitter, before and after."""
    whole = scale * np.sqrt(of.motion_density + of.jitter_density)
    if not np.any(whole > 0.0):
        empty(axes, f"{name} never changes", 24)
        return
    H = np.abs(frequency_response(filter_.sections, of.f_hz, of.rate_hz))
    shown = whole > 0.0
    axes.plot(of.f_hz[shown], whole[shown], color=BLUE, linewidth=1.4)
    axes.plot(of.f_hz[shown], (whole * H)[shown], color=ORANGE, linewidth=1.8)
    axes.axhline(scale * np.sqrt(of.floor), color=GREEN, linewidth=1.4, linestyle="--")
    if of.motion_hz > 0.0:
        axes.axvline(of.motion_hz, color=INK, linewidth=1.2, linestyle=":")
    _logarithmic(axes)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_plain_tick)
    axes.yaxis.set_minor_formatter(NullFormatter())
    top = float(whole.max())
    axes.set_ylim(max(1e-3 * float(np.median(whole[shown])), 1e-7 * top), 2.0 * top)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel(f"{unit} per root Hz")
    axes.set_title("Spectrum; green: jitter's floor")
    axes.grid()
