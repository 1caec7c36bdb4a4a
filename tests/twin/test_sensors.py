"""The head's true motion against differences of its path, and time stamps against their statistics."""

from __future__ import annotations

import numpy as np
import pytest

from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.parameters import free_swing
from calib.stages.actuator.simulate import state_row, swing
from calib.twin.sensors import Trajectory, head_motion, normal, stamps, stream


def test_the_motion_of_a_swing_is_that_of_its_path() -> None:
    plant = free_swing()
    h = 1e-4
    fine = swing(plant, state_row(plant, 0.5, 0.07), 0.6, h)
    motion = head_motion(coefficients(plant), fine.states)
    inner = slice(200, -200)
    for value, rate in (
        (motion.phi_rad[:, None], motion.dphi_radps[:, None]),
        (motion.dphi_radps[:, None], motion.ddphi_radps2[:, None]),
    ):
        slope = (value[2:] - value[:-2]) / (2.0 * h)
        assert np.abs(slope - rate[1:-1])[inner].max() < 2e-4 * np.abs(rate).max()
    path = motion.position_m
    second = (path[2:] - 2.0 * path[1:-1] + path[:-2]) / (h * h)
    assert np.abs(second - motion.acceleration_mps2[1:-1])[inner].max() < 2e-3
    # As much as gravity, as a swing at 4 Hz must be.
    assert 8.0 < np.abs(motion.acceleration_mps2[1000:]).max() < 25.0


def test_a_trajectory_can_be_asked_at_any_times() -> None:
    nodes = np.zeros((4, 10))
    nodes[:, 0] = nodes[:, 1] = 0.065
    nodes[:, 8] = [0.0, 1.0, 2.0, 3.0]
    trajectory = Trajectory(0.5, nodes)
    assert trajectory.at(np.array([0.25, 1.5, 99.0]))[:, 8].tolist() == [0.5, 3.0, 3.0]
    assert trajectory.at(np.zeros(0)).shape == (0, 10)


def test_stamps_jitter_repeat_and_never_run_backwards() -> None:
    t = 0.01 * np.arange(200_000)
    stamped = stamps(t, 4e-4, 0.01, stream(0, 9))
    steps = np.diff(stamped)
    assert np.all(steps >= 0.0)
    # A repeated stamp makes a zero step; nothing else does at this jitter.
    share = float(np.mean(steps == 0.0))
    assert share == pytest.approx(0.01, abs=4.0 * np.sqrt(0.01 / len(t)))
    own = np.concatenate([[True], steps > 0.0])
    assert np.std((stamped - t)[own]) == pytest.approx(4e-4, rel=0.02)
    assert abs(float(np.mean((stamped - t)[own]))) < 5e-6
    assert np.array_equal(np.rint(stamped * 1e6) * 1e-6, stamped)
    assert stamped[0] >= 0.0


def test_stamps_without_errors_are_the_times() -> None:
    t = np.array([0.0, 0.01, 0.02])
    assert np.array_equal(stamps(t, 0.0, 0.0, stream(0, 1)), t)
    assert stamps(np.zeros(0), 1e-3, 0.5, stream(0, 1)).shape == (0,)


def test_streams_do_not_mix() -> None:
    first = normal(stream(1, 2, 0), 100)
    assert np.array_equal(first, normal(stream(1, 2, 0), 100))
    for other in (stream(1, 2, 1), stream(1, 3, 0), stream(2, 2, 0), stream(1, 2)):
        assert abs(float(np.corrcoef(first[:, 0], normal(other, 100)[:, 0])[0, 1])) < 0.4
