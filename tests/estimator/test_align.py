"""Alignments of simulated rigs: errors against sigma, what cannot be told apart, and bad logs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from align_trials import MOTIONS, Trial, align_log, draw, known, prior_settings, scores, twin_log

from calib.errors import BadInputError
from calib.estimator.align import Alignment, align, rest_angle
from calib.estimator.sensors import SENSOR
from calib.twin.rig import SimulatedRig

OFFSET, MOUNT, BIAS = (
    SENSOR.index(name) for name in ("time_offset_s", "mount_angle_rad", "accel_bias_y_mps2")
)


def _found(trial: Trial, motions: tuple[tuple[str, dict[str, str]], ...], seed: int) -> Alignment:
    logs = [
        align_log(twin_log(trial.rig, name, options, 10 * seed + k))
        for k, (name, options) in enumerate(motions)
    ]
    return align(logs, prior_settings(trial.view))


def test_swing_and_ellipse_align_a_rig() -> None:
    trial = known(SimulatedRig())
    found = _found(trial, MOTIONS[:2], 1)
    assert found.converged
    assert found.moves
    assert abs(found.sensor[OFFSET] - 0.025) < 1e-3
    assert abs(found.sensor[MOUNT] - 0.02) < math.radians(0.1)
    assert np.abs(scores(trial, found)).max() < 4.0
    assert found.sigma[OFFSET] < 5e-4
    for trace in found.traces:
        after, before = trace.imu_after[:, 1], trace.imu_before[:, 1]
        assert np.nanstd(after) < 0.03
        assert abs(np.nanmean(before)) > 5.0 * abs(np.nanmean(after))


def test_at_rest_only_the_sum_is_known() -> None:
    trial = known(SimulatedRig())
    log = align_log(twin_log(trial.rig, "static", {}, 5, 15.0))
    found = align([log], prior_settings(trial.view))
    R = found.covariance / found.sigma / found.sigma[:, None]
    assert not found.moves
    assert found.sigma[OFFSET] > 0.04
    assert R[MOUNT, BIAS] < -0.999
    assert found.sigma[MOUNT] > math.radians(1.0)
    assert found.rest_angle_sigma < math.radians(0.1)
    assert np.abs(scores(trial, found)).max() < 4.0


def test_outliers_dropouts_and_a_blackout_do_little() -> None:
    nominal = SimulatedRig()
    tracker = replace(nominal.tracker, outliers=0.03, dropouts=0.05, blackouts_s=((1.0, 0.4),))
    trial = known(replace(nominal, tracker=tracker))
    found = _found(trial, MOTIONS[:2], 2)
    assert np.abs(scores(trial, found)).max() < 4.0
    assert found.noise.share == pytest.approx(0.03, abs=0.015)
    assert sum(log.outliers for log in found.logs) > 10


def test_the_angle_at_rest_and_its_gradient() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        sensor = rng.normal(0.0, 1.0, len(SENSOR)) * 0.05
        angle, gradient = rest_angle(sensor)
        for k in range(len(SENSOR)):
            ahead, back = sensor.copy(), sensor.copy()
            ahead[k] += 1e-6
            back[k] -= 1e-6
            slope = (rest_angle(ahead)[0] - rest_angle(back)[0]) / 2e-6
            assert gradient[k] == pytest.approx(slope, abs=1e-7)
        assert abs(angle) < 0.5


def test_a_moment_is_not_enough() -> None:
    trial = known(SimulatedRig())
    log = align_log(twin_log(trial.rig, "swing", {}, 3, 0.5))
    with pytest.raises(BadInputError, match="has no stretch of 1 s"):
        align([log], prior_settings(trial.view))


@pytest.mark.slow
def test_sigma_tells_the_errors_of_rigs_that_differ() -> None:
    """Latency 10 - 40 ms, mount, lever, scales, biases, noise and plane drawn anew for each rig."""
    z, offset, mount = [], [], []
    for seed in range(16):
        trial = draw(seed)
        found = _found(trial, MOTIONS, seed)
        assert found.converged
        z.append(scores(trial, found))
        error = found.sensor - trial.truth
        offset.append(error[OFFSET])
        mount.append(error[MOUNT])
    inside = (np.abs(np.array(z)) < 1.96).mean()
    assert 0.90 <= inside <= 1.0
    # A single quantity may be outside in three of 16; more has the probability 0.01.
    assert ((np.abs(np.array(z)) < 1.96).sum(axis=0) >= 13).all()
    assert np.abs(offset).max() < 1e-3
    assert np.sqrt(np.mean(np.square(mount))) < math.radians(0.1)
