"""Aspect and bow of a board, measured while the camera is calibrated."""

from __future__ import annotations

import numpy as np
import pytest
from sets import Recipe, camera_of, take

from calib.camera.board import Board
from calib.camera.board_shape import DEFORMATIONS, TargetShape, target_shape
from calib.camera.bundle import calibrate
from calib.camera.views import pack


def _shape(recipe: Recipe, seed: int = 0, count: int = 17) -> TargetShape:
    views = take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)
    found = target_shape(calibrate(pack(views), (640, 480), "radial2"))
    assert found is not None
    return found


@pytest.mark.parametrize("aspect", [0.95, 0.99, 1.0, 1.02])
def test_aspect_is_measured(aspect: float) -> None:
    found = _shape(Recipe(aspect=aspect))
    assert found.aspect == pytest.approx(aspect - 1, abs=max(4 * found.aspect_sigma, 0.05 * abs(aspect - 1)))
    assert found.aspect_sigma < 0.005


@pytest.mark.parametrize("bow_m", [-0.003, -0.0005, 0.001, 0.003])
def test_bow_is_measured(bow_m: float) -> None:
    found = _shape(Recipe(bow_m=bow_m))
    along_x = found.values[DEFORMATIONS.index("bow_x")]
    assert along_x == pytest.approx(bow_m, abs=4 * found.sigma[2] + 0.05 * abs(bow_m))
    assert found.bow_m == pytest.approx(abs(bow_m), rel=0.15)
    assert found.bow_significance > 4
    assert found.size_m == pytest.approx(0.12)
    assert found.rms_drop > 0.05


def test_a_flat_board_of_square_squares_is_left_alone() -> None:
    for seed in range(5):
        found = _shape(Recipe(), seed)
        assert found.bow_significance < 3.5
        assert abs(found.aspect) < 4 * found.aspect_sigma
        assert found.rms_drop < 0.02


def test_one_step_is_as_good_as_fitting() -> None:
    board = Board(9, 6, 0.025)
    target = board.points_m()
    views = take(np.random.default_rng(1), camera_of(), 15, target, Recipe(bow_m=0.002))
    fit = calibrate(pack(views), (640, 480), "radial2")
    found = target_shape(fit)
    assert found is not None
    half = 0.5 * found.size_m
    x, y = (target - target.mean(axis=0)).T
    zero = np.zeros_like(x)
    basis = np.array(
        [
            [zero, y, zero],
            [y, zero, zero],
            [zero, zero, 1 - (x / half) ** 2],
            [zero, zero, 1 - (y / half) ** 2],
            [zero, zero, x * y / half**2],
        ]
    )
    exact = calibrate(pack(views), (640, 480), "radial2", basis=basis, start=fit.block)
    np.testing.assert_allclose(found.values, exact.block.deformation, rtol=0.05, atol=1e-4)
    assert found.rms_drop == pytest.approx(1 - exact.rms_px / fit.rms_px, abs=0.01)
    assert found.focal_shift == pytest.approx(exact.camera.fx_px / fit.camera.fx_px - 1, rel=0.1, abs=3e-4)
    np.testing.assert_allclose(
        found.displacement_m[0].T, np.tensordot(found.values, basis, axes=1), atol=1e-12
    )


def test_parallel_views_hang_on_flatness() -> None:
    assert _shape(Recipe(tilt_deg=(0.0, 5.0))).focal_per_bow > 1.5 * _shape(Recipe()).focal_per_bow


def test_too_few_data_give_no_shape() -> None:
    views = take(np.random.default_rng(2), camera_of(), 1)
    corners = [0, 6, 28, 34, 17]
    few = [v.__class__(v.name, v.target_m[corners], v.pixels[corners]) for v in views]
    fit = calibrate(pack(few), (640, 480), "pinhole", fixed=("cx_px", "cy_px"))
    assert target_shape(fit) is None
