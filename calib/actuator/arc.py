"""The circular arc: four functions of its angle on which kinematics and dynamics rest.

An arc of length l that turns by phi has the chord l S(phi) in the direction phi / 2, with

    S(phi) = sin(phi / 2) / (phi / 2),   S'(phi) = -phi D(phi),   S''(phi) = 2 D(phi) - S(phi) / 4,
    D(phi) = (S(phi) - cos(phi / 2)) / phi^2.

The second derivative follows from the differential equation of the spherical Bessel function j0.
S and D are entire and even, so both are power series in w = phi^2 without any singularity: there is
nothing to switch at zero curvature, and (3.9) holds by itself. D has no closed form that does not
cancel at zero; `chord_ratio_w` and `chord_decay_w` sum the series, to the last bit for |phi| <= 4 and
within 1e-15 up to 2 pi, where the arc closes on itself and the model ends.

With them H13 = l S sin(phi / 2) and H23 = l S cos(phi / 2) in (3.6), f = 2 / S in (3.13).

The functions whose names end in `_w` are plain Python for arrays and for numbers, and the compiled
kernel inlines the same functions (`inlined`).
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from math import factorial
from typing import ParamSpec, TypeVar

import numpy as np
from numba.extending import register_jitable

from calib.arrays import FloatArray

__all__ = [
    "FULL_CIRCLE_RAD",
    "LARGEST_ANGLE_RAD",
    "chord_curvature",
    "chord_decay",
    "chord_decay_w",
    "chord_ratio",
    "chord_ratio_w",
    "chord_slope",
    "inlined",
]

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
