"""Rendered pictures: the shipped bytes and their truth, closed forms of the optics, OpenCV's calibration."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares
from scipy.special import erf
from shipped_pictures import write

from calib.stages.camera.model import Board, Camera, project, undistort
from calib.twin.pictures import BOARD, CAMERA, plane_shot, shots
from calib.twin.scene import (
    Light,
    Pose,
    PrintedBoard,
    Sensor,
    board_coordinates,
    clutter,
    corner_pixels,
    expose,
    pose_facing,
    render,
)
from calib.twin.sensors import normal

PRINTED = PrintedBoard(BOARD)


@pytest.fixture(scope="module")
def images(project_root: Path) -> Path:
    return project_root / "images"


@pytest.fixture(scope="module")
def known(project_root: Path) -> dict[str, Any]:
    text = (project_root / "tests" / "truth" / "pictures.json").read_text()
    document: dict[str, Any] = json.loads(text)
    return document


def _found(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Corners as OpenCV's classic finder and cornerSubPix see them, in the order of `near`."""
    found, corners = cv2.findChessboardCorners(picture, (BOARD.columns, BOARD.rows))
    assert found
    corners = cv2.cornerSubPix(picture, corners, (4, 4), (-1, -1), (3, 100, 1e-5)).reshape(-1, 2)
    return min((corners, corners[::-1]), key=lambda order: np.abs(order - near).max())


def test_one_command_gives_the_shipped_bytes(images: Path, known: dict[str, Any], tmp_path: Path) -> None:
    write(tmp_path / "images", tmp_path / "truth.json")
    made = sorted(path.relative_to(tmp_path / "images") for path in (tmp_path / "images").rglob("*.*"))
    shipped = sorted(path.relative_to(images) for path in images.rglob("*.*"))
    assert made == shipped
    for name in made:
        assert (tmp_path / "images" / name).read_bytes() == (images / name).read_bytes(), name
    assert known == json.loads((tmp_path / "truth.json").read_text())


def test_every_square_of_every_board_is_in_the_picture_and_the_set_is_diverse() -> None:
    px = BOARD.square_m
    outline = np.array([[-px, -px, 0], [7 * px, -px, 0], [7 * px, 5 * px, 0], [-px, 5 * px, 0]])
    for shot in [*shots(), plane_shot()]:
        seen = project(CAMERA, outline @ shot.pose.R_CB.T + shot.pose.t_m)
        assert seen.min() > 2.0, shot.path
        assert (np.array([315.0, 207.0]) - seen).min() > 2.0, shot.path
    normals = np.array([shot.pose.R_CB[:, 2] for shot in shots()])
    tilts = np.degrees(np.arccos(normals[:, 2]))
    assert tilts.min() < 5.0
    assert np.sum(tilts > 25.0) >= 10
    assert all(np.any(sign * normals[:, axis] > 0.4) for axis in (0, 1) for sign in (-1, 1))
    points = np.vstack([corner_pixels(CAMERA, PRINTED, shot.pose) for shot in shots()])
    counts, _, _ = np.histogram2d(*points.T, bins=(6, 4), range=((25, 290), (18, 188)))
    assert np.all(counts > 0)


def test_truth_describes_the_pictures(images: Path, known: dict[str, Any]) -> None:
    assert known["camera"]["distortion"][:2] == [-0.2201, 0.5494]
    for name, view in known["views"].items():
        corners = np.array(view["corners_px"])
        R, t = np.array(view["R_CB"]), np.array(view["t_m"])
        flat = np.column_stack([BOARD.points_m(), np.zeros(BOARD.corners)])
        np.testing.assert_allclose(project(CAMERA, flat @ R.T + t), corners, atol=1e-5)
        error = _found(cv2.imread(str(images / name), cv2.IMREAD_GRAYSCALE), corners) - corners
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.06, name


def test_plane_truth_places_the_board_in_the_world(images: Path, known: dict[str, Any]) -> None:
    plane = known["plane"]
    R, t = np.array(plane["R_CW"]), np.array(plane["t_m"])
    c, s = np.cos(plane["angle_rad"]), np.sin(plane["angle_rad"])
    x, y = BOARD.points_m().T
    world = np.column_stack(
        [plane["first_corner_m"][0] + c * x - s * y, plane["first_corner_m"][1] + s * x + c * y, 0 * x]
    )
    corners = np.array(plane["views"]["plane/plane01.png"]["corners_px"])
    np.testing.assert_allclose(project(CAMERA, world @ R.T + t), corners, atol=1e-5)
    picture = cv2.imread(str(images / "plane" / "plane01.png"), cv2.IMREAD_GRAYSCALE)
    assert np.abs(_found(picture, corners) - corners).max() < 0.3
    assert 0.25 <= t[2] <= 0.30
    assert 2.0 < np.degrees(np.arccos(R[2, 2])) < 8.0


def test_opencv_calibrates_the_camera_back(images: Path) -> None:
    pixels = [
        _found(
            cv2.imread(str(images / shot.path), cv2.IMREAD_GRAYSCALE),
            corner_pixels(CAMERA, PRINTED, shot.pose),
        ).astype(np.float32)
        for shot in shots()
    ]
    flat = np.column_stack([BOARD.points_m(), np.zeros(BOARD.corners)]).astype(np.float32)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, K, d, *_ = cv2.calibrateCamera(
        [flat] * 17, pixels, (316, 208), None, None, flags=flags, criteria=(3, 200, 1e-12)
    )
    assert rms < 0.06
    np.testing.assert_allclose(K, CAMERA.K, atol=0.5)
    np.testing.assert_allclose(d.ravel()[:2], CAMERA.distortion[:2], atol=0.02)


BOARD_SCENE = Board(7, 5, 0.02)
PRINTED_scene = PrintedBoard(BOARD_SCENE)
COEFFICIENTS = {
    "pinhole": (0.0,) * 8,
    "radial2": (-0.2201, 0.5494, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "brown5": (-0.28, 0.1, 0.002, -0.003, -0.02, 0.0, 0.0, 0.0),
    "rational8": (0.3, 0.05, 0.001, -0.001, 0.01, 0.55, 0.1, 0.02),
}
NO_LIGHT = Light(level=1.0, shadow=0.0)


def _camera(model: str, skew_px: float = 0.0) -> Camera:
    return Camera(model, (640, 480), 553.0, 551.0, skew_px, 322.0, 237.0, np.array(COEFFICIENTS[model]))


def _symmetry_centres(grey: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Points about which the picture is even: half a turn about a corner leaves a checkerboard unchanged."""
    spline = spline_filter(grey, 5)
    axis = np.linspace(-3.0, 3.0, 13)
    dx, dy = np.meshgrid(axis, axis)
    weight = np.exp(-(dx**2 + dy**2) / 4.5)
    centres = []
    for u, v in start:

        def odd_part(p: np.ndarray, u: float = u, v: float = v) -> np.ndarray:
            here = map_coordinates(spline, [v + p[1] + dy, u + p[0] + dx], order=5, prefilter=False)
            there = map_coordinates(spline, [v + p[1] - dy, u + p[0] - dx], order=5, prefilter=False)
            return ((here - there) * weight).ravel()

        centres.append(np.array([u, v]) + least_squares(odd_part, [0.05, -0.03], xtol=1e-12).x)
    return np.array(centres)


@pytest.mark.few(0, 2)
@pytest.mark.parametrize(
    ("model", "skew_px", "printed", "sensor"),
    [
        ("pinhole", 0.0, PRINTED_scene, Sensor()),
        ("radial2", 0.0, PRINTED_scene, Sensor()),
        ("radial2", 20.0, PRINTED_scene, Sensor(blur_px=1.2)),
        ("brown5", 0.0, PrintedBoard(BOARD_SCENE, aspect=1.05), Sensor()),
        ("rational8", -10.0, PRINTED_scene, Sensor(gamma=2.2)),
        ("radial2", 0.0, PrintedBoard(BOARD_SCENE, bow_m=(0.003, 0.001)), Sensor(motion_px=(3.0, 1.0))),
    ],
)
def test_corners_lie_where_truth_says(
    model: str, skew_px: float, printed: PrintedBoard, sensor: Sensor
) -> None:
    camera = _camera(model, skew_px)
    for tilt in (0.0, 0.5):
        pose = pose_facing(camera, printed, (300.3, 250.1), 0.27, tilt, 0.7, 0.3)
        truth = corner_pixels(camera, printed, pose)
        grey = expose(camera, printed, pose, NO_LIGHT, sensor, 0.3)
        error = _symmetry_centres(grey, truth) - truth
        assert np.hypot(*error.T).max() < 0.005
        assert np.abs(error.mean(axis=0)).max() < 0.0015


def test_an_edge_is_the_error_function_of_aperture_and_blur() -> None:
    # One edge along v at u = 20.37 px: the integral of the blurred step over a pixel.
    camera = Camera("pinhole", (40, 30), 100.0, 100.0, 0.0, 0.0, 0.0)
    printed = PrintedBoard(Board(2, 2, 1.0), margin_squares=0.0, paper=1.0, ink=0.0)
    pose = Pose(np.eye(3), np.array([0.2037, 0.5, 1.0]))  # black left of the edge, white right of it
    for blur in (0.5, 0.8, 1.5):
        grey = expose(camera, printed, pose, NO_LIGHT, Sensor(blur_px=blur, supersampling=4), 0.5) / 255

        def primitive(d: np.ndarray, s: float = blur) -> np.ndarray:
            return 0.5 * d * (1 + erf(d / (s * math.sqrt(2)))) + s / math.sqrt(2 * math.pi) * np.exp(
                -0.5 * (d / s) ** 2
            )

        d = np.arange(40) - 20.37
        expected = primitive(d + 0.5) - primitive(d - 0.5)
        np.testing.assert_allclose(grey[15], expected, atol=2e-3)
        np.testing.assert_allclose(grey, np.broadcast_to(grey[15], grey.shape), atol=1e-12)


def test_the_same_arguments_give_the_same_bytes() -> None:
    camera = _camera("radial2")
    pose = pose_facing(camera, PRINTED_scene, (300.0, 250.0), 0.3)
    first = render(camera, PRINTED_scene, pose, seed=4)
    assert first.dtype == np.uint8
    assert first.tobytes() == render(camera, PRINTED_scene, pose, seed=4).tobytes()
    assert first.tobytes() != render(camera, PRINTED_scene, pose, seed=5).tobytes()


def test_opencv_finds_the_rendered_board() -> None:
    camera = _camera("radial2")
    pose = pose_facing(camera, PRINTED_scene, (320.0, 240.0), 0.35, 0.4, 1.0, 0.2)
    picture = render(camera, PRINTED_scene, pose, light=Light(vignetting=0.3, gradient=(0.1, -0.1)), seed=2)
    found, corners = cv2.findChessboardCornersSB(picture, (7, 5))
    assert found
    corners = corners.reshape(-1, 2)
    truth = corner_pixels(camera, PRINTED_scene, pose)
    best = min(np.abs(order - truth).max() for order in (corners, corners[::-1]))
    assert best < 0.3


def test_motion_blurs_along_its_path_only() -> None:
    camera = _camera("pinhole")
    pose = pose_facing(camera, PRINTED_scene, (320.0, 240.0), 0.4)
    still, moved = (
        expose(camera, PRINTED_scene, pose, NO_LIGHT, Sensor(motion_px=motion), 0.4)
        for motion in ((0.0, 0.0), (4.0, 0.0))
    )
    row, column = 240, 320
    assert np.abs(np.diff(moved[row])).max() < 0.5 * np.abs(np.diff(still[row])).max()
    assert np.abs(np.diff(moved[:, column + 5])).max() > 0.95 * np.abs(np.diff(still[:, column + 5])).max()


BOARD_SHEET = Board(7, 5, 0.02)
RADIAL2 = np.array([-0.2201, 0.5494, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
CAMERA_SHEET = Camera("radial2", (316, 208), 273.0, 272.0, 1.5, 160.0, 101.0, RADIAL2)


def _random_pose(rng: np.random.Generator, printed: PrintedBoard) -> Pose:
    pixel = (rng.uniform(80, 240), rng.uniform(60, 150))
    tilt, azimuth, roll = rng.uniform(0, 1.0), rng.uniform(-3, 3), rng.uniform(-3, 3)
    return pose_facing(CAMERA_SHEET, printed, pixel, rng.uniform(0.25, 0.6), tilt, azimuth, roll)


def test_aspect_stretches_rows_and_bow_is_a_parabola_over_the_corners() -> None:
    printed = PrintedBoard(BOARD_SHEET, aspect=1.25, bow_m=(0.003, 0.001))
    points = printed.points_m()
    assert points[-1, :2] == pytest.approx((0.12, 0.1))
    grid = points[:, 2].reshape(5, 7)
    np.testing.assert_allclose(grid[[0, 0, -1, -1], [0, -1, 0, -1]], 0.0, atol=1e-18)
    assert grid[2, 3] == pytest.approx(0.004)
    assert grid[0, 3] == pytest.approx(0.003)
    assert grid[2, 0] == pytest.approx(0.001)
    np.testing.assert_allclose(np.diff(grid, n=3, axis=1), 0.0, atol=1e-17)


@pytest.mark.parametrize("bow_m", [(0.0, 0.0), (0.003, 0.0), (-0.01, 0.004)])
def test_rays_of_projected_corners_meet_the_sheet_in_the_corners(bow_m: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    printed = PrintedBoard(BOARD_SHEET, aspect=0.9, bow_m=bow_m)
    for _ in range(20):
        pose = _random_pose(rng, printed)
        rays = undistort(CAMERA_SHEET, corner_pixels(CAMERA_SHEET, printed, pose))
        x, y = board_coordinates(printed, pose, rays)
        np.testing.assert_allclose(np.column_stack([x, y]), printed.points_m()[:, :2], atol=1e-10)


def test_noise_is_standard_normal() -> None:
    noise = normal(np.random.PCG64(1), 400, 500).ravel()
    assert abs(noise.mean()) < 4.0 / np.sqrt(noise.size)
    assert abs(noise.var() - 1.0) < 4.0 * np.sqrt(2.0 / noise.size)
    assert abs(stats.kurtosis(noise) - (-1.2 / 16)) < 0.05
    quantiles = np.quantile(noise, [0.0228, 0.1587, 0.8413, 0.9772])
    np.testing.assert_allclose(quantiles, [-2.0, -1.0, 1.0, 2.0], atol=0.03)


@pytest.mark.few(0)
@pytest.mark.parametrize("seed", range(6))
def test_clutter_is_cluttered_but_holds_no_board(seed: int) -> None:
    picture = clutter((316, 208), seed)
    assert picture.min() >= 0.03
    assert picture.max() <= 0.95
    assert picture.std() > 0.05
    grey = np.round(255 * picture).astype(np.uint8)
    assert not cv2.findChessboardCornersSB(grey, (7, 5))[0]
    assert not cv2.findChessboardCorners(grey, (7, 5))[0]
