"""The suggested filter keeps to the wanted jitter, and no other one found by brute force is faster."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.lowpass.filters import (
    FAMILIES,
    Design,
    dc_delay_s,
    design_lowpass,
    filter_signal,
    jitter_after,
    spectrum,
    suggest,
)

T = np.arange(6000) / 60.0
NOISE = 0.5 * np.random.default_rng(2).normal(size=6000)
REST = spectrum(NOISE, 60.0)
MOVING = spectrum(NOISE + 10.0 * np.sin(2.0 * np.pi * 0.5 * T), 60.0)


def test_the_wanted_jitter_is_left_and_not_much_less() -> None:
    found = suggest([REST], 0.1, unit="px")
    for one in found.candidates:
        assert 0.098 < one.jitter <= 0.1
    assert filter_signal(found.best.filter.sections, NOISE)[120:].std() == pytest.approx(0.1, rel=0.15)
    assert len(found.candidates) == 1 + 7 * 3


def test_no_filter_of_a_grid_is_faster() -> None:
    found = suggest([REST], 0.15, orders=(1, 2, 3, 4))
    fastest = math.inf
    for family in FAMILIES:
        for order in (1, 2, 3, 4):
            for cutoff in np.geomspace(0.1, 20.0, 80):
                made = design_lowpass(Design(float(cutoff), 60.0, order, family))
                if jitter_after(REST, made.exact) <= 0.15:
                    fastest = min(fastest, dc_delay_s(made.exact, 60.0))
    assert found.candidates[0].delay_s <= 1.001 * fastest


def test_at_rest_the_simplest_of_equals_and_in_motion_the_truest() -> None:
    """With white jitter one pole and one pair have the same delay for the same jitter."""
    rest, moving = suggest([REST], 0.1), suggest([MOVING], 0.1)
    assert rest.best.filter.design.order == 1
    assert moving.best.filter.design.order == 2
    assert moving.best.delay_s <= 1.07 * moving.candidates[0].delay_s
    single = next(one for one in moving.candidates if one.filter.design.order == 1)
    assert moving.best.motion_lost < 0.7 * single.motion_lost


def test_the_worse_coordinate_decides_and_choices_can_be_narrowed() -> None:
    calm = spectrum(0.2 * NOISE, 60.0)
    both = suggest([calm, REST], 0.1, orders=[3], families=["bessel"])
    assert [(one.filter.design.order, one.filter.design.family) for one in both.candidates] == [(3, "bessel")]
    assert both.best.jitter == pytest.approx(jitter_after(REST, both.best.filter.exact))
    assert suggest([calm], 0.09).best.delay_s < both.best.delay_s
    assert {one.filter.design.family for one in suggest([REST], 0.1, (), ["critical"]).candidates} == {
        "critical"
    }


def test_a_wish_just_below_what_there_is() -> None:
    found = suggest([REST], 0.99 * REST.jitter)
    assert found.best.filter.design.cutoff_hz < 30.0
    assert found.best.jitter <= 0.99 * REST.jitter


@pytest.mark.parametrize(
    ("of", "wanted", "words"),
    [
        (REST, 0.6, r"jitters by 0\.5\d* px unfiltered, not more than the 0\.6 px .* no low-pass is needed"),
        (REST, 1e-6, "no low-pass here leaves only 1e-06 px"),
        (spectrum(np.full(100, 2.0), 60.0), 0.1, "has no jitter at all"),
    ],
)
def test_wishes_that_cannot_be_met(of: object, wanted: float, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        suggest([of], wanted, unit="px")


def test_metres_are_told_as_millimetres() -> None:
    with pytest.raises(BadInputError, match="more than the 600 mm"):
        suggest([REST], 0.6)
