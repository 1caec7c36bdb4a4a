"""Tables as text: rows of numbers as comma-separated lines by compiled code, digit for digit as Python's.

A number |v| 10^(8-e) with nine digits before its point has, after at most three products with powers of
ten that double precision holds exactly, an error below 4e-7; where its fraction is not that close to one
half, the rounded digits are those of exact arithmetic. What is closer, and what is not finite, is left to
Python's own formatting, row by row, so the text never depends on which of the two wrote it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from calib.core.arrays import FloatArray, IntArray

POWERS: FloatArray = np.array([10.0**k for k in range(23)])
"""10^0 .. 10^22, all exact."""

TIME, GENERAL, WHOLE = 0, 1, 2
"""Kinds of columns: six decimals; nine significant digits, shortest; no decimals. NaN is blank."""

_COMMA, _NEWLINE, _DOT, _ZERO, _MINUS, _PLUS, _E = 44, 10, 46, 48, 45, 43, 101
_WIDEST = 26
_FORMATS = {TIME: ".6f", GENERAL: ".9g", WHOLE: ".0f"}


@njit(cache=True, nogil=True, error_model="numpy")
def _whole(value: int, out: npt.NDArray[np.uint8], at: int) -> int:
    """Digits of a number that is not negative; the place behind them."""
    size, bound = 1, 10
    while value >= bound and size < 18:
        bound *= 10
        size += 1
    for k in range(at + size - 1, at - 1, -1):
        rest = value // 10
        out[k] = _ZERO + value - 10 * rest
        value = rest
    return at + size


@njit(cache=True, nogil=True, error_model="numpy")
def _time(value: float, out: npt.NDArray[np.uint8], at: int) -> int:
    """Six decimals; -1 where it is left to the caller."""
    if np.signbit(value) or not value < 1e15:
        return -1
    whole = int(value)
    # The fraction of a double is a double, so only this product is rounded.
    scaled = (value - whole) * 1e6
    micro = int(scaled)
    if abs(scaled - micro - 0.5) < 1e-9:
        return -1
    if scaled - micro > 0.5:
        micro += 1
    if micro == 1000000:
        whole, micro = whole + 1, 0
    at = _whole(whole, out, at)
    out[at] = _DOT
    for k in range(at + 6, at, -1):
        out[k] = _ZERO + micro % 10
        micro //= 10
    return at + 7


@njit(cache=True, nogil=True, error_model="numpy")
def _scaled(value: float, powers: FloatArray, exponent: int) -> float:
    """value 10^(8 - exponent)."""
    shift = 8 - exponent
    if shift < 0:
        return float(value / powers[-shift])
    while shift > 22:
        value *= powers[22]
        shift -= 22
    return float(value * powers[shift])


@njit(cache=True, nogil=True, error_model="numpy")
def _digits(rest: Any, out: npt.NDArray[np.uint8], at: int, digits: int, before: int) -> int:
    """So many digits, with a point behind the first `before` unless they are all; the place behind them."""
    point = 1 if digits > before else 0
    for k in range(digits - 1, -1, -1):
        cut = rest // np.uint32(10)
        out[at + k + (point if k >= before else 0)] = _ZERO + rest - np.uint32(10) * cut
        rest = cut
    if point:
        out[at + before] = _DOT
    return at + digits + point


@njit(cache=True, nogil=True, error_model="numpy")
def _general(value: float, powers: FloatArray, out: npt.NDArray[np.uint8], at: int) -> int:
    """Nine significant digits without zeros behind; -1 where it is left to the caller."""
    if value == 0.0:
        if np.signbit(value):
            out[at] = _MINUS
            at += 1
        out[at] = _ZERO
        return at + 1
    size = abs(value)
    if not 1e-50 < size < 1e25:
        return -1
    # floor(log10) from the binary exponent, 1233 / 4096 being log10(2); at most one off.
    e = int((((np.float64(size).view(np.int64) >> 52) - 1023) * 1233) >> 12)
    scaled = _scaled(size, powers, e)
    if scaled >= 1e9:
        e += 1
        scaled = _scaled(size, powers, e)
    elif scaled < 1e8:
        e -= 1
        scaled = _scaled(size, powers, e)
    m = int(scaled)
    if abs(scaled - m - 0.5) < 2e-6:
        return -1
    if scaled - m > 0.5:
        m += 1
    if m >= 1000000000:
        m //= 10
        e += 1
    # In 32 bits a division costs a third.
    rest: Any = np.uint32(m)
    digits = 9
    while rest % np.uint32(10000) == 0:
        rest //= np.uint32(10000)
        digits -= 4
    while rest % np.uint32(10) == 0:
        rest //= np.uint32(10)
        digits -= 1
    if value < 0.0:
        out[at] = _MINUS
        at += 1
    if -4 <= e < 0:
        out[at], out[at + 1] = _ZERO, _DOT
        at += 2
        for _ in range(-e - 1):
            out[at] = _ZERO
            at += 1
        return _digits(rest, out, at, digits, digits)
    before = 1 if e < -4 or e >= 9 else e + 1
    if digits <= before:
        at = _digits(rest, out, at, digits, digits)
        for _ in range(before - digits):
            out[at] = _ZERO
            at += 1
    else:
        at = _digits(rest, out, at, digits, before)
    if before == e + 1:
        return at
    out[at], out[at + 1] = _E, _MINUS if e < 0 else _PLUS
    size_of_e = abs(e)
    out[at + 2], out[at + 3] = _ZERO + size_of_e // 10, _ZERO + size_of_e % 10
    return at + 4


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(
    values: FloatArray, kinds: IntArray, powers: FloatArray, out: npt.NDArray[np.uint8], row: int
) -> tuple[int, int]:
    """Text of the rows from `row` on, to the first that holds a cell left to the caller, and its length."""
    at = 0
    for i in range(row, values.shape[0]):
        begin = at
        for j in range(values.shape[1]):
            if j > 0:
                out[at] = _COMMA
                at += 1
            value = values[i, j]
            if np.isnan(value):
                continue
            end = -1
            if kinds[j] == TIME:
                end = _time(value, out, at)
            elif kinds[j] == GENERAL:
                end = _general(value, powers, out, at)
            elif 0.0 <= value < 1e15 and value == np.floor(value) and not np.signbit(value):
                end = _whole(int(value), out, at)
            if end < 0:
                return i, begin
            at = end
        out[at] = _NEWLINE
        at += 1
    return values.shape[0], at


def _row(values: list[float], kinds: list[int]) -> bytes:
    cells = (
        "" if value != value else format(value, _FORMATS[kind])
        for value, kind in zip(values, kinds, strict=True)
    )
    return (",".join(cells) + "\n").encode()


def table_bytes(values: FloatArray, kinds: IntArray) -> bytes:
    """Rows (n, columns) as lines, with a kind for each column; NaN is a blank cell."""
    values = np.ascontiguousarray(values, dtype=np.float64)
    kinds = np.asarray(kinds, dtype=np.int64)
    out = np.empty(len(values) * (values.shape[1] * _WIDEST + 1) + 1, dtype=np.uint8)
    pieces, row = [], 0
    while row < len(values):
        row, size = _rows(values, kinds, POWERS, out, row)
        pieces.append(out[:size].tobytes())
        if row < len(values):
            pieces.append(_row(values[row].tolist(), kinds.tolist()))
            row += 1
    return b"".join(pieces)
