"""A calibration while the camera runs: frames go in, what to do and when to take a picture comes out.

Nothing here reads, writes or serves. A frame is looked at (`Session.look`): the board's corners, whether the
board holds still, and how far it is from the pose that would lower the camera's uncertainty most
(`calib.stages.camera.checks.best_next_view`). A picture is taken (`Session.accept`) where it is sharp, bright
enough and unlike the earlier ones. A fit of the pictures so far comes back (`Session.fitted`) and moves the
next pose.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np

from calib.core.arrays import BoolArray, FloatArray, GrayImage
from calib.core.geometry import in_picture
from calib.core.verdict import Verdict
from calib.stages.camera import checks
from calib.stages.camera.bundle import poses_with_camera, projection_sigma_px
from calib.stages.camera.corners import Detection, detect, find_size, follow, reduced, resized
from calib.stages.camera.intrinsics import Intrinsics
from calib.stages.camera.lattice import find_lattices, find_saddles
from calib.stages.camera.model import Board, Camera, View, pack, project
from calib.stages.camera.read import BoardFile
from calib.stages.camera.targets import (
    Layout,
    Markers,
    detect_charuco,
    find_markers,
    in_place,
    of_size,
    other_board,
    recognise,
    sketch_charuco,
    with_rows,
)

_LOOK_PX = 800
"""Largest side of what is searched while the camera runs; larger frames are made smaller for it."""
_STILL_S = 0.4
_STILL_SHARE = 0.004
"""Corners that move less than this share of the picture's width for so long hold still."""
_BLUR_SHARE, _LEAST_BLUR_PX = 0.0035, 1.6
"""Standard deviation of an edge's blur, over the picture's width, from which on a picture is not taken."""
_CONTRAST = 12.0
"""Grey levels from the middle to white below which a board is too dark."""
_ALIKE_SHARE = 0.02
"""Distance of corners to those of an earlier picture, over the width, below which it tells little."""
_MATCH_SHARE, _MATCH_DEG = 0.07, 15.0
"""Distance of the board's outer corners from the ghost's, over the picture's diagonal, and angle between the
boards, within which they match."""
_GAIN_SHARE = 0.7
"""A pose that gains this share of what the best would is as good."""
ENOUGH = 0.05
"""Where the best next picture would lower the uncertainty by less, the work is done."""
_BEFORE = 3
"""Pictures before a fit can say which pose is next."""
_SMALL_SHARE = 0.15
"""Least diagonal of the board over that of the picture."""

_UNSEEN_S = 2.0
"""Without a board for so long, then for twice as long each time, another one is looked for: that takes up to
a second."""
_RECOGNISED_EVERY = 8
"""Frames without a board of which one is looked at for markers, which takes up to half a second."""
_FEWEST = 3
"""Columns and rows of which a picture of a ChArUco board has to show corners."""

Code = Literal["no board", "dark", "blurred", "alike", "small", "size", "move", "hold", "taken", "enough"]


@dataclass(frozen=True)
class Seen:
    """What a frame shows.

    Attributes
    ----------
    corners_px : (rows, columns, 2) in pixels of the whole picture; None where no board is seen.
    code : what `says` is about. says : one sentence of what to do.
    take : whether a picture is to be taken now.
    matched : 1 where the board is at the ghost, falling to 0 at a tenth of the picture away.
    """

    corners_px: FloatArray | None
    code: Code
    says: str
    take: bool = False
    matched: float = 0.0


@dataclass(frozen=True)
class Ghost:
    """The next pose to show.

    Attributes
    ----------
    lines_px : lines of the board's lattice, each (n, 2).
    box_px : (4, 2) outer corners, in order around. normal : (3,) of the board, in the camera's frame.
    says : one sentence. away : edge in the picture that leans away, "" without tilt.
    """

    lines_px: tuple[FloatArray, ...]
    box_px: FloatArray
    normal: FloatArray
    says: str
    away: str


@dataclass(frozen=True)
class Progress:
    """What the pictures so far make of the camera, after each fit."""

    pictures: int
    sigma_fx_px: float
    worst_sigma_px: float


@dataclass
class Session:
    """One camera, one board, the pictures so far.

    Attributes
    ----------
    corners : inner corners, columns and rows; None until a frame shows them.
    square_m : side of a square; intrinsics do not depend on it.
    dictionary : of the markers of a ChArUco board, where it was stated.
    layout : of a ChArUco board, once a frame shows it; None for a plain board.
    views : by the names of pictures, in the order in which they were taken.
    fit : of the views, as `fitted` brought it. history : one entry for each fit.
    """

    corners: tuple[int, int] | None = None
    square_m: float | None = None
    size_px: tuple[int, int] | None = None
    dictionary: str | None = None
    layout: Layout | None = None
    views: dict[str, View] = field(default_factory=dict)
    fit: Intrinsics | None = None
    history: list[Progress] = field(default_factory=list)
    _plan: checks.Plan | None = None
    _past: deque[tuple[float, FloatArray]] = field(default_factory=lambda: deque(maxlen=60))
    _before: FloatArray | None = None
    _waits: bool = False
    _sized: tuple[int, int] | None = None
    _unseen: int = 0
    _asked: tuple[float, float] | None = None
    _instead: str = ""

    # ------------------------------------------------------------------
    # Looking at a frame.

    def look(
        self, gray: GrayImage, t_s: float, size_px: tuple[int, int] | None = None, still: bool = False
    ) -> Seen:
        """What one frame shows, and whether to take it.

        Parameters
        ----------
        gray : (h, w) uint8, the picture or a smaller copy of it. t_s : when it came.
        size_px : width and height of the whole picture, where the frame is a copy.
        still : whether the frame is a picture that somebody took already, in whatever pose.
        """
        found = self.found(gray, size_px, still)
        if isinstance(found, Seen):
            self._past.clear()
            if found.code == "no board" and (says := self._other(gray, t_s, still)):
                return replace(found, says=says)
            return found
        self._asked, self._instead = None, ""
        grid, fault = found
        hold = self._holds_still(grid, t_s)
        if fault is not None:
            return Seen(grid, *fault)
        if self.enough:
            return Seen(grid, "enough", "Enough: another picture would change little. Press Done.")
        if self._alike(grid):
            return Seen(grid, "alike", f"Too like an earlier picture. {self._hint(grid)}")
        if still:
            return Seen(grid, "taken", "Good.", take=True)
        ghost = self.ghost()
        near, angle = self._near(grid, ghost), self._angle_deg(grid, ghost)
        matched = max(0.0, 1.0 - near / 0.1)
        # Of a camera that nothing is known of the outline is a guess: a long lens cannot show it.
        within = _MATCH_SHARE if self._plan is not None else 2 * _MATCH_SHARE
        good = (near < within and angle < _MATCH_DEG) or self._as_good(grid)
        if not good:
            return Seen(grid, "move", self._hint(grid), matched=matched)
        if not hold:
            return Seen(grid, "hold", "Good. Hold still.", matched=matched)
        return Seen(grid, "taken", "Good.", take=True, matched=matched)

    def found(
        self, gray: GrayImage, size_px: tuple[int, int] | None = None, still: bool = False
    ) -> tuple[FloatArray, tuple[Code, str] | None] | Seen:
        """Corners (rows, columns, 2) of the board in pixels of the whole picture, and what is wrong with it.

        Else why there are none. Parameters as for `look`.
        """
        size_px = size_px or (gray.shape[1], gray.shape[0])
        if self.size_px is not None and self.views and size_px != self.size_px:
            return Seen(None, "size", _other_size(size_px, self.size_px))
        self.size_px = size_px
        small = _reduced(gray)
        scale = size_px[0] / small.shape[1]
        board, plain = (None, small) if self.dictionary and not self.layout else self._sought_in(small)
        if board is None and self.layout is None and (still or self.dictionary or self.corners is None):
            self._unseen += 1
            if (still or self._unseen % _RECOGNISED_EVERY == 1) and self._recognised(small):
                board, plain = self._sought_in(small)
        if self.corners is None:
            return Seen(None, "no board", "Hold the whole board into the picture, with light on it.")
        if board is None or not self._shows_enough((board + 0.5) * scale - 0.5):
            return Seen(None, "no board", self._sought())
        self._unseen = 0
        return (board + 0.5) * scale - 0.5, self._fault(plain, board, scale)

    def _sought_in(self, gray: GrayImage) -> tuple[FloatArray | None, GrayImage]:
        """Corners of the board in a frame, and the frame without its markers."""
        if self.layout is not None:
            markers = self._markers(gray)
            return sketch_charuco(gray, markers, self.layout) or (None, gray)
        board = None if self._before is None else follow(gray, self._before)
        if board is None and self.corners is not None:
            board = _grid(gray, self.corners)
        # Until a picture is taken: a hand on the board makes it look smaller.
        if board is None and not self._size_settled and (size := _size_of(gray)):
            self.corners = self._sized = size
            board = _grid(gray, size)
        self._before = board
        return board, gray

    def _markers(self, gray: GrayImage) -> Markers:
        """Those of the layout's dictionary, which may show that the board has more rows than were seen."""
        assert self.layout is not None
        markers = find_markers(gray, self.layout.dictionary)
        grown = with_rows(self.layout, [in_place(markers, self.layout)[0].ids])
        if self.corners == self._sized and grown is not None and grown.rows > self.layout.rows:
            self._begin(grown)
        return markers

    def _recognised(self, gray: GrayImage) -> bool:
        """Whether a picture shows the ChArUco board that is stated, or any where nothing says otherwise."""
        if self.views and not self.dictionary and self.corners is not None:
            return False
        layout = recognise([gray], self.dictionary)
        if layout is None or layout.kind != "charuco" or layout.rows < _FEWEST:
            return False
        if self.corners is not None and self.corners != self._sized:
            self.layout = of_size(layout, self.corners)
            if self.layout is not None:
                self.corners = self.layout.columns - 1, self.layout.rows - 1
            return self.layout is not None
        self._begin(layout)
        return True

    def _begin(self, layout: Layout) -> None:
        self.layout, self.corners = layout, (layout.columns - 1, layout.rows - 1)
        self._sized = self.corners

    def _in_picture(self, grid: FloatArray) -> BoolArray:
        """Which corners (..., 2) are in the picture; of a ChArUco board not all have to be."""
        return in_picture(grid, self._size())

    def _shows_enough(self, grid: FloatArray) -> bool:
        seen = self._in_picture(grid)
        return min(int(seen.any(axis=0).sum()), int(seen.any(axis=1).sum())) >= _FEWEST

    def _moved(self, a: FloatArray, b: FloatArray) -> float:
        """Root mean square distance of the corners that both show."""
        both = self._in_picture(a) & self._in_picture(b)
        return _apart(a[both], b[both]) if both.sum() > _FEWEST else np.inf

    @property
    def _size_settled(self) -> bool:
        """Whether the board's size was stated, or a picture was taken."""
        return self.corners is not None and (self.corners != self._sized or bool(self.views))

    def _other(self, gray: GrayImage, t_s: float, still: bool) -> str:
        """What else is held into the picture, looked for now and then; "" where nothing is known."""
        since, wait = self._asked or (t_s, _UNSEEN_S)
        self._asked = since, wait
        if still or t_s - since >= wait:
            self._asked = t_s, 2.0 * wait
            self._instead = self._other_words(gray if still else _reduced(gray))
        return self._instead

    def _other_words(self, gray: GrayImage) -> str:
        if self.layout is None and self._recognised(gray):
            return ""
        size = _size_of(gray) if self.corners else None
        if size and self.corners and sorted(size) != sorted(self.corners):
            seen, expected = (f"{columns}x{rows}" for columns, rows in (size, self.corners))
            return (
                f"A board of {seen} inner corners is seen, expected {expected}: show all of that one, or "
                f"begin a new folder with --corners {seen}."
            )
        other = None if size else other_board(gray)
        if other is None:
            return ""
        wanted = "a checkerboard or a ChArUco board"
        if self.views:
            wanted = "the one of the pictures so far"
        elif self.corners:
            wanted = f"one of {self.corners[0]}x{self.corners[1]} inner corners"
        more = ", or begin a new folder" if "ChArUco" in other else ""
        return f"The picture shows {other}: show {wanted}{more}."

    def _sought(self) -> str:
        assert self.corners is not None
        columns, rows = self.corners
        board = "the whole board" if self.layout is None else "more of the ChArUco board"
        return f"Show {board} of {columns}x{rows} inner corners. {self.ghost().says}"

    def _holds_still(self, grid: FloatArray, t_s: float) -> bool:
        width = self._size()[0]
        self._past.append((t_s, grid))
        while len(self._past) > 2 and self._past[1][0] <= t_s - _STILL_S:
            self._past.popleft()
        long = t_s - self._past[0][0] >= _STILL_S
        return long and all(self._moved(grid, one) < _STILL_SHARE * width for _, one in self._past)

    def _fault(self, gray: GrayImage, grid: FloatArray, scale: float) -> tuple[Code, str] | None:
        """Why a picture is not worth taking."""
        blur_px, contrast = edges(gray, grid)
        if contrast < _CONTRAST:
            return "dark", "Too dark: more light on the board."
        width, height = self._size()
        if np.linalg.norm(np.ptp(grid, axis=(0, 1))) * scale < _SMALL_SHARE * np.hypot(width, height):
            return "small", "Too far away: bring the board closer."
        if blur_px * scale > max(_BLUR_SHARE * width, _LEAST_BLUR_PX * scale):
            return "blurred", "Blurred: hold still, or focus."
        return None

    def _alike(self, grid: FloatArray) -> str | None:
        """Name of an earlier picture that shows the board in the same place."""
        limit = _ALIKE_SHARE * self._size()[0]
        ends = range(4 if self.layout is None else 1)
        turns = [turned for k in ends if (turned := np.rot90(grid, k)).shape == grid.shape]
        for name, view in self.views.items():
            # Of a ChArUco board earlier pictures may have shown fewer rows.
            other = view.pixels[: grid.size // 2]
            if self.layout is None and other.size != grid.size:
                continue
            if min(self._moved(one.reshape(-1, 2)[: len(other)], other) for one in turns) < limit:
                return name
        return None

    # ------------------------------------------------------------------
    # Taking a picture.

    def accept(self, gray: GrayImage, name: str, by_hand: bool = False) -> View | Seen:
        """The view that a whole picture shows, which then belongs to the session; else why it is not taken.

        One that is taken by hand may be like an earlier one or blurred: who asks for it gets it.
        """
        size_px = (gray.shape[1], gray.shape[0])
        if self.views and size_px != self._size():
            return Seen(None, "size", _other_size(size_px, self._size()))
        if self.corners is None and not self.dictionary:
            self.corners = self._sized = find_size(gray, within=True)
        found, plain = self.measured(gray)
        if found is None and self.layout is None and self._recognised(gray):
            found, plain = self.measured(gray)
        if found is None:
            return Seen(None, "no board", "Not taken: the board is not seen whole.")
        self.size_px = size_px
        grid = found.pixels.reshape(found.rows, found.columns, 2)
        fault = self._fault(plain, grid, 1.0)
        if fault is not None and not by_hand:
            return Seen(grid, *fault)
        if not by_hand and (other := self._alike(grid)):
            return Seen(grid, "alike", f"Too like {other}.")
        view = View(name, self._board().points_m(), found.pixels, found.refined)
        self.views[name] = view
        self._past.clear()
        self._waits = True
        return view

    def measured(self, gray: GrayImage) -> tuple[Detection | None, GrayImage]:
        """The board in a whole picture, and the picture without its markers."""
        if self.layout is not None:
            markers = self._markers(gray)
            sketched = sketch_charuco(gray, markers, self.layout)
            return detect_charuco(gray, markers, self.layout), gray if sketched is None else sketched[1]
        if self.corners is None or self.dictionary:
            return None, gray
        return detect(gray, *self.corners), gray

    def drop(self, name: str) -> View | None:
        """Leave a picture out."""
        return self.views.pop(name, None)

    def fitted(self, fit: Intrinsics | None) -> None:
        """Take a fit of the views, from which the next pose follows; None where they make no camera."""
        self.fit, self._plan, self._waits = fit, None, False
        if fit is None:
            return
        some = fit.calibration
        if np.all(np.isfinite(some.normal)) and some.observations.views >= _BEFORE:
            self._plan = self._not_taken(checks.best_next_view(some))
        worst = projection_sigma_px(some, fit.covariance, checks.image_outline(some.camera))
        sigma = fit.covariance.sigma().get("fx_px", np.inf)
        known = worst[~np.isnan(worst)]
        largest = float(known.max()) if len(known) else np.inf
        self.history.append(Progress(some.observations.views, float(sigma), largest))

    def _not_taken(self, plan: checks.Plan | None) -> checks.Plan | None:
        """The plan less poses that a picture has; one that the fit leaves out is not in the plan's views."""
        if plan is None:
            return None
        new = [one for one in plan.candidates if self._alike(self._grid_at(plan, one)) is None]
        return replace(plan, candidates=tuple(new)) if new else plan

    @property
    def enough(self) -> bool:
        """Whether the verdict is ok and the best next picture would change little."""
        gain = self.gain
        return gain is not None and gain < ENOUGH and self.fit is not None and self.fit.verdict.ok

    @property
    def gain(self) -> float | None:
        """Share by which the best next picture would lower the uncertainty; None before there is a fit."""
        return None if self._plan is None else 1.0 - self._plan.best.remaining

    def board_file(self) -> BoardFile:
        """What is known of the board. Markers tell its size, of which the pictures may not show all yet."""
        stated: dict[str, Any] = {} if self.square_m is None else {"square_m": self.square_m}
        if self.layout is not None:
            stated["dictionary"] = self.layout.dictionary
        if self.corners is not None and (self.layout is None or self.corners != self._sized):
            stated = {"corners": list(self.corners)} | stated
        return BoardFile(**stated)

    # ------------------------------------------------------------------
    # The next pose.

    def ghost(self) -> Ghost:
        """The pose to show next; before the first fits one of a few that make a start."""
        if self._plan is not None:
            best = self._plan.best
            lean = (
                f"tilted by {best.tilt_deg:.0f} degrees, its {best.away} edge away from the camera"
                if best.away
                else "parallel to the picture"
            )
            size = "over half of the picture" if best.span_share > 0.5 else "at a third of the picture"
            says = f"Next: the board {best.where}, {lean}, {size}."
            return _drawn(self._grid_at(self._plan, best), best.R_CT, says, best.away)
        camera = self._nominal()
        away, (u, v), where = _START[len(self.views) % len(_START)]
        R = checks.tilted(35.0, away)
        width, height = camera.image_size_px
        box = np.ptp(self._board().points_m(), axis=0)
        distance = camera.fx_px * float(np.hypot(*box)) / (0.5 * np.hypot(width, height))
        ray = np.array([(u - 0.5) * width / camera.fx_px, (v - 0.5) * height / camera.fx_px, 1.0])
        says = f"Hold the board {where}, tilted, its {away} edge away from the camera."
        # As near as the outer squares let it, in an upright picture too.
        columns, rows = self.corners or _USUAL
        whole = box * [(columns + 1) / (columns - 1), (rows + 1) / (rows - 1)]
        for _ in range(20):
            edge = self._projected(camera, R, distance * ray, whole)
            if np.all((edge > 0) & (edge < [width - 1, height - 1])):
                break
            distance *= 1.1
        grid = self._projected(camera, R, distance * ray, box)
        return _drawn(grid, R, says, away)

    def _grid_at(self, plan: checks.Plan, pose: checks.Candidate) -> FloatArray:
        """Corners (rows, columns, 2) of the board in a planned pose."""
        box = np.ptp(plan.target_m, axis=0)[:2]
        return self._projected(plan.calibration.camera, pose.R_CT, pose.t_m, box)

    def _projected(self, camera: Camera, R: FloatArray, t_m: FloatArray, box_m: FloatArray) -> FloatArray:
        columns, rows = self.corners or _USUAL
        X, Y = np.meshgrid(
            np.linspace(-0.5, 0.5, columns) * box_m[0], np.linspace(-0.5, 0.5, rows) * box_m[1]
        )
        return project(camera, np.stack([X, Y, 0.0 * X], axis=-1) @ R.T + t_m)

    def _nominal(self) -> Camera:
        """A camera to begin with: 58 degrees over the width, no distortion."""
        if self.fit is not None and self.fit.calibration.observations.views >= _BEFORE:
            return self.fit.calibration.camera
        width, height = self._size()
        return Camera(
            "pinhole", (width, height), 0.9 * width, 0.9 * width, 0.0, (width - 1) / 2, (height - 1) / 2
        )

    def _pose(self, grid: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Rotation and the position of the board's middle."""
        target = self._board().points_m()
        target = target - 0.5 * target.max(axis=0)
        pixels = grid.reshape(-1, 2)
        shown = self._in_picture(pixels)
        seen = poses_with_camera(self._nominal(), pack([View("", target, pixels, shown)]))
        return (seen.R_CT[0], seen.t_CT_m[0]) if seen.posed.all() else None

    def _near(self, grid: FloatArray, ghost: Ghost) -> float:
        """Distance of the outer corners from the ghost's, over the picture's diagonal, whatever end is up."""
        box = _outer(grid)
        apart = min(_apart(np.roll(box, k, axis=0), ghost.box_px) for k in range(4))
        return apart / float(np.hypot(*self._size()))

    def _angle_deg(self, grid: FloatArray, ghost: Ghost) -> float:
        pose = self._pose(grid)
        if pose is None:
            return 180.0
        return float(np.degrees(np.arccos(np.clip(pose[0][:, 2] @ ghost.normal, -1.0, 1.0))))

    def _as_good(self, grid: FloatArray) -> bool:
        """Whether this pose, though another one, gains nearly what the best would."""
        if self._plan is None or self._waits or (pose := self._pose(grid)) is None:
            return False
        gain = 1.0 - self._plan.remaining(*pose)
        return gain > max(_GAIN_SHARE * (self.gain or 0.0), ENOUGH)

    def _hint(self, grid: FloatArray) -> str:
        """What separates the board most from the ghost."""
        ghost, size = self.ghost(), np.array(self._size(), dtype=np.float64)
        box = _outer(grid)
        off = (ghost.box_px.mean(axis=0) - box.mean(axis=0)) / size
        ratio = _diagonal(ghost.box_px) / max(_diagonal(box), 1e-9)
        if np.abs(off).max() > 0.1:
            across = "right" if off[0] > 0.07 else "left" if off[0] < -0.07 else ""
            down = "down" if off[1] > 0.07 else "up" if off[1] < -0.07 else ""
            return f"Move the board {' and '.join(word for word in (across, down) if word)} in the picture."
        if not 0.8 < ratio < 1.25:
            return "Bring the board closer." if ratio > 1 else "Move the board away."
        if self._angle_deg(grid, ghost) > _MATCH_DEG:
            return f"Tilt its {ghost.away} edge away from the camera." if ghost.away else "Hold it parallel."
        return "Turn the board as the outline shows."

    def _size(self) -> tuple[int, int]:
        return self.size_px or (640, 480)

    def _board(self) -> Board:
        return Board(*(self.corners or _USUAL), 1.0 if self.square_m is None else self.square_m)

    # ------------------------------------------------------------------
    # What a page shows.

    def shown(self) -> dict[str, Any]:
        """State for a page, as JSON takes it; pictures by name with their residuals."""
        ghost = self.ghost()
        fit, gain = self.fit, self.gain
        rms: Mapping[str, float] = {}
        why: Mapping[str, str] = {}
        if fit is not None:
            some = fit.calibration
            rms = dict(zip(some.observations.names, some.view_rms_px.tolist(), strict=True))
            why = {one.name: one.why for one in fit.left_out}
        verdict = None if fit is None else fit.verdict
        return {
            "corners": self.corners,
            "size": self._size(),
            "pictures": [
                {"name": name, "rms_px": _number(rms.get(name)), "why": why.get(name, "")}
                for name in self.views
            ],
            "coverage": self._coverage(),
            "tilts": self._tilts(),
            "history": [
                [one.pictures, _number(one.sigma_fx_px), _number(one.worst_sigma_px)] for one in self.history
            ],
            "fx_px": None if fit is None else _number(fit.calibration.camera.fx_px),
            "verdict": "none yet" if verdict is None else verdict.word,
            "reasons": [] if verdict is None else foremost(verdict),
            "gain": _number(gain),
            "enough": self.enough,
            "ghost": {
                "lines": [np.round(line, 1).tolist() for line in ghost.lines_px],
                "box": np.round(ghost.box_px, 1).tolist(),
                "says": ghost.says,
            },
        }

    def _coverage(self, columns: int = 8, rows: int = 6) -> list[list[int]]:
        """Points in each cell of the picture."""
        counts = np.zeros((rows, columns), dtype=np.int64)
        for view in self.views.values():
            at = checks.cell_of(view.counted()[1], self._size(), columns, rows)
            np.add.at(counts, at[::-1], 1)
        return [list(map(int, row)) for row in counts]

    def _tilts(self) -> list[list[float]]:
        """Lean (x, y) of each view's board in degrees: where its far side is, right and down."""
        if self.fit is None:
            return []
        # Where a step towards (x, y) leads away from the camera, the normal leans the other way.
        normals = -self.fit.calibration.block.normals
        tilt = np.degrees(np.arccos(np.clip(-normals[:, 2], -1.0, 1.0)))
        along = normals[:, :2] / np.maximum(np.linalg.norm(normals[:, :2], axis=1, keepdims=True), 1e-9)
        lean = np.round(tilt[:, None] * along, 1)
        return [list(map(float, row)) for row in lean[np.isfinite(lean).all(axis=1)]]


_USUAL = (8, 5)
_START: tuple[tuple[str, tuple[float, float], str], ...] = (
    ("right", (0.5, 0.5), "in the middle of the picture"),
    ("bottom", (0.36, 0.4), "left of the middle"),
    ("left", (0.64, 0.6), "right of the middle"),
    ("top", (0.5, 0.5), "in the middle of the picture"),
)
"""Edge that leans away, and place in the picture, of the first poses."""


def edges(gray: GrayImage, grid: FloatArray) -> tuple[float, float]:
    """Blur and contrast of a board's edges, in the worse of both directions.

    The blur is a standard deviation in pixels: an edge between neighbouring corners that is blurred by a
    Gaussian has the steepest slope step / (sqrt(2 pi) sigma). The contrast is half the step, in grey levels.

    Parameters
    ----------
    grid : (rows, columns, 2) corners; those beyond the picture do not count.
    """
    blur_px, contrast = 0.0, np.inf
    seen = in_picture(grid, (gray.shape[1], gray.shape[0]))
    for before, after in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = seen[before] & seen[after]
        if not both.any():
            continue
        a, b = grid[before][both], grid[after][both]
        along, middle = b - a, 0.5 * (a + b)
        length = np.linalg.norm(along, axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        at = np.linspace(-0.4, 0.4, 41) * float(np.median(length))
        where = (middle[:, None] + at[:, None] * across[:, None]).astype(np.float32)
        profile = cv2.remap(gray, where[..., 0], where[..., 1], cv2.INTER_LINEAR).astype(np.float64)
        step = np.abs(profile[:, -5:].mean(axis=1) - profile[:, :5].mean(axis=1))
        # Over a pixel or more, so that noise and the sampling do not look steep.
        k = max(1, round(1.0 / (at[1] - at[0])))
        slope = np.abs(profile[:, k:] - profile[:, :-k]).max(axis=1) / (k * (at[1] - at[0]))
        blur_px = max(blur_px, float(np.median(step / np.maximum(slope, 1e-9))) / float(np.sqrt(2 * np.pi)))
        contrast = min(contrast, 0.5 * float(np.median(step)))
    return blur_px, contrast


def _grid(gray: GrayImage, corners: tuple[int, int]) -> FloatArray | None:
    """Corners (rows, columns, 2) of a board of this size."""
    found = detect(gray, *corners, quick=True)
    return None if found is None else found.pixels.reshape(found.rows, found.columns, 2)


def _size_of(gray: GrayImage) -> tuple[int, int] | None:
    """Inner corners of a board of unknown size, looked for only where there is some lattice."""
    some = find_lattices(find_saddles(reduced(gray, 120_000).image), least=9)
    return find_size(gray, within=True) if some else None


def _reduced(gray: GrayImage) -> GrayImage:
    """What is searched of a frame."""
    n = 1
    while max(gray.shape) / n > _LOOK_PX:
        n += 1
    return resized(gray, 1.0 / n).image


def _other_size(size_px: tuple[int, int], expected_px: tuple[int, int]) -> str:
    return (
        f"The camera sends {size_px[0]}x{size_px[1]} px, the pictures so far have "
        f"{expected_px[0]}x{expected_px[1]} px: choose that size, or begin a new folder."
    )


def _apart(a: FloatArray, b: FloatArray) -> float:
    """Root mean square distance of points (..., 2)."""
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1))))


def _drawn(grid: FloatArray, R: FloatArray, says: str, away: str) -> Ghost:
    return Ghost((*grid, *grid.transpose(1, 0, 2)), _outer(grid), R[:, 2], says, away)


def _outer(grid: FloatArray) -> FloatArray:
    return np.asarray(grid[[0, 0, -1, -1], [0, -1, -1, 0]])


def _diagonal(box: FloatArray) -> float:
    return float(np.linalg.norm(box[2] - box[0]) + np.linalg.norm(box[3] - box[1]))


def foremost(verdict: Verdict) -> list[str]:
    """The sentences of a verdict that a page has room for."""
    return [*verdict.reasons[:3], *([] if verdict.ok else verdict.advice[:1])]


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
