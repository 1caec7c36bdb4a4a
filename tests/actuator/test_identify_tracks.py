"""Simulated heads at a log's times against finer integration, and delays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identifytrials import track

from calib.actuator.batch import simulate_batch
from calib.actuator.identify_parameters import Nominal, made
from calib.actuator.identify_tracks import COMPONENTS, Start, Track, heads_of
from calib.actuator.integrate import state_row
from calib.actuator.pump import TICK_S
from calib.errors import BadInputError


@pytest.mark.parametrize("kind", ["free", "prbs"])
def test_interpolated_heads_agree_with_fine_steps(kind: str) -> None:
    one = track(kind, noise=0.0)
    start = Start(0.5 if kind == "free" else 0.0, 0.065)
    head, rate = heads_of(one, Nominal(), [{}], [start], 0.025)
    # The track's own values lie on straight lines between steps of 1.7 ms.
    assert np.abs(head[0] - one.head).max() < 3e-4
    later, _ = heads_of(one, Nominal(), [{}], [start], 0.026)
    moved = (head - later) / 1e-3
    inner = (one.t_s > 0.1) & (one.t_s < one.t_s[-1] - 0.1)
    assert np.abs(moved - rate)[0, inner].max() < 0.05 * np.abs(rate).max()


def test_sets_of_a_batch_are_those_that_go_alone() -> None:
    one = track("prbs", noise=0.0, duration_s=1.0)
    sets = [{}, {"stiffness_scale": 1.3}, {"lag_s": 0.4}]
    starts = [Start(0.0, 0.065), Start(0.1, 0.066), Start(0.0, 0.065)]
    together, _ = heads_of(one, Nominal(), sets, starts, 0.0)
    for k in range(3):
        alone, _ = heads_of(one, Nominal(), [sets[k]], [starts[k]], 0.0)
        assert np.allclose(together[k], alone[0], atol=1e-9)


def test_before_the_first_tick_the_rig_rests() -> None:
    one = track("free", noise=0.0, duration_s=1.0)
    head, rate = heads_of(one, Nominal(), [{}], [Start(0.5, 0.065)], 0.1)
    assert np.allclose(head[0, one.t_s < 0.1], [0.5, 0.065])
    assert np.allclose(rate[0, one.t_s < 0.1], 0.0)


def test_arrays_that_do_not_match_are_refused() -> None:
    one = track("free", duration_s=1.0)
    with pytest.raises(BadInputError, match="do not match"):
        replace(one, head=one.head[:-1])
    with pytest.raises(BadInputError, match="no rows"):
        Track("x", 0.1, one.pwm, False, one.t_s[:0], one.head[:0], one.whitening[:0])
    assert one.start.phi_rad == pytest.approx(0.5, abs=0.02)


def test_a_start_in_motion_continues_a_longer_run() -> None:
    one = track("prbs", duration_s=4.0, noise=0.0)
    nominal = Nominal()
    plant, pump = made(nominal, {}, True, TICK_S)
    tick = 110
    states, _ = simulate_batch([plant], [pump], one.pwm, state_row(plant), 12, 1)
    row = states[0, tick - 1]
    r = plant.bellows_radius_m
    begin = Start(
        float(row[0] - row[1]) / (2.0 * r),
        0.5 * float(row[0] + row[1]),
        float(row[2] - row[3]) / (2.0 * r),
        0.5 * float(row[2] + row[3]),
        *row[4:6].tolist(),
        *row[8:10].tolist(),
        *row[6:8].tolist(),
    )
    assert np.allclose(begin.row(plant), row, atol=1e-12)
    late = one.t_s >= (tick + 3) * TICK_S
    rows = {"head": one.head[late], "whitening": one.whitening[late]}
    rest = Start(0.0, plant.rest_length_m)
    whole, _ = heads_of(replace(one, t_s=one.t_s[late], **rows), nominal, [{}], [rest], 0.0, 1)
    cut = replace(one, pwm=one.pwm[tick:], t_s=one.t_s[late] - tick * TICK_S, moving=begin, **rows)
    late_run, _ = heads_of(cut, nominal, [{}], [begin], 0.0, 1)
    # The commands that were on their way are like the first one here.
    assert np.abs(whole - late_run).max() < 1e-9
    assert cut.unknown == COMPONENTS and one.unknown == ("phi_rad", "length_m")
