"""The claim about the low-pass."""

from __future__ import annotations

import math

import pytest

from thesis import claims_filters


def test_delays_are_those_of_the_analogue_filters() -> None:
    numbers = claims_filters.cutoff.check().numbers
    # Of 1 / (1 + s / w) and of Butterworth's second order, to the bilinear transform's bending.
    assert numbers["delay_order1_s"] == pytest.approx(1.0 / (2.0 * math.pi), rel=2e-3)
    assert numbers["delay_order2_s"] == pytest.approx(math.sqrt(2.0) / (2.0 * math.pi), rel=2e-3)
    assert numbers["kept_4hz"] == pytest.approx(1.0 / math.sqrt(17.0), rel=0.02)
    assert 0.95 < numbers["kept_jump"] < 1.0
    # A jump of 0.4 rad moves the head by some 20 mm; a filter in time would be off by nothing.
    assert 2e-3 < numbers["late_m"] < 2e-2
