"""Figures read off curves that are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.twin.scenarios import fall_time_s, step_response, swing_decay

T = 1e-3 * np.arange(5001)


def _swing(zeta: float, hertz: float, offset: float) -> np.ndarray:
    """Released at rest from 0.5 rad above an offset that decays in a third of a second."""
    w = 2.0 * math.pi * hertz
    wd = w * math.sqrt(1.0 - zeta * zeta)
    shape = np.exp(-zeta * w * T) * (np.cos(wd * T) + zeta * w / wd * np.sin(wd * T))
    return 0.5 * shape + offset * np.exp(-3.0 * T)


@pytest.mark.parametrize("zeta", [0.02, 0.0513, 0.1])
def test_damping_and_frequency_without_an_offset(zeta: float) -> None:
    swing = swing_decay(T, _swing(zeta, 4.0, 0.0))
    assert swing.damping_ratio == pytest.approx(zeta, rel=1e-4)
    assert swing.frequency_hz == pytest.approx(4.0 * math.sqrt(1.0 - zeta**2), rel=1e-4)
    assert np.abs(swing.offset_rad).max() < 0.5 * 0.02 + zeta


def test_peak_to_peak_amplitudes_do_not_see_the_offset() -> None:
    phi = _swing(0.0513, 4.0, 0.05)
    assert swing_decay(T, phi).damping_ratio == pytest.approx(0.0513, rel=0.12)
    swing = swing_decay(T, phi)
    late = swing.offset_at_s > 0.4
    assert swing.offset_rad[late] == pytest.approx(0.05 * np.exp(-3.0 * swing.offset_at_s[late]), abs=4e-3)


def test_a_curve_without_extremes_is_refused() -> None:
    with pytest.raises(BadInputError, match="swing: found 1 extremes, expected at least 3"):
        swing_decay(T, np.exp(-T))


def test_a_first_order_response_never_reaches() -> None:
    response = step_response(1e-3, 1.0 - np.exp(-T / 0.5), 1.0)
    assert response.reach_s is None
    assert response.peak < 1.0
    assert response.settle_s == pytest.approx(0.5 * math.log(50.0), abs=2e-3)


def test_an_overshooting_response() -> None:
    zeta, w = 0.5, 4.0
    wd = w * math.sqrt(1.0 - zeta**2)
    y = 0.7 * (1.0 - np.exp(-zeta * w * T) * (np.cos(wd * T) + zeta * w / wd * np.sin(wd * T)))
    response = step_response(1e-3, y, 0.7)
    assert response.reach_s == pytest.approx((math.pi - math.acos(zeta)) / wd, abs=1e-5)
    assert response.peak == pytest.approx(
        0.7 * (1.0 + math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))), rel=1e-5
    )
    assert response.settle_s is not None
    assert np.all(np.abs(y[round(response.settle_s / 1e-3) :] - 0.7) <= 0.02 * 0.7)
    assert step_response(1e-3, y[:800], 0.7).settle_s is None


def test_a_response_that_starts_there() -> None:
    response = step_response(0.1, np.ones(5), 1.0)
    assert (response.reach_s, response.settle_s) == (0.0, 0.0)


def test_fall_times() -> None:
    assert fall_time_s(1e-3, np.exp(-T)) == pytest.approx(math.log(20.0), abs=2e-3)
    assert fall_time_s(1e-3, np.ones(10)) is None
