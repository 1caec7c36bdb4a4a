"""Angle and length as splines of time: a quintic B-spline with equal knots, and sums over its rows.

Within a knot span i, at the fraction x of it, the spline is sum_j b_j(x) c_(i+j) over six coefficients with

    b_j(x) = sum_s M[s, j] x^s,   M[s, j] = C(5, s) / 5! sum_(k >= j) (-1)^(k-j) C(6, k-j) (5 - k)^(5-s)

(Qin 1998). Its second derivative is a cubic spline, so that accelerations of a swing of 4 Hz are met to a
thousandth with two samples of a 100 Hz IMU per span. A coefficient is a pair (phi, l); a row of measurement
touches twelve numbers that lie side by side, which makes the normal equations banded.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray, IntArray
from calib.core.compilation import kernel
from calib.stages.estimator.sensors import SIZE, accelerometer, gyroscope, marker_rows

_DEGREE = 5
_ORDER = _DEGREE + 1
BAND = 2 * _ORDER
"""Diagonals of the normal equations, the main one included."""


def _matrix() -> FloatArray:
    p = _DEGREE
    M = np.zeros((p + 1, p + 1))
    for s in range(p + 1):
        for j in range(p + 1):
            total = sum(
                (-1) ** (k - j) * math.comb(p + 1, k - j) * (p - k) ** (p - s) for k in range(j, p + 1)
            )
            M[s, j] = math.comb(p, s) * total / math.factorial(p)
    return M


_M = _matrix()


@dataclass(frozen=True)
class Knots:
    """Equal knot spans from `start_s` on, each `span_s` long; `count` coefficients."""

    start_s: float
    span_s: float
    count: int

    @property
    def middles(self) -> FloatArray:
        """Times in the middle of the spans, (count - 5,)."""
        return np.asarray(self.start_s + self.span_s * (np.arange(self.count - _DEGREE) + 0.5))

    @staticmethod
    def over(start_s: float, end_s: float, span_s: float) -> Knots:
        """Knots that cover a time."""
        spans = max(1, math.ceil((end_s - start_s) / span_s))
        return Knots(start_s, span_s, spans + _DEGREE)


CHUNK = 8192
"""Measurements of which gradients are held at one time: 600 bytes each."""


def chunks(count: int) -> Iterator[slice]:
    """Parts of so many measurements; one empty part of none."""
    for first in range(0, max(count, 1), CHUNK):
        yield slice(first, min(first + CHUNK, count))


@dataclass(frozen=True)
class Rows:
    """Measurements of one kind in a stretch or a part of it, linearised.

    Attributes
    ----------
    span : (n,) first coefficient of each. basis : (n, 3, 6) of value, first and second derivative.
    predicted : (n, channels). by : (n, channels, 20), gradients as in `calib.stages.estimator.sensors`.
    """

    span: IntArray
    basis: FloatArray
    predicted: FloatArray
    by: FloatArray


@kernel()
def _basis(
    M: FloatArray, start: float, h: float, count: int, t_s: FloatArray, span: IntArray, basis: FloatArray
) -> None:
    last = count - _ORDER
    for n in range(len(t_s)):
        place = (t_s[n] - start) / h
        i = min(max(int(np.floor(place)), 0), last)
        x = place - i
        span[n] = i
        for j in range(_ORDER):
            value, slope, bend = 0.0, 0.0, 0.0
            for s in range(_DEGREE, -1, -1):
                bend = bend * x + 2.0 * slope
                slope = slope * x + value
                value = value * x + M[s, j]
            basis[n, 0, j], basis[n, 1, j], basis[n, 2, j] = value, slope / h, bend / (h * h)


def basis_rows(knots: Knots, t_s: FloatArray) -> tuple[IntArray, FloatArray]:
    """Spans (n,) and bases (n, 3, 6) at these times (n,); the ends' polynomials go on outside."""
    span, basis = np.empty(len(t_s), dtype=np.int64), np.empty((len(t_s), 3, _ORDER))
    _basis(_M, knots.start_s, knots.span_s, knots.count, np.ascontiguousarray(t_s), span, basis)
    return span, basis


@kernel()
def states_of(span: IntArray, basis: FloatArray, c: FloatArray, sensor: FloatArray) -> FloatArray:
    """States (n, 20) of coefficients c (count, 2) and `SENSOR` (14,), its time offset already taken."""
    states = np.empty((len(span), SIZE))
    for n in range(len(span)):
        for d in range(3):
            phi, length = 0.0, 0.0
            for j in range(basis.shape[2]):
                phi += basis[n, d, j] * c[span[n] + j, 0]
                length += basis[n, d, j] * c[span[n] + j, 1]
            states[n, 2 * d], states[n, 2 * d + 1] = phi, length
        for k in range(len(sensor)):
            states[n, 6 + k] = sensor[k]
        states[n, 13] = 0.0
    return states


@kernel()
def _felt(states: FloatArray) -> tuple[FloatArray, FloatArray]:
    out, by = np.empty((len(states), 3)), np.empty((len(states), 3, states.shape[1]))
    for n in range(len(states)):
        out[n, 0], out[n, 1] = accelerometer(states[n], by[n, 0], by[n, 1])
        out[n, 2] = gyroscope(states[n], by[n, 2])
    return out, by


def camera_rows(view: FloatArray, knots: Knots, c: FloatArray, sensor: FloatArray, t_s: FloatArray) -> Rows:
    """Pixels of pictures with the stamps (n,), exposed `time_offset_s` earlier."""
    span, basis = basis_rows(knots, t_s - sensor[7])
    return Rows(span, basis, *marker_rows(view, states_of(span, basis, c, sensor)))


def imu_rows(knots: Knots, c: FloatArray, sensor: FloatArray, t_s: FloatArray) -> Rows:
    """Readings a_x, a_y, g_z at the times (n,)."""
    span, basis = basis_rows(knots, t_s)
    return Rows(span, basis, *_felt(states_of(span, basis, c, sensor)))


@kernel()
def _row(basis: FloatArray, by: FloatArray, J: FloatArray) -> None:
    for j in range(basis.shape[1]):
        J[2 * j] = by[0] * basis[0, j] + by[2] * basis[1, j] + by[4] * basis[2, j]
        J[2 * j + 1] = by[1] * basis[0, j] + by[3] * basis[1, j] + by[5] * basis[2, j]


@kernel()
def normal_sums(
    span: IntArray, basis: FloatArray, by: FloatArray, weight: FloatArray, A: FloatArray, B: FloatArray,
    C: FloatArray,
) -> None:  # fmt: skip
    """Add weight J J' of all rows to A (12, 2 count), lower banded, B (2 count, 14) and C (14, 14)."""
    J = np.empty(2 * basis.shape[2])
    for n in range(len(span)):
        first = 2 * span[n]
        for channel in range(by.shape[1]):
            w = weight[n, channel]
            if w == 0.0:
                continue
            g = by[n, channel]
            _row(basis[n], g, J)
            for a in range(len(J)):
                wa = w * J[a]
                if wa == 0.0:
                    continue
                for b in range(a, len(J)):
                    A[b - a, first + a] += wa * J[b]
                for k in range(6, g.shape[0]):
                    if g[k] != 0.0:
                        B[first + a, k - 6] += wa * g[k]
            for k in range(6, g.shape[0]):
                if g[k] != 0.0:
                    for m in range(6, g.shape[0]):
                        C[k - 6, m - 6] += w * g[k] * g[m]


@kernel()
def gathered(
    span: IntArray, basis: FloatArray, by: FloatArray, pull: FloatArray, to_c: FloatArray, to_s: FloatArray
) -> None:
    """Add J' pull of all rows, pull (n, channels), to (2 count,) and (14,)."""
    J = np.empty(2 * basis.shape[2])
    for n in range(len(span)):
        first = 2 * span[n]
        for channel in range(by.shape[1]):
            p = pull[n, channel]
            if p == 0.0:
                continue
            g = by[n, channel]
            _row(basis[n], g, J)
            for a in range(len(J)):
                to_c[first + a] += p * J[a]
            for k in range(6, g.shape[0]):
                to_s[k - 6] += p * g[k]
