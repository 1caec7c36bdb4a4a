"""The plane of gains against the facts of single pairs."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu.frontier import damped, frontier, gain_grid
from calib.imu.gains import Noise, gain_facts, predicted_sigma, riccati
from calib.imu.mahony import Mahony

NOISE = Noise(2e-3, 1e-3, 2e-3)


def test_every_pair_is_what_gain_facts_says() -> None:
    f = frontier(NOISE, 0.002, 5, 5)
    for k in range(len(f.Kp)):
        pair = Mahony(float(f.Kp[k]), float(f.Ki[k]))
        facts = gain_facts(pair, 0.002)
        assert facts.damping == pytest.approx(f.damping[k])
        assert f.noise_gain[k] == pytest.approx(facts.noise_gain, rel=1e-6)
        assert f.bias_peak_s[k] == pytest.approx(facts.bias_peak_s, rel=0.05)
        assert f.sigma_rad[k] == pytest.approx(predicted_sigma(pair, NOISE, 0.002), rel=1e-6)
        if f.Kp[k] < 5.0:
            assert f.lag_s[k] == pytest.approx(facts.lag_s, rel=0.05, abs=0.004)


def test_none_beats_the_best_and_riccati_has_the_least_error() -> None:
    f = frontier(NOISE, 0.01, 31, 31)
    assert f.best.any()
    for k in np.flatnonzero(f.best):
        better = (f.noise_gain < f.noise_gain[k]) & (f.settling_s < f.settling_s[k])
        assert not better.any()
    least = predicted_sigma(riccati(NOISE, 0.01), NOISE, 0.01)
    assert f.sigma_rad.min() == pytest.approx(least, rel=0.02)


def test_grid() -> None:
    K, Z = gain_grid(0.01)
    assert (len(K), len(Z)) == (25, 17)
    assert K[-1] == pytest.approx(20.0)
    assert gain_grid(0.1)[0][-1] == pytest.approx(5.0)
    assert damped(2.0, 0.5) == Mahony(2.0, 4.0)
    with pytest.raises(BadInputError, match="step"):
        gain_grid(0.0)
