"""States between nodes and the head's motion, against fine simulations, Jacobians and differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.stages.actuator.kinematics import forward, forward_jacobian, forward_jacobian_rate
from calib.stages.actuator.parameters import free_swing
from calib.stages.actuator.simulate import state_row, swing
from calib.twin.sensors import MOTION, head_rows, states_between

RADIUS_M = 0.0126
NODE_S = 1.0 / 300.0


def test_a_swing_between_nodes_is_that_of_a_fine_simulation() -> None:
    plant = free_swing()
    fine = swing(plant, state_row(plant, 0.5), 1.0, NODE_S / 16, every=1)
    between = states_between(NODE_S, fine.states[::16].copy(), fine.t_s)
    error = np.abs(between - fine.states)
    assert error[:, :2].max() < 1.2e-8
    assert error[:, 2:4].max() < 1.2e-5
    assert error[:, 4:6].max() < 1e-4
    assert np.array_equal(between[::16], fine.states[::16])


def test_cubics_are_exact_with_their_rates() -> None:
    t = NODE_S * np.arange(6)
    nodes = np.zeros((6, 10))
    for k, c in enumerate(([0.06, 0.1, -3.0, 40.0], [0.07, -0.2, 5.0, 10.0])):
        nodes[:, k] = np.polyval(c[::-1], t)
        nodes[:, k + 2] = np.polyval(np.polyder(c[::-1]), t)
    at = np.random.default_rng(0).uniform(0.0, t[-1], 200)
    states = states_between(NODE_S, nodes, at)
    for k, c in enumerate(([0.06, 0.1, -3.0, 40.0], [0.07, -0.2, 5.0, 10.0])):
        assert np.allclose(states[:, k], np.polyval(c[::-1], at), rtol=0.0, atol=1e-15)
        assert np.allclose(states[:, k + 2], np.polyval(np.polyder(c[::-1]), at), rtol=0.0, atol=1e-13)


@settings(deadline=None)  # the first call compiles
@given(st.integers(0, 4_000_000))
def test_a_time_meant_to_be_a_nodes_own_finds_it(sample: int) -> None:
    # 100 Hz samples fall on nodes 1/300 s apart; the division must not miss them by rounding.
    nodes = np.random.default_rng(0).normal(size=(4, 10))
    near = np.array([sample / 100.0 - 3 * sample * NODE_S + NODE_S])
    assert np.array_equal(states_between(NODE_S, nodes, near)[0], nodes[1])


def test_times_outside_are_held() -> None:
    nodes = np.random.default_rng(1).normal(size=(3, 10))
    states = states_between(NODE_S, nodes, np.array([-1.0, 0.0, 2 * NODE_S, 5.0]))
    assert np.array_equal(states, nodes[[0, 0, 2, 2]])
    assert np.array_equal(states_between(NODE_S, nodes[:1], np.array([0.0, 1.0])), nodes[[0, 0]])


@pytest.mark.parametrize("bend", [1.0, 1e-3, 1e-9, 0.0])
def test_accelerations_are_those_of_the_jacobian_and_its_rate(bend: float) -> None:
    rng = np.random.default_rng(2)
    n = 200
    half = RADIUS_M * bend * rng.uniform(-1.5, 1.5, n)
    length = rng.uniform(0.05, 0.1, n)
    states = np.zeros((n, 10))
    states[:, 0], states[:, 1] = length + half, length - half
    states[:, 2:4] = 0.3 * rng.normal(size=(n, 2))
    ddq = 20.0 * rng.normal(size=(n, 2))
    q, dq = states[:, :2], states[:, 2:4]
    rows = head_rows(RADIUS_M, states, ddq)
    pose = forward(q, RADIUS_M)
    J, rate = forward_jacobian(q, RADIUS_M), forward_jacobian_rate(q, dq, RADIUS_M)
    expected = np.einsum("nij,nj->ni", J, ddq) + np.einsum("nij,nj->ni", rate, dq)
    assert rows.shape == (n, len(MOTION))
    assert np.allclose(rows[:, 3:5], pose[:, :2], rtol=0.0, atol=1e-15)
    assert np.allclose(rows[:, 0], pose[:, 2], rtol=0.0, atol=1e-12)
    assert np.allclose(rows[:, 1], np.einsum("nij,nj->ni", J, dq)[:, 2], rtol=1e-12)
    assert np.allclose(rows[:, 2], expected[:, 2], rtol=1e-10, atol=1e-8)
    assert np.allclose(rows[:, 5:7], expected[:, :2], rtol=1e-10, atol=1e-9)
