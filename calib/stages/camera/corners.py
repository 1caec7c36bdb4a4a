"""Corners of a checkerboard in a picture: searched, checked and in one order for every picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calib.core.arrays import BoolArray, FloatArray, GrayImage, rms
from calib.stages.camera.lattice import (
    Lattice,
    checkered,
    extrapolated,
    find_lattices,
    find_saddles,
    looks_like_corners,
    sample,
)
from calib.stages.camera.refine import (
    Refined,
    fit_corners,
    frames_of,
    misshape,
    predict,
    refine,
    square_px,
)

# ----------------------------------------------------------------------
# The order of a checkerboard's corners: one rule for every picture.
#
# Quarter turns of a grid keep its hand, so a grid that is not mirrored stays so. Of the turns that give
# the board's columns and rows, the rule takes those with the dark square outward of corner (0, 0), where
# the colours differ between turns, and of these the one whose columns axis points most to the right.

_TIE = 1e-9


def canonical_turn(points: FloatArray, colours: FloatArray, columns: int, rows: int) -> int | None:
    """Quarter turns (for `numpy.rot90`) that bring a grid into the order of the rule.

    Parameters
    ----------
    points : (r, c, 2) corners, not mirrored; r x c is rows x columns or columns x rows.
    colours : (r, c), positive where the square between growing column and growing row of a corner is
        bright. A quarter turn swaps the two squares that this can mean.

    Returns
    -------
    None when the grid has another size.
    """
    turns = [k for k in range(4) if np.rot90(colours, k).shape == (rows, columns)]
    if not turns:
        return None
    parity = checkered(rows, columns)
    # Outward of corner (0, 0) is the colour of the square across it, between growing column and row.
    bright = {k: float(np.sum((-1.0) ** k * np.sign(np.rot90(colours, k)) * parity)) > 0 for k in turns}
    if len(set(bright.values())) == 2:
        turns = [k for k in turns if not bright[k]]

    def rightward(turn: int) -> tuple[float, float]:
        grid = np.rot90(points, turn)
        du, dv = np.mean(grid[:, -1] - grid[:, 0], axis=0)
        cosine = float(du / max(np.hypot(du, dv), _TIE))
        # Of two that point straight up and down the one that points down.
        return round(cosine / _TIE) * _TIE, float(dv)

    return max(turns, key=rightward)


# ----------------------------------------------------------------------
# Is a refined grid a whole checkerboard? What a texture, or a part of a larger board, gets wrong.

_UNREFINED_SHARE, _CLOSE_UNREFINED_SHARE = 0.1, 0.25
"""Largest share of corners that could not be measured, and the same in a close grid."""
_LOOSE = 0.02
"""Typical standard deviation of a corner, in squares, from which on squares have to meet: the place along a
stripe's edge is free. Stripes have .032 and more, blurred, pale and small boards .009 and less."""
_CLOSE_MISFIT = 0.03
"""Misfit, in squares, below which a grid is close: its corners may have another shape."""
_NEAR, _NEAR_PX = 0.06, 1.2
"""How far from a corner the squares are looked at, in squares, and at least in pixels."""
_NEAR_STEP = 0.7
"""Least step there over the step between the squares' middles. Sharpened boards, interlaced or not, have .78
and more, spots that touch .68 and less."""
_BULGE = 0.036
"""Largest bulge of edges between corners, in squares, towards the same colour everywhere. Photographed
boards, sharpened or in two tones too, have .022 and less, drawn ones of 5 px .029; drawn spots .046 and more,
and .029 where they are filtered besides."""
_ACROSS = 0.3
"""How far across an edge its place is looked for, in squares."""
_SHARP, _SHARP_AT = 0.6, 0.15
"""Least share of the step from dark to bright within so many squares of an edge: blur makes squares round."""
_CONTINUES = 0.4
"""Least amplitude of a further corner over the median of the grid."""
_WORST_RESIDUAL = 0.3
_REACH_PX = 10
_ITERATIONS = 8
_MARKED_SHARE = 0.7
"""Largest share of bright squares that may show something in their middle: on boards with markers all do."""
_RIM, _SAG = 0.3, 0.25
"""So far on the way from its corners to its middle a bright square is at most this much of the step brighter
than further on, beyond what a dark square is darker."""
_FLAT = 0.6
"""Largest difference between the quarters of a square, over the step from dark to bright."""

_INWARD = (0.5, 0.65, 0.8, 1.0)
"""Where a square is looked at, as shares of the way from its corners to its middle."""

_SMOOTHED_PX = 12.0
"""Side of squares from which on their tones are averages over 3 x 3 pixels."""
_FINE = 1 / 14
"""Share of a square's side below which detail counts for nothing: cells of markers are larger."""


def _squares_are_plain(grid: Refined) -> bool:
    """Whether the bright squares between corners are of one tone each, without a marker."""
    p = grid.part.from_picture(grid.points)
    corners = np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]])
    middle = corners.mean(axis=0)
    side = square_px(p)
    beside = [-1, 0, 1] if side > _SMOOTHED_PX else [0]
    # The pixels of a screen that shows the board are no marker.
    fine, image = int(_FINE * side), grid.part.image
    if fine > 1:
        image = np.asarray(cv2.blur(image, (fine, fine)), dtype=np.float32)
    around = np.stack(np.meshgrid(beside, beside), axis=-1).reshape(-1, 1, 1, 1, 2)
    # From the quarters, where a marker of half the square's side begins, to the middle.
    inward = np.array(_INWARD)[:, None, None, None, None, None]
    tones = sample(image, corners + inward * (middle - corners) + around).mean(axis=1)
    tone = tones[0].mean(axis=0)
    bright = grid.sign * checkered(*tone.shape) > 0
    step = 2.0 * float(np.median(np.abs(grid.amplitude)))
    amplitude = np.abs(grid.amplitude)
    local = 0.5 * (amplitude[:-1, :-1] + amplitude[1:, :-1] + amplitude[:-1, 1:] + amplitude[1:, 1:])
    if bright.any() and (~bright).any():
        # Blur makes a bright square brighter all the way to its middle, and a dark one darker. Sharpening
        # turns that about in both, a marker in bright ones.
        rim = sample(image, corners + _RIM * (middle - corners) + around).mean(axis=(0, 1))
        profile = tones.mean(axis=1)
        sag = float(np.median((rim - profile.min(axis=0))[bright]))
        rise = float(np.median((profile.max(axis=0) - rim)[~bright]))
        if sag - max(rise, 0.0) > _SAG * step and grid.part.halo_px == 0.0:
            return False
    # Light through blinds makes a square uneven as well, but no part of it as dark as dark ones.
    framed = np.pad(np.where(bright, -np.inf, tone), 1, constant_values=-np.inf)
    dark = np.max([framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:]], axis=0)
    parts = tones.reshape(-1, *tone.shape)
    marked = np.ptp(parts, axis=0) > _FLAT * np.maximum(local, 0.25 * step)
    marked &= bright & (parts.min(axis=0) < dark + (1.0 - _FLAT) * local.min())
    return bool(np.sum(marked) <= _MARKED_SHARE * np.sum(bright))


def _squares_meet(grid: Refined) -> bool:
    """Whether the squares keep their tones up to the corners, as round spots do not that only touch."""
    p = grid.part.from_picture(grid.points)
    along, across = np.gradient(p, axis=1), np.gradient(p, axis=0)
    parity = grid.sign * checkered(*p.shape[:2])

    def step(share: float) -> float:
        """Median step between the four squares of a corner, at a share of a square from it."""
        one, two = share * (along + across), share * (along - across)
        here = sample(grid.part.image, np.stack([p + one, p - one, p + two, p - two]))
        return float(np.median(parity * (here[0] + here[1] - here[2] - here[3])))

    near = max(_NEAR, _NEAR_PX / square_px(p))
    return step(near) > _NEAR_STEP * step(0.5)


def _edges_bulge(grid: Refined) -> bool:
    """Whether the edges between corners bulge, all towards dark or all towards bright, as those of spots do.

    A lens bends neighbouring edges of a line alike, which is towards dark for one and towards bright for the
    next; an exposure shifts an edge by as much at its quarters as in its middle.
    """
    local, image = grid.part.from_picture(grid.points), grid.part.image
    bulges = []
    for p in (local, local.transpose(1, 0, 2)):
        along, across = np.diff(p, axis=1), np.gradient(p, axis=0)
        across = 0.5 * (across[:, :-1] + across[:, 1:])
        middles = p[:, :-1] + 0.5 * along
        aside = np.array([-0.5, -_SHARP_AT, _SHARP_AT, 0.5])[:, None, None, None] * across
        far, near, near_too, far_too = sample(image, middles + aside)
        step = np.maximum(np.abs(far_too - far), 1.0)
        if np.median(np.abs(near_too - near) / step) < _SHARP:
            return False
        # The share of bright across an edge says where the edge is: at the quarters and in the middle.
        way = np.array([-0.25, 0.0, 0.25])[:, None, None, None, None] * along
        aside = np.linspace(-_ACROSS, _ACROSS, 19)[1::2, None, None, None] * across
        tones = (sample(image, middles + way + aside) - 0.5 * (far + far_too)) / step
        # A sharpened edge is darker and brighter than its squares.
        first, middle, last = np.clip(tones, -0.5, 0.5).mean(axis=1)
        bulge = 2.0 * _ACROSS * (middle - 0.5 * (first + last))
        bulges.append(float(np.median(bulge)))
    return min(bulges) > _BULGE or max(bulges) < -_BULGE


def fault_of(gray: GrayImage, grid: Refined) -> str | None:
    """What speaks against a grid being a checkerboard, in a few words; None when nothing does."""
    height, width = gray.shape
    square = square_px(grid.points)
    shape = grid.refined.shape
    if np.any(grid.points < -0.5) or np.any(grid.points > np.array([width, height]) - 0.5):
        return "corners outside the picture"
    close = grid.misfit_px < _CLOSE_MISFIT * square
    if np.mean(~grid.refined) > (_CLOSE_UNREFINED_SHARE if close else _UNREFINED_SHARE):
        return "corners that are none"
    if np.median(grid.sigma_px) > _LOOSE * square and not _squares_meet(grid):
        return "edges without corners"
    if min(shape) >= 2 and not _squares_are_plain(grid):
        return "squares that are not plain"
    if min(shape) >= 2 and _edges_bulge(grid):
        return "round spots"
    return None


def _ringed(points: FloatArray) -> FloatArray:
    """A grid (rows, columns, 2) and the places of one more corner on each side."""
    wide = extrapolated(points)
    wide[1:-1, 1:-1] = points
    for v, v1 in ((0, 1), (-1, -2)):
        for u, u1 in ((0, 1), (-1, -2)):
            wide[v, u] = wide[v, u1] + wide[v1, u] - wide[v1, u1]
    return wide


def surroundings(grid: Refined) -> tuple[list[bool], list[bool]]:
    """Whether another row of corners follows on each side, and whether the picture shows where it would be.

    Sides of the grid's arrays: top, bottom, left, right. A part of a larger board is not the board: which
    part it is cannot be told.
    """
    part = grid.part
    local = _ringed(part.from_picture(grid.points))
    image = part.image
    rows, columns = local.shape[:2]
    outside = np.ones((rows, columns), dtype=np.bool_)
    outside[1:-1, 1:-1] = False
    outside[:: rows - 1, :: columns - 1] = False
    low, high = np.array([1.0, 1.0]), np.array(image.shape[::-1]) - 2.0
    inside = outside & np.all((local > low) & (local < high), axis=-1)
    parity = grid.sign * checkered(rows, columns)
    least = _CONTINUES * float(np.median(np.abs(grid.amplitude)))
    along, across = np.gradient(local, axis=1), np.gradient(local, axis=0)
    half_step, unlike = looks_like_corners(image, local, along, across)
    likely = inside & (parity * half_step > 0.5 * least) & (unlike < 1.0)
    lines = (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1])
    count = [int(inside[line].sum()) for line in lines]
    needed = [max(2, 0.5 * n) for n in count]
    for line, n in zip(lines, needed, strict=True):
        # So few make no row, whatever they are.
        likely[line] &= likely[line].sum() >= n
    chosen = np.flatnonzero(likely.ravel())
    found: BoolArray = np.zeros(rows * columns, dtype=np.bool_)
    if len(chosen):
        frames = frames_of(local).take(chosen)
        fit = fit_corners(part, local.reshape(-1, 2)[chosen], frames, _ITERATIONS, _REACH_PX)
        square = np.minimum(np.linalg.norm(frames.along, axis=1), np.linalg.norm(frames.across, axis=1))
        near = np.linalg.norm(fit.points - local.reshape(-1, 2)[chosen], axis=1) < 0.3 * square
        strong = parity.ravel()[chosen] * fit.amplitude > least
        # Corners beyond a sharpened board's are as misshapen as its own.
        alike = misshape(fit, part.noise) < max(_WORST_RESIDUAL, 1.5 * float(np.median(grid.residual)))
        found[chosen] = fit.converged & near & strong & alike
    hit = found.reshape(rows, columns)
    hits = [int(hit[line].sum()) for line in lines]
    return [h >= n for h, n in zip(hits, needed, strict=True)], [n >= 2 for n in count]


# ----------------------------------------------------------------------
# Candidates for a checkerboard, stage by stage, the cheap and sure stages first.
#
# The first stages look for grids of saddle points in copies of the picture, from a small one, where
# large squares stay and noise goes, up to one of twice the size for squares of a few pixels. OpenCV's finder
# by sectors (SB) follows, and then with an exhaustive search, which take long where there is no board and are
# asked only when the first stages saw most of one. They add three boards in 1400 pictures, its classic finder
# none.

_COARSE_PIXELS = 120_000
_LARGEST_PIXELS = 6_000_000
_ENLARGED = ((2.0, 700_000), (4.0, 90_000))
"""Zooms of small pictures, and the number of pixels below which they are tried."""
_QUICK_PIXELS = 400_000
_OPENCV_PIXELS = 1_300_000
"""Of a picture that OpenCV's finders can search quickly."""
_SEEN_SHARE = 0.8
"""Least share of a grid's corners that must be seen; the others are looked for where they should be."""
_FRAGMENT = 0.5
"""Share of the board's corners, in a grid with holes, from which on OpenCV's finders are asked too."""


@dataclass(frozen=True)
class Level:
    """A copy of the picture, `zoom` times its size; u = (x + 1/2) / zoom - 1/2."""

    image: GrayImage
    zoom: float

    def to_picture(self, points: FloatArray) -> FloatArray:
        """Pixels of the picture from pixels of the copy."""
        return np.asarray((points + 0.5) / self.zoom - 0.5)


def resized(gray: GrayImage, zoom: float) -> Level:
    """A copy of the picture; `zoom` is 1 / n or n for a whole n."""
    if zoom == 1.0:
        return Level(gray, 1.0)
    if zoom > 1.0:
        copy = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        return Level(np.asarray(copy, dtype=np.uint8), zoom)
    # A picture of a few rows keeps one.
    n = min(round(1.0 / zoom), *gray.shape)
    height, width = gray.shape[0] // n, gray.shape[1] // n
    copy = cv2.resize(gray[: height * n, : width * n], (width, height), interpolation=cv2.INTER_AREA)
    return Level(np.asarray(copy, dtype=np.uint8), 1.0 / n)


def lattice_levels(gray: GrayImage) -> list[float]:
    """Zooms at which to look for grids of saddle points, in order."""
    halvings = max(0, math.ceil(0.5 * math.log2(gray.size / _COARSE_PIXELS)))
    copies = (0.5**n for n in range(halvings, -1, -1))
    zooms = [zoom for zoom in copies if gray.size * zoom**2 <= _LARGEST_PIXELS]
    return zooms + [zoom for zoom, most in _ENLARGED if gray.size < most]


def complete(lattice: Lattice) -> FloatArray | None:
    """Points of a lattice with the few unseen corners where the others place them, or None."""
    seen = lattice.seen
    if seen.all():
        return lattice.points
    if seen.mean() < _SEEN_SHARE:
        return None
    prediction = predict(lattice.points, seen)
    if prediction is None:
        return None
    return np.where(seen[..., None], lattice.points, prediction.points)


def reduced(gray: GrayImage, pixels: int) -> Level:
    """A copy of no more than so many pixels, or the picture."""
    return resized(gray, 1.0 / max(1, math.ceil(math.sqrt(gray.size / pixels))))


_BY_SECTORS = (0, cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE)
_EVEN_LIGHT = np.rint(255.0 * np.log1p(np.arange(256) / 4.0) / math.log1p(255 / 4.0)).astype(np.uint8)
"""Logarithms of grey levels: in a shadow black and white are as far apart as beside it."""


def _candidates(gray: GrayImage, columns: int, rows: int, quick: bool) -> Iterator[list[FloatArray]]:
    """Grids (r, c, 2) of the picture to try, stage by stage."""
    some = fragments = False
    zooms = lattice_levels(gray)
    # Where the board moved, or white bleeds into black, corners are saddle points in a smaller copy only.
    levels = [(zoom, False) for zoom in (*zooms, 0.5 * zooms[0])]
    for zoom, even in (*levels, *((zoom, True) for zoom in zooms if zoom <= 1.0)):
        if quick and (even or (zoom > 1.0 and zoom**2 * gray.size > _QUICK_PIXELS)):
            continue
        if even and not some:
            break
        level, grids = resized(_EVEN_LIGHT[gray] if even else gray, zoom), []
        for lattice in find_lattices(find_saddles(level.image), least=max(4, columns * rows // 4)):
            shape = sorted(lattice.points.shape[:2])
            points = complete(lattice) if shape == sorted((rows, columns)) else None
            if points is not None:
                grids.append(level.to_picture(points))
            elif all(a <= b for a, b in zip(shape, sorted((rows, columns)), strict=True)):
                some = True
                fragments |= int(lattice.seen.sum()) >= _FRAGMENT * columns * rows
        yield grids
    if quick or not fragments:
        return
    level = reduced(gray, _OPENCV_PIXELS)
    for flags in _BY_SECTORS:
        with suppress(cv2.error):
            found, corners = cv2.findChessboardCornersSB(level.image, (columns, rows), flags=flags)
            if found and corners.size == 2 * columns * rows:
                grid = np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
                yield [level.to_picture(_not_mirrored(grid))]


def _not_mirrored(grid: FloatArray) -> FloatArray:
    along, across = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    a, b = along.mean(axis=0), across.mean(axis=0)
    return grid if a[0] * b[1] - a[1] * b[0] > 0 else np.asarray(grid[:, ::-1])


# ----------------------------------------------------------------------
# How many corners a board of unknown size has.

_ROUNDS = 12
_NARROW = 0.65
"""Largest share of corners that only a small window can fit, in a board that nobody asked for."""
_SIZE_MISFIT = 0.04
"""Largest misfit, in squares, of a board that nobody asked for."""
_LATTICES = 3


def _whole(gray: GrayImage, points: FloatArray, within: bool, covered: bool = False) -> Refined | None:
    """Refine a grid and add the rows that follow it, until there are none; None when it is no board.

    A pattern that leaves the picture on every side has no size; `within` the picture, on any side. Something
    may lie over single corners of one that is `covered`.
    """
    for _ in range(_ROUNDS):
        if min(points.shape[:2]) < 3:
            return None
        grid = refine(gray, points)
        if grid is None or fault_of(gray, grid) is not None:
            return None
        continues, seen = surroundings(grid)
        top, bottom, left, right = continues
        if not any(continues):
            sure = covered or bool(grid.refined.all() and grid.narrow.mean() < _NARROW)
            sure &= grid.misfit_px < _SIZE_MISFIT * square_px(grid.points)
            return grid if sure and (all if within else any)(seen) else None
        wide = _ringed(grid.points)
        rows, columns = wide.shape[:2]
        points = wide[
            0 if top else 1 : rows - (0 if bottom else 1), 0 if left else 1 : columns - (0 if right else 1)
        ]
    return None


def _size(grid: Refined) -> tuple[int, int]:
    rows, columns = grid.refined.shape
    return max(rows, columns), min(rows, columns)


def find_size(gray: GrayImage, within: bool = False, covered: bool = False) -> tuple[int, int] | None:
    """Inner corners (columns, rows), columns >= rows, of the largest board of one picture.

    Parameters
    ----------
    within : only of one that does not reach the picture's border, where it may be a part of a larger one.
    covered : also of one with single corners that cannot be measured, as under a finger: only what several
        pictures agree on is a size then.
    """
    if not _shows_something(gray):
        return None
    for zoom in lattice_levels(gray):
        level = resized(gray, zoom)
        lattices = find_lattices(find_saddles(level.image), least=6)[:_LATTICES]
        every = [level.to_picture(p) for p in map(complete, lattices) if p is not None]
        grids = [grid for p in every if (grid := _whole(gray, p, within, covered)) is not None]
        if grids:
            return _size(max(grids, key=lambda grid: np.prod(np.ptp(grid.points, axis=(0, 1)))))
    return None if covered else _size_by_opencv(gray, within)


def _size_by_opencv(gray: GrayImage, within: bool) -> tuple[int, int] | None:
    level = reduced(gray, _OPENCV_PIXELS)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(level.image, (3, 3), flags)
    except cv2.error:
        return None
    if not found or corners is None or meta is None:
        return None
    rows, columns = meta.shape[:2]
    if corners.size != 2 * rows * columns:
        return None
    grid = _whole(
        gray, level.to_picture(np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)), within
    )
    return None if grid is None else _size(grid)


# ----------------------------------------------------------------------
# Corners of a checkerboard in a picture: found, refined and in one order for every picture.

_LEAST_RANGE = 6
"""Grey levels between the darkest and the brightest pixel of a picture that may show a board."""


@dataclass(frozen=True)
class Detection:
    """A checkerboard found in a picture.

    Corner (column i, row j) has index j * columns + i. The grid is not mirrored: the rows axis is
    clockwise from the columns axis as seen. Where the colours tell turns of the board apart, the
    square outward of corner (0, 0) is dark; else the columns axis points right in the picture to
    within 90 degrees (45 on square boards).

    Attributes
    ----------
    pixels : (rows * columns, 2), (0, 0) at the centre of the top-left pixel, u right, v down.
    columns, rows : inner corners.
    sigma_px : (rows * columns,) standard deviation of one coordinate of a corner, from its own fit.
    refined : (rows * columns,) False where the corner itself could not be measured: `pixels` then has
        its place between the others and must not be taken for a measurement.
    contrast : median half step from dark to bright, grey levels.
    alone : whether no other board of this size was seen beside it, with smaller squares.
    """

    pixels: FloatArray
    columns: int
    rows: int
    sigma_px: FloatArray
    refined: BoolArray
    contrast: float
    alone: bool = True


def _shows_something(gray: GrayImage) -> bool:
    """Whether there is anything to look at."""
    return min(gray.shape) >= 8 and int(gray.max()) - int(gray.min()) >= _LEAST_RANGE


def _ordered(grid: Refined, columns: int, rows: int, alone: bool) -> Detection | None:
    turn = canonical_turn(grid.points, grid.amplitude, columns, rows)
    if turn is None:
        return None
    return Detection(
        pixels=np.ascontiguousarray(np.rot90(grid.points, turn)).reshape(-1, 2),
        columns=columns,
        rows=rows,
        sigma_px=np.rot90(grid.sigma_px, turn).ravel(),
        refined=np.rot90(grid.refined, turn).ravel(),
        contrast=float(np.median(np.abs(grid.amplitude))),
        alone=alone,
    )


def _boards(gray: GrayImage, grids: Sequence[FloatArray]) -> list[Refined]:
    """The grids that pass every test, the one with the largest squares first."""
    refined = [grid for points in grids if (grid := refine(gray, points)) is not None]
    sound = [g for g in refined if fault_of(gray, g) is None and not any(surroundings(g)[0])]
    return sorted(sound, key=lambda grid: -square_px(grid.points))


def detect(gray: GrayImage, columns: int, rows: int, quick: bool = False) -> Detection | None:
    """Find a board of `columns` x `rows` inner corners, at any angle, to a small fraction of a pixel.

    The first stage whose grid is whole and passes the tests ends the search. Refinement starts each
    corner anew from where the others place it, so it matters little which stage that is.

    Parameters
    ----------
    gray : (H, W) of uint8.
    columns, rows : inner corners, each at least 3.
    quick : for a camera that runs: no large copies and no other finders, which take ten times as long on
        a frame without a board.

    Returns
    -------
    None where no such board is seen whole, or only as a part of a larger one.
    """
    if not _shows_something(gray):
        return None
    for grids in _candidates(gray, columns, rows, quick):
        boards = _boards(gray, grids)
        if boards:
            centre, *others = (board.points.mean(axis=(0, 1)) for board in boards)
            near = square_px(boards[0].points)
            alone = all(np.linalg.norm(other - centre) < near for other in others)
            return _ordered(boards[0], columns, rows, alone)
    return None


def between_fields(first: Detection, second: Detection | None) -> Detection:
    """The board at the mean moment of the two fields of an interlaced picture, or the first without a second.

    Every other row makes corners of boards along the rows err by .05 px, in the two fields opposite ways.
    Corners that one field alone tells are no measurement.
    """
    if second is None:
        return first
    turns = ((second.pixels[::k], second.sigma_px[::k], second.refined[::k]) for k in (1, -1))
    pixels, sigma_px, refined = min(turns, key=lambda turn: rms(turn[0] - first.pixels))
    both = first.refined & refined
    return replace(
        first,
        pixels=np.where(both[:, None], 0.5 * (first.pixels + pixels), first.pixels),
        sigma_px=0.5 * np.hypot(first.sigma_px, sigma_px),
        refined=both,
    )


_FOLLOWED_SHARE = 1.0
"""How far a board may go from one picture to the next, over its longer side, to be taken for the same."""


def follow(gray: GrayImage, before_px: FloatArray) -> FloatArray | None:
    """Corners (rows, columns, 2) of a board that was detected a moment ago, to some tenths of a pixel.

    They are the saddle points of the brightness, in a fifth of the time that `detect` takes, which measures
    each corner and its surroundings.

    Parameters
    ----------
    gray : (H, W) of uint8. before_px : (rows, columns, 2) where the board was.

    Returns
    -------
    None where not every corner is seen, or where the board went too far: `detect` may find it then. The
    order is the one that is nearest to the order before.
    """
    rows, columns = before_px.shape[:2]
    side = np.linalg.norm([before_px[0, -1] - before_px[0, 0], before_px[-1, 0] - before_px[0, 0]], axis=1)
    for zoom in lattice_levels(gray):
        if zoom > 1.0:
            break
        level = resized(gray, zoom)
        for lattice in find_lattices(find_saddles(level.image), least=columns * rows):
            points = level.to_picture(lattice.points)
            turns = [t for k in range(4) if (t := np.rot90(points, k)).shape == before_px.shape]
            if lattice.seen.all() and turns:
                away = [rms(np.linalg.norm(turn - before_px, axis=-1)) for turn in turns]
                k = int(np.argmin(away))
                if away[k] < _FOLLOWED_SHARE * side.max():
                    return np.ascontiguousarray(turns[k])
    return None
