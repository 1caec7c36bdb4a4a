"""Delay, steps and noise of low-pass filters against SciPy, finite differences and long sums."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import group_delay, sos2tf, sosfilt, sosfilt_zi, sosfreqz

from calib.stages.lowpass.filters import (
    FAMILIES,
    Design,
    LowPass,
    cutoff_hz,
    dc_delay_s,
    decibels,
    design_lowpass,
    filter_signal,
    frequency_response,
    group_delay_s,
    noise_gain,
    settled,
    settled_state,
    step,
    step_response,
)

F = np.array([0.0, 0.05, 0.5, 1.0, 2.0, 7.0, 25.0])
EVERY = [(order, family) for order in (1, 2, 3, 5, 8) for family in FAMILIES]


def _sections(order: int = 1, family: str = "butterworth", cutoff: float = 1.0) -> np.ndarray:
    return design_lowpass(Design(cutoff, 60.0, order, family)).sections


@pytest.mark.parametrize(("order", "delay_s"), [(1, 0.159), (2, 0.225)])
def test_the_delay_of_slow_motion(order: int, delay_s: float) -> None:
    sections = _sections(order)
    assert dc_delay_s(sections, 60.0) == pytest.approx(delay_s, abs=5e-4)
    # A ramp arrives late by just that.
    t = np.arange(3000) / 60.0
    assert 40.0 - np.interp(40.0, t, filter_signal(sections, t)) == pytest.approx(
        dc_delay_s(sections, 60.0), rel=1e-6
    )


@pytest.mark.parametrize(("order", "family"), EVERY)
def test_response_and_delay_are_scipys(order: int, family: str) -> None:
    sections = _sections(order, family)
    H = frequency_response(sections, F, 60.0)
    np.testing.assert_allclose(H, sosfreqz(sections, F, fs=60.0)[1], rtol=1e-9, atol=1e-15)
    h = 1e-4
    ahead, behind = (frequency_response(sections, F[1:] + s * h, 60.0) for s in (1.0, -1.0))
    slope = -np.angle(ahead / behind) / (4.0 * np.pi * h)
    np.testing.assert_allclose(group_delay_s(sections, F[1:], 60.0), slope, rtol=1e-6, atol=1e-7)
    if order <= 2:
        _, theirs = group_delay(sos2tf(sections), w=F[:-1], fs=60.0)
        np.testing.assert_allclose(group_delay_s(sections, F[:-1], 60.0), theirs / 60.0, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("order", "family"), EVERY)
def test_a_constant_stays_what_it_is_from_the_first_sample(order: int, family: str) -> None:
    sections = _sections(order, family)
    x = np.array([[0.07, -3.0]] * 400)
    np.testing.assert_allclose(filter_signal(sections, x), x, rtol=2e-11)
    np.testing.assert_allclose(settled_state(sections, np.asarray(1.0)), sosfilt_zi(sections), rtol=1e-8)


def test_filtering_is_the_firmwares_difference_equation() -> None:
    x = 0.3 + np.random.default_rng(1).normal(size=400)
    state, out = settled(x[0]), [x[0]]
    for value in x[1:].tolist():
        state = step(LowPass(), state, value)
        out.append(state.y1)
    exact = design_lowpass(Design()).exact
    np.testing.assert_allclose(filter_signal(exact, x), out, rtol=0.0, atol=1e-13)
    assert filter_signal(exact, x[:0]).shape == (0,)
    assert filter_signal(exact, x[:1]) == pytest.approx(x[:1])


@pytest.mark.parametrize(("order", "family"), EVERY)
def test_the_noise_gain_is_the_sum_of_squares(order: int, family: str) -> None:
    sections = _sections(order, family, 0.8)
    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    assert noise_gain(sections) == pytest.approx(float(np.sum(sosfilt(sections, impulse) ** 2)), rel=1e-9)


def test_the_cutoff_and_decibels() -> None:
    assert cutoff_hz(_sections(3, "bessel"), 60.0) == pytest.approx(1.0, abs=1e-5)
    assert decibels(np.array([1.0, 0.1, 0.0])).tolist() == pytest.approx([0.0, -20.0, -400.0])


def test_steps() -> None:
    first = step_response(_sections(), 60.0)
    # A single pole: ln 9 time constants from 10 % to 90 %, ln 50 to within 2 %.
    assert first.rise_s == pytest.approx(np.log(9.0) / (2.0 * np.pi), rel=0.01)
    assert first.settling_s == pytest.approx(np.log(50.0) / (2.0 * np.pi), abs=0.02)
    assert first.overshoot == 0.0
    second = step_response(_sections(2), 60.0)
    assert second.overshoot == pytest.approx(np.exp(-np.pi), rel=0.02)
    assert step_response(_sections(4, "critical"), 60.0).overshoot < 1e-12
    for one in (first, second):
        assert abs(one.values[-1] - 1.0) < 1e-3
        late = one.t_s >= one.settling_s
        assert np.all(np.abs(one.values[late] - 1.0) <= 0.02)
        assert abs(one.values[~late][-1] - 1.0) > 0.02
