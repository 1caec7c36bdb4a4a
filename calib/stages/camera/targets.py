"""Targets other than a plain checkerboard: recognised, and a ChArUco board's corners found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from calib.core.arrays import BoolArray, FloatArray, GrayImage, IntArray
from calib.core.geometry import apply_homography
from calib.stages.camera.corners import Detection
from calib.stages.camera.lattice import sample
from calib.stages.camera.refine import Refined, refine, square_px

# ----------------------------------------------------------------------
# Markers: which dictionary they are of, and where their neighbours lie in units of their own side.
#
# A marker's four corners are a small coordinate system. Seen in it, the centre of a neighbour lies where
# the board's layout puts it, but for perspective and the lens, which change little over a few squares.
# A misread marker, or the wrong number of columns, is off by squares.

DICTIONARIES = tuple(
    sorted(
        name.removeprefix("DICT_")
        for name in dir(cv2.aruco)
        if name.startswith("DICT_") and name == name.upper()
    )
)
"""Names of OpenCV's dictionaries, without their common prefix."""

_WAYS = (
    *((name, 1) for name in ("4X4_1000", "5X5_1000", "6X6_1000", "APRILTAG_36H11")),
    ("APRILTAG_36H11", 2),
    *((name, 1) for name in ("7X7_1000", "ARUCO_ORIGINAL", "ARUCO_MIP_36H12", "APRILTAG_16H5")),
    *((name, 1) for name in ("APRILTAG_25H9", "APRILTAG_36H10")),
)
"""Dictionaries to look for, the usual ones first, and the width of the frame in cells, which is two for
Kalibr's tags. The smaller dictionaries of a family are the first markers of its largest."""
_SIZES = (50, 100, 250, 1000)
_PROBE_PIXELS = 2_500_000
"""Pictures are averaged down to about this many pixels to recognise what they show."""
_FEWEST_MARKERS = 6
"""Fewer agree by chance with one of the many numberings."""
_MOST_COLUMNS = 60
_NEIGHBOURS = 4
_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
_MARKER_SHARE = (0.25, 0.97)
"""Side of a marker over that of its square, or over the pitch of a grid."""
_OFF = 0.2
"""Distance of a neighbour from its place over its distance from the marker, that perspective may make."""
_AGREEING = 0.7
"""Share of neighbours that have to be in place."""

_Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Markers:
    """Markers of a picture: `ids` (N,), and their corners `quads` (N, 4, 2) px, clockwise."""

    ids: IntArray
    quads: FloatArray

    def take(self, chosen: IntArray | BoolArray) -> Markers:
        """Some of them."""
        return Markers(self.ids[chosen], self.quads[chosen])


@dataclass(frozen=True)
class Layout:
    """How markers are numbered.

    Attributes
    ----------
    kind : "charuco", or "grid" where markers stand side by side (AprilGrid, ArUco's grid board).
    dictionary : one of `DICTIONARIES`, the smallest that holds the markers.
    columns, rows : squares of a ChArUco board, markers of a grid; rows as far as they were seen.
    first_white : whether the square at the top left holds a marker; OpenCV's boards of before 4.6 with an
        even number of rows do so, and none of later.
    upward : whether the rows of a grid are numbered from below, as Kalibr does.
    """

    kind: str
    dictionary: str
    columns: int
    rows: int
    first_white: bool = False
    upward: bool = False

    def places(self, ids: IntArray) -> IntArray:
        """Column and row (N, 2) of markers; rows from 0, downward."""
        if self.kind == "grid":
            row, column = np.divmod(ids, self.columns)
            return np.stack([column, -row if self.upward else row], axis=1)
        above = (self.columns + 1) // 2 if self.first_white else self.columns // 2
        pair, rest = np.divmod(ids, self.columns)
        lower = rest >= above
        row = 2 * pair + lower
        column = 2 * np.where(lower, rest - above, rest) + (lower == self.first_white)
        return np.stack([column, row], axis=1)


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of this name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _detector(dictionary: str, border: int = 1) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.markerBorderBits = border
    return cv2.aruco.ArucoDetector(dictionary_of(dictionary), parameters)


def find_markers(gray: GrayImage, dictionary: str, border: int = 1) -> Markers:
    """All markers of a dictionary in a picture; `border` is the width of their frame in cells."""
    quads, ids, _ = _detector(dictionary, border).detectMarkers(gray)
    return _markers(quads, ids)


def _markers(quads: Sequence[npt.NDArray[Any]], ids: npt.ArrayLike | None) -> Markers:
    if ids is None:
        return Markers(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))
    return Markers(
        np.asarray(ids, dtype=np.int64).ravel(), np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)
    )


def _steps(markers: Markers) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs (i, j) of neighbours, and where j's centre lies from i's in units of both's mean sides, (P, 2).

    Sides of one alone would be off by what perspective and lens change from one to the other.
    """
    quads = markers.quads
    centres = quads.mean(axis=1)
    count = min(_NEIGHBOURS, len(centres) - 1)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, :count]
    i = np.repeat(np.arange(len(centres)), count)
    j = near.ravel()
    along = 0.5 * (quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3])
    down = 0.5 * (quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1])
    basis = np.stack([along, down], axis=2)
    both = 0.5 * (basis[i] + basis[j])
    step = np.linalg.solve(both + 1e-12 * np.eye(2), (centres[j] - centres[i])[..., None])[..., 0]
    return i, j, step


def _share(board: FloatArray, step: FloatArray) -> tuple[float, BoolArray]:
    """Side of a marker over that of a square, and which pairs (P,) have the steps that the board gives."""
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    cosine = np.sum(board * step, axis=1) / (length * np.maximum(np.linalg.norm(board, axis=1), 1e-9))
    ratios = np.linalg.norm(board, axis=1) / length
    share = float(np.median(ratios[cosine > 0.9])) if np.any(cosine > 0.9) else 0.0
    off = np.linalg.norm(step * share - board, axis=1) / np.maximum(np.linalg.norm(board, axis=1), 1e-9)
    return share, np.asarray(off < _OFF)


def in_place(markers: Markers, layout: Layout) -> tuple[Markers, float]:
    """Markers that agree with most of their neighbours, and their side over that of a square."""
    none = markers.take(np.zeros(len(markers.ids), dtype=np.bool_)), 0.0
    if len(markers.ids) < 2:
        return none
    i, j, step = _steps(markers)
    places = layout.places(markers.ids)
    share, good = _share((places[j] - places[i]).astype(np.float64), step)
    if not _MARKER_SHARE[0] < share < _MARKER_SHARE[1]:
        return none
    count = len(markers.ids)
    votes = np.bincount(i, good, count) + np.bincount(j, good, count)
    kept = votes > 0.5 * (np.bincount(i, minlength=count) + np.bincount(j, minlength=count))
    # A marker that is there twice is not of this board, or is misread.
    once = np.bincount(markers.ids[kept], minlength=int(markers.ids.max()) + 1)[markers.ids] == 1
    return markers.take(kept & once), share


def _layouts() -> list[Layout]:
    kinds = (("charuco", 3, "first_white"), ("grid", 2, "upward"))
    return [
        Layout(kind, "", columns, 0, **{either: way})
        for kind, fewest, either in kinds
        for columns in range(fewest, _MOST_COLUMNS)
        for way in (False, True)
    ]


def _layout_of(pictures: Sequence[Markers], dictionary: str) -> Layout | None:
    """The numbering that puts the neighbours of most markers in their place."""
    pairs = [(markers, *_steps(markers)) for markers in pictures if len(markers.ids) >= _FEWEST_MARKERS]
    if not pairs:
        return None
    step = np.concatenate([one[3] for one in pairs])
    best: tuple[float, Layout] | None = None
    for layout in _layouts():
        board = np.concatenate(
            [(p := layout.places(m.ids))[j] - p[i] for m, i, j, _ in pairs], dtype=np.float64
        )
        # Makers of grids turn their markers as they like.
        turns = (_TURN @ board.T).T, -board, -(_TURN @ board.T).T
        every = [_share(one, step) for one in (board, *(turns if layout.kind == "grid" else ()))]
        share, good = max(every, key=lambda one: float(np.mean(one[1])))
        agreeing = float(np.mean(good))
        if _MARKER_SHARE[0] < share < _MARKER_SHARE[1] and (best is None or agreeing > best[0]):
            best = agreeing, layout
    if best is None or best[0] < _AGREEING:
        return None
    layout = replace(best[1], dictionary=dictionary)
    if layout.kind == "grid":
        return with_rows(layout, [markers.ids for markers in pictures])
    return with_rows(layout, [in_place(markers, layout)[0].ids for markers in pictures])


def with_rows(layout: Layout, ids: Sequence[IntArray]) -> Layout | None:
    """The layout with the rows, and of the dictionary, that these markers (one array a picture) need."""
    every = np.concatenate([np.zeros(0, dtype=np.int64), *ids])
    if len(every) < _FEWEST_MARKERS:
        return None
    rows = int(np.abs(layout.places(every)[:, 1]).max()) + 1
    family, _, size = layout.dictionary.rpartition("_")
    dictionary = layout.dictionary
    if size.isdigit():
        enough = next((n for n in _SIZES if n > every.max()), None)
        dictionary = layout.dictionary if enough is None else f"{family}_{enough}"
    return replace(layout, dictionary=dictionary, rows=rows)


def of_size(layout: Layout, corners: tuple[int, int]) -> Layout | None:
    """The layout with as many rows as stated, of which some may not be seen yet; None for another board."""
    columns, rows = layout.columns - 1, layout.rows - 1
    stated = next((c for c in (corners, corners[::-1]) if c[0] == columns and c[1] >= rows), None)
    return None if stated is None else replace(layout, rows=stated[1] + 1)


def _reduced(gray: GrayImage, pixels: int) -> GrayImage:
    """The picture averaged down to about so many pixels."""
    zoom = np.sqrt(pixels / gray.size)
    if zoom >= 1.0:
        return gray
    return np.asarray(cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def recognise(pictures: Sequence[GrayImage], dictionary: str | None = None) -> Layout | None:
    """What board of markers these pictures show, of a dictionary or of any; None where there is none."""
    small = [_reduced(gray, _PROBE_PIXELS) for gray in pictures]
    ways = [way for way in _WAYS if dictionary is None or way[0] == _largest(dictionary)]
    for gray in small:
        for name, border in ways:
            quads, ids, others = _detector(name, border).detectMarkers(gray)
            if len(quads) + len(others) < _FEWEST_MARKERS:
                # Nothing in this picture has the outline of a marker.
                break
            if ids is None or len(ids) < _FEWEST_MARKERS:
                continue
            seen = _markers(quads, ids)
            layout = _layout_of([seen], name)
            if layout is None:
                continue
            more = [find_markers(one, name, border) for one in small if one is not gray]
            return _layout_of([seen, *more], name) if more else layout
    return None


def _largest(dictionary: str) -> str:
    """The dictionary of `_WAYS` that holds the markers of this one."""
    family = dictionary.rpartition("_")[0]
    return next((name for name, _ in _WAYS if name in (dictionary, f"{family}_1000")), dictionary)


# ----------------------------------------------------------------------
# Corners: the markers say where each corner is to a few hundredths of a square, and our own model of a
# corner measures it.
#
# A marker leaves a margin of an eighth of a square or so, and no window that is free of ink would be
# large enough. So the ink is painted over with the white around it: what is left is a checkerboard, of
# which `refine` measures all that the picture shows.

_OF_MARGIN = 0.5
"""Share of the margin that is painted over, as the marker's blur reaches into it."""
_LEVEL = 0.3
"""Weight of an even white, against one sample of it: near the border of the picture few are seen."""
_UNSURE = 4.0
"""Sigma over the median, above which a corner beside a marker that was not read is not trusted."""
_SIDE_SAMPLES = 8
_NEAREST = 12
_FEWEST_CORNERS = 6


def _place(board: FloatArray, pixels: FloatArray, wanted: FloatArray) -> FloatArray | None:
    """Pixels of points (M, 2) of the board: a homography, and what the lens adds near each."""
    # Of all points: half of them fit best where a wide lens bends the other half most.
    found, _ = cv2.findHomography(board, pixels)
    if found is None or not np.all(np.isfinite(found)):
        return None
    H: FloatArray = np.asarray(found, dtype=np.float64)
    left = pixels - apply_homography(H, board)
    straight = apply_homography(H, wanted)
    known = np.isfinite(left).all(axis=1)
    board, left = board[known], left[known]
    if len(board) < 4:
        return None
    apart = np.sum((wanted[:, None] - board) ** 2, axis=2)
    near = np.argsort(apart, axis=1)[:, :_NEAREST]
    weights = 1.0 / (np.take_along_axis(apart, near, axis=1) + 0.25) ** 2
    offset = board[near] - wanted[:, None]
    basis = np.concatenate([np.ones((*near.shape, 1)), offset], axis=2)
    weighted = basis * weights[..., None]
    normal = weighted.transpose(0, 2, 1) @ basis + np.diag([0.0, 0.3, 0.3])
    bent = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ left[near])[:, 0]
    return np.asarray(straight + bent)


def _quads(places: IntArray, share: float) -> FloatArray:
    """Corners (N, 4, 2), in squares, of markers in the squares at these columns and rows (N, 2)."""
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return np.asarray(places[:, None] + 0.5 + share * square)


def _paint(gray: GrayImage, quads: FloatArray, share: float) -> GrayImage:
    """The picture with the markers (N, 4, 2) in the colour of the white around them."""
    painted = gray.copy()
    smooth = gray.astype(np.float32)
    height, width = gray.shape
    centres = quads.mean(axis=1, keepdims=True)
    rays = quads - centres
    side = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean(axis=1)
    margin = 0.5 * (1.0 / share - 1.0) * side
    inked = centres + rays * (1.0 + 2.0 * _OF_MARGIN * margin / side)[:, None, None]
    # The middle of the margin, the corners of the ring left out: there the black squares are nearest.
    ring = centres + rays * (0.5 * (1.0 + 1.0 / share))
    t = np.linspace(0.15, 0.85, _SIDE_SAMPLES)[:, None]
    for area, line, centre in zip(inked, ring, centres[:, 0], strict=True):
        around = (line[:, None] * (1.0 - t) + np.roll(line, -1, axis=0)[:, None] * t).reshape(-1, 2)
        seen = np.all((around >= 0) & (around <= [width - 1, height - 1]), axis=1)
        low = np.maximum(np.floor(area.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(area.max(axis=0)).astype(int) + 1, [width, height])
        if seen.sum() < 2 or np.any(high <= low):
            continue
        tones = sample(smooth, around[seen])
        scale = max(float(np.ptp(area)), 1.0)
        plane = np.column_stack([np.ones(int(seen.sum())), (around[seen] - centre) / scale])
        level = np.diag([0.0, _LEVEL, _LEVEL])
        fit = np.linalg.solve(plane.T @ plane + level, plane.T @ tones)
        v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
        filled = fit[0] + ((u - centre[0]) * fit[1] + (v - centre[1]) * fit[2]) / scale
        mask = np.zeros(u.shape, dtype=np.uint8)
        cv2.fillConvexPoly(mask, np.rint((area - low) * 16).astype(np.int32), 1, shift=4)
        part = painted[low[1] : high[1], low[0] : high[0]]
        part[mask > 0] = np.clip(np.rint(filled), 0, 255).astype(np.uint8)[mask > 0]
    return painted


def _ordered(
    grid: Refined, seen: BoolArray, first: tuple[int, int], layout: Layout, away: FloatArray
) -> Detection | None:
    """The measured part of a board in the frame of the whole, (0, 0) at its first corner."""
    columns, rows = layout.columns - 1, layout.rows - 1
    part = np.s_[first[1] : first[1] + grid.refined.shape[0], first[0] : first[0] + grid.refined.shape[1]]
    measured = np.zeros((rows, columns), dtype=np.bool_)
    measured[part] = grid.refined & seen
    if measured.sum() < _FEWEST_CORNERS or min(measured.any(axis=0).sum(), measured.any(axis=1).sum()) < 2:
        return None
    pixels = away.copy().reshape(rows, columns, 2)
    pixels[part] = grid.points
    sigma = np.full((rows, columns), 0.25 * square_px(grid.points))
    sigma[part] = grid.sigma_px
    return Detection(
        pixels=pixels.reshape(-1, 2),
        columns=columns,
        rows=rows,
        sigma_px=sigma.ravel(),
        refined=measured.ravel(),
        contrast=float(np.median(np.abs(grid.amplitude))),
    )


def _corners(layout: Layout) -> FloatArray:
    """Inner corners (rows * columns, 2) of a ChArUco board, in squares from its outer corner."""
    j, i = np.mgrid[1 : layout.rows, 1 : layout.columns]
    return np.stack([i.ravel(), j.ravel()], axis=1).astype(np.float64)


def _placed(markers: Markers, layout: Layout) -> tuple[Markers, float, FloatArray] | None:
    """The board's own markers, their side over that of a square, and where they put its corners (n, 2)."""
    markers, share = in_place(markers, layout)
    markers = markers.take(layout.places(markers.ids)[:, 1] < layout.rows)
    if len(markers.ids) < 2:
        return None
    board = _quads(layout.places(markers.ids), share).reshape(-1, 2)
    at = _place(board, markers.quads.reshape(-1, 2), _corners(layout))
    return None if at is None else (markers, share, at)


def sketch_charuco(gray: GrayImage, markers: Markers, layout: Layout) -> tuple[FloatArray, GrayImage] | None:
    """Where the markers put the corners (rows, columns, 2), and the picture without these markers.

    The corners are right to a few hundredths of a square where markers were read, and guessed elsewhere;
    parameters as for `detect_charuco`, which takes many times as long.
    """
    placed = _placed(markers, layout)
    if placed is None or not np.all(np.isfinite(placed[2])):
        return None
    own, share, at = placed
    return at.reshape(layout.rows - 1, layout.columns - 1, 2), _paint(gray, own.quads, share)


def shows(gray: GrayImage, layout: Layout) -> bool:
    """Whether a picture shows a board of markers."""
    markers = find_markers(_reduced(gray, _PROBE_PIXELS), layout.dictionary)
    return len(in_place(markers, layout)[0].ids) >= _FEWEST_MARKERS


def is_mirrored(gray: GrayImage, layout: Layout) -> bool:
    """Whether a picture shows a board of markers as in a mirror, such as a selfie camera stores."""
    return shows(np.asarray(cv2.flip(gray, 1), dtype=np.uint8), layout)


def detect_charuco(gray: GrayImage, markers: Markers, layout: Layout) -> Detection | None:
    """Corners of a ChArUco board, of which a picture may show any part.

    Parameters
    ----------
    gray : (H, W) of uint8.
    markers : of the layout's dictionary, as `find_markers` gives them.

    Returns
    -------
    None where fewer than 3 x 3 corners lie in the picture's part of the board. Corner (0, 0) is the
    inner corner next to the marker with the lowest number; `refined` is False for corners that the
    picture does not show or whose markers were not read, and `pixels` there is no measurement.
    """
    placed = _placed(markers, layout)
    if placed is None:
        return None
    markers, share, at = placed
    columns, rows = layout.columns - 1, layout.rows - 1
    corners = _corners(layout)
    places = layout.places(markers.ids)
    board = _quads(places, share).reshape(-1, 2)
    height, width = gray.shape
    inside = np.isfinite(at).all(axis=1) & np.all((at > -0.5) & (at < [width - 0.5, height - 0.5]), axis=1)
    read = np.zeros((layout.rows, layout.columns), dtype=np.bool_)
    read[places[:, 1], places[:, 0]] = True
    count = read[:-1, :-1] + 0 + read[1:, 1:] + read[1:, :-1] + read[:-1, 1:]
    beside = (count > 0) & inside.reshape(rows, columns)
    some_rows, some_columns = np.flatnonzero(beside.any(axis=1)), np.flatnonzero(beside.any(axis=0))
    if len(some_rows) == 0:
        return None
    (v0, v1), (u0, u1) = (some_rows[0], some_rows[-1] + 1), (some_columns[0], some_columns[-1] + 1)
    if min(v1 - v0, u1 - u0) < 3:
        return None
    start = at.reshape(rows, columns, 2)[v0:v1, u0:u1]
    if not np.all(np.isfinite(start)):
        return None
    # Markers that were not read have ink as well. Where it lies the corners say best, once they are known.
    unread = np.argwhere(~read[v0 : v1 + 1, u0 : u1 + 1])[:, ::-1] + [u0, v0]
    unread = unread[(unread.sum(axis=1) % 2 == 0) == layout.first_white]
    ink = _quads(unread, share).reshape(-1, 2)
    known, pixels = board, markers.quads.reshape(-1, 2)
    grid = None
    for _ in range(2 if len(unread) else 1):
        more = _place(known, pixels, ink) if len(unread) else np.zeros((0, 2))
        if more is None:
            return None
        quads = np.concatenate([markers.quads, more.reshape(-1, 4, 2)])
        grid = refine(_paint(gray, quads, share), start)
        if grid is None:
            return None
        if grid.refined.sum() >= _FEWEST_CORNERS:
            known = corners.reshape(rows, columns, 2)[v0:v1, u0:u1][grid.refined]
            pixels = grid.points[grid.refined]
    assert grid is not None
    far = np.where(np.isfinite(at), np.clip(at, -1e5, 1e5), 0.0)
    part = np.s_[v0:v1, u0:u1]
    there = np.all((grid.points > -0.5) & (grid.points < [width - 0.5, height - 0.5]), axis=2)
    sure = (count[part] > 1) | (grid.sigma_px < _UNSURE * np.median(grid.sigma_px[grid.refined]))
    return _ordered(grid, beside[part] & there & sure, (int(u0), int(v0)), layout, far)


# ----------------------------------------------------------------------
# Grids of circles and grids of markers are recognised, so that they can be named; they are not read.

_CIRCLES_PIXELS = 300_000
_CIRCLES = (12, 300)
"""Round spots of a picture that may show a grid of circles."""
_FEWEST_OF_PART, _OF_SPOTS = 20, 0.9
"""Round spots that form one grid, and their share of all, that are a part of a grid of circles."""
SOME_CIRCLES = "a grid of circles"
_ROUND = 0.83
"""4 pi area / perimeter^2: of a square pi / 4, of a circle seen at 60 degrees 0.84."""
_AROUND = 8
"""Nearest spots, of which those on opposite sides are a spot's neighbours in its row and column."""
_BESIDE = 0.3
"""Distance of a spot from its place over that of its neighbour: perspective takes a tenth of it."""
_BASES = tuple(np.array(basis) for basis in ([[1, 0], [0, 1]], [[1, 1], [0, 1]], [[1, -1], [0, 1]]))
"""What two neighbours may be in columns and rows, where slanting ones are the nearer."""


def _neighbours(points: FloatArray) -> FloatArray:
    """Steps (N, 2, 2) to the next spot of a row and to that of a column; NaN where opposite spots lack."""
    apart = points[None] - points[:, None]
    order = np.argsort(np.hypot(*apart.transpose(2, 0, 1)), axis=1)[:, 1 : _AROUND + 1]
    v = np.take_along_axis(apart, order[..., None], axis=1)
    i, j = np.triu_indices(v.shape[1], 1)
    opposed = np.linalg.norm(v[:, i] + v[:, j], axis=2) < _BESIDE * np.linalg.norm(v[:, i], axis=2)
    steps = np.full((len(points), 2, 2), np.nan)
    for at, (paired, found) in enumerate(zip(v[:, i], opposed, strict=True)):
        pairs = paired[found]
        if len(pairs) == 0:
            continue
        a, lengths = pairs[0], np.linalg.norm(pairs, axis=1)
        across = np.abs(a[0] * pairs[:, 1] - a[1] * pairs[:, 0]) > 0.5 * lengths[0] * lengths
        if across.any():
            steps[at] = a, pairs[np.argmax(across)]
    return steps


def _places(points: FloatArray) -> IntArray:
    """Whole coordinates (n, 2) of the spots of the largest grid among those at `points` (N, 2)."""
    steps = _neighbours(points)
    inner = np.isfinite(steps[:, 0, 0])
    left, largest = set(np.flatnonzero(inner).tolist()), np.zeros((0, 2), dtype=np.int64)
    while left:
        first = min(left)
        places, waiting = {first: (0, 0)}, [(first, steps[first])]
        while waiting:
            at, basis = waiting.pop(0)
            for side in (*np.eye(2), *-np.eye(2)):
                step = side @ basis
                gap = np.linalg.norm(points - points[at] - step, axis=1)
                there = int(np.argmin(gap))
                if there in places or gap[there] > _BESIDE * np.linalg.norm(step):
                    continue
                places[there] = (places[at][0] + int(side[0]), places[at][1] + int(side[1]))
                waiting.append((there, _like(basis, steps[there]) if inner[there] else basis))
        left -= places.keys()
        if len(places) > len(largest):
            largest = np.array(list(places.values()))
    return largest


def _like(basis: FloatArray, steps: FloatArray) -> FloatArray:
    """Steps (2, 2), of either sign, nearest to a neighbour's basis, which stays where none is near."""
    near = np.concatenate([steps, -steps])
    chosen = near[np.argmin(np.linalg.norm(near[None] - basis[:, None], axis=2), axis=1)]
    off = np.linalg.norm(chosen - basis, axis=1) > _BESIDE * np.linalg.norm(basis, axis=1)
    return np.where(off[:, None], basis, chosen)


def _sizes(places: IntArray) -> list[tuple[str, int, int]]:
    """Grids that spots at these coordinates fill: kind, circles in a row, rows."""
    sizes, count = [], len(np.unique(places, axis=0))
    for basis in _BASES if count >= _CIRCLES[0] else ():
        straight = places @ basis
        columns, rows = sorted(np.ptp(straight, axis=0) + 1, reverse=True)
        if count == columns * rows:
            sizes.append(("symmetric", int(columns), int(rows)))
        across, along = np.ptp(straight @ [[1, 1], [1, -1]], axis=0) + 1
        for wide, rows in ((across, along), (along, across)):
            if wide % 2 == 0 and 2 * count == wide * rows:
                sizes.append(("asymmetric", int(wide // 2), int(rows)))
    return [(kind, columns, rows) for kind, columns, rows in sizes if min(columns, rows) >= 3]


def circle_grid(gray: GrayImage) -> str | None:
    """What grid of circles a picture shows, in words: with its size, or `SOME_CIRCLES` of a part of one.

    The spots say the size that OpenCV is asked for. To ask for every size took a minute for each picture
    of gravel.
    """
    small = _reduced(gray, _CIRCLES_PIXELS)
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.filterByCircularity, parameters.minCircularity = True, _ROUND
    spots = cv2.SimpleBlobDetector.create(parameters)
    some = False
    for image in (small, cv2.bitwise_not(small)):
        points = np.array([spot.pt for spot in spots.detect(image)]).reshape(-1, 2)
        if not _CIRCLES[0] <= len(points) <= _CIRCLES[1]:
            continue
        places = _places(points)
        # Spots that lie anyhow share their places.
        single = len(np.unique(places, axis=0)) == len(places)
        some = some or (single and len(places) >= max(_FEWEST_OF_PART, _OF_SPOTS * len(points)))
        for kind, columns, rows in _sizes(places):
            flag = cv2.CALIB_CB_SYMMETRIC_GRID if kind == "symmetric" else cv2.CALIB_CB_ASYMMETRIC_GRID
            if cv2.findCirclesGrid(image, (columns, rows), flags=flag, blobDetector=spots)[0]:
                return f"{'an' if kind == 'asymmetric' else 'a'} {kind} grid of circles, {columns}x{rows}"
    return SOME_CIRCLES if some else None


def other_board(gray: GrayImage) -> str | None:
    """What a picture shows that is no checkerboard; None where that is nothing known."""
    layout = recognise([gray])
    if layout is not None:
        return "a ChArUco board" if layout.kind == "charuco" else f"a grid of {layout.dictionary} markers"
    return circle_grid(gray)


def name_of(pictures: Sequence[GrayImage]) -> str | None:
    """What most of these pictures show that calib does not read; None where that is nothing known."""
    counts = Counter(grid for gray in pictures if (grid := circle_grid(gray)))
    if not counts:
        mirrored = [np.asarray(cv2.flip(gray, 1), dtype=np.uint8) for gray in pictures]
        return "a board of markers, mirrored: flip the pictures back" if recognise(mirrored) else None
    sized = [(many, grid) for grid, many in counts.items() if grid != SOME_CIRCLES]
    for many, grid in (max(sized, default=(0, "")), (counts.total(), SOME_CIRCLES)):
        if many >= max(1, len(pictures) // 3):
            return grid
    return None
