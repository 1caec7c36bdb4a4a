"""A fleet of simulated rigs with small pictures: each camera is a little different, and known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.core.arrays import GrayImage
from calib.stages.camera.model import Camera
from calib.twin.pictures import BOARD, CAMERA, VIEWS, png_bytes
from calib.twin.scene import Light, PrintedBoard, Sensor, pose_facing, render

__all__ = ["camera_of", "write_camera_rig", "write_fleet", "write_manifest"]

CHOSEN = (0, 5, 6, 7, 8, 15, 11, 14)
"""Views that see the lens at its borders and the board tilted in all directions, best first."""


def camera_of(number: int, drift_px: float = 0.0, seed: int = 0) -> Camera:
    """Camera of a rig of the fleet: the nominal one, a little off, longer by `drift_px` for each number."""
    rng = np.random.default_rng([seed, number])
    grow = 1.0 + 0.004 * rng.standard_normal()
    lens = CAMERA.distortion.copy()
    lens[0] += 0.003 * rng.standard_normal()
    return replace(
        CAMERA,
        fx_px=CAMERA.fx_px * grow + drift_px * number,
        fy_px=CAMERA.fy_px * grow + drift_px * number,
        cx_px=CAMERA.cx_px + 0.8 * rng.standard_normal(),
        cy_px=CAMERA.cy_px + 0.8 * rng.standard_normal(),
        distortion=lens,
    )


def _picture(camera: Camera, index: int, noise_grey: float, seed: int) -> GrayImage:
    u, v, depth_m, *degrees = VIEWS[index]
    tilt, azimuth, roll = (math.radians(value) for value in degrees)
    printed = PrintedBoard(BOARD)
    pose = pose_facing(camera, printed, (u, v), depth_m, tilt, azimuth, roll)
    return render(camera, printed, pose, light=Light(), sensor=Sensor(noise_grey=noise_grey), seed=seed)


def write_camera_rig(folder: Path, camera: Camera, views: int = 6, seed: int = 0) -> Path:
    """Write the pictures of a rig, images/*.png with their board.yaml, and return its folder."""
    (folder / "images").mkdir(parents=True)
    for count, index in enumerate(CHOSEN[:views]):
        picture = _picture(camera, index, 2.0, 1000 * seed + count)
        (folder / "images" / f"view{count + 1}.png").write_bytes(png_bytes(picture))
    board = f"corners: [{BOARD.columns}, {BOARD.rows}]\nsquare_m: {BOARD.square_m:.3f}\n"
    (folder / "images" / "board.yaml").write_text(board)
    return folder


def write_manifest(path: Path, folders: list[Path], model: str = "") -> Path:
    """A manifest of these folders; serials count from AX-0001 on."""
    head = "name,path,serial" + (",model" if model else "")
    end = f",{model}" if model else ""
    rows = [f"{folder.name},{folder},AX-{k:04d}{end}" for k, folder in enumerate(folders, start=1)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def write_fleet(root: Path, count: int, cameras: int = 10, views: int = 5) -> list[Path]:
    """Folders of many rigs quickly: few cameras are rendered, and each rig has noise of its own on them."""
    rendered = []
    for number in range(cameras):
        camera = camera_of(number)
        rendered.append([_picture(camera, index, 0.0, 0) for index in CHOSEN[:views]])
    board = f"corners: [{BOARD.columns}, {BOARD.rows}]\nsquare_m: {BOARD.square_m:.3f}\n"
    folders = []
    for k in range(count):
        folder = root / f"rig{k + 1:04d}"
        (folder / "images").mkdir(parents=True)
        rng = np.random.default_rng(k)
        for i, picture in enumerate(rendered[k % cameras], start=1):
            noisy = np.clip(np.rint(picture + 2.0 * rng.standard_normal(picture.shape)), 0, 255)
            (folder / "images" / f"view{i}.png").write_bytes(png_bytes(noisy.astype(np.uint8)))
        (folder / "images" / "board.yaml").write_text(board)
        folders.append(folder)
    return folders
