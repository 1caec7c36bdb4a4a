"""Kinematics of one section of constant curvature, exact and as the firmware's truncated series."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from math import factorial
from typing import ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError

# ----------------------------------------------------------------------
# The circular arc: four functions of its angle on which kinematics and dynamics rest.
#
# An arc of length l that turns by phi has the chord l S(phi) in the direction phi / 2, with
#
#     S(phi) = sin(phi / 2) / (phi / 2),   S'(phi) = -phi D(phi),   S''(phi) = 2 D(phi) - S(phi) / 4,
#     D(phi) = (S(phi) - cos(phi / 2)) / phi^2.
#
# The second derivative follows from the differential equation of the spherical Bessel function j0.
# S and D are entire and even, so both are power series in w = phi^2 without any singularity: there is
# nothing to switch at zero curvature, and (3.9) holds by itself. D has no closed form that does not
# cancel at zero; `chord_ratio_w` and `chord_decay_w` sum the series, to the last bit for |phi| <= 4 and
# within 1e-15 up to 2 pi, where the arc closes on itself and the model ends.
#
# With them H13 = l S sin(phi / 2) and H23 = l S cos(phi / 2) in (3.6), f = 2 / S in (3.13).
#
# The functions whose names end in `_w` are plain Python for arrays and for numbers, and the compiled
# kernel inlines the same functions (`inlined`).

FULL_CIRCLE_RAD = 2.0 * np.pi
"""At this angle the chord vanishes and the mass matrix loses its rank: the end of the model."""

LARGEST_ANGLE_RAD = 6.0
"""Where simulations stop: the chord is a twentieth of the arc, and soon no step is small enough."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result", float, FloatArray)
Returned = TypeVar("Returned")


def inlined(function: Callable[Parameters, Returned]) -> Callable[Parameters, Returned]:
    """Leave a scalar function as it is for Python and let compiled callers inline it.

    Without the inlining each call copies the coefficients, which costs a third of the speed.
    """
    register_jitable(forceinline=True, error_model="numpy")(function)
    return function


_TERMS = 13
"""The first term left out, pi^(2n) / (2n + 1)! at phi = 2 pi, is 8e-16 for n = 13; at pi it is 1e-23."""

_RATIO = tuple(float(Fraction((-1) ** n, factorial(2 * n + 1) * 4**n)) for n in range(_TERMS))
_DECAY = tuple(
    float((Fraction(1, factorial(2 * n + 1)) - Fraction(1, factorial(2 * n))) * Fraction((-1) ** n, 4**n))
    for n in range(1, _TERMS + 1)
)


@inlined
def _series(c: tuple[float, ...], w: Result) -> Result:
    """Sum of c[n] w^n by Estrin's scheme: its additions wait for each other in five places, not in twelve."""
    w2 = w * w
    w4 = w2 * w2
    low = (c[0] + c[1] * w) + (c[2] + c[3] * w) * w2
    middle = (c[4] + c[5] * w) + (c[6] + c[7] * w) * w2
    high = (c[8] + c[9] * w) + (c[10] + c[11] * w) * w2 + c[12] * w4
    return (low + middle * w4) + high * (w4 * w4)


@inlined
def chord_ratio_w(w: Result) -> Result:
    """S as a function of w = phi^2."""
    return _series(_RATIO, w)


@inlined
def chord_decay_w(w: Result) -> Result:
    """D = -2 dS/dw as a function of w = phi^2."""
    return _series(_DECAY, w)


def chord_ratio(phi: FloatArray) -> FloatArray:
    """S, chord over arc length, of the angle phi [rad], any shape; exact for every angle."""
    return np.sinc(np.asarray(phi, dtype=np.float64) / FULL_CIRCLE_RAD)


def chord_decay(phi: FloatArray) -> FloatArray:
    """D = -S' / phi of the angle phi [rad], any shape, for |phi| <= 2 pi."""
    angle = np.asarray(phi, dtype=np.float64)
    return chord_decay_w(angle * angle)


def chord_slope(phi: FloatArray) -> FloatArray:
    """S' of the angle phi [rad], any shape, for |phi| <= 2 pi."""
    return -np.asarray(phi, dtype=np.float64) * chord_decay(phi)


def chord_curvature(phi: FloatArray) -> FloatArray:
    """S'' of the angle phi [rad], any shape, for |phi| <= 2 pi."""
    return 2.0 * chord_decay(phi) - 0.25 * chord_ratio(phi)


# ----------------------------------------------------------------------
# Actuator, configuration and task space of one section, both ways, with their derivatives.
#
#     q = (q1, q2)        lengths of the bellows [m]                                  (3.1)
#     k = (kappa, l)      curvature [1/m] and length of the backbone [m]              (3.2)
#     x = (x, y, phi)     head in the world frame [m, m, rad]                         (3.4)
#
#     phi = kappa l = (q1 - q2) / (2 r_B),   l = (q1 + q2) / 2                        (3.3)
#     (x, y) = l S(phi) (sin(phi / 2), cos(phi / 2))                                  (3.6), (3.10)
#     l = |(x, y)| / S(phi)                                                           (3.11), (3.12)
#
# with S as above. World: x to the right, y along the straight actuator towards the head, phi > 0 bends the
# head towards +x and bellows 1, at -r_B in the head's frame, is then longer.
#
# The rotation in (3.6) is printed the other way round: the arc's tangent at the head is
# (sin phi, cos phi), as (A.1) has it, so the block is [[cos, sin], [-sin, cos]].
#
# All functions take arrays with any leading dimensions.

MARKER_OFFSET_M = 0.015
"""Distance d from the head to the marker along the head's tangent (A.1)."""


def _parts(values: FloatArray, size: int, what: str) -> tuple[FloatArray, ...]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != size:
        raise BadInputError(f"{what}: found shape {array.shape}, expected (..., {size})")
    return tuple(array[..., i] for i in range(size))


def angle(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Bending angle phi [rad] of the bellows' lengths (..., 2) (3.3)."""
    q1, q2 = _parts(q_m, 2, "bellows")
    return (q1 - q2) / (2.0 * bellows_radius_m)


def length(q_m: FloatArray) -> FloatArray:
    """Length l [m] of the backbone (3.3)."""
    q1, q2 = _parts(q_m, 2, "bellows")
    return 0.5 * (q1 + q2)


def angle_and_length(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Angle and length (..., 2) [rad, m] of the bellows' lengths (..., 2) (3.3); of rates their rates."""
    return np.stack([angle(q_m, bellows_radius_m), length(q_m)], axis=-1)


def bellows(phi_rad: npt.ArrayLike, length_m: npt.ArrayLike, bellows_radius_m: float) -> FloatArray:
    """Lengths of the bellows (..., 2) [m] of an angle and a length (3.3); of rates their rates."""
    middle, turned = np.asarray(length_m), bellows_radius_m * np.asarray(phi_rad)
    return np.stack([middle + turned, middle - turned], axis=-1)


def configuration_from_pose(pose: FloatArray) -> FloatArray:
    """Curvature and length (..., 2) [1/m, m] of the head (..., 3) (3.11).

    Raises `BadInputError` for |phi| >= 2 pi, where no chord is left to measure.
    """
    x, y, phi = _parts(pose, 3, "pose")
    if np.any(np.abs(phi) >= FULL_CIRCLE_RAD):
        raise BadInputError(
            f"pose: found an angle of {np.nanmax(np.abs(phi)):.6g} rad, expected less than a full circle"
        )
    ell = np.hypot(x, y) / chord_ratio(phi)
    return np.stack([phi / ell, ell], axis=-1)


def forward(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Head (..., 3) [m, m, rad] of the bellows' lengths (..., 2) (3.3), (3.6)."""
    phi = angle(q_m, bellows_radius_m)
    chord = length(q_m) * chord_ratio(phi)
    return np.stack([chord * np.sin(0.5 * phi), chord * np.cos(0.5 * phi), phi], axis=-1)


def inverse(pose: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Lengths of the bellows (..., 2) [m] of the head (..., 3) (3.12).

    Only the distance of (x, y) from the base counts, as in the source. Raises `BadInputError` for
    |phi| >= 2 pi.
    """
    return bellows(np.asarray(pose)[..., 2], configuration_from_pose(pose)[..., 1], bellows_radius_m)


def _arc_derivatives(phi: FloatArray) -> tuple[FloatArray, ...]:
    """a = S sin(phi / 2) and b = S cos(phi / 2) with their first and second derivatives."""
    S, S1, S2 = chord_ratio(phi), chord_slope(phi), chord_curvature(phi)
    s, c = np.sin(0.5 * phi), np.cos(0.5 * phi)
    return (
        S * s,
        S1 * s + 0.5 * S * c,
        S2 * s + S1 * c - 0.25 * S * s,
        S * c,
        S1 * c - 0.5 * S * s,
        S2 * c - S1 * s - 0.25 * S * c,
    )


def _to_bellows(by_length: FloatArray, by_phi: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Columns d/dq1, d/dq2 from d/dl, d/dphi: ell = (q1 + q2) / 2, phi = (q1 - q2) / (2 r_B)."""
    half_l, half_phi = 0.5 * by_length, by_phi / (2.0 * bellows_radius_m)
    return np.stack([half_l + half_phi, half_l - half_phi], axis=-1)


def forward_jacobian(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """J = d(x, y, phi) / d(q1, q2), shape (..., 3, 2), of `forward`, for |phi| <= 2 pi."""
    phi, ell = angle(q_m, bellows_radius_m), length(q_m)
    a, a1, _, b, b1, _ = _arc_derivatives(phi)
    zero, one = np.zeros_like(phi), np.ones_like(phi)
    return _to_bellows(
        np.stack([a, b, zero], axis=-1), np.stack([ell * a1, ell * b1, one], axis=-1), bellows_radius_m
    )


def forward_jacobian_rate(q_m: FloatArray, dq_mps: FloatArray, bellows_radius_m: float) -> FloatArray:
    """dJ/dt, shape (..., 3, 2), along (q, dq): the head accelerates with J ddq + dJ/dt dq."""
    phi, ell = angle(q_m, bellows_radius_m), length(q_m)
    dphi, dl = angle(dq_mps, bellows_radius_m), length(dq_mps)
    _, a1, a2, _, b1, b2 = _arc_derivatives(phi)
    zero = np.zeros_like(phi * dphi)
    return _to_bellows(
        np.stack([a1 * dphi, b1 * dphi, zero], axis=-1),
        np.stack([dl * a1 + ell * a2 * dphi, dl * b1 + ell * b2 * dphi, zero], axis=-1),
        bellows_radius_m,
    )


def _along_tangent(phi: FloatArray, distance_m: float) -> FloatArray:
    phi = np.asarray(phi, dtype=np.float64)
    return distance_m * np.stack([np.sin(phi), np.cos(phi)], axis=-1)


def marker_from_head(head_m: FloatArray, phi: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Marker (..., 2) [m] of the head (..., 2) [m] and the angle phi (...) [rad], (A.1) reversed."""
    return np.asarray(head_m, dtype=np.float64) + _along_tangent(phi, offset_m)


def angle_from_marker(marker_m: FloatArray, offset_m: float = MARKER_OFFSET_M) -> FloatArray:
    """Bending angle phi (n,) [rad] of markers (n, 2) [m]: tan(phi / 2) = x / (y + d), whatever the length.

    The chord to the head has half of the head's angle (3.10), and the marker lies d beyond it (A.1).
    """
    x, y = marker_m.T
    return np.asarray(2.0 * np.arctan2(x, y + offset_m))


# ----------------------------------------------------------------------
# The truncated series of the firmware for the inverse kinematics (3.14):
#
#     f(phi) = phi / sin(phi / 2) = 2 + phi^2 / 12 + 7 phi^4 / 2880 + 31 phi^6 / 483840 + ...
#
# with phi = kappa l. `order` is the highest power of phi that is kept, 6 in the source. Its text gives
# 4.45e-5 as the error at pi / 2; that is the error at 1.5 rad, the one at pi / 2 is 6.49e-5.

INVERSE_ORDER = 6
"""Order that the source truncates at."""


def inverse_coefficients(order: int = INVERSE_ORDER) -> tuple[Fraction, ...]:
    """Coefficients of phi^0, phi^2, ... phi^order of f (3.14): 2, 1/12, 7/2880, 31/483840, ...

    u / sin u has the coefficients c_n with sum_k (-1)^k c_(n-k) / (2k + 1)! = 0, and f is twice
    that at u = phi / 2.
    """
    c = [Fraction(1)]
    for n in range(1, order // 2 + 1):
        c.append(-sum(((-1) ** k * c[n - k] / factorial(2 * k + 1) for k in range(1, n + 1)), Fraction(0)))
    return tuple(2 * value / 4**n for n, value in enumerate(c))
