"""Turns miss nothing where all is known, and their misses spread as their covariance says."""

from __future__ import annotations

import numpy as np
import pytest
from imu_poses import G, PoseLog, Sensor, motion, sphere_poses, tilts

from calib.imu.accelerometer import Accelerometer
from calib.imu.intrinsics import find_intrinsics
from calib.imu.rests import Rest
from calib.imu.turns import Turns, misfit, misfit_covariance, tangents

REST_S, TURN_S, FIRST_S, RATE_HZ = 3.0, 2.0, 20.0, 100.0


def _ideal() -> Sensor:
    return Sensor(np.zeros(3), np.ones(3), np.zeros(3), np.zeros(3), np.ones(3), np.zeros(6))


def _accelerometer(d: int, covariance: np.ndarray, sigma_rad: np.ndarray, up: np.ndarray) -> Accelerometer:
    k = {2: 1, 3: 3}[d]
    n = len(up)
    return Accelerometer(
        np.zeros(d), np.ones(d), np.zeros(k), np.sqrt(np.diag(covariance)), covariance, up, sigma_rad,
        np.zeros(n), np.ones(n), 0.0, 0.0, n - 2 * d - k, 0.25, np.zeros(2 * d + k), True,
    )  # fmt: skip


def _turns(poses: list, d: int, rng: np.random.Generator | None, noise: tuple[float, float]) -> Turns:
    """Turns of an ideal sensor with noise, between rests whose limits are known."""
    _, w, f = motion(poses, RATE_HZ, REST_S, TURN_S, FIRST_S)
    if d == 2:
        w = w * [0.0, 0.0, 1.0]
    gyro, accel = w.copy(), f[:, :d].copy()
    if rng is not None:
        accel += noise[0] * rng.normal(size=accel.shape)
        gyro += noise[1] * rng.normal(size=gyro.shape) * (np.array([0, 0, 1]) if d == 2 else 1)
    rests, at = [], 0
    for i in range(len(poses)):
        stop = at + round((FIRST_S if i == 0 else REST_S) * RATE_HZ)
        rests.append(
            Rest(
                0,
                at,
                stop,
                at / RATE_HZ,
                stop / RATE_HZ,
                accel[at:stop].mean(axis=0),
                np.full(d, noise[0] ** 2),
            )
        )
        at = stop + round(TURN_S * RATE_HZ)
    k = np.arange(len(rests) - 1)
    scatter = np.tile([0.0, 0.0, noise[1] ** 2] if d == 2 else [noise[1] ** 2] * 3, (len(rests), 1))
    return Turns(
        gyro,
        accel,
        np.array([rest.stop - 1 for rest in rests[:-1]]),
        np.array([rest.start for rest in rests[1:]]),
        k,
        k + 1,
        rests,
        np.stack([gyro[rest.start : rest.stop].mean(axis=0) for rest in rests]),
        scatter,
        0,
        1.0 / RATE_HZ,
    )


@pytest.mark.parametrize("d", [2, 3])
def test_an_ideal_sensor_misses_nothing(d: int) -> None:
    poses = sphere_poses(12) if d == 3 else tilts(np.radians(np.arange(0, 360, 45)))
    turns = _turns(poses, d, None, (0.0, 0.0))
    n = len(poses)
    accel = _accelerometer(d, np.zeros((9, 9)) if d == 3 else np.zeros((5, 5)), np.zeros(n), np.zeros((n, d)))
    across = tangents(turns, accel)
    assert across.shape == (n - 1, d - 1, 3)
    off = misfit(turns, accel.parameters, turns.gyro, np.eye(3), across)
    assert np.abs(off).max() < 1e-4
    wrong = misfit(turns, accel.parameters, turns.gyro, 1.01 * np.eye(3), across)
    assert np.abs(wrong).max() > 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_the_covariance_is_that_of_many_repetitions(d: int) -> None:
    poses = sphere_poses(8) if d == 3 else tilts(np.radians(np.arange(0, 360, 45)))
    noise, bias_error, errors = (0.05, 0.002), 3e-4, []
    rng = np.random.default_rng(0)
    size = 9 if d == 3 else 5
    spread = np.concatenate([np.full(d, 2e-3), np.full(d, 2e-4), np.full(size - 2 * d, 5e-4)])
    clean = _turns(poses, d, None, noise)
    sigma = noise[0] / np.sqrt([rest.samples for rest in clean.rests]) / G
    accel = _accelerometer(d, np.diag(spread**2), sigma, np.zeros((len(poses), d)))
    across = tangents(clean, accel)
    bias_sigma = np.array([0.0, 0.0, bias_error]) if d == 2 else np.full(3, bias_error)
    M = np.diag([0.0, 0.0, 1.0]) if d == 2 else np.eye(3)
    for _ in range(1500):
        turns = _turns(poses, d, rng, noise)
        rates = turns.gyro - bias_sigma * rng.normal(size=3)
        parameters = accel.parameters + spread * rng.normal(size=size)
        errors.append(misfit(turns, parameters, rates, M, across))
    C = misfit_covariance(clean, accel, clean.gyro, M, across, bias_sigma, np.zeros(3))
    found = np.cov(np.array(errors).T)
    deviation = np.sqrt(np.diag(C))
    assert np.sqrt(np.diag(found)) / deviation == pytest.approx(np.ones(len(C)), abs=0.1)
    # Entries of a correlation matrix from so many repetitions are known to 0.026.
    assert np.abs((found - C) / np.outer(deviation, deviation)).max() < 0.13


def test_turns_of_a_log_run_from_rest_to_rest() -> None:
    t, w, f = motion(sphere_poses(10))
    values = _ideal().readings(w, f, np.random.default_rng(0))
    result = find_intrinsics(PoseLog("log", ("gx", "gy", "gz", "ax", "ay", "az"), t, values), G)
    assert result.gyro is not None
    assert len(result.gyro.turns_s) == 9
    # The window that finds the rests sees a turn up to half a second before and after it.
    assert np.all((result.gyro.turns_s > 1.5) & (result.gyro.turns_s < 3.1))
