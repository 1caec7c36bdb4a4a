"""The memory of the bank: states and covariances of its levels, carried on and mixed.

A level is a record of `RECORD` numbers in one flat array: twenty rows of `WIDTH`, of which the first 19 are
the covariance and the last is the state, then six rows of scratch for the readings of an event. Of the
sensors' rows the first six columns, which mirror the head's rows, are brought up to date where they are
needed. Slot s holds the levels of one moment, its level m at `(s M + m) RECORD`.

A row is five vector registers long and all rows stand at fixed distances, so that the compiler sees without
a check that none overlaps another.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.compiled import compiled
from calib.estimator.model import LARGEST_STEP_S, axis_noise, axis_transition
from calib.estimator.sensors import SIZE

__all__ = [
    "CORE",
    "DIAGONAL",
    "POSITIVE",
    "RECORD",
    "STATE",
    "WIDTH",
    "copy_level",
    "get",
    "mirror",
    "mix",
    "new_bank",
    "predict",
    "put",
    "settle_weights",
]

WIDTH = 20
R1, R2, R3, R4, R5, R6, R7, R8, R9, R10, R11, R12, R13, R14, R15, R16, R17, R18 = range(20, 380, 20)
"""Where the rows after the first begin; every product that is written out costs time when compiling."""
DIAGONAL = WIDTH + 1
CORE = WIDTH * (SIZE + 1)
"""Covariance and state: what a level is between events."""
RECORD = WIDTH * (SIZE + 7)
STATE = WIDTH * SIZE
"""Where in a record the state begins."""

POSITIVE = 0x7FFFFFFF
"""Places are cut to this: an index that cannot be negative is not tested for counting from the end."""

_NEGLIGIBLE = 1e-6
"""A share of a mixture that is left out."""


def new_bank(slots: int, count: int) -> FloatArray:
    """Zeroed memory for that many moments of a bank of `count` levels."""
    return np.zeros(slots * count * RECORD)


def put(bank: FloatArray, slot: int, x: FloatArray, P: FloatArray) -> None:
    """Write states (M, 19) and covariances (M, 19, 19) of a bank's levels."""
    count = len(x)
    rows = bank.reshape(-1, RECORD)[slot * count : (slot + 1) * count, :CORE].reshape(count, SIZE + 1, WIDTH)
    rows[:, :SIZE, :SIZE], rows[:, SIZE, :SIZE] = P, x


def get(bank: FloatArray, slot: int, count: int) -> tuple[FloatArray, FloatArray]:
    """States (M, 19) and covariances (M, 19, 19) of a bank's levels, copied."""
    rows = bank.reshape(-1, RECORD)[slot * count : (slot + 1) * count, :CORE].reshape(count, SIZE + 1, WIDTH)
    P = rows[:, :SIZE, :SIZE].copy()
    P[:, 6:, :6] = np.swapaxes(P[:, :6, 6:], 1, 2)
    return rows[:, SIZE, :SIZE].copy(), P


@compiled()
def copy_level(bank: FloatArray, since: int, to: int) -> None:
    """Copy a level from one place to another."""
    since, to = since & POSITIVE, to & POSITIVE
    for k in range(CORE):
        bank[to + k] = bank[since + k]


@compiled(inlined=True)
def _step(bank: FloatArray, at: int, level: FloatArray, k: int, m: int, walk: FloatArray, h: float) -> None:
    o = at & POSITIVE
    a01, a02, a11, a12, a22 = axis_transition(level[k, m, 0], level[k, m, 1], h)
    b01, b02, b11, b12, b22 = axis_transition(level[k, m, 4], level[k, m, 5], h)
    p, v, a = bank[o + STATE], bank[o + STATE + 2], bank[o + STATE + 4]
    bank[o + STATE] = p + (a01 * v + a02 * a)
    bank[o + STATE + 2], bank[o + STATE + 4] = a11 * v + a12 * a, a22 * a
    p, v, a = bank[o + STATE + 1], bank[o + STATE + 3], bank[o + STATE + 5]
    bank[o + STATE + 1] = p + (b01 * v + b02 * a)
    bank[o + STATE + 3], bank[o + STATE + 5] = b11 * v + b12 * a, b22 * a
    for j in range(WIDTH):
        v, a = bank[o + R2 + j], bank[o + R4 + j]
        bank[o + j] += a01 * v + a02 * a
        bank[o + R2 + j] = a11 * v + a12 * a
        bank[o + R4 + j] = a22 * a
        v, a = bank[o + R3 + j], bank[o + R5 + j]
        bank[o + R1 + j] += b01 * v + b02 * a
        bank[o + R3 + j] = b11 * v + b12 * a
        bank[o + R5 + j] = b22 * a
    for i in range(6):
        r = o + WIDTH * i
        v, a = bank[r + 2], bank[r + 4]
        bank[r] += a01 * v + a02 * a
        bank[r + 2] = a11 * v + a12 * a
        bank[r + 4] = a22 * a
        v, a = bank[r + 3], bank[r + 5]
        bank[r + 1] += b01 * v + b02 * a
        bank[r + 3] = b11 * v + b12 * a
        bank[r + 5] = b22 * a
    for axis in range(2):
        pp, pv, pa, vv, va, aa = axis_noise(level[k, m, 4 * axis + 2], level[k, m, 4 * axis + 3], h)
        r = o + axis * DIAGONAL
        bank[r] += pp
        bank[r + R2] += pv
        bank[r + R4] += pa
        bank[r + R2 + 2] += vv
        bank[r + R4 + 2] += va
        bank[r + R4 + 4] += aa
    for i in range(5):
        for j in range(i + 1, 6):
            bank[o + WIDTH * i + j] = bank[o + WIDTH * j + i]
    for i in range(6, SIZE):
        bank[o + DIAGONAL * i] += walk[i - 6] * h


@compiled()
def mirror(bank: FloatArray, at: int, i: int) -> None:
    """Bring the first six columns of a sensor's row up to date."""
    o = at & POSITIVE
    for j in range(6):
        bank[o + WIDTH * i + j] = bank[o + WIDTH * j + i]


@compiled(inlined=True)
def predict(
    bank: FloatArray, at: int, levels: FloatArray, k: int, m: int, walk: FloatArray, dt: float
) -> None:
    """Carry the level at a place on by dt >= 0 [s].

    Parameters
    ----------
    levels : (n, M, 8) rows of `Kinematic.arrays`, of which [k, m] counts.
    walk : (13,) squared densities of the sensors' walk.
    """
    if not dt > 0.0:
        return
    parts = max(math.ceil(dt / LARGEST_STEP_S - 1e-9), 1)
    for _ in range(parts):
        _step(bank, at, levels, k, m, walk, dt / parts)


@compiled()
def _spread(bank: FloatArray, to: int, since: int, part: float) -> None:
    """Add part (x - x') (x - x')' to the covariance at `to`, x the state there, x' that at `since`."""
    o, other = to & POSITIVE, since & POSITIVE
    root = math.sqrt(part)
    for j in range(WIDTH):
        bank[o + CORE + j] = root * (bank[other + STATE + j] - bank[o + STATE + j])
    for i in range(6):
        r = o + R3 * i
        g0, g1, g2 = bank[o + CORE + 3 * i], bank[o + CORE + 3 * i + 1], bank[o + CORE + 3 * i + 2]
        for j in range(WIDTH):
            d = bank[o + CORE + j]
            bank[r + j] += g0 * d
            bank[r + R1 + j] += g1 * d
            bank[r + R2 + j] += g2 * d
    g0 = bank[o + CORE + 18]
    for j in range(WIDTH):
        bank[o + R18 + j] += g0 * bank[o + CORE + j]


@compiled()
def mix(bank: FloatArray, weights: FloatArray, old: int, new: int, turn: float) -> None:
    """Let the levels start from their mixtures.

    Parameters
    ----------
    weights : (slots, M + 1) of the levels in each slot; `old` is read, `new` written.
    turn : probability of turning into each one of the others.
    """
    count = weights.shape[1] - 1
    stay = 1.0 - (count - 1) * turn
    for j in range(count):
        total = 0.0
        for i in range(count):
            total += weights[old, i] * (stay if i == j else turn)
        weights[new, j] = total
        alone = -1
        for i in range(count):
            if weights[old, i] * (stay if i == j else turn) > (1.0 - _NEGLIGIBLE) * total:
                alone = i
        to = (new * count + j) * RECORD
        if alone >= 0:
            copy_level(bank, (old * count + alone) * RECORD, to)
            continue
        to &= POSITIVE
        for k in range(CORE):
            bank[to + k] = 0.0
        left = 1.0
        for i in range(count):
            part = weights[old, i] * (stay if i == j else turn) / total
            left -= part if part < _NEGLIGIBLE else 0.0
        for i in range(count):
            part = weights[old, i] * (stay if i == j else turn) / total
            if part < _NEGLIGIBLE:
                continue
            part /= left
            since = ((old * count + i) * RECORD) & POSITIVE
            for k in range(CORE):
                bank[to + k] += part * bank[since + k]
        for i in range(count):
            part = weights[old, i] * (stay if i == j else turn) / total
            if part >= _NEGLIGIBLE:
                _spread(bank, to, (old * count + i) * RECORD, part / left)


@compiled()
def settle_weights(weights: FloatArray, slot: int, log_likelihood: FloatArray, place: int) -> float:
    """Weights of a slot after an event, in place; returns the log likelihood of the event.

    No weight falls below 1e-6, so that a level can come back.

    Parameters
    ----------
    weights : (slots, M + 1). log_likelihood : (M, n), of which the column `place` counts.
    """
    count = weights.shape[1] - 1
    best = -math.inf
    for j in range(count):
        best = max(best, log_likelihood[j, place])
    total = 0.0
    for j in range(count):
        weights[slot, j] *= math.exp(log_likelihood[j, place] - best)
        total += weights[slot, j]
    if not total > 0.0:
        for j in range(count):
            weights[slot, j] = 1.0 / count
        return best
    floored = 0.0
    for j in range(count):
        weights[slot, j] = max(weights[slot, j] / total, 1e-6)
        floored += weights[slot, j]
    for j in range(count):
        weights[slot, j] /= floored
    return best + math.log(total)


assert SIZE == 19 and R18 == 18 * WIDTH
