"""Sections in series: composition, rigid limits and the tip's Jacobian."""

from __future__ import annotations

import numpy as np
import pytest

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.actuator import chain as sections
from calib.stages.actuator import kinematics as kin

R_B = 0.0126


def bellows(seed: int, n: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.05, 0.09, (n, 2))


def test_one_section_is_the_single_actuator() -> None:
    q = bellows(0, 1)
    assert sections.poses(q, R_B)[0] == pytest.approx(kin.forward(q[0], R_B))
    assert sections.tip_jacobian(q, R_B) == pytest.approx(kin.forward_jacobian(q[0], R_B))


@pytest.mark.parametrize("n", [2, 3, 6])
def test_heads_are_the_composition(n: int) -> None:
    q = bellows(n, n)
    whole = np.eye(3)
    for i, H in enumerate(sections.heads(q, R_B)):
        whole = whole @ kin.transform(kin.angle(q[i], R_B), kin.length(q[i]))
        assert pytest.approx(whole, abs=1e-15) == H
        x, y, phi = sections.poses(q, R_B)[i]
        assert [x, y] == pytest.approx(H[:2, 2])
        assert [np.sin(phi), np.cos(phi)] == pytest.approx(H[:2, 1], abs=1e-14)


def test_equal_curvature_makes_one_long_arc() -> None:
    """n sections of the same curvature lie on one circle, as a single section n times as long."""
    q = np.tile([0.07, 0.065], (4, 1))
    kappa, length = kin.configuration(q[0], R_B)
    whole = kin.pose_from_configuration(np.array([kappa, 4 * length]))
    assert sections.poses(q, R_B)[-1] == pytest.approx(whole, abs=1e-15)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_tip_jacobian_against_differences(n: int) -> None:
    q, h = bellows(10 + n, n), 1e-6
    radii = np.linspace(0.010, 0.014, n)
    J = sections.tip_jacobian(q, radii)
    for j in range(2 * n):
        step = np.zeros(2 * n)
        step[j] = h
        step = step.reshape(n, 2)
        column = (sections.poses(q + step, radii)[-1] - sections.poses(q - step, radii)[-1]) / (2 * h)
        assert J[:, j] == pytest.approx(column, abs=1e-7)


def test_straight_sections_add_up() -> None:
    q = np.full((5, 2), 0.065)
    assert sections.poses(q, R_B)[-1] == pytest.approx([0.0, 0.325, 0.0], abs=1e-15)


@pytest.mark.parametrize(
    ("q", "radius", "words"),
    [
        (np.zeros((0, 2)), R_B, "expected"),
        (np.zeros(2), R_B, "expected"),
        (np.full((3, 2), 0.065), np.array([R_B, R_B]), "3 values"),
    ],
)
def test_bad_input(q: FloatArray, radius: float | FloatArray, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        sections.heads(q, radius)
