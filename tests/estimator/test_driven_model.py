"""The driven process: the simulation's motion, and a Jacobian against central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.actuator.dynamics import coefficients
from calib.actuator.kernel import derivative, run
from calib.actuator.parameters import pumps_connected
from calib.actuator.pump import Orifice, Pump, RateLimit, pump_coefficients
from calib.arrays import FloatArray
from calib.estimator.driven_model import (
    DRIVEN,
    DYNAMIC,
    INVOLVED,
    PARAMETER,
    accelerations,
    carry,
    flow,
    jacobian,
)
from calib.estimator.driven_setup import Drive

PUMPS = (Pump(), Pump(deflation=Orifice()))


def some_state(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    x = np.zeros(len(DRIVEN))
    x[0], x[1] = rng.uniform(-0.7, 0.7), rng.uniform(0.063, 0.09)
    x[2], x[3] = rng.normal(0.0, 2.0), rng.normal(0.0, 0.03)
    x[4:6] = rng.normal(0.0, 0.05, 2)
    # One bellows fills, the other empties: away from the corner between the two laws.
    x[6:10] = 0.5, 0.3, 0.5, 0.9
    x[10:12] = rng.normal(0.0, 0.02, 2)
    x[DYNAMIC:INVOLVED] = rng.normal(0.0, 0.05, len(PARAMETER))
    x[19] = 3e-4
    return x


def stepped(plant: FloatArray, x: FloatArray, segments: FloatArray) -> FloatArray:
    out = np.empty(DYNAMIC)
    flow(plant, x, segments, len(segments), out)
    return out


@pytest.mark.parametrize("pump", PUMPS)
def test_it_moves_as_the_simulation_does(pump: Pump) -> None:
    body = pumps_connected()
    x = some_state(1)
    x[10:INVOLVED] = 0.0
    r = body.bellows_radius_m
    l, phi, dl, dphi = x[1], x[0], x[3], x[2]  # noqa: E741  the source's symbols
    lengths = [l + r * phi, l - r * phi, dl + r * dphi, dl - r * dphi]
    row = np.array([*lengths, 0.5 * (x[4] + x[5]), 0.5 * (x[4] - x[5]), *x[6:10]])
    static = np.array([[1.5, 0.2], [1.0, 0.0]])
    exact = np.empty((2, 10))
    assert run(coefficients(body), pump_coefficients(pump), row, static, 0.01, 40, 40, exact) == -1
    got = stepped(Drive(pump=pump).numbers(), x, np.array([[0.01, 1.5, 0.2], [0.01, 1.0, 0.0]]))
    q1, q2, dq1, dq2, z1, z2 = exact[1, :6]
    turned, spun = (q1 - q2) / (2.0 * r), (dq1 - dq2) / (2.0 * r)
    there = np.array([turned, 0.5 * (q1 + q2), spun, 0.5 * (dq1 + dq2), z1 + z2, z1 - z2])
    # A start far from any balance; steps of 3 ms follow it to a thousandth of the way.
    np.testing.assert_array_less(np.abs(got[:6] - there), 1e-3 * np.abs(there - x[:6]))
    np.testing.assert_allclose(got[6:10], exact[1, 6:10], atol=2e-5)


@pytest.mark.parametrize("pump", PUMPS)
@pytest.mark.parametrize("seed", range(4))
def test_the_jacobian_agrees_with_central_differences(pump: Pump, seed: int) -> None:
    plant, x = Drive(pump=pump).numbers(), some_state(seed)
    segments = np.array([[0.004, 1.5, 0.2], [0.003, 1.2, 0.1]])
    out, F = np.empty(2 * DYNAMIC), np.empty((DYNAMIC, INVOLVED))
    jacobian(plant, x, segments, 2, out, F)
    np.testing.assert_array_equal(out[:DYNAMIC], stepped(plant, x, segments))
    central = np.empty_like(F)
    for k in range(INVOLVED):
        h = 1e-4 if k != 1 and k != 19 else 1e-6
        above, below = x.copy(), x.copy()
        above[k] += h
        below[k] -= h
        central[:, k] = (stepped(plant, above, segments) - stepped(plant, below, segments)) / (2.0 * h)
    size = np.abs(central).max(axis=1, keepdims=True)
    assert np.all(np.abs(F - central) <= 2e-4 * size + 1e-9)


def test_accelerations_are_those_of_the_dynamics_with_their_gradients() -> None:
    body, drive = pumps_connected(), Drive()
    x = some_state(3)
    x[DYNAMIC:INVOLVED] = 0.0
    r = body.bellows_radius_m
    y = np.array(
        [x[1] + r * x[0], x[1] - r * x[0], x[3] + r * x[2], x[3] - r * x[2], 0.0, 0.0],
    )
    y[4], y[5] = 0.5 * (x[4] + x[5]), 0.5 * (x[4] - x[5])
    rate = derivative(coefficients(body), y, x[8] + x[10], x[9] + x[11])
    by_phi, by_length = np.empty(INVOLVED), np.empty(INVOLVED)
    ddphi, ddl = accelerations(drive.numbers(), x, by_phi, by_length)
    assert ddphi == pytest.approx((rate[2] - rate[3]) / (2.0 * r), rel=1e-9)
    assert ddl == pytest.approx(0.5 * (rate[2] + rate[3]), rel=1e-9)
    spare = np.empty(INVOLVED)
    for k in range(INVOLVED):
        h = 1e-5 if k != 1 and k != 19 else 1e-7
        above, below = x.copy(), x.copy()
        above[k] += h
        below[k] -= h
        up, down = (accelerations(drive.numbers(), v, spare, spare.copy()) for v in (above, below))
        assert by_phi[k] == pytest.approx((up[0] - down[0]) / (2.0 * h), rel=2e-3, abs=1e-3)
        assert by_length[k] == pytest.approx((up[1] - down[1]) / (2.0 * h), rel=2e-3, abs=1e-3)


def test_the_covariance_is_carried_as_by_the_whole_matrix() -> None:
    rng = np.random.default_rng(5)
    n = len(DRIVEN)
    A = rng.standard_normal((n, n))
    P = A @ A.T
    F = rng.standard_normal((DYNAMIC, INVOLVED))
    F[:, 10:12] = 0.0
    noise = rng.uniform(0.1, 1.0, n)
    whole = np.eye(n)
    whole[:DYNAMIC, :DYNAMIC] = 0.0
    whole[:DYNAMIC, :INVOLVED] = F
    expected = whole @ P @ whole.T + 0.01 * np.diag(noise)
    carry(P, F, noise, 0.01, np.empty((DYNAMIC, n)))
    np.testing.assert_allclose(P, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(P, P.T)


def test_a_stronger_pump_and_a_faster_orifice_do_what_they_say() -> None:
    drive = Drive(pump=replace(Pump(), deflation=RateLimit(0.4)))
    x = some_state(2)
    x[DYNAMIC:INVOLVED] = 0.0
    fill, empty = np.array([[0.02, 1.5, 1.5]]), np.array([[0.02, 0.0, 0.0]])
    x[6:10] = 0.5
    base = stepped(drive.numbers(), x, fill)
    x[15] = 0.1
    assert stepped(drive.numbers(), x, fill)[8] > base[8]
    x[15], x[6:8] = 0.0, 0.0
    slow = stepped(drive.numbers(), x, empty)
    assert slow[8] == pytest.approx(0.5 - 0.4 * 0.02)
    x[18] = 0.5
    assert stepped(drive.numbers(), x, empty)[8] == pytest.approx(0.5 - 0.6 * 0.02)
