"""Constant gains: the limit of the time-varying filter, stable, and better than what they replace."""

from __future__ import annotations

import numpy as np
import pytest
from estimatorlogs import rows_from, setup_for, simulated, truth

from calib.errors import BadInputError
from calib.estimator.baseline import Baseline, BaselineSetup, undistorting_nothing
from calib.estimator.constant_gain import AxisGain, TickNoise, design, run_gain, tick_noise, ticks_of
from calib.estimator.model import LEVELS, Level

NOISE = TickNoise(8e-3, 4e-4, 2e-3, 0.1)
PHI, LENGTH = LEVELS[3], LEVELS[1]


def simulated_axis(
    gain: AxisGain, level: Level, noise: TickNoise, delay: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """True lengths of a process of this level, and their readings one delay late."""
    rng, T, parts = np.random.default_rng(seed), 1.0 / 60.0, 20
    c, b, q, walk = level.numbers()[4:]
    p = v = a = 0.0
    true = []
    for _ in range(4000):
        for _ in range(parts):
            h = T / parts
            p += v * h + rng.normal() * np.sqrt(walk * h)
            v += (a - b * v) * h
            a += -c * a * h + rng.normal() * np.sqrt(q * h)
        true.append(p)
    values = np.array(true)
    old = np.concatenate([np.zeros(delay), values[: len(values) - delay]])
    return values, old + noise.camera_m * rng.standard_normal(len(values))


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_both_axes_are_stable(delay: int) -> None:
    for gain, own in zip(design(PHI, LENGTH, NOISE, 60.0, delay), (4, 3), strict=True):
        n, m = gain.K.shape
        assert n == own + max(delay, 1)
        assert gain.F.shape == (n, n) and gain.H.shape == (m, n)
        closed = gain.F - gain.K @ gain.H @ gain.F
        assert np.abs(np.linalg.eigvals(closed)).max() < 1.0


@pytest.mark.parametrize("delay", [0, 2])
def test_errors_are_as_large_as_the_gain_expects(delay: int) -> None:
    _, gain = design(PHI, LENGTH, NOISE, 60.0, delay)
    squares = []
    for seed in range(4):
        true, z = simulated_axis(gain, LENGTH, NOISE, delay, seed)
        out = run_gain(gain.F, gain.H, gain.K, z[:, None], 0.0)
        squares.append(np.mean((out[600:, 0] - true[600:]) ** 2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(gain.sigma[0], rel=0.2)


def test_a_delay_costs_accuracy_and_missing_readings_do_not_matter_much() -> None:
    sigmas = [design(PHI, LENGTH, NOISE, 60.0, delay)[1].sigma[0] for delay in (0, 1, 3, 8)]
    assert (np.diff(sigmas) > 0.0).all()
    _, gain = design(PHI, LENGTH, NOISE, 60.0, 1)
    z = np.full((200, 1), 0.07)
    z[50:60] = np.nan
    np.testing.assert_allclose(run_gain(gain.F, gain.H, gain.K, z, 0.07)[:, 0], 0.07, rtol=1e-12)


@pytest.mark.parametrize(("rate", "delay"), [(0.0, 1), (60.0, 9), (60.0, -1)])
def test_refuses_what_no_controller_has(rate: float, delay: int) -> None:
    with pytest.raises(BadInputError, match="expected"):
        design(PHI, LENGTH, NOISE, rate, delay)


@pytest.mark.parametrize("name", ["ellipse", "elongation", "swing"])
def test_beats_the_low_pass_on_a_log(name: str) -> None:
    rig, log = simulated(name, 1)
    setup, rows = setup_for(rig, 1), rows_from(log)
    ticks = ticks_of(setup, rows)
    delay = round(float(setup.start.sensor[7]) * 60.0)
    gains = design(PHI, LENGTH, tick_noise(setup, PHI, 60.0), 60.0, delay)
    phi, length = (
        run_gain(g.F, g.H, g.K, z, float(z[np.isfinite(z[:, 0]), 0][0]))[:, 0]
        for g, z in zip(gains, (ticks.phi, ticks.length), strict=True)
    )
    known = np.flatnonzero(rows.kinds & 1)
    late = ticks.t_s > 2.0
    true = truth(log)[known][late]
    r = setup.bellows_radius_m
    errors = np.stack([(length + r * phi)[late] - true[:, 0], (length - r * phi)[late] - true[:, 1]])
    place = undistorting_nothing(setup.view, (-0.06, 0.04, 0.06, 0.11), rig.view.camera.image_size_px)
    other = Baseline(BaselineSetup(place, r)).run(rows)[known][late]
    low_pass = np.stack([other[:, 1] - true[:, 0], other[:, 2] - true[:, 1]])
    assert np.sqrt(np.mean(errors**2)) < 0.7 * np.sqrt(np.mean(low_pass**2))
