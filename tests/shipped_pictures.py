"""The pictures shipped in `images/`, and the truth about them, `tests/truth/pictures.json`.

    python tests/shipped_pictures.py

writes both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.writing import write_atomically
from calib.twin.pictures import BOARD, CAMERA, PLANE, Shot, plane_shot, shots, write_pictures
from calib.twin.scene import PrintedBoard, corner_pixels


def _rounded(values: FloatArray, digits: int) -> Any:
    return (np.round(values, digits) + 0.0).tolist()


def _view_truth(shot: Shot) -> dict[str, Any]:
    pixels = corner_pixels(CAMERA, PrintedBoard(BOARD), shot.pose)
    return {
        "R_CB": _rounded(shot.pose.R_CB, 12),
        "t_m": _rounded(shot.pose.t_m, 12),
        "corners_px": _rounded(pixels, 6),
    }


def truth() -> dict[str, Any]:
    """What is true of the shipped pictures: camera, board, pose and corners of each view, and the plane."""
    camera = {
        "model": CAMERA.model,
        "image_size_px": list(CAMERA.image_size_px),
        "fx_px": CAMERA.fx_px,
        "fy_px": CAMERA.fy_px,
        "skew_px": CAMERA.skew_px,
        "cx_px": CAMERA.cx_px,
        "cy_px": CAMERA.cy_px,
        "distortion": CAMERA.distortion.tolist(),
    }
    lying = {
        "R_CW": _rounded(PLANE.R_CW, 12),
        "t_m": _rounded(PLANE.t_m, 12),
        "first_corner_m": list(PLANE.first_corner_m),
        "angle_rad": PLANE.angle_rad,
    }
    return {
        "board": {"corners": [BOARD.columns, BOARD.rows], "square_m": BOARD.square_m},
        "camera": camera,
        "views": {shot.path: _view_truth(shot) for shot in shots()},
        "plane": {**lying, "views": {plane_shot().path: _view_truth(plane_shot())}},
    }


def write(images: Path, known: Path) -> None:
    """Write the pictures into a folder and the truth into a file."""
    write_pictures(images, CAMERA, [*shots(), plane_shot()])
    write_atomically(known, json.dumps(truth(), indent=1) + "\n")


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parent.parent
    write(ROOT / "images", ROOT / "tests" / "truth" / "pictures.json")
