"""The feed-forward line: its values in the text, its edges, and what it is for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.actuator.pump import Pump, static_force_N
from calib.control.feedforward import FeedForward, feed_forward
from calib.errors import BadInputError

LINE = FeedForward()


def test_values_of_the_text() -> None:
    assert feed_forward(LINE, math.nextafter(0.067, 0.0)) == 0.0
    assert feed_forward(LINE, 0.067) == 110.0
    assert feed_forward(LINE, 0.091) == pytest.approx(241.95, abs=0.01)
    assert pytest.approx(0.09337, abs=1e-5) == LINE.saturates_at_m
    assert feed_forward(LINE, LINE.saturates_at_m + 1e-6) == 255.0
    assert feed_forward(LINE, 1.0) == 255.0


def test_it_rises_between_its_edges() -> None:
    values = [feed_forward(LINE, q) for q in np.linspace(0.05, 0.1, 501).tolist()]
    assert np.all(np.diff(values) >= 0.0)


def test_alone_it_errs_by_up_to_3_5_mm() -> None:
    # A straight line through the S of the steady elongation (2.13): too low below 80 mm, too high above.
    pump = Pump()
    wanted = np.linspace(0.068, 0.091, 60)
    pwm = np.array([feed_forward(LINE, q) for q in wanted.tolist()])
    grid = np.linspace(0.0, 0.0266, 2000)
    force = (47.7 + 1092.9 * grid) * grid
    reached = np.interp(static_force_N(pump, pwm), force, grid) + 0.065
    error_mm = 1e3 * (reached - wanted)
    assert error_mm.min() == pytest.approx(-3.46, abs=0.01)
    assert 0.0 < error_mm.max() < 1.5


@pytest.mark.parametrize("change", [{"from_m": 0.0}, {"slope_pwm_per_m": math.nan}, {"limit_pwm": math.inf}])
def test_what_no_line_can_have(change: dict[str, float]) -> None:
    with pytest.raises(BadInputError, match="feed-forward"):
        FeedForward(**change)
