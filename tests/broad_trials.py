"""BROAD's recordings for the test and the benchmark: reading, windows in plane, and the filter in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from calib.stages.imu.mahony import Mahony, MahonyState, accelerometer_angles, filter_log, wrapped

FILES = {
    "02": "02_undisturbed_slow_rotation_B.mat",
    "05": "05_undisturbed_slow_rotation_with_breaks_B.mat",
}
PUBLISHED_DEG = {
    "VQF": {"02": 0.429, "05": 0.353},
    "imufusion": {"02": 0.666, "05": 0.553},
    "Mahony": {"02": 0.459, "05": 0.528},
    "Madgwick": {"02": 0.606, "05": 0.549},
}
"""Inclination's RMSE in motion of six-axis filters, by others."""

_SHORTEST_S = 1.0


@dataclass(frozen=True)
class Trial:
    """A recording: rates [rad/s], forces [m/s^2], true up vectors with gaps, and whether it moves."""

    gyro: np.ndarray
    force: np.ndarray
    truth: np.ndarray
    moving: np.ndarray
    period_s: float

    @property
    def true_phi(self) -> np.ndarray:
        """Angle of the true up vector in the plane."""
        return np.arctan2(self.truth[:, 1], self.truth[:, 0])

    def inclination_deg(self, up: np.ndarray) -> float:
        """RMS in motion of the angle between up vectors (n, 3) and the true ones.

        It is BROAD's inclination error (Data 6(7):72, 2021, section 4), whose arc cosine loses digits.
        """
        up = up / np.linalg.norm(up, axis=1, keepdims=True)
        apart = 2.0 * np.arcsin(np.clip(np.linalg.norm(up - self.truth, axis=1) / 2.0, 0.0, 1.0))
        return float(np.degrees(np.sqrt(np.nanmean(apart[self.moving] ** 2))))


def in_plane(up: np.ndarray, least: float = 0.5) -> np.ndarray:
    """Where (n,) ux^2 + uy^2 is at least `least` of |u|^2: 0.5 is a tilt of the plane by up to 45 degrees."""
    return up[:, 0] ** 2 + up[:, 1] ** 2 >= least * (up**2).sum(axis=1)


def _up(q: np.ndarray) -> np.ndarray:
    """The world's up vector (n, 3) in the axes of a sensor whose quaternions (n, 4) are w, x, y, z."""
    w, x, y, z = q.T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)


def read_trial(path: Path) -> Trial:
    """A recording of BROAD."""
    m = loadmat(path, squeeze_me=True)
    return Trial(
        np.ascontiguousarray(m["imu_gyr"]),
        np.ascontiguousarray(m["imu_acc"]),
        _up(m["opt_quat"]),
        m["movement"] == 1,
        1.0 / float(m["sampling_rate"]),
    )


def windows(one: Trial, up: np.ndarray, least: float) -> list[slice]:
    """Stretches of a second or more in motion, with known truth and in plane."""
    inside = one.moving & np.isfinite(one.truth).all(axis=1) & in_plane(up, least)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(np.int64), [0]])))
    return [
        slice(a, b)
        for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        if (b - a) * one.period_s >= _SHORTEST_S
    ]


def rmse_deg(one: Trial, phi: np.ndarray, where: list[slice]) -> float:
    """Of an angle in the windows, all together."""
    errors = [wrapped(phi[w] - one.true_phi[w]) for w in where]
    return float(np.degrees(np.sqrt(np.mean(np.concatenate(errors) ** 2))))


def filter_rmse_deg(one: Trial, rate: np.ndarray, where: list[slice]) -> float:
    """Of MM 3/3 with this rate, begun in each window at the accelerometer's angle."""
    phi_acc = accelerometer_angles(one.force[:, 0], one.force[:, 1])
    t = one.period_s * np.arange(len(phi_acc), dtype=np.float64)
    phi = np.full(len(phi_acc), np.nan)
    for w in where:
        start = MahonyState(float(phi_acc[w.start]))
        phi[w] = filter_log(Mahony(), t[w], phi_acc[w], rate[w], start)[0]
    return rmse_deg(one, phi, where)
