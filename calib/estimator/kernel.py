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

from numba import njit

from calib.arrays import FloatArray
from calib.estimator.model import mix, predict, settle_weights
from calib.estimator.rounding import update_terms
from calib.estimator.sensors import accelerometer, gyroscope, marker

__all__ = [
    "CAMERA",
    "CONSIDERED",
    "IMU",
    "NOISE",
    "REPORT",
    "camera_terms",
    "event",
    "imu_terms",
    "scalar_update",
]

CONSIDERED = (11, 12, 14, 15, 16)
"""Entries of the state that readings do not change; `scalar_update` has them written out."""

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
        if i == 11 or i == 12 or 14 <= i <= 16:
            for j in range(11):
                P[i, j] -= gain * p[j]
            P[i, 13] -= gain * p[13]
            P[i, 17] -= gain * p[17]
            P[i, 18] -= gain * p[18]
            continue
        x[i] += gain * move
        # p_i p_j is the same product on both sides of the diagonal, so P stays symmetric.
        for j in range(n):
            P[i, j] -= gain * p[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _project(P: FloatArray, H: FloatArray, p: FloatArray) -> float:
    """p = P H' and H P H'."""
    n = H.shape[0]
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
    return total


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


@njit(cache=True, nogil=True, error_model="numpy")
def _pair(
    P: FloatArray, H: FloatArray, work: FloatArray, m: int, e0: float, e1: float, r0: float, r1: float
) -> float:
    """Chi-square of two readings together in level m; it and both innovations go to `work`."""
    p = work[0]
    a = _project(P, H[0], p) + r0
    b = 0.0
    for k in range(H.shape[1]):
        b += H[1, k] * p[k]
    c = _project(P, H[1], p) + r1
    work[8, m], work[10, m], work[11, m] = (
        (c * e0 * e0 - 2.0 * b * e0 * e1 + a * e1 * e1) / (a * c - b * b),
        e0 / math.sqrt(a),
        e1 / math.sqrt(c),
    )
    return float(work[8, m])


@njit(cache=True, nogil=True, error_model="numpy")
def _tell(kind: int, weight: FloatArray, work: FloatArray, report: FloatArray) -> None:
    """Innovations in the report, those of each level weighted as after the event."""
    pair, gyro, e0, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(weight.shape[0]):
        pair += weight[m] * work[8, m]
        gyro += weight[m] * work[9, m]
        e0 += weight[m] * work[10, m]
        e1 += weight[m] * work[11, m]
        e2 += weight[m] * work[12, m]
    if kind == CAMERA:
        report[0], report[3], report[4] = pair, e0, e1
        return
    if not math.isnan(report[9]):
        report[1], report[5], report[6] = pair, e0, e1
    if not math.isnan(report[10]):
        report[2], report[7] = gyro, e2


@njit(cache=True, nogil=True, error_model="numpy")
def _judge_camera(
    x: FloatArray, P: FloatArray, view: FloatArray, noise: FloatArray, z: FloatArray, H: FloatArray,
    work: FloatArray, report: FloatArray, gated: FloatArray,
) -> None:  # fmt: skip
    """Innovations of a picture, and whether it is gated."""
    out = work[2]
    variance = noise[0] * noise[0] + noise[1] * noise[1] / 12.0
    best = math.inf
    for m in range(x.shape[0]):
        camera_terms(view, noise, x[m], P[m], H, out)
        e0, e1 = z[0] - out[0], z[1] - out[1]
        r0, r1 = variance + out[2], variance + out[3]
        best = min(best, _pair(P[m], H, work, m, e0, e1, r0 + _MARGIN_PX2, r1 + _MARGIN_PX2))
        _pair(P[m], H, work, m, e0, e1, r0, r1)
    gated[0] = 0.0 if best < noise[8] else 1.0
    report[8] = gated[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _camera(
    x: FloatArray, P: FloatArray, view: FloatArray, noise: FloatArray, z: FloatArray, H: FloatArray,
    work: FloatArray, log_l: FloatArray,
) -> None:  # fmt: skip
    p, x0, out = work[0], work[1], work[2]
    jitter, grid = noise[0] * noise[0], noise[1]
    for m in range(x.shape[0]):
        camera_terms(view, noise, x[m], P[m], H, out)
        x0[:] = x[m]
        for k in range(2):
            spread = _project(P[m], H[k], p)
            moved = 0.0
            for i in range(x.shape[1]):
                moved += H[k, i] * (x[m, i] - x0[i])
            y, S, log_z = update_terms(z[k] - out[k] - moved, spread, jitter + out[2 + k], grid)
            log_l[m] += log_z
            scalar_update(x[m], P[m], y, S, p)


@njit(cache=True, nogil=True, error_model="numpy")
def _judge_imu(
    x: FloatArray, P: FloatArray, constants: FloatArray, noise: FloatArray, z: FloatArray, H: FloatArray,
    work: FloatArray, report: FloatArray, gated: FloatArray,
) -> None:  # fmt: skip
    """Innovations of an IMU sample, and which of its two sensors is gated or missing."""
    p, out = work[0], work[2]
    has_accel = not (math.isnan(z[0]) or math.isnan(z[1]))
    has_gyro = not math.isnan(z[2])
    best_accel, best_gyro = math.inf, math.inf
    for m in range(x.shape[0]):
        imu_terms(constants, noise, x[m], P[m], H, out)
        if has_gyro:
            S = _project(P[m], H[2], p) + out[5]
            e = z[2] - out[2]
            work[9, m], work[12, m] = e * e / S, e / math.sqrt(S)
            best_gyro = min(best_gyro, e * e / S)
        if has_accel:
            x_off, y_off = z[0] - out[0], z[1] - out[1]
            best_accel = min(best_accel, _pair(P[m], H, work, m, x_off, y_off, out[3], out[4]))
    gated[1], gated[2] = 1.0, 1.0
    if has_accel:
        gated[1] = 0.0 if best_accel < noise[9] else 1.0
        report[9] = gated[1]
    if has_gyro:
        gated[2] = 0.0 if best_gyro < noise[10] else 1.0
        report[10] = gated[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _imu(
    x: FloatArray, P: FloatArray, constants: FloatArray, noise: FloatArray, z: FloatArray, H: FloatArray,
    work: FloatArray, log_l: FloatArray, gated: FloatArray,
) -> None:  # fmt: skip
    p, x0, out = work[0], work[1], work[2]
    for m in range(x.shape[0]):
        imu_terms(constants, noise, x[m], P[m], H, out)
        x0[:] = x[m]
        for order in range(3):
            # The gyroscope first: it is the most exact.
            k = 2 if order == 0 else order - 1
            if gated[2 if k == 2 else 1] != 0.0:
                continue
            S = _project(P[m], H[k], p) + out[3 + k]
            y = z[k] - out[k]
            for i in range(x.shape[1]):
                y -= H[k, i] * (x[m, i] - x0[i])
            log_l[m] -= 0.5 * (y * y / S + math.log(2.0 * math.pi * S))
            scalar_update(x[m], P[m], y, S, p)


@njit(cache=True, nogil=True, error_model="numpy")
def event(
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
) -> None:
    """Carry the bank on to an event and update it, in place.

    Parameters
    ----------
    x, P, weight : (M, 19), (M, 19, 19), (M,).
    kind, z, dt : `CAMERA` or `IMU`, readings (3,), time since the last event [s].
    switch_hz, levels, walk : of `model.Kinematic`.
    view, constants, noise : camera (24,), gravity and lever across (2,), `NOISE` (11,).
    work : (13, 19) scratch. report : (12,) of `REPORT`, written to.
    again : whether the event is done once more; then `gated` holds.
    gated : (3,) 1 where camera, accelerometer or gyroscope is not used.
    """
    count = x.shape[0]
    if not again:
        report[:] = math.nan
    if count > 1 and dt > 0.0:
        turn = (1.0 - math.exp(-count * switch_hz * dt)) / count
        mix(x, P, weight, 1.0 - (count - 1) * turn, turn)
    for m in range(count):
        predict(x[m], P[m], levels[m], walk, dt)
    log_l = work[4, :count]
    log_l[:] = 0.0
    H = work[5:8]
    if kind == CAMERA:
        if not again:
            _judge_camera(x, P, view, noise, z, H, work, report, gated)
        if gated[0] == 0.0:
            _camera(x, P, view, noise, z, H, work, log_l)
    elif kind == IMU:
        if not again:
            _judge_imu(x, P, constants, noise, z, H, work, report, gated)
        _imu(x, P, constants, noise, z, H, work, log_l, gated)
    report[11] = settle_weights(weight, log_l) if count > 1 else log_l[0]
    if not again and kind != 0:
        _tell(kind, weight, work, report)
