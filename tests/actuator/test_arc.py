"""The arc's functions against multiple precision, against each other and near zero."""

from __future__ import annotations

from math import factorial

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.arc import (
    FULL_CIRCLE_RAD,
    chord_curvature,
    chord_decay,
    chord_decay_w,
    chord_ratio,
    chord_ratio_w,
    chord_slope,
)

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.01, 0.1, 0.7, 1.5, np.pi / 2, 2.0, np.pi, 4.0, 5.5, 6.2]


def exact(phi: float) -> tuple[float, float, float, float]:
    """S, S', S'', D with 60 digits, from the definition and its derivatives."""
    with mpmath.workdps(60):

        def S(x: mpmath.mpf) -> mpmath.mpf:
            return mpmath.sinc(x / 2)

        x = mpmath.mpf(phi)
        first, second = mpmath.diff(S, x), mpmath.diff(S, x, 2)
        decay = (S(x) - mpmath.cos(x / 2)) / x**2 if abs(phi) > 1e-10 else mpmath.mpf(1) / 12
        return float(S(x)), float(first), float(second), float(decay)


@pytest.mark.parametrize("phi", ANGLES)
def test_series_reach_machine_precision(phi: float) -> None:
    S, _, _, D = exact(phi)
    first_left_out = (phi / 2) ** 26 / factorial(27)
    assert chord_ratio_w(phi * phi) == pytest.approx(S, abs=4e-16 + first_left_out)
    assert chord_decay_w(phi * phi) == pytest.approx(D, abs=1e-16)
    assert float(chord_ratio(np.array(phi))) == pytest.approx(S, abs=4e-16)


@pytest.mark.parametrize("phi", [0.01, 0.7, -1.5, 3.0, 6.0])
def test_derivatives_match_multiple_precision(phi: float) -> None:
    _, S1, S2, _ = exact(phi)
    assert float(chord_slope(np.array(phi))) == pytest.approx(S1, rel=1e-13, abs=1e-15)
    assert float(chord_curvature(np.array(phi))) == pytest.approx(S2, rel=1e-12, abs=1e-15)


def test_limits_at_zero_curvature() -> None:
    assert float(chord_ratio(np.array(0.0))) == 1.0
    assert float(chord_decay(np.array(0.0))) == pytest.approx(1 / 12, rel=1e-15)
    assert float(chord_curvature(np.array(0.0))) == pytest.approx(-1 / 12, rel=1e-15)
    # S' = -phi / 12 keeps its relative precision where a difference quotient would have none.
    assert float(chord_slope(np.array(1e-300))) == pytest.approx(-1e-300 / 12, rel=1e-15)


@given(st.floats(-FULL_CIRCLE_RAD, FULL_CIRCLE_RAD))
def test_even_and_odd(phi: float) -> None:
    at, mirrored = np.array(phi), np.array(-phi)
    assert chord_ratio(at) == chord_ratio(mirrored)
    assert chord_decay(at) == chord_decay(mirrored)
    assert chord_slope(at) == -chord_slope(mirrored)


@given(st.floats(1e-3, 6.28))
def test_decay_definition(phi: float) -> None:
    """phi^2 D = S - cos(phi / 2)."""
    left = phi * phi * float(chord_decay(np.array(phi)))
    assert left == pytest.approx(float(chord_ratio(np.array(phi))) - np.cos(phi / 2), abs=6e-16)


def test_closed_circle_has_no_chord() -> None:
    assert abs(chord_ratio_w(FULL_CIRCLE_RAD**2)) < 1e-15
