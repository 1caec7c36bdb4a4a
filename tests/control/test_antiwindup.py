"""Back-calculation: the PID of the source within the limits, and bounded beyond them."""

from __future__ import annotations

import math

import pytest
from control_models import NOMINAL
from hypothesis import given
from hypothesis import strategies as st

from calib.control.antiwindup import (
    BackCalculation,
    BackOrientation,
    BackState,
    start_back_orientation,
    step_back,
    step_back_orientation,
)
from calib.control.pid import Pid, PidState
from calib.control.pid import step as step_pid
from calib.errors import BadInputError

errors = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60)


@given(errors=errors, Kp=st.floats(0, 2000), Ki=st.floats(0, 2000), Kd=st.floats(0, 50))
def test_without_limits_it_is_the_incremental_form(
    errors: list[float], Kp: float, Ki: float, Kd: float
) -> None:
    back, pid = BackCalculation(Kp, Ki, Kd), Pid(Kp, Ki, Kd)
    a, b = BackState(), PidState()
    for error in errors:
        a, u = step_back(back, a, error, -math.inf, math.inf)
        b, v = step_pid(pid, b, error)
        assert u == pytest.approx(v, abs=1e-6 * (1.0 + abs(v)))


@given(errors=errors, tracking_s=st.floats(0.02, 5.0))
def test_commands_stay_within_their_limits(errors: list[float], tracking_s: float) -> None:
    back, state = BackCalculation(1000.0, 1000.0, 10.0, tracking_s), BackState()
    for error in errors:
        state, u = step_back(back, state, error, 10.0, 200.0)
        assert 10.0 <= u <= 200.0


def test_a_constant_error_beyond_the_limit_settles_the_integral() -> None:
    """At rest Ki e = (v - u) / Tt: the integral stops a known way beyond the limit, it does not wind up."""
    back, state = BackCalculation(100.0, 50.0, 0.0, 0.5), BackState()
    for _ in range(3000):
        state, u = step_back(back, state, 3.0, 0.0, 255.0)
    v = 100.0 * 3.0 + state.integral + 0.5 / 60.0 * 50.0 * 3.0
    assert u == 255.0
    assert v - 255.0 == pytest.approx(0.5 * 50.0 * 3.0, rel=1e-9)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"Kp": math.nan}, "Kp: found nan"),
        ({"Kp": 1.0, "tracking_s": 0.001}, "back-calculation time: found 0.001 s"),
        ({"Kp": 1.0, "tracking_s": math.inf}, "back-calculation time: found inf s"),
        ({"Kp": 1.0, "tick_s": 0.0}, "tick of the controller"),
    ],
)
def test_gains_that_cannot_be(words: dict[str, float], sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        BackCalculation(**words)


def test_both_channels_and_their_limits() -> None:
    control = BackOrientation(BackCalculation(1000.0, 1000.0, 10.0), NOMINAL)
    state = start_back_orientation(control)
    for _ in range(120):
        state, pwm = step_back_orientation(control, state, 0.7, 0.2)
    assert pwm == (255.0, 0.0)
    # The other way at once: the first pump is not switched off while its bellows is full.
    state, pwm = step_back_orientation(control, state, 0.0, 0.7)
    assert 100.0 < pwm[0] < 255.0 and pwm[1] == 255.0
    free = BackOrientation(control.control, NOMINAL, math.inf)
    state, pwm = step_back_orientation(free, state, 0.0, 0.7)
    assert pwm[0] == 0.0


def test_crossed_hoses_swap_the_pumps() -> None:
    straight = BackOrientation(BackCalculation(1000.0, 10.0, 1.0), NOMINAL)
    crossed = BackOrientation(straight.control, NOMINAL, sign=-1)
    _, one = step_back_orientation(straight, start_back_orientation(straight), 0.2, 0.0)
    _, other = step_back_orientation(crossed, start_back_orientation(crossed), 0.2, 0.0)
    assert one == other[::-1]


def test_what_it_refuses() -> None:
    control = BackCalculation(1.0)
    with pytest.raises(BadInputError, match="found 0, expected 1 or -1"):
        BackOrientation(control, NOMINAL, sign=0)
    with pytest.raises(BadInputError, match="share of the falling rate: found -1"):
        BackOrientation(control, NOMINAL, falling_share=-1.0)
    made = BackOrientation(control, NOMINAL)
    with pytest.raises(BadInputError, match=r"found 0\.1, nan, expected finite numbers"):
        step_back_orientation(made, start_back_orientation(made), 0.1, math.nan)
