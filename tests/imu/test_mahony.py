"""The angle filter: its sign on a sensor that turns, its poles, what it does with a bias."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from calib.errors import BadInputError
from calib.imu.mahony import Mahony, MahonySample, MahonyState, accelerometer_angle, step

DT = 0.01


def _angles(phi: np.ndarray, rate: np.ndarray, start: float = 0.0, gains: Mahony | None = None) -> np.ndarray:
    """Angles of the filter for a sensor that feels gravity alone at the angles phi."""
    state, out = MahonyState(start, 0.0), []
    for angle, w in zip(phi.tolist(), rate.tolist(), strict=True):
        sample = MahonySample(9.81 * math.cos(angle), 9.81 * math.sin(angle), -w, DT)
        state = step(Mahony() if gains is None else gains, state, sample)
        out.append(state.phi_rad)
    return np.array(out)


@given(st.floats(-3.0, 3.0), st.floats(-5.0, 5.0), st.floats(0.0, 6.28))
def test_for_any_right_handed_sensor_the_angle_grows_with_minus_gz(
    phi: float, rate: float, mounted: float
) -> None:
    # A sensor that turns about its own z axis, with a fixed force of the world on it.
    force_W, h = np.array([0.3, -9.81, 0.0]), 1e-6

    def angle(t: float) -> float:
        R_WS = Rotation.from_rotvec([0.0, 0.0, phi + mounted + rate * t]).as_matrix()
        fx, fy, _ = R_WS.T @ force_W
        return accelerometer_angle(fx, fy)

    slope = math.remainder(angle(h) - angle(-h), 2.0 * math.pi) / (2.0 * h)
    assert slope == pytest.approx(-rate, abs=1e-6)


def test_a_steady_turn_is_followed_over_many_turns_without_wrapping() -> None:
    rate = np.full(2000, 2.0)
    phi = np.cumsum(rate) * DT
    # (2.3a) compares with the last estimate, so the settled filter is one sample ahead.
    assert np.allclose((_angles(phi, rate) - phi)[-200:], 2.0 * DT, atol=1e-9)
    assert phi[-1] > 6.0 * math.pi


def test_a_constant_bias_is_taken_up_by_the_integral() -> None:
    state, bias = MahonyState(), 0.05
    for _ in range(3000):
        state = step(Mahony(), state, MahonySample(9.81, 0.0, -bias, DT))
    assert state.integral_radps == pytest.approx(-bias, abs=1e-12)
    assert state.phi_rad == pytest.approx(0.0, abs=1e-12)


def test_its_response_is_that_of_the_block_diagram() -> None:
    # (2.3) without wrapping: phi (z - 1) = (Kp e + Ki dt e z / (z - 1) + w) dt with e = phi_acc - phi / z.
    Kp, Ki = 3.0, 3.0
    rng = np.random.default_rng(2)
    phi_acc, w = 0.3 * rng.normal(size=400), rng.normal(size=400)
    one_more = [1.0, -1.0]
    gains = np.array([Kp + Ki * DT, -Kp])
    denominator = np.convolve(one_more, one_more) + DT * np.concatenate([[0.0], gains])
    expected = lfilter(DT * gains, denominator, phi_acc) + lfilter(DT * np.array(one_more), denominator, w)
    state, out = MahonyState(), []
    for angle, rate in zip(phi_acc.tolist(), w.tolist(), strict=True):
        state = step(Mahony(), state, MahonySample(math.cos(angle), math.sin(angle), -rate, DT))
        out.append(state.phi_rad)
    assert np.allclose(out, expected, rtol=0.0, atol=1e-12)
    poles = np.log(np.roots(denominator)) / DT
    assert np.allclose(np.sort_complex(poles), [-1.5 - 0.87j, -1.5 + 0.87j], atol=0.03)


def test_the_error_takes_the_short_way_round() -> None:
    assert _angles(np.array([-3.1]), np.zeros(1), start=3.1)[0] > 3.1


@pytest.mark.parametrize(("Kp", "Ki"), [(-1.0, 3.0), (3.0, math.nan), (math.inf, 0.0)])
def test_what_no_gain_can_be(Kp: float, Ki: float) -> None:
    with pytest.raises(BadInputError, match="of the angle filter"):
        Mahony(Kp, Ki)
