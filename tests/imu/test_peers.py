"""Filters by others: they agree about gravity, and what is missing is named."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.imu import peers
from calib.imu.orientation import up_in_sensor
from calib.imu.peers import PEERS, missing, run_peer


def _tilted(n: int = 3000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rates, forces and angle of a sensor that swings about its z axis in the plane of gravity."""
    t = 0.01 * np.arange(n)
    phi, rate = 0.5 * np.sin(t), 0.5 * np.cos(t)
    gyro = np.stack([0.0 * t, 0.0 * t, -rate], axis=1)
    force = 9.81 * np.stack([np.cos(phi), np.sin(phi), 0.0 * t], axis=1)
    return gyro, force, phi


@pytest.mark.parametrize("name", PEERS)
def test_the_angle_in_the_plane_is_found(name: str) -> None:
    if missing(name):
        pytest.skip(f"{missing(name)} is not installed")
    gyro, force, phi = _tilted()
    q = run_peer(name, gyro, force, 0.01)
    assert q.shape == (3000, 4)
    assert np.allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-5)
    up = up_in_sensor(q)
    late = slice(1500, None)
    assert np.abs(np.arctan2(up[late, 1], up[late, 0]) - phi[late]).max() < np.radians(1.0)


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert missing("VQF") == "vqf"
    with pytest.raises(BadInputError, match="VQF: needs the package vqf; install the extra peers"):
        run_peer("VQF", np.zeros((5, 3)), np.ones((5, 3)), 0.01)


def test_bad_input_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInputError, match="expected one of Mahony, Madgwick"):
        missing("EKF")
    monkeypatch.setattr(peers, "missing", lambda name: "")
    with pytest.raises(BadInputError, match="expected \\(n, 3\\)"):
        run_peer("VQF", np.zeros((5, 2)), np.zeros((5, 3)), 0.01)
    with pytest.raises(BadInputError, match="period of 0 s"):
        run_peer("VQF", np.zeros((5, 3)), np.zeros((5, 3)), 0.0)
