"""Figures of a camera, its plane and its lens."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.contour import ContourSet, QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.interpolate import RectBivariateSpline

from calib.core.arrays import BoolArray, FloatArray
from calib.core.geometry import apply_homography
from calib.show.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RISING,
    SHADE,
    SIGMA,
    SKY,
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
from calib.stages.camera.bundle import Calibration, Covariance, projection_sigma_px
from calib.stages.camera.checks import hull
from calib.stages.camera.intrinsics import Candidate, Intrinsics
from calib.stages.camera.lens import (
    DistortionReport,
    InversePolynomial,
    Region,
    displacement_field,
    distorted_normalised,
    distortion_kind,
    exact_inverse,
    fold_radius,
    pixel_grid,
    undistort_by_polynomial,
)
from calib.stages.camera.model import INTRINSICS, Camera, camera_from_vector, undistort, vector_from_camera
from calib.stages.camera.plane import Plane, to_pixels, visible

# ----------------------------------------------------------------------
# What figures draw over a picture or a plane: its frame, arrows with a key, contour maps, ellipses.

_LEAST_IN, _MOST_IN = 1.6, 7.4
_NEARLY_FLAT = 1e-3
"""A map whose values differ by less than this share has no contours worth drawing."""
_STEEP = 12.0
"""From this ratio of largest to smallest value on, levels are spaced by factors."""


def panel_height_in(width_in: float, image_size_px: tuple[int, int]) -> float:
    """Height in inches of a panel that shows the picture's frame at this width, labels included."""
    aspect = image_size_px[1] / image_size_px[0]
    return float(np.clip((width_in - 0.7) * aspect, _LEAST_IN, _MOST_IN)) + 0.8


def picture_frame(axes: Axes, image_size_px: tuple[int, int], margin: float = 0.02) -> None:
    """Pixels at their true aspect with v downwards, and the outline of the picture."""
    width, height = image_size_px
    pad = margin * max(width, height)
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=INK, linewidth=1.1, zorder=4))
    axes.set_xlim(-0.5 - pad, width - 0.5 + pad)
    axes.set_ylim(height - 0.5 + pad, -0.5 - pad)
    axes.set_aspect("equal", anchor="N")
    steps = [1, 2, 2.5, 5, 10]
    axes.xaxis.set_major_locator(MaxNLocator(5 if width >= 0.5 * height else 3, steps=steps))
    axes.yaxis.set_major_locator(MaxNLocator(5 if height >= 0.5 * width else 3, steps=steps))
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")


def grid_over(image_size_px: tuple[int, int], across: int) -> tuple[FloatArray, FloatArray]:
    """Coordinates (columns,), (rows,) of a grid over the picture's pixels, about square, borders included."""
    width, height = image_size_px
    down = int(np.clip(round(across * height / width), 3, 3 * across))
    return np.linspace(0.0, width - 1.0, across), np.linspace(0.0, height - 1.0, down)


def arrows(
    axes: Axes,
    at: FloatArray,
    vectors: FloatArray,
    reach: float,
    unit: str = "px",
    *,
    colour: Any = BLUE,
    pivot: str = "tail",
    magnification: float | None = None,
    keyed: bool = True,
) -> float:
    """Arrows at (n, 2) for vectors (n, 2) in the axes' own unit, with a key above the upper right corner.

    Parameters
    ----------
    reach : length in the axes' unit that the longer vectors should get.
    magnification : to use instead of the one that follows from `reach`.
    keyed : draw the key.

    Returns
    -------
    how many times as long as the vectors the arrows are.
    """
    usable = np.isfinite(at).all(axis=1) & np.isfinite(vectors).all(axis=1)
    at, vectors = at[usable], vectors[usable]
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    longest = float(np.quantile(length, 0.98)) if len(length) else 0.0
    if magnification is None:
        magnification = magnified(reach, longest)
    axes.quiver(
        at[:, 0],
        at[:, 1],
        vectors[:, 0],
        vectors[:, 1],
        angles="xy",
        scale_units="xy",
        scale=1.0 / magnification,
        units="inches",
        width=0.013,
        headwidth=4.0,
        headlength=4.5,
        headaxislength=4.0,
        minlength=0.6,
        pivot=pivot,
        color=colour,
        zorder=5,
    )
    if longest > 0.0 and keyed:
        _key(axes, round_down(1.3 * reach / magnification), magnification, unit, colour)
    return magnification


def _key(axes: Axes, length: float, magnification: float, unit: str, colour: Any) -> None:
    """An arrow of known length above the upper right corner, level with the panel's title."""
    (left, end), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
    start = end - length * magnification
    # Above a narrow panel there is no room beside the title.
    lift = 10.0 if end - left > 0.7 * (top - bottom) else 28.0
    above = ScaledTranslation(0.0, lift / 72.0, axes.figure.dpi_scale_trans)
    place = axes.get_xaxis_transform() + above
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.3, "shrinkA": 0.0, "shrinkB": 0.0}
    axes.annotate("", (end, 1.0), xytext=(start, 1.0), xycoords=place, textcoords=place, arrowprops=arrow)
    room = 0.015 * (end - left)
    axes.text(start - room, 1.0, f"{length:g} {unit}", transform=place, ha="right", va="center_baseline")


def magnified(reach: float, longest: float) -> float:
    """How many times, to two digits, `longest` fits into `reach`; 1 where there is nothing to magnify."""
    ratio = reach / longest if longest > 0.0 else 1.0
    if not (math.isfinite(ratio) and ratio > 0.0):
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(ratio)) - 1)
    return float(f"{max(math.floor(ratio / unit), 1) * unit:.2g}")


def contour_levels(values: FloatArray, *, even: bool = False) -> FloatArray:
    """Round levels that enclose all finite values: by 1-2-5 where these span decades, else evenly spaced."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    if low > 0.0 and high > _STEEP * low and not even:
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        steps = ("1", "2", "5") if high / low < 3e3 else ("1",)
        # One decade more on both sides: logarithms of round numbers may be off by their last digit.
        levels = [float(f"{step}e{k}") for k in range(first - 1, last + 2) for step in steps]
        inside = [level for level in levels if low < level < high]
        under = [level for level in levels if level <= low]
        over = [level for level in levels if level >= high]
        return np.array([under[-1], *inside, over[0]])
    return np.asarray(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high), dtype=np.float64)


def contour_map(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    values: FloatArray,
    unit: str,
    *,
    even: bool = False,
    norm: Normalize | None = None,
    labelled: bool = True,
) -> ContourSet | None:
    """Filled contours of values (rows, columns) over x, y, hatched where unknown.

    Parameters
    ----------
    even : see `contour_levels`.
    norm : colours by value, for panels that are to be compared; by default each level has its own.
    labelled : draw the lines between the levels and write their values on them.

    Returns what a colour bar needs, None where the map has no contours (nothing known, or all alike);
    a sentence in the panel then says so.
    """
    known = np.where(np.isfinite(values), values, np.nan)
    finite = known[np.isfinite(known)]
    left, right, top, bottom = float(x[0]), float(x[-1]), float(y[0]), float(y[-1])
    if len(finite) < known.size:
        axes.add_patch(
            Rectangle(
                (left, top),
                right - left,
                bottom - top,
                facecolor=SHADE,
                edgecolor="#b9c0c7",
                hatch="///",
                zorder=0,
            )
        )
    if len(finite) == 0:
        empty(axes, "not bounded" if np.isinf(values).any() else "nothing to show: no value is known here")
        return None
    spread = float(np.ptp(finite))
    if spread <= _NEARLY_FLAT * max(abs(float(finite.max())), 1e-12):
        axes.pcolormesh(
            x, y, np.where(np.isfinite(known), 0.25, np.nan), cmap=RISING, vmin=0.0, vmax=1.0, zorder=1
        )
        empty(axes, f"{number(float(finite.mean()), unit)} everywhere")
        return None
    levels = contour_levels(finite, even=even)
    if norm is None:
        norm = BoundaryNorm(levels, RISING.N)
    elif isinstance(norm, LogNorm) and norm.vmin is not None:
        levels = np.maximum(levels, 0.5 * norm.vmin)
    filled = axes.contourf(x, y, known, levels=levels, cmap=RISING, norm=norm, zorder=1)
    inside = levels[(levels > finite.min()) & (levels < finite.max())]
    if len(inside) and labelled:
        lines = axes.contour(x, y, known, levels=inside, colors=INK, linewidths=0.7, zorder=2)
        _label(axes, lines)
    return filled


def _label(axes: Axes, lines: QuadContourSet) -> None:
    """Values on contour lines, left out where they would run into each other or over the border."""
    corner, other = axes.transAxes.transform([(0.0, 0.0), (1.0, 1.0)])
    kept: list[tuple[float, float]] = []
    for text in axes.clabel(lines, inline=False, fontsize=9, fmt=lambda value: f"{value:g}"):
        at = axes.transData.transform(text.get_position())
        # As a share of the panel, which the layout moves but hardly reshapes.
        u, v = (at - corner) / (other - corner)
        if not (0.06 < u < 0.94 and 0.06 < v < 0.94) or any(
            abs(u - a) < 0.07 and abs(v - b) < 0.06 for a, b in kept
        ):
            text.remove()
            continue
        kept.append((u, v))
        text.set_path_effects([patheffects.withStroke(linewidth=3.0, foreground="white")])
        text.set_color(INK)
        text.set_zorder(3)


def colour_bar(
    axes: Axes, drawn: ContourSet, label: str, where: Literal["right", "bottom"] = "right"
) -> None:
    """A colour bar with its levels named."""
    bar = axes.figure.colorbar(drawn, ax=axes, location=where, fraction=0.045, pad=0.02, shrink=0.92)
    levels = list(drawn.levels)
    if where == "bottom":
        levels = levels[:: math.ceil(len(levels) / 5)]
    bar.set_ticks(levels, labels=[f"{level:g}" for level in levels])
    bar.set_label(label)


def ellipse(
    centre: tuple[float, float], covariance: FloatArray, sigmas: float, colour: str, *, dashed: bool = False
) -> Ellipse:
    """Outline of `sigmas` standard deviations of a 2 x 2 covariance."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * sigmas * np.sqrt(np.maximum(values[::-1], 0.0))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    return Ellipse(
        centre,
        float(width),
        float(height),
        angle=angle,
        fill=False,
        edgecolor=colour,
        linewidth=1.4,
        linestyle="--" if dashed else "-",
        zorder=6,
    )


# ----------------------------------------------------------------------
# Where the boards stood: drawn in the camera's frame, with how they leaned.

_HEIGHT_IN = 5.3
_LEFT = 0.62
"""Share of the width that the boards take."""


def pose_figure(fit: Calibration, verdict: str = "ok") -> Figure:
    """Boards in the camera's frame, a histogram of their tilts, and the directions they lean to."""
    R, t = fit.block.R_CT, fit.block.t_CT_m
    usable = np.flatnonzero(np.isfinite(R).all(axis=(1, 2)) & np.isfinite(t).all(axis=1))
    note = (
        "Boards that stand parallel to each other say the same about the camera. A good set leans to all "
        "sides, by 20 to 50 degrees, and so fills the panel at the lower right."
    )
    figure = sheet(_HEIGHT_IN, "Where the boards stood before the camera, and how they leaned", note, verdict)
    grid = figure.add_gridspec(2, 2, width_ratios=[_LEFT, 1.0 - _LEFT])
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    normals = R[usable, :, 2]
    normals = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    colours = view_colours(fit.observations.views)
    _tilts(figure.add_subplot(grid[0, 1]), normals)
    _leans(figure.add_subplot(grid[1, 1]), normals, [colours[i] for i in usable])
    _scene(space, fit, usable.tolist(), colours)
    return figure


def _tilts(axes: Axes, normals: FloatArray) -> None:
    tilt = np.degrees(np.arccos(np.clip(normals[:, 2], 0.0, 1.0)))
    axes.hist(tilt, bins=18, range=(0.0, 90.0), color=BLUE, edgecolor="white", linewidth=0.6)
    axes.set_xlim(0.0, max(60.0, 5.0 * np.ceil(tilt.max() / 5.0)) if len(tilt) else 60.0)
    axes.set_ylim(0.0, None if len(tilt) else 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlabel("angle to the picture's plane (degrees)")
    axes.set_ylabel("views")
    axes.set_title("Tilt of the board")


def _leans(axes: Axes, normals: FloatArray, colours: list[tuple[float, float, float, float]]) -> None:
    """Each board's normal as its angles to the right and upwards; the middle is a board facing the camera."""
    tilt = np.degrees(np.arccos(np.clip(normals[:, 2], 0.0, 1.0)))
    direction = np.arctan2(normals[:, 1], normals[:, 0])
    right, down = tilt * np.cos(direction), tilt * np.sin(direction)
    reach = max(64.0, 1.08 * float(tilt.max())) if len(normals) else 64.0
    for ring in (20.0, 40.0, 60.0):
        axes.add_patch(Circle((0.0, 0.0), ring, fill=False, edgecolor="#c3cad0", linewidth=0.9))
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    axes.axvline(0.0, color=GREY, linewidth=0.7)
    size = float(np.clip(900.0 / max(len(normals), 1), 8.0, 40.0))
    axes.scatter(right, down, s=size, color=colours or None, edgecolor="white", linewidth=0.4, zorder=3)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(reach, -reach)
    axes.set_aspect("equal")
    axes.set_xlabel("normal, to the right (degrees)")
    axes.set_ylabel("normal, down (degrees)")
    axes.set_title("Lean of each view")


def _rays(camera: Camera) -> FloatArray:
    """Directions (4, 3) of the picture's corners, as an ideal lens has them where this one has none."""
    width, height = camera.image_size_px
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [width - 1, height - 1], [0.0, height - 1]])
    ideal = undistort(camera, corners)
    plain_y = (corners[:, 1] - camera.cy_px) / camera.fy_px
    plain_x = (corners[:, 0] - camera.cx_px - camera.skew_px * plain_y) / camera.fx_px
    ideal = np.where(np.isfinite(ideal), ideal, np.stack([plain_x, plain_y], axis=1))
    return np.column_stack([ideal, np.ones(4)])


def _drawn(points_C: FloatArray) -> FloatArray:
    """Camera axes (x right, y down, z forward) as the plot's (right, forward, up)."""
    return points_C[..., [0, 2, 1]] * [1.0, 1.0, -1.0]


def _scene(
    axes: Any, fit: Calibration, usable: list[int], colours: list[tuple[float, float, float, float]]
) -> None:
    """Outlines of the boards and the cone of sight."""
    observations, block = fit.observations, fit.block
    rays = _rays(fit.camera)
    if not usable or not np.isfinite(rays).all():
        axes.set_axis_off()
        axes.text2D(0.5, 0.5, "no poses: the fit failed", transform=axes.transAxes, ha="center", color=GREY)
        return
    boards = []
    for i in usable:
        target = observations.target_m[0 if observations.same_target else i][observations.present[i]]
        outline = hull(target[:, :2])
        flat = np.column_stack([outline, np.zeros(len(outline))])
        boards.append(_drawn(flat @ block.R_CT[i].T + block.t_CT_m[i]))
    depth = float(np.median([board[:, 1].mean() for board in boards]))
    # A focal length that means nothing can open the cone to almost a half space.
    cone = _drawn(0.3 * depth * rays / max(1.0, float(np.abs(rays).max())))
    faint = 0.28 if len(boards) <= 40 else 0.08
    axes.add_collection3d(
        Poly3DCollection(
            boards,
            facecolors=[(*colours[i][:3], faint) for i in usable],
            edgecolors=[(*colours[i][:3], 1.0 if len(boards) <= 40 else 0.45) for i in usable],
            linewidths=1.1 if len(boards) <= 40 else 0.6,
        )
    )
    edges = [np.stack([np.zeros(3), corner]) for corner in cone]
    edges += [np.stack([cone[k], cone[(k + 1) % 4]]) for k in range(4)]
    axes.add_collection3d(Line3DCollection(edges, colors=INK, linewidths=1.3))
    axes.add_collection3d(Poly3DCollection([cone], facecolors=[(0.3, 0.35, 0.4, 0.15)]))
    everything = np.concatenate([*boards, cone, np.zeros((1, 3))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    # Ticks of a flat scene would lie on top of each other.
    widest = float((high - low).max())
    spare = np.maximum(0.25 * widest - (high - low), 0.0) / 2 + 0.03 * widest
    low, high = low - spare, high + spare
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(high - low, zoom=1.02)
    axes.set_proj_type("ortho")
    axes.view_init(elev=22.0, azim=-62.0)
    axes.set_xlabel("x, right (m)", labelpad=7.0)
    axes.set_ylabel("z, forward (m)", labelpad=9.0)
    axes.set_zlabel("-y, up (m)", labelpad=7.0)
    for axis, extent in zip((axes.xaxis, axes.yaxis, axes.zaxis), high - low, strict=True):
        axis.pane.set_facecolor("#f7f8f9")
        axis.pane.set_edgecolor("#d3d8dd")
        axis.set_major_locator(MaxNLocator(int(np.clip(round(6 * extent / widest), 2, 5))))


# ----------------------------------------------------------------------
# Figures of what the fit leaves over: how large the residuals are, view by view, and where they point.

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


# ----------------------------------------------------------------------
# Figures of lens distortion: where it moves what is seen (Fig. B.2), and how well it can be undone.

_SAMPLE = 40_000
"""Pixels over which the displacement is averaged."""


def write_lens_figures(folder: Path, camera: Camera, report: DistortionReport) -> list[Path]:
    """Draw a camera's distortion and its inverse into a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        return [
            save(_displacement(camera, report), folder / "lens_displacement.png"),
            save(_inverse(camera, report.inverse), folder / "lens_inverse.png"),
        ]


def distortion_figure(
    camera: Camera, covariance: Covariance, seen_px: FloatArray, verdict: str = "ok"
) -> Figure:
    """Displacement by a calibrated lens over the picture, and along the radius with its uncertainty.

    Parameters
    ----------
    seen_px : (n, 2) pixels of the points that the camera was calibrated with.
    """
    length = np.linalg.norm(
        displacement_field(camera, pixel_grid(camera.image_size_px, most=_SAMPLE)), axis=-1
    )
    if not np.all(np.isfinite(length)):
        note = "The camera's numbers are not finite; its distortion cannot be drawn."
    elif length.max() == 0.0:
        note = "This camera model has no distortion."
    else:
        note = (
            f"Kind: {distortion_kind(camera)}; up to {number(float(length.max()), 'px')}, mean "
            f"{number(float(length.mean()), 'px')} over the picture. Arrows lead from where a lens without "
            "distortion shows a point to where this one does. Dashed: hull of the corners seen; shaded: none "
            "seen."
        )
    figure = _sheet(camera, "How far lens distortion moves what is seen", note, verdict)
    left, right = figure.subplots(1, 2, width_ratios=[1.55, 1.0])
    _map(left, camera)
    _radial_curve(right, camera, covariance, seen_px)
    if np.any(camera.distortion) and np.isfinite(vector_from_camera(camera)).all():
        outline = _ideal_pixels(camera, hull(seen_px))
        known = outline[np.isfinite(outline).all(axis=1)]
        left.add_patch(Polygon(known, fill=False, edgecolor=INK, linewidth=1.4, linestyle="--", zorder=6))
    return figure


def _sheet(camera: Camera, title: str, note: str, verdict: str) -> Figure:
    return sheet(max(panel_height_in(0.6 * WIDTH_IN, camera.image_size_px), 3.9), title, note, verdict)


def _ideal_pixels(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Where a lens without distortion shows what is seen at pixels (n, 2)."""
    ideal = undistort(camera, pixels)
    return np.asarray(np.column_stack([ideal, np.ones(len(ideal))]) @ camera.K[:2].T)


def _focal(camera: Camera) -> float:
    return math.sqrt(abs(camera.fx_px * camera.fy_px))


def _farthest_corner_px(camera: Camera) -> float:
    """Distance of the picture's farthest corner from the principal point."""
    width, height = camera.image_size_px
    across = max(camera.cx_px, width - 1 - camera.cx_px)
    down = max(camera.cy_px, height - 1 - camera.cy_px)
    return math.hypot(across, down)


def _before_fold(camera: Camera, pixels: FloatArray) -> BoolArray:
    """Which ideal pixels (..., 2) the lens model shows once only."""
    y = (pixels[..., 1] - camera.cy_px) / camera.fy_px
    x = (pixels[..., 0] - camera.cx_px - camera.skew_px * y) / camera.fx_px
    return np.asarray(np.hypot(x, y) < fold_radius(camera)[0])


def _map(axes: Axes, camera: Camera, region: Region | None = None) -> None:
    """Length of the displacement as a map, arrows on top, and the region of interest."""
    picture_frame(axes, camera.image_size_px)
    if not np.isfinite(vector_from_camera(camera)).all():
        empty(axes, "not bounded")
        return
    if not np.any(camera.distortion):
        empty(axes, "no distortion: every point is seen where an ideal lens shows it")
    else:
        u, v = grid_over(camera.image_size_px, 81)
        pixels = np.stack(np.meshgrid(u, v), axis=-1)
        length = np.linalg.norm(displacement_field(camera, pixels), axis=-1)
        contour_map(axes, u, v, np.where(_before_fold(camera, pixels), length, np.nan), "px", even=True)
        u, v = grid_over(camera.image_size_px, 15)
        at = np.stack(np.meshgrid(u[1:-1], v[1:-1]), axis=-1).reshape(-1, 2)
        at = at[_before_fold(camera, at)]
        times = arrows(axes, at, displacement_field(camera, at), float(u[1]), colour=VERMILLION)
        axes.set_title(f"Displacement in px; arrows drawn {times:g} times")
    if region is not None:
        u0, v0, u1, v1 = region
        box = Rectangle((u0, v0), u1 - u0, v1 - v0, fill=False, edgecolor=VERMILLION, linewidth=2.2, zorder=7)
        axes.add_patch(box)


def _radial(camera: Camera, radius_px: FloatArray) -> FloatArray:
    """Displacement along the radius at ideal radii, the radial part of the model alone, pixels."""
    focal = _focal(camera)
    k1, k2, _, _, k3, k4, k5, k6 = camera.distortion
    r2 = (radius_px / focal) ** 2
    factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.asarray(radius_px * (factor - 1.0))


def _radial_sigma(camera: Camera, covariance: Covariance, radius_px: FloatArray) -> FloatArray:
    """Standard deviation of `_radial` to first order, infinite where the views do not bound it."""
    if not np.all(np.isfinite(covariance.intrinsics)):
        return np.full(len(radius_px), np.inf)
    vector = vector_from_camera(camera)
    rows = []
    for name, sigma in covariance.sigma().items():
        step = np.zeros(len(vector))
        step[INTRINSICS.index(name)] = 1e-4 * sigma or 1e-9
        ahead, behind = (
            _radial(camera_from_vector(camera.model, camera.image_size_px, vector + sign * step), radius_px)
            for sign in (1.0, -1.0)
        )
        rows.append((ahead - behind) / (2.0 * step.sum()))
    J = np.array(rows).reshape(-1, len(radius_px))
    variance = np.einsum("pr,pq,qr->r", J, covariance.intrinsics, J)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _radial_curve(
    axes: Axes, camera: Camera, covariance: Covariance | None = None, seen_px: FloatArray | None = None
) -> None:
    """Displacement over the distance from the principal point, out to the farthest corner."""
    axes.set_xlabel("distance from the principal point (px)")
    axes.set_ylabel("moved outwards (px)")
    last = _farthest_corner_px(camera)
    if not (math.isfinite(last) and np.isfinite(vector_from_camera(camera)).all()):
        empty(axes, "not bounded")
        return
    fold = min(fold_radius(camera)[0] * _focal(camera), last)
    radius = np.linspace(0.0, fold, 241)
    moved = _radial(camera, radius)
    low, high = float(moved.min()), float(moved.max())
    span = max(high - low, 1e-3 if np.any(camera.distortion) else 2.0)
    bottom, top = low, high
    title = "Along the radius"
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    if covariance is not None and np.any(camera.distortion):
        sigma = _radial_sigma(camera, covariance, radius)
        if np.isfinite(sigma).all():
            below, above = moved - 2 * sigma, moved + 2 * sigma
            axes.fill_between(radius, below, above, color=SKY, alpha=0.45, linewidth=0, zorder=2)
            # A band that the views hardly bound must not flatten the curve.
            bottom, top = max(float(below.min()), low - span), min(float(above.max()), high + span)
            title += f", band of 2 {SIGMA}"
        else:
            title += f", {SIGMA} not bounded"
    axes.plot(radius, moved, color=BLUE, linewidth=2.2, zorder=3)
    axes.set_xlim(0.0, last)
    axes.set_ylim(bottom - 0.06 * span, top + 0.06 * span)
    if seen_px is not None:
        seen = _ideal_pixels(camera, seen_px) - [camera.cx_px, camera.cy_px]
        reached = float(np.nanmax(np.append(np.hypot(seen[:, 0], seen[:, 1]), 0.0)))
        if reached < last:
            axes.axvspan(
                reached, last, facecolor="#fdeccc", edgecolor=ORANGE, hatch="//", linewidth=0.5, zorder=0
            )
    if fold < last:
        axes.axvline(fold, color=INK, linewidth=1.4, linestyle=":")
        title = "Along the radius, to where the model folds over"
    axes.grid()
    axes.set_title(title)


def _displacement(camera: Camera, report: DistortionReport) -> Figure:
    """The map of Fig. B.2 with the region of interest, and the radial curve."""
    most, mean = number(report.max_px, "px"), number(report.mean_px, "px")
    region_most, region_mean = number(report.region_max_px, "px"), number(report.region_mean_px, "px")
    note = (
        f"Kind: {plain(report.kind)}; it {plain(report.effect)}. Whole picture: up to {most}, mean "
        f"{mean}. Region of interest (box): up to {region_most}, mean {region_mean}."
    )
    if report.plane is not None:
        read, fitted = number(report.plane.max_mm, "mm"), number(report.plane.refitted_max_mm, "mm")
        note += (
            f" On the plane, reading without the lens costs up to {read}, with the best map that knows no "
            f"lens {fitted}."
        )
    if not report.monotonic:
        note += " Beyond the dotted line the model folds over."
    figure = _sheet(camera, "What lens distortion does to the picture", note, "ok")
    left, right = figure.subplots(1, 2, width_ratios=[1.55, 1.0])
    _map(left, camera, report.region_px)
    _radial_curve(right, camera)
    u0, v0, u1, v1 = report.region_px
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) - [camera.cx_px, camera.cy_px]
    right.axvline(float(np.linalg.norm(corners, axis=1).max()), color=VERMILLION, linewidth=1.8)
    right.set_title("Along the radius; red: end of the region")
    return figure


def _inverse(camera: Camera, inverse: InversePolynomial) -> Figure:
    """Distance between the polynomial's answer and the exact one, over the picture and the radius."""
    count = len(inverse.radial)
    most, asked = number(inverse.max_error_px, "px"), number(inverse.tolerance_px, "px", 1)
    note = (
        f"{count} radial coefficient{'' if count == 1 else 's'}; largest error {most} where {asked} is asked "
        f"for, over the {100 * inverse.covered:.0f} % of the picture that the lens model can show."
    )
    figure = _sheet(camera, "How well the firmware's polynomial undoes the lens", note, "ok")
    left, right = figure.subplots(1, 2, width_ratios=[1.55, 1.0])
    picture_frame(left, camera.image_size_px)
    u, v = grid_over(camera.image_size_px, 121)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    error = _inverse_error(camera, inverse, pixels.reshape(-1, 2))
    drawn = contour_map(left, u, v, error.reshape(pixels.shape[:2]), "px", even=True, labelled=False)
    if drawn is not None:
        colour_bar(left, drawn, "error (px)", "bottom")
    left.set_title("Error over the picture")
    radius = np.linalg.norm(pixels.reshape(-1, 2) - [camera.cx_px, camera.cy_px], axis=1)
    right.scatter(radius, error, s=2.5, color=BLUE, linewidths=0, zorder=3)
    finite = error[np.isfinite(error)]
    largest = float(finite.max()) if len(finite) else 0.0
    shown = inverse.tolerance_px <= 4.0 * largest or largest == 0.0
    if shown:
        right.axhline(inverse.tolerance_px, color=VERMILLION, linewidth=1.6, linestyle="--", zorder=4)
    right.set_ylim(0.0, 1.15 * max(largest, inverse.tolerance_px if shown else 0.0))
    right.set_xlim(0.0, float(radius.max()))
    right.grid()
    right.set_xlabel("distance from the principal point (px)")
    right.set_ylabel("error (px)")
    right.set_title("Error over the radius")
    return figure


def _inverse_error(camera: Camera, inverse: InversePolynomial, pixels: FloatArray) -> FloatArray:
    """Distance in pixels (n,) between both inverses, NaN where the lens model has none."""
    exact, shown = exact_inverse(camera, pixels)
    found = undistort_by_polynomial(inverse, distorted_normalised(camera, pixels))
    error = np.linalg.norm((found - exact) @ camera.K[:2, :2].T, axis=1)
    return np.asarray(np.where(shown, error, np.nan))


# ----------------------------------------------------------------------
# Figures of a calibrated plane: how well a marker's position is known, and what the lens costs there.

_FINE = 45
"""Places along each side of the workspace at which maps are drawn."""
_PLANE_FIGURES_MOST_NAMED = 6
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
        plane.verdict.word,
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
        plane.verdict.word,
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
        plane.verdict.word,
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
    if 1 < len(plane.pictures) <= _PLANE_FIGURES_MOST_NAMED:
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


# ----------------------------------------------------------------------
# Figures of a camera's calibration: what the views say, where they say it, and what is left open.

_COLUMNS, _ROWS = 6, 5
"""Cells of the picture in which points are looked for, as in `calib.stages.camera.checks`."""


def write_camera_figures(folder: Path, result: Intrinsics) -> list[Path]:
    """Draw everything about a calibration into a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    fit, verdict = result.calibration, result.judgement.verdict.word
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
