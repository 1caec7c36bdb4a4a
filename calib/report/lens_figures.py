"""Figures of lens distortion: where it moves what is seen (Fig. B.2), and how well it can be undone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from calib.arrays import BoolArray, FloatArray
from calib.camera.covariance import Covariance
from calib.camera.coverage import hull
from calib.camera.distortion import DistortionReport, Region, displacement_field, distortion_kind
from calib.camera.model import Camera, undistort
from calib.camera.projection import INTRINSICS, camera_from_vector, vector_from_camera
from calib.camera.undistortion import (
    InversePolynomial,
    distorted_normalised,
    exact_inverse,
    fold_radius,
    pixel_grid,
    undistort_by_polynomial,
)
from calib.report.fields import arrows, colour_bar, contour_map, grid_over, panel_height_in, picture_frame
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
)

__all__ = ["distortion_figure", "write_lens_figures"]

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
        f"Kind: {plain(report.kind)}; verdict: {plain(report.verdict)}. Whole picture: up to {most}, mean "
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
