"""Processor time and memory of `calib intrinsics` over those of the usual OpenCV script.

    python tests/bench/camera_speed.py [FOLDER or COUNTxWIDTHxHEIGHT ...] [--repeats N]

By default the 13 photographs of 640x480, and renderings: 100 of 1280x960 and 20 of 4000x3000; all boards have
9x6 corners. The least time of all rounds counts, of whole commands with all their processes; ours chooses the
model, judges and gives standard deviations. Memory is that of the largest process.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import _here  # noqa: F401
from _rows import run
from outside import RECORDINGS
from whole_process import intrinsics, opencv_script, rendered

from calib.stages.camera.model import Board

JOBS = {str(RECORDINGS / "opencv_left"): 3.0, "100x1280x960": 2.0, "20x4000x3000": 1.0}
"""Wanted ratios of time; of memory 2 at 12 MP."""


BOARD = Board(9, 6, 0.025)


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
                rendered(folder, count, (size_px[0], size_px[1]), BOARD, ".jpg")
            ours, theirs = intrinsics(folder, BOARD, place), opencv_script(folder, BOARD)
            rounds = [(run(ours), run(theirs)) for _ in range(1 + asked.repeats)][1:]
        a, b = (min((pair[k] for pair in rounds), key=lambda one: one.cpu_s) for k in (0, 1))
        wanted = f"{JOBS[job]:g}" if job in JOBS else ""
        numbers = f"{a.cpu_s:10.2f}{b.cpu_s:11.2f}{a.cpu_s / b.cpu_s:7.2f}{wanted:>8}"
        print(f"{Path(job).name:14}{numbers}{a.mib:7.0f}{b.mib:8.0f}", flush=True)


if __name__ == "__main__":
    main()
