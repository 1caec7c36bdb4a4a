"""One event, a picture or an IMU sample: what a state expects of its readings, gates, and the update.

Both filters go through here. Each scalar reading z = h(x) + noise updates a state x with covariance P,

    p = P H',  S = H p + R,  x += p y / S,  P -= p p' / S

with y = z - h(x0) - H (x - x0), linearised at the state x0 before the event's first reading. For one scalar
and this gain Joseph's form is the same thing: its remainder p - K S is zero term by term. P is kept symmetric
to the last bit. The readings of an event act on the P H' of those that follow one after the other, and on P
together at the end. A rounded pixel enters as its equivalent Gaussian reading (`sensors.update_terms`).

A reading is gated by the chi-square of its whole sensor, in that level of a bank that expects it best; a
gated one changes nothing. What is considered and not learnt (Schmidt 1966) has its uncertainty in P and its
correlations with the motion are, but readings do not change it.
"""

from __future__ import annotations

import math

from calib.core.arrays import FloatArray
from calib.core.compilation import kernel
from calib.stages.estimator.sensors import GRAVITY_MPS2, accelerometer, gyroscope, marker, update_terms

CAMERA, IMU = 1, 2
"""Kinds of events; a picture has the readings (u, v), a sample (a_x, a_y, g_z), NaN where missing."""

NOISE = {
    "jitter_px": 0.3, "grid_px": 1.0, "accel_x_mps2": 0.0158, "accel_y_mps2": 0.0158, "gyro_radps": 0.0026,
    "accel_share": 0.002, "camera_stamp_s": 5e-5, "imu_stamp_s": 5e-5, "camera_gate": 20.0,
    "accel_gate": 30.0, "gyro_gate": 25.0,
}  # fmt: skip
"""Usual standard deviations of the readings and chi-square limits of the sensors, in the order of `noise`."""

REPORT = (
    "nis_camera", "nis_accel", "nis_gyro", "e_u", "e_v", "e_ax", "e_ay", "e_gz", "gated_camera",
    "gated_accel", "gated_gyro", "log_likelihood",
)  # fmt: skip
"""What an event says of itself; e are innovations over their standard deviation. NaN: not sampled."""

GATE, PAIR, E_FIRST, E_SECOND, GYRO, E_GYRO, LOG_LIKELIHOOD = range(7)
"""What a level says of an event: chi-square of the first two readings for the gate and as it is, these over
their deviations, the same of the gyroscope, and the log likelihood of what was used."""

TELLING = 9.0
"""A rate or acceleration below three deviations (squared) tells nothing of what it multiplies."""

_MARGIN_PX2 = 0.25
"""Added to the variance for gating: half a pixel of motion that no level expects is no outlier."""


_SWING_RADPS = 25.0


@kernel(arrays=False, inlined=True)
def stamp_variance(kind: int, noise: FloatArray, z: FloatArray) -> float:
    """Variance [s^2] of an event's time: that of its clock z[3], at least what is usual."""
    return float(max(noise[6 if kind == CAMERA else 7] ** 2, z[3]))


@kernel(arrays=False, inlined=True)
def accel_variance(noise: FloatArray, stamp: float, rate: float, moved: float) -> float:
    """Variance of what is felt of a head that turns at a rate and is `moved` [m^2/s^4], squared.

    Errors of scale are a share of that. In a swing at `_SWING_RADPS` it changes in a second by as many times
    itself, and gravity turns by the rate.
    """
    turning = GRAVITY_MPS2 * GRAVITY_MPS2 * rate * rate + _SWING_RADPS * _SWING_RADPS * moved
    return float(noise[5] * noise[5] * moved + stamp * turning)


@kernel(arrays=False)
def camera_terms(
    view: FloatArray, noise: FloatArray, stamp: float, x: FloatArray, P: FloatArray, H: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Predicted pixel out[0:2] and variances of its noise out[3:5], without the grid's.

    Parameters
    ----------
    stamp : variance [s^2] of the picture's time. x : (20,) of head and sensors. H : (2, 20) or more rows,
        gets the gradients. P : covariance of a state whose rates are at 2 and 3.
    """
    out[0], out[1] = marker(view, x, H[0], H[1])
    for k in range(2):
        speed = H[k, 0] * x[2] + H[k, 1] * x[3]
        out[3 + k] = noise[0] * noise[0] + speed * speed * stamp
        if speed * speed < TELLING * (H[k, 0] ** 2 * P[2, 2] + H[k, 1] ** 2 * P[3, 3]):
            H[k, 13] = 0.0


@kernel(arrays=False)
def imu_terms(
    noise: FloatArray, stamp: float, x: FloatArray, P: FloatArray, H: FloatArray, out: FloatArray
) -> None:
    """Predicted a_x, a_y, g_z and variances of their noise, for a state (20,) that holds its accelerations.

    `stamp` is the variance [s^2] of the sample's time.

    Length and lever act on the accelerometer through ddphi, which is estimated from the same readings; errors
    in what multiplies them would pass for knowledge and pull the length by a millimetre at rest. So they go
    into the noise. For the same reason the gyroscope's scale is learnt only from rates that tell.
    """
    out[0], out[1] = accelerometer(x, H[0], H[1])
    out[2] = gyroscope(x, H[2])
    if x[2] * x[2] < TELLING * P[2, 2]:
        H[2, 10] = 0.0
    tilt = x[0] + x[9]
    moved_x = out[0] - x[7] - GRAVITY_MPS2 * math.cos(tilt)
    moved_y = out[1] - x[8] - GRAVITY_MPS2 * math.sin(tilt)
    scale = accel_variance(noise, stamp, x[2], moved_x * moved_x + moved_y * moved_y)
    for k in range(2):
        unknown = H[k, 1] * H[k, 1] * P[1, 1] + H[k, 11] * H[k, 11] * P[11, 11]
        out[3 + k] = noise[2 + k] * noise[2 + k] + scale + unknown
        H[k, 1], H[k, 11] = 0.0, 0.0
    out[5] = noise[4] * noise[4] + x[4] * x[4] * stamp


@kernel(arrays=False, inlined=True)
def project(P: FloatArray, H: FloatArray, p: FloatArray, at: FloatArray, n: int) -> float:
    """p = P H' and H P H'.

    Parameters
    ----------
    at : (n,) gets the places at which H is not zero and last of all their number, at most n - 4.
    n : length of the state, a constant of the caller's: loops whose length is known take half the time.
    """
    count = 0
    for k in range(n):
        if H[k] != 0.0:
            at[count] = k
            count += 1
        p[k] = 0.0
    at[count], at[count + 1], at[count + 2], at[n - 1] = 0.0, 0.0, 0.0, count
    # Four rows at a time; what stands after the last one counts nothing.
    for first in range(0, count, 4):
        a, b, c, d = int(at[first]), int(at[first + 1]), int(at[first + 2]), int(at[first + 3])
        ha, hb = H[a], H[b] if first + 1 < count else 0.0
        hc, hd = H[c] if first + 2 < count else 0.0, H[d] if first + 3 < count else 0.0
        for j in range(n):
            p[j] = p[j] + ha * P[a, j] + hb * P[b, j] + hc * P[c, j] + hd * P[d, j]
    return dot(H, p, at, n)


@kernel(arrays=False, inlined=True)
def dot(H: FloatArray, p: FloatArray, at: FloatArray, n: int) -> float:
    """H p over the places at which H is not zero."""
    total = 0.0
    for k in range(int(at[n - 1])):
        i = int(at[k])
        total += H[i] * p[i]
    return total


@kernel(arrays=False)
def update(
    x: FloatArray, P: FloatArray, innovation: float, S: float, p: FloatArray, learnt: FloatArray
) -> None:
    """Update in place by an innovation with variance S; p = P H' becomes p / sqrt(S).

    `learnt` is 1 for the entries of a state that readings change, 0 for those that are considered.
    """
    n = P.shape[0]
    root = 1.0 / math.sqrt(S)
    for j in range(n):
        p[j] *= root
    move = innovation * root
    for i in range(n):
        gain = p[i]
        if learnt[i] == 0.0:
            for j in range(n):
                P[i, j] -= gain * learnt[j] * p[j]
            continue
        x[i] += gain * move
        for j in range(n):
            P[i, j] -= gain * p[j]


@kernel(arrays=False)
def leave(trace: FloatArray, row: int, H: FloatArray, p: FloatArray, innovation: float, S: float) -> None:
    """Write what a reading did for the smoother: H (n), P H' / S (n), y / S and 1 / S; p as of `update`.

    The last is 0 where there was no reading. A trace without rows takes nothing.
    """
    if trace.shape[0] == 0:
        return
    n, root = trace.shape[1] // 2 - 1, 1.0 / math.sqrt(S)
    for j in range(n):
        trace[row, j], trace[row, n + j] = H[j], p[j] * root
    trace[row, 2 * n], trace[row, 2 * n + 1] = innovation / S, 1.0 / S


@kernel(arrays=False, inlined=True)
def chi_squares(
    kind: int, P: FloatArray, H: FloatArray, z: FloatArray, out: FloatArray, noise: FloatArray, e: FloatArray,
    p: FloatArray, at: FloatArray, told: FloatArray, n: int,
) -> None:  # fmt: skip
    """Innovations e (3,), p (3, n) = P H', out[6:9] = H P H', and what the event is worth into told (7,).

    at : (3, n), and n, as in `project`.
    """
    for k in range(2 if kind == CAMERA else 3):
        e[k] = z[k] - out[k]
        out[6 + k] = project(P, H[k], p[k], at[k], n)
    b = dot(H[1], p[0], at[1], n)
    grid = noise[1] * noise[1] / 12.0 if kind == CAMERA else 0.0
    a, c = out[6] + out[3] + grid, out[7] + out[4] + grid
    told[E_FIRST], told[E_SECOND] = e[0] / math.sqrt(a), e[1] / math.sqrt(c)
    told[PAIR] = (c * e[0] * e[0] - 2.0 * b * e[0] * e[1] + a * e[1] * e[1]) / (a * c - b * b)
    told[GATE] = told[PAIR]
    if kind == CAMERA:
        a, c = a + _MARGIN_PX2, c + _MARGIN_PX2
        told[GATE] = (c * e[0] * e[0] - 2.0 * b * e[0] * e[1] + a * e[1] * e[1]) / (a * c - b * b)
        return
    S = out[8] + out[5]
    told[E_GYRO], told[GYRO] = e[2] / math.sqrt(S), e[2] * e[2] / S


@kernel(arrays=False)
def judge(
    kind: int, z: FloatArray, told: FloatArray, noise: FloatArray, accel: bool, gated: FloatArray,
    report: FloatArray,
) -> None:  # fmt: skip
    """Which sensors of an event are gated, by the level of told (M, 7) that expects them best.

    Parameters
    ----------
    accel : whether the accelerometer may be used.
    gated : (3,) 1 where camera, accelerometer or gyroscope is not used.
    """
    best, best_gyro = math.inf, math.inf
    for m in range(told.shape[0]):
        best, best_gyro = min(best, told[m, GATE]), min(best_gyro, told[m, GYRO])
    if kind == CAMERA:
        gated[0] = 0.0 if best < noise[8] else 1.0
        report[8] = gated[0]
        return
    gated[1], gated[2] = 1.0, 1.0
    if accel and not (math.isnan(z[0]) or math.isnan(z[1])):
        gated[1] = 0.0 if best < noise[9] else 1.0
        report[9] = gated[1]
    if not math.isnan(z[2]):
        gated[2] = 0.0 if best_gyro < noise[10] else 1.0
        report[10] = gated[2]


@kernel(arrays=False)
def tell(kind: int, weights: FloatArray, told: FloatArray, report: FloatArray) -> None:
    """Innovations of a judged event in the report, those of each level weighed as after the event."""
    pair, gyro, e0, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(told.shape[0]):
        w = weights[m]
        pair, e0, e1 = pair + w * told[m, PAIR], e0 + w * told[m, E_FIRST], e1 + w * told[m, E_SECOND]
        gyro, e2 = gyro + w * told[m, GYRO], e2 + w * told[m, E_GYRO]
    if kind == CAMERA:
        report[0], report[3], report[4] = pair, e0, e1
        return
    if not math.isnan(report[9]):
        report[1], report[5], report[6] = pair, e0, e1
    if not math.isnan(report[10]):
        report[2], report[7] = gyro, e2


@kernel(arrays=False, inlined=True)
def absorb(
    kind: int, x: FloatArray, P: FloatArray, H: FloatArray, e: FloatArray, out: FloatArray,
    noise: FloatArray, gated: FloatArray, learnt: FloatArray, p: FloatArray, at: FloatArray,
    trace: FloatArray, n: int,
) -> float:  # fmt: skip
    """Update by the readings that are not gated, one after the other; their log likelihood.

    Of a sample the gyroscope comes first: it is the most exact. e, out, p and `at` are of `chi_squares`, used
    up.
    """
    log_l, count = 0.0, 2 if kind == CAMERA else 3
    if kind == CAMERA:
        for i in range(n):
            p[2, i] = 0.0
    for order in range(count):
        # (0, 1) of a picture, (2, 0, 1) of a sample.
        k = order if count == 2 else (order + 2) % 3
        if gated[0 if kind == CAMERA else 2 if k == 2 else 1] != 0.0:
            for i in range(n):
                p[k, i] = 0.0
            continue
        spread, y = max(out[6 + k], 0.0), e[k]
        S = spread + out[3 + k]
        if kind == CAMERA:
            y, S, log_z = update_terms(y, spread, out[3 + k], noise[1])
        else:
            log_z = -0.5 * (y * y / S + math.log(2.0 * math.pi * S))
        log_l += log_z
        root = 1.0 / math.sqrt(S)
        move = y * root
        for i in range(n):
            p[k, i] *= root
            x[i] += learnt[i] * p[k, i] * move
        leave(trace, order, H[k], p[k], y, S)
        for after in range(order + 1, count):
            other, by_learnt, by_held = after - 1 if count == 3 else after, 0.0, 0.0
            for q in range(int(at[other, n - 1])):
                i = int(at[other, q])
                by = H[other, i] * p[k, i]
                by_learnt += learnt[i] * by
                by_held += (1.0 - learnt[i]) * by
            for i in range(n):
                p[other, i] -= p[k, i] * (by_learnt + learnt[i] * by_held)
            e[other] -= by_learnt * move
            out[6 + other] -= by_learnt * (by_learnt + 2.0 * by_held)
    for i in range(P.shape[0]):
        a, b, c = p[0, i], p[1, i], p[2, i]
        if learnt[i] == 0.0:
            for j in range(n):
                P[i, j] -= learnt[j] * (a * p[0, j] + b * p[1, j] + c * p[2, j])
        else:
            for j in range(n):
                P[i, j] -= a * p[0, j] + b * p[1, j] + c * p[2, j]
    return log_l
