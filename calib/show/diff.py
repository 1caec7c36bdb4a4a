"""The page of two calibrations: side by side over the picture and on the plane, and constant by constant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.core import __version__
from calib.core.arrays import FloatArray
from calib.core.diff import SIGNIFICANT, Change, RigDiff, grid_m
from calib.core.plot import Arrows, Field, Figure, Plot, magnified
from calib.core.plot import number as rounded
from calib.core.rig import Rig
from calib.core.words import number
from calib.core.writing import write_atomically
from calib.show.page import PAGE, embedded, render
from calib.stages.camera.lens import far_difference_px, ideal_pixels, projection_sigma_px
from calib.stages.camera.plots import grid_over, panel_height_in, picture
from calib.stages.camera.section import Camera

_ACROSS = 33
_NOTHING = 1e-6
"""Differences in px or mm below this are rounding's."""
_SAME = "no difference"
_BAR = 0.5**0.5
"""Of a length over sqrt(2): the root mean square of its two coordinates, whose sigma is that of one."""


def write_diff_page(path: Path, before: Rig, after: Rig, names: tuple[str, str], found: RigDiff) -> None:
    """Write the page atomically. Raises `BadInputError` when it cannot be written."""
    write_atomically(path, diff_page_text(before, after, names, found), PAGE)


def diff_page_text(before: Rig, after: Rig, names: tuple[str, str], found: RigDiff) -> str:
    """The whole page; `names` are those of the two files."""
    figures = []
    if before.camera is not None and after.camera is not None:
        figures.append(_over_picture(before.camera, after.camera))
    if found.plane is not None:
        figures.append(_on_plane(before, after, found))
    rows = [
        (
            change.section,
            change.name,
            *((number(one, change.sigma), one) for one in (change.before, change.after)),
            _difference(change),
            (number(change.sigma, change.sigma), change.sigma),
            ("" if change.sigmas is None else f"{change.sigmas:.1f}", change.sigmas),
            change.unit,
            change.significant,
        )
        for change in found.changes
    ]
    return render(
        "diff.html.j2",
        ("page.css",),
        ("common.js",),
        bool(figures),
        version=__version__,
        names=names,
        found=found,
        simulated=any(one is not None and one.simulated for one in (before.camera, after.camera)),
        limit=SIGNIFICANT,
        figures=[embedded(figure) for figure in figures],
        rows=rows,
        alone=[(names[0], found.only_before), (names[1], found.only_after)],
    )


def _difference(change: Change) -> tuple[str, float | None]:
    if change.before is None or change.after is None:
        return "", None
    apart = change.after - change.before
    return number(apart, change.sigma) if change.sigma else f"{apart:.2g}", apart


def _over_picture(before: Camera, after: Camera) -> Figure:
    """Both cameras' uncertainty, and where they differ, in px."""
    size = (before.image_size_px[0], before.image_size_px[1])
    title = "Where the two cameras see the same far point"
    if before.image_size_px != after.image_size_px:
        why = f"{size[0]}x{size[1]} and {after.image_size_px[0]}x{after.image_size_px[1]} px"
        return Figure(title, f"The pictures differ in size: {why}.", (Plot(empty=why),), 1.5)
    u, v, grid = grid_over(size, _ACROSS)
    apart = far_difference_px(before.optics, after.optics, grid.reshape(-1, 2)).reshape(grid.shape)
    sigmas = [_sigma_px(one, grid) for one in (before, after)]
    both = None if sigmas[0] is None or sigmas[1] is None else np.hypot(sigmas[0], sigmas[1])
    known = [one for one in sigmas if one is not None and np.isfinite(one).any()]
    least, most = (
        (min(float(np.nanmin(one)) for one in known), max(float(np.nanmax(one)) for one in known))
        if known
        else (0.0, 1.0)
    )

    def map_of(values: FloatArray | None, word: str, unit: str, scale: tuple[float, float] | None) -> Plot:
        if values is None:
            return picture(size, (), word, "the covariance of this camera is not known")
        if np.all(values == 0.0):
            return picture(size, (), word, _SAME)
        return picture(size, (Field(u, v, values, unit, unit, scale=scale, even=True),), word)

    # What rounding leaves is no map.
    apart[np.abs(apart) < _NOTHING] = 0.0
    length = np.linalg.norm(apart, axis=-1)
    note = "Above are maps of the standard deviation of one coordinate, below of the difference."
    finite = length[np.isfinite(length)]
    if len(finite):
        note += f" A far point is seen up to {rounded(float(finite.max()), 'px', 2)} elsewhere"
        note += f", {rounded(float(finite.mean()), 'px', 2)} on average"
        if both is not None:
            note += f", with a sigma of up to {rounded(float(np.nanmax(both)), 'px', 2)} per coordinate"
        note += "."
    note += " The rotation that fits best between both is taken off: it is made good by finding the plane."
    panels = [
        map_of(sigmas[0], "Before: sigma, px", "px", (least, most)),
        map_of(sigmas[1], "After: sigma, px", "px", (least, most)),
        _arrowed(picture(size, (), "Difference, px"), u, v, apart, "px"),
        map_of(None if both is None else _BAR * length / both, "Difference over its sigma", "sigma", None),
    ]
    return Figure(title, note, panels, 2.0 * panel_height_in(0.44, size), columns=2)


def _sigma_px(camera: Camera, grid: FloatArray) -> FloatArray | None:
    """Of where a far point is projected (rows, columns); None without a covariance."""
    covariance = camera.intrinsic_covariance
    if covariance is None:
        return None
    optics = camera.optics
    # What is propagated starts from where a camera without the lens shows the point.
    ideal = ideal_pixels(optics, grid.reshape(-1, 2))
    return projection_sigma_px(optics, covariance, ideal).reshape(grid.shape[:2])


def _arrowed(panel: Plot, x: FloatArray, y: FloatArray, apart: FloatArray, unit: str) -> Plot:
    """A map of the lengths of differences (rows, columns, 2), with arrows that are drawn longer."""
    length = np.linalg.norm(apart, axis=-1)
    step = max(1, len(x) // 11)
    at = np.stack(np.meshgrid(x, y), axis=-1)[::step, ::step].reshape(-1, 2)
    along = apart[::step, ::step].reshape(-1, 2)
    longest = float(np.nanmax(length)) if np.isfinite(length).any() else 0.0
    if np.all(length == 0.0):
        return replace(panel, empty=_SAME)
    times = magnified(0.9 * step * abs(float(x[1] - x[0])), longest)
    marks = (Field(x, y, length, unit, unit, even=True), Arrows(at, along, times, unit, "red"))
    return replace(panel, marks=(*marks, *panel.marks), title=f"{panel.title}; arrows drawn {times:g} times")


def _on_plane(before: Rig, after: Rig, found: RigDiff) -> Figure:
    """How far apart a marker is read, over the workspace, in mm."""
    assert before.camera and before.plane and after.camera and after.plane and found.plane
    x0, y0, x1, y1 = (after if after.geometry else before).workspace_m
    world = grid_m((x0, y0, x1, y1))
    pixels = before.plane.to_pixels(world.reshape(-1, 2), before.camera)
    apart = 1e3 * (after.plane.to_world(pixels, after.camera).reshape(world.shape) - world)
    apart[np.abs(apart) < _NOTHING] = 0.0
    x, y = 1e3 * world[0, :, 0], 1e3 * world[:, 0, 1]
    limits = (1e3 * x0, 1e3 * x1), (1e3 * y0, 1e3 * y1)
    blank = Plot("x (mm)", "y (mm)", (), "Difference, mm", *limits, grid="", equal=True, down=True)
    plane = found.plane
    most, mean = (
        rounded(one if one > _NOTHING else 0.0, "mm", 2) for one in (plane.largest_mm, plane.mean_mm)
    )
    note = f"It is read up to {most} apart, {mean} on average"
    if plane.sigma_mm:
        note += (
            f"; the sigma of the difference is at most {rounded(plane.sigma_mm, 'mm', 2)}, so that this is "
            f"{'more' if plane.significant else 'no more'} than the calibrations' own uncertainty explains"
        )
    panel = _arrowed(blank, x, y, apart, "mm")
    high = panel_height_in(0.8, np.array([x1 - x0, y1 - y0]))
    return Figure("How far apart the same marker is read on the plane", f"{note}.", (panel,), high)
