"""One event of the driven filter: a picture, an IMU sample, or the certainty that the hoses are on.

The process is `driven_model`, the readings are those of `kernel`: pixels rounded as `rounding` has it,
linearised once per event, taken one after the other, gated by the chi-square of their sensor. The head's
accelerations, which the accelerometer feels, are what the dynamics say of the state, so their gradients
reach forces and parameters. What `kernel.CONSIDERED` names of the geometry is considered and not learnt.
"""

from __future__ import annotations

import math

from calib.arrays import FloatArray
from calib.estimator.compiled import compiled
from calib.estimator.driven_model import DRIVEN, DYNAMIC, INVOLVED, accelerations, carry, jacobian
from calib.estimator.rounding import update_terms
from calib.estimator.sensors import SIZE, accelerometer, gyroscope, marker

__all__ = [
    "CAMERA",
    "HOSES",
    "IMU",
    "LONGEST_S",
    "SETTLING_S",
    "WORK",
    "copy_state",
    "cut",
    "driven_event",
    "measure",
    "predict_driven",
]

CAMERA, IMU, HOSES = 1, 2, 4

LONGEST_S = 0.02
"""Longer steps are taken in parts."""

SIZE_D = len(DRIVEN)
WORK = (24, SIZE_D)
"""Shape of the scratch: p, x0, three gradients, terms, segments, accelerations, and F P."""

_TELLING = 9.0
_MARGIN_PX2 = 0.25
_SWING_RADPS = 25.0
_KNOWN_MPS = 3e-3
"""The accelerometer is left out until the length's rate is known so well."""
SETTLING_S = 0.3
"""For so long after a start it is left out too: it is not linear in what is not known yet."""
_MOST_SEGMENTS = 12
_SHIFT = INVOLVED - 6
"""The sensors' quantities stand this much further on than in `sensors`."""


@compiled()
def copy_state(to_x: FloatArray, to_P: FloatArray, x: FloatArray, P: FloatArray) -> None:
    """Copy a state and its covariance."""
    for i in range(x.shape[0]):
        to_x[i] = x[i]
        for j in range(x.shape[0]):
            to_P[i, j] = P[i, j]


@compiled()
def _update(x: FloatArray, P: FloatArray, innovation: float, S: float, p: FloatArray) -> None:
    """Update in place by an innovation with variance S; p = P H' is used up."""
    n = x.shape[0]
    root = 1.0 / math.sqrt(S)
    for j in range(n):
        p[j] *= root
    move = innovation * root
    for i in range(n):
        gain = p[i]
        # Lever, marker offset, shift and stretch of the plane.
        if i == 28 or i == 29 or 31 <= i <= 33:
            for j in range(28):
                P[i, j] -= gain * p[j]
            P[i, 30] -= gain * p[30]
            P[i, 34] -= gain * p[34]
            P[i, 35] -= gain * p[35]
            continue
        x[i] += gain * move
        for j in range(n):
            P[i, j] -= gain * p[j]


@compiled()
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


@compiled()
def cut(
    begin: float, end: float, switch_t: FloatArray, switch_g: FloatArray, last: int, segments: FloatArray
) -> int:
    """Segments of constant command between two times; returns their number.

    Parameters
    ----------
    switch_t, switch_g : ring of the times at which commands take effect and of their static forces.
    last : place of the newest. Before the oldest one the oldest holds.
    """
    size = switch_t.shape[0]
    back = 0
    while back < size - 1 and switch_t[(last - back) % size] > begin:
        back += 1
    count, now = 0, begin
    while True:
        at = (last - back) % size
        stop = end
        if back > 0 and count < _MOST_SEGMENTS - 1:
            stop = min(end, max(switch_t[(last - back + 1) % size], now))
        if stop > now or stop == end:
            segments[count, 0] = stop - now
            segments[count, 1], segments[count, 2] = switch_g[at, 0], switch_g[at, 1]
            count += 1
            now = stop
        if stop == end or back == 0:
            return count
        back -= 1


@compiled()
def predict_driven(
    x: FloatArray, P: FloatArray, begin: float, end: float, plant: FloatArray, walk: FloatArray,
    switch_t: FloatArray, switch_g: FloatArray, last: int, F: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """Carry a state on from one time to another, in place; F (12, 23) is that of the last part."""
    if not end > begin:
        return
    parts = max(math.ceil((end - begin) / LONGEST_S - 1e-9), 1)
    h = (end - begin) / parts
    segments, moved = work[8:12].reshape(-1)[: 3 * _MOST_SEGMENTS].reshape(_MOST_SEGMENTS, 3), work[6]
    for k in range(parts):
        count = cut(begin + k * h, begin + (k + 1) * h, switch_t, switch_g, last, segments)
        jacobian(plant, x, segments, count, moved, F)
        carry(P, F, walk, h, work[12:])
        for i in range(DYNAMIC):
            x[i] = moved[i]


@compiled()
def _spread_out(h: FloatArray, H: FloatArray) -> None:
    """A gradient (19,) by head and sensors as one by the driven state; accelerations are left out."""
    for k in range(4, INVOLVED):
        H[k] = 0.0
    for k in range(4):
        H[k] = h[k]
    for k in range(6, SIZE):
        H[k + _SHIFT] = h[k]


@compiled()
def measure(
    kind: int, x: FloatArray, P: FloatArray, plant: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, stamp: float, H: FloatArray, out: FloatArray, work: FloatArray,
) -> None:  # fmt: skip
    """Predicted readings out[0:3] and variances of their noise out[3:6]; H (3, 36) gets the gradients.

    `stamp` is the variance [s^2] of the event's time: what moves fast is not read where it was.
    """
    state = work[0, :SIZE]
    state[0], state[1], state[2], state[3], state[4], state[5] = x[0], x[1], x[2], x[3], 0.0, 0.0
    for k in range(6, SIZE):
        state[k] = x[k + _SHIFT]
    h0, h1 = work[1, :SIZE], work[7, :SIZE]
    if kind == CAMERA:
        out[0], out[1] = marker(view, state, h0, h1)
        _spread_out(h0, H[0])
        _spread_out(h1, H[1])
        for k in range(2):
            speed = H[k, 0] * x[2] + H[k, 1] * x[3]
            out[3 + k] = noise[0] * noise[0] + speed * speed * stamp
            if speed * speed < _TELLING * (H[k, 0] ** 2 * P[2, 2] + H[k, 1] ** 2 * P[3, 3]):
                H[k, 30] = 0.0
        return
    by_phi, by_length = work[8], work[9]
    state[4], state[5] = accelerations(plant, x, by_phi, by_length)
    out[0], out[1] = accelerometer(constants[0], constants[1], state, h0, h1)
    tilt = x[0] + x[26]
    moved_x = out[0] - x[24] - constants[0] * math.cos(tilt)
    moved_y = out[1] - x[25] - constants[0] * math.sin(tilt)
    moved = moved_x * moved_x + moved_y * moved_y
    # Of a swing at _SWING_RADPS the acceleration changes by so much in a second.
    turning = constants[0] * constants[0] * x[2] * x[2] + _SWING_RADPS * _SWING_RADPS * moved
    scale = noise[5] * noise[5] * moved + stamp * turning
    for k in range(2):
        h = h0 if k == 0 else h1
        _spread_out(h, H[k])
        for i in range(INVOLVED):
            H[k, i] += h[4] * by_phi[i] + h[5] * by_length[i]
        out[3 + k] = noise[2 + k] * noise[2 + k] + scale
    out[2] = gyroscope(state, h0)
    _spread_out(h0, H[2])
    if x[2] * x[2] < _TELLING * P[2, 2]:
        H[2, 27] = 0.0
    out[5] = noise[4] * noise[4] + state[4] * state[4] * stamp


@compiled()
def _chi_square(
    P: FloatArray, H: FloatArray, p: FloatArray, first: int, e: FloatArray, r: FloatArray, more: float
) -> tuple[float, float, float]:
    """Chi-square of two readings together, and the deviations of both."""
    a = _project(P, H[first], p) + r[first] + more
    b = 0.0
    for k in range(H.shape[1]):
        b += H[first + 1, k] * p[k]
    c = _project(P, H[first + 1], p) + r[first + 1] + more
    e0, e1 = e[first], e[first + 1]
    total = (c * e0 * e0 - 2.0 * b * e0 * e1 + a * e1 * e1) / (a * c - b * b)
    return total, math.sqrt(a), math.sqrt(c)


@compiled()
def driven_event(
    x: FloatArray, P: FloatArray, kind: int, z: FloatArray, plant: FloatArray, view: FloatArray,
    constants: FloatArray, noise: FloatArray, work: FloatArray, again: bool, report: FloatArray,
    gated: FloatArray,
) -> None:  # fmt: skip
    """Update a predicted state by an event, in place.

    Parameters
    ----------
    kind, z : `CAMERA`, `IMU` or `HOSES` and (4,) its readings, NaN where missing, and the variance of its
        time [s^2]; of `HOSES` the deviation that the damping then has.
    plant : (22,). view, constants, noise : as in `kernel.event`.
    work : scratch of the shape `WORK`. report : (12,) of `kernel.REPORT`, written to.
    again : whether the event is done once more; then `gated` (3,) holds.
    """
    if not again:
        for k in range(report.shape[0]):
            report[k] = math.nan
    log_l = 0.0
    stamp = max(noise[6 if kind == CAMERA else 7] ** 2, z[3])
    H, p, out, e = work[2:5], work[0], work[5], work[10]
    if kind == HOSES:
        for k in range(x.shape[0]):
            p[k] = P[k, 13]
        _update(x, P, -x[13], P[13, 13] + z[0] * z[0], p)
    elif kind == CAMERA:
        measure(kind, x, P, plant, view, constants, noise, stamp, H, out, work)
        e[0], e[1] = z[0] - out[0], z[1] - out[1]
        grid = noise[1] * noise[1] / 12.0
        if not again:
            gate, _, _ = _chi_square(P, H, p, 0, e, out[3:6], grid + _MARGIN_PX2)
            report[0], s0, s1 = _chi_square(P, H, p, 0, e, out[3:6], grid)
            report[3], report[4] = e[0] / s0, e[1] / s1
            gated[0] = 0.0 if gate < noise[8] else 1.0
            report[8] = gated[0]
        if gated[0] == 0.0:
            x0 = work[1]
            for k in range(x.shape[0]):
                x0[k] = x[k]
            for k in range(2):
                spread = _project(P, H[k], p)
                moved = 0.0
                for i in range(x.shape[0]):
                    moved += H[k, i] * (x[i] - x0[i])
                y, S, log_z = update_terms(e[k] - moved, spread, out[3 + k], noise[1])
                log_l += log_z
                _update(x, P, y, S, p)
    elif kind == IMU:
        measure(kind, x, P, plant, view, constants, noise, stamp, H, out, work)
        for k in range(3):
            e[k] = z[k] - out[k]
        if not again:
            gated[1], gated[2] = 1.0, 1.0
            known = P[3, 3] < _KNOWN_MPS * _KNOWN_MPS
            if known and not (math.isnan(z[0]) or math.isnan(z[1])):
                report[1], s0, s1 = _chi_square(P, H, p, 0, e, out[3:6], 0.0)
                report[5], report[6] = e[0] / s0, e[1] / s1
                gated[1] = 0.0 if report[1] < noise[9] else 1.0
                report[9] = gated[1]
            if not math.isnan(z[2]):
                S = _project(P, H[2], p) + out[5]
                report[2], report[7] = e[2] * e[2] / S, e[2] / math.sqrt(S)
                gated[2] = 0.0 if report[2] < noise[10] else 1.0
                report[10] = gated[2]
        x0 = work[1]
        for k in range(x.shape[0]):
            x0[k] = x[k]
        for order in range(3):
            k = 2 if order == 0 else order - 1
            if gated[2 if k == 2 else 1] != 0.0:
                continue
            S = _project(P, H[k], p) + out[3 + k]
            y = e[k]
            for i in range(x.shape[0]):
                y -= H[k, i] * (x[i] - x0[i])
            log_l -= 0.5 * (y * y / S + math.log(2.0 * math.pi * S))
            _update(x, P, y, S, p)
    report[11] = log_l


assert SIZE_D == 36
