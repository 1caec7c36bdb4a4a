"""Figures of a calibrated plane: how well a marker's position is known, and what the lens costs there."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import RectBivariateSpline

from calib.arrays import FloatArray
from calib.camera.homography import apply_homography
from calib.camera.model import Camera
from calib.camera.plane import Plane, to_pixels
from calib.camera.plane_sigma import visible
from calib.camera.undistortion import fold_radius
from calib.report.fields import (
    arrows,
    colour_bar,
    contour_levels,
    contour_map,
    magnified,
    panel_height_in,
    picture_frame,
)
from calib.report.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    RISING,
    VERMILLION,
    WIDTH_IN,
    empty,
    figure_folder,
    look,
    number,
    plain,
    round_down,
    save,
    sheet,
    view_colours,
)

__all__ = ["write_plane_figures"]

_FINE = 45
"""Places along each side of the workspace at which maps are drawn."""
_MOST_NAMED = 6
"""Pictures whose names fit into a legend."""


def write_plane_figures(folder: Path, camera: Camera, plane: Plane) -> list[Path]:
    """Draw a calibrated plane into a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        return [
            save(_picture(camera, plane), folder / "plane_picture.png"),
            save(_sigma(plane), folder / "plane_sigma.png"),
            save(_difference(camera, plane), folder / "plane_difference.png"),
        ]


def _grid(plane: Plane, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x (columns,) and y (rows,) in mm and values (rows, columns), from the places where sigma is known.

    Where all of them are seen, a spline through them fills the gaps: these fields bend slowly.
    """
    x, column = np.unique(plane.sigma.points_m[:, 0], return_inverse=True)
    y, row = np.unique(plane.sigma.points_m[:, 1], return_inverse=True)
    table = np.full((len(y), len(x)), np.nan)
    table[row, column] = values
    if min(table.shape) > 3 and np.isfinite(table).all():
        fine_x, fine_y = np.linspace(x[0], x[-1], _FINE), np.linspace(y[0], y[-1], _FINE)
        table = np.asarray(RectBivariateSpline(y, x, table)(fine_y, fine_x))
        x, y = fine_x, fine_y
    return 1e3 * x, 1e3 * y, table


def _workspace(axes: Axes, plane: Plane) -> None:
    """World axes in mm, y downwards as the camera sees it."""
    x0, y0, x1, y1 = (1e3 * value for value in plane.workspace_m)
    axes.set_xlim(x0, x1)
    axes.set_ylim(y1, y0)
    axes.set_aspect("equal", anchor="N")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")


def _panel_in(plane: Plane, width_in: float) -> float:
    x0, y0, x1, y1 = plane.workspace_m
    return panel_height_in(width_in, (round(1e6 * (x1 - x0)) + 1, round(1e6 * (y1 - y0)) + 1))


def _sigma(plane: Plane) -> Figure:
    """Standard deviation of a marker's position over the workspace: in total, and by where it comes from."""
    sigma = plane.sigma
    parts: list[tuple[str, FloatArray | None]] = [
        ("All together", sigma.total_mm),
        ("From the intrinsics", sigma.intrinsics_mm),
        ("From the plane's fit", sigma.plane_mm),
        ("From whole pixels", sigma.quantisation_mm),
    ]
    lengths = [None if part is None else np.linalg.norm(part, axis=1) for _, part in parts]
    known = [np.inf if length is None else length for length in lengths]
    everything = np.concatenate([np.atleast_1d(length) for length in known])
    finite = everything[np.isfinite(everything)]
    worst = lengths[0][np.isfinite(lengths[0])] if lengths[0] is not None else finite
    most = number(float(worst.max()) if len(worst) else np.inf, "mm")
    note = (
        f"Standard deviation in mm of a marker's position, x and y together: up to {most} in the workspace. "
        "Variances of the three parts add up. Hatched, if any: not in the picture."
    )
    figure = sheet(
        2.0 * _panel_in(plane, 0.46 * WIDTH_IN),
        "How well a marker's position is known over the workspace",
        note,
        plane.verdict,
    )
    panels = figure.subplots(2, 2).ravel()
    norm = _common_colours(finite)
    for axes, (name, _), length in zip(panels, parts, lengths, strict=True):
        _workspace(axes, plane)
        if length is None:
            axes.set_title(name)
            empty(axes, "the covariance of the intrinsics is not known", 30)
            continue
        seen = length[np.isfinite(length)]
        most = f"up to {number(float(seen.max()), 'mm')}" if len(seen) else "not bounded"
        axes.set_title(f"{name}: {most}")
        x, y, table = _grid(plane, length)
        contour_map(axes, x, y, table, "mm", even=True, norm=norm)
    if len(finite):
        ticks = [level for level in contour_levels(finite) if norm.vmin <= level <= norm.vmax]
        bar = figure.colorbar(ScalarMappable(norm, RISING), ax=panels, fraction=0.04, pad=0.02, shrink=0.9)
        bar.minorticks_off()
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.set_label("standard deviation (mm)")
    return figure


def _common_colours(values: FloatArray) -> Normalize:
    """One scale of colours for all panels, by factors where the values span decades."""
    if len(values) == 0 or values.max() <= 0.0:
        return Normalize(0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    return LogNorm(low, high) if low > 0.0 and high > 12.0 * low else Normalize(0.0, high)


def _difference(camera: Camera, plane: Plane) -> Figure:
    """How far a homography fitted without the lens puts the marker from where the calibrated map does."""
    x0, y0, x1, y1 = plane.workspace_m
    x, y = np.linspace(x0, x1, _FINE), np.linspace(y0, y1, _FINE)
    points_m = np.stack(np.meshgrid(x, y), axis=-1)
    seen = visible(camera, plane.R_CW, plane.t_CW_m, points_m.reshape(-1, 2)).reshape(_FINE, _FINE)
    without = np.asarray(np.linalg.inv(plane.direct.H), dtype=np.float64)
    moved_mm = np.full(points_m.shape, np.nan)
    pixels = to_pixels(plane, camera, points_m[seen])
    moved_mm[seen] = 1e3 * (apply_homography(without, pixels) - points_m[seen])
    length = np.linalg.norm(moved_mm, axis=-1)
    finite = length[np.isfinite(length)]
    if len(finite):
        most, mean = number(float(finite.max()), "mm"), number(float(finite.mean()), "mm")
        free, fixed = number(plane.direct.rms_px, "px"), number(plane.rms_px, "px")
        note = (
            f"A homography fitted to the same corners without knowing the lens puts the marker up to {most} "
            f"elsewhere, {mean} on average. Its RMS is {free}, with the lens it is {fixed}. Dots: corners of "
            "the board."
        )
    else:
        note = "No part of the workspace is in the picture."
    figure = sheet(
        _panel_in(plane, 0.8 * WIDTH_IN),
        "What it costs to leave the lens out, over the workspace",
        note,
        plane.verdict,
    )
    axes = figure.subplots()
    _workspace(axes, plane)
    drawn = contour_map(axes, 1e3 * x, 1e3 * y, length, "mm", even=True)
    if drawn is not None:
        colour_bar(axes, drawn, "difference of the two maps (mm)")
    corners = 1e3 * plane.corners_m
    axes.scatter(corners[:, 0], corners[:, 1], s=16, color=INK, linewidths=0, zorder=4)
    if len(finite):
        some = (slice(2, None, 4), slice(2, None, 4))
        at, vectors = 1e3 * points_m[some].reshape(-1, 2), moved_mm[some].reshape(-1, 2)
        spacing = 4e3 * min(x[1] - x[0], y[1] - y[0])
        times = arrows(axes, at, vectors, 0.9 * spacing, "mm", colour=VERMILLION)
        axes.set_title(f"Arrows drawn {times:g} times")
    return figure


def _picture(camera: Camera, plane: Plane) -> Figure:
    """Corners with their residuals in the picture, and the workspace with the world's axes."""
    x0, y0, x1, y1 = (1e3 * value for value in plane.workspace_m)
    note = (
        f"RMS {number(plane.rms_px, 'px')} in the picture, {number(plane.rms_mm, 'mm')} on the plane, over "
        f"{plane.points} corners. Outlined: the workspace, x from {x0:g} to {x1:g} mm and y from {y0:g} to "
        f"{y1:g} mm."
    )
    figure = sheet(
        panel_height_in(0.88 * WIDTH_IN, camera.image_size_px),
        "The plane in the picture: corners, their residuals, and the workspace",
        note,
        plane.verdict,
    )
    axes = figure.subplots()
    picture_frame(axes, camera.image_size_px, margin=0.02)
    _outline(axes, camera, plane)
    _world_axes(axes, camera, plane)
    reach = 0.05 * max(camera.image_size_px)
    lengths = np.linalg.norm(plane.residuals_px, axis=1)
    times = magnified(reach, float(np.quantile(lengths, 0.98)))
    single = len(plane.pictures) == 1
    colours: list[Any] = [BLUE] if single else list(view_colours(len(plane.pictures)))
    first = 0
    for picture, colour in zip(plane.pictures, colours, strict=True):
        part = slice(first, first + picture.points)
        first += picture.points
        at = plane.corners_px[part]
        label = f"{plain(picture.name, 22)}, RMS {number(picture.rms_px, 'px')}"
        axes.scatter(at[:, 0], at[:, 1], s=14, color=colour, linewidths=0, zorder=4, label=label)
        arrows(
            axes,
            at,
            plane.residuals_px[part],
            reach,
            colour=colour,
            magnification=times,
            keyed=part.start == 0,
        )
    if 1 < len(plane.pictures) <= _MOST_NAMED:
        axes.legend(loc="best", frameon=True, framealpha=0.9, edgecolor="none", markerscale=1.5)
    axes.set_title(f"Residuals drawn {times:g} times")
    return figure


def _shown(camera: Camera, plane: Plane, world_m: FloatArray) -> FloatArray:
    """Pixels (n, 2) of places on the plane, NaN behind the camera and beyond the lens model's fold."""
    depth = world_m @ plane.R_CW[2, :2] + plane.t_CW_m[2]
    across = np.hypot(*(world_m @ plane.R_CW[:2, :2].T + plane.t_CW_m[:2]).T)
    kept = (depth > 0.0) & (across < fold_radius(camera)[0] * np.where(depth > 0.0, depth, 1.0))
    pixels = np.full(world_m.shape, np.nan)
    pixels[kept] = to_pixels(plane, camera, world_m[kept])
    return pixels


def _outline(axes: Axes, camera: Camera, plane: Plane) -> None:
    """The border of the workspace; curved where the lens bends it."""
    x0, y0, x1, y1 = plane.workspace_m
    along = np.linspace(0.0, 1.0, 41)[:, None]
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
    border = np.concatenate([a + along * (b - a) for a, b in pairwise(corners)])
    pixels = _shown(camera, plane, border)
    axes.plot(pixels[:, 0], pixels[:, 1], color=ORANGE, linewidth=2.0, zorder=3)
    if np.isfinite(pixels).all():
        axes.fill(pixels[:, 0], pixels[:, 1], color="#fdf1da", zorder=1)


def _world_axes(axes: Axes, camera: Camera, plane: Plane) -> None:
    """The world's x and y from the origin, or from the workspace's middle where the origin is not seen."""
    x0, y0, x1, y1 = plane.workspace_m
    length = round_down(0.3 * max(x1 - x0, y1 - y0))
    size = np.array(camera.image_size_px, dtype=np.float64)
    for start in (np.zeros(2), np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])):
        ends = _shown(camera, plane, start + length * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        if np.all(np.isfinite(ends)) and np.all((ends > 0.0) & (ends < size)):
            break
    else:
        return
    where = "origin" if not start.any() else "middle"
    for end, name, colour in zip(ends[1:], "xy", (VERMILLION, GREEN), strict=True):
        arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.2, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", tuple(end), xytext=tuple(ends[0]), arrowprops=arrow, zorder=6)
        beyond = ends[0] + 1.06 * (end - ends[0])
        side = "left" if name == "x" else "right"
        label = f"{name}, {1e3 * length:g} mm"
        words = axes.text(beyond[0], beyond[1], label, color=colour, fontweight="bold", ha=side, zorder=7)
        words.set_path_effects([patheffects.withStroke(linewidth=3.0, foreground="white")])
    words = axes.annotate(
        where, tuple(ends[0]), xytext=(-6, 6), textcoords="offset points", ha="right", zorder=7
    )
    words.set_path_effects([patheffects.withStroke(linewidth=3.0, foreground="white")])
