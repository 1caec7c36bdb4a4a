"""The Mahony-Madgwick filter of the angle (2.3), one log or many gains at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import kernel
from calib.stages.imu.levelling import Levelling

# ----------------------------------------------------------------------
# The Mahony-Madgwick filter of the angle in the plane (2.1 - 2.3).
#
#     phi_acc = atan2(ay, ax)                                                (2.1)
#     e_k   = phi_acc_k - phi_(k-1)                                          (2.3a)
#     I_k   = I_(k-1) + Ki e_k dt                                            (2.3b)
#     phi_k = phi_(k-1) + (Kp e_k + I_k + w_k) dt                            (2.3c)
#
# with the sensor's x axis from the head to the base at rest. For any right-handed sensor
# d atan2(ay, ax) / dt = -gz, so the rate w is -gz. The error is wrapped to half a turn, the angle
# itself is not. A constant gyro bias ends up in the integral and leaves no error.


@dataclass(frozen=True)
class Mahony:
    """Gains Kp [1/s] and Ki [1/s^2]; the source has 3 and 3."""

    Kp: float = 3.0
    Ki: float = 3.0

    def fill(
        self, t: FloatArray, phi_acc: FloatArray, w: FloatArray, phi: FloatArray, integral: FloatArray
    ) -> None:
        """Angle and integral after each sample; the first of both are those before the first sample."""
        _run(t, phi_acc, w, self.Kp, self.Ki, phi, integral)


AngleFilter = Mahony | Levelling
"""What can be asked for an angle."""


@dataclass(frozen=True)
class MahonyState:
    """Angle [rad] and integral I [rad/s], which goes to minus the bias of the rate."""

    phi_rad: float = 0.0
    integral_radps: float = 0.0


# ----------------------------------------------------------------------
# Over whole logs, compiled.
#
# A sample's step is the time since the sample before it, so that stamps need not be even, may repeat
# (a step of zero leaves the state as it is) and may leave gaps. The filter is linear apart from the
# wrapping of e, and a new sample depends on the last state by one subtraction and one multiplication
# only, which is what the loop is written for:
#
#     phi_k = phi_(k-1) + dt (Kp + Ki dt) e_k + dt (I_(k-1) + w_k),   I_k = I_(k-1) + Ki dt e_k.
#
# This is (2.3) with (2.3b) put into (2.3c). A step longer than 2 / Kp does not settle: logs are split at
# long gaps before they come here.

_TURN = 2.0 * math.pi


def accelerometer_angles(ax_mps2: FloatArray, ay_mps2: FloatArray) -> FloatArray:
    """phi_acc (n,) [rad] of (2.1) in [-pi, pi]; right only while the sensor does not accelerate."""
    return np.arctan2(ay_mps2, ax_mps2)


def wrapped(angle_rad: FloatArray) -> FloatArray:
    """Angles (n,) taken to [-pi, pi] by whole turns."""
    return angle_rad - _TURN * np.rint(angle_rad / _TURN)


def mean_angle(angles: FloatArray) -> float:
    """Direction of the mean of unit vectors at the angles (n,) [rad]."""
    return math.atan2(float(np.sin(angles).mean()), float(np.cos(angles).mean()))


# A product and a sum may be rounded once; nothing else is loosened.
@kernel()
def advance(
    phi: float, integral: float, phi_acc: float, w: float, dt: float, Kp: float, Ki: float
) -> tuple[float, float]:
    """Angle and integral after one sample (2.3), compiled."""
    e = phi_acc - phi
    if not -math.pi <= e <= math.pi:
        e -= _TURN * np.rint(e / _TURN)
    turned = dt * (integral + w)
    return phi + (dt * (Kp + Ki * dt) * e + turned), integral + Ki * dt * e


@kernel()
def _run(
    t: FloatArray,
    phi_acc: FloatArray,
    w: FloatArray,
    Kp: float,
    Ki: float,
    out_phi: FloatArray,
    out_integral: FloatArray,
) -> None:
    before, phi, integral = t[0], out_phi[0], out_integral[0]
    for k in range(len(t)):
        phi, integral = advance(phi, integral, phi_acc[k], w[k], t[k] - before, Kp, Ki)
        before = t[k]
        out_phi[k] = phi
        out_integral[k] = integral


def filter_log(
    parameters: AngleFilter,
    t_s: FloatArray,
    phi_acc_rad: FloatArray,
    rate_radps: FloatArray,
    start: MahonyState | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Angle and integral after each sample of a log; gains that are unstable at its steps may overflow.

    Parameters
    ----------
    parameters : of either filter. The levelling filter takes the rate as straight between samples.
    t_s : (n,) time stamps that do not go back, one or more.
    phi_acc_rad : (n,) accelerometer's angles (2.1), wrapped or not, finite as the rate.
    rate_radps : (n,) rate of phi, which is -gz of a sensor in the plane.
    start : state at the first sample, whose own step is zero; without it the first accelerometer's
        angle and no integral.

    Returns
    -------
    phi_rad (n,), not wrapped, and integral_radps (n,), which goes to minus the bias of the rate.
    """
    t, phi_acc, w = (np.ascontiguousarray(x, dtype=np.float64) for x in (t_s, phi_acc_rad, rate_radps))
    state = MahonyState(float(phi_acc[0]), 0.0) if start is None else start
    phi, integral = np.empty(len(t)), np.empty(len(t))
    phi[0], integral[0] = state.phi_rad, state.integral_radps
    parameters.fill(t, phi_acc, w, phi, integral)
    return phi, integral
