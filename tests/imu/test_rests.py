"""Rests are found where they are, to within the window, and means err as their scatter says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from imu_poses import Sensor, motion, sphere_poses

from calib.imu.rests import Quiet, find_rests, quiet_level, spread
from calib.imu.sampling import Part

COLUMNS = [3, 4, 5]
PERIOD_S = 0.01


def _parts(values: np.ndarray) -> tuple[Part, ...]:
    rows = np.arange(len(values))
    return (Part(0.0, values, rows, rows),)


def _log(poses: int = 8, **how: float) -> np.ndarray:
    _, w, f = motion(sphere_poses(poses), **how)
    return Sensor().readings(w, f, np.random.default_rng(3))


def test_rests_lie_inside_the_true_ones_and_fill_them() -> None:
    parts = _parts(_log(8, rest_s=4.0, turn_s=2.0, initial_s=10.0))
    s = spread(parts, COLUMNS, PERIOD_S)
    quiet = quiet_level(s, np.full(3, math.nan))
    rests = find_rests(parts, COLUMNS, s, 5.0 * quiet.zeta)
    assert len(rests) == 8
    for k, rest in enumerate(rests):
        start = 0.0 if k == 0 else 10.0 + 6.0 * k - 4.0
        stop = 10.0 if k == 0 else start + 4.0
        # A turn begins so slowly that its first and last tenths of a second hide in the noise.
        assert start - 0.2 < rest.from_s < start + 0.55
        assert stop - 0.55 < rest.to_s < stop + 0.2


def test_the_quiet_level_is_that_of_the_rest_at_the_start() -> None:
    values = _log(6, initial_s=12.0)
    quiet = quiet_level(spread(_parts(values), COLUMNS, PERIOD_S), np.full(3, math.nan))
    assert quiet.initial_s == pytest.approx(12.0, abs=0.6)
    assert quiet.zeta == pytest.approx(math.sqrt(3.0) * 0.02**2, rel=0.1)


def test_a_log_that_begins_in_motion_is_measured_by_its_quietest_windows() -> None:
    values = _log(6, initial_s=4.0)[450:]
    quiet = quiet_level(spread(_parts(values), COLUMNS, PERIOD_S), np.full(3, math.nan))
    assert quiet.initial_s == 0.0
    assert quiet.zeta == pytest.approx(math.sqrt(3.0) * 0.02**2, rel=0.3)


def test_readings_without_noise_are_known_to_their_step() -> None:
    parts = _parts(np.ones((500, 6)))
    quiet = quiet_level(spread(parts, COLUMNS, PERIOD_S), np.full(3, 0.1))
    assert quiet == Quiet(pytest.approx(math.sqrt(3.0) * 0.01 / 12.0), 5.0)


def test_short_parts_hold_no_rest() -> None:
    parts = _parts(np.ones((50, 6)))
    s = spread(parts, COLUMNS, PERIOD_S)
    assert np.isinf(s.zeta[0]).all()
    assert find_rests(parts, COLUMNS, s, 1.0) == ()


def test_scatter_counts_correlation_between_readings() -> None:
    rng = np.random.default_rng(1)
    white = 0.02 * rng.normal(size=(40_003, 6))
    smooth = np.stack([white[k : k + 40_000] for k in range(4)]).mean(axis=0)
    for values in (white[:40_000], smooth):
        parts = _parts(values)
        (rest,) = find_rests(parts, COLUMNS, spread(parts, COLUMNS, PERIOD_S), math.inf)
        # The mean of four neighbours has a quarter of the variance and the same long-run one.
        assert rest.scatter == pytest.approx(0.02**2 * np.ones(3), rel=0.15)
        assert rest.mean == pytest.approx(values[:, COLUMNS].mean(axis=0))
        assert rest.samples == 40_000
        assert rest.duration_s == pytest.approx(400.0)
