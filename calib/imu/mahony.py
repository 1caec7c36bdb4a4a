"""The Mahony-Madgwick filter of the angle in the plane (2.1 - 2.3).

    phi_acc = atan2(ay, ax)                                                (2.1)
    e_k   = phi_acc_k - phi_(k-1)                                          (2.3a)
    I_k   = I_(k-1) + Ki e_k dt                                            (2.3b)
    phi_k = phi_(k-1) + (Kp e_k + I_k + w_k) dt                            (2.3c)

with the sensor's x axis from the head to the base at rest. For any right-handed sensor
d atan2(ay, ax) / dt = -gz, so the rate w is -gz. The error is wrapped to half a turn, the angle
itself is not. A constant gyro bias ends up in the integral and leaves no error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.errors import BadInputError

__all__ = ["Mahony", "MahonySample", "MahonyState", "accelerometer_angle", "step"]


@dataclass(frozen=True)
class Mahony:
    """Gains Kp [1/s] and Ki [1/s^2]; the source has 3 and 3.

    Raises `BadInputError` for gains that are negative or not finite.
    """

    Kp: float = 3.0
    Ki: float = 3.0

    def __post_init__(self) -> None:
        for name, gain in (("Kp", self.Kp), ("Ki", self.Ki)):
            if not 0.0 <= gain < math.inf:
                raise BadInputError(f"{name} of the angle filter: found {gain:g}, expected zero or more")


@dataclass(frozen=True)
class MahonyState:
    """Angle [rad] and integral I [rad/s], which goes to minus the bias of the rate."""

    phi_rad: float = 0.0
    integral_radps: float = 0.0


@dataclass(frozen=True)
class MahonySample:
    """Specific force in the plane [m/s^2], rate about z [rad/s], and time since the last sample [s]."""

    ax_mps2: float
    ay_mps2: float
    gz_radps: float
    dt_s: float


def accelerometer_angle(ax_mps2: float, ay_mps2: float) -> float:
    """phi_acc [rad] of (2.1), in (-pi, pi]; right only while the sensor does not accelerate."""
    return math.atan2(ay_mps2, ax_mps2)


def step(parameters: Mahony, state: MahonyState, sample: MahonySample) -> MahonyState:
    """State after one sample (2.3)."""
    phi_acc = accelerometer_angle(sample.ax_mps2, sample.ay_mps2)
    e = math.remainder(phi_acc - state.phi_rad, 2.0 * math.pi)
    integral = state.integral_radps + parameters.Ki * e * sample.dt_s
    phi = state.phi_rad + (parameters.Kp * e + integral - sample.gz_radps) * sample.dt_s
    return MahonyState(phi, integral)
