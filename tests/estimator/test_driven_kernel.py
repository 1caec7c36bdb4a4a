"""One event of the driven filter: gradients of readings, cutting at commands, what is considered."""

from __future__ import annotations

import numpy as np
import pytest
from drivenlogs import varied_drive
from estimatorlogs import setup_for

from calib.arrays import FloatArray
from calib.estimator.driven_kernel import CAMERA, HOSES, IMU, WORK, cut, driven_event, measure
from calib.estimator.driven_model import DRIVEN
from calib.estimator.driven_setup import Drive

CONSTANTS = np.array([9.81, 0.0])


def some(seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """State, covariance, plant, view and noise."""
    setup, drive = setup_for(varied_drive(1)), Drive()
    x, P = drive.start(setup)
    rng = np.random.default_rng(seed)
    x[:4] = 0.3, 0.07, 2.0, 0.02
    x[4:12] = rng.uniform(0.0, 0.1, 8)
    P[:4, :4] = np.diag([1e-2, 1e-3, 1e-2, 1e-3]) ** 2
    return x, P, drive.numbers(), setup.view, setup.noise


@pytest.mark.parametrize("kind", [CAMERA, IMU])
def test_gradients_agree_with_differences(kind: int) -> None:
    x, P, plant, view, noise = some()
    n, count = len(DRIVEN), 2 if kind == CAMERA else 3
    H, spare, out, work = np.zeros((3, n)), np.zeros((3, n)), np.zeros(n), np.zeros(WORK)
    measure(kind, x, P, plant, view, CONSTANTS, noise, 0.0, H, out, work)
    for k in range(n):
        h = 1e-7 if DRIVEN[k].endswith("_m") else 1e-5
        above, below = np.zeros(n), np.zeros(n)
        for sign, to in ((1.0, above), (-1.0, below)):
            near = x.copy()
            near[k] += sign * h
            measure(kind, near, P, plant, view, CONSTANTS, noise, 0.0, spare, to, work)
        slope = (above[:count] - below[:count]) / (2.0 * h)
        np.testing.assert_allclose(H[:count, k], slope, rtol=2e-3, atol=2e-3)


def test_steps_are_cut_where_commands_act() -> None:
    times, forces = np.array([-np.inf, 1.0, 1.2, 1.4]), np.arange(8.0).reshape(4, 2)
    segments = np.empty((12, 3))

    def pieces(begin: float, end: float, last: int) -> list[list[float]]:
        count = cut(begin, end, times, forces, last, segments)
        return [[round(float(value), 9) for value in row] for row in segments[:count]]

    assert pieces(1.05, 1.1, 3) == [[0.05, 2.0, 3.0]]
    assert pieces(0.9, 1.3, 3) == [[0.1, 0.0, 1.0], [0.2, 2.0, 3.0], [0.1, 4.0, 5.0]]
    assert pieces(1.4, 1.5, 3) == [[0.1, 6.0, 7.0]]
    assert pieces(1.5, 1.6, 1) == [[0.1, 2.0, 3.0]]
    # A ring that has been gone round: the newest entry is in the middle.
    ring = np.array([1.2, 1.4, -np.inf, 1.0])
    count = cut(1.1, 1.3, ring, forces, 1, segments)
    assert segments[:count, 1].tolist() == [6.0, 0.0]


@pytest.mark.parametrize("kind", [CAMERA, IMU])
def test_what_is_considered_stays_and_the_rest_learns(kind: int) -> None:
    x, P, plant, view, noise = some()
    before_x, before_P = x.copy(), P.copy()
    n = len(DRIVEN)
    out, H, work, report, gated = np.zeros(n), np.zeros((3, n)), np.zeros(WORK), np.empty(12), np.zeros(3)
    measure(kind, x, P, plant, view, CONSTANTS, noise, 0.0, H, out, work)
    z = np.array([out[0] + 0.5, out[1] - 0.4, out[2] + 0.002, 0.0])
    driven_event(x, P, kind, z, plant, view, CONSTANTS, noise, work, False, report, gated)
    held = [28, 29, 31, 32, 33]
    np.testing.assert_array_equal(x[held], before_x[held])
    np.testing.assert_array_equal(P[np.ix_(held, held)], before_P[np.ix_(held, held)])
    np.testing.assert_array_equal(P, P.T)
    assert np.all(np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))) > -1e-9)
    assert np.all(np.diag(P) <= np.diag(before_P) * (1.0 + 1e-12))
    told = 0 if kind == CAMERA else 2
    assert P[told, told] < 0.98 * before_P[told, told]
    assert gated[0 if kind == CAMERA else 2] == 0.0


def test_an_outlier_is_gated_and_changes_nothing() -> None:
    x, P, plant, view, noise = some()
    n = len(DRIVEN)
    out, H, work, report, gated = np.zeros(n), np.zeros((3, n)), np.zeros(WORK), np.empty(12), np.zeros(3)
    measure(CAMERA, x, P, plant, view, CONSTANTS, noise, 0.0, H, out, work)
    before = x.copy()
    z = np.array([out[0] + 15.0, out[1], np.nan, 0.0])
    driven_event(x, P, CAMERA, z, plant, view, CONSTANTS, noise, work, False, report, gated)
    assert gated[0] == 1.0 and report[8] == 1.0 and report[0] > noise[8]
    np.testing.assert_array_equal(x, before)


def test_hoses_settle_the_damping() -> None:
    x, P, plant, view, noise = some()
    at = DRIVEN.index("log_damping")
    assert x[at] < -0.5 and P[at, at] > 0.5
    z = np.array([0.1, np.nan, np.nan, 0.0])
    driven_event(
        x, P, HOSES, z, plant, view, CONSTANTS, noise, np.zeros(WORK), False, np.empty(12), np.zeros(3)
    )
    assert abs(x[at]) < 0.02
    assert P[at, at] == pytest.approx(0.01, rel=0.05)
