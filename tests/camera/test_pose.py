"""Pose of the plane: derivatives, recovery, OpenCV's answer, and its dependence on the intrinsics."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calib.camera.board import Board
from calib.camera.model import Camera, project
from calib.camera.pose import (
    fit_pose,
    plane_map,
    pose_derivatives,
    projection_with_derivatives,
    rotation,
)
from calib.camera.projection import camera_from_vector, vector_from_camera
from calib.errors import BadInputError

RICH = Camera(
    "rational8",
    (640, 480),
    530.0,
    541.0,
    1.7,
    322.0,
    236.0,
    np.array([-0.28, 0.09, 1.3e-3, -9e-4, 0.02, 0.015, -0.02, 0.004]),
)
THESIS = Camera(
    "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
POINTS = Board(7, 5, 0.02).points_m() - np.array([0.05, 0.03])
R_TRUE = rotation(np.array([0.35, -0.22, 0.4]))
T_TRUE = np.array([0.01, -0.012, 0.33])


def pixels_of(camera: Camera) -> np.ndarray:
    return project(camera, POINTS @ R_TRUE[:, :2].T + T_TRUE)


def test_derivatives_against_finite_differences() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.15, 0.15, (40, 2)), rng.uniform(0.2, 0.6, 40)])
    pixels, by_point, by_camera = projection_with_derivatives(RICH, points)
    assert np.abs(pixels - project(RICH, points)).max() < 1e-11
    for axis in range(3):
        d = np.zeros(3)
        d[axis] = 1e-7
        numeric = (project(RICH, points + d) - project(RICH, points - d)) / 2e-7
        assert np.abs(by_point[:, :, axis] - numeric).max() < 1e-4 * np.abs(by_point).max()
    c = vector_from_camera(RICH)
    for index in range(13):
        d = np.zeros(13)
        d[index] = 1e-5 * max(1.0, abs(c[index]))
        plus, minus = (camera_from_vector("rational8", RICH.image_size_px, c + s * d) for s in (1, -1))
        numeric = (project(plus, points) - project(minus, points)) / (2 * d[index])
        assert by_camera[:, :, index] == pytest.approx(numeric, rel=1e-6, abs=1e-6)


def test_pose_derivatives_against_finite_differences() -> None:
    _, by_world, by_pose, _ = pose_derivatives(RICH, R_TRUE, T_TRUE, POINTS)

    def moved(step: np.ndarray) -> np.ndarray:
        return project(RICH, POINTS @ (rotation(step[:3]) @ R_TRUE)[:, :2].T + T_TRUE + step[3:])

    for index in range(6):
        d = np.zeros(6)
        d[index] = 1e-6
        numeric = (moved(d) - moved(-d)) / 2e-6
        assert by_pose[:, :, index] == pytest.approx(numeric, rel=1e-6, abs=1e-4)
    for axis in range(2):
        d2 = np.zeros(2)
        d2[axis] = 1e-7
        numeric = (
            project(RICH, (POINTS + d2) @ R_TRUE[:, :2].T + T_TRUE)
            - project(RICH, (POINTS - d2) @ R_TRUE[:, :2].T + T_TRUE)
        ) / 2e-7
        assert by_world[:, :, axis] == pytest.approx(numeric, rel=1e-6, abs=1e-3)


def test_rotation_is_a_rotation_down_to_nothing() -> None:
    for w in (np.zeros(3), np.array([1e-300, 0, 0]), np.array([1e-9, 2e-9, 0]), np.array([0.3, -2.0, 1.1])):
        R = rotation(w)
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-15
        assert np.abs(R @ rotation(-w) - np.eye(3)).max() < 1e-15
        assert np.abs(R - cv2.Rodrigues(w)[0]).max() < 1e-14


@pytest.mark.parametrize("camera", [THESIS, RICH], ids=["radial2", "rational8 with skew"])
@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.5, 1.2])
@pytest.mark.parametrize("roll", [0.0, 1.5, 3.1, -2.0])
def test_the_pose_is_recovered_from_exact_pixels(camera: Camera, tilt: float, roll: float) -> None:
    R = rotation(np.array([tilt, -0.4 * tilt, 0.0])) @ rotation(np.array([0.0, 0.0, roll]))
    fit = fit_pose(camera, POINTS, project(camera, POINTS @ R[:, :2].T + T_TRUE))
    assert np.abs(fit.R_CW - R).max() < 1e-9
    assert np.abs(fit.t_CW_m - T_TRUE).max() < 1e-10
    assert fit.termination != "iteration limit"
    assert fit.other is None or fit.other[0] > 1e-6
    assert np.abs(plane_map(camera, fit.R_CW, fit.t_CW_m, pixels_of(camera))).max() < 1.0


def test_opencv_agrees_on_noisy_pixels() -> None:
    camera = Camera(
        "brown5",
        (640, 480),
        530.0,
        541.0,
        0.0,
        322.0,
        236.0,
        np.array([-0.28, 0.09, 1e-3, -9e-4, 0.02, 0, 0, 0]),
    )
    pixels = pixels_of(camera) + np.random.default_rng(4).normal(0.0, 0.3, POINTS.shape)
    fit = fit_pose(camera, POINTS, pixels)
    world = np.column_stack([POINTS, np.zeros(len(POINTS))])
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    start = (cv2.Rodrigues(fit.R_CW)[0] + 0.01, fit.t_CW_m.reshape(3, 1) + 0.003)
    w, t = cv2.solvePnPRefineLM(world, pixels, camera.K, camera.distortion[:5], *start, criteria)
    assert np.abs(cv2.Rodrigues(w)[0] - fit.R_CW).max() < 1e-7
    assert np.abs(t.ravel() - fit.t_CW_m).max() < 1e-7


def test_the_plane_tilted_the_other_way_is_tried() -> None:
    # From far away the tilt shows in so little perspective that a fit started wrongly stays wrong.
    R = rotation(np.array([0.5, 0.0, 0.0]))
    t = np.array([0.0, 0.0, 1.5])
    camera = Camera("pinhole", (640, 480), 1200.0, 1200.0, 0.0, 319.5, 239.5)
    pixels = project(camera, POINTS @ R[:, :2].T + t)
    fit = fit_pose(camera, POINTS, pixels)
    assert np.abs(fit.R_CW - R).max() < 1e-8
    assert fit.other is not None
    cost, R_other, _ = fit.other
    assert cost > 1e-3
    assert R_other[1, 2] * R[1, 2] < 0


def test_the_pose_follows_the_intrinsics_as_stated() -> None:
    rng = np.random.default_rng(6)
    pixels = pixels_of(THESIS) + rng.normal(0.0, 0.05, POINTS.shape)
    fit = fit_pose(THESIS, POINTS, pixels)
    c = vector_from_camera(THESIS)
    for index, step in enumerate([0.5, 0.5, 0.3, 0.3, 0.3, 2e-3, 2e-2]):
        moved = []
        for sign in (1.0, -1.0):
            shifted = c.copy()
            shifted[index] += sign * step
            other = fit_pose(camera_from_vector("radial2", THESIS.image_size_px, shifted), POINTS, pixels)
            w = cv2.Rodrigues(other.R_CW @ fit.R_CW.T)[0].ravel()
            moved.append(np.concatenate([w, other.t_CW_m]))
        numeric = (moved[0] - moved[1]) / (2 * step)
        # Gauss-Newton leaves out the curvature times the residual, so agreement is not to the digit.
        assert np.linalg.norm(fit.by_intrinsics[:, index] - numeric) < 0.01 * np.linalg.norm(numeric)


def test_mirrored_planes_and_folded_lenses_are_refused() -> None:
    with pytest.raises(BadInputError, match="mirrored"):
        fit_pose(THESIS, POINTS * np.array([1.0, -1.0]), pixels_of(THESIS))
    folded = Camera(
        "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-300.0, 0, 0, 0, 0, 0, 0, 0])
    )
    with pytest.raises(BadInputError, match="folds over"):
        fit_pose(folded, POINTS, pixels_of(THESIS))
