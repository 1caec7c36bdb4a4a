"""Time of the bundle adjustment beside OpenCV's, on the same corners in the same run.

    python tests/bench/solver.py [--extended]

Medians of interleaved repetitions. Ours includes the initial guess and all standard deviations;
OpenCV's plain call has none, calibrateCameraExtended has them (some ten seconds at 400 views). mrcal, where
some Python on the machine has it, solves for an opencv4 lens from its own seed, without uncertainty; its
time is taken inside its process, once it has loaded.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
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


def _python_with_mrcal() -> str | None:
    for python in (sys.executable, "/usr/bin/python3"):
        try:
            if (
                subprocess.run([python, "-c", "import mrcal"], capture_output=True, check=False).returncode
                == 0
            ):
                return python
        except OSError:
            continue
    return None


def _mrcal(python: str, views: list[View]) -> dict[str, float]:
    with tempfile.NamedTemporaryFile(suffix=".npz") as file:
        pixels = np.stack([view.pixels.reshape(BOARD.rows, BOARD.columns, 2) for view in views])
        np.savez(file, pixels=pixels, square_m=BOARD.square_m, image_size_px=(640, 480))
        file.flush()
        script = Path(__file__).with_name("_mrcal.py")
        call = [python, str(script), file.name]
        return json.loads(subprocess.run(call, capture_output=True, check=True, text=True).stdout)


def main(extended: bool) -> None:
    """Print the table and the exponent of our time in the number of views."""
    python = _python_with_mrcal()
    board = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1).astype(np.float32)
    print(
        f"{'views':>6} {'ours, ms':>9} {'OpenCV, ms':>11} {'ratio':>6} {'mrcal, ms':>10} {'ratio':>6}", end=""
    )
    print(f" {'Extended, s':>12} {'ratio':>7}" if extended else "")
    counts, times = (20, 100, 400, 1000), []
    for count in counts:
        views = views_of(count, 1, 0.2)
        target = [board] * count
        pixels = [v.pixels.astype(np.float32)[:, None] for v in views]

        def plain(target: list = target, pixels: list = pixels) -> object:
            return cv2.calibrateCamera(target, pixels, (640, 480), None, None, flags=FLAGS)

        ours, theirs, mrcals = [], [], []
        for _ in range(9 if count <= 100 else 5):
            ours.append(_seconds(lambda views=views: _ours(views)))
            theirs.append(_seconds(plain))
            if python is not None and len(mrcals) < 3:
                mrcals.append(_mrcal(python, views))
        fx, rms = _ours(views)
        found = plain()
        assert abs(found[0] - rms) < 1e-3 * rms and abs(found[1][0, 0] - fx) < 0.05
        times.append(median(ours))
        opencv = median(theirs)
        line = f"{count:6d} {1e3 * times[-1]:9.1f} {1e3 * opencv:11.1f} {opencv / times[-1]:6.1f}"
        if mrcals:
            seconds = median(one["seconds"] for one in mrcals)
            assert abs(mrcals[0]["fx_px"] / fx - 1.0) < 0.01
            line += f" {1e3 * seconds:10.1f} {seconds / times[-1]:6.1f}"
        else:
            line += f" {'not here':>10} {'':6}"
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
