"""Rendered pictures against the projection of the corners and against closed forms of the optics."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares
from scipy.special import erf

from calib.core.errors import BadInputError
from calib.stages.camera.model import Board, Camera
from calib.twin.scene import (
    Light,
    Pose,
    PrintedBoard,
    Sensor,
    corner_pixels,
    expose,
    pose_facing,
    quantise,
    render,
)

BOARD = Board(7, 5, 0.02)
PRINTED = PrintedBoard(BOARD)
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


@pytest.mark.parametrize(
    ("model", "skew_px", "printed", "sensor"),
    [
        ("pinhole", 0.0, PRINTED, Sensor()),
        ("radial2", 0.0, PRINTED, Sensor()),
        ("radial2", 20.0, PRINTED, Sensor(blur_px=1.2)),
        ("brown5", 0.0, PrintedBoard(BOARD, aspect=1.05), Sensor()),
        ("rational8", -10.0, PRINTED, Sensor(gamma=2.2)),
        ("radial2", 0.0, PrintedBoard(BOARD, bow_m=(0.003, 0.001)), Sensor(motion_px=(3.0, 1.0))),
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


def test_finer_supersampling_changes_little() -> None:
    camera = _camera("radial2")
    pose = pose_facing(camera, PRINTED, (300.0, 250.0), 0.3, 0.6, 2.0, -0.4)
    coarse, fine = (expose(camera, PRINTED, pose, NO_LIGHT, Sensor(supersampling=n), 0.3) for n in (4, 8))
    assert np.abs(coarse - fine).max() < 0.6
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.05


def test_the_same_arguments_give_the_same_bytes() -> None:
    camera = _camera("radial2")
    pose = pose_facing(camera, PRINTED, (300.0, 250.0), 0.3)
    first = render(camera, PRINTED, pose, seed=4)
    assert first.dtype == np.uint8
    assert first.tobytes() == render(camera, PRINTED, pose, seed=4).tobytes()
    assert first.tobytes() != render(camera, PRINTED, pose, seed=5).tobytes()


def test_noise_has_its_deviation() -> None:
    flat = np.full((200, 200), 120.3)
    noisy = quantise(flat, 2.0, 3).astype(np.float64)
    assert noisy.mean() == pytest.approx(120.3, abs=0.05)
    assert noisy.var() == pytest.approx(4.0 + 1.0 / 12.0, rel=0.03)
    assert quantise(np.array([[-5.0, 300.0]]), 0.0, 0).tolist() == [[0, 255]]


def test_opencv_finds_the_rendered_board() -> None:
    camera = _camera("radial2")
    pose = pose_facing(camera, PRINTED, (320.0, 240.0), 0.35, 0.4, 1.0, 0.2)
    picture = render(camera, PRINTED, pose, light=Light(vignetting=0.3, gradient=(0.1, -0.1)), seed=2)
    found, corners = cv2.findChessboardCornersSB(picture, (7, 5))
    assert found
    corners = corners.reshape(-1, 2)
    truth = corner_pixels(camera, PRINTED, pose)
    best = min(np.abs(order - truth).max() for order in (corners, corners[::-1]))
    assert best < 0.3


def test_a_picture_without_a_board_is_the_background() -> None:
    camera = _camera("pinhole")
    grey = expose(camera, None, None, NO_LIGHT, Sensor(), 0.4)
    np.testing.assert_allclose(grey, 255 * 0.4, atol=1e-9)
    assert render(camera, seed=1).std() > 10


def test_a_board_out_of_sight_changes_nothing_and_one_at_the_border_is_cut() -> None:
    camera = _camera("pinhole")
    away = Pose(np.eye(3), np.array([5.0, 0.0, 1.0]))
    empty = expose(camera, None, None, NO_LIGHT, Sensor(), 0.4)
    np.testing.assert_array_equal(expose(camera, PRINTED, away, NO_LIGHT, Sensor(), 0.4), empty)
    cut = pose_facing(camera, PRINTED, (0.0, 240.0), 0.3)
    grey = expose(camera, PRINTED, cut, NO_LIGHT, Sensor(), 0.4)
    whole = expose(
        camera, PRINTED, pose_facing(camera, PRINTED, (320.0, 240.0), 0.3), NO_LIGHT, Sensor(), 0.4
    )
    # Shifted by a whole number of pixels the pinhole picture is the same, up to the left border.
    np.testing.assert_allclose(grey[:, :300], whole[:, 320:620], atol=1e-8)


def test_motion_blurs_along_its_path_only() -> None:
    camera = _camera("pinhole")
    pose = pose_facing(camera, PRINTED, (320.0, 240.0), 0.4)
    still, moved = (
        expose(camera, PRINTED, pose, NO_LIGHT, Sensor(motion_px=motion), 0.4)
        for motion in ((0.0, 0.0), (4.0, 0.0))
    )
    row, column = 240, 320
    assert np.abs(np.diff(moved[row])).max() < 0.5 * np.abs(np.diff(still[row])).max()
    assert np.abs(np.diff(moved[:, column + 5])).max() > 0.95 * np.abs(np.diff(still[:, column + 5])).max()


def test_light_follows_its_parameters() -> None:
    camera = _camera("pinhole")
    light = Light(level=0.8, gradient=(0.2, 0.0), spot=0.5, spot_at=(0.5, 0.0), vignetting=0.4, shadow=0.0)
    grey = expose(camera, None, None, light, Sensor(), 1.0) / 255
    even = expose(camera, None, None, Light(level=0.8, vignetting=0.4), Sensor(), 1.0) / 255
    assert even[0, 0] == pytest.approx(0.8 * 0.6, abs=0.003)
    assert even[239, 320] == pytest.approx(0.8, abs=0.001)
    assert np.unravel_index(np.argmax(grey), grey.shape)[1] > 400


def test_contradictory_arguments_are_refused() -> None:
    camera = _camera("pinhole")
    with pytest.raises(BadInputError, match="pose"):
        render(camera, PRINTED)
    with pytest.raises(BadInputError, match="background"):
        render(camera, background=np.zeros((3, 4)))
