"""The rate of the in-plane angle of a tilted sensor, and the up vector that it needs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import BadInputError
from calib.imu.rate import LEAST, in_plane, planar_rate, up_vector

G = 9.81


def _wave(t: np.ndarray, phase: float, w: float) -> tuple[np.ndarray, np.ndarray]:
    return np.sin(w * t + phase), w * np.cos(w * t + phase)


def _tumbling(t: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rates, up vectors, in-plane angle and its rate of a sensor whose up vector is given in closed form.

    The up vector has azimuth phi and elevation e in the sensor's axes. A turn about the up vector itself
    does not change it and is added on top.
    """
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    phi, dphi = (2.0 * x for x in _wave(t, phase[0], 1.7))
    e, de = (0.9 * x for x in _wave(t, phase[1], 2.3))
    spin = 3.0 * np.cos(0.7 * t + phase[2])
    u = np.stack([np.cos(e) * np.cos(phi), np.cos(e) * np.sin(phi), np.sin(e)], axis=1)
    du = de[:, None] * np.stack(
        [-np.sin(e) * np.cos(phi), -np.sin(e) * np.sin(phi), np.cos(e)], axis=1
    ) + dphi[:, None] * np.stack([-np.cos(e) * np.sin(phi), np.cos(e) * np.cos(phi), 0.0 * e], axis=1)
    # du/dt = u x w is solved by w = du x u + any multiple of u.
    return np.cross(du, u) + spin[:, None] * u, u, phi, dphi


@pytest.mark.parametrize("seed", range(5))
def test_the_rate_of_a_tilted_sensor_is_exact(seed: int) -> None:
    gyro, u, _, dphi = _tumbling(np.linspace(0.0, 20.0, 4001), seed)
    assert np.abs(planar_rate(gyro, u) - dphi).max() < 1e-12
    assert np.abs(-gyro[:, 2] - dphi).max() > 1.0


def test_against_rotation_matrices_and_finite_differences() -> None:
    """An independent tool integrates the rotation; the angle comes from what an accelerometer feels."""
    rng = np.random.default_rng(3)
    h = 1e-4
    for _ in range(50):
        R_WS = Rotation.random(random_state=rng)
        w = rng.normal(size=3)
        angle = []
        for side in (-1.0, 1.0):
            up = (R_WS * Rotation.from_rotvec(side * h * w)).inv().apply([0.0, 0.0, 1.0])
            angle.append(np.arctan2(up[1], up[0]))
        u = R_WS.inv().apply([0.0, 0.0, 1.0])
        s = u[0] ** 2 + u[1] ** 2
        if s < 0.05:
            continue
        slope = np.angle(np.exp(1j * (angle[1] - angle[0]))) / (2.0 * h)
        found = planar_rate(w[None, :], u[None, :])[0]
        assert found == pytest.approx(slope, abs=1e-5 / s**1.5)


def test_a_sensor_in_plane_has_the_rate_minus_gz() -> None:
    phi = np.linspace(-3.0, 3.0, 50)
    u = np.stack([np.cos(phi), np.sin(phi), 0.0 * phi], axis=1)
    gyro = np.random.default_rng(0).normal(size=(50, 3))
    assert np.array_equal(planar_rate(gyro, u), -gyro[:, 2])


def test_where_the_angle_is_not_defined_the_rate_stays_finite() -> None:
    gyro = np.array([[5.0, -3.0, 0.5]] * 4)
    u = np.array([[0.0, 0.0, 1.0], [1e-9, 0.0, -1.0], [1e-3, 0.0, 1.0], [0.0, 0.0, 0.0]])
    rate = planar_rate(gyro, u)
    assert np.allclose(rate, -0.5, atol=5.0 * 1e-3 / LEAST + 1e-12)
    assert rate[0] == -0.5
    # It is continuous where the floor begins.
    side = np.sqrt(LEAST)
    edge = np.array([[side * k, 0.0, np.sqrt(1.0 - (side * k) ** 2)] for k in (1.0 - 1e-9, 1.0 + 1e-9)])
    assert np.ptp(planar_rate(gyro[:2], edge)) < 1e-6
    assert in_plane(np.array([[1.0, 0.0, 0.0], [0.1, 0.0, 0.99], [0.8, 0.0, 0.6]])).tolist() == [
        True,
        False,
        True,
    ]


def test_the_up_vector_keeps_up_with_turning() -> None:
    t = np.arange(0.0, 30.0, 0.005)
    gyro, u, _, _ = _tumbling(t)
    found = up_vector(G * u, gyro, 0.005)
    assert np.allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    # A filter of the same time constant in the sensor's axes would be off by radians.
    assert np.degrees(np.arccos(np.clip((found * u).sum(axis=1), -1.0, 1.0))).max() < 0.02


def test_the_up_vector_does_not_follow_the_sensors_own_acceleration() -> None:
    t = np.arange(0.0, 40.0, 0.01)
    gyro, u, _, _ = _tumbling(t)
    shaken = G * u + np.stack([0.0 * t, 9.5 * np.sin(2.0 * np.pi * 4.0 * t), 0.0 * t], axis=1)
    clean = up_vector(G * u, gyro, 0.01)
    late = t > 5.0
    off = np.degrees(np.linalg.norm(up_vector(shaken, gyro, 0.01) - clean, axis=1))[late]
    raw = np.degrees(np.linalg.norm(shaken / np.linalg.norm(shaken, axis=1)[:, None] - u, axis=1))[late]
    assert raw.max() > 40.0
    assert off.max() < 2.0


def test_a_gyro_bias_leaves_the_up_vector_bias_times_tau_behind() -> None:
    t = np.arange(0.0, 60.0, 0.01)
    bias = np.radians(0.3)
    force = np.tile([G, 0.0, 0.0], (len(t), 1))
    gyro = np.tile([0.0, 0.0, bias], (len(t), 1))
    found = up_vector(force, gyro, 0.01, tau_s=3.0)
    # Second order: the delay of a ramp is 2 zeta / w0 = sqrt(2) tau / sqrt(2).
    assert abs(np.arctan2(found[-1, 1], found[-1, 0])) == pytest.approx(3.0 * bias, rel=0.01)


def test_bad_input_is_refused() -> None:
    three = np.ones((5, 3))
    for words, call in (
        ("(n, 3)", lambda: planar_rate(np.ones(3), three)),
        ("as many", lambda: planar_rate(np.ones((4, 3)), three)),
        ("more than zero", lambda: planar_rate(three, three, 0.0)),
        ("as many", lambda: up_vector(three, np.ones((4, 3)), 0.01)),
        ("period", lambda: up_vector(three, three, 0.0)),
        ("time constant", lambda: up_vector(three, three, 0.01, 0.001)),
        ("not finite", lambda: up_vector(three * np.nan, three, 0.01)),
    ):
        with pytest.raises(BadInputError) as error:
            call()
        assert words in str(error.value)
    assert np.array_equal(up_vector(0.0 * three, three, 0.01), 0.0 * three)
