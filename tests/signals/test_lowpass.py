"""The first-order low-pass against SciPy's design and filter, and its delay."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, group_delay, lfilter

from calib.core.errors import BadInputError
from calib.stages.lowpass.filters import LowPass, LowPassState, coefficients, settled, step


@given(st.floats(0.01, 29.0))
def test_the_coefficients_are_butterworths(cutoff_hz: float) -> None:
    b, a = butter(1, cutoff_hz, fs=60.0)
    b0, a1 = coefficients(LowPass(cutoff_hz, 60.0))
    assert np.allclose([b0, b0], b, rtol=1e-12)
    assert np.allclose([1.0, a1], a, rtol=1e-12)


def test_the_nominal_coefficients_and_delay() -> None:
    b0, a1 = coefficients(LowPass())
    assert b0 == pytest.approx(0.04979798, abs=5e-9)
    assert a1 == pytest.approx(-0.90040404, abs=5e-9)
    _, delay = group_delay(([b0, b0], [1.0, a1]), w=[1e-6])
    assert delay[0] / 60.0 == pytest.approx(0.159, abs=5e-4)


def test_it_is_the_difference_equation() -> None:
    x = np.random.default_rng(0).normal(size=500)
    b, a = butter(1, 1.0, fs=60.0)
    state, out = LowPassState(0.0, 0.0), []
    for value in x.tolist():
        state = step(LowPass(), state, value)
        out.append(state.y1)
    assert np.allclose(out, lfilter(b, a, x), rtol=0.0, atol=1e-14)


def test_it_starts_without_a_transient() -> None:
    state = settled(0.123)
    for _ in range(1000):
        state = step(LowPass(), state, 0.123)
    assert state.y1 == pytest.approx(0.123, abs=1e-15)


@pytest.mark.parametrize(
    ("cutoff", "rate"), [(0.0, 60.0), (30.0, 60.0), (-1.0, 60.0), (math.nan, 60.0), (1.0, math.inf)]
)
def test_what_no_filter_can_be(cutoff: float, rate: float) -> None:
    with pytest.raises(BadInputError, match="low-pass"):
        LowPass(cutoff, rate)
