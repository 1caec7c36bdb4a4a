"""Figures of a replay: states with their 2-sigma bands, innovations, and the baseline beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.core import plot
from calib.core.arrays import FloatArray, runs
from calib.stages.estimator.kinematic import OUT

if TYPE_CHECKING:
    from calib.stages.estimator.section import Replayed

_BASELINE = len(OUT)
_TRUTH = len(OUT) + 3
_QUANTITIES = (
    ("bellows 1 (mm)", "q1_m", "sigma_q1_m", 1e3),
    ("bellows 2 (mm)", "q2_m", "sigma_q2_m", 1e3),
    ("angle (degrees)", "phi_rad", "sigma_phi_rad", float(np.degrees(1.0))),
)
_SENSORS = (
    ("camera u, v", ("e_u", "e_v"), "gated_camera"),
    ("accelerometer x, y", ("e_ax", "e_ay"), "gated_accel"),
    ("gyroscope z", ("e_gz",), "gated_gyro"),
)
_TWO = ("blue", "grey")
_INNOVATIONS = [OUT.index(name) for _, names, _ in _SENSORS for name in names]


def plots(outcome: list[Replayed] | Replayed) -> dict[str, plot.Figure]:
    """`replay_<log>_states`, `_innovations` and, with a truth, `_errors` of each log."""
    results, figures = outcome if isinstance(outcome, list) else [outcome], {}
    stems = [Path(one.source).stem for one in results]
    for k, (result, stem) in enumerate(zip(results, stems, strict=True)):
        name = f"replay_{stem}_{k + 1}" if stems.count(stem) > 1 else f"replay_{stem}"
        figures[f"{name}_states"] = _states(result)
        if np.isfinite(result.evidence.trace[:, _INNOVATIONS]).any():
            figures[f"{name}_innovations"] = _innovations(result)
        if np.isfinite(result.evidence.trace[:, _TRUTH]).any():
            figures[f"{name}_errors"] = _errors(result)
    return figures


def _named(trace: FloatArray, name: str) -> FloatArray:
    return np.asarray(trace[:, OUT.index(name)])


def _figure(title: str, note: str, result: Replayed, panels: Sequence[plot.Plot]) -> plot.Figure:
    """Panels over the same time, its name under the last one."""
    t = _named(result.evidence.trace, "t_s")
    shared = [replace(one, x_limits=(float(t[0]), float(t[-1]))) for one in panels]
    shared[-1] = replace(shared[-1], x="time (s)")
    title = f"{title}: {plot.short(result.source, 78)}"
    return plot.Figure(title, note, shared, 6.6, result.verdict.word)


def _line(t: FloatArray, values: FloatArray, label: str, colour: str, size: float = 0.9) -> list[plot.Mark]:
    known = bool(np.isfinite(values).any())
    return [plot.Curve(*plot.thinned(t, values), label, "line", colour, size)] if known else []


def _states(result: Replayed) -> plot.Figure:
    """Lengths and angle over time with their bands, the baseline and the truth where it is known."""
    trace, t = result.evidence.trace, _named(result.evidence.trace, "t_s")
    note = (
        f"Blue is the estimate with its 2{plot.SIGMA} band, orange the source's pipeline with its 1 Hz "
        "low-pass, black the truth, where the log knows it. Red marks are pictures that were gated out."
    )
    gated = _named(trace, "gated_camera") == 1.0
    # NaN where there is no driven model.
    kinematic = _named(trace, "driven_weight") < 0.5
    stretches = [plot.Band("x", t[i], t[j - 1], colour="ochre") for i, j in runs(kinematic)]
    if stretches:
        note += " Where it is shaded the kinematic model speaks."
    panels = []
    for k, (y, name, sigma, factor) in enumerate(_QUANTITIES):
        value, spread = factor * _named(trace, name), 2.0 * factor * _named(trace, sigma)
        marks = [
            *stretches,
            plot.Ribbon(plot.every(t), plot.every(value - spread), plot.every(value + spread)),
            *_line(t, factor * trace[:, _BASELINE + k], "baseline", "orange"),
            *_line(t, factor * trace[:, _TRUTH + k], "truth", "ink", 1.4),
            *_line(t, value, "estimate", "blue"),
        ]
        if gated.any():
            marks.append(
                plot.Curve(
                    plot.every(t[gated]), plot.every(value[gated]), "gated picture", "marks", "red", 6.0
                )
            )
        # The bands of the start would press all else flat.
        panels.append(plot.Plot("", y, marks, y_limits=plot.central(value, 0.5, 0.25)))
    return _figure("States", note, result, panels)


def _innovations(result: Replayed) -> plot.Figure:
    """Innovations of each sensor over their standard deviation, gated ones marked."""
    trace, t = result.evidence.trace, _named(result.evidence.trace, "t_s")
    note = (
        f"An honest covariance keeps 95 % within the grey band of 2{plot.SIGMA}, without a pattern. "
        "Red ones were gated out and not used; marks at the edge lie beyond it."
    )
    panels = []
    for y, names, gate in _SENSORS:
        marks: list[plot.Mark] = [plot.Band("y", -2.0, 2.0)]
        gated = _named(trace, gate) == 1.0
        for name, colour in zip(names, _TWO, strict=False):
            value = np.clip(_named(trace, name), -5.8, 5.8)
            some = plot.every(np.flatnonzero(~gated & np.isfinite(value)))
            marks.append(plot.Curve(t[some], value[some], kind="cloud", colour=colour))
            marks.append(plot.Curve(t[gated], value[gated], kind="crosses", colour="red"))
        empty = "" if np.isfinite(_named(trace, names[0])).any() else "not sampled"
        panels.append(plot.Plot("", y, marks, y_limits=(-6.0, 6.0), grid="y", empty=empty))
    return _figure("Innovations", note, result, panels)


def _errors(result: Replayed) -> plot.Figure:
    """Errors against the truth with the 2-sigma band, the baseline's beside them."""
    trace, t = result.evidence.trace, _named(result.evidence.trace, "t_s")
    note = (
        f"Grey is 2{plot.SIGMA} of the estimate, blue its error, orange the error of the source's pipeline."
    )
    panels = []
    for k, (y, name, sigma, factor) in enumerate(_QUANTITIES):
        truth, spread = trace[:, _TRUTH + k], 2.0 * factor * plot.every(_named(trace, sigma))
        other, error = factor * (trace[:, _BASELINE + k] - truth), factor * (_named(trace, name) - truth)
        marks = [
            plot.Ribbon(plot.every(t), -spread, spread),
            *_line(t, other, "baseline", "orange"),
            *_line(t, error, "estimate", "blue"),
        ]
        panels.append(
            plot.Plot("", y, marks, y_limits=plot.central(np.concatenate([error, other]), 0.5, 0.25))
        )
    return _figure("Errors", note, result, panels)
