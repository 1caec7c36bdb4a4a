"""The compiled hot path: Runge-Kutta steps of the plant with its pumps, tick by tick.

The mathematics is that of `dynamics.rates` and `pump.advance`, inlined. Forces are known ahead of the
mechanics, at the start, middle and end of each step, so the step is of fourth order.

A state is the row

    q1, q2 [m], dq1, dq2 [m/s], z1, z2 [N], lag1, lag2, force1, force2 [N].

`run` follows one parameter set, `run_lanes` `LANES` sets side by side, which the compiler turns into
vector instructions: the same numbers at a quarter of the time for each.

The functions are cached on disk beside this file. The cache notices a change of this file only, not
of the functions that it inlines: touch it after editing `dynamics`, `pump` or `arc`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np
from numba import njit

from calib.actuator.arc import LARGEST_ANGLE_RAD, inlined
from calib.actuator.dynamics import Coefficients, rates
from calib.actuator.pump import PumpCoefficients, advance
from calib.arrays import FloatArray

__all__ = ["LANES", "LANE_COEFFICIENTS", "STATE", "derivative", "run", "run_lanes"]

STATE = (
    "q1_m",
    "q2_m",
    "dq1_mps",
    "dq2_mps",
    "z1_N",
    "z2_N",
    "lag1_N",
    "lag2_N",
    "force1_N",
    "force2_N",
)

LANES = 16
"""Sets side by side; with fewer the compiler leaves the loop scalar, with more nothing is gained."""

LANE_COEFFICIENTS = 18
"""Rows of the coefficients of `run_lanes`: 13 of the plant, decay, and 4 of the pump."""


Function = TypeVar("Function", bound=Callable[..., object])


def _compiled(function: Function) -> Function:
    """Compile at the first call; keep the result on disk where some folder can be written."""
    try:
        kept = njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        kept = njit(nogil=True, error_model="numpy")(function)
    return cast(Function, kept)


@inlined
def _step(
    c: Coefficients,
    y: tuple[float, float, float, float, float, float],
    h: float,
    start: tuple[float, float],
    middle: tuple[float, float],
    end: tuple[float, float],
) -> tuple[float, float, float, float, float, float]:
    """One classical Runge-Kutta step of (l, phi, dl, dphi, z1 + z2, z1 - z2)."""
    x, p, u, v, s, d = y
    g = 0.5 * h
    a1, b1, s1, d1 = rates(c, x, p, u, v, s, d, start[0], start[1])
    u2, v2 = u + g * a1, v + g * b1
    a2, b2, s2, d2 = rates(c, x + g * u, p + g * v, u2, v2, s + g * s1, d + g * d1, middle[0], middle[1])
    u3, v3 = u + g * a2, v + g * b2
    a3, b3, s3, d3 = rates(c, x + g * u2, p + g * v2, u3, v3, s + g * s2, d + g * d2, middle[0], middle[1])
    u4, v4 = u + h * a3, v + h * b3
    a4, b4, s4, d4 = rates(c, x + h * u3, p + h * v3, u4, v4, s + h * s3, d + h * d3, end[0], end[1])
    w = h / 6.0
    return (
        x + w * (u + 2.0 * (u2 + u3) + u4),
        p + w * (v + 2.0 * (v2 + v3) + v4),
        u + w * (a1 + 2.0 * (a2 + a3) + a4),
        v + w * (b1 + 2.0 * (b2 + b3) + b4),
        s + w * (s1 + 2.0 * (s2 + s3) + s4),
        d + w * (d1 + 2.0 * (d2 + d3) + d4),
    )


@_compiled
def run(
    c: Coefficients,
    pump: PumpCoefficients,
    start: FloatArray,
    static_N: FloatArray,
    tick_s: float,
    substeps: int,
    every: int,
    out: FloatArray,
) -> int:
    """Simulate the ticks of `static_N` (n, 2), the static forces in effect [N]; returns a step number.

    Writes the state after every `every`-th step into `out` (n * substeps // every, 10). The result is
    the number of the step in which the state left the model (a length that is not positive, an
    angle beyond `LARGEST_ANGLE_RAD`, or no number at all), or -1.
    """
    h = tick_s / substeps
    decay = math.exp(-0.5 * h / pump.lag_s)
    r = c.r
    y = (
        0.5 * (start[0] + start[1]),
        0.5 * (start[0] - start[1]) / r,
        0.5 * (start[2] + start[3]),
        0.5 * (start[2] - start[3]) / r,
        start[4] + start[5],
        start[4] - start[5],
    )
    x1, x2, f1, f2 = start[6], start[7], start[8], start[9]
    row, due, count = 0, every, 0
    for tick in range(len(static_N)):
        g1, g2 = static_N[tick, 0], static_N[tick, 1]
        for _ in range(substeps):
            x1, middle1, end1 = advance(pump, x1, f1, g1, decay, h)
            x2, middle2, end2 = advance(pump, x2, f2, g2, decay, h)
            y = _step(c, y, h, (f1, f2), (middle1, middle2), (end1, end2))
            f1, f2 = end1, end2
            # Written so that NaN fails as well.
            if not (abs(y[1]) < LARGEST_ANGLE_RAD and y[0] > r * abs(y[1])):
                return count
            count += 1
            due -= 1
            if due == 0:
                due = every
                turned, spun = r * y[1], r * y[3]
                out[row, 0], out[row, 1] = y[0] + turned, y[0] - turned
                out[row, 2], out[row, 3] = y[2] + spun, y[2] - spun
                out[row, 4], out[row, 5] = 0.5 * (y[4] + y[5]), 0.5 * (y[4] - y[5])
                out[row, 6], out[row, 7], out[row, 8], out[row, 9] = x1, x2, f1, f2
                row += 1
    return -1


@_compiled
def derivative(c: Coefficients, y: FloatArray, F1: float, F2: float) -> FloatArray:
    """Rate (6,) of the mechanical state (q1, q2, dq1, dq2, z1, z2) under the forces F1, F2 [N]."""
    r = c.r
    a, b, s, d = rates(
        c,
        0.5 * (y[0] + y[1]),
        0.5 * (y[0] - y[1]) / r,
        0.5 * (y[2] + y[3]),
        0.5 * (y[2] - y[3]) / r,
        y[4] + y[5],
        y[4] - y[5],
        F1,
        F2,
    )
    out = np.empty(6)
    out[0], out[1] = y[2], y[3]
    out[2], out[3] = a + r * b, a - r * b
    out[4], out[5] = 0.5 * (s + d), 0.5 * (s - d)
    return out


@_compiled
def run_lanes(
    kind: int,
    table: FloatArray,
    lanes: FloatArray,
    static_N: FloatArray,
    step_s: float,
    substeps: int,
    out: FloatArray,
) -> None:
    """As `run` for `LANES` sets with virtual work, without gravity, and pumps of one kind.

    Lane i of row k of a flat array is at k LANES + i: offsets that are known when compiling are what
    lets the loop over the lanes become vector instructions.

    Parameters
    ----------
    table : (LANE_COEFFICIENTS * LANES,) the first 13 of `Coefficients`, the pumps' decay in half a step
        and the last 4 of `PumpCoefficients`.
    lanes : (12 * LANES,) l, phi, dl, dphi, z1 + z2, z1 - z2, lags, forces, then 1 for a lane that is in
        the model and its number of good steps; written to.
    static_N : (n, 2 * LANES) static forces in effect, those of bellows 1 first.
    out : (n, 10 * LANES) the first ten rows of `lanes` after each tick.
    """
    for tick in range(len(static_N)):
        for _ in range(substeps):
            for i in range(LANES):
                c = Coefficients(
                    table[i],
                    table[LANES + i],
                    table[2 * LANES + i],
                    table[3 * LANES + i],
                    table[4 * LANES + i],
                    table[5 * LANES + i],
                    table[6 * LANES + i],
                    table[7 * LANES + i],
                    table[8 * LANES + i],
                    table[9 * LANES + i],
                    table[10 * LANES + i],
                    table[11 * LANES + i],
                    table[12 * LANES + i],
                    0.0,
                    0.0,
                    0,
                    0,
                )
                decay = table[13 * LANES + i]
                pump = PumpCoefficients(
                    kind,
                    table[14 * LANES + i],
                    table[15 * LANES + i],
                    table[16 * LANES + i],
                    table[17 * LANES + i],
                )
                g1, g2 = static_N[tick, i], static_N[tick, LANES + i]
                f1, f2 = lanes[8 * LANES + i], lanes[9 * LANES + i]
                x1, middle1, end1 = advance(pump, lanes[6 * LANES + i], f1, g1, decay, step_s)
                x2, middle2, end2 = advance(pump, lanes[7 * LANES + i], f2, g2, decay, step_s)
                y = (
                    lanes[i],
                    lanes[LANES + i],
                    lanes[2 * LANES + i],
                    lanes[3 * LANES + i],
                    lanes[4 * LANES + i],
                    lanes[5 * LANES + i],
                )
                y = _step(c, y, step_s, (f1, f2), (middle1, middle2), (end1, end2))
                lanes[i], lanes[LANES + i] = y[0], y[1]
                lanes[2 * LANES + i], lanes[3 * LANES + i] = y[2], y[3]
                lanes[4 * LANES + i], lanes[5 * LANES + i] = y[4], y[5]
                lanes[6 * LANES + i], lanes[7 * LANES + i] = x1, x2
                lanes[8 * LANES + i], lanes[9 * LANES + i] = end1, end2
                inside = abs(y[1]) < LARGEST_ANGLE_RAD and y[0] > c.r * abs(y[1])
                kept = lanes[10 * LANES + i] if inside else 0.0
                lanes[10 * LANES + i] = kept
                lanes[11 * LANES + i] += kept
        for k in range(10 * LANES):
            out[tick, k] = lanes[k]
