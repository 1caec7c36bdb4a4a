"""The pump's identification: truth recovered, extras only where needed, tables as people write them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from identifytrials import FLOW_TRUTH, LAG_TRUTH, pump_records
from outside import outside
from pydantic import ValidationError

from calib.core.errors import BadInputError
from calib.core.rig import Rig
from calib.stages.actuator.identify_pump import (
    MODELS,
    PumpFit,
    PumpFound,
    PumpRecord,
    PumpTable,
    Settled,
    Shape,
    _by_chance,
    _Problem,
    _solve,
    ceiling,
    cross_validate,
    fit_pump,
    identify_pump,
    judge_pump,
    jumps,
    of_lag,
    pump_section,
    settled_groups,
    simulate_pump,
    unexplained,
    with_run_sigma,
)
from calib.stages.actuator.pump import Orifice
from calib.stages.actuator.read import read_pump_table
from calib.stages.actuator.section import LAG, ORIFICE, PumpIdentified, PumpModel


@pytest.mark.parametrize(
    ("model", "truth"), [(LAG, LAG_TRUTH), pytest.param(ORIFICE, FLOW_TRUTH, marks=pytest.mark.slow)]
)
def test_truth_is_recovered_within_its_deviations(model: str, truth: np.ndarray) -> None:
    fit = fit_pump(pump_records(model, truth), model)
    names = [p.name for p in MODELS[model]]
    assert "dead_time_s" in fit.fitted
    for name in fit.fitted:
        expected = truth[names.index(name)]
        assert abs(fit.values[name] - expected) < 4.0 * fit.sigma[name] + 0.02 * expected, name
    assert fit.rms == pytest.approx(0.1, rel=0.1)
    assert np.allclose(np.diag(fit.correlation), 1.0)


@pytest.mark.parametrize(
    ("model", "truth"), [(LAG, LAG_TRUTH), pytest.param(ORIFICE, FLOW_TRUTH, marks=pytest.mark.slow)]
)
def test_rounding_and_the_order_of_recordings_decide_nothing(model: str, truth: np.ndarray) -> None:
    runs = pump_records(model, truth)
    rng = np.random.default_rng(1)
    moved = [
        PumpRecord(r.name, r.t_s, r.pwm, r.value * (1.0 + 1e-12 * rng.standard_normal(len(r.value))))
        for r in reversed(runs)
    ]
    one, other = fit_pump(runs, model), fit_pump(moved, model)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-6)
    assert other.sigma == pytest.approx(one.sigma, rel=1e-6)


def test_what_data_do_not_ask_for_stays_off() -> None:
    fit = fit_pump(pump_records(LAG, LAG_TRUTH), LAG)
    assert "rising_limit_per_s" not in fit.fitted
    assert fit.fixed["rising_limit_per_s"].startswith("off")
    limited = fit_pump(pump_records(LAG, np.array([0.06, 25.0, 0.3, 20.0])), LAG)
    assert limited.values["rising_limit_per_s"] == pytest.approx(20.0, rel=0.05)


@pytest.mark.slow
def test_the_right_model_wins_on_recordings_not_fitted() -> None:
    runs = pump_records(ORIFICE, FLOW_TRUTH)
    errors = {}
    for model in MODELS:
        fit = fit_pump(runs, model)
        held = cross_validate(fit, runs)
        assert [h.name for h in held] == [r.name for r in runs]
        errors[model] = np.sqrt(np.mean([h.rms**2 for h in held]))
        assert all(h.ahead > 0.0 for h in held)
    assert errors[ORIFICE] < 0.13
    assert errors[LAG] > 5.0 * errors[ORIFICE]
    assert cross_validate(fit_pump(runs[:1], LAG), runs[:1]) == []


@pytest.mark.slow
def test_a_real_pump(shared_data: Path) -> None:
    """Errors in kPa on files that were not fitted, and which model is the better one."""
    folder = outside(shared_data / "softbot")
    runs = []
    for path in sorted(folder.glob("sweep_*.csv")):
        table = np.genfromtxt(path, delimiter=",", skip_header=1)
        runs.append(PumpRecord(path.name, table[:, 0], table[:, 3], table[:, 2]))
    gone = {"sweep_kp_15.csv", "sweep_ki_500.csv"}
    rms = {}
    for model in MODELS:
        held = {h.name: h.rms for h in cross_validate(fit_pump(runs, model), runs)}
        assert all(math.isfinite(v) for v in held.values())
        rms[model] = float(np.sqrt(np.mean([v**2 for name, v in held.items() if name not in gone])))
    assert rms[ORIFICE] < 0.6
    assert rms[ORIFICE] < 0.6 * rms[LAG]


@pytest.mark.slow
def test_intervals_contain_where_real_runs_settle(shared_data: Path) -> None:
    """Each held run, those that leave the others by 5 kPa included; errors of the free runs are bounded."""
    folder = outside(shared_data / "softbot")
    found = identify_pump([read_pump_table(path) for path in sorted(folder.glob("sweep_*.csv"))])
    assert found.better is not None
    settles = found.settles(found.better)
    assert settles is not None
    level, half, inside, count = settles
    assert (inside, count) == (8, 8)
    assert level - half < 29.3
    assert level + half > 35.1
    errors = {h.name: h.rms for h in found.held[found.better]}
    jumping = [errors.pop("sweep_kp_15.csv"), errors.pop("sweep_ki_500.csv")]
    assert max(jumping) < 3.9
    assert max(errors.values()) < 1.0


@pytest.mark.parametrize("levels", [(30.0,) * 4, (30.0, 30.0, 30.0, 35.0)])
def test_the_level_has_a_sigma_that_holds_from_run_to_run(levels: tuple[float, ...]) -> None:
    rng = np.random.default_rng(1)
    runs = []
    for k, level in enumerate(levels):
        clean = simulate_pump(LAG, np.array([0.05, level, 0.6, FREE]), _record(_step()), start_s=-1.0)
        runs.append(PumpRecord(f"run{k}", T, _step(), clean + 0.05 * rng.standard_normal(len(T))))
    fit = fit_pump(runs, LAG)
    wide, between = with_run_sigma(fit, cross_validate(fit, runs))
    assert wide.sigma["level"] >= fit.sigma["level"]
    assert between < 0.1 if len(set(levels)) == 1 else 2.0 < between < 5.0
    assert wide.sigma["level"] >= math.hypot(fit.sigma["level"], between)


def test_a_lag_that_differs_from_run_to_run_is_told_by_runs_left_out() -> None:
    """Five times of five runs; the least sum of magnitudes alone says a third of how far they scatter."""
    off, rng = [], np.random.default_rng(4)
    for _ in range(5):
        runs = []
        for k, lag_s in enumerate((0.6 * (1.0 + 0.15 * rng.standard_normal(5))).tolist()):
            clean = simulate_pump(LAG, np.array([0.05, 30.0, lag_s, FREE]), _record(_step()), start_s=-1.0)
            runs.append(PumpRecord(f"run{k}", T, _step(), clean))
        start = np.array([0.05, 30.0, 0.6, FREE])
        fit = fit_pump(runs, LAG, start=start)
        wide, _ = with_run_sigma(fit, cross_validate(fit, runs))
        off.append((wide.values["lag_s"] - 0.6) / wide.sigma["lag_s"])
    assert np.sqrt(np.mean(np.square(off))) < 1.6


def test_runs_whose_controller_hides_their_level_widen_its_sigma() -> None:
    """All end at 22 kPa, at the PWM that holds it; how they rise tells 30 from 36 kPa."""
    runs = []
    for k, level in enumerate((30.0, 36.0, 30.0, 36.0)):
        pwm = np.where(0.8 + 0.1 * k <= T, 255.0 * 22.0 / level, _step())
        clean = simulate_pump(LAG, np.array([0.05, level, 0.6, FREE]), _record(pwm), start_s=-1.0)
        runs.append(PumpRecord(f"run{k}", T, pwm, clean + 0.05 * np.sin(37.0 * T + k)))
    fit = fit_pump(runs, LAG)
    assert 2.0 < with_run_sigma(fit, cross_validate(fit, runs))[1] < 8.0


def test_a_run_settles_where_as_much_flows_in_as_leaks_out() -> None:
    theta = np.array([0.05, 40.0, 0.3, 0.01, 2.0, 0.0, 1.0])
    fit = PumpFit(ORIFICE, theta, ("level",), {"level": 5.0}, np.eye(1), 0.0, 0.0, Shape())
    long = PumpRecord("run", 0.1 * np.arange(300), np.full(300, 255.0), np.zeros(300))
    at, sigma = fit.settles(3.0)
    assert at == pytest.approx(fit.run(long, -1.0)[-1], abs=1e-3)
    assert 3.0 < sigma < 5.0


@pytest.mark.slow
def test_what_chance_brings_is_bounded_by_recordings_left_out() -> None:
    """With coloured errors an extra that is not needed lowers the cost by less than the limit in 95 %."""
    beyond = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        runs = []
        for run in pump_records(LAG, np.array([0.06, 25.0, 0.3, 20.0]), 8):
            # Each recording has an error of its own that stays the same all along, as a model's have.
            wrong = 0.6 * rng.standard_normal() + 0.02 * run.pwm / 255.0 * rng.standard_normal()
            runs.append(PumpRecord(run.name, run.t_s, run.pwm, run.value + wrong))
        problem = _Problem(LAG, runs, Shape(), max(float(np.ptp(r.value)) for r in runs))
        start, _, _ = problem.nominal()
        rich, cost = _solve(problem, start, [0, 1, 2, 3])
        # The limit of the rise is held where it is in truth: then it is not needed among the unknowns.
        _, plain = _solve(problem, np.array([*rich[:3], 20.0]), [0, 1, 2])
        beyond += plain - cost > _by_chance(problem, rich, [0, 1, 2, 3], 1)
    assert beyond <= 4


T = 0.02 * np.arange(200)
FREE = 1e6


def _record(pwm: np.ndarray, value: np.ndarray | None = None) -> PumpRecord:
    return PumpRecord("run", T, pwm, np.zeros(len(T)) if value is None else value)


def _step(at_s: float = 0.1, level: float = 255.0) -> np.ndarray:
    return np.where(at_s - 1e-9 <= T, level, 0.0)


def test_the_lag_is_the_exponential_that_it_should_be() -> None:
    theta = np.array([0.05, 30.0, 0.6, FREE])
    told = simulate_pump(LAG, theta, _record(_step()), start_s=-1.0)
    expected = 30.0 * -np.expm1(-np.maximum(T - 0.15, 0.0) / 0.6)
    assert np.allclose(told, expected, atol=2e-3)


def test_the_flow_in_follows_the_law_of_the_orifice() -> None:
    """Without hose and leak the fall of g - p is the emptying of `Orifice` with the same coefficients."""
    a, b, level = 0.3, 0.01, 30.0
    told = simulate_pump(ORIFICE, np.array([0.0, level, a, b, FREE, 0.0, 1.0]), _record(_step(0.0)))
    law, drop, h = Orifice(a, b), level, 1e-4
    expected = []
    for k in range(len(T)):
        expected.append(level - drop)
        for _ in range(round(0.02 / h)):
            w = 2.0 * drop / (law.laminar_s + np.sqrt(law.laminar_s**2 + 4.0 * law.turbulent_s2_per_N * drop))
            drop -= h * w
        assert k >= 0
    assert np.allclose(told, expected, atol=0.02)


PATH = Path("rig.yaml")
U = np.arange(100.0, 256.0, 5.0)


def _table(record: PumpRecord, unit: str = "kPa") -> PumpTable:
    return PumpTable(unit, record, (), ())


@pytest.fixture(scope="module")
def found() -> PumpFound:
    settled = Settled("static", U, 25.0 * Shape(90.0, 40.0).of(U) + 0.05 * np.sin(7.0 * U))
    tables = [_table(r) for r in pump_records(LAG, LAG_TRUTH, 3)]
    return identify_pump([*tables, PumpTable("kPa", None, (settled,), ())])


def test_a_pump_that_is_a_lag_is_found_to_be_one(found: PumpFound) -> None:
    section = pump_section(found, Rig())
    assert section.lag_s == pytest.approx(0.5, rel=0.02)
    assert section.delay_ticks == 4
    assert section.identified is not None
    assert section.identified.better == LAG
    # The recordings' own map is a line through zero, and the data say so.
    assert found.fits[LAG].shape == Shape()
    static = section.identified.static["static"]
    assert static.dead_pwm == pytest.approx(90.0, abs=4.0)
    assert set(section.identified.models) == {LAG, ORIFICE}


def test_a_lag_that_a_file_gives_without_deviations_has_none() -> None:
    model = PumpModel(parameters={"lag_s": 0.5, "dead_time_s": 0.06}, sigma={}, fitted_rms=0.1)
    values, sigma = of_lag(model, 0.015)
    assert values == {"lag_s": 0.5, "delay_ticks": 4}
    assert sigma == {"lag_s": None, "delay_ticks": None}
    without = model.model_copy(update={"parameters": {"lag_s": 0.5}})
    with pytest.raises(ValidationError, match="linear lag lack one of lag_s and dead_time_s"):
        PumpIdentified(unit="kPa", models={LAG: without})


@pytest.mark.slow
def test_a_vacuum_pump_is_a_pump_that_counts_downward(found: PumpFound) -> None:
    tables = [_table(replace(r, value=-r.value)) for r in pump_records(LAG, LAG_TRUTH, 3)]
    drawn = identify_pump([*tables, PumpTable("kPa", None, (Settled("static", U, -25.0 * U / 255.0),), ())])
    assert drawn.fits[LAG].values == pytest.approx(found.fits[LAG].values, rel=1e-6)
    assert any("vacuum" in said for said in drawn.said)


def test_what_the_pwm_does_not_explain_makes_it_poor(found: PumpFound) -> None:
    t = 0.04 * np.arange(125)
    pwm = np.where(t > 0.03, 255.0, 0.0)
    y = 25.0 * -np.expm1(-np.maximum(t - 0.1, 0.0) / 0.5)
    runs = [PumpRecord(f"run{k}", t, pwm, y + 0.02 * np.sin(40.0 * t + k)) for k in range(2)]
    runs.append(PumpRecord("odd", t, pwm, y + 6.0 * np.clip(t - 2.0, 0.0, 1.0)))
    odd = identify_pump([_table(r) for r in runs])
    said = [one.text for one in unexplained(odd)]
    assert "settle apart: 2 at 25.0 kPa" in said[0]
    assert "odd leaves the model" in said[1]
    assert "while the PWM stood still" in said[1]
    verdict = judge_pump(odd)
    assert verdict.word == "poor" and any("look for a leak" in one for one in verdict.advice)
    assert odd.main_group is not None
    assert odd.held_rms(LAG, odd.main_group.files) < odd.held_rms(LAG)


def test_what_is_no_fault_of_a_run_is_none() -> None:
    """A sensor that is slower than the log, and runs that have not settled at full PWM."""
    t = 0.02 * np.arange(200)
    y = 30.0 * -np.expm1(-np.maximum(t - 0.04, 0.0) / 0.35)
    slow = PumpRecord("slow", t, np.full(200, 255.0), y[5 * (np.arange(200) // 5)])
    assert jumps([slow]) == ()
    assert len(jumps([replace(slow, value=np.where(t < 0.1, 0.0, 8.0 + 0.5 * y))])) == 1
    late = replace(slow, pwm=np.where(t < 3.3, 0.0, 255.0), value=np.where(t < 3.3, 0.0, 20.0 * (t - 3.3)))
    less = replace(slow, pwm=np.full(200, 220.0), value=220.0 / 255.0 * y)
    full = replace(slow, value=y)
    assert [group.files for group in settled_groups([full, late, less])] == [["slow"]]


def test_the_lag_of_runs_that_end_on_their_way_is_poor_where_it_is_no_lag(found: PumpFound) -> None:
    full = tuple(replace(r, pwm=np.full_like(r.pwm, 255.0)) for r in found.records)
    flow = {LAG: found.held[ORIFICE], ORIFICE: found.held[LAG]}
    for one, told in (
        (replace(found, records=full, held=flow), True),
        (replace(found, records=full), False),
        (replace(found, held=flow), False),
    ):
        assert any("the runs end at" in text for text in judge_pump(one).reasons) == told


def test_tables_kept_out_and_the_lag_that_is_written_are_judged(found: PumpFound) -> None:
    off = {LAG: [replace(found.held[LAG][0], name="other", rms=4.0)], ORIFICE: []}
    assert (
        "on other, kept out, the linear lag is off by 4.00 kPa"
        in judge_pump(replace(found, asked=off)).reasons[0]
    )
    flow = {LAG: [replace(one, rms=4.0) for one in found.held[LAG]], ORIFICE: found.held[ORIFICE]}
    assert any("so that lag and delay" in text for text in judge_pump(replace(found, held=flow)).reasons)
    # None but for a hundredth of the lag is a dead time as good as any.
    lag = found.fits[LAG]
    none = replace(lag, theta=lag.theta * [0.0, 1.0, 1.0, 1.0], sigma={**lag.sigma, "dead_time_s": 0.005})
    assert judge_pump(replace(found, fits={**found.fits, LAG: none})).word == "ok"


def test_a_run_may_settle_where_a_model_that_is_as_good_does(found: PumpFound) -> None:
    held = [replace(one, rms=0.05, settles=0.1) for one in found.held[LAG]]
    flow = found.fits[ORIFICE]
    other = replace(flow, theta=np.array([0.06, 18.0, 0.0, 0.1, FREE, 0.0, 1.0]))
    one = replace(found, fits={**found.fits, ORIFICE: other}, between=dict.fromkeys(MODELS, 0.1))
    for rms, least, most in ((0.055, 6.5, 7.5), (0.07, 0.0, 1.0)):
        told = replace(one, held={LAG: held, ORIFICE: [replace(h, rms=rms) for h in held]}).settles(LAG)
        assert told is not None
        assert told[0] == pytest.approx(25.0, abs=0.2) and least < told[1] < most


def _write(path: Path, head: str, rows: np.ndarray) -> Path:
    lines = [",".join("" if c != c else f"{c:.6g}" for c in row) for row in rows.tolist()]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


def _rows(n: int = 100) -> np.ndarray:
    t = 0.02 * np.arange(n)
    return np.stack([t, np.where(t > 0.1, 255.0, 0.0), 30.0 * -np.expm1(-t)], axis=1)


@pytest.mark.parametrize(
    ("head", "unit"),
    [
        ("Time,PWM,Pressure", "kPa"),
        ("t_s,pwm,pressure_kPa", "kPa"),
        ("Timestamp_s,PWM_Main,Feedback_kPa", "kPa"),
        ("t_s,pwm1,force_N", "N"),
        ("t_s,pwm1,chamber", "kPa"),
    ],
)
def test_columns_are_recognised(tmp_path: Path, head: str, unit: str) -> None:
    table = read_pump_table(_write(tmp_path / "a.csv", head, _rows()), value=head.rpartition(",")[2])
    assert table.unit == unit
    assert table.record is not None
    assert np.allclose(table.record.value, _rows()[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        ([1.0, 1.0 / 255.0, 1.0], "PWM is 1 at most, expected 0 to 255; .*by 255"),
        ([1.0, 1.0 / 2.55, 1.0], "PWM is 100 at most and not whole, as a percentage"),
        ([1.0, 1.0, 0.01], "Pressure is 0.2586 at most, expected 1 to 2000 kPa; of another unit"),
        ([1.0, 1.0, 1e3], r"Pressure is 2.586e\+04 at most, expected 1 to 2000 kPa; of another unit"),
        ([0.0, 0.0, 101.3], "Pressure is 101.3 kPa with the pump off, as one that counts from vacuum"),
    ],
)
def test_columns_in_other_units_are_refused(tmp_path: Path, scale: list[float], sentence: str) -> None:
    rows = _rows()
    rows[20, 1] = 120.0
    rows = rows * scale if scale[0] else rows + scale
    with pytest.raises(BadInputError, match=rf"a\.csv: {sentence}"):
        read_pump_table(_write(tmp_path / "a.csv", "t_s,pwm,Pressure", rows))


@pytest.mark.parametrize(
    ("time", "pwm", "value", "sentence"),
    [
        ("time_ms", "pwm", "force", "time_ms is in ms by its name, expected seconds"),
        ("t", "Duty (%)", "force", r"Duty \(%\) is in % by its name, expected 0 to 255"),
        ("t", "pwm", "chamber_psi", "chamber_psi is in psi by its name, expected kPa or N"),
    ],
)
def test_columns_named_after_other_units_are_refused(
    tmp_path: Path, time: str, pwm: str, value: str, sentence: str
) -> None:
    path = _write(tmp_path / "a.csv", f"{time},{pwm},{value}", _rows())
    with pytest.raises(BadInputError, match=rf"a\.csv: {sentence}"):
        read_pump_table(path, time, pwm, value)


@pytest.mark.parametrize("step", [0.0, 0.01, 0.2])
def test_a_sensor_at_the_end_of_its_range_is_told_from_a_chamber_that_is_full(step: float) -> None:
    t = 0.02 * np.arange(400)
    y = 30.0 * -np.expm1(-t / 0.6)
    y = np.round(y / step) * step if step else y
    held = np.repeat(y[::10], 10)
    whole = [PumpRecord("whole", t, np.full(400, 255.0), one) for one in (y, held, np.round(y, 3))]
    assert [ceiling(one) for one in whole] == [None] * 3
    quick = [30.0 * -np.expm1(-t / lag_s) for lag_s in (0.01, 0.02, 0.04)]
    assert [ceiling(replace(whole[0], value=np.round(one, 2))) for one in quick] == [None] * 3
    top, at_s = ceiling(replace(whole[0], value=np.minimum(y, 20.2))) or (0.0, 0.0)
    assert top == 20.2 and at_s == pytest.approx(0.67, abs=0.02)


def test_real_tables(shared_data: Path) -> None:
    folder = outside(shared_data / "softbot")
    for path in sorted(folder.glob("sweep_*.csv")):
        record = read_pump_table(path).record
        assert record is not None
        assert record.pwm.max() == 255.0
    parts = read_pump_table(next(folder.glob("calibration_raw*.csv"))).settled
    assert [len(s.pwm) for s in parts] == [30, 30]
