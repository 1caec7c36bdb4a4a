"""Figures of an alignment: residuals before and after, and the camera's rate against the gyroscope's."""

from __future__ import annotations

import math

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.plot import SIGMA, Band, Curve, Figure, Mark, Plot, Rule, every, judged, short
from calib.core.words import number as with_sigma
from calib.stages.align.section import Align
from calib.stages.align.solve import OFFSETS_S, Alignment, Trace
from calib.stages.estimator.sensors import SENSOR

_ROWS = (
    ("u (px)", "camera", 0),
    ("v (px)", "camera", 1),
    ("along y (m/s\N{SUPERSCRIPT TWO})", "imu", 1),
    ("rate (rad/s)", "imu", 2),
)


def plots(section: Align) -> dict[str, Figure]:
    """`align_correlation` and, for each log, `align_residuals_1`, ..."""
    fit: Alignment = section.evidence
    figures = {"align_correlation": _correlation(fit)}
    for k in range(len(fit.logs)):
        figures[f"align_residuals_{k + 1}"] = _residuals(fit, k)
    return judged(figures, section.verdict.word)


def _residuals(fit: Alignment, log: int) -> Figure:
    """Residuals of one log with the sensors as assumed beforehand and as estimated."""
    title = f"Residuals: {short(fit.logs[log].name, 78)}"
    note = (
        "This is what was measured less what the fitted motion predicts: in orange with the time offset and "
        "the scales assumed beforehand, without mount angle and biases, in blue with those estimated. Red "
        "crosses are pictures taken for something else. Points at the edge lie beyond it."
    )
    traces = [trace for trace in fit.traces if trace.log == log]
    panels = []
    for y, sensor, channel in _ROWS:
        x = "time (s)" if y == _ROWS[-1][0] else ""
        panels.append(_panel(traces, sensor, channel, x, y))
    return Figure(title, note, panels, 7.4)


def _panel(traces: list[Trace], sensor: str, channel: int, x: str, y: str) -> Plot:
    """One channel of a sensor before and after; what lies beyond the edge is drawn at it."""
    if not traces:
        return Plot(x, y, empty="no stretch of this log was used")
    zero, end = min(float(one.imu_s[0]) for one in traces), max(float(one.imu_s[-1]) for one in traces)
    before, after = (
        [getattr(one, f"{sensor}_{when}")[:, channel] for one in traces] for when in ("before", "after")
    )
    if not any(np.isfinite(value).any() for value in after):
        return Plot(x, y, empty="not sampled")
    values = np.abs(np.concatenate([*before, *after]))
    limit = 1.2 * float(np.percentile(values[np.isfinite(values)], 99.0)) or 1.0
    marks: list[Mark] = [Rule("y", 0.0, "ink")]
    for one, old, new in zip(traces, before, after, strict=True):
        t = getattr(one, f"{sensor}_s") - zero
        good = one.good > 0.5 if sensor == "camera" else np.ones(len(t), dtype=np.bool_)
        marks += [_cloud(t, old, limit, "before"), _cloud(t[good], new[good], limit, "after")]
        bad = np.clip(new[~good], -0.95 * limit, 0.95 * limit)
        marks.append(Curve(t[~good], bad, kind="crosses", colour="red"))
    return Plot(x, y, marks, x_limits=(0.0, end - zero), y_limits=(-limit, limit), grid="y")


def _cloud(t: FloatArray, values: FloatArray, limit: float, label: str) -> Curve:
    known = np.isfinite(values)
    shown = every(np.clip(values[known], -0.98 * limit, 0.98 * limit))
    return Curve(every(t[known]), shown, label, "cloud", "orange" if label == "before" else "blue")


def _correlation(fit: Alignment) -> Figure:
    """Correlation of the camera's rate with the gyroscope's over the time offset, and what was estimated."""
    at = SENSOR.index("time_offset_s")
    offset, sigma = 1e3 * float(fit.sensor[at]), 1e3 * float(fit.sigma[at])
    title = "When the camera and the gyroscope see the same motion"
    note = (
        "The rate of phi that pictures four frames apart show is compared with the gyroscope's over the same "
        f"time. The line is the time offset of the whole fit, the band its 2{SIGMA}; with one {SIGMA} it is "
        f"{with_sigma(offset, sigma)} \N{PLUS-MINUS SIGN} {with_sigma(sigma, sigma)} ms."
    )
    x, y = "pictures later than the gyroscope (ms)", "correlation"
    at_ms, value = 1e3 * OFFSETS_S, fit.correlation
    if not np.isfinite(value).any():
        return Figure(title, note, (Plot(x, y, empty="too few pictures"),), 3.4)
    low, high = float(at_ms[0]), float(at_ms[-1])
    marks = (
        Band("x", max(offset - 2.0 * sigma, low), min(offset + 2.0 * sigma, high)),
        Rule("x", min(max(offset, low), high), "red"),
        Rule("y", 0.0),
        Curve(at_ms, value),
    )
    above = "" if math.isfinite(sigma) and sigma <= 10.0 else "the logs do not show the time offset"
    y_limits = (min(-0.1, 1.1 * float(np.nanmin(value))), max(0.1, 1.1 * float(np.nanmax(value))))
    return Figure(title, note, (Plot(x, y, marks, above, (low, high), y_limits),), 3.4)
