"""Margins against closed forms, and against raising the gain until the loop is unstable."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from control_models import NOMINAL, ORIFICE
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.control.linear import System, bent_rest, closed_loop, delay, response, series, spectral_radius
from calib.control.margins import (
    break_at,
    frequencies,
    gain_to_instability,
    loop_margins,
    margins_of_response,
)
from calib.control.pid import Pid
from calib.control.tuning import orientation_loop, position_loop

H = NOMINAL.tick_s


def _integrator(k: float) -> System:
    return System(np.eye(1), np.array([[k * H]]), np.eye(1), np.zeros((1, 1)), H)


@given(k=st.floats(0.5, 60.0))
def test_an_integrator_has_the_margins_of_the_book(k: float) -> None:
    """L = k h / (z - 1): gain margin 2 / (k h), |L| = 1 at 2 sin(w h / 2) = k h, phase pi / 2 - w h / 2."""
    (found,) = loop_margins(_integrator(k))
    assert found.stable
    assert found.gain == pytest.approx(2.0 / (k * H), rel=1e-3)
    half = math.asin(0.5 * k * H)
    assert found.phase_rad == pytest.approx(0.5 * math.pi - half, abs=2e-3)
    assert found.crossover_hz == pytest.approx(half / (math.pi * H), rel=1e-2)
    assert found.delay_s == pytest.approx((0.5 * math.pi - half) / (2.0 * half / H), rel=2e-2)


@pytest.mark.parametrize("model", [NOMINAL, ORIFICE])
@pytest.mark.parametrize("phi", [0.15, 0.4, 0.8])
@pytest.mark.parametrize("gains", [(470.0, 1000.0, 0.0), (350.0, 300.0, 10.0), (600.0, 0.0, 0.0)])
def test_the_gain_margin_by_brute_force(model: object, phi: float, gains: tuple[float, ...]) -> None:
    loop = orientation_loop(model, Pid(*gains), tuple(bent_rest(model, phi)))
    (found,) = loop_margins(loop)
    assert found.stable
    assert found.gain == pytest.approx(gain_to_instability(loop), rel=1e-3)


@pytest.mark.parametrize("q", [(0.07, 0.07), (0.078, 0.078), (0.085, 0.072)])
@pytest.mark.parametrize("sensing", [False, True])
def test_each_channel_of_the_position_loop_by_brute_force(q: tuple[float, float], sensing: bool) -> None:
    loop = position_loop(NOMINAL, Pid(18000.0, 0.0, 180.0), q, sensing)
    for i, found in enumerate(loop_margins(loop)):
        assert found.stable
        assert found.gain == pytest.approx(gain_to_instability(loop, i), rel=1e-3)


def test_the_delay_margin_by_brute_force() -> None:
    """So many ticks more are stable as fit into the delay margin, and one more is not."""
    loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0), tuple(bent_rest(NOMINAL, 0.5)))
    (found,) = loop_margins(loop)
    ticks = math.floor(found.delay_s / H)
    assert ticks >= 3
    assert spectral_radius(closed_loop(series(loop, delay(ticks, H)))) < 1.0
    assert spectral_radius(closed_loop(series(loop, delay(ticks + 1, H)))) > 1.0


def test_the_phase_margin_by_turning_the_loop() -> None:
    """Turned by the phase margin the response passes -1, turned by less it does not."""
    loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0), tuple(bent_rest(NOMINAL, 0.5)))
    w = frequencies(H, 20000)
    L = break_at(response(loop, w), 0)
    found = margins_of_response(w, L, True)
    least = float(np.abs(1.0 + L * np.exp(-1j * found.phase_rad)).min())
    assert least < 1e-3
    assert float(np.abs(1.0 + L * np.exp(-0.9j * found.phase_rad)).min()) > 10.0 * least


def test_the_sensitivity_bounds_both_margins() -> None:
    """GM >= Ms / (Ms - 1) and PM >= 2 asin(1 / 2 Ms), as for every loop."""
    for phi in (0.1, 0.3, 0.6):
        loop = orientation_loop(NOMINAL, Pid(470.0, 1000.0, 3.0), tuple(bent_rest(NOMINAL, phi)))
        (m,) = loop_margins(loop)
        assert m.gain >= m.sensitivity / (m.sensitivity - 1.0) - 1e-2
        assert m.phase_rad >= 2.0 * math.asin(0.5 / m.sensitivity) - 1e-2


def test_an_unstable_loop_says_so() -> None:
    """The source's PID on the nominal model: at 0.5 rad its loop is unstable for small motion."""
    loop = orientation_loop(NOMINAL, Pid(1000.0, 1000.0, 10.0), tuple(bent_rest(NOMINAL, 0.5)))
    assert not loop_margins(loop)[0].stable
    assert gain_to_instability(loop) == 1.0


def test_a_loop_that_nothing_upsets() -> None:
    still = System(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.2]]), H)
    (m,) = loop_margins(still)
    assert m.stable and math.isinf(m.gain) and math.isinf(m.phase_rad) and m.crossover_hz == 0.0
    assert math.isinf(gain_to_instability(still))


@settings(max_examples=30)
@given(a=st.floats(-0.5, 0.5), b=st.floats(-0.5, 0.5), c=st.floats(-0.5, 0.5), d=st.floats(-0.5, 0.5))
def test_breaking_one_channel_keeps_the_determinant(a: float, b: float, c: float, d: float) -> None:
    """det(I + L) = (1 + L_i) det(I + L_oo): the broken loop encircles -1 as often as the whole."""
    L = np.array([[[a, b], [c, d]]], dtype=np.complex128)
    whole = np.linalg.det(np.eye(2) + L[0])
    assert (1.0 + break_at(L, 0)[0]) * (1.0 + d) == pytest.approx(whole)
    assert (1.0 + break_at(L, 1)[0]) * (1.0 + a) == pytest.approx(whole)


def test_scaling_a_loop_scales_its_margin() -> None:
    loop = orientation_loop(NOMINAL, Pid(400.0, 500.0), tuple(bent_rest(NOMINAL, 0.4)))
    twice = replace(loop, C=1.25 * loop.C, D=1.25 * loop.D)
    assert loop_margins(twice)[0].gain == pytest.approx(loop_margins(loop)[0].gain / 1.25, rel=1e-3)
