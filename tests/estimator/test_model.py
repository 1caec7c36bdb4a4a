"""The process: its transition against the matrix exponential, and its noise."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from calib.estimator.model import axis_noise, axis_transition

C, B = 12.0, 0.5


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
