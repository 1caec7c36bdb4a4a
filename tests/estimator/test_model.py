"""The process: its transition against the matrix exponential, its noise, and the bank."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from calib.arrays import FloatArray
from calib.estimator.model import (
    LARGEST_STEP_S,
    Kinematic,
    axis_noise,
    axis_transition,
    mix,
    predict,
    settle_weights,
)
from calib.estimator.sensors import SIZE

C, B = 12.0, 0.5


def covariance(seed: int) -> FloatArray:
    A = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    return np.asarray(A @ A.T / SIZE)


def test_transition_is_the_exponential() -> None:
    A = np.array([[0.0, 1.0, 0.0], [0.0, -B, 1.0], [0.0, 0.0, -C]])
    for h in (1e-4, 2e-3, 0.01):
        f01, f02, f11, f12, f22 = axis_transition(C, B, h)
        F = np.array([[1.0, f01, f02], [0.0, f11, f12], [0.0, 0.0, f22]])
        np.testing.assert_allclose(F, expm(A * h), atol=(C * h) ** 4 / 20.0)


def test_noise_is_that_of_a_white_jerk() -> None:
    q, walk, h, parts = 3.0, 0.2, 0.01, 4000
    F = expm(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]) * h / parts)
    P = np.zeros((3, 3))
    for _ in range(parts):
        P = F @ P @ F.T + np.diag([walk, 0.0, q]) * h / parts
    pp, pv, pa, vv, va, aa = axis_noise(q, walk, h)
    np.testing.assert_allclose([[pp, pv, pa], [pv, vv, va], [pa, va, aa]], P, rtol=2e-3)


def test_prediction_is_that_of_its_matrices_and_symmetric() -> None:
    levels, walk = Kinematic().arrays()
    x, P = np.random.default_rng(1).standard_normal(SIZE), covariance(2)
    before_x, before_P = x.copy(), P.copy()
    h = 0.008
    predict(x, P, levels[2], walk, h)
    F = np.eye(SIZE)
    for axis in range(2):
        f01, f02, f11, f12, f22 = axis_transition(levels[2, 4 * axis], levels[2, 4 * axis + 1], h)
        rows = [axis, axis + 2, axis + 4]
        F[np.ix_(rows, rows)] = [[1.0, f01, f02], [0.0, f11, f12], [0.0, 0.0, f22]]
    np.testing.assert_allclose(x, F @ before_x, rtol=1e-12, atol=1e-14)
    moved = P - F @ before_P @ F.T
    assert np.linalg.eigvalsh(moved)[0] > -1e-10
    np.testing.assert_array_equal(P, P.T)


def test_long_steps_are_taken_in_parts() -> None:
    levels, walk = Kinematic().arrays()
    x, P = np.ones(SIZE), covariance(3)
    again_x, again_P = x.copy(), P.copy()
    predict(x, P, levels[1], walk, 5 * LARGEST_STEP_S)
    for _ in range(5):
        predict(again_x, again_P, levels[1], walk, LARGEST_STEP_S)
    np.testing.assert_allclose(x, again_x, rtol=1e-12)
    np.testing.assert_allclose(P, again_P, rtol=1e-9, atol=1e-12)


def test_mixing_keeps_mean_and_covariance_of_the_whole_bank() -> None:
    rng = np.random.default_rng(5)
    x, P = rng.standard_normal((3, SIZE)), np.stack([covariance(k) for k in range(3)])
    w = np.array([0.6, 0.3, 0.1])

    def moments(x: FloatArray, P: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean = w @ x
        d = x - mean
        return mean, np.einsum("m,mij->ij", w, P) + np.einsum("m,mi,mj->ij", w, d, d)

    before = moments(x, P, w)
    mixed_x, mixed_P, mixed_w = np.empty_like(x), np.empty_like(P), np.empty_like(w)
    mix(x, P, w, mixed_x, mixed_P, mixed_w, 0.05)
    after = moments(mixed_x, mixed_P, mixed_w)
    np.testing.assert_allclose(mixed_w, [0.56, 0.305, 0.135])
    mix(x, P, w, mixed_x, mixed_P, mixed_w, 0.0)
    np.testing.assert_array_equal(mixed_P, P)
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)


def test_weights_follow_the_likelihood_and_never_vanish() -> None:
    w = np.array([0.5, 0.25, 0.25])
    total = settle_weights(w, np.log(np.array([1.0, 2.0, 4.0])))
    np.testing.assert_allclose(w, np.array([0.5, 0.5, 1.0]) / 2.0)
    np.testing.assert_allclose(total, np.log(2.0))
    settle_weights(w, np.array([-2000.0, 0.0, -2000.0]))
    assert w.min() >= 0.9e-6
