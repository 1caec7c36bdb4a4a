"""Columns of the output from a bank and from single states."""

from __future__ import annotations

import numpy as np

from calib.estimator.bank import new_bank, put
from calib.estimator.clock import new_clock
from calib.estimator.columns import begin_row, write_bank, write_columns
from calib.estimator.model import Kinematic
from calib.estimator.sensors import SIZE
from calib.estimator.setup import OUT


def test_a_bank_gives_the_moments_of_its_mixture() -> None:
    rng = np.random.default_rng(3)
    x = 0.1 * rng.standard_normal((3, SIZE)) + np.eye(SIZE)[1]
    A = rng.standard_normal((3, SIZE, SIZE))
    P, w, r = A @ A.transpose(0, 2, 1) / SIZE, np.array([0.5, 0.3, 0.2]), 0.01
    bank, weights, out = new_bank(2, 3), np.zeros((2, 4)), np.zeros((1, len(OUT)))
    put(bank, 1, x, P)
    weights[1, :3] = w
    write_bank(bank, weights, 1, 0.0, Kinematic().arrays()[0][None, :3], r, out, 0)
    mean = w @ x
    V = np.einsum("m,mij->ij", w, P) + np.einsum("m,mi,mj->ij", w, x - mean, x - mean)
    np.testing.assert_allclose(out[0, 1:3], [mean[1] + r * mean[0], mean[1] - r * mean[0]])
    np.testing.assert_allclose(out[0, 9], mean[6])
    g = np.array([[r, 1.0], [-r, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(out[0, 10:13] ** 2, np.diag(g @ V[:2, :2] @ g.T))
    again = np.zeros((2, len(OUT)))
    write_columns(mean[None], V[None], np.array([1]), r, again)
    np.testing.assert_allclose(again[1, 1:13], out[0, 1:13])
    assert not again[0].any()


def test_a_row_begins_blank_and_a_jump_of_time_starts_the_clocks_again() -> None:
    out = np.ones((2, 5))
    for step, jumps in ((0.01, False), (-0.05, False), (1.9, False), (-0.2, True), (3600.0, True)):
        camera, imu = new_clock(0.016), new_clock(0.01)
        camera[0] = imu[0] = 1.0
        assert begin_row(7.0 + step, 7.0, camera, imu, out, 1) is jumps
        assert out[1, 0] == 7.0 + step
        assert np.isnan(out[1, 1:]).all()
        assert camera[0] == imu[0] == (0.0 if jumps else 1.0)
    assert not begin_row(7.0, np.nan, new_clock(0.016), new_clock(0.01), out, 0)
