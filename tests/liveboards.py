"""A person who holds a rendered board in front of a camera and does what the live session asks for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray, GrayImage
from calib.live.session import Ghost, Session
from calib.stages.camera.bundle import poses_with_camera, rotation_exp
from calib.stages.camera.intrinsics import calibrate_camera
from calib.stages.camera.model import Board, Camera, View, pack, project
from calib.twin.scene import Light, Pose, PrintedBoard, Sensor, render

CAMERA = Camera(
    "radial2", (320, 240), 285.0, 284.0, 0.0, 163.0, 118.0, np.array([-0.22, 0.1, 0, 0, 0, 0, 0, 0.0])
)
BOARD = Board(8, 5, 0.025)
LIGHT = Light(level=0.8, vignetting=0.2)


@dataclass
class Person:
    """Holds the board where the ghost is, as well as a person does."""

    rng: np.random.Generator
    camera: Camera = CAMERA
    board: Board = BOARD
    sloppy: float = 1.0
    seed: int = 0

    def pose_at(self, ghost: Ghost) -> Pose:
        """The pose that the true camera shows at the ghost, a few degrees and percent off, wholly inside."""
        target = self.board.points_m()
        grid = np.stack(ghost.lines_px[: self.board.rows])
        seen = poses_with_camera(self.camera, pack([View("", target, grid.reshape(-1, 2))]))
        R, t = seen.R_CT, seen.t_CT_m
        turn = rotation_exp(np.radians(3.0 * self.sloppy) * self.rng.standard_normal((1, 3)))[0]
        middle = R[0] @ np.append(0.5 * target.max(axis=0), 0.0) + t[0]
        for nearer in np.linspace(1.0, 2.0, 21):
            shift = 0.02 * self.sloppy * self.rng.standard_normal(3) * middle[2]
            pose = about(turn @ R[0], nearer * middle + shift, self.board)
            if inside(self.camera, self.board, pose):
                return pose
        raise AssertionError("the ghost is outside of the picture")

    def frame(
        self, pose: Pose, motion_px: tuple[float, float] = (0.0, 0.0), light: Light = LIGHT
    ) -> GrayImage:
        """What the camera shows."""
        self.seed += 2
        sensor = Sensor(blur_px=0.6, noise_grey=2.0, motion_px=motion_px)
        return render(
            self.camera, PrintedBoard(self.board), pose, light=light, sensor=sensor, background=0.35,
            seed=self.seed,
        )  # fmt: skip


def about(R: FloatArray, middle_m: FloatArray, board: Board) -> Pose:
    """The pose with this rotation and the board's middle here."""
    return Pose(R, middle_m - R @ np.append(0.5 * board.points_m().max(axis=0), 0.0))


def inside(camera: Camera, board: Board, pose: Pose, margin_px: float = 2.0) -> bool:
    """Whether all squares of the board are in the picture."""
    edge = board.square_m * np.array(
        [[-1, -1], [board.columns, -1], [board.columns, board.rows], [-1, board.rows]]
    )
    points = np.c_[edge, np.zeros(4)] @ pose.R_CB.T + pose.t_m
    if points[:, 2].min() <= 0.0:
        return False
    pixels = project(camera, points)
    size = np.array(camera.image_size_px) - 1
    return bool(np.all((pixels > margin_px) & (pixels < size - margin_px)))


def random_poses(rng: np.random.Generator, camera: Camera = CAMERA, board: Board = BOARD) -> Iterator[Pose]:
    """Poses that show the whole board, uniform in place, distance, and tilts up to 45 degrees."""
    width, height = camera.image_size_px
    near = camera.fx_px * board.square_m * board.columns / width
    while True:
        R = rotation_exp(rng.uniform(-np.pi / 4, np.pi / 4, (1, 3)) * [1.0, 1.0, 0.5])[0]
        depth = near * rng.uniform(1.0, 3.0)
        ray = (rng.uniform(0.0, 1.0, 2) * [width, height] - [camera.cx_px, camera.cy_px]) / camera.fx_px
        pose = about(R, depth * np.array([*ray, 1.0]), board)
        if inside(camera, board, pose):
            yield pose


def follow(session: Session, person: Person, pictures: int = 40) -> list[Pose]:
    """Let a person follow a session until it has enough, and give back the poses that were taken.

    The session takes every picture by itself, within a second of holding still.
    """
    poses: list[Pose] = []
    t_s = 0.0
    for k in range(pictures):
        pose, seen = person.pose_at(session.ghost()), None
        for _ in range(8):
            seen = session.look(person.frame(pose), t_s)
            t_s += 0.15
            if seen.take or seen.code == "enough":
                break
        assert seen is not None
        if seen.code == "enough":
            return poses
        assert seen.take, f"picture {k}: {seen.says}"
        taken = session.accept(person.frame(pose), f"view{k + 1:03d}.png")
        assert isinstance(taken, View), taken
        poses.append(pose)
        assert session.size_px is not None
        session.fitted(calibrate_camera(list(session.views.values()), session.size_px))
    return poses


def write_y4m(path: Path, pictures: Iterable[GrayImage], frames_each: int = 20, rate_hz: int = 20) -> None:
    """A grey video for a browser's fake camera, each picture shown for some frames."""
    with path.open("wb") as stream:
        for k, gray in enumerate(pictures):
            height, width = gray.shape
            if k == 0:
                stream.write(f"YUV4MPEG2 W{width} H{height} F{rate_hz}:1 Ip A1:1 C420\n".encode())
            # Video has its black at 16 and its white at 235.
            luma = np.rint(16.0 + gray * (219.0 / 255.0)).astype(np.uint8).tobytes()
            chroma = bytes([128]) * (2 * ((width + 1) // 2) * ((height + 1) // 2))
            stream.write((b"FRAME\n" + luma + chroma) * frames_each)
