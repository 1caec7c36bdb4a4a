"""Figures of the low-pass: its gain, delay and step response, and a log before and after it (Fig. 2.10)."""

from __future__ import annotations

import numpy as np

from calib.core import plot
from calib.core.arrays import FloatArray
from calib.stages.lowpass import filters, jitter
from calib.stages.lowpass.section import LowPass

_WINDOW_S = 12.0
"""Length of a log that is drawn: its livelier part."""
_LOWEST_DB = -80.0


def plots(section: LowPass) -> dict[str, plot.Figure]:
    """`lowpass_response`, and with the log's positions `lowpass_log`."""
    filter_, positions = section.evidence.filter, section.evidence.positions
    design = f"{section.family}, order {section.order}, {section.cutoff_hz:g} Hz at {section.rate_hz:g} Hz"
    figures = {"lowpass_response": _response(filter_, section, design)}
    if positions is not None:
        figures["lowpass_log"] = _on_log(filter_, section, positions, design)
    return figures


def _response(filter_: filters.Filter, section: LowPass, design: str) -> plot.Figure:
    """Gain, group delay, step response and poles."""
    step, rate, cut = section.step, section.rate_hz, section.cutoff_hz
    overshoot = f"it overshoots by {step['overshoot']:.1%}" if step["overshoot"] else "it does not overshoot"
    note = (
        f"Slow motion arrives {plot.number(section.dc_delay_s, 's')} late. A step rises in "
        f"{plot.number(step['rise_s'], 's')} and stays within 2 % after "
        f"{plot.number(step['settling_s'], 's')}; {overshoot}. The coefficients are rounded to "
        "single precision."
    )
    f = np.geomspace(min(0.02 * cut, 1e-3 * rate), 0.4999 * rate, 800)
    x, limits, at_cut = "frequency (Hz)", (float(f[0]), 0.5 * rate), plot.Rule("x", cut, "red", "dashed")
    grid = [hz for axis in section.log.axes.values() for hz in axis.quantisation_hz] if section.log else []
    crossed: list[plot.Mark] = [plot.Band("x", min(grid), max(grid), colour="ochre")] if grid else []
    marks = (
        *crossed,
        plot.Curve(f, filters.decibels(filters.frequency_response(filter_.sections, f, rate)), size=2.0),
        at_cut,
    )
    title = "Gain; red: cut-off" + ("; shaded: pixel grid crossed" if grid else "")
    gain = plot.Plot(x, "gain (dB)", marks, title, limits, (_LOWEST_DB, 5.0), log="x")
    late = (plot.Curve(f, filters.group_delay_s(filter_.sections, f, rate), size=2.0), at_cut)
    most = 1.15 * max(section.largest_delay_s, section.dc_delay_s)
    title = f"Group delay: {plot.number(section.dc_delay_s, 's')} at 0 Hz; red: cut-off"
    delay = plot.Plot(x, "delay (s)", late, title, limits, (0.0, most), log="x")
    answer = filters.step_response(filter_.sections, rate)
    within, curve = plot.Band("y", 0.98, 1.02, colour="mint"), plot.Curve(answer.t_s, answer.values, size=2.0)
    x, y, title = "time after the step (s)", "answer to a step of 1", "Step response; green: within 2 %"
    limits, high = (0.0, max(1.6 * step["settling_s"], 8.0 / rate)), 1.08 + step["overshoot"]
    rise = plot.Plot(x, y, (within, plot.Rule("y", 1.0), curve), title, limits, (0.0, high))
    panels = (gain, delay, rise, _poles(np.array(section.poles)))
    return plot.Figure(f"Low-pass: {design}", note, panels, 6.2, section.verdict.word, columns=2)


def _poles(z: FloatArray) -> plot.Plot:
    """Poles (n, 2) in the z plane, drawn around the part of the unit circle where they lie."""
    reach = 1.35 * max(float(np.abs(z[:, 1]).max()), 1.0 - float(z[:, 0].min()), 0.02)
    reach = min(reach, 1.1)
    marks = (
        plot.Shape(plot.circle(0.0, 0.0, 1.0), edge="grey"),
        plot.Rule("y", 0.0),
        plot.Curve(z[:, 0], z[:, 1], kind="crosses", colour="red", size=8.0),
    )
    x_limits, y_limits = (1.0 - 1.6 * reach, 1.0 + 0.6 * reach), (-reach, reach)
    title = "Poles; grey: unit circle"
    return plot.Plot("real part", "imaginary part", marks, title, x_limits, y_limits, equal=True)


def _on_log(
    filter_: filters.Filter, section: LowPass, positions: jitter.Positions, design: str
) -> plot.Figure:
    """Each coordinate before and after the filter, and its spectrum."""
    log = section.log
    assert log is not None
    jitter = ", ".join(
        f"in {name} from {plot.number(axis.jitter_before, log.unit)} "
        f"to {plot.number(axis.jitter_after, log.unit)}"
        for name, axis in log.axes.items()
    )
    note = (
        f"The jitter of {plot.short(log.name, 60)} (standard deviation) goes {jitter}. The filtered line is "
        f"{plot.number(section.dc_delay_s, 's')} late and starts without a transient."
    )
    piece = positions.ticks.longest
    scale = positions.scale
    window = _window(piece.t_s, piece.values)
    t, before = piece.t_s[window], scale * piece.values[window]
    after = scale * filters.filter_signal(filter_.sections, piece.values)[window]
    panels = []
    for name, of, old, new in zip(positions.names, positions.spectra, before.T, after.T, strict=True):
        curves = (plot.Curve(*plot.thinned(t, old), size=0.9), plot.Curve(t, new, colour="orange", size=2.2))
        words, x_limits = f"{name}; blue: as logged, orange: filtered", (float(t[0]), float(t[-1]))
        limits = plot.central(old, 0.5, 0.12)
        panels.append(plot.Plot("time (s)", f"{name} ({log.unit})", curves, words, x_limits, limits))
        panels.append(_spectrum(of, filter_, scale, name, log.unit))
    title = f"A log before and after the low-pass: {design}"
    return plot.Figure(title, note, panels, 6.2, section.verdict.word, columns=2, widths=(1.75, 1.0))


def _window(t_s: FloatArray, values: FloatArray) -> slice:
    """The window in which coordinates (n, 2) reach farthest, in half-window steps."""
    if t_s[-1] - t_s[0] <= 1.25 * _WINDOW_S:
        return slice(0, len(t_s))
    count = int(np.searchsorted(t_s, t_s[0] + _WINDOW_S))
    starts = range(0, len(t_s) - count + 1, max(1, count // 2))
    best = max(starts, key=lambda i: float(np.ptp(values[i : i + count], axis=0).max()))
    return slice(best, best + count)


def _spectrum(of: jitter.Spectrum, filter_: filters.Filter, scale: float, name: str, unit: str) -> plot.Plot:
    """Amplitude density of motion and jitter, before and after."""
    whole = scale * np.sqrt(of.motion_density + of.jitter_density)
    some = whole > 0.0
    if not np.any(some):
        return plot.Plot("frequency (Hz)", title="Spectrum", empty=f"{name} never changes")
    f, whole, top = of.f_hz[some], whole[some], float(whole.max())
    H = np.abs(filters.frequency_response(filter_.sections, f, of.rate_hz))
    marks: list[plot.Mark] = [
        plot.Curve(f, whole, size=1.4),
        plot.Curve(f, whole * H, colour="orange", size=1.8),
        plot.Rule("y", scale * float(np.sqrt(of.floor)), "green", "dashed"),
    ]
    if of.motion_hz > 0.0:
        marks.append(plot.Rule("x", of.motion_hz, "ink", "dotted"))
    x, y, title = "frequency (Hz)", f"{unit} per root Hz", "Spectrum; green: jitter's floor"
    limits = max(1e-3 * float(np.median(whole)), 1e-7 * top), 2.0 * top
    return plot.Plot(x, y, marks, title, y_limits=limits, log="xy")
