"""Designed sections against SciPy's, and what rounding leaves of them, in exact arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.signal import bessel, butter, sosfreqz

from calib.core.errors import BadInputError
from calib.stages.lowpass.filters import (
    FAMILIES,
    Design,
    LowPass,
    analogue_poles,
    coefficients,
    design_lowpass,
    digital_poles,
)

FREQUENCIES = np.array([0.0, 0.1, 0.7, 1.0, 3.0, 11.0, 29.0])


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize(("family", "scipys"), [("butterworth", butter), ("bessel", bessel)])
def test_the_response_is_scipys(order: int, family: str, scipys: object) -> None:
    words = {"norm": "mag"} if family == "bessel" else {}
    expected = scipys(order, 1.3, fs=60.0, output="sos", **words)
    ours = design_lowpass(Design(1.3, 60.0, order, family)).exact
    _, H = sosfreqz(ours, FREQUENCIES, fs=60.0)
    _, theirs = sosfreqz(expected, FREQUENCIES, fs=60.0)
    np.testing.assert_allclose(H, theirs, rtol=1e-7, atol=1e-13)


def test_the_printed_coefficients() -> None:
    b0, b1, b2, one, a1, a2 = design_lowpass(Design()).exact[0]
    assert (b0, b1) == (pytest.approx(0.04979798, abs=5e-9), pytest.approx(0.04979798, abs=5e-9))
    assert (one, a1, a2, b2) == (1.0, pytest.approx(-0.90040404, abs=5e-9), 0.0, 0.0)
    assert (b0, a1) == pytest.approx(coefficients(LowPass()), rel=1e-14)


@pytest.mark.parametrize("order", range(1, 9))
def test_critical_poles_are_equal_and_lose_half_the_power(order: int) -> None:
    poles = analogue_poles("critical", order)
    assert np.all(poles == poles[0])
    gain = np.prod(poles / (poles - 1j))
    assert abs(gain) ** 2 == pytest.approx(0.5, rel=1e-12)


@pytest.mark.parametrize("order", [2, 5, 8])
def test_the_bessel_delay_is_flat(order: int) -> None:
    poles = analogue_poles("bessel", order)
    w = np.linspace(0.0, 0.5, 6)
    delay = np.sum(-poles.real / (poles.real**2 + (w[:, None] - poles.imag) ** 2), axis=1)
    # An order n has n derivatives of the delay zero: order 2 to w^4, above to higher powers.
    np.testing.assert_allclose(delay, delay[0], rtol=0.03 if order == 2 else 2e-3)


CUTOFF = st.floats(1e-3, 0.499)


@settings(max_examples=150, deadline=None)
@given(CUTOFF, st.integers(1, 8), st.sampled_from(FAMILIES))
def test_the_gain_at_rest_is_exactly_one_in_binary32(part: float, order: int, family: str) -> None:
    try:
        made = design_lowpass(Design(part * 60.0, 60.0, order, family))
    except BadInputError:
        assert part < 0.01
        return
    for section in made.sections:
        assert np.array_equal(section.astype(np.float32).astype(np.float64), section)
        b, a = [Fraction(v) for v in section[:3]], [Fraction(v) for v in section[3:]]
        assert sum(b) == sum(a) > 0
        # Both zeros at z = -1.
        assert b[0] - b[1] + b[2] == 0
        assert 2 * (b[0] - b[2]) in (0, 2 * b[1])
    assert made.stable
    assert made.pole_radius < 1.0


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("order", [1, 2, 3, 8])
def test_rounding_moves_the_cutoff_little_and_poles_are_those_of_the_sections(
    order: int, family: str
) -> None:
    made = design_lowpass(Design(1.0, 60.0, order, family))
    np.testing.assert_allclose(made.sections, made.exact, rtol=2e-4, atol=2e-7)
    assert len(digital_poles(made.sections)) == order
    assert len(made.sections) == (order + 1) // 2

    def power(f: float) -> float:
        return float(np.abs(sosfreqz(made.sections, [f], fs=60.0)[1][0])) ** 2 - 0.5

    assert brentq(power, 0.1, 5.0) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("design", "words"),
    [
        ({"cutoff_hz": 30.0}, r"the cut-off is 30 Hz at 60 samples/s, .* 30 Hz"),
        ({"cutoff_hz": 0.0}, "the cut-off is 0 Hz"),
        ({"cutoff_hz": -1.0}, "the cut-off is -1 Hz"),
        ({"cutoff_hz": math.nan}, "the cut-off is nan Hz"),
        ({"rate_hz": math.inf}, "at inf samples/s"),
        ({"order": 0}, "the order is 0, expected 1 to 8"),
        ({"order": 9}, "the order is 9, expected 1 to 8"),
        ({"family": "chebyshev"}, "the family is 'chebyshev', expected one of butterworth"),
    ],
)
def test_what_no_filter_can_be(design: dict[str, object], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Design(**design)


def test_a_cutoff_too_low_for_single_precision() -> None:
    with pytest.raises(BadInputError, match=r"single precision a cut-off of 0\.001 Hz .* is not stable"):
        design_lowpass(Design(0.001, 60.0, 4))
