"""The angle filter as a linear system, and gains from noise.

Without wrapping one step of (2.3) with the input v = phi_acc and a rate that errs by b is

    (phi, I)' = A (phi, I) + B v + (dt, 0) b,
    A = [[1 - dt (Kp + Ki dt), dt], [-Ki dt, 1]],   B = (dt (Kp + Ki dt), Ki dt).

In continuous time its poles are the roots of s^2 + Kp s + Ki.

It is the Kalman filter, settled, of the angle and the gyroscope's bias: with white noise N^2 on the rate,
K^2 on the bias' derivative and a density r of the accelerometer's angle the Riccati equation gives

    Ki = K / sqrt(r),   Kp = sqrt(N^2 / r + 2 Ki)          for dt -> 0,

so any pair with Kp^2 >= 2 Ki, damped by 1 / sqrt(2) or more, is a Kalman filter of some noise. For a
finite step the discrete equation is solved and its gains (L1, L2) of the prediction mapped by
Ki dt = -L2, dt (Kp + Ki dt) = L1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.mahony import Mahony

__all__ = ["DATA_SHEET", "GainFacts", "Noise", "equivalent_noise", "gain_facts", "predicted_sigma", "riccati"]

_BAND = 0.02
_LONGEST_STEPS = 400_000


@dataclass(frozen=True)
class Noise:
    """Densities in continuous time.

    Attributes
    ----------
    gyro : N of the rate [rad/s/sqrt(Hz)].
    walk : K of the bias [rad/s^2/sqrt(Hz)].
    accel : of the accelerometer's angle at low frequencies, motion included [rad/sqrt(Hz)].

    Raises `BadInputError` for densities that are not finite or not positive; the walk may be zero.
    """

    gyro: float
    walk: float
    accel: float

    def __post_init__(self) -> None:
        for name, value, least in (("gyro", self.gyro, 0.0), ("accel", self.accel, 0.0)):
            if not least < value < math.inf:
                raise BadInputError(f"density {name}: found {value:g}, expected more than zero")
        if not 0.0 <= self.walk < math.inf:
            raise BadInputError(f"density walk: found {self.walk:g}, expected zero or more")


DATA_SHEET = Noise(math.radians(0.01), 1e-4, 0.01)
"""Gyroscope N and bias walk K of consumer sensors; the accelerometer's is only a stand-in at rest."""


@dataclass(frozen=True)
class GainFacts:
    """What a pair of gains does at a step dt.

    Attributes
    ----------
    poles : the two, discrete; stable inside of the unit circle.
    damping : Kp / (2 sqrt(Ki)), infinite without Ki.
    bandwidth_hz : where the accelerometer's part has fallen by 3 dB.
    noise_gain : variance of the angle over that of white noise on phi_acc.
    bias_gain_s : angle left by a constant bias of the rate [rad per rad/s].
    bias_peak_s : largest angle on the way after the bias appears.
    settling_s : time after which an error of the start stays below 2 % of it.
    bias_settling_s : the same of the bias' estimate.
    lag_s : time after which a step that the accelerometer alone sees is followed half way.
    """

    poles: tuple[complex, complex]
    damping: float
    bandwidth_hz: float
    noise_gain: float
    bias_gain_s: float
    bias_peak_s: float
    settling_s: float
    bias_settling_s: float
    lag_s: float

    @property
    def stable(self) -> bool:
        """Whether all errors die out; a pole on the unit circle is the integral that is not used."""
        return max(abs(p) for p in self.poles) < 1.0


def _system(gains: Mahony, dt: float) -> tuple[FloatArray, FloatArray]:
    whole = dt * (gains.Kp + gains.Ki * dt)
    A = np.array([[1.0 - whole, dt], [-gains.Ki * dt, 1.0]])
    return A, np.array([whole, gains.Ki * dt])


def _bandwidth_hz(A: FloatArray, B: FloatArray, dt: float) -> float:
    f = np.geomspace(1e-5, 0.5, 4000) / dt
    z = np.exp(2j * math.pi * f * dt)
    # (z - A)^-1 B for its first row, times z: phi_k hears of v_k at once.
    determinant = (z - A[0, 0]) * (z - A[1, 1]) - A[0, 1] * A[1, 0]
    gain = np.abs(z * ((z - A[1, 1]) * B[0] + A[0, 1] * B[1]) / determinant)
    below = np.flatnonzero(gain < math.sqrt(0.5))
    beyond = below[below > int(np.argmax(gain))]
    return float(f[beyond[0]]) if len(beyond) else 0.5 / dt


def _settled(values: FloatArray, dt: float) -> float:
    outside = np.flatnonzero(np.abs(values) > _BAND * float(np.abs(values).max()))
    return math.inf if outside[-1] == len(values) - 1 else float(outside[-1] + 1) * dt


def _powers(A: FloatArray, x: FloatArray, steps: int) -> FloatArray:
    """A^k x (steps, 2) by doubling."""
    out = x[:, None]
    power = A
    while out.shape[1] < steps:
        out = np.concatenate([out, power @ out], axis=1)
        power = power @ power
    return out[:, :steps].T


def gain_facts(gains: Mahony, dt_s: float) -> GainFacts:
    """Poles, bandwidth, noise, rejection of a bias and settling of a pair of gains.

    Raises `BadInputError` for a step that is not positive and for gains that are unstable with it.
    """
    if not 0.0 < dt_s < math.inf:
        raise BadInputError(f"step: found {dt_s:g} s, expected more than zero")
    A, B = _system(gains, dt_s)
    poles = np.linalg.eigvals(A)
    size = float(np.abs(poles[np.abs(poles - 1.0) > 1e-12]).max(initial=0.0))
    if size >= 1.0 or gains.Kp == 0.0:
        raise BadInputError(
            f"gains Kp {gains.Kp:g}, Ki {gains.Ki:g} at steps of {dt_s:g} s: are not stable, expected "
            f"0 < Kp < {2.0 / dt_s:g}"
        )
    only = gains.Ki == 0.0
    damping = math.inf if only else gains.Kp / (2.0 * math.sqrt(gains.Ki))
    steps = min(math.ceil(math.log(1e-3) / math.log(size)) + 2, _LONGEST_STEPS)
    start = _powers(A, np.array([1.0, 0.0]), steps)[:, 0]
    toward = _powers(A, np.array([0.0, 1.0]), steps)
    # Of a bias that appears at once the angle is the sum of what each step adds.
    biased = dt_s * np.cumsum(start)
    if only:
        noise = float(B[0] ** 2 / (1.0 - A[0, 0] ** 2))
        left = dt_s / (1.0 - A[0, 0])
    else:
        noise = float(solve_discrete_lyapunov(A, np.outer(B, B))[0, 0])
        left = 0.0
    follow = np.cumsum(_powers(A, B, steps)[:, 0])
    half = np.flatnonzero(follow >= 0.5)
    return GainFacts(
        poles=(complex(poles[0]), complex(poles[1])),
        damping=damping,
        bandwidth_hz=_bandwidth_hz(A, B, dt_s),
        noise_gain=noise,
        bias_gain_s=left,
        bias_peak_s=float(np.abs(biased).max()),
        settling_s=_settled(start, dt_s),
        bias_settling_s=math.inf if only else _settled(toward[:, 1], dt_s),
        lag_s=float(half[0]) * dt_s if len(half) else math.inf,
    )


def predicted_sigma(gains: Mahony, noise: Noise, dt_s: float) -> float:
    """Standard deviation of the settled angle [rad] under these densities; infinite where none settles."""
    A, B = _system(gains, dt_s)
    if float(np.abs(np.linalg.eigvals(A)).max()) >= 1.0:
        return math.inf
    # With the bias' walk in I: the error of I is I + b.
    Q = np.diag([noise.gyro**2 * dt_s, noise.walk**2 * dt_s]) + noise.accel**2 / dt_s * np.outer(B, B)
    return math.sqrt(float(solve_discrete_lyapunov(A, Q)[0, 0]))


def riccati(noise: Noise, dt_s: float) -> Mahony:
    """Gains of the settled Kalman filter of angle and bias for these densities.

    Source: Higgins, IEEE Trans. Aerospace and Electronic Systems 11(3), 1975, for the equivalence.
    """
    if noise.walk == 0.0:
        # The bias is known in the end; what is left is the angle alone.
        q, R = noise.gyro**2 * dt_s, noise.accel**2 / dt_s
        variance = 0.5 * (q + math.sqrt(q * q + 4.0 * q * R))
        return Mahony(variance / (variance + R) / dt_s, 0.0)
    F = np.array([[1.0, -dt_s], [0.0, 1.0]])
    K2 = noise.walk**2
    Q = np.array(
        [
            [noise.gyro**2 * dt_s + K2 * dt_s**3 / 3.0, -0.5 * K2 * dt_s**2],
            [-0.5 * K2 * dt_s**2, K2 * dt_s],
        ]
    )
    R = noise.accel**2 / dt_s
    # Angles in units of the accelerometer's noise, for the solver's sake.
    scale = 1.0 / R
    P = solve_discrete_are(F.T, np.array([[1.0], [0.0]]), Q * scale, np.array([[1.0]]))
    L = F @ P[:, 0] / (P[0, 0] + 1.0)
    Ki = -float(L[1]) / dt_s
    return Mahony(float(L[0]) / dt_s - Ki * dt_s, Ki)


def equivalent_noise(gains: Mahony, accel: float) -> Noise:
    """Densities whose Kalman filter settles to these gains, for dt -> 0 and a given accelerometer.

    Below a damping of 1 / sqrt(2) there are none; the gyroscope's is then taken as nearly none.
    """
    square = max(gains.Kp**2 - 2.0 * gains.Ki, 1e-4 * gains.Kp**2)
    return Noise(accel * math.sqrt(square), accel * gains.Ki, accel)
