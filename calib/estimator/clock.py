"""Time stamps made even: a causal clock for each sensor that samples at a steady rate.

A sensor's k-th sample was taken at o + k T; its stamp has jitter, waits in buffers and is sometimes that of
the sample before. A Kalman filter on (time of this sample, period) with a period that wanders a little is
a line fitted with forgetting: its gains fall as in a fit of a line and end at about one in a hundred.

A stamp that comes a number of periods late says that samples are missing, and they are counted. One
that is off by less, or early, is not believed; the sample gets the time that was due. When ten in
a row are not believed the clock starts again from the stamp, as it does where time jumps.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from calib.arrays import FloatArray
from calib.estimator.compiled import compiled

__all__ = ["CLOCK_SIZE", "advance", "even_times", "new_clock", "restart"]

CLOCK_SIZE = 10
"""Entries: running, time, period, P_tt, P_tT, P_TT, jitter variance, unbelieved in a row, nominal, count."""

_WANDER = 2e-6
_JITTER_S = 5e-4
_GATE = 5.0
_MOST_MISTRUST = 10


def new_clock(period_s: float) -> FloatArray:
    """A clock for a sensor that samples about every `period_s` [s]; NaN: stamps are taken as they are."""
    clock = np.zeros(CLOCK_SIZE)
    clock[8] = period_s
    clock[6] = _JITTER_S**2
    return clock


@compiled()
def restart(clock: FloatArray) -> None:
    """Forget the time, but neither the nominal period nor the jitter."""
    clock[0] = 0.0
    clock[7] = 0.0


@compiled()
def advance(clock: FloatArray, stamp: float) -> float:
    """Time of the sample that came with this stamp [s]."""
    nominal = clock[8]
    if not nominal > 0.0:
        return float(stamp)
    if clock[0] == 0.0:
        clock[0], clock[1], clock[7] = 1.0, stamp, 0.0
        if clock[9] == 0.0:
            clock[2] = nominal
        clock[3], clock[4], clock[5] = clock[6], 0.0, (1e-3 * nominal) ** 2
        clock[9] += 1.0
        return float(stamp)
    T = clock[2]
    time = clock[1] + T
    steps = 1.0
    error = stamp - time
    if error > 0.5 * T:
        missed = math.floor(error / T + 0.5)
        # A period is not known well enough to count over a long gap.
        if missed * math.sqrt(clock[5]) > 0.1 * T:
            clock[0] = 0.0
            return float(advance_again(clock, stamp))
        # Only where the stamp then fits: a sample that waited half a period is late, none is missing.
        if abs(error - missed * T) < _GATE * math.sqrt(clock[3] + clock[6]) + 0.01 * T:
            steps += missed
            time += missed * T
            error -= missed * T
    wander = (_WANDER * nominal) ** 2 * steps
    tt = clock[3] + 2.0 * steps * clock[4] + steps * steps * clock[5]
    tT = clock[4] + steps * clock[5]
    TT = clock[5] + wander
    limit = _GATE * math.sqrt(tt + clock[6])
    clock[1], clock[3], clock[4], clock[5] = time, tt, tT, TT
    clock[9] += 1.0
    if abs(error) > min(limit, 0.45 * nominal):
        clock[7] += 1.0
        if clock[7] >= _MOST_MISTRUST:
            clock[0] = 0.0
            return float(advance_again(clock, stamp))
        return float(time)
    clock[7] = 0.0
    S = tt + clock[6]
    clock[1] += tt / S * error
    clock[2] += tT / S * error
    clock[5] = TT - tT * tT / S
    clock[4] = tT - tT * tt / S
    clock[3] = tt - tt * tt / S
    clock[6] += 0.01 * (max(error * error, 1e-10) - clock[6])
    return float(clock[1])


@compiled()
def advance_again(clock: FloatArray, stamp: float) -> float:
    """Start from this stamp with the period as it was."""
    clock[0], clock[1], clock[7] = 1.0, stamp, 0.0
    clock[3], clock[4], clock[5] = clock[6], 0.0, (1e-3 * clock[8]) ** 2
    return stamp


@njit(cache=True, nogil=True, error_model="numpy")
def even_times(clock: FloatArray, stamps: FloatArray) -> FloatArray:
    """Times (n,) of samples with these stamps (n,) [s], each from the stamps up to its own."""
    out = np.empty(len(stamps))
    for i in range(len(stamps)):
        out[i] = advance(clock, stamps[i])
    return out
