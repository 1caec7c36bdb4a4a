"""Motion is found where it is, and noise, steps and a walking bias are not taken for it."""

from __future__ import annotations

import numpy as np
import pytest

from calib.imu.rest import rest_parts
from calib.imu.sampling import Part

GYRO = np.array([True, False])
NONE = np.array([np.nan, np.nan])
NOISE = np.array([2.4e-3, 0.015])


def _part(values: np.ndarray, start_s: float = 5.0) -> tuple[Part, ...]:
    places = np.arange(len(values))
    return (Part(start_s, values, places, places),)


def _still(seed: int, n: int = 6000) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).normal(size=(n, 2)) + [0.006, 9.81]


def test_rest_is_rest() -> None:
    for seed in range(40):
        parts, motions = rest_parts(_part(_still(seed)), 0.01, GYRO, NONE)
        assert motions == ()
        assert len(parts[0].values) == 6000


def test_a_walking_bias_and_a_coarse_step_are_rest() -> None:
    rng = np.random.default_rng(1)
    walk = np.cumsum(1e-4 * rng.normal(size=(60_000, 2)), axis=0)
    assert rest_parts(_part(_still(2, 60_000) + walk), 0.01, GYRO, NONE)[1] == ()
    coarse = 0.02 * np.rint(_still(3) / 0.02)
    assert rest_parts(_part(coarse), 0.01, GYRO, np.array([0.02, 0.02]))[1] == ()


@pytest.mark.parametrize(("axis", "size"), [(0, 0.03), (1, 0.2)])
def test_a_knock_is_found_and_cut_out(axis: int, size: float) -> None:
    values = _still(4)
    values[2030:2090, axis] += size * np.sin(np.arange(60))
    parts, motions = rest_parts(_part(values), 0.01, GYRO, NONE)
    (motion,) = motions
    assert motion.axis == axis
    assert motion.from_s <= 5.0 + 20.3
    assert motion.to_s >= 5.0 + 20.9
    assert motion.to_s - motion.from_s <= 2.1
    assert [len(part.values) for part in parts] == [
        2000,
        6000 - 2000 - round((motion.to_s - motion.from_s) * 100),
    ]
    assert parts[1].places[0] == 0
    assert np.array_equal(parts[1].values, values[parts[1].rows])


def test_a_new_pose_is_motion_even_without_noise_in_between() -> None:
    values = _still(5)
    values[3000:, 1] += 0.1
    _, motions = rest_parts(_part(values), 0.01, GYRO, NONE)
    assert len(motions) == 1
    assert motions[0].axis == 1


def test_a_log_that_mostly_moves_keeps_its_rest() -> None:
    values = _still(6)
    values[1500:5000] += np.array([0.5, 2.0]) * np.sin(0.3 * np.arange(3500))[:, None]
    parts, motions = rest_parts(_part(values), 0.01, GYRO, NONE)
    assert len(motions) == 1
    assert sum(len(part.values) for part in parts) >= 2300


def test_a_log_of_less_than_a_window_is_left_alone() -> None:
    parts, motions = rest_parts(_part(_still(7, 50)), 0.01, GYRO, NONE)
    assert (len(parts), motions) == (1, ())
