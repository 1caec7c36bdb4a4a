"""Tuned gains keep their margins, and stronger ones would not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from control_models import NOMINAL

from calib.control.margins import loop_margins
from calib.control.pid import Pid
from calib.control.reach import reachable
from calib.control.tuning import (
    Criterion,
    Tuned,
    holds,
    operating_angles,
    operating_lengths,
    orientation_loop,
    position_loop,
    tune_orientation,
    tune_position,
)
from calib.errors import BadInputError

CRITERION = Criterion()


@pytest.fixture(scope="module")
def orientation() -> Tuned:
    return tune_orientation(NOMINAL, CRITERION)


@pytest.fixture(scope="module")
def position() -> Tuned:
    return tune_position(NOMINAL, CRITERION)


def _at_least(tuned: Tuned) -> None:
    for point in tuned.points:
        m = point.margins
        assert m.stable
        # Gains are rounded to two digits.
        assert m.gain > 0.98 * CRITERION.gain
        assert m.phase_rad > 0.98 * CRITERION.phase_rad
        assert m.sensitivity < 1.02 * CRITERION.sensitivity


def test_every_operating_point_keeps_the_margins(orientation: Tuned, position: Tuned) -> None:
    assert len(orientation.points) == 4 and len(position.points) == 6
    _at_least(orientation)
    _at_least(position)


def test_the_limit_is_used(orientation: Tuned, position: Tuned) -> None:
    """Ten percent more of everything breaks the criterion at some point."""
    for tuned, make in ((orientation, orientation_loop), (position, position_loop)):
        pid = tuned.pid
        more = replace(pid, Kp=1.1 * pid.Kp, Ki=1.1 * pid.Ki, Kd=1.1 * pid.Kd)
        kept = [
            all(holds(CRITERION, m) for m in loop_margins(make(NOMINAL, more, point.q_m)))
            for point in tuned.points
        ]
        assert not all(kept)


def test_the_gains_have_the_order_of_the_source(orientation: Tuned, position: Tuned) -> None:
    assert 200.0 < orientation.pid.Kp < 1000.0 and orientation.pid.Ki > 500.0
    assert 1e4 < position.pid.Kp < 4e4 and position.pid.Ki == 0.0


def test_a_lower_demand_gives_stronger_gains(orientation: Tuned) -> None:
    easy = tune_orientation(NOMINAL, Criterion(1.5, math.radians(40.0), 2.5))
    assert easy.pid.Ki > orientation.pid.Ki


def test_operating_points_are_within_reach() -> None:
    for q in (*operating_angles(NOMINAL), *operating_lengths(NOMINAL)):
        assert bool(reachable(NOMINAL, q))


def test_a_demand_beyond_the_delay_is_refused() -> None:
    with pytest.raises(BadInputError, match="no gains reach a gain margin of 90"):
        tune_orientation(NOMINAL, Criterion(90.0, math.radians(89.9), 1.001), operating_angles(NOMINAL)[:1])


def test_unstable_loops_hold_nothing() -> None:
    loop = orientation_loop(NOMINAL, Pid(3000.0), operating_angles(NOMINAL)[1])
    assert not holds(Criterion(1.01, 0.01, 99.0), loop_margins(loop)[0])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((1.0, 0.7, 2.0), "gain margin: found 1"),
        ((2.0, 0.0, 2.0), "phase margin: found 0 deg"),
        ((2.0, 1.6, 2.0), "phase margin: found 91"),
        ((2.0, 0.7, 1.0), "sensitivity: found 1"),
        ((math.nan, 0.7, 2.0), "gain margin: found nan"),
    ],
)
def test_margins_that_cannot_be(words: tuple[float, float, float], sentence: str) -> None:
    with pytest.raises(BadInputError, match=sentence):
        Criterion(*words)
