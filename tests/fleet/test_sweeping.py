"""A sweep in this process: all cases, what is kept, and the best and worst points."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fleet_clusters import in_threads

from calib.runner import engine as worker
from calib.runner import sweep as sweeping
from calib.runner.engine import Cluster, Lost
from calib.runner.fleet import Store, Table, column, opened_store, texts
from calib.runner.sweep import Base, Case, CaseResult, SweepSpec, run_sweep, summarise_sweep
from calib.runner.task import program

pytest.importorskip("distributed")
pytest.importorskip("pyarrow")

pytestmark = pytest.mark.filterwarnings("default")
"""What Dask warns of is not ours."""

SPEC = SweepSpec(
    Base("scenario", "orientation", "", "", "truth", 1.0, "auto"),
    (("scenario.Kp", (1.0, 2.0, 3.0)), ("scenario.controller", ("p", "pid"))),
    (("actuator.mass_kg", ("uniform", 0.04, 0.06)),),
    4,
    0,
    ("error",),
)


def bowl(base: Base, cases: tuple[Case, ...], seed: int, scratch: str) -> list[CaseResult]:
    """An error that is least at Kp = 2 with pid; the third draw fails there."""
    out = []
    for case in cases:
        values = dict(case.values)
        kp, pid = float(values["scenario.Kp"]), values["scenario.controller"] == "pid"
        error = (kp - 2.0) ** 2 + (0.0 if pid else 0.5) + 0.01 * case.draw
        fails = case.draw == 3 and kp == 2.0 and pid
        out.append(CaseResult(case.number, {} if fails else {"error": error, "other": kp}, "oh" * fails, 0.1))
    return out


@pytest.fixture(scope="module")
def here() -> Iterator[Cluster]:
    with in_threads(1, program()) as cluster:
        yield cluster


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeping, "run_cases", bowl)
    monkeypatch.setattr(sweeping, "BUNDLE", 5)


def _opened(tmp_path: Path) -> Iterator[Store]:
    with opened_store(tmp_path / "out", "calib sweep", ()) as (store, _):
        yield store


def test_best_worst_and_resumed(here: Cluster, tmp_path: Path) -> None:
    for store in _opened(tmp_path):
        assert run_sweep(store, here, SPEC, 1) == 0
        found = summarise_sweep(store, SPEC, 0)
        assert (found.cases, found.failed, found.why, found.measure) == (24, 1, "oh", "error")
        best = found.best[0]
        assert dict(best.values) == {"scenario.Kp": 2.0, "scenario.controller": "pid"}
        assert (best.draws, best.median, best.worst) == (3, pytest.approx(0.01), pytest.approx(0.02))
        assert dict(best.measures) == {"error": pytest.approx(0.01)}
        assert found.best[0].loss < found.best[-1].loss and not found.worst
        with Table(tmp_path / "out" / "sweep.parquet") as table:
            assert table.rows == 24
            np.testing.assert_equal(column(table, "case"), np.arange(24.0))
            assert texts(table, "scenario.controller")[:8] == ["p"] * 4 + ["pid"] * 4
            assert sum(bool(s) for s in texts(table, "sentence")) == 1
            masses = column(table, "actuator.mass_kg").reshape(6, 4)
            assert (masses == masses[0]).all()
        # One bundle is lost, one is of another sweep: both are done again, and no others.
        files = sorted((tmp_path / "out" / ".fleet" / "outcomes").glob("bundle*.json"))
        assert len(files) == 5
        files[0].unlink()
        told = json.loads(files[2].read_text())
        files[2].write_text(json.dumps({**told, "digest": "x"}))
        assert run_sweep(store, here, SPEC, 1) == 14
        assert summarise_sweep(store, SPEC, 14).best == found.best


def deadly(base: Base, cases: tuple[Case, ...], seed: int, scratch: str) -> list[CaseResult] | Lost:
    """As `bowl`; one case is as good as the death of its process, and takes all beside it with it."""
    if any(case.number == 7 for case in cases):
        return Lost(1)
    return bowl(base, cases, seed, scratch)


def test_one_case_takes_no_others_with_it(
    here: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeping, "run_cases", deadly)
    for store in _opened(tmp_path):
        run_sweep(store, here, SPEC, 1)
        found = summarise_sweep(store, SPEC, 0)
        assert (found.cases, found.failed, found.why) == (24, 2, "each process that tried it died")
        # It may live another time: its bundle is done again, and no others.
        monkeypatch.setattr(sweeping, "run_cases", bowl)
        assert run_sweep(store, here, SPEC, 1) == 19
        assert summarise_sweep(store, SPEC, 19).failed == 1


def endless(base: Base, cases: tuple[Case, ...], seed: int, scratch: str) -> list[CaseResult]:
    """As `bowl`; one case never ends."""
    if any(case.number == 7 for case in cases):
        threading.Event().wait(5.0)
    return bowl(base, cases, seed, scratch)


def test_a_case_that_hangs_is_a_row(here: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeping, "run_cases", endless)
    monkeypatch.setattr(worker, "_end_process", lambda seconds: None)
    monkeypatch.setattr(worker, "_LEAVE_S", 0.01)
    for store in _opened(tmp_path):
        run_sweep(store, here, SPEC, 1, limit_s=0.2)
        found = summarise_sweep(store, SPEC, 0)
    worker._leaving.clear()
    assert (found.cases, found.failed) == (24, 2)
    assert found.why == "was not done after 0.2 s, which is the --timeout of a case"
