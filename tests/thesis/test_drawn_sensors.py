"""Curves of the sensors and the steady elongation: slopes, sizes, times."""

from __future__ import annotations

import math

import numpy as np
import pytest

from thesis.drawn import Plot
from thesis.drawn_sensors import (
    VOLTS,
    elongation_steps,
    imu_in_motion,
    marker_low_passed,
    onchip,
    steady_elongation,
    steady_elongations,
)


def _plot(figure: object) -> Plot:
    made = figure.make()  # type: ignore[attr-defined]  # a Drawn
    assert isinstance(made, Plot)
    return made


def test_five_logs_drift_in_straight_lines() -> None:
    made = _plot(onchip)
    assert len(made.curves) == 5
    for curve in made.curves:
        line = np.polyfit(curve.x, curve.y, 1)
        assert 0.05 < line[0] < 0.3
        assert np.std(curve.y - np.polyval(line, curve.x)) < 0.05 * np.ptp(curve.y)


def test_the_gyroscope_drifts_and_the_filter_does_not() -> None:
    made = _plot(imu_in_motion)
    truth = made.curve("truth").y
    off = {name: made.curve(name).y - truth for name in ("accelerometer", "gyroscope, integrated", "filter")}
    assert np.std(off["filter"]) < 0.5 * np.std(off["accelerometer"])
    drift = off["gyroscope, integrated"]
    assert abs(drift[-1]) > 2.0 * abs(drift[len(drift) // 4])
    assert abs(off["filter"][-1]) < 0.03


def test_the_low_pass_is_late_by_its_delay_and_smooth() -> None:
    made = _plot(marker_low_passed)
    x, smooth = made.curve("from the camera").y, made.curve("after the low-pass").y
    assert made.numbers["delay_s"] == pytest.approx(1.0 / (2.0 * math.pi), abs=1e-3)
    assert made.numbers["fine_m"] < 0.1 * made.numbers["rough_m"]
    t = made.curves[0].x
    half = 0.5 * np.median(x[(t > 3.0) & (t < 5.0)])
    late = float(t[np.argmax(smooth > half)] - t[np.argmax(x > half)])
    assert 0.05 < late < 0.3


def test_the_steady_elongation_is_that_of_the_cubic() -> None:
    found, made = steady_elongations(), _plot(steady_elongation)
    assert found.shape == (len(VOLTS), 3)
    mean = found.mean(axis=1)
    assert abs(mean[0]) < 0.3 and np.all(np.diff(mean[1:]) > 0.0)
    assert mean[-1] == pytest.approx(26.56, abs=0.3)
    told = made.curve("(2.13) with 3.756 for 3.376")
    assert np.abs(np.interp(VOLTS[1:], told.x, told.y) - mean[1:]).max() < 0.4


def test_steps_rise_to_their_steady_lengths() -> None:
    made = _plot(elongation_steps)
    ends = [float(np.median(curve.y[-60:])) for curve in made.curves]
    assert ends == pytest.approx([1.9, 11.1, 21.7, 26.6], abs=0.6)
    assert all(0.5 < t < 1.0 for t in made.numbers.values())
    # A first-order rise: half of it is there before the lag is over.
    assert all(
        float(np.median(curve.y[54:60])) > 0.4 * end for curve, end in zip(made.curves, ends, strict=True)
    )
