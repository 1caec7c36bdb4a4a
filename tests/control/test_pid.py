"""The incremental PID against its transfer function and its memoryless form, and its handling of limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import dlsim, dlti, lfilter

from calib.control.pid import Pid, PidState, saturate, step
from calib.errors import BadInputError

errors_of_a_run = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=80)
gain = st.floats(0.0, 2000.0)


def _outputs(pid: Pid, errors: list[float], state: PidState | None = None) -> np.ndarray:
    state = PidState() if state is None else state
    out = []
    for error in errors:
        state, u = step(pid, state, error)
        out.append(u)
    return np.array(out)


@given(errors_of_a_run, gain, gain, st.floats(0.0, 50.0))
def test_with_zero_history_it_has_no_memory_but_the_integral(
    errors: list[float], Kp: float, Ki: float, Kd: float
) -> None:
    pid = Pid(Kp, Ki, Kd)
    h, e = pid.tick_s, np.array(errors)
    before = np.concatenate([[0.0], e[:-1]])
    expected = Kp * e + Ki * h * np.cumsum(0.5 * (e + before)) + Kd * (e - before) / h
    scale = 1.0 + len(e) * (Kp + Ki * h + Kd / h)
    assert np.allclose(_outputs(pid, errors), expected, rtol=0.0, atol=1e-13 * scale)


def test_it_is_the_transfer_function_of_the_appendix() -> None:
    Kp, Ki, Kd, h = 1000.0, 1000.0, 10.0, 1.0 / 60.0
    e = np.random.default_rng(1).normal(size=200)
    # (D.6): Kp + Ki h / 2 (z + 1) / (z - 1) + Kd / h (z - 1) / z, over the common denominator z (z - 1).
    numerator = (
        Kp * np.array([1.0, -1.0, 0.0])
        + 0.5 * Ki * h * np.array([1.0, 1.0, 0.0])
        + Kd / h * np.array([1.0, -2.0, 1.0])
    )
    _, by_z = dlsim(dlti(numerator, [1.0, -1.0, 0.0], dt=h), e)
    ours = _outputs(Pid(Kp, Ki, Kd), e.tolist())
    assert np.allclose(ours, by_z[:, 0], rtol=1e-10, atol=1e-8)
    # (D.9) as a filter.
    b = [Kp + 0.5 * Ki * h + Kd / h, -Kp + 0.5 * Ki * h - 2.0 * Kd / h, Kd / h]
    assert np.allclose(ours, lfilter(b, [1.0, -1.0], e), rtol=1e-10, atol=1e-8)


def test_a_history_of_the_first_error_leaves_a_bias_for_ever() -> None:
    pid, errors = Pid(1000.0, 0.0, 10.0), np.linspace(0.7, 0.1, 300).tolist()
    biased = _outputs(pid, errors, PidState(0.0, errors[0], errors[0]))
    right = _outputs(pid, errors)
    assert np.allclose((biased - right)[2:], -1000.0 * errors[0], atol=1e-9)


@given(errors_of_a_run)
def test_clamping_changes_nothing_within_the_limits(errors: list[float]) -> None:
    plain = Pid(50.0, 20.0, 0.5)
    wide = replace(plain, clamping=True, low=-1e9, high=1e9)
    assert np.array_equal(_outputs(plain, errors), _outputs(wide, errors))


@given(st.floats(-500.0, 500.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_clamping_drops_the_integral_where_the_output_is_out_of_range(
    u: float, e0: float, e1: float, e2: float
) -> None:
    pid, state = Pid(1000.0, 1000.0, 10.0, clamping=True), PidState(u, e1, e2)
    with_integral = step(replace(pid, clamping=False), state, e0)[1]
    without = step(replace(pid, clamping=False, Ki=0.0), state, e0)[1]
    after, got = step(pid, state, e0)
    assert got == (with_integral if 0.0 <= with_integral <= 255.0 else without)
    # What is remembered is the output itself, however far beyond the limits.
    assert after == PidState(got, e0, e1)


def test_the_output_winds_up_without_clamping_and_not_with_it() -> None:
    errors = [0.5] * 600
    assert _outputs(Pid(1000.0, 1000.0, 0.0), errors)[-1] > 5000.0
    assert _outputs(Pid(1000.0, 1000.0, 0.0, clamping=True), errors)[-1] == pytest.approx(500.0, abs=1e-9)


@pytest.mark.parametrize(
    ("u", "pwm"), [(-3.0, 0.0), (0.0, 0.0), (127.4, 127.0), (127.5, 128.0), (254.9, 255.0), (9e9, 255.0)]
)
def test_saturation_to_whole_values(u: float, pwm: float) -> None:
    assert saturate(u) == pwm


def test_saturation_without_rounding() -> None:
    assert saturate(127.4, whole=False) == 127.4
    assert saturate(300.0, whole=False) == 255.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"Kp": math.nan}, "Kp: found nan"),
        ({"Kd": math.inf}, "Kd: found inf"),
        ({"tick_s": 0.0}, "tick of the controller: found 0 s"),
        ({"tick_s": math.nan}, "tick of the controller"),
        ({"low": 255.0, "high": 0.0}, "limits of the controller: found 255 to 0"),
    ],
)
def test_what_no_controller_can_have(change: dict[str, float], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        Pid(**{"Kp": 1.0, **change})
