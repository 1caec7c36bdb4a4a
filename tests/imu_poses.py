"""Logs of an IMU that is turned from pose to pose, with everything known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from calib.stages.imu.sampling import Readings

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
G = 9.81


@dataclass(frozen=True)
class Sensor:
    """a = T_a / s_a (x - b_a), w = T_g / s_g (x - b_g - S a); noise of a reading beside."""

    accel_bias: np.ndarray = field(default_factory=lambda: np.array([0.12, -0.2, 0.31]))
    accel_scale: np.ndarray = field(default_factory=lambda: np.array([1.012, 0.991, 1.006]))
    accel_angles: np.ndarray = field(default_factory=lambda: np.array([0.011, -0.007, 0.014]))
    gyro_bias: np.ndarray = field(default_factory=lambda: np.array([0.01, -0.02, 0.005]))
    gyro_scale: np.ndarray = field(default_factory=lambda: np.array([1.01, 0.985, 0.993]))
    gyro_angles: np.ndarray = field(
        default_factory=lambda: np.array([0.012, -0.009, 0.021, 0.004, -0.015, 0.008])
    )
    sensitivity: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    accel_noise: float = 0.02
    gyro_noise: float = 0.002

    def readings(self, w: np.ndarray, f: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        yz, zy, zx = self.accel_angles
        T = np.array([[1.0, -yz, zy], [0.0, 1.0, -zx], [0.0, 0.0, 1.0]])
        yz, zy, xz, zx, xy, yx = self.gyro_angles
        Tg = np.array([[1.0, -yz, zy], [xz, 1.0, -zx], [-xy, yx, 1.0]])
        accel = f @ np.linalg.inv(T / self.accel_scale).T + self.accel_bias
        gyro = w @ np.linalg.inv(Tg / self.gyro_scale).T + self.gyro_bias + f @ self.sensitivity.T
        accel_size, gyro_size = self.accel_scale.mean(), self.gyro_scale.mean()
        return np.hstack(
            [
                gyro + gyro_size * self.gyro_noise * rng.normal(size=w.shape),
                accel + accel_size * self.accel_noise * rng.normal(size=f.shape),
            ]
        )


def in_counts(sensor: Sensor) -> Sensor:
    """The same sensor with 400 counts per m/s^2 and 4800 per rad/s about 32768."""
    return Sensor(
        32768.0 + 400.0 * sensor.accel_bias,
        400.0 * sensor.accel_scale,
        sensor.accel_angles,
        32768.0 + 4800.0 * sensor.gyro_bias,
        4800.0 * sensor.gyro_scale,
        sensor.gyro_angles,
        4800.0 * sensor.sensitivity,
        sensor.accel_noise,
        sensor.gyro_noise,
    )


def sphere_poses(count: int, seed: int = 5) -> list[Rotation]:
    """Attitudes (sensor to world) with the directions of gravity spread over the sphere."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    up = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    rng = np.random.default_rng(seed)
    poses = []
    for u in up[rng.permutation(count)]:
        R, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [u])
        poses.append(Rotation.from_rotvec([0.0, 0.0, rng.uniform(-3, 3)]) * R)
    return poses


def tilts(angles_rad: np.ndarray) -> list[Rotation]:
    """Attitudes about the z axis, which lies level: in the sensor's frame up is (cos, sin, 0)."""
    base = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    return [base * Rotation.from_rotvec([0.0, 0.0, -float(a)]) for a in angles_rad]


def motion(
    poses: list[Rotation],
    rate_hz: float = 100.0,
    rest_s: float = 3.0,
    turn_s: float = 2.0,
    initial_s: float = 20.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (n,), rate of rotation (n, 3) and specific force (n, 3) in the sensor's frame, without errors."""
    w, f = [], []
    up = np.array([0.0, 0.0, G])
    for i, pose in enumerate(poses):
        n = round((initial_s if i == 0 else rest_s) * rate_hz)
        w.append(np.zeros((n, 3)))
        f.append(np.tile(pose.inv().apply(up), (n, 1)))
        if i + 1 == len(poses):
            break
        n = round(turn_s * rate_hz)
        s = (np.arange(n) + 0.5) / n
        angle = (pose.inv() * poses[i + 1]).as_rotvec()
        w.append(np.outer((1.0 - np.cos(2 * np.pi * s)) / turn_s, angle))
        way = s - np.sin(2 * np.pi * s) / (2 * np.pi)
        f.append((pose * Rotation.from_rotvec(np.outer(way, angle))).inv().apply(up))
    w_all, f_all = np.concatenate(w), np.concatenate(f)
    return np.arange(len(w_all)) / rate_hz, w_all, f_all


def pose_log(
    poses: list[Rotation], sensor: Sensor, seed: int = 0, counts: bool = False, **how: float
) -> Readings:
    """A log of this sensor."""
    t, w, f = motion(poses, **how)
    values = sensor.readings(w, f, np.random.default_rng(seed))
    return Readings("log", AXES, t, values, counts="ag" if counts else "")
