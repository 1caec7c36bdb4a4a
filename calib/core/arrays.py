"""Names for the array types that signatures use, how an array is cut, and its integral."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from calib.core.errors import UsageError

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
GrayImage: TypeAlias = npt.NDArray[np.uint8]
AnyArray: TypeAlias = npt.NDArray[Any]


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """First and behind the last of each run of set flags."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def blocks(values: FloatArray, size: int) -> FloatArray:
    """Values (n, ...) in whole blocks (n // size, size, ...); what is left at the end is left out."""
    return values[: len(values) // size * size].reshape(-1, size, *values.shape[1:])


def evenly(count: int, most: int) -> IntArray:
    """At most so many of `count` indices, spread evenly, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64))


def points_of(values: npt.ArrayLike, size: int) -> FloatArray:
    """Points (n, size) from those of a caller (..., size), as lists or numbers of any kind.

    Raises `UsageError` for another shape: rows and columns that are exchanged would be other points.
    """
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"found no table of numbers, expected points (n, {size})") from None
    if found.size and found.shape[-1:] != (size,):
        raise UsageError(f"found numbers of shape {found.shape}, expected points (n, {size})")
    return found.reshape(-1, size)


def integral(t: FloatArray, values: FloatArray) -> FloatArray:
    """Integral (n,) of values (n,) at t (n,) from the first of them on, by trapezoids.

    Of a rate that a sensor gives at t it is the angle at t; where a value holds for the step before it, as in
    (2.3c), the angle is half a step ahead.
    """
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t)
    return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]))


def rms(values: FloatArray) -> float:
    """Root mean square of values of any shape; NaN for none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def robust_sigma(values: FloatArray) -> float:
    """Standard deviation about zero of values (n,), by their median size: 1.4826 times it for normal ones."""
    return 1.4826 * float(np.median(np.abs(values)))
