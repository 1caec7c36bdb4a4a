"""The printed sheet in front of a camera: its pose, where rays meet it, and what colour it has there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.board import Board
from calib.camera.model import Camera, project, undistort
from calib.errors import BadInputError

__all__ = [
    "Pose",
    "PrintedBoard",
    "board_coordinates",
    "corner_pixels",
    "pose_facing",
    "rotation",
    "shadow",
    "tones",
]


@dataclass(frozen=True)
class Pose:
    """Board to camera: p_C = R_CB p_B + t_m, with the board's origin in its corner (0, 0).

    Attributes
    ----------
    R_CB : (3, 3) rotation.
    t_m : (3,) corner (0, 0) in the camera's frame, metres.
    """

    R_CB: FloatArray
    t_m: FloatArray


@dataclass(frozen=True)
class PrintedBoard:
    """The sheet as it really is, which may differ from the board that a user believes in.

    Attributes
    ----------
    board : corners and the width of a square.
    aspect : height of a square over its width.
    bow_m : deflection away from the camera, along columns and along rows, metres: a parabola that
        is zero at the outermost inner corners and `bow_m` half-way between them.
    margin_squares : width of the white margin, in squares.
    paper, ink : reflectances.
    """

    board: Board
    aspect: float = 1.0
    bow_m: tuple[float, float] = (0.0, 0.0)
    margin_squares: float = 1.0
    paper: float = 0.82
    ink: float = 0.07

    @property
    def pitch_m(self) -> tuple[float, float]:
        """Distance of neighbouring corners along columns and rows, metres."""
        return self.board.square_m, self.board.square_m * self.aspect

    @property
    def centre_m(self) -> FloatArray:
        """Middle of the board before it is bent, shape (3,), metres."""
        px, py = self.pitch_m
        return np.array([0.5 * (self.board.columns - 1) * px, 0.5 * (self.board.rows - 1) * py, 0.0])

    def depth_m(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Bow z(x, y) and its slopes along x and y, metres and dimensionless."""
        z, slopes = np.zeros_like(x_m), []
        for value, bow, middle in zip((x_m, y_m), self.bow_m, self.centre_m, strict=False):
            half = max(float(middle), 1e-9)
            ratio = (value - middle) / half
            z = z + bow * (1.0 - ratio * ratio)
            slopes.append(-2.0 * bow * ratio / half)
        return z, slopes[0], slopes[1]

    def points_m(self) -> FloatArray:
        """Inner corners on the bent sheet, shape (columns * rows, 3), metres, in the order of `Board`."""
        flat = self.board.points_m() * np.array([1.0, self.aspect])
        z, _, _ = self.depth_m(flat[:, 0], flat[:, 1])
        return np.column_stack([flat, z])


def rotation(tilt_rad: float, azimuth_rad: float = 0.0, roll_rad: float = 0.0) -> FloatArray:
    """R_CB of a board that is rolled in its plane and then tilted, shape (3, 3).

    The tilt pushes the side that lies in the direction `azimuth_rad` (0 right, pi/2 down) away from
    the camera. Zero everywhere is a board parallel to the picture.
    """
    ca, sa = math.cos(azimuth_rad), math.sin(azimuth_rad)
    ct, st = math.cos(tilt_rad), math.sin(tilt_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    # Rodrigues about (sin a, -cos a, 0); written out because a matrix product may differ by an ulp.
    tilted = (
        (ct * ca * ca + sa * sa, (ct - 1.0) * ca * sa, -st * ca),
        ((ct - 1.0) * ca * sa, ct * sa * sa + ca * ca, -st * sa),
        (st * ca, st * sa, ct),
    )
    return np.array([[a * cr + b * sr, b * cr - a * sr, c] for a, b, c in tilted])


def pose_facing(
    camera: Camera,
    printed: PrintedBoard,
    pixel: tuple[float, float],
    distance_m: float,
    tilt_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    roll_rad: float = 0.0,
) -> Pose:
    """Pose whose board has its middle at `pixel` and at depth Z = `distance_m`, turned as in `rotation`.

    Raises
    ------
    BadInputError : no ray of the camera ends at this pixel.
    """
    ray = undistort(camera, np.array(pixel, dtype=np.float64))
    if not np.all(np.isfinite(ray)):
        raise BadInputError(f"pixel {pixel} is beyond the fold of the camera's distortion")
    R = rotation(tilt_rad, azimuth_rad, roll_rad)
    cx, cy, _ = (float(value) for value in printed.centre_m)
    at = (float(ray[0]) * distance_m, float(ray[1]) * distance_m, distance_m)
    return Pose(R, np.array([at[k] - (R[k, 0] * cx + R[k, 1] * cy) for k in range(3)]))


def corner_pixels(camera: Camera, printed: PrintedBoard, pose: Pose) -> FloatArray:
    """True pixels of the inner corners, shape (columns * rows, 2), in the order of `Board.points_m`."""
    return project(camera, printed.points_m() @ pose.R_CB.T + pose.t_m)


def board_coordinates(printed: PrintedBoard, pose: Pose, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where rays (..., 2) meet the sheet: (X, Y) in metres, NaN where they miss it or see its back."""
    x, y = rays[..., 0], rays[..., 1]
    R = [[float(value) for value in row] for row in pose.R_CB]
    t = [float(value) for value in pose.t_m]
    origin = [-(R[0][k] * t[0] + R[1][k] * t[1] + R[2][k] * t[2]) for k in range(3)]
    dx, dy, dz = (R[0][k] * x + R[1][k] * y + R[2][k] for k in range(3))
    with np.errstate(all="ignore"):
        depth = -origin[2] / dz
        bx, by = origin[0] + depth * dx, origin[1] + depth * dy
        if printed.bow_m != (0.0, 0.0):
            # Newton on the ray's depth; a parabola this flat needs three or four steps.
            for _ in range(8):
                z, zx, zy = printed.depth_m(bx, by)
                depth = depth - (origin[2] + depth * dz - z) / (dz - zx * dx - zy * dy)
                bx, by = origin[0] + depth * dx, origin[1] + depth * dy
        far = 3.0 * max(printed.board.columns + 2, printed.board.rows + 2) * max(printed.pitch_m)
        seen = (dz > 0.0) & (depth > 0.0) & (np.abs(bx) < far) & (np.abs(by) < far)
    return np.where(seen, bx, np.nan), np.where(seen, by, np.nan)


def _coverage(
    printed: PrintedBoard, coordinate: FloatArray, ramp: FloatArray, axis: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along one axis: alternating sign of the squares, share inside the squares, share inside the sheet."""
    pitch = printed.pitch_m[axis]
    last = (printed.board.columns, printed.board.rows)[axis]
    t = coordinate / pitch
    slope = pitch / ramp
    # The outermost squares have no neighbour, so their colour does not change again.
    wave = np.clip(t, -0.5, last - 0.5) + 0.5
    wave -= 2.0 * np.floor(0.5 * wave)
    sign = np.clip((2.0 * np.abs(wave - 1.0) - 1.0) * slope, -1.0, 1.0)
    beyond = (np.abs(t - 0.5 * (last - 1)) - 0.5 * (last + 1)) * slope - 0.5
    inside = np.clip(-beyond, 0.0, 1.0)
    sheet = np.clip(printed.margin_squares * slope - beyond, 0.0, 1.0)
    return sign, inside, sheet


def tones(
    printed: PrintedBoard, bx: FloatArray, by: FloatArray, ramp_x: FloatArray, ramp_y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Shares of ink and of sheet at board coordinates, any shape, each in [0, 1], both 0 off the sheet.

    Parameters
    ----------
    bx, by : board coordinates, metres, NaN off the board's plane.
    ramp_x, ramp_y : widths over which an edge along each axis goes from 0 to 1, metres.
    """
    sign_x, inside_x, sheet_x = _coverage(printed, bx, ramp_x, 0)
    sign_y, inside_y, sheet_y = _coverage(printed, by, ramp_y, 1)
    sheet = sheet_x * sheet_y
    ink = inside_x * inside_y * (0.5 + 0.5 * sign_x * sign_y)
    seen = np.isfinite(sheet)
    return np.where(seen, ink, 0.0), np.where(seen, sheet, 0.0)


def shadow(printed: PrintedBoard, bx: FloatArray, by: FloatArray) -> FloatArray:
    """Soft shadow around the sheet, in [0, 1], falling to the lower right."""
    px, py = printed.pitch_m
    half_x = (0.5 * (printed.board.columns + 1) + printed.margin_squares) * px
    half_y = (0.5 * (printed.board.rows + 1) + printed.margin_squares) * py
    mx, my, _ = (float(value) for value in printed.centre_m)
    outside = np.maximum(np.abs(bx - mx - 0.15 * px) - half_x, np.abs(by - my - 0.15 * py) - half_y)
    return np.where(np.isfinite(outside), np.clip(0.5 - outside / (0.8 * px), 0.0, 1.0), 0.0)
