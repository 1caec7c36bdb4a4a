"""The desk behind the board and the sensor's noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import stats

from calib.twin.sensors import clutter, gaussian_noise, uniform


def test_noise_is_standard_normal() -> None:
    noise = gaussian_noise(np.random.PCG64(1), (400, 500)).ravel()
    assert abs(noise.mean()) < 4.0 / np.sqrt(noise.size)
    assert abs(noise.var() - 1.0) < 4.0 * np.sqrt(2.0 / noise.size)
    assert abs(stats.kurtosis(noise) - (-1.2 / 16)) < 0.05
    quantiles = np.quantile(noise, [0.0228, 0.1587, 0.8413, 0.9772])
    np.testing.assert_allclose(quantiles, [-2.0, -1.0, 1.0, 2.0], atol=0.03)


def test_noise_is_white() -> None:
    noise = gaussian_noise(np.random.PCG64(2), (300, 300))
    assert abs((noise[1:] * noise[:-1]).mean()) < 0.015
    assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 0.015


def test_uniform_is_uniform() -> None:
    values = uniform(np.random.PCG64(3), 20000)
    assert stats.kstest(values, "uniform").pvalue > 0.01


def test_noise_is_the_sum_of_the_raw_bytes() -> None:
    bits = np.random.PCG64(7)
    words = [[int(bits.random_raw()) for _ in range(2)] for _ in range(6)]
    sums = [sum((word >> shift) & 255 for word in pair for shift in range(0, 64, 8)) for pair in words]
    noise = gaussian_noise(np.random.PCG64(7), (2, 3)).ravel() * np.sqrt(16 * 65535 / 12)
    np.testing.assert_allclose(noise, np.array(sums) - 16 * 127.5, atol=1e-9)


def test_clutter_depends_on_its_seed_only() -> None:
    first = clutter((316, 208), 5)
    assert first.shape == (208, 316)
    assert np.array_equal(first, clutter((316, 208), 5))
    assert not np.array_equal(first, clutter((316, 208), 6))


@pytest.mark.parametrize("seed", range(6))
def test_clutter_is_cluttered_but_holds_no_board(seed: int) -> None:
    picture = clutter((316, 208), seed)
    assert picture.min() >= 0.03
    assert picture.max() <= 0.95
    assert picture.std() > 0.05
    grey = np.round(255 * picture).astype(np.uint8)
    assert not cv2.findChessboardCornersSB(grey, (7, 5))[0]
    assert not cv2.findChessboardCorners(grey, (7, 5))[0]
