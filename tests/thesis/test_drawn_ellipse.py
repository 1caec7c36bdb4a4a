"""The ellipse: shape, phases, errors, and the recorded run as a reference."""

from __future__ import annotations

import numpy as np
import pytest

from thesis.drawn import Drawn, Plot
from thesis.drawn_ellipse import (
    bellows,
    ellipse_angle,
    ellipse_angle_error,
    ellipse_errors,
    ellipse_run,
    model_bellows,
    model_plane,
    phases,
    plane,
    recorded_bellows,
    recorded_errors,
    recorded_plane,
    recorded_run,
    seen_lengths,
    wanted_ellipse,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_the_reference_is_the_drawn_ellipse() -> None:
    reference = _plot(plane).curve("reference")
    x, y = reference.x, reference.y
    assert ((x / 15.0) ** 2 + ((y - 78.0) / 10.0) ** 2) == pytest.approx(np.ones(len(x)))
    numbers = _plot(bellows).numbers
    assert numbers["least_ref_mm"] == pytest.approx(67.0, abs=0.1)
    assert numbers["greatest_ref_mm"] == pytest.approx(89.3, abs=0.1)


def test_the_head_goes_round_once_and_stays_near() -> None:
    made = _plot(plane)
    head = made.curve("seen by the firmware")
    turned = np.unwrap(np.arctan2(head.x, 78.0 - head.y))[150:]
    assert abs(turned[-1] - turned[0]) == pytest.approx(2.0 * np.pi * 17.5 / 20.0, abs=0.5)
    assert 0.5 < made.numbers["rms_mm"] < 2.0


def test_the_four_phases_are_in_order_with_gaps_between_them() -> None:
    bands = phases(wanted_ellipse(), 1.0 / 60.0)
    assert [band.word for band in bands] == ["I", "II", "III", "IV"]
    edges = [edge for band in bands for edge in (band.begin, band.end)]
    assert edges == sorted(edges) and edges[0] > 0.0 and edges[-1] < 20.0
    made = _plot(ellipse_errors)
    assert made.bands == bands
    assert made.numbers["between_mm"] < 2.0 * made.numbers["inside_mm"]


def test_the_angle_turns_back_twice() -> None:
    made = _plot(ellipse_angle)
    wanted = made.curve("reference").y
    assert made.numbers["greatest_ref_rad"] == pytest.approx(2.0 * np.arctan(0.015 / 0.0772), abs=5e-3)
    assert wanted.max() == pytest.approx(-wanted.min(), rel=1e-6)
    error = _plot(ellipse_angle_error)
    assert error.numbers["turns"] == 2.0 and error.numbers["rms_rad"] < 0.04


def test_the_recorded_run_is_the_reference_of_the_second() -> None:
    made = _plot(recorded_plane)
    assert made.curve("reference").x == pytest.approx(_plot(plane).curve("seen by the firmware").x)
    assert _plot(recorded_bellows).curve("references").y == pytest.approx(
        1e3 * seen_lengths(ellipse_run())[:, 0]
    )
    assert not np.array_equal(recorded_run().pwm, ellipse_run().pwm)
    # The source sees the same profile of errors, larger; here it is larger by a little.
    first, again = _plot(ellipse_errors), _plot(recorded_errors)
    assert again.numbers["rms_q1_mm"] == pytest.approx(first.numbers["rms_q1_mm"], rel=0.3)
    smooth = [np.convolve(one.curves[0].y[120:], np.ones(30) / 30.0, mode="valid") for one in (first, again)]
    assert np.corrcoef(*smooth)[0, 1] > 0.9


def test_the_model_follows_the_run() -> None:
    assert _plot(model_plane).numbers["apart_mm"] < 1.0
    made = _plot(model_bellows)
    assert max(made.numbers.values()) < 0.6
    model = made.curve("bellows 2, model")
    assert 7.5 < model.x[np.argmax(model.y)] < 9.5
