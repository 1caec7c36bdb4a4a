"""The simulated BNO055 on the head (2.1): rotation rate, specific force, and its own drifting angle.

Axes. Unmounted, the sensor's x axis points from the head to the base, y is the head's +x and z points
away from the camera, in the world frame

    x_S = -(sin phi, cos phi, 0),   y_S = (cos phi, -sin phi, 0),   z_S = (0, 0, 1),

so that at rest atan2(ay, ax) = phi and at all times gz = -dphi/dt. Mounted with the angle alpha the
sensor is turned about z so that it reads phi + alpha at rest.

The accelerometer feels the specific force f = a - g at its own place c in the head's frame,

    a = a_head + ddphi R' c - dphi^2 R c,   R = [[cos, sin], [-sin, cos]],  R' = dR / dphi,

with g = (0, 9.81) m/s^2 in the world. Then per axis

    m = clip(round(((1 + scale error) true + bias + walk + white noise) / step) step).

White noise is given by its density, as in Kalibr's imu.yaml: the deviation of a sample is the density
times sqrt(rate). The bias walks by a normal step of density / sqrt(rate) per sample.

Scale errors, biases and walks are those of a common part, the densities of noise are the data sheet's
(0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.twin.sensors import HeadMotion, normal, stamps, stream

__all__ = ["Imu", "ImuNoise", "draw_imu_noise", "measure", "onchip_angle_rad"]

_PURPOSE = 2
_DEG = math.pi / 180.0
_G = 9.81

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Imu:
    """Place and errors of the sensor.

    Attributes
    ----------
    rate_hz : samples per second.
    mount_angle_rad : what it reads at rest at phi = 0.
    lever_m : its place c in the head's frame, across and along the tangent [m].
    gravity_mps2 : g in the world frame.
    gyro_scale, accel_scale : scale errors per axis.
    gyro_bias_radps, accel_bias_mps2 : biases at the start.
    gyro_noise, accel_noise : densities of the white noise [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)].
    gyro_walk, accel_walk : densities of the biases' walk [rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)].
    gyro_step_radps, accel_step_mps2 : quantisation; zero for none.
    gyro_range_radps, accel_range_mps2 : largest reading.
    stamp_jitter_s, duplicated_stamps : deviation of the time stamps, share that repeat the last one.
    onchip : whether the fusion on the chip is logged too.
    onchip_drift_radps, onchip_spread : mean of its drift over many logs, and the deviation of a log's
        drift from it as a share of it (Fig. 2.4).

    Raises `BadInputError` for values that no sensor has.
    """

    rate_hz: float = 100.0
    mount_angle_rad: float = 0.02
    lever_m: tuple[float, float] = (0.0, 0.006)
    gravity_mps2: tuple[float, float] = (0.0, _G)
    gyro_scale: Triple = (0.004, -0.003, 0.006)
    accel_scale: Triple = (0.003, -0.002, 0.004)
    gyro_bias_radps: Triple = (0.004, -0.003, 0.006)
    accel_bias_mps2: Triple = (0.05, -0.04, 0.07)
    gyro_noise: float = 0.014 * _DEG
    accel_noise: float = 150e-6 * _G
    gyro_walk: float = 1e-5
    accel_walk: float = 1e-4
    gyro_step_radps: float = 0.0305 * _DEG
    accel_step_mps2: float = 0.01916
    gyro_range_radps: float = 2000.0 * _DEG
    accel_range_mps2: float = 4.0 * _G
    stamp_jitter_s: float = 4e-4
    duplicated_stamps: float = 0.002
    onchip: bool = False
    onchip_drift_radps: float = 0.145 * _DEG
    onchip_spread: float = 0.4

    def __post_init__(self) -> None:
        if not 1.0 <= self.rate_hz <= 1e5:
            raise BadInputError(f"imu rate_hz: found {self.rate_hz:g}, expected 1 to 100000 Hz")
        for name in (
            "gyro_noise",
            "accel_noise",
            "gyro_walk",
            "accel_walk",
            "gyro_step_radps",
            "accel_step_mps2",
            "stamp_jitter_s",
            "onchip_spread",
        ):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise BadInputError(f"imu {name}: found {getattr(self, name):g}, expected zero or more")
        for name in ("gyro_range_radps", "accel_range_mps2"):
            if not getattr(self, name) > 0.0:
                raise BadInputError(f"imu {name}: found {getattr(self, name):g}, expected a positive number")
        if not 0.0 <= self.duplicated_stamps < 1.0:
            raise BadInputError(
                f"imu duplicated_stamps: found {self.duplicated_stamps:g}, expected a share below 1"
            )
        for name, most in (("mount_angle_rad", math.pi), ("onchip_drift_radps", 1.0)):
            if not abs(getattr(self, name)) <= most:
                raise BadInputError(
                    f"imu {name}: found {getattr(self, name):g}, expected {-most:.3g} to {most:.3g}"
                )
        for name, size, most in (
            ("lever_m", 2, 0.5),
            ("gravity_mps2", 2, 100.0),
            ("gyro_scale", 3, 0.5),
            ("accel_scale", 3, 0.5),
            ("gyro_bias_radps", 3, 10.0),
            ("accel_bias_mps2", 3, 50.0),
        ):
            values = getattr(self, name)
            if len(values) != size or not all(abs(value) <= most for value in values):
                raise BadInputError(
                    f"imu {name}: found {tuple(values)}, expected {size} numbers of at most {most:g}"
                )


@dataclass(frozen=True)
class ImuNoise:
    """Everything random about the n samples of a log.

    Attributes
    ----------
    taken_s, stamp_s : (n,) times of the samples and their time stamps.
    gyro, accel : (n, 3) biases with their walk, and white noise [rad/s, m/s^2].
    onchip_rad : (n,) error of the on-chip angle.
    """

    taken_s: FloatArray
    stamp_s: FloatArray
    gyro: FloatArray
    accel: FloatArray
    onchip_rad: FloatArray


def _axis_errors(
    imu: Imu, n: int, bias: Triple, noise: float, walk: float, bits: np.random.PCG64
) -> FloatArray:
    white = noise * math.sqrt(imu.rate_hz) * normal(bits, n, 3)
    steps = walk / math.sqrt(imu.rate_hz) * normal(bits, n, 3)
    return np.asarray(np.array(bias) + np.cumsum(steps, axis=0) + white)


def draw_imu_noise(imu: Imu, duration_s: float, seed: int) -> ImuNoise:
    """Noise of all samples from 0 up to, not including, the duration [s]."""
    n = max(math.ceil(duration_s * imu.rate_hz - 1e-9), 0)
    taken = np.arange(n) / imu.rate_hz
    stamp = stamps(taken, imu.stamp_jitter_s, imu.duplicated_stamps, stream(seed, _PURPOSE, 0))
    gyro = _axis_errors(imu, n, imu.gyro_bias_radps, imu.gyro_noise, imu.gyro_walk, stream(seed, _PURPOSE, 1))
    accel = _axis_errors(
        imu, n, imu.accel_bias_mps2, imu.accel_noise, imu.accel_walk, stream(seed, _PURPOSE, 2)
    )
    # The drift of a log is inconsistent in Fig. 2.4 from log to log, and a little within one.
    bits = stream(seed, _PURPOSE, 3)
    drift = imu.onchip_drift_radps * (1.0 + imu.onchip_spread * float(normal(bits, 1)[0, 0]))
    wander = 0.1 * abs(imu.onchip_drift_radps) / math.sqrt(imu.rate_hz) * np.cumsum(normal(bits, n)[:, 0])
    return ImuNoise(taken, stamp, gyro, accel, drift * taken + wander)


def _read(true: FloatArray, scale: Triple, error: FloatArray, step: float, limit: float) -> FloatArray:
    value = (1.0 + np.array(scale)) * true + error
    if step <= 0.0:
        return np.clip(value, -limit, limit)
    most = math.floor(limit / step + 1e-9)
    return step * np.clip(np.floor(value / step + 0.5), -most, most)


def _specific_force(imu: Imu, motion: HeadMotion) -> FloatArray:
    """f = a - g at the sensor's place, world frame (m, 2)."""
    s, c = np.sin(motion.phi_rad), np.cos(motion.phi_rad)
    across, along = imu.lever_m
    arm_x, arm_y = c * across + s * along, c * along - s * across
    turned_x, turned_y = arm_y, -arm_x
    spin2 = motion.dphi_radps * motion.dphi_radps
    a_x = motion.acceleration_mps2[:, 0] + motion.ddphi_radps2 * turned_x - spin2 * arm_x
    a_y = motion.acceleration_mps2[:, 1] + motion.ddphi_radps2 * turned_y - spin2 * arm_y
    return np.stack([a_x - imu.gravity_mps2[0], a_y - imu.gravity_mps2[1]], axis=-1)


def measure(imu: Imu, noise: ImuNoise, samples: slice, motion: HeadMotion) -> tuple[FloatArray, FloatArray]:
    """Readings of the samples of `noise` while the head moves as `motion` (m).

    Returns
    -------
    specific force (m, 3) [m/s^2] and rotation rate (m, 3) [rad/s] in the sensor's axes.
    """
    s, c = np.sin(motion.phi_rad), np.cos(motion.phi_rad)
    f = _specific_force(imu, motion)
    x = -(s * f[:, 0] + c * f[:, 1])
    y = c * f[:, 0] - s * f[:, 1]
    ca, sa = math.cos(imu.mount_angle_rad), math.sin(imu.mount_angle_rad)
    zero = np.zeros_like(x)
    force = np.stack([ca * x - sa * y, sa * x + ca * y, zero], axis=-1)
    rate = np.stack([zero, zero, -motion.dphi_radps], axis=-1)
    return (
        _read(force, imu.accel_scale, noise.accel[samples], imu.accel_step_mps2, imu.accel_range_mps2),
        _read(rate, imu.gyro_scale, noise.gyro[samples], imu.gyro_step_radps, imu.gyro_range_radps),
    )


def onchip_angle_rad(imu: Imu, noise: ImuNoise, samples: slice, motion: HeadMotion) -> FloatArray:
    """Angle (m,) [rad] of the fusion on the chip: right but for the mount angle and its drift.

    The chip reports it in steps of 1/16 deg.
    """
    step = _DEG / 16.0
    angle = motion.phi_rad + imu.mount_angle_rad + noise.onchip_rad[samples]
    return np.asarray(step * np.floor(angle / step + 0.5))
