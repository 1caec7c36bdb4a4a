"""Five hundred calibrations of simulated views on all processors, beside a loop over OpenCV.

    python tests/bench/monte_carlo.py

Twenty views of 54 points with 0.2 px of noise; ours with all standard deviations, OpenCV's without. OpenCV's
loop runs on a part of the sets, with its own threads; its time is taken for all.
"""

from __future__ import annotations

import time

import _here  # noqa: F401
import cv2
import numpy as np
from _rows import Row, print_rows

from calib.core.workers import Workers
from calib.stages.camera.bundle import calibrate, covariance
from calib.stages.camera.model import View, pack
from synthetic import BOARD, views_of

FLAGS = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
SETS, PART, VIEWS = 500, 50, 20


def _one(sets: list[list[View]], i: int) -> tuple[float, float]:
    fit = calibrate(pack(sets[i]), (640, 480), "radial2")
    return fit.camera.fx_px, covariance(fit).sigma()["fx_px"]


def _ours(sets: list[list[View]]) -> list[tuple[float, float]]:
    with Workers(sets, len(sets)) as workers:
        return list(workers.in_order(_one, range(len(sets))))


def _theirs(sets: list[list[View]]) -> list[float]:
    board = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1).astype(np.float32)
    found = []
    for views in sets:
        pixels = [v.pixels.astype(np.float32)[:, None] for v in views]
        found.append(
            cv2.calibrateCamera([board] * VIEWS, pixels, (640, 480), None, None, flags=FLAGS)[1][0, 0]
        )
    return found


def rows() -> list[Row]:
    """One row."""
    sets = [views_of(VIEWS, seed, 0.2) for seed in range(SETS)]
    _ours(sets[:4])
    times: dict[str, list[float]] = {"ours": [], "theirs": []}
    for part in range(3):
        some = sets[part * PART : (part + 1) * PART]
        began = time.perf_counter()
        theirs = _theirs(some)
        times["theirs"].append((time.perf_counter() - began) * SETS / PART)
        began = time.perf_counter()
        ours = _ours(sets)
        times["ours"].append(time.perf_counter() - began)
        mine = np.array([fx for fx, _ in ours[part * PART : (part + 1) * PART]])
        assert np.abs(mine - theirs).max() < 0.05
    fx, sigma = np.array(ours).T
    note = f"spread of fx over its sigma {fx.std(ddof=1) / np.median(sigma):.2f}"
    found = {name: float(np.median(seconds)) for name, seconds in times.items()}
    return [
        Row(
            f"Monte Carlo of {SETS} calibrations",
            "OpenCV loop",
            found["ours"],
            found["theirs"],
            5.0,
            note=note,
        )
    ]


if __name__ == "__main__":
    print_rows(rows())
