"""Boards found and their RMS beside OpenCV's finders, with the same solver, and error against rendered truth.

    python tests/bench/corners.py [FOLDER ...]

Folders hold pictures and a board.yaml; by default the real recordings and the shipped pictures. The model
is radial2 without skew throughout. Milliseconds are of one picture on one core, refinement included.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT / "tests"))

import cv2
import numpy as np

from calib.core.arrays import FloatArray, GrayImage
from calib.io.pictures import list_pictures, read_picture
from calib.stages.camera.bundle import calibrate
from calib.stages.camera.corners import detect
from calib.stages.camera.model import Board, Camera, View, pack
from calib.stages.camera.read import read_board_file
from calib.twin.scene import PrintedBoard, Sensor, corner_pixels, pose_facing, render

Finder = Callable[[GrayImage, int, int], FloatArray | None]


def _classic(gray: GrayImage, columns: int, rows: int) -> FloatArray | None:
    found, corners = cv2.findChessboardCorners(gray, (columns, rows))
    if not found:
        return None
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    return cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), ends).reshape(-1, 2).astype(np.float64)


def _sb(flags: int) -> Finder:
    def find(gray: GrayImage, columns: int, rows: int) -> FloatArray | None:
        found, corners = cv2.findChessboardCornersSB(gray, (columns, rows), flags=flags)
        return corners.reshape(-1, 2).astype(np.float64) if found else None

    return find


def _ours(gray: GrayImage, columns: int, rows: int) -> FloatArray | None:
    detection = detect(gray, columns, rows)
    return None if detection is None else np.where(detection.refined[:, None], detection.pixels, np.nan)


FINDERS: dict[str, Finder] = {
    "calib": _ours,
    "classic + cornerSubPix(5)": _classic,
    "SB": _sb(0),
    "SB exhaustive, accuracy": _sb(
        cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    ),
}


def _on_folder(folder: Path) -> None:
    told = read_board_file(folder)
    assert told.corners is not None
    columns, rows = told.corners
    board = Board(columns, rows, told.square_m or 1.0)
    pictures = [read_picture(path) for path in list_pictures([folder])]
    print(
        f"\n{folder.name}, {len(pictures)} pictures of {pictures[0].size_px[0]}x{pictures[0].size_px[1]} px"
    )
    print(f"{'':28}{'boards':>8}{'RMS, px':>10}{'ms':>8}")
    for name, find in FINDERS.items():
        began = time.perf_counter()
        found = [(p.name, find(p.gray, columns, rows)) for p in pictures]
        each = 1e3 * (time.perf_counter() - began) / len(pictures)
        views = [
            View(n, board.points_m(), np.nan_to_num(c), np.isfinite(c[:, 0]))
            for n, c in found
            if c is not None
        ]
        rms = calibrate(pack(views), pictures[0].size_px, "radial2").rms_px if len(views) > 2 else np.nan
        print(f"{name:28}{len(views):5d}/{len(pictures)}{rms:10.4f}{each:8.1f}")


def _turned(corners: FloatArray, truth: FloatArray) -> FloatArray:
    """The corners or their half turn, whichever is nearer to the truth."""
    return min((corners, corners[::-1]), key=lambda c: float(np.nansum((c - truth) ** 2)))


def _on_truth(width: int, height: int, count: int) -> None:
    """Corner RMSE over rendered pictures that every finder found."""
    rng = np.random.default_rng(width)
    lens = np.array([-0.22, 0.12, 0, 0, 0, 0, 0, 0.0])
    f = 0.85 * width
    camera = Camera("radial2", (width, height), f, f, 0.0, width / 2 + 3.3, height / 2 - 2.1, lens)
    printed = PrintedBoard(Board(9, 6, 0.025))
    errors: dict[str, list[float]] = {name: [] for name in FINDERS}
    boards = dict.fromkeys(FINDERS, 0)
    for seed in range(count):
        pose = pose_facing(
            camera,
            printed,
            (width * rng.uniform(0.4, 0.6), height * rng.uniform(0.4, 0.6)),
            rng.uniform(0.36, 0.6),
            tilt_rad=rng.uniform(0, 0.7),
            azimuth_rad=rng.uniform(0, 2 * np.pi),
            roll_rad=rng.uniform(-0.5, 0.5),
        )
        sensor = Sensor(
            blur_px=rng.uniform(0.5, 0.9), noise_grey=rng.uniform(1, 4), gamma=rng.uniform(1, 1.6)
        )
        gray = render(camera, printed, pose, sensor=sensor, seed=seed)
        truth = corner_pixels(camera, printed, pose)
        found = {name: find(gray, 9, 6) for name, find in FINDERS.items()}
        for name, corners in found.items():
            boards[name] += corners is not None
        if all(c is not None for c in found.values()):
            for name, corners in found.items():
                errors[name].append(float(np.nanmean(np.sum((_turned(corners, truth) - truth) ** 2, axis=1))))
    print(f"\nrendered, {count} pictures of {width}x{height} px; RMSE per coordinate over those all found")
    print(f"{'':28}{'boards':>8}{'RMSE, px':>10}")
    for name in FINDERS:
        print(f"{name:28}{boards[name]:5d}/{count}{np.sqrt(np.mean(errors[name]) / 2):10.4f}")


def main(folders: list[str]) -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    recordings = Path(os.environ.get("CALIB_SHARED_DATA", ROOT.parent / "shared" / "data"))
    usual = [recordings / "opencv_left", recordings / "gloworm_qvga", ROOT / "images"]
    for folder in [Path(name) for name in folders] or usual:
        if folder.is_dir():
            _on_folder(folder)
        else:
            print(f"\nno folder {folder.name}")
    if not folders:
        _on_truth(640, 480, 30)
        _on_truth(316, 208, 30)


if __name__ == "__main__":
    main(sys.argv[1:])
