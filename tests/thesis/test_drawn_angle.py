"""Control of the angle: steady values, peaks, outputs, overshoot."""

from __future__ import annotations

import numpy as np
import pytest

from calib.stages.control.laws import Pid
from thesis.drawn import Drawn, Plot
from thesis.drawn_angle import (
    GAINS,
    WANTED_RAD,
    against_model,
    angle_run,
    jump,
    jump_output,
    p_control,
    p_output,
    pid_control,
    pid_output,
    unsaturated,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_no_proportional_gain_reaches_the_reference_and_a_larger_one_comes_nearer() -> None:
    numbers = _plot(p_control).numbers
    peaks = [numbers[f"peak_{gain:g}_rad"] for gain in GAINS]
    assert peaks == sorted(peaks) and peaks[-1] < WANTED_RAD
    assert peaks == pytest.approx([0.375, 0.535, 0.630, 0.699], abs=0.02)


def test_unsaturated_outputs_are_what_was_sent_where_it_is_within_the_limits() -> None:
    run = angle_run("p", 2000.0)
    u = unsaturated(run, Pid(2000.0))
    inside = (u > 0.0) & (u < 255.0)
    assert inside.any() and np.abs(u - run.pwm)[inside].max() <= 0.5
    assert np.all(run.pwm[u >= 255.0] == 255.0) and np.all(run.pwm[u <= 0.0] == 0.0)


def test_all_gains_begin_alike_because_of_the_limit() -> None:
    made = _plot(p_output)
    first = made.numbers["free_500_s"]
    angles = [curve.y[curve.x < first] for curve in _plot(p_control).curves[:4]]
    assert all(np.array_equal(angles[0], other) for other in angles[1:])
    assert made.numbers["first_5000_pwm"] == pytest.approx(10.0 * made.numbers["first_500_pwm"])


def test_the_pid_reaches_overshoots_a_little_and_settles() -> None:
    made = _plot(pid_control)
    assert made.numbers["reach_s"] == pytest.approx(0.95, abs=0.1)
    assert 0.70 < made.numbers["peak_rad"] < 0.76 and 0.70 < made.numbers["true_peak_rad"] < 0.76
    assert made.numbers["true_settle_s"] == pytest.approx(2.3, abs=0.3)
    seen = made.curve("seen by the firmware")
    assert seen.y[seen.x > 3.0].mean() == pytest.approx(WANTED_RAD, abs=0.005)


def test_the_pids_output_leaves_the_limit_before_the_angle_arrives() -> None:
    made = _plot(pid_output)
    assert 0.5 < made.numbers["free_s"] < _plot(pid_control).numbers["reach_s"]
    one, other = made.curves[0].y, made.curves[1].y
    assert one == pytest.approx(-other)


def test_clamping_about_halves_the_overshoot_and_is_slower() -> None:
    numbers = _plot(jump).numbers
    assert 0.3 < numbers["clamping_overshoot_rad"] / numbers["pid_overshoot_rad"] < 0.7
    assert numbers["clamping_to_95_percent_s"] > 1.5 * numbers["pid_to_95_percent_s"]
    below = _plot(jump_output).numbers
    assert below["pid_below_s"] > 2.0 > 0.5 > below["clamping_below_s"]


def test_the_model_ends_where_the_run_does() -> None:
    made = _plot(against_model)
    assert [curve.kind for curve in made.curves] == ["line", "dashed"] * 5
    assert all(abs(v) < 0.01 for name, v in made.numbers.items() if name.startswith("off"))
    assert made.numbers["saturated"] < 0.3
