"""Facts of gains against the filter itself, and the Riccati equation's gains against all others."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import freqz

from calib.errors import BadInputError
from calib.imu.gains import Noise, equivalent_noise, gain_facts, predicted_sigma, riccati
from calib.imu.mahony import Mahony, MahonyState
from calib.imu.mahony_batch import filter_log

DT = 0.01
NOISE = Noise(math.radians(0.1), 1e-3, math.radians(0.1))


def _run(gains: Mahony, acc: np.ndarray, w: np.ndarray, start: float = 0.0) -> np.ndarray:
    # The step of the first sample is zero: it is put before the log.
    t = DT * np.arange(len(acc) + 1)
    zero = np.zeros(1)
    return filter_log(gains, t, np.concatenate([zero, acc]), np.concatenate([zero, w]), MahonyState(start))[
        0
    ][1:]


@pytest.mark.parametrize(("Kp", "Ki"), [(3.0, 3.0), (0.5, 0.02), (8.0, 40.0), (1.0, 0.0)])
def test_facts_are_those_of_the_filter(Kp: float, Ki: float) -> None:
    gains = Mahony(Kp, Ki)
    facts = gain_facts(gains, DT)
    n = 60_000
    zero, one = np.zeros(n), np.full(n, 1e-3)
    impulse = zero.copy()
    impulse[0] = 1e-3
    h = _run(gains, impulse, zero) / 1e-3
    assert facts.noise_gain == pytest.approx(float(h @ h), rel=1e-6)
    f, H = freqz(h, worN=[facts.bandwidth_hz], fs=1.0 / DT)
    assert abs(H[0]) == pytest.approx(math.sqrt(0.5), abs=0.002)
    biased = _run(gains, zero, one) / 1e-3
    assert facts.bias_gain_s == pytest.approx(biased[-1], abs=1e-6)
    assert facts.bias_peak_s == pytest.approx(np.abs(biased).max(), rel=1e-3)
    start = _run(gains, zero, zero, 0.1) / 0.1
    outside = np.flatnonzero(np.abs(start) > 0.02)[-1] + 1
    assert facts.settling_s == pytest.approx(DT * outside, abs=2.5 * DT)
    followed = _run(gains, one, zero) / 1e-3
    assert facts.lag_s == pytest.approx(DT * np.flatnonzero(followed >= 0.5)[0], abs=1.5 * DT)
    assert facts.stable or Ki == 0.0
    assert f[0] == pytest.approx(facts.bandwidth_hz)


def test_three_three_has_the_poles_of_the_source() -> None:
    facts = gain_facts(Mahony(3.0, 3.0), 1e-4)
    poles = np.log(np.array(facts.poles)) / 1e-4
    assert np.allclose(np.sort_complex(poles), [-1.5 - 0.866j, -1.5 + 0.866j], atol=1e-3)
    assert facts.damping == pytest.approx(math.sqrt(3.0) / 2.0)


def test_no_other_gains_leave_less_than_riccatis() -> None:
    best = riccati(NOISE, DT)
    least = predicted_sigma(best, NOISE, DT)
    for a in (0.85, 1.0, 1.15):
        for b in (0.8, 1.0, 1.25):
            # (2.3) takes the angle in one sample later than the Kalman filter's prediction does.
            assert predicted_sigma(Mahony(a * best.Kp, b * best.Ki), NOISE, DT) >= least * (1.0 - 1e-3)
    assert predicted_sigma(Mahony(2.0 * best.Kp, best.Ki), NOISE, DT) > 1.03 * least


def test_predicted_noise_is_met() -> None:
    rng = np.random.default_rng(3)
    n, gains = 400_000, Mahony(1.5, 0.6)
    v = NOISE.accel / math.sqrt(DT) * rng.normal(size=n)
    bias = NOISE.walk * math.sqrt(DT) * np.cumsum(rng.normal(size=n))
    w = bias + NOISE.gyro / math.sqrt(DT) * rng.normal(size=n)
    found = _run(gains, v, w)[5000:].std()
    assert found == pytest.approx(predicted_sigma(gains, NOISE, DT), rel=0.03)


def test_continuous_formulas_and_their_inverse() -> None:
    r, K, N = NOISE.accel, NOISE.walk, NOISE.gyro
    gains = riccati(NOISE, 1e-5)
    assert gains.Ki == pytest.approx(K / r, rel=1e-3)
    assert gains.Kp == pytest.approx(math.sqrt((N / r) ** 2 + 2.0 * K / r), rel=1e-3)
    again = equivalent_noise(gains, r)
    assert (again.gyro, again.walk) == (pytest.approx(N, rel=5e-3), pytest.approx(K, rel=1e-3))
    without = riccati(Noise(N, 0.0, r), 1e-5)
    assert (without.Kp, without.Ki) == (pytest.approx(N / r, rel=1e-3), 0.0)


def test_what_cannot_be() -> None:
    with pytest.raises(BadInputError, match="density gyro"):
        Noise(0.0, 1e-4, 1e-2)
    with pytest.raises(BadInputError, match="density walk"):
        Noise(1e-4, -1.0, 1e-2)
    with pytest.raises(BadInputError, match="not stable"):
        gain_facts(Mahony(250.0, 3.0), DT)
    with pytest.raises(BadInputError, match="step"):
        gain_facts(Mahony(), 0.0)
    assert predicted_sigma(Mahony(300.0, 0.0), NOISE, DT) == math.inf
