"""The kinematic filter: a bank of noise levels over camera and IMU, event by event."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from calib.core.arrays import FloatArray, IntArray
from calib.stages.estimator.sensors import (
    SIZE,
    accelerometer_terms,
    compiled,
    head_position,
    invert_marker,
    marker_terms,
    update_terms,
)

# ----------------------------------------------------------------------
# The kinematic process: how the head moves when nothing is known of what drives it.
#
# Angle and length each follow
#
#     dp = v dt + dw_p,   dv = (a - v / T_v) dt,   da = -a / T_a dt + dw_a
#
# with white noise w_p, w_a: an acceleration that forgets after T_a and a rate that dies after T_v
# (Singer 1970 with friction). One level of noise cannot serve rest and swing, so a bank of levels runs side
# by side as an interacting multiple model (Blom and Bar-Shalom 1988): before each event a level i starts
# from the mixture of all levels j with the weights of j having turned into i. The sensors' quantities
# are constant but for a slow random walk.
#
# A step of more than `LARGEST_STEP_S` is taken in parts, so that the series for the transition,
# I + A h + A^2 h^2 / 2 + A^3 h^3 / 6, and that for its noise hold.

LARGEST_STEP_S = 0.02


@dataclass(frozen=True)
class Level:
    """Process noise of one level, for phi [rad] and for the length [m].

    Attributes
    ----------
    name : for what it is made.
    accel_phi_radps2, accel_length_mps2 : standard deviation of the acceleration.
    memory_s : T_a of both. friction_s : T_v of the length; that of phi is infinite.
    walk_phi_rad_per_sqrt_s, walk_length_m_per_sqrt_s : density of w_p.
    """

    name: str
    accel_phi_radps2: float
    accel_length_mps2: float
    memory_s: float
    friction_s: float
    walk_phi_rad_per_sqrt_s: float
    walk_length_m_per_sqrt_s: float

    def numbers(self) -> list[float]:
        """(1/T_a, 1/T_v, density of w_a, of w_p) of phi and then of the length."""
        b, c = 1.0 / self.friction_s, 1.0 / self.memory_s
        return [
            c, 0.0, 2.0 * self.accel_phi_radps2**2 * c, self.walk_phi_rad_per_sqrt_s**2,
            c, b, 2.0 * self.accel_length_mps2**2 * c, self.walk_length_m_per_sqrt_s**2,
        ]  # fmt: skip


LEVELS = (
    Level("rest", 1.0, 3e-4, 0.04, 0.08, 5e-6, 1.5e-5),
    Level("drift", 1.0, 8e-3, 0.04, 7.5, 5e-6, 3e-6),
    Level("move", 20.0, 0.05, 0.02, 1.0, 1.3e-4, 2.6e-5),
    Level("swing", 120.0, 0.8, 0.05, 50.0, 7e-4, 6e-5),
)
"""From rest over the slow and quick motion of the pumps to a free swing.

Found by a random search for the least errors on simulated rigs whose parameters vary. Rest and drift have
the same angle, so that the gyroscope has no say in which of them it is: ten times as fast as the camera,
it would outvote the pictures, which alone see a slow change of length.
"""


@dataclass(frozen=True)
class Kinematic:
    """Parameters of the process.

    Attributes
    ----------
    levels : the bank.
    switch_hz : rate at which one level turns into another.
    sensor_walk : (13,) densities of the walk of `sensors.SENSOR`, unit per sqrt(s).
    """

    levels: tuple[Level, ...] = LEVELS
    switch_hz: float = 0.1
    sensor_walk: tuple[float, ...] = (
        2e-5,
        3e-3,
        1e-3,
        1e-6,
        1e-6,
        1e-7,
        1e-7,
        1e-7,
        1e-8,
        1e-8,
        1e-6,
        1e-6,
        1e-6,
    )
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(level.name for level in self.levels))

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Levels (M, 8) and squared walks (13,) for the compiled functions."""
        return np.array([level.numbers() for level in self.levels]), np.array(self.sensor_walk) ** 2


@compiled(inlined=True)
def axis_transition(c: float, b: float, h: float) -> tuple[float, float, float, float, float]:
    """Entries f01, f02, f11, f12, f22 of the transition of (p, v, a) over h [s]; c = 1/T_a, b = 1/T_v."""
    h2, h3 = 0.5 * h * h, h * h * h / 6.0
    return (
        h - b * h2 + b * b * h3,
        h2 - (b + c) * h3,
        1.0 - b * h + b * b * h2 - b * b * b * h3,
        h - (b + c) * h2 + (b * b + b * c + c * c) * h3,
        1.0 - c * h + c * c * h2 - c * c * c * h3,
    )


@compiled(inlined=True)
def axis_noise(q: float, walk: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Entries pp, pv, pa, vv, va, aa of the noise over h [s] for the densities q of w_a, walk of w_p."""
    h2 = h * h
    h3 = h2 * h
    return (
        walk * h + q * h2 * h3 / 20.0,
        q * h2 * h2 / 8.0,
        q * h3 / 6.0,
        q * h3 / 3.0,
        q * h2 / 2.0,
        q * h,
    )


# ----------------------------------------------------------------------
# The memory of the bank: states and covariances of its levels, carried on and mixed.
#
# A level is a record of `RECORD` numbers in one flat array: twenty rows of `WIDTH`, of which the first 19
# are
# the covariance and the last is the state, then six rows of scratch for the readings of an event. Of the
# sensors' rows the first six columns, which mirror the head's rows, are brought up to date where they are
# needed. Slot s holds the levels of one moment, its level m at `(s M + m) RECORD`.
#
# A row is five vector registers long and all rows stand at fixed distances, so that the compiler sees
# without
# a check that none overlaps another.

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


# ----------------------------------------------------------------------
# What a level expects of a picture or an IMU sample: P H', innovations and their variances.
#
# Of a gradient only what is not zero is told, from `H_U`, `H_V`, `H_X`, `H_Y` and `H_Z` on, in the order of
# `SEEN`, `FELT_X`, `FELT_Y` and `TURNED`. What is not linear in a state that is not known well stays out
# of it,
# see `kernel`.

TOLD = 40
"""Scratch of each level: innovations 0 to 2, variances of their noise 3 to 5, of the prediction 6 to 8, its
covariances 9 (first and second), 10 and 11 (third with both), of a picture the parts of 9 by what is learnt
and by what is considered; chi-squares 12 and 13, e 14 to 16, log likelihood 17, gradients from 18 on."""

P0, P1, P2 = CORE, CORE + WIDTH, CORE + 2 * WIDTH
"""Rows of a record with P H' of the readings (u, v) or (a_x, a_y, g_z)."""

SEEN, TURNED = np.array([0, 1, 2, 3, 4, 5, 12, 13, 14, 15, 16]), np.array([2, 6, 10])
FELT_X, FELT_Y = np.array([0, 2, 3, 4, 5, 9, 7, 17]), np.array([0, 2, 3, 4, 5, 9, 8, 18])
"""What is not zero in the gradients of pixels, accelerations and rotation rate."""

H_U, H_V, H_X, H_Y, H_Z = 18, 29, 18, 26, 34
"""Calls pass them as int(): a literal would be a type, and its function compiled for each of them."""

TELLING = 9.0
"""A rate or acceleration below three deviations (squared) tells nothing of what it multiplies."""


@compiled(inlined=True)
def expect_camera(
    bank: FloatArray, at: int, z: FloatArray, row: int, view: FloatArray, noise: FloatArray, told: FloatArray,
    m: int,
) -> None:  # fmt: skip
    """Gradients, P H', innovations and their variances of a picture's two readings."""
    o = at & POSITIVE
    x = o + STATE
    for i in range(12, 17):
        mirror(bank, at, i)
    late, dphi, dl = bank[x + 13], bank[x + 2], bank[x + 3]
    u, v, u0, v0, u1, v1, u12, v12, u13, v13, u14, v14, u15, v15, u16, v16 = marker_terms(
        view, bank[x], bank[x + 1], dphi, dl, bank[x + 4], bank[x + 5], bank[x + 12], late, bank[x + 14],
        bank[x + 15], bank[x + 16],
    )  # fmt: skip
    half = 0.5 * late * late
    u2, v2, u3, v3 = -late * u0, -late * v0, -late * u1, -late * v1
    u4, v4, u5, v5 = half * u0, half * v0, half * u1, half * v1
    var_phi, var_l = bank[o + R2 + 2], bank[o + R3 + 3]
    speed_u, speed_v = u0 * dphi + u1 * dl, v0 * dphi + v1 * dl
    if speed_u * speed_u < TELLING * (u0 * u0 * var_phi + u1 * u1 * var_l):
        u13 = 0.0
    if speed_v * speed_v < TELLING * (v0 * v0 * var_phi + v1 * v1 * var_l):
        v13 = 0.0
    stamp = noise[6] * noise[6]
    told[m, 0], told[m, 1] = z[row, 0] - u, z[row, 1] - v
    told[m, 3], told[m, 4] = speed_u * speed_u * stamp, speed_v * speed_v * stamp
    told[m, 18], told[m, 19], told[m, 20], told[m, 21], told[m, 22], told[m, 23] = u0, u1, u2, u3, u4, u5
    told[m, 24], told[m, 25], told[m, 26], told[m, 27], told[m, 28] = u12, u13, u14, u15, u16
    told[m, 29], told[m, 30], told[m, 31], told[m, 32], told[m, 33], told[m, 34] = v0, v1, v2, v3, v4, v5
    told[m, 35], told[m, 36], told[m, 37], told[m, 38], told[m, 39] = v12, v13, v14, v15, v16
    for j in range(WIDTH):
        r0, r1, r2 = bank[o + j], bank[o + R1 + j], bank[o + R2 + j]
        r3, r4, r5 = bank[o + R3 + j], bank[o + R4 + j], bank[o + R5 + j]
        r12, r13, r14 = bank[o + R12 + j], bank[o + R13 + j], bank[o + R14 + j]
        r15, r16 = bank[o + R15 + j], bank[o + R16 + j]
        bank[o + P0 + j] = (
            (u0 * r0 + u1 * r1 + u2 * r2 + u3 * r3) + (u4 * r4 + u5 * r5 + u12 * r12 + u13 * r13)
            + (u14 * r14 + u15 * r15 + u16 * r16)
        )  # fmt: skip
        bank[o + P1 + j] = (
            (v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3) + (v4 * r4 + v5 * r5 + v12 * r12 + v13 * r13)
            + (v14 * r14 + v15 * r15 + v16 * r16)
        )  # fmt: skip
    at_u, at_v = int(H_U), int(H_V)
    told[m, 6] = seen_learnt(bank, o + P0, told, m, at_u) + seen_considered(bank, o + P0, told, m, at_u)
    told[m, 7] = seen_learnt(bank, o + P1, told, m, at_v) + seen_considered(bank, o + P1, told, m, at_v)
    told[m, 10] = seen_learnt(bank, o + P0, told, m, at_v)
    told[m, 11] = seen_considered(bank, o + P0, told, m, at_v)
    told[m, 9] = told[m, 10] + told[m, 11]


@compiled()
def seen_learnt(bank: FloatArray, p: int, told: FloatArray, m: int, H: int) -> float:
    """H p of a pixel's gradient, by what readings change."""
    p &= POSITIVE
    return float(
        (told[m, H] * bank[p] + told[m, H + 1] * bank[p + 1] + told[m, H + 2] * bank[p + 2])
        + (told[m, H + 3] * bank[p + 3] + told[m, H + 4] * bank[p + 4] + told[m, H + 5] * bank[p + 5])
        + told[m, H + 7] * bank[p + 13]
    )  # fmt: skip


@compiled()
def seen_considered(bank: FloatArray, p: int, told: FloatArray, m: int, H: int) -> float:
    """H p of a pixel's gradient, by what readings do not change."""
    p &= POSITIVE
    return float(
        (told[m, H + 6] * bank[p + 12] + told[m, H + 8] * bank[p + 14])
        + (told[m, H + 9] * bank[p + 15] + told[m, H + 10] * bank[p + 16])
    )  # fmt: skip


@compiled()
def felt(bank: FloatArray, p: int, told: FloatArray, m: int, H: int) -> float:
    """H p of an acceleration's gradient, that of a_x or a_y."""
    p &= POSITIVE
    own = 0 if H == H_X else 1
    return float(
        (told[m, H] * bank[p] + told[m, H + 1] * bank[p + 2] + told[m, H + 2] * bank[p + 3])
        + (told[m, H + 3] * bank[p + 4] + told[m, H + 4] * bank[p + 5] + told[m, H + 5] * bank[p + 9])
        + (bank[p + 7 + own] + told[m, H + 7] * bank[p + 17 + own])
    )  # fmt: skip


@compiled(inlined=True)
def expect_imu(
    bank: FloatArray, at: int, z: FloatArray, row: int, constants: FloatArray, noise: FloatArray,
    told: FloatArray, m: int,
) -> None:  # fmt: skip
    """Gradients, P H', innovations and their variances of a sample's three readings."""
    o = at & POSITIVE
    x = o + STATE
    for i in range(6, 11):
        mirror(bank, at, i)
    for i in range(17, 19):
        mirror(bank, at, i)
    dphi, scale = bank[x + 2], bank[x + 10]
    ax, ay, rest_x, rest_y, x0, y0, x1, y1, x2, y2, x3, y3, x4, y4, x5, y5, x11, y11 = accelerometer_terms(
        constants[0], constants[1], bank[x], bank[x + 1], dphi, bank[x + 3], bank[x + 4], bank[x + 5],
        bank[x + 9], bank[x + 11],
    )  # fmt: skip
    grow_x, grow_y = 1.0 + bank[x + 17], 1.0 + bank[x + 18]
    x0, x1, x2, x3, x4, x5, x11 = (
        grow_x * x0, grow_x * x1, grow_x * x2, grow_x * x3, grow_x * x4, grow_x * x5, grow_x * x11
    )  # fmt: skip
    y0, y1, y2, y3, y4, y5, y11 = (
        grow_y * y0, grow_y * y1, grow_y * y2, grow_y * y3, grow_y * y4, grow_y * y5, grow_y * y11
    )  # fmt: skip
    x9, y9 = -grow_x * ay, grow_y * ax
    moved_x, moved_y = grow_x * ax - rest_x, grow_y * ay - rest_y
    share = noise[5] * noise[5] * (moved_x * moved_x + moved_y * moved_y)
    var_l, var_lever = bank[o + R1 + 1], bank[o + R11 + 11]
    told[m, 0] = z[row, 0] - (grow_x * ax + bank[x + 7])
    told[m, 1] = z[row, 1] - (grow_y * ay + bank[x + 8])
    told[m, 2] = z[row, 2] - (bank[x + 6] - (1.0 + scale) * dphi)
    told[m, 3] = noise[2] * noise[2] + share + (x1 * x1 * var_l + x11 * x11 * var_lever)
    told[m, 4] = noise[3] * noise[3] + share + (y1 * y1 * var_l + y11 * y11 * var_lever)
    late = bank[x + 4] * noise[7]
    told[m, 5] = noise[4] * noise[4] + late * late
    g2, g10 = -(1.0 + scale), -dphi
    if dphi * dphi < TELLING * bank[o + R2 + 2]:
        g10 = 0.0
    told[m, 18], told[m, 19], told[m, 20], told[m, 21], told[m, 22], told[m, 23] = x0, x2, x3, x4, x5, x9
    told[m, 24], told[m, 25] = 1.0, ax
    told[m, 26], told[m, 27], told[m, 28], told[m, 29], told[m, 30], told[m, 31] = y0, y2, y3, y4, y5, y9
    told[m, 32], told[m, 33] = 1.0, ay
    told[m, 34], told[m, 35], told[m, 36] = g2, 1.0, g10
    for j in range(WIDTH):
        r0, r2, r3 = bank[o + j], bank[o + R2 + j], bank[o + R3 + j]
        r4, r5, r9 = bank[o + R4 + j], bank[o + R5 + j], bank[o + R9 + j]
        bank[o + P0 + j] = (
            (x0 * r0 + x2 * r2 + x3 * r3) + (x4 * r4 + x5 * r5 + x9 * r9)
            + (bank[o + R7 + j] + ax * bank[o + R17 + j])
        )  # fmt: skip
        bank[o + P1 + j] = (
            (y0 * r0 + y2 * r2 + y3 * r3) + (y4 * r4 + y5 * r5 + y9 * r9)
            + (bank[o + R8 + j] + ay * bank[o + R18 + j])
        )  # fmt: skip
        bank[o + P2 + j] = g2 * r2 + bank[o + R6 + j] + g10 * bank[o + R10 + j]
    told[m, 6] = felt(bank, o + P0, told, m, int(H_X))
    told[m, 9] = felt(bank, o + P0, told, m, int(H_Y))
    told[m, 7] = felt(bank, o + P1, told, m, int(H_Y))
    told[m, 10] = felt(bank, o + P2, told, m, int(H_X))
    told[m, 11] = felt(bank, o + P2, told, m, int(H_Y))
    told[m, 8] = g2 * bank[o + P2 + 2] + bank[o + P2 + 6] + g10 * bank[o + P2 + 10]


# ----------------------------------------------------------------------
# Time stamps made even: a causal clock for each sensor that samples at a steady rate.
#
# A sensor's k-th sample was taken at o + k T; its stamp has jitter, waits in buffers and is sometimes that
# of
# the sample before. A Kalman filter on (time of this sample, period) with a period that wanders a little is
# a line fitted with forgetting: its gains fall as in a fit of a line and end at about one in a hundred.
#
# A stamp that comes a number of periods late says that samples are missing, and they are counted. One
# that is off by less, or early, is not believed; the sample gets the time that was due. When ten in
# a row are not believed the clock starts again from the stamp, as it does where time jumps.

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


# ----------------------------------------------------------------------
# One event of the fused filter: a picture or an IMU sample, for all levels of the bank.
#
# Each scalar reading z = h(x) + noise updates a state x with covariance P in turn,
#
#     p = P H',  S = H p + R,  x += p y / S,  P -= p p' / S
#
# with y = z - h(x0) - H (x - x0), linearised at the state x0 before the event's first reading. For one
# scalar and this gain Joseph's form is the same thing: its remainder p - K S is zero term by term. P is
# kept symmetric to the last bit. Of H only what is not zero is kept; the readings of an event act on the P
# H'
# of those that follow by the Cholesky factor of their own covariance, and on P together at the end. A
# rounded
# pixel enters as its equivalent Gaussian reading (`rounding`).
#
# A reading is gated by the chi-square of its whole sensor in that level of the bank that expects it best;
# a gated one changes nothing. The noise of an accelerometer grows with the head's acceleration by a share,
# for errors of scale, those of gyroscope and marker by what an error of the time stamps makes of the
# motion.
#
# What calibration and alignment say of the geometry (`CONSIDERED`: lever, marker offset, shift and stretch
# of the plane) is considered and not learnt (Schmidt 1966): its uncertainty is in P and its correlations
# with the motion are, but a single log does not change it. Length and lever act on the accelerometer
# through ddphi, which is estimated from the same readings; errors in what multiplies them would pass for
# knowledge and pull the length by a millimetre at rest. So they go into the noise there. For the same
# reason
# the gyroscope's scale and the time offset are learnt only from rates above three of their own deviations.

CONSIDERED = (11, 12, 14, 15, 16)
"""Entries of the state that readings do not change."""

_LEARNT = np.array([0.0 if k in CONSIDERED else 1.0 for k in range(WIDTH)])

CAMERA, IMU = 1, 2
"""Kinds of events; a picture has the readings (u, v), a sample (a_x, a_y, g_z), NaN where missing."""

MIXED_S = 0.015
"""The levels are mixed at each picture, without pictures after so long: their turns take seconds."""

NOISE = (
    "jitter_px",
    "grid_px",
    "accel_x_mps2",
    "accel_y_mps2",
    "gyro_radps",
    "accel_share",
    "camera_stamp_s",
    "imu_stamp_s",
    "camera_gate",
    "accel_gate",
    "gyro_gate",
)
"""Standard deviations of the readings and chi-square limits of the sensors, in the order of `noise`."""

REPORT = (
    "nis_camera",
    "nis_accel",
    "nis_gyro",
    "e_u",
    "e_v",
    "e_ax",
    "e_ay",
    "e_gz",
    "gated_camera",
    "gated_accel",
    "gated_gyro",
    "log_likelihood",
)
"""What an event says of itself; e are innovations over their standard deviation. NaN: not sampled."""

TRACE = 40
"""What a reading leaves for the smoother: H (19), P H' / S (19), y / S, 1 / S; the last is 0 without one."""

_Q0, _Q1, _Q2 = CORE + 3 * WIDTH, CORE + 4 * WIDTH, CORE + 5 * WIDTH
"""Rows of a record: P H' / sqrt(S) of each reading, and the same with zeros for what is only considered."""

_FIRST, _SECOND, _THIRD = range(3)
_TURN = 2.0 * math.pi
_MARGIN_PX2 = 0.25
"""Added to the variance for gating: half a pixel of motion that no level expects is no outlier."""


@compiled()
def _pair(told: FloatArray, m: int, more: float) -> float:
    """Chi-square of the first two readings together, `more` added to their variances."""
    a, b, c = told[m, 6] + told[m, 3] + more, told[m, 9], told[m, 7] + told[m, 4] + more
    e0, e1 = told[m, 0], told[m, 1]
    told[m, 14], told[m, 15] = e0 / math.sqrt(a), e1 / math.sqrt(c)
    told[m, 12] = (c * e0 * e0 - 2.0 * b * e0 * e1 + a * e1 * e1) / (a * c - b * b)
    return float(told[m, 12])


@compiled()
def _judge(
    kind: int, z: FloatArray, row: int, noise: FloatArray, told: FloatArray, report: FloatArray,
    gated: FloatArray,
) -> None:  # fmt: skip
    """Which sensors of an event are gated, by the level that expects them best."""
    best, best_gyro = math.inf, math.inf
    if kind == CAMERA:
        variance = noise[0] * noise[0] + noise[1] * noise[1] / 12.0
        for m in range(told.shape[0]):
            best = min(best, _pair(told, m, variance + _MARGIN_PX2))
            _pair(told, m, variance)
        gated[row, 0] = 0.0 if best < noise[8] else 1.0
        report[8] = gated[row, 0]
        return
    gated[row, 1], gated[row, 2] = 1.0, 1.0
    for m in range(told.shape[0]):
        S = told[m, 8] + told[m, 5]
        told[m, 16] = told[m, 2] / math.sqrt(S)
        told[m, 13] = told[m, 16] * told[m, 16]
        best_gyro = min(best_gyro, told[m, 13])
        best = min(best, _pair(told, m, 0.0))
    if not (math.isnan(z[row, 0]) or math.isnan(z[row, 1])):
        gated[row, 1] = 0.0 if best < noise[9] else 1.0
        report[9] = gated[row, 1]
    if not math.isnan(z[row, 2]):
        gated[row, 2] = 0.0 if best_gyro < noise[10] else 1.0
        report[10] = gated[row, 2]


@compiled()
def _gains(bank: FloatArray, p: int) -> tuple[float, float, float]:
    """What the three readings make of one quantity."""
    return bank[p], bank[p + R1], bank[p + R2]


@compiled(inlined=True)
def _settle(bank: FloatArray, at: int, move0: float, move1: float, move2: float) -> None:
    """Take the rows of three readings from covariance and state; p_i p_j is the same on both sides of P.

    Between two quantities that are only considered the covariance stays, and so do their values.
    """
    o = at & POSITIVE
    p = o + P0
    a0, a1, a2 = _gains(bank, p)
    b0, b1, b2 = _gains(bank, p + 1)
    c0, c1, c2 = _gains(bank, p + 2)
    d0, d1, d2 = _gains(bank, p + 3)
    e0, e1, e2 = _gains(bank, p + 4)
    f0, f1, f2 = _gains(bank, p + 5)
    for j in range(WIDTH):
        p0, p1, p2 = bank[o + P0 + j], bank[o + P1 + j], bank[o + P2 + j]
        q0, q1, q2 = bank[o + _Q0 + j], bank[o + _Q1 + j], bank[o + _Q2 + j]
        bank[o + j] -= a0 * p0 + a1 * p1 + a2 * p2
        bank[o + R1 + j] -= b0 * p0 + b1 * p1 + b2 * p2
        bank[o + R2 + j] -= c0 * p0 + c1 * p1 + c2 * p2
        bank[o + R3 + j] -= d0 * p0 + d1 * p1 + d2 * p2
        bank[o + R4 + j] -= e0 * p0 + e1 * p1 + e2 * p2
        bank[o + R5 + j] -= f0 * p0 + f1 * p1 + f2 * p2
        bank[o + STATE + j] += move0 * q0 + move1 * q1 + move2 * q2
    a0, a1, a2 = _gains(bank, p + 6)
    b0, b1, b2 = _gains(bank, p + 7)
    c0, c1, c2 = _gains(bank, p + 8)
    d0, d1, d2 = _gains(bank, p + 9)
    e0, e1, e2 = _gains(bank, p + 10)
    f0, f1, f2 = _gains(bank, p + 13)
    g0, g1, g2 = _gains(bank, p + 17)
    h0, h1, h2 = _gains(bank, p + 18)
    for j in range(4, WIDTH):
        p0, p1, p2 = bank[o + P0 + j], bank[o + P1 + j], bank[o + P2 + j]
        bank[o + R6 + j] -= a0 * p0 + a1 * p1 + a2 * p2
        bank[o + R7 + j] -= b0 * p0 + b1 * p1 + b2 * p2
        bank[o + R8 + j] -= c0 * p0 + c1 * p1 + c2 * p2
        bank[o + R9 + j] -= d0 * p0 + d1 * p1 + d2 * p2
        bank[o + R10 + j] -= e0 * p0 + e1 * p1 + e2 * p2
        bank[o + R13 + j] -= f0 * p0 + f1 * p1 + f2 * p2
        bank[o + R17 + j] -= g0 * p0 + g1 * p1 + g2 * p2
        bank[o + R18 + j] -= h0 * p0 + h1 * p1 + h2 * p2
    a0, a1, a2 = _gains(bank, p + 11)
    b0, b1, b2 = _gains(bank, p + 12)
    c0, c1, c2 = _gains(bank, p + 14)
    d0, d1, d2 = _gains(bank, p + 15)
    e0, e1, e2 = _gains(bank, p + 16)
    for j in range(4, WIDTH):
        p0, p1, p2 = bank[o + _Q0 + j], bank[o + _Q1 + j], bank[o + _Q2 + j]
        bank[o + R11 + j] -= a0 * p0 + a1 * p1 + a2 * p2
        bank[o + R12 + j] -= b0 * p0 + b1 * p1 + b2 * p2
        bank[o + R14 + j] -= c0 * p0 + c1 * p1 + c2 * p2
        bank[o + R15 + j] -= d0 * p0 + d1 * p1 + d2 * p2
        bank[o + R16 + j] -= e0 * p0 + e1 * p1 + e2 * p2


@compiled()
def _leave(
    trace: FloatArray, row: int, used: int, bank: FloatArray, p: int, told: FloatArray, m: int, H: int,
    places: IntArray, move: float, scale: float,
) -> None:  # fmt: skip
    """Write what a reading does to the trace; `scale` is 1 / sqrt(S), which row and move have in them."""
    for j in range(SIZE):
        trace[row, used, j], trace[row, used, SIZE + j] = 0.0, bank[p + j] * scale
    for k in range(len(places)):
        trace[row, used, places[k]] = told[m, H + k]
    trace[row, used, 2 * SIZE], trace[row, used, 2 * SIZE + 1] = move * scale, scale * scale


@compiled(inlined=True)
def _absorb_camera(
    bank: FloatArray, at: int, noise: FloatArray, told: FloatArray, m: int, trace: FloatArray, row: int
) -> None:
    """Update by the readings of a picture, one after the other."""
    o = at & POSITIVE
    jitter = noise[0] * noise[0]
    y, S, log_u = update_terms(told[m, 0], told[m, 6], jitter + told[m, 3], noise[1])
    scale0 = 1.0 / math.sqrt(S)
    move0 = y * scale0
    learnt, considered = told[m, 10] * scale0, told[m, 11] * scale0
    left = max(told[m, 7] - learnt * (learnt + 2.0 * considered), 0.0)
    y, S, log_v = update_terms(told[m, 1] - learnt * move0, left, jitter + told[m, 4], noise[1])
    scale1 = 1.0 / math.sqrt(S)
    move1 = y * scale1
    told[m, 17] = log_u + log_v
    for j in range(WIDTH):
        free = _LEARNT[j]
        p0 = scale0 * bank[o + P0 + j]
        p1 = scale1 * (bank[o + P1 + j] - (learnt + free * considered) * p0)
        bank[o + P0 + j], bank[o + P1 + j], bank[o + P2 + j] = p0, p1, 0.0
        bank[o + _Q0 + j], bank[o + _Q1 + j], bank[o + _Q2 + j] = free * p0, free * p1, 0.0
    if trace.shape[0]:
        _leave(trace, row, int(_FIRST), bank, o + P0, told, m, int(H_U), SEEN, move0, scale0)
        _leave(trace, row, int(_SECOND), bank, o + P1, told, m, int(H_V), SEEN, move1, scale1)
        trace[row, 2, TRACE - 1] = 0.0
    _settle(bank, at, move0, move1, 0.0)


@compiled(inlined=True)
def _absorb_imu(
    bank: FloatArray, at: int, told: FloatArray, m: int, gated: FloatArray, trace: FloatArray, row: int
) -> None:
    """Update by the readings of a sample, the gyroscope first: it is the most exact."""
    o = at & POSITIVE
    log_l, product = 0.0, 1.0
    scale0, scale1, scale2, move0, move1, move2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    z_on_x, z_on_y, x_on_y = 0.0, 0.0, 0.0
    if gated[row, 2] == 0.0:
        S = told[m, 8] + told[m, 5]
        scale2 = 1.0 / math.sqrt(S)
        move2 = told[m, 2] * scale2
        z_on_x, z_on_y = told[m, 10] * scale2, told[m, 11] * scale2
        log_l, product = log_l + move2 * move2, product * S * _TURN
    if gated[row, 1] == 0.0:
        S = max(told[m, 6] - z_on_x * z_on_x, 0.0) + told[m, 3]
        scale0 = 1.0 / math.sqrt(S)
        move0 = (told[m, 0] - z_on_x * move2) * scale0
        log_l, product = log_l + move0 * move0, product * S * _TURN
        x_on_y = (told[m, 9] - z_on_x * z_on_y) * scale0
        S = max(told[m, 7] - z_on_y * z_on_y - x_on_y * x_on_y, 0.0) + told[m, 4]
        scale1 = 1.0 / math.sqrt(S)
        move1 = (told[m, 1] - z_on_y * move2 - x_on_y * move0) * scale1
        log_l, product = log_l + move1 * move1, product * S * _TURN
    told[m, 17] = -0.5 * (log_l + math.log(product))
    for j in range(WIDTH):
        free = _LEARNT[j]
        p2 = scale2 * bank[o + P2 + j]
        p0 = scale0 * (bank[o + P0 + j] - z_on_x * p2)
        p1 = scale1 * (bank[o + P1 + j] - z_on_y * p2 - x_on_y * p0)
        bank[o + P0 + j], bank[o + P1 + j], bank[o + P2 + j] = p0, p1, p2
        bank[o + _Q0 + j], bank[o + _Q1 + j], bank[o + _Q2 + j] = free * p0, free * p1, free * p2
    if trace.shape[0]:
        _leave(trace, row, int(_FIRST), bank, o + P2, told, m, int(H_Z), TURNED, move2, scale2)
        _leave(trace, row, int(_SECOND), bank, o + P0, told, m, int(H_X), FELT_X, move0, scale0)
        _leave(trace, row, int(_THIRD), bank, o + P1, told, m, int(H_Y), FELT_Y, move1, scale1)
    _settle(bank, at, move0, move1, move2)


@compiled()
def _tell(kind: int, weights: FloatArray, slot: int, told: FloatArray, report: FloatArray) -> None:
    """Innovations in the report, those of each level weighted as after the event."""
    pair, gyro, e0, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(told.shape[0]):
        w = weights[slot, m]
        pair += w * told[m, 12]
        gyro += w * told[m, 13]
        e0 += w * told[m, 14]
        e1 += w * told[m, 15]
        e2 += w * told[m, 16]
    if kind == CAMERA:
        report[0], report[3], report[4] = pair, e0, e1
        return
    if not math.isnan(report[9]):
        report[1], report[5], report[6] = pair, e0, e1
    if not math.isnan(report[10]):
        report[2], report[7] = gyro, e2


@compiled()
def mixes(kind: int, since: float) -> bool:
    """Whether the levels are mixed before an event of this kind, so long after they last were [s]."""
    return bool(kind == CAMERA or (kind != 0 and since > MIXED_S))


@compiled(inlined=True)
def event(
    bank: FloatArray, weights: FloatArray, old: int, new: int, kind: int, z: FloatArray, row: int, dt: float,
    switch_hz: float, levels: FloatArray, k: int, walk: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, told: FloatArray, again: bool, report: FloatArray, gated: FloatArray,
    trace: FloatArray,
) -> None:  # fmt: skip
    """Carry the bank on to an event and update it.

    Parameters
    ----------
    bank : memory of `bank`, of which slot `old` is read and `new` written; of one level they may be the same.
    weights : (slots, M + 1) weights of the levels, and the time since they were last mixed [s].
    kind, dt : `CAMERA`, `IMU` or 0 for none; time since the event before [s].
    z, gated : (n, 3) each, of which `row` counts: readings, and 1 where camera, accelerometer or gyroscope is
        not used.
    switch_hz, levels, walk : of `model.Kinematic`, (n, M, 8) levels of which [k] counts.
    view, constants, noise : camera (25,), gravity and lever across (2,), `NOISE` (11,).
    told : (M, `expect.TOLD`) scratch.
    again : whether the event is done once more; then `gated` holds.
    report : (12,) of `REPORT`, written to.
    trace : (n, 3, `TRACE`) what each reading of the last level did, for the smoother; (0, 3, `TRACE`) for
        nothing.
    """
    count = told.shape[0]
    since = weights[old, count] + max(dt, 0.0)
    if count > 1 and mixes(kind, since):
        mix(bank, weights, old, new, (1.0 - math.exp(-count * switch_hz * since)) / count)
        since = 0.0
    elif old != new:
        for m in range(count):
            copy_level(bank, (old * count + m) * RECORD, (new * count + m) * RECORD)
            weights[new, m] = weights[old, m]
    weights[new, count] = since
    if not again:
        report[:] = math.nan
    report[11] = 0.0
    for m in range(count):
        at = (new * count + m) * RECORD
        predict(bank, at, levels, k, m, walk, dt)
        if kind == CAMERA:
            expect_camera(bank, at, z, row, view, noise, told, m)
        elif kind == IMU:
            expect_imu(bank, at, z, row, constants, noise, told, m)
    if kind == 0:
        if trace.shape[0]:
            for i in range(3):
                trace[row, i, TRACE - 1] = 0.0
        return
    if not again:
        _judge(kind, z, row, noise, told, report, gated)
    if kind == CAMERA and gated[row, 0] != 0.0:
        for m in range(count):
            told[m, 17] = 0.0
        if trace.shape[0]:
            for i in range(3):
                trace[row, i, TRACE - 1] = 0.0
    else:
        for m in range(count):
            at = (new * count + m) * RECORD
            if kind == CAMERA:
                _absorb_camera(bank, at, noise, told, m, trace, row)
            else:
                _absorb_imu(bank, at, told, m, gated, trace, row)
    report[11] = settle_weights(weights, new, told, 17) if count > 1 else told[0, 17]
    if not again:
        _tell(kind, weights, new, told, report)


# ----------------------------------------------------------------------
# What goes into the fused filter and what comes out: set-up, rows, columns and flags.

FLAGS = {
    "restarted": 1,
    "camera_silent": 2,
    "imu_silent": 4,
    "held_by_prior": 8,
    "late": 16,
    "time_jump": 32,
    "not_started": 64,
}

OUT = (
    "t_s", "q1_m", "q2_m", "dq1_mps", "dq2_mps", "phi_rad", "length_m", "x_m", "y_m", "gyro_bias_radps",
    "sigma_q1_m", "sigma_q2_m", "sigma_phi_rad", *REPORT, "flags", "swing_weight", "rest_weight",
    "driven_weight",
)  # fmt: skip
"""Columns of the output."""
"""Bits of the column `flags`."""


@dataclass(frozen=True)
class Start:
    """What is known before the first reading.

    Attributes
    ----------
    head, head_sigma : (6,) of `sensors.HEAD`.
    sensor, sensor_sigma : (13,) of `sensors.SENSOR`.
    sensor_covariance : (13, 13) in place of the deviations, where the quantities are not independent.
    """

    sensor: FloatArray
    sensor_sigma: FloatArray
    head: FloatArray = field(default_factory=lambda: np.array([0.0, 0.068, 0.0, 0.0, 0.0, 0.0]))
    head_sigma: FloatArray = field(default_factory=lambda: np.array([0.4, 0.015, 2.0, 0.1, 100.0, 2.0]))
    sensor_covariance: FloatArray | None = None

    def covariance(self) -> FloatArray:
        """Covariance (19, 19) of head and sensors."""
        P = np.diag(np.concatenate([self.head_sigma, self.sensor_sigma]) ** 2)
        if self.sensor_covariance is not None:
            P[6:, 6:] = self.sensor_covariance
        return np.asarray(P)


@dataclass(frozen=True)
class Setup:
    """Everything that stays the same over a log.

    Attributes
    ----------
    view : (25,) of `sensors.view_coefficients`; without a camera any.
    noise : (11,) of `kernel.NOISE`.
    start : prior. `sensor[7]`, the time offset, is the delay of the pictures.
    bellows_radius_m : r_B.
    gravity_mps2, lever_across_m : g and the IMU's place across the tangent.
    process : bank of levels.
    camera_period_s, imu_period_s : nominal; NaN takes the stamps as they are.
    """

    view: FloatArray
    noise: FloatArray
    start: Start
    bellows_radius_m: float
    gravity_mps2: float = 9.81
    lever_across_m: float = 0.0
    process: Kinematic = field(default_factory=Kinematic)
    camera_period_s: float = math.nan
    imu_period_s: float = math.nan


@dataclass(frozen=True)
class Rows:
    """Rows of a log, NaN where nothing was sampled.

    Attributes
    ----------
    t_s : (n,) stamps.
    readings : (n, 5) u, v [px], a_x, a_y [m/s^2], g_z [rad/s].
    kinds : (n,) 1 for the camera's tick, with or without a marker, 2 for an IMU sample, 3 for both.
    """

    t_s: FloatArray
    readings: FloatArray
    kinds: IntArray

    def __len__(self) -> int:
        return len(self.t_s)


# ----------------------------------------------------------------------
# Columns 1 to 12 of the output: lengths, rates, pose, bias and deviations from states and covariances.

_JUMP_S = (-0.1, 2.0)


@compiled()
def begin_row(
    stamp: float, last: float, camera_clock: FloatArray, imu_clock: FloatArray, out: FloatArray, row: int
) -> bool:
    """Blank a row but for its stamp; whether time jumps there from the last one, where clocks start again."""
    for k in range(out.shape[1]):
        out[row, k] = math.nan
    out[row, 0] = stamp
    step = stamp - last
    jumps = step < _JUMP_S[0] or step > _JUMP_S[1]
    if jumps:
        restart(camera_clock)
        restart(imu_clock)
    return bool(jumps)


@compiled()
def finish_row(
    phi: float, length: float, dphi: float, dl: float, bias: float, pp: float, ll: float, pl: float, r: float,
    out: FloatArray, row: int,
) -> None:  # fmt: skip
    """Means and variances into columns 1 to 12 of a row."""
    out[row, 1], out[row, 2] = length + r * phi, length - r * phi
    out[row, 3], out[row, 4] = dl + r * dphi, dl - r * dphi
    out[row, 5], out[row, 6] = phi, length
    out[row, 7], out[row, 8] = head_position(phi, length)
    out[row, 9] = bias
    out[row, 10] = math.sqrt(max(ll + r * r * pp + 2.0 * r * pl, 1e-18))
    out[row, 11] = math.sqrt(max(ll + r * r * pp - 2.0 * r * pl, 1e-18))
    out[row, 12] = math.sqrt(max(pp, 1e-18))


@compiled()
def write_bank(
    bank: FloatArray, weights: FloatArray, slot: int, dt: float, levels: FloatArray, radius: float,
    out: FloatArray, row: int,
) -> None:  # fmt: skip
    """Means and deviations of the bank a short time dt after its last event into columns 1 to 12."""
    count = weights.shape[1] - 1
    phi = length = dphi = dl = bias = pp = ll = pl = 0.0
    # Second moments about the first level: what cancels is no more than the levels are apart.
    phi_0 = length_0 = 0.0
    for m in range(count):
        at = (slot * count + m) * RECORD
        x = at + STATE
        a01, a02, a11, a12, _ = axis_transition(levels[0, m, 0], levels[0, m, 1], dt)
        b01, b02, b11, b12, _ = axis_transition(levels[0, m, 4], levels[0, m, 5], dt)
        phi_m = bank[x] + a01 * bank[x + 2] + a02 * bank[x + 4]
        length_m = bank[x + 1] + b01 * bank[x + 3] + b02 * bank[x + 5]
        if m == 0:
            phi_0, length_0 = phi_m, length_m
        phi_m, length_m = phi_m - phi_0, length_m - length_0
        p, v, a = at, at + R2, at + R4
        q, u, b = at + R1, at + R3, at + R5
        var_p = (
            bank[p] + a01 * a01 * bank[v + 2] + a02 * a02 * bank[a + 4]
            + 2.0 * (a01 * bank[p + 2] + a02 * bank[p + 4] + a01 * a02 * bank[v + 4])
        )  # fmt: skip
        var_l = (
            bank[q + 1] + b01 * b01 * bank[u + 3] + b02 * b02 * bank[b + 5]
            + 2.0 * (b01 * bank[q + 3] + b02 * bank[q + 5] + b01 * b02 * bank[u + 5])
        )  # fmt: skip
        cross = bank[p + 1] + b01 * bank[p + 3] + b02 * bank[p + 5]
        cross += a01 * (bank[v + 1] + b01 * bank[v + 3] + b02 * bank[v + 5])
        cross += a02 * (bank[a + 1] + b01 * bank[a + 3] + b02 * bank[a + 5])
        if dt > 0.0:
            var_p += axis_noise(levels[0, m, 2], levels[0, m, 3], dt)[0]
            var_l += axis_noise(levels[0, m, 6], levels[0, m, 7], dt)[0]
        w = weights[slot, m]
        phi += w * phi_m
        length += w * length_m
        dphi += w * (a11 * bank[x + 2] + a12 * bank[x + 4])
        dl += w * (b11 * bank[x + 3] + b12 * bank[x + 5])
        bias += w * bank[x + 6]
        pp += w * (var_p + phi_m * phi_m)
        ll += w * (var_l + length_m * length_m)
        pl += w * (cross + phi_m * length_m)
    finish_row(
        phi_0 + phi, length_0 + length, dphi, dl, bias, pp - phi * phi, ll - length * length,
        pl - phi * length, radius, out, row,
    )  # fmt: skip


@compiled()
def write_columns(
    x: FloatArray, P: FloatArray, bias: int, rows: IntArray, radius: float, out: FloatArray
) -> None:
    """States (k, n) and covariances (k, n, n) into columns 1 to 12 of these rows (k,) of `out`.

    `bias` is the place of the gyroscope's bias in a state.
    """
    for k in range(len(rows)):
        finish_row(
            x[k, 0], x[k, 1], x[k, 2], x[k, 3], x[k, bias], P[k, 0, 0], P[k, 1, 1], P[k, 0, 1], radius, out,
            rows[k],
        )  # fmt: skip


# ----------------------------------------------------------------------
# The fused filter, row by row: what is known of the head at the time of each row of a log.
#
# A picture arrives `time_offset` after it was exposed, when newer IMU samples have been used already. The
# last events are kept with the state after each; an event that belongs between them is put there and
# those after it are done again. So each row's output rests on all that had arrived by then, and on nothing
# else. Time stamps go through the clocks of `clock` first.
#
# What goes wrong is said in `flags`: a picture or a sample that was gated; a sensor that is silent; a
# restart
# after half a second of rejected pictures, at a jump of the time, or from a state that no rig has; an
# angle or length that no sensor sees, which the prior then holds.

NEWEST, COUNT = 0, 1
"""Where a filter's integers tell the place of the newest of the last events, and how many there are."""

FASTEST_MPS = 1.0
"""No rig's bellows change their lengths faster: a swing from 0.7 rad reaches a quarter of it."""
_SILENT_S = 0.5
_LOCKED_OUT_S = 0.5
_KNOWN_M = 0.05
"""A length with a larger deviation than this is as good as unknown."""
_LAST, _CAMERA_SEEN, _IMU_SEEN, _REJECTED_SINCE, _GYRO_REJECTED_SINCE = range(5)
_CAMERA_STARTED, _PENDING = 2, 3
_PHI, _LENGTH = 0, 1


@compiled()
def _clear(bank: FloatArray, at: int, i: int, variance: float) -> None:
    """Make a state independent of all others."""
    for j in range(SIZE):
        bank[at + WIDTH * i + j] = 0.0
        bank[at + WIDTH * j + i] = 0.0
    bank[at + (WIDTH + 1) * i] = variance


@compiled()
def _reset_head(
    bank: FloatArray, weights: FloatArray, slot: int, head: FloatArray, sigma: FloatArray
) -> None:
    """Forget the head's motion; what is known of the sensors stays."""
    count = weights.shape[1] - 1
    for m in range(count):
        at = (slot * count + m) * RECORD
        for i in range(6):
            bank[at + STATE + i] = head[i]
            _clear(bank, at, i, sigma[i] * sigma[i])
        weights[slot, m] = 1.0 / count


@compiled()
def _place_head(bank: FloatArray, slot: int, count: int, phi: float, length: float) -> None:
    for m in range(count):
        at = (slot * count + m) * RECORD + STATE
        bank[at], bank[at + 1] = phi, length


@compiled()
def _hold(bank: FloatArray, at: int, k: int, middle: float, sigma: float) -> None:
    """Use the prior of one quantity of the head as a reading."""
    S = bank[at + (WIDTH + 1) * k] + sigma * sigma
    row, scratch = at + WIDTH * k, at + STATE + WIDTH
    for j in range(WIDTH):
        bank[scratch + j] = bank[row + j] / math.sqrt(S)
    move = (middle - bank[at + STATE + k]) / math.sqrt(S)
    for i in range(SIZE):
        gain = bank[scratch + i]
        bank[at + STATE + i] += gain * move
        for j in range(WIDTH):
            bank[at + WIDTH * i + j] -= gain * bank[scratch + j]


@compiled()
def _mend(
    bank: FloatArray, slot: int, count: int, head: FloatArray, head_sigma: FloatArray, radius: float
) -> int:
    """Whether the state is still one that a rig can have, and what is done where it is not: flags."""
    flags = 0
    for m in range(count):
        at = (slot * count + m) * RECORD
        x = at + STATE
        if bank[at] > 1.0:
            _hold(bank, at, int(_PHI), head[0], 0.7)
            flags |= 8
        if bank[at + WIDTH + 1] > 2.25 * head_sigma[1] * head_sigma[1]:
            _hold(bank, at, int(_LENGTH), head[1], head_sigma[1])
            flags |= 8
        bad = 0 if abs(bank[x]) < 3.0 and 1e-3 < bank[x + 1] < 1.0 else 1
        for i in range(SIZE):
            bad += 0 if abs(bank[x + i]) < 1e6 else 1
            bad += 0 if bank[at + (WIDTH + 1) * i] > 0.0 else 1
        if not bad and not abs(bank[x + 3]) + radius * abs(bank[x + 2]) < FASTEST_MPS:
            # Faster than a rig: where it is stays, as unsure as the prior, and its motion is not known.
            for i in range(6):
                if i >= 2:
                    bank[x + i] = head[i]
                _clear(bank, at, i, head_sigma[i] ** 2)
            flags |= 1
        if bad:
            # A level that has left the model starts again from the prior, all of it.
            for i in range(SIZE):
                if i < 6:
                    bank[x + i] = head[i]
                elif not abs(bank[x + i]) < 1e6:
                    bank[x + i] = 0.0
                _clear(bank, at, i, head_sigma[i] ** 2 if i < 6 else 1e-2)
            flags |= 1
    return flags


@compiled()
def count_first(ring_t: FloatArray, ring_kind: IntArray, whole: IntArray, when: float) -> None:
    """Let the ring of events begin where it is empty."""
    if whole[COUNT] == 0:
        ring_t[whole[NEWEST]], ring_kind[whole[NEWEST]] = when, 0
        whole[COUNT] = 1


@compiled()
def make_room(
    ring_t: FloatArray, ring_z: FloatArray, ring_kind: IntArray, ring_gated: FloatArray,
    ring_let_go: FloatArray, whole: IntArray, kind: int, when: float,
) -> int:  # fmt: skip
    """Put an event among the last ones, by its time; how many are after it, -1 where it is older than all.

    Its readings are the caller's to write. What is only known to be older than the oldest of a ring that is
    not full goes right after that one. `ring_let_go` may be empty.
    """
    size, newest, back = ring_t.shape[0], whole[NEWEST], 0
    while back < whole[COUNT] - 1 and ring_t[(newest - back) % size] > when:
        back += 1
    if ring_t[(newest - back) % size] > when:
        if whole[COUNT] == size:
            return -1
        when = ring_t[(newest - back) % size]
    for i in range(back):
        to, since = (newest + 1 - i) % size, (newest - i) % size
        ring_t[to], ring_kind[to] = ring_t[since], ring_kind[since]
        for k in range(ring_z.shape[1]):
            ring_z[to, k] = ring_z[since, k]
        for k in range(3):
            ring_gated[to, k] = ring_gated[since, k]
        if ring_let_go.shape[0]:
            ring_let_go[to] = ring_let_go[since]
    own = (newest + 1 - back) % size
    ring_t[own], ring_kind[own] = when, kind
    return int(back)


@compiled()
def settle_event(whole: IntArray, size: int, report: FloatArray, out: FloatArray, row: int) -> None:
    """The ring has one event more; what it says of itself goes into its row."""
    whole[NEWEST] = (whole[NEWEST] + 1) % size
    whole[COUNT] = min(whole[COUNT] + 1, size)
    if not math.isnan(out[row, 24]) and not math.isnan(report[11]):
        report[11] += out[row, 24]
    for k in range(12):
        if not math.isnan(report[k]):
            out[row, 13 + k] = report[k]


@compiled()
def run_filter(
    t: FloatArray, readings: FloatArray, kinds: IntArray,
    bank: FloatArray, weights: FloatArray, ring_t: FloatArray, ring_z: FloatArray,
    ring_kind: IntArray, ring_gated: FloatArray, whole: IntArray, real: FloatArray,
    camera_clock: FloatArray, imu_clock: FloatArray,
    switch_hz: float, levels: FloatArray, walk: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, head: FloatArray, head_sigma: FloatArray, radius: float, delay: float,
    sensor: FloatArray, told: FloatArray, report: FloatArray, spare: FloatArray, untraced: FloatArray,
    never: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n, 5), (n,) through the ring of the last events; writes `out` (n, len(OUT)).

    The last slot of bank and weights is scratch; so are the arrays from `sensor` (13,) on.
    """
    size, count = ring_t.shape[0], told.shape[0]
    z0 = z1 = z2 = 0.0
    for row in range(len(t)):
        stamp = t[row]
        flags = 0
        if begin_row(stamp, real[_LAST], camera_clock, imu_clock, out, row):
            newest = whole[NEWEST]
            _reset_head(bank, weights, newest, head, head_sigma)
            whole[COUNT], whole[_CAMERA_STARTED], whole[_PENDING] = 0, 0, 0
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
            real[_REJECTED_SINCE], real[_GYRO_REJECTED_SINCE] = math.nan, math.nan
            flags |= 32
        elif math.isnan(real[_LAST]):
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
        real[_LAST] = stamp
        for kind in range(1, 3):
            if not kinds[row] & kind:
                continue
            if kind == CAMERA:
                when = advance(camera_clock, stamp) - delay
                z0, z1, z2 = readings[row, 0], readings[row, 1], math.nan
                if math.isnan(z0) or math.isnan(z1):
                    continue
                real[_CAMERA_SEEN] = stamp
            else:
                when = advance(imu_clock, stamp)
                z0, z1, z2 = readings[row, 2], readings[row, 3], readings[row, 4]
                if math.isnan(z2) and (math.isnan(z0) or math.isnan(z1)):
                    continue
                real[_IMU_SEEN] = stamp
            newest = whole[NEWEST]
            if whole[COUNT] == 0:
                count_first(ring_t, ring_kind, whole, when)
                if kind == IMU and not math.isnan(z0) and math.hypot(z0, z1) > 1.0:
                    at = newest * count * RECORD + STATE
                    tilt = math.atan2(z1, z0) - bank[at + 9]
                    tilt = min(max(math.atan2(math.sin(tilt), math.cos(tilt)), -1.5), 1.5)
                    _place_head(bank, newest, count, tilt, bank[at + 1])
            back = make_room(ring_t, ring_z, ring_kind, ring_gated, never, whole, kind, when)
            if back < 0:
                flags |= 16
                continue
            own = (newest + 1 - back) % size
            ring_z[own, 0], ring_z[own, 1], ring_z[own, 2] = z0, z1, z2
            begin_camera = kind == CAMERA and (whole[_CAMERA_STARTED] == 0 or whole[_PENDING] == 1)
            for i in range(back + 1):
                now = (newest + 1 - back + i) % size
                before = (now - 1) % size
                if i == 0 and begin_camera:
                    at = before * count * RECORD + STATE
                    for k in range(len(sensor)):
                        sensor[k] = bank[at + 6 + k]
                    phi, length, found = 0.0, 0.0, False
                    for attempt in range(2):
                        if not found:
                            angle = bank[at] if attempt == 0 else 0.0
                            phi, length, found = invert_marker(view, sensor, z0, z1, angle, head[1])
                    if found and 0.2 * head[1] < length < 3.0 * head[1]:
                        if whole[_CAMERA_STARTED] == 1:
                            flags |= 1
                        _reset_head(bank, weights, before, head, head_sigma)
                        _place_head(bank, before, count, phi, length)
                        whole[_CAMERA_STARTED], whole[_PENDING] = 1, 0
                event(
                    bank, weights, before, now, ring_kind[now], ring_z, now, ring_t[now] - ring_t[before],
                    switch_hz, levels, 0, walk, view, constants, noise, told, i > 0,
                    report if i == 0 else spare, ring_gated, untraced,
                )  # fmt: skip
                flags |= _mend(bank, now, count, head, head_sigma, radius)
            settle_event(whole, size, report, out, row)
            if kind == CAMERA:
                if report[8] == 0.0:
                    real[_REJECTED_SINCE] = math.nan
                elif math.isnan(real[_REJECTED_SINCE]):
                    real[_REJECTED_SINCE] = stamp
                elif stamp - real[_REJECTED_SINCE] > _LOCKED_OUT_S:
                    whole[_PENDING] = 1
                    real[_REJECTED_SINCE] = math.nan
            elif report[10] == 0.0:
                real[_GYRO_REJECTED_SINCE] = math.nan
            elif report[10] == 1.0:
                if math.isnan(real[_GYRO_REJECTED_SINCE]):
                    real[_GYRO_REJECTED_SINCE] = stamp
                elif stamp - real[_GYRO_REJECTED_SINCE] > _LOCKED_OUT_S:
                    here = whole[NEWEST]
                    at = here * count * RECORD + STATE
                    phi, length = bank[at], bank[at + 1]
                    _reset_head(bank, weights, here, head, head_sigma)
                    _place_head(bank, here, count, phi, length)
                    real[_GYRO_REJECTED_SINCE] = math.nan
                    flags |= 1
        if stamp - real[_CAMERA_SEEN] > _SILENT_S:
            flags |= 2
        if stamp - real[_IMU_SEEN] > _SILENT_S:
            flags |= 4
        here = whole[NEWEST]
        ahead = stamp - ring_t[here] if whole[COUNT] > 0 else 0.0
        if whole[COUNT] == 0:
            flags |= 64
        far = abs(ahead) > 0.02
        if not far:
            write_bank(bank, weights, here, ahead, levels, radius, out, row)
            far = not max(abs(out[row, 3]), abs(out[row, 4])) < FASTEST_MPS
        if far:
            for m in range(count):
                weights[size, m] = weights[here, m]
                at = (size * count + m) * RECORD
                copy_level(bank, (here * count + m) * RECORD, at)
                predict(bank, at, levels, 0, m, walk, ahead)
            flags |= _mend(bank, size, count, head, head_sigma, radius)
            write_bank(bank, weights, size, 0.0, levels, radius, out, row)
        if max(out[row, 10], out[row, 11]) > _KNOWN_M:
            flags |= 8
        out[row, 25] = flags
        out[row, 26], out[row, 27] = weights[here, count - 1], weights[here, 0]


def starting_state(setup: Setup, rows: Rows | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State (M, 19), covariance and weights before the first reading.

    Parameters
    ----------
    rows : where given, the first of them that the camera can be inverted for says where the head begins.
    """
    start, count = setup.start, len(setup.process.levels)
    mean = np.concatenate([start.head, start.sensor])
    # Pictures are put at their exposure, so that what is left of the offset is zero.
    mean[13] -= max(float(start.sensor[7]), 0.0)
    if rows is not None:
        for u, v in rows.readings[np.isfinite(rows.readings[:, :2]).all(axis=1)][:20, :2].tolist():
            phi, length, found = invert_marker(setup.view, mean[6:], u, v, 0.0, float(start.head[1]))
            if found and 0.2 * start.head[1] < length < 3.0 * start.head[1]:
                mean[0], mean[1] = phi, length
                break
    return np.tile(mean, (count, 1)), np.tile(start.covariance(), (count, 1, 1)), np.full(count, 1.0 / count)


class Filter:
    """A filter at work: rows in, estimates out, with memory of the last events only."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        levels, walk = setup.process.arrays()
        self._levels, self._walk = levels, walk
        delay = max(float(setup.start.sensor[7]), 0.0)
        self._delay = delay
        period = setup.imu_period_s if setup.imu_period_s > 0.0 else 0.002
        size = min(max(16, math.ceil(2.0 * (delay + 0.02) / period) + 8), 512)
        count = len(levels)
        # One slot more than the ring has, for what is only looked ahead.
        self._bank, self._w = new_bank(size + 1, count), np.zeros((size + 1, count + 1))
        self._w[:, :count] = 1.0 / count
        self._scratch = (
            np.empty(SIZE - 6), np.zeros((count, TOLD)), np.empty(len(REPORT)), np.empty(len(REPORT)),
            np.empty((0, 3, TRACE)), np.empty(0),
        )  # fmt: skip
        self._t, self._z, self._gated = np.zeros(size), np.zeros((size, 3)), np.zeros((size, 3))
        self._kind, self._whole = np.zeros(size, dtype=np.int64), np.zeros(4, dtype=np.int64)
        self._real = np.full(5, np.nan)
        self._camera_clock = new_clock(setup.camera_period_s)
        self._imu_clock = new_clock(setup.imu_period_s)
        x, P, _ = starting_state(setup)
        put(self._bank, 0, x, P)

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        setup = self.setup
        out = np.empty((len(rows), len(OUT)))
        run_filter(
            rows.t_s, rows.readings, rows.kinds, self._bank, self._w, self._t, self._z, self._kind,
            self._gated, self._whole, self._real, self._camera_clock, self._imu_clock,
            setup.process.switch_hz, self._levels[None], self._walk, setup.view,
            np.array([setup.gravity_mps2, setup.lever_across_m]), setup.noise, setup.start.head,
            setup.start.head_sigma, setup.bellows_radius_m, self._delay, *self._scratch, out,
        )  # fmt: skip
        return out

    def stream(self, blocks: Iterable[Rows]) -> Iterator[FloatArray]:
        """Estimates of each block in turn."""
        for rows in blocks:
            yield self.run(rows)

    @property
    def sensor(self) -> FloatArray:
        """What the log has come to say of `sensors.SENSOR` (13,), as in `starting_state`."""
        x, _, weights = self.state
        return np.asarray(weights @ x[:, 6:])

    @property
    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State (M, 19), covariance (M, 19, 19) and weights (M,) after the last event."""
        here, count = int(self._whole[0]), len(self._levels)
        return *get(self._bank, here, count), self._w[here, :count].copy()


assert CLOCK_SIZE == 10
