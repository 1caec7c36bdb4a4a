"""Pumps: static laws, lag, limits, delay, and both deflation models."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from calib.actuator.parameters import Stiffness
from calib.actuator.pump import (
    ElongationForce,
    Orifice,
    PolynomialForce,
    Pump,
    PumpState,
    RateLimit,
    advance,
    delayed,
    pump_at_rest,
    pump_coefficients,
    static_force_N,
    step_pump,
)
from calib.arrays import FloatArray
from calib.errors import BadInputError

FULL_N = float(static_force_N(Pump(), np.array(255.0)))
DEFLATIONS = [RateLimit(), Orifice()]


def ticks(pump: Pump, pwm: list[float], state: PumpState | None = None) -> FloatArray:
    """Force of pump 1 after each tick; pump 2 stays off."""
    state = state or pump_at_rest(pump)
    force = []
    for value in pwm:
        state = step_pump(pump, state, (value, 0.0))
        force.append(state.force_N[0])
        assert state.force_N[1] == 0.0
    return np.array(force)


@pytest.mark.parametrize(("volt", "elongation_mm"), [(6, 1.88), (8, 11.11), (10, 21.73), (12, 26.56)])
def test_static_force_holds_the_measured_elongation(volt: float, elongation_mm: float) -> None:
    force = float(static_force_N(Pump(), np.array(volt * 255 / 12)))
    eps = 1e-3 * elongation_mm
    assert force == pytest.approx(Stiffness().secant(eps) * eps, rel=2e-3)


def test_dead_zone_and_saturation() -> None:
    pwm = np.array([-50.0, 0.0, 50.0, 99.8, 255.0, 400.0])
    assert static_force_N(Pump(), pwm) == pytest.approx([0, 0, 0, 0, FULL_N, FULL_N])
    assert np.all(static_force_N(Pump(), np.linspace(0, 255, 2000)) >= 0.0)


def test_printed_coefficient_of_213_gives_negative_lengths() -> None:
    printed = (-0.1493, 3.376, -25.87, 54.13)
    assert np.polyval(printed, [4.7, 12.0]) == pytest.approx([-8.4, -28.2], abs=0.05)
    assert np.polyval(ElongationForce().elongation_mm, [4.7, 12.0]) == pytest.approx([0.01, 26.56], abs=0.005)


def test_polynomial_of_349_is_in_millinewton_with_a_bump() -> None:
    law = PolynomialForce()
    assert float(law.force_N(np.array(255.0))) == pytest.approx(2.062, abs=1e-3)
    bare = np.polyval((*law.force_mN, 0.0), np.arange(100))
    assert bare.max() == pytest.approx(244, abs=0.5)
    assert bare.argmax() == 31
    assert np.all(static_force_N(Pump(static=law), np.arange(100.0)) == 0.0)
    # Both laws describe one pump; they differ by a tenth of the range at most.
    pwm = np.linspace(100, 255, 200)
    assert np.abs(law.force_N(pwm) - ElongationForce().force_N(pwm)).max() < 0.1 * FULL_N


@pytest.mark.parametrize("deflation", DEFLATIONS)
def test_rise_is_a_first_order_lag(deflation: RateLimit | Orifice) -> None:
    pump = Pump(deflation=deflation, delay_ticks=0)
    force = ticks(pump, [255.0] * 300)
    t = pump.tick_s * np.arange(1, 301)
    # The orifice takes one Runge-Kutta step of 1/42 of the time constant per tick.
    assert force == pytest.approx(FULL_N * (1 - np.exp(-t / 0.7)), abs=1e-8)


@pytest.mark.parametrize("deflation", DEFLATIONS)
@pytest.mark.parametrize("delay", [0, 1, 2, 5])
def test_transport_delay_in_ticks(deflation: RateLimit | Orifice, delay: int) -> None:
    pump = Pump(deflation=deflation, delay_ticks=delay)
    force = ticks(pump, [255.0] * 10)
    assert np.all(force[:delay] == 0.0)
    assert np.all(force[delay:] > 0.0)


def test_delayed_rows() -> None:
    pump = Pump()
    rows = np.arange(10.0).reshape(5, 2)
    assert np.array_equal(delayed(pump, rows), [[0, 0], [0, 0], [0, 1], [2, 3], [4, 5]])
    assert np.array_equal(delayed(pump, rows[:1], np.array([[7.0, 8.0], [9.0, 9.0]])), [[7, 8]])


def test_falling_rate_limit() -> None:
    pump = Pump(delay_ticks=0)
    force = ticks(pump, [0.0] * 330, PumpState((FULL_N, 0.0), (FULL_N, 0.0), ()))
    t = pump.tick_s * np.arange(1, 331)
    expected = np.maximum(FULL_N - 0.4 * t, FULL_N * np.exp(-t / 0.7))
    assert force == pytest.approx(expected, abs=1e-12)
    assert np.argmax(force < 0.05 * FULL_N) * pump.tick_s == pytest.approx(0.95 * FULL_N / 0.4, abs=0.02)


def test_printed_rate_limit_is_too_fast() -> None:
    """-2 N/s empties the bellows in 2.6 s, not 5 s: the lag then decides alone."""
    pump = Pump(deflation=RateLimit(2.0), delay_ticks=0)
    force = ticks(pump, [0.0] * 300, PumpState((FULL_N, 0.0), (FULL_N, 0.0), ()))
    assert np.argmax(force < 0.05 * FULL_N) * pump.tick_s < 2.6


@given(
    st.floats(0.0, 2.1),
    st.floats(0.0, 2.1),
    st.floats(0.0, 2.1),
    st.lists(st.floats(1e-4, 0.3), min_size=1, max_size=6),
)
def test_closed_form_of_the_rate_limit_is_exact(
    g: float, lag: float, above: float, pieces: list[float]
) -> None:
    """However a span is cut, the end is the same, and no piece falls faster than the limit."""
    p = pump_coefficients(Pump())
    x, f = lag, lag + above
    for dt in pieces:
        before = f
        x, middle, f = advance(p, x, f, g, math.exp(-0.5 * dt / 0.7), dt)
        assert f >= before - 0.4 * dt - 1e-12
        assert f >= x - 1e-15
        assert middle >= before - 0.2 * dt - 1e-12
    total = sum(pieces)
    _, _, whole = advance(p, lag, lag + above, g, math.exp(-0.5 * total / 0.7), total)
    assert f == pytest.approx(whole, abs=1e-12)


def test_orifice_against_an_adaptive_integrator() -> None:
    """Up, down and up again, with the valve closing and opening in between."""
    pump = Pump(deflation=Orifice(), delay_ticks=0)
    p = pump_coefficients(pump)
    a, b = p.laminar, p.turbulent
    force, f = [], 0.0
    reference, r = [], 0.0
    for g in np.repeat([1.8, 0.3, 0.0, 1.2], 120).tolist():
        dt = pump.tick_s

        def slope(_: float, y: FloatArray, g: float = g) -> FloatArray:
            return np.maximum((g - y) / 0.7, -2 * y / (a + np.sqrt(a * a + 4 * b * y)))

        r = float(solve_ivp(slope, (0, dt), [r], rtol=1e-11, atol=1e-13).y[0, -1])
        reference.append(r)
        before = f
        _, middle, f = advance(p, 0.0, f, g, 1.0, dt)
        force.append(f)
        assert min(before, f) - 1e-12 <= middle <= max(before, f) + 1e-12
    # The corner where the valve closes or opens costs the one step per tick its order.
    assert np.abs(np.array(force) - reference).max() < 2e-5


def test_orifice_falls_like_its_pressure_law() -> None:
    """F = a w + b w^2 all the way down, nearly exponential at the end."""
    law = Orifice()
    pump = Pump(deflation=law, delay_ticks=0)
    force = ticks(pump, [0.0] * 600, PumpState((FULL_N, 0.0), (FULL_N, 0.0), ()))
    w = -np.gradient(force, pump.tick_s)[1:-1]
    assert law.laminar_s * w + law.turbulent_s2_per_N * w**2 == pytest.approx(force[1:-1], rel=2e-4, abs=1e-7)
    late = np.log(force[540] / force[599]) / (59 * pump.tick_s)
    assert 1 / late == pytest.approx(law.laminar_s, rel=2e-3)


def test_orifice_and_rate_limit_settle_alike() -> None:
    for pwm in (0.0, 140.0, 200.0, 255.0):
        ends = [ticks(Pump(deflation=d), [255.0] * 200 + [pwm] * 1500)[-1] for d in DEFLATIONS]
        assert ends[0] == pytest.approx(float(static_force_N(Pump(), np.array(pwm))), abs=1e-9)
        assert ends[1] == pytest.approx(ends[0], abs=1e-5)


def test_rest_under_a_held_command_stays() -> None:
    for deflation in DEFLATIONS:
        pump = Pump(deflation=deflation)
        state = pump_at_rest(pump, (200.0, 130.0))
        moved = step_pump(pump, state, (200.0, 130.0))
        assert moved.force_N == pytest.approx(state.force_N, abs=1e-15)
        assert moved.waiting_pwm == state.waiting_pwm


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Pump(lag_s=0.0), "lag of the pump: found 0 s"),
        (lambda: Pump(tick_s=-0.1), "tick: found -0.1 s"),
        (lambda: Pump(delay_ticks=-1), "found -1 ticks"),
        (lambda: RateLimit(-2.0), "falling rate: found -2 N/s, expected a positive rate"),
        (lambda: Orifice(laminar_s=0.0), "orifice: found a = 0 s"),
        (lambda: Orifice(turbulent_s2_per_N=-1.0), "orifice"),
        (lambda: static_force_N(Pump(), np.array([1.0, math.nan])), "pwm: found a value that is not finite"),
        (lambda: delayed(Pump(), np.zeros((4, 3))), r"expected \(n, 2\)"),
    ],
)
def test_bad_input(build: object, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        build()
