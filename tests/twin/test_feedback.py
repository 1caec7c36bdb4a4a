"""The firmware's pipeline, tick by tick, against the same in vectors with SciPy's filters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import butter, lfilter, lfilter_zi

from calib.core.geometry import apply_homography
from calib.stages.actuator.kinematics import inverse_series
from calib.stages.control.references import Ellipse
from calib.twin.rig import nominal_view, workspace_homography
from calib.twin.sensors import Tracker, marker_pixels
from calib.twin.simulate import Firmware, FirmwareState, add_frame, add_imu

RADIUS_M, D_M = 0.0126, 0.015
H = workspace_homography(nominal_view())
FIRMWARE = Firmware(np.linalg.inv(H), RADIUS_M, 0.065, D_M, 100.0)


def _frames(pixels: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """phi, q1, q2 at each tick for an angle filter that is told the angle."""
    state, out = FirmwareState(), []
    for (u, v), angle in zip(pixels.tolist(), phi.tolist(), strict=True):
        # A fresh angle filter starts at the accelerometer's angle.
        state = FirmwareState(None, state.marker_m, state.x, state.y)
        state = add_imu(FIRMWARE, state, 9.81 * math.cos(angle), 9.81 * math.sin(angle), 0.0)
        state, seen = add_frame(FIRMWARE, state, u, v)
        out.append([seen.phi_rad, *seen.q_m])
    return np.array(out)


def test_it_is_homography_offset_lowpass_and_series() -> None:
    rng = np.random.default_rng(0)
    pixels = np.array([160.0, 120.0]) + 10.0 * rng.normal(size=(300, 2))
    phi = 0.3 * rng.normal(size=300)
    marker = apply_homography(np.linalg.inv(H), pixels)
    head = marker - D_M * np.stack([np.sin(phi), np.cos(phi)], axis=1)
    b, a = butter(1, 1.0, fs=60.0)
    low = np.stack([lfilter(b, a, x, zi=lfilter_zi(b, a) * x[0])[0] for x in head.T], axis=1)
    expected = inverse_series(np.column_stack([low, phi]), RADIUS_M)
    seen = _frames(pixels, phi)
    assert np.allclose(seen[:, 0], phi, atol=1e-14)
    assert np.allclose(seen[:, 1:], expected, rtol=0.0, atol=1e-13)


def test_at_rest_it_finds_the_bellows_within_the_error_of_the_lens() -> None:
    q = Ellipse().bellows_m(np.linspace(0.0, 20.0, 41), RADIUS_M)
    phi = (q[:, 0] - q[:, 1]) / (2.0 * RADIUS_M)
    pixels = marker_pixels(nominal_view(), Tracker(), q, RADIUS_M)
    error = [
        1e3 * (_frames(np.repeat([p], 3, axis=0), np.full(3, angle))[-1, 1:] - wanted)
        for p, angle, wanted in zip(pixels, phi, q, strict=True)
    ]
    # Neglecting the lens costs some tenths of a millimetre; a wrong sign or offset would cost tens.
    assert 0.05 < np.abs(error).max() < 1.5


def test_the_last_marker_is_held_while_nothing_is_found() -> None:
    pixels = np.array([[160.0, 120.0]] + [[math.nan, math.nan]] * 20)
    seen = _frames(pixels, np.zeros(21))
    # A low-pass holds a constant but for the rounding of its sums.
    assert np.allclose(seen, seen[:1], rtol=0.0, atol=1e-15)


def test_before_the_first_frame_it_believes_in_the_rest_length() -> None:
    state = add_imu(FIRMWARE, FirmwareState(), 9.81 * math.cos(0.2), 9.81 * math.sin(0.2), 0.0)
    _, seen = add_frame(FIRMWARE, state, math.nan, math.nan)
    assert seen.phi_rad == pytest.approx(0.2)
    assert seen.q_m == pytest.approx((0.065 + 0.0126 * 0.2, 0.065 - 0.0126 * 0.2))
    _, blind = add_frame(FIRMWARE, FirmwareState(), math.nan, math.nan)
    assert blind.q_m == (0.065, 0.065)


def test_samples_are_counted_not_timed() -> None:
    state = FirmwareState()
    for _ in range(101):
        state = add_imu(FIRMWARE, state, 9.81, 0.0, 0.0)
    assert state.angle is not None
    assert state.angle.phi_rad == 0.0
    turned = add_imu(FIRMWARE, state, 9.81, 0.0, -1.0)
    assert turned.angle is not None
    assert turned.angle.phi_rad == pytest.approx(0.01)
