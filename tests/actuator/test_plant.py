"""Plant and pumps: parameters and laws, refused values, lag, limits, delay, and both deflation models."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from source_model import PRINTED_CREEP, PolynomialForce

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator.dynamics import linearised
from calib.stages.actuator.parameters import (
    Creep,
    Plant,
    Stiffness,
    UnstablePlantWarning,
    growth_rate_per_s,
    pumps_connected,
)
from calib.stages.actuator.pump import (
    ElongationForce,
    Orifice,
    Pump,
    RateLimit,
    advance_pump,
    pump_coefficients,
    settling_force_N,
    static_force_N,
)
from calib.stages.control.rig_model import Model, PumpEstimate, pumps_at_rest, push


def test_nominal_values() -> None:
    plant = Plant()
    assert (plant.mass_kg, plant.inertia_kgm2) == (0.0166, 1.27e-5)
    assert (plant.bellows_radius_m, plant.rest_length_m) == (0.0126, 0.065)
    assert plant.stiffness.coefficients == (47.7, 1092.9)
    assert (plant.damping_ratio, plant.damping_scale) == (0.0513, 3.3)
    assert pumps_connected().damping_scale == 16.0
    assert plant.bending_N_per_rad2 == 0.1695
    assert plant.creep_rates == (3.0, 10.0, -1.0)
    assert plant.gravity_mps2 == (0.0, 0.0)


@pytest.mark.parametrize("law", [Stiffness(), Stiffness((60.0,)), Stiffness((40.0, 500.0, -2e4, 3e5))])
def test_stiffness_law_is_consistent(law: Stiffness) -> None:
    """Secant and tangent belong to one force."""
    for eps in (-0.01, 1e-4, 0.01, 0.0266, 0.039):
        h = 1e-6
        force = [law.secant(e) * e for e in (eps - h, eps, eps + h)]
        assert law.tangent(eps) == pytest.approx((force[2] - force[0]) / (2 * h), rel=1e-5)
    assert law.secant(-0.02) == law.coefficients[0]


def test_printed_creep_is_refused_with_its_growth_rate() -> None:
    """lambda2 lambda3 = 27.8 N/m takes so much of k0 that z grows at 0.1047 / (1 - 27.8 / 47.7)."""
    with pytest.raises(BadInputError, match=r"leaves rest at 0\.25 1/s \(e-fold in 4 s\)"):
        Plant(creep=Creep(*PRINTED_CREEP))
    slow = 0.1047 / (1 - 14.98 * 1.854 / 47.7)
    with pytest.warns(UnstablePlantWarning, match="unstable"):
        kept = Plant(creep=Creep(*PRINTED_CREEP), allow_unstable=True)
    assert growth_rate_per_s(kept) == pytest.approx(slow, rel=0.01)


@pytest.mark.parametrize(
    "creep", [Creep(*PRINTED_CREEP), Creep(), Creep(1.0, 20.0, 1.0), Creep(2.0, 60.0, 1.0), None]
)
@pytest.mark.filterwarnings("ignore::calib.stages.actuator.parameters.UnstablePlantWarning")
def test_growth_rate_against_the_linearised_plant(creep: Creep | None) -> None:
    plant = Plant(creep=creep, allow_unstable=True)
    roots = np.linalg.eigvals(linearised(plant, np.array([0.065, 0.065])))
    expected = max(float(roots.real.max()), 0.0)
    assert growth_rate_per_s(plant) == pytest.approx(expected, rel=1e-9, abs=1e-7)


@given(st.floats(0.0, 1e3), st.floats(1e-2, 1e2))
def test_a_standard_linear_solid_is_stable(branch: float, relaxation: float) -> None:
    assert growth_rate_per_s(Plant(creep=Creep(1.0 / relaxation, branch, -1.0))) == 0.0


FULL_N = float(static_force_N(Pump(), np.array(255.0)))
DEFLATIONS = [RateLimit(), Orifice()]


def ticks(pump: Pump, pwm: list[float], state: PumpEstimate | None = None) -> FloatArray:
    """Force of pump 1 after each tick; pump 2 stays off."""
    model = Model(pumps_connected(), pump)
    state = state or pumps_at_rest(model)
    force = []
    for value in pwm:
        state = push(model, state, (value, 0.0))
        force.append(state.force_N[0])
        assert state.force_N[1] == 0.0
    return np.array(force)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.0, 255.0), st.floats(0.0, 255.0)), min_size=1, max_size=40),
    st.floats(0.5, 60.0),
    st.floats(0.01, 0.5),
    st.integers(0, 40),
)
def test_a_play_stays_within_its_width_and_does_not_know_time(
    rows: list[tuple[float, float]], play_pwm: float, play_N: float, cut: int
) -> None:
    pwm = np.array(rows)
    forces = settling_force_N(Pump(play_N=play_N), pwm, (1.1, 0.9))
    plain = settling_force_N(Pump(), pwm, (1.1, 0.9))
    assert np.array_equal(plain, static_force_N(Pump(), pwm) * (1.1, 0.9))
    assert np.abs(forces - plain).max() <= 0.5 * play_N + 1e-12
    both = Pump(play_pwm=play_pwm, play_N=play_N)
    whole = settling_force_N(both, pwm)
    assert np.all(whole >= 0.0)
    # A command that stays, and one in parts, change nothing.
    assert np.array_equal(settling_force_N(both, np.repeat(pwm, 3, axis=0))[::3], whole)
    held = np.zeros((2, 2))
    parts = [settling_force_N(both, part, held=held) for part in (pwm[:cut], pwm[cut:])]
    assert np.array_equal(np.concatenate(parts), whole)


def test_a_play_loops_by_its_width_and_a_pump_that_is_off_gives_none() -> None:
    up = np.arange(120.0, 241.0)
    pwm = np.concatenate([up, up[::-1], [0.0]])[:, None] * np.ones(2)
    held = np.zeros((2, 2))
    force = settling_force_N(Pump(play_pwm=20.0), pwm, held=held)
    assert np.allclose(force[20:121], static_force_N(Pump(), pwm[20:121] - 10.0))
    assert np.allclose(force[141:241], static_force_N(Pump(), pwm[141:241] + 10.0))
    assert force[-1].tolist() == [0.0, 0.0] and held[0].tolist() == [10.0, 10.0]


@pytest.mark.parametrize(("volt", "elongation_mm"), [(6, 1.88), (8, 11.11), (10, 21.73), (12, 26.56)])
def test_static_force_holds_the_measured_elongation(volt: float, elongation_mm: float) -> None:
    force = float(static_force_N(Pump(), np.array(volt * 255 / 12)))
    eps = 1e-3 * elongation_mm
    assert force == pytest.approx(Stiffness().secant(eps) * eps, rel=2e-3)


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


def test_printed_rate_limit_is_too_fast() -> None:
    """-2 N/s empties the bellows in 2.6 s, not 5 s: the lag then decides alone."""
    pump = Pump(deflation=RateLimit(2.0), delay_ticks=0)
    force = ticks(pump, [0.0] * 300, PumpEstimate((FULL_N, 0.0), (FULL_N, 0.0), ()))
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
    p, _ = pump_coefficients(Pump())
    x, f = lag, lag + above
    for dt in pieces:
        before = f
        x, middle, f = advance_pump(p, x, f, g, math.exp(-0.5 * dt / 0.7), dt)
        assert f >= before - 0.4 * dt - 1e-12
        assert f >= x - 1e-15
        assert middle >= before - 0.2 * dt - 1e-12
    total = sum(pieces)
    _, _, whole = advance_pump(p, lag, lag + above, g, math.exp(-0.5 * total / 0.7), total)
    assert f == pytest.approx(whole, abs=1e-12)


def test_orifice_against_an_adaptive_integrator() -> None:
    """Up, down and up again, with the valve closing and opening in between."""
    pump = Pump(deflation=Orifice(), delay_ticks=0)
    p, _ = pump_coefficients(pump)
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
        _, middle, f = advance_pump(p, 0.0, f, g, 1.0, dt)
        force.append(f)
        assert min(before, f) - 1e-12 <= middle <= max(before, f) + 1e-12
    # The corner where the valve closes or opens costs the one step per tick its order.
    assert np.abs(np.array(force) - reference).max() < 2e-5


def test_orifice_falls_like_its_pressure_law() -> None:
    """F = a w + b w^2 all the way down, nearly exponential at the end."""
    law = Orifice()
    pump = Pump(deflation=law, delay_ticks=0)
    force = ticks(pump, [0.0] * 600, PumpEstimate((FULL_N, 0.0), (FULL_N, 0.0), ()))
    w = -np.gradient(force, pump.tick_s)[1:-1]
    assert law.laminar_s * w + law.turbulent_s2_per_N * w**2 == pytest.approx(force[1:-1], rel=2e-4, abs=1e-7)
    late = np.log(force[540] / force[599]) / (59 * pump.tick_s)
    assert 1 / late == pytest.approx(law.laminar_s, rel=2e-3)
