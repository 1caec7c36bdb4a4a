"""Runs that claims share."""

from __future__ import annotations

import numpy as np

from calib.stages.actuator.parameters import PRINTED_CREEP, growth_rate_per_s
from calib.stages.actuator.pump import RateLimit
from calib.twin.rig import SimulatedRig
from thesis.runs import PRINTED_K_BND, first_model, nominal, printed_plant, tried, with_plant, with_pump


def test_the_nominal_rig_is_the_twins_own() -> None:
    assert nominal() == SimulatedRig()
    assert with_plant() == nominal() and with_pump(0.4) == nominal()
    assert with_pump(2.0).pump.deflation == RateLimit(2.0)


def test_a_run_is_done_once_and_another_seed_is_another_run() -> None:
    assert tried("swing", 0.5)[0] is tried("swing", 0.5)[0]
    one, other = tried("swing", 0.5)[0], tried("swing", 0.5, seed=1)[0]
    assert np.array_equal(one.states, other.states)
    assert not np.array_equal(one.gyro_radps, other.gyro_radps)


def test_the_first_model_has_neither_bending_nor_creep() -> None:
    plant = first_model().free_plant
    assert plant.creep is None and plant.bending_N_per_rad2 == 0.0 and plant.damping_scale == 1.0


def test_the_printed_plant_is_made_without_a_warning_and_grows() -> None:
    plant = printed_plant()
    assert plant.creep_rates == PRINTED_CREEP
    assert plant.bending_N_per_rad2 == 1e-3 * PRINTED_K_BND
    assert growth_rate_per_s(plant) > 0.1
