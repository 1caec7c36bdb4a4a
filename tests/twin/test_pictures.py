"""The shipped pictures: the same bytes, the truth beside the tests, and an independent calibration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calib.stages.camera.model import distort, project, undistort
from calib.twin.pictures import (
    BOARD,
    CAMERA,
    PLANE,
    main,
    plane_shot,
    png_bytes,
    shots,
    truth,
    write_pictures,
)
from calib.twin.scene import PrintedBoard, corner_pixels, expose
from calib.twin.sensors import clutter, gaussian_noise

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
    assert main([str(tmp_path / "images"), str(tmp_path / "truth.json")]) == 0
    made = sorted(path.relative_to(tmp_path / "images") for path in (tmp_path / "images").rglob("*.*"))
    shipped = sorted(path.relative_to(images) for path in images.rglob("*.*"))
    assert made == shipped
    for name in made:
        assert (tmp_path / "images" / name).read_bytes() == (images / name).read_bytes(), name
    assert known == json.loads((tmp_path / "truth.json").read_text())


def test_rounding_leaves_room_for_another_processors_last_digit() -> None:
    # Were a grey level within 1e-10 of a half, a last digit could decide a byte; errors are near 1e-13.
    for shot in [*shots(), plane_shot()]:
        background = clutter(CAMERA.image_size_px, shot.seed)
        grey = expose(CAMERA, PRINTED, shot.pose, shot.light, shot.sensor, background)
        grey = grey + shot.sensor.noise_grey * gaussian_noise(np.random.PCG64(shot.seed + 1), grey.shape)
        assert np.abs(grey - np.floor(grey) - 0.5).min() > 1e-10


def test_there_are_seventeen_views_of_the_thesis_board(images: Path) -> None:
    assert len(list(images.glob("*.png"))) == 17
    assert BOARD.corners * 17 == 595
    for path in images.rglob("*.png"):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (208, 316)
        assert picture.dtype == np.uint8
        assert 150 < picture.max() < 255, "neither dark nor clipped"


def test_png_decodes_to_the_picture() -> None:
    rng = np.random.default_rng(0)
    for shape in ((1, 1), (208, 316), (500, 400)):
        picture = rng.integers(0, 256, shape).astype(np.uint8)
        decoded = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decoded, picture)


def test_the_lens_stays_monotonic_beyond_the_picture() -> None:
    radius = np.linspace(0.0, 1.5, 3000)
    assert np.all(np.diff(distort(radius, np.zeros_like(radius), CAMERA.distortion)[0]) > 0.0)
    corners = np.array([[-4.0, -4.0], [319.0, -4.0], [-4.0, 211.0], [319.0, 211.0]])
    assert np.all(np.isfinite(undistort(CAMERA, corners)))


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


def test_the_actuators_workspace_is_in_the_plane_picture() -> None:
    x, y = np.meshgrid(np.linspace(-0.08, 0.08, 9), np.linspace(0.0, 0.12, 7))
    world = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = project(CAMERA, world @ PLANE.R_CW.T + PLANE.t_m)
    assert seen.min() > 5.0
    assert (np.array([315.0, 207.0]) - seen).min() > 5.0


def test_board_files_say_what_is_true(images: Path) -> None:
    assert (images / "board.yaml").read_text() == "corners: [7, 5]\nsquare_m: 0.020\n"
    assert (images / "plane" / "board.yaml").read_text() == (
        "corners: [7, 5]\nsquare_m: 0.020\nfirst_corner_m: [-0.058, 0.022]\nangle_rad: 0.05\n"
    )


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


def test_truth_is_made_from_the_same_definitions(known: dict[str, Any]) -> None:
    assert json.loads(json.dumps(truth())) == known


def test_wrong_words_end_with_the_usage(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main([]) == 2
    assert main(["--help"]) == 2
    assert "usage" in capsys.readouterr().err
    assert len(write_pictures(tmp_path)) == 20
