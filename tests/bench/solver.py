"""Time of the bundle adjustment beside OpenCV's, on the same corners in the same run.

    python tests/bench/solver.py [--extended]

Medians of interleaved repetitions. Ours includes the initial guess and all standard deviations;
OpenCV's plain call has none, calibrateCameraExtended has them (some ten seconds at 400 views).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np

from calib.camera.bundle import calibrate
from calib.camera.covariance import covariance
from calib.camera.views import View, pack
from synthetic import BOARD, views_of

FLAGS = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3


def _seconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def _ours(views: list[View]) -> tuple[float, float]:
    fit = calibrate(pack(views), (640, 480), "radial2")
    covariance(fit)
    return fit.camera.fx_px, fit.rms_px


def main(extended: bool) -> None:
    """Print the table and the exponent of our time in the number of views."""
    board = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1).astype(np.float32)
    print(f"{'views':>6} {'ours, ms':>9} {'OpenCV, ms':>11} {'ratio':>6} {'Extended, s':>12} {'ratio':>7}")
    counts, times = (20, 100, 400, 1000), []
    for count in counts:
        views = views_of(count, 1, 0.2)
        target = [board] * count
        pixels = [v.pixels.astype(np.float32)[:, None] for v in views]

        def plain(target: list = target, pixels: list = pixels) -> object:
            return cv2.calibrateCamera(target, pixels, (640, 480), None, None, flags=FLAGS)

        ours, theirs = [], []
        for _ in range(9 if count <= 100 else 5):
            ours.append(_seconds(lambda views=views: _ours(views)))
            theirs.append(_seconds(plain))
        fx, rms = _ours(views)
        found = plain()
        assert abs(found[0] - rms) < 1e-3 * rms and abs(found[1][0, 0] - fx) < 0.05
        times.append(median(ours))
        opencv = median(theirs)
        line = f"{count:6d} {1e3 * times[-1]:9.1f} {1e3 * opencv:11.1f} {opencv / times[-1]:6.1f}"
        if extended and count <= 400:
            slow = _seconds(
                lambda target=target, pixels=pixels: cv2.calibrateCameraExtended(
                    target, pixels, (640, 480), None, None, flags=FLAGS
                )
            )
            line += f" {slow:12.2f} {slow / times[-1]:7.0f}"
        print(line)
    exponent = np.polyfit(np.log(counts[1:]), np.log(times[1:]), 1)[0]
    print(f"our time grows as views^{exponent:.2f} from 100 views on")


if __name__ == "__main__":
    main("--extended" in sys.argv)
