"""The dead band in sixteen bits: the bound holds, is reached, and float has nearly none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.stages.lowpass.filters import FAMILIES, Design, dead_band_binary32, design_lowpass, fixed_point


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
def test_what_was_seen_lies_within_the_bound(order: int, family: str) -> None:
    found = fixed_point(design_lowpass(Design(1.0, 60.0, order, family)))
    assert found.usable
    assert found.stuck <= found.dead_band
    assert found.cutoff_hz == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("order", [1, 2])
def test_the_bound_is_reached_by_a_loop_of_integers(order: int) -> None:
    """An independent loop that starts at the edge of the dead band stays there, and beyond it does not."""
    made = design_lowpass(Design(1.0, 60.0, order))
    bound = fixed_point(made).dead_band
    q = 15 if order == 1 else 14
    a1, a2 = (round(float(v) * 2**q) for v in made.exact[0, 4:])
    S = 2**q + a1 + a2
    assert bound == pytest.approx(2**q / (2 * S))

    def held(away: int) -> bool:
        x, y1, y2 = 1000, 1000 + away, 1000 + away
        return (S * x - a1 * y1 - a2 * y2 + 2 ** (q - 1)) // 2**q == y1

    edge = math.ceil(bound) - 1
    assert held(edge) and held(-edge)
    assert not held(edge + 2)
    assert edge == (5 if order == 1 else 49)


def test_a_lower_cutoff_has_a_wider_band_and_then_none_at_all() -> None:
    bands = [fixed_point(design_lowpass(Design(f, 60.0, 2))).dead_band for f in (4.0, 1.0, 0.25)]
    assert bands == sorted(bands)
    assert bands[2] > 100 * bands[0]
    gone = fixed_point(design_lowpass(Design(0.03, 60.0, 2)))
    assert not gone.usable
    assert math.isnan(gone.cutoff_hz)


def test_float_comes_to_rest_where_it_should() -> None:
    for order, most in ((1, 2e-6), (2, 2e-5), (8, 1e-4)):
        assert dead_band_binary32(design_lowpass(Design(1.0, 60.0, order))) < most
    # An order of magnitude in the cut-off is two in 1 / (1 + a1 + a2).
    assert dead_band_binary32(design_lowpass(Design(0.05, 60.0, 2))) > 1e-4
    assert np.isfinite(dead_band_binary32(design_lowpass(Design(25.0, 60.0, 8))))
