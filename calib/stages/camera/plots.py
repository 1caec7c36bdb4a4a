"""Figures of a camera, its plane and its lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import RectBivariateSpline

from calib.core import plot
from calib.core.arrays import FloatArray, IntArray
from calib.core.geometry import box_grid
from calib.stages.camera.bundle import Calibration, Covariance, projection_sigma_px
from calib.stages.camera.checks import Means, cell_means, cell_of, hull
from calib.stages.camera.intrinsics import Candidate, Intrinsics
from calib.stages.camera.lens import (
    displacement_field,
    distortion_kind,
    ideal_pixels,
    pixel_grid,
    radial_displacement,
    radial_sigma,
    shown_once,
)
from calib.stages.camera.model import Camera, focal_px, fold_radius, vector_from_camera
from calib.stages.camera.plane import Plane, moved_m
from calib.stages.camera.pose import plane_pixels
from calib.stages.camera.section import Lens

Size = tuple[int, int]
_RADIUS = "distance from the principal point (px)"


def plots(result: Intrinsics) -> dict[str, plot.Figure]:
    """Figures of a calibration: `camera_errors`, `camera_residuals`, ...; what was compared comes last."""
    fit, sigma = result.calibration, result.covariance
    figures = {
        "camera_errors": _errors(fit),
        "camera_residuals": _residuals(fit),
        "camera_coverage": _coverage(fit, sigma),
        "camera_poses": _poses(fit),
        "camera_sigma": _projection_sigma(fit, sigma),
        "camera_distortion": _distortion(fit, sigma),
    }
    if result.models:
        figures["camera_models"] = _comparison("lens model", result.models, fit.camera.model)
    if result.boards:
        figures["camera_boards"] = _comparison("board model", result.boards, result.board)
    return plot.judged(figures, result.verdict.word)


def lens_plots(lens: Lens) -> dict[str, plot.Figure]:
    """`lens_displacement`: a camera's distortion."""
    return {"lens_displacement": _displacement(lens.evidence, lens)}


def plane_plots(camera: Camera, plane: Plane) -> dict[str, plot.Figure]:
    """`plane_picture`, `plane_sigma` and `plane_difference`."""
    figures = {
        "plane_picture": _plane_picture(camera, plane),
        "plane_sigma": _plane_sigma(plane),
        "plane_difference": _plane_difference(camera, plane),
    }
    return plot.judged(figures, plane.verdict.word)


# ----------------------------------------------------------------------
# Panels that show the picture.

_LEAST_IN, _MOST_IN = 1.6, 7.4


def panel_height_in(share: float, size: Size | FloatArray) -> float:
    """Height in inches of a panel that shows a frame at this share of the width, labels included."""
    return float(np.clip((share * plot.WIDTH_IN - 0.7) * size[1] / size[0], _LEAST_IN, _MOST_IN)) + 0.8


def picture(size: Size, marks: Sequence[plot.Mark], title: str = "", empty: str = "") -> plot.Plot:
    """Pixels at their true aspect with v downwards, and the outline of the picture."""
    width, height = size
    pad = 0.5 + 0.02 * max(width, height)
    inside = (*marks, plot.Shape(plot.rectangle(-0.5, -0.5, width, height)))
    u, v = (-pad, width - 1.0 + pad), (-pad, height - 1.0 + pad)
    return plot.Plot("u (px)", "v (px)", inside, title, u, v, grid="", equal=True, down=True, empty=empty)


def grid_over(size: Size, across: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Coordinates (columns,), (rows,) and pixels (rows, columns, 2), the cells about square."""
    down = int(np.clip(round(across * size[1] / size[0]), 3, 3 * across))
    pixels = box_grid((0.0, 0.0, size[0] - 1.0, size[1] - 1.0), across, down)
    return pixels[0, :, 0], pixels[:, 0, 1], pixels


# ----------------------------------------------------------------------
# What the fit leaves over: how large the residuals are, view by view, and where they point.

_MOST_NAMED = 26
"""Views whose names fit beside their bars."""
_ROUNDING_PX = 1e-9
"""No corner is measured to this; residuals below it are those of arithmetic."""
_MOST_ARROWS = 720


def _points(fit: Calibration) -> tuple[IntArray, ...]:
    """Indices of points and views with residuals, point by point: no view lies wholly on top of another."""
    return np.nonzero(np.isfinite(fit.residuals_px).all(axis=2).T)


def _errors(fit: Calibration) -> plot.Figure:
    """RMS of each view as bars, and all residuals as a cloud in the same colours."""
    names, views, whole = fit.observations.names, fit.observations.views, fit.rms_px
    squared = np.sum(fit.residuals_px**2, axis=2)
    count = np.isfinite(squared).sum(axis=1)
    rms = np.sqrt(np.nansum(squared, axis=1) / np.maximum(count, 1))
    worst = int(np.argmax(rms))
    note = (
        f"The RMS is {plot.number(whole, 'px')} over {fit.observations.points} points in {views} view"
        f"{'' if views == 1 else 's'}, at worst {plot.number(float(rms[worst]), 'px')} in "
        f"{plot.short(names[worst], 24)}. Rings are 1, 2 and 3 standard deviations of a coordinate "
        f"({plot.number(fit.sigma_px, 'px')}); chance puts 39, 86 and 99 % inside."
    )
    if not count.any():
        note = f"There are no residuals: the fit ended as {fit.termination!r}."
    title, y = "Each view; dashed: all together", "RMS of the view (px)"
    if views <= _MOST_NAMED:
        bars = plot.Bars(np.arange(views), rms, colour=plot.spaced(views), across=True)
        labels = tuple(plot.short(name, 24) for name in names)
        left = plot.Plot(y, "", (bars, plot.Rule("x", whole, "ink", "dashed")), title, grid="x", names=labels)
        high = max(4.4, 0.2 * views + 1.0)
    else:
        bars = plot.Bars(np.arange(1, views + 1), rms, 1.0, plot.spaced(views))
        left = plot.Plot(
            "view, in the order given", y, (bars, plot.Rule("y", whole, "ink", "dashed")), title, grid="y"
        )
        high = 4.6
    title = "How far the corners lie from where the fitted camera puts them"
    return plot.Figure(title, note, (left, _cloud(fit)), high, columns=2, widths=(1.12, 1.0))


def _cloud(fit: Calibration) -> plot.Plot:
    """Residuals with equal axes; how many lie outside of the panel stands above it."""
    point, view = _points(fit)
    residuals = fit.residuals_px[view, point]
    x, y = "projected less measured, u (px)", "projected less measured, v (px)"
    if len(residuals) == 0:
        return plot.Plot(x, y, empty=f"no residuals: the fit ended as {fit.termination!r}")
    sigma, largest = fit.sigma_px, float(np.abs(residuals).max())
    limit = max(3.5 * sigma, min(1.08 * largest, 7.0 * sigma)) or 1.0
    size = float(np.clip(math.sqrt(6000.0 / len(residuals)), 1.2, 4.0))
    u, v = residuals.T
    marks: list[plot.Mark] = [plot.Rule("x", 0.0), plot.Rule("y", 0.0)]
    marks.append(plot.Curve(u, v, kind="points", colour=plot.spaced(fit.observations.views)[view], size=size))
    distance = np.hypot(u, v)
    for ring in (1, 2, 3):
        share = float(np.mean(distance <= ring * sigma))
        marks.append(plot.Shape(plot.circle(0.0, 0.0, ring * sigma)))
        marks.append(plot.Text(0.0, -ring * sigma, f"{ring}{plot.SIGMA}: {100 * share:.0f} %"))
    outside = int(np.any(np.abs(residuals) > limit, axis=1).sum())
    farther = f"Each point; {outside} farther out, up to {plot.number(float(distance.max()), 'px')}"
    title = farther if outside else "Each point, coloured as its view"
    return plot.Plot(x, y, marks, title, (-limit, limit), (-limit, limit), equal=True, down=True)


def _residuals(fit: Calibration) -> plot.Figure:
    """Residual vectors where they are in the picture, and their mean over cells against chance."""
    size = fit.camera.image_size_px
    point, view = _points(fit)
    at, vectors = fit.observations.pixels[view, point], fit.residuals_px[view, point]
    means = cell_means(fit, at, vectors, fit.weights[view, point])
    note = (
        "Errors of chance point every way, and 95 % of the cells' means stay in their discs. Arrows that "
        "agree with their neighbours show what lens model or board leave unexplained. "
        f"{int(means.outside.sum())} of {len(means.at)} means leave their discs."
    )
    nothing = ""
    if len(at) == 0:
        nothing = f"no residuals: the fit ended as {fit.termination!r}"
    elif float(np.abs(vectors).max()) < _ROUNDING_PX:
        nothing = "the residuals are rounding errors"
    panels = (_each(size, at, vectors), _mean(size, means))
    if nothing:
        panels = (picture(size, (), empty=nothing),) * 2
    title = "Where the residuals point, over the picture"
    return plot.Figure(title, note, panels, panel_height_in(0.5, size), columns=2)


def _each(size: Size, at: FloatArray, vectors: FloatArray) -> plot.Plot:
    """Residuals (n, 2) of points, or of as many as there is room for."""
    # An even step would pick the same views again and again.
    some = np.sort(np.random.default_rng(0).permutation(len(at))[:_MOST_ARROWS])
    times = _times(vectors[some], 0.08 * max(size))
    which = "Each point" if len(some) == len(at) else f"{len(some)} of {len(at)} points"
    arrows = plot.Arrows(at[some], vectors[some], times, "px")
    return picture(size, (arrows,), f"{which}, drawn {times:g} times")


def _times(vectors: FloatArray, reach: float) -> float:
    """How many times as long the longer vectors (n, 2) are drawn to have a length."""
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    length = length[np.isfinite(length)]
    return plot.magnified(reach, float(np.quantile(length, 0.98)) if len(length) else 0.0)


def _mean(size: Size, means: Means) -> plot.Plot:
    if len(means.at) == 0:
        return picture(size, (), empty="no cell of the picture holds enough points")
    lengths = np.maximum(np.hypot(*means.mean.T), means.by_chance)
    times = plot.magnified(means.reach_px, float(np.quantile(lengths, 0.9)))
    discs = [
        plot.Shape(plot.circle(u, v, times * radius), "peach" if far else "shade", None)
        for (u, v), radius, far in zip(means.at, means.by_chance, means.outside, strict=True)
    ]
    arrows = plot.Arrows(means.at, means.mean, times, "px")
    return picture(size, (*discs, arrows), f"Mean of each cell, drawn {times:g} times")


# ----------------------------------------------------------------------
# How the boards leaned.


def _poses(fit: Calibration) -> plot.Figure:
    """A histogram of the boards' tilts, and the directions they lean to."""
    usable = np.flatnonzero(fit.block.posed)
    note = (
        "Boards that stand parallel to each other say the same about the camera. A good set leans to all "
        "sides, by 20 to 50 degrees, and so fills the panel at the right."
    )
    normals = fit.block.normals[usable]
    colours = plot.spaced(fit.observations.views)[usable]
    title = "How the boards leaned before the camera"
    return plot.Figure(title, note, _tilts(normals, colours), 4.0, columns=2)


def _tilts(normals: FloatArray, colours: FloatArray) -> tuple[plot.Plot, plot.Plot]:
    """Tilts of normals (n, 3), and where they lean: the middle is a board that faces the camera."""
    tilt = np.degrees(np.arccos(np.clip(normals[:, 2], 0.0, 1.0)))
    most = float(tilt.max()) if len(tilt) else 0.0
    x, limits = "angle to the picture's plane (degrees)", (0.0, max(60.0, 5.0 * math.ceil(most / 5.0)))
    bars = (plot.histogram(tilt, 18, 0.0, 90.0),)
    views = plot.Plot(x, "views", bars, "Tilt of the board", limits, whole="y", grid="")
    direction = np.arctan2(normals[:, 1], normals[:, 0])
    right, down = tilt * np.cos(direction), tilt * np.sin(direction)
    size = float(np.clip(math.sqrt(900.0 / max(len(normals), 1)), 3.0, 6.0))
    rings = [plot.Shape(plot.circle(0.0, 0.0, ring), edge="silver") for ring in (20.0, 40.0, 60.0)]
    points = plot.Curve(right, down, kind="points", colour=colours, size=size)
    reach = max(64.0, 1.08 * most)
    x, y, limits = "normal, to the right (degrees)", "normal, down (degrees)", (-reach, reach)
    marks: tuple[plot.Mark, ...] = (*rings, plot.Rule("x", 0.0), plot.Rule("y", 0.0), points)
    return views, plot.Plot(x, y, marks, "Lean of each view", limits, limits, grid="", equal=True, down=True)


# ----------------------------------------------------------------------
# What the views cover, how uncertain that leaves the camera, and which model was taken.

_COLUMNS, _ROWS = 6, 5
"""Cells of the picture in which points are looked for, as in `calib.stages.camera.checks`."""


def _coverage(fit: Calibration, sigma: Covariance) -> plot.Figure:
    """All points over the picture with empty cells shaded, the principal point, and points by radius."""
    camera, size = fit.camera, fit.camera.image_size_px
    pixels = fit.observations.pixels[fit.observations.present]
    filled = set(zip(*(part.tolist() for part in cell_of(pixels, size, _COLUMNS, _ROWS)), strict=True))
    wide, high = size[0] / _COLUMNS, size[1] / _ROWS
    note = (
        f"{len(filled)} of {_COLUMNS * _ROWS} cells of the picture hold points; the others are hatched. "
        "Where no point was seen the camera's numbers are extrapolated."
    )
    marks: list[plot.Mark] = [
        plot.Shape(plot.rectangle(i * wide - 0.5, j * high - 0.5, wide, high), "ochre", hatched=True)
        for i in range(_COLUMNS)
        for j in range(_ROWS)
        if (i, j) not in filled
    ]
    dot = float(np.clip(math.sqrt(5000.0 / len(pixels)), 1.0, 3.5))
    marks.append(plot.Curve(pixels[:, 0], pixels[:, 1], kind="points", size=dot))
    centre = camera.centre_px
    if np.isfinite(centre).all():
        marks.append(plot.Curve(centre[:1], centre[1:], kind="pluses", colour="red", size=15.0))
    rings, principal = _principal_point(camera, sigma)
    title = "Corners of all views (dots) and the principal point (cross)"
    frame = picture(size, (*marks, *rings[:1]), title)
    title, high = f"Which parts of the picture the {len(pixels)} corners cover", panel_height_in(0.62, size)
    panels = (frame, principal, _radii(camera, pixels))
    return plot.Figure(title, note, panels, max(high, 4.3), mosaic=("AB", "AC"), widths=(1.75, 1.0))


def _principal_point(camera: Camera, sigma: Covariance) -> tuple[tuple[plot.Shape, ...], plot.Plot]:
    """Ellipses of the principal point of 1 and 2 standard deviations, and a panel for them."""
    title, names = f"Principal point: 1 and 2 {plot.SIGMA}", ("cx_px", "cy_px")
    cx, cy = camera.cx_px, camera.cy_px
    why = ""
    if not np.isfinite([cx, cy]).all():
        why = "not known: the fit failed"
    elif not all(name in sigma.names for name in names):
        why = f"held at ({cx:.1f}, {cy:.1f}) px, not estimated"
    else:
        index = [sigma.names.index(name) for name in names]
        covariance = sigma.intrinsics[np.ix_(index, index)]
        if not np.all(np.isfinite(covariance)):
            why = "its standard deviation is not bounded by these views"
    if why:
        return (), plot.Plot(title=title, empty=why, bare=True)
    rings = (
        plot.Shape(plot.ellipse(cx, cy, covariance, 1.0), edge="red"),
        plot.Shape(plot.ellipse(cx, cy, covariance, 2.0), edge="red", kind="dashed"),
    )
    deviation = np.sqrt(np.diag(covariance))
    plus_minus = [plot.number(float(one), digits=2) for one in deviation]
    x, y = f"cx = {cx:.2f} ± {plus_minus[0]} px", f"cy = {cy:.2f} ± {plus_minus[1]} px"
    cross = plot.Curve(np.array([cx]), np.array([cy]), kind="pluses", colour="red", size=10.0)
    reach = max(2.2 * float(deviation.max()), 1e-3)
    around_x, around_y = (cx - 1.8 * reach, cx + 1.8 * reach), (cy - reach, cy + reach)
    return rings, plot.Plot(x, y, (*rings, cross), title, around_x, around_y, equal=True, down=True)


def _radii(camera: Camera, pixels: FloatArray) -> plot.Plot:
    """Points by distance from the principal point, out to the picture's farthest corner."""
    last, radius = camera.farthest_px, np.linalg.norm(pixels - camera.centre_px, axis=1)
    if not (math.isfinite(last) and np.isfinite(radius).all()):
        return plot.Plot(empty="the principal point is not known", bare=True)
    reached = float(radius.max())
    last = max(last, reached)
    marks = (
        plot.histogram(radius, 24, 0.0, last),
        plot.Band("x", reached, last, colour="ochre", hatched=True),
    )
    title = f"Points reach {100 * reached / last:.0f} % of the radius"
    return plot.Plot(_RADIUS, "points", marks, title, (0.0, last), grid="")


def _projection_sigma(fit: Calibration, sigma: Covariance) -> plot.Figure:
    """Standard deviation of projection over the picture, with the hull of what was seen."""
    size = fit.camera.image_size_px
    u, v, pixels = grid_over(size, 97)
    values = projection_sigma_px(fit, sigma, pixels.reshape(-1, 2)).reshape(len(v), len(u))
    # What moves by more than the picture's size is not known at all.
    values[values > math.hypot(*size)] = np.inf
    note = (
        "With pictures taken again, the camera would put a point at the boards' distance elsewhere by this "
        "standard deviation, in the worst direction. The dashed line is the hull of the corners seen; beyond "
        "it the camera extrapolates."
    )
    outline = plot.Shape(hull(fit.observations.pixels[fit.observations.present]), edge="red", kind="dashed")
    panel = picture(size, (plot.Field(u, v, values, "px", "standard deviation (px)"), outline))
    title = "How uncertain the camera's projection is, over the picture"
    return plot.Figure(title, note, (panel,), panel_height_in(0.8, size))


def _comparison(what: str, candidates: Sequence[Candidate], chosen: str) -> plot.Figure:
    """Fitted and held-back RMS of each model, drawn and in figures, the chosen one marked."""
    rms = np.array([[c.fitted_rms_px, c.held_back_rms_px] for c in candidates])
    # A model far off would press the others together; its line ends at the limit.
    finite = rms[np.isfinite(rms)]
    near = finite[finite <= 1.6 * finite.min()] if len(finite) else np.array([0.0])
    room = float(np.ptp(near)) or 0.1 * float(near.max()) or 1.0
    low, limit = float(near.min()) - 0.08 * room, float(near.max()) + 0.12 * room
    columns = limit + np.array([0.08, 0.21]) * (limit - low)
    marks: list[plot.Mark] = [
        plot.Text(float(at), -0.95, head, "grey")
        for at, head in zip(columns, ("fitted", "held back"), strict=True)
    ]
    for i, one in enumerate(candidates):
        taken = one.name == chosen
        if taken:
            marks.append(plot.Band("y", i - 0.45, i + 0.45, colour="ice"))
        marks.append(plot.Curve(np.minimum(rms[i], limit), np.array([i, i]), colour="grey", size=2.0))
        if rms[i].min() > limit:
            marks.append(plot.Text(limit, i, f"from {rms[i].min():.3g} px on  ", "grey", align="right"))
        for at, value in zip(columns, rms[i], strict=True):
            words = f"{value:.4f}" if math.isfinite(value) else "not fitted"
            marks.append(plot.Text(float(at), i, words, bold=taken))
    shown, rows = np.where(rms <= limit, rms, np.nan), np.arange(len(candidates))
    marks.append(plot.Curve(shown[:, 0], rows, "fitted", "points", "sky", 7.5))
    marks.append(plot.Curve(shown[:, 1], rows, "held back", "diamonds", "red", 6.5))
    names = tuple(f"{plot.short(one.name, 20)}, {one.parameters} parameters" for one in candidates)
    note = (
        "The RMS is over views that the model was fitted to, and over views held back. The simplest model is "
        f"taken that no richer one beats on views held back: {plot.short(chosen, 20)}."
    )
    panel = plot.Plot("RMS (px)", "", marks, x_limits=(low, limit), grid="x", names=names)
    title = f"Which {what} predicts views that it has not seen"
    return plot.Figure(title, note, (panel,), 0.42 * len(candidates) + 1.3)


# ----------------------------------------------------------------------
# Lens distortion: where it moves what is seen (Fig. B.2).

_SAMPLE = 40_000
"""Pixels over which the displacement is averaged."""


def _finite(camera: Camera) -> bool:
    return bool(np.isfinite(vector_from_camera(camera)).all())


def _distortion(fit: Calibration, covariance: Covariance) -> plot.Figure:
    """Displacement by a calibrated lens over the picture, and along the radius with its uncertainty."""
    camera, pixels = fit.camera, fit.observations.pixels[fit.observations.present]
    field = displacement_field(camera, pixel_grid(camera.image_size_px, most=_SAMPLE))
    length = np.linalg.norm(field, axis=-1)
    if not np.all(np.isfinite(length)):
        note = "The camera's numbers are not finite; its distortion cannot be drawn."
    elif length.max() == 0.0:
        note = "This camera model has no distortion."
    else:
        note = (
            f"The distortion ({distortion_kind(camera)}) moves points by up to "
            f"{plot.number(float(length.max()), 'px')}, by {plot.number(float(length.mean()), 'px')} on "
            "average over the picture. Arrows lead from where a lens without distortion shows a point to "
            "where this one does. The dashed line is the hull of the corners seen; in the shaded part none "
            "was seen."
        )
    marks: tuple[plot.Mark, ...] = ()
    if not camera.ideal and _finite(camera):
        outline = ideal_pixels(camera, hull(pixels))
        marks = (plot.Shape(outline[np.isfinite(outline).all(axis=1)], kind="dashed"),)
    panels = (_map(camera, marks), _along_radius(camera, covariance, pixels))
    return _lens_figure(camera, "How far lens distortion moves what is seen", note, panels)


def _lens_figure(camera: Camera, title: str, note: str, panels: tuple[plot.Plot, plot.Plot]) -> plot.Figure:
    high = max(panel_height_in(0.6, camera.image_size_px), 3.9)
    return plot.Figure(title, note, panels, high, columns=2, widths=(1.55, 1.0))


def _map(camera: Camera, marks: tuple[plot.Mark, ...]) -> plot.Plot:
    """Length of the displacement as a map with arrows on it, under other marks."""
    size = camera.image_size_px
    if not _finite(camera):
        return picture(size, (), empty="not bounded")
    if camera.ideal:
        return picture(size, marks, empty="no distortion: every point is seen where an ideal lens shows it")
    u, v, pixels = grid_over(size, 81)
    length = np.linalg.norm(displacement_field(camera, pixels), axis=-1)
    field = plot.Field(u, v, np.where(shown_once(camera, pixels), length, np.nan), "px", even=True)
    u, _, pixels = grid_over(size, 15)
    at = pixels[1:-1, 1:-1].reshape(-1, 2)
    at = at[shown_once(camera, at)]
    vectors = displacement_field(camera, at)
    times = _times(vectors, float(u[1]))
    arrows = plot.Arrows(at, vectors, times, "px", "red")
    return picture(size, (field, arrows, *marks), f"Displacement in px; arrows drawn {times:g} times")


def _along_radius(
    camera: Camera, covariance: Covariance | None = None, pixels: FloatArray | None = None
) -> plot.Plot:
    """Displacement over the distance from the principal point, out to the picture's farthest corner.

    With the uncertainty of a calibration, and how far its pixels (n, 2) reached.
    """
    x, y = _RADIUS, "moved outwards (px)"
    last = camera.farthest_px
    if not (math.isfinite(last) and _finite(camera)):
        return plot.Plot(x, y, empty="not bounded")
    radius_of_fold, distorted = fold_radius(camera)
    # Next to a pole the curve leaves every scale.
    fold = min((1.0 if math.isfinite(distorted) else 0.98) * radius_of_fold * focal_px(camera), last)
    radius = np.linspace(0.0, fold, 241)
    moved = radial_displacement(camera, radius)
    bottom, top = float(moved.min()), float(moved.max())
    span = max(top - bottom, 2.0 if camera.ideal else 1e-3)
    title, marks = "Along the radius", list[plot.Mark]((plot.Rule("y", 0.0),))
    if covariance is not None and not camera.ideal:
        sigma = radial_sigma(camera, covariance, radius)
        if np.isfinite(sigma).all():
            below, above = moved - 2 * sigma, moved + 2 * sigma
            marks.append(plot.Ribbon(radius, below, above, colour="ice"))
            # A band that the views hardly bound must not flatten the curve.
            bottom, top = max(float(below.min()), bottom - span), min(float(above.max()), top + span)
            title += f", band of 2 {plot.SIGMA}"
        else:
            title += f", {plot.SIGMA} not bounded"
    marks.append(plot.Curve(radius, moved, size=2.2))
    if pixels is not None:
        distance = np.linalg.norm(ideal_pixels(camera, pixels) - camera.centre_px, axis=1)
        reached = float(np.nanmax(np.append(distance, 0.0)))
        if reached < last:
            marks.append(plot.Band("x", reached, last, colour="ochre", hatched=True))
    if fold < last:
        marks.append(plot.Rule("x", fold, "ink", "dotted"))
        title = "Along the radius, to where the model folds over"
    return plot.Plot(x, y, marks, title, (0.0, last), (bottom - 0.06 * span, top + 0.06 * span))


def _displacement(camera: Camera, report: Lens) -> plot.Figure:
    """The map of Fig. B.2 with the region of interest, and the radial curve."""
    most, mean = plot.number(report.max_px, "px"), plot.number(report.mean_px, "px")
    region_most, region_mean = (
        plot.number(report.region_max_px, "px"),
        plot.number(report.region_mean_px, "px"),
    )
    note = (
        f"The distortion ({report.kind}) moves points by up to {most}, by {mean} on average over the "
        f"picture, in the region of interest (box) by up to {region_most}, by {region_mean} on average; it "
        f"{'matters' if report.effect == 'matters' else 'is ' + report.effect}."
    )
    if report.plane_max_mm is not None and report.refitted_max_mm is not None:
        read, fitted = plot.number(report.plane_max_mm, "mm"), plot.number(report.refitted_max_mm, "mm")
        note += (
            f" On the plane, reading without the lens costs up to {read}, with the best map that knows no "
            f"lens {fitted}."
        )
    if not report.monotonic:
        note += " Beyond the dotted line the model folds over."
    u0, v0, u1, v1 = report.region_px
    box = plot.rectangle(u0, v0, u1 - u0, v1 - v0)
    end = float(np.linalg.norm(box - camera.centre_px, axis=1).max())
    right = _along_radius(camera)
    marks, title = (*right.marks, plot.Rule("x", end, "red")), "Along the radius; red: end of the region"
    right = replace(right, marks=marks, title=title)
    panels = (_map(camera, (plot.Shape(box, edge="red"),)), right)
    return _lens_figure(camera, "What lens distortion does to the picture", note, panels)


# ----------------------------------------------------------------------
# A calibrated plane: how well a marker's position is known, and what the lens costs there.

_FINE = 45
"""Places along each side of the workspace at which maps are drawn."""
_MOST_IN_LEGEND = 6
"""Pictures whose names fit into a legend."""


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


def _workspace(plane: Plane, marks: Sequence[plot.Mark], title: str = "", empty: str = "") -> plot.Plot:
    """World axes in mm, y downwards as the camera sees it."""
    x0, y0, x1, y1 = (1e3 * value for value in plane.workspace_m)
    limits = ((x0, x1), (y0, y1))
    return plot.Plot("x (mm)", "y (mm)", marks, title, *limits, grid="", equal=True, down=True, empty=empty)


def _plane_height_in(plane: Plane, share: float) -> float:
    return panel_height_in(share, np.diff(np.reshape(plane.workspace_m, (2, 2)), axis=0)[0])


def _plane_sigma(plane: Plane) -> plot.Figure:
    """Standard deviation of a marker's position over the workspace: in total, and by where it comes from."""
    sigma = plane.sigma
    parts = {
        "All together": sigma.total_mm,
        "From the intrinsics": sigma.intrinsics_mm,
        "From the plane's fit": sigma.plane_mm,
        "From whole pixels": sigma.quantisation_mm,
    }
    lengths = {name: np.linalg.norm(part, axis=1) for name, part in parts.items() if part is not None}
    finite = {name: length[np.isfinite(length)] for name, length in lengths.items()}
    every = np.concatenate(list(finite.values()))
    scale = (float(every.min()), float(every.max())) if len(every) else None
    worst = finite.get("All together", every)
    most = plot.number(float(worst.max()) if len(worst) else np.inf, "mm")
    note = (
        f"The standard deviation of a marker's position, x and y together, is up to {most} in the workspace. "
        "The variances of the three parts add up. What is hatched is not in the picture."
    )
    panels = []
    for name in parts:
        if name not in lengths:
            why = "the covariance of the intrinsics is not known"
            panels.append(_workspace(plane, (), name, why))
            continue
        most = f"up to {plot.number(float(finite[name].max()), 'mm')}" if len(finite[name]) else "not bounded"
        field = plot.Field(*_grid(plane, lengths[name]), "mm", even=True, scale=scale)
        panels.append(_workspace(plane, (field,), f"{name}: {most}"))
    title, high = "How well a marker's position is known over the workspace", _plane_height_in(plane, 0.46)
    return plot.Figure(title, note, panels, 2.0 * high, columns=2)


def _plane_difference(camera: Camera, plane: Plane) -> plot.Figure:
    """How far a homography fitted without the lens puts the marker from where the calibrated map does."""
    points_m = box_grid(plane.workspace_m, _FINE, _FINE)
    x, y = points_m[0, :, 0], points_m[:, 0, 1]
    moved_mm = 1e3 * moved_m(camera, plane, plane.direct, points_m)
    length = np.linalg.norm(moved_mm, axis=-1)
    finite = length[np.isfinite(length)]
    corners = 1e3 * plane.corners_m
    marks: list[plot.Mark] = [
        plot.Field(1e3 * x, 1e3 * y, length, "mm", "difference of the two maps (mm)", even=True),
        plot.Curve(corners[:, 0], corners[:, 1], kind="points", colour="ink"),
    ]
    above, note = "", "No part of the workspace is in the picture."
    if len(finite):
        most, mean = plot.number(float(finite.max()), "mm"), plot.number(float(finite.mean()), "mm")
        free, fixed = plot.number(plane.direct.rms_px, "px"), plot.number(plane.rms_px, "px")
        note = (
            f"A homography fitted to the same corners without knowing the lens puts the marker up to {most} "
            f"elsewhere, {mean} on average. Its RMS is {free}, with the lens it is {fixed}. Dots are "
            "the board's corners."
        )
        at, vectors = (grid[2::4, 2::4].reshape(-1, 2) for grid in (1e3 * points_m, moved_mm))
        times = _times(vectors, 3.6e3 * float(min(x[1] - x[0], y[1] - y[0])))
        marks.append(plot.Arrows(at, vectors, times, "mm", "red"))
        above = f"Arrows drawn {times:g} times"
    panel = _workspace(plane, marks, above)
    title = "What it costs to leave the lens out, over the workspace"
    return plot.Figure(title, note, (panel,), _plane_height_in(plane, 0.8))


def _plane_picture(camera: Camera, plane: Plane) -> plot.Figure:
    """Corners with their residuals in the picture, and the workspace with the world's axes."""
    size = camera.image_size_px
    x0, y0, x1, y1 = (1e3 * value for value in plane.workspace_m)
    note = (
        f"The RMS is {plot.number(plane.rms_px, 'px')} in the picture, {plot.number(plane.rms_mm, 'mm')} on "
        f"the plane, over {len(plane.corners_m)} corners. The outline is the workspace, x from {x0:g} to "
        f"{x1:g} mm and y from {y0:g} to {y1:g} mm."
    )
    times = _times(plane.residuals_px, 0.05 * max(size))
    marks = [*_outline(camera, plane), *_world_axes(camera, plane)]
    count, first = len(plane.pictures), 0
    for k, one in enumerate(plane.pictures):
        part = slice(first, first + one.points)
        first += one.points
        colour: plot.Colour = "blue" if count == 1 else float(plot.spaced(count)[k])
        words = f"{plot.short(one.name, 22)}, RMS {plot.number(one.rms_px, 'px')}"
        label = words if 1 < count <= _MOST_IN_LEGEND else ""
        at = plane.corners_px[part]
        marks.append(plot.Curve(at[:, 0], at[:, 1], label, "points", colour))
        marks.append(plot.Arrows(at, plane.residuals_px[part], times, "" if k else "px", colour))
    panel = picture(size, marks, f"Residuals drawn {times:g} times")
    title = "The plane in the picture: corners, their residuals, and the workspace"
    return plot.Figure(title, note, (panel,), panel_height_in(0.88, size))


def _pixels(camera: Camera, plane: Plane, world_m: FloatArray) -> FloatArray:
    """Pixels (n, 2) of places on the plane, NaN behind the camera and beyond the lens model's fold."""
    x, y, z = (world_m @ plane.R_CW[:, :2].T + plane.t_CW_m).T
    kept = (z > 0.0) & (np.hypot(x, y) < fold_radius(camera)[0] * np.where(z > 0.0, z, 1.0))
    return np.where(kept[:, None], plane_pixels(camera, plane.R_CW, plane.t_CW_m, world_m), np.nan)


def _outline(camera: Camera, plane: Plane) -> list[plot.Mark]:
    """The border of the workspace; curved where the lens bends it."""
    x0, y0, x1, y1 = plane.workspace_m
    along = np.linspace(0.0, 1.0, 41)[:, None]
    corners = plot.rectangle(x0, y0, x1 - x0, y1 - y0)
    border = np.concatenate([a + along * (b - a) for a, b in pairwise([*corners, corners[0]])])
    pixels = _pixels(camera, plane, border)
    filled: list[plot.Mark] = (
        [plot.Shape(pixels, "ochre", None, opacity=0.5)] if np.isfinite(pixels).all() else []
    )
    return [*filled, plot.Curve(pixels[:, 0], pixels[:, 1], colour="orange", size=2.0)]


def _world_axes(camera: Camera, plane: Plane) -> list[plot.Mark]:
    """The world's x and y from the origin, or from the workspace's middle where the origin is not seen."""
    x0, y0, x1, y1 = plane.workspace_m
    length = plot.round_down(0.3 * max(x1 - x0, y1 - y0))
    size = np.array(camera.image_size_px, dtype=np.float64)
    for start in (np.zeros(2), np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])):
        ends = _pixels(camera, plane, start + length * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        if np.all(np.isfinite(ends)) and np.all((ends > 0.0) & (ends < size)):
            break
    else:
        return []
    marks: list[plot.Mark] = []
    axes = ((ends[1], "x", "red", "left"), (ends[2], "y", "green", "right"))
    for end, name, colour, align in axes:
        marks.append(plot.Arrows(ends[:1], end[None] - ends[:1], colour=colour))
        u, v = ends[0] + 1.06 * (end - ends[0])
        marks.append(plot.Text(u, v, f"{name}, {1e3 * length:g} mm", align=align, bold=True))
    u, v = ends[0] - 0.02 * size.max()
    return [*marks, plot.Text(u, v, "middle" if start.any() else "origin", align="right")]
