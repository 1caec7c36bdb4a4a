"""By how much one record of a motion is later than another."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.solve.delay import clocks, estimate_delay, moments, shares, vertex


def _motion(t: np.ndarray) -> np.ndarray:
    return 0.3 * np.sin(2.0 * t) + 0.1 * np.sin(7.0 * t)


@pytest.mark.parametrize("delay", [0.0, 0.0173, 0.035, 0.4321])
def test_finds_the_delay(delay: float) -> None:
    rng = np.random.default_rng(1)
    t, seen = 0.01 * np.arange(2000), np.arange(0.0, 20.0, 1.0 / 60.0)
    late = _motion(seen - delay) + 0.4 + 0.003 * rng.normal(size=len(seen))
    found = estimate_delay(seen, late, t, _motion(t), _motion(t) + 0.01 * t)
    assert found == pytest.approx(delay, abs=1e-3)


@given(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(-1.0, 1.0))
def test_a_line_in_time_and_the_scale_leave_nothing(scale: float, offset: float, slope: float) -> None:
    t, seen = 0.01 * np.arange(1000), np.arange(0.0, 10.0, 0.02)
    late = scale * _motion(seen) + offset + slope * seen
    sums = moments(seen, late, t, _motion(t), np.array([0.0, 20.0]), 20)
    a, left = shares(sums)
    moved = np.linalg.norm(scale * _motion(seen)) > 1e-6
    assert a[0] == pytest.approx(scale, abs=1e-9)
    # No motion, and a delay at which nothing is shared, leave all.
    assert left == pytest.approx([0.0 if moved else 1.0, 1.0], abs=1e-6 if moved else 1.0)
    if moved:
        assert shares(sums, 1.0)[1][0] == pytest.approx((1.0 / scale - 1.0) ** 2, rel=1e-6, abs=1e-6)


@given(st.floats(-0.5, 0.5), st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
def test_the_vertex_is_where_the_parabola_is_least(at: float, bend: float, least: float) -> None:
    assert vertex(*(bend * (k - at) ** 2 + least for k in (-1, 0, 1))) == pytest.approx(at, abs=1e-6)
    assert vertex(least, least, least) == 0.0


def _swing(t: np.ndarray) -> np.ndarray:
    """Let go at 0.3 s, with periods of 0.25 s of which each is 0.8 times the one before."""
    after = np.maximum(t - 0.3, 0.0)
    return 0.4 * np.exp(np.log(0.8) * after / 0.25) * np.cos(2.0 * np.pi * after / 0.25)


@pytest.mark.parametrize(
    ("scale", "seen_s", "felt_s", "drift", "told", "rate_hz"),
    [
        (1.0, 0.1, 0.0, 0.0, True, 60.0),
        (1.0, 0.1, 0.0, 2e-4, True, 60.0),
        (1.0, 0.3, 0.75, 0.0, False, 60.0),
        (0.85, 0.35, 0.35, 0.0, False, 60.0),
        (1.0, 0.1, 0.0, 0.0, True, 12.0),
        (1.0, 0.31, 0.31, 0.0, True, 15.0),
    ],
)
def test_a_swing_is_not_taken_for_the_one_a_period_later(
    scale: float, seen_s: float, felt_s: float, drift: float, told: bool, rate_hz: float
) -> None:
    rng = np.random.default_rng(2)
    board, seen = np.arange(felt_s, 6.0, 0.01), np.arange(seen_s, 6.0, 1.0 / rate_hz)
    way = scale * _swing(seen) + 0.002 * rng.normal(size=len(seen))
    rates = -(_swing(board + 1e-4) - _swing(board - 1e-4)) / 2e-4 + 0.005 * rng.normal(size=len(board))
    found = clocks((1.0 + drift) * seen - 50.0, way, board, rates, True)
    assert (found is not None) == told
    if found is not None:
        assert found.offset_s == pytest.approx(50.0, abs=3e-3)
