"""A whole rig folder from the simulated rig: pictures of the board, the plane, logs at rest and in motion.

    images/*.png, images/board.yaml           views of the board
    images/plane/*.png, images/plane/board.yaml   the board lying in the actuator's plane
    logs/static*.csv                          rig at rest
    logs/*.csv                                rig in motion
    truth.json                                all that is true of the rig, for scoring only

With the nominal camera and plane the pictures are the shipped ones. For another camera the same views
are taken so that the board fills the same part of the picture.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.writing import write_atomically
from calib.io.logs import log_text
from calib.twin.pictures import (
    BOARD,
    CAMERA,
    PLANE,
    VIEWS,
    Plane,
    Shot,
    plane_shot,
    png_bytes,
    shots,
    write_board_files,
    write_pictures,
)
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.scene import PrintedBoard, corner_pixels, pose_facing, render
from calib.twin.sensors import View
from calib.twin.simulate import log_of

LOGS: dict[str, tuple[str, dict[str, str]]] = {
    "static1": ("static", {}),
    "static2": ("static", {}),
    "swing1": ("swing", {"phi_rad": "0.5"}),
    "swing2": ("swing", {"phi_rad": "-0.4"}),
    "swing3": ("swing", {"phi_rad": "0.3"}),
    "steps": ("steps", {}),
    "deflate": ("deflate", {}),
    "orientation": ("orientation", {}),
    "clamping": ("orientation", {"controller": "clamping"}),
    "elongation": ("elongation", {}),
    "ellipse": ("ellipse", {}),
    "chirp": ("chirp", {}),
    "prbs": ("prbs", {}),
}
"""Scenario and options of each log in the folder."""

Progress = Callable[[int, int], None]


def _is_nominal(view: View) -> bool:
    ours, theirs = view.camera, CAMERA
    return bool(
        ours.fisheye == theirs.fisheye
        and ours.image_size_px == theirs.image_size_px
        and np.array_equal(ours.K, theirs.K)
        and np.array_equal(ours.distortion, theirs.distortion)
        and np.array_equal(view.R_CW, PLANE.R_CW)
        and np.array_equal(view.t_CW_m, PLANE.t_m)
    )


def _views(view: View) -> list[Shot]:
    """The shipped views taken by another camera, and its picture of the plane."""
    camera, printed = view.camera, PrintedBoard(BOARD)
    width, height = camera.image_size_px
    wide, high = width / CAMERA.image_size_px[0], height / CAMERA.image_size_px[1]
    farther = min(camera.fx_px / (CAMERA.fx_px * wide), camera.fy_px / (CAMERA.fy_px * high))
    taken = []
    for shot, (u, v, depth_m, *degrees) in zip(shots(), VIEWS, strict=True):
        tilt, azimuth, roll = (math.radians(value) for value in degrees)
        pose = pose_facing(camera, printed, (u * wide, v * high), depth_m * farther, tilt, azimuth, roll)
        taken.append(replace(shot, pose=pose))
    lying = Plane(view.R_CW, view.t_CW_m, PLANE.first_corner_m, PLANE.angle_rad)
    pose = lying.board_pose
    corners = corner_pixels(camera, printed, pose)
    inside = (corners > 1.0) & (corners < np.array([width - 2.0, height - 2.0]))
    facing = float(pose.R_CB[:, 2] @ pose.t_m) > 0.0
    if not facing or not bool(np.all(inside)):
        raise BadInputError("plane: the camera does not see a whole board lying in the actuator's plane")
    return [*taken, replace(plane_shot(), pose=pose)]


def _write_pictures(view: View, folder: Path) -> None:
    if _is_nominal(view):
        write_pictures(folder)
        return
    views = _views(view)
    (folder / "plane").mkdir(parents=True, exist_ok=True)
    for shot in views:
        picture = render(
            view.camera, PrintedBoard(BOARD), shot.pose, light=shot.light, sensor=shot.sensor, seed=shot.seed
        )
        write_atomically(folder / shot.path, png_bytes(picture))
    write_board_files(folder)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value


def write_rig_folder(
    folder: Path,
    rig: SimulatedRig,
    seed: int = 0,
    feedback: str = "sensors",
    progress: Progress | None = None,
) -> list[Path]:
    """Write a rig folder and return the logs in it; the same arguments, the same bytes.

    Raises `BadInputError` for a folder that is not empty or cannot be written, and for a camera that
    does not see the actuator.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInputError(f"{shown(folder)}: is there already, expected a new or an empty folder")
        (folder / "logs").mkdir(parents=True, exist_ok=True)
        _write_pictures(rig.view, folder / "images")
    except OSError as error:
        raise BadInputError(f"{shown(folder)}: cannot be written: {error.strerror or error}") from error
    written = []
    for index, (name, (scenario, options)) in enumerate(LOGS.items()):
        run = run_scenario(make_scenario(scenario, options), rig, len(LOGS) * seed + index, feedback)
        path = folder / "logs" / f"{name}.csv"
        write_atomically(path, log_text(log_of(run, name)))
        written.append(path)
        if progress is not None:
            progress(index + 1, len(LOGS))
    write_atomically(folder / "truth.json", json.dumps(_plain(asdict(rig)), indent=1) + "\n")
    return written
