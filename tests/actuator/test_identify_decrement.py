"""Damping by peaks: the known ratio, whatever offset creeps under it and whatever single readings say."""

from __future__ import annotations

import numpy as np
import pytest

from calib.actuator.identify_decrement import decrement, without_outliers
from calib.errors import BadInputError

T = np.arange(480) / 60.0


def _swing(zeta: float = 0.05, hz: float = 4.0, offset: float = 0.0) -> np.ndarray:
    w = 2.0 * np.pi * hz
    swing = 0.5 * np.exp(-zeta * w * T) * np.cos(w * np.sqrt(1.0 - zeta**2) * T)
    return swing + offset * np.exp(-T / 0.4)


@pytest.mark.parametrize("zeta", [0.01, 0.0513, 0.12])
def test_the_ratio_of_an_ideal_swing(zeta: float) -> None:
    found = decrement(T, _swing(zeta))
    assert found.zeta == pytest.approx(zeta, rel=0.03)
    assert found.frequency_hz == pytest.approx(4.0 * np.sqrt(1.0 - zeta**2), rel=0.01)


def test_an_offset_that_creeps_does_not_count() -> None:
    assert decrement(T, _swing(offset=0.04)).zeta == pytest.approx(0.05, rel=0.05)


def test_outliers_make_no_peaks() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(20):
        phi = _swing() + 0.008 * rng.standard_normal(len(T))
        phi[rng.integers(0, 480, 4)] += rng.choice([-0.4, 0.4], 4)
        found = decrement(T, phi, 0.008)
        errors.append((found.zeta - 0.05) / found.sigma)
    assert np.median(np.abs(errors)) < 2.0
    assert abs(np.median(errors)) < 1.5


def test_single_readings_are_replaced_and_a_swing_is_left_alone() -> None:
    clean = _swing()
    kept, none = without_outliers(clean)
    assert none <= 2
    dirty = clean.copy()
    dirty[100] += 0.5
    mended, count = without_outliers(dirty)
    assert count >= 1
    assert abs(mended[100] - clean[100]) < 0.15
    assert np.abs(kept - clean).max() < 0.05


def test_a_rig_that_does_not_swing_is_refused() -> None:
    with pytest.raises(BadInputError, match="extremes"):
        decrement(T, np.exp(-T))
