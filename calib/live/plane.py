"""The board in the plane of motion: a picture in hand, which corner is (0, 0), and where that lies.

A picture is taken (`take`) and kept in hand until a person has confirmed its corner (0, 0) and its place
(`board_file`); only then is it saved. `shown` is what a page draws.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.core.arrays import FloatArray, GrayImage
from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.live.session import Seen, Session, foremost
from calib.stages.camera.model import Board
from calib.stages.camera.plane import settle_orientation, turns_of
from calib.stages.camera.read import BoardFile

if TYPE_CHECKING:
    from calib.stages.camera.section import Camera, Plane

_AXIS_M = 0.02
_MOST_M = 10.0


@dataclass
class Flat:
    """The picture of the board in the plane that is in hand.

    Attributes
    ----------
    png : as it was taken; None where there is none.
    ends : for each corner that can be (0, 0) the corners (rows, columns, 2) in that order.
    chosen : which of them; None until a rule or a person has chosen.
    first_corner_m, angle_rad : where corner (0, 0) lies in the plane, and where the columns lead.
    """

    session: Session
    png: bytes | None = None
    ends: list[FloatArray] = field(default_factory=list)
    chosen: int | None = None
    first_corner_m: tuple[float, float] = (0.0, 0.0)
    angle_rad: float = 0.0

    def look(self, gray: GrayImage, size_px: tuple[int, int] | None = None) -> Seen:
        """What one frame shows."""
        found = self.session.found(gray, size_px)
        if isinstance(found, Seen):
            if found.code == "size":
                return found
            return Seen(None, "no board", "Lay the whole board into the plane of motion, and light on it.")
        grid, fault = found
        if fault is not None:
            return Seen(grid, *fault)
        return Seen(grid, "hold", "The board is seen. Does it lie in the plane of motion? Take the picture.")

    def take(self, gray: GrayImage, png: bytes) -> Seen:
        """Keep a whole picture in hand, where it shows the board."""
        if self.session.views and (gray.shape[1], gray.shape[0]) != self.session.size_px:
            return Seen(None, "size", "Not taken: the picture has another size than those of the camera.")
        found, _ = self.session.measured(gray)
        if found is None:
            return Seen(None, "no board", "Not taken: the board is not seen whole.")
        shape = (found.rows, found.columns, 2)
        if self.session.layout is not None:
            self.png, self.ends, self.chosen = png, [found.pixels.reshape(shape)], 0
            return Seen(self.ends[0], "taken", "Say where the board's corner (0, 0) lies, and confirm.")
        board = Board(found.columns, found.rows, 1.0)
        turns = turns_of(found.pixels, board)
        self.png, self.ends = png, [one.reshape(shape) for _, one in turns]
        try:
            turn = settle_orientation(found.pixels, board, self.angle_rad).quarter_turns
            self.chosen = [one for one, _ in turns].index(turn)
        except BadInputError:
            self.chosen = None
        return Seen(
            self.ends[0], "taken", "Click on the board's corner (0, 0), say where it lies, and confirm."
        )

    def drop(self) -> None:
        """Put the picture in hand away."""
        self.png, self.ends, self.chosen = None, [], None

    def choose(self, at_px: tuple[float, float]) -> None:
        """Take the possible corner (0, 0) that is nearest to a pixel."""
        if self.ends:
            self.chosen = int(np.argmin([np.hypot(*(one[0, 0] - at_px)) for one in self.ends]))

    def place(self, asked: dict[str, Any]) -> BoardFile:
        """What board.yaml says of the picture in hand, from numbers in mm and degrees.

        Raises `BadInputError` for what a person has not said yet, or not in numbers.
        """
        if self.png is None or self.chosen is None:
            raise BadInputError(
                "first take a picture of the board in the plane, and click on its corner (0, 0)"
            )
        x, y = (_number(asked.get(f"{axis}_mm"), f"{axis} of corner (0, 0), mm") for axis in "xy")
        angle = _number(asked.get("angle_deg"), "the angle of the columns, degrees")
        square = self.session.square_m
        if square is None:
            square = 1e-3 * _number(asked.get("square_mm"), "the side of a square, mm")
        if not 1e-4 <= square <= 1.0:
            raise BadInputError(f"the side of a square is {1e3 * square:g} mm, expected 0.1 mm to 1 m")
        self.session.square_m = square
        self.first_corner_m, self.angle_rad = (1e-3 * x, 1e-3 * y), float(np.radians(angle))
        grid, layout = self.ends[self.chosen], self.session.layout
        marked = {"first_corner_px": np.round(grid[0, 0], 1).tolist()}
        return BoardFile(
            corners=[grid.shape[1], grid.shape[0]],
            square_m=square,
            first_corner_m=list(self.first_corner_m),
            angle_rad=self.angle_rad,
            **(marked if layout is None else {"dictionary": layout.dictionary}),
        )

    def shown(self, rig: Rig) -> dict[str, Any]:
        """State for a page, as JSON takes it: the picture in hand, and the plane as far as it is known."""
        square = self.session.square_m
        return {
            "held": self.png is not None,
            "ends": [
                [np.round(one[at], 1).tolist() for at in ((0, 0), (0, -1), (-1, 0))] for one in self.ends
            ],
            "chosen": self.chosen,
            "x_mm": round(1e3 * self.first_corner_m[0], 4),
            "y_mm": round(1e3 * self.first_corner_m[1], 4),
            "angle_deg": round(float(np.degrees(self.angle_rad)), 4),
            "square_mm": None if square is None else round(1e3 * square, 5),
            "camera": rig.camera is not None,
            "result": _result(rig.plane, rig.camera, rig) if rig.plane and rig.camera else None,
        }


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e3 * _MOST_M:
        found = "" if value is None else f" is {str(value)[:40]}"
        raise BadInputError(f"{name}{found}: expected a number up to {1e3 * _MOST_M:g}")
    return float(value)


def _result(plane: Plane, camera: Camera, rig: Rig) -> dict[str, Any]:
    x0, y0, x1, y1 = rig.workspace_m
    box = plane.to_pixels([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], camera)
    axes = plane.to_pixels([[0.0, 0.0], [_AXIS_M, 0.0], [0.0, _AXIS_M]], camera)
    return {
        "verdict": plane.verdict.word,
        "reasons": [*rig.outdated(), *foremost(plane.verdict)],
        "rms_mm": plane.rms_mm,
        "sigma_mm": plane.sigma_marker_mm.get("calibration_max"),
        "axes": [None if not np.isfinite(one).all() else np.round(one, 1).tolist() for one in axes],
        "box": np.round(box, 1).tolist() if np.isfinite(box).all() else None,
    }
