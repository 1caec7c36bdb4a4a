"""Gains of the angle filter: judged on data held back, compared with a Kalman filter and a smoother."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from scipy.special import ndtri, stdtrit

from calib.core.arrays import FloatArray, IntArray, integral, robust_sigma
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.core.result import degrees_or_none, finite_or_none, judged
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Finding, Severity, Verdict
from calib.stages.imu.levelling import Levelling
from calib.stages.imu.levelling import system as levelling_system
from calib.stages.imu.mahony import AngleFilter, Mahony, filter_log, mean_angle, wrapped
from calib.stages.imu.sampling import Sampling, sensor_findings
from calib.stages.imu.section import FilterCandidate, FilterLog, OrientationFilter

F = TypeVar("F", Mahony, Levelling)


# ----------------------------------------------------------------------
# The angle filter as a linear system, and gains from noise.
#
# Without wrapping one step of (2.3) with the input v = phi_acc and a rate that errs by b is
#
#     (phi, I)' = A (phi, I) + B v + (dt, 0) b,
#     A = [[1 - dt (Kp + Ki dt), dt], [-Ki dt, 1]],   B = (dt (Kp + Ki dt), Ki dt).
#
# In continuous time its poles are the roots of s^2 + Kp s + Ki.
#
# It is the Kalman filter, settled, of the angle and the gyroscope's bias: with white noise N^2 on the rate,
# K^2 on the bias' derivative and a density r of the accelerometer's angle the Riccati equation gives
#
#     Ki = K / sqrt(r),   Kp = sqrt(N^2 / r + 2 Ki)          for dt -> 0,
#
# so any pair with Kp^2 >= 2 Ki, damped by 1 / sqrt(2) or more, is a Kalman filter of some noise. For a
# finite step the discrete equation is solved and its gains (L1, L2) of the prediction mapped by
# Ki dt = -L2, dt (Kp + Ki dt) = L1.

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
    """

    gyro: float
    walk: float
    accel: float


DATA_SHEET = Noise(math.radians(0.01), 1e-4, 0.01)
"""Gyroscope N and bias walk K of consumer sensors; the accelerometer's is only a stand-in at rest."""


def _system(gains: AngleFilter, dt: float) -> tuple[FloatArray, FloatArray]:
    """A (m, m) and B (m,) of the settled filter; the state begins with the angle and the integral."""
    if isinstance(gains, Levelling):
        return levelling_system(gains, dt)
    whole = dt * (gains.Kp + gains.Ki * dt)
    A = np.array([[1.0 - whole, dt], [-gains.Ki * dt, 1.0]])
    return A, np.array([whole, gains.Ki * dt])


def _bandwidth_hz(A: FloatArray, B: FloatArray, dt: float) -> float:
    f = np.geomspace(1e-5, 0.5, 4000) / dt
    z = np.exp(2j * math.pi * f * dt)
    # The first element of (z - A)^-1 B, times z: phi_k hears of v_k at once.
    inner = z[:, None, None] * np.eye(len(B)) - A
    gain = np.abs(z * np.linalg.solve(inner, np.broadcast_to(B[:, None], (len(z), len(B), 1)))[:, 0, 0])
    below = np.flatnonzero(gain < math.sqrt(0.5))
    beyond = below[below > int(np.argmax(gain))]
    return float(f[beyond[0]]) if len(beyond) else 0.5 / dt


def _settled(values: FloatArray, dt: float) -> float:
    outside = np.flatnonzero(np.abs(values) > _BAND * float(np.abs(values).max()))
    return math.inf if outside[-1] == len(values) - 1 else float(outside[-1] + 1) * dt


def _powers(A: FloatArray, x: FloatArray, steps: int) -> FloatArray:
    """A^k x (steps, m) by doubling."""
    out = x[:, None]
    power = A
    while out.shape[1] < steps:
        out = np.concatenate([out, power @ out], axis=1)
        power = power @ power
    return out[:, :steps].T


def gain_facts(gains: AngleFilter, dt_s: float) -> dict[str, Any]:
    """Poles, bandwidth, noise, rejection of a bias and settling, by the keys of `FilterCandidate`.

    Of the filter with its settled gains; times are None where nothing settles. Raises
    `BadInputError` for gains that are unstable with the step.
    """
    A, B = _system(gains, dt_s)
    poles = np.linalg.eigvals(A)
    size = float(np.abs(poles[np.abs(poles - 1.0) > 1e-12]).max(initial=0.0))
    only = isinstance(gains, Mahony) and gains.Ki == 0.0
    if size >= 1.0 or (isinstance(gains, Mahony) and gains.Kp == 0.0):
        raise BadInputError(f"{gains} is not stable at steps of {dt_s:g} s, expected 0 < Kp < {2.0 / dt_s:g}")
    steps = min(math.ceil(math.log(1e-3) / math.log(size)) + 2, _LONGEST_STEPS)
    unit = np.eye(len(B))
    start = _powers(A, unit[0], steps)[:, 0]
    toward = _powers(A, unit[1], steps)
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
    return {
        "poles": [[float(pole.real), float(pole.imag)] for pole in poles],
        "bandwidth_hz": _bandwidth_hz(A, B, dt_s),
        "noise_gain": noise,
        "bias_gain_s": left,
        "bias_peak_s": float(np.abs(biased).max()),
        "settling_s": finite_or_none(_settled(start, dt_s)),
        "bias_settling_s": None if only else finite_or_none(_settled(toward[:, 1], dt_s)),
        "lag_s": float(half[0]) * dt_s if len(half) else None,
    }


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


# ----------------------------------------------------------------------
# Held-out errors of filters, compared by a block bootstrap.
#
# The errors of an angle are correlated over seconds, so that samples are no independent witnesses. A
# circular block bootstrap (Politis and Romano, in Exploring the Limits of Bootstrap, 1992) draws runs of a
# tenth of the log, 2 to 60 s. All filters are drawn with the same runs: what they have in common cancels
# in their difference.
#
# With m runs, about ten, the spread of the draws is too small and not well known. Runs about their common
# mean lose a share 1 / m of the variance, and a variance from overlapping runs has 1.5 m degrees of freedom
# (Kuensch, Annals of Statistics 17, 1989). So deviations from the estimate are widened by
#
#     sqrt(m / (m - 1)) t(1.5 m) / z,   t and z the 97.5 % points of Student's and the normal distribution,
#
# and intervals of an error, which is a scale, are those of its logarithm, turned about the estimate: an error
# that was found too small was found with too small a spread.

CONFIDENCE = 0.95
_RESAMPLES = 2000
_FINEST_S = 0.5
_MOST_BLOCKS = 600
_SEED = 20


@dataclass(frozen=True)
class Candidate:
    """A filter and its held-out errors.

    Attributes
    ----------
    name : "3/3", "tuned", "riccati" or "levelling".
    gains : those that would be used.
    whole_rad : error of `gains` on the whole logs, which for "tuned" they were tuned on.
    rmse_rad, low_rad, high_rad : held-out error and its 95 % interval; this and the rest are NaN where
        nothing was judged.
    less_rad, less_low_rad, less_high_rad : error less that of 3/3, and its 95 % interval.
    confidence : share of the resamples in which it is less.
    """

    name: str
    gains: AngleFilter
    whole_rad: float = math.nan
    rmse_rad: float = math.nan
    low_rad: float = math.nan
    high_rad: float = math.nan
    less_rad: float = math.nan
    less_low_rad: float = math.nan
    less_high_rad: float = math.nan
    confidence: float = math.nan

    @property
    def wins(self) -> bool:
        """Whether its error is less than that of 3/3 with 95 %."""
        return self.confidence >= CONFIDENCE


def _block_sums(errors: Sequence[FloatArray], size: int) -> tuple[FloatArray, FloatArray]:
    """Sums of squares and counts in consecutive blocks of `size` samples."""
    totals, counts = [], []
    for e in errors:
        known = np.isfinite(e)
        starts = np.arange(0, len(e), size)
        totals.append(np.add.reduceat(np.where(known, e, 0.0) ** 2, starts))
        counts.append(np.add.reduceat(known.astype(np.float64), starts))
    return np.concatenate(totals), np.concatenate(counts)


def _resampled(blocks: int, length: int) -> IntArray:
    """Numbers of the blocks (resamples, blocks) in runs of `length`, round the end."""
    rng = np.random.default_rng(_SEED)
    runs = -(-blocks // length)
    first = rng.integers(0, blocks, size=(_RESAMPLES, runs))
    at = (first[:, :, None] + np.arange(length)) % blocks
    return np.asarray(at.reshape(_RESAMPLES, -1)[:, :blocks])


def _widening(runs: float) -> float:
    """By how much deviations of the draws from the estimate are too small, for a number of runs."""
    m = max(runs, 2.0)
    return math.sqrt(m / (m - 1.0)) * float(stdtrit(1.5 * m, 0.975) / ndtri(0.975))


def rms(errors: Sequence[FloatArray]) -> float:
    """Root mean square of errors in several pieces, NaN not counted."""
    whole = np.concatenate(errors)
    return math.sqrt(float(np.nanmean(whole**2)))


def compared(
    candidates: Sequence[Candidate], errors_rad: Sequence[Sequence[FloatArray]], dt_s: float
) -> tuple[tuple[Candidate, ...], float]:
    """Candidates with their held-out errors, and the length of the bootstrap's blocks [s].

    Parameters
    ----------
    candidates : 3/3 first.
    errors_rad : of each candidate those (n_i,) in each log, NaN where not judged, all of the same samples.
    """
    judged_s = dt_s * sum(int(np.isfinite(errors).sum()) for errors in errors_rad[0])
    size = max(round(max(_FINEST_S, judged_s / _MOST_BLOCKS) / dt_s), 1)
    block_s = min(max(judged_s / 10.0, 2.0), 60.0)
    tables = [_block_sums(errors, size) for errors in errors_rad]
    length = min(max(round(block_s / (size * dt_s)), 1), len(tables[0][0]))
    at = _resampled(len(tables[0][0]), length)
    drawn = [
        np.sqrt(total[at].sum(axis=1) / np.maximum(count[at].sum(axis=1), 1.0)) for total, count in tables
    ]
    base, wide = rms(errors_rad[0]), _widening(len(tables[0][0]) / length)
    out = []
    for one, errors, draws in zip(candidates, errors_rad, drawn, strict=True):
        rmse = rms(errors)
        off = wide * (np.log(np.maximum(draws, 1e-300)) - math.log(max(rmse, 1e-300)))
        high, low = (rmse * np.exp(-np.quantile(off, [0.025, 0.975]))).tolist()
        less = rmse - base
        apart = less + wide * (draws - drawn[0] - less)
        less_interval = np.quantile(apart, [0.025, 0.975]).tolist()
        judged = (rmse, low, high, less, *less_interval, float((apart < 0.0).mean()))
        out.append(Candidate(one.name, one.gains, one.whole_rad, *judged))
    return tuple(out), block_s


# ----------------------------------------------------------------------
# The angle of a whole log, from both of its ends: what a filter is judged by where nothing else is known.
#
# The rate integrated, theta, follows every motion but drifts; the accelerometer's angle does not drift but
# feels every acceleration. Their difference d = phi_acc - theta is explained by
#
#     delta' = -(b + s w) + n,   b' = n_b,   c' = -c / tau + n_c,   d = delta + asin(X1 rx + X2 ry) + c + v
#
# with the bias b and the scale error s of the gyroscope, a lever (rx, ry) from the centre of rotation to
# the sensor, whose accelerations follow from the rate,
#
#     X1 = (alpha cos phi_acc + w^2 sin phi_acc) / g,   X2 = (alpha sin phi_acc - w^2 cos phi_acc) / g,
#
# with alpha = dgz/dt, the slope of cubics over 0.2 s: one that dampens a swing, or that is as noisy as
# differences, has the scale explain what the lever did. The arcsine is linearised, first about no lever, then
# about the one that was found. There are
#
# white noises n, n_b of the gyroscope, and of the accelerometer white noise v and accelerations c that last
# for a time tau. A Kalman filter forwards and the smoother of Rauch, Tung and Striebel backwards give phi =
# theta + delta. How much of c and v there is depends on the motion, and a rate that is not quite that of the
# angle adds to n: densities, tau and the size of c are those that make the log most likely, from means over
# a quarter of a second. What the accelerometer feels stays bounded and what the gyroscope gathers does not,
# by which the two are told apart.

BLOCK_S = 0.05
_COARSE_S = 0.25
_SLOPE_S, _SLOPE_POWER = 0.2, 3
_LINEARISED = 2
_MOST_SINE = 0.9
SHORTEST_S = 4.0
_LIKELY_BLOCKS = 2400
_LASTING_S = (0.3, 1.0, 3.0)
_LASTING_RAD = (2e-4, 6e-4, 2e-3, 6e-3, 2e-2, 6e-2)
_NONE_RAD = 1e-6
"""Size of c where there is none, which keeps the covariance regular."""
_NOISIER = 9
_STATES = 6
_SURE_LIKELIHOOD = 2.0
"""Logarithm by which a likelihood is higher where one number is two standard deviations off."""
_KNOCK = 6.0
"""Standard deviations of an innovation from which on its variance is what it is itself."""
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
    bias_radps : of the rate, at the end of the log.
    scale, scale_sigma : of the rate, over the angle's.
    """

    phi_rad: FloatArray
    sigma_rad: float
    gyro_noise: float
    accel_noise: float
    bias_radps: float
    scale: float
    scale_sigma: float


class _Blocks(NamedTuple):
    """Means over blocks: time, difference d, levers (n, 2), step and turn since the block before."""

    t_s: FloatArray
    d: FloatArray
    X: FloatArray
    dt: FloatArray
    turn: FloatArray


class _Densities(NamedTuple):
    """q and q_b of the rate and its bias, r of v, and tau and size of c."""

    q: float
    q_b: float
    r: float
    tau: float
    c: float


@kernel()
def _forward(blocks: _Blocks, of: _Densities, P: FloatArray, xs: FloatArray, Ps: FloatArray) -> float:
    """Kalman filter over blocks; fills the states (n, 6) and covariances (n, 6, 6) where there is room.

    Returns the logarithm of the likelihood, without its constant.
    """
    m = 6
    keep = len(xs) > 0
    dt, turn, X = blocks.dt, blocks.turn, blocks.X
    x, P = np.zeros(m), P.copy()
    P[5, 5] = of.c * of.c
    h, Ph = np.zeros(m), np.zeros(m)
    log_likelihood = 0.0
    for k in range(len(dt)):
        if k > 0:
            # P <- F P F' with F the identity but for its first row (1, dt, turn, 0, 0, 0) and its last.
            a, b = dt[k], turn[k]
            x[0] += a * x[1] + b * x[2]
            for j in range(m):
                P[0, j] += a * P[1, j] + b * P[2, j]
            for i in range(m):
                P[i, 0] += a * P[i, 1] + b * P[i, 2]
            P[0, 0] += of.q * dt[k]
            P[1, 1] += of.q_b * dt[k]
            kept = math.exp(-dt[k] / of.tau)
            x[5] *= kept
            for j in range(m):
                P[5, j] *= kept
            for i in range(m):
                P[i, 5] *= kept
            P[5, 5] += of.c * of.c * (1.0 - kept * kept)
        h[3], h[4] = X[k, 0], X[k, 1]
        s, e = of.r / dt[k], blocks.d[k]
        for i in range(m):
            Ph[i] = P[i, 0] + P[i, 3] * h[3] + P[i, 4] * h[4] + P[i, 5]
        s += Ph[0] + h[3] * Ph[3] + h[4] * Ph[4] + Ph[5]
        e -= x[0] + h[3] * x[3] + h[4] * x[4] + x[5]
        # A knock is no noise: what is further off counts for as little as if it were foreseen.
        s = max(s, e * e / (_KNOCK * _KNOCK))
        for i in range(m):
            x[i] += Ph[i] / s * e
            for j in range(i + 1):
                P[i, j] -= Ph[i] * Ph[j] / s
                P[j, i] = P[i, j]
        log_likelihood -= 0.5 * (e * e / s + math.log(s))
        if keep:
            for i in range(m):
                xs[k, i] = x[i]
                for j in range(m):
                    Ps[k, i, j] = P[i, j]
    return log_likelihood


def _backward(blocks: _Blocks, of: _Densities, xs: FloatArray, Ps: FloatArray) -> float:
    """Smooths the states in place; returns the mean variance of the first."""
    steps, dt = len(xs) - 1, blocks.dt[1:]
    F, Q = np.tile(np.eye(_STATES), (steps, 1, 1)), np.zeros((steps, _STATES, _STATES))
    kept = np.exp(-dt / of.tau)
    F[:, 0, 1], F[:, 0, 2], F[:, 5, 5] = dt, blocks.turn[1:], kept
    Q[:, 0, 0], Q[:, 1, 1], Q[:, 5, 5] = of.q * dt, of.q_b * dt, of.c * of.c * (1.0 - kept * kept)
    ahead = F @ Ps[:-1]
    P_minus = ahead @ F.transpose(0, 2, 1) + Q
    G = np.linalg.solve(P_minus, ahead).transpose(0, 2, 1)
    x_minus = (F @ xs[:-1, :, None])[..., 0]
    P = Ps[-1]
    total = float(P[0, 0])
    for k in range(steps - 1, -1, -1):
        xs[k] += G[k] @ (xs[k + 1] - x_minus[k])
        P = Ps[k] + G[k] @ (P - P_minus[k]) @ G[k].T
        total += float(P[0, 0])
    return total / len(xs)


def _means(values: FloatArray, starts: FloatArray, counts: FloatArray) -> FloatArray:
    return np.asarray(np.add.reduceat(values, starts.astype(np.int64))) / counts


def _levers(t: FloatArray, w: FloatArray, phi_acc: FloatArray) -> FloatArray:
    """X (n, 2)."""
    from scipy.signal import savgol_filter

    size = max(2 * int(0.5 * _SLOPE_S * (len(t) - 1) / (t[-1] - t[0])) + 1, _SLOPE_POWER + 2)
    slope, step = (savgol_filter(values, size, _SLOPE_POWER, deriv=1) for values in (w, t))
    alpha, c, s = -slope / step, np.cos(phi_acc), np.sin(phi_acc)
    return np.stack([alpha * c + w**2 * s, alpha * s - w**2 * c], axis=1) / GRAVITY_MPS2


def _blocks(t: FloatArray, theta: FloatArray, d: FloatArray, X: FloatArray, size_s: float) -> _Blocks:
    # Stamps on the border of two blocks begin the later one, however they are rounded.
    number = np.floor((t - t[0]) / size_s + 1e-6)
    starts = np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0).astype(np.float64)
    counts = np.diff(np.append(starts, len(t)))
    tb, th, db, X1, X2 = (_means(values, starts, counts) for values in (t, theta, d, *X.T))
    dt = np.diff(tb, prepend=tb[0] - size_s)
    return _Blocks(tb, db, np.stack([X1, X2], axis=1), dt, np.diff(th, prepend=th[0]))


@kernel()
def _likelihoods(blocks: _Blocks, q_b: float, P: FloatArray, tried: FloatArray) -> FloatArray:
    """Logarithms of the likelihood of rows (n, 4) of q, r, tau, c."""
    out = np.empty(len(tried))
    for i in range(len(tried)):
        q, r, tau, c = tried[i]
        of = _Densities(q, q_b, r, tau, c)
        out[i] = _forward(blocks, of, P, np.zeros((0, 6)), np.zeros((0, 6, 6)))
    return out


def _first(blocks: _Blocks) -> _Blocks:
    """Those that a likelihood is computed of."""
    return _Blocks(*(values[:_LIKELY_BLOCKS] for values in blocks))


def _most_likely(blocks: _Blocks, q_b: float, P: FloatArray, tried: FloatArray) -> FloatArray:
    """Row (4,) of highest likelihood of `tried` (n, 4)."""
    return np.asarray(tried[int(np.argmax(_likelihoods(_first(blocks), q_b, P, tried)))])


def _likely(blocks: _Blocks, q_least: float, q_b: float, r_least: float, P: FloatArray) -> FloatArray:
    """q, r, tau and c of highest likelihood: over wide steps, then over narrow ones about the best.

    q is the least one unless the blocks are sure that it is more.
    """
    q, r = q_least * 4.0 ** np.arange(11), r_least * 4.0 ** np.arange(12)
    lasting = [(1.0, _NONE_RAD), *((tau, c) for tau in _LASTING_S for c in _LASTING_RAD)]
    rows = np.array([(a, b, tau, c) for a in q.tolist() for b in r.tolist() for tau, c in lasting])
    likely = _likelihoods(_first(blocks), q_b, P, rows)
    # Of a few swings the likelihood hardly tells q; the rate errs as the sensor until a log is sure of more.
    least = rows[:, 0] == q_least
    if likely[least].max() > likely.max() - _SURE_LIKELIHOOD:
        rows, likely = rows[least], likely[least]
    best = np.asarray(rows[int(np.argmax(likely))])
    for step in (2.0, math.sqrt(2.0)):
        about = (1.0 / step, 1.0, step)
        noisier = about if best[0] > q_least else (1.0,)
        rows = np.array([best * (a, b, e, f) for a in noisier for b in about for e in about for f in about])
        rows = np.maximum(rows, [q_least, r_least, 0.1, _NONE_RAD])
        best = _most_likely(blocks, q_b, P, rows)
    return best


def smooth_log(
    t_s: FloatArray, phi_acc_rad: FloatArray, rate_radps: FloatArray, gyro_noise: float, gyro_walk: float
) -> Smoothed:
    """The smoothed angle of a log without long gaps.

    Parameters
    ----------
    t_s, phi_acc_rad, rate_radps : (n,) as of `calib.stages.imu.mahony.filter_log`.
    gyro_noise, gyro_walk : densities N [rad/s/sqrt(Hz)] and K [rad/s^2/sqrt(Hz)] of the sensor.

    Raises `BadInputError` for a log of less than five seconds.

    Source: Rauch, Tung and Striebel, AIAA Journal 3(8), 1965, (3.30).
    """
    t = np.asarray(t_s, dtype=np.float64)
    if len(t) < 20 or t[-1] - t[0] < SHORTEST_S:
        raise BadInputError(
            f"smoothing: found {t[-1] - t[0]:.3g} s of samples, expected at least {SHORTEST_S:g} s"
        )
    theta = integral(t, rate_radps)
    d = np.unwrap(wrapped(phi_acc_rad - theta))
    offset = float(np.median(d[:20]))
    d = d - offset
    # White noise of the readings themselves, below which the accelerometer's cannot be.
    period = (t[-1] - t[0]) / (len(t) - 1)
    r_least = max(0.5 * float(np.median(np.diff(d) ** 2)) / 0.4549 * period, 1e-12)
    q_b = gyro_walk**2
    P = np.diag([1.0, _BIAS_SIGMA_RADPS**2, _SCALE_SIGMA**2, _LEVER_SIGMA_M**2, _LEVER_SIGMA_M**2, 0.0])
    levers, lever_m = _levers(t, rate_radps, phi_acc_rad), np.zeros(2)
    for _ in range(_LINEARISED):
        sine = np.clip(levers @ lever_m, -_MOST_SINE, _MOST_SINE)
        X = levers / np.sqrt(1.0 - sine**2)[:, None]
        left = d - np.arcsin(sine) + X @ lever_m
        coarse, fine = (_blocks(t, theta, left, X, size_s) for size_s in (_COARSE_S, BLOCK_S))
        q, r, tau, c = _likely(coarse, gyro_noise**2, q_b, r_least, P).tolist()
        # What swings within a quarter of a second is noise that only the fine blocks show.
        noisier = np.array([(q, r * 4.0**k, tau, c) for k in range(_NOISIER)])
        r = float(_most_likely(fine, q_b, P, noisier)[1])
        xs, Ps = np.empty((len(fine.d), _STATES)), np.empty((len(fine.d), _STATES, _STATES))
        of = _Densities(q, q_b, r, tau, c)
        _forward(fine, of, P, xs, Ps)
        lever_m = xs[-1, 3:5].copy()
    last, scale_sigma = xs[-1].copy(), math.sqrt(float(Ps[-1, 2, 2]))
    variance = _backward(fine, of, xs, Ps)
    phi = theta + offset + np.interp(t, fine.t_s, xs[:, 0])
    # What lasts for tau counts at low frequencies with its size times the time that it lasts.
    slow = math.sqrt(r + 2.0 * c * c * tau)
    bias, scale = -float(last[1]), 1.0 - float(last[2])
    return Smoothed(phi, math.sqrt(variance), math.sqrt(q), slow, bias, scale, scale_sigma)


def damped(Kp: float, damping: float) -> Mahony:
    """The pair of this Kp and damping ratio."""
    return Mahony(Kp, Kp * Kp / (4.0 * damping * damping))


def gain_grid(dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Values of Kp (25,) and of the damping (17,), evenly spaced in their logarithms.

    From what a minute of data can tell to what the step allows. Raises `BadInputError` for steps of more
    than a second or none.
    """
    if not 0.0 < dt_s <= 1.0:
        raise BadInputError(f"step: found {dt_s:g} s, expected 0 to 1 s")
    highest = min(_HIGHEST_KP, 0.5 / dt_s)
    return (
        np.geomspace(min(_LOWEST_KP, 0.1 * highest), highest, 25),
        np.geomspace(_LOWEST_DAMPING, _HIGHEST_DAMPING, 17),
    )


# ----------------------------------------------------------------------
# Filters from logs, tuned on some parts and judged on the others.
#
# The judge is a reference angle where the logs have one, and the log's own smoothed angle where they do not.
# For Gaussian errors the latter is no makeshift: the expected square of a filter's error, given the log, is
# the square of its distance from the smoothed angle plus the smoother's variance, which no gains change. It
# holds as far as the smoother's model does, so a log that contradicts the model has no judge of its own.
#
# A filter runs over each log from its first sample with an empty integral, as firmware does. It is judged
# when it has had five seconds to settle: logs that begin in a swing begin with any angle. The logs are
# cut into parts; the errors of a tuned filter in a part are those of the parameters that are best in all
# other parts. Whether they are less than those of 3/3 is asked of a block bootstrap. Only a filter that wins
# with 95 % is recommended, with the parameters that are best in all parts; of several that win, the one with
# the least held-out error.
#
# Of pairs within 3 % of the least error the best damped is taken: a short log does not tell them apart,
# and a pair that rings has fitted the log's start.

THREE = Mahony(3.0, 3.0)
_HIGHEST_KP = 20.0
_LOWEST_KP = 0.02
_LOWEST_DAMPING, _HIGHEST_DAMPING = 0.15, 10.0
_ALIKE = 1.03
_LEAST_JUDGED_S = 8.0
_WORSE = 100.0
_SETTLE_S = 5.0
_SETTLE_SHARE = 0.25
_PART_S = 8.0
_MOST_PARTS = 8
"""Parts of a log: eight where it is longer than a minute, none shorter than some swings."""
_TAU_S = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
_VELOCITY_MPS = (0.01, 0.03, 0.1, 0.3)
"""Levelling filters that are tried: from a filter that trusts the accelerometer to one that a walk allows."""


@dataclass(frozen=True)
class Piece:
    """A log without long gaps.

    Attributes
    ----------
    t_s, phi_acc_rad, rate_radps : (n,) as of `calib.stages.imu.mahony.filter_log`.
    reference_rad : (n,) the true angle but for a constant, NaN where it is not known; None without one.
    in_plane : False where the rate is known not to be the angle's; the log then cannot judge itself.
    """

    source: str
    t_s: FloatArray
    phi_acc_rad: FloatArray
    rate_radps: FloatArray
    reference_rad: FloatArray | None = None
    in_plane: bool = True


@dataclass(frozen=True)
class Surface:
    """Root mean square error (kp, dampings) on the whole logs over the grid of gains."""

    Kp: FloatArray
    damping: FloatArray
    rmse_rad: FloatArray


@dataclass(frozen=True)
class Tuning:
    """What tuning found.

    Attributes
    ----------
    judge : "reference", "smoothed", or "none" where nothing could be judged.
    candidates : with 3/3 first; without errors (NaN) where nothing could be judged.
    recommended : one of them.
    reasons : why.
    held_out : best gains Kp, Ki without each part, empty where nothing could be judged.
    surface : None where nothing could be judged.
    smoothed : of each piece, None where it is too short.
    noise : densities of the sensor with the accelerometer's in motion.
    offset_rad : what was added to each piece's reference.
    judged_s : length of what was judged, `block_s` that of the bootstrap's blocks.
    """

    judge: str
    candidates: tuple[Candidate, ...]
    recommended: Candidate
    reasons: tuple[str, ...]
    held_out: tuple[Mahony, ...]
    surface: Surface | None
    smoothed: tuple[Smoothed | None, ...]
    noise: Noise
    offset_rad: tuple[float, ...]
    judged_s: float
    block_s: float

    @property
    def mahony(self) -> Mahony:
        """Gains of (2.3): the recommended ones, else the best of those that win, else 3/3."""
        pairs = [self.recommended, *sorted(self.candidates, key=lambda one: one.rmse_rad)]
        return next((p.gains for p in pairs if isinstance(p.gains, Mahony) and p.wins), THREE)


@dataclass(frozen=True)
class _Judged:
    """A piece with the angle that it is judged by, NaN where it is not, and each sample's part."""

    piece: Piece
    target: FloatArray
    part: IntArray

    def errors(self, gains: AngleFilter) -> FloatArray:
        """Errors (n,) of a filter that runs from the first sample on."""
        one = self.piece
        return wrapped(filter_log(gains, one.t_s, one.phi_acc_rad, one.rate_radps)[0] - self.target)


def _parted(pieces: Sequence[tuple[Piece, FloatArray]], dt_s: float) -> tuple[tuple[_Judged, ...], int]:
    """Pieces in parts that are judged for as long as each other, and how many parts there are."""
    out, count = [], 0
    for piece, target in pieces:
        known = np.cumsum(np.isfinite(target))
        parts = int(np.clip(known[-1] * dt_s / _PART_S, 2, _MOST_PARTS))
        out.append(_Judged(piece, target, count + np.minimum(parts * known // (known[-1] + 1), parts - 1)))
        count += parts
    return tuple(out), count


def _sums(judged: Sequence[_Judged], filters: Sequence[AngleFilter], parts: int) -> FloatArray:
    """Sums (filters, parts) of squared errors, infinite where they overflow."""
    out = np.zeros((len(filters), parts))
    for one in judged:
        for row, gains in zip(out, filters, strict=True):
            row += np.bincount(one.part, np.nan_to_num(one.errors(gains)) ** 2, parts)
    return np.where(np.isfinite(out), out, np.inf)


def _pick(gains: Sequence[Mahony], errors: FloatArray) -> Mahony:
    """The best damped of the pairs whose error is nearly the least, up to critical damping."""
    near = np.flatnonzero(errors <= _ALIKE**2 * errors.min()).tolist()
    rank = {k: min(round(gains[k].Kp / (2.0 * math.sqrt(gains[k].Ki)), 3), 1.0) for k in near}
    most = max(rank.values())
    return gains[min((k for k in near if rank[k] == most), key=lambda k: float(errors[k]))]


def _best(
    tried: Sequence[F], sums: FloatArray, pick: Callable[[Sequence[F], FloatArray], F]
) -> tuple[F, tuple[F, ...]]:
    """The filter that is picked by all parts, and those by all but each."""
    whole = sums.sum(axis=1)
    return pick(tried, whole), tuple(pick(tried, whole - own) for own in sums.T)


def _search(judged: Sequence[_Judged], dt_s: float, parts: int) -> tuple[Mahony, tuple[Mahony, ...], Surface]:
    """Best gains of (2.3) for these logs, those without each part, and the errors over the grid."""
    K, Z = gain_grid(dt_s)
    tried = [damped(k, z) for k in K.tolist() for z in Z.tolist()]
    sums = _sums(judged, tried, parts)
    count = sum(int(np.isfinite(one.target).sum()) for one in judged)
    surface = Surface(K, Z, np.sqrt(sums.sum(axis=1) / count).reshape(len(K), len(Z)))
    step_k, step_z = float(K[1] / K[0]), float(Z[1] / Z[0])
    for _ in range(3):
        step_k, step_z = math.sqrt(step_k), math.sqrt(step_z)
        at = tried[int(np.argmin(sums.sum(axis=1)))]
        zeta = at.Kp / (2.0 * math.sqrt(at.Ki))
        more = [
            damped(
                float(np.clip(at.Kp * step_k**i, K[0], K[-1])),
                float(np.clip(zeta * step_z**j, Z[0], Z[-1])),
            )
            for i, j in product((-1, 0, 1), repeat=2)
            if i or j
        ]
        tried += more
        sums = np.concatenate([sums, _sums(judged, more, parts)])
    return *_best(tried, sums, _pick), surface


def _crossed(judged: Sequence[_Judged], filters: Sequence[AngleFilter]) -> list[FloatArray]:
    """Errors of each log, in each part those of the filter that has not seen it."""
    out = []
    for one in judged:
        errors = np.empty(len(one.part))
        for k in np.unique(one.part).tolist():
            errors[one.part == k] = one.errors(filters[k])[one.part == k]
        out.append(errors)
    return out


def _smoothed(piece: Piece, sensor: Noise) -> Smoothed | None:
    if piece.t_s[-1] - piece.t_s[0] < SHORTEST_S:
        return None
    return smooth_log(piece.t_s, piece.phi_acc_rad, piece.rate_radps, sensor.gyro, sensor.walk)


def _astray(own: Smoothed, sensor: Noise) -> bool:
    """Whether the smoothed angle is the accelerometer's alone, or the rate worse than any gyroscope's."""
    return own.gyro_noise * BLOCK_S > own.accel_noise or own.gyro_noise > _WORSE * sensor.gyro


def _offset(piece: Piece, smoothed: Smoothed | None) -> float:
    """What brings the reference to the accelerometer's zero: how the sensor is mounted."""
    assert piece.reference_rad is not None
    own = piece.phi_acc_rad if smoothed is None else smoothed.phi_rad
    apart = own - piece.reference_rad
    known = apart[np.isfinite(apart)]
    middle = mean_angle(known)
    return middle + float(wrapped(known - middle).mean())


def tune(pieces: Sequence[Piece], sensor: Noise) -> Tuning:
    """A filter for these logs, and whether it is worth more than 3/3.

    Parameters
    ----------
    pieces : logs of the same rate; where one has a reference, only those that have one are judged.
    sensor : densities of the sensor; the accelerometer's is that of a log too short to tell its own.
    """
    smoothed = tuple(_smoothed(piece, sensor) for piece in pieces)
    spans = [len(piece.t_s) for piece in pieces]
    known = [(n, s.accel_noise) for n, s in zip(spans, smoothed, strict=True) if s is not None]
    accel = sensor.accel
    if known:
        accel = math.sqrt(sum(n * a * a for n, a in known) / sum(n for n, _ in known))
    noise = Noise(sensor.gyro, sensor.walk, accel)
    dt_s = float(np.median([(p.t_s[-1] - p.t_s[0]) / max(len(p.t_s) - 1, 1) for p in pieces]))
    judge = "reference" if any(p.reference_rad is not None for p in pieces) else "smoothed"
    with_target, offsets, reasons = [], [], []
    for piece, own in zip(pieces, smoothed, strict=True):
        offset = 0.0
        target: FloatArray | None = None if own is None else own.phi_rad
        if judge == "reference":
            target = None
            if piece.reference_rad is not None and int(np.isfinite(piece.reference_rad).sum()) >= 20:
                offset = _offset(piece, own)
                target = piece.reference_rad + offset
        elif own is not None and not piece.in_plane:
            reasons.append(f"{piece.source}: the sensor tilts out of the plane, so that -gz is not its rate.")
            target = None
        elif own is not None and _astray(own, sensor):
            reasons.append(
                f"{piece.source}: rate and accelerometer differ by {math.degrees(own.gyro_noise):.2g} "
                "deg/s/sqrt(Hz). The rate is not that of the angle, or the sensor is pushed for seconds; the "
                "log cannot judge itself, an outside angle (--reference) could judge."
            )
            target = None
        offsets.append(offset)
        if target is not None:
            span_s = float(piece.t_s[-1] - piece.t_s[0])
            late = piece.t_s - piece.t_s[0] >= min(_SETTLE_S, _SETTLE_SHARE * span_s)
            with_target.append((piece, np.where(late, target, np.nan)))
    judged_s = sum(float(np.isfinite(target).sum()) for _, target in with_target) * dt_s
    settled, surface, block_s = riccati(noise, dt_s), None, math.nan
    held_out: tuple[Mahony, ...] = ()
    why: tuple[str, ...]
    if judged_s < _LEAST_JUDGED_S:
        judge = "none"
        candidates: tuple[Candidate, ...] = (Candidate("3/3", THREE), Candidate("riccati", settled))
        recommended, why = candidates[0], (
            f"There are {judged_s:.3g} s to judge gains by, expected at least {_LEAST_JUDGED_S:g} s: "
            "3/3 is kept.",
        )  # fmt: skip
    else:
        judged, parts = _parted(with_target, dt_s)
        tuned, held_out, surface = _search(judged, dt_s, parts)
        tried = [Levelling(tau, v) for tau in _TAU_S if tau >= 2.0 * dt_s for v in _VELOCITY_MPS]
        levelling, levelling_held_out = _best(
            tried, _sums(judged, tried, parts), lambda filters, errors: filters[int(np.argmin(errors))]
        )

        rivals, errors = [], []
        for name, gains, crossed in (
            ("3/3", THREE, ()),
            ("tuned", tuned, held_out),
            ("riccati", settled, ()),
            ("levelling", levelling, levelling_held_out),
        ):
            whole = [one.errors(gains) for one in judged]
            rivals.append(Candidate(name, gains, rms(whole)))
            errors.append(_crossed(judged, crossed) if crossed else whole)
        candidates, block_s = compared(rivals, errors, dt_s)
        recommended, why = _recommended(candidates, judge)
    return Tuning(
        judge, candidates, recommended, (*reasons, *why), held_out, surface, smoothed, noise, tuple(offsets),
        judged_s, block_s,
    )  # fmt: skip


def _recommended(candidates: Sequence[Candidate], judge: str) -> tuple[Candidate, tuple[str, ...]]:
    """The best of those that win, else 3/3, and why."""
    by = "the reference" if judge == "reference" else "the log's own smoothed angle"
    base = candidates[0]
    reasons = []
    for one in candidates[1:]:
        held = "" if one.name == "riccati" else " on parts that it was not tuned on"
        wanted = "" if one.wins else f", expected {100.0 * CONFIDENCE:g} %"
        reasons.append(
            f"By {by} {one.name} leaves {math.degrees(one.rmse_rad):.3f} deg{held}, 3/3 "
            f"{math.degrees(base.rmse_rad):.3f} deg; it is better with "
            f"{100.0 * one.confidence:.3g} %{wanted}."
        )
    best = min((one for one in candidates if one.wins), key=lambda one: one.rmse_rad, default=base)
    reasons.append(f"{best.name} is {'kept' if best is base else 'recommended'}.")
    return best, tuple(reasons)


# ----------------------------------------------------------------------
# Whether a log's sensors speak of the same motion. Gains of logs that contradict themselves are nobody's.
#
# Rate and reference are compared over spans of some seconds, in which the bias is a straight line; outliers
# of the reference are cut. Thresholds are sizes that change gains, several times what sound logs show.

_SPAN_S = 4.0
_TURNS_RAD = math.radians(1.0)
_MOST_SCALE = 0.1
_MOST_APART = 0.3
_MOST_APART_RAD = math.radians(2.0)
_MOST_LATE_S = 0.06
_LEFT_OF_FELT, _LEFT_OF_REST = 0.2, 0.35
_LATER_S = 0.03
"""What a sensor's own low-pass at 5 Hz does to its readings."""
_SURE = 3.0
_LATE_S = 0.01 * np.arange(-30, 31)
_MOST_RATE_ERROR = math.radians(1.5)
_TIMES_THE_SENSOR = 10.0
_MOST_TURNED_RAD = math.radians(5.0)
_MEAN_S, _FEWEST_MEANS = 2.0, 5
_TURNED_SLOWLY_RAD = math.radians(3.0)
_ALIKE_SLOWLY = 0.5


def _level(t_s: FloatArray, values: FloatArray) -> FloatArray:
    """Angles (n,) less a straight line in each span, NaN where they are or where a span has too few."""
    known = np.isfinite(values)
    span = ((t_s - t_s[0]) / _SPAN_S).astype(np.int64)
    of, most = span[known], int(span[-1]) + 1
    count = np.bincount(of, minlength=most)

    def mean(x: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(of, x, most) / np.maximum(count, 1))

    t, y = t_s[known], values[known]
    t, y = t - mean(t)[of], y - mean(y)[of]
    slope = mean(t * y) / np.maximum(mean(t * t), 1e-300)
    out = np.full(len(values), np.nan)
    out[known] = np.where(count[of] >= 20, y - slope[of] * t, np.nan)
    return out


def contradicted(t_s: FloatArray, rate_radps: FloatArray, seen_rad: FloatArray) -> str:
    """How a rate contradicts a reference of its angle; empty where it does not or hardly anything turns."""
    known = np.isfinite(seen_rad)
    theta = integral(t_s, rate_radps)
    a, b = _level(t_s, np.where(known, theta, np.nan)), _level(t_s, seen_rad)
    kept = np.isfinite(a) & np.isfinite(b)
    a, b = a[kept], b[kept]
    if len(a) < 20 or max(float(a.std()), float(b.std())) < 2.0 * _TURNS_RAD:
        return ""
    scale = 1.0
    for _ in range(3):
        rest = b - scale * a
        near = np.abs(rest) <= 4.0 * max(robust_sigma(rest), 1e-6)
        scale = float(a[near] @ b[near]) / max(float(a[near] @ a[near]), 1e-12)
    rest = b - scale * a
    # What jumps from sample to sample is the reference's own noise, as that of a marker in whole pixels.
    noise_rad = robust_sigma(np.diff(rest)) / math.sqrt(2.0)
    left_rad = math.sqrt(max(robust_sigma(rest) ** 2 - noise_rad**2, 0.0))
    most = max(float(a.std()), float(b[np.abs(b) <= 4.0 * b.std()].std()))
    if left_rad > max(_MOST_APART * most, _MOST_APART_RAD):
        return f"the rate leaves {math.degrees(left_rad):.2g} of {math.degrees(most):.2g} deg unexplained"
    # A share of the turns that noise alone could feign is no scale.
    if abs(scale - 1.0) > _MOST_SCALE and abs(scale - 1.0) * float(a.std()) > max(_TURNS_RAD, left_rad / 3.0):
        return f"the angle turns {scale:.3g} times as far as the rate says"
    return ""


def _slowly(t_s: FloatArray, own_rad: FloatArray, seen_rad: FloatArray) -> str:
    """How means over spans of a reference contradict those of the IMU's own angle; empty where they do not.

    Slow turns are the accelerometer's own, and the rate has no say in them.
    """
    known = np.isfinite(seen_rad)
    span = ((t_s - t_s[0]) / _MEAN_S).astype(np.int64)[known]
    count = np.bincount(span)
    full = count > 0.5 * max(float(count.max(initial=0)), 1.0)
    if int(full.sum()) < _FEWEST_MEANS:
        return ""
    own, seen = (np.bincount(span, x[known])[full] / count[full] for x in (own_rad, seen_rad))
    own, seen = own - own.mean(), seen - seen.mean()
    if max(float(own.std()), float(seen.std())) < _TURNED_SLOWLY_RAD:
        return ""
    # A cart that brakes is felt and does not turn. Errors of either angle flatten the regression on it, so
    # that the scale lies between both regressions; angles that hardly resemble each other tell none.
    both = float(own @ seen) / max(float(np.linalg.norm(own) * np.linalg.norm(seen)), 1e-12)
    if abs(both) < _ALIKE_SLOWLY:
        return ""
    ratio = float(seen.std() / own.std())
    least, most = sorted((both * ratio, ratio / both))
    scale = min(max(1.0, least), most)
    if abs(scale - 1.0) <= _MOST_SCALE or abs(scale - 1.0) * float(own.std()) <= _TURNS_RAD:
        return ""
    return f"the angle turns {scale:.3g} times as far as the accelerometer says"


def _rate_error(piece: Piece, own: Smoothed) -> float:
    """Density of the rate's error [rad/s/sqrt(Hz)] by the log itself, or by its reference where that is less.

    A log that is pushed for seconds blames its rate for what the accelerometer feels. Means over a span of an
    angle that walks by N differ from each other by N sqrt(2 span / 3).
    """
    if piece.reference_rad is None:
        return own.gyro_noise
    known = np.isfinite(piece.reference_rad)
    span = ((piece.t_s - piece.t_s[0]) / _MEAN_S).astype(np.int64)[known]
    off = np.unwrap((piece.reference_rad - integral(piece.t_s, piece.rate_radps))[known])
    count = np.bincount(span)
    if int((count > 0).sum()) < _FEWEST_MEANS:
        return own.gyro_noise
    steps = np.diff(np.bincount(span, off)[count > 0] / count[count > 0])
    return min(own.gyro_noise, float(steps.std()) / math.sqrt(2.0 * _MEAN_S / 3.0))


def _late(t_s: FloatArray, phi_acc_rad: FloatArray, rate_radps: FloatArray) -> float:
    """By how much the accelerometer's angle comes later than the rate's [s]; 0 where that is not clear.

    What a lever adds to the accelerometer's angle grows with the angular acceleration, and in a swing
    looks like half a period; it is taken out for each lag that is tried.
    """
    theta = integral(t_s, rate_radps)
    turning = np.convolve(np.gradient(rate_radps, t_s), np.full(5, 0.2), "same")
    angles = np.unwrap(phi_acc_rad)
    felt = _level(t_s, angles)
    known = np.isfinite(felt)
    if int(known.sum()) < 20 or float(_level(t_s, theta)[known].std()) < 2.0 * _TURNS_RAD:
        return 0.0
    rests = []
    for late in _LATE_S.tolist():
        apart, lever = angles - np.interp(t_s - late, t_s, theta), np.interp(t_s - late, t_s, turning)
        kept = known
        # A jerk, as of a head that is let go, has no say in the lever and in what is level.
        for _ in range(3):
            x, y = (_level(t_s, np.where(kept, values, np.nan)) for values in (lever, apart))
            kept = np.isfinite(y)
            rest = y - float(y[kept] @ x[kept]) / max(float(x[kept] @ x[kept]), 1e-12) * x
            spread = robust_sigma(rest[kept])
            kept = kept & (np.abs(rest) <= 4.0 * max(spread, 1e-6))
        rests.append(spread)
    k, zero = int(np.argmin(rests)), len(rests) // 2
    clear = rests[k] < min(_LEFT_OF_FELT * robust_sigma(felt[known]), _LEFT_OF_REST * rests[zero])
    return float(_LATE_S[k]) if clear and k not in (0, len(rests) - 1) else 0.0


def _off(own: Smoothed) -> float:
    """What the scale of the rate does to the angle over the log [rad, RMS]."""
    return abs(own.scale - 1.0) * float(own.phi_rad.std())


def _later(t_s: FloatArray, phi_acc_rad: FloatArray, rate_radps: FloatArray) -> tuple[float, float]:
    """As `_late`, of lags that are short beside the motion, and what it does to the angle [rad, RMS].

    The difference of both angles is a lag times the rate, and a lever times the angular acceleration; its
    deviation is that of sums over a second.
    """
    apart = _level(t_s, np.unwrap(phi_acc_rad) - integral(t_s, rate_radps))
    turning = np.convolve(np.gradient(rate_radps, t_s), np.full(5, 0.2), "same")
    known = np.isfinite(apart)
    if int(known.sum()) < 20:
        return 0.0, 0.0
    X = np.stack([-_level(t_s, rate_radps)[known], _level(t_s, turning)[known]], axis=1)
    apart, of = apart[known], (t_s[known] - t_s[0]).astype(np.int64)
    kept, fit = np.isfinite(apart), np.zeros(2)
    for _ in range(3):
        fit = np.asarray(np.linalg.lstsq(X[kept], apart[kept], rcond=None)[0], dtype=np.float64)
        left = apart - X @ fit
        kept = np.abs(left) <= 4.0 * max(robust_sigma(left), 1e-6)
    size = float(X[kept, 0] @ X[kept, 0])
    together = np.bincount(of, np.where(kept, X[:, 0] * left, 0.0))
    sigma = math.sqrt(float(together @ together)) / max(size, 1e-300)
    late = float(fit[0])
    off_rad = abs(late) * math.sqrt(size / int(kept.sum()))
    # Accelerations of the sensor's own that are partly in step with its turns leave more than a lag does.
    rest_rad = float(left[kept].std())
    if abs(late) - _SURE * sigma <= _LATER_S or rest_rad > _LEFT_OF_REST * math.hypot(off_rad, rest_rad):
        return 0.0, 0.0
    return late, off_rad


def _contradiction(piece: Piece, own: Smoothed | None, noise: Noise) -> tuple[str, Severity] | None:
    """What in a log contradicts what else of it, and how badly; None where all speaks of one motion.

    A rate that errs is "poor" alone, for a sensor that lies flat errs as one with wrong columns does.
    """
    t_s, rate, seen = piece.t_s, piece.rate_radps, piece.reference_rad
    if seen is not None and (what := contradicted(t_s, rate, seen)):
        return f"rate and reference contradict each other: {what}", "inconsistent"
    if own is None or not piece.in_plane:
        return None
    if seen is not None and (what := _slowly(t_s, own.phi_rad, seen)):
        return f"accelerometer and reference contradict each other: {what}", "inconsistent"
    if abs(late_s := _late(t_s, piece.phi_acc_rad, rate)) > _MOST_LATE_S:
        return f"{_lateness(late_s)}, or it is pushed in step with its turns", "inconsistent"
    if (errs := _rate_error(piece, own)) > max(_TIMES_THE_SENSOR * noise.gyro, _MOST_RATE_ERROR):
        return (
            "rate and accelerometer contradict each other: the rate, unless the sensor is pushed for "
            f"seconds, errs by {math.degrees(errs):.2g} deg/s/sqrt(Hz), the sensor by "
            f"{math.degrees(noise.gyro):.2g}"
        ), "poor"
    if abs(own.scale - 1.0) - _SURE * own.scale_sigma > _MOST_SCALE and _off(own) > _TURNS_RAD:
        what = f"the rate turns {own.scale:.3g} times as far as the accelerometer's angle"
        return f"rate and accelerometer contradict each other: {what}", "poor"
    late_s, off_rad = _later(t_s, piece.phi_acc_rad, rate)
    if off_rad > _TURNS_RAD:
        turned = f"which is {math.degrees(off_rad):.2g} deg (RMS) in these turns"
        return f"{_lateness(late_s)}, {turned}, or it is pushed in step with them", "inconsistent"
    return None


def _lateness(late_s: float) -> str:
    when = "later" if late_s > 0.0 else "earlier"
    return f"the accelerometer's angle comes {1e3 * abs(late_s):.0f} ms {when} than the rate's"


def contradictions(pieces: Sequence[Piece], result: Tuning) -> list[Finding]:
    """Findings on logs whose rate, accelerometer and reference do not speak of the same motion."""
    out: dict[str, Finding] = {}

    def found(source: str, what: str, severity: Severity) -> None:
        advice = "check the columns, signs and units of that log"
        # A rate that errs alone may be that of a sensor that lies flat.
        advice += ", and that gravity lies in its x-y plane" if severity == "poor" else ""
        out.setdefault(source, Finding(severity, f"{source}: {what}", advice))

    for piece, own in zip(pieces, result.smoothed, strict=True):
        if (what := _contradiction(piece, own, result.noise)) is not None:
            found(piece.source, *what)
    offsets = [
        (piece.source, offset)
        for piece, offset in zip(pieces, result.offset_rad, strict=True)
        if piece.reference_rad is not None and piece.source not in out
    ]
    middle = float(np.median([offset for _, offset in offsets])) if offsets else 0.0
    for source, offset in offsets:
        apart = float(wrapped(np.array(offset - middle)))
        if abs(apart) > _MOST_TURNED_RAD:
            found(
                source,
                f"the angle of its accelerometer differs from the reference by {math.degrees(apart):.3g} deg "
                "more than that of the other logs, as if the sensor were mounted otherwise",
                "inconsistent",
            )
    return list(out.values())


# ----------------------------------------------------------------------
# The section.

_TILTED = 3.0
_SCALED_RAD = math.radians(0.5)
_RINGS = 0.5


@dataclass(frozen=True)
class TuneLog:
    """A log on an even grid.

    Attributes
    ----------
    pieces : without gaps of more than a second.
    reference : "truth", "camera", "onchip" or "" for none, and by how much it came late.
    quiet_radps : standard deviation of gz in the quiet windows.
    said : what is to be known about the log. findings : on its sensors.
    """

    source: str
    sampling: Sampling
    pieces: tuple[Piece, ...]
    reference: str
    lag_s: float
    quiet_radps: float
    said: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


def solve_tune(
    logs: Sequence[TuneLog], noise: Noise, densities_from: str, tilted: bool = False
) -> OrientationFilter:
    """Tune on logs of one rate, judge on what was held back, and assemble the section.

    Parameters
    ----------
    noise : densities of the sensor; `densities_from` says where they are from.
    tilted : whether the up vector is used.
    """
    pieces = [piece for log in logs for piece in log.pieces]
    result = tune(pieces, noise)
    dt_s = float(np.median([log.sampling.period_s for log in logs]))
    chosen, mahony = result.recommended, result.mahony
    levelling = next((one.gains for one in result.candidates if isinstance(one.gains, Levelling)), None)
    held_out = [[one.Kp, one.Ki] for one in result.held_out]
    sigma: dict[str, float | None] = {}
    if held_out and chosen.name == "tuned":
        # The jackknife's deviation.
        spread = np.std(np.array(held_out), axis=0) * math.sqrt(len(held_out) - 1)
        sigma = dict(zip(("Kp_per_s", "Ki_per_s2"), spread.tolist(), strict=True))
    by: Literal["reference", "smoothed", "default"] = "default"
    if chosen.name != "3/3":
        by = "reference" if result.judge == "reference" else "smoothed"
    severity: Literal["poor", "remark"] = "poor" if result.judge == "none" else "remark"
    findings = [Finding(severity, text) for text in result.reasons]
    findings += [one for one in sensor_findings(logs) if one.severity != "remark"]
    firsts = np.cumsum([0, *(len(log.pieces) for log in logs)]).tolist()
    return OrientationFilter(
        filter="levelling" if chosen.gains is levelling else "mahony",
        Kp_per_s=mahony.Kp,
        Ki_per_s2=mahony.Ki,
        tau_s=None if levelling is None else levelling.tau_s,
        velocity_mps=None if levelling is None else levelling.velocity_mps,
        rate_hz=1.0 / dt_s,
        recommended=chosen.name,
        recommended_by=by,
        rate_of_angle="up vector" if tilted else "-gz",
        sigma=sigma,
        held_out=held_out,
        candidates={one.name: _candidate(one, dt_s) for one in result.candidates},
        densities={
            "gyro_radps_per_sqrt_Hz": result.noise.gyro,
            "walk_radps2_per_sqrt_Hz": result.noise.walk,
            "angle_rad_per_sqrt_Hz": result.noise.accel,
        },
        densities_from=densities_from,
        judged_s=result.judged_s,
        block_s=finite_or_none(result.block_s),
        logs=[_filter_log(log, result, k) for log, k in zip(logs, firsts, strict=False)],
        **judged(Verdict.of([*findings, *_of_tuning(result, logs, tilted)])),
    ).with_evidence((result, pieces))


def parameters_of(gains: AngleFilter) -> dict[str, Any]:
    """The parameters of a filter by their keys."""
    if isinstance(gains, Mahony):
        return {"Kp_per_s": gains.Kp, "Ki_per_s2": gains.Ki}
    return {"tau_s": gains.tau_s, "velocity_mps": gains.velocity_mps}


def _candidate(one: Candidate, dt_s: float) -> FilterCandidate:
    def interval(low: float, high: float) -> list[float] | None:
        return [math.degrees(low), math.degrees(high)] if math.isfinite(low) else None

    return FilterCandidate(
        **(parameters_of(one.gains) | gain_facts(one.gains, dt_s)),
        rmse_deg=degrees_or_none(one.rmse_rad),
        interval_deg=interval(one.low_rad, one.high_rad),
        less_than_3_3_deg=degrees_or_none(one.less_rad),
        less_interval_deg=interval(one.less_low_rad, one.less_high_rad),
        confidence=finite_or_none(one.confidence),
        whole_rmse_deg=degrees_or_none(one.whole_rad),
    )


def _filter_log(log: TuneLog, result: Tuning, first: int) -> FilterLog:
    """A log whose first piece is the tuning's piece of this number."""
    s, own = log.sampling, result.smoothed[first]
    return FilterLog(
        name=log.source,
        duration_s=s.duration_s,
        samples=s.samples,
        missing=s.missing,
        pieces=len(log.pieces),
        repeated_rows=s.repeated_rows,
        repeated_stamps=s.repeated_stamps,
        reference=log.reference or None,
        reference_offset_deg=math.degrees(result.offset_rad[first]) if log.reference else None,
        reference_lag_s=log.lag_s if log.reference else None,
        rate_error_degps_per_sqrt_Hz=None if own is None else math.degrees(own.gyro_noise),
        angle_error_deg_per_sqrt_Hz=None if own is None else math.degrees(own.accel_noise),
        smoothed_sigma_deg=None if own is None else math.degrees(own.sigma_rad),
        bias_degps=None if own is None else math.degrees(own.bias_radps),
    )


def _of_tuning(result: Tuning, logs: Sequence[TuneLog], tilted: bool) -> Iterator[Finding]:
    """What is to be known of the gains, and of the logs that they are from."""
    pieces = [piece for log in logs for piece in log.pieces]
    yield from contradictions(pieces, result)
    turns = (_level(piece.t_s, integral(piece.t_s, piece.rate_radps)) for piece in pieces)
    most = max((float(np.nanstd(turn)) for turn in turns if np.isfinite(turn).any()), default=math.inf)
    if most < _TURNS_RAD:
        yield Finding(
            "poor",
            f"The logs turn by {math.degrees(most):.2g} deg (RMS) only: they tell no filter from another.",
            "log the rig in motion, with the IMU at its full rate",
        )
    gains, base = result.recommended.gains, result.candidates[0]
    if isinstance(gains, Mahony) and gains.Kp < 2.0 * _RINGS * math.sqrt(gains.Ki):
        yield Finding(
            "remark",
            f"The pair is damped by {gains.Kp / (2.0 * math.sqrt(gains.Ki)):.2f} only and rings: it serves a "
            "start from an unknown bias; a bias that is subtracted before allows a calmer one.",
        )
    for one in result.candidates[1:]:
        if one.name == "riccati" and one.whole_rad > 1.5 * base.whole_rad:
            yield Finding(
                "remark",
                "The settled Kalman filter, riccati, takes longer than these logs to learn the bias.",
            )
    both = zip(pieces, result.smoothed, strict=True)
    worst = max((_rate_error(piece, own) for piece, own in both if own is not None), default=0.0)
    if worst > _TILTED * result.noise.gyro and not tilted:
        yield Finding(
            "remark",
            f"-gz errs by {math.degrees(worst):.2g} deg/s/sqrt(Hz) as the angle's rate, the sensor by "
            f"{math.degrees(result.noise.gyro):.2g}: it may be tilted out of the plane or its scale be off; "
            "with all six axes --rate up takes the tilt out.",
        )
    for piece, own in zip(pieces, result.smoothed, strict=True):
        if own is None or not _SURE * own.scale_sigma < abs(own.scale - 1.0) <= _MOST_SCALE:
            continue
        if _off(own) > _SCALED_RAD:
            yield Finding(
                "remark",
                f"{piece.source}: the rate turns {own.scale:.3g} times as far as the accelerometer's angle, "
                f"which is {math.degrees(_off(own)):.2g} deg (RMS) in these turns",
                "find scales and biases by calib imu intrinsics"
                + ("" if tilted else ", and see whether the sensor leans out of the plane (--rate up)"),
            )
    if result.judge == "smoothed":
        yield Finding("remark", "Without a reference the logs are judged by their own smoothed angle.")
    for reference in dict.fromkeys(log.reference for log in logs if log.lag_s):
        lags_ms = [1e3 * log.lag_s for log in logs if log.lag_s and log.reference == reference]
        span = " to ".join(dict.fromkeys(f"{one:.0f}" for one in (min(lags_ms), max(lags_ms))))
        better = "; calib align knows the delay" if reference == "camera" else ""
        text = f"{reference} came {span} ms late by the best match of angles, log by log{better}."
        yield Finding("remark", text)
