"""One event: scalar updates against matrices, gating, and a covariance that stays one."""

from __future__ import annotations

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated

from calib.estimator.filter import Filter, starting_state
from calib.estimator.kernel import CAMERA, CONSIDERED, IMU, REPORT, TRACE, WORK, event, scalar_update
from calib.estimator.model import Kinematic
from calib.estimator.sensors import SIZE
from calib.estimator.setup import Rows


def test_scalar_update_is_joseph_s_form_but_for_what_is_considered() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((SIZE, SIZE))
    P, x, H, R = A @ A.T, rng.standard_normal(SIZE), rng.standard_normal(SIZE), 0.3
    S = H @ P @ H + R
    K = P @ H / S
    left = np.eye(SIZE) - np.outer(K, H)
    expected = left @ P @ left.T + R * np.outer(K, K)
    got_x, got_P = x.copy(), P.copy()
    scalar_update(got_x, got_P, 0.7, S, P @ H)
    held = list(CONSIDERED)
    moved = x + 0.7 * K
    moved[held] = x[held]
    expected[np.ix_(held, held)] = P[np.ix_(held, held)]
    np.testing.assert_allclose(got_x, moved, rtol=1e-12)
    np.testing.assert_allclose(got_P, expected, rtol=1e-9, atol=1e-9)
    assert np.linalg.eigvalsh(got_P)[0] > 0.0
    np.testing.assert_array_equal(got_P, got_P.T)


def _one_event(kind: int, z: list[float], levels: int = 4) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    rig, log = simulated("static")
    process = Kinematic(Kinematic().levels[:levels])
    setup = setup_for(rig, 0, process)
    x, P, w = starting_state(setup, rows_from(log))
    before = x.copy()
    level, walk = process.arrays()
    report, gated = np.empty(len(REPORT)), np.zeros(3)
    after, after_P, after_w = np.empty_like(x), np.empty_like(P), np.empty_like(w)
    event(
        x, P, w, after, after_P, after_w, kind, np.array(z), 0.0, 0.3, level, walk, setup.view,
        np.array([9.81, 0.0]), setup.noise, np.zeros((levels, WORK, SIZE)), False, report, gated,
        np.empty((0, TRACE)),
    )  # fmt: skip
    np.testing.assert_array_equal(x, before)
    np.testing.assert_array_equal(after_P, np.swapaxes(after_P, 1, 2))
    return dict(zip(REPORT, report.tolist(), strict=True)), before, after


def test_an_outlier_changes_nothing() -> None:
    said, before, after = _one_event(CAMERA, [5000.0, 120.0, np.nan])
    assert said["gated_camera"] == 1.0 and said["nis_camera"] > 20.0
    np.testing.assert_array_equal(before, after)


def test_a_missing_accelerometer_leaves_the_gyroscope() -> None:
    said, before, after = _one_event(IMU, [np.nan, np.nan, 0.1])
    assert np.isnan(said["gated_accel"]) and np.isnan(said["nis_accel"])
    assert said["gated_gyro"] == 0.0
    assert not np.array_equal(before, after)


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
