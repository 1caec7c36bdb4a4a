"""Whether a log begins in motion: swings that are let go or cut out, and pumps that are on already."""

from __future__ import annotations

import numpy as np
import pytest
from identifytrials import SIGMA, track

from calib.actuator.identify_tracks import Track
from calib.actuator.parameters import Plant
from calib.identifystart import start_in_motion, swing_at_beginning

PLANT = Plant()


def _swing(rate: float, noise: float, seed: int, w: float = 25.0) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(120) / 60.0
    a, zeta = 0.3, 0.05
    b = rate / w + zeta * a
    phi = 0.01 + np.exp(-zeta * w * t) * (a * np.cos(w * t) + b * np.sin(w * t))
    return t, phi + noise * np.random.default_rng(seed).standard_normal(len(t))


def test_rate_and_angle_of_a_swing_at_its_beginning() -> None:
    z = []
    for seed in range(10):
        t, phi = _swing(-3.0, 0.008, seed)
        at_0, rate, sigma, fastest = swing_at_beginning(t, phi)
        assert at_0 == pytest.approx(0.31, abs=0.02) and fastest == pytest.approx(25.0 * 0.3, rel=0.15)
        z.append((rate + 3.0) / sigma)
    # Frequency and damping are not known, which adds to what the linear fit says.
    assert np.sqrt(np.mean(np.square(z))) < 3.0


def test_a_wrong_picture_does_not_decide() -> None:
    t, phi = _swing(-3.0, 0.002, 0)
    clean = swing_at_beginning(t, phi)[1]
    phi[30] += 2.0
    assert swing_at_beginning(t, phi)[1] == pytest.approx(clean, abs=0.3)


def _started(one: Track, from_s: float = 0.0) -> object:
    some = one.t_s >= from_s + 0.025
    t, head = one.t_s[some] - from_s - 0.025, one.head[some]
    return start_in_motion(t, head, one.hoses, PLANT, SIGMA[0])


@pytest.mark.parametrize("seed", range(5))
def test_swings_that_are_let_go_begin_at_rest_and_cut_ones_do_not(seed: int) -> None:
    one = track("free", phi_rad=0.2 + 0.1 * seed, seed=seed)
    assert _started(one) is None
    # A quarter of a period after an extreme the rate is greatest.
    phi = np.abs(one.head[:, 0] - np.median(one.head[:, 0]))
    cut = one.t_s[30 + int(np.argmin(phi[30:45]))]
    begun = _started(one, float(cut))
    assert begun is not None and abs(begun.dphi_radps) > 1.0


def test_pumps_that_are_on_already_are_seen_by_the_pose() -> None:
    one = track("steps")
    assert _started(one) is None
    begun = _started(one, 1.5)
    assert begun is not None
    # Both pumps alike: no angle, and the force that holds the length.
    assert abs(begun.phi_rad) < 0.01 and begun.length_m > PLANT.rest_length_m + 0.01
    assert begun.force1_N == pytest.approx(begun.force2_N, abs=0.1) and begun.force1_N > 0.5
    assert begun.lag1_N == begun.force1_N and begun.creep1_N == 0.0
