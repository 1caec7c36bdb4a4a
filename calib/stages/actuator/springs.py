"""Stiffness from hanging weights or steady elongations: linear and polynomial, zero at zero (Fig. 3.10).

    F = (k0 + k1 eps + k2 eps^2 + ...) eps

by least squares on the force, with the standard deviation and correlation of the coefficients. The order
is the one whose force at points left out is best; a higher one has to beat a lower by a twentieth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, rms
from calib.core.errors import BadInputError

_ORDERS = (1, 2, 3)
_HIGHER = 0.95


@dataclass(frozen=True)
class StiffnessFit:
    """A law of one order.

    Attributes
    ----------
    coefficients, sigma : (order,) k0 [N/m], k1 [N/m^2], ...
    correlation : (order, order). rms_N : over the points. left_out_rms_N : over points left out in turn.
    """

    coefficients: FloatArray
    sigma: FloatArray
    correlation: FloatArray
    rms_N: float
    left_out_rms_N: float

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return len(self.coefficients)

    def force_N(self, elongation_m: FloatArray) -> FloatArray:
        """Force [N] at elongations (n,) [m]."""
        return np.asarray(np.polyval(self.coefficients[::-1], elongation_m) * elongation_m)


def _one(eps: FloatArray, force: FloatArray, order: int) -> StiffnessFit:
    A = np.stack([eps ** (k + 1) for k in range(order)], axis=1)
    size = np.sqrt(np.sum(A * A, axis=0))
    B = A / size
    inverse = np.linalg.inv(B.T @ B)
    k = inverse @ (B.T @ force)
    residual = force - B @ k
    leverage = np.sum((B @ inverse) * B, axis=1)
    left = residual / np.maximum(1.0 - leverage, 1e-6)
    variance = float(residual @ residual) / max(len(eps) - order, 1)
    spread = np.sqrt(variance * np.diag(inverse))
    root = np.sqrt(np.diag(inverse))
    return StiffnessFit(
        k / size,
        spread / size,
        inverse / np.outer(root, root),
        rms(residual),
        rms(left),
    )


def fit_stiffness(name: str, elongation_m: FloatArray, force_N: FloatArray) -> tuple[list[StiffnessFit], int]:
    """Laws of all orders that the points allow, and the index of the one to use.

    Parameters
    ----------
    elongation_m, force_N : (n,) from the rest length on; points at zero say nothing.

    Raises `BadInputError` for fewer than three points, or forces that do not pull with the elongation.
    """
    eps, force = np.asarray(elongation_m, dtype=np.float64), np.asarray(force_N, dtype=np.float64)
    some = np.abs(eps) > 1e-9
    eps, force = eps[some], force[some]
    levels = len(np.unique(np.round(eps, 9)))
    if levels < 3:
        raise BadInputError(f"{name}: has {levels} elongations apart from zero, expected at least 3")
    if not float(eps @ force) > 0.0:
        raise BadInputError(f"{name}: force and elongation have opposite signs, expected the same")
    fits = [_one(eps, force, order) for order in _ORDERS if order < levels]
    best = 0
    for k in range(1, len(fits)):
        if fits[k].left_out_rms_N < _HIGHER * fits[best].left_out_rms_N:
            best = k
    return fits, best
