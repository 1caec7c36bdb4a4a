"""A gyroscope's scale and misalignment from the turns between rests.

Rates of rotation are

    w = M (x - b - S a),   M = T diag(1/s),
    T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]],

with readings x, bias b, scale s (counts per rad/s, or about 1) and six small angles [rad] to the axes of
the accelerometer's frame (Tedaldi, Pretto and Menegatti, ICRA 2014, eqs. 7 - 11; names as in imu_tk).
Integrated from rest to rest they carry gravity's direction along (`calib.imu.turns`). A turn about gravity
itself shows nothing; many others together show all. In a plane the scale of z alone is left.

The bias is that of the rest at the start, as in the paper. Where the readings at rest follow the pose
beyond doubt (F test), b and the sensitivity S to the specific force a are fitted to all rests instead: an
Xsens MTi has 0.2 deg/s per g, which is most of what its turns disagree by otherwise.

The turns are weighted by their covariance, and the measured scale of the residuals goes into the standard
deviations.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.special import fdtrc

from calib.arrays import FloatArray
from calib.imu.accelerometer import Accelerometer, corrected
from calib.imu.turns import Turns, misfit, misfit_covariance, rest_forces, tangents

__all__ = ["GYRO_ANGLES", "Bias", "Gyroscope", "fit_bias", "fit_gyroscope", "foreign_axes"]

GYRO_ANGLES = {
    "yz": (0, 1, -1.0),
    "zy": (0, 2, 1.0),
    "xz": (1, 0, 1.0),
    "zx": (1, 2, -1.0),
    "xy": (2, 0, -1.0),
    "yx": (2, 1, 1.0),
}
"""Row, column and sign of each misalignment in T."""

_FASTEST_RADPS, _SLOWEST_RADPS = 50.0, 0.2
_FINE, _COARSE = 1.05, 1.3
_FOLLOWS_POSE = 1e-4
_LEAST_FALL = 0.7
_ASTRAY_RAD = 0.2
_LEAST_SPAN = 1e-3


@dataclass(frozen=True)
class Bias:
    """What a gyroscope reads at rest.

    Attributes
    ----------
    bias, sigma : (3,) at no specific force where S is fitted, else in the rest at the start; the deviation
        from what is met in other rests.
    sensitivity, sensitivity_sigma : (3, d) S per m/s^2, None where the bias does not follow the pose.
    wander : (3,) standard deviation from rest to rest beyond noise.
    """

    bias: FloatArray
    sigma: FloatArray
    sensitivity: FloatArray | None
    sensitivity_sigma: FloatArray | None
    wander: FloatArray


@dataclass(frozen=True)
class Gyroscope:
    """A fitted gyroscope.

    Attributes
    ----------
    bias : what it reads at rest.
    initial_bias : (3,) mean reading of the rest at the start.
    scale, scale_sigma : (3,) per rad/s; NaN for axes that were not fitted.
    angles, angle_sigma : (6,) rad as `GYRO_ANGLES`; NaN where not fitted.
    residual_rad : (k, c) direction predicted less direction found after each turn, c = 1 in a plane.
    rms_rad : of their lengths.
    turns_s : (k,) lengths of the turns.
    travel_rad : (3,) root mean square of the angle turned about each axis.
    span : smallest singular value of the residuals' derivative by relative parameters over sqrt(k).
    """

    bias: Bias
    initial_bias: FloatArray
    scale: FloatArray
    scale_sigma: FloatArray
    angles: FloatArray
    angle_sigma: FloatArray
    residual_rad: FloatArray
    rms_rad: float
    turns_s: FloatArray
    travel_rad: FloatArray
    span: float

    @property
    def matrix(self) -> FloatArray:
        """M (3, 3), zero where not fitted."""
        return _matrix(np.concatenate([np.nan_to_num(self.scale, nan=math.inf), np.nan_to_num(self.angles)]))


def _matrix(p: FloatArray) -> FloatArray:
    T = np.eye(3)
    for (i, j, sign), angle in zip(GYRO_ANGLES.values(), p[3:], strict=True):
        T[i, j] = sign * angle
    return np.asarray(T / p[:3])


def fit_bias(turns: Turns, accel: Accelerometer) -> Bias:
    """What the gyroscope reads at rest, by pose where that shows."""
    x, d = turns.gyro_mean, len(accel.bias)
    n = len(x)
    length = np.array([rest.samples for rest in turns.rests], dtype=np.float64)
    white = np.median(turns.gyro_scatter, axis=0) / length[:, None]
    active = np.flatnonzero(white.any(axis=0))
    f = rest_forces(turns, accel.parameters)
    H = np.hstack([np.ones((n, 1)), f])
    dof = n - d - 1
    about = ((x - x.mean(axis=0)) ** 2).sum(axis=0)
    if len(active) and dof >= 4 and np.linalg.svd(H, compute_uv=False)[-1] > 0.1 * math.sqrt(n):
        c: FloatArray = np.asarray(np.linalg.lstsq(H, x, rcond=None)[0], dtype=np.float64)
        left = ((x - H @ c) ** 2).sum(axis=0)
        F = (about - left)[active] / d / np.maximum(left[active] / dof, 1e-300)
        fall = math.sqrt(float(left[active].sum()) / max(float(about[active].sum()), 1e-300))
        if float(fdtrc(d, dof, F).min()) < _FOLLOWS_POSE and fall < _LEAST_FALL:
            inverse = np.diag(np.linalg.inv(H.T @ H))
            sigma: FloatArray = np.sqrt(np.outer(inverse, left / dof)).astype(np.float64)
            wander = np.asarray(np.sqrt(np.maximum(left / dof - white.mean(axis=0), 0.0)))
            return Bias(c[0], sigma[0], c[1:].T, sigma[1:].T, wander)
    excess = about / (n - 1) - white.mean(axis=0) if n > 1 else np.zeros(3)
    # Noise alone exceeds its expectation by chance, too.
    clear = excess > 3.0 * math.sqrt(2.0 / max(n - 1, 1)) * white.mean(axis=0)
    wander = np.asarray(np.sqrt(np.where(clear, excess, 0.0)))
    return Bias(x[turns.initial], np.sqrt(white[turns.initial] + wander**2), None, None, wander)


def _rates(turns: Turns, accel: Accelerometer, bias: Bias) -> FloatArray:
    """Readings (n, 3) without their bias."""
    out = turns.gyro - bias.bias
    if bias.sensitivity is not None:
        out -= corrected(accel.parameters, turns.accel) @ bias.sensitivity.T
    return np.ascontiguousarray(out)


def _signed_permutations() -> list[FloatArray]:
    out = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            P = np.zeros((3, 3))
            P[np.arange(3), order] = signs
            out.append(P)
    return out


def _scales(rates: FloatArray, si: bool, step: float) -> list[float]:
    """Scales to try: 1, or all by which the fastest turn is one that a hand or a rig makes."""
    if si:
        return [1.0]
    fastest = float(np.quantile(np.abs(rates).max(axis=1), 0.9999))
    low, high = fastest / _FASTEST_RADPS, fastest / _SLOWEST_RADPS
    return [] if low <= 0.0 else np.geomspace(low, high, math.ceil(math.log(high / low, step))).tolist()


def _rms(turns: Turns, accel: Accelerometer, rates: FloatArray, M: FloatArray, across: FloatArray) -> float:
    return float(np.sqrt((misfit(turns, accel.parameters, rates, M, across) ** 2).sum() / len(across)))


def foreign_axes(turns: Turns, accel: Accelerometer, found: Gyroscope, si: bool) -> FloatArray | None:
    """Which axes of the gyroscope run along which of the accelerometer, where that is not one to one.

    Looked for only where the turns disagree widely. Returns the signed permutation P (3, 3) by which
    w = P x / s explains them, or None where none does.
    """
    if len(accel.bias) == 2 or found.rms_rad < _ASTRAY_RAD:
        return None
    rates, across = _rates(turns, accel, found.bias), tangents(turns, accel)
    best, least = None, 0.5 * found.rms_rad
    for P in _signed_permutations():
        for scale in _scales(rates, si, _COARSE if not si else _FINE):
            now = _rms(turns, accel, rates, P / scale, across)
            if now < least:
                best, least = P, now
    return best if best is None or not np.array_equal(best, np.eye(3)) else None


def fit_gyroscope(turns: Turns, accel: Accelerometer, si: bool) -> Gyroscope:
    """Scale and misalignment from at least one turn.

    Parameters
    ----------
    turns : readings between rests, (0, 0, z) in a plane.
    accel : the accelerometer as it was fitted to the same rests.
    si : readings are in rad/s already, so that the scale is about 1.
    """
    planar = len(accel.bias) == 2
    bias = fit_bias(turns, accel)
    rates, across = _rates(turns, accel, bias), tangents(turns, accel)
    k, c = across.shape[:2]
    free = np.array([2]) if planar else np.arange(9)
    start = np.zeros(9)
    grid = _scales(rates, si, _FINE) or [1.0]
    start[:3] = min(grid, key=lambda scale: _rms(turns, accel, rates, np.eye(3) / scale, across))
    units = np.where(np.arange(9) < 3, start[0], 1.0)

    def full(q: FloatArray) -> FloatArray:
        p = start.copy()
        p[free] += q * units[free]
        p[:3] = np.where(np.abs(p[:3]) < 0.05 * start[0], 0.05 * start[0], p[:3])
        return p

    def off(q: FloatArray) -> FloatArray:
        return misfit(turns, accel.parameters, rates, _matrix(full(q)), across)

    method: Literal["lm", "trf"] = "lm" if k * c >= len(free) else "trf"
    q = least_squares(off, np.zeros(len(free)), method=method).x
    C = misfit_covariance(turns, accel, rates, _matrix(full(q)), across, bias.sigma, bias.wander)
    L = np.linalg.cholesky(C)

    def whitened(q: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(L, off(q)))

    solution = least_squares(whitened, q, method=method)
    W: FloatArray = np.asarray(solution.jac)
    p, dof = full(solution.x), k * c - len(free)
    J = L @ W
    span = float(np.linalg.svd(J / math.sqrt(k), compute_uv=False)[-1]) if k * c >= len(free) else 0.0
    sigma = np.full(9, math.nan)
    sigma[free] = math.inf
    if span > _LEAST_SPAN:
        scale2 = 2.0 * float(solution.cost) / dof if dof > 0 else 1.0
        inverse = np.linalg.inv(W.T @ W)
        sigma[free] = units[free] * np.sqrt(np.diag(inverse) * scale2)
    values = np.full(9, math.nan)
    values[free] = p[free]
    residual = off(solution.x).reshape(k, c)
    angle = np.stack(
        [
            (rates[a : b + 1] @ _matrix(p).T).sum(axis=0) * turns.period_s
            for a, b in zip(turns.first, turns.last, strict=True)
        ]
    )
    return Gyroscope(
        bias=bias,
        initial_bias=turns.gyro_mean[turns.initial],
        scale=values[:3],
        scale_sigma=sigma[:3],
        angles=values[3:],
        angle_sigma=sigma[3:],
        residual_rad=residual,
        rms_rad=float(np.sqrt((residual**2).sum() / k)),
        turns_s=turns.duration_s,
        travel_rad=np.sqrt((angle**2).mean(axis=0)),
        span=span,
    )
