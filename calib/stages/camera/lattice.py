"""Corners of a checkerboard as saddle points of the brightness, joined to grids along their edges."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from calib.core.arrays import BoolArray, FloatArray, GrayImage, IntArray

# ----------------------------------------------------------------------
# Where a picture looks like the corner of a checkerboard: saddle points of the brightness.
#
# At a corner the brightness is a saddle, so the determinant of its Hessian is negative there and has a
# minimum. Position: the zero of the gradient, by one Newton step. Proof: on a circle around a corner
# the brightness changes sides four times, and is the same at opposite points.
#
# An edge that leaves a corner has the bright square on one side. Angles grow from u to v, clockwise as
# seen; a ray is "rising" where the brightness rises with the angle. Opposite rays are of one kind, so
# a corner has one rising and one falling line, and the ray by which an edge arrives at the next corner
# is of the other kind than the one by which it left.

_BLUR_PX = 1.2
_RING_PX = 4.0
_RING_POINTS = 32
_BORDER_PX = 2
_CANDIDATES = 4000
_REMAP_ROWS = 30_000
"""OpenCV takes fewer than 2^15 rows."""
_LEAST_CONTRAST = 4.0
"""Grey levels, half the step from dark to bright."""
_ODD_SHARE = 0.55
"""Largest part of the ring that may differ between opposite points, over the part that agrees."""

_Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Saddles:
    """Corner-like points of one picture.

    Attributes
    ----------
    points : (N, 2) pixels.
    rising, falling : (N,) angles of the two edges' lines, rad, in [0, pi).
    contrast : (N,) half the step from dark to bright, grey levels.
    smooth : (H, W) the blurred picture that they were measured in.
    weak : (M, 2) further saddle points that failed the test on the circle.
    """

    points: FloatArray
    rising: FloatArray
    falling: FloatArray
    contrast: FloatArray
    smooth: _Float32
    weak: FloatArray


def sample(image: _Float32 | GrayImage, points: FloatArray) -> FloatArray:
    """Bilinear grey levels at (..., 2) points; beyond the border the border's values go on."""
    flat = np.nan_to_num(points.reshape(-1, 2), nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    if image.dtype == np.uint8:
        return _between_pixels(np.asarray(image), flat).reshape(points.shape[:-1])
    values = np.empty(len(flat))
    for start in range(0, len(flat), _REMAP_ROWS):
        part = flat[start : start + _REMAP_ROWS]
        u, v = np.ascontiguousarray(part[:, :1]), np.ascontiguousarray(part[:, 1:])
        values[start : start + _REMAP_ROWS] = cv2.remap(
            image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )[:, 0]
    return values.reshape(points.shape[:-1])


def _between_pixels(image: GrayImage, points: _Float32) -> FloatArray:
    """The same of whole grey levels at a few points (n, 2), which OpenCV would round."""
    height, width = image.shape
    u, v = np.clip(points, 0, [width - 1, height - 1]).astype(np.float64).T
    u0, v0 = u.astype(np.intp), v.astype(np.intp)
    u1, v1 = np.minimum(u0 + 1, width - 1), np.minimum(v0 + 1, height - 1)
    right, down = u - u0, v - v0
    above = image[v0, u0] * (1.0 - right) + image[v0, u1] * right
    below = image[v1, u0] * (1.0 - right) + image[v1, u1] * right
    return np.asarray(above * (1.0 - down) + below * down)


def _extrema(smooth: _Float32) -> FloatArray:
    """Saddle points (N, 2) to a fraction of a pixel, the strongest first."""
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    response = xy * xy - xx * yy
    peak = cv2.dilate(response, np.ones((5, 5), np.uint8))
    # A corner of contrast C and blur s has xy = 2 C / (pi s^2) at its centre.
    least = (_LEAST_CONTRAST * 0.6 / (2 * _BLUR_PX**2)) ** 2
    found = (response == peak) & (response > least)
    found[:_BORDER_PX], found[-_BORDER_PX:] = False, False
    found[:, :_BORDER_PX], found[:, -_BORDER_PX:] = False, False
    v, u = np.nonzero(found)
    strength = response[v, u]
    order = np.lexsort((u, v, -strength))[:_CANDIDATES]
    v, u, strength = v[order], u[order], strength[order]
    gx = (smooth[v, u + 1] - smooth[v, u - 1]) * 0.5
    gy = (smooth[v + 1, u] - smooth[v - 1, u]) * 0.5
    a, b, c = xx[v, u], xy[v, u], yy[v, u]
    du = (b * gy - c * gx) / -strength
    dv = (b * gx - a * gy) / -strength
    near = np.hypot(du, dv) < 2.0
    points: FloatArray = np.stack([u + du, v + dv], axis=1)[near].astype(np.float64)
    return points


def _crossings(even: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Angles where half a turn (N, n) of a ring rises and falls through its middle.

    The second half is the same as the first, so one rise and one fall are what a corner has.
    """
    n = even.shape[1]
    after = np.roll(even, -1, axis=1)
    rises, falls = (even < 0) & (after >= 0), (even >= 0) & (after < 0)
    once = (rises.sum(axis=1) == 1) & (falls.sum(axis=1) == 1)
    angles = []
    rows = np.arange(len(even))
    for crossing in (rises, falls):
        k = np.argmax(crossing, axis=1)
        y0, y1 = even[rows, k], after[rows, k]
        share = np.where(y0 == y1, 0.5, y0 / np.where(y0 == y1, 1.0, y0 - y1))
        angles.append((k + share) * np.pi / n % np.pi)
    return once, angles[0], angles[1]


def find_saddles(gray: GrayImage | _Float32) -> Saddles:
    """Corner-like points of a picture whose squares are at least 6 px wide.

    Parameters
    ----------
    gray : (H, W) grey levels.
    """
    smooth = cv2.GaussianBlur(
        np.asarray(gray, dtype=np.float32), (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE
    ).astype(np.float32, copy=False)
    points = _extrema(smooth)
    angle = np.arange(_RING_POINTS) * (2 * np.pi / _RING_POINTS)
    ring = sample(smooth, points[:, None] + _RING_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    half = _RING_POINTS // 2
    even = 0.5 * (ring[:, :half] + ring[:, half:])
    odd = 0.5 * (ring[:, :half] - ring[:, half:])
    # The middle between dark and bright, which the share of bright sectors must not shift.
    even = even - 0.5 * (even.max(axis=1) + even.min(axis=1))[:, None]
    contrast = even.max(axis=1)
    once, rising, falling = _crossings(even)
    odd_share = np.sqrt(np.mean(odd * odd, axis=1)) / np.maximum(np.sqrt(np.mean(even * even, axis=1)), 1e-9)
    good = once & (contrast > _LEAST_CONTRAST) & (odd_share < _ODD_SHARE)
    return Saddles(points[good], rising[good], falling[good], contrast[good], smooth, points[~good])


# ----------------------------------------------------------------------
# Grids of corners: saddle points joined along the edges that they share.
#
# Every corner has four ports, its edges' rays in the order of growing angle: rising, falling, rising,
# falling. An edge joins a rising port of one corner to a falling port of the next, points along both
# rays, and has the bright side where the ports say. Two ports are linked when each is the other's
# nearest. Walking the links numbers the corners: who arrives by port p goes on in the same direction
# by port p + 2, and turns clockwise by p + 1, so no grid is mirrored.

_NEIGHBOURS = 30
_KDTREE_SINGLE = 4
_LEAST_EDGE_PX = 4.5
_OFF_AXIS = float(np.cos(np.radians(25.0)))
_ALONG_EDGE = (0.3, 0.5, 0.7)
_LEAST_CORNERS = 5
_GRIDS = 5
_SNAP = 0.3
"""Share of a square within which a saddle point is taken for a predicted corner."""
_OCCUPIED = 0.5
"""An outermost row or column with a smaller share of its corners is not part of the board."""


def checkered(rows: int, columns: int) -> FloatArray:
    """+1 and -1 in turn over a grid (rows, columns), +1 at its first place."""
    i, j = np.indices((rows, columns))
    return np.asarray(1.0 - 2.0 * ((i + j) % 2))


@dataclass(frozen=True)
class Lattice:
    """Corners of one grid.

    Attributes
    ----------
    points : (rows, columns, 2) pixels; NaN where a corner was not seen.
    sign : +1 where the square between the directions of growing column and row of corner (0, 0) is
        bright, else -1.
    contrast : median half step from dark to bright, grey levels.
    """

    points: FloatArray
    sign: int
    contrast: float

    @property
    def seen(self) -> BoolArray:
        """Where a corner was seen, (rows, columns)."""
        return np.isfinite(self.points[..., 0])

    def colours(self) -> FloatArray:
        """Colour between the growing column and row of each corner, +1 or -1, (rows, columns)."""
        return self.sign * checkered(*self.points.shape[:2])


class _Nearest:
    """Indices (n, k) of the points nearest to each of (n, 2) queries, the nearest first.

    OpenCV's search tree: SciPy's would double the time that it takes to load this package.
    """

    def __init__(self, points: FloatArray) -> None:
        # The tree does not keep the points alive.
        self._points = points.astype(np.float32)
        self._tree = cv2.flann.Index(self._points, {"algorithm": _KDTREE_SINGLE})

    def __call__(self, queries: FloatArray, k: int) -> IntArray:
        found, _ = self._tree.knnSearch(queries.astype(np.float32), k, params={"checks": -1})
        return np.asarray(found, dtype=np.int64)


def _ports(saddles: Saddles) -> tuple[FloatArray, IntArray]:
    """Angles (N, 4) of the ports, and which of the even and odd ports is rising (0 or 1), (N,)."""
    first = np.minimum(saddles.rising, saddles.falling)
    second = np.maximum(saddles.rising, saddles.falling)
    angles = np.stack([first, second, first + np.pi, second + np.pi], axis=1)
    return angles, (saddles.rising > saddles.falling).astype(np.int64)


def _links(saddles: Saddles) -> IntArray:
    """Corner and port at the other end of each port, (N, 4, 2), -1 where there is none."""
    N = len(saddles.points)
    links = np.full((N, 4, 2), -1, dtype=np.int64)
    if N < _LEAST_CORNERS:
        return links
    angles, parity = _ports(saddles)
    k = min(_NEIGHBOURS + 1, N)
    other = _Nearest(saddles.points)(saddles.points, k)
    a = np.repeat(np.arange(N), k - 1)
    b = other[:, 1:].ravel()
    d = np.linalg.norm(saddles.points[b] - saddles.points[a], axis=1)
    keep = (d > _LEAST_EDGE_PX) & (a != b)
    a, b, d = a[keep], b[keep], d[keep]
    direction = (saddles.points[b] - saddles.points[a]) / d[:, None]
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    towards = np.einsum("npk,nk->np", rays[a], direction)
    back = np.einsum("npk,nk->np", rays[b], -direction)
    port_a, port_b = np.argmax(towards, axis=1), np.argmax(back, axis=1)
    rows = np.arange(len(a))
    kind_a, kind_b = (port_a + parity[a]) % 2, (port_b + parity[b]) % 2
    contrast_a, contrast_b = saddles.contrast[a], saddles.contrast[b]
    good = (towards[rows, port_a] > _OFF_AXIS) & (back[rows, port_b] > _OFF_AXIS) & (kind_a != kind_b)
    good &= np.minimum(contrast_a, contrast_b) > 0.3 * np.maximum(contrast_a, contrast_b)
    a, b, d, port_a, port_b = a[good], b[good], d[good], port_a[good], port_b[good]
    direction, kind_a = direction[good], kind_a[good]

    aside = np.stack([-direction[:, 1], direction[:, 0]], axis=1) * np.clip(0.12 * d, 1.2, 5.0)[:, None]
    along = np.array(_ALONG_EDGE)
    middle = saddles.points[a, None] + along[:, None] * (d[:, None] * direction)[:, None]
    step = sample(saddles.smooth, middle + aside[:, None]) - sample(saddles.smooth, middle - aside[:, None])
    sided = step * np.where(kind_a == 0, 1.0, -1.0)[:, None]
    least = np.minimum(saddles.contrast[a], saddles.contrast[b])
    edge = np.all(sided > 0.25 * least[:, None], axis=1)
    a, b, d, port_a, port_b = a[edge], b[edge], d[edge], port_a[edge], port_b[edge]

    order = np.lexsort((b, d))
    from_a = 4 * a[order] + port_a[order]
    ports, first = np.unique(from_a, return_index=True)
    best = np.full(4 * N, -1, dtype=np.int64)
    best[ports] = (4 * b[order] + port_b[order])[first]
    mutual = ports[best[best[ports]] == ports]
    links.reshape(-1, 2)[mutual, 0] = best[mutual] // 4
    links.reshape(-1, 2)[mutual, 1] = best[mutual] % 4
    return links


def _components(links: IntArray) -> list[dict[tuple[int, int], tuple[int, int]]]:
    """Connected grids: for each place (column, row) the corner there and its port towards growing columns."""
    steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
    table = links.tolist()
    visited = [False] * len(table)
    grids = []
    for seed in range(len(table)):
        if visited[seed]:
            continue
        visited[seed] = True
        grid = {(0, 0): (seed, 0)}
        queue = deque([(0, 0)])
        while queue:
            place = queue.popleft()
            corner, port0 = grid[place]
            for turn, (di, dj) in enumerate(steps):
                other, arrival = table[corner][(port0 + turn) % 4]
                there = (place[0] + di, place[1] + dj)
                if other < 0 or visited[other] or there in grid:
                    continue
                visited[other] = True
                # Arriving by `arrival`, the way on is the port opposite, which points in direction `turn`.
                grid[there] = (other, (arrival + 2 - turn) % 4)
                queue.append(there)
        if len(grid) >= _LEAST_CORNERS:
            grids.append(grid)
    grids.sort(key=len, reverse=True)
    return grids


def _lattice(saddles: Saddles, grid: dict[tuple[int, int], tuple[int, int]]) -> Lattice:
    places = np.array(list(grid))
    corner, port0 = np.array(list(grid.values())).T
    low = places.min(axis=0)
    columns, rows = places.max(axis=0) - low + 1
    points = np.full((rows, columns, 2), np.nan)
    i, j = (places - low).T
    points[j, i] = saddles.points[corner]
    # Port 0 along the columns is rising: then the square clockwise of it is bright.
    rising = (port0 + (saddles.rising > saddles.falling)[corner]) % 2 == 0
    vote = np.sum(np.where(rising, 1, -1) * (1 - 2 * ((i + j) % 2)))
    return Lattice(points, 1 if vote >= 0 else -1, float(np.median(saddles.contrast[corner])))


def extrapolated(points: FloatArray) -> FloatArray:
    """Predict every place of a grid, and one ring around it, from its neighbours in line.

    Parameters
    ----------
    points : (rows, columns, 2), NaN where unknown.

    Returns
    -------
    (rows + 2, columns + 2, 2); NaN where there is too little to go by. Known places are predicted too.
    """
    rows, columns = points.shape[:2]
    padded = np.full((rows + 6, columns + 6, 2), np.nan)
    padded[3:-3, 3:-3] = points
    guesses = []
    for axis in (0, 1):

        def at(offset: int, axis: int = axis) -> FloatArray:
            return np.asarray(np.roll(padded, -offset, axis=axis)[2:-2, 2:-2])

        guesses.append(0.5 * (at(-1) + at(1)))
        for side in (-1, 1):
            # The cross-ratio of equal steps, to first order: each step changes by the same factor.
            last, step, before = at(side), at(side) - at(2 * side), at(2 * side) - at(3 * side)
            length, length_before = np.linalg.norm(step, axis=-1), np.linalg.norm(before, axis=-1)
            ratio = np.clip(length / np.maximum(length_before, 1e-9), 0.6, 1.6)[..., None]
            turned = np.where(np.isfinite(ratio), step * ratio, step)
            guesses.append(last + turned)
    stack = np.stack(guesses)
    known = np.isfinite(stack[..., :1])
    # Interpolation beats extrapolation.
    weights = np.array([9.0, 1.0, 1.0, 9.0, 1.0, 1.0])[:, None, None, None] * known
    total = weights.sum(axis=0)
    mean = np.sum(np.where(known, stack, 0.0) * weights, axis=0) / np.where(total > 0, total, np.nan)
    return np.asarray(mean)


def _axes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Steps to the next column and row, (rows, columns, 2), from what neighbours there are."""
    out = []
    for axis in (1, 0):
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[axis] = (1, 1)
        wide = np.pad(points, pad, constant_values=np.nan)
        n = points.shape[axis]
        before, after = np.take(wide, range(n), axis), np.take(wide, range(2, n + 2), axis)
        steps = np.stack([points - before, after - points])
        known = np.isfinite(steps)
        count = known.sum(axis=0)
        mean = np.where(known, steps, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan)
        overall = np.where(known, steps, 0.0).sum(axis=(0, 1, 2)) / max(int(known.sum()) // 2, 1)
        out.append(np.where(np.isfinite(mean), mean, overall))
    return out[0], out[1]


def looks_like_corners(
    smooth: _Float32 | GrayImage, points: FloatArray, along: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Contrast of the four squares around each of (..., 2) points, and how far it misses a corner's symmetry.

    Parameters
    ----------
    smooth : (H, W) grey levels, slightly blurred.
    along, across : (..., 2) steps to the next column and row.

    Returns
    -------
    Half the step from dark to bright, positive where the square between the two steps is bright, and
    the largest difference between squares of the same colour over the step. Shapes (...).
    """
    values = [
        sample(smooth, points + 0.28 * (p * along + q * across))
        for p, q in ((1, 1), (-1, -1), (1, -1), (-1, 1))
    ]
    half_step = 0.25 * (values[0] + values[1] - values[2] - values[3])
    unlike = np.maximum(np.abs(values[0] - values[1]), np.abs(values[2] - values[3]))
    return half_step, unlike / np.maximum(2.0 * np.abs(half_step), 1e-9)


def _grown(saddles: Saddles, lattice: Lattice, pool: FloatArray, nearest_to: _Nearest) -> Lattice:
    """Add the saddle points that lie where the grid goes on, until there are none left."""
    for _ in range(40):
        place = extrapolated(lattice.points)
        inner = place[1:-1, 1:-1]
        points = np.pad(lattice.points, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        inner[lattice.seen] = np.nan
        along, across = _axes(np.where(np.isfinite(points), points, place))
        todo = np.isfinite(place[..., 0])
        todo &= np.all((place > -0.5) & (place < np.array(saddles.smooth.shape[::-1]) - 0.5), axis=-1)
        if not todo.any():
            break
        square = np.minimum(np.linalg.norm(along, axis=-1), np.linalg.norm(across, axis=-1))
        snapped = pool[nearest_to(place[todo], 1)[:, 0]]
        distance = np.linalg.norm(snapped - place[todo], axis=1)
        half_step, unlike = looks_like_corners(saddles.smooth, snapped, along[todo], across[todo])
        wide = replace(lattice, points=points)
        agrees = wide.colours()[todo] * half_step > 0.35 * lattice.contrast
        good = (distance < _SNAP * square[todo]) & agrees & (unlike < 0.6)
        if not good.any():
            break
        filled = points.copy()
        spots = np.argwhere(todo)[good]
        filled[spots[:, 0], spots[:, 1]] = snapped[good]
        lattice = _cropped(replace(wide, points=filled))
    return lattice


def _pruned(saddles: Saddles, lattice: Lattice) -> Lattice:
    """Without corners that do not look like ones in the finished grid."""
    for _ in range(5):
        along, across = _axes(lattice.points)
        half_step, unlike = looks_like_corners(saddles.smooth, lattice.points, along, across)
        fine = (lattice.colours() * half_step > 0.3 * lattice.contrast) & (unlike < 0.6)
        if not np.any(lattice.seen & ~fine) or not np.any(lattice.seen & fine):
            break
        points = np.where(fine[..., None], lattice.points, np.nan)
        lattice = _cropped(replace(lattice, points=points))
    return lattice


def _cropped(lattice: Lattice) -> Lattice:
    """Without rows and columns at the border that hold no corner."""
    seen = lattice.seen
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    points = lattice.points[top : rows[-1] + 1, left : columns[-1] + 1]
    return replace(lattice, points=points, sign=lattice.sign * (1 - 2 * ((top + left) % 2)))


def _trimmed(lattice: Lattice) -> Lattice:
    """Without outermost rows and columns that are mostly empty, the emptiest first."""
    while min(lattice.points.shape[:2]) > 1:
        seen = lattice.seen
        shares = [seen[0].mean(), seen[-1].mean(), seen[:, 0].mean(), seen[:, -1].mean()]
        side = int(np.argmin(shares))
        if shares[side] >= _OCCUPIED:
            break
        points = [lattice.points[1:], lattice.points[:-1], lattice.points[:, 1:], lattice.points[:, :-1]][
            side
        ]
        lattice = replace(lattice, points=points, sign=lattice.sign * (-1 if side in (0, 2) else 1))
    return lattice


def find_lattices(saddles: Saddles, least: int = _LEAST_CORNERS) -> list[Lattice]:
    """Grids of at least 2 x 2 corners in a picture, the one with most corners first.

    Parameters
    ----------
    least : corners that must be linked for a grid to be followed up.
    """
    grids = _components(_links(saddles))
    pool = np.concatenate([saddles.points, saddles.weak])
    if not grids:
        return []
    nearest_to = _Nearest(pool)
    found = []
    for grid in grids[:_GRIDS]:
        if len(grid) < least:
            break
        lattice = _trimmed(_pruned(saddles, _grown(saddles, _lattice(saddles, grid), pool, nearest_to)))
        if min(lattice.points.shape[:2]) >= 2:
            found.append(lattice)
    found.sort(key=lambda lattice: int(lattice.seen.sum()), reverse=True)
    return found
