"""The board's place in the world, and the rule that tells the first corner from the last."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.camera.board import Board
from calib.camera.model import Camera, project
from calib.camera.placement import Placement, settle_orientation, world_points_m
from calib.camera.pose import rotation
from calib.errors import BadInputError

CAMERA = Camera(
    "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
THESIS, ASYMMETRIC, SQUARE = Board(7, 5, 0.02), Board(9, 6, 0.015), Board(6, 6, 0.02)


def picture(
    board: Board,
    angle_rad: float,
    roll_deg: float,
    tilt: tuple[float, float] = (0.0, 0.0),
    noise_px: float = 0.0,
) -> np.ndarray:
    """Corners, in their true order, of a board at `angle_rad`, the camera rolled and tilted."""
    centre = world_points_m(board, (0.01, 0.05), angle_rad)
    R = rotation(np.array([tilt[0], tilt[1], 0.0])) @ rotation(np.array([0.0, 0.0, np.radians(roll_deg)]))
    t = np.array([0.0, 0.0, 0.3]) - R[:, :2] @ centre.mean(axis=0)
    pixels = project(CAMERA, centre @ R[:, :2].T + t)
    return pixels + np.random.default_rng(5).normal(0.0, noise_px, pixels.shape)


def detections(board: Board, pixels: np.ndarray) -> list[np.ndarray]:
    """Every order in which a detector may report these corners without mirroring them."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    turns = range(4) if board.rows == board.columns else (0, 2)
    return [np.rot90(grid, turn).reshape(-1, 2) for turn in turns]


def test_world_points_turn_with_the_board() -> None:
    at_zero = world_points_m(Board(3, 2, 0.1), (1.0, 2.0), 0.0)
    assert at_zero == pytest.approx(np.array([[1, 2], [1.1, 2], [1.2, 2], [1, 2.1], [1.1, 2.1], [1.2, 2.1]]))
    # Columns along +y; the rows axis is a quarter turn clockwise from it, along -x.
    turned = world_points_m(Board(3, 2, 0.1), (1.0, 2.0), np.pi / 2)
    assert turned == pytest.approx(np.array([[1, 2], [1, 2.1], [1, 2.2], [0.9, 2], [0.9, 2.1], [0.9, 2.2]]))


@pytest.mark.parametrize("board", [THESIS, ASYMMETRIC])
@pytest.mark.parametrize("roll_deg", [-89.0, -60.0, 0.0, 30.0, 89.0])
@pytest.mark.parametrize("angle_deg", [-180.0, -135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0])
def test_the_true_order_is_found_at_all_angles(board: Board, roll_deg: float, angle_deg: float) -> None:
    angle_rad = np.radians(angle_deg)
    truth = picture(board, angle_rad, roll_deg, noise_px=0.05)
    for turns, seen in zip((0, 2), detections(board, truth), strict=True):
        placement = settle_orientation(seen, board, angle_rad)
        assert np.array_equal(placement.pixels, truth)
        assert placement.quarter_turns == turns
        assert placement.x_axis_deg == pytest.approx(roll_deg, abs=0.3)


@pytest.mark.parametrize("roll_deg", [-44.0, 0.0, 44.0])
@pytest.mark.parametrize("angle_deg", [-170.0, -90.0, 0.0, 20.0, 45.0, 100.0])
def test_square_boards_are_settled_among_quarter_turns(roll_deg: float, angle_deg: float) -> None:
    angle_rad = np.radians(angle_deg)
    truth = picture(SQUARE, angle_rad, roll_deg, noise_px=0.05)
    for seen in detections(SQUARE, truth):
        placement = settle_orientation(seen, SQUARE, angle_rad)
        assert np.array_equal(placement.pixels, truth)
        assert "45 degrees" in placement.how


@settings(max_examples=60, deadline=None)
@given(
    angle_rad=st.floats(-np.pi, np.pi),
    roll_deg=st.floats(-75.0, 75.0),
    tilt_x=st.floats(-0.3, 0.3),
    tilt_y=st.floats(-0.3, 0.3),
    reverse=st.booleans(),
)
def test_oblique_views(
    angle_rad: float, roll_deg: float, tilt_x: float, tilt_y: float, reverse: bool
) -> None:
    truth = picture(THESIS, angle_rad, roll_deg, (tilt_x, tilt_y))
    placement = settle_orientation(truth[::-1] if reverse else truth, THESIS, angle_rad)
    assert np.array_equal(placement.pixels, truth)


@pytest.mark.parametrize("board", [THESIS, ASYMMETRIC, SQUARE])
def test_no_candidate_mirrors_the_grid(board: Board) -> None:
    truth = picture(board, 0.3, 10.0)
    for seen in detections(board, truth):
        grid = settle_orientation(seen, board, 0.3).pixels.reshape(board.rows, board.columns, 2)
        along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        assert along[0] * down[1] - along[1] * down[0] > 0


def test_the_first_corner_given_overrules_the_rule() -> None:
    truth = picture(THESIS, 0.0, 170.0)
    by_rule = settle_orientation(truth, THESIS, 0.0)
    assert np.array_equal(by_rule.pixels, truth[::-1])
    given = settle_orientation(truth[::-1], THESIS, 0.0, first_corner_px=truth[0] + np.array([2.0, -3.0]))
    assert np.array_equal(given.pixels, truth)
    assert "first_corner_px" in given.how
    assert abs(given.x_axis_deg) == pytest.approx(170.0, abs=0.5)
    for turns, seen in enumerate(detections(SQUARE, picture(SQUARE, 0.0, 80.0))):
        first = picture(SQUARE, 0.0, 80.0)[0]
        assert settle_orientation(seen, SQUARE, 0.0, first).quarter_turns == (4 - turns) % 4


def test_the_result_says_how_it_was_settled() -> None:
    placement: Placement = settle_orientation(picture(THESIS, 0.0, 12.0)[::-1], THESIS, 0.0)
    first = placement.pixels[0]
    assert f"({first[0]:.1f}, {first[1]:.1f})" in placement.how
    assert "12.0 degrees down" in placement.how


@pytest.mark.parametrize("roll_deg", [90.0, -90.0, 90.2, -89.8])
def test_an_axis_straight_up_or_down_is_not_guessed(roll_deg: float) -> None:
    with pytest.raises(BadInputError, match="first_corner_px"):
        settle_orientation(picture(THESIS, 1.0, roll_deg), THESIS, 1.0)


def test_a_square_board_at_45_degrees_is_not_guessed() -> None:
    with pytest.raises(BadInputError, match="first_corner_px"):
        settle_orientation(picture(SQUARE, 0.0, 45.0), SQUARE, 0.0)


def test_a_first_corner_far_from_every_candidate_is_refused() -> None:
    truth = picture(THESIS, 0.0, 0.0)
    middle = truth.mean(axis=0)
    with pytest.raises(BadInputError, match="within half a square"):
        settle_orientation(truth, THESIS, 0.0, middle)
    with pytest.raises(BadInputError, match="two numbers"):
        settle_orientation(truth, THESIS, 0.0, (1.0, 2.0, 3.0))


def test_mirrored_and_incomplete_grids_are_refused() -> None:
    truth = picture(THESIS, 0.0, 0.0)
    mirrored = truth.reshape(5, 7, 2)[:, ::-1].reshape(-1, 2)
    with pytest.raises(BadInputError, match=r"shot\.png: the grid of corners is mirrored"):
        settle_orientation(mirrored, THESIS, 0.0, name="shot.png")
    with pytest.raises(BadInputError, match="7x5 finite corners"):
        settle_orientation(truth[:-1], THESIS, 0.0)
    with pytest.raises(BadInputError, match="7x5 finite corners"):
        settle_orientation(np.where(truth == truth[3], np.nan, truth), THESIS, 0.0)
    with pytest.raises(BadInputError, match="shows no direction"):
        settle_orientation(truth[:7], Board(7, 1, 0.02), 0.0)


@pytest.mark.parametrize("turn", [0, 2])
def test_flags_of_corners_follow_their_corners(turn: int) -> None:
    board = Board(4, 3, 0.01)
    flags = np.arange(12) % 5 == 0
    pixels = 20.0 * np.stack([np.tile(np.arange(4), 3), np.repeat(np.arange(3), 4)], axis=1) + 50.0
    given = np.rot90(pixels.reshape(3, 4, 2), turn).reshape(-1, 2)
    given_flags = np.rot90(flags.reshape(3, 4), turn).ravel()
    placed = settle_orientation(given, board, 0.0)
    np.testing.assert_array_equal(placed.pixels, pixels)
    np.testing.assert_array_equal(placed.reordered(given_flags, board), flags)
