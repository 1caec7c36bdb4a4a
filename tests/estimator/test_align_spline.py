"""The quintic spline: identities, derivatives, and the sums over its rows against dense algebra."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.estimator.align_spline import (
    BAND,
    Knots,
    basis_rows,
    camera_rows,
    gathered,
    imu_rows,
    normal_sums,
    states_of,
)
from calib.estimator.sensors import SIZE, view_coefficients
from calib.twin.rig import nominal_view

KNOTS = Knots.over(1.0, 3.0, 0.05)


# The first example compiles.
@settings(deadline=None)
@given(st.lists(st.floats(0.5, 3.5), min_size=1, max_size=20))
def test_bases_sum_to_one_and_their_derivatives_to_zero(times: list[float]) -> None:
    t = np.array(times)
    _, basis = basis_rows(KNOTS, t)
    scale = 1.0 + np.abs(basis).max(axis=2)
    assert np.abs(basis[:, 0].sum(axis=1) - 1.0).max() < 1e-10 * scale[:, 0].max()
    assert np.abs(basis[:, 1].sum(axis=1)).max() < 1e-10 * scale[:, 1].max()
    assert np.abs(basis[:, 2].sum(axis=1)).max() < 1e-10 * scale[:, 2].max()


def test_a_swing_of_four_hertz_is_met_with_its_acceleration() -> None:
    knots = Knots.over(0.0, 1.0, 0.02)
    omega = 2.0 * np.pi * 4.0
    t = np.linspace(0.0, 1.0, 501)
    span, basis = basis_rows(knots, t)
    A = np.zeros((len(t), knots.count))
    for n in range(len(t)):
        A[n, span[n] : span[n] + 6] = basis[n, 0]
    c = np.linalg.lstsq(A, 0.5 * np.sin(omega * t), rcond=None)[0]
    states = states_of(span, basis, np.stack([c, c], axis=1), np.zeros(13))
    bend = -0.5 * omega**2 * np.sin(omega * t)
    inside = slice(50, -50)
    assert np.abs(states[inside, 4] - bend[inside]).max() < 1e-3 * 0.5 * omega**2
    assert np.array_equal(states[:, 4], states[:, 5])


def test_gradients_by_coefficients_and_sensors_against_differences() -> None:
    rng = np.random.default_rng(0)
    view = nominal_view()
    numbers = view_coefficients(view.camera, view.R_CW, view.t_CW_m)
    knots = Knots.over(0.0, 0.4, 0.05)
    c = np.stack([rng.normal(0.0, 0.3, knots.count), rng.normal(0.075, 0.005, knots.count)], axis=1)
    sensor = np.array([0.01, 0.05, -0.03, 0.1, 0.01, 0.006, 0.015, 0.03, 1e-4, -1e-4, 1e-3, 0.002, 0.003])
    t = rng.uniform(0.05, 0.35, 7)

    def predicted(values: np.ndarray) -> np.ndarray:
        coefficients, s = values[: c.size].reshape(c.shape), values[c.size :]
        seen = camera_rows(numbers, knots, coefficients, s, t).predicted
        felt = imu_rows(9.81, 0.001, knots, coefficients, s, t).predicted
        return np.concatenate([seen.ravel(), felt.ravel()])

    at = np.concatenate([c.ravel(), sensor])
    weights = rng.standard_normal(len(predicted(at)))
    to_c, to_s = np.zeros(c.size), np.zeros(13)
    rows = camera_rows(numbers, knots, c, sensor, t)
    gathered(rows.span, rows.basis, rows.by, weights[:14].reshape(7, 2), to_c, to_s)
    rows = imu_rows(9.81, 0.001, knots, c, sensor, t)
    gathered(rows.span, rows.basis, rows.by, weights[14:].reshape(7, 3), to_c, to_s)
    found = np.concatenate([to_c, to_s])
    for k in range(len(at)):
        step = 1e-6 if k < c.size else 1e-6 * max(abs(at[k]), 1e-2)
        ahead, back = at.copy(), at.copy()
        ahead[k] += step
        back[k] -= step
        slope = weights @ (predicted(ahead) - predicted(back)) / (2.0 * step)
        assert abs(slope - found[k]) < 1e-5 * (1.0 + abs(slope)), k


def test_sums_are_those_of_the_dense_matrices() -> None:
    rng = np.random.default_rng(1)
    knots = Knots.over(0.0, 0.5, 0.05)
    t = rng.uniform(0.0, 0.5, 40)
    span, basis = basis_rows(knots, t)
    by, weight = rng.standard_normal((40, 2, SIZE)), rng.uniform(0.0, 2.0, (40, 2))
    n = 2 * knots.count
    A, B, C = np.zeros((BAND, n)), np.zeros((n, 13)), np.zeros((13, 13))
    normal_sums(span, basis, by, weight, A, B, C)
    J = np.zeros((80, n + 13))
    for i in range(40):
        for channel in range(2):
            row = J[2 * i + channel]
            for d in range(3):
                row[2 * span[i] : 2 * span[i] + 12 : 2] += by[i, channel, 2 * d] * basis[i, d]
                row[2 * span[i] + 1 : 2 * span[i] + 12 : 2] += by[i, channel, 2 * d + 1] * basis[i, d]
            row[n:] = by[i, channel, 6:]
    N = J.T @ (weight.reshape(-1, 1) * J)
    scale = np.abs(N).max()
    for k in range(BAND):
        assert np.abs(A[k, : n - k] - np.diagonal(N[:n, :n], -k)).max() < 1e-12 * scale
    assert np.abs(B - N[:n, n:]).max() < 1e-12 * scale
    assert np.abs(C - N[n:, n:]).max() < 1e-12 * scale
    assert np.abs(np.tril(N[:n, :n], -BAND)).max() == 0.0
