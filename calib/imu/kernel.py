"""Compiled sums over long logs."""

from __future__ import annotations

from numba import njit

from calib.arrays import FloatArray

__all__ = ["sum_of_squared_differences"]


# Additions may be taken in any order, so that several are done at once; nothing else is loosened.
@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz", "contract"})
def sum_of_squared_differences(x: FloatArray, m: int) -> float:
    """Sum of (x_(k+2m) - 2 x_(k+m) + x_k)^2 over x (n,), zero where n <= 2 m."""
    total = 0.0
    for k in range(len(x) - 2 * m):
        v = x[k + 2 * m] - 2.0 * x[k + m] + x[k]
        total += v * v
    return total
