"""Noise from a log: the tracker's jitter and levels of process noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated

from calib.estimator.model import Kinematic
from calib.estimator.noise import grid_px, jitter_px, log_likelihood, tune
from calib.estimator.setup import Rows
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of


@pytest.mark.parametrize("jitter", [0.2, 0.5])
def test_jitter_is_recovered_from_whole_pixels(jitter: float) -> None:
    nominal = SimulatedRig()
    rig = replace(nominal, tracker=replace(nominal.tracker, jitter_px=jitter))
    log = log_of(run_scenario(make_scenario("ellipse"), rig, 3, "sensors", 12.0))
    found = jitter_px(setup_for(nominal), [rows_from(log)])
    assert found.sigma is not None and found.sigma < 0.15
    assert abs(np.log(found.value / jitter)) < max(4.0 * found.sigma, 0.12)


def test_without_pictures_the_jitter_is_a_guess() -> None:
    rig, log = simulated("static")
    rows = rows_from(log)
    rows.readings[:, :2] = np.nan
    found = jitter_px(setup_for(rig), [rows])
    assert found.sigma is None and found.value > 0.0


def test_whole_pixels_are_told_from_others() -> None:
    readings = np.full((5, 5), np.nan)
    assert grid_px(readings) == 0.0
    readings[:3, :2] = [[10.0, 20.0], [11.0, 20.0], [12.0, 21.0]]
    assert grid_px(readings) == 1.0
    readings[3, :2] = 10.25, 20.0
    assert grid_px(readings) == 0.0


def test_tuning_mends_a_level_that_is_far_too_loud() -> None:
    rig, log = simulated("swing", 1)
    levels = Kinematic().levels
    loud = replace(levels[3], accel_phi_radps2=levels[3].accel_phi_radps2 * 8.0)
    setup = setup_for(rig, 1, Kinematic((levels[0], loud)))
    rows = rows_from(log)
    short = Rows(rows.t_s[:500], rows.readings[:500], rows.kinds[:500])
    steps: list[int] = []
    found = tune(setup, [short], lambda done, total: steps.append(done))
    assert found.after > found.before
    assert found.after == pytest.approx(log_likelihood(found.setup, [short]))
    assert found.factors["swing_phi"].value < 0.7
    assert found.rows == 500 and len(steps) == 4
