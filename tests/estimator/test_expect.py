"""What a level expects: the sparse gradients and variances against matrices."""

from __future__ import annotations

import numpy as np
from estimatorlogs import rows_from, setup_for, simulated

from calib.arrays import FloatArray
from calib.estimator.bank import STATE, WIDTH, get, new_bank, put
from calib.estimator.expect import (
    FELT_X,
    FELT_Y,
    H_U,
    H_V,
    H_X,
    H_Y,
    H_Z,
    P0,
    SEEN,
    TOLD,
    TURNED,
    expect_camera,
    expect_imu,
)
from calib.estimator.filter import starting_state
from calib.estimator.reference import camera_terms, imu_terms
from calib.estimator.sensors import SIZE
from calib.estimator.setup import Setup


def _moving() -> tuple[Setup, FloatArray, FloatArray, FloatArray]:
    """A set-up, a bank of one moving level whose states are correlated, its state and covariance."""
    rig, log = simulated("static")
    setup = setup_for(rig)
    x, P, _ = starting_state(setup, rows_from(log))
    x, P = x[:1], P[:1]
    x[0, 2:6] = [3.0, 0.02, -20.0, 0.5]
    sigma = np.sqrt(np.diag(P[0]))
    A = np.random.default_rng(7).standard_normal((SIZE, SIZE)) * sigma[:, None] * 0.1
    P[0] = P[0] * 0.01 + A @ A.T
    bank = new_bank(1, 1)
    put(bank, 0, x, P)
    return setup, bank, x[0], P[0]


def _check(
    bank: FloatArray, P: FloatArray, k: int, told: FloatArray, H: FloatArray, at: int, places: tuple[int, ...]
) -> None:
    sparse = np.zeros(SIZE)
    sparse[list(places)] = told[0, at : at + len(places)]
    np.testing.assert_allclose(sparse, H, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(bank[P0 + WIDTH * k :][:SIZE], P @ H, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(told[0, 6 + k], H @ P @ H, rtol=1e-9)


def test_pixels() -> None:
    setup, bank, x, P = _moving()
    H, out, told = np.zeros((3, SIZE)), np.empty(SIZE), np.zeros((1, TOLD))
    camera_terms(setup.view, setup.noise, x, P, H, out)
    expect_camera(bank, 0, np.array([[100.0, 50.0, np.nan]]), 0, setup.view, setup.noise, told, 0)
    np.testing.assert_allclose(told[0, :2], np.array([100.0, 50.0]) - out[:2], rtol=1e-12)
    np.testing.assert_allclose(told[0, 3:5], out[2:4], rtol=1e-9)
    _check(bank, P, 0, told, H[0], H_U, SEEN)
    _check(bank, P, 1, told, H[1], H_V, SEEN)
    np.testing.assert_allclose(told[0, 9], H[0] @ P @ H[1], rtol=1e-9)
    np.testing.assert_array_equal(get(bank, 0, 1)[0][0], x)
    assert bank[STATE] == x[0]


def test_imu_samples() -> None:
    setup, bank, x, P = _moving()
    H, out, told = np.zeros((3, SIZE)), np.empty(SIZE), np.zeros((1, TOLD))
    imu_terms(np.array([9.81, 0.002]), setup.noise, x, P, H, out)
    z = np.array([[9.0, 1.0, -2.0]])
    expect_imu(bank, 0, z, 0, np.array([9.81, 0.002]), setup.noise, told, 0)
    np.testing.assert_allclose(told[0, :3], z[0] - out[:3], rtol=1e-10)
    np.testing.assert_allclose(told[0, 3:6], out[3:6], rtol=1e-9)
    _check(bank, P, 0, told, H[0], H_X, FELT_X)
    _check(bank, P, 1, told, H[1], H_Y, FELT_Y)
    _check(bank, P, 2, told, H[2], H_Z, TURNED)
    S = H @ P @ H.T
    np.testing.assert_allclose(told[0, 9:12], [S[0, 1], S[0, 2], S[1, 2]], rtol=1e-8)
