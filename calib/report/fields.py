"""What figures draw over a picture or a plane: its frame, arrows with a key, contour maps, ellipses."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LogNorm, Normalize
from matplotlib.contour import ContourSet, QuadContourSet
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from calib.arrays import FloatArray
from calib.report.style import BLUE, INK, RISING, SHADE, empty, number, round_down

__all__ = [
    "arrows",
    "colour_bar",
    "contour_levels",
    "contour_map",
    "ellipse",
    "grid_over",
    "magnified",
    "panel_height_in",
    "picture_frame",
]

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
