"""Jitter and motion from a log's spectrum, against jitter that was put in and against the simulated rig."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.lowpass.filters import (
    Design,
    dc_delay_s,
    design_lowpass,
    filter_signal,
    grid_step,
    jitter_after,
    motion_lost,
    noise_gain,
    on_ticks,
    quantisation_hz,
    spectrum,
)
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.sensors import marker_pixels
from calib.twin.simulate import log_of

FIRST = design_lowpass(Design()).sections
T = np.arange(3600) / 60.0


def test_white_jitter_is_measured_through_slow_motion_and_outliers() -> None:
    rng = np.random.default_rng(3)
    noise = 0.2 * rng.normal(size=3600)
    x = 40.0 * np.sin(2.0 * np.pi * 0.1 * T) + noise
    x[::700] += 15.0
    found = spectrum(x, 60.0)
    assert found.flat
    # The line stands 60 dB above the threshold; Hann's side lobes are below that from 7 bins of 1/8 Hz on,
    # and one bin goes to the smoothing.
    assert 0.1 <= found.motion_hz <= 0.1 + 8 / 8
    assert found.outliers >= 6
    assert found.jitter == pytest.approx(0.2, rel=0.15)
    expected = 0.2 * math.sqrt(noise_gain(FIRST))
    assert jitter_after(found, FIRST) == pytest.approx(expected, rel=0.15)
    assert filter_signal(FIRST, noise)[60:].std() == pytest.approx(expected, rel=0.15)


def test_coloured_jitter_above_the_motion_counts_as_it_is() -> None:
    rng = np.random.default_rng(4)
    hum = 0.1 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 20.0 * T)
    found = spectrum(0.02 * rng.normal(size=3600) + hum, 60.0)
    assert found.motion_hz == 0.0
    assert found.jitter == pytest.approx(math.hypot(0.02, 0.1), rel=0.2)
    # A filter at 1 Hz takes the hum out, and only white noise is left.
    assert jitter_after(found, FIRST) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ellipse", "orientation", "chirp"])
def test_the_simulated_rigs_jitter_is_found_in_motion(name: str) -> None:
    rig = SimulatedRig()
    run = run_scenario(make_scenario(name), rig, 1, "sensors", 30.0 if name == "ellipse" else None)
    log = log_of(run)
    rows = log.sampled("u_px", "v_px")
    seen = np.stack([log.columns["u_px"][rows], log.columns["v_px"][rows]], axis=1)
    q = run.trajectory.at(run.tracker.exposed_s)[:, :2]
    noise = run.pixels - marker_pixels(rig.view, rig.tracker, q, run.plant.bellows_radius_m)
    for axis in (0, 1):
        one = noise[:, axis][~np.isnan(noise[:, axis])]
        calm = np.where(np.abs(one) < 3.0, one, 0.0)
        found = spectrum(on_ticks(log.t_s[rows], seen, 60.0).longest.values[:, axis], 60.0)
        # Between the jitter without outliers and that with all of them; a floor of few segments to 15 %.
        low, high = (filter_signal(FIRST, value)[60:].std() for value in (calm, one))
        assert 0.85 * low < jitter_after(found, FIRST) < 1.15 * high


def test_motion_changed_is_what_the_delayed_motion_lacks() -> None:
    x = 10.0 * np.sin(2.0 * np.pi * 1.0 * T) + 0.01 * np.random.default_rng(5).normal(size=3600)
    delay = dc_delay_s(FIRST, 60.0)
    lost = motion_lost(spectrum(x, 60.0), FIRST, delay)
    late = 10.0 * np.sin(2.0 * np.pi * (T - delay))
    difference = (filter_signal(FIRST, x) - late)[300:]
    assert lost == pytest.approx(difference.std() / late.std(), rel=0.03)


def test_fast_motion_is_not_called_jitter_with_confidence() -> None:
    rng = np.random.default_rng(6)
    walk = np.cumsum(rng.normal(size=3600))
    assert not spectrum(walk, 60.0).flat
    assert spectrum(rng.normal(size=3600), 60.0).flat


def test_constant_and_short_signals() -> None:
    still = spectrum(np.full(200, 7.0), 60.0)
    assert (still.jitter, still.motion_hz, still.flat) == (0.0, 0.0, True)
    assert motion_lost(still, FIRST, 0.1) == 0.0
    assert spectrum(np.random.default_rng(0).normal(size=64), 60.0).jitter == pytest.approx(1.0, rel=0.4)
    with pytest.raises(BadInputError, match=r"has 63 camera ticks .* at least 64"):
        spectrum(np.zeros(63), 60.0)


def test_the_grid_and_the_frequency_of_crossing_it() -> None:
    ramp = 100.0 + 4.0 * T[:600]
    assert grid_step(np.round(ramp)) == 1.0
    assert grid_step(np.round(ramp * 4.0) / 4.0) == 0.25
    assert grid_step(ramp + np.random.default_rng(0).normal(size=600)) == 0.0
    assert grid_step(np.full(9, 3.0)) == 0.0
    quartiles = quantisation_hz(np.round(ramp), 1.0, 60.0)
    np.testing.assert_allclose(quartiles, 4.0, rtol=0.15)
    # 80 lines a second look like 20 at 60 samples a second.
    np.testing.assert_allclose(quantisation_hz(np.round(20.0 * ramp), 1.0, 60.0), 20.0, atol=1.0)
    assert np.isnan(quantisation_hz(np.full(600, 3.0), 1.0, 60.0)).all()
    assert np.isnan(quantisation_hz(ramp, 0.0, 60.0)).all()
