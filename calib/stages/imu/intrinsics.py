"""Bias, scale and misalignment of an IMU from rests in many poses and the turns between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc, stdtrit

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.core.result import finite_or_none, judged
from calib.core.units import GRAVITY_MPS2
from calib.core.verdict import Finding, Verdict
from calib.solve.clock import Part
from calib.stages.imu.levelling import turned
from calib.stages.imu.sampling import (
    INSET_S,
    MULTIPLES,
    Quiet,
    Readings,
    Rest,
    Sampling,
    Spread,
    find_rests,
    quiet_level,
    regular_parts,
    rounding,
    sampling_findings,
    spread,
)
from calib.stages.imu.section import (
    AccelIntrinsics,
    GyroIntrinsics,
    GyroSigma,
    ImuIntrinsics,
    IntrinsicsSigma,
)

# ----------------------------------------------------------------------
# A direction fixed in the world, seen by a sensor that turns at w: dv/dt = v x w, step by step.


@kernel()
def turn_directions(
    rates: FloatArray, starts: IntArray, stops: IntArray, before: FloatArray, period_s: float, out: FloatArray
) -> None:
    """Directions that are fixed in the world, as the sensor sees them after each turn.

    Parameters
    ----------
    rates : (n, 3) of rotation, linear between readings.
    starts, stops : (k,) first and last reading of each turn.
    before : (k, 3) vectors before the turns.
    out : (k, 3) vectors after them.
    """
    w = np.zeros(3)
    for turn in range(len(starts)):
        for i in range(3):
            out[turn, i] = before[turn, i]
        for row in range(starts[turn], stops[turn]):
            for i in range(3):
                w[i] = 0.5 * (rates[row, i] + rates[row + 1, i])
            turned(out[turn], w, period_s)


# ----------------------------------------------------------------------
# An accelerometer's bias, scale and misalignment from rests in many poses.
#
# At rest the specific force has the length g, whatever the pose. Readings x (counts or m/s^2) become
#
#     a = T diag(1/s) (x - b),   T = [[1, -yz, zy], [0, 1, -zx], [0, 0, 1]],
#
# with the bias b, the scale s (counts per m/s^2, or about 1) and three small angles [rad] (Tedaldi, Pretto
# and Menegatti, ICRA 2014, eqs. 1 - 6; names as in imu_tk). T is upper triangular because a rotation of all
# axes together changes no length: the frame's z axis is the sensor's, its y axis lies in the plane of the
# sensor's y and z. In a plane of two axes yz alone is left.
#
# The cost is the sum of w (|a| - g)^2 over the means of the rests. With the long-run variance of the
# readings C, a mean of n has
#
#     1 / w = u^T A C A^T u / n + tau^2,   A = T diag(1/s),  u = a / |a|,
#
# where tau is what the rests disagree by beyond their noise (a bias that moves, a table that gives way),
# chosen so that the weighted residuals have the size that their degrees of freedom ask for. So neither a long
# rest counts for more than it is worth, nor a short one for less. Standard deviations follow from the normal
# equations times the measured scale of the residuals, where that is above one: few residuals may be small by
# chance, and the noise is known.
#
# What can be told is judged by the singular values of dr/dp, in units of g, by which the root of the number
# of rests is divided. Poses all over the sphere make the smallest 0.26, on the circle 0.35. Misalignments
# that the poses do not tell, as when each axis just points up and down, are left at zero.

PLACES = {
    "yz": (0, 1, -1.0),
    "zy": (0, 2, 1.0),
    "xz": (1, 0, 1.0),
    "zx": (1, 2, -1.0),
    "xy": (2, 0, -1.0),
    "yx": (2, 1, 1.0),
}
"""Row, column and sign of each misalignment in T; a gyroscope has all of them."""

ANGLES = {2: ("yz",), 3: ("yz", "zy", "zx")}
"""Those of an accelerometer by the number of its axes, in the order of the parameters."""

LEAST_SPAN = 0.02
"""Smallest singular value below which parameters are not told apart."""

_SQUARE_RAD = 0.01
"""Deviation of an accelerometer's axes from right angles: data sheets allow 1 to 2 % of cross-axis share."""

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
        d = len(self.bias)
        return misalignment(ANGLES[d], self.angles, d) / self.scale


def misalignment(names: Sequence[str], angles: FloatArray, d: int) -> FloatArray:
    """T (d, d) of misalignments with these names."""
    T = np.eye(d)
    for name, angle in zip(names, angles, strict=True):
        i, j, sign = PLACES[name]
        T[i, j] = sign * angle
    return T


def _unit(vectors: FloatArray) -> FloatArray:
    """Directions (n, d) of vectors (n, d)."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None])


def corrected(parameters: FloatArray, readings: FloatArray) -> FloatArray:
    """Specific forces (n, d) of readings (n, d) [m/s^2], by parameters as `Accelerometer.parameters`."""
    return _corrected(parameters, readings)[0]


def _corrected(p: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """a (n, d) and its parts: T (d, d) and the scaled y (n, d)."""
    d = x.shape[1]
    T = misalignment(ANGLES[d], p[2 * d :], d)
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
        i, j, sign = PLACES[name]
        J[:, 2 * d + k] = sign * u[:, i] * y[:, j]
    return length - g, J


def _units(p: FloatArray, d: int, g: float) -> FloatArray:
    """A change of each parameter that alters a reading by about g, so that J * units / g has no unit."""
    out = np.ones(len(p))
    out[:d] = g * np.abs(p[d : 2 * d])
    out[d : 2 * d] = np.abs(p[d : 2 * d])
    return out


def _starts(x: FloatArray, g: float, si: bool) -> list[FloatArray]:
    """Bias and scale of the sphere through the means, after bias 0 and scale 1 where that is a start."""
    d = x.shape[1]
    middle, size = x.mean(axis=0), max(float(np.ptp(x, axis=0).max()), 1e-12)
    z = (x - middle) / size
    p, plain = np.zeros((2, 2 * d + len(ANGLES[d])))
    q = np.linalg.lstsq(np.hstack([2.0 * z, np.ones((len(x), 1))]), (z**2).sum(axis=1), rcond=1e-6)[0]
    p[:d] = middle + size * q[:d]
    p[d : 2 * d] = size * math.sqrt(max(float(q[d] + q[:d] @ q[:d]), 1e-6)) / g
    plain[d : 2 * d] = 1.0
    return [plain, p] if si else [p]


def _deviations(p: FloatArray, x: FloatArray, variance: FloatArray) -> FloatArray:
    """Standard deviation (n,) of |a| from the noise of the readings' means, whose variance is (n, d)."""
    d = x.shape[1]
    a, T, _ = _corrected(p, x)
    return np.asarray(np.sqrt((((_unit(a) @ T) / p[d : 2 * d]) ** 2 * variance).sum(axis=1)))


def _tau(r: FloatArray, deviation: FloatArray, dof: int) -> float:
    """tau by which sum r^2 / (deviation^2 + tau^2) becomes dof; 0 where it is less without it."""
    from scipy.optimize import brentq

    def excess(tau2: float) -> float:
        return float((r**2 / (deviation**2 + tau2)).sum()) - dof

    if dof <= 0 or excess(0.0) <= 0.0:
        return 0.0
    return math.sqrt(float(brentq(excess, 0.0, float((r**2).sum()) / dof)))


def _solve(p: FloatArray, free: IntArray, x: FloatArray, g: float, deviation: FloatArray) -> FloatArray:
    """Least squares over the free parameters."""
    from scipy.optimize import least_squares

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
    count = np.array([rest.samples - 2 * rest.inset for rest in rests], dtype=np.float64)
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
    scale2 = max(float(((r / deviation) ** 2).sum()) / dof, 1.0) if dof > 0 else 1.0
    sigma, covariance = np.full(len(p), math.inf), np.zeros((len(p), len(p)))
    if span > 1e-6:
        units = _units(p, d, g)[free]
        W = J[:, free] * units / deviation[:, None]
        inverse = np.linalg.inv(W.T @ W)
        # Angles that are taken to be zero turn what they leave of the residuals into bias and scale.
        shift = inverse @ W.T @ (J[:, len(free) :] / deviation[:, None]) * _SQUARE_RAD
        known = np.outer(units, units) * (inverse * scale2 + shift @ shift.T)
        covariance[np.ix_(free, free)] = known
        sigma[free] = np.sqrt(np.diag(known))
    across = np.sqrt((variance / p[d : 2 * d] ** 2).mean(axis=1) + tau**2) / g
    return Accelerometer(
        bias=p[:d],
        scale=p[d : 2 * d],
        angles=p[2 * d :],
        sigma=sigma,
        covariance=covariance,
        directions=_unit(corrected(p, x)),
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


# ----------------------------------------------------------------------
# Turns from one rest to the next: what the rates of rotation predict there, and how far it can be off.
#
# The rate is integrated from the end of a rest to the start of the next; the direction of gravity before,
# carried along, is compared with that after by its components across the latter (Tedaldi, Pretto and
# Menegatti, ICRA 2014, eqs. 13 - 18).
#
# A rest ends one turn and begins the next, so both share the error of its direction. All turns share the
# errors of the gyroscope's bias and of the accelerometer's parameters. White noise of the rate and what the
# bias moves by belong to each turn alone.


@dataclass(frozen=True)
class Turns:
    """Readings on the way from each rest to the next.

    Attributes
    ----------
    gyro : (n, 3) readings, (0, 0, z) in a plane.
    accel : (n, d) readings.
    first, last : (k,) last reading of the rest before and first of the rest after.
    before : (k,) numbers of the rests before, rising; those after follow them.
    rests : all of them.
    gyro_mean, gyro_scatter : (m, 3) mean over the middle of each rest, and long-run variance of a reading.
    gyro_count : (m,) readings of each mean.
    rounded : (3,) deviation of a mean by the rounding of the rates.
    initial : number of the rest that the bias is taken from.
    """

    gyro: FloatArray
    accel: FloatArray
    first: IntArray
    last: IntArray
    before: IntArray
    rests: Sequence[Rest]
    gyro_mean: FloatArray
    gyro_scatter: FloatArray
    gyro_count: FloatArray
    rounded: FloatArray
    initial: int
    period_s: float

    @property
    def after(self) -> IntArray:
        """(k,) numbers of the rests after."""
        return self.before + 1

    @property
    def duration_s(self) -> FloatArray:
        """(k,) lengths in seconds."""
        return np.asarray((self.last - self.first) * self.period_s)


def rest_forces(turns: Turns, parameters: FloatArray) -> FloatArray:
    """Specific forces (m, d) at rest [m/s^2], by parameters of the accelerometer."""
    return corrected(parameters, np.stack([rest.mean for rest in turns.rests]))


def _directions(turns: Turns, parameters: FloatArray) -> FloatArray:
    """Unit vectors (m, 3) at rest; z is zero in a plane."""
    f = rest_forces(turns, parameters)
    return np.pad(_unit(f), ((0, 0), (0, 3 - f.shape[1])))


def carried(turns: Turns, rates: FloatArray, M: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (k, 3) fixed in the world, given before each turn and returned as they are seen after it.

    `rates` (n, 3) are readings without their bias, M (3, 3) makes them rad/s.
    """
    out = np.empty((len(turns.first), 3))
    w = np.ascontiguousarray(rates @ M.T)
    turn_directions(w, turns.first, turns.last, np.ascontiguousarray(vectors), turns.period_s, out)
    return out


def tangents(turns: Turns, accel: Accelerometer) -> FloatArray:
    """Unit vectors (k, 2, 3) across the direction after each turn; in a plane one (k, 1, 3)."""
    u = _directions(turns, accel.parameters)[turns.after]
    planar = len(accel.bias) == 2
    z = np.tile([0.0, 0.0, 1.0], (len(u), 1)) if planar else np.eye(3)[np.argmin(np.abs(u), axis=1)]
    first = np.cross(z, u)
    first /= np.linalg.norm(first, axis=1)[:, None]
    if planar:
        return np.asarray(first[:, None])
    return np.stack([first, np.cross(u, first)], axis=1)


def misfit(
    turns: Turns, parameters: FloatArray, rates: FloatArray, M: FloatArray, across: FloatArray
) -> FloatArray:
    """Direction predicted less direction found, along the vectors `across` (k, c, 3): (k c,) [rad]."""
    u = _directions(turns, parameters)
    off = carried(turns, rates, M, u[turns.before]) - u[turns.after]
    return np.asarray(np.einsum("kci,ki->kc", across, off).ravel())


def misfit_covariance(
    turns: Turns,
    accel: Accelerometer,
    rates: FloatArray,
    M: FloatArray,
    across: FloatArray,
    bias_sigma: FloatArray,
    wander: FloatArray,
) -> FloatArray:
    """Covariance (k c, k c) of `misfit`.

    Parameters
    ----------
    bias_sigma : (3,) of the bias that all turns share, in the readings' unit.
    wander : (3,) standard deviation of the bias about that from turn to turn.
    """
    k, c = across.shape[:2]
    s2 = accel.direction_sigma**2
    gain = (M**2).sum(axis=0)
    white = float((np.median(turns.gyro_scatter, axis=0) * gain).sum()) * turns.period_s
    moved = float((wander**2 * gain).sum())
    # In a plane all noise is that of z; else each component across has the mean of three axes.
    axes = 1 if c == 1 else 3
    T = turns.duration_s
    own = s2[turns.before] + s2[turns.after] + (white * T + moved * T**2) / axes
    C = np.zeros((k, c, k, c))
    C[np.arange(k), :, np.arange(k), :] = own[:, None, None] * np.eye(c)
    # Turns that follow each other: what the rest between them was off by, seen before and after.
    last = np.flatnonzero(turns.after[:-1] == turns.before[1:])
    vectors = np.zeros((c, k, 3))
    vectors[:, last + 1] = across[last].transpose(1, 0, 2)
    seen = np.stack([carried(turns, rates, M, one) for one in vectors], axis=1)
    cross = -s2[turns.before, None, None] * np.einsum("kai,kbi->kab", across, seen)
    C[last + 1, :, last, :] = cross[last + 1]
    C[last, :, last + 1, :] = cross[last + 1].transpose(0, 2, 1)
    C2 = C.reshape(k * c, k * c)
    base = misfit(turns, accel.parameters, rates, M, across)
    shared = [
        misfit(turns, accel.parameters, rates - sigma * np.eye(3)[j], M, across) - base
        for j, sigma in enumerate(bias_sigma.tolist())
        if sigma > 0.0 and gain[j] > 0.0
    ]
    values, vectors = np.linalg.eigh(accel.covariance)
    shared += [
        misfit(turns, accel.parameters + math.sqrt(value) * vector, rates, M, across) - base
        for value, vector in zip(values.tolist(), vectors.T, strict=True)
        if value > 0.0
    ]
    E = np.array(shared).reshape(-1, k * c)
    return np.asarray(C2 + E.T @ E + 1e-16 * np.eye(k * c))


# ----------------------------------------------------------------------
# A gyroscope's scale and misalignment from the turns between rests.
#
# Rates of rotation are
#
#     w = M (x - b - S a),   M = T diag(1/s),
#     T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]],
#
# with readings x, bias b, scale s (counts per rad/s, or about 1) and six small angles [rad] to the axes of
# the accelerometer's frame (Tedaldi, Pretto and Menegatti, ICRA 2014, eqs. 7 - 11; names as in imu_tk).
# Integrated from rest to rest they carry gravity's direction along. A turn about gravity itself shows
# nothing; many others together show all. In a plane the scale of z alone is left.
#
# The bias is that of the rest at the start, as in the paper. Where the readings at rest follow the pose
# beyond doubt (F test), b and the sensitivity S to the specific force a are fitted to all rests instead: an
# Xsens MTi has 0.2 deg/s per g, which is most of what its turns disagree by otherwise.
#
# The turns are weighted by their covariance, and the measured scale of the residuals goes into the standard
# deviations.

_FASTEST_RADPS, _SLOWEST_RADPS = 50.0, 0.2
_FINE, _COARSE = 1.05, 1.3
_FOLLOWS_POSE = 1e-4
_LEAST_FALL = 0.7
_TURNS = 6.0
"""Times the usual deviation of the rests' mean rates, from which on one turns about the vertical."""
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
    angles, angle_sigma : (6,) rad as `PLACES`; NaN where not fitted.
    residual_rad : (k, c) direction predicted less direction found after each turn, c = 1 in a plane.
    rms_rad : of their lengths.
    turns_s : (k,) lengths of the turns.
    travel_rad : (3,) root mean square of the angle turned about each axis.
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

    @property
    def matrix(self) -> FloatArray:
        """M (3, 3), zero where not fitted."""
        return _matrix(np.concatenate([np.nan_to_num(self.scale, nan=math.inf), np.nan_to_num(self.angles)]))


def _matrix(p: FloatArray) -> FloatArray:
    return misalignment(tuple(PLACES), p[3:], 3) / p[:3]


def _unturned(gyro_mean: FloatArray, rounded: FloatArray) -> BoolArray:
    """Which rests (m,) do not turn about the vertical, by their mean rates (m, 3) with what rounding does."""
    off = np.abs(gyro_mean - np.median(gyro_mean, axis=0))
    usual = np.maximum(1.4826 * np.median(off, axis=0), rounded)
    return np.asarray((off <= _TURNS * usual).all(axis=1))


def fit_bias(turns: Turns, accel: Accelerometer) -> Bias:
    """What the gyroscope reads at rest, by pose where that shows."""
    d, still = len(accel.bias), _unturned(turns.gyro_mean, turns.rounded)
    noise = np.median(turns.gyro_scatter, axis=0)
    x, white = turns.gyro_mean[still], noise / turns.gyro_count[still, None]
    n = len(x)
    active = np.flatnonzero(white.any(axis=0))
    f = rest_forces(turns, accel.parameters)[still]
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
            sigma[0] = np.hypot(sigma[0], turns.rounded)
            wander = np.asarray(np.sqrt(np.maximum(left / dof - white.mean(axis=0), 0.0)))
            return Bias(c[0], sigma[0], c[1:].T, sigma[1:].T, wander)
    excess = about / (n - 1) - white.mean(axis=0) if n > 1 else np.zeros(3)
    # Noise alone exceeds its expectation by chance, too.
    clear = excess > 3.0 * math.sqrt(2.0 / max(n - 1, 1)) * white.mean(axis=0)
    wander = np.asarray(np.sqrt(np.where(clear, excess, 0.0)))
    sigma = np.sqrt(noise / turns.gyro_count[turns.initial] + wander**2 + turns.rounded**2)
    return Bias(turns.gyro_mean[turns.initial], sigma, None, None, wander)


def _rates(turns: Turns, accel: Accelerometer, bias: Bias) -> FloatArray:
    """Readings (n, 3) without their bias."""
    out = turns.gyro - bias.bias
    if bias.sensitivity is not None:
        out -= corrected(accel.parameters, turns.accel) @ bias.sensitivity.T
    return np.ascontiguousarray(out)


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
    for order, signs in itertools.product(
        itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)
    ):
        P = np.diag(signs) @ np.eye(3)[list(order)]
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
    from scipy.optimize import least_squares

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
    )


# ----------------------------------------------------------------------
# An IMU's intrinsics from one log: rests in many poses with turns between them.
#
# The rests are found with one threshold after another, the accelerometer is fitted to each set of them, and
# the one with the least residual wins (Tedaldi, Pretto and Menegatti, ICRA 2014, algorithm 1). Thresholds
# that lose poses are left out of the contest. With its rests the gyroscope is fitted.
#
# A rig that moves in a plane has two axes of the accelerometer in it and turns about z: the same code with
# bias and scale of x and y, the angle between them, and the scale of gz. That is taken where the log has
# these columns alone, or where all rests of a log in m/s^2 lie in the plane of x and y.

_POSE_RAD = math.radians(5.0)
_IN_PLANE = math.sin(math.radians(15.0))
_PLANE_SPREAD = math.cos(math.radians(30.0))
_LONGEST_FILLED_S = 0.1
_KEPT = 0.9


@dataclass(frozen=True)
class Trial:
    """One threshold: how many poses it shows, and the rests' residual with lost freedom counted."""

    multiple: float
    poses: int
    rms_mps2: float


@dataclass(frozen=True)
class Intrinsics:
    """What a log tells of an IMU.

    Attributes
    ----------
    planar, asked : whether two axes were calibrated, and whether that was asked for.
    lean_rad : about how far the plane leans by az, NaN where that is not known.
    quiet : spread at rest, and the rest at the start.
    multiple : of the threshold that won among `trials`.
    rests, poses : stretches at rest, and how many poses more than 5 degrees apart they show.
    accel : None for fewer rests than bias and scale need.
    gyro : None without turns, the axes of a gyroscope, or poses that tell the accelerometer.
    foreign : (3, 3) signed permutation where the gyroscope's axes are not the accelerometer's.
    turns_lost : turns not used, as readings are missing in them.
    has_gyro : whether the log has the gyroscope's axes that are needed.
    """

    log: Readings
    gravity_mps2: float
    planar: bool
    asked: bool
    lean_rad: float
    sampling: Sampling
    quiet: Quiet
    multiple: float
    trials: tuple[Trial, ...]
    rests: tuple[Rest, ...]
    poses: int
    accel: Accelerometer | None
    gyro: Gyroscope | None
    foreign: FloatArray | None
    turns_lost: int
    has_gyro: bool


def count_poses(directions: FloatArray) -> int:
    """How many of the unit vectors (n, d) are more than 5 degrees from each one counted before."""
    kept: list[FloatArray] = []
    for u in directions:
        if all(float(u @ v) < math.cos(_POSE_RAD) for v in kept):
            kept.append(u)
    return len(kept)


def _in_plane(rests: Sequence[Rest], columns: list[int]) -> bool:
    """Whether the rests lie in the plane of x and y, and turn in it."""
    if len(columns) != 3 or len(rests) < 3:
        return False
    u = _unit(np.stack([rest.mean for rest in rests]))
    apart = float((u @ u.T).min())
    return bool(np.abs(u[:, 2]).max() < _IN_PLANE and apart < _PLANE_SPREAD)


def _columns(log: Readings, planar: bool) -> list[int]:
    return log.places("ax", "ay", *([] if planar or "az" not in log.axes else ["az"]))


def _contest(
    parts: tuple[Part, ...], columns: list[int], s: Spread, quiet: Quiet, gravity_mps2: float, si: bool
) -> tuple[tuple[Trial, ...], Trial, tuple[Rest, ...], Accelerometer | None]:
    """All thresholds, the one that wins, its rests and its fit."""
    tried: list[tuple[Trial, tuple[Rest, ...], Accelerometer | None]] = []
    for multiple in MULTIPLES:
        rests = find_rests(parts, columns, s, multiple * quiet.zeta)
        accel = None
        if len(rests) >= 2 * len(columns):
            accel = fit_accelerometer(rests, gravity_mps2, si)
        poses, rms = 0, math.inf
        if accel is not None:
            poses = count_poses(accel.directions)
            if accel.dof > 0:
                rms = accel.rms_mps2 * math.sqrt(len(rests) / accel.dof)
        elif rests and si:
            poses = count_poses(_unit(np.stack([rest.mean for rest in rests])))
        else:
            poses = min(len(rests), 1)
        tried.append((Trial(multiple, poses, rms), rests, accel))
    most = max(trial.poses for trial, _, _ in tried)
    able = [one for one in tried if one[0].poses >= _KEPT * most]
    trial, rests, accel = min(able, key=lambda one: (one[0].rms_mps2, one[0].multiple))
    return tuple(one[0] for one in tried), trial, rests, accel


def _turns(
    log: Readings,
    parts: tuple[Part, ...],
    rests: tuple[Rest, ...],
    columns: list[int],
    quiet: Quiet,
    period_s: float,
    step: FloatArray,
) -> tuple[Turns, int]:
    """Turns between rests, and how many could not be used."""
    names = ("gx", "gy", "gz") if len(columns) == 3 else ("gz",)
    values = np.concatenate([part.values for part in parts])
    gyro = np.zeros((len(values), 3))
    gyro[:, 3 - len(names) :] = values[:, log.places(*names)]
    offsets = np.cumsum([0, *(len(part.values) for part in parts)]).tolist()
    longest = max(2, round(_LONGEST_FILLED_S / period_s))

    def inside_by(rest: Rest) -> int:
        return min(rest.samples // 2, round(INSET_S / period_s))

    spans = []
    for i, (a, b) in enumerate(itertools.pairwise(rests)):
        places = parts[a.part].places
        inside = places[(places >= a.stop - 1) & (places <= b.start)]
        if a.part == b.part and len(inside) >= 2 and int(np.diff(inside).max()) <= longest:
            spans.append(
                (offsets[a.part] + a.stop - 1 - inside_by(a), offsets[a.part] + b.start + inside_by(b), i)
            )
    first, last, before = np.array(spans, dtype=np.int64).reshape(-1, 3).T.copy()
    held = [gyro[offsets[rest.part] :][rest.middle] for rest in rests]
    # By differences, which a slow drift does not enter.
    scatter = np.stack([0.5 * (np.diff(one, axis=0) ** 2).mean(axis=0) for one in held])
    steps = np.zeros(3)
    steps[3 - len(names) :] = step[log.places(*names)]
    mean = np.stack([one.mean(axis=0) for one in held])
    rounded = rounding(np.median(scatter, axis=0), steps)
    long = [rest.duration_s for rest in rests] * _unturned(mean, rounded)
    turns = Turns(
        gyro=gyro,
        accel=values[:, columns],
        first=first,
        last=last,
        before=before,
        rests=rests,
        gyro_mean=mean,
        gyro_scatter=scatter,
        gyro_count=np.array([len(one) for one in held], dtype=np.float64),
        rounded=rounded,
        initial=0 if quiet.initial_s > 0.0 else int(np.argmax(long)),
        period_s=period_s,
    )
    return turns, len(rests) - 1 - len(spans)


def find_intrinsics(log: Readings, gravity_mps2: float, planar: bool = False) -> Intrinsics:
    """Calibrate an accelerometer, and a gyroscope where the log has one.

    Parameters
    ----------
    log : begins at rest, for the gyroscope's bias; then rests of a second or more in many poses.
    gravity_mps2 : g where the log was taken.
    planar : calibrate x, y and gz alone.

    Raises
    ------
    BadInputError for a log without the accelerometer's axes, shorter than a second, or never at rest.
    """
    columns = _columns(log, planar)
    sampling, parts = regular_parts(log)
    si = "a" not in log.counts
    asked, lean = planar, math.nan

    def still(columns: list[int]) -> tuple[Spread, Quiet]:
        s = spread(parts, columns, sampling.period_s)
        return s, quiet_level(s, sampling.step[columns])

    s, quiet = still(columns)
    if si and not planar and len(columns) == 3:
        planar = _in_plane(find_rests(parts, columns, s, 6.0 * quiet.zeta), columns)
    if planar or len(columns) == 2:
        planar, columns = True, _columns(log, True)
        s, quiet = still(columns)
    trials, won, rests, accel = _contest(parts, columns, s, quiet, gravity_mps2, si)
    if not rests:
        raise BadInputError(
            f"{log.source}: is never at rest for a second, expected rests in many poses and turns between"
        )
    if planar and si and "az" in log.axes:
        k = log.axes.index("az")
        z = np.concatenate([parts[rest.part].values[rest.start : rest.stop, k] for rest in rests])
        lean = math.asin(min(1.0, abs(float(z.mean())) / gravity_mps2))
    needed = ("gz",) if planar else ("gx", "gy", "gz")
    has_gyro = all(name in log.axes for name in needed)
    gyro, foreign, lost = None, None, 0
    # Directions of an accelerometer that is not told would be blamed on the gyroscope.
    if has_gyro and accel is not None and accel.span >= LEAST_SPAN:
        turns, lost = _turns(log, parts, rests, columns, quiet, sampling.period_s, sampling.step)
        if len(turns.first):
            gyro_si = "g" not in log.counts
            gyro = fit_gyroscope(turns, accel, gyro_si)
            foreign = foreign_axes(turns, accel, gyro, gyro_si)
    return Intrinsics(
        log=log,
        gravity_mps2=gravity_mps2,
        planar=planar,
        asked=asked,
        lean_rad=lean,
        sampling=sampling,
        quiet=quiet,
        multiple=won.multiple,
        trials=trials,
        rests=rests,
        poses=won.poses,
        accel=accel,
        gyro=gyro,
        foreign=foreign,
        turns_lost=lost,
        has_gyro=has_gyro,
    )


# ----------------------------------------------------------------------
# What an IMU's intrinsics are worth: a verdict, reasons in plain words, and poses that would help.
#
# - unidentifiable: the poses or turns do not tell the parameters at all;
# - inconsistent: they are told, but contradict each other or what an IMU is (another unit, another g,
#   axes of the gyroscope that are not the accelerometer's);
# - poor: known less well than `LIMITS`, or poses missing on one side;
# - ok otherwise.
#
# A scale and a bias of an axis are told apart by rests with the axis up and with it down. A side lacks where
# no rest has the axis within 60 degrees of it.

LIMITS = {"scale": 0.005, "bias_g": 0.005, "angle_rad": math.radians(0.5), "gyro": 0.01}
"""Largest standard deviations: relative scale, bias in g, misalignment, and those of the gyroscope."""

_USELESS = 20.0
_NEAR = 0.5
_LARGEST_RMS_G = 0.01
_GRAVITY_SHARE = 0.0027
"""By which gravity is less at the equator and more at the poles than the standard one."""
_OFF_SCALE = 0.15
_OFF_ANGLE_RAD = math.radians(15.0)
_ROUGH_TURNS_RAD, _WRONG_TURNS_RAD = 0.03, 0.2
_TIMES_OTHERS = 6.0
_LEAST_TRAVEL_RAD = 0.3


def protocol(planar: bool) -> str:
    """How to record a log for this verb, in a sentence."""
    if planar:
        return (
            "stand the plane upright, wait 10 s, then tilt about z by 45 degrees at a time through the whole "
            "circle and back, each tilt held still for 3 s"
        )
    return (
        "let it lie for 30 s, then put it down in 24 poses or more, each axis up and down and both ways at "
        "45 degrees between two axes, each held still for 3 s, turning about another axis every time"
    )


def _sides(accel: Accelerometer) -> Iterator[Finding]:
    u = accel.directions
    for k, axis in enumerate("xyz"[: u.shape[1]]):
        for sign, word in ((1.0, "up"), (-1.0, "down")):
            best = float((sign * u[:, k]).max())
            if best < _NEAR:
                nearest = math.degrees(math.acos(max(-1.0, best)))
                yield Finding(
                    "poor",
                    f"no rest with the {axis} axis {word}: the nearest is {nearest:.0f} degrees from it",
                    f"add rests with the {axis} axis {word}",
                )


def _names(d: int) -> list[str]:
    """The accelerometer's parameters in words, in their order."""
    words = [f"{what} of {axis}" for what in ("bias", "scale") for axis in "xyz"[:d]]
    return words + [f"misalignment {name}" for name in ANGLES[d]]


def _loose(
    sensor: str, names: Sequence[str], sigma: FloatArray, limits: FloatArray, planar: bool, by: str = ""
) -> Iterator[Finding]:
    """Findings on parameters that are known less well than their limits: g, shares and rad."""
    for name, one, limit in zip(names, sigma.tolist(), limits.tolist(), strict=True):
        if limit < one < math.inf:
            kind = name.split()[0]
            shown = f"{one:.2%}" if kind == "scale" else f"{one:.2g} {'g' if kind == 'bias' else 'rad'}"
            yield Finding(
                "unidentifiable" if one > _USELESS * limit else "poor",
                f"{sensor}, {name}: known to {shown} only{by}",
                protocol(planar),
            )


def _off_scale(scale: FloatArray, what: str, so: str, advice: str) -> Iterator[Finding]:
    off = float(scale[int(np.argmax(np.abs(scale - 1.0)))])
    if abs(off - 1.0) > _OFF_SCALE:
        yield Finding("inconsistent", f"{what} comes out as {off:.3g}, so {so}", advice)


def _of_accelerometer(result: Intrinsics, accel: Accelerometer) -> Iterator[Finding]:
    d, g, counts = len(accel.bias), result.gravity_mps2, "a" in result.log.counts
    told, names = accel.span >= LEAST_SPAN, _names(len(accel.bias))
    if told or not counts:
        yield from _sides(accel)
    if not told:
        *words, last = (names[place] for place in np.flatnonzero(np.abs(accel.weakest) > 0.3).tolist())
        mixed = f"{', '.join(words)} and {last}" if words else last
        yield Finding("unidentifiable", f"the poses do not tell {mixed} apart", protocol(result.planar))
        return
    k = len(accel.angles)
    size = np.concatenate([g * accel.scale, accel.scale, np.ones(k)])
    limits = np.repeat([LIMITS["bias_g"], LIMITS["scale"], LIMITS["angle_rad"]], [d, d, k])
    # Few rests more than parameters hardly tell how far they scatter: with one, 95 % lie within 12.7 sigma.
    spread = float(stdtrit(accel.dof, 0.975)) / 1.96 if accel.dof > 0 else 1.0
    n = len(result.rests)
    by = f", by {n} rests for {n - accel.dof} parameters" if spread > 1.5 else ""
    yield from _loose("accelerometer", names, spread * accel.sigma / size, limits, result.planar, by)
    if g == GRAVITY_MPS2 and float((accel.sigma[d : 2 * d] / accel.scale).max()) < _GRAVITY_SHARE:
        yield Finding(
            "remark",
            f"the scales hold where gravity is {g:g} m/s^2; on Earth it is 9.78 to 9.83, by "
            f"{_GRAVITY_SHARE:.2%} less or more",
            "state that of the place with --gravity where scales matter",
        )
    if not accel.skewed:
        yield Finding(
            "remark",
            "the poses do not tell the accelerometer's misalignment; it is taken to be zero, and the "
            f"gyroscope's, which are counted from its axes, hold to {_SQUARE_RAD:g} rad",
            "rests with two axes both at 45 degrees would show the misalignment",
        )
    if accel.dof <= 0:
        yield Finding(
            "poor",
            f"{len(result.rests)} rests for as many parameters: nothing is left to check them by, and sigma "
            "is that of the noise alone",
            protocol(result.planar),
        )
    elif accel.rms_mps2 > _LARGEST_RMS_G * g:
        yield Finding(
            "inconsistent",
            f"the rests disagree by {accel.rms_mps2:.3g} m/s^2, more than a bias, a scale and angles explain",
            "hold each pose still, far from what vibrates",
        )
    r = np.abs(accel.residual_mps2)
    others = 1.4826 * float(np.median(r))
    worst = int(np.argmax(r))
    if accel.dof >= 6 and r[worst] > max(_TIMES_OTHERS * others, 1e-3 * g):
        rest = result.rests[worst]
        yield Finding(
            "poor",
            f"the rest from {rest.from_s:.1f} to {rest.to_s:.1f} s is off by {r[worst]:.2g} m/s^2, "
            f"{r[worst] / max(others, 1e-12):.0f} times what the others are",
            "look at that rest: something pushed the sensor, or it crept",
        )
    if not counts:
        so = "the readings are not in the unit that was named, or gravity is another"
        yield from _off_scale(accel.scale, "a scale", so, "check --acc-unit and --gravity")
    skew = float(np.abs(accel.angles).max(initial=0.0))
    if accel.skewed and skew > _OFF_ANGLE_RAD:
        yield Finding(
            "inconsistent", f"two axes come out {math.degrees(skew):.0f} degrees from a right angle"
        )


def _swapped(P: FloatArray) -> str:
    """Which column measures which axis, for P with w = P x."""
    rows = np.argmax(np.abs(P), axis=0).tolist()
    return ", ".join(
        f"g{'xyz'[column]} measures {'-' if P[row, column] < 0 else ''}{'xyz'[row]}"
        for column, row in enumerate(rows)
    )


def _of_gyroscope(result: Intrinsics, gyro: Gyroscope) -> Iterator[Finding]:
    if result.foreign is not None:
        mirror = "; that mirrors it" if np.linalg.det(result.foreign) < 0.0 else ""
        yield Finding(
            "inconsistent",
            f"the gyroscope's axes are not the accelerometer's: {_swapped(result.foreign)}{mirror}",
            "put the gyroscope's columns into the accelerometer's order and signs",
        )
        return
    missed = f"the turns miss gravity's direction by {math.degrees(gyro.rms_rad):.2g} degrees"
    if result.sampling.at_limit[result.log.gyro].any() and gyro.rms_rad > _ROUGH_TURNS_RAD:
        yield Finding(
            "inconsistent",
            f"{missed}, as the gyroscope is at the end of its range in some of them",
            "set the sensor to a wider range, or turn more slowly",
        )
        return
    if gyro.rms_rad > _WRONG_TURNS_RAD:
        yield Finding(
            "inconsistent",
            f"{missed}: the rates are not in the unit that was named, or gyroscope and accelerometer do not "
            "belong together",
            "check --gyro-unit and the signs of the gyroscope",
        )
        return
    if gyro.rms_rad > _ROUGH_TURNS_RAD:
        yield Finding("poor", missed, "turn more slowly, in a second or two, and log at 100 Hz or more")
    used = np.isfinite(gyro.scale)
    if "g" not in result.log.counts:
        so = "its readings are not in the unit that was named"
        told = gyro.scale[used & np.isfinite(gyro.scale_sigma)]
        if len(told):
            yield from _off_scale(told, "a scale of the gyroscope", so, "check --gyro-unit")
    for k in np.flatnonzero(used).tolist():
        travel = float(gyro.travel_rad[k])
        if travel < _LEAST_TRAVEL_RAD:
            yield Finding(
                "poor",
                f"hardly a turn about the {'xyz'[k]} axis: {math.degrees(travel):.0f} degrees",
                f"turn by 90 degrees or more about the {'xyz'[k]} axis between rests",
            )
    names = [f"scale of g{axis}" for axis in "xyz"] + [f"misalignment {name}" for name in PLACES]
    sigma = np.concatenate([gyro.scale_sigma / np.abs(gyro.scale), gyro.angle_sigma])
    if unknown := int(np.isinf(sigma).sum()):
        yield Finding(
            "unidentifiable",
            f"{len(gyro.turns_s)} turn(s) do not tell the gyroscope's {unknown} parameters",
            protocol(result.planar),
        )
    yield from _loose("gyroscope", names, sigma, np.full(9, LIMITS["gyro"]), result.planar)
    if gyro.bias.sensitivity is not None:
        yield Finding(
            "remark",
            "the gyroscope's bias follows the pose; its sensitivity to the specific force is fitted as well",
        )


def _findings(result: Intrinsics) -> Iterator[Finding]:
    log, accel, planar = result.log, result.accel, result.planar
    yield from sampling_findings(result.sampling, () if log.counts else log.axes)
    if result.turns_lost:
        yield Finding("remark", f"{result.turns_lost} turn(s) not used: readings are missing in them")
    if result.quiet.initial_s == 0.0 and result.has_gyro:
        yield Finding(
            "poor",
            "the log does not begin at rest; the gyroscope's bias is that of its longest rest",
            "let the sensor lie still for 30 s at the start",
        )
    if planar and not result.asked:
        yield Finding("remark", "all poses lie in the plane of x and y: ax, ay and gz alone are calibrated")
    if planar:
        lean = "" if math.isnan(result.lean_rad) else (
            f"; by az it leans by {math.degrees(result.lean_rad):.1f} degrees at most, which would make the "
            f"scales {1.0 - math.cos(result.lean_rad):.2g} too small"
        )  # fmt: skip
        yield Finding("remark", "the plane is taken to stand upright" + lean)
    if accel is None:
        yield Finding(
            "unidentifiable",
            f"{len(result.rests)} rest(s) in {result.poses} pose(s) are fewer than the "
            f"{4 if planar else 6} that bias and scale need",
            protocol(planar),
        )
    else:
        yield from _of_accelerometer(result, accel)
    if result.gyro is not None:
        yield from _of_gyroscope(result, result.gyro)
    elif not result.has_gyro:
        needed = "gz" if planar else "gx, gy and gz"
        yield Finding("remark", f"without {needed} the gyroscope is not calibrated")
    elif accel is not None and accel.span >= LEAST_SPAN:
        yield Finding("unidentifiable", "no turn between two rests is there to calibrate the gyroscope by")
    yield from log.findings


def judge_intrinsics(result: Intrinsics) -> Verdict:
    """Verdict of a calibration of an IMU."""
    return Verdict.of(_findings(result))


# ----------------------------------------------------------------------
# The section.


def solve_intrinsics(log: Readings, gravity_mps2: float, planar: bool = False) -> ImuIntrinsics:
    """Calibrate, judge, and assemble the section; what the log does not tell is null."""
    result = find_intrinsics(log, gravity_mps2, planar)
    return ImuIntrinsics(
        gravity_mps2=result.gravity_mps2,
        planar=result.planar,
        rate_hz=result.sampling.rate_hz,
        rests=len(result.rests),
        poses=result.poses,
        rest_s=sum(rest.duration_s for rest in result.rests),
        degrees_of_freedom=None if result.accel is None else result.accel.dof,
        initial_rest_s=result.quiet.initial_s,
        threshold=result.multiple,
        thresholds={f"{trial.multiple:g}": finite_or_none(trial.rms_mps2) for trial in result.trials},
        accel=_accelerometer(result),
        gyro=None if result.gyro is None else _gyroscope(result, result.gyro),
        **judged(judge_intrinsics(result)),
    ).with_evidence(result)


def _three(values: FloatArray) -> list[float | None]:
    """x, y, z with null for what is not finite or not there."""
    out = [finite_or_none(value) for value in values.tolist()]
    return out + [None] * (3 - len(out))


def _named(names: Sequence[str], values: FloatArray) -> dict[str, float | None]:
    pairs = zip(names, values.tolist(), strict=True)
    return {name: finite_or_none(value) for name, value in pairs if not math.isnan(value)}


def _padded(matrix: FloatArray) -> list[list[float]]:
    """A matrix (r, c) as rows of three, zero where there is nothing."""
    out = np.zeros((3, 3))
    out[: matrix.shape[0], : matrix.shape[1]] = matrix
    rows: list[list[float]] = out.tolist()
    return rows


def _accelerometer(result: Intrinsics) -> AccelIntrinsics:
    unit: Literal["m/s2", "counts"] = "counts" if "a" in result.log.counts else "m/s2"
    accel = result.accel
    if accel is None or accel.span < LEAST_SPAN:
        unknown: list[float | None] = [None] * 3
        sigma = IntrinsicsSigma(bias=unknown, scale=unknown)
        return AccelIntrinsics(unit=unit, bias=unknown, scale=unknown, sigma=sigma)
    d = len(accel.bias)
    names = ANGLES[d] if accel.skewed else ()
    k = len(names)
    return AccelIntrinsics(
        unit=unit,
        bias=_three(accel.bias),
        scale=_three(accel.scale),
        misalignment_rad=_named(names, accel.angles[:k]),
        sigma=IntrinsicsSigma(
            bias=_three(accel.sigma[:d]),
            scale=_three(accel.sigma[d : 2 * d]),
            misalignment_rad=_named(names, accel.sigma[2 * d : 2 * d + k]),
        ),
        matrix=_padded(accel.matrix),
        rms_mps2=accel.rms_mps2,
        disagreement_mps2=accel.tau_mps2,
    )


def _gyroscope(result: Intrinsics, gyro: Gyroscope) -> GyroIntrinsics:
    used = np.isfinite(gyro.scale)
    known = np.isfinite(gyro.scale_sigma) & used & (result.foreign is None)
    angle_known = np.isfinite(gyro.angle_sigma) & (result.foreign is None)
    bias, names = gyro.bias, tuple(PLACES)
    square = 0.0 if result.accel is not None and result.accel.skewed else _SQUARE_RAD
    angle_sigma = np.where(angle_known, np.hypot(gyro.angle_sigma, square), math.nan)
    return GyroIntrinsics(
        unit="counts" if "g" in result.log.counts else "rad/s",
        bias=_three(np.where(used, bias.bias, math.nan)),
        scale=_three(np.where(known, gyro.scale, math.nan)),
        misalignment_rad=_named(names, np.where(angle_known, gyro.angles, math.nan)),
        sigma=GyroSigma(
            bias=_three(np.where(used, bias.sigma, math.nan)),
            scale=_three(np.where(known, gyro.scale_sigma, math.nan)),
            misalignment_rad=_named(names, angle_sigma),
            sensitivity=None if bias.sensitivity_sigma is None else _padded(bias.sensitivity_sigma),
        ),
        matrix=_padded(gyro.matrix) if known[used].all() else None,
        start_bias=_three(np.where(used, gyro.initial_bias, math.nan)),
        sensitivity=None if bias.sensitivity is None else _padded(bias.sensitivity),
        rms_rad=gyro.rms_rad,
        turns=len(gyro.turns_s),
    )
