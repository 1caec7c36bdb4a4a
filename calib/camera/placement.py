"""Where the board lies in the actuator's plane, and which of its corners is the first.

The world's x axis points right and its y axis down as the camera sees them, so that the corner at
(x, y) on the board lies at

    X_W = first_corner + [[c, -s], [s, c]] (x, y),   c = cos(angle), s = sin(angle)

A checkerboard looks the same after half a turn (a square one after a quarter), or the detector does
not care. No picture can settle that, so a rule does: the turn is taken that makes the world's x axis
point to the right in the picture, unless the user says where the first corner is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.board import Board
from calib.camera.homography import fit_homography, map_jacobian
from calib.errors import BadInputError

__all__ = ["Placement", "settle_orientation", "world_points_m"]

_UNDECIDED_DEG = 0.5
"""Two turns are told apart only when the axis is at least this far from the border between them."""


@dataclass(frozen=True)
class Placement:
    """Corners of one picture in the board's own order.

    Attributes
    ----------
    pixels : (columns * rows, 2), row by row from the corner (0, 0).
    quarter_turns : by how many quarter turns, clockwise as seen, the detected order was turned.
    x_axis_deg : direction of the world's x axis in the picture at the board's centre; 0 is right,
        90 is down.
    how : one sentence that says how the orientation was settled.
    """

    pixels: FloatArray
    quarter_turns: int
    x_axis_deg: float
    how: str

    def reordered(self, values: BoolArray, board: Board) -> BoolArray:
        """Values (columns * rows,) of the detected corners in the order of `pixels`."""
        return np.rot90(values.reshape(board.rows, board.columns), self.quarter_turns).ravel()


def world_points_m(board: Board, first_corner_m: Sequence[float], angle_rad: float) -> FloatArray:
    """Inner corners in the world's plane, shape (columns * rows, 2), metres, row by row.

    Parameters
    ----------
    first_corner_m : world position of corner (0, 0).
    angle_rad : direction of the board's columns axis, from x towards y.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turned = board.points_m() @ np.array([[c, s], [-s, c]])
    return np.asarray(turned + np.asarray(first_corner_m, dtype=np.float64))


def _turned(pixels: FloatArray, board: Board) -> list[tuple[int, FloatArray]]:
    """The detected grid after 0, 1, 2, 3 quarter turns (1 and 3 on square boards only)."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    turns = range(4) if board.columns == board.rows else (0, 2)
    return [(turn, np.rot90(grid, turn).reshape(-1, 2)) for turn in turns]


def _world_x_direction(pixels: FloatArray, board: Board, angle_rad: float) -> float:
    """Direction (rad) of the world's x axis in the picture at the board's centre."""
    points = board.points_m()
    H = fit_homography(points, pixels).H
    along_board = np.array([np.cos(angle_rad), -np.sin(angle_rad)])
    du, dv = map_jacobian(H, points.mean(axis=0)) @ along_board
    return float(np.arctan2(dv, du))


def _local_square_px(pixels: FloatArray, board: Board) -> float:
    """Mean length in pixels of the two sides that meet in the first corner."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    return float(0.5 * (np.linalg.norm(grid[0, 1] - grid[0, 0]) + np.linalg.norm(grid[1, 0] - grid[0, 0])))


def _wrapped_deg(angle_rad: float) -> float:
    return float(np.degrees((angle_rad + np.pi) % (2 * np.pi) - np.pi))


def settle_orientation(
    pixels: FloatArray,
    board: Board,
    angle_rad: float,
    first_corner_px: Sequence[float] | None = None,
    name: str = "the picture",
) -> Placement:
    """Give the detected corners the board's own order, by a stated rule.

    Without `first_corner_px` the half turn (or, on a square board, the quarter turn) is chosen that
    turns the *world's* x axis most to the right in the picture, whatever `angle_rad` is and whether
    or not the colours could tell the corners apart. With it the corner (0, 0) is the one seen there,
    which must be within half a square of it.

    Parameters
    ----------
    pixels : (columns * rows, 2) detected corners, row by row, of any turn but not mirrored.
    angle_rad : direction of the board's columns axis in the world.
    first_corner_px : (u, v) of the corner (0, 0), distorted pixels.
    name : how messages call the picture.

    Raises
    ------
    BadInputError
        On a mirrored or incomplete grid, where the rule cannot decide, and where no corner that can
        be the first is near `first_corner_px`.
    """
    if pixels.shape != (board.corners, 2) or not np.all(np.isfinite(pixels)):
        raise BadInputError(
            f"{name}: expected {board.columns}x{board.rows} finite corners, got an array of shape "
            f"{pixels.shape}"
        )
    if min(board.columns, board.rows) < 2:
        raise BadInputError(
            f"{name}: a board of {board.columns}x{board.rows} inner corners shows no direction; 2x2 is the "
            "least"
        )
    points = board.points_m()
    if np.linalg.det(np.linalg.lstsq(points - points.mean(0), pixels - pixels.mean(0), rcond=None)[0]) <= 0:
        raise BadInputError(
            f"{name}: the grid of corners is mirrored; the rows axis must turn clockwise from the columns "
            "axis"
        )
    candidates = _turned(pixels, board)
    if first_corner_px is not None:
        return _settle_by_pixel(candidates, board, angle_rad, first_corner_px, name)

    directions = [_world_x_direction(turned, board, angle_rad) for _, turned in candidates]
    off = np.abs([_wrapped_deg(direction) for direction in directions])
    order = np.argsort(off)
    best = int(order[0])
    turn, chosen = candidates[best]
    degrees = _wrapped_deg(directions[best])
    if off[order[1]] - off[best] < 2 * _UNDECIDED_DEG:
        raise BadInputError(
            f"{name}: the world's x axis would point {degrees:.1f} or "
            f"{_wrapped_deg(directions[int(order[1])]):.1f} degrees "
            "from the picture's right, so the first corner cannot be told; give first_corner_px: [u, v] in "
            "board.yaml"
        )
    limit = 90 if len(candidates) == 2 else 45
    looks = "looks the same after a quarter turn" if limit == 45 else "can be read from either end"
    how = (
        f"The board {looks}; corner (0, 0) was taken at pixel ({chosen[0, 0]:.1f}, {chosen[0, 1]:.1f}), so "
        "that the world's "
        f"x axis points {_words(degrees)} in the picture (rule: right to within {limit} degrees)."
    )
    return Placement(chosen, turn, degrees, how)


def _words(degrees: float) -> str:
    if abs(degrees) < 0.05:
        return "right"
    return f"right and {abs(degrees):.1f} degrees {'down' if degrees > 0 else 'up'}"


def _settle_by_pixel(
    candidates: list[tuple[int, FloatArray]],
    board: Board,
    angle_rad: float,
    first_corner_px: Sequence[float],
    name: str,
) -> Placement:
    wanted = np.asarray(first_corner_px, dtype=np.float64)
    if wanted.shape != (2,) or not np.all(np.isfinite(wanted)):
        raise BadInputError(f"{name}: first_corner_px must be two numbers [u, v], got {first_corner_px!r}")
    distances = [float(np.linalg.norm(turned[0] - wanted)) for _, turned in candidates]
    best = int(np.argmin(distances))
    turn, chosen = candidates[best]
    limit = 0.5 * _local_square_px(chosen, board)
    if distances[best] > limit:
        seen = ", ".join(f"({turned[0, 0]:.1f}, {turned[0, 1]:.1f})" for _, turned in candidates)
        raise BadInputError(
            f"{name}: first_corner_px is [{wanted[0]:g}, {wanted[1]:g}], but the corners that can be the "
            "first are seen at "
            f"{seen}; expected one within half a square ({limit:.1f} px)"
        )
    degrees = _wrapped_deg(_world_x_direction(chosen, board, angle_rad))
    how = (
        f"Corner (0, 0) was taken at pixel ({chosen[0, 0]:.1f}, {chosen[0, 1]:.1f}), {distances[best]:.1f} "
        "px from "
        f"first_corner_px; the world's x axis points {degrees:.1f} degrees from the picture's right "
        "(positive is down)."
    )
    return Placement(chosen, turn, degrees, how)
