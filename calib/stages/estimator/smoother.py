"""The smoother: every state from the whole log, forward and backward, with a covariance of its own.

1. The bank runs over the events in the order of their times, pictures at their exposure, and leaves its
   weights; these are smoothed backwards (Kim 1994, eq. 2.20),
       w_k|N(i) = w_k|k(i) sum_j pi_ij w_k+1|N(j) / w_k+1|k(j).
2. One filter with the process noise that these weights mix runs forward, given what is only considered
   (`kinematic.CONSIDERED`). Readings that the bank has gated stay out.
3. Bryson and Frazier (1963) backwards: each scalar reading, with k = P H' / S and L = I - k H, turns
       y into L' y + H' innovation / S,   Y into L' Y L + H' H / S,
   each step from one event to the next turns them into F' y and F' Y F, and
       x_N = x + P y,   P_N = P - P Y P.
   Nothing is inverted, and what has no variance does no harm.
4. The same again, without the covariance, from starting states that are off by a deviation along each
   principal direction of what is considered, all else following by regression: the squares of what this makes
   of the states are added.

A filter that does not learn some states leaves innovations that are not white, and a backward pass over those
would learn from afterwards what the filter had refused to: a loose alignment then made the smoothed
angle several times worse than the filtered one. Given what is considered, both passes are optimal.

Rows of the output are events without a reading.

The backward pass begins anew every `WINDOW` events, from events `OVERLAP` further on, so that memory does not
grow with the log; what is constant over the log is then known from all before and the overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.stages.estimator.kinematic import (
    CONSIDERED,
    FASTEST_MPS,
    FLAGS,
    LARGEST_STEP_S,
    OUT,
    TRACE,
    WORK,
    Rows,
    Setup,
    axis_transition,
    bank_event,
    banked,
    copy_state,
    even_times,
    mixes,
    new_clock,
    starting_state,
    write_columns,
)
from calib.stages.estimator.sensors import SIZE

WINDOW, OVERLAP = 12_000, 3_000
_KEPT = 7
"""States that the output needs: the head's motion and the gyroscope's bias."""


@dataclass(frozen=True)
class Events:
    """Everything that happens in a log, in the order of time.

    Attributes
    ----------
    t_s : (n,). kinds : (n,) 0 for a row of the output, else of `kernel`. readings : (n, 4), the last one the
        variance of the time [s^2].
    rows : (n,) the row of the log.
    """

    t_s: FloatArray
    kinds: IntArray
    readings: FloatArray
    rows: IntArray


def events_of(setup: Setup, rows: Rows) -> Events:
    """Events of a log: pictures at their exposure, IMU samples, and the rows' own stamps.

    Stamps run through the clocks, which do not look ahead.
    """
    camera, imu = np.nonzero(rows.kinds & 1)[0], np.nonzero(rows.kinds & 2)[0]
    exposed, camera_s2 = even_times(new_clock(setup.camera_period_s), rows.taken_s[camera])
    exposed = exposed - setup.delay_s
    taken, imu_s2 = even_times(new_clock(setup.imu_period_s), rows.taken_s[imu])
    taken = taken - setup.imu_delay_s
    seen = np.isfinite(rows.readings[camera, :2]).all(axis=1)
    camera, exposed = camera[seen], exposed[seen]
    pixels = np.full((len(camera), 4), np.nan)
    pixels[:, :2], pixels[:, 3] = rows.readings[camera, :2], camera_s2[seen]
    samples = np.column_stack([rows.readings[imu, 2:], imu_s2])
    every = np.arange(len(rows))
    t = np.concatenate([exposed, taken, rows.t_s])
    kinds = np.repeat([1, 2, 0], [len(camera), len(imu), len(every)])
    readings = np.concatenate([pixels, samples, np.full((len(every), 4), np.nan)])
    order = np.argsort(t, kind="stable")
    return Events(t[order], kinds[order], readings[order], np.concatenate([camera, imu, every])[order])


@kernel()
def forward(
    t: FloatArray, before_s: float, kinds: IntArray, readings: FloatArray, bank_x: FloatArray,
    bank_P: FloatArray, weights: FloatArray, switch_hz: float, levels: FloatArray, walk: FloatArray,
    view: FloatArray, noise: FloatArray, again: bool, gated: FloatArray,
    kept_weights: FloatArray, trace: FloatArray, kept_x: FloatArray, kept_P: FloatArray,
) -> float:  # fmt: skip
    """A bank over all events; its log likelihood.

    Parameters
    ----------
    before_s : time of the first slot of bank and weights, which becomes that after the last event.
    levels : (1, M, 8), or (n, M, 8) with levels of their own for each event.
    again : whether `gated` (n, 3) holds; else it is written to.
    kept_weights : (n, M) written to.
    trace : (n, 3, `TRACE`), of the last level, or (1, 0, `TRACE`) for nothing.
    kept_x, kept_P : (n, a) and (n, a, 20), the last level's first states after each event; or none (0, ...).
    """
    count = weights.shape[1] - 1
    told, report, work = np.zeros((count, 7)), np.empty(12), np.zeros((count, WORK[0], WORK[1]))
    size, rows, total = kept_P.shape[2], kept_x.shape[1], 0.0
    for k in range(len(t)):
        dt = t[k] - (t[k - 1] if k else before_s)
        old = k % 2 if count > 1 else 0
        new = 1 - old if count > 1 else 0
        bank_event(
            bank_x, bank_P, weights, old, new, kinds[k], readings[k], dt, switch_hz,
            levels[k if levels.shape[0] > 1 else 0], walk, view, noise, work, told, again, report,
            gated[k], trace[k if trace.shape[0] > 1 else 0],
        )  # fmt: skip
        for m in range(count):
            kept_weights[k, m] = weights[new, m]
        for i in range(rows if kept_x.shape[0] else 0):
            kept_x[k, i] = bank_x[new, count - 1, i]
            for j in range(size):
                kept_P[k, i, j] = bank_P[new, count - 1, i, j]
        total += report[11]
    if count > 1 and len(t) % 2:
        for m in range(count):
            copy_state(bank_x[0, m], bank_P[0, m], bank_x[1, m], bank_P[1, m])
            weights[0, m] = weights[1, m]
        weights[0, count] = weights[1, count]
    return total


@kernel()
def _smooth_weights(t: FloatArray, kinds: IntArray, switch_hz: float, weights: FloatArray) -> None:
    """Kim's backward pass over the weights (n, M), in place."""
    n, count = weights.shape
    ratio, turned_s, since = np.empty(count), np.zeros(n), 0.0
    for k in range(1, n):
        since += t[k] - t[k - 1]
        if mixes(kinds[k], since):
            turned_s[k], since = since, 0.0
    for k in range(n - 2, -1, -1):
        turn = (1.0 - math.exp(-count * switch_hz * turned_s[k + 1])) / count
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


@kernel()
def transition(level: FloatArray, dt: float, F: FloatArray) -> None:
    """F (n, n) of `kinematic.predict` over dt [s]."""
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


@kernel()
def _undo_step(y: FloatArray, level: FloatArray, h: float) -> None:
    """F' y for a step of h, in place."""
    for axis in range(2):
        f01, f02, f11, f12, f22 = axis_transition(level[4 * axis], level[4 * axis + 1], h)
        p, v, a = y[axis], y[axis + 2], y[axis + 4]
        y[axis + 2] = f01 * p + f11 * v
        y[axis + 4] = f02 * p + f12 * v + f22 * a


@kernel()
def look_back(
    x: FloatArray, P: FloatArray, y: FloatArray, Y: FloatArray, part: FloatArray, spread: bool
) -> None:
    """x + P y and P - P Y P of the first a states, in place; P (a, n), of which the first a columns change.

    `part` (n,) is scratch; `spread` tells whether the covariance is wanted.
    """
    rows, n = P.shape
    for i in range(rows):
        for j in range(n):
            x[i] += P[i, j] * y[j]
    if not spread:
        return
    off = np.zeros((rows, rows))
    for i in range(rows):
        for j in range(n):
            part[j] = 0.0
        for m in range(n):
            for j in range(n):
                part[j] += P[i, m] * Y[m, j]
        for j in range(i + 1):
            for m in range(n):
                off[i, j] += part[m] * P[j, m]
    for i in range(rows):
        for j in range(i + 1):
            P[i, j] -= off[i, j]
            P[j, i] = P[i, j]


@kernel(arrays=False)
def undo_readings(trace: FloatArray, y: FloatArray, Y: FloatArray, Yk: FloatArray, spread: bool) -> None:
    """Take y and Y from after an event's readings (3, 2 n + 2) to before them; Yk (n,) is scratch."""
    n = y.shape[0]
    for reading in range(2, -1, -1):
        weight = trace[reading, 2 * n + 1]
        if weight == 0.0:
            continue
        change = trace[reading, 2 * n]
        for i in range(n):
            change -= trace[reading, n + i] * y[i]
        for i in range(n):
            y[i] += trace[reading, i] * change
            Yk[i] = 0.0
        if not spread:
            continue
        for i in range(n):
            gain = trace[reading, n + i]
            for j in range(n):
                Yk[j] += gain * Y[i, j]
        for i in range(n):
            weight += trace[reading, n + i] * Yk[i]
        for i in range(n):
            H = trace[reading, i]
            half = 0.5 * weight * H - Yk[i]
            for j in range(n):
                Y[i, j] += half * trace[reading, j] + H * (0.5 * weight * trace[reading, j] - Yk[j])


@kernel()
def backward(
    t: FloatArray, level: FloatArray, trace: FloatArray, wanted: BoolArray, kept_x: FloatArray,
    kept_P: FloatArray, spread: bool,
) -> None:  # fmt: skip
    """Bryson and Frazier over what `forward` has kept of one level, in place.

    Parameters
    ----------
    level : (n, 8). trace : (n, 3, `TRACE`). wanted : (n,) events whose states are.
    kept_x, kept_P : (n, a) and (n, a, 20); of kept_P the first a columns become the smoothed covariance.
    spread : whether the covariance is wanted; the states do without it.
    """
    n = kept_P.shape[2]
    y, Y, part = np.zeros(n), np.zeros((n, n)), np.empty(n)
    for k in range(len(t) - 1, -1, -1):
        # What follows the event tells of the state after its readings.
        if wanted[k]:
            look_back(kept_x[k], kept_P[k], y, Y, part, spread)
        undo_readings(trace[k], y, Y, part, spread)
        dt = t[k] - t[k - 1] if k else 0.0
        if not dt > 0.0:
            continue
        parts = max(math.ceil(dt / LARGEST_STEP_S - 1e-9), 1)
        for _ in range(parts):
            _undo_step(y, level[k], dt / parts)
            if not spread:
                continue
            for i in range(n):
                _undo_step(Y[i], level[k], dt / parts)
            for i in range(6, n):
                for j in range(6):
                    Y[j, i] = Y[i, j]
            for j in range(6):
                for i in range(6):
                    part[i] = Y[i, j]
                _undo_step(part, level[k], dt / parts)
                for i in range(6):
                    Y[i, j] = part[i]


def _given(x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Starting states (1 + k, 20), what is considered as it is and off by a deviation, and their covariance.

    The rest follows by its regression on what is considered; k counts the principal directions of that.
    """
    held, free = list(CONSIDERED), [i for i in range(SIZE) if i not in CONSIDERED]
    V = P[np.ix_(held, held)]
    sigma = np.sqrt(np.maximum(np.diag(V), 1e-30))
    eigenvalues, Q = np.linalg.eigh(V / sigma / sigma[:, None])
    use = eigenvalues > 1e-6
    directions = sigma[:, None] * Q[:, use] * np.sqrt(eigenvalues[use])
    along = Q[:, use] / np.sqrt(eigenvalues[use]) / sigma[:, None]
    follow = P[np.ix_(free, held)] @ along
    states = np.tile(x, (1 + directions.shape[1], 1))
    states[1:, held] += directions.T
    states[1:, free] += follow.T
    left = np.zeros((SIZE, SIZE))
    left[np.ix_(free, free)] = P[np.ix_(free, free)] - follow @ follow.T
    return states, left


@dataclass(frozen=True)
class OneLevel:
    """One level of process noise over events: what it gated (n, 3), states (n, 20), covariances, trace."""

    gated: FloatArray
    x: FloatArray
    P: FloatArray
    trace: FloatArray


def one_level(setup: Setup, rows: Rows, events: Events) -> OneLevel:
    """The compiled filter with the first level of `setup` alone, everything kept: 4 kB an event."""
    levels, walk = setup.process.arrays()
    x, P, _ = starting_state(setup, rows)
    n, begin = len(events.t_s), float(events.t_s[0])
    kept = OneLevel(np.zeros((n, 3)), np.empty((n, SIZE)), np.empty((n, SIZE, SIZE)), np.empty((n, 3, TRACE)))
    forward(
        events.t_s, begin, events.kinds, events.readings, *banked(x[:1], P[:1], np.ones(1)), 0.0,
        levels[None, :1], walk, setup.view, setup.noise,
        False, kept.gated, np.empty((n, 1)), kept.trace, kept.x, kept.P,
    )  # fmt: skip
    return kept


def _begun_again(outputs: FloatArray) -> list[int]:
    """Rows at which the filter takes a picture again, which it had rejected until it started again."""
    gated, flags = (outputs[:, OUT.index(name)] for name in ("gated_camera", "flags"))
    restarts = np.cumsum(flags.astype(np.int64) & FLAGS["restarted"])
    seen = np.flatnonzero(np.isfinite(gated))
    good = np.flatnonzero(gated[seen] == 0.0)
    before, after = seen[good[:-1]], seen[good[1:]]
    some = (np.diff(good) > 1) & (restarts[after] > restarts[before])
    return [int(row) for row in after[some]]


def smooth(setup: Setup, rows: Rows, outputs: FloatArray) -> FloatArray:
    """Smoothed estimates (n, len(OUT)) at the rows' stamps.

    Where the filter began again at a picture the smoother does, too: one that has lost the head rejects all
    that follows.

    Parameters
    ----------
    outputs : (n, len(OUT)) of the filter on the same rows; what it says of innovations and flags is kept, and
        all that it says where both sides of a row make the head faster than a rig.
    """
    cuts = [0, *_begun_again(outputs), len(rows)]
    parts = [slice(begin, end) for begin, end in pairwise(cuts)]
    return np.concatenate([_smooth_part(setup, rows[part], outputs[part]) for part in parts])


def _smooth_part(setup: Setup, rows: Rows, outputs: FloatArray) -> FloatArray:
    """`smooth` of rows between which the filter does not begin again."""
    events = events_of(setup, rows)
    levels, walk = setup.process.arrays()
    x, P, w = starting_state(setup, rows)
    n, count = len(events.t_s), len(levels)
    out = outputs.copy()
    if n == 0:
        return out
    weights, gated = np.empty((n, count)), np.zeros((n, 3))
    states, left = _given(x[0], P[0])
    steady = walk.copy()
    steady[[k - 6 for k in CONSIDERED]] = 0.0
    known = (setup.view, setup.noise)
    none = (np.empty((1, 0, TRACE)), np.empty((0, _KEPT)), np.empty((0, _KEPT, SIZE)))
    forward(
        events.t_s, float(events.t_s[0]), events.kinds, events.readings, *banked(x, P, w),
        setup.process.switch_hz, levels[None], walk, *known, False, gated, weights, *none,
    )  # fmt: skip
    _smooth_weights(events.t_s, events.kinds, setup.process.switch_hz, weights)
    mixed = weights @ levels
    ones = [banked(state[None], left[None], np.ones(1)) for state in states]
    begin, before = 0, float(events.t_s[0])
    while begin < n:
        end = min(begin + WINDOW, n)
        stop = min(end + OVERLAP, n)
        own, beyond = slice(begin, end), slice(end, stop)
        shown = np.nonzero(events.kinds[own] == 0)[0]
        kept_x, kept_P = np.empty((stop - begin, _KEPT)), np.empty((stop - begin, _KEPT, SIZE))
        trace, spare = np.empty((stop - begin, 3, TRACE)), np.empty((stop - begin, 1))
        mean, covariance = np.empty(0), np.empty(0)
        for number, state in enumerate(ones):
            since = before
            for part in (own, beyond):
                if part is beyond:
                    # The next window begins with the state at `end`; what is beyond only looks back.
                    state = (state[0].copy(), state[1].copy(), state[2].copy())
                at = slice(part.start - begin, part.stop - begin)
                if part.start < part.stop:
                    forward(
                        events.t_s[part], since, events.kinds[part], events.readings[part], *state, 0.0,
                        mixed[part, None], steady, *known, True, gated[part], spare[at], trace[at],
                        kept_x[at], kept_P[at],
                    )  # fmt: skip
                since = float(events.t_s[end - 1])
            backward(
                events.t_s[begin:stop], mixed[begin:stop], trace, events.kinds[begin:stop] == 0, kept_x,
                kept_P, number == 0,
            )  # fmt: skip
            if number == 0:
                mean, covariance = kept_x[shown], kept_P[shown, :, :_KEPT]
            else:
                away = kept_x[shown] - mean
                covariance = covariance + away[:, :, None] * away[:, None, :]
        write_columns(
            mean, np.ascontiguousarray(covariance), 6, events.rows[own][shown], setup.bellows_radius_m, out,
        )  # fmt: skip
        before = float(events.t_s[end - 1])
        begin = end
    # The smoother linearises where the filter may start again, and readings that lie carry it away.
    lost = ~(np.isfinite(out[:, 1:13]).all(axis=1) & (np.abs(out[:, 3:5]) < FASTEST_MPS).all(axis=1))
    out[lost] = outputs[lost]
    out[lost, OUT.index("flags")] = out[lost, OUT.index("flags")].astype(np.int64) | FLAGS["restarted"]
    out[:, OUT.index("rest_weight")] = _of_rows(events, weights[:, 0], len(rows))
    out[:, OUT.index("swing_weight")] = _of_rows(events, weights[:, -1], len(rows))
    return out


def _of_rows(events: Events, values: FloatArray, count: int) -> FloatArray:
    own = events.kinds == 0
    out = np.zeros(count)
    out[events.rows[own]] = values[own]
    return out
