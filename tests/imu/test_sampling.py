"""Time stamps as loggers write them: jitter, gaps, repeated rows and stamps; steps and limits of readings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.sampling import regular_parts

GYRO = np.array([True, False])


def _log(n: int = 6000, jitter_s: float = 4e-4, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.maximum.accumulate(0.01 * np.arange(n) + jitter_s * rng.normal(size=n))
    return t, rng.normal(size=(n, 2)) + np.array([0.0, 9.81])


def test_rate_and_jitter() -> None:
    t, values = _log()
    sampling, parts = regular_parts(t, values, GYRO)
    assert sampling.rate_hz == pytest.approx(100.0, rel=1e-5)
    assert sampling.jitter_s == pytest.approx(4e-4, rel=0.1)
    assert (sampling.gaps, sampling.repeated_rows, sampling.repeated_stamps) == ((), 0, 0)
    assert len(parts) == 1
    assert np.array_equal(parts[0].values, values)
    assert np.isnan(sampling.step).all()


def test_stamps_that_repeat_are_samples_of_their_own() -> None:
    t, values = _log()
    late = np.random.default_rng(1).choice(np.arange(1, 5999), 12, replace=False)
    for i in sorted(late.tolist()):
        t[i] = t[i - 1]
    sampling, parts = regular_parts(t, values, GYRO)
    assert (sampling.repeated_stamps, sampling.repeated_rows, sampling.missing) == (12, 0, 0)
    assert np.array_equal(parts[0].values, values)


def test_rows_written_twice_are_dropped() -> None:
    t, values = _log()
    rows = np.sort(np.concatenate([np.arange(6000), np.arange(100, 5900, 480)]))
    sampling, parts = regular_parts(t[rows], values[rows], GYRO)
    assert sampling.repeated_rows == 13
    assert sampling.gaps == ()
    assert np.array_equal(parts[0].values, values)


def test_a_short_gap_is_filled_and_the_time_axis_kept() -> None:
    t, values = _log(jitter_s=1e-4)
    keep = np.ones(6000, dtype=bool)
    keep[3000:3002] = False
    sampling, parts = regular_parts(t[keep], values[keep], GYRO)
    (gap,) = sampling.gaps
    assert (gap.missing, gap.split) == (2, False)
    assert gap.at_s == pytest.approx(29.99, abs=1e-3)
    assert gap.duration_s == pytest.approx(0.03, abs=1e-3)
    assert len(parts[0].values) == 6000
    filled = values[2999] + np.outer([1 / 3, 2 / 3], values[3002] - values[2999])
    assert np.allclose(parts[0].values[3000:3002], filled)
    assert np.array_equal(parts[0].values[3002:], values[3002:])


def test_a_long_gap_splits() -> None:
    t, values = _log()
    t[4000:] += 3600.0
    sampling, parts = regular_parts(t, values, GYRO)
    assert [gap.split for gap in sampling.gaps] == [True]
    assert [len(part.values) for part in parts] == [4000, 2000]
    assert sampling.duration_s == pytest.approx(60.0, rel=1e-3)
    assert sampling.jitter_s == pytest.approx(4e-4, rel=0.15)
    assert np.array_equal(parts[1].values, values[4000:])
    assert parts[1].rows[0] == 4000


def test_quantisation_and_limits() -> None:
    t, values = _log()
    step, end = 0.05, math.radians(250.0)
    values[:, 0] = step * np.rint(values[:, 0] / step)
    values[100:110, 0] = end
    values[:, 1] = np.clip(values[:, 1], None, 9.9)
    sampling, _ = regular_parts(t, values, GYRO)
    assert sampling.at_limit.tolist() == [10, 0]
    values[100:110, 0] = 0.0
    sampling, _ = regular_parts(t, values, GYRO)
    assert sampling.step[0] == pytest.approx(step, rel=1e-9)


def test_no_log_at_all() -> None:
    with pytest.raises(BadInputError, match="has 1 IMU sample"):
        regular_parts(np.zeros(1), np.zeros((1, 2)), GYRO)
    with pytest.raises(BadInputError, match="all 5 IMU samples have the time 2 s"):
        regular_parts(np.full(5, 2.0), np.arange(10.0).reshape(5, 2), GYRO)
