"""Time of the bundle adjustment beside OpenCV's, on the same corners in the same run.

    python tests/bench/solver.py [--extended]

Medians of interleaved repetitions. Ours includes the initial guess and all standard deviations;
OpenCV's plain call has none, calibrateCameraExtended has them (some ten seconds at 400 views). mrcal, where
some Python on the machine has it, solves for an opencv4 lens from its own seed, without uncertainty; its
time is taken inside its process, once it has loaded.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from statistics import median

import _here
import cv2
import numpy as np
from _rows import Row, interleaved, peak_mib, print_rows

from calib.stages.camera.bundle import calibrate, covariance
from calib.stages.camera.model import View, pack
from synthetic import BOARD, views_of

FLAGS = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3


def _ours(views: list[View]) -> tuple[float, float]:
    fit = calibrate(pack(views), (640, 480), "radial2")
    covariance(fit)
    return fit.camera.fx_px, fit.rms_px


def _python_with_mrcal() -> str | None:
    for python in filter(None, map(shutil.which, (sys.executable, "/usr/bin/python3"))):
        if subprocess.run([python, "-c", "import mrcal"], capture_output=True, check=False).returncode == 0:
            return python
    return None


def _mrcal(python: str, views: list[View]) -> dict[str, float]:
    with tempfile.NamedTemporaryFile(suffix=".npz") as file:
        pixels = np.stack([view.pixels.reshape(BOARD.rows, BOARD.columns, 2) for view in views])
        np.savez(file, pixels=pixels, square_m=BOARD.square_m, image_size_px=(640, 480))
        file.flush()
        call = [python, str(_here.BENCH / "_mrcal.py"), file.name]
        return json.loads(subprocess.run(call, capture_output=True, check=True, text=True).stdout)


def rows(counts: Sequence[int] = (20, 100, 400), extended: bool = False) -> list[Row]:
    """Each number of views beside each peer."""
    python = _python_with_mrcal()
    board = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1).astype(np.float32)
    out = []
    for count in counts:
        views = views_of(count, 1, 0.2)
        given = (
            [board] * count,
            [v.pixels.astype(np.float32)[:, None] for v in views],
            (640, 480),
            None,
            None,
        )
        found = interleaved(
            {
                "ours": lambda views=views: _ours(views),
                "OpenCV": lambda given=given: cv2.calibrateCamera(*given, flags=FLAGS),
            },
            9 if count <= 100 else 5,
        )
        fx, rms = _ours(views)
        opencv = cv2.calibrateCamera(*given, flags=FLAGS)
        assert abs(opencv[0] - rms) < 1e-3 * rms and abs(opencv[1][0, 0] - fx) < 0.05
        job, ours = f"solve with sigma, {count} views", found["ours"]
        mib = peak_mib(lambda views=views: _ours(views))
        target = 6.0 if count >= 100 else None
        out.append(Row(job, "OpenCV, no sigma", ours, found["OpenCV"], target, mib))
        if extended and count <= 400:
            slow = interleaved(
                {"OpenCV": lambda given=given: cv2.calibrateCameraExtended(*given, flags=FLAGS)}, 1
            )
            out.append(
                Row(job, "OpenCV Extended", ours, slow["OpenCV"], 200.0 if count == 400 else None, mib)
            )
        if python is None:
            out.append(Row(job, "mrcal", ours, None, note="not installed"))
            continue
        mrcals = [_mrcal(python, views) for _ in range(3)]
        assert abs(mrcals[0]["fx_px"] / fx - 1.0) < 0.01
        out.append(Row(job, "mrcal, no sigma", ours, median(one["seconds"] for one in mrcals), None, mib))
    return out


def growth(found: Sequence[Row]) -> str:
    """How our time grows with the views."""
    ours = {int(row.job.split()[-2]): row.ours_s for row in found}
    counts = [count for count in ours if count >= 100]
    exponent = np.polyfit(np.log(counts), np.log([ours[count] for count in counts]), 1)[0]
    return f"solver: time grows as views^{exponent:.2f} from 100 views on; one core, bound by memory"


def main(extended: bool) -> None:
    """Print the table and the exponent."""
    found = rows((20, 100, 400, 1000), extended)
    print_rows(found)
    print(growth(found))


if __name__ == "__main__":
    main("--extended" in sys.argv)
