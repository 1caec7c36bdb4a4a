"""The centre of a coloured disc in a picture, below a pixel.

Found coarsely: pixels of the marker's hue and saturation, joined. Then measured: along rays from the middle,
each pixel is a mixture of marker and background,

    p = a M + (1 - a) B,    a = (p - B) . (M - B) / |M - B|^2,

with M the colour inside and B the colour outside of that ray, so that light, shadow and what lies beside
the disc differ as they may; M goes on to the edge as the light over the disc does. The edge is where a = 1/2,
by the area under a about that place, and an ellipse is fitted to the edges, less those that do not belong to
it. Blur by motion during the exposure is symmetric about its middle, and so is the edge.
What is no ellipse, too small, or not told apart from another one is lost rather than guessed.

The ellipse's centre is not the image of the disc's centre; `disc_centre` corrects it where camera and plane
are known.
"""

from __future__ import annotations

import colorsys
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np

from calib.core.arrays import AnyArray, BoolArray, FloatArray, rms, robust_sigma
from calib.core.errors import UsageError
from calib.core.writing import Kind, column_names

COLOURS = {
    "red": 0.0, "orange": 24.0, "yellow": 55.0, "green": 120.0, "cyan": 185.0, "blue": 220.0, "purple": 280.0,
    "pink": 330.0,
}  # fmt: skip
"""Hues in degrees by their names."""

_HUE_DEG = 16.0
_LEAST_SATURATION = 0.30
_SATURATION_SHARE = 0.55
"""Least saturation over that of the marker."""
_FULL = 0.05
"""Share of a picture from which on the background has the marker's colour, as wood has that of orange."""
_PURER = (0.75, 0.6)
"""Least saturations that may tell a marker from such a background: varnished oak has 0.6, pine 0.45."""
_LEAST_VALUE = 0.12
_LEAST_PIXELS = 12
_COARSE_PX = 400
"""Width from which on the search is done at half the size."""
_RAYS = 64
_ANGLES = 2 * np.pi * np.arange(_RAYS) / _RAYS
_TOWARDS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Directions (64, 2) of the rays."""
_STEP_PX = 0.5
_ABOUT_PX = 1.5
"""Of a ray, to each side of its crossing, over which the edge is measured: about its blur."""
_LEAST_RAYS = 0.6
"""Share of rays that must show an edge on the ellipse."""
_ROUND = 0.35
"""Least ratio of the axes."""
_FAR = 4.0
"""Distance of an edge from the ellipse, in robust standard deviations, from which on it does not belong."""
_SURELY_PX = 0.15
"""Distance within which an edge always belongs."""
_ROUGH_SHARE = 0.06
"""Scatter of the edges over the radius above which a blob is no disc."""
_LIT = 0.8
"""Share of the radius within which the light's slope is read; a blur takes alike from both sides."""
_LIT_PX = 7.0
"""Least radius of a disc whose light tells a slope: of one of 4 px the errors of a codec would, too."""
_LIGHT_WAVES = np.exp(-1j * np.outer(_ANGLES, np.arange(1, 7)))
_LIGHT = (np.arange(256) / 255.0) ** 2.2
"""Light by grey level: mixtures are mixtures of light, and cameras store about its root."""
_ORDERS = np.arange(3, 13)
_WAVES = np.exp(-1j * np.outer(_ANGLES, _ORDERS))
"""Waves around the outline from the third on, the first that an ellipse does not take up."""
_LONGEST, _SHORTEST, _SHORTEST_PX, _FEWEST_WAVES = 2, 3, 5.0, 5
"""How many waves are the long ones and the short ones, the shortest in pixels, and the fewest in all."""
_BENT_SHARE, _BENT_PX = 0.025, 0.25
"""Standard deviation of the centre, over the radius and in pixels, from which on what is seen is no disc,
as with a hose before a fifth of it. Codecs mostly stay below."""
_FLOOR_PX = 0.02
"""What uneven light and blur leave on rendered videos without noise."""
_LEAST_COLOURED = 0.8
"""Share of the pixels inside that must have the marker's colour."""
_AGAIN_FRAMES = 6
"""Frames without the marker after which the only disc of its colour and size is it, wherever that is."""
_FORGOTTEN_FRAMES = 600
"""Frames after which what was seen beside the marker, or before it came back elsewhere, is forgotten."""
_BORDER_RADII = 3.0
"""Distance from the border, in radii, within which a disc may just have come in."""
_GROWTH, _GROWTH_PX, _GROWTH_LOST = 0.15, 1.0, 0.005
"""By how much a radius may change from one frame to the next, and more for each frame without the marker:
half a disc looks like one of three quarters of its radius."""
_JUMP_RADII = 4.0
"""Radii from where it is expected within which a disc is the marker from one frame to the next."""
_NEARER, _SLACK_RADII = 2.0, 0.5
"""How many times nearer to one disc's way than to another's a disc has to be to be told apart, and radii that
noise may add."""


@dataclass(frozen=True)
class Colour:
    """Hue in degrees and saturation from 0 to 1; None where any saturated colour of the hue will do.

    `least` is the saturation below which no pixel has the colour.
    """

    hue_deg: float
    saturation: float | None = None
    least: float = _LEAST_SATURATION


@dataclass(frozen=True)
class Disc:
    """One disc in one picture.

    Attributes
    ----------
    centre_px : (2,) centre of the ellipse. sigma_px : standard deviation of one coordinate, from the edges.
    axes_px : (2,) half axes. box_px : left, top, right, bottom of the coloured pixels, inclusive.
    waves_px2 : (n,) squares of the outline's waves from the third on.
    """

    centre_px: FloatArray
    sigma_px: float
    axes_px: FloatArray
    box_px: tuple[int, int, int, int]
    waves_px2: FloatArray = field(default_factory=lambda: np.zeros(len(_ORDERS)))

    @property
    def radius_px(self) -> float:
        """Geometric mean of the half axes."""
        return float(np.sqrt(self.axes_px[0] * self.axes_px[1]))

    def pixy_px(self) -> FloatArray:
        """The centre as a Pixy2 tells it: whole pixels of the middle of the blob's box, the lower of two."""
        left, top, right, bottom = self.box_px
        return np.array([(left + right) // 2, (top + bottom) // 2], dtype=np.float64)


def parse_colour(text: str) -> Colour:
    """A colour from its name, #rrggbb, or a hue such as 24deg. Raises `UsageError`."""
    word = text.strip().lower()
    if word in COLOURS:
        return Colour(COLOURS[word])
    if re.fullmatch(r"#[0-9a-f]{6}", word):
        hue, saturation, _ = colorsys.rgb_to_hsv(*(int(word[k : k + 2], 16) / 255 for k in (1, 3, 5)))
        if saturation < _LEAST_SATURATION:
            raise UsageError(f"--colour: {text} is nearly grey, expected a colour that the background lacks")
        return Colour(360 * hue, saturation)
    found = re.fullmatch(r"(\d+(?:\.\d*)?)\s*deg", word)
    if found and float(found[1]) <= 360:
        return Colour(float(found[1]))
    raise UsageError(
        f"--colour: {text!r} is no colour, expected {', '.join(COLOURS)}, #rrggbb or a hue such as 24deg"
    )


def colour_at(bgr: AnyArray, pixel: tuple[float, float]) -> Colour | None:
    """The colour around a pixel; None outside of the picture and where it is grey."""
    u, v = (round(value) for value in pixel)
    height, width = bgr.shape[:2]
    if not (0 <= u < width and 0 <= v < height):
        return None
    patch = bgr[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3].reshape(-1, 3)
    blue, green, red = (np.median(patch, axis=0) / 255.0).tolist()
    hue, saturation, _ = colorsys.rgb_to_hsv(red, green, blue)
    return None if saturation < _LEAST_SATURATION else Colour(360 * hue, saturation)


def coloured(bgr: AnyArray, colour: Colour) -> BoolArray:
    """Pixels (H, W) of a colour."""
    hsv = cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)
    least = max(colour.least, _SATURATION_SHARE * (colour.saturation or 0.0))
    low, high = colour.hue_deg - _HUE_DEG, colour.hue_deg + _HUE_DEG
    # OpenCV's hue goes from 0 to 179 in steps of two degrees.
    parts = [(low, high)]
    if low < 0:
        parts = [(0.0, high), (low + 360, 360.0)]
    elif high > 360:
        parts = [(low, 360.0), (0.0, high - 360)]
    mask = np.zeros(bgr.shape[:2], dtype=np.uint8)
    for a, b in parts:
        floor = (round(a / 2), round(255 * least), round(255 * _LEAST_VALUE))
        mask = np.maximum(mask, cv2.inRange(hsv, np.array(floor), np.array((round(b / 2), 255, 255))))
    return np.asarray(mask > 0)


def discs(bgr: AnyArray, colour: Colour) -> list[Disc]:
    """All discs of a colour in a picture (H, W, 3) of uint8, the largest first."""
    zoom = 2 if bgr.shape[1] >= _COARSE_PX else 1
    small = bgr
    if zoom == 2:
        height, width = bgr.shape[0] // 2, bgr.shape[1] // 2
        small = cv2.resize(bgr[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
    mask = coloured(small, colour).astype(np.uint8)
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    found: list[Disc] = []
    order = sorted(range(1, count), key=lambda k: -int(stats[k, cv2.CC_STAT_AREA]))
    for k in order[:8]:
        left, top, width, height, area = (int(value) for value in stats[k])
        if area * zoom**2 < _LEAST_PIXELS:
            break
        if min(width, height) < _ROUND * max(width, height):
            continue
        middle = zoom * np.array([left + 0.5 * width, top + 0.5 * height]) - 0.5
        radius = 0.5 * zoom * float(np.hypot(width, height) / np.sqrt(2))
        one = measured(bgr, middle, radius, colour)
        if one is not None and not any(
            np.hypot(*(one.centre_px - other.centre_px)) < other.radius_px for other in found
        ):
            found.append(one)
    return found


def measured(bgr: AnyArray, middle_px: FloatArray, radius_px: float, colour: Colour) -> Disc | None:
    """The disc around here, its centre below a pixel; None where there is none.

    Parameters
    ----------
    middle_px, radius_px : of the blob, to a few pixels.
    """
    centre, radius = middle_px, radius_px
    ellipse = None
    for _ in range(2):
        edges = _edges(bgr, centre, radius)
        if edges is None:
            return None
        ellipse = _ellipse(*edges)
        if ellipse is None:
            return None
        centre, radius = ellipse.centre_px, float(np.sqrt(ellipse.axes_px.prod()))
    assert ellipse is not None
    axes = np.sort(ellipse.axes_px)
    if ellipse.share < _LEAST_RAYS or axes[0] < _ROUND * axes[1]:
        return None
    if radius < 1.5 or ellipse.scatter_px / radius > max(_ROUGH_SHARE, 0.4 / radius):
        return None
    if ellipse.sigma_px > max(_BENT_SHARE * radius, _BENT_PX):
        return None
    box = _box(bgr, ellipse, colour)
    if box is None:
        return None
    return Disc(centre, ellipse.sigma_px, ellipse.axes_px, box, ellipse.waves_px2)


def _edges(bgr: AnyArray, centre: FloatArray, radius: float) -> tuple[FloatArray, BoolArray] | None:
    """Points (n, 2) where rays from the centre cross the edge, and which do."""
    height, width = bgr.shape[:2]
    reach = 1.6 * radius + 3.0
    if not (0 <= centre[0] < width and 0 <= centre[1] < height and reach < max(width, height)):
        return None
    r = np.arange(0.0, reach, _STEP_PX)
    where = (centre + r[:, None] * _TOWARDS[:, None]).astype(np.float32)
    colours = cv2.remap(bgr, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colours = _LIGHT[colours]
    within = r < 0.5 * radius
    M = colours[:, within].mean(axis=1)
    # Light may differ over the disc, and noise is large in few pixels: half of its own, half of all.
    M = 0.5 * (M + M.mean(axis=0))
    # From there to the edge M changes as the plane does that fits the light best, a pixel for each area of
    # it, all channels alike. A glint, a hose and a codec raise the next waves too, whose part is taken off.
    lit, whole = r < _LIT * radius, M.mean(axis=0)
    light = (colours[:, lit] * r[lit, None] ** 2).mean(axis=1) @ whole / (r[lit] ** 3).mean()
    first, *others = np.abs(light @ _LIGHT_WAVES) ** 2
    share = max(1.0 - sum(others) / max(first, 1e-12), 0.0) if radius > _LIT_PX else 0.0
    slope = share * 2.0 / _RAYS * light @ _TOWARDS
    further = (radius - 0.5 * r[within].mean()) * _TOWARDS @ slope
    M += np.outer(further, whole) / max(float(whole @ whole), 1e-9)
    beyond = r > 1.25 * radius + 1.0
    B = np.median(colours[:, beyond], axis=1)
    across = M - B
    square = (across**2).sum(axis=1)
    a = ((colours - B[:, None]) * across[:, None]).sum(axis=2) / np.maximum(square, 1e-9)[:, None]
    # The last crossing of 1/2 from inside, so that a glint within the disc is none.
    falls = (a[:, :-1] >= 0.5) & (a[:, 1:] < 0.5) & (r[:-1] > 0.3 * radius)
    there = falls.any(axis=1) & (square > 0.05**2)
    k = np.where(falls.any(axis=1), np.argmax(falls, axis=1), 0)
    # The area under a about the crossing says where the edge is with less noise than two samples do.
    n = round(_ABOUT_PX / _STEP_PX)
    i = np.arange(_RAYS)
    k += np.abs(a[i, k + 1] - 0.5) < np.abs(a[i, k] - 0.5)
    k = np.clip(k, n, len(r) - 1 - n)
    window = np.clip(a[i[:, None], k[:, None] + np.arange(-n, n + 1)], -0.25, 1.25)
    at = r[k] - _ABOUT_PX + np.trapezoid(window, dx=_STEP_PX, axis=1)
    points = centre + at[:, None] * _TOWARDS
    there &= ((points > 0) & (points < [width - 1, height - 1])).all(axis=1)
    return points, np.asarray(there)


@dataclass(frozen=True)
class _Ellipse:
    centre_px: FloatArray
    axes_px: FloatArray
    scatter_px: float
    sigma_px: float
    share: float
    waves_px2: FloatArray


def _ellipse(points: FloatArray, there: BoolArray) -> _Ellipse | None:
    """Fit A x^2 + B x y + C y^2 + D x + E y = 1, weighted so that the residuals are distances (Sampson).

    Edges that are far off leave.
    """
    if there.sum() < 0.5 * _RAYS:
        return None
    used, weight = there.copy(), np.ones(len(points))
    origin = points[there].mean(axis=0)
    scale = rms(points[there] - origin)
    x, y = ((points - origin) / max(scale, 1e-9)).T
    terms = np.stack([x * x, x * y, y * y, x, y], axis=1)
    for _ in range(4):
        A, B, C, D, E = conic = np.linalg.lstsq((terms * weight[:, None])[used], weight[used], rcond=None)[0]
        slope = np.hypot(2 * A * x + B * y + D, B * x + 2 * C * y + E)
        weight = 1.0 / np.maximum(slope, 1e-9)
        left = (terms @ conic - 1.0) * weight * scale
        spread = robust_sigma(left[used])
        used = there & (np.abs(left) < max(_FAR * spread, _SURELY_PX))
        if used.sum() < 0.5 * _RAYS:
            return None
    Q = np.array([[A, 0.5 * B], [0.5 * B, C]])
    values = np.linalg.eigvalsh(Q)
    if not values[0] > 0.0:
        return None
    middle = -0.5 * np.linalg.solve(Q, np.array([D, E]))
    axes = scale * np.sqrt((1.0 + middle @ Q @ middle) / values)
    scatter = rms(left[used])
    # Neighbouring rays share pixels: about one independent edge for each pixel of the outline.
    outline = 2 * np.pi * float(np.sqrt(axes.prod()))
    independent = min(float(used.sum()), outline)
    alone = scatter * np.sqrt(2.0 / max(independent - 5.0, 1.0))
    # What covers a part, and a codec, bends the outline over many rays. The first wave of that moves the
    # centre, and is about as large as the next ones, which remain: of independent edges S is what `alone` is.
    waves = np.abs(np.where(used, left, 0.0) @ _WAVES / used.sum()) ** 2
    S = np.sqrt(waves[:_LONGEST].sum())
    sigma = float(np.hypot(max(alone, S), _FLOOR_PX))
    return _Ellipse(origin + scale * middle, axes, scatter, sigma, float(used.mean()), waves)


def _box(bgr: AnyArray, ellipse: _Ellipse, colour: Colour) -> tuple[int, int, int, int] | None:
    """Box of the coloured pixels in and around an ellipse; None where too few inside are."""
    reach = float(ellipse.axes_px.max()) + 2.0
    left, top = (max(int(value), 0) for value in np.floor(ellipse.centre_px - reach))
    right, bottom = (int(value) for value in np.ceil(ellipse.centre_px + reach) + 1)
    about = np.ascontiguousarray(bgr[top:bottom, left:right])
    mask = coloured(about, colour)
    v, u = np.ogrid[: mask.shape[0], : mask.shape[1]]
    near = np.hypot(u + left - ellipse.centre_px[0], v + top - ellipse.centre_px[1])
    inside = near < 0.8 * float(ellipse.axes_px.min())
    # A glint is paler, whatever the background asks for.
    usual = replace(colour, least=_LEAST_SATURATION)
    if not (mask if usual == colour else coloured(about, usual))[inside].mean() > _LEAST_COLOURED:
        return None
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return left + int(columns[0]), top + int(rows[0]), left + int(columns[-1]), top + int(rows[-1])


def _at_border(one: Disc, shape: tuple[int, ...]) -> bool:
    reach = _BORDER_RADII * one.radius_px
    (u, v), (height, width) = one.centre_px, shape[:2]
    return bool(min(u, v, width - 1 - u, height - 1 - v) < reach)


def disc_centre(
    ellipse_px: FloatArray,
    radius_m: float,
    to_world: Callable[[FloatArray], FloatArray],
    to_pixels: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Pixels (2,) of the centre of a disc in the plane, from the centre of the ellipse that it shows.

    Parameters
    ----------
    radius_m : of the disc.
    to_world, to_pixels : between pixels (n, 2) and places on the plane (n, 2), metres.
    """
    guess = ellipse_px
    for _ in range(2):
        place = to_world(guess[None])[0]
        fitted = _ellipse(to_pixels(place + radius_m * _TOWARDS), np.ones(_RAYS, dtype=np.bool_))
        if fitted is None:
            return np.full(2, np.nan)
        guess = ellipse_px - (fitted.centre_px - to_pixels(place[None])[0])
    return guess


# ----------------------------------------------------------------------
# Following the marker from frame to frame.

_RUNS = range(4, 11)
"""Frames of differences, from the third to the ninth."""
_FEWEST_RUNS = 20
_REST_PX = 0.3
"""Step from frame to frame below which a codec may send nothing anew."""
_STRIDES = (1, 2, 4, 8)
"""Frames from one to the next of a run: a codec carries an error on."""
_WALK = 1.8
"""Growth of the scatter with twice the stride up to which it is an error that is carried on: 1.41 of a random
walk, somewhat more of medians over few runs. Of a vibration with too few frames it is larger."""
_SETTLED = 0.85
"""Of the differences of one order less, from which on they are noise: those of a motion fall by more."""


def first_wave_share(discs_of: Sequence[Disc]) -> float:
    """How many times the long waves of the discs' outlines the first one is, which moves the centre.

    A codec errs alike along a part of the outline: its waves fall as 1 / (1 + (tau k)^2) with their order k,
    and those of independent edges are alike, for which this is 1.
    """
    outline_px = 2 * np.pi * float(np.median([one.radius_px for one in discs_of]))
    count = int((outline_px / _ORDERS >= _SHORTEST_PX).sum())
    if count < _FEWEST_WAVES or len(discs_of) < _FEWEST_RUNS:
        return 1.0
    power, square = np.median([one.waves_px2 for one in discs_of], axis=0)[:count], _ORDERS[:count] ** 2
    long, short = power[:_LONGEST].mean(), power[-_SHORTEST:].mean()
    k_long, k_short = square[:_LONGEST].mean(), square[-_SHORTEST:].mean()
    if not long > short:
        return 1.0
    # tau^2 from both, at most infinite.
    tau = (long - short) / max(k_short * short - k_long * long, 1e-12)
    return float(np.sqrt((1.0 + k_long * tau) / (1.0 + tau)))


def scatter_px(centres_px: FloatArray, times_s: FloatArray) -> FloatArray:
    """Standard deviation of a coordinate by differences of a track of which a smooth motion has none, (n,).

    It sees what edges do not tell, as a codec that moves the whole marker. Differences from the third to
    the ninth are tried, and the least counts of those that fall no more with their order, as those of a
    motion do. Runs of every second, fourth and eighth frame see errors that last. Frames at rest, in slow
    and in fast motion are apart, as a codec moves what moves; at rest it repeats an error, so that they
    scatter as those in slow motion. Frames may be as uneven as their times say, or even with times that are
    not. 0 where the track does not tell, as in few frames.

    Parameters
    ----------
    centres_px : (n, 2) one for each frame, NaN where it was lost. times_s : (n,) of the frames, increasing.
    """
    steps = np.hypot(*np.diff(centres_px, axis=0).T)
    step = np.fmax(np.r_[np.nan, steps], np.r_[steps, np.nan])
    moving = step >= _REST_PX
    fast = moving & (step > (np.median(step[moving]) if moving.any() else 0.0))
    if fast.sum() < 2 * _FEWEST_RUNS:
        fast[:] = False
    groups = ~moving, moving & ~fast, fast
    even_s = np.arange(len(step), dtype=np.float64)
    levels, goes_on = [0.0] * len(groups), [True] * len(groups)
    for stride in _STRIDES:
        differences = [[_differences(centres_px, t, run, stride) for run in _RUNS] for t in (times_s, even_s)]
        for k, group in enumerate(groups):
            settled = [least for each in differences if (least := _settled(each, group, stride)) > 0.0]
            level = min(settled, default=0.0)
            goes_on[k] &= stride == 1 or 0.0 < level < _WALK * levels[k]
            if goes_on[k]:
                levels[k] = max(levels[k], level)
    rest, slow, _ = levels
    return np.asarray(np.select(groups, (max(rest, slow), *levels[1:])))


def _differences(centres_px: FloatArray, times_s: FloatArray, run: int, stride: int) -> FloatArray:
    """Divided differences (m, 2) of runs of frames a stride apart, of the size of a coordinate's noise."""
    span = (run - 1) * stride + 1
    if len(times_s) < span:
        return np.zeros((0, 2))

    def windows(values: FloatArray) -> FloatArray:
        return np.lib.stride_tricks.sliding_window_view(values, span, axis=0)[..., ::stride]

    t = windows(times_s)
    weights = np.stack(
        [1.0 / np.prod([t[:, i] - t[:, j] for j in range(run) if j != i], axis=0) for i in range(run)], axis=1
    )
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.asarray((windows(centres_px) * weights[:, None]).sum(axis=2))


def _settled(differences: Sequence[FloatArray], group: BoolArray, stride: int) -> float:
    """The least scatter, of runs about a group's frames, that falls no more with the order; else 0."""
    scatters = []
    for run, each in zip(_RUNS, differences, strict=True):
        middle = ((run - 1) * stride + 1) // 2
        about = each[group[middle : middle + len(each)]]
        known = about[np.isfinite(about).all(axis=1)]
        scatters.append(1.4826 * float(np.median(np.abs(known))) if len(known) >= _FEWEST_RUNS else np.nan)
    return min((b for a, b in pairwise(scatters) if b > _SETTLED * a), default=0.0)


@dataclass
class _Path:
    """A disc over the frames: where it was last, its step from frame to frame, and the frames since then."""

    disc: Disc
    step_px: FloatArray = field(default_factory=lambda: np.zeros(2))
    since: int = 0

    def away(self, one: Disc) -> float:
        """Distance of a disc from where this one is expected, in its radii."""
        # A way that was not seen for long tells nothing.
        expected = self.disc.centre_px + min(self.since, _AGAIN_FRAMES) * self.step_px
        return float(np.hypot(*(one.centre_px - expected))) / self.disc.radius_px

    @property
    def reach(self) -> float:
        """Radii from there within which this disc goes on by itself."""
        speed = float(np.hypot(*self.step_px)) / self.disc.radius_px
        return 1.0 + (0.1 + 0.5 * speed) * min(self.since, _AGAIN_FRAMES)

    @property
    def longest(self) -> float:
        """Radii from there within which this disc may be."""
        return _JUMP_RADII * min(1 + 0.5 * (self.since - 1), 6.0)

    def alike(self, one: Disc) -> bool:
        """Whether a disc may be this one by its size."""
        growth = _GROWTH + _GROWTH_PX / self.disc.radius_px + _GROWTH_LOST * (self.since - 1)
        return bool(abs(np.log(one.radius_px / self.disc.radius_px)) < min(growth, np.log(1.6)))

    def to(self, one: Disc) -> None:
        """Go on to a disc of this frame."""
        step = (one.centre_px - self.disc.centre_px) / self.since
        self.step_px = step if self.since == 1 else np.zeros(2)
        self.disc, self.since = one, 0


@dataclass
class Tracker:
    """Follows one disc, and the others beside it, so that none of them is taken for it.

    A disc far from where the marker was lost may be the marker or another one. It is followed; where a second
    disc then shows that it may be another one, its frames are taken back.

    Attributes
    ----------
    colour : of the marker. start_px : where it is in the first frame; None to take the only disc.
    frames, doubled : frames in all, and with another disc of its colour.
    first : the discs of the first frame.
    elsewhere : the frames from which on a disc far from where the marker was lost is followed.
    taken_back : how many frames before the last one have lost their disc with it.
    """

    colour: Colour
    start_px: tuple[float, float] | None = None
    frames: int = 0
    doubled: int = 0
    first: list[Disc] = field(default_factory=list)
    elsewhere: list[int] = field(default_factory=list)
    taken_back: int = 0
    _marker: _Path | None = None
    _others: list[_Path] = field(default_factory=list)
    _before: _Path | None = None
    """The marker's path up to where it was lost, while a disc far from there is followed."""
    _far: int = 0
    _far_from: int = 0
    """Frames that show that disc, and the first of them."""

    def follow(self, bgr: AnyArray) -> Disc | None:
        """The marker in the next frame; None where it is not seen, or not told apart from another."""
        self.frames += 1
        self.taken_back = 0
        for path in (self._marker, self._before, *self._others):
            if path is not None:
                path.since += 1
        self._others = [path for path in self._others if path.since < _FORGOTTEN_FRAMES]
        found = discs(bgr, self.colour)
        if self._marker is None and not self._begins(found) and coloured(bgr, self.colour).mean() > _FULL:
            found = self._purer(bgr) or found
        self.doubled += len(found) > 1
        if self.frames == 1:
            self.first = found
        if self._marker is None:
            one = self._first(found)
            self._marker = None if one is None else _Path(one)
        else:
            one = self._next(self._marker, found, bgr.shape)
        if one is not None and self._before is not None:
            self._far += 1
            if self._far > _FORGOTTEN_FRAMES:
                self._before = None
        self._beside(found, one)
        return one

    def take_back(self, found: list[Disc | None]) -> None:
        """Empty the frames that were another disc's, in a list that ends with the last frame."""
        end = len(found) - 1
        found[max(end - self.taken_back, 0) : end] = [None] * min(self.taken_back, end)

    def doubt(self, times_s: Sequence[float]) -> str:
        """What to look at, by the times of the frames; empty where there is nothing."""
        at = ", ".join(f"{times_s[frame]:.2f}" for frame in self.elsewhere[:5] if frame < len(times_s))
        return f"lost and found far from there at {at} s: look whether it is the marker" if at else ""

    def begin(self) -> None:
        """Count from the next frame on."""
        self.frames = self.doubled = 0
        self.elsewhere, self._before = [], None

    def _begins(self, found: list[Disc]) -> bool:
        """Whether one of the discs may be the marker."""
        return bool(found) if self.start_px is None else self._first(found) is not None

    def _purer(self, bgr: AnyArray) -> list[Disc]:
        """Discs of the purest colour that the marker may have, kept from then on; empty without any."""
        for least in _PURER:
            purer = replace(self.colour, least=least)
            if self._begins(found := discs(bgr, purer)):
                self.colour = purer
                return found
        return []

    def _first(self, found: list[Disc]) -> Disc | None:
        if not found:
            return None
        if self.start_px is not None:
            start = np.array(self.start_px)
            near = min(found, key=lambda one: float(np.hypot(*(one.centre_px - start))))
            return near if np.hypot(*(near.centre_px - start)) < 1.5 * near.radius_px else None
        # Two of a kind cannot be told apart without a person's word.
        return found[0] if len(found) == 1 else None

    def _next(self, marker: _Path, found: list[Disc], shape: tuple[int, ...]) -> Disc | None:
        free = [
            one for one in found if marker.alike(one) and not self._another(marker, one, found, surely=True)
        ]
        if not free:
            return None
        near, *rest = sorted(free, key=marker.away)
        if self._before is not None and (
            any(self._appears_inside(one, shape) and not self._another(marker, one, found) for one in rest)
            or (marker.away(near) > _JUMP_RADII and self._before.away(near) < marker.away(near))
        ):
            marker = self._marker = self._give_up(self._before)
            near, *rest = sorted(free, key=marker.away)
        away = marker.away(near)
        lost = marker.since > _AGAIN_FRAMES
        clearly = not rest or (marker.away(rest[0]) > _NEARER * away + 1.0 and not (lost and away > 1.0))
        if not clearly or self._another(marker, near, found):
            return None
        # The only disc of which it is not known that it is another one is the marker, wherever it went.
        alone = lost and len(found) == 1 + len(self._others)
        if not alone and away > marker.longest:
            return None
        if away > _JUMP_RADII:
            self.elsewhere.append(self.frames - 1)
            if self._before is None:
                self._before, self._far, self._far_from = replace(marker), 0, self.frames - 1
        marker.to(near)
        self._marker = marker
        return near

    def _another(self, marker: _Path, one: Disc, found: list[Disc], surely: bool = False) -> bool:
        """Whether a disc may be one that was seen beside the marker, or surely is."""
        away, in_touch = marker.away(one), marker.since <= 2
        for path in self._others:
            apart = path.away(one)
            # A disc that is nearer to where it is expected is it.
            if not path.alike(one) or any(path.away(other) < min(apart, path.reach) for other in found):
                continue
            if surely:
                if apart < path.reach and _NEARER * apart < away:
                    return True
            elif in_touch and path.since > _AGAIN_FRAMES and away < marker.reach:
                # It has been gone for long, and the marker goes on as expected.
                continue
            elif apart < (path.reach if in_touch else path.longest) and apart < _NEARER * away + _SLACK_RADII:
                return True
        return False

    def _appears_inside(self, one: Disc, shape: tuple[int, ...]) -> bool:
        """Whether a disc cannot just have come in over the border, or the marker may have left by it."""
        assert self._before is not None
        return not _at_border(one, shape) or _at_border(self._before.disc, shape)

    def _give_up(self, before: _Path) -> _Path:
        """Give up the disc that is followed for the path before it."""
        self.taken_back = self.frames - 1 - self._far_from
        self.elsewhere = [frame for frame in self.elsewhere if frame < self._far_from]
        self._before, self._others = None, []
        return before

    def _beside(self, found: list[Disc], marker: Disc | None) -> None:
        """Follow the discs that are surely not the marker."""
        for one in found:
            if one is marker or (
                marker is None
                and not (self._marker is not None and self._another(self._marker, one, found, surely=True))
            ):
                continue
            near = [path for path in self._others if path.since and path.alike(one)]
            path = min(near, key=lambda path: path.away(one), default=None)
            if path is not None and path.away(one) < path.reach:
                path.to(one)
            else:
                self._others.append(_Path(one))


TRACK_COLUMNS = ("t_s", "u_px", "v_px", "sigma_px")
TRACK = Kind("a track", (".csv",), lambda path: column_names(path) == TRACK_COLUMNS)
"""Of the log that a track is written as."""


def track_rows(
    times_s: Sequence[float],
    found: Sequence[Disc | None],
    pixy: bool = False,
    centre: Callable[[FloatArray], FloatArray] | None = None,
) -> list[tuple[float, float, float, float]]:
    """Time, pixel and its standard deviation of each frame that shows the marker.

    Parameters
    ----------
    pixy : whole pixels of the middle of the blob's box. centre : maps the ellipse's centre to the disc's.
    """
    seen = [one for one in found if one is not None]
    if not seen:
        return []
    nowhere = np.full(2, np.nan)
    centres = np.array([nowhere if one is None else one.centre_px for one in found])
    scatter = scatter_px(centres, np.array(times_s[: len(found)]))
    sigmas = np.array([np.nan if one is None else one.sigma_px for one in found]) * first_wave_share(seen)
    for level in np.unique(scatter):
        alike = scatter == level
        sigmas[alike] *= max(1.0, level / float(np.nanmedian(sigmas[alike])))
    rows = []
    for t_s, one, sigma in zip(times_s, found, sigmas.tolist(), strict=False):
        if one is not None:
            at = one.pixy_px() if pixy else one.centre_px if centre is None else centre(one.centre_px)
            # A whole pixel is off by up to half of one, evenly.
            rows.append((t_s, float(at[0]), float(at[1]), 12**-0.5 if pixy else sigma))
    return rows


def track_text(rows: Sequence[tuple[float, float, float, float]], pixy: bool = False) -> str:
    """The log of a track, without its head."""
    places = 0 if pixy else 3
    return "".join(f"{t:.6f},{u:.{places}f},{v:.{places}f},{sigma:.3f}\n" for t, u, v, sigma in rows)
