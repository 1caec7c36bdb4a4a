"""Set-points against the figures in the text and against the kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.actuator.kinematics import forward
from calib.control.setpoints import AngleSteps, Ellipse, PolynomialElongation
from calib.errors import BadInputError

RADIUS_M = 0.0126
TURN_S = np.linspace(0.0, 20.0, 2001)


def test_steps_count_from_their_own_time_on() -> None:
    steps = AngleSteps((0.7, 0.3, 0.5), (5.0, 8.0))
    t = np.array([0.0, 4.999, 5.0, 7.9, 8.0, 100.0])
    assert steps.angle_rad(t).tolist() == [0.7, 0.7, 0.3, 0.3, 0.5, 0.5]
    assert AngleSteps().angle_rad(t).tolist() == [0.7] * 6


def test_elongation_starts_flat_peaks_at_5_s_and_is_held() -> None:
    setpoint, h = PolynomialElongation(), 1e-6
    q = setpoint.bellows_m(np.array([0.0, h, 5.0 - h, 5.0, 5.0 + h, 10.0]))
    assert np.array_equal(q[:, 0], q[:, 1])
    assert q[0, 0] == 0.067
    assert q[3:, 0] == pytest.approx(0.090, abs=1e-12)
    assert abs(q[1, 0] - q[0, 0]) / h < 1e-7
    assert abs(q[3, 0] - q[2, 0]) / h < 1e-7
    # As printed, without the hold, it would want a bellows of negative length.
    printed = 0.0670 + 0.00276 * 10.0**2 - 0.000368 * 10.0**3
    assert printed == pytest.approx(-0.025, abs=1e-12)


def test_the_exact_chord_gives_the_drawn_ellipse_back() -> None:
    ellipse = Ellipse()
    wanted, reached = ellipse.pose(TURN_S), forward(ellipse.bellows_m(TURN_S, RADIUS_M), RADIUS_M)
    assert np.abs(reached - wanted).max() < 1e-15
    x, y = reached[:, 0], reached[:, 1]
    assert np.abs((x / 0.015) ** 2 + ((y - 0.078) / 0.010) ** 2 - 1.0).max() < 1e-12


def test_the_thesis_chord_halves_the_width() -> None:
    reached = forward(Ellipse(chord="thesis").bellows_m(TURN_S, RADIUS_M), RADIUS_M)
    assert np.abs(reached[:, 0]).max() == pytest.approx(0.0075, abs=1e-4)
    assert np.ptp(reached[:, 1]) == pytest.approx(0.020, abs=2e-4)


def test_bellows_stay_in_the_range_of_the_pumps() -> None:
    q = Ellipse().bellows_m(TURN_S, RADIUS_M)
    assert 1e3 * q.min() == pytest.approx(67.0, abs=0.05)
    assert 1e3 * q.max() == pytest.approx(89.3, abs=0.05)


def test_it_starts_at_the_end_near_the_base_and_turns_counter_clockwise_as_drawn() -> None:
    x, y, phi = Ellipse().pose(np.array([0.0, 0.1])).T
    assert (x[0], y[0], phi[0]) == (0.0, 0.068, 0.0)
    # Drawn with y upward, from the top to the left.
    assert x[1] < 0.0 < y[1] - y[0]
    assert phi[1] < 0.0


@given(st.floats(-1e3, 1e3), st.sampled_from(["exact", "thesis"]))
def test_it_repeats_with_its_period(t: float, chord: str) -> None:
    ellipse = Ellipse(chord=chord)
    assert np.allclose(ellipse.pose(np.array(t)), ellipse.pose(np.array(t + 20.0)), atol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: AngleSteps((0.7, 0.3), ()), "found 2 angles and 0 times"),
        (lambda: AngleSteps((0.7, 0.3, 0.1), (5.0, 5.0)), "do not rise"),
        (lambda: AngleSteps((math.nan,)), "expected finite numbers"),
        (lambda: PolynomialElongation(hold_s=math.inf), "expected finite numbers"),
        (lambda: Ellipse(x_m=-0.015), "ellipse x_m: found -0.015"),
        (lambda: Ellipse(period_s=0.0), "ellipse period_s: found 0"),
        (lambda: Ellipse(y_m=0.08), "reaches the base"),
        (lambda: Ellipse(chord="tan"), "chord: found 'tan', expected one of exact, thesis"),
    ],
)
def test_what_no_setpoint_can_be(make, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        make()
