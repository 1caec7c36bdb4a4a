"""The filter over whole logs against its step function, sample by sample."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import BadInputError
from calib.imu.mahony import Mahony, MahonySample, MahonyState, accelerometer_angle, step
from calib.imu.mahony_batch import accelerometer_angles, filter_log, filter_many, wrapped


def _stepped(
    gains: Mahony, t: np.ndarray, acc: np.ndarray, w: np.ndarray, start: MahonyState
) -> tuple[np.ndarray, np.ndarray]:
    state, phi, integral, before = start, [], [], float(t[0])
    for at, (ax, ay), rate in zip(t.tolist(), acc.tolist(), w.tolist(), strict=True):
        state = step(gains, state, MahonySample(ax, ay, -rate, at - before))
        before = at
        phi.append(state.phi_rad)
        integral.append(state.integral_radps)
    return np.array(phi), np.array(integral)


def _log(seed: int, n: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Uneven stamps with repetitions and gaps, an angle of several turns, noise beyond half a turn."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.002, 0.02, n)
    dt[rng.random(n) < 0.02] = 0.0
    dt[rng.integers(0, n, 5)] = 0.3
    phi = np.cumsum(rng.normal(0.01, 0.05, n))
    angle = phi + rng.normal(0.0, 1.0, n)
    return np.cumsum(dt), 9.8 * np.stack([np.cos(angle), np.sin(angle)], axis=1), np.gradient(phi) / 0.011


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("Kp", "Ki"), [(3.0, 3.0), (0.3, 0.0), (12.0, 40.0)])
def test_equal_to_the_step_function(seed: int, Kp: float, Ki: float) -> None:
    t, acc, w = _log(seed)
    angles = accelerometer_angles(acc[:, 0], acc[:, 1])
    start = MahonyState(0.4, -0.1)
    phi, integral = filter_log(Mahony(Kp, Ki), t, angles, w, start)
    expected = _stepped(Mahony(Kp, Ki), t, acc, w, start)
    assert np.ptp(phi) > 4.0 * math.pi
    assert np.abs(phi - expected[0]).max() < 1e-12
    assert np.abs(integral - expected[1]).max() < 1e-12


@settings(max_examples=25, deadline=None)
@given(st.floats(0.0, 20.0), st.floats(0.0, 30.0), st.integers(0, 1000))
def test_many_pairs_at_once_are_each_the_same(Kp: float, Ki: float, seed: int) -> None:
    t, acc, w = _log(seed, 200)
    angles = accelerometer_angles(acc[:, 0], acc[:, 1])
    pairs = [Mahony(Kp, Ki), Mahony()]
    phi = filter_many(pairs, t, angles, w)
    for gains, row in zip(pairs, phi, strict=True):
        assert np.array_equal(row, filter_log(gains, t, angles, w)[0])


def test_starts_at_the_first_angle_and_repeated_stamps_change_nothing() -> None:
    t = np.array([5.0, 5.0, 5.0])
    phi, integral = filter_log(Mahony(), t, np.array([0.3, 1.0, -1.0]), np.full(3, 9.0))
    assert phi.tolist() == [0.3] * 3
    assert integral.tolist() == [0.0] * 3


def test_angles_of_the_accelerometer() -> None:
    rng = np.random.default_rng(0)
    ax, ay = rng.normal(size=(2, 50))
    expected = [accelerometer_angle(a, b) for a, b in zip(ax.tolist(), ay.tolist(), strict=True)]
    assert np.allclose(accelerometer_angles(ax, ay), expected, rtol=0.0, atol=1e-15)
    assert np.allclose(wrapped(np.array([7.0, -4.0])), [7.0 - 2.0 * np.pi, -4.0 + 2.0 * np.pi])


@pytest.mark.parametrize(
    ("t", "acc", "words"),
    [
        ([0.0, 1.0, 0.5], [0.0, 0.0, 0.0], "goes back from 1.000000 to 0.500000 s at sample 2"),
        ([0.0, 1.0], [0.0, 0.0, 0.0], "expected as many of each"),
        ([], [], "at least one"),
        ([0.0, 1.0, 2.0], [0.0, math.nan, 0.0], "not finite"),
    ],
)
def test_bad_logs(t: list[float], acc: list[float], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        filter_log(Mahony(), np.array(t), np.array(acc), np.zeros(len(acc)))
