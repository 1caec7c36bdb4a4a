"""One event of the fused filter: a picture or an IMU sample, for all levels of the bank.

Each scalar reading z = h(x) + noise updates a state x with covariance P in turn,

    p = P H',  S = H p + R,  x += p y / S,  P -= p p' / S

with y = z - h(x0) - H (x - x0), linearised at the state x0 before the event's first reading. For one
scalar and this gain Joseph's form is the same thing: its remainder p - K S is zero term by term. P is
kept symmetric to the last bit. Of H only what is not zero is kept; the readings of an event act on the P H'
of those that follow by the Cholesky factor of their own covariance, and on P together at the end. A rounded
pixel enters as its equivalent Gaussian reading (`rounding`).

A reading is gated by the chi-square of its whole sensor in that level of the bank that expects it best;
a gated one changes nothing. The noise of an accelerometer grows with the head's acceleration by a share,
for errors of scale, those of gyroscope and marker by what an error of the time stamps makes of the motion.

What calibration and alignment say of the geometry (`CONSIDERED`: lever, marker offset, shift and stretch
of the plane) is considered and not learnt (Schmidt 1966): its uncertainty is in P and its correlations
with the motion are, but a single log does not change it. Length and lever act on the accelerometer
through ddphi, which is estimated from the same readings; errors in what multiplies them would pass for
knowledge and pull the length by a millimetre at rest. So they go into the noise there. For the same reason
the gyroscope's scale and the time offset are learnt only from rates above three of their own deviations.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import FloatArray, IntArray
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
    RECORD,
    STATE,
    WIDTH,
    copy_level,
    mix,
    predict,
    settle_weights,
)
from calib.estimator.compiled import compiled
from calib.estimator.expect import (
    FELT_X,
    FELT_Y,
    H_U,
    H_V,
    H_X,
    H_Y,
    H_Z,
    P0,
    P1,
    P2,
    SEEN,
    TURNED,
    expect_camera,
    expect_imu,
)
from calib.estimator.rounding import update_terms
from calib.estimator.sensors import SIZE

__all__ = ["CAMERA", "CONSIDERED", "IMU", "MIXED_S", "NOISE", "REPORT", "TRACE", "event", "mixes"]

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
    view, constants, noise : camera (24,), gravity and lever across (2,), `NOISE` (11,).
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
