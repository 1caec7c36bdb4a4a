"""Made-up views of a board with a known camera, for tests of the solver."""

from __future__ import annotations

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.camera.bundle import rotation_exp
from calib.stages.camera.model import Board, Camera, View, project

CAMERA = Camera(
    "radial2", (640, 480), 530.0, 532.0, 0.0, 325.0, 236.0, np.array([-0.25, 0.1, 0, 0, 0, 0, 0, 0.0])
)
BOARD = Board(9, 6, 0.025)


def views_of(
    count: int,
    seed: int = 0,
    noise_px: float = 0.0,
    camera: Camera = CAMERA,
    board: Board = BOARD,
    tilt_rad: float = 0.7,
    points_m: FloatArray | None = None,
) -> list[View]:
    """Views with tilts up to `tilt_rad` about both axes, wholly inside the picture.

    Distances keep the board between a third and the whole of the picture's width.
    """
    rng = np.random.default_rng(seed)
    target = board.points_m() if points_m is None else points_m
    flat = np.concatenate([target - target.mean(axis=0), np.zeros((len(target), 1))], axis=1)
    width, height = camera.image_size_px
    near = camera.fx_px * float(np.ptp(target[:, 0])) / width
    views: list[View] = []
    while len(views) < count:
        tilt = rng.uniform(-tilt_rad, tilt_rad, 2)
        R = (
            rotation_exp(np.array([[tilt[0], 0, 0]]))[0]
            @ rotation_exp(np.array([[0, tilt[1], 0]]))[0]
            @ rotation_exp(np.array([[0, 0, rng.uniform(-0.5, 0.5)]]))[0]
        )
        depth = near * rng.uniform(1.2, 3.0)
        t = np.array([*(rng.uniform(-0.5, 0.5, 2) * depth * np.array([width, height]) / camera.fx_px), depth])
        points_C = flat @ R.T + t
        if points_C[:, 2].min() < 0.3 * depth:
            continue
        pixels = project(camera, points_C)
        if pixels.min() < 0 or pixels[:, 0].max() > width - 1 or pixels[:, 1].max() > height - 1:
            continue
        noisy = pixels + noise_px * rng.standard_normal(pixels.shape)
        views.append(View(f"view{len(views) + 1:02d}", target, noisy))
    return views
