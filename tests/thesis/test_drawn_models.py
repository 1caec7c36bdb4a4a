"""Curves of series, energies and springs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from thesis.drawn import Drawn, Plot
from thesis.drawn_models import (
    hanging_weights,
    inverse_error,
    inverse_function,
    kinetic_energies,
    series_error,
    series_norm,
    share_of_rotation,
    stiffness_curves,
    weighed,
)


def _plot(figure: Drawn) -> Plot:
    made = figure.make()
    assert isinstance(made, Plot)
    return made


def test_each_further_term_of_the_series_is_better_everywhere() -> None:
    curves = _plot(series_error).curves
    for worse, better in pairwise(curves):
        assert np.all(better.y[20:] < worse.y[20:])
    # The first power that is left out decides: order 3 leaves x^5.
    slope = np.polyfit(np.log(curves[1].x[10:40]), np.log(curves[1].y[10:40]), 1)[0]
    assert slope == pytest.approx(5.0, abs=0.05)
    assert _plot(series_error).numbers["order_7_mm"] < 2e-3


def test_the_norm_falls_with_the_order() -> None:
    made = _plot(series_norm)
    rms = made.curve("RMS").y
    assert np.all(rms[1:] < 0.1 * rms[:-1])
    assert np.all(made.curve("largest").y > rms)


def test_f_is_even_and_its_series_comes_nearer() -> None:
    made = _plot(inverse_function)
    exact = made.curve("exact").y
    assert exact == pytest.approx(exact[::-1])
    assert made.numbers == pytest.approx({"at_0": 2.0, "at_pi": np.pi})
    off = [float(np.abs(made.curve(f"order {n}").y - exact).max()) for n in (0, 2, 4, 6)]
    assert off == sorted(off, reverse=True) and off[-1] < 0.05
    errors = _plot(inverse_error)
    assert errors.numbers["at_half_pi"] == pytest.approx(6.49e-5, abs=1e-7)
    assert all(np.all(np.diff(curve.y[30:]) > 0.0) for curve in errors.curves[:-1])


def test_energies_pulse_twice_a_period_and_decay() -> None:
    made = _plot(kinetic_energies)
    moving, turning = made.curve("moving"), made.curve("turning")
    peaks = np.flatnonzero((moving.y[1:-1] > moving.y[:-2]) & (moving.y[1:-1] >= moving.y[2:])) + 1
    spacing = np.diff(moving.x[peaks[:8]])
    assert spacing == pytest.approx(np.full(7, 0.5 / 4.04), rel=0.08)
    assert np.all(np.diff(moving.y[peaks[:6]]) < 0.0)
    assert 0.6 < float(turning.y.sum() / moving.y.sum()) < 0.8
    share = _plot(share_of_rotation)
    assert share.numbers["share_straight"] == pytest.approx(0.420, abs=1e-3)
    assert abs(share.numbers["share"] - 0.2) > 0.15


def test_weights_give_the_springs_back() -> None:
    eps, force, fits = weighed()
    assert force[0] == 0.0 and np.all(np.diff(force) > 0.0) and eps.max() < 0.03
    second = fits[1]
    truth = np.array([2 * 47.7, 2 * 1092.9])
    assert np.all(np.abs(second.coefficients - truth) < 3.0 * second.sigma)
    line = _plot(hanging_weights)
    assert line.numbers["left_out_1_N"] > 2.0 * line.numbers["left_out_2_N"]
    curves = _plot(stiffness_curves)
    assert np.ptp(curves.curve("linear").y) == 0.0
    assert np.all(np.diff(curves.curve("second order").y) > 0.0)
