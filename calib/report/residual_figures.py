"""Figures of what the fit leaves over: how large the residuals are, view by view, and where they point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from calib.arrays import BoolArray, FloatArray
from calib.camera.bundle import Calibration
from calib.report.fields import arrows, magnified, panel_height_in, picture_frame
from calib.report.style import (
    GREY,
    INK,
    SIGMA,
    VERMILLION,
    WIDTH_IN,
    empty,
    number,
    plain,
    sheet,
    view_colours,
)

__all__ = ["error_figure", "residual_figure"]

_MOST_NAMED = 26
"""Views whose names fit beside their bars."""
_ROUNDING_PX = 1e-9
"""No corner is measured to this; residuals below it are those of arithmetic."""
_MOST_ARROWS = 720
_LEAST_IN_CELL = 6
"""Points from which a cell's mean residual is worth an arrow."""


def _view_rms(fit: Calibration) -> FloatArray:
    """RMS of each view (N,), NaN where there are no residuals."""
    squared = np.sum(fit.residuals_px**2, axis=2)
    count = np.isfinite(squared).sum(axis=1)
    mean = np.where(count > 0, np.nansum(squared, axis=1), np.nan) / np.maximum(count, 1)
    return np.asarray(np.sqrt(mean))


def error_figure(fit: Calibration, verdict: str = "ok") -> Figure:
    """RMS of each view as bars, and all residuals as a cloud in the same colours."""
    observations = fit.observations
    views = observations.views
    rms = _view_rms(fit)
    bars = np.nan_to_num(rms)
    worst = int(np.argmax(bars))
    whole, sigma = fit.rms_px, number(fit.sigma_px, "px")
    note = (
        f"RMS {number(whole, 'px')} over {observations.points} points in {_views(views)}, at worst "
        f"{number(float(bars[worst]), 'px')} in {plain(observations.names[worst], 24)}. Rings: 1, 2 and 3 "
        f"standard deviations of a coordinate ({sigma}); chance puts 39, 86 and 99 % inside."
    )
    if not np.isfinite(rms).any():
        note = f"There are no residuals: the fit ended as {fit.termination!r}."
    named = views <= _MOST_NAMED
    height = max(4.4, 0.2 * views + 1.0) if named else 4.6
    figure = sheet(height, "How far the corners lie from where the fitted camera puts them", note, verdict)
    left, right = figure.subplots(1, 2, width_ratios=[1.12, 1.0])
    colours = view_colours(views)
    places = np.arange(1, views + 1)
    if named:
        left.barh(places, bars, color=colours, height=0.78)
        left.set_yticks(places, [plain(name, 24) for name in observations.names])
        left.set_ylim(max(views, 6) + 0.6, 0.4)
        left.tick_params(axis="y", length=0)
        left.set_xlabel("RMS of the view (px)")
        left.grid(axis="x")
        left.axvline(whole, color=INK, linewidth=1.3, linestyle="--")
    else:
        left.bar(places, bars, color=colours, width=1.0)
        left.set_xlim(0.4, views + 0.6)
        left.set_xlabel("view, in the order given")
        left.set_ylabel("RMS of the view (px)")
        left.grid(axis="y")
        left.axhline(whole, color=INK, linewidth=1.3, linestyle="--")
    left.set_title("Each view; dashed: all together")
    _cloud(right, fit, colours)
    right.set_title("Each point, coloured as its view")
    return figure


def _views(count: int) -> str:
    return "1 view" if count == 1 else f"{count} views"


def _cloud(axes: Axes, fit: Calibration, colours: Sequence[tuple[float, ...]]) -> None:
    """Residuals with equal axes; what lies outside of the panel is counted at its edge."""
    axes.set_aspect("equal", anchor="N")
    axes.set_xlabel("projected less measured, u (px)")
    axes.set_ylabel("projected less measured, v (px)")
    present = np.isfinite(fit.residuals_px).all(axis=2)
    # Point by point, so that no view lies wholly on top of another.
    point, view = np.nonzero(present.T)
    residuals = fit.residuals_px[view, point]
    if len(residuals) == 0:
        empty(axes, f"no residuals: the fit ended as {fit.termination!r}")
        return
    sigma, largest = fit.sigma_px, float(np.abs(residuals).max())
    limit = max(3.5 * sigma, min(1.08 * largest, 7.0 * sigma)) or 1.0
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid()
    size = float(np.clip(6000.0 / len(residuals), 1.5, 16.0))
    axes.scatter(
        residuals[:, 0],
        residuals[:, 1],
        s=size,
        c=np.array(colours)[view],
        alpha=0.75,
        linewidths=0,
        zorder=3,
    )
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    axes.axvline(0.0, color=GREY, linewidth=0.7)
    distance = np.hypot(*residuals.T)
    for ring in (1, 2, 3):
        axes.add_patch(Circle((0, 0), ring * sigma, fill=False, edgecolor=INK, linewidth=1.1, zorder=4))
        share = float(np.mean(distance <= ring * sigma))
        axes.text(
            0.0,
            -ring * sigma,
            f"{ring}{SIGMA}: {100 * share:.0f} %",
            ha="center",
            va="center",
            fontsize=9,
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.9},
        )
    outside = int(np.any(np.abs(residuals) > limit, axis=1).sum())
    if outside:
        axes.text(
            0.98,
            0.02,
            f"{outside} farther out, up to {number(float(distance.max()), 'px')}",
            transform=axes.transAxes,
            ha="right",
            va="bottom",
            fontsize=9,
            color=VERMILLION,
            fontweight="bold",
            zorder=6,
        )


def residual_figure(fit: Calibration, verdict: str = "ok") -> Figure:
    """Residual vectors where they are in the picture, and their mean over cells against chance."""
    camera = fit.camera
    present = np.isfinite(fit.residuals_px).all(axis=2)
    point, view = np.nonzero(present.T)
    at, vectors = fit.observations.pixels[view, point], fit.residuals_px[view, point]
    # An even step would pick the same views again and again.
    some = np.sort(np.random.default_rng(0).permutation(len(at))[:_MOST_ARROWS])
    means = _cell_means(fit, at, vectors, fit.weights[view, point])
    note = (
        "Errors of chance point every way, and 95 % of the cells' means stay in their discs. Arrows that "
        "agree with their neighbours show what lens model or board leave unexplained. "
        f"{int(means.outside.sum())} of {len(means.at)} means leave their discs."
    )
    figure = sheet(
        panel_height_in(0.5 * WIDTH_IN, camera.image_size_px),
        "Where the residuals point, over the picture",
        note,
        verdict,
    )
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        picture_frame(axes, camera.image_size_px)
    nothing = ""
    if len(at) == 0:
        nothing = f"no residuals: the fit ended as {fit.termination!r}"
    elif float(np.abs(vectors).max()) < _ROUNDING_PX:
        nothing = "the residuals are rounding errors"
    if nothing:
        for axes in (left, right):
            empty(axes, nothing)
        return figure
    times = arrows(left, at[some], vectors[some], 0.08 * max(camera.image_size_px))
    which = "Each point" if len(some) == len(at) else f"{len(some)} of {len(at)} points"
    left.set_title(f"{which}, drawn {times:g} times")
    if len(means.at) == 0:
        empty(right, f"no cell of the picture holds {_LEAST_IN_CELL} points or more")
        return figure
    lengths = np.maximum(np.hypot(*means.mean.T), means.by_chance)
    times = magnified(means.reach_px, float(np.quantile(lengths, 0.9)))
    arrows(right, means.at, means.mean, means.reach_px, magnification=times)
    for place, radius, far in zip(means.at, times * means.by_chance, means.outside, strict=True):
        face = "#f6cfb2" if far else "#dfe4e8"
        right.add_patch(Circle((place[0], place[1]), float(radius), facecolor=face, linewidth=0, zorder=2))
    right.set_title(f"Mean of each cell, drawn {times:g} times")
    return figure


@dataclass(frozen=True)
class _Means:
    """Mean residuals of cells of the picture.

    Attributes
    ----------
    at, mean : (n, 2) centres of the cells and mean residuals, px.
    by_chance : (n,) radius that 95 % of such means stay within when the errors are chance, px.
    outside : (n,) which do not.
    reach_px : what an arrow may take without running into the next cell's.
    """

    at: FloatArray
    mean: FloatArray
    by_chance: FloatArray
    outside: BoolArray
    reach_px: float


def _cell_means(fit: Calibration, at: FloatArray, vectors: FloatArray, weights: FloatArray) -> _Means:
    """Means over about 8 x 6 cells, with the weights of a robust loss where there is one."""
    width, height = fit.camera.image_size_px
    columns = 8 if width >= height else max(3, round(8 * width / height))
    rows = max(2, round(columns * height / width))
    column = np.clip((at[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    row = np.clip((at[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns)
    used = count >= _LEAST_IN_CELL
    total = np.stack([np.bincount(cell, weights * vectors[:, k], rows * columns) for k in (0, 1)], axis=1)
    weight = np.bincount(cell, weights, rows * columns)[used]
    mean = total[used] / weight[:, None]
    centre = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
    # 95 % of two-dimensional Gaussian vectors are shorter than 2.448 standard deviations.
    by_chance = 2.448 * fit.sigma_px / np.sqrt(weight)
    return _Means(
        at=centre[used] * [width / columns, height / rows] - 0.5,
        mean=mean,
        by_chance=by_chance,
        outside=np.hypot(mean[:, 0], mean[:, 1]) > by_chance,
        reach_px=0.6 * min(width / columns, height / rows),
    )
