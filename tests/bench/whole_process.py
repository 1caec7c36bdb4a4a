"""From pictures to a camera by whole processes: ours, the usual OpenCV script, mrgingham with mrcal.

    python tests/bench/whole_process.py

Thirteen photographs of 640x480 px with 9x6 corners, where the recordings are, and thirteen renderings with
10x10 corners, since mrgingham looks for square grids only. Ours and mrcal's give standard deviations.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from pathlib import Path

import _here
import cv2
import numpy as np
from _rows import CALIB, Process, Row, interleaved_processes, print_rows
from outside import RECORDINGS

from calib.stages.camera.model import Board, Camera
from calib.twin.scene import PrintedBoard, Sensor, pose_facing, render

MRCAL = """
set -e
cd "$1"
mrgingham --gridn "$2" --jobs "$(nproc)" "$1/*.png" > "$3/corners.vnl" 2> /dev/null
mrcal-calibrate-cameras --corners-cache "$3/corners.vnl" --lensmodel LENSMODEL_OPENCV4 --focal 600 \\
    --object-spacing "$4" --object-width-n "$2" --outdir "$3" "*.png" 2> /dev/null
awk '!/^#/ && $2 != "-" {seen[$1] = 1} END {print length(seen) " boards"}' "$3/corners.vnl"
"""


def rendered(folder: Path, count: int, size_px: tuple[int, int], board: Board, ending: str) -> None:
    """Pictures of a board in a folder."""
    rng, (width, height) = np.random.default_rng(5), size_px
    lens = np.array([-0.2, 0.1, 0, 0, 0, 0, 0, 0.0])
    camera = Camera(
        "radial2", size_px, 0.85 * width, 0.85 * width, 0.0, 0.5 * width + 2, 0.5 * height - 2, lens
    )
    printed = PrintedBoard(board)
    for i in range(count):
        pose = pose_facing(
            camera,
            printed,
            (width * rng.uniform(0.4, 0.6), height * rng.uniform(0.4, 0.6)),
            rng.uniform(0.45, 0.65),
            tilt_rad=rng.uniform(0.1, 0.7),
            azimuth_rad=rng.uniform(0, 2 * np.pi),
            roll_rad=rng.uniform(-0.3, 0.3),
        )
        picture = render(camera, printed, pose, sensor=Sensor(blur_px=0.7, noise_grey=2.0), seed=i)
        cv2.imwrite(str(folder / f"view{i:03d}{ending}"), picture)


def intrinsics(folder: Path, board: Board, place: str, *more: str) -> list[str]:
    """Our command on the pictures of a folder."""
    told = ["--corners", f"{board.columns}x{board.rows}", "--square", f"{board.square_m}m", *more]
    return [*CALIB, "intrinsics", str(folder), *told, "--rig", f"{place}/rig.yaml"]


def opencv_script(folder: Path, board: Board) -> list[str]:
    """The usual script on them."""
    told = (folder, board.columns, board.rows, board.square_m)
    return [sys.executable, str(_here.BENCH / "_opencv_script.py"), *map(str, told)]


def _boards(process: Process) -> str:
    found = re.search(r"views +(\d+)|(\d+) (?:of \d+ )?boards", process.output)
    return "no camera" if process.code > 1 or found is None else f"{found[1] or found[2]} boards"


def _beside(job: str, folder: Path, board: Board, repeats: int) -> list[Row]:
    peer = "mrgingham + mrcal"
    here = shutil.which("mrgingham") and shutil.which("mrcal-calibrate-cameras")
    with tempfile.TemporaryDirectory() as place:
        commands = {
            "calib": intrinsics(folder, board, place, "--model", "radial2"),
            "OpenCV script": opencv_script(folder, board),
        }
        if here and board.columns == board.rows:
            told = (folder, board.columns, place, board.square_m)
            commands[peer] = ["bash", "-c", MRCAL, "-", *map(str, told)]
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
    recordings = RECORDINGS / "opencv_left"
    out = []
    if recordings.is_dir():
        out += _beside("corners + solve, 13 photographs 640x480", recordings, Board(9, 6, 0.025), repeats)
    with tempfile.TemporaryDirectory() as place:
        square = Board(10, 10, 0.02)
        rendered(Path(place), 13, (640, 480), square, ".png")
        out += _beside("corners + solve, 13 renderings 640x480", Path(place), square, repeats)
    return out


if __name__ == "__main__":
    print_rows(rows())
