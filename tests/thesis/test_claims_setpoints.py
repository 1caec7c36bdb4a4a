"""Claims about feed-forward, set-points and both bellows."""

from __future__ import annotations

import pytest

from calib.stages.control.laws import FeedForward
from thesis import claims_setpoints
from thesis.outcome import Outcome


def test_the_line_follows_the_measured_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = claims_setpoints.feedforward.check().numbers
    assert numbers["at_91mm_pwm"] == pytest.approx(242.0, abs=0.5)
    assert numbers["worst_pwm"] < 25.0
    monkeypatch.setattr(claims_setpoints, "FeedForward", lambda: FeedForward(slope_pwm_per_m=3000.0))
    assert claims_setpoints.feedforward.check().outcome is Outcome.REFUTED


def test_the_printed_set_point_falls_below_nothing() -> None:
    numbers = claims_setpoints.setpoint.check().numbers
    assert numbers["at_5s_mm"] == pytest.approx(90.0)
    assert numbers["at_10s_mm"] == pytest.approx(-25.0)


def test_errors_with_feed_forward() -> None:
    assert claims_setpoints.largest_error.check().numbers["largest_mm"] == pytest.approx(2.0, rel=0.05)
    numbers = claims_setpoints.static_error.check().numbers
    # Alike pumps, between the printed errors of the real ones.
    assert numbers["q1_mm"] == pytest.approx(numbers["q2_mm"])
    assert -0.3034 < numbers["q1_mm"] < -0.06754
    assert 1.0 < claims_setpoints.integral_delay.check().numbers["moves_s"] < 2.0


def test_the_chord_of_an_arc_points_at_half_its_angle() -> None:
    numbers = claims_setpoints.ellipse.check().numbers
    assert numbers["half_width_m"] == pytest.approx(0.5 * 0.015, rel=0.05)
    assert numbers["exact_error_m"] < 1e-12
    numbers = claims_setpoints.ellipse_range.check().numbers
    assert (round(numbers["least_mm"], 1), round(numbers["greatest_mm"], 1)) == (67.0, 89.3)


def test_what_the_rig_shows_of_the_ellipse_and_of_another_start() -> None:
    numbers = claims_setpoints.ellipse_wobble.check().numbers
    assert numbers["spike_mm"] < 3.0 * numbers["rms_elsewhere_mm"]
    numbers = claims_setpoints.initial.check().numbers
    assert numbers["rebound_printed_mm"] > 5.0 * numbers["rebound_nominal_mm"]
