"""What sixteen-bit integers would do to a low-pass: its dead band and its cut-off.

A section in the direct form I with Q15 samples and coefficients of q fractional bits (15 for a single
pole, 14 for a pair because |a1| reaches 2) computes

    y_k = floor( (B0 x_k + B1 x_(k-1) + B2 x_(k-2) - A1 y_(k-1) - A2 y_(k-2)) / 2^q + 1/2 ).

Every value y with |S (x - y)| < 1/2, S = 1 + a1 + a2, is a fixed point for the constant input x: the output
sticks up to 1 / (2 S) steps away from it (Jackson 1970). The lower the cut-off against the rate, the
smaller S and the wider this dead band; S itself is known to 2^-q only, which moves the cut-off.
The same is measured in binary32 by letting the filter come to rest in that arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import FloatArray
from calib.signals.design import Filter, digital_poles
from calib.signals.response import cutoff_hz, settled_state

__all__ = ["FixedPoint", "dead_band_binary32", "fixed_point"]

IntMatrix = npt.NDArray[np.int64]

_STARTS = 16
_LONGEST = 20_000


@dataclass(frozen=True)
class FixedPoint:
    """A filter in sixteen-bit integers.

    Attributes
    ----------
    usable : whether the rounded filter is stable and passes anything at all.
    cutoff_hz : its cut-off, NaN where it is not usable.
    dead_band : bound on how far from a constant input the output may stick, in steps of the samples.
    stuck : how far it did stick when it was run, in steps.
    """

    usable: bool
    cutoff_hz: float
    dead_band: float
    stuck: float


def _integers(section: FloatArray) -> tuple[list[int], int]:
    """B0, B1, B2, A1, A2 with B0 + B1 + B2 = 2^q + A1 + A2, and q."""
    pair = section[5] != 0.0
    q = 14 if pair else 15
    A1, A2 = (round(math.ldexp(float(a), q)) for a in section[4:])
    total = (1 << q) + A1 + A2
    side = round(total / 4) if pair else total // 2
    return [side, total - 2 * side if pair else total - side, side if pair else 0, A1, A2], q


def _come_to_rest(sections: list[tuple[list[int], int]], x: int, starts: IntMatrix, steps: int) -> IntMatrix:
    """Distance (n,) from x at which the cascade ends, or the widest of a cycle, from each start (n,)."""
    delay = [[starts.copy() for _ in range(4)] for _ in sections]
    last = np.zeros((32, len(starts)), dtype=np.int64)
    for k in range(steps):
        value = np.full(len(starts), x, dtype=np.int64)
        for ((B0, B1, B2, A1, A2), q), d in zip(sections, delay, strict=True):
            total = B0 * value + B1 * d[0] + B2 * d[1] - A1 * d[2] - A2 * d[3]
            out = np.clip((total + (1 << (q - 1))) >> q, -(1 << 15), (1 << 15) - 1)
            d[1], d[0], d[3], d[2] = d[0], value, d[2], out
            value = out
        last[k % len(last)] = value
        if k % len(last) == len(last) - 1 and np.all(last == last[0]):
            break
    return np.asarray(np.abs(last - x).max(axis=0))


def fixed_point(filter_: Filter) -> FixedPoint:
    """The filter in Q15: whether it can be, its cut-off, and its dead band."""
    integers = [_integers(section) for section in filter_.exact]
    values = np.array(
        [[*(math.ldexp(b, -q) for b in c[:3]), 1.0, *(math.ldexp(a, -q) for a in c[3:])] for c, q in integers]
    )
    S = 1.0 + values[:, 4] + values[:, 5]
    usable = bool(np.all(S > 0.0)) and float(np.abs(digital_poles(values)).max()) < 1.0
    if not usable:
        return FixedPoint(False, math.nan, math.inf, math.nan)
    bound = float(np.sum(0.5 / S))
    reach = min(4.0 * bound, 12_000.0)
    starts = np.round(np.linspace(-reach, reach, _STARTS)).astype(np.int64)
    stuck = _come_to_rest(integers, 11_003, 11_003 + starts, _steps(filter_))
    return FixedPoint(True, cutoff_hz(values, filter_.design.rate_hz), bound, float(stuck.max()))


def _steps(filter_: Filter) -> int:
    slowest = float(np.abs(digital_poles(filter_.exact)).max())
    return int(min(25.0 / max(1.0 - slowest, 1e-6) + 200, _LONGEST))


def dead_band_binary32(filter_: Filter) -> float:
    """Largest distance from 1 at which the filter comes to rest in binary32, from starts around 1.

    Relative: at a position of 0.1 m the distance is a tenth of it in metres.
    """
    sections = filter_.sections.astype(np.float32)
    starts = np.linspace(0.0, 2.0, _STARTS)
    s1, s2 = np.moveaxis(settled_state(filter_.sections, starts).astype(np.float32), 1, 0)
    y = np.zeros(_STARTS, dtype=np.float32)
    for _ in range(_steps(filter_)):
        value = np.ones(_STARTS, dtype=np.float32)
        for i, (b0, b1, b2, _, a1, a2) in enumerate(sections):
            y = b0 * value + s1[i]
            s1[i] = b1 * value - a1 * y + s2[i]
            s2[i] = b2 * value - a2 * y
            value = y
    return float(np.abs(y.astype(np.float64) - 1.0).max())
