"""The fused filter: accuracy and honesty on simulated rigs, and everything that can be wrong with a log."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from estimatorlogs import SCENARIOS, rows_from, setup_for, simulated, truth

from calib.arrays import FloatArray
from calib.estimator.bank import get
from calib.estimator.consistency import Tally
from calib.estimator.filter import Filter, starting_state
from calib.estimator.kernel import CAMERA, TRACE
from calib.estimator.sensors import SIZE
from calib.estimator.setup import FLAGS, OUT, Rows, Setup
from calib.estimator.smoother import banked, events_of, forward

TARGET_MM = {"static": 0.08, "swing": 0.22, "ellipse": 0.19, "step": 0.22, "elongation": 0.18}
TARGET_DEG = {"swing": 0.06}


def nominal(name: str = "ellipse") -> tuple[Setup, Rows, FloatArray]:
    rig, log = simulated(name)
    return setup_for(rig), rows_from(log), truth(log)


def part(rows: Rows, keep: FloatArray | slice) -> Rows:
    return Rows(rows.t_s[keep], rows.readings[keep].copy(), rows.kinds[keep].copy())


def flag(out: FloatArray, name: str) -> FloatArray:
    return (out[:, OUT.index("flags")].astype(int) & FLAGS[name]) > 0


def sane(out: FloatArray) -> None:
    """Estimates are numbers, within reason, and their deviations bounded or flagged."""
    assert np.isfinite(out[:, :13]).all()
    assert (out[:, 10:13] > 0.0).all()
    assert np.abs(out[:, 5]).max() < 3.2
    told = ~flag(out, "held_by_prior")
    assert out[told, 10:12].max(initial=0.0) < 0.06 and out[told, 12].max(initial=0.0) < 1.5
    assert out[:, 10:13].max() < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_errors_and_their_covariance_on_varied_rigs(name: str) -> None:
    errors, angles, ratio = [], [], []
    for seed in range(4):
        rig, log = simulated(name, seed)
        setup = setup_for(rig, seed)
        tally = Tally(setup.bellows_radius_m)
        tally.add(Filter(setup).run(rows_from(log)), truth(log))
        figures = tally.rmse()
        errors.append(figures["mean_q_mm"])
        angles.append(figures["phi_deg"])
        ratio.append(figures["nees"])
    assert np.mean(errors) < TARGET_MM[name]
    assert np.mean(angles) < TARGET_DEG.get(name, 0.04)
    assert 0.7 < np.mean(ratio) < 4.5


def test_blocks_make_no_difference() -> None:
    setup, rows, _ = nominal("swing")
    whole = Filter(setup).run(rows)
    parts = Filter(setup)
    cuts = [0, 1, 17, 300, 301, len(rows)]
    pieces = [part(rows, slice(a, b)) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(np.concatenate(list(parts.stream(pieces))), whole)


def test_output_rests_on_the_past_alone() -> None:
    setup, rows, _ = nominal("swing")
    whole, head = Filter(setup).run(rows), Filter(setup).run(part(rows, slice(0, 400)))
    np.testing.assert_array_equal(head, whole[:400])


def test_late_pictures_end_in_the_state_of_the_right_order() -> None:
    rig, log = simulated("swing", 3)
    setup = setup_for(rig, 3)
    rows = rows_from(log)
    late = Filter(setup)
    out = late.run(rows)
    events = events_of(setup, rows, outputs=False)
    # The filter has begun with its first event and has gated what it has gated.
    x, P, w = starting_state(setup, rows)
    levels, walk = setup.process.arrays()
    weights, gated = np.empty((len(events.t_s), len(levels))), np.zeros((len(events.t_s), 3))
    bank, turned = banked(x, P, w)
    forward(
        events.t_s, float(events.t_s[0]), events.kinds, events.readings, bank, turned,
        setup.process.switch_hz, levels[None], walk, setup.view, np.array([9.81, 0.0]), setup.noise, False,
        gated, weights,
        np.empty((0, 3, TRACE)), np.empty((0, SIZE)), np.empty((0, SIZE, SIZE)),
    )  # fmt: skip
    assert np.nansum(out[:, OUT.index("gated_camera")]) == gated[events.kinds == CAMERA, 0].sum()
    got_x, got_P, got_w = late.state
    deviation = np.sqrt(np.diagonal(got_P[0]))
    ordered_x, _ = get(bank, 0, len(levels))
    np.testing.assert_allclose((got_w @ got_x - turned[0, :-1] @ ordered_x) / deviation, 0.0, atol=0.02)


def test_a_blackout_is_survived_and_its_uncertainty_told() -> None:
    setup, rows, true = nominal()
    dark = (rows.t_s > 8.0) & (rows.t_s < 8.4)
    rows.readings[dark, :2] = np.nan
    out = Filter(setup).run(rows)
    sane(out)
    assert out[dark, 10].max() > 1.3 * np.median(out[~dark, 10])
    assert np.abs(out[dark, 1] - true[dark, 0]).max() < 5.0 * out[dark, 10].max()
    after = rows.t_s > 9.0
    assert 1e3 * np.sqrt(np.mean((out[after, 1] - true[after, 0]) ** 2)) < 0.3


def test_camera_alone_works_and_says_so() -> None:
    setup, rows, true = nominal()
    rows.readings[:, 2:] = np.nan
    out = Filter(setup).run(part(rows, rows.kinds == 1))
    sane(out)
    assert flag(out, "imu_silent")[-1] and not flag(out, "imu_silent")[0]
    error = 1e3 * (out[out[:, 0] > 2.0, 1] - true[rows.kinds == 1][out[:, 0] > 2.0, 0])
    assert np.sqrt(np.mean(error**2)) < 1.2


def test_imu_alone_works_is_bounded_and_says_so() -> None:
    setup, rows, true = nominal()
    rows.readings[:, :2] = np.nan
    out = Filter(setup).run(part(rows, rows.kinds == 2))
    sane(out)
    assert flag(out, "camera_silent")[-1]
    late = out[:, 0] > 2.0
    error = np.degrees(out[late, 5] - true[rows.kinds == 2][late, 2])
    assert np.sqrt(np.mean(error**2)) < 1.0


def test_no_sensor_at_all_is_the_prior() -> None:
    setup, rows, _ = nominal()
    rows.readings[:] = np.nan
    out = Filter(setup).run(rows)
    sane(out)
    assert flag(out, "not_started").all()


def test_outliers_are_gated() -> None:
    setup, rows, true = nominal("static")
    rng = np.random.default_rng(5)
    hit = (rng.uniform(size=len(rows)) < 0.05) & np.isfinite(rows.readings[:, 0]) & (rows.t_s > 0.5)
    angle = rng.uniform(0.0, 2.0 * np.pi, int(hit.sum()))
    away = np.rint(rng.uniform(5.0, 20.0, len(angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))
    rows.readings[hit, :2] += away
    out = Filter(setup).run(rows)
    sane(out)
    gated = out[hit, OUT.index("gated_camera")] == 1.0
    assert gated.mean() > 0.97
    late = out[:, 0] > 2.0
    assert 1e3 * np.sqrt(np.mean((out[late, 1] - true[late, 0]) ** 2)) < 0.12


def test_a_log_of_outliers_alone_restarts_and_tells_that_it_knows_nothing() -> None:
    gated = []
    for seed in range(3):
        setup, rows, _ = nominal("static")
        seen = np.isfinite(rows.readings[:, 0])
        rng = np.random.default_rng(seed)
        rows.readings[seen, 0] = np.rint(rng.uniform(20.0, 300.0, int(seen.sum())))
        rows.readings[seen, 1] = np.rint(rng.uniform(20.0, 200.0, int(seen.sum())))
        out = Filter(setup).run(rows)
        sane(out)
        assert flag(out, "restarted").any()
        # The prior of the length has a deviation of 15 mm.
        assert np.median(out[:, 10]) > 0.015
        gated.append(np.nanmean(out[:, OUT.index("gated_camera")]))
    assert np.mean(gated) > 0.15


def test_a_head_that_has_moved_unseen_is_found_again_within_a_second() -> None:
    setup, rows, true = nominal("static")
    moved = rows.t_s > 7.0
    rows.readings[moved, 0] += 25.0
    rows.readings[moved, 1] += 25.0
    out = Filter(setup).run(rows)
    sane(out)
    when = rows.t_s[flag(out, "restarted")]
    assert len(when) and 7.4 < when[0] < 8.0
    assert abs(out[-1, 6] - true[-1, :2].mean()) > 0.01


@pytest.mark.parametrize("jump", [3600.0, -5.0, 1e9])
def test_jumps_of_the_time_start_the_filter_again(jump: float) -> None:
    setup, rows, true = nominal()
    t = rows.t_s.copy()
    t[len(t) // 2 :] += jump
    out = Filter(setup).run(replace(rows, t_s=t))
    sane(out)
    assert flag(out, "time_jump").sum() == 1
    assert 1e3 * np.abs(out[-300:, 1] - true[-300:, 0]).mean() < 0.4


def test_time_running_backwards_all_the_way_is_survived() -> None:
    setup, rows, _ = nominal()
    out = Filter(setup).run(replace(rows, t_s=rows.t_s[::-1].copy()))
    sane(out)


def test_small_disorder_and_repeated_rows_do_little() -> None:
    setup, rows, true = nominal()
    order = np.argsort(rows.t_s + np.random.default_rng(1).uniform(0.0, 0.012, len(rows)), kind="stable")
    out = Filter(setup).run(Rows(rows.t_s[order], rows.readings[order], rows.kinds[order]))
    sane(out)
    late = out[:, 0] > 2.0
    assert 1e3 * np.sqrt(np.mean((out[late, 1] - true[order][late, 0]) ** 2)) < 0.35
    twice = np.sort(np.concatenate([np.arange(len(rows)), np.arange(100, len(rows), 50)]))
    out = Filter(setup).run(Rows(rows.t_s[twice], rows.readings[twice], rows.kinds[twice]))
    sane(out)
    late = out[:, 0] > 2.0
    assert 1e3 * np.sqrt(np.mean((out[late, 1] - true[twice][late, 0]) ** 2)) < 0.35


def test_a_marker_outside_of_the_picture_is_gated() -> None:
    setup, rows, _ = nominal("static")
    seen = np.nonzero(np.isfinite(rows.readings[:, 0]))[0][60::40]
    rows.readings[seen, :2] = [-4000.0, 1e7]
    out = Filter(setup).run(rows)
    sane(out)
    assert (out[seen, OUT.index("gated_camera")] == 1.0).all()


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_log_shorter_than_the_latency_gives_the_prior_and_what_it_has(count: int) -> None:
    setup, rows, _ = nominal()
    out = Filter(setup).run(part(rows, slice(0, count)))
    assert len(out) == count
    sane(out)


def test_readings_far_beyond_any_sensor_do_no_harm() -> None:
    setup, rows, _ = nominal("static")
    rows.readings[500:520, 2:] = 1e12
    rows.readings[900:905, 4] = -1e300
    rows.readings[1200:1203, :2] = 1e300
    sane(Filter(setup).run(rows))


def test_one_row_may_hold_both_sensors() -> None:
    setup, rows, true = nominal()
    ticks = np.nonzero(rows.kinds == 1)[0]
    samples = np.nonzero(rows.kinds == 2)[0]
    nearest = samples[np.clip(np.searchsorted(rows.t_s[samples], rows.t_s[ticks]), 0, len(samples) - 1)]
    readings = rows.readings[ticks].copy()
    readings[:, 2:] = rows.readings[nearest, 2:]
    both = Rows(rows.t_s[ticks], readings, np.full(len(ticks), 3))
    out = Filter(replace(setup, imu_period_s=1.0 / 60.0)).run(both)
    sane(out)
    late = out[:, 0] > 2.0
    assert 1e3 * np.sqrt(np.mean((out[late, 1] - true[ticks][late, 0]) ** 2)) < 0.6
