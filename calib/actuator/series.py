"""The truncated series of the firmware: (3.10) forward, (3.14) inverse, and what they cost.

    H13 = l sum_n (-1)^n phi^(2n + 1) / (2n + 2)!,   H23 = l sum_n (-1)^n phi^(2n) / (2n + 1)!    (3.10)
    f(phi) = phi / sin(phi / 2) = 2 + phi^2 / 12 + 7 phi^4 / 2880 + 31 phi^6 / 483840 + ...        (3.14)

with phi = kappa l. `order` is the highest power of phi that is kept: the source uses H13 up to 7
and f up to 6. Its text gives 4.45e-5 as the error of f at pi / 2; that is the error at 1.5 rad, the
one at pi / 2 is 6.49e-5.

`calib.actuator.kinematics` has the exact functions; these here are for comparing and for constants
of a microcontroller.
"""

from __future__ import annotations

from fractions import Fraction
from math import factorial

import numpy as np

from calib.actuator.arc import chord_ratio
from calib.arrays import FloatArray
from calib.errors import BadInputError

__all__ = [
    "H13_ORDER",
    "H23_ORDER",
    "INVERSE_ORDER",
    "H13_error_m",
    "H13_series_m",
    "H23_error_m",
    "H23_series_m",
    "f_error",
    "f_series",
    "forward_series",
    "inverse_coefficients",
    "inverse_series",
]

H13_ORDER = 7
H23_ORDER = 6
INVERSE_ORDER = 6
"""Orders that the source truncates at."""


def _terms(order: int, first: int) -> int:
    """Number of terms up to and with phi^order of a series that starts at phi^first."""
    if order < first:
        raise BadInputError(f"order of the series: found {order}, expected {first} or more")
    return (order - first) // 2 + 1


def _polynomial(w: FloatArray, coefficients: list[float]) -> FloatArray:
    total = np.full_like(w, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * w + coefficient
    return total


def _arrays(phi: FloatArray, length_m: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    return np.asarray(phi, dtype=np.float64), np.asarray(length_m, dtype=np.float64)


def H13_series_m(phi: FloatArray, length_m: FloatArray | float, order: int = H13_ORDER) -> FloatArray:
    """x of the head [m] by (3.10a) up to phi^order, of phi (...) [rad] and the length [m]."""
    angle, ell = _arrays(phi, length_m)
    coefficients = [(-1.0) ** n / factorial(2 * n + 2) for n in range(_terms(order, 1))]
    return ell * angle * _polynomial(angle * angle, coefficients)


def H23_series_m(phi: FloatArray, length_m: FloatArray | float, order: int = H23_ORDER) -> FloatArray:
    """y of the head [m] by (3.10b) up to phi^order, of phi (...) [rad] and the length [m]."""
    angle, ell = _arrays(phi, length_m)
    coefficients = [(-1.0) ** n / factorial(2 * n + 1) for n in range(_terms(order, 0))]
    return ell * _polynomial(angle * angle, coefficients)


def inverse_coefficients(order: int = INVERSE_ORDER) -> tuple[Fraction, ...]:
    """Coefficients of phi^0, phi^2, ... phi^order of f (3.14): 2, 1/12, 7/2880, 31/483840, ...

    u / sin u has the coefficients c_n with sum_k (-1)^k c_(n-k) / (2k + 1)! = 0, and f is twice
    that at u = phi / 2.
    """
    c = [Fraction(1)]
    for n in range(1, _terms(order, 0)):
        c.append(-sum(((-1) ** k * c[n - k] / factorial(2 * k + 1) for k in range(1, n + 1)), Fraction(0)))
    return tuple(2 * value / 4**n for n, value in enumerate(c))


def f_series(phi: FloatArray, order: int = INVERSE_ORDER) -> FloatArray:
    """The series of (3.14) up to phi^order, of phi (...) [rad]."""
    angle = np.asarray(phi, dtype=np.float64)
    return _polynomial(angle * angle, [float(c) for c in inverse_coefficients(order)])


def H13_error_m(phi: FloatArray, length_m: FloatArray | float, order: int = H13_ORDER) -> FloatArray:
    """Exact minus truncated x of the head [m] (Figs. 3.2, 3.3)."""
    angle, ell = _arrays(phi, length_m)
    return ell * chord_ratio(angle) * np.sin(0.5 * angle) - H13_series_m(angle, ell, order)


def H23_error_m(phi: FloatArray, length_m: FloatArray | float, order: int = H23_ORDER) -> FloatArray:
    """Exact minus truncated y of the head [m]."""
    angle, ell = _arrays(phi, length_m)
    return ell * chord_ratio(angle) * np.cos(0.5 * angle) - H23_series_m(angle, ell, order)


def f_error(phi: FloatArray, order: int = INVERSE_ORDER) -> FloatArray:
    """Exact minus truncated f (Figs. 3.4, 3.5), |phi| < 2 pi."""
    return 2.0 / chord_ratio(phi) - f_series(phi, order)


def forward_series(q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Head (..., 3) [m, m, rad] of the bellows (..., 2) as the source's simulation has it."""
    q = np.asarray(q_m, dtype=np.float64)
    phi = (q[..., 0] - q[..., 1]) / (2.0 * bellows_radius_m)
    ell = 0.5 * (q[..., 0] + q[..., 1])
    return np.stack([H13_series_m(phi, ell), H23_series_m(phi, ell), phi], axis=-1)


def inverse_series(pose: FloatArray, bellows_radius_m: float, order: int = INVERSE_ORDER) -> FloatArray:
    """Bellows (..., 2) [m] of the head (..., 3) by (3.12) with the series for f, as the firmware does.

    q1 = r_B phi + |(x, y)| f(phi) / 2 and q2 = -r_B phi + |(x, y)| f(phi) / 2.
    """
    x, y, phi = np.moveaxis(np.asarray(pose, dtype=np.float64), -1, 0)
    ell = 0.5 * np.hypot(x, y) * f_series(phi, order)
    return np.stack([ell + bellows_radius_m * phi, ell - bellows_radius_m * phi], axis=-1)
