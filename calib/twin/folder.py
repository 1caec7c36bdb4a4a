"""A whole rig folder from the simulated rig: pictures of the board, the plane, logs at rest and in motion.

    images/*.png, images/board.yaml           views of the board
    images/plane/*.png, images/plane/board.yaml   the board lying in the actuator's plane
    logs/static*.csv                          rig at rest
    logs/*.csv                                rig in motion
    truth.json                                all that is true of the rig, for scoring only

With the nominal camera and plane, and the seed 0, the pictures are the shipped ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from calib.core.errors import BadInputError
from calib.core.files import shown, to_be
from calib.core.writing import write_atomically
from calib.io.logs import log_text
from calib.twin.pictures import BOARD, PLANE, Plane, Shot, plane_shot, shots, write_pictures
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.scene import PrintedBoard, corner_pixels
from calib.twin.sensors import View
from calib.twin.simulate import run_log

_PICTURES_SEEDS = 10_000
"""From one seed to the next, for the pictures' noise; those of one folder lie below it."""

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


def _views(view: View) -> list[Shot]:
    """The shipped views taken by a camera, and its picture of the plane."""
    camera = view.camera
    lying = plane_shot(Plane(view.R_CW, view.t_CW_m, PLANE.first_corner_m, PLANE.angle_rad))
    corners = corner_pixels(camera, PrintedBoard(BOARD), lying.pose)
    inside = (corners > 1.0) & (corners < np.array(camera.image_size_px) - 2.0)
    facing = float(lying.pose.R_CB[:, 2] @ lying.pose.t_m) > 0.0
    if not facing or not bool(np.all(inside)):
        raise BadInputError("plane: the camera does not see a whole board lying in the actuator's plane")
    return [*shots(camera), lying]


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
    with to_be("written", folder):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInputError(f"{shown(folder)}: is there already, expected a new or an empty folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        # All of it or nothing: a part would be taken for a whole rig.
        with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as place:
            whole = Path(place) / "rig"
            names = _write(whole, rig, seed, feedback, progress)
            if folder.exists():
                folder.rmdir()
            whole.rename(folder)
    return [folder / name for name in names]


def _write(
    folder: Path, rig: SimulatedRig, seed: int, feedback: str, progress: Progress | None
) -> list[Path]:
    (folder / "logs").mkdir(parents=True)
    taken = [replace(shot, seed=shot.seed + _PICTURES_SEEDS * seed) for shot in _views(rig.view)]
    write_pictures(folder / "images", rig.view.camera, taken)
    written = []
    for index, (name, (scenario, options)) in enumerate(LOGS.items()):
        run = run_scenario(make_scenario(scenario, options), rig, len(LOGS) * seed + index, feedback)
        written.append(Path("logs") / f"{name}.csv")
        write_atomically(folder / written[-1], log_text(run_log(run, name)))
        if progress is not None:
            progress(index + 1, len(LOGS))
    write_atomically(
        folder / "truth.json", json.dumps(asdict(rig), indent=1, default=np.ndarray.tolist) + "\n"
    )
    return written
