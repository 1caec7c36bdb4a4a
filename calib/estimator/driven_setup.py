"""What the driven filter knows beforehand: plant, pumps, and how far from the truth they may be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from calib.actuator.dynamics import coefficients
from calib.actuator.parameters import DAMPING_SCALE_FREE, Plant, pumps_connected
from calib.actuator.pump import Pump, pump_coefficients, static_force_N
from calib.arrays import FloatArray
from calib.estimator.driven_model import DRIVEN, DYNAMIC, INVOLVED, PARAMETER
from calib.estimator.setup import Setup

__all__ = ["SIGMA", "Drive", "commands"]

SIGMA = (0.08, 0.1, 0.1, 0.06, 0.06, 0.06, 0.08, 5e-4, 0.08, 0.1, 0.1)
"""Deviations of `driven_model.PARAMETER` from nominal: by what two rigs that were made alike differ."""


@dataclass(frozen=True)
class Drive:
    """Plant and pumps of the driven filter.

    Attributes
    ----------
    plant, pump, strength : nominal, with the hoses on; factors on the pumps' static forces.
    free_damping_scale : c_dmp with the hoses off. Until the first command nobody knows which it is.
    sigma : (11,) deviations of `driven_model.PARAMETER`.
    covariance : (11, 11) of the same where they are not independent; its diagonal is `sigma` squared.
    sigma_force_N, sigma_disturbance_N, sigma_creep_N : of the state before the first reading.
    sigma_turning_radps : of dphi; a free swing is fast.
    walk_disturbance : density of the disturbances' walk [N/sqrt(s)].
    walk_rates : densities of the walk of dphi and dl [rad/s, m/s per sqrt(s)].
    walk_forces : density of the walk of lag, force and creep [N/sqrt(s)].
    walk_parameters : of all parameters, as a share of `SIGMA` per sqrt(s). Known ones walk as well: they
        stand for a model that is not the actuator, and a smoother spreads what they learn over the log.
    imu_noise : deviations of a_x, a_y [m/s^2] and g_z [rad/s] for this filter, which knows the head's
        accelerations; None for those of the set-up.
    """

    plant: Plant = field(default_factory=pumps_connected)
    pump: Pump = field(default_factory=Pump)
    strength: tuple[float, float] = (1.0, 1.0)
    free_damping_scale: float = DAMPING_SCALE_FREE
    sigma: tuple[float, ...] = SIGMA
    sigma_force_N: float = 0.03
    sigma_disturbance_N: float = 0.01
    sigma_creep_N: float = 0.03
    sigma_turning_radps: float = 6.0
    walk_disturbance: float = 2.5e-4
    walk_rates: tuple[float, float] = (2e-3, 1e-4)
    walk_forces: float = 1e-4
    walk_parameters: float = 3.5e-3
    imu_noise: tuple[float, float, float] | None = None
    covariance: FloatArray | None = None

    def numbers(self) -> FloatArray:
        """The (22,) vector of `driven_model.PLANT`."""
        return np.array([*coefficients(self.plant), *pump_coefficients(self.pump)], dtype=np.float64)

    def noise(self, setup: Setup) -> FloatArray:
        """The (11,) of `kernel.NOISE` for the driven filter."""
        noise = setup.noise.copy()
        if self.imu_noise is not None:
            noise[2:5] = self.imu_noise
        return noise

    def walk(self, setup: Setup) -> FloatArray:
        """Squared densities (36,) of the walk of the state."""
        moving = np.zeros(DYNAMIC)
        moving[2:4] = self.walk_rates
        moving[4:10] = self.walk_forces
        moving[10:12] = self.walk_disturbance
        parameters = self.walk_parameters * np.array(SIGMA)
        return np.concatenate([moving, parameters, setup.process.sensor_walk]) ** 2

    def start(self, setup: Setup) -> tuple[FloatArray, FloatArray]:
        """State (36,) and covariance (36, 36) before the first reading."""
        begin = setup.start
        x, sigma = np.zeros(len(DRIVEN)), np.zeros(len(DRIVEN))
        x[:4], sigma[:4] = begin.head[:4], begin.head_sigma[:4]
        sigma[2] = self.sigma_turning_radps
        sigma[4:6], sigma[6:10] = self.sigma_creep_N, self.sigma_force_N
        sigma[10:12] = self.sigma_disturbance_N
        sigma[DYNAMIC:INVOLVED] = self.sigma
        # With the hoses off or on, whichever it is.
        apart = (
            math.log(self.free_damping_scale / self.plant.damping_scale) if self.free_damping_scale else -1.0
        )
        at = DYNAMIC + PARAMETER.index("log_damping")
        x[at], sigma[at] = 0.5 * apart, math.hypot(0.5 * apart, self.sigma[1])
        x[INVOLVED:] = begin.sensor
        # Pictures are put at their exposure, so that what is left of the offset is zero.
        x[INVOLVED + 7] -= max(float(begin.sensor[7]), 0.0)
        P = np.diag(sigma**2)
        if self.covariance is not None:
            P[DYNAMIC:INVOLVED, DYNAMIC:INVOLVED] = self.covariance
            P[at, at] = sigma[at] ** 2
        P[INVOLVED:, INVOLVED:] = begin.covariance()[6:, 6:]
        return x, P


def commands(drive: Drive, pwm: FloatArray) -> FloatArray:
    """Static forces (n, 2) [N] that commands (n, 2) settle at with nominal pumps; NaN without a command."""
    known = np.isfinite(pwm).all(axis=1)
    out = np.full(pwm.shape, np.nan)
    out[known] = static_force_N(drive.pump, pwm[known]) * np.array(drive.strength)
    return out
