"""What pairs of gains cost: noise against lag, drift and settling, over the whole plane of gains.

Every pair is named by Kp and its damping zeta, Ki = Kp^2 / (4 zeta^2). In continuous time the shapes of
all answers depend on zeta alone and their times on 1 / Kp:

    bias of the rate -> angle      s / (s^2 + Kp s + Ki), a step of it peaks at
                                   exp(-zeta acos(zeta) / sqrt(1 - zeta^2)) / sqrt(Ki),
                                   with acosh and zeta^2 - 1 for zeta > 1
    accelerometer's angle -> angle (Kp s + Ki) / (s^2 + Kp s + Ki)

Noise is that of the discrete filter, from its Lyapunov equation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.errors import BadInputError
from calib.imu.gains import Noise
from calib.imu.mahony import Mahony

__all__ = ["Frontier", "damped", "frontier", "gain_grid"]

_HIGHEST_KP = 20.0
_LOWEST_KP = 0.02
_LOWEST_DAMPING, _HIGHEST_DAMPING = 0.15, 10.0


@dataclass(frozen=True)
class Frontier:
    """Facts of pairs of gains, each (n,).

    Attributes
    ----------
    Kp, Ki, damping : the pairs.
    noise_gain : variance of the angle over that of white noise on the accelerometer's angle.
    lag_s : time to follow half of a step that the accelerometer alone sees.
    bias_peak_s : largest angle after a bias appears, over the bias [rad per rad/s].
    settling_s : time in which the slower pole takes an error to 2 %.
    sigma_rad : predicted deviation under the log's densities.
    best : pairs that no other beats in noise and settling at once.
    """

    Kp: FloatArray
    Ki: FloatArray
    damping: FloatArray
    noise_gain: FloatArray
    lag_s: FloatArray
    bias_peak_s: FloatArray
    settling_s: FloatArray
    sigma_rad: FloatArray
    best: BoolArray


def damped(Kp: float, damping: float) -> Mahony:
    """The pair of this Kp and damping ratio."""
    return Mahony(Kp, Kp * Kp / (4.0 * damping * damping))


def gain_grid(dt_s: float, kp: int = 25, dampings: int = 17) -> tuple[FloatArray, FloatArray]:
    """Values of Kp (kp,) and of the damping (dampings,), evenly spaced in their logarithms.

    From what a minute of data can tell to what the step allows. Raises `BadInputError` for steps of more
    than a second or none.
    """
    if not 0.0 < dt_s <= 1.0:
        raise BadInputError(f"step: found {dt_s:g} s, expected 0 to 1 s")
    highest = min(_HIGHEST_KP, 0.5 / dt_s)
    return (
        np.geomspace(min(_LOWEST_KP, 0.1 * highest), highest, kp),
        np.geomspace(_LOWEST_DAMPING, _HIGHEST_DAMPING, dampings),
    )


def _variance(A: FloatArray, Q: FloatArray) -> FloatArray:
    """First element (n,) of P = A P A' + Q for pairs (n, 2, 2)."""
    a, b, c, d = A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1]
    one = np.ones_like(a)
    # Unknowns P11, P12, P22.
    M = np.stack(
        [
            np.stack([one - a * a, -2.0 * a * b, -b * b], axis=-1),
            np.stack([-a * c, one - a * d - b * c, -b * d], axis=-1),
            np.stack([-c * c, -2.0 * c * d, one - d * d], axis=-1),
        ],
        axis=-2,
    )
    right = np.stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]], axis=-1)
    return np.asarray(np.linalg.solve(M, right[..., None])[:, 0, 0])


def _half_time(damping: float) -> float:
    """Time times Kp after which a step is followed half way."""
    Ki = 1.0 / (4.0 * damping * damping)
    roots = np.roots([1.0, 1.0, Ki]).astype(np.complex128)
    if abs(roots[0] - roots[1]) < 1e-6:
        roots[0] *= 1.0 + 1e-5
    # The error is 1 at first and falls with slope 1.
    tau = np.linspace(0.0, 1.5, 3001)
    s1, s2 = roots
    error = ((-1.0 - s2) * np.exp(s1 * tau) - (-1.0 - s1) * np.exp(s2 * tau)) / (s1 - s2)
    return float(np.interp(0.5, 1.0 - error.real, tau))


def _bias_peak(damping: FloatArray) -> FloatArray:
    """Peak times sqrt(Ki), of a step of the bias."""
    z = np.where(np.abs(damping - 1.0) < 1e-6, 1.0 + 1e-6, damping)
    root = np.sqrt(np.abs(1.0 - z * z))
    angle = np.where(z < 1.0, np.arccos(np.minimum(z, 1.0)), np.arccosh(np.maximum(z, 1.0)))
    return np.asarray(np.exp(-z * angle / root))


def frontier(noise: Noise, dt_s: float, kp: int = 25, dampings: int = 17) -> Frontier:
    """The facts of a grid of gains for a log's densities and step."""
    K, Z = gain_grid(dt_s, kp, dampings)
    Kp, damping = (x.ravel() for x in np.meshgrid(K, Z, indexing="ij"))
    Ki = Kp**2 / (4.0 * damping**2)
    whole = dt_s * (Kp + Ki * dt_s)
    A = np.empty((len(Kp), 2, 2))
    A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = 1.0 - whole, dt_s, -Ki * dt_s, 1.0
    B = np.stack([whole, Ki * dt_s], axis=-1)
    BB = B[:, :, None] * B[:, None, :]
    own = np.diag([noise.gyro**2 * dt_s, noise.walk**2 * dt_s])
    slowest = np.abs(np.linalg.eigvals(A)).max(axis=1)
    settling = dt_s * math.log(0.02) / np.log(slowest)
    noise_gain = _variance(A, BB)
    order = np.lexsort((settling, noise_gain))
    best = np.zeros(len(Kp), dtype=np.bool_)
    least = np.minimum.accumulate(settling[order])
    best[order] = np.concatenate([[True], least[1:] < least[:-1]])
    return Frontier(
        Kp=Kp,
        Ki=Ki,
        damping=damping,
        noise_gain=noise_gain,
        lag_s=np.repeat([[_half_time(z) for z in Z.tolist()]], len(K), axis=0).ravel() / Kp,
        bias_peak_s=_bias_peak(damping) / np.sqrt(Ki),
        settling_s=settling,
        sigma_rad=np.sqrt(_variance(A, own + noise.accel**2 / dt_s * BB)),
        best=best,
    )
