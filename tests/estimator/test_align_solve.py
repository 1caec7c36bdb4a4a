"""The batch fit: a known truth from exact readings, and its covariance against a dense one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arrays import FloatArray
from calib.estimator.align_problem import Noise, Problem, Stretch, pictures_off, readings_off
from calib.estimator.align_solve import response, solve
from calib.estimator.align_spline import Knots, camera_rows, imu_rows
from calib.estimator.sensors import sensor_values, view_coefficients
from calib.twin.rig import nominal_view

VIEW = nominal_view()
NUMBERS = view_coefficients(VIEW.camera, VIEW.R_CW, VIEW.t_CW_m)
TRUTH = sensor_values(
    {
        "gyro_bias_radps": 0.01,
        "accel_bias_x_mps2": 0.05,
        "accel_bias_y_mps2": -0.04,
        "mount_angle_rad": 0.03,
        "gyro_scale": 0.006,
        "imu_lever_m": 0.006,
        "marker_offset_m": 0.0155,
        "time_offset_s": 0.031,
    }
)
MEAN = sensor_values({"marker_offset_m": 0.015, "time_offset_s": 0.025})
SIGMA = np.array([0.1, 0.3, 0.3, 0.5, 0.02, 0.02, 0.003, 0.05, 5e-5, 5e-5, 1e-3, 0.01, 0.01])
NOISE = Noise(0.3, 0.003, np.array([0.015, 0.015, 0.0025]))


def _problem(
    noisy: bool, seed: int = 0, span_s: float = 0.05, duration_s: float = 4.0
) -> tuple[Problem, FloatArray]:
    """A motion that lies in the spline's space, its exact or noisy readings, and its coefficients."""
    rng = np.random.default_rng(seed)
    knots = Knots.over(-0.06, duration_s + 0.06, span_s)
    at = knots.start_s + span_s * (np.arange(knots.count) - 2.0)
    phi = 0.5 * np.sin(2.0 * np.pi * 1.3 * at) + 0.2 * np.sin(0.9 * at)
    c = np.stack([phi, 0.078 + 0.008 * np.sin(1.7 * at)], axis=1)
    camera_s = np.arange(4, int(60 * duration_s)) / 60.0
    imu_s = np.arange(int(100 * duration_s)) / 100.0
    pixels = camera_rows(NUMBERS, knots, c, TRUTH, camera_s).predicted
    readings = imu_rows(9.81, 0.0, knots, c, TRUTH, imu_s).predicted
    if noisy:
        pixels = pixels + 0.3 * rng.standard_normal(pixels.shape)
        readings = readings + NOISE.imu * rng.standard_normal(readings.shape)
    begin = c + np.array([0.02, 0.001]) * rng.standard_normal(c.shape)
    loose = np.full((knots.count - 5, 2), 1e3)
    stretch = Stretch(0, camera_s, pixels, imu_s, readings, knots, begin, loose)
    return Problem(NUMBERS, 9.81, 0.0, 0.0, 1256.0, (stretch,), MEAN, SIGMA), c


def test_exact_readings_give_the_truth_back() -> None:
    problem, c = _problem(noisy=False)
    loose = replace(problem, sigma=1e3 * SIGMA)
    fit = solve(loose, MEAN, NOISE)
    stretch = loose.stretches[0]
    assert np.abs(pictures_off(loose, stretch, fit.coefficients[0], fit.sensor)).max() < 1e-3
    assert np.abs(readings_off(loose, stretch, fit.coefficients[0], fit.sensor)).max() < 1e-3
    # What the motion shows well is exact; scale, d and stretch together have a direction of their own.
    assert fit.sensor[7] == pytest.approx(TRUTH[7], abs=2e-6)
    assert fit.sensor[0] == pytest.approx(TRUTH[0], abs=2e-6)
    assert c.shape == fit.coefficients[0].shape


@pytest.mark.slow
def test_covariance_is_that_of_repeated_fits() -> None:
    found, sigmas, noises = [], [], []
    for seed in range(40):
        problem, _ = _problem(noisy=True, seed=seed)
        # The truth is drawn about the prior's mean, as the covariance takes it.
        shift = np.random.default_rng(1000 + seed).standard_normal(13)
        mean = TRUTH + SIGMA * np.where(np.arange(13) >= 8, shift, 0.0)
        fit = solve(replace(problem, mean=mean), mean, NOISE)
        assert fit.converged
        found.append(fit.sensor - TRUTH)
        sigmas.append(np.sqrt(np.diag(fit.covariance)))
        noises.append([fit.noise.jitter_px, *fit.noise.imu])
    z = np.array(found) / np.array(sigmas)
    rms = np.sqrt((z**2).mean(axis=0))
    # 40 draws leave 11 %; four of that.
    assert (rms < 1.45).all(), rms
    assert (rms > 0.55).all(), rms
    assert np.mean(noises, axis=0) == pytest.approx([0.3, 0.015, 0.015, 0.0025], rel=0.03)


def test_the_covariance_is_the_inverse_of_the_whole_matrix() -> None:
    problem, _ = _problem(noisy=True, span_s=0.1, duration_s=1.5)
    fit = solve(problem, MEAN, NOISE)
    stretch, c = problem.stretches[0], fit.coefficients[0]
    at = np.concatenate([c.ravel(), fit.sensor])

    def off(values: FloatArray) -> FloatArray:
        moved, sensor = values[: c.size].reshape(c.shape), values[c.size :]
        seen = pictures_off(problem, stretch, moved, sensor) / fit.noise.jitter_px
        felt = readings_off(problem, stretch, moved, sensor) / fit.noise.imu
        anchor = (moved - stretch.start) / np.array([3.0, 0.1])
        return np.concatenate([seen.ravel(), felt.ravel(), anchor.ravel(), (sensor - MEAN) / SIGMA])

    steps = np.concatenate([np.full(c.size, 1e-6), 1e-4 * SIGMA])
    columns = []
    for k, step in enumerate(steps):
        ahead, back = at.copy(), at.copy()
        ahead[k] += step
        back[k] -= step
        columns.append((off(ahead) - off(back)) / (2.0 * step))
    J = np.stack(columns, axis=1)
    dense = np.linalg.inv(J.T @ J)[c.size :, c.size :]
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx(np.sqrt(np.diag(dense)), rel=0.03)


def test_the_response_is_that_of_changed_readings() -> None:
    problem, _ = _problem(noisy=True)
    fit = solve(problem, MEAN, NOISE)
    stretch = problem.stretches[0]
    change = np.zeros_like(stretch.readings)
    change[:, 2] = 1e-4
    predicted = response(problem, fit, [np.zeros_like(stretch.pixels)], [change])
    moved = replace(stretch, readings=stretch.readings - change, start=fit.coefficients[0])
    again = solve(replace(problem, stretches=(moved,)), fit.sensor, fit.noise)
    assert predicted[0] == pytest.approx(-1e-4, rel=0.02)
    assert again.sensor[0] - fit.sensor[0] == pytest.approx(predicted[0], rel=0.05)
