"""The accelerometer's fit: derivatives, recovery of a known truth, and whether sigma is what it says."""

from __future__ import annotations

import numpy as np
import pytest
from imu_poses import G, Sensor, in_counts, sphere_poses, tilts
from scipy.optimize import approx_fprime
from scipy.special import stdtrit

from calib.imu.accelerometer import (
    ANGLES,
    _residual_and_jacobian,
    corrected,
    fit_accelerometer,
    misalignment,
)
from calib.imu.rests import Rest

PLAIN = Sensor()


def _truth(sensor: Sensor, d: int = 3) -> np.ndarray:
    angles = sensor.accel_angles[: len(ANGLES[d])]
    return np.concatenate([sensor.accel_bias[:d], sensor.accel_scale[:d], angles])


def _rests(
    up: np.ndarray,
    sensor: Sensor,
    rng: np.random.Generator,
    noise: float = 0.02,
    beyond: float = 0.0,
    counts: np.ndarray | None = None,
) -> list[Rest]:
    """Rests with these directions up (n, d), the mean of `counts` readings each."""
    n, d = up.shape
    p = _truth(sensor, d)
    size = sensor.accel_scale[:d].mean()
    A = misalignment(p[2 * d :], d) / p[d : 2 * d]
    force = (G + beyond * rng.normal(size=n))[:, None] * up
    counts = np.full(n, 300) if counts is None else counts
    x = force @ np.linalg.inv(A).T + p[:d]
    x += size * noise * rng.normal(size=x.shape) / np.sqrt(counts)[:, None]
    scatter = np.full(d, (size * noise) ** 2)
    return [
        Rest(0, 0, int(m), 0.0, 0.01 * m, row, scatter) for row, m in zip(x, counts.tolist(), strict=True)
    ]


def _ups(count: int) -> np.ndarray:
    return np.stack([pose.inv().apply([0.0, 0.0, 1.0]) for pose in sphere_poses(count)])


def _circle(count: int) -> np.ndarray:
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return np.stack([pose.inv().apply([0.0, 0.0, 1.0]) for pose in tilts(angles)])[:, :2]


@pytest.mark.parametrize("d", [2, 3])
def test_derivatives_agree_with_differences(d: int) -> None:
    rng = np.random.default_rng(d)
    p = _truth(PLAIN, d)
    x = G * rng.normal(size=(7, d))
    _, J = _residual_and_jacobian(p, x, G)
    for row in range(7):
        found = approx_fprime(
            p, lambda q, row=row: float(_residual_and_jacobian(q, x[row : row + 1], G)[0][0]), 1e-7
        )
        assert J[row] == pytest.approx(found, abs=2e-5)


def test_the_misalignment_is_that_of_the_paper() -> None:
    T = misalignment(np.array([0.1, 0.2, 0.3]), 3)
    assert T.tolist() == [[1.0, -0.1, 0.2], [0.0, 1.0, -0.3], [0.0, 0.0, 1.0]]
    assert misalignment(np.array([0.1]), 2).tolist() == [[1.0, -0.1], [0.0, 1.0]]


@pytest.mark.parametrize("sensor", [PLAIN, in_counts(PLAIN)])
@pytest.mark.parametrize("d", [2, 3])
def test_a_known_truth_is_recovered_without_noise(sensor: Sensor, d: int) -> None:
    up = _ups(20) if d == 3 else _circle(8)
    rests = _rests(up, sensor, np.random.default_rng(0), noise=1e-9)
    fit = fit_accelerometer(rests, G, sensor is PLAIN)
    truth = _truth(sensor, d)
    assert fit.skewed
    assert np.abs((fit.parameters - truth) / np.maximum(np.abs(truth), 1e-2)).max() < 1e-6
    assert fit.directions == pytest.approx(up, abs=1e-7)
    means = np.stack([rest.mean for rest in rests])
    assert np.linalg.norm(corrected(fit.parameters, means), axis=1) == pytest.approx(G, rel=1e-8)


def test_axes_up_and_down_alone_do_not_tell_the_misalignment() -> None:
    up = np.concatenate([np.eye(3), -np.eye(3)])
    fit = fit_accelerometer(_rests(up, PLAIN, np.random.default_rng(0)), G, True)
    assert not fit.skewed
    assert fit.dof == 0
    assert np.isinf(fit.sigma[6:]).all()
    assert np.isfinite(fit.sigma[:6]).all()


def test_poses_on_one_side_leave_bias_and_scale_apart_unknown() -> None:
    up = _ups(60)
    fit = fit_accelerometer(_rests(up[up[:, 2] > 0.75], PLAIN, np.random.default_rng(0)), G, True)
    assert fit.span < 0.02
    assert np.abs(fit.weakest[[2, 5]]).min() > 0.3


def test_disagreement_beyond_noise_is_measured() -> None:
    up = np.concatenate([_ups(150), _circle(50) @ np.eye(2, 3)])
    fit = fit_accelerometer(_rests(up, PLAIN, np.random.default_rng(4), beyond=0.01), G, True)
    assert fit.tau_mps2 == pytest.approx(0.01, rel=0.2)
    assert fit_accelerometer(_rests(up, PLAIN, np.random.default_rng(4)), G, True).tau_mps2 < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("d", "beyond"), [(3, 0.0), (3, 0.004), (2, 0.0)])
def test_reported_deviations_are_those_of_many_repetitions(d: int, beyond: float) -> None:
    up = _ups(30) if d == 3 else _circle(16)
    rng = np.random.default_rng(11)
    lengths = rng.integers(100, 1000, len(up))
    truth = _truth(PLAIN, d)
    errors, sigmas = [], []
    for _ in range(250):
        fit = fit_accelerometer(_rests(up, PLAIN, rng, beyond=beyond, counts=lengths), G, True)
        errors.append(fit.parameters - truth)
        sigmas.append(fit.sigma)
    error, sigma = np.array(errors), np.array(sigmas)
    reported = np.sqrt((sigma**2).mean(axis=0))
    assert error.std(axis=0) / reported == pytest.approx(np.ones(len(truth)), abs=0.15)
    assert np.abs(error.mean(axis=0)).max() < 4.0 * (reported / np.sqrt(250)).max()
    inside = np.abs(error) < stdtrit(len(up) - len(truth), 0.975) * sigma
    assert inside.mean() == pytest.approx(0.95, abs=0.02)
