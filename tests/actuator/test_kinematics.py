"""Kinematics of one section: the arc's functions against multiple precision, inverses, derivatives, signs."""

from __future__ import annotations

from math import copysign, factorial

import mpmath
import numpy as np
import pytest
import source_model as src
from hypothesis import given
from hypothesis import strategies as st

from calib.core.arrays import FloatArray
from calib.stages.actuator import kinematics as kin
from calib.stages.actuator.kinematics import (
    chord_curvature,
    chord_decay,
    chord_decay_w,
    chord_ratio,
    chord_ratio_w,
    chord_slope,
)

R_B = 0.0126
BELLOWS = st.floats(0.04, 0.1)
LENGTHS = st.floats(0.03, 0.12)
SIGNS = st.sampled_from([-1.0, 1.0])
# Exponents down to 1e-300 are as likely as ordinary angles.
TINY = st.builds(lambda s, m, e: s * m * 10.0**e, SIGNS, st.floats(1.0, 9.9), st.integers(-300, -1))
ANGLES = st.one_of(st.floats(-6.0, 6.0), TINY, st.just(0.0))


def random_bellows(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.04, 0.1, (count, 2))


@given(BELLOWS, BELLOWS)
def test_inverse_of_forward_over_the_workspace(q1: float, q2: float) -> None:
    q = np.array([q1, q2])
    assert kin.inverse(kin.forward(q, R_B), R_B) == pytest.approx(q, abs=2e-16, rel=1e-14)


@given(ANGLES, LENGTHS)
def test_configuration_survives_task_space_at_any_curvature(phi: float, length: float) -> None:
    k = np.array([phi / length, length])
    back = kin.configuration_from_pose(src.pose_from_configuration(k))
    # Relative precision in the curvature, down to the smallest normal numbers.
    assert back[0] == pytest.approx(k[0], rel=4e-14, abs=0.0)
    assert back[1] == pytest.approx(k[1], rel=2e-14)
    assert copysign(1.0, back[0]) == copysign(1.0, k[0])


def test_signs_and_frames() -> None:
    """Bellows 1 longer: phi > 0, the head goes to +x, its tangent is (sin phi, cos phi)."""
    q = np.array([0.07, 0.06])
    x, y, phi = kin.forward(q, R_B)
    assert phi > 0 and x > 0 and y > 0
    H = src.transform(phi, kin.length(q))
    assert H[:2, 1] == pytest.approx([np.sin(phi), np.cos(phi)])
    assert H[:2, :2] @ H[:2, :2].T == pytest.approx(np.eye(2), abs=1e-15)
    assert np.linalg.det(H) == pytest.approx(1.0)
    assert H[:2, 2] == pytest.approx([x, y])


def test_bellows_end_beside_the_head() -> None:
    """Bellows at -+r_B in the head's frame are arcs of their own lengths about the same centre."""
    q = np.array([0.08, 0.06])
    kappa, length = src.configuration(q, R_B)
    H = src.transform(kappa * length, length)
    centre = np.array([1 / kappa, 0.0])
    for side, arc in ((-R_B, q[0]), (R_B, q[1])):
        end = H @ np.array([side, 0.0, 1.0])
        radius = float(np.linalg.norm(end[:2] - centre))
        assert radius * kappa * length == pytest.approx(arc, rel=1e-12)


def numeric(function: object, at: FloatArray, h: float = 1e-6) -> FloatArray:
    columns = []
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = h
        columns.append((function(at + step) - function(at - step)) / (2 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize(
    "q", [*random_bellows(1, 6), np.array([0.065, 0.065]), np.array([0.065, 0.065 + 1e-9])]
)
def test_jacobians_against_differences(q: FloatArray) -> None:
    assert kin.forward_jacobian(q, R_B) == pytest.approx(numeric(lambda p: kin.forward(p, R_B), q), abs=2e-8)


@pytest.mark.parametrize("q", [*random_bellows(2, 5), np.array([0.07, 0.07])])
def test_jacobian_rate_and_the_identity_323(q: FloatArray) -> None:
    """dJ/dt by the chain rule, and d(dx/dt)/dq = d/dt(dx/dq), which (3.35) rests on."""
    dq = np.array([0.3, -0.2])
    rate = kin.forward_jacobian_rate(q, dq, R_B)
    h = 1e-6
    along = (kin.forward_jacobian(q + h * dq, R_B) - kin.forward_jacobian(q - h * dq, R_B)) / (2 * h)
    assert rate == pytest.approx(along, abs=1e-6)
    swapped = numeric(lambda p: kin.forward_jacobian(p, R_B) @ dq, q)
    assert rate == pytest.approx(swapped, abs=1e-6)


@given(st.floats(-0.1, 0.1), st.floats(0.0, 0.12), st.floats(-3.0, 3.0))
def test_marker_and_head(x: float, y: float, phi: float) -> None:
    head = np.array([x, y])
    marker = kin.marker_from_head(head, np.array(phi))
    assert marker == pytest.approx([x + 0.015 * np.sin(phi), y + 0.015 * np.cos(phi)], abs=1e-16)
    assert src.head_from_marker(marker, np.array(phi)) == pytest.approx(head, abs=1e-16)


ANGLES_ARC = [
    0.0,
    1e-12,
    1e-4,
    0.1,
    1.5,
    2.0,
    4.0,
    6.2,
]


def exact(phi: float) -> tuple[float, float, float, float]:
    """S, S', S'', D with 60 digits, from the definition and its derivatives."""
    with mpmath.workdps(60):

        def S(x: mpmath.mpf) -> mpmath.mpf:
            return mpmath.sinc(x / 2)

        x = mpmath.mpf(phi)
        first, second = mpmath.diff(S, x), mpmath.diff(S, x, 2)
        decay = (S(x) - mpmath.cos(x / 2)) / x**2 if abs(phi) > 1e-10 else mpmath.mpf(1) / 12
        return float(S(x)), float(first), float(second), float(decay)


@pytest.mark.parametrize("phi", ANGLES_ARC)
def test_series_reach_machine_precision(phi: float) -> None:
    S, _, _, D = exact(phi)
    first_left_out = (phi / 2) ** 26 / factorial(27)
    assert chord_ratio_w(phi * phi) == pytest.approx(S, abs=4e-16 + first_left_out)
    assert chord_decay_w(phi * phi) == pytest.approx(D, abs=1e-16)
    assert float(chord_ratio(np.array(phi))) == pytest.approx(S, abs=4e-16)


@pytest.mark.parametrize("phi", [0.01, 0.7, -1.5, 3.0, 6.0])
def test_derivatives_match_multiple_precision(phi: float) -> None:
    _, S1, S2, _ = exact(phi)
    assert float(chord_slope(np.array(phi))) == pytest.approx(S1, rel=1e-13, abs=1e-15)
    assert float(chord_curvature(np.array(phi))) == pytest.approx(S2, rel=1e-12, abs=1e-15)


def test_limits_at_zero_curvature() -> None:
    assert float(chord_ratio(np.array(0.0))) == 1.0
    assert float(chord_decay(np.array(0.0))) == pytest.approx(1 / 12, rel=1e-15)
    assert float(chord_curvature(np.array(0.0))) == pytest.approx(-1 / 12, rel=1e-15)
    # S' = -phi / 12 keeps its relative precision where a difference quotient would have none.
    assert float(chord_slope(np.array(1e-300))) == pytest.approx(-1e-300 / 12, rel=1e-15)
