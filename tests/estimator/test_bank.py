"""The memory of the bank: prediction against matrices, mixing, weights."""

from __future__ import annotations

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.bank import RECORD, get, mix, new_bank, predict, put, settle_weights
from calib.estimator.model import LARGEST_STEP_S, Kinematic
from calib.estimator.reference import process_noise
from calib.estimator.sensors import SIZE
from calib.estimator.smoother import transition


def covariance(seed: int) -> FloatArray:
    A = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    return np.asarray(A @ A.T / SIZE)


def bank_of(x: FloatArray, P: FloatArray, slots: int = 1) -> FloatArray:
    bank = new_bank(slots, len(x))
    put(bank, 0, x, P)
    return bank


def test_what_is_put_is_got() -> None:
    x, P = np.random.default_rng(0).standard_normal((2, SIZE)), np.stack([covariance(1), covariance(2)])
    bank = new_bank(3, 2)
    put(bank, 2, x, P)
    got_x, got_P = get(bank, 2, 2)
    np.testing.assert_array_equal(got_x, x)
    np.testing.assert_array_equal(got_P, P)
    assert not get(bank, 1, 2)[1].any()


def test_prediction_is_that_of_its_matrices_and_symmetric() -> None:
    levels, walk = Kinematic().arrays()
    x, P = np.random.default_rng(1).standard_normal((2, SIZE)), np.stack([covariance(2), covariance(3)])
    bank, h = bank_of(x, P), 0.008
    predict(bank, RECORD, levels[None], 0, 1, walk, h)
    got_x, got_P = get(bank, 0, 2)
    np.testing.assert_array_equal(got_P[0], P[0])
    F = np.empty((SIZE, SIZE))
    transition(levels[1], h, F)
    np.testing.assert_allclose(got_x[1], F @ x[1], rtol=1e-12, atol=1e-14)
    expected = F @ P[1] @ F.T + process_noise(levels[1], walk, h)
    np.testing.assert_allclose(got_P[1], expected, rtol=1e-10, atol=1e-13)
    np.testing.assert_array_equal(got_P[1], got_P[1].T)


def test_long_steps_are_taken_in_parts() -> None:
    levels, walk = Kinematic().arrays()
    once = bank_of(np.ones((1, SIZE)), covariance(3)[None])
    again = once.copy()
    predict(once, 0, levels[None], 0, 0, walk, 5 * LARGEST_STEP_S)
    for _ in range(5):
        predict(again, 0, levels[None], 0, 0, walk, LARGEST_STEP_S)
    np.testing.assert_allclose(once, again, rtol=1e-9, atol=1e-12)


def test_mixing_keeps_mean_and_covariance_of_the_whole_bank() -> None:
    rng = np.random.default_rng(5)
    x, P = rng.standard_normal((3, SIZE)), np.stack([covariance(k) for k in range(3)])
    w = np.array([0.6, 0.3, 0.1])

    def moments(x: FloatArray, P: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean = w @ x
        d = x - mean
        return mean, np.einsum("m,mij->ij", w, P) + np.einsum("m,mi,mj->ij", w, d, d)

    before = moments(x, P, w)
    bank, weights = bank_of(x, P, slots=2), np.zeros((2, 4))
    weights[0, :3] = w
    mix(bank, weights, 0, 1, 0.05)
    after = moments(*get(bank, 1, 3), weights[1, :3])
    np.testing.assert_allclose(weights[1, :3], [0.56, 0.305, 0.135])
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)
    mix(bank, weights, 0, 1, 0.0)
    np.testing.assert_array_equal(get(bank, 1, 3)[1], P)


def test_weights_follow_the_likelihood_and_never_vanish() -> None:
    w = np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 0.25, 0.25, 0.0]])
    total = settle_weights(w, 1, np.log(np.array([[9.0, 1.0], [9.0, 2.0], [9.0, 4.0]])), 1)
    np.testing.assert_allclose(w[1, :3], np.array([0.5, 0.5, 1.0]) / 2.0)
    np.testing.assert_allclose(total, np.log(2.0))
    settle_weights(w, 1, np.array([[-2000.0], [0.0], [-2000.0]]), 0)
    assert w[1, :3].min() >= 0.9e-6
