"""One event: scalar updates against matrices, gating, and a covariance that stays one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated

from calib.arrays import FloatArray
from calib.estimator.bank import get, new_bank, put
from calib.estimator.expect import TOLD
from calib.estimator.filter import Filter, starting_state
from calib.estimator.kernel import CAMERA, CONSIDERED, IMU, MIXED_S, REPORT, TRACE, event, mixes
from calib.estimator.model import Kinematic
from calib.estimator.reference import camera_terms, imu_terms
from calib.estimator.sensors import SIZE
from calib.estimator.setup import Rows, Setup


def _one_event(
    kind: int, z: list[float], levels: int = 4, setup: Setup | None = None
) -> tuple[dict[str, float], tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    rig, log = simulated("static")
    process = Kinematic(Kinematic().levels[:levels])
    setup = setup or setup_for(rig, 0, process)
    x, P, w = starting_state(setup, rows_from(log))
    bank, weights = new_bank(2, levels), np.zeros((2, levels + 1))
    put(bank, 0, x, P)
    weights[0, :levels] = w
    level, walk = process.arrays()
    report = np.empty(len(REPORT))
    event(
        bank, weights, 0, 1, kind, np.array([z]), 0, 0.0, 0.3, level[None], 0, walk, setup.view,
        np.array([9.81, 0.0]), setup.noise, np.zeros((levels, TOLD)), False, report, np.zeros((1, 3)),
        np.empty((0, 3, TRACE)),
    )  # fmt: skip
    np.testing.assert_array_equal(get(bank, 0, levels)[0], x)
    after = get(bank, 1, levels)
    np.testing.assert_array_equal(after[1], np.swapaxes(after[1], 1, 2))
    return dict(zip(REPORT, report.tolist(), strict=True)), (x, P), after


@pytest.mark.parametrize("kind", [CAMERA, IMU])
def test_an_event_is_joseph_s_form_reading_by_reading_but_for_what_is_considered(kind: int) -> None:
    rig, log = simulated("static")
    process = Kinematic(Kinematic().levels[:1])
    setup = setup_for(rig, 0, process)
    noise = setup.noise.copy()
    noise[1] = 0.0
    setup = replace(setup, noise=noise)
    rows = rows_from(log)
    row = np.nonzero(rows.kinds == kind)[0][3]
    z = [*rows.readings[row, :2], np.nan] if kind == CAMERA else rows.readings[row, 2:].tolist()
    _, (x, P), (got_x, got_P) = _one_event(kind, z, 1, setup)
    H, out, held = np.zeros((3, SIZE)), np.empty(SIZE), list(CONSIDERED)
    before, x, P = x[0], x[0].copy(), P[0].copy()
    if kind == CAMERA:
        camera_terms(setup.view, noise, before, P, H, out)
        order, R = [0, 1], out[2:4] + noise[0] ** 2
    else:
        imu_terms(np.array([9.81, 0.0]), noise, before, P, H, out)
        order, R = [2, 0, 1], out[3:6].copy()
    for k in order:
        S = H[k] @ P @ H[k] + R[k]
        K = P @ H[k] / S
        y = z[k] - out[k] - H[k] @ (x - before)
        left = np.eye(SIZE) - np.outer(K, H[k])
        updated, moved = left @ P @ left.T + R[k] * np.outer(K, K), x + y * K
        updated[np.ix_(held, held)], moved[held] = P[np.ix_(held, held)], x[held]
        x, P = moved, updated
    sigma = np.sqrt(np.diag(P))
    np.testing.assert_allclose(got_x[0] / sigma, x / sigma, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        got_P[0] / sigma / sigma[:, None], P / sigma / sigma[:, None], rtol=0, atol=1e-9
    )
    assert np.linalg.eigvalsh(got_P[0] / sigma / sigma[:, None])[0] > 0.0


def test_an_outlier_changes_nothing() -> None:
    said, before, after = _one_event(CAMERA, [5000.0, 120.0, np.nan])
    assert said["gated_camera"] == 1.0 and said["nis_camera"] > 20.0
    np.testing.assert_array_equal(before[0], after[0])


def test_a_missing_accelerometer_leaves_the_gyroscope() -> None:
    said, before, after = _one_event(IMU, [np.nan, np.nan, 0.1])
    assert np.isnan(said["gated_accel"]) and np.isnan(said["nis_accel"])
    assert said["gated_gyro"] == 0.0
    assert not np.array_equal(before[0], after[0])


def test_levels_are_mixed_at_pictures_or_after_a_while() -> None:
    assert mixes(CAMERA, 0.0) and mixes(IMU, 2.0 * MIXED_S)
    assert not mixes(IMU, 0.5 * MIXED_S) and not mixes(0, 1.0)


@pytest.mark.slow
def test_covariance_stays_positive_definite_for_ten_million_steps() -> None:
    rig, log = simulated("swing")
    setup = setup_for(rig, 0, Kinematic(Kinematic().levels[:1]))
    rows, filtered = rows_from(log), Filter(setup)
    length = float(rows.t_s[-1]) + 0.01
    filtered.run(rows)
    many = 50
    once = len(rows)
    t = np.concatenate([rows.t_s + length * k for k in range(1, many + 1)])
    readings, kinds = np.tile(rows.readings, (many, 1)), np.tile(rows.kinds, many)
    done, turn = once, 1
    while done < 1e7:
        filtered.run(Rows(t + (turn - 1) * many * length, readings, kinds))
        done += many * once
        turn += 1
    _, P, _ = filtered.state
    np.testing.assert_array_equal(P[0], P[0].T)
    scale = 1.0 / np.sqrt(np.diag(P[0]))
    assert np.linalg.eigvalsh(P[0] * scale[:, None] * scale)[0] > 1e-12
