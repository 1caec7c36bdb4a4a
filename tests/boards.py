"""Rendered pictures of any flat drawing, as of OpenCV's boards, under a known camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calib.core.arrays import FloatArray, GrayImage
from calib.stages.camera.model import Camera, project, undistort

CAMERA = Camera(
    "radial2", (640, 480), 530.0, 532.0, 0.0, 325.0, 236.0, np.array([-0.25, 0.1, 0, 0, 0, 0, 0, 0.0])
)
_FINE = 3
"""Samples of a pixel to each side."""
_SQUARE = 96
"""Pixels of the drawing to a square."""
_RAYS: dict[int, FloatArray] = {}


@dataclass(frozen=True)
class Drawing:
    """A drawing of `columns` x `rows` squares, and OpenCV's board of it if it has one."""

    image: GrayImage
    columns: int
    rows: int
    board: cv2.aruco.CharucoBoard | None = None


def charuco(columns: int, rows: int, dictionary: int, share: float, legacy: bool = False) -> Drawing:
    """OpenCV's own drawing of a ChArUco board."""
    markers = cv2.aruco.getPredefinedDictionary(dictionary)
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, share, markers)
    board.setLegacyPattern(legacy)
    image = board.generateImage((columns * _SQUARE, rows * _SQUARE), marginSize=0, borderBits=1)
    return Drawing(np.asarray(image), columns, rows, board)


def pose(
    drawing: Drawing, seed: int, fill: float = 0.9, shift: float = 0.35
) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation (in squares) of a tilted, turned board about the picture's middle."""
    rng = np.random.default_rng(seed)
    tilt, roll = rng.uniform(-0.6, 0.6, 2), rng.uniform(-np.pi, np.pi)
    R = cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    width, height = CAMERA.image_size_px
    depth = CAMERA.fx_px * max(drawing.columns, drawing.rows) / width / fill
    aside = rng.uniform(-shift, shift, 2) * np.array([width, height]) / CAMERA.fx_px * depth
    middle = 0.5 * np.array([drawing.columns, drawing.rows, 0.0])
    return R, np.array([*aside, depth]) - R @ middle


def render(
    drawing: Drawing, R: FloatArray, t: FloatArray, blur_px: float = 0.7, noise: float = 2.0, seed: int = 0
) -> GrayImage:
    """The picture, brighter to the right, with the pixels' aperture, blur and noise."""
    width, height = CAMERA.image_size_px
    if not _RAYS:
        offset = (np.arange(_FINE) + 0.5) / _FINE - 0.5
        u, v = np.meshgrid(*((np.arange(n)[:, None] + offset).ravel() for n in (width, height)))
        _RAYS[0] = undistort(CAMERA, np.stack([u, v], axis=-1), 8)
    rays = np.concatenate([_RAYS[0], np.ones((*_RAYS[0].shape[:2], 1))], axis=-1)
    on_board = (rays * ((R[:, 2] @ t) / (rays @ R[:, 2]))[..., None] - t) @ R
    x, y = ((on_board[..., k] + 1.0) * _SQUARE - 0.5 for k in (0, 1))
    paper = cv2.copyMakeBorder(drawing.image, *[_SQUARE] * 4, cv2.BORDER_CONSTANT, value=255)
    fine = cv2.remap(
        paper, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT,
        borderValue=90,
    )  # fmt: skip
    grey = cv2.GaussianBlur(20.0 + fine.astype(np.float32) * 0.75, (0, 0), blur_px * _FINE)
    grey = grey.reshape(height, _FINE, width, _FINE).mean(axis=(1, 3)) * np.linspace(0.85, 1.15, width)
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(grey + noise * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8)


def inner_corners(drawing: Drawing, R: FloatArray, t: FloatArray) -> FloatArray:
    """True pixels of the inner corners, row by row."""
    j, i = np.mgrid[1 : drawing.rows, 1 : drawing.columns]
    points = np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=1)
    return project(CAMERA, points @ R.T + t)
