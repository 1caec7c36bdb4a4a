"""Process noise of the driven filter from logs."""

from __future__ import annotations

from dataclasses import replace

import pytest
from drivenlogs import commands_of, driven_log
from estimatorlogs import rows_from, setup_for

from calib.arrays import FloatArray
from calib.estimator.driven_noise import WALKS, driven_likelihood, scaled, tune_driven
from calib.estimator.driven_setup import Drive
from calib.estimator.setup import Rows, Setup

_ROWS = 600


def _short(name: str, seed: int) -> tuple[Setup, tuple[Rows, FloatArray]]:
    rig, log = driven_log(name, seed)
    rows = rows_from(log)
    part = Rows(rows.t_s[:_ROWS], rows.readings[:_ROWS], rows.kinds[:_ROWS])
    return setup_for(rig, seed), (part, commands_of(log)[:_ROWS])


def test_each_walk_is_scaled_alone() -> None:
    drive = Drive()
    assert scaled(drive, "disturbance", 2.0) == replace(drive, walk_disturbance=2.0 * drive.walk_disturbance)
    phi, length = drive.walk_rates
    assert scaled(drive, "rates", 3.0) == replace(drive, walk_rates=(3.0 * phi, 3.0 * length))
    assert scaled(drive, "forces", 0.5) == replace(drive, walk_forces=0.5 * drive.walk_forces)


def test_a_walk_that_is_far_too_loud_is_mended_and_none_is_taken_for_nothing() -> None:
    setup, log = _short("step", 1)
    nominal = Drive()
    loud = scaled(nominal, "rates", 30.0)
    steps: list[int] = []
    found = tune_driven(setup, loud, [log], lambda done, total: steps.append(total - done))
    assert found.after > found.before + 10.0
    assert found.after == pytest.approx(driven_likelihood(setup, found.drive, [log]))
    assert found.factors["rates"].value == 0.5
    assert all(found.factors[walk].value >= 0.5 for walk in WALKS)
    assert steps == [3, 2, 1] and found.rows == _ROWS


def test_a_plant_that_is_pushed_about_asks_for_a_disturbance() -> None:
    """A command that the estimator is not told of is a force that nothing explains."""
    setup, (rows, pwm) = _short("step", 2)
    blind = pwm.copy()
    blind[rows.t_s > 2.0] *= 0.9
    told = tune_driven(setup, Drive(), [(rows, pwm)])
    fooled = tune_driven(setup, Drive(), [(rows, blind)])
    assert fooled.factors["disturbance"].value > 2.0 * told.factors["disturbance"].value


def test_without_logs_nothing_changes() -> None:
    setup, _ = _short("step", 1)
    found = tune_driven(setup, Drive(), [])
    assert found.drive == Drive() and found.rows == 0
