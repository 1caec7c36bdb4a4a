"""Figures of a camera's calibration: what the views say, where they say it, and what is left open."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from calib.arrays import FloatArray
from calib.camera.bundle import Calibration
from calib.camera.covariance import Covariance, projection_sigma_px
from calib.camera.coverage import hull
from calib.camera.intrinsics import Intrinsics
from calib.camera.selection import Candidate
from calib.report.fields import (
    colour_bar,
    contour_map,
    ellipse,
    grid_over,
    panel_height_in,
    picture_frame,
)
from calib.report.lens_figures import distortion_figure
from calib.report.pose_figure import pose_figure
from calib.report.residual_figures import error_figure, residual_figure
from calib.report.style import (
    BLUE,
    GREY,
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
)

__all__ = ["write_camera_figures"]

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
            ("camera_errors.png", lambda: error_figure(fit, verdict)),
            ("camera_residuals.png", lambda: residual_figure(fit, verdict)),
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
    if np.isfinite(centre).all():
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
    if not np.isfinite([camera.cx_px, camera.cy_px]).all():
        axes.set_axis_off()
        empty(axes, "not known: the fit failed", 24)
        return
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
    reach = max(2.4 * float(deviation.max()), 1e-3)
    axes.scatter([centre[0] - reach, centre[0] + reach], [centre[1] - reach, centre[1] + reach], s=0.0)
    axes.margins(0.0)
    axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid()
    axes.xaxis.set_major_locator(MaxNLocator(5, prune="both"))
    axes.yaxis.set_major_locator(MaxNLocator(4, prune="both"))
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
        axes.set_xticks([])
        axes.set_yticks([])
        # Keeps the room below that the picture's own labels need.
        axes.set_xlabel(" ", labelpad=24.0)
        empty(axes, "the principal point is not known", 24)
        return
    seen = float(radius.max())
    axes.hist(radius, bins=24, range=(0.0, max(last, seen)), color=BLUE)
    axes.axvspan(seen, max(last, seen), facecolor="#fdeccc", edgecolor=ORANGE, hatch="//", linewidth=0.5)
    axes.set_xlim(0.0, max(last, seen))
    axes.set_xlabel("distance from the principal point (px)")
    axes.set_ylabel("points")
    axes.set_title(f"Points reach {100 * min(seen / last, 1.0):.0f} % of the radius")


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
