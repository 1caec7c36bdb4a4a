"""One event of the fused filter: a picture or an IMU sample, for all levels of the bank.

Each scalar reading z = h(x) + noise updates a state x with covariance P in turn,

    p = P H',  S = H p + R,  x += p y / S,  P -= p p' / S

with y = z - h(x0) - H (x - x0), linearised at the state x0 before the event's first reading. For one
scalar and this gain Joseph's form is the same thing: its remainder p - K S is zero term by term. P is
kept symmetric to the last bit. A rounded pixel enters as its equivalent Gaussian reading (`rounding`).

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
from numba import njit

from calib.arrays import FloatArray
from calib.estimator.model import mix, predict, settle_weights
from calib.estimator.rounding import update_terms
from calib.estimator.sensors import SIZE, accelerometer, gyroscope, marker

__all__ = [
    "CAMERA",
    "CONSIDERED",
    "IMU",
    "NOISE",
    "REPORT",
    "TRACE",
    "WORK",
    "camera_terms",
    "event",
    "imu_terms",
    "scalar_update",
]

CONSIDERED = (11, 12, 14, 15, 16)
"""Entries of the state that readings do not change."""

_LEARNT = np.array([0.0 if k in CONSIDERED else 1.0 for k in range(SIZE)])

CAMERA, IMU = 1, 2
"""Kinds of events; a picture has the readings (u, v), a sample (a_x, a_y, g_z), NaN where missing."""

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

WORK = 8
"""Scratch of each level: gradients 0 to 2, P H' 3 to 5, innovations and variances 6, chi-squares 7."""

TRACE = 40
"""What a reading leaves for the smoother: H (19), P H' / S (19), y / S, 1 / S; the last is 0 without one."""

_TELLING = 9.0
"""A rate or acceleration below three deviations (squared) tells nothing of what it multiplies."""

_MARGIN_PX2 = 0.25
"""Added to the variance for gating: half a pixel of motion that no level expects is no outlier."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def scalar_update(x: FloatArray, P: FloatArray, innovation: float, S: float, p: FloatArray) -> None:
    """Update of (n,) and (n, n) in place by an innovation with variance S; p = P H' is used up.

    What is only considered keeps its value and its covariance.
    """
    n = x.shape[0]
    root = 1.0 / math.sqrt(S)
    for j in range(n):
        p[j] *= root
    move = innovation * root
    for i in range(n):
        gain = p[i]
        if i < SIZE and _LEARNT[i] == 0.0:
            for j in range(n):
                if j >= SIZE or _LEARNT[j] != 0.0:
                    P[i, j] -= gain * p[j]
            continue
        x[i] += gain * move
        # p_i p_j is the same product on both sides of the diagonal, so P stays symmetric.
        for j in range(n):
            P[i, j] -= gain * p[j]


@njit(cache=True, nogil=True, error_model="numpy")
def camera_terms(
    view: FloatArray, noise: FloatArray, x: FloatArray, P: FloatArray, H: FloatArray, out: FloatArray
) -> None:
    """Predicted pixel and what the stamps' error adds to its variance: u, v, var_u, var_v.

    H (2, n) gets the gradients.
    """
    out[0], out[1] = marker(view, x, H[0], H[1])
    for k in range(2):
        speed = H[k, 0] * x[2] + H[k, 1] * x[3]
        out[2 + k] = (speed * noise[6]) ** 2
        if speed * speed < _TELLING * (H[k, 0] ** 2 * P[2, 2] + H[k, 1] ** 2 * P[3, 3]):
            H[k, 13] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def imu_terms(
    constants: FloatArray, noise: FloatArray, x: FloatArray, P: FloatArray, H: FloatArray, out: FloatArray
) -> None:
    """Predicted a_x, a_y, g_z and the variances of their noise; H (3, n) gets the gradients."""
    out[0], out[1] = accelerometer(constants[0], constants[1], x, H[0], H[1])
    out[2] = gyroscope(x, H[2])
    if x[2] * x[2] < _TELLING * P[2, 2]:
        H[2, 10] = 0.0
    tilt = x[0] + x[9]
    moved_x = out[0] - x[7] - constants[0] * math.cos(tilt)
    moved_y = out[1] - x[8] - constants[0] * math.sin(tilt)
    scale = noise[5] * noise[5] * (moved_x * moved_x + moved_y * moved_y)
    for k in range(2):
        unknown = H[k, 1] * H[k, 1] * P[1, 1] + H[k, 11] * H[k, 11] * P[11, 11]
        out[3 + k] = noise[2 + k] * noise[2 + k] + scale + unknown
        H[k, 1], H[k, 11] = 0.0, 0.0
    out[5] = noise[4] * noise[4] + (x[4] * noise[7]) ** 2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _expect(
    x: FloatArray, P: FloatArray, kind: int, z: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """Gradients H, P H', innovations 6[:3], variances of the noise 6[3:6] and of the prediction 6[6:10]."""
    n, out, told = x.shape[0], work[7], work[6]
    count = 2 if kind == CAMERA else 3
    if kind == CAMERA:
        camera_terms(view, noise, x, P, work, out)
    else:
        imu_terms(constants, noise, x, P, work, out)
    for i in range(count):
        told[i], told[3 + i] = z[i] - out[i], out[count + i]
        H, p = work[i], work[3 + i]
        for j in range(n):
            p[j] = 0.0
        for k in range(n):
            slope = H[k]
            if slope != 0.0:
                for j in range(n):
                    p[j] += slope * P[k, j]
        total = 0.0
        for k in range(n):
            total += H[k] * p[k]
        told[6 + i] = total
    total = 0.0
    for k in range(n):
        total += work[1, k] * work[3, k]
    told[9] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _pair(told: FloatArray, more: float, kept: FloatArray) -> float:
    """Chi-square of two readings together, `more` added to their variances; both go to `kept`."""
    a, b, c = told[6] + told[3] + more, told[9], told[7] + told[4] + more
    e0, e1 = told[0], told[1]
    kept[0] = (c * e0 * e0 - 2.0 * b * e0 * e1 + a * e1 * e1) / (a * c - b * b)
    kept[2], kept[3] = e0 / math.sqrt(a), e1 / math.sqrt(c)
    return float(kept[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(
    kind: int, z: FloatArray, noise: FloatArray, work: FloatArray, report: FloatArray, gated: FloatArray
) -> None:
    """Which sensors of an event are gated, by the level that expects them best."""
    best, best_gyro = math.inf, math.inf
    if kind == CAMERA:
        variance = noise[0] * noise[0] + noise[1] * noise[1] / 12.0
        for m in range(work.shape[0]):
            best = min(best, _pair(work[m, 6], variance + _MARGIN_PX2, work[m, 7]))
            _pair(work[m, 6], variance, work[m, 7])
        gated[0] = 0.0 if best < noise[8] else 1.0
        report[8] = gated[0]
        return
    gated[1], gated[2] = 1.0, 1.0
    for m in range(work.shape[0]):
        told, kept = work[m, 6], work[m, 7]
        S = told[8] + told[5]
        kept[1], kept[4] = told[2] * told[2] / S, told[2] / math.sqrt(S)
        best_gyro = min(best_gyro, kept[1])
        best = min(best, _pair(told, 0.0, kept))
    if not (math.isnan(z[0]) or math.isnan(z[1])):
        gated[1] = 0.0 if best < noise[9] else 1.0
        report[9] = gated[1]
    if not math.isnan(z[2]):
        gated[2] = 0.0 if best_gyro < noise[10] else 1.0
        report[10] = gated[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _absorb(
    x: FloatArray, P: FloatArray, kind: int, noise: FloatArray, work: FloatArray, gated: FloatArray,
    trace: FloatArray,
) -> float:  # fmt: skip
    """Update by the readings of an event, one after the other; their log likelihood.

    The readings act on P H' of those that follow at once and on P itself together at the end.
    """
    n, told = x.shape[0], work[6]
    total, used = 0.0, 0
    move0, move1, move2 = 0.0, 0.0, 0.0
    for order in range(3):
        # The gyroscope first: it is the most exact.
        k = order if kind == CAMERA else (order + 2) % 3
        p, H = work[3 + k], work[k]
        sensor = 0 if kind == CAMERA else 2 if k == 2 else 1
        if gated[sensor] != 0.0 or (kind == CAMERA and k == 2):
            for j in range(n):
                p[j] = 0.0
            continue
        spread = 0.0
        for j in range(n):
            spread += H[j] * p[j]
        if kind == CAMERA:
            y, S, log_z = update_terms(told[k], spread, noise[0] * noise[0] + told[3 + k], noise[1])
            total += log_z
        else:
            y, S = told[k], spread + told[3 + k]
            total -= 0.5 * (y * y / S + math.log(2.0 * math.pi * S))
        if trace.shape[0]:
            for j in range(n):
                trace[used, j], trace[used, n + j] = H[j], p[j] / S
            trace[used, 2 * n], trace[used, 2 * n + 1] = y / S, 1.0 / S
            used += 1
        root = 1.0 / math.sqrt(S)
        for j in range(n):
            p[j] *= root
        move = y * root
        for later in range(order + 1, 3):
            other = later if kind == CAMERA else (later + 2) % 3
            if kind == CAMERA and other == 2:
                continue
            next_H, next_p = work[other], work[3 + other]
            every = 0.0
            for j in range(n):
                every += p[j] * next_H[j]
            learnt = 0.0
            for j in range(n):
                learnt += _LEARNT[j] * p[j] * next_H[j]
            told[other] -= learnt * move
            # Between two that are only considered the covariance stays.
            for j in range(n):
                next_p[j] -= (learnt + _LEARNT[j] * (every - learnt)) * p[j]
        if k == 0:
            move0 = move
        elif k == 1:
            move1 = move
        else:
            move2 = move
    if trace.shape[0]:
        for k in range(used, 3):
            trace[k, 2 * n + 1] = 0.0
    p0, p1, p2 = work[3], work[4], work[5]
    three = kind != CAMERA
    for i in range(n):
        if _LEARNT[i] == 0.0:
            continue
        g0, g1 = p0[i], p1[i]
        x[i] += g0 * move0 + g1 * move1
        # p_i p_j is the same product on both sides of the diagonal, so P stays symmetric.
        if three:
            g2 = p2[i]
            x[i] += g2 * move2
            for j in range(n):
                P[i, j] -= g0 * p0[j] + g1 * p1[j] + g2 * p2[j]
        else:
            for j in range(n):
                P[i, j] -= g0 * p0[j] + g1 * p1[j]
    for i in range(6, n):
        if _LEARNT[i] == 0.0:
            for j in range(n):
                if _LEARNT[j] != 0.0:
                    P[i, j] = P[j, i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _tell(kind: int, weight: FloatArray, work: FloatArray, report: FloatArray) -> None:
    """Innovations in the report, those of each level weighted as after the event."""
    pair, gyro, e0, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(weight.shape[0]):
        kept = work[m, 7]
        pair += weight[m] * kept[0]
        gyro += weight[m] * kept[1]
        e0 += weight[m] * kept[2]
        e1 += weight[m] * kept[3]
        e2 += weight[m] * kept[4]
    if kind == CAMERA:
        report[0], report[3], report[4] = pair, e0, e1
        return
    if not math.isnan(report[9]):
        report[1], report[5], report[6] = pair, e0, e1
    if not math.isnan(report[10]):
        report[2], report[7] = gyro, e2


@njit(cache=True, nogil=True, error_model="numpy")
def event(
    old_x: FloatArray,
    old_P: FloatArray,
    old_weight: FloatArray,
    x: FloatArray,
    P: FloatArray,
    weight: FloatArray,
    kind: int,
    z: FloatArray,
    dt: float,
    switch_hz: float,
    levels: FloatArray,
    walk: FloatArray,
    view: FloatArray,
    constants: FloatArray,
    noise: FloatArray,
    work: FloatArray,
    again: bool,
    report: FloatArray,
    gated: FloatArray,
    trace: FloatArray,
) -> None:
    """Carry the bank on to an event and update it.

    Parameters
    ----------
    old_x, old_P, old_weight : (M, 19), (M, 19, 19), (M,) after the event before.
    x, P, weight : the same after this one; written to.
    kind, z, dt : `CAMERA`, `IMU` or 0 for none, readings (3,), time since the event before [s].
    switch_hz, levels, walk : of `model.Kinematic`.
    view, constants, noise : camera (24,), gravity and lever across (2,), `NOISE` (11,).
    work : (M, `WORK`, 19) scratch. report : (12,) of `REPORT`, written to.
    again : whether the event is done once more; then `gated` holds.
    gated : (3,) 1 where camera, accelerometer or gyroscope is not used.
    trace : (3, `TRACE`) what each reading of the last level did, for the smoother; (0, `TRACE`) for nothing.
    """
    count = x.shape[0]
    turn = (1.0 - math.exp(-count * switch_hz * dt)) / count if count > 1 and dt > 0.0 else 0.0
    mix(old_x, old_P, old_weight, x, P, weight, turn)
    if not again:
        report[:] = math.nan
    if kind == 0:
        for m in range(count):
            predict(x[m], P[m], levels[m], walk, dt)
        if trace.shape[0]:
            trace[:, TRACE - 1] = 0.0
        report[11] = 0.0
        return
    for m in range(count):
        predict(x[m], P[m], levels[m], walk, dt)
        _expect(x[m], P[m], kind, z, view, constants, noise, work[m])
    if not again:
        _judge(kind, z, noise, work, report, gated)
    best = -math.inf
    for m in range(count):
        work[m, 6, 12] = _absorb(x[m], P[m], kind, noise, work[m], gated, trace)
        best = max(best, work[m, 6, 12])
    report[11] = settle_weights(weight, work[:, 6, 12]) if count > 1 else best
    if not again:
        _tell(kind, weight, work, report)
