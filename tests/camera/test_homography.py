"""The direct homography: exact recovery, gradients, covariance."""

from __future__ import annotations

import numpy as np
import pytest

from calib.camera.board import Board
from calib.camera.homography import apply_homography, fit_homography, grouped_variance, map_jacobian
from calib.errors import BadInputError

H_TRUE = np.array([[820.0, 35.0, 95.0], [-60.0, 760.0, 70.0], [0.9, -0.6, 1.0]])
POINTS = Board(7, 5, 0.02).points_m() + np.array([-0.05, 0.02])


def at_centroid(H: np.ndarray) -> np.ndarray:
    """H with depth 1 at the centroid of the points."""
    return np.asarray(H / (H[2, :2] @ POINTS.mean(axis=0) + H[2, 2]))


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_exact_pixels_give_the_homography_back(scale: float, offset: float) -> None:
    points = POINTS * scale + offset * scale
    H = H_TRUE @ np.linalg.inv(np.array([[scale, 0, offset * scale], [0, scale, offset * scale], [0, 0, 1]]))
    fit = fit_homography(points, apply_homography(H, points))
    back = apply_homography(fit.H, points)
    assert np.abs(back - apply_homography(H_TRUE, POINTS)).max() < 1e-8
    assert fit.rms_px < 1e-9
    assert fit.H[2, :2] @ points.mean(axis=0) + fit.H[2, 2] == pytest.approx(1.0, abs=1e-9)


def test_four_points_fix_it_without_an_error_estimate() -> None:
    corners = POINTS[[0, 6, 28, 34]]
    fit = fit_homography(corners, apply_homography(H_TRUE, corners))
    assert np.abs(apply_homography(fit.H, POINTS) - apply_homography(H_TRUE, POINTS)).max() < 1e-9
    assert np.isnan(fit.sigma_px)


def test_it_is_the_minimum_of_the_distances_in_pixels() -> None:
    rng = np.random.default_rng(1)
    pixels = apply_homography(H_TRUE, POINTS) + rng.normal(0.0, 0.5, POINTS.shape)
    H = fit_homography(POINTS, pixels).H

    def cost(H: np.ndarray) -> float:
        return float(np.sum((apply_homography(H, POINTS) - pixels) ** 2))

    best = cost(H)
    for entry in range(9):
        for sign in (-1.0, 1.0):
            nudged = H.copy().ravel()
            nudged[entry] += sign * 1e-5 * max(abs(nudged[entry]), 1.0)
            assert cost(nudged.reshape(3, 3)) >= best


def test_map_jacobian_against_finite_differences() -> None:
    step = 1e-7
    numeric = np.stack(
        [
            (apply_homography(H_TRUE, POINTS + d) - apply_homography(H_TRUE, POINTS - d)) / (2 * step)
            for d in (np.array([step, 0.0]), np.array([0.0, step]))
        ],
        axis=-1,
    )
    assert np.abs(map_jacobian(H_TRUE, POINTS) - numeric).max() < 1e-4


def test_beyond_the_horizon_there_is_nothing() -> None:
    beyond = np.array([[-2.0, 0.0]])
    assert H_TRUE[2] @ np.array([-2.0, 0.0, 1.0]) < 0.0
    assert np.all(np.isnan(apply_homography(H_TRUE, beyond)))


def test_covariance_agrees_with_many_draws() -> None:
    rng = np.random.default_rng(2)
    sigma = 0.2
    clean = apply_homography(H_TRUE, POINTS)
    drawn, reported = [], []
    for _ in range(600):
        fit = fit_homography(POINTS, clean + rng.normal(0.0, sigma, clean.shape))
        drawn.append(fit.H.ravel())
        reported.append(np.diag(fit.covariance))
    assert np.mean(drawn, axis=0) == pytest.approx(at_centroid(H_TRUE).ravel(), rel=0.02, abs=0.01)
    ratio = np.std(drawn, axis=0) / np.sqrt(np.mean(reported, axis=0))
    assert np.all(np.abs(ratio - 1.0) < 0.1), ratio


def test_grouped_variance_counts_repeated_errors_once() -> None:
    rng = np.random.default_rng(3)
    points, copies, sigma = 2000, 4, 0.3
    groups = np.tile(np.arange(points), copies)
    independent = rng.normal(0.0, sigma, (points * copies, 2))
    assert grouped_variance(independent, groups, 0) == pytest.approx(sigma**2, rel=0.06)
    repeated = np.tile(rng.normal(0.0, sigma, (points, 2)), (copies, 1))
    assert grouped_variance(repeated, groups, 0) == pytest.approx(copies * sigma**2, rel=0.06)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (POINTS[:3], "at least 4"),
        (POINTS[:7], "one line"),
        (POINTS[[0, 1, 2, 3, 30]], "one line"),
        (np.repeat(POINTS[:1], 5, axis=0), "one line"),
    ],
)
def test_too_little_is_refused(points: np.ndarray, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        fit_homography(points, apply_homography(H_TRUE, points))
