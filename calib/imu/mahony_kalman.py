"""The angle filter with gains that start large: a Kalman filter of angle and gyro bias from a prior.

The constant gains of (2.3) take many seconds to learn the bias. A Kalman filter that starts from what is
known of it, a standard deviation, learns it as fast as the accelerometer's noise allows, and settles to
the gains of `calib.imu.gains.riccati`. With P of (phi, I) and I = -b one sample is

    s = P11 + r / dt,   Kp_k + Ki_k dt = (P11 + dt P12) / (s dt),   Ki_k = P12 / (s dt),
    P <- F (P - P1 P1' / s) F' + diag(N^2, K^2) dt,   F = [[1, dt], [0, 1]],

after which the step is (2.3) with Kp_k and Ki_k.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.gains import Noise
from calib.imu.mahony import MahonyState

__all__ = ["Prior", "Started", "filter_from_prior"]

_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Prior:
    """What is known before the first sample: standard deviations of the angle [rad] and bias [rad/s]."""

    angle_rad: float = 0.1
    bias_radps: float = 0.05


@dataclass(frozen=True)
class Started:
    """Angle and integral after each sample (n,), the gains that were used, and the last deviations.

    `sigma_phi_rad` and `sigma_bias_radps` (n,) are those that the filter itself believes in.
    """

    phi_rad: FloatArray
    integral_radps: FloatArray
    Kp_per_s: FloatArray
    Ki_per_s2: FloatArray
    sigma_phi_rad: FloatArray
    sigma_bias_radps: FloatArray


@njit(cache=True, nogil=True)
def _run(
    t: FloatArray,
    phi_acc: FloatArray,
    w: FloatArray,
    q: float,
    q_b: float,
    r: float,
    phi: float,
    integral: float,
    P11: float,
    P22: float,
    out: FloatArray,
) -> None:
    P12 = 0.0
    before = t[0]
    Kp = Ki = 0.0
    for k in range(len(t)):
        dt = t[k] - before
        before = t[k]
        if dt > 0.0:
            s = P11 + r / dt
            whole = (P11 + dt * P12) / (s * dt)
            Ki = P12 / (s * dt)
            Kp = whole - Ki * dt
            a11, a12, a22 = P11 - P11 * P11 / s, P12 - P11 * P12 / s, P22 - P12 * P12 / s
            P11 = a11 + 2.0 * dt * a12 + dt * dt * a22 + q * dt
            P12 = a12 + dt * a22
            P22 = a22 + q_b * dt
            e = phi_acc[k] - phi
            e -= _TURN * np.rint(e / _TURN)
            integral += Ki * e * dt
            phi += (Kp * e + integral + w[k]) * dt
        out[0, k] = phi
        out[1, k] = integral
        out[2, k] = Kp
        out[3, k] = Ki
        out[4, k] = math.sqrt(P11)
        out[5, k] = math.sqrt(P22)


def filter_from_prior(
    noise: Noise,
    prior: Prior,
    t_s: FloatArray,
    phi_acc_rad: FloatArray,
    rate_radps: FloatArray,
    start: MahonyState | None = None,
) -> Started:
    """The filter over a log, from the first accelerometer's angle or a given state.

    Parameters
    ----------
    t_s, phi_acc_rad, rate_radps : (n,) as of `calib.imu.mahony_batch.filter_log`.

    Raises
    ------
    BadInputError for lengths that differ, time that goes back, and values that are not finite.
    """
    t, phi_acc, w = (np.ascontiguousarray(x, dtype=np.float64) for x in (t_s, phi_acc_rad, rate_radps))
    if t.ndim != 1 or t.shape != phi_acc.shape or t.shape != w.shape or len(t) == 0:
        raise BadInputError(
            f"angle filter: found times {t.shape}, angles {phi_acc.shape} and rates {w.shape}, "
            "expected as many of each and at least one"
        )
    if not (np.isfinite(phi_acc).all() and np.isfinite(w).all() and (np.diff(t) >= 0.0).all()):
        raise BadInputError("angle filter: expected finite readings and time that runs forward")
    state = MahonyState(float(phi_acc[0]), 0.0) if start is None else start
    out = np.empty((6, len(t)))
    _run(
        t,
        phi_acc,
        w,
        noise.gyro**2,
        noise.walk**2,
        noise.accel**2,
        state.phi_rad,
        state.integral_radps,
        prior.angle_rad**2,
        prior.bias_radps**2,
        out,
    )
    return Started(*out)
