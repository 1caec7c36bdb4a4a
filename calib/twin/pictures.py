"""The pictures shipped in `images/`: seventeen views of the thesis's board and one in the actuator's plane.

`calib simulate rig` writes them, byte for byte the same everywhere. The camera is a stand-in for the
thesis's Pixy2: its picture size and distortion coefficients are printed there (2.2.2, B), its intrinsics are
not, so a field of view of 60 degrees is assumed.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray, GrayImage
from calib.core.writing import write_atomically
from calib.stages.camera.model import Board, Camera
from calib.twin.scene import Light, Pose, PrintedBoard, Sensor, pose_facing, render, rotation

CAMERA = Camera(
    model="radial2",
    image_size_px=(316, 208),
    fx_px=273.4,
    fy_px=272.6,
    skew_px=0.0,
    cx_px=160.7,
    cy_px=101.9,
    distortion=np.array([-0.2201, 0.5494, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
)

BOARD = Board(columns=7, rows=5, square_m=0.020)

VIEWS: tuple[tuple[float, float, float, float, float, float], ...] = (
    (158.0, 104.0, 0.250, 3.0, 40.0, 2.0),
    (118.0, 86.0, 0.268, 24.0, 175.0, -4.0),
    (202.0, 84.0, 0.272, 28.0, 5.0, 6.0),
    (110.0, 126.0, 0.275, 22.0, 120.0, 9.0),
    (208.0, 124.0, 0.265, 25.0, -60.0, -7.0),
    (152.0, 100.0, 0.232, 38.0, 92.0, 1.0),
    (166.0, 108.0, 0.240, 41.0, -88.0, -3.0),
    (92.0, 104.0, 0.280, 36.0, 190.0, 14.0),
    (228.0, 100.0, 0.285, 39.0, -12.0, -11.0),
    (160.0, 76.0, 0.310, 18.0, -140.0, 24.0),
    (154.0, 132.0, 0.315, 30.0, 55.0, -22.0),
    (84.0, 58.0, 0.375, 33.0, -35.0, 5.0),
    (231.0, 57.0, 0.370, 34.0, 215.0, -3.0),
    (82.0, 148.0, 0.380, 29.0, 35.0, -6.0),
    (234.0, 147.0, 0.375, 31.0, 150.0, 4.0),
    (168.0, 98.0, 0.370, 44.0, 20.0, 38.0),
    (146.0, 106.0, 0.218, 10.0, -110.0, -1.0),
)
"""Pixel (u, v) of the board's middle, its depth in metres, then tilt, azimuth and roll in degrees."""


@dataclass(frozen=True)
class Plane:
    """The actuator's plane z = 0 of the world as the camera sees it, and the board that lies in it.

    Attributes
    ----------
    R_CW, t_m : world to camera, (3, 3) and (3,) metres; x right, y down in the picture, z away.
    first_corner_m : world position (x, y) of the board's corner (0, 0).
    angle_rad : direction of the board's columns axis in the plane.
    """

    R_CW: FloatArray
    t_m: FloatArray
    first_corner_m: tuple[float, float]
    angle_rad: float

    @property
    def board_pose(self) -> Pose:
        """The board in the camera's frame."""
        R_WB, (x, y) = rotation(0.0, 0.0, self.angle_rad), self.first_corner_m
        R = self.R_CW
        turned = [[sum(float(R[i, k] * R_WB[k, j]) for k in range(3)) for j in range(3)] for i in range(3)]
        return Pose(np.array(turned), R[:, 0] * x + R[:, 1] * y + self.t_m)


PLANE = Plane(
    R_CW=rotation(math.radians(4.0), math.radians(70.0), math.radians(-1.5)),
    t_m=np.array([0.004, -0.061, 0.272]),
    first_corner_m=(-0.058, 0.022),
    angle_rad=0.05,
)


@dataclass(frozen=True)
class Shot:
    """One picture to take: its path under the folder, the board's pose, the light and the seed."""

    path: str
    pose: Pose
    light: Light
    sensor: Sensor
    seed: int


def _light(index: int) -> Light:
    """A window that wanders around the rig from one picture to the next."""
    turn = 2.4 * index
    return Light(
        level=0.80 + 0.05 * math.cos(1.7 * index),
        gradient=(0.14 * math.cos(turn), 0.10 * math.sin(turn)),
        spot=0.10,
        spot_at=(0.6 * math.cos(turn + 0.7), 0.5 * math.sin(turn + 0.7)),
        spot_radius=0.45,
        vignetting=0.30,
        shadow=0.35,
    )


def shots(camera: Camera = CAMERA) -> list[Shot]:
    """The seventeen views, in order; before another camera the board fills the same part of the picture."""
    wide, high = (own / ours for own, ours in zip(camera.image_size_px, CAMERA.image_size_px, strict=True))
    farther = min(camera.fx_px / (CAMERA.fx_px * wide), camera.fy_px / (CAMERA.fy_px * high))
    taken = []
    for index, (u, v, depth_m, *degrees) in enumerate(VIEWS, start=1):
        tilt, azimuth, roll = (math.radians(value) for value in degrees)
        at, printed = (u * wide, v * high), PrintedBoard(BOARD)
        pose = pose_facing(camera, printed, at, depth_m * farther, tilt, azimuth, roll)
        sensor = Sensor(blur_px=0.62 + 0.04 * (index % 5), noise_grey=2.0, gamma=1.5)
        taken.append(Shot(f"view{index:02d}.png", pose, _light(index), sensor, seed=1000 + 10 * index))
    return taken


def plane_shot(plane: Plane = PLANE) -> Shot:
    """The board lying in the actuator's plane."""
    return Shot("plane/plane01.png", plane.board_pose, _light(0), Sensor(blur_px=0.7, gamma=1.5), seed=2000)


def png_bytes(image: GrayImage) -> bytes:
    """PNG of an 8-bit grey picture (height, width), stored without compression.

    What a compressor writes depends on its version and on the processor; stored blocks do not.
    """
    height, width = image.shape
    rows = b"".join(b"\0" + row.tobytes() for row in np.ascontiguousarray(image, dtype=np.uint8))
    stream = [b"\x78\x01"]
    for start in range(0, len(rows), 0xFFFF):
        block = rows[start : start + 0xFFFF]
        last = start + len(block) == len(rows)
        stream.append(struct.pack("<BHH", last, len(block), len(block) ^ 0xFFFF) + block)
    stream.append(struct.pack(">I", zlib.adler32(rows)))

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"".join(stream)) + chunk(b"IEND", b"")
    )


def write_pictures(folder: Path, camera: Camera, taken: Sequence[Shot]) -> None:
    """Write pictures and the board.yaml files of a folder and of its folder `plane`."""
    (folder / "plane").mkdir(parents=True, exist_ok=True)
    for shot in taken:
        image = render(
            camera, PrintedBoard(BOARD), shot.pose, light=shot.light, sensor=shot.sensor, seed=shot.seed
        )
        write_atomically(folder / shot.path, png_bytes(image))
    board = f"corners: [{BOARD.columns}, {BOARD.rows}]\nsquare_m: {BOARD.square_m:.3f}\nsimulated: true\n"
    x, y = PLANE.first_corner_m
    place = f"first_corner_m: [{x:.3f}, {y:.3f}]\nangle_rad: {PLANE.angle_rad:.2f}\n"
    write_atomically(folder / "board.yaml", board)
    write_atomically(folder / "plane" / "board.yaml", board + place)
