"""One tick of both schemes: whose error is whose, what is added where, and what is remembered."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.control.feedforward import FeedForward, feed_forward
from calib.control.loop import (
    LoopState,
    OrientationControl,
    PositionControl,
    step_orientation,
    step_position,
)
from calib.control.pid import Pid, PidState
from calib.errors import BadInputError

PID = Pid(1000.0, 1000.0, 10.0)


def test_the_formula_extends_bellows_1_when_the_angle_is_too_small() -> None:
    _, command = step_orientation(OrientationControl(Pid(500.0)), LoopState(), 0.7, 0.6)
    assert command.feedback == pytest.approx((50.0, -50.0))
    assert command.pwm == (50.0, 0.0)
    _, crossed = step_orientation(OrientationControl(Pid(500.0), sign=-1), LoopState(), 0.7, 0.6)
    assert crossed.feedback == pytest.approx((-50.0, 50.0))


def test_saturated_values_are_not_remembered() -> None:
    state, command = step_orientation(OrientationControl(PID), LoopState(), 0.7, 0.0)
    assert command.pwm == (255.0, 0.0)
    assert state.first.u == command.feedback[0] > 255.0
    assert state.second.u == command.feedback[1] < 0.0


def test_whole_numbers_are_optional() -> None:
    _, whole = step_orientation(OrientationControl(Pid(100.0)), LoopState(), 0.7, 0.0123)
    _, exact = step_orientation(OrientationControl(Pid(100.0), whole_pwm=False), LoopState(), 0.7, 0.0123)
    assert whole.pwm[0] == 69.0
    assert exact.pwm[0] == pytest.approx(68.77)


def test_the_feed_forward_is_added_but_not_fed_back() -> None:
    rng = np.random.default_rng(0)
    reference, measured = 0.067 + 0.02 * rng.random((200, 2)), 0.065 + 0.02 * rng.random((200, 2))
    pid = Pid(300.0, 50.0, 1.0)
    control, bare = PositionControl(pid), PositionControl(pid, None)
    with_line, without = LoopState(), LoopState()
    for q_ref, q in zip(reference.tolist(), measured.tolist(), strict=True):
        with_line, command = step_position(control, with_line, tuple(q_ref), tuple(q))
        without, plain = step_position(bare, without, tuple(q_ref), tuple(q))
        assert command.feedback == plain.feedback
        for u, value, pwm in zip(command.feedback, q_ref, command.pwm, strict=True):
            total = u + feed_forward(FeedForward(), value)
            assert abs(pwm - min(max(total, 0.0), 255.0)) <= 0.5
    assert with_line == without


def test_the_bellows_do_not_mix() -> None:
    control = PositionControl(PID, None)
    state, command = step_position(control, LoopState(), (0.08, 0.07), (0.08, 0.06))
    assert command.feedback[0] == 0.0
    assert command.feedback[1] > 0.0
    assert state.first == PidState()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_measurement_that_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(BadInputError, match="angle of the orientation controller"):
        step_orientation(OrientationControl(PID), LoopState(), 0.7, value)
    with pytest.raises(BadInputError, match="lengths of the position controller"):
        step_position(PositionControl(PID), LoopState(), (0.07, 0.07), (value, 0.07))


def test_a_sign_is_plus_or_minus_one() -> None:
    with pytest.raises(BadInputError, match="found 0, expected 1 or -1"):
        OrientationControl(PID, sign=0)
