"""Figures of a calibrated plane: how well a marker's position on it is known, and what the lens does to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calib.arrays import FloatArray
from calib.camera.model import Camera
from calib.camera.plane import Plane, to_pixels
from calib.report.fields import arrows, colour_bar, contour_levels, contour_map, panel_height_in, picture_frame
from calib.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
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

__all__ = ["write_plane_figures"]


def write_plane_figures(folder: Path, camera: Camera, plane: Plane) -> list[Path]:
    """Draw a calibrated plane into a folder, which is made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        return [
            save(_picture(camera, plane), folder / "plane_picture.png"),
            save(_sigma(plane), folder / "plane_sigma.png"),
            save(_difference(plane), folder / "plane_difference.png"),
        ]


def _grid(plane: Plane, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x (columns,) and y (rows,) in mm and values (rows, columns), at the places where sigma is known."""
    x, column = np.unique(plane.sigma.points_m[:, 0], return_inverse=True)
    y, row = np.unique(plane.sigma.points_m[:, 1], return_inverse=True)
    table = np.full((len(y), len(x)), np.nan)
    table[row, column] = values
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
    note = (
        f"Standard deviation in mm of a marker's position (x and y together), up to "
        f"{number(float(worst.max()) if len(worst) else np.inf, 'mm')} in the workspace. The parts add up as squares. "
        "Hatched: not in the picture."
    )
    figure = sheet(
        2.0 * _panel_in(plane, 0.46 * WIDTH_IN),
        "How well a marker's position is known over the workspace",
        note,
        plane.verdict,
    )
    panels = figure.subplots(2, 2).ravel()
    levels = contour_levels(finite) if len(finite) else None
    drawn = None
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
        drawn = contour_map(axes, x, y, table, "mm", levels=levels) or drawn
    if drawn is not None:
        colour_bar(list(panels), drawn, "standard deviation (mm)")
    return figure


def _difference(plane: Plane) -> Figure:
    """How far a homography fitted without the lens puts the marker from where the calibrated map does."""
    difference = plane.direct_difference_mm
    finite = difference[np.isfinite(difference)]
    if len(finite):
        note = (
            f"A homography fitted to the same corners without knowing the lens puts the marker up to "
            f"{number(float(finite.max()), 'mm')} elsewhere, {number(float(finite.mean()), 'mm')} on average. Its RMS "
            f"is {number(plane.direct.rms_px, 'px')}, with the lens it is {number(plane.rms_px, 'px')}."
        )
    else:
        note = "No part of the workspace is in the picture."
    figure = sheet(
        _panel_in(plane, 0.8 * WIDTH_IN), "What it costs to leave the lens out, over the workspace", note, plane.verdict
    )
    axes = figure.subplots()
    _workspace(axes, plane)
    x, y, table = _grid(plane, difference)
    drawn = contour_map(axes, x, y, table, "mm", even=True)
    if drawn is not None:
        colour_bar(axes, drawn, "difference of the two maps (mm)")
    corners = 1e3 * plane.corners_m
    axes.scatter(corners[:, 0], corners[:, 1], s=14, color=VERMILLION, linewidths=0, zorder=4)
    axes.set_title("Dots: the board's corners")
    return figure


def _picture(camera: Camera, plane: Plane) -> Figure:
    """Corners with their residuals in the picture, and the workspace with the world's axes."""
    note = (
        f"RMS {number(plane.rms_px, 'px')} in the picture, {number(plane.rms_mm, 'mm')} on the plane, over "
        f"{plane.points} corners. Outline: the workspace, {_box_words(plane)}."
    )
    figure = sheet(
        panel_height_in(0.85 * WIDTH_IN, camera.image_size_px),
        "The plane in the picture: corners, their residuals, and the workspace",
        note,
        plane.verdict,
    )
    axes = figure.subplots()
    picture_frame(axes, camera.image_size_px)
    _outline(axes, camera, plane)
    first = 0
    colours = view_colours(len(plane.pictures)) if len(plane.pictures) > 1 else [BLUE]
    size = max(camera.image_size_px)
    times = None
    for picture, colour in zip(plane.pictures, colours, strict=True):
        part = slice(first, first + picture.points)
        first += picture.points
        ...
    _ = (times, size, part, colour, ORANGE, GREEN, GREY, INK, plain, to_pixels)
    return figure
