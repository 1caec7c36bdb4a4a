"""What goes into the fused filter and what comes out: set-up, rows, columns and flags."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.estimator.kernel import REPORT
from calib.estimator.model import Kinematic

__all__ = ["FLAGS", "OUT", "Rows", "Setup", "Start"]

FLAGS = {
    "restarted": 1,
    "camera_silent": 2,
    "imu_silent": 4,
    "held_by_prior": 8,
    "late": 16,
    "time_jump": 32,
    "not_started": 64,
}

OUT = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", *REPORT, "flags", "swing_weight", "rest_weight",
    "driven_weight",
)  # fmt: skip
"""Columns of the output."""
"""Bits of the column `flags`."""


@dataclass(frozen=True)
class Start:
    """What is known before the first reading.

    Attributes
    ----------
    head, head_sigma : (6,) of `sensors.HEAD`.
    sensor, sensor_sigma : (13,) of `sensors.SENSOR`.
    sensor_covariance : (13, 13) in place of the deviations, where the quantities are not independent.
    """

    sensor: FloatArray
    sensor_sigma: FloatArray
    head: FloatArray = field(default_factory=lambda: np.array([0.0, 0.068, 0.0, 0.0, 0.0, 0.0]))
    head_sigma: FloatArray = field(default_factory=lambda: np.array([0.4, 0.015, 2.0, 0.1, 100.0, 2.0]))
    sensor_covariance: FloatArray | None = None

    def covariance(self) -> FloatArray:
        """Covariance (19, 19) of head and sensors."""
        P = np.diag(np.concatenate([self.head_sigma, self.sensor_sigma]) ** 2)
        if self.sensor_covariance is not None:
            P[6:, 6:] = self.sensor_covariance
        return np.asarray(P)


@dataclass(frozen=True)
class Setup:
    """Everything that stays the same over a log.

    Attributes
    ----------
    view : (24,) of `sensors.view_coefficients`; without a camera any.
    noise : (11,) of `kernel.NOISE`.
    start : prior. `sensor[7]`, the time offset, is the delay of the pictures.
    bellows_radius_m : r_B.
    gravity_mps2, lever_across_m : g and the IMU's place across the tangent.
    process : bank of levels.
    camera_period_s, imu_period_s : nominal; NaN takes the stamps as they are.
    """

    view: FloatArray
    noise: FloatArray
    start: Start
    bellows_radius_m: float
    gravity_mps2: float = 9.81
    lever_across_m: float = 0.0
    process: Kinematic = field(default_factory=Kinematic)
    camera_period_s: float = math.nan
    imu_period_s: float = math.nan


@dataclass(frozen=True)
class Rows:
    """Rows of a log, NaN where nothing was sampled.

    Attributes
    ----------
    t_s : (n,) stamps.
    readings : (n, 5) u, v [px], a_x, a_y [m/s^2], g_z [rad/s].
    kinds : (n,) 1 for the camera's tick, with or without a marker, 2 for an IMU sample, 3 for both.
    """

    t_s: FloatArray
    readings: FloatArray
    kinds: IntArray

    def __len__(self) -> int:
        return len(self.t_s)
