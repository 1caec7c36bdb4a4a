"""BROAD's recordings for the test and the benchmark: reading, windows in plane, and the filter in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

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


def averaged(one: Trial, every: int) -> Trial:
    """Means over `every` samples, and the truth in their middle."""
    n = len(one.gyro) // every * every
    gyro, force = (x[:n].reshape(-1, every, 3).mean(axis=1) for x in (one.gyro, one.force))
    middles = slice(every // 2, n, every)
    return Trial(gyro, force, one.truth[middles], one.moving[middles], every * one.period_s)


def varied(one: Trial) -> Iterator[tuple[str, Trial]]:
    """The recording as others might have made it, by name."""
    rng, quarter = np.random.default_rng(0), Rotation.random(random_state=1).as_matrix()
    moving = np.flatnonzero(one.moving)
    late = slice(int(moving[len(moving) // 2]), None)
    biased = replace(one, gyro=one.gyro + np.radians([3.0, -3.0, 3.0]))
    begun = Trial(one.gyro[late], one.force[late], one.truth[late], one.moving[late], one.period_s)
    noise = rng.normal(size=(2, *one.gyro.shape))
    pushed, up = one.force.copy(), np.nan_to_num(one.truth[late][: round(3.0 / one.period_s)])
    across = np.cross(up, [0.0, 0.0, 1.0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    pushed[late.start : late.start + len(up)] += 0.3 * 9.81 * across
    yield "as it is", one
    yield "means at 57 Hz", averaged(one, 5)
    yield "bias of 3 deg/s", biased
    yield "the same at 57 Hz", averaged(biased, 5)
    yield "from the middle of the motion", begun
    yield "the same, bias of 1 deg/s", replace(begun, gyro=begun.gyro + np.radians([1.0, -1.0, 1.0]))
    yield (
        "sensor turned",
        replace(one, gyro=one.gyro @ quarter.T, force=one.force @ quarter.T, truth=one.truth @ quarter.T),
    )
    yield "noisy", replace(one, gyro=one.gyro + 0.02 * noise[0], force=one.force + 0.3 * noise[1])
    yield "rate 1 % too large", replace(one, gyro=1.01 * one.gyro)
    yield "0.3 g held for 3 s", replace(one, force=pushed)


def late_deg(one: Trial, up: np.ndarray) -> float:
    """Inclination's RMS in motion after 5 s, least over the shift of the truth's clock, which is late."""
    t = one.period_s * np.arange(len(up))
    after, found = replace(one, moving=one.moving & (t > 5.0)), []
    for shift in np.arange(-0.02, 0.021, 0.002).tolist():
        at = np.stack([np.interp(t, t + shift, up[:, i]) for i in range(3)], axis=1)
        found.append(after.inclination_deg(at))
    return min(found)


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
