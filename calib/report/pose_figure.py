"""Where the boards stood: drawn in the camera's frame, with how they leaned."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import (  # type: ignore[import-untyped]  # matplotlib has no types for it
    Line3DCollection,
    Poly3DCollection,
)

from calib.arrays import FloatArray
from calib.camera.bundle import Calibration
from calib.camera.coverage import hull
from calib.camera.model import Camera, undistort
from calib.report.style import BLUE, GREY, INK, sheet, view_colours

__all__ = ["pose_figure"]

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
