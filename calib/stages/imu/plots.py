"""Figures of an IMU: at rest, in poses, its drift, the tuning of its filter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.core import plot
from calib.core.arrays import FloatArray, blocks
from calib.stages.imu.allan import model_variance
from calib.stages.imu.drift import LogDrift
from calib.stages.imu.intrinsics import Accelerometer, Intrinsics
from calib.stages.imu.mahony import Mahony, filter_log, wrapped
from calib.stages.imu.section import Drift, Imu, ImuIntrinsics, OrientationFilter
from calib.stages.imu.static import AxisNoise, Static, StaticLog
from calib.stages.imu.tuning import Piece, Tuning

# ----------------------------------------------------------------------
# At rest: Allan deviation with what explains it, readings over time, drift by log.

_UNITS = {
    "g": ("rad/s/\N{SQUARE ROOT}Hz", "rad/s", "rad/s\N{SUPERSCRIPT TWO}/\N{SQUARE ROOT}Hz"),
    "a": (
        "m/s\N{SUPERSCRIPT TWO}/\N{SQUARE ROOT}Hz",
        "m/s\N{SUPERSCRIPT TWO}",
        "m/s\N{SUPERSCRIPT THREE}/\N{SQUARE ROOT}Hz",
    ),
}
"""Of N, of B and the readings, and of K, by the first letter of an axis."""
_NAMES = {"g": f"rate ({_UNITS['g'][1]})", "a": f"specific force ({_UNITS['a'][1]})"}
_TAU = "\N{GREEK SMALL LETTER TAU}"


def static_plots(imu: Imu) -> dict[str, plot.Figure]:
    """`imu_allan`, `imu_drift`, and `imu_static_1`, ... for each log."""
    result: Static = imu.evidence
    figures = {"imu_allan": _allan(result), "imu_drift": _drift(result)}
    for i, log in enumerate(result.logs, start=1):
        figures[f"imu_static_{i}"] = _readings(result.axes, log)
    return plot.judged(figures, imu.verdict.word)


def _by_axis(axes: Sequence[str]) -> tuple[str, ...]:
    """Places of a panel for each axis of the sensor: gyroscope above, x to z from left to right."""
    letters = {axis: chr(ord("A") + k) for k, axis in enumerate(axes)}
    kinds = [kind for kind in "ga" if any(axis[0] == kind for axis in axes)]
    return tuple("".join(letters.get(kind + name, ".") for name in "xyz") for kind in kinds)


def _y(axis: str) -> str:
    """Name of the readings, beside the first panel of a row."""
    return _NAMES[axis[0]] if axis[1] == "x" else ""


def _allan(result: Static) -> plot.Figure:
    """Overlapping Allan deviation of each axis, its 1-sigma bounds, and the fitted N, B and K."""
    note = (
        f"Grey bands are 1{plot.SIGMA} bounds. White noise N falls with the root of the averaging time "
        f"{_TAU}, bias instability B is level, a random walk K of the bias rises. A line is drawn for "
        "what the logs show; \N{LESS-THAN SIGN} marks a bound of 95 % for what they are too short for."
    )
    mosaic = _by_axis(result.axes)
    panels = tuple(_deviation(noise) for noise in result.noise)
    return plot.Figure("Allan deviation at rest", note, panels, 2.75 * len(mosaic) + 0.25, mosaic=mosaic)


def _deviation(noise: AxisNoise) -> plot.Plot:
    """Allan deviation of one axis; what was fitted stands in the corner."""
    x, y = f"{_TAU} (s)", _y(noise.axis)
    a = noise.allan
    if a is None:
        return plot.Plot(x, y, title=noise.axis, empty="never changes")
    marks: list[plot.Mark] = [plot.Ribbon(a.tau_s, a.low, a.high)]
    parts = np.sqrt(model_variance(a.theta, a.tau_s))
    words = []
    terms = (("N", a.N, "blue"), ("B", a.B, "green"), ("K", a.K, "red"))
    for k, ((name, term, hue), unit) in enumerate(zip(terms, _UNITS[noise.axis[0]], strict=True)):
        if term.supported and a.theta[k] > 0.0:
            marks.append(plot.Curve(a.tau_s, parts[:, k], name, "dashed", hue, 1.1))
        bound = f"< {plot.number(term.below, unit, 2)}"
        words.append(f"{name} {plot.number(term.value, unit) if term.supported else bound}")
    some = (a.tau_s >= 0.999 * a.fit_s[0]) & (a.tau_s <= 1.001 * a.fit_s[1])
    whole = np.sqrt((parts**2).sum(axis=1))
    marks.append(plot.Curve(a.tau_s[some], whole[some], "fitted", colour="orange", size=2.2))
    marks.append(plot.Curve(a.tau_s, a.deviation, "measured", colour="ink", size=1.2))
    limits = (float(np.nanmin(a.low)) / 12.0, 1.6 * float(np.nanmax(a.high)))
    return plot.Plot(x, y, marks, noise.axis, y_limits=limits, log="xy", corner="\n".join(words))


def _readings(axes: Sequence[str], log: StaticLog) -> plot.Figure:
    """Readings of one log over time, means over a second, and where it moves."""
    moved = len(log.motions)
    note = "Grey are the readings, as the extremes of each bin, blue their means over a second. " + (
        "Red stretches were taken for motion and left out." if moved else "No motion was found."
    )
    period, zero = log.sampling.period_s, float(log.parts[0].t_s[0])
    bands = [plot.Band("x", one.from_s - zero, one.to_s - zero, colour="peach") for one in log.motions]
    size = max(1, round(1.0 / period))
    panels = []
    for k, axis in enumerate(axes):
        marks: list[plot.Mark] = list(bands)
        for part in log.parts:
            marks.append(
                plot.Curve(*plot.thinned(part.t_s - zero, part.values[:, k]), colour="silver", size=0.5)
            )
            means = blocks(part.values[:, k], size).mean(axis=1)
            middle = part.t_s[0] - zero + period * size * (np.arange(len(means)) + 0.5)
            marks.append(plot.Curve(middle, means, size=1.0))
        panels.append(plot.Plot("time (s)", _y(axis), marks, axis))
    title, mosaic = f"Readings at rest: {plot.short(log.source, 70)}", _by_axis(axes)
    return plot.Figure(title, note, panels, 2.2 * len(mosaic), mosaic=mosaic)


def _drift(result: Static) -> plot.Figure:
    """Drift of the angle in each log, by the gyroscope and by the chip (Fig. 2.4)."""
    note = (
        f"These are the slopes of -gz integrated and of the angle that the chip reports, with 2{plot.SIGMA}. "
        "The line is the mean of the logs, the band their standard deviation. A slope does not rank filters."
    )
    panels = []
    for title, drifts in (
        ("Gyroscope alone", [log.gyro for log in result.logs]),
        ("On the chip", [log.onchip for log in result.logs]),
    ):
        have = [(i, drift) for i, drift in enumerate(drifts, start=1) if drift is not None]
        if not have:
            panels.append(plot.Plot("log", title=title, empty="not logged, or the logs move"))
            continue
        at = np.array([i for i, _ in have])
        slope = np.degrees([drift.slope_radps for _, drift in have])
        sigma = np.nan_to_num(np.degrees([drift.sigma_radps for _, drift in have]))
        mean, spread = float(slope.mean()), float(slope.std(ddof=1)) if len(have) > 1 else 0.0
        marks = (
            plot.Band("y", mean - spread, mean + spread),
            plot.Rule("y", mean),
            plot.Rule("y", 0.0, "ink"),
            plot.Curve(at, slope, kind="points", size=7.0, spread=2.0 * sigma),
        )
        limits = (0.4, len(drifts) + 0.6)
        panels.append(plot.Plot("log", "slope (degrees/s)", marks, title, limits, whole="x", grid="y"))
    return plot.Figure("Drift of the angle, log by log", note, panels, 3.4, columns=2)


# ----------------------------------------------------------------------
# Intrinsics: where the poses lie, and what rests and turns are off by.

_MMPS2 = "mm/s\N{SUPERSCRIPT TWO}"
_DEGREE = "\N{DEGREE SIGN}"


def intrinsics_plots(section: ImuIntrinsics) -> dict[str, plot.Figure]:
    """`imu_poses` and `imu_residuals`."""
    result: Intrinsics = section.evidence
    return plot.judged(
        {"imu_poses": _poses(result), "imu_residuals": _residuals(result)}, section.verdict.word
    )


def _poses(result: Intrinsics) -> plot.Figure:
    """Which way was up in each rest, in the sensor's frame."""
    note = (
        f"Each point is a rest: the direction in the sensor's frame that was up. {len(result.rests)} rests "
        f"show {result.poses} poses."
    )
    if not result.planar:
        note += f" Rings are 30{_DEGREE}, 60{_DEGREE} and 90{_DEGREE} from the z axis; areas are true."
    panels: tuple[plot.Plot, ...]
    if result.accel is None:
        panels = (plot.Plot(empty="too few rests to tell their poses"),)
    elif result.planar:
        panels = (_disc(result.accel.directions, (90.0,), "", "In the plane of x and y"),)
    else:
        panels = tuple(_half(result.accel, sign) for sign in (1.0, -1.0))
    return plot.Figure("Poses of the IMU", note, panels, 4.3, columns=len(panels))


def _half(accel: Accelerometer, sign: float) -> plot.Plot:
    """The half of the sphere with z up or down, in Lambert's equal-area projection."""
    u = accel.directions
    here = u[u[:, 2] > 0.0] if sign > 0.0 else u[u[:, 2] <= 0.0]
    at = here[:, :2] / np.sqrt(1.0 + sign * here[:, 2:])
    words = "up" if sign > 0.0 else "down"
    return _disc(at, (90.0, 60.0, 30.0), "z" if sign > 0.0 else "-z", f"z axis {words}: {len(here)} rests")


def _disc(at: FloatArray, rings_deg: Sequence[float], centre: str, title: str) -> plot.Plot:
    """Points (n, 2) on a disc of radius 1 with rings at these angles from its centre."""
    marks: list[plot.Mark] = []
    for degrees in rings_deg:
        radius = math.sqrt(2.0) * math.sin(math.radians(degrees) / 2.0)
        marks.append(
            plot.Shape(plot.circle(0.0, 0.0, radius), "shade" if degrees == 90.0 else None, "silver")
        )
    for name, x, y in (("x", 1, 0), ("-x", -1, 0), ("y", 0, 1), ("-y", 0, -1), (centre, 0.03, 0.03)):
        marks.append(plot.Text(1.12 * x, 1.12 * y, name, "grey"))
    marks.append(plot.Curve(at[:, 0], at[:, 1], kind="points", size=6.0))
    return plot.Plot("", "", marks, title, (-1.25, 1.25), (-1.25, 1.25), equal=True, bare=True)


def _residuals(result: Intrinsics) -> plot.Figure:
    """What rests and turns are off by, and the threshold that was taken."""
    note = f"Bars are 2{plot.SIGMA} of a rest. "
    if result.accel is not None:
        rms = plot.number(1e3 * result.accel.rms_mps2, _MMPS2)
        note += f"The rests differ from g by {rms} (RMS). Red are the threshold taken and the turns' RMS."
    panels = (_rests(result), _thresholds(result), _turns(result))
    return plot.Figure("Residuals of rests and turns", note, panels, 5.4, mosaic=("AA", "BC"))


def _rests(result: Intrinsics) -> plot.Plot:
    accel, x, y = result.accel, "time (s)", f"residual ({_MMPS2})"
    title = "Length of the specific force less g, rest by rest"
    if accel is None:
        return plot.Plot(x, y, title=title, empty="too few rests for a fit")
    at = np.array([0.5 * (rest.from_s + rest.to_s) for rest in result.rests])
    points = plot.Curve(at, 1e3 * accel.residual_mps2, kind="points", spread=2e3 * accel.deviation_mps2)
    return plot.Plot(x, y, (plot.Rule("y", 0.0, "ink"), points), title, grid="y")


def _thresholds(result: Intrinsics) -> plot.Plot:
    title, x, y = "Threshold by residual", "multiple of the spread at rest", f"residual RMS ({_MMPS2})"
    tried = [
        (trial.multiple, 1e3 * trial.rms_mps2) for trial in result.trials if math.isfinite(trial.rms_mps2)
    ]
    if not tried:
        return plot.Plot(x, y, title=title, empty="too few rests to compare thresholds")
    multiple, rms = np.array(tried).T
    taken = multiple == result.multiple
    marks = (
        plot.Curve(multiple, rms, colour="ink", size=1.0),
        plot.Curve(multiple, rms, kind="points", colour="ink"),
        plot.Curve(multiple[taken], rms[taken], kind="points", colour="red", size=8.0),
    )
    return plot.Plot(x, y, marks, title, y_limits=(0.0, 1.15 * float(rms.max())))


def _turns(result: Intrinsics) -> plot.Plot:
    title, x, y = "Gravity missed after each turn", "turn", "angle (degrees)"
    if result.gyro is None:
        return plot.Plot(x, y, title=title, empty="no gyroscope, or no turn")
    missed = np.degrees(np.linalg.norm(result.gyro.residual_rad, axis=1))
    bars = plot.Bars(np.arange(1, len(missed) + 1), missed, 0.7)
    rms = plot.Rule("y", math.degrees(result.gyro.rms_rad), "red")
    return plot.Plot(x, y, (bars, rms), title, whole="x", grid="y")


# ----------------------------------------------------------------------
# The drift comparison: angles over a log at rest (Fig. 2.4), in motion (Fig. 2.6), slopes.

_METHODS = {
    "accelerometer alone": ("grey", 0.9),
    "gyroscope alone": ("red", 0.9),
    "MM 3/3": ("blue", 1.6),
    "tuned": ("purple", 1.4),
    "levelling": ("orange", 1.2),
    "levelling in three axes": ("ink", 1.2),
    "VQF": ("green", 0.9),
}
"""Those that are drawn in motion, with colour and width."""
_WINDOW_S = 12.0
_MOST_IN_LEGEND = 8
_PM = "\N{PLUS-MINUS SIGN}"


def drift_plots(drift: Drift) -> dict[str, plot.Figure]:
    """`drift_angles`, `drift_slopes` where there are any, and `drift_motion_1`, ... for logs that move."""
    logs: Sequence[LogDrift] = drift.evidence
    figures = {"drift_angles": _angles(logs)}
    if any(m.slope_degps is not None for log in logs for m in log.section.methods.values()):
        figures["drift_slopes"] = _slopes(logs)
    moving = {f"drift_motion_{i}": log for i, log in enumerate(logs, start=1) if log.section.moving_s > 0.0}
    return figures | {name: _in_motion(log) for name, log in moving.items()}


def _colours(logs: Sequence[LogDrift]) -> list[plot.Colour]:
    return list(plot.spaced(len(logs)).tolist()) if len(logs) > 1 else ["blue"]


def _angles(logs: Sequence[LogDrift]) -> plot.Figure:
    """Angles since each log's start, a panel for each method and a line for each log (Fig. 2.4)."""
    names = list(dict.fromkeys(track.name for log in logs for track in log.tracks))
    note = (
        "This is the angle since the start of each log, less the true one where it has one. Each panel has "
        "its own scale. A slope alone does not rank filters: the MM filter rejects a constant gyro bias "
        "entirely."
    )
    panels = []
    for i, name in enumerate(names):
        marks = tuple(
            mark
            for log, hue in zip(logs, _colours(logs), strict=True)
            for mark in _change(log, name, hue, len(logs))
        )
        empty = "" if marks else "nothing to draw"
        panels.append(plot.Plot("time (s)", "" if i % 3 else "angle (degrees)", marks, name, empty=empty))
    high = 2.1 * -(-len(names) // 3) + (0.3 if len(logs) > 1 else 0.0)
    return plot.Figure("Drift of the angle", note, panels, high, columns=3)


def _change(log: LogDrift, name: str, colour: plot.Colour, logs: int) -> list[plot.Curve]:
    """Change of the angle by one method in each part of a log."""
    curves: list[plot.Curve] = []
    first = None
    period = log.period_s
    for phi_rad in (track.phi_rad for track in log.tracks if track.name == name):
        for k, phi in enumerate(phi_rad):
            change = np.degrees(phi - log.truth_rad[k]) if log.truth_rad is not None else np.degrees(phi)
            known = change[np.isfinite(change)]
            if len(known):
                first = float(np.mean(known[: max(round(1.0 / period), 1)])) if first is None else first
                t = log.start_s[k] - log.start_s[0] + period * np.arange(len(change))
                label = plot.short(log.section.name, 24) if k == 0 and 1 < logs <= _MOST_IN_LEGEND else ""
                curves.append(plot.Curve(*plot.thinned(t, change - first), label, colour=colour, size=1.0))
    return curves


def _slopes(logs: Sequence[LogDrift]) -> plot.Figure:
    """Slope of each method in each log with its interval."""
    names = list(dict.fromkeys(name for log in logs for name in log.section.methods))
    note = (
        "These are the slopes of the angle's error in each log, with 95 % intervals, from the first log at "
        f"the top to the last. The scale is linear within {_PM}0.01 degrees/s and logarithmic beyond."
    )
    marks: list[plot.Mark] = [plot.Rule("x", 0.0, "ink")]
    for j, (log, hue) in enumerate(zip(logs, _colours(logs), strict=True)):
        have = {name: m for name, m in log.section.methods.items() if m.slope_degps is not None}
        at = np.array([names.index(name) for name in have]) + 0.6 * ((j + 0.5) / len(logs) - 0.5)
        value = np.array([m.slope_degps for m in have.values()])
        # A log that never rests shows no slope.
        ends = np.array([m.interval_degps for m in have.values()], dtype=np.float64).reshape(-1, 2)
        half = np.nan_to_num(0.5 * np.ptp(ends, axis=1))
        marks.append(plot.Curve(value, at, kind="points", colour=hue, spread=half, across=True))
    x = "slope (degrees/s)"
    panel = plot.Plot(x, "", marks, log="x", linear_within=0.01, grid="x", names=tuple(names))
    return plot.Figure("Slope by method", note, (panel,), 0.9 + 0.34 * len(names))


def _liveliest(log: LogDrift) -> tuple[int, slice]:
    """The part and the window in which it moves most, by the accelerometer-free angle."""
    period = log.period_s
    tracks = {track.name: track for track in log.tracks}
    most, best = -1.0, (0, slice(0, 0))
    for k, phi in enumerate(tracks["MM 3/3"].phi_rad):
        size = min(max(round(_WINDOW_S / period), 2), len(phi))
        for start in range(0, len(phi) - size + 1, max(size // 4, 1)):
            spread = float(phi[start : start + size].std())
            if spread > most:
                most, best = spread, (k, slice(start, start + size))
    return best


def _in_motion(log: LogDrift) -> plot.Figure:
    """Angles of sensors and filters while the log moves most, and their errors (Fig. 2.6)."""
    note = "These twelve seconds move most. Below is the error against the true angle, less its mean there."
    truth = log.truth_rad
    if truth is None:
        note = "These twelve seconds move most. The log has no true angle: below is what differs from MM 3/3."
    k, where = _liveliest(log)
    t = log.start_s[k] - log.start_s[0] + log.period_s * np.arange(where.start, where.stop)
    tracks = {track.name: np.degrees(track.phi_rad[k][where]) for track in log.tracks}
    against = tracks["MM 3/3"] if truth is None else np.degrees(truth[k][where])
    above: list[plot.Mark] = []
    below: list[plot.Mark] = []
    for name, (hue, size) in _METHODS.items():
        if name in tracks:
            turns = 360.0 * np.rint(np.nanmedian(tracks[name] - tracks["MM 3/3"]) / 360.0)
            degrees = tracks[name] - turns
            error = degrees - against
            if truth is not None and np.isfinite(error).any():
                error = error - np.nanmean(error)
            above.append(plot.Curve(t, degrees, name, colour=hue, size=size))
            if truth is not None or name != "MM 3/3":
                below.append(plot.Curve(t, error, colour=hue, size=size))
    if truth is not None:
        above.append(plot.Curve(t, against, "truth", "dashed", "ink", 1.0))
    limits = (float(t[0]), float(t[-1]))
    y = "error (degrees)" if truth is not None else "difference (degrees)"
    panels = (
        plot.Plot("", "angle (degrees)", above, x_limits=limits),
        plot.Plot("time (s)", y, below, x_limits=limits),
    )
    return plot.Figure(f"In motion: {plot.short(log.section.name, 78)}", note, panels, 4.9)


# ----------------------------------------------------------------------
# A tuning: errors over the plane of gains, and over time.

_PAIRS = {"3/3": ("red", "squares"), "tuned": ("green", "points"), "riccati": ("orange", "diamonds")}


def tune_plots(section: OrientationFilter) -> dict[str, plot.Figure]:
    """`tune_gains` and `tune_errors`."""
    result, pieces = section.evidence
    figures = {"tune_gains": _gains(result), "tune_errors": _tuning_errors(result, pieces)}
    return plot.judged(figures, section.verdict.word)


def _gains(result: Tuning) -> plot.Figure:
    """Error on the whole logs over Kp and Ki, and where the pairs that are compared lie."""
    marks: list[plot.Mark] = []
    above, s = "nothing to judge by", result.surface
    if s is not None:
        Kp = np.repeat(s.Kp[:, None], len(s.damping), axis=1)
        Ki = Kp**2 / (4.0 * s.damping[None, :] ** 2)
        error = np.degrees(s.rmse_rad)
        least = float(np.nanmin(error))
        levels = least * np.geomspace(1.0, 8.0, 13)
        error = np.clip(np.where(np.isfinite(error), error, np.inf), None, levels[-1])
        marks.append(plot.Field(Kp, Ki, error, levels=levels, outlined=levels[1:2]))
        above = f"Least {least:.3f} deg; line: 19 % more"
    for one in result.candidates:
        if isinstance(one.gains, Mahony):
            (hue, kind), gains = _PAIRS[one.name], one.gains
            at = np.array([gains.Kp]), np.array([max(gains.Ki, 1e-9)])
            marks.append(plot.Curve(*at, one.name, kind, hue, 8.0))
    panel = plot.Plot("Kp (1/s)", "Ki (1/s\N{SUPERSCRIPT TWO})", marks, above, log="xy")
    title = f"Gains of the angle filter: {result.recommended.name}"
    return plot.Figure(title, "The map is the error on the whole logs by pair of gains.", (panel,), 4.3)


def _tuning_errors(result: Tuning, pieces: Sequence[Piece]) -> plot.Figure:
    """Angle of the longest piece, and the errors of 3/3 and of the tuned filters."""
    k = int(np.argmax([len(piece.t_s) for piece in pieces]))
    piece, own = pieces[k], result.smoothed[k]
    if result.judge == "reference" and piece.reference_rad is not None:
        target, by = piece.reference_rad + result.offset_rad[k], "the reference"
    elif own is not None:
        target, by = own.phi_rad, "the log's own smoothed angle"
    else:
        target, by = np.full(len(piece.t_s), np.nan), "nothing"
    t = piece.t_s
    measured = plot.thinned(t, np.degrees(np.unwrap(piece.phi_acc_rad)))
    above = (
        plot.Curve(*measured, colour="silver", size=0.6),
        plot.Curve(plot.every(t), plot.every(np.degrees(target)), colour="ink"),
    )
    below: list[plot.Mark] = [plot.Rule("y", 0.0)]
    for one in result.candidates:
        if one.name == "riccati":
            continue
        phi = filter_log(one.gains, t, piece.phi_acc_rad, piece.rate_radps)[0]
        error = np.degrees(wrapped(phi - target))
        if np.isfinite(error).any():
            hue = _PAIRS[one.name][0] if one.name in _PAIRS else "purple"
            below.append(plot.Curve(*plot.thinned(t, error), one.name, colour=hue, size=1.0))
    limits = (float(t[0]), float(t[-1]))
    panels = (
        plot.Plot("", "angle (degrees)", above, f"Grey: accelerometer; black: {by}", limits),
        plot.Plot("time (s)", "error (degrees)", below, x_limits=limits),
    )
    title = f"Errors over time: {plot.short(piece.source, 70)}"
    return plot.Figure(title, f"Errors are differences from {by}.", panels, 4.6)
