"""Poses, the map from rays to the sheet, and its colours."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.camera.model import Board, Camera, project, undistort
from calib.twin.scene import (
    Pose,
    PrintedBoard,
    board_coordinates,
    corner_pixels,
    pose_facing,
    rotation,
    tones,
)

BOARD = Board(7, 5, 0.02)
RADIAL2 = np.array([-0.2201, 0.5494, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
CAMERA = Camera("radial2", (316, 208), 273.0, 272.0, 1.5, 160.0, 101.0, RADIAL2)


def _random_pose(rng: np.random.Generator, printed: PrintedBoard) -> Pose:
    pixel = (rng.uniform(80, 240), rng.uniform(60, 150))
    tilt, azimuth, roll = rng.uniform(0, 1.0), rng.uniform(-3, 3), rng.uniform(-3, 3)
    return pose_facing(CAMERA, printed, pixel, rng.uniform(0.25, 0.6), tilt, azimuth, roll)


def test_rotation_is_a_rotation_that_tilts_by_the_angle() -> None:
    rng = np.random.default_rng(0)
    for tilt, azimuth, roll in rng.uniform(-1.4, 1.4, (50, 3)):
        R = rotation(tilt, azimuth, roll)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert R[2, 2] == pytest.approx(math.cos(tilt))
        np.testing.assert_allclose(rotation(0.0, azimuth, roll), rotation(0.0, 0.0, roll), atol=1e-15)


def test_rotation_pushes_the_named_side_away_and_rolls_clockwise() -> None:
    right = rotation(0.3, 0.0) @ np.array([1.0, 0.0, 0.0])
    below = rotation(0.3, math.pi / 2) @ np.array([0.0, 1.0, 0.0])
    assert right[2] == pytest.approx(math.sin(0.3))
    assert below[2] == pytest.approx(math.sin(0.3))
    # u right and v down: a positive roll moves the columns axis from right towards down.
    np.testing.assert_allclose(rotation(0.0, 0.0, math.pi / 2)[:, 0], [0.0, 1.0, 0.0], atol=1e-15)


def test_pose_facing_puts_the_middle_where_it_is_told() -> None:
    rng = np.random.default_rng(1)
    printed = PrintedBoard(BOARD, aspect=1.1)
    for _ in range(20):
        pixel, distance = rng.uniform((0, 0), (315, 207)), rng.uniform(0.2, 1.0)
        pose = pose_facing(CAMERA, printed, (pixel[0], pixel[1]), distance, 0.5, *rng.uniform(-3, 3, 2))
        middle = pose.R_CB @ printed.centre_m + pose.t_m
        assert middle[2] == pytest.approx(distance)
        np.testing.assert_allclose(project(CAMERA, middle), pixel, atol=1e-9)


def test_pose_facing_refuses_a_pixel_without_a_ray() -> None:
    barrel = Camera("radial2", (316, 208), 100.0, 100.0, 0.0, 160.0, 101.0, -0.4 * np.eye(8)[0])
    with pytest.raises(BadInputError, match="fold"):
        pose_facing(barrel, PrintedBoard(BOARD), (315.0, 207.0), 0.4)


def test_flat_corners_are_the_boards() -> None:
    points = PrintedBoard(BOARD).points_m()
    np.testing.assert_allclose(points[:, :2], BOARD.points_m(), atol=0)
    assert np.all(points[:, 2] == 0.0)


def test_aspect_stretches_rows_and_bow_is_a_parabola_over_the_corners() -> None:
    printed = PrintedBoard(BOARD, aspect=1.25, bow_m=(0.003, 0.001))
    points = printed.points_m()
    assert points[-1, :2] == pytest.approx((0.12, 0.1))
    grid = points[:, 2].reshape(5, 7)
    np.testing.assert_allclose(grid[[0, 0, -1, -1], [0, -1, 0, -1]], 0.0, atol=1e-18)
    assert grid[2, 3] == pytest.approx(0.004)
    assert grid[0, 3] == pytest.approx(0.003)
    assert grid[2, 0] == pytest.approx(0.001)
    np.testing.assert_allclose(np.diff(grid, n=3, axis=1), 0.0, atol=1e-17)


def test_bow_slopes_are_its_derivatives() -> None:
    printed = PrintedBoard(BOARD, bow_m=(0.003, -0.002))
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.05, 0.2, (2, 40))
    h = 1e-6
    _, zx, zy = printed.depth_m(x, y)
    np.testing.assert_allclose(
        (printed.depth_m(x + h, y)[0] - printed.depth_m(x - h, y)[0]) / (2 * h), zx, atol=1e-9
    )
    np.testing.assert_allclose(
        (printed.depth_m(x, y + h)[0] - printed.depth_m(x, y - h)[0]) / (2 * h), zy, atol=1e-9
    )


@pytest.mark.parametrize("bow_m", [(0.0, 0.0), (0.003, 0.0), (-0.01, 0.004)])
def test_rays_of_projected_corners_meet_the_sheet_in_the_corners(bow_m: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    printed = PrintedBoard(BOARD, aspect=0.9, bow_m=bow_m)
    for _ in range(20):
        pose = _random_pose(rng, printed)
        rays = undistort(CAMERA, corner_pixels(CAMERA, printed, pose))
        x, y = board_coordinates(printed, pose, rays)
        np.testing.assert_allclose(np.column_stack([x, y]), printed.points_m()[:, :2], atol=1e-10)


def test_the_back_of_the_sheet_and_what_lies_behind_the_camera_are_not_seen() -> None:
    printed = PrintedBoard(BOARD)
    rays = np.array([[0.0, 0.0], [0.05, 0.02]])
    turned = Pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.06, -0.04, 0.4]))
    behind = Pose(np.eye(3), np.array([-0.06, -0.04, -0.4]))
    for pose in (turned, behind):
        assert np.isnan(np.column_stack(board_coordinates(printed, pose, rays))).all()


def test_colours_alternate_and_end_with_the_board() -> None:
    printed = PrintedBoard(BOARD)
    j, i = np.mgrid[-3:8, -3:10]
    x, y = (i - 0.5) * 0.02, (j - 0.5) * 0.02
    ramp = np.full(x.shape, 1e-4)
    ink, sheet = tones(printed, x, y, ramp, ramp)
    on_board = (i >= 0) & (i <= 7) & (j >= 0) & (j <= 5)
    on_sheet = (i >= -1) & (i <= 8) & (j >= -1) & (j <= 6)
    np.testing.assert_array_equal(ink, on_board & ((i + j) % 2 == 0))
    np.testing.assert_array_equal(sheet, on_sheet)


def test_white_squares_at_the_border_join_the_margin_without_a_line() -> None:
    printed = PrintedBoard(BOARD)
    x = np.linspace(-0.03, 0.0, 301)
    y = np.full_like(x, 0.01)  # the second row begins with a white square
    ink, _ = tones(printed, x, y, np.full_like(x, 1e-3), np.full_like(x, 1e-3))
    assert np.all(ink[x < -1e-3] == 0.0)


def test_ramps_hold_as_much_ink_as_steps() -> None:
    printed = PrintedBoard(BOARD)
    x = (np.arange(40000) + 0.5) / 40000 * 0.24 - 0.06
    y = np.full_like(x, -0.01)
    for width in (1e-5, 1e-3, 5e-3):
        ink, sheet = tones(printed, x, y, np.full_like(x, width), np.full_like(x, 1e-5))
        assert ink.sum() / 40000 * 0.24 == pytest.approx(4 * 0.02, rel=1e-3)
        assert sheet.sum() / 40000 * 0.24 == pytest.approx(0.2, rel=1e-3)
