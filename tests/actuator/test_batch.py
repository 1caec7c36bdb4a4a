"""Batches: the numbers of the single runs, whatever is mixed, and marked failures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.actuator.batch import simulate_batch
from calib.actuator.integrate import rig_at_rest, simulate, state_row
from calib.actuator.kernel import LANES, STATE
from calib.actuator.parameters import Plant, StandardLinearSolid, Stiffness, pumps_connected
from calib.actuator.pump import Orifice, Pump, RateLimit
from calib.arrays import FloatArray
from calib.errors import BadInputError

PUMPED = pumps_connected()


def commands(seed: int, blocks: int) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).uniform(0, 255, (blocks, 2)), 20, axis=0)


def mixed(sets: int, seed: int) -> tuple[list[Plant], list[Pump]]:
    """Every parameter differs; some plants have gravity or the head's projection, some pumps an orifice."""
    rng = np.random.default_rng(seed)
    plants, pumps = [], []
    for i in range(sets):
        plants.append(
            Plant(
                mass_kg=rng.uniform(0.012, 0.02),
                inertia_kgm2=rng.uniform(0.8e-5, 2e-5),
                bellows_radius_m=rng.uniform(0.011, 0.014),
                rest_length_m=rng.uniform(0.06, 0.07),
                stiffness=Stiffness((rng.uniform(40, 60), rng.uniform(0, 2000), 1e3, 1e4)),
                stiffness_scale=rng.uniform(0.9, 1.1),
                damping_scale=rng.uniform(3, 20),
                bending_N_per_rad2=rng.uniform(0, 0.3),
                creep=StandardLinearSolid(rng.uniform(5, 15), rng.uniform(0.2, 1.0)),
                gravity_mps2=(0.0, 9.81) if i % 5 == 3 else (0.0, 0.0),
                force_projection="head" if i % 7 == 4 else "virtual_work",
            )
        )
        deflation = Orifice(rng.uniform(0.8, 1.2)) if i % 3 == 0 else RateLimit(rng.uniform(0.3, 0.5))
        pumps.append(Pump(lag_s=rng.uniform(0.5, 0.9), delay_ticks=i % 4, deflation=deflation))
    return plants, pumps


@pytest.mark.parametrize(("sets", "threads"), [(1, 1), (5, 1), (2 * LANES + 3, 2), (40, 3)])
def test_sets_are_the_single_runs(sets: int, threads: int) -> None:
    pwm, (plants, pumps) = commands(sets, 3), mixed(sets, sets)
    start = np.array([state_row(plant, 0.2) for plant in plants])
    states, stopped = simulate_batch(plants, pumps, pwm, start, threads=threads)
    assert states.shape == (sets, len(pwm), len(STATE))
    assert np.all(stopped == -1)
    for plant, pump, rows in zip(plants, pumps, states, strict=True):
        alone = simulate(plant, pump, pwm, rig_at_rest(plant, pump, 0.2))
        assert rows == pytest.approx(alone.states[1:], rel=1e-10, abs=1e-13)


def test_one_start_for_all() -> None:
    pwm, start = commands(1, 2), state_row(PUMPED, 0.1, 0.07, (0.3, 0.2))
    shared, _ = simulate_batch([PUMPED] * 3, [Pump()] * 3, pwm, start)
    repeated, _ = simulate_batch([PUMPED] * 3, [Pump()] * 3, pwm, np.tile(start, (3, 1)))
    assert np.array_equal(shared, repeated)
    assert np.array_equal(shared[0], shared[2])


def test_the_company_does_not_matter() -> None:
    """A set gives the same bytes alone in a block and in a full one."""
    pwm = commands(2, 2)
    plants = [replace(PUMPED, stiffness=Stiffness((40.0 + i,))) for i in range(LANES)]
    pumps = [Pump()] * LANES
    together, _ = simulate_batch(plants, pumps, pwm, state_row(PUMPED))
    alone, _ = simulate_batch(plants[5:6], pumps[:1], pwm, state_row(PUMPED))
    assert np.array_equal(together[5], alone[0])


@pytest.mark.parametrize("gravity", [(0.0, 0.0), (0.0, 9.81)])
def test_marks_a_set_that_leaves_the_model(gravity: tuple[float, float]) -> None:
    """Alone and side by side the same step is named, and the neighbours go on."""
    hard = replace(PUMPED, stiffness=Stiffness((1e6,)), gravity_mps2=gravity)
    states, stopped = simulate_batch(
        [PUMPED, hard, PUMPED], [Pump()] * 3, np.full((20, 2), 100.0), state_row(PUMPED, 0.3)
    )
    assert stopped[0] == stopped[2] == -1
    assert 0 <= stopped[1] < 17
    assert np.all(np.isnan(states[1]))
    assert np.all(np.isfinite(states[[0, 2]]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pumps": []}, "1 plants and 0 pumps"),
        ({"plants": [], "pumps": []}, "0 plants and 0 pumps"),
        ({"plants": [PUMPED] * 2, "pumps": [Pump(), Pump(tick_s=0.01)]}, "different ticks"),
        ({"substeps": 0}, "found 0 steps per tick"),
        ({"threads": 0}, "0 threads"),
        ({"pwm": np.zeros((0, 2))}, "0 rows"),
        ({"start": np.zeros((2, 10))}, r"starts of shape \(2, 10\)"),
    ],
)
def test_bad_input(change: dict[str, object], words: str) -> None:
    arguments = {"plants": [PUMPED], "pumps": [Pump()], "pwm": np.zeros((5, 2)), "start": state_row(PUMPED)}
    with pytest.raises(BadInputError, match=words):
        simulate_batch(**{**arguments, **change})
