"""Simulated heads at a log's times against finer integration, and delays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identifytrials import track

from calib.actuator.identify_parameters import Nominal
from calib.actuator.identify_tracks import Start, Track, heads_of
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
