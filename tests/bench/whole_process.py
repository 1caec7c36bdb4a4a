"""From pictures to a camera by whole processes: ours, the usual OpenCV script, mrgingham with mrcal.

    python tests/bench/whole_process.py

Thirteen photographs of 640x480 px with 9x6 corners, where the recordings are, and thirteen renderings with
10x10 corners, since mrgingham looks for square grids only. Ours and mrcal's give standard deviations.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE)]

from _rows import Process, Row, interleaved_processes, print_rows

from calib.stages.camera.model import Board, Camera
from calib.twin.scene import PrintedBoard, Sensor, pose_facing, render

CALIB = "from calib.cli.main import main; main()"
MRCAL = """
set -e
cd "$1"
mrgingham --gridn "$2" --jobs "$(nproc)" "$1/*.png" > "$3/corners.vnl" 2> /dev/null
mrcal-calibrate-cameras --corners-cache "$3/corners.vnl" --lensmodel LENSMODEL_OPENCV4 --focal 600 \\
    --object-spacing "$4" --object-width-n "$2" --outdir "$3" "*.png" 2> /dev/null
awk '!/^#/ && $2 != "-" {seen[$1] = 1} END {print length(seen) " boards"}' "$3/corners.vnl"
"""


def rendered(folder: Path, count: int = 13, corners: int = 10) -> None:
    """Pictures of a board that mrgingham looks for, too."""
    rng = np.random.default_rng(5)
    camera = Camera(
        "radial2", (640, 480), 540.0, 540.0, 0.0, 322.0, 238.0, np.array([-0.2, 0.1, 0, 0, 0, 0, 0, 0.0])
    )
    printed = PrintedBoard(Board(corners, corners, 0.02))
    for i in range(count):
        pose = pose_facing(
            camera,
            printed,
            (640 * rng.uniform(0.4, 0.6), 480 * rng.uniform(0.4, 0.6)),
            rng.uniform(0.45, 0.65),
            tilt_rad=rng.uniform(0.1, 0.7),
            azimuth_rad=rng.uniform(0, 2 * np.pi),
            roll_rad=rng.uniform(-0.3, 0.3),
        )
        picture = render(camera, printed, pose, sensor=Sensor(blur_px=0.7, noise_grey=2.0), seed=i)
        cv2.imwrite(str(folder / f"view{i:02d}.png"), picture)


def _boards(process: Process) -> str:
    found = re.search(r"(\d+) (?:of \d+ boards|views|boards)", process.output)
    return "no camera" if process.code or found is None else f"{found[1]} boards"


def _beside(job: str, folder: Path, columns: int, rows: int, square_m: float, repeats: int) -> list[Row]:
    with tempfile.TemporaryDirectory() as place:
        commands: dict[str, list[str]] = {
            "calib": [
                sys.executable, "-c", CALIB, "intrinsics", str(folder), "--corners", f"{columns}x{rows}",
                "--square", f"{square_m}m", "--model", "radial2", "--rig", f"{place}/rig.yaml",
            ],
            "OpenCV script": [
                sys.executable, str(HERE / "_opencv_script.py"), str(folder), str(columns), str(rows),
                str(square_m),
            ],
        }  # fmt: skip
        peer = "mrgingham + mrcal"
        here = shutil.which("mrgingham") and shutil.which("mrcal-calibrate-cameras")
        if here and columns == rows:
            commands[peer] = ["bash", "-c", MRCAL, "-", str(folder), str(columns), place, str(square_m)]
        found = interleaved_processes(commands, repeats)
    ours = found.pop("calib")
    out = [
        Row(job, name, ours.seconds, p.seconds, 1.0, ours.mib, p.mib, f"{_boards(ours)}, {_boards(p)}")
        for name, p in found.items()
    ]
    if peer not in found:
        why = "finds square grids only" if here else "not installed"
        out.append(Row(job, peer, ours.seconds, None, 1.0, ours.mib, None, why))
    return out


def rows(repeats: int = 5) -> list[Row]:
    """Both sets beside both peers."""
    recordings = Path(os.environ.get("CALIB_SHARED_DATA", ROOT.parent / "shared" / "data")) / "opencv_left"
    out = []
    if recordings.is_dir():
        out += _beside("corners + solve, 13 photographs 640x480", recordings, 9, 6, 0.025, repeats)
    with tempfile.TemporaryDirectory() as place:
        rendered(Path(place))
        out += _beside("corners + solve, 13 renderings 640x480", Path(place), 10, 10, 0.02, repeats)
    return out


if __name__ == "__main__":
    print_rows(rows())
