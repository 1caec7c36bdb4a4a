"""The pump's models: closed forms, limits, and what the start may use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.actuator.identify_pump_models import LAG, ORIFICE, PumpRecord, Shape, simulate_pump
from calib.actuator.pump import Orifice
from calib.errors import BadInputError

T = 0.02 * np.arange(200)
FREE = 1e6


def _record(pwm: np.ndarray, value: np.ndarray | None = None) -> PumpRecord:
    return PumpRecord("run", T, pwm, np.zeros(len(T)) if value is None else value)


def _step(at_s: float = 0.1, level: float = 255.0) -> np.ndarray:
    return np.where(at_s - 1e-9 <= T, level, 0.0)


def test_the_lag_is_the_exponential_that_it_should_be() -> None:
    theta = np.array([0.05, 30.0, 0.6, FREE])
    told = simulate_pump(LAG, theta, _record(_step()), start_s=-1.0)
    expected = 30.0 * -np.expm1(-np.maximum(T - 0.15, 0.0) / 0.6)
    assert np.allclose(told, expected, atol=2e-3)


def test_a_limit_on_the_rate_is_kept() -> None:
    told = simulate_pump(LAG, np.array([0.0, 30.0, 0.1, 12.0]), _record(_step()))
    assert np.diff(told).max() == pytest.approx(12.0 * 0.02, rel=1e-6)


def test_dead_time_shifts_and_is_smooth() -> None:
    for model, theta in (
        (LAG, [0.05, 30.0, 0.6, FREE]),
        (ORIFICE, [0.05, 30.0, 0.2, 5e-3, FREE, 20.0, 0.05]),
    ):
        base = np.array(theta)
        near = [
            simulate_pump(model, np.concatenate([[d], base[1:]]), _record(_step()))
            for d in (0.05, 0.0501, 0.0502)
        ]
        first, second = near[1] - near[0], near[2] - near[1]
        assert np.abs(first - second).max() < 0.1 * np.abs(first).max() + 1e-9
        assert np.abs(first).max() < 0.02


def test_the_flow_in_follows_the_law_of_the_orifice() -> None:
    """Without hose and leak the fall of g - p is the emptying of `Orifice` with the same coefficients."""
    a, b, level = 0.3, 0.01, 30.0
    told = simulate_pump(ORIFICE, np.array([0.0, level, a, b, FREE, 0.0, 1.0]), _record(_step(0.0)))
    law, drop, h = Orifice(a, b), level, 1e-4
    expected = []
    for k in range(len(T)):
        expected.append(level - drop)
        for _ in range(round(0.02 / h)):
            w = 2.0 * drop / (law.laminar_s + np.sqrt(law.laminar_s**2 + 4.0 * law.turbulent_s2_per_N * drop))
            drop -= h * w
        assert k >= 0
    assert np.allclose(told, expected, atol=0.02)


def test_valves_hold_the_pressure_and_a_leak_lets_it_go() -> None:
    pwm = np.where(T < 2.0, 255.0, 0.0)
    tight = simulate_pump(ORIFICE, np.array([0.0, 30.0, 0.1, 0.01, FREE, 0.0, 1.0]), _record(pwm))
    assert tight[-1] == pytest.approx(tight[np.searchsorted(T, 2.05)], rel=1e-4)
    leaking = simulate_pump(ORIFICE, np.array([0.0, 30.0, 0.1, 0.01, 2.0, 0.0, 1.0]), _record(pwm))
    late = T > 2.1
    slope = np.polyfit(T[late], np.log(leaking[late]), 1)[0]
    assert slope == pytest.approx(-0.5, rel=1e-3)


def test_the_start_uses_the_beginning_alone() -> None:
    theta = np.array([0.05, 30.0, 0.2, 5e-3, FREE, 30.0, 0.05])
    value = simulate_pump(ORIFICE, theta, _record(_step(), np.zeros(len(T))))
    # The range of the values, which the prior is a share of, is kept.
    late = np.where((T > 0.25) & (T < 2.0), value.max() - 3.0, value)
    one = simulate_pump(ORIFICE, theta, _record(_step(), value))
    assert np.abs(one - simulate_pump(ORIFICE, theta, _record(_step(), late))).max() < 1e-9


def test_a_chamber_under_pressure_shows_as_a_jump() -> None:
    theta = np.array([0.05, 30.0, 0.2, 5e-3, FREE, 60.0, 0.03])
    plain = simulate_pump(ORIFICE, theta, _record(_step(0.04), np.zeros(len(T))))
    head = np.where(T > 0.1, plain + 4.0, plain)
    told = simulate_pump(ORIFICE, theta, _record(_step(0.04), head))
    assert told[0] == 0.0
    assert told[10] > plain[10] + 2.0


def test_shapes_are_one_at_the_end_and_zero_in_the_dead_zone() -> None:
    u = np.array([0.0, 90.0, 100.0, 180.0, 255.0, 300.0])
    for shape in (Shape(), Shape(100.0), Shape(100.0, 30.0)):
        s = shape.of(u)
        assert s[4] == pytest.approx(1.0)
        assert s[5] == pytest.approx(1.0)
        assert np.all(np.diff(s) >= 0.0)
    assert np.allclose(Shape(100.0, 30.0).of(u)[:3], 0.0)
    assert np.allclose(Shape(100.0, 1e7).of(u), Shape(100.0).of(u), atol=1e-4)


def test_records_that_are_none_are_refused() -> None:
    with pytest.raises(BadInputError, match="found 3 rows"):
        PumpRecord("x", T[:3], T[:3], T[:3])
    with pytest.raises(BadInputError, match="runs backward"):
        PumpRecord("x", T[::-1].copy(), T, T)
    assert replace(_record(T), name="y").name == "y"
