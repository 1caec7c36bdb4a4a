"""The angle of a whole log, from both of its ends: what a filter is judged by where nothing else is known.

The rate integrated, theta, follows every motion but drifts; the accelerometer's angle does not drift but
feels every acceleration. Their difference d = phi_acc - theta is explained by

    delta' = -(b + s w) + n,   b' = n_b,   c' = -c / tau + n_c,   d = delta + (X1 rx + X2 ry) + c + v

with the bias b and the scale error s of the gyroscope, a lever (rx, ry) from the centre of rotation to
the sensor, whose accelerations follow from the rate,

    X1 = (alpha cos phi + w^2 sin phi) / g,   X2 = (alpha sin phi - w^2 cos phi) / g,   alpha = dgz/dt,

white noises n, n_b of the gyroscope, and of the accelerometer white noise v and accelerations c that last
for a time tau. A Kalman filter forwards and the
smoother of Rauch, Tung and Striebel backwards give phi = theta + delta. How much of c and v there is
depends on the motion, and a rate that is not quite that of the angle adds to n: densities, tau and the
size of c are those that make the log most likely, from means over half a second. What the accelerometer
feels stays bounded and what the gyroscope gathers does not, by which the two are told apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.errors import BadInputError
from calib.imu.mahony_batch import wrapped

__all__ = ["BLOCK_S", "SHORTEST_S", "Smoothed", "smooth_log"]

_G = 9.80665
BLOCK_S = 0.05
_COARSE_S = 0.5
SHORTEST_S = 4.0
_LIKELY_BLOCKS = 2400
_LASTING_S = (0.3, 1.0, 3.0)
_LASTING_RAD = (2e-4, 6e-4, 2e-3, 6e-3, 2e-2, 6e-2)
_NONE_RAD = 1e-6
"""Size of c where there is none, which keeps the covariance regular."""
_STATES = 6
_BIAS_SIGMA_RADPS = 0.05
_SCALE_SIGMA = 0.02
_LEVER_SIGMA_M = 0.3
"""What data sheets leave open, and levers that a hand-sized rig can have; a log of seconds narrows them."""


@dataclass(frozen=True)
class Smoothed:
    """A log's own angle and what explains it.

    Attributes
    ----------
    phi_rad : (n,) angle, not wrapped.
    sigma_rad : its standard deviation, root of the mean square over the log.
    gyro_noise : density of the rate's error [rad/s/sqrt(Hz)], at least that of the sensor.
    accel_noise : density of the accelerometer's angle at low frequencies, motion included [rad/sqrt(Hz)].
    bias_radps, scale : of the rate, at the end of the log.
    lever_m : (2,) from the centre of rotation to the sensor, in its axes.
    """

    phi_rad: FloatArray
    sigma_rad: float
    gyro_noise: float
    accel_noise: float
    bias_radps: float
    scale: float
    lever_m: FloatArray


@njit(cache=True, nogil=True)
def _forward(
    z: FloatArray,
    X: FloatArray,
    dt: FloatArray,
    turn: FloatArray,
    q: float,
    q_b: float,
    r: float,
    tau: float,
    c: float,
    x: FloatArray,
    P: FloatArray,
    xs: FloatArray,
    Ps: FloatArray,
) -> float:
    """Kalman filter over blocks; fills the states (n, 6) and covariances (n, 6, 6) where there is room.

    Returns the logarithm of the likelihood, without its constant.
    """
    m = 6
    keep = len(xs) > 0
    x, P = x.copy(), P.copy()
    h, Ph = np.zeros(m), np.zeros(m)
    log_likelihood = 0.0
    for k in range(len(z)):
        if k > 0:
            # P <- F P F' with F the identity but for its first row (1, dt, turn, 0, 0, 0) and its last.
            a, b = dt[k], turn[k]
            x[0] += a * x[1] + b * x[2]
            for j in range(m):
                P[0, j] += a * P[1, j] + b * P[2, j]
            for i in range(m):
                P[i, 0] += a * P[i, 1] + b * P[i, 2]
            P[0, 0] += q * dt[k]
            P[1, 1] += q_b * dt[k]
            kept = math.exp(-dt[k] / tau)
            x[5] *= kept
            for j in range(m):
                P[5, j] *= kept
            for i in range(m):
                P[i, 5] *= kept
            P[5, 5] += c * c * (1.0 - kept * kept)
        h[3], h[4] = X[k, 0], X[k, 1]
        s, e = r / dt[k], z[k]
        for i in range(m):
            Ph[i] = P[i, 0] + P[i, 3] * h[3] + P[i, 4] * h[4] + P[i, 5]
        s += Ph[0] + h[3] * Ph[3] + h[4] * Ph[4] + Ph[5]
        e -= x[0] + h[3] * x[3] + h[4] * x[4] + x[5]
        for i in range(m):
            x[i] += Ph[i] / s * e
            for j in range(i + 1):
                P[i, j] -= Ph[i] * Ph[j] / s
                P[j, i] = P[i, j]
        log_likelihood -= 0.5 * (e * e / s + math.log(s))
        if keep:
            xs[k] = x
            Ps[k] = P
    return log_likelihood


@njit(cache=True, nogil=True)
def _backward(
    dt: FloatArray,
    turn: FloatArray,
    q: float,
    q_b: float,
    tau: float,
    c: float,
    xs: FloatArray,
    Ps: FloatArray,
) -> float:
    """Smooths the states in place; returns the mean variance of the first."""
    m = 6
    P_next, x_next = Ps[-1].copy(), xs[-1].copy()
    total = P_next[0, 0]
    F = np.eye(m)
    for k in range(len(xs) - 2, -1, -1):
        kept = math.exp(-dt[k + 1] / tau)
        F[0, 1], F[0, 2], F[5, 5] = dt[k + 1], turn[k + 1], kept
        ahead = F @ Ps[k]
        P_minus = ahead @ F.T
        P_minus[0, 0] += q * dt[k + 1]
        P_minus[1, 1] += q_b * dt[k + 1]
        P_minus[5, 5] += c * c * (1.0 - kept * kept)
        G = np.linalg.solve(P_minus, ahead).T
        x_next = xs[k] + G @ (x_next - F @ xs[k])
        P_next = Ps[k] + G @ (P_next - P_minus) @ G.T
        xs[k] = x_next
        total += P_next[0, 0]
    mean: float = total / len(xs)
    return mean


@dataclass(frozen=True)
class _Blocks:
    """Means over blocks: time, difference d, levers (n, 2), step and turn since the block before."""

    t_s: FloatArray
    d: FloatArray
    X: FloatArray
    dt: FloatArray
    turn: FloatArray


def _means(values: FloatArray, starts: FloatArray, counts: FloatArray) -> FloatArray:
    return np.asarray(np.add.reduceat(values, starts.astype(np.int64))) / counts


def _blocks(
    t: FloatArray, theta: FloatArray, w: FloatArray, phi_acc: FloatArray, d: FloatArray, size_s: float
) -> _Blocks:
    number = np.floor((t - t[0]) / size_s)
    starts = np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0).astype(np.float64)
    counts = np.diff(np.append(starts, len(t)))
    tb, th, db = (_means(values, starts, counts) for values in (t, theta, d))
    c, s, rate = (_means(values, starts, counts) for values in (np.cos(phi_acc), np.sin(phi_acc), w))
    dt = np.diff(tb, prepend=tb[0] - size_s)
    alpha = -np.gradient(rate, tb) if len(tb) > 2 else np.zeros(len(tb))
    X = np.stack([alpha * c + rate**2 * s, alpha * s - rate**2 * c], axis=1) / _G
    return _Blocks(tb, db, X, dt, np.diff(th, prepend=th[0]))


@njit(cache=True, nogil=True)
def _likelihoods(
    z: FloatArray,
    X: FloatArray,
    dt: FloatArray,
    turn: FloatArray,
    q_b: float,
    P: FloatArray,
    tried: FloatArray,
) -> FloatArray:
    """Logarithms of the likelihood of rows (n, 4) of q, r, tau, c."""
    out = np.empty(len(tried))
    for i in range(len(tried)):
        q, r, tau, c = tried[i]
        P[5, 5] = c * c
        out[i] = _forward(
            z, X, dt, turn, q, q_b, r, tau, c, np.zeros(6), P, np.zeros((0, 6)), np.zeros((0, 6, 6))
        )
    return out


def _likely(blocks: _Blocks, q_least: float, q_b: float, r_least: float, P: FloatArray) -> FloatArray:
    """q, r, tau and c of highest likelihood: over wide steps, then over narrow ones about the best."""
    few = slice(0, _LIKELY_BLOCKS)
    data = (blocks.d[few], blocks.X[few], blocks.dt[few], blocks.turn[few], q_b, P.copy())
    q, r = q_least * 4.0 ** np.arange(11), r_least * 4.0 ** np.arange(12)
    lasting = [(1.0, _NONE_RAD), *((tau, c) for tau in _LASTING_S for c in _LASTING_RAD)]
    rows = np.array([(a, b, tau, c) for a in q.tolist() for b in r.tolist() for tau, c in lasting])
    best = rows[int(np.argmax(_likelihoods(*data, rows)))]
    for step in (2.0, math.sqrt(2.0)):
        about = (1.0 / step, 1.0, step)
        rows = np.array([best * (a, b, e, f) for a in about for b in about for e in about for f in about])
        rows = np.maximum(rows, [q_least, r_least, 0.1, _NONE_RAD])
        best = rows[int(np.argmax(_likelihoods(*data, rows)))]
    return np.asarray(best)


def smooth_log(
    t_s: FloatArray, phi_acc_rad: FloatArray, rate_radps: FloatArray, gyro_noise: float, gyro_walk: float
) -> Smoothed:
    """The smoothed angle of a log without long gaps.

    Parameters
    ----------
    t_s, phi_acc_rad, rate_radps : (n,) as of `calib.imu.mahony_batch.filter_log`.
    gyro_noise, gyro_walk : densities N [rad/s/sqrt(Hz)] and K [rad/s^2/sqrt(Hz)] of the sensor.

    Raises `BadInputError` for a log of less than five seconds.

    Source: Rauch, Tung and Striebel, AIAA Journal 3(8), 1965, (3.30).
    """
    t = np.asarray(t_s, dtype=np.float64)
    if len(t) < 20 or t[-1] - t[0] < SHORTEST_S:
        raise BadInputError(
            f"smoothing: found {t[-1] - t[0]:.3g} s of samples, expected at least {SHORTEST_S:g} s"
        )
    step = np.diff(t, prepend=t[0])
    theta = np.cumsum(rate_radps * step)
    d = np.unwrap(wrapped(phi_acc_rad - theta))
    offset = float(np.median(d[:20]))
    d = d - offset
    # White noise of the readings themselves, below which the accelerometer's cannot be.
    period = (t[-1] - t[0]) / (len(t) - 1)
    r_least = max(0.5 * float(np.median(np.diff(d) ** 2)) / 0.4549 * period, 1e-12)
    q_b = gyro_walk**2
    P = np.diag([1.0, _BIAS_SIGMA_RADPS**2, _SCALE_SIGMA**2, _LEVER_SIGMA_M**2, _LEVER_SIGMA_M**2, 0.0])
    coarse = _blocks(t, theta, rate_radps, phi_acc_rad, d, _COARSE_S)
    q, r, tau, c = _likely(coarse, gyro_noise**2, q_b, r_least, P).tolist()
    P[5, 5] = c * c
    fine = _blocks(t, theta, rate_radps, phi_acc_rad, d, BLOCK_S)
    xs, Ps = np.empty((len(fine.d), _STATES)), np.empty((len(fine.d), _STATES, _STATES))
    _forward(fine.d, fine.X, fine.dt, fine.turn, q, q_b, r, tau, c, np.zeros(_STATES), P, xs, Ps)
    last = xs[-1].copy()
    variance = _backward(fine.dt, fine.turn, q, q_b, tau, c, xs, Ps)
    phi = theta + offset + np.interp(t, fine.t_s, xs[:, 0])
    # What lasts for tau counts at low frequencies with its size times the time that it lasts.
    slow = math.sqrt(r + 2.0 * c * c * tau)
    return Smoothed(phi, math.sqrt(variance), math.sqrt(q), slow, -float(last[1]), -float(last[2]), last[3:5])
