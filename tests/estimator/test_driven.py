"""The driven estimator: accuracy, causality, Jacobians, handing over to the kinematic one, tuning."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from drivenlogs import driven_log, held_log, hostile, unsound, varied_drive
from estimatorlogs import SCENARIOS, rows_from, setup_for, simulated, truth
from identifytrials import rig_file

from calib.core.arrays import BoolArray, FloatArray
from calib.core.rig import Rig
from calib.io.logs import write_log
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.parameters import pumps_connected
from calib.stages.actuator.pump import Orifice, Pump, RateLimit, pump_coefficients
from calib.stages.actuator.simulate import derivative, run
from calib.stages.estimator import driven as driven_smoother
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.driven import (
    CAMERA,
    CARRY,
    DRIVEN,
    DYNAMIC,
    FLOW,
    IMU,
    INVOLVED,
    PARAMETER,
    TRACE,
    WORK,
    Drive,
    DrivenFilter,
    Handover,
    Model,
    Switches,
    accelerations,
    blended,
    carry,
    driven_event,
    jacobian,
    longest_step_s,
    measure,
    new_handover,
    pass_on,
    smooth_both,
    smooth_driven,
    weigh,
)
from calib.stages.estimator.kinematic import OUT, Filter, Rows, Setup
from calib.stages.estimator.noise import WALKS, log_likelihood, scaled, tune_driven
from calib.stages.estimator.read import drive_from_rig, periods
from calib.stages.estimator.smoother import smooth
from calib.stages.estimator.tuning import tuned_section
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log

TARGET_MM = {"static": 0.04, "swing": 0.11, "ellipse": 0.05, "step": 0.06, "elongation": 0.07}
"""Means over the seeds below; an alignment as in `estimatorlogs.SIGMA` alone leaves 0.03 mm."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGET_MM)
def test_it_reaches_its_accuracy_on_rigs_that_differ(name: str) -> None:
    figures = []
    for seed in range(21, 29):
        rig, log = driven_log(name, seed)
        setup = setup_for(rig, seed)
        tally = Tally(setup.bellows_radius_m)
        tally.add(DrivenFilter(setup, Drive()).run(rows_from(log)), truth(log))
        found = tally.rmse()
        figures.append((found["mean_q_mm"], found["phi_deg"], found["nees"]))
    mm, degrees, nees = np.mean(figures, axis=0)
    assert mm < TARGET_MM[name]
    assert degrees < 0.06
    assert 0.8 < nees < 3.0


def test_parameters_move_towards_the_truth() -> None:
    rig, log = driven_log("ellipse", 3)
    driven = DrivenFilter(setup_for(rig, 3), Drive())
    driven.run(rows_from(log))
    x, P = driven.state
    sigma = np.sqrt(np.diag(P))
    # The lag and the falling rate stand alone; stiffness and strength only show in their ratio.
    assert x[17] == pytest.approx(rig.pump.lag_s / 0.7 - 1.0, abs=4.0 * sigma[17])
    law = rig.pump.deflation
    assert isinstance(law, RateLimit)
    assert sigma[17] < 0.02 and sigma[18] < 0.02
    ratio = (1.0 + x[18]) / (1.0 + x[12])
    assert ratio == pytest.approx(law.falling_N_per_s / 0.4 / rig.plant.stiffness_scale, abs=0.03)


@pytest.mark.parametrize("late_s", [0.0048, 0.02])
def test_readings_of_an_imu_that_come_late_are_put_at_their_moments(late_s: float) -> None:
    """As of a low-pass of 47 Hz: where it is not stated the angle is that of so much before."""
    rig, log = driven_log("swing", 3)
    rows, true = rows_from(log), truth(log)[:, 2]
    stamps = np.where(rows.kinds == 2, rows.t_s + late_s, rows.t_s)
    order = np.argsort(stamps, kind="stable")
    late = replace(rows, t_s=stamps)[order]
    phi = np.interp(late.t_s, rows.t_s, true)
    setup = replace(setup_for(rig, 3), imu_delay_s=late_s)

    def off_deg(out: FloatArray) -> float:
        some = (late.t_s > 0.5) & (late.t_s < late.t_s[-1] - 0.1)
        return float(np.degrees(np.std(out[some, OUT.index("phi_rad")] - phi[some])))

    filtered, driven = Filter(setup).run(late), DrivenFilter(setup, Drive()).run(late)
    told = [off_deg(out) for out in (filtered, driven, smooth(setup, late, filtered))]
    untold = off_deg(Filter(replace(setup, imu_delay_s=0.0)).run(late))
    assert max(told) < 0.15 * untold


def test_blocks_make_no_difference_and_the_future_has_no_say() -> None:
    rig, log = driven_log("elongation", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    whole = DrivenFilter(setup, Drive()).run(rows)
    blocks = DrivenFilter(setup, Drive())
    cut = [0, 1, 300, 301, 900, len(rows)]
    parts = [blocks.run(rows[a:b]) for a, b in pairwise(cut)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    head = DrivenFilter(setup, Drive()).run(rows[:700])
    np.testing.assert_array_equal(head, whole[:700])
    _, P = blocks.state
    np.testing.assert_array_equal(P, P.T)
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 0.0


def test_a_head_that_is_held_and_let_go_is_found_again() -> None:
    """The motion of the first half does not follow from any command: the filter starts again."""
    rig, log = driven_log("swing", 2)
    rows, setup = rows_from(log), setup_for(rig, 2)
    readings, t_s = np.tile([np.nan, np.nan, 9.0, 4.9, 0.0], (200, 1)), np.arange(200) * 0.01 - 2.01
    held = Rows(t_s, readings, np.full(200, 2), pwm=np.full((200, 2), np.nan))
    out = DrivenFilter(setup, Drive()).run(Rows.joined([held, rows]))[200:]
    late = log.t_s > 2.0
    error = 1e3 * (out[late, 1] - truth(log)[late, 0])
    assert np.sqrt(np.mean(error**2)) < 0.3


def _rms_deg(out: FloatArray, true: FloatArray, some: BoolArray) -> float:
    return float(np.degrees(np.sqrt(np.mean((out[some, 5] - true[some, 2]) ** 2))))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_head_that_is_let_go_is_followed_from_there(seed: int) -> None:
    """The gyroscope moves most where the model has nothing that moves it."""
    rig, rows, true = held_log(seed, 3.0)
    setup = setup_for(rig, seed)
    filtered = DrivenFilter(setup, Drive()).run(rows)
    smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
    held, first = (rows.t_s > 1.0) & (rows.t_s < 3.0), (rows.t_s > 3.03) & (rows.t_s < 4.0)
    for out in (filtered, smoothed):
        assert _rms_deg(out, true, held) < 0.15
        assert _rms_deg(out, true, first) < 0.25
        assert _rms_deg(out, true, rows.t_s > 4.0) < 0.05
    # A tenth of a second: the jerk is felt by the place of the IMU across the head, too, which is uncertain.
    assert np.nansum(filtered[first, OUT.index("gated_gyro")]) < 10.0
    assert not (filtered[rows.t_s > 1.0, OUT.index("flags")].astype(int) & 1).any()


def test_two_wrong_samples_of_the_gyroscope_are_no_hand() -> None:
    rig, log = driven_log("ellipse", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    readings = rows.readings.copy()
    wrong = np.nonzero((rows.kinds == 2) & (rows.t_s > 5.0))[0][:2]
    readings[wrong, 2:] += np.array([[3.0, -2.0, 4.0], [-2.0, 4.0, 3.0]])
    plain = DrivenFilter(setup, Drive()).run(rows)
    out = DrivenFilter(setup, Drive()).run(replace(rows, readings=readings))
    assert (out[wrong, OUT.index("gated_gyro")] == 1.0).all()
    np.testing.assert_allclose(out[:, 1:3], plain[:, 1:3], atol=5e-5)
    np.testing.assert_allclose(out[:, 5], plain[:, 5], atol=2e-3)


def test_the_transition_over_a_release_is_that_of_the_whole_step() -> None:
    switches = Switches(np.array([-np.inf]), np.array([[1.5, 0.2, 0.0, 0.0]]))
    x, x0, P0 = some_state(2), np.zeros(len(DRIVEN)), np.diag(np.full(len(DRIVEN), 1e-4))
    model = Drive().model(setup_for(varied_drive(1)))
    model = model._replace(x0=x0, P0=P0, walk=np.zeros(len(DRIVEN) + 1))
    x[10:12] = 0.3, -0.2

    def passed(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        y, P, F = x.copy(), P0.copy(), np.zeros((DYNAMIC, INVOLVED))
        pass_on(y, P, 0.0, 0.01, 0.004, model, switches, 0, F, np.zeros(WORK))
        return y, P, F

    y, P, F = passed(x)
    assert (y[10:12] == 0.0).all() and (P == P.T).all()
    for k in range(INVOLVED):
        h = 1e-6 if k in (1, 19) else 1e-4
        up, down = x.copy(), x.copy()
        up[k] += h
        down[k] -= h
        slope = (passed(up)[0] - passed(down)[0])[:DYNAMIC] / (2.0 * h)
        assert (np.abs(F[:, k] - slope) < 1e-3 * np.abs(F).max(axis=1) + 1e-9).all()


def test_a_start_at_an_outlier_does_not_lock_it_out() -> None:
    rig, log = driven_log("ellipse", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    readings = rows.readings.copy()
    first = np.nonzero((rows.kinds == 1) & (rows.t_s > 0.05))[0][:3]
    readings[first, :2] += 15.0
    out = DrivenFilter(setup, Drive()).run(replace(rows, readings=readings))
    late = rows.t_s > 2.0
    assert np.sqrt(np.mean((out[late, 1] - truth(log)[late, 0]) ** 2)) < 2e-4


@pytest.mark.parametrize("what", ["nan", "jump", "outliers", "backwards", "no_commands"])
def test_no_input_makes_it_say_nan(what: str) -> None:
    rig, log = driven_log("step", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    readings, t = rows.readings.copy(), rows.t_s.copy()
    rng = np.random.default_rng(1)
    if what == "nan":
        readings[rng.random(len(rows)) < 0.5] = np.nan
    elif what == "jump":
        t[800:] += 3600.0
    elif what == "outliers":
        readings[:, :2] += rng.uniform(-80.0, 80.0, (len(rows), 2))
    elif what == "backwards":
        t[800:] = t[:800][-1] - np.arange(len(t) - 800) * 0.01
    else:
        rows.pwm[:] = np.nan
    out = DrivenFilter(setup, Drive()).run(replace(rows, readings=readings, t_s=t))
    assert np.isfinite(out[:, :13]).all()
    assert (out[:, 10:13] > 0.0).all()
    if what in ("jump", "backwards"):
        assert (out[:, OUT.index("flags")].astype(int) & 48).any()


def test_a_head_at_rest_teaches_nothing_of_what_multiplies_its_motion() -> None:
    for seed in (4, 5):
        rig = varied_drive(seed)
        log = run_log(run_scenario(make_scenario("static"), rig, seed, "sensors", 60.0))
        setup = setup_for(rig, seed)
        driven = DrivenFilter(setup, Drive())
        begin, _ = Drive().start(setup)
        out = driven.run(rows_from(log))
        x, _ = driven.state
        away = np.abs(x - begin)[DYNAMIC:INVOLVED] / np.array(Drive().sigma)
        assert np.delete(away, PARAMETER.index("rest_length_m")).max() < 0.1
        late = log.t_s > 2.0
        assert np.sqrt(np.mean((out[late, 1:3] - truth(log)[late, :2]) ** 2)) < 1e-4


@pytest.mark.parametrize("name", ["step", "elongation"])
def test_a_plant_far_from_the_truth_gives_no_rates_that_no_rig_has(name: str) -> None:
    rig, log = driven_log(name, 3)
    drive = Drive(plant=replace(pumps_connected(), damping_scale=60.0))
    out = DrivenFilter(setup_for(rig, 3), drive).run(rows_from(log))
    assert np.nanmax(np.abs(out[:, 3:5])) < 1.0


def test_commands_carry_it_through_four_seconds_without_readings() -> None:
    rig, log = driven_log("step", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    readings = rows.readings.copy()
    silent = (log.t_s > 4.0) & (log.t_s < 8.0)
    readings[silent] = np.nan
    out = DrivenFilter(setup, Drive()).run(replace(rows, readings=readings))
    assert np.abs(out[silent, 1] - truth(log)[silent, 0]).max() < 3e-4


WEIGHT = OUT.index("driven_weight")


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["ellipse", "step"])
def test_commands_that_are_missing_cost_little_and_are_paid_for(name: str) -> None:
    """One in twenty is not in the log: held until the next, they cost 0.19 mm at a NEES of 12 to 20."""
    figures = []
    for seed in (1, 2, 3):
        rig, log = driven_log(name, seed)
        rows = rows_from(log)
        rows.pwm[np.random.default_rng(seed).random(len(rows)) < 0.05] = np.nan
        setup = setup_for(rig, seed)
        assert periods(log).command_s == pytest.approx(setup.command_period_s, rel=0.02)
        filtered = DrivenFilter(setup, Drive()).run(rows)
        for out in (filtered, smooth_driven(setup, Drive(), rows, filtered)):
            tally = Tally(setup.bellows_radius_m)
            tally.add(out, truth(log))
            figures.append((tally.rmse()["mean_q_mm"], 0.5 * tally.rmse()["nees"]))
    mm, nees = np.mean(np.reshape(figures, (3, 2, 2)), axis=0).T
    assert mm[0] < 0.09 and mm[1] < 0.07
    assert (nees < 2.0).all()


def test_the_right_model_speaks_throughout() -> None:
    for name in ("ellipse", "elongation"):
        rig, log = driven_log(name, 21)
        out = Handover(setup_for(rig, 21), Drive()).run(rows_from(log))
        late = log.t_s > 2.0
        assert (out[late, WEIGHT] > 0.5).mean() > 0.9
        assert np.isfinite(out[:, :13]).all()


@pytest.mark.slow
def test_another_law_of_deflation_does_little_harm() -> None:
    """Never worse than the kinematic target, 0.20 mm for the step, by more than a fifth."""
    worst = []
    for seed in (21, 22, 23):
        rig, log = driven_log("step", seed, orifice=True)
        setup = setup_for(rig, seed)
        driven, kinematic, weight = Handover(setup, Drive()).run_each(rows_from(log))
        tally = Tally(setup.bellows_radius_m)
        tally.add(blended(driven, kinematic, weight), truth(log))
        worst.append(tally.rmse()["mean_q_mm"])
        assert weight[log.t_s > 6.0].min() < 0.1
    assert np.mean(worst) < 1.2 * 0.20


def test_smoothing_of_both_is_finite_and_better_than_the_filter() -> None:
    rig, log = driven_log("elongation", 22)
    setup, rows = setup_for(rig, 22), rows_from(log)
    driven, kinematic, weight = Handover(setup, Drive()).run_each(rows)
    smoothed = smooth_both(setup, Drive(), rows, driven, kinematic)
    assert np.isfinite(smoothed[:, :13]).all()
    before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
    before.add(blended(driven, kinematic, weight), truth(log))
    after.add(smoothed, truth(log))
    assert after.rmse()["mean_q_mm"] < before.rmse()["mean_q_mm"]


SMOOTHED_MM = {"static": 0.035, "swing": 0.05, "ellipse": 0.04, "step": 0.04, "elongation": 0.05}
"""Means over the seeds below, of which a marker known to 0.03 mm is the larger part."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTHED_MM)
def test_smoothing_reaches_its_accuracy_on_rigs_that_differ(name: str) -> None:
    figures = []
    for seed in range(21, 29):
        rig, log = driven_log(name, seed)
        setup, rows = setup_for(rig, seed), rows_from(log)
        driven, kinematic, _ = Handover(setup, Drive()).run_each(rows)
        tally = Tally(setup.bellows_radius_m)
        tally.add(smooth_both(setup, Drive(), rows, driven, kinematic), truth(log))
        found = tally.rmse()
        figures.append((found["mean_q_mm"], found["phi_deg"], found["nees"]))
    mm, degrees, nees = np.mean(figures, axis=0)
    assert mm < SMOOTHED_MM[name]
    assert degrees < 0.03
    assert 0.8 < nees < 3.2


def innovations(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = np.full((count, len(OUT)), np.nan)
    out[:, 0] = np.arange(count) / 60.0
    e = rng.standard_normal((count, 2))
    out[:, OUT.index("e_u")], out[:, OUT.index("e_v")] = e[:, 0], e[:, 1]
    out[:, OUT.index("nis_camera")] = (e**2).sum(axis=1)
    out[:, OUT.index("gated_camera")] = 0.0
    out[:, OUT.index("log_likelihood")] = -0.5 * (e**2).sum(axis=1)
    out[:, OUT.index("flags")] = 0.0
    return out


def test_a_bias_of_the_innovations_takes_the_word_away_and_it_comes_back() -> None:
    driven, other = innovations(1200, 1), innovations(1200, 1)
    other[:, OUT.index("log_likelihood")] -= 0.05
    biased = slice(400, 600)
    driven[biased, OUT.index("e_u")] += 1.5
    driven[biased, OUT.index("nis_camera")] += 2.25
    weight = np.empty(1200)
    weigh(driven, other, new_handover(), 0.0, weight)
    assert (weight[100:400] > 0.5).mean() > 0.9
    assert weight[450:600].max() < 0.01
    assert (weight[900:] > 0.5).mean() > 0.9
    halves, memory = np.empty(1200), new_handover()
    weigh(driven[:500], other[:500], memory, 0.0, halves[:500])
    weigh(driven[500:], other[500:], memory, 0.0, halves[500:])
    np.testing.assert_array_equal(halves, weight)


@pytest.mark.parametrize("right", ["driven", "kinematic"])
def test_a_filter_that_rejects_what_the_other_expects_loses_its_word(right: str) -> None:
    driven, other = innovations(120, 1), innovations(120, 1)
    lost = other if right == "driven" else driven
    lost[:, OUT.index("gated_camera")] = 1.0
    weight = np.empty(120)
    weigh(driven, other, new_handover(), 0.0, weight)
    assert abs(weight[-1] - (right == "driven")) < 1e-3


def some(seed: int = 0) -> tuple[FloatArray, FloatArray, Model]:
    """State, covariance, and what does not change."""
    setup, drive = setup_for(varied_drive(1)), Drive()
    x, P = drive.start(setup)
    rng = np.random.default_rng(seed)
    x[:4] = 0.3, 0.07, 2.0, 0.02
    x[4:12] = rng.uniform(0.0, 0.1, 8)
    P[:4, :4] = np.diag([1e-2, 1e-3, 1e-2, 1e-3]) ** 2
    return x, P, drive.model(setup)


@pytest.mark.parametrize("kind", [CAMERA, IMU])
def test_gradients_agree_with_differences(kind: int) -> None:
    x, P, model = some()
    n, count = len(DRIVEN), 2 if kind == CAMERA else 3
    H, spare, out, work = np.zeros((3, n)), np.zeros((3, n)), np.zeros(n), np.zeros(WORK)
    measure(kind, x, P, model, 0.0, H, out, work)
    for k in range(n):
        h = 1e-7 if DRIVEN[k].endswith("_m") else 1e-5
        above, below = np.zeros(n), np.zeros(n)
        for sign, to in ((1.0, above), (-1.0, below)):
            near = x.copy()
            near[k] += sign * h
            measure(kind, near, P, model, 0.0, spare, to, work)
        slope = (above[:count] - below[:count]) / (2.0 * h)
        np.testing.assert_allclose(H[:count, k], slope, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("kind", [CAMERA, IMU])
def test_what_is_considered_stays_and_the_rest_learns(kind: int) -> None:
    x, P, model = some()
    before_x, before_P = x.copy(), P.copy()
    n = len(DRIVEN)
    out, H, work, report, gated = np.zeros(n), np.zeros((3, n)), np.zeros(WORK), np.empty(12), np.zeros(4)
    measure(kind, x, P, model, 0.0, H, out, work)
    z = np.array([out[0] + 0.5, out[1] - 0.4, out[2] + 0.002, 0.0])
    driven_event(x, P, kind, z, model, work, False, report, gated, np.empty((0, TRACE)))
    held = [28, 29, 31, 32, 33]
    np.testing.assert_array_equal(x[held], before_x[held])
    np.testing.assert_array_equal(P[np.ix_(held, held)], before_P[np.ix_(held, held)])
    np.testing.assert_array_equal(P, P.T)
    assert np.all(np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))) > -1e-9)
    assert np.all(np.diag(P) <= np.diag(before_P) * (1.0 + 1e-12))
    told = 0 if kind == CAMERA else 2
    assert P[told, told] < 0.98 * before_P[told, told]
    assert gated[0 if kind == CAMERA else 2] == 0.0


PUMPS = (Pump(), Pump(deflation=Orifice(), lag_ratio=1.2))


def some_state(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    x = np.zeros(len(DRIVEN))
    x[0], x[1] = rng.uniform(-0.7, 0.7), rng.uniform(0.063, 0.09)
    x[2], x[3] = rng.normal(0.0, 2.0), rng.normal(0.0, 0.03)
    x[4:6] = rng.normal(0.0, 0.05, 2)
    # One bellows fills, the other empties: away from the corner between the two laws.
    x[6:10] = 0.5, 0.3, 0.5, 0.9
    x[10:12] = rng.normal(0.0, 0.02, 2)
    x[DYNAMIC:INVOLVED] = rng.normal(0.0, 0.05, len(PARAMETER))
    x[19] = 3e-4
    return x


def stepped(
    plant: FloatArray, x: FloatArray, segments: FloatArray, longest_s: float | None = None
) -> tuple[FloatArray, FloatArray]:
    out, F = np.empty(DYNAMIC), np.empty((DYNAMIC, INVOLVED))
    longest_s = longest_s or longest_step_s(plant, x)
    jacobian(plant, x, segments, len(segments), longest_s, out, F, np.empty(FLOW))
    return out, F


@pytest.mark.parametrize("pump", PUMPS)
def test_it_moves_as_the_simulation_does(pump: Pump) -> None:
    body = pumps_connected()
    x = some_state(1)
    x[10:INVOLVED] = 0.0
    r = body.bellows_radius_m
    l, phi, dl, dphi = x[1], x[0], x[3], x[2]  # noqa: E741  the source's symbols
    lengths = [l + r * phi, l - r * phi, dl + r * dphi, dl - r * dphi]
    row = np.array([*lengths, 0.5 * (x[4] + x[5]), 0.5 * (x[4] - x[5]), *x[6:10]])
    static = np.array([[1.5, 0.2], [1.0, 0.0]])
    exact = np.empty((2, 10))
    assert run(coefficients(body), pump_coefficients(pump), row, static, 0.01, 40, 40, exact) == -1
    got, _ = stepped(Drive(pump=pump).numbers(), x, np.array([[0.01, 1.5, 0.2], [0.01, 1.0, 0.0]]))
    q1, q2, dq1, dq2, z1, z2 = exact[1, :6]
    turned, spun = (q1 - q2) / (2.0 * r), (dq1 - dq2) / (2.0 * r)
    there = np.array([turned, 0.5 * (q1 + q2), spun, 0.5 * (dq1 + dq2), z1 + z2, z1 - z2])
    # A start far from any balance; steps of 3 ms follow it to a thousandth of the way.
    np.testing.assert_array_less(np.abs(got[:6] - there), 1e-3 * np.abs(there - x[:6]))
    np.testing.assert_allclose(got[6:10], exact[1, 6:10], atol=2e-5)


@pytest.mark.parametrize("log_damping", [-1.6, 0.0, 1.4, 2.0, 3.0])
def test_steps_are_as_exact_where_the_damping_is_stiff(log_damping: float) -> None:
    """An interval of 10 ms that follows 20 ms of fine steps, in which what is fast has settled."""
    plant, segments = Drive().numbers(), np.array([[0.01, 1.5, 0.2]])
    for seed in range(10):
        x = some_state(seed)
        x[13] = log_damping
        x[:DYNAMIC] = stepped(plant, x, segments * np.array([2.0, 1.0, 1.0]), 2e-5)[0]
        error = np.abs(stepped(plant, x, segments)[0] - stepped(plant, x, segments, 2e-5)[0])
        assert error[0] < 1e-5 and error[1] < 1e-6
        assert error[2] < 1e-3 and error[3] < 3e-4


@pytest.mark.parametrize("pump", PUMPS)
@pytest.mark.parametrize("seed", range(4))
def test_the_jacobian_agrees_with_central_differences(pump: Pump, seed: int) -> None:
    body = replace(pumps_connected(), gravity_mps2=(0.4 * (seed % 2), 9.81 * (seed % 2)))
    plant, x = Drive(body, pump=pump).numbers(), some_state(seed)
    segments = np.array([[0.004, 1.5, 0.2], [0.003, 1.2, 0.1]])
    F = stepped(plant, x, segments)[1]
    central = np.empty_like(F)
    for k in range(INVOLVED):
        h = 1e-6 if k != 1 and k != 19 else 1e-7
        above, below = x.copy(), x.copy()
        above[k] += h
        below[k] -= h
        central[:, k] = (stepped(plant, above, segments)[0] - stepped(plant, below, segments)[0]) / (2.0 * h)
    size = np.abs(central).max(axis=1, keepdims=True)
    assert np.all(np.abs(F - central) <= 1e-6 * size + 1e-9)


def test_accelerations_are_those_of_the_dynamics_with_their_gradients() -> None:
    body, drive = pumps_connected(), Drive()
    x = some_state(3)
    x[DYNAMIC:INVOLVED] = 0.0
    r = body.bellows_radius_m
    y = np.array(
        [x[1] + r * x[0], x[1] - r * x[0], x[3] + r * x[2], x[3] - r * x[2], 0.0, 0.0],
    )
    y[4], y[5] = 0.5 * (x[4] + x[5]), 0.5 * (x[4] - x[5])
    rate = derivative(coefficients(body), y, x[8] + x[10], x[9] + x[11])
    by_phi, by_length, room = np.empty(INVOLVED), np.empty(INVOLVED), np.empty(26)
    ddphi, ddl = accelerations(drive.numbers(), x, by_phi, by_length, room)
    assert ddphi == pytest.approx((rate[2] - rate[3]) / (2.0 * r), rel=1e-9)
    assert ddl == pytest.approx(0.5 * (rate[2] + rate[3]), rel=1e-9)
    spare = np.empty(INVOLVED)
    for k in range(INVOLVED):
        h = 1e-5 if k != 1 and k != 19 else 1e-7
        above, below = x.copy(), x.copy()
        above[k] += h
        below[k] -= h
        up, down = (accelerations(drive.numbers(), v, spare, spare.copy(), room) for v in (above, below))
        assert by_phi[k] == pytest.approx((up[0] - down[0]) / (2.0 * h), rel=2e-3, abs=1e-3)
        assert by_length[k] == pytest.approx((up[1] - down[1]) / (2.0 * h), rel=2e-3, abs=1e-3)


def test_the_covariance_is_carried_as_by_the_whole_matrix() -> None:
    rng = np.random.default_rng(5)
    n = len(DRIVEN)
    A = rng.standard_normal((n, n))
    P = A @ A.T
    F = rng.standard_normal((DYNAMIC, INVOLVED))
    F[:, 10:12] = 0.0
    noise = rng.uniform(0.1, 1.0, n)
    whole = np.eye(n)
    whole[:DYNAMIC, :DYNAMIC] = 0.0
    whole[:DYNAMIC, :INVOLVED] = F
    expected = whole @ P @ whole.T + 0.01 * np.diag(noise)
    carry(P, F, noise, 0.01, np.empty(CARRY))
    np.testing.assert_allclose(P, expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(P, P.T)


_ROWS = 600


def _short(name: str, seed: int) -> tuple[Setup, Rows]:
    rig, log = driven_log(name, seed)
    return setup_for(rig, seed), rows_from(log)[:_ROWS]


def test_a_walk_that_is_far_too_loud_is_mended_and_none_is_taken_for_nothing() -> None:
    setup, log = _short("step", 1)
    nominal = Drive()
    loud = scaled(nominal, "rates", 30.0)
    steps: list[int] = []
    found, factors = tune_driven(setup, loud, [log], lambda done, total: steps.append(total - done))
    assert log_likelihood(setup, [log], found) > log_likelihood(setup, [log], loud) + 10.0
    assert factors["rates"].value == 0.5
    assert all(factors[walk].value >= 0.5 for walk in WALKS)
    assert steps == [3, 2, 1]


def test_a_plant_that_is_pushed_about_asks_for_a_disturbance() -> None:
    """A command that the estimator is not told of is a force that nothing explains."""
    setup, rows = _short("step", 2)
    blind = np.where((rows.t_s > 2.0)[:, None], 0.99, 1.0) * rows.pwm
    _, told = tune_driven(setup, Drive(), [rows])
    _, fooled = tune_driven(setup, Drive(), [replace(rows, pwm=blind)])
    assert fooled["disturbance"].value > 2.0 * told["disturbance"].value


def test_what_was_identified_together_starts_together() -> None:
    sigma = np.array(Drive().sigma)
    told = 0.01 * np.outer(sigma, sigma) + 0.01 * np.diag(sigma**2)
    deviation = np.sqrt(np.diag(told))
    drive = Drive(sigma=tuple(deviation.tolist()), covariance=told)
    _, P = drive.start(setup_for(varied_drive(1)))
    at = DRIVEN.index("log_damping")
    others = [k for k in range(DYNAMIC, INVOLVED) if k != at]
    np.testing.assert_array_equal(
        P[np.ix_(others, others)], told[np.ix_(*[np.subtract(others, DYNAMIC)] * 2)]
    )
    # Of the damping nobody knows yet whether the hoses are on.
    assert P[at, at] > 100.0 * told[1, 1]
    assert np.all(np.linalg.eigvalsh(P) > 0.0)


def test_smoothed_angles_of_a_swing_are_as_sure_as_they_say_from_its_beginning() -> None:
    """The first times of a log are uncertain; taken as exact they belie the gyroscope in a fast swing."""
    squares = []
    for seed in (1, 2, 12, 22):
        rig, log = driven_log("swing", seed)
        setup, rows = setup_for(rig, seed), rows_from(log)
        filtered = DrivenFilter(setup, Drive()).run(rows)
        smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
        early = (rows.t_s > 0.2) & (rows.t_s < 1.0)
        z = (smoothed[early, 5] - truth(log)[early, 2]) / smoothed[early, 12]
        squares.append(np.mean(z**2))
    assert np.mean(squares) < 1.5


@pytest.mark.few(0)
@pytest.mark.parametrize("name", ["elongation", "step"])
def test_smoothing_lessens_the_error(name: str) -> None:
    figures = []
    for seed in (11, 12):
        rig, log = driven_log(name, seed)
        setup, rows = setup_for(rig, seed), rows_from(log)
        filtered = DrivenFilter(setup, Drive()).run(rows)
        smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
        known = np.isfinite(smoothed[:, 1])
        assert known[rows.t_s > 0.2].all()
        before, after = Tally(setup.bellows_radius_m), Tally(setup.bellows_radius_m)
        before.add(filtered, truth(log))
        after.add(smoothed, truth(log))
        late = rows.t_s > 2.0
        assert (smoothed[late, 10:13] <= 1.02 * filtered[late, 10:13]).mean() > 0.98
        figures.append((before.rmse()["mean_q_mm"], after.rmse()["mean_q_mm"], after.rmse()["nees"]))
    filtered_mm, smoothed_mm, nees = np.mean(figures, axis=0)
    assert smoothed_mm < 0.85 * filtered_mm
    assert nees < 8.0


def test_after_a_gap_the_forces_are_not_taken_as_none() -> None:
    rig, log = driven_log("elongation", 1)
    rows, setup = rows_from(log), setup_for(rig, 1)
    some = (log.t_s < 4.0) | (log.t_s > 7.0)
    rows, true = rows[some], truth(log)[some]
    filtered = DrivenFilter(setup, Drive()).run(rows)
    smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
    late = rows.t_s > 7.5
    assert np.abs(filtered[late, 1] - true[late, 0]).max() < 1e-3
    assert np.abs(smoothed[late, 1] - true[late, 0]).max() < 5e-4


@pytest.mark.parametrize("name", ["static", "swing", "step"])
def test_smoothing_stands_readings_that_are_thought_exact(name: str) -> None:
    """An IMU that is a hundred times as noisy as it is said to be."""
    rig, log = driven_log(name, 3)
    setup, rows = setup_for(rig, 3), rows_from(log)
    noise = setup.noise.copy()
    noise[2:5] = 1e-4
    setup = replace(setup, noise=noise)
    filtered = DrivenFilter(setup, Drive()).run(rows)
    smoothed = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
    known = np.isfinite(smoothed[:, 1])
    assert known[rows.t_s > 0.5].all()
    assert np.abs(smoothed[known, 1] - truth(log)[known, 0]).max() < 5e-3


def test_windows_make_little_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, log = driven_log("elongation", 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    filtered = DrivenFilter(setup, Drive()).run(rows)
    whole = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
    monkeypatch.setattr(driven_smoother, "WINDOW", 800)
    monkeypatch.setattr(driven_smoother, "OVERLAP", 1500)
    parts = driven_smoother.smooth_driven(setup, Drive(), rows, filtered)
    late = rows.t_s > 1.0
    difference = np.abs(whole - parts)[late, 1:3]
    assert (difference < 0.5 * whole[late, 10:12]).all()


_TOLD = ("stiffness_scale", "lambda2_N_per_m", "lag_s", "strength1", "strength2", "damping_scale_free_swing")


def _identified(sigma: tuple[float, ...], correlation: float, lag_sigma: float | None = None) -> Rig:
    """A rig whose values were identified together, all pairs with one correlation."""
    share = np.full((len(sigma), len(sigma)), correlation) + (1.0 - correlation) * np.eye(len(sigma))
    table = {"order": list(_TOLD), "values": (share * np.outer(sigma, sigma)).tolist()}
    k, c, lag, first, second, free = sigma
    return Rig.of(
        {
            "schema": 2,
            "actuator": {
                "verdict": "ok",
                "stiffness_scale": 1.1, "lambda2_N_per_m": 9.0, "damping_scale_free_swing": 3.0,
                "sigma": {"stiffness_scale": k, "lambda2_N_per_m": c, "damping_scale_free_swing": free},
                "covariance": table,
            },
            "pump": {
                "verdict": "ok", "lag_s": 0.7, "strength": [1.0, 0.97],
                "sigma": {"lag_s": lag if lag_sigma is None else lag_sigma, "strength": [first, second]},
            },
        },
        "rig.yaml",
    )  # fmt: skip


def test_what_was_identified_together_stays_together() -> None:
    drive = drive_from_rig(_identified((0.022, 0.36, 0.014, 0.02, 0.0194, 0.1), 0.98))
    assert drive.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(drive.covariance)), drive.sigma, rtol=1e-12)
    assert np.linalg.eigvalsh(drive.covariance).min() > 0.0
    k, c, s1, s2 = (PARAMETER.index(n) for n in ("stiffness", "creep_stiffness", "strength1", "strength2"))
    deviation = np.sqrt(np.diag(drive.covariance))
    # Shares of the values, and 0.3 % of each that it has for itself.
    assert deviation[[k, c, s1]] == pytest.approx(np.hypot([0.02, 0.04, 0.02], 0.003))
    assert drive.covariance[k, c] == pytest.approx(0.98 * 0.02 * 0.04)
    assert drive.covariance[s1, s2] == pytest.approx(0.98 * 0.02 * 0.02)
    # The scale of forces and springs is that of the mass, which was kept.
    assert drive.sigma[PARAMETER.index("mass")] == 0.01
    bending = PARAMETER.index("bending")
    assert np.count_nonzero(drive.covariance[bending]) == 1
    assert drive.sigma[bending] == Drive().sigma[bending]


def test_what_each_value_has_for_itself_is_a_share_of_it_and_no_length() -> None:
    told = {"stiffness_scale": 0.022, "rest_length_m": 3e-4}
    values = np.outer([*told.values()], [*told.values()]) * [[1.0, 0.3], [0.3, 1.0]]
    table = {"order": list(told), "values": values.tolist()}
    section = {"verdict": "ok", "stiffness_scale": 1.1, "rest_length_m": 0.0652}
    rig = Rig.of({"schema": 2, "actuator": {**section, "sigma": told, "covariance": table}}, "rig.yaml")
    assert drive_from_rig(rig).sigma[PARAMETER.index("rest_length_m")] == pytest.approx(3e-4)


def test_a_log_with_commands_tunes_the_driven_model_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calib.stages.estimator.tuning._MOST_ROWS", 400)
    _, log = simulated("ellipse", 1)
    first = np.arange(len(log)) < 400
    short = replace(log, t_s=log.t_s[first], columns={k: v[first] for k, v in log.columns.items()},
                    lines=log.lines[first])  # fmt: skip
    write_log(tmp_path / "told.csv", short)
    quiet = {k: v for k, v in short.columns.items() if not k.startswith("pwm")}
    write_log(tmp_path / "quiet.csv", replace(short, columns=quiet))
    path = tmp_path / "rig.yaml"
    rig = rig_file(path)
    found = tuned_section([tmp_path / "told.csv"], rig, path)
    assert found.driven is not None
    assert found.driven.walk_disturbance_N_per_sqrt_s > 0.0
    assert {"driven_disturbance", "driven_rates", "driven_forces"} <= set(found.sigma)
    assert tuned_section([tmp_path / "quiet.csv"], rig, path).driven is None


@pytest.mark.parametrize("seed", [*range(15), 130, 1300, 1500])
def test_hostile_logs_break_nothing(seed: int) -> None:
    """Of more logs, `python tests/bench/hostile.py`; the last three had smoothed rates of up to 13 m/s."""
    name = list(SCENARIOS)[seed % len(SCENARIOS)]
    rig, log = simulated(name, 1)
    setup, drive = setup_for(rig, 1), Drive()
    rows = hostile(seed, rows_from(log))
    driven, kinematic, weight = Handover(setup, drive).run_each(rows)
    for out in (driven, kinematic, blended(driven, kinematic, weight)):
        assert unsound(out) == ""
    assert unsound(smooth_both(setup, drive, rows, driven, kinematic)) == ""
