"""What a level expects of a picture or an IMU sample: P H', innovations and their variances.

Of a gradient only what is not zero is told, from `H_U`, `H_V`, `H_X`, `H_Y` and `H_Z` on, in the order of
`SEEN`, `FELT_X`, `FELT_Y` and `TURNED`. What is not linear in a state that is not known well stays out of it,
see `kernel`.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.bank import (
    CORE,
    POSITIVE,
    R1,
    R2,
    R3,
    R4,
    R5,
    R6,
    R7,
    R8,
    R9,
    R10,
    R11,
    R12,
    R13,
    R14,
    R15,
    R16,
    R17,
    R18,
    STATE,
    WIDTH,
    mirror,
)
from calib.estimator.compiled import compiled
from calib.estimator.sensors import accelerometer_terms, marker_terms

__all__ = [
    "FELT_X",
    "FELT_Y",
    "H_U",
    "H_V",
    "H_X",
    "H_Y",
    "H_Z",
    "P0",
    "P1",
    "P2",
    "SEEN",
    "TELLING",
    "TOLD",
    "TURNED",
    "expect_camera",
    "expect_imu",
    "felt",
    "seen_considered",
    "seen_learnt",
]

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
