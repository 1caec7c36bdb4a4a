"""The camera's angle against the kinematics, and its lag against one that is known."""

from __future__ import annotations

import numpy as np
import pytest

from calib.actuator.kinematics import marker_from_head, pose_from_configuration
from calib.camera.model import Camera, project
from calib.phi_reference import angle_from_marker, angle_from_pixels, lag_of


def _markers(phi: np.ndarray, length: np.ndarray) -> np.ndarray:
    pose = pose_from_configuration(np.stack([phi / length, length], axis=-1))
    return marker_from_head(pose[:, :2], phi)


def _motion(t: np.ndarray) -> np.ndarray:
    return 0.3 * np.sin(2.0 * t) + 0.1 * np.sin(7.0 * t)


def test_is_the_angle_of_the_arc_whatever_its_length() -> None:
    rng = np.random.default_rng(0)
    phi, length = rng.uniform(-1.5, 1.5, 200), rng.uniform(0.06, 0.1, 200)
    assert np.allclose(angle_from_marker(_markers(phi, length)), phi, atol=1e-12)


def test_through_the_camera() -> None:
    lens = np.array([-0.2, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    camera = Camera("radial2", (316, 208), 270.0, 268.0, 0.0, 158.0, 104.0, lens)
    phi = np.linspace(-0.5, 0.5, 30)
    marker = _markers(phi, np.full(30, 0.07))
    pixels = project(camera, np.column_stack([marker - [0.0, 0.07], np.full(30, 0.3)]))
    A = camera.K @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -0.07], [0.0, 0.0, 0.3]])
    assert np.allclose(angle_from_pixels(camera, np.linalg.inv(A), pixels), phi, atol=1e-6)


@pytest.mark.parametrize("lag", [0.0, 0.0173, 0.035])
def test_finds_the_lag(lag: float) -> None:
    rng = np.random.default_rng(1)
    t, seen = 0.01 * np.arange(2000), np.arange(0.0, 20.0, 1.0 / 60.0)
    late = _motion(seen - lag) + 0.4 + 0.003 * rng.normal(size=len(seen))
    assert lag_of(seen, late, t, _motion(t)) == pytest.approx(lag, abs=1e-3)


def test_a_rig_at_rest_tells_no_lag() -> None:
    rng = np.random.default_rng(2)
    t = 0.01 * np.arange(1000)
    assert lag_of(t, 1e-3 * rng.normal(size=1000), t, np.zeros(1000)) == 0.0
    assert lag_of(t[:5], t[:5], t, t) == 0.0
