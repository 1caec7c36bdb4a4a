"""Feed-forward, and the length along the third-order set-point."""

from __future__ import annotations

import numpy as np
import pytest

from thesis.drawn import Drawn, Plot
from thesis.drawn_lengths import (
    against_model,
    difference,
    errors,
    length_run,
    profile,
    three_controllers,
    unlike_rig,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_the_profile_has_its_jump_slope_and_limit() -> None:
    made = _plot(profile)
    line = made.curve("(4.6)")
    assert np.all(line.y[line.x < 67.0 - 1e-6] == 0.0) and line.y.max() == 255.0
    rising = (line.x > 67.1) & (line.x < 93.0)
    assert np.polyfit(line.x[rising], line.y[rising], 1)[0] == pytest.approx(5.4981)
    assert made.numbers["at_91mm_pwm"] == pytest.approx(242.0, abs=0.1)


def test_feed_forward_is_needed_to_get_there() -> None:
    numbers = _plot(three_controllers).numbers
    assert numbers["pdff_end_mm"] == pytest.approx(90.0, abs=0.5)
    assert numbers["pd_end_mm"] < 80.0
    assert numbers["rms_pd_ff_mm"] < numbers["rms_pid_mm"] < numbers["rms_pd_mm"]
    assert 1.0 < numbers["pid_moves_s"] < 2.2


def test_errors_are_of_the_printed_size() -> None:
    made = _plot(errors)
    assert made.numbers["largest_true_mm"] == pytest.approx(2.149, rel=0.1)
    assert made.numbers["static_q1_mm"] < made.numbers["static_q2_mm"] < 0.3
    assert unlike_rig().pump_strength[0] > unlike_rig().pump_strength[1]


def test_the_printed_damping_rings_and_the_nominal_one_does_not() -> None:
    made = _plot(against_model)
    assert made.numbers["swings_back_mm"] > 1.0

    def turns(label: str) -> int:
        early = made.curve(label).y[:60]
        return int(np.sum(np.diff(np.sign(np.diff(early))) != 0))

    assert turns("printed damping") > 6 > 3 > turns("nominal model")
    assert length_run("pd+ff", start_m=0.0681).states[0, 0] == pytest.approx(0.0681)


def test_model_and_run_agree_once_the_start_is_over() -> None:
    made = _plot(difference)
    curve = made.curves[0]
    assert abs(made.numbers["late_mm"]) < 0.2
    assert np.abs(curve.y[curve.x > 1.0]).max() < 0.6 < made.numbers["largest_mm"]
