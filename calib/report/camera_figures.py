"""Figures of a camera's calibration: what the views say, where they say it, and what is left open."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from calib.arrays import BoolArray, FloatArray
from calib.camera.bundle import Calibration
from calib.camera.covariance import Covariance, projection_sigma_px
from calib.camera.coverage import hull
from calib.camera.intrinsics import Intrinsics
from calib.camera.selection import Candidate
from calib.report.fields import (
    arrows,
    colour_bar,
    contour_map,
    ellipse,
    grid_over,
    magnified,
    panel_height_in,
    picture_frame,
)
from calib.report.lens_figures import distortion_figure
from calib.report.pose_figure import pose_figure
from calib.report.style import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    SIGMA,
    SKY,
    VERMILLION,
    WIDTH_IN,
    empty,
    figure_folder,
    look,
    number,
    plain,
    save,
    sheet,
    view_colours,
)

__all__ = ["write_camera_figures"]

_MOST_NAMED = 26
"""Views whose names fit beside their bars."""
_MOST_ARROWS = 720
_LEAST_IN_CELL = 6
"""Points from which a cell's mean residual is worth an arrow."""
_COLUMNS, _ROWS = 6, 5
"""Cells of the picture in which points are looked for, as in `calib.camera.coverage`."""


def write_camera_figures(folder: Path, result: Intrinsics) -> list[Path]:
    """Draw everything about a calibration into a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    fit, verdict = result.calibration, result.judgement.verdict
    seen = fit.observations.pixels[fit.observations.present]
    written = []
    with look():
        figures: list[tuple[str, Callable[[], Figure]]] = [
            ("camera_errors.png", lambda: _errors(fit, verdict)),
            ("camera_residuals.png", lambda: _residuals(fit, verdict)),
            ("camera_coverage.png", lambda: _coverage(fit, result.covariance, verdict)),
            ("camera_poses.png", lambda: pose_figure(fit, verdict)),
            ("camera_sigma.png", lambda: _projection_sigma(fit, result.covariance, verdict)),
            (
                "camera_distortion.png",
                lambda: distortion_figure(fit.camera, result.covariance, seen, verdict),
            ),
        ]
        if result.models:
            chosen = fit.camera.model
            figures.append(
                ("camera_models.png", lambda: _comparison("lens model", result.models, chosen, verdict))
            )
        if result.boards:
            figures.append(
                (
                    "camera_boards.png",
                    lambda: _comparison("board model", result.boards, result.board, verdict),
                )
            )
        for name, draw in figures:
            written.append(save(draw(), folder / name))
    return written


def _view_rms(fit: Calibration) -> FloatArray:
    """RMS of each view (N,), NaN where there are no residuals."""
    squared = np.sum(fit.residuals_px**2, axis=2)
    count = np.isfinite(squared).sum(axis=1)
    mean = np.where(count > 0, np.nansum(squared, axis=1), np.nan) / np.maximum(count, 1)
    return np.asarray(np.sqrt(mean))


def _errors(fit: Calibration, verdict: str) -> Figure:
    """RMS of each view as bars, and all residuals as a cloud in the same colours."""
    observations = fit.observations
    views = observations.views
    rms = _view_rms(fit)
    bars = np.nan_to_num(rms)
    worst = int(np.argmax(bars))
    note = (
        f"RMS {number(fit.rms_px, 'px')} over {observations.points} points in {_views(views)}, at worst "
        f"{number(float(bars[worst]), 'px')} in {plain(observations.names[worst], 24)}. Rings: 1, 2 and 3 standard "
        f"deviations of a coordinate, {number(fit.sigma_px, 'px')}; chance puts 39, 86 and 99 % inside."
    )
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
        left.axvline(fit.rms_px, color=INK, linewidth=1.3, linestyle="--")
    else:
        left.bar(places, bars, color=colours, width=1.0)
        left.set_xlim(0.4, views + 0.6)
        left.set_xlabel("view, in the order given")
        left.set_ylabel("RMS of the view (px)")
        left.grid(axis="y")
        left.axhline(fit.rms_px, color=INK, linewidth=1.3, linestyle="--")
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


def _coverage(fit: Calibration, sigma: Covariance, verdict: str) -> Figure:
    """All points over the picture with empty cells shaded, the principal point, and points by radius."""
    camera, observations = fit.camera, fit.observations
    width, height = camera.image_size_px
    pixels = observations.pixels[observations.present]
    column = np.clip((pixels[:, 0] + 0.5) / width * _COLUMNS, 0, _COLUMNS - 1).astype(np.int64)
    row = np.clip((pixels[:, 1] + 0.5) / height * _ROWS, 0, _ROWS - 1).astype(np.int64)
    filled = {(int(i), int(j)) for i, j in zip(column, row, strict=True)}
    note = (
        f"{len(filled)} of {_COLUMNS * _ROWS} cells of the picture hold points; the others are hatched. "
        "Where no point was seen the camera's numbers are extrapolated."
    )
    panel = 0.62 * WIDTH_IN
    figure = sheet(
        max(panel_height_in(panel, camera.image_size_px), 4.3),
        f"Which parts of the picture the {observations.points} corners cover",
        note,
        verdict,
    )
    grid = figure.add_gridspec(2, 2, width_ratios=[1.75, 1.0])
    frame = figure.add_subplot(grid[:, 0])
    picture_frame(frame, camera.image_size_px)
    for i in range(_COLUMNS):
        for j in range(_ROWS):
            if (i, j) not in filled:
                corner = (i * width / _COLUMNS - 0.5, j * height / _ROWS - 0.5)
                cell = Rectangle(
                    corner,
                    width / _COLUMNS,
                    height / _ROWS,
                    facecolor="#fdeccc",
                    edgecolor=ORANGE,
                    hatch="//",
                    linewidth=0.5,
                    zorder=1,
                )
                frame.add_patch(cell)
    size = float(np.clip(5000.0 / len(pixels), 1.0, 12.0))
    frame.scatter(pixels[:, 0], pixels[:, 1], s=size, color=BLUE, alpha=0.7, linewidths=0, zorder=3)
    centre = (camera.cx_px, camera.cy_px)
    frame.plot(*centre, marker="+", markersize=15, markeredgewidth=2.0, color=VERMILLION, zorder=7)
    _principal_point(frame, figure.add_subplot(grid[0, 1]), fit, sigma)
    _radii(figure.add_subplot(grid[1, 1]), fit, pixels)
    frame.set_title("Corners of all views (dots) and the principal point (cross)")
    return figure


def _principal_point(frame: Axes, axes: Axes, fit: Calibration, sigma: Covariance) -> None:
    """Ellipses of the principal point, true to scale in the picture and enlarged beside it."""
    camera = fit.camera
    axes.set_title(f"Principal point: 1 and 2 {SIGMA}")
    names = ("cx_px", "cy_px")
    if not all(name in sigma.names for name in names):
        axes.set_axis_off()
        empty(axes, f"held at ({camera.cx_px:.1f}, {camera.cy_px:.1f}) px, not estimated", 24)
        return
    index = [sigma.names.index(name) for name in names]
    covariance = sigma.intrinsics[np.ix_(index, index)]
    if not np.all(np.isfinite(covariance)):
        axes.set_axis_off()
        empty(axes, "its standard deviation is not bounded by these views", 24)
        return
    centre = (camera.cx_px, camera.cy_px)
    frame.add_patch(ellipse(centre, covariance, 1.0, VERMILLION))
    for ring, dashed in ((1.0, False), (2.0, True)):
        axes.add_patch(ellipse(centre, covariance, ring, VERMILLION, dashed=dashed))
    axes.plot(*centre, marker="+", markersize=10, markeredgewidth=1.6, color=VERMILLION)
    deviation = np.sqrt(np.diag(covariance))
    # Limits that follow from points let the panel keep its width with equal axes.
    reach = 2.4 * (float(deviation.max()) or 1.0)
    axes.scatter([centre[0] - reach, centre[0] + reach], [centre[1] - reach, centre[1] + reach], s=0.0)
    axes.margins(0.0)
    axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid()
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel(f"cx = {camera.cx_px:.2f} ± {number(float(deviation[0]), digits=2)} px")
    axes.set_ylabel(f"cy = {camera.cy_px:.2f} ± {number(float(deviation[1]), digits=2)} px")


def _radii(axes: Axes, fit: Calibration, pixels: FloatArray) -> None:
    """Points by distance from the principal point, out to the picture's farthest corner."""
    camera = fit.camera
    width, height = camera.image_size_px
    centre = np.array([camera.cx_px, camera.cy_px])
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [0.0, height - 1], [width - 1, height - 1]])
    last = float(np.linalg.norm(corners - centre, axis=1).max())
    radius = np.linalg.norm(pixels - centre, axis=1)
    if not (math.isfinite(last) and np.isfinite(radius).all()):
        axes.set_axis_off()
        empty(axes, "the principal point is not known")
        return
    seen = float(radius.max())
    axes.hist(radius, bins=24, range=(0.0, max(last, seen)), color=BLUE)
    axes.axvspan(seen, max(last, seen), facecolor="#fdeccc", edgecolor=ORANGE, hatch="//", linewidth=0.5)
    axes.set_xlim(0.0, max(last, seen))
    axes.set_xlabel("distance from the principal point (px)")
    axes.set_ylabel("points")
    axes.set_title(f"Points reach {100 * min(seen / last, 1.0):.0f} % of the radius")


def _residuals(fit: Calibration, verdict: str) -> Figure:
    """Residual vectors where they are in the picture, and their mean over cells against chance."""
    camera = fit.camera
    present = np.isfinite(fit.residuals_px).all(axis=2)
    point, view = np.nonzero(present.T)
    at, vectors = fit.observations.pixels[view, point], fit.residuals_px[view, point]
    # An even step would pick the same views again and again.
    some = np.sort(np.random.default_rng(0).permutation(len(at))[:_MOST_ARROWS])
    means = _cell_means(fit, at, vectors)
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
    if len(at) == 0:
        for axes in (left, right):
            empty(axes, f"no residuals: the fit ended as {fit.termination!r}")
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


def _cell_means(fit: Calibration, at: FloatArray, vectors: FloatArray) -> _Means:
    width, height = fit.camera.image_size_px
    columns = 8 if width >= height else max(3, round(8 * width / height))
    rows = max(2, round(columns * height / width))
    column = np.clip((at[:, 0] + 0.5) / width * columns, 0, columns - 1).astype(np.int64)
    row = np.clip((at[:, 1] + 0.5) / height * rows, 0, rows - 1).astype(np.int64)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns)
    used = count >= _LEAST_IN_CELL
    total = np.stack([np.bincount(cell, vectors[:, k], rows * columns) for k in (0, 1)], axis=1)
    mean = total[used] / count[used, None]
    centre = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
    # 95 % of two-dimensional Gaussian vectors are shorter than 2.448 standard deviations.
    by_chance = 2.448 * fit.sigma_px / np.sqrt(count[used])
    return _Means(
        at=centre[used] * [width / columns, height / rows] - 0.5,
        mean=mean,
        by_chance=by_chance,
        outside=np.hypot(mean[:, 0], mean[:, 1]) > by_chance,
        reach_px=0.6 * min(width / columns, height / rows),
    )


def _projection_sigma(fit: Calibration, sigma: Covariance, verdict: str) -> Figure:
    """Standard deviation of projection over the picture, with the hull of what was seen."""
    camera = fit.camera
    u, v = grid_over(camera.image_size_px, 97)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    values = projection_sigma_px(fit, sigma, pixels.reshape(-1, 2)).reshape(len(v), len(u))
    # What moves by more than the picture's size is not known at all.
    values[values > math.hypot(*camera.image_size_px)] = np.inf
    median = float(np.median(values[~np.isnan(values)])) if not np.isnan(values).all() else np.nan
    found = f"median {number(median, 'px')}"
    note = (
        f"Standard deviation of where the camera puts a point {number(sigma.distance_m, 'm')} away, had the "
        f"pictures been taken again; worst direction, {found}. Dashed: hull of the corners seen; beyond it "
        "the camera extrapolates."
    )
    figure = sheet(
        panel_height_in(0.8 * WIDTH_IN, camera.image_size_px),
        "How uncertain the camera's projection is, over the picture",
        note,
        verdict,
    )
    axes = figure.subplots()
    picture_frame(axes, camera.image_size_px)
    drawn = contour_map(axes, u, v, values, "px")
    if drawn is not None:
        colour_bar(axes, drawn, "standard deviation (px)")
    seen = hull(fit.observations.pixels[fit.observations.present])
    axes.add_patch(Polygon(seen, fill=False, edgecolor=VERMILLION, linewidth=1.5, linestyle="--", zorder=6))
    return figure


def _comparison(what: str, candidates: Sequence[Candidate], chosen: str, verdict: str) -> Figure:
    """Fitted and held-back RMS of each model, drawn and in figures, the chosen one marked."""
    names = [plain(candidate.name, 20) for candidate in candidates]
    rms = np.array([[c.fitted_rms_px, c.held_back_rms_px] for c in candidates])
    figure = sheet(
        0.42 * len(candidates) + 1.3,
        f"Which {what} predicts views that it has not seen",
        "RMS over views that the model was fitted to and over views held back. The simplest model is taken "
        f"that no richer one beats on views held back: {plain(chosen, 20)}.",
        verdict,
    )
    axes = figure.subplots()
    # A model far off would press the others together; beyond the limit an arrow stands for it.
    finite = rms[np.isfinite(rms)]
    near = finite[finite <= 1.6 * finite.min()] if len(finite) else np.array([0.0])
    room = float(np.ptp(near)) or 0.1 * float(near.max()) or 1.0
    low, limit = float(near.min()) - 0.08 * room, float(near.max()) + 0.12 * room
    for i, name in enumerate(names):
        if candidates[i].name == chosen:
            axes.axhspan(i - 0.45, i + 0.45, color="#e6f1f8", zorder=0)
        axes.plot(np.minimum(rms[i], limit), [i, i], color=GREY, linewidth=2.0, zorder=2)
        if np.any(rms[i] > limit):
            axes.plot(limit, i, marker=">", markersize=9, color=GREY, clip_on=False, zorder=5)
        weight = "bold" if candidates[i].name == chosen else "normal"
        for x, value in zip((1.03, 1.16), rms[i], strict=True):
            words = f"{value:.4f}" if math.isfinite(value) else "not fitted"
            axes.text(x, i, words, transform=axes.get_yaxis_transform(), va="center", fontweight=weight)
        names[i] = f"{name}, {candidates[i].parameters} parameters"
    shown = np.where(rms <= limit, rms, np.nan)
    rows = np.arange(len(names))
    axes.scatter(shown[:, 0], rows, s=56, color=SKY, zorder=3, label="fitted")
    axes.scatter(shown[:, 1], rows, s=46, color=VERMILLION, marker="D", zorder=4, label="held back")
    axes.set_yticks(rows, names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(low, limit)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")
    axes.set_xlabel("RMS (px)")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2, handletextpad=0.2)
    for x, head in ((1.03, "fitted"), (1.16, "held back")):
        axes.text(x, -0.75, head, transform=axes.get_yaxis_transform(), va="bottom", color=GREY, fontsize=9)
    return figure
