"""Figures of a tuning: errors over the plane of gains, what gains cost, and the errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from calib.imu.frontier import frontier
from calib.imu.mahony import Mahony
from calib.imu.mahony_batch import filter_log, wrapped
from calib.imu.tuning import Piece, Tuning
from calib.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RISING,
    VERMILLION,
    empty,
    figure_folder,
    look,
    plain,
    save,
    sheet,
)
from calib.rig_filter import OrientationFilter

__all__ = ["errors_figure", "gains_figure", "write_tune_figures"]

_COLOUR = {"3/3": VERMILLION, "tuned": GREEN, "riccati": ORANGE}
_MARK = {"3/3": "s", "tuned": "o", "riccati": "D"}
_MOST_POINTS = 3000


def _tick(value: float, _: float | None) -> str:
    return f"{value:g}"


def _logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(_tick)
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True)


def _pairs(result: Tuning) -> list[tuple[str, Mahony]]:
    return [(one.name, one.gains) for one in result.candidates if one.name in _COLOUR]


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
    _logarithmic(left)
    left.set_xlabel("Kp (1/s)")
    left.set_ylabel("Ki (1/s\N{SUPERSCRIPT TWO})")
    settles = np.isfinite(f.settling_s)
    middle.plot(f.noise_gain[settles], f.settling_s[settles], color="#b9c0c7", marker=".", linestyle="none")
    best = np.flatnonzero(f.best & settles)
    best = best[np.argsort(f.noise_gain[best])]
    middle.plot(f.noise_gain[best], f.settling_s[best], color=BLUE, linewidth=2.0)
    _logarithmic(middle)
    middle.set_xlabel("noise gain (variance)")
    middle.set_ylabel("settling to 2 % (s)")
    middle.set_title("Noise and settling")
    right.plot(f.lag_s, f.bias_peak_s, color="#b9c0c7", marker=".", linestyle="none")
    _logarithmic(right)
    right.set_xlabel("lag of a step (s)")
    right.set_ylabel("peak per bias (s)")
    right.set_title("Lag and bias")
    for name, gains in _pairs(result):
        # The grid's nearest pair stands for it: the facts change slowly.
        k = int(np.argmin(np.log(f.Kp / gains.Kp) ** 2 + np.log(f.Ki / max(gains.Ki, 1e-9)) ** 2))
        style = {"color": _COLOUR[name], "marker": _MARK[name], "markeredgecolor": "white"}
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
    every = max(1, len(piece.t_s) // _MOST_POINTS)
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
            below.plot(t, error[rows], color=_COLOUR[name], linewidth=1.0, label=name)
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
