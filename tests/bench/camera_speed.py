"""Processor time and memory of `calib intrinsics` over those of the usual OpenCV script.

    python tests/bench/camera_speed.py [FOLDER or COUNTxWIDTHxHEIGHT ...] [--repeats N]

By default the 13 photographs of 640x480, and renderings: 100 of 1280x960 and 20 of 4000x3000; all boards have
9x6 corners. The least time of all rounds counts, of whole commands with all their processes; ours chooses the
model, judges and gives standard deviations. Memory is that of the largest process.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE)]

import cv2
import numpy as np
from _rows import run
from whole_process import CALIB

from calib.stages.camera.model import Board, Camera
from calib.twin.scene import PrintedBoard, Sensor, pose_facing, render

RECORDINGS = Path(os.environ.get("CALIB_SHARED_DATA", HERE.parents[2] / "shared" / "data"))
JOBS = {str(RECORDINGS / "opencv_left"): 3.0, "100x1280x960": 2.0, "20x4000x3000": 1.0}
"""Wanted ratios of time; of memory 2 at 12 MP."""


def _draw(folder: Path, count: int, size_px: tuple[int, int]) -> None:
    rng, (width, height) = np.random.default_rng(5), size_px
    lens = np.array([-0.2, 0.1, 0, 0, 0, 0, 0, 0.0])
    camera = Camera(
        "radial2", size_px, 0.85 * width, 0.85 * width, 0.0, 0.5 * width + 2, 0.5 * height - 2, lens
    )
    printed = PrintedBoard(Board(9, 6, 0.025))
    for i in range(count):
        pose = pose_facing(
            camera,
            printed,
            (width * rng.uniform(0.35, 0.65), height * rng.uniform(0.35, 0.65)),
            rng.uniform(0.4, 0.65),
            tilt_rad=rng.uniform(0.1, 0.7),
            azimuth_rad=rng.uniform(0, 2 * np.pi),
            roll_rad=rng.uniform(-0.3, 0.3),
        )
        picture = render(camera, printed, pose, sensor=Sensor(blur_px=0.7, noise_grey=2.0), seed=i)
        cv2.imwrite(str(folder / f"view{i:03d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser()
    words.add_argument("jobs", nargs="*", default=list(JOBS))
    words.add_argument("--repeats", type=int, default=3)
    asked = words.parse_args()
    print(f"{'job':14}{'calib, s':>10}{'script, s':>11}{'ratio':>7}{'wanted':>8}{'MiB':>7}{'script':>8}")
    for job in asked.jobs:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(job)
            if not folder.is_dir():
                count, *size_px = (int(part) for part in job.split("x"))
                folder = Path(place) / "views"
                folder.mkdir()
                _draw(folder, count, (size_px[0], size_px[1]))
            ours = [sys.executable, "-c", CALIB, "intrinsics", str(folder), "--corners", "9x6"]
            ours += ["--square", "25mm", "--rig", f"{place}/rig.yaml"]
            theirs = [sys.executable, str(HERE / "_opencv_script.py"), str(folder), "9", "6", "0.025"]
            rounds = [(run(ours), run(theirs)) for _ in range(1 + asked.repeats)][1:]
        a, b = (min((pair[k] for pair in rounds), key=lambda one: one.cpu_s) for k in (0, 1))
        wanted = f"{JOBS[job]:g}" if job in JOBS else ""
        numbers = f"{a.cpu_s:10.2f}{b.cpu_s:11.2f}{a.cpu_s / b.cpu_s:7.2f}{wanted:>8}"
        print(f"{Path(job).name:14}{numbers}{a.mib:7.0f}{b.mib:8.0f}", flush=True)


if __name__ == "__main__":
    main()
