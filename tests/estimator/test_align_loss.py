"""Losses: their slopes against differences, and the jitter that simulated pixels had."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimator.align_loss import HUBER, best_jitter_px, imu_terms, pixel_terms

AREA = 1256.0


def _terms(off: np.ndarray, jitter: float, grid: float, share: float) -> tuple[float, np.ndarray, np.ndarray]:
    pull, weight, good = np.empty(off.shape), np.empty(off.shape), np.empty(len(off))
    loss = pixel_terms(off, jitter, grid, share, AREA, pull, weight, good)
    return loss, pull, good


@pytest.mark.parametrize("grid", [0.0, 1.0])
@pytest.mark.parametrize("off", [(0.1, -0.4), (1.3, 0.2), (2.6, -1.9), (9.0, 4.0)])
def test_the_pull_is_the_slope_of_the_loss(grid: float, off: tuple[float, float]) -> None:
    at, step = np.array([off]), 1e-6
    _, pull, good = _terms(at, 0.35, grid, 0.01)
    for k in range(2):
        ahead, back = at.copy(), at.copy()
        ahead[0, k] += step
        back[0, k] -= step
        slope = (_terms(ahead, 0.35, grid, 0.01)[0] - _terms(back, 0.35, grid, 0.01)[0]) / (2 * step)
        # Beyond six deviations the truncated normal's mean is an approximation; pulls are of the order 3.
        assert pull[0, k] == pytest.approx(slope, rel=1e-4, abs=1e-5)
    assert (good[0] < 0.01) == (abs(off[0]) > 2.0)


def test_a_picture_that_is_not_finite_has_no_say() -> None:
    _, pull, good = _terms(np.array([[np.nan, 0.0], [0.1, 0.2]]), 0.3, 1.0, 0.01)
    assert good[0] == 0.0
    assert np.array_equal(pull[0], [0.0, 0.0])
    assert good[1] > 0.99


@pytest.mark.parametrize("jitter", [0.2, 0.35, 0.7])
def test_jitter_is_found_below_a_pixel(jitter: float) -> None:
    rng = np.random.default_rng(3)
    place = rng.uniform(0.0, 100.0, (20000, 2))
    seen = np.rint(place + jitter * rng.standard_normal(place.shape))
    seen[:60] += rng.uniform(5.0, 14.0, (60, 2))
    assert best_jitter_px(seen - place, 1.0, 0.003, AREA) == pytest.approx(jitter, rel=0.03)


def test_readings_have_a_loss_with_a_far_knee() -> None:
    noise = np.array([0.1, 0.2, 0.01])
    off = np.array([[0.05, np.nan, 0.2], [-0.1, 1.6, 0.0]])
    loss, pull, weight = imu_terms(off, noise)
    by_hand = 0.5 * 0.5**2 + 0.5 * 1.0**2 + HUBER * (8.0 - 0.5 * HUBER) + HUBER * (20.0 - 0.5 * HUBER)
    assert loss == pytest.approx(by_hand)
    assert weight[0, 1] == 0.0
    assert pull[0, 1] == 0.0
    assert pull[0, 2] == pytest.approx(HUBER / 0.01)
    assert pull[0, 0] == pytest.approx(0.05 / 0.01)
