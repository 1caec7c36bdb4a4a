"""The driven smoother: forward with the commands, backward by Rauch, Tung and Striebel (1965).

Events stand in the order of their times as in `smoother`, pictures at their exposure. With the transition F
of `driven_model.jacobian`, its noise Q, P' = F P F' + Q and C = P F' P'^-1

    x_N += C (x_N+1 - x'),   P_N += C (P_N+1 - P') C'.

Only twelve of the states move, the others are carried over as they are. Where the forward filter starts
again the chain is cut: what comes later says nothing of what was before. The backward pass begins anew every
`WINDOW` events, from events `OVERLAP` further on.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.estimator.clock import even_times, new_clock
from calib.estimator.driven_filter import begin_again, sound, write_row
from calib.estimator.driven_kernel import (
    CAMERA,
    HOSES,
    IMU,
    LONGEST_S,
    SETTLING_S,
    WORK,
    driven_event,
    predict_driven,
)
from calib.estimator.driven_model import DRIVEN, DYNAMIC, INVOLVED, carry
from calib.estimator.driven_setup import Drive, commands
from calib.estimator.setup import Rows, Setup
from calib.estimator.smoother import events_of

__all__ = ["smooth_driven"]

WINDOW, OVERLAP = 6000, 3000
_BEFORE_S, _LOCKED_OUT = 0.03, 5.5
_STARTED, _PENDING, _HOSES = range(3)


@njit(cache=True, nogil=True, error_model="numpy")
def _forward(
    t: FloatArray, before_s: float, first_s: float, kinds: IntArray, readings: FloatArray, x: FloatArray,
    P: FloatArray, whole: IntArray, rejected: FloatArray, switch_t: FloatArray, switch_g: FloatArray,
    x0: FloatArray, P0: FloatArray, plant: FloatArray, walk: FloatArray, view: FloatArray,
    constants: FloatArray, noise: FloatArray, kept_x: FloatArray, kept_P: FloatArray, ahead: FloatArray,
    F: FloatArray, chained: BoolArray, alive: BoolArray, keep: int, hoses_sigma: float,
) -> None:  # fmt: skip
    """The filter over events, keeping all states; those of the event `keep` and its counters are left."""
    work, report, gated = np.zeros(WORK), np.empty(12), np.zeros(3)
    own_x, own_P, counters, marks = x.copy(), P.copy(), rejected.copy(), whole.copy()
    last = 0
    for k in range(len(t)):
        begin = t[k - 1] if k else before_s
        while last < len(switch_t) - 1 and switch_t[last + 1] <= t[k]:
            last += 1
        F[k] = 0.0
        chained[k] = False
        if whole[_STARTED] == 1:
            for i in range(DYNAMIC):
                F[k, i, i] = 1.0
            predict_driven(x, P, begin, t[k], plant, walk, switch_t, switch_g, last, F[k], work)
            chained[k] = True
        ahead[k] = x[:DYNAMIC]
        kind, z = kinds[k], readings[k]
        if kind == HOSES:
            whole[_HOSES] = 1
        waits = (whole[_STARTED] == 0 or whole[_PENDING] == 1) and t[k] > first_s + _BEFORE_S
        if waits and kind == CAMERA and begin_again(x, P, x0, P0, view, z[0], z[1]):
            whole[_STARTED], whole[_PENDING] = 1, 0
            chained[k] = False
            rejected[2] = t[k]
            if whole[_HOSES] == 1:
                x[13], P[13, 13] = 0.0, hoses_sigma * hoses_sigma
        if kind == IMU and t[k] < rejected[2] + SETTLING_S:
            z[0], z[1] = math.nan, math.nan
        if whole[_STARTED] == 1 and kind != 0:
            driven_event(x, P, kind, z, plant, view, constants, noise, work, False, report, gated)
            for i in range(3):
                if report[8 + i] == 1.0:
                    rejected[min(i, 1)] += 1.0
                elif report[8 + i] == 0.0:
                    rejected[min(i, 1)] *= 0.7
            if not sound(x, P):
                x[:], P[:] = x0, P0
                chained[k] = False
                whole[_PENDING] = 1
            elif rejected[0] > _LOCKED_OUT or rejected[1] > 2.0 * _LOCKED_OUT:
                whole[_PENDING] = 1
                rejected[:2] = 0.0
        kept_x[k], kept_P[k] = x, P
        alive[k] = whole[_STARTED] == 1
        if k == keep:
            own_x[:], own_P[:], counters[:], marks[:] = x, P, rejected, whole
    x[:], P[:], rejected[:], whole[:] = own_x, own_P, counters, marks


@njit(cache=True, nogil=True, error_model="numpy")
def _backward(
    t: FloatArray, walk: FloatArray, F: FloatArray, ahead: FloatArray, chained: BoolArray, kept_x: FloatArray,
    kept_P: FloatArray,
) -> None:  # fmt: skip
    """Over the kept states, in place."""
    n = kept_x.shape[1]
    normal, cross, FP = np.empty((n, n)), np.empty((n, n)), np.empty((DYNAMIC, n))
    P, scale, move, change = np.empty((n, n)), np.empty(n), np.empty(n), np.empty((n, n))
    for k in range(len(t) - 2, -1, -1):
        if not chained[k + 1] or not t[k + 1] > t[k]:
            if chained[k + 1]:
                kept_x[k], kept_P[k] = kept_x[k + 1], kept_P[k + 1]
            continue
        G = F[k + 1]
        P[:] = kept_P[k]
        carry(P, G, walk, t[k + 1] - t[k], FP)
        # FP is F P of the moving part; below it P itself.
        for i in range(n):
            scale[i] = 1.0 / math.sqrt(P[i, i])
        for i in range(n):
            for j in range(n):
                normal[i, j] = P[i, j] * scale[i] * scale[j]
                cross[i, j] = (FP[i, j] if i < DYNAMIC else kept_P[k, i, j]) * scale[i]
            normal[i, i] += 1e-12
        gain = np.linalg.solve(normal, cross).T
        for i in range(n):
            before = ahead[k + 1, i] if i < DYNAMIC else kept_x[k, i]
            move[i] = (kept_x[k + 1, i] - before) * scale[i]
            for j in range(n):
                change[i, j] = (kept_P[k + 1, i, j] - P[i, j]) * scale[i] * scale[j]
        kept_x[k] += gain @ move
        added = gain @ change @ gain.T
        for i in range(n):
            for j in range(n):
                kept_P[k, i, j] += 0.5 * (added[i, j] + added[j, i])
            kept_P[k, i, i] = max(kept_P[k, i, i], 1e-24)


@njit(cache=True, nogil=True, error_model="numpy")
def _write(
    kept_x: FloatArray, kept_P: FloatArray, kinds: IntArray, rows: IntArray, alive: BoolArray, radius: float,
    out: FloatArray,
) -> None:  # fmt: skip
    for k in range(len(kinds)):
        if kinds[k] == 0 and rows[k] >= 0 and alive[k]:
            write_row(kept_x[k], kept_P[k], 0.0, radius, out[rows[k]])


def _timeline(
    setup: Setup, drive: Drive, rows: Rows, pwm: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray, IntArray, FloatArray, FloatArray]:
    """Times, kinds, readings (n, 4) and rows of all events, and when commands act with their forces."""
    events = events_of(setup, rows)
    forces = commands(drive, pwm)
    ticks = rows.t_s.copy()
    camera = np.nonzero(rows.kinds & 1)[0]
    ticks[camera] = even_times(new_clock(setup.camera_period_s), rows.t_s[camera])
    given = np.isfinite(forces[:, 0])
    action = drive.pump.delay_ticks * drive.pump.tick_s
    switch_t = np.concatenate([[-np.inf], np.maximum.accumulate(ticks[given] + action)])
    switch_g = np.concatenate([np.zeros((1, 2)), forces[given]])
    t, kinds, at = events.t_s, events.kinds, events.rows
    readings = np.full((len(t), 4), 0.0)
    readings[:, :3] = events.readings
    extra_t, extra_kind = [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    driven = np.nonzero(np.nan_to_num(pwm).max(axis=1, initial=0.0) > 0.0)[0]
    if len(driven):
        extra_t.append(ticks[driven[:1]])
        extra_kind.append(np.array([HOSES]))
    for k in np.nonzero(np.diff(t) > 0.95 * LONGEST_S)[0]:
        # No step is taken in parts, so that each has one transition. Longer silences are a cut.
        gap = t[k + 1] - t[k]
        if gap < 2.0:
            fill = np.linspace(t[k], t[k + 1], math.ceil(gap / (0.95 * LONGEST_S)) + 1)[1:-1]
            extra_t.append(fill)
            extra_kind.append(np.zeros(len(fill), dtype=np.int64))
    more_t, more_kind = np.concatenate(extra_t), np.concatenate(extra_kind)
    more = np.zeros((len(more_t), 4))
    more[:, 0] = drive.sigma[1]
    order = np.argsort(np.concatenate([t, more_t]), kind="stable")
    readings = np.concatenate([readings, more])[order]
    kinds = np.concatenate([kinds, more_kind])[order]
    at = np.concatenate([at, np.full(len(more_t), -1)])[order]
    return np.concatenate([t, more_t])[order], kinds, readings, at, switch_t, switch_g


def smooth_driven(setup: Setup, drive: Drive, rows: Rows, pwm: FloatArray, outputs: FloatArray) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) at the rows' stamps; NaN where the filter had not started.

    Parameters
    ----------
    pwm : (n, 2) commands, NaN in rows without.
    outputs : (n, len(OUT)) of the driven filter; what it says of innovations and flags is kept.
    """
    t, kinds, readings, at, switch_t, switch_g = _timeline(setup, drive, rows, pwm)
    x, P = drive.start(setup)
    x0, P0 = x.copy(), P.copy()
    constants = np.array([setup.gravity_mps2, setup.lever_across_m])
    whole, rejected = np.zeros(3, dtype=np.int64), np.zeros(3)
    plant, walk, noise = drive.numbers(), drive.walk(setup), drive.noise(setup)
    out = outputs.copy()
    out[:, 1:13] = np.nan
    n, size = len(t), len(DRIVEN)
    begin, before = 0, float(t[0]) if n else 0.0
    first = float(rows.t_s[0]) - max(float(setup.start.sensor[7]), 0.0) if n else 0.0
    while begin < n:
        end = min(begin + WINDOW, n)
        stop = min(end + OVERLAP, n)
        part, count = slice(begin, stop), stop - begin
        kept_x, kept_P = np.empty((count, size)), np.empty((count, size, size))
        ahead, F = np.empty((count, DYNAMIC)), np.empty((count, DYNAMIC, INVOLVED))
        chained, alive = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        _forward(
            t[part], before, first, kinds[part], readings[part], x, P, whole, rejected, switch_t, switch_g,
            x0, P0, plant, walk, setup.view, constants, noise, kept_x, kept_P, ahead, F, chained,
            alive, end - begin - 1, drive.sigma[1],
        )  # fmt: skip
        _backward(t[part], walk, F, ahead, chained, kept_x, kept_P)
        own = slice(0, end - begin)
        _write(
            kept_x[own], kept_P[own], kinds[begin:end], at[begin:end], alive[own], setup.bellows_radius_m, out
        )
        before = float(t[end - 1])
        begin = end
    return out
