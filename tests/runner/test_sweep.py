"""A sweep in this process: its specification, all its cases, what is kept, the best and worst points."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

from calib.cli.fleet import _tell_sweep
from calib.core.errors import BadInputError
from calib.core.workers import Failure, Task
from calib.runner import sweep as sweeping
from calib.runner.outcomes import column, opened_store, texts
from calib.runner.processes import Here
from calib.runner.sweep import Base, Case, Sweep, cases, read_sweep, run_sweep, summarise_sweep
from calib.show.fleet import sweep_page_text

_BASE = "base: {controller: pid, reference: jump}\n"


def _read(tmp_path: Path, text: str) -> Sweep:
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
        ("base: {controller: pod, reference: jump}\n", "base.controller is 'pod', expected one of p, pid"),
        ("base: {scenario: swing, rig: none.yaml}\n", "none.yaml is not there"),
        (_BASE + "grid: {__class__.x: [1]}\n", "is no parameter"),
        ("base: {scenario: swing}\ngrid: {controller.pwm_high: [200]}\n", "needs a controller"),
        (
            _BASE + f"grid: {{pump.lag_s: [{'9' * 390}]}}\n",
            r"grid.pump.lag_s.0 is 9{57}..., expected at most 1e\+40",
        ),
        ("base: {~: 1, scenario: swing}\n", "base.None is None, expected text as a key"),
        (_BASE + "draws: {count: 0}\n", "draws.count is 0"),
        (_BASE + "grid: {pump.lag_s: []}\n", r"grid.pump.lag_s is \[\], expected at least 1 value"),
        (_BASE + "draws: {actuator.mass_g: {uniform: [1, 2]}}\n", "not a key .* did you mean mass_kg"),
        ("base: {scenario: steps}\ngrid: {scenario.vols: [6]}\n", "vols is not a key .* mean volts"),
        ("base: {filter: fused, scenario: swing}\ngrid: {align.x: [1]}\n", "lacks; calib align writes it"),
        ("base: {filter: fused, scenario: swing, controller: p}\n", "has a controller and a filter"),
        ("base: {scenario: swing, reference: jump}\n", "reference is that of a controller"),
        (_BASE + "grid: {pump.lag_s: [1]}\ndraws: {pump.lag_s: {normal: [1, 1]}}\n", "in grid and in draws"),
        (_BASE + "grid: {pump.lag_s: [1]}\nnear: 2\n", "measure names none"),
        (_BASE + "grid: {pump.lag_s: [1]}\nmeasure: [rise_s, rise_s]\n", "measure names 'rise_s' twice"),
    ],
)
def test_what_is_no_sweep(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        _read(tmp_path, text)


SPEC = Sweep.model_validate(
    {
        "base": {"scenario": "orientation", "feedback": "truth", "duration": "1s"},
        "grid": {"scenario.Kp": [1.0, 2.0, 3.0], "scenario.controller": ["p", "pid"]},
        "draws": {"count": 4, "actuator.mass_kg": {"uniform": [0.04, 0.06]}},
        "measure": ["error", "other"],
    }
)


def bowl(base: Base, case: Case, seed: int) -> dict[str, float | None]:
    """An error that is least at Kp = 2 with pid; the third draw fails there."""
    values = dict(case.values)
    kp, pid = float(values["scenario.Kp"]), values["scenario.controller"] == "pid"
    if case.draw == 3 and kp == 2.0 and pid:
        raise BadInputError("oh")
    return {"error": (kp - 2.0) ** 2 + (0.0 if pid else 0.5) + 0.01 * case.draw, "other": kp}


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeping, "run_case", bowl)


def test_best_worst_and_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with opened_store(tmp_path / "out", "calib sweep", ()) as (store, _):
        assert run_sweep(store, Here(), SPEC)["same"] == 0
        found = summarise_sweep(store, SPEC, 0)
        assert (found.cases, found.failed, found.why, found.measure) == (24, 1, "oh", "error")
        assert found.first is not None
        assert found.first.told().startswith(
            "#3 (scenario.Kp 2, scenario.controller pid, actuator.mass_kg 0.0"
        )
        best = found.best[0]
        assert best.parameters == {"scenario.Kp": 2.0, "scenario.controller": "pid"}
        assert (best.draws, best.median, best.worst) == (3, pytest.approx(0.01), pytest.approx(0.02))
        assert best.measures == {"error": pytest.approx(0.01), "other": 2.0}
        _tell_sweep(found)
        _, head, first, *_ = capsys.readouterr().out.splitlines()
        assert head.split()[-3:] == ["worst", "draw", "other"] and first.split()[-3:] == ["0.01", "0.02", "2"]
        assert found.best[0].loss < found.best[-1].loss and not found.worst
        # The page speaks in words.
        page = sweep_page_text(SPEC, found)
        assert "scenario Kp" in page and "scenario.Kp" not in page and "Error over each parameter" in page
        table = pyarrow.parquet.read_table(tmp_path / "out" / "sweep.parquet")
        assert table.num_rows == 24
        np.testing.assert_equal(column(table, "case"), np.arange(24.0))
        assert texts(table, "scenario.controller")[:8] == ["p"] * 4 + ["pid"] * 4
        assert sum(bool(s) for s in texts(table, "sentence")) == 1
        masses = column(table, "actuator.mass_kg").reshape(6, 4)
        assert (masses == masses[0]).all()
        # One case is lost, one is damaged, one is of another sweep: they are done again, and no others.
        files = sorted((tmp_path / "out" / ".sweep" / "outcomes").glob("case*.json"))
        assert len(files) == 24
        files[0].unlink()
        files[1].write_text(files[1].read_text()[:100])
        files[2].write_text(json.dumps({**json.loads(files[2].read_text()), "key": "x"}))
        assert run_sweep(store, Here(), SPEC)["same"] == 21
        assert summarise_sweep(store, SPEC, 21).best == found.best


class Deadly(Here):
    """As a process that dies, or hangs, of case 7."""

    how = "died"

    def finished(self) -> Iterator[tuple[Task, Any]]:
        for task, result in super().finished():
            yield task, Failure(self.how) if task.arguments[0].number == 7 else result


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("died", "each process that tried it died: out of memory, or a fault in a library"),
        ("over", "was not done after 0.2 s, which is the --timeout of a case"),
    ],
)
def test_one_case_takes_no_others_with_it(tmp_path: Path, how: str, why: str) -> None:
    processes = Deadly()
    processes.how = how
    with opened_store(tmp_path / "out", "calib sweep", ()) as (store, _):
        run_sweep(store, processes, SPEC, limit_s=0.2)
        found = summarise_sweep(store, SPEC, 0)
        assert (found.cases, found.failed, found.why) == (24, 2, why)
        # It may live another time.
        assert run_sweep(store, Here(), SPEC)["same"] == 23
        assert summarise_sweep(store, SPEC, 23).failed == 1
