"""Figures of an identification, of a pump and of a validation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.core import plot
from calib.core.arrays import FloatArray, rms
from calib.stages.actuator.identify import autocorrelation
from calib.stages.actuator.identify_pump import PumpFound
from calib.stages.actuator.results import Identified, simulated_heads
from calib.stages.actuator.section import LAG, ORIFICE, Actuator, PumpSection, label_of
from calib.stages.actuator.stage import Springs, Validated
from calib.stages.actuator.validate import CALLED, IMPROVED, NOMINAL, ORIGINAL, QUANTITIES, Comparison

_HUES = ("blue", "green", "orange", "grey")

# ----------------------------------------------------------------------
# An identification: simulated against measured, residuals, parameters, the springs' law.

_MOST_LOGS = 6
_MOST_S = 20.0
_LAGS = 30
_PROSPECTS = (
    ("red", "points"), ("green", "squares"), ("orange", "diamonds"), ("grey", "pluses"), ("ink", "crosses")
)  # fmt: skip


def plots(outcome: tuple[Actuator, PumpSection | None] | Actuator | PumpSection) -> dict[str, plot.Figure]:
    """`identify_motion`, `_residuals`, `_parameters` and, where a log is a free swing, `_damping`.

    Each section of an identification has them all.
    """
    one = outcome[0] if isinstance(outcome, tuple) else outcome
    result: Identified = one.evidence
    figures = {
        "identify_motion": _motion(result),
        "identify_residuals": _residuals(result),
        "identify_parameters": _parameters(result),
    }
    figures |= {"identify_damping": _damping(result)} if result.decrements else {}
    return plot.judged(figures, result.verdict.word)


def _motion(result: Identified) -> plot.Figure:
    """Angle and length of each log, measured and simulated with the identified parameters."""
    tracks = list(result.solution.problem.tracks)[:_MOST_LOGS]
    note = (
        "Points are from the logs. Lines are simulated with the identified parameters from the commands and "
        f"the start alone. At most the first {_MOST_S:g} s of {_MOST_LOGS} logs are drawn."
    )
    panels = []
    for track, head in zip(tracks, simulated_heads(result.solution), strict=False):
        some = track.t_s <= _MOST_S
        t = track.t_s[some]
        for column, (scale, y) in enumerate(((1.0, "angle (rad)"), (1e3, "length (mm)"))):
            measured, simulated = scale * track.head[some, column], scale * head[some, column]
            marks = (_measured(t, measured), plot.Curve(t, simulated, "simulated", size=1.0))
            spread = 0.3 * max(float(np.ptp(simulated)), 1e-3 * scale)
            # A picture with another thing in place of the marker is far away; the curve is what counts.
            limits = (float(simulated.min()) - spread, float(simulated.max()) + spread)
            panels.append(
                plot.Plot("time (s)", y, marks, "" if column else plot.short(track.name, 40), y_limits=limits)
            )
    high = 2.0 * len(tracks) + 0.3
    return plot.Figure("Simulated against measured", note, panels, high, columns=2)


def _measured(t: FloatArray, values: FloatArray) -> plot.Curve:
    return plot.Curve(plot.every(t), plot.every(values), "measured", "cloud", "grey")


def _residuals(result: Identified) -> plot.Figure:
    """Correlation of each log's residuals with themselves, and how they are distributed."""
    note = (
        "Residuals are divided by their standard deviation. On the left is their correlation with the rows "
        "after: white ones stay within the grey band (95 %). On the right is their distribution beside a "
        "normal one."
    )
    rows, lags = [], np.arange(1, _LAGS)
    marks: list[plot.Mark] = []
    for span in result.solution.problem.spans:
        residual = result.solution.residual[span]
        r, c = residual.reshape(-1, 2), autocorrelation(residual, _LAGS - 1)
        rows.append(r / np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9))
        marks.append(plot.Curve(lags, c[:, 0], "first component", size=0.8))
        marks.append(plot.Curve(lags, c[:, 1], "second component", colour="orange", size=0.8))
    white = 1.96 / np.sqrt(min(len(z) for z in rows))
    x = np.linspace(-5.0, 5.0, 201)
    normal = plot.Curve(x, np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi), "normal", colour="red")
    bars = plot.histogram(np.clip(np.concatenate(rows).ravel(), -5.0, 5.0), 50, -5.0, 5.0, density=True)
    panels = (
        plot.Plot("lag (rows)", "correlation", (plot.Band("y", -white, white), *marks)),
        plot.Plot("residual / deviation", "density", (replace(bars, colour="silver"), normal)),
    )
    return plot.Figure("Residuals", note, panels, 3.5, columns=2)


def _parameters(result: Identified) -> plot.Figure:
    """Relative deviation of each parameter now and after one more experiment."""
    names = list(result.solution.problem.names)
    note = "Bars are the standard deviation over the value from these logs, points with one more recording."
    sigma, values = result.uncertainty.sigma, result.solution.values
    now = np.array([100.0 * sigma[name] / max(abs(values[name]), 1e-12) for name in names])
    marks: list[plot.Mark] = [plot.Bars(np.arange(len(names)), now, 0.6, "ice", across=True)]
    for one, (hue, kind) in zip(result.prospects, _PROSPECTS, strict=False):
        after = 100.0 * np.array([one.relative.get(name, np.nan) for name in names])
        marks.append(plot.Curve(after, np.arange(len(names)), one.name, kind, hue, 5.0))
    labels = tuple(map(label_of, names))
    title = f"What is known of the parameters ({plot.SIGMA} / value)"
    panel = plot.Plot("%", "", marks, grid="x", names=labels)
    return plot.Figure(title, note, (panel,), 1.1 + 0.36 * len(names))


def _damping(result: Identified) -> plot.Figure:
    """Swings with the peaks that the logarithmic decrement took."""
    note = "These peaks were used for the damping by the logarithmic decrement (3.39), (3.40)."
    panels: list[plot.Plot] = []
    for track in result.solution.problem.tracks:
        if track.name in result.decrements and len(panels) < _MOST_LOGS:
            d, of_fit = result.decrements[track.name]
            marks = (
                plot.Curve(track.t_s, track.head[:, 0], colour="grey", size=0.7),
                plot.Curve(d.peak_at_s, d.peak, kind="points", colour="red"),
            )
            top = 1.3 * float(np.abs(d.peak).max())
            fitted = "" if of_fit is None else f", that of the fit {of_fit:.4f}"
            title = (
                f"{plot.short(track.name, 30)}: zeta {d.zeta:.4f} \N{PLUS-MINUS SIGN} {d.sigma:.1g}{fitted}"
            )
            panels.append(plot.Plot("time (s)", "angle (rad)", marks, title, y_limits=(-top, top)))
    whole = panels or (plot.Plot(empty="no free swing with enough peaks"),)
    return plot.Figure("Damping by peaks", note, whole, 2.1 * len(whole))


def stiffness_plots(section: Actuator) -> dict[str, plot.Figure]:
    """`identify_stiffness`: force (Fig. 3.9) and stiffness (Fig. 3.10) over elongation."""
    found: Springs = section.evidence
    elongation_m, force_N = found.elongation_m, found.force_N
    x = np.linspace(0.0, 1.05 * float(np.max(np.abs(elongation_m))), 200)[1:]
    some = np.abs(elongation_m) > 1e-9
    eps, stiffness = 1e3 * elongation_m, force_N[some] / elongation_m[some]
    left: list[plot.Mark] = [plot.Curve(eps, force_N, "measured", "points", "ink")]
    right: list[plot.Mark] = [plot.Curve(eps[some], stiffness, "measured", "points", "ink")]
    for k, (fit, hue) in enumerate(zip(found.fits, ("orange", "blue", "green"), strict=False)):
        name, size = f"order {fit.order}", 2.0 if k == found.used else 0.9
        left.append(plot.Curve(1e3 * x, fit.force_N(x), name, "line", hue, size))
        right.append(plot.Curve(1e3 * x, fit.force_N(x) / x, name, "line", hue, size))
    panels = tuple(
        plot.Plot("elongation (mm)", y, marks)
        for y, marks in (("force (N)", left), ("stiffness (N/m)", right))
    )
    note = "The laws go through zero; the thick one is used."
    return {"identify_stiffness": plot.Figure("Springs", note, panels, 3.5, columns=2)}


# ----------------------------------------------------------------------
# A pump's identification: both models against the recordings, residuals, the static map.

_MODELS = {LAG: "orange", ORIFICE: "blue"}
_MOST_RUNS = 12


def pump_plots(section: PumpSection) -> dict[str, plot.Figure]:
    """`pump_runs` and `pump_residuals` of recordings, and `pump_static`."""
    result: PumpFound = section.evidence
    figures = {}
    if result.records:
        figures["pump_runs"] = _runs(result)
        figures["pump_residuals"] = _left_over(result)
    if result.maps or result.groups:
        figures["pump_static"] = _static(result)
    return plot.judged(figures, section.verdict.word)


def _runs(result: PumpFound) -> plot.Figure:
    """Each recording with both models, simulated from its PWM and its first fifth of a second."""
    records = result.records[:_MOST_RUNS]
    note = (
        "Points are measured, lines simulated from the PWM and the first 0.2 s. Each title has the RMS of "
        "linear lag / orifice flow, fitted without that file where there are several."
    )
    held = {model: {one.name: one.rms for one in result.held[model]} for model in result.fits}
    longest = max(float(record.t_s[-1] - record.t_s[0]) for record in records)
    panels = []
    for i, record in enumerate(records):
        t, errors = record.t_s - record.t_s[0], []
        marks = [plot.Curve(t, record.value, "measured", "points", "grey", 2.5)]
        for model, fit in result.fits.items():
            simulated = fit.run(record)
            marks.append(plot.Curve(t, simulated, model, "line", _MODELS[model], 1.1))
            off = held[model].get(record.name, rms(simulated - record.value))
            errors.append(f"{off:.2f}")
        title = f"{plot.short(record.name, 20)}: {' / '.join(errors)}"
        x, y = "time (s)" if i + 3 >= len(records) else "", "" if i % 3 else result.unit
        panels.append(plot.Plot(x, y, marks, title, (0.0, longest)))
    title, high = "The pump's models against the recordings", 2.1 * -(-len(records) // 3) + 0.3
    return plot.Figure(title, note, panels, high, columns=3)


def _left_over(result: PumpFound) -> plot.Figure:
    """Measured minus simulated over time, a panel for each model and a line for each recording."""
    note = (
        "This is measured minus simulated. Runs that leave the model are red: the PWM does not explain them."
    )
    gone = {one.name for one in result.departs}
    errors = {
        model: [one.value - fit.run(one) for one in result.records] for model, fit in result.fits.items()
    }
    most = 1.05 * max(float(np.abs(error).max()) for of_model in errors.values() for error in of_model) or 1.0
    panels: list[plot.Plot] = []
    for model, of_model in errors.items():
        marks = tuple(
            plot.Curve(one.t_s - one.t_s[0], error, colour="red" if one.name in gone else "grey", size=0.8)
            for one, error in zip(result.records, of_model, strict=True)
        )
        y = "" if panels else f"error ({result.unit})"
        panels.append(plot.Plot("time (s)", y, marks, model, y_limits=(-most, most)))
    return plot.Figure("What is left over", note, panels, 3.0, columns=len(panels))


def _static(result: PumpFound) -> plot.Figure:
    """Settled values over PWM with the fitted maps, and where the recordings settle."""
    note = "Points are settled values, crosses outliers, lines the fitted map, squares ends of recordings."
    u = np.linspace(0.0, 255.0, 400)
    marks: list[plot.Mark] = []
    for m, hue in zip(result.maps, _HUES * len(result.maps), strict=False):
        far = np.isin(m.pwm, m.fit.outliers_pwm)
        marks.append(plot.Curve(m.pwm[~far], m.value[~far], kind="points", colour=hue))
        marks.append(plot.Curve(m.pwm[far], m.value[far], kind="crosses", colour=hue, size=5.0))
        marks.append(plot.Curve(u, m.of(u), plot.short(m.name, 50), colour=hue))
    for group in result.groups:
        at, value = np.array(group.pwm[1:2]), np.array([group.value])
        marks.append(plot.Curve(at, value, kind="squares", colour="red", size=5.0))
        marks.append(plot.Text(at[0] - 3.0, value[0], f"{len(group.files)} runs", align="right"))
    return plot.Figure("Static map", note, (plot.Plot("PWM", result.unit, marks),), 3.6)


# ----------------------------------------------------------------------
# A validation: what was measured, with the curves of the models over it.

_VALIDATED = {ORIGINAL: "orange", NOMINAL: "green", IMPROVED: "blue"}
_SCALES = {
    "q1": (1e3, "length of bellows 1 (mm)"),
    "q2": (1e3, "length of bellows 2 (mm)"),
    "phi": (1.0, "angle (rad)"),
}


def validate_plots(outcome: Validated) -> dict[str, plot.Figure]:
    """`validate_model`, or `validate_model_1`, ... of several logs."""
    compared = outcome.compared
    several = len(compared) > 1
    return {
        f"validate_model_{k}" if several else "validate_model": _validation(one)
        for k, one in enumerate(compared, start=1)
    }


def _validation(one: Comparison) -> plot.Figure:
    """Bellows and angle of one log, measured and simulated, and beside them the errors."""
    # A model's motion may end before the log does.
    known = [model for model, curves in one.simulated.items() if np.isfinite(curves).all()]
    rms = {model: {name: error.rms for name, error in one.errors[model].items()} for model in known}
    parts = [
        f"{CALLED[model]} {plot.number(1e3 * of['q1'], 'mm')}, {plot.number(1e3 * of['q2'], 'mm')}, "
        f"{plot.number(of['phi'], 'rad')}"
        for model, of in rms.items()
    ]
    parts += [
        f"{CALLED[model]} unknown, it ends before the log" for model in one.simulated if model not in known
    ]
    note = (
        "Points are from the log, lines are simulated from commands and start alone. RMS errors of q1, q2 "
        "and phi are, model by model: " + "; ".join(parts) + "."
    )
    some = one.t_s <= _MOST_S
    t = one.t_s[some]
    panels = []
    for row, name in enumerate(QUANTITIES):
        scale, y = _SCALES[name]
        measured = scale * one.measured[some, row]
        left: list[plot.Mark] = [_measured(t, measured)]
        right: list[plot.Mark] = [plot.Rule("y", 0.0)]
        for model in known:
            simulated = scale * one.simulated[model][some, row]
            left.append(plot.Curve(t, simulated, CALLED[model], "line", _VALIDATED[model], 1.1))
            right.append(plot.Curve(t, measured - simulated, "", "line", _VALIDATED[model], 0.9))
        x, limits = "time (s)" if row == len(QUANTITIES) - 1 else "", (float(t[0]), float(t[-1]))
        panels.append(plot.Plot(x, y, left, "" if row else "Curves", limits))
        panels.append(plot.Plot(x, "", right, "" if row else "Measured less simulated", limits))
    title = f"Model against log: {plot.short(one.name, 50)}"
    return plot.Figure(title, note, panels, 6.6, columns=2, widths=(1.5, 1.0))
