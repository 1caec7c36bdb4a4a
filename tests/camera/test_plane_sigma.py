"""The reported uncertainty of a position against many simulated calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera.board import Board
from calib.camera.model import Camera, project
from calib.camera.plane_sigma import position_sigma, visible, workspace_grid
from calib.camera.pose import fit_pose, plane_map, rotation
from calib.camera.projection import camera_from_vector, vector_from_camera

THESIS = Camera(
    "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
POINTS = Board(7, 5, 0.02).points_m() + np.array([-0.06, 0.02])
R_TRUE = rotation(np.array([0.2, -0.25, 0.1]))
T_TRUE = np.array([0.005, -0.055, 0.3])
GRID = workspace_grid((-0.06, 0.02, 0.06, 0.1), 5)
# Correlated, as real ones are: focal lengths together, k1 against k2.
SIGMA_C = np.array([1.2, 1.2, 0.8, 0.7, 0.0, 0.012, 0.08, 0, 0, 0, 0, 0, 0])
CORRELATION = np.eye(13)
CORRELATION[0, 1] = CORRELATION[1, 0] = 0.97
CORRELATION[5, 6] = CORRELATION[6, 5] = -0.93
COVARIANCE_C = CORRELATION * SIGMA_C * SIGMA_C[:, None]


def pixels_of(points: np.ndarray) -> np.ndarray:
    return project(THESIS, points @ R_TRUE[:, :2].T + T_TRUE)


def simulate(trials: int, noise_px: float, part: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors (trials, N, 2) in mm of positions read after calibrating anew, and the variances reported."""
    uncertain, whole_pixels = part != "plane_mm", part == "total_mm"
    rng = np.random.default_rng(11)
    c = vector_from_camera(THESIS)
    corners, markers = pixels_of(POINTS), pixels_of(GRID)
    errors, reported = [], []
    for _ in range(trials):
        drawn = rng.multivariate_normal(c, COVARIANCE_C) if uncertain else c
        camera = camera_from_vector("radial2", THESIS.image_size_px, drawn)
        pose = fit_pose(camera, POINTS, corners + rng.normal(0.0, noise_px, corners.shape))
        measured = markers + (rng.uniform(-0.5, 0.5, markers.shape) if whole_pixels else 0.0)
        errors.append(1e3 * (plane_map(camera, pose.R_CW, pose.t_CW_m, measured) - GRID))
        sigma = position_sigma(camera, COVARIANCE_C if uncertain else None, pose, GRID)
        reported.append(getattr(sigma, part) ** 2)
    return np.array(errors), np.array(reported)


def rms_over_places(variance: np.ndarray) -> np.ndarray:
    """Per axis, over all places of the grid."""
    return np.asarray(np.sqrt(variance.mean(axis=0)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise_px", "part"),
    [(0.15, "plane_mm"), (1e-4, "intrinsics_mm"), (0.15, "calibration_mm"), (0.15, "total_mm")],
)
def test_reported_and_empirical_sigma_agree(noise_px: float, part: str) -> None:
    errors, reported = simulate(400, noise_px, part)
    empirical = errors.var(axis=0)
    stated = reported.mean(axis=0)
    ratio = rms_over_places(stated) / rms_over_places(empirical)
    assert np.all(np.abs(ratio - 1.0) < 0.1), ratio
    # Place by place, where each empirical figure is itself uncertain by 4 %.
    by_place = np.sqrt(stated / empirical)
    assert np.all(np.abs(by_place - 1.0) < 0.15), (by_place.min(), by_place.max())


def test_leaving_out_that_the_pose_follows_the_intrinsics_would_mislead() -> None:
    pose = fit_pose(THESIS, POINTS, pixels_of(POINTS) + np.random.default_rng(1).normal(0, 0.1, POINTS.shape))
    sigma = position_sigma(THESIS, COVARIANCE_C, pose, GRID).intrinsics_mm
    frozen = position_sigma(
        THESIS, COVARIANCE_C, replace(pose, by_intrinsics=np.zeros((6, 13))), GRID
    ).intrinsics_mm
    assert sigma is not None and frozen is not None
    assert np.sqrt(np.mean(frozen**2)) > 3.0 * np.sqrt(np.mean(sigma**2))


def test_a_pixel_of_a_camera_that_looks_straight_is_its_size() -> None:
    camera = Camera("pinhole", (320, 240), 300.0, 300.0, 0.0, 159.5, 119.5)
    t = np.array([0.0, 0.0, 0.3])
    points = Board(7, 5, 0.02).points_m() - np.array([0.06, 0.04])
    world = np.column_stack([points, np.zeros(len(points))])
    pose = fit_pose(camera, points, project(camera, world + t))
    sigma = position_sigma(camera, None, pose, np.array([[0.0, 0.0], [0.05, 0.03]]))
    # 0.3 m over 300 px is 1 mm per pixel.
    assert sigma.quantisation_mm == pytest.approx(np.full((2, 2), np.sqrt(1 / 12)), rel=1e-9)
    assert sigma.plane_mm.max() < 1e-8
    assert sigma.intrinsics_mm is None
    assert sigma.total_mm == pytest.approx(sigma.quantisation_mm, rel=1e-9)


def test_the_parts_add_up_in_squares() -> None:
    pose = fit_pose(THESIS, POINTS, pixels_of(POINTS) + np.random.default_rng(1).normal(0, 0.1, POINTS.shape))
    sigma = position_sigma(THESIS, COVARIANCE_C, pose, GRID)
    assert sigma.intrinsics_mm is not None
    together = sigma.intrinsics_mm**2 + sigma.plane_mm**2 + sigma.quantisation_mm**2
    assert sigma.total_mm**2 == pytest.approx(together)


def test_places_out_of_sight_are_not_given_a_sigma() -> None:
    pose = fit_pose(THESIS, POINTS, pixels_of(POINTS))
    places = np.array([[0.0, 0.05], [0.5, 0.05], [0.0, 50.0], [-100.0, 0.0]])
    seen = visible(THESIS, pose.R_CW, pose.t_CW_m, places)
    assert seen.tolist() == [True, False, False, False]
    assert np.isfinite(position_sigma(THESIS, None, pose, places).plane_mm[:, 0]).tolist() == seen.tolist()


def test_the_grid_spans_the_box() -> None:
    grid = workspace_grid((-1.0, 2.0, 3.0, 4.0), 3)
    assert grid.tolist() == [[-1, 2], [1, 2], [3, 2], [-1, 3], [1, 3], [3, 3], [-1, 4], [1, 4], [3, 4]]
