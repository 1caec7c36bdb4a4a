"""Boards found and their RMS beside OpenCV's finders, with the same solver, and error against rendered truth.

    python tests/bench/corners.py [FOLDER ...] [--truth]

Folders hold pictures and a board.yaml; by default the real recordings and the shipped pictures, and
renderings of four sizes; with --truth these alone. The model is radial2 without skew throughout.
Milliseconds are of one picture on one core, refinement included.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import _here
import cv2
import numpy as np
from outside import RECORDINGS
from scipy.special import erf

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


TRUTH = {(316, 208): 6, (640, 480): 6, (1280, 960): 4, (4000, 3000): 1}
"""Sizes of rendered pictures and how many of each kind."""
_NOISE = 2.0
"""Grey levels."""


def _rendered(
    size_px: tuple[int, int], blur_px: float, along_pixels: bool, seed: int
) -> tuple[GrayImage, FloatArray]:
    """A board of 9 x 6 corners and the truth; along the pixels to 3 degrees, or at any angle."""
    rng = np.random.default_rng([seed, size_px[0]])
    width, height = size_px
    lens = np.array([-0.22, 0.12, 0, 0, 0, 0, 0, 0.0])
    f = 0.85 * width
    camera = Camera("radial2", size_px, f, f, 0.0, width / 2 + 3.3, height / 2 - 2.1, lens)
    printed = PrintedBoard(Board(9, 6, 0.025))
    pose = pose_facing(
        camera,
        printed,
        (width * rng.uniform(0.4, 0.6), height * rng.uniform(0.4, 0.6)),
        rng.uniform(0.36, 0.55),
        tilt_rad=rng.uniform(0, 0.05 if along_pixels else 0.7),
        azimuth_rad=rng.uniform(0, 2 * np.pi),
        roll_rad=rng.uniform(-0.05, 0.05) if along_pixels else rng.uniform(-0.5, 0.5),
    )
    gray = render(camera, printed, pose, sensor=Sensor(blur_px=blur_px, noise_grey=_NOISE), seed=seed)
    return gray, corner_pixels(camera, printed, pose)


def _bound_px(truth: FloatArray, contrast: float, blur_px: float) -> float:
    """Least RMSE per coordinate, px, that an unbiased estimate of single corners (54, 2) can have.

    Cramer and Rao's, from all pixels nearer to a corner than to the next ones, of place, directions of the
    edges, blur, tones and slope of the light, against the noise and the rounding to whole grey levels.
    """
    grid = truth.reshape(6, 9, 2)
    steps = zip(*(np.gradient(grid, axis=axis).reshape(-1, 2) for axis in (1, 0)), strict=True)
    v, u = np.mgrid[-40:41, -40:41]
    variances = []
    for (u0, v0), (along, across) in zip(truth % 1.0, steps, strict=True):
        share = np.linalg.solve(np.column_stack([along, across]), np.stack([u.ravel() - u0, v.ravel() - v0]))
        at = np.abs(share).max(axis=0) < 0.5
        x, y = u.ravel()[at], v.ravel()[at]

        def shown(q: FloatArray, x: FloatArray = x, y: FloatArray = y) -> FloatArray:
            dx, dy = x - q[0], y - q[1]
            edges = (
                (dy * np.cos(q[2]) - dx * np.sin(q[2])) / q[4],
                (dx * np.sin(q[3]) - dy * np.cos(q[3])) / q[4],
            )
            return (1 + q[7] * dx + q[8] * dy) * (q[5] + q[6] * erf(edges[0]) * erf(edges[1]))

        directions = np.arctan2(along[1], along[0]), np.arctan2(across[1], across[0])
        q = np.array([u0, v0, *directions, np.sqrt(2 * (blur_px**2 + 1 / 12)), 128.0, contrast, 0.0, 0.0])
        J = [(shown(q + e) - shown(q - e)) / 2e-4 for e in 1e-4 * np.eye(9)]
        variances.append(np.diag(np.linalg.inv(np.array(J) @ np.array(J).T))[:2] * (_NOISE**2 + 1 / 12))
    return float(np.sqrt(np.mean(variances)))


def _on_truth() -> None:
    """Corner RMSE by size, blur and direction, beside the classic finder's and the bound."""
    print("\nrendered, RMSE per coordinate, px; bound: Cramer and Rao's; z: over the sigma that calib gives")
    print(f"{'':34}{'calib':>8}{'classic':>9}{'ratio':>7}{'bound':>8}{'over it':>9}{'z':>6}{'boards':>8}")
    for size_px, count in TRUTH.items():
        for blur_px in (0.3, 0.7, 1.5, 3.0):
            for along_pixels in (False, True):
                squares, theirs, sigmas, bounds, boards = [], [], [], [], 0
                for seed in range(count):
                    gray, truth = _rendered(size_px, blur_px, along_pixels, seed)
                    detection, classic = detect(gray, 9, 6), _classic(gray, 9, 6)
                    if detection is None:
                        continue
                    boards += 1
                    on = detection.refined
                    squares.append(np.mean((_turned(detection.pixels, truth) - truth)[on] ** 2))
                    sigmas.append(np.mean(detection.sigma_px[on] ** 2))
                    bounds.append(_bound_px(truth, detection.contrast, blur_px) ** 2)
                    if classic is not None:
                        theirs.append(np.mean((_turned(classic, truth) - truth) ** 2))
                ours, sigma, bound = (np.sqrt(np.mean(some)) for some in (squares, sigmas, bounds))
                peer = np.sqrt(np.mean(theirs)) if theirs else np.nan
                what = f"{size_px[0]}x{size_px[1]}, blur {blur_px}" + (
                    ", along pixels" if along_pixels else ""
                )
                numbers = f"{ours:8.4f}{peer:9.4f}{ours / peer:7.2f}{bound:8.4f}{ours / bound:9.2f}"
                print(f"{what:34}{numbers}{ours / sigma:6.2f}{boards:5d}/{count}", flush=True)


def main(folders: list[str]) -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    usual = [RECORDINGS / "opencv_left", RECORDINGS / "gloworm_qvga", _here.ROOT / "images"]
    if folders == ["--truth"]:
        _on_truth()
        return
    for folder in [Path(name) for name in folders] or usual:
        if folder.is_dir():
            _on_folder(folder)
        else:
            print(f"\nno folder {folder.name}")
    if not folders:
        _on_truth()


if __name__ == "__main__":
    main(sys.argv[1:])
