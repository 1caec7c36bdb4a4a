"""Figures of an IMU's intrinsics: where the poses lie, and what rests and turns are off by."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from calib.arrays import FloatArray
from calib.imu.accelerometer import Accelerometer
from calib.imu.intrinsics import Intrinsics
from calib.report.style import (
    BLUE,
    GREY,
    INK,
    RULE,
    SHADE,
    SIGMA,
    VERMILLION,
    empty,
    figure_folder,
    look,
    number,
    save,
    sheet,
)

__all__ = ["pose_figure", "residual_figure", "write_imu_intrinsics_figures"]

_MPS2 = "mm/s\N{SUPERSCRIPT TWO}"
_DEGREE = "\N{DEGREE SIGN}"


def _bare(axes: Axes, limit: float) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _disc(axes: Axes, u: FloatArray, sign: float) -> int:
    """The half of the sphere with z up or down, in Lambert's equal-area projection; how many are on it."""
    here = u[sign * u[:, 2] > 0.0] if sign > 0.0 else u[u[:, 2] <= 0.0]
    for degrees in (30.0, 60.0, 90.0):
        radius = math.sqrt(2.0) * math.sin(math.radians(degrees) / 2.0)
        face = SHADE if degrees == 90.0 else "none"
        axes.add_patch(
            Circle((0, 0), radius, facecolor=face, edgecolor=RULE, zorder=0.5 if degrees == 90.0 else 1)
        )
    for label, at in (("x", (1, 0)), ("-x", (-1, 0)), ("y", (0, 1)), ("-y", (0, -1))):
        axes.text(1.09 * at[0], 1.09 * at[1], label, ha="center", va="center", color=GREY)
    axes.text(0.03, 0.03, "z" if sign > 0.0 else "-z", color=GREY)
    if len(here):
        scale = 1.0 / np.sqrt(1.0 + sign * here[:, 2])
        axes.plot(
            here[:, 0] * scale, here[:, 1] * scale, color=BLUE, marker="o", markersize=6, linestyle="none",
            alpha=0.8, markeredgecolor="white",
        )  # fmt: skip
    _bare(axes, 1.2)
    return len(here)


def _circle(axes: Axes, accel: Accelerometer) -> None:
    axes.add_patch(Circle((0, 0), 1.0, facecolor=SHADE, edgecolor=RULE, zorder=0.5))
    for label, at in (("x", (1, 0)), ("-x", (-1, 0)), ("y", (0, 1)), ("-y", (0, -1))):
        axes.text(1.12 * at[0], 1.12 * at[1], label, ha="center", va="center", color=GREY)
    for u in accel.directions:
        axes.plot([0, u[0]], [0, u[1]], color=RULE, linewidth=0.8)
    axes.plot(*accel.directions.T, color=BLUE, marker="o", markersize=6, linestyle="none", alpha=0.8)
    _bare(axes, 1.25)


def pose_figure(result: Intrinsics, verdict: str = "ok") -> Figure:
    """Which way was up in each rest, in the sensor's frame."""
    note = (
        f"Each point is a rest: the direction in the sensor's frame that was up. {len(result.rests)} rests "
        f"show {result.poses} poses."
    )
    if not result.planar:
        note += f" Rings are 30{_DEGREE}, 60{_DEGREE} and 90{_DEGREE} from the z axis; areas are true."
    figure = sheet(4.3, "Poses of the IMU", note, verdict)
    accel = result.accel
    if accel is None:
        axes = figure.subplots()
        empty(axes, "too few rests to tell their poses")
        axes.set_xticks([])
        axes.set_yticks([])
    elif result.planar:
        axes = figure.subplots()
        axes.set_title("In the plane of x and y")
        _circle(axes, accel)
    else:
        panels = figure.subplots(1, 2)
        for axes, sign, words in ((panels[0], 1.0, "up"), (panels[1], -1.0, "down")):
            count = _disc(axes, accel.directions, sign)
            axes.set_title(f"z axis {words}: {count} rests")
    return figure


def _rest_panel(axes: Axes, result: Intrinsics) -> None:
    accel = result.accel
    axes.set_title("Length of the specific force less g, rest by rest")
    axes.set_xlabel("time (s)")
    axes.set_ylabel(f"residual ({_MPS2})")
    if accel is None:
        empty(axes, "too few rests for a fit")
        return
    at = [0.5 * (rest.from_s + rest.to_s) for rest in result.rests]
    axes.axhline(0.0, color=INK, linewidth=0.6)
    axes.errorbar(
        at, 1e3 * accel.residual_mps2, yerr=2e3 * accel.deviation_mps2, color=BLUE, marker="o", markersize=4,
        linestyle="none", capsize=2, elinewidth=0.8,
    )  # fmt: skip
    axes.grid(True, axis="y")


def _threshold_panel(axes: Axes, result: Intrinsics) -> None:
    axes.set_title("Threshold by residual")
    axes.set_xlabel("multiple of the spread at rest")
    axes.set_ylabel(f"residual RMS ({_MPS2})")
    found = [trial for trial in result.trials if math.isfinite(trial.rms_mps2)]
    if not found:
        empty(axes, "too few rests to compare thresholds", 24)
        return
    axes.plot(
        [trial.multiple for trial in found], [1e3 * trial.rms_mps2 for trial in found], color=INK, marker="o",
        markersize=4, linewidth=1.0,
    )  # fmt: skip
    taken = next((trial for trial in found if trial.multiple == result.multiple), None)
    if taken is not None:
        axes.plot(taken.multiple, 1e3 * taken.rms_mps2, color=VERMILLION, marker="o", markersize=8)
    axes.set_ylim(0.0, 1.15e3 * max(trial.rms_mps2 for trial in found))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.grid(True)


def _turn_panel(axes: Axes, result: Intrinsics) -> None:
    axes.set_title("Gravity missed after each turn")
    axes.set_xlabel("turn")
    axes.set_ylabel("angle (degrees)")
    if result.gyro is None:
        empty(axes, "no gyroscope, or no turn", 24)
        return
    missed = np.degrees(np.linalg.norm(result.gyro.residual_rad, axis=1))
    axes.bar(np.arange(1, len(missed) + 1), missed, color=BLUE, width=0.7)
    axes.axhline(math.degrees(result.gyro.rms_rad), color=VERMILLION, linewidth=1.2)
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(True, axis="y")


def residual_figure(result: Intrinsics, verdict: str = "ok") -> Figure:
    """What rests and turns are off by, and the threshold that was taken."""
    note = f"Bars: 2{SIGMA} of a rest. "
    if result.accel is not None:
        rms = number(1e3 * result.accel.rms_mps2, _MPS2)
        note += f"The rests differ from g by {rms} (RMS). Red: the threshold taken, and the RMS of the turns."
    figure = sheet(5.4, "Residuals of rests and turns", note, verdict)
    grid = figure.add_gridspec(2, 2)
    _rest_panel(figure.add_subplot(grid[0, :]), result)
    _threshold_panel(figure.add_subplot(grid[1, 0]), result)
    _turn_panel(figure.add_subplot(grid[1, 1]), result)
    return figure


def write_imu_intrinsics_figures(folder: Path, result: Intrinsics, verdict: str = "ok") -> list[Path]:
    """Write `imu_poses.png` and `imu_residuals.png`."""
    figure_folder(folder)
    with look():
        return [
            save(pose_figure(result, verdict), folder / "imu_poses.png"),
            save(residual_figure(result, verdict), folder / "imu_residuals.png"),
        ]
