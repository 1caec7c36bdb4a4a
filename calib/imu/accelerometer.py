"""An accelerometer's bias, scale and misalignment from rests in many poses.

At rest the specific force has the length g, whatever the pose. Readings x (counts or m/s^2) become

    a = T diag(1/s) (x - b),   T = [[1, -yz, zy], [0, 1, -zx], [0, 0, 1]],

with the bias b, the scale s (counts per m/s^2, or about 1) and three small angles [rad] (Tedaldi, Pretto
and Menegatti, ICRA 2014, eqs. 1 - 6; names as in imu_tk). T is upper triangular because a rotation of all
axes together changes no length: the frame's z axis is the sensor's, its y axis lies in the plane of the
sensor's y and z. In a plane of two axes yz alone is left.

The cost is the sum of w (|a| - g)^2 over the means of the rests. With the long-run variance of the
readings C, a mean of n has

    1 / w = u^T A C A^T u / n + tau^2,   A = T diag(1/s),  u = a / |a|,

where tau is what the rests disagree by beyond their noise (a bias that moves, a table that gives way),
chosen so that the weighted residuals have the size that their degrees of freedom ask for. So neither a long
rest counts for more than it is worth, nor a short one for less. Standard deviations follow from the normal
equations times the measured scale of the residuals.

What can be told is judged by the singular values of dr/dp, in units of g, by which the root of the number
of rests is divided. Poses all over the sphere make the smallest 0.26, on the circle 0.35. Misalignments
that the poses do not tell, as when each axis just points up and down, are left at zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calib.arrays import FloatArray, IntArray
from calib.imu.rests import Rest

__all__ = ["ANGLES", "LEAST_SPAN", "Accelerometer", "corrected", "fit_accelerometer", "misalignment"]

ANGLES = {2: ("yz",), 3: ("yz", "zy", "zx")}
"""Names of the misalignments by the number of axes, in the order of the parameters."""

LEAST_SPAN = 0.02
"""Smallest singular value below which parameters are not told apart."""

_PLACES = {"yz": (0, 1, -1.0), "zy": (0, 2, 1.0), "zx": (1, 2, -1.0)}
_ROUNDS = 6


@dataclass(frozen=True)
class Accelerometer:
    """A fitted accelerometer of d axes.

    Attributes
    ----------
    bias, scale : (d,) in the unit of the readings, and per m/s^2.
    angles : (k,) misalignments as `ANGLES[d]`, rad; zero where `skewed` is False.
    sigma : (2 d + k,) standard deviations of bias, scale and angles, infinite where not told.
    covariance : (2 d + k, 2 d + k) of them, zero where not told.
    directions : (n, d) unit vectors of the rests' specific forces.
    direction_sigma : (n,) standard deviation of a direction [rad], residuals included.
    residual_mps2 : (n,) |a| - g of the rests.
    deviation_mps2 : (n,) what their deviation is, tau included.
    tau_mps2 : disagreement beyond noise.
    rms_mps2 : of the residuals, each rest alike.
    dof : rests less parameters.
    span : smallest singular value of all parameters that were fitted; 0 without a solution.
    weakest : (2 d + k,) the direction in the space of parameters that belongs to it.
    skewed : whether the misalignments were fitted.
    """

    bias: FloatArray
    scale: FloatArray
    angles: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    directions: FloatArray
    direction_sigma: FloatArray
    residual_mps2: FloatArray
    deviation_mps2: FloatArray
    tau_mps2: float
    rms_mps2: float
    dof: int
    span: float
    weakest: FloatArray
    skewed: bool

    @property
    def parameters(self) -> FloatArray:
        """Bias, scale and angles (2 d + k,)."""
        return np.concatenate([self.bias, self.scale, self.angles])

    @property
    def matrix(self) -> FloatArray:
        """A (d, d) of a = A (x - b)."""
        return misalignment(self.angles, len(self.bias)) / self.scale


def misalignment(angles: FloatArray, d: int) -> FloatArray:
    """T (d, d) of the misalignments as `ANGLES[d]`."""
    T = np.eye(d)
    for name, angle in zip(ANGLES[d], angles, strict=True):
        i, j, sign = _PLACES[name]
        T[i, j] = sign * angle
    return T


def corrected(parameters: FloatArray, readings: FloatArray) -> FloatArray:
    """Specific forces (n, d) of readings (n, d) [m/s^2], by parameters as `Accelerometer.parameters`."""
    return _corrected(parameters, readings)[0]


def _corrected(p: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """a (n, d) and its parts: T (d, d) and the scaled y (n, d)."""
    d = x.shape[1]
    T = misalignment(p[2 * d :], d)
    y = (x - p[:d]) / p[d : 2 * d]
    return y @ T.T, T, y


def _residual_and_jacobian(p: FloatArray, x: FloatArray, g: float) -> tuple[FloatArray, FloatArray]:
    """|a| - g (n,) and its derivative (n, 2 d + k)."""
    d = x.shape[1]
    a, T, y = _corrected(p, x)
    length = np.maximum(np.linalg.norm(a, axis=1), 1e-12 * g)
    u = a / length[:, None]
    along = u @ T
    J = np.empty((len(x), len(p)))
    J[:, :d] = -along / p[d : 2 * d]
    J[:, d : 2 * d] = -along * y / p[d : 2 * d]
    for k, name in enumerate(ANGLES[d]):
        i, j, sign = _PLACES[name]
        J[:, 2 * d + k] = sign * u[:, i] * y[:, j]
    return length - g, J


def _units(p: FloatArray, d: int, g: float) -> FloatArray:
    """A change of each parameter that alters a reading by about g, so that J * units / g has no unit."""
    out = np.ones(len(p))
    out[:d] = g * np.abs(p[d : 2 * d])
    out[d : 2 * d] = np.abs(p[d : 2 * d])
    return out


def _start(x: FloatArray, g: float) -> FloatArray:
    """Bias and scale of the axis-aligned ellipsoid through the means; a sphere where that is none."""
    d = x.shape[1]
    middle, size = x.mean(axis=0), max(float(np.ptp(x, axis=0).max()), 1e-12)
    z = (x - middle) / size
    k = ANGLES[d]
    p = np.zeros(2 * d + len(k))
    if len(x) >= 2 * d:
        q = np.linalg.lstsq(np.hstack([z**2, z]), np.ones(len(x)), rcond=1e-9)[0]
        if np.all(q[:d] > 0.0):
            centre = -0.5 * q[d:] / q[:d]
            radius = np.sqrt((1.0 + (q[:d] * centre**2).sum()) / q[:d])
            if radius.max() < 3.0 * radius.min():
                p[:d], p[d : 2 * d] = middle + size * centre, size * radius / g
                return p
    q = np.linalg.lstsq(np.hstack([2.0 * z, np.ones((len(x), 1))]), (z**2).sum(axis=1), rcond=1e-6)[0]
    p[:d] = middle + size * q[:d]
    p[d : 2 * d] = size * math.sqrt(max(float(q[d] + q[:d] @ q[:d]), 1e-6)) / g
    return p


def _starts(x: FloatArray, g: float, si: bool) -> list[FloatArray]:
    d = x.shape[1]
    starts = [_start(x, g)]
    if si:
        p = np.zeros_like(starts[0])
        p[d : 2 * d] = 1.0
        starts.insert(0, p)
    return starts


def _deviations(p: FloatArray, x: FloatArray, variance: FloatArray) -> FloatArray:
    """Standard deviation (n,) of |a| from the noise of the readings' means, whose variance is (n, d)."""
    d = x.shape[1]
    a, T, _ = _corrected(p, x)
    u = a / np.maximum(np.linalg.norm(a, axis=1), 1e-300)[:, None]
    return np.asarray(np.sqrt((((u @ T) / p[d : 2 * d]) ** 2 * variance).sum(axis=1)))


def _tau(r: FloatArray, deviation: FloatArray, dof: int) -> float:
    """tau by which sum r^2 / (deviation^2 + tau^2) becomes dof; 0 where it is less without it."""

    def excess(tau2: float) -> float:
        return float((r**2 / (deviation**2 + tau2)).sum()) - dof

    if dof <= 0 or excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, float((r**2).sum()) / dof
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return math.sqrt(0.5 * (low + high))


def _solve(p: FloatArray, free: IntArray, x: FloatArray, g: float, deviation: FloatArray) -> FloatArray:
    """Least squares over the free parameters."""
    d = x.shape[1]
    units = _units(p, d, g)[free]

    def full(q: FloatArray) -> FloatArray:
        out = p.copy()
        out[free] = p[free] + q * units
        # A scale of the other sign is the same sensor turned over.
        out[d : 2 * d] = np.maximum(out[d : 2 * d], 0.02 * p[d : 2 * d])
        return out

    def weighted(q: FloatArray) -> FloatArray:
        return np.asarray(_residual_and_jacobian(full(q), x, g)[0] / deviation)

    def slope(q: FloatArray) -> FloatArray:
        J = _residual_and_jacobian(full(q), x, g)[1]
        return np.asarray(J[:, free] * units / deviation[:, None])

    start = np.zeros(len(free))
    found = least_squares(weighted, start, jac=slope, method="lm", xtol=1e-10, ftol=1e-10, max_nfev=200)
    return full(found.x)


def _span(p: FloatArray, free: IntArray, x: FloatArray, g: float) -> tuple[float, FloatArray]:
    """Smallest singular value, and its direction (2 d + k,) in units of g."""
    J = _residual_and_jacobian(p, x, g)[1][:, free] * _units(p, x.shape[1], g)[free] / g
    _, values, Vt = np.linalg.svd(J / math.sqrt(len(x)))
    weakest = np.zeros(len(p))
    weakest[free] = Vt[-1]
    return (float(values[-1]) if len(values) == len(free) else 0.0), weakest


def _fit(
    starts: list[FloatArray], free: IntArray, x: FloatArray, g: float, variance: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Parameters, deviations of the rests with tau in them, and tau."""
    best: FloatArray | None = None
    cost = math.inf
    for start in starts:
        flat = np.full(len(x), 1e-3 * g)
        p = _solve(start, free, x, g, flat)
        now = float((_residual_and_jacobian(p, x, g)[0] ** 2).sum())
        if best is None or now < 0.999 * cost:
            best, cost = p, now
    assert best is not None
    p, tau, deviation = best, -1.0, np.ones(len(x))
    for _ in range(_ROUNDS):
        white = np.maximum(_deviations(p, x, variance), 1e-9 * g)
        r = _residual_and_jacobian(p, x, g)[0]
        before, tau = tau, _tau(r, white, len(x) - len(free))
        deviation = np.sqrt(white**2 + tau**2)
        p = _solve(p, free, x, g, deviation)
        if abs(tau - before) <= 1e-4 * float(deviation.mean()):
            break
    return p, deviation, tau


def fit_accelerometer(rests: Sequence[Rest], gravity_mps2: float, si: bool) -> Accelerometer:
    """Bias, scale and misalignment from rests.

    Parameters
    ----------
    rests : at least 2 d, their means of d = 2 or 3 axes.
    gravity_mps2 : g, in the plane for two axes.
    si : readings are in m/s^2 already, so that bias 0 and scale 1 are a start.
    """
    x = np.stack([rest.mean for rest in rests])
    n, d = x.shape
    count = np.array([rest.samples for rest in rests], dtype=np.float64)
    # The noise is the sensor's: one rest tells little of it, all together much.
    scatter = np.median(np.stack([rest.scatter for rest in rests]), axis=0)
    variance = scatter / count[:, None]
    g = gravity_mps2
    starts = _starts(x, g, si)
    everything = np.arange(len(starts[0]), dtype=np.int64)
    plain = everything[: 2 * d]
    p, deviation, tau = _fit(starts, plain, x, g, variance)
    free, skewed = plain, False
    if n > len(everything) and _span(p, everything, x, g)[0] >= LEAST_SPAN:
        free, skewed = everything, True
        p, deviation, tau = _fit([p], free, x, g, variance)
    span, weakest = _span(p, free, x, g)
    if si and span < LEAST_SPAN:
        # Such a fit may have gone anywhere; directions by readings as they are will do.
        p = starts[0]
        least, weakest = _span(p, free, x, g)
        span = min(span, least)
    r, J = _residual_and_jacobian(p, x, g)
    dof = n - len(free)
    scale2 = float(((r / deviation) ** 2).sum()) / dof if dof > 0 else 1.0
    sigma, covariance = np.full(len(p), math.inf), np.zeros((len(p), len(p)))
    if span > 1e-6:
        units = _units(p, d, g)[free]
        W = J[:, free] * units / deviation[:, None]
        covariance[np.ix_(free, free)] = np.outer(units, units) * np.linalg.inv(W.T @ W) * scale2
        sigma[free] = np.sqrt(np.diag(covariance)[free])
    a = _corrected(p, x)[0]
    u = a / np.maximum(np.linalg.norm(a, axis=1), 1e-300)[:, None]
    across = np.sqrt((variance / p[d : 2 * d] ** 2).mean(axis=1) + tau**2) / g
    return Accelerometer(
        bias=p[:d],
        scale=p[d : 2 * d],
        angles=p[2 * d :],
        sigma=sigma,
        covariance=covariance,
        directions=u,
        direction_sigma=across,
        residual_mps2=r,
        deviation_mps2=deviation * math.sqrt(scale2),
        tau_mps2=tau,
        rms_mps2=float(np.sqrt((r**2).mean())),
        dof=dof,
        span=span,
        weakest=weakest,
        skewed=skewed,
    )
