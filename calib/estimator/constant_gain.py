"""The kinematic filter with constant gains, for a controller that has no time for a covariance.

Once a tick of T the camera gives angle and length (phi_c, l_c), exposed d ticks ago, the gyroscope the mean
rate since the last tick and the accelerometer the angle atan2(a_y, a_x) less the mount. Angle and length are
apart then, with one level of `model.Level` each and a line of the last values behind:

    x_phi = (phi, dphi, ddphi, b, phi[k-1] ...),   z_phi = (phi_c, -g_z, phi_a)
    x_l   = (l, dl, ddl, l[k-1] ...),              z_l   = (l_c)
    x     <- F x,   x <- x + K (z - H x)

with b the gyroscope's bias in the sense of the angle, so that -g_z = (phi - phi[k-1]) / T + b, which holds
for any motion between the ticks. The line has max(d, 1) values. K is that of the stationary filter: P of the
discrete algebraic Riccati equation, K = P H' (H P H' + R)^-1 (Anderson and Moore 1979, 4.4). A missing
reading counts as expected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.estimator.model import Level, axis_noise, axis_transition
from calib.estimator.sensors import invert_marker, marker
from calib.estimator.setup import Rows, Setup

__all__ = [
    "MOST_DELAY_TICKS",
    "AxisGain",
    "TickNoise",
    "Ticks",
    "design",
    "run_gain",
    "tick_noise",
    "ticks_of",
]

MOST_DELAY_TICKS = 8


@dataclass(frozen=True)
class TickNoise:
    """Standard deviations of a tick's readings.

    Attributes
    ----------
    camera_rad, camera_m : of angle and length from a picture. gyro_radps : of the mean rate.
    accel_rad : of the accelerometer's angle, the head's own acceleration included.
    bias_walk_radps : density of the gyroscope's bias, per sqrt(s).
    """

    camera_rad: float
    camera_m: float
    gyro_radps: float
    accel_rad: float
    bias_walk_radps: float = 2e-5


@dataclass(frozen=True)
class AxisGain:
    """One axis: F (n, n), H (m, n), K (n, m), and the stationary deviations (n,) that the model expects."""

    F: FloatArray
    H: FloatArray
    K: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Ticks:
    """Readings at the ticks: t_s (n,), phi (n, 3) and length (n, 1), NaN where missing."""

    t_s: FloatArray
    phi: FloatArray
    length: FloatArray


def tick_noise(setup: Setup, level: Level, rate_hz: float) -> TickNoise:
    """Noise of a tick's readings from that of the sensors, at the head's rest.

    The accelerometer is trusted as far as the level's accelerations let it show gravity.
    """
    state, by = np.concatenate([setup.start.head, setup.start.sensor]), np.empty((2, 19))
    state[2:6] = 0.0
    marker(setup.view, state, by[0], by[1])
    inverse = np.linalg.inv(by[:, :2])
    pixel = setup.noise[0] ** 2 + setup.noise[1] ** 2 / 12.0
    camera = np.sqrt(pixel * np.sum(inverse**2, axis=1))
    samples = max(1.0 / (setup.imu_period_s * rate_hz), 1.0) if setup.imu_period_s > 0.0 else 1.0
    reach = 0.5 * float(setup.start.head[1]) + float(setup.start.sensor[5])
    shaken = level.accel_phi_radps2 * reach / setup.gravity_mps2
    return TickNoise(
        float(camera[0]),
        float(camera[1]),
        float(setup.noise[4]) / math.sqrt(samples),
        math.hypot(float(setup.noise[3]) / setup.gravity_mps2, shaken),
    )


def _axis(numbers: list[float], h: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (3, 3) of (p, v, a)."""
    f01, f02, f11, f12, f22 = axis_transition(numbers[0], numbers[1], h)
    pp, pv, pa, vv, va, aa = axis_noise(numbers[2], numbers[3], h)
    F = np.array([[1.0, f01, f02], [0.0, f11, f12], [0.0, 0.0, f22]])
    return F, np.array([[pp, pv, pa], [pv, vv, va], [pa, va, aa]])


def _stationary(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> AxisGain:
    from scipy.linalg import solve_discrete_are

    scale = np.sqrt(np.maximum(np.diag(Q), 1e-30))
    scale[scale < 1e-12] = scale.max()
    # The line of old values has no noise of its own; a trace of it keeps the pencil regular.
    f, h = F / scale[:, None] * scale, H * scale
    q = Q / scale[:, None] / scale + 1e-12 * np.eye(len(F))
    P = solve_discrete_are(f.T, h.T, q, R)
    K = np.asarray(np.linalg.solve(h @ P @ h.T + R, h @ P).T, dtype=np.float64)
    sigma = np.sqrt(np.maximum(np.diag(P - K @ h @ P), 0.0)) * scale
    return AxisGain(F, H, K * scale[:, None], np.asarray(sigma, dtype=np.float64))


def design(
    phi_level: Level, length_level: Level, noise: TickNoise, rate_hz: float, delay_ticks: int
) -> tuple[AxisGain, AxisGain]:
    """Gains for the angle with the first level's noise and for the length with the second's.

    Parameters
    ----------
    delay_ticks : how old a picture is when it arrives.

    Raises `BadInputError` for a rate that is not positive or a delay of more than `MOST_DELAY_TICKS`.
    """
    if not rate_hz > 0.0:
        raise BadInputError(f"rate_hz is {rate_hz:g}, expected a positive rate of ticks")
    if not 0 <= delay_ticks <= MOST_DELAY_TICKS:
        raise BadInputError(f"delay_ticks is {delay_ticks}, expected 0 to {MOST_DELAY_TICKS}")
    T, gains = 1.0 / rate_hz, []
    line = max(delay_ticks, 1)
    for axis, own, numbers in ((0, 4, phi_level.numbers()[:4]), (1, 3, length_level.numbers()[4:])):
        n = own + line
        F, Q = np.zeros((n, n)), np.zeros((n, n))
        parts = max(math.ceil(T / 0.005), 1)
        f, q = np.eye(3), np.zeros((3, 3))
        step, added = _axis(numbers, T / parts)
        for _ in range(parts):
            f, q = step @ f, step @ q @ step.T + added
        F[:3, :3], Q[:3, :3] = f, q
        if axis == 0:
            F[3, 3], Q[3, 3] = 1.0, noise.bias_walk_radps**2 * T
        for k in range(line):
            F[own + k, own + k - 1 if k else 0] = 1.0
        H = np.zeros((3 if axis == 0 else 1, n))
        H[0, n - 1 if delay_ticks else 0] = 1.0
        if axis == 0:
            H[1, 0], H[1, own], H[1, 3], H[2, 0] = 1.0 / T, -1.0 / T, 1.0, 1.0
            R = np.diag([noise.camera_rad, noise.gyro_radps, noise.accel_rad]) ** 2
        else:
            R = np.array([[noise.camera_m**2]])
        gains.append(_stationary(F, Q, H, R))
    return gains[0], gains[1]


def ticks_of(setup: Setup, rows: Rows) -> Ticks:
    """A tick at each picture or camera's tick of a log, as a controller sees it."""
    at = np.nonzero(rows.kinds & 1)[0]
    phi, length = np.full((len(at), 3), np.nan), np.full((len(at), 1), np.nan)
    sensor, last = setup.start.sensor, (0.0, float(setup.start.head[1]))
    scale, mount = 1.0 + sensor[4], float(sensor[3])
    before = 0
    for k, row in enumerate(at.tolist()):
        u, v = rows.readings[row, :2].tolist()
        if math.isfinite(u) and math.isfinite(v):
            found = invert_marker(setup.view, sensor, u, v, *last)
            if found[2]:
                last = found[:2]
                phi[k, 0], length[k, 0] = last
        since = rows.readings[before : row + 1]
        rates, accel = since[np.isfinite(since[:, 4]), 4], since[np.isfinite(since[:, 2:4]).all(axis=1), 2:4]
        if len(rates):
            phi[k, 1] = -(float(rates.mean()) - sensor[0]) / scale
        if len(accel):
            a_x, a_y = (accel[-1] - sensor[1:3]) / (1.0 + sensor[11:13])
            phi[k, 2] = math.atan2(a_y, a_x) - mount
        before = row + 1
    return Ticks(rows.t_s[at], phi, length)


@njit(cache=True, nogil=True, error_model="numpy")
def run_gain(F: FloatArray, H: FloatArray, K: FloatArray, z: FloatArray, start: float) -> FloatArray:
    """States (k, n) after each tick's readings z (k, m) of an axis that starts at rest at `start`."""
    n, m = K.shape
    out, x = np.empty((z.shape[0], n)), np.zeros(n)
    ahead, y = np.empty(n), np.empty(m)
    for j in range(n):
        # The value and its line; rates, acceleration and bias begin at zero.
        x[j] = start if j == 0 or (j >= (4 if m == 3 else 3)) else 0.0
    for k in range(z.shape[0]):
        for i in range(n):
            ahead[i] = 0.0
            for j in range(n):
                ahead[i] += F[i, j] * x[j]
        for i in range(m):
            y[i] = 0.0
            if not math.isnan(z[k, i]):
                y[i] = z[k, i]
                for j in range(n):
                    y[i] -= H[i, j] * ahead[j]
        for i in range(n):
            x[i] = ahead[i]
            for j in range(m):
                x[i] += K[i, j] * y[j]
            out[k, i] = x[i]
    return out
