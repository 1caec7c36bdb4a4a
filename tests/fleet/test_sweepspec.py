"""Specifications of sweeps: the cases that follow, and what is refused with its key."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.runner.sweep import SweepSpec, cases, read_sweep

_BASE = "base: {controller: pid, reference: jump}\n"


def _read(tmp_path: Path, text: str) -> SweepSpec:
    path = tmp_path / "s.yaml"
    path.write_text(text)
    return read_sweep(path)


def test_grid_times_draws(tmp_path: Path) -> None:
    spec = _read(
        tmp_path,
        _BASE + "grid:\n  pump.lag_s: [0.1, 0.2]\n  actuator.stiffness_scale: {from: 1, to: 2, count: 3}\n"
        "draws: {count: 4, seed: 7, actuator.mass_kg: {normal: [0.05, 0.002]}, "
        "pump.supply_V: {uniform: [11, 12]}, pump.falling_N_per_s: {log_uniform: [1, 10]}}\n"
        "measure: [angle_rms_rad]\nnear: 0.1\n",
    )
    assert (spec.points, spec.cases, spec.near) == (6, 24, 0.1)
    made = list(cases(spec))
    assert [case.number for case in made] == list(range(24))
    assert {case.point for case in made} == set(range(6)) and {case.draw for case in made} == set(range(4))
    assert dict(made[4].values)["actuator.stiffness_scale"] == 1.5
    # A draw is the same plant at every point of the grid, and another one than the other draws.
    for name in ("actuator.mass_kg", "pump.supply_V"):
        by_draw = np.array([dict(case.values)[name] for case in made]).reshape(6, 4)
        assert (by_draw == by_draw[0]).all() and len(set(by_draw[0].tolist())) == 4
    assert all(11.0 <= dict(case.values)["pump.supply_V"] <= 12.0 for case in made)
    assert all(1.0 <= dict(case.values)["pump.falling_N_per_s"] <= 10.0 for case in made)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("grid: {pump.lag_s: [1]}\n", "base is missing"),
        (_BASE, "nothing to sweep over"),
        (_BASE + "colour: red\n", "colour is not known"),
        ("base: {}\ngrid: {pump.lag_s: [1]}\n", "names none of controller, scenario, filter"),
        ("base: {controller: pod, reference: jump}\n", "base.controller is 'pod', expected one of p, pid"),
        ("base: {controller: pid, reference: hop}\n", "base.reference is 'hop'"),
        ("base: {scenario: dance}\n", "base.scenario is 'dance'"),
        ("base: {filter: fused}\n", "base.scenario is ''"),
        ("base: {scenario: swing, rig: none.yaml}\n", "none.yaml is not there"),
        ("base: {scenario: swing, duration: 3}\n", "base.duration is 3, expected text"),
        ("base: {scenario: swing, duration: 3m2}\n", "duration"),
        (_BASE + "grid: {lag: [1]}\n", "lag is no parameter"),
        (_BASE + "grid: {__class__.x: [1]}\n", "is no parameter"),
        (_BASE + "grid: {scenario.Kp: [1]}\n", "needs a scenario"),
        (
            _BASE + "grid: {controller.orientation.Kp_pwm_per_rad: [1]}\n",
            "belongs to the controller tuned-pid",
        ),
        (_BASE + "grid: {controller.pwm_high: [200]}\n", "section controller, which base.rig lacks"),
        ("base: {scenario: swing}\ngrid: {controller.pwm_high: [200]}\n", "needs a controller"),
        (_BASE + "grid: {pump.lag_s: []}\n", "no list of values and no range"),
        (_BASE + "grid: {pump.lag_s: [.nan]}\n", "has .* in it, expected numbers"),
        (_BASE + "grid: {pump.lag_s: [[1]]}\n", "in it, expected numbers"),
        (_BASE + "grid: {pump.lag_s: [null]}\n", "has None in it"),
        (_BASE + f"grid: {{pump.lag_s: [{'9' * 390}]}}\n", "has 9{60} in it, expected numbers"),
        (_BASE + "grid: {true: [1]}\n", "grid has the key True, expected text"),
        (_BASE + "draws: {count: 2, 3.5: {uniform: [0, 1]}}\n", "draws has the key 3.5"),
        (_BASE + f"draws: {{count: 2, pump.lag_s: {{uniform: [0, {'9' * 390}]}}}}\n", "expected a number"),
        ("base: {~: 1, scenario: swing, duration: {}}\n", "base has the key None"),
        ("base: {scenario: swing, duration: 2h}\n", "base.duration is '2h', expected at most 1h"),
        (_BASE + "grid: {pump.lag_s: {from: 1, to: 2, count: 0}}\n", "count is 0"),
        (_BASE + "grid: {pump.lag_s: {from: 0, to: 2, count: 3, log: true}}\n", "expected positive"),
        (_BASE + "draws: {count: 0}\n", "draws.count is 0"),
        (_BASE + "draws: {count: 2, pump.lag_s: {cauchy: [0, 1]}}\n", "is no distribution"),
        (_BASE + "draws: {count: 2, pump.lag_s: {uniform: [2, 1]}}\n", "the smaller one first"),
        (_BASE + "draws: {count: 2, pump.lag_s: {normal: [1, -1]}}\n", "none below zero"),
        (_BASE + "grid: {pump.lag_s: [1]}\ndraws: {pump.lag_s: {normal: [1, 1]}}\n", "in grid and in draws"),
        (_BASE + "grid: {pump.lag_s: [1, 2]}\ndraws: {count: 900000}\n", "asks for 1800000 cases"),
        (
            _BASE
            + "grid:\n"
            + "".join(f"  pump.a{k}: {{from: 0, to: 1, count: 10000}}\n" for k in range(99)),
            "asks for 100000000 cases or more",
        ),
        (_BASE + "grid: {pump.lag_s: [1]}\nmeasure: 3\n", "measure is no list"),
        (_BASE + "grid: {pump.lag_s: [1]}\nnear: 2\n", "measure names none"),
    ],
)
def test_what_is_no_sweep(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        _read(tmp_path, text)
