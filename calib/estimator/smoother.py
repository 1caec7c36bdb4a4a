"""The smoother: every state from the whole log, forward and backward, with a covariance of its own.

1. The bank runs over the events in the order of their times, pictures at their exposure, and leaves its
   weights; these are smoothed backwards (Kim 1994, eq. 2.20),
       w_k|N(i) = w_k|k(i) sum_j pi_ij w_k+1|N(j) / w_k+1|k(j).
2. One filter with the process noise that these weights mix runs forward. Readings that the bank has
   gated stay out.
3. Rauch, Tung and Striebel (1965) backwards: with P' = F P F' + Q
       C = P F' P'^-1,   x_N += C (x_N+1 - F x),   P_N += C (P_N+1 - P') C'.

Rows of the output are events without a reading. P' is scaled by its diagonal before it is factorised: a
state holds accelerations of the angle next to micrometres.

The backward pass begins anew every `WINDOW` events, from events `OVERLAP` further on, so that memory does not
grow with the log; what is constant over the log is then known from all before and the overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from calib.arrays import FloatArray, IntArray
from calib.estimator.clock import even_times, new_clock
from calib.estimator.filter import starting_state, write_columns
from calib.estimator.kernel import event
from calib.estimator.model import LARGEST_STEP_S, axis_transition, predict
from calib.estimator.sensors import SIZE
from calib.estimator.setup import OUT, Rows, Setup

__all__ = ["OVERLAP", "WINDOW", "Events", "events_of", "forward_bank", "smooth", "transition"]

WINDOW, OVERLAP = 12_000, 3_000


@dataclass(frozen=True)
class Events:
    """Everything that happens in a log, in the order of time.

    Attributes
    ----------
    t_s : (n,). kinds : (n,) 0 for a row of the output, else of `kernel`. readings : (n, 3).
    rows : (n,) the row of the log.
    """

    t_s: FloatArray
    kinds: IntArray
    readings: FloatArray
    rows: IntArray


def events_of(setup: Setup, rows: Rows, outputs: bool = True) -> Events:
    """Events of a log: pictures at their exposure, IMU samples, and the rows' own stamps.

    Stamps run through the clocks, which do not look ahead.
    """
    camera, imu = np.nonzero(rows.kinds & 1)[0], np.nonzero(rows.kinds & 2)[0]
    exposed = even_times(new_clock(setup.camera_period_s), rows.t_s[camera])
    exposed = exposed - max(float(setup.start.sensor[7]), 0.0)
    taken = even_times(new_clock(setup.imu_period_s), rows.t_s[imu])
    seen = np.isfinite(rows.readings[camera, :2]).all(axis=1)
    camera, exposed = camera[seen], exposed[seen]
    pixels = np.full((len(camera), 3), np.nan)
    pixels[:, :2] = rows.readings[camera, :2]
    every = np.arange(len(rows)) if outputs else np.zeros(0, dtype=np.int64)
    t = np.concatenate([exposed, taken, rows.t_s[every]])
    kinds = np.repeat([1, 2, 0], [len(camera), len(imu), len(every)])
    readings = np.concatenate([pixels, rows.readings[imu, 2:], np.full((len(every), 3), np.nan)])
    order = np.argsort(t, kind="stable")
    return Events(t[order], kinds[order], readings[order], np.concatenate([camera, imu, every])[order])


@njit(cache=True, nogil=True, error_model="numpy")
def forward_bank(
    t: FloatArray, kinds: IntArray, readings: FloatArray, x: FloatArray, P: FloatArray, w: FloatArray,
    switch_hz: float, levels: FloatArray, walk: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, weights: FloatArray, gated: FloatArray,
) -> float:  # fmt: skip
    """The bank over all events, in place; weights (n, M) and what was gated (n, 3); log likelihood."""
    work, report = np.zeros((13, x.shape[1])), np.empty(12)
    total = 0.0
    for k in range(len(t)):
        dt = t[k] - t[k - 1] if k else 0.0
        event(
            x, P, w, kinds[k], readings[k], dt, switch_hz, levels, walk, view, constants, noise, work, False,
            report, gated[k],
        )  # fmt: skip
        weights[k] = w
        total += report[11]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_weights(t: FloatArray, switch_hz: float, weights: FloatArray) -> None:
    """Kim's backward pass over the weights (n, M), in place."""
    n, count = weights.shape
    ratio = np.empty(count)
    for k in range(n - 2, -1, -1):
        turn = (1.0 - math.exp(-count * switch_hz * (t[k + 1] - t[k]))) / count
        stay = 1.0 - (count - 1) * turn
        for j in range(count):
            ahead = 0.0
            for i in range(count):
                ahead += weights[k, i] * (stay if i == j else turn)
            ratio[j] = weights[k + 1, j] / max(ahead, 1e-300)
        total = 0.0
        for i in range(count):
            factor = 0.0
            for j in range(count):
                factor += (stay if i == j else turn) * ratio[j]
            weights[k, i] *= factor
            total += weights[k, i]
        for i in range(count):
            weights[k, i] /= total


@njit(cache=True, nogil=True, error_model="numpy")
def transition(level: FloatArray, dt: float, F: FloatArray) -> None:
    """F (n, n) of `model.predict` over dt [s]."""
    n = F.shape[0]
    F[:] = 0.0
    for i in range(n):
        F[i, i] = 1.0
    if not dt > 0.0:
        return
    parts = max(math.ceil(dt / LARGEST_STEP_S - 1e-9), 1)
    for axis in range(2):
        f01, f02, f11, f12, f22 = axis_transition(level[4 * axis], level[4 * axis + 1], dt / parts)
        p, v, a = axis, axis + 2, axis + 4
        for _ in range(parts):
            for j in (p, v, a):
                F[p, j] += f01 * F[v, j] + f02 * F[a, j]
                F[v, j] = f11 * F[v, j] + f12 * F[a, j]
                F[a, j] = f22 * F[a, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _forward(
    t: FloatArray, before_s: float, kinds: IntArray, readings: FloatArray, level: FloatArray,
    gated: FloatArray, x: FloatArray, P: FloatArray, walk: FloatArray, view: FloatArray,
    constants: FloatArray, noise: FloatArray, kept_x: FloatArray, kept_P: FloatArray,
) -> None:  # fmt: skip
    """One filter with the mixed levels (n, 8) over events, keeping all states."""
    work, report, one = np.zeros((13, x.shape[1])), np.empty(12), np.ones(1)
    for k in range(len(t)):
        dt = t[k] - (t[k - 1] if k else before_s)
        event(
            x, P, one, kinds[k], readings[k], dt, 0.0, level[k : k + 1], walk, view, constants, noise, work,
            True, report, gated[k],
        )  # fmt: skip
        kept_x[k], kept_P[k] = x[0], P[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _backward(
    t: FloatArray, level: FloatArray, walk: FloatArray, kept_x: FloatArray, kept_P: FloatArray
) -> None:
    """Rauch, Tung and Striebel over the kept states, in place."""
    n = kept_x.shape[1]
    F, ahead_x, ahead_P, scale = np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n)
    for k in range(len(t) - 2, -1, -1):
        dt = t[k + 1] - t[k]
        transition(level[k + 1], dt, F)
        ahead_x[:], ahead_P[:] = kept_x[k], kept_P[k]
        predict(ahead_x, ahead_P, level[k + 1], walk, dt)
        for i in range(n):
            scale[i] = 1.0 / math.sqrt(ahead_P[i, i])
        normal = np.empty((n, n))
        for i in range(n):
            for j in range(n):
                normal[i, j] = ahead_P[i, j] * scale[i] * scale[j]
            normal[i, i] += 1e-13
        cross = F @ kept_P[k]
        for i in range(n):
            for j in range(n):
                cross[i, j] *= scale[i]
        gain = np.linalg.solve(normal, cross).T
        move, change = np.empty(n), np.empty((n, n))
        for i in range(n):
            move[i] = (kept_x[k + 1, i] - ahead_x[i]) * scale[i]
            for j in range(n):
                change[i, j] = (kept_P[k + 1, i, j] - ahead_P[i, j]) * scale[i] * scale[j]
        kept_x[k] += gain @ move
        added = gain @ change @ gain.T
        for i in range(n):
            for j in range(n):
                kept_P[k, i, j] += 0.5 * (added[i, j] + added[j, i])
            kept_P[k, i, i] = max(kept_P[k, i, i], 1e-24)


def smooth(setup: Setup, rows: Rows, outputs: FloatArray) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) at the rows' stamps.

    Parameters
    ----------
    outputs : (n, len(OUT)) of the filter on the same rows; what it says of innovations and flags is kept.
    """
    events = events_of(setup, rows)
    levels, walk = setup.process.arrays()
    constants = np.array([setup.gravity_mps2, setup.lever_across_m])
    x, P, w = starting_state(setup, rows)
    n, count = len(events.t_s), len(levels)
    weights, gated = np.empty((n, count)), np.zeros((n, 3))
    common = (walk, setup.view, constants, setup.noise)
    bank_x, bank_P = x.copy(), P.copy()
    forward_bank(
        events.t_s, events.kinds, events.readings, bank_x, bank_P, w, setup.process.switch_hz, levels,
        *common, weights, gated,
    )  # fmt: skip
    _smooth_weights(events.t_s, setup.process.switch_hz, weights)
    mixed = weights @ levels
    out = outputs.copy()
    one_x, one_P = x[:1].copy(), P[:1].copy()
    begin, before = 0, float(events.t_s[0]) if n else 0.0
    while begin < n:
        end = min(begin + WINDOW, n)
        stop = min(end + OVERLAP, n)
        part = slice(begin, stop)
        kept_x, kept_P = np.empty((stop - begin, SIZE)), np.empty((stop - begin, SIZE, SIZE))
        _forward(
            events.t_s[part], before, events.kinds[part], events.readings[part], mixed[part], gated[part],
            one_x, one_P, *common, kept_x, kept_P,
        )  # fmt: skip
        at_end = end - begin - 1
        one_x[0], one_P[0] = kept_x[at_end], kept_P[at_end]
        _backward(events.t_s[part], mixed[part], walk, kept_x, kept_P)
        own = np.nonzero(events.kinds[begin:end] == 0)[0]
        write_columns(
            kept_x[own], kept_P[own], mixed[begin:end][own], events.rows[begin:end][own],
            setup.bellows_radius_m, out,
        )  # fmt: skip
        before = float(events.t_s[end - 1])
        begin = end
    out[:, OUT.index("rest_weight")] = _of_rows(events, weights[:, 0], len(rows))
    out[:, OUT.index("swing_weight")] = _of_rows(events, weights[:, -1], len(rows))
    return out


def _of_rows(events: Events, values: FloatArray, count: int) -> FloatArray:
    own = events.kinds == 0
    out = np.zeros(count)
    out[events.rows[own]] = values[own]
    return out
