"""The driven filter, row by row: the dynamics with the commands as input, readings as they arrive.

As in `filter` a picture belongs to its exposure, before IMU samples that have been used already; the last
events are kept with the state before the reading of each, the picture is put among them and those after it
are done again. A command acts `delay_s` after the tick that gave it, so it is known in time.

The first command that is not zero says that the hoses are on (`HOSES`); until then the damping may be
that of either. When most readings are rejected for a tenth of a second, time jumps, or the state leaves the
model, the filter starts again from the next picture: somebody may have held the head, or let it go.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.estimator.clock import advance, new_clock
from calib.estimator.columns import begin_row
from calib.estimator.compiled import compiled
from calib.estimator.driven_kernel import (
    CAMERA,
    HOSES,
    IMU,
    SETTLING_S,
    WORK,
    copy_state,
    driven_event,
    predict_driven,
)
from calib.estimator.driven_model import DRIVEN, DYNAMIC, INVOLVED
from calib.estimator.driven_setup import Drive, commands
from calib.estimator.sensors import SIZE, head_position, invert_marker
from calib.estimator.setup import OUT, Rows, Setup

__all__ = ["DrivenFilter", "begin_again", "run_driven", "sound", "write_row"]

_LOCKED_OUT = 5.5
"""So many pictures rejected, IMU readings twice so many, and the filter starts again."""
_BEFORE_S = 0.03
_LAST, _REJECTED, _FIRST, _REJECTED_IMU, _BEGUN = range(5)
_NEWEST, _COUNT, _STARTED, _PENDING, _SWITCH, _HOSES = range(6)
_SWITCHES = 128


@compiled()
def write_row(x: FloatArray, P: FloatArray, dt: float, radius: float, out: FloatArray) -> None:
    """Mean and deviations a very short time dt after the state into columns 1 to 12."""
    phi, length = x[0] + dt * x[2], x[1] + dt * x[3]
    pp = P[0, 0] + dt * (2.0 * P[0, 2] + dt * P[2, 2])
    ll = P[1, 1] + dt * (2.0 * P[1, 3] + dt * P[3, 3])
    pl = P[0, 1] + dt * (P[0, 3] + P[1, 2] + dt * P[2, 3])
    r = radius
    out[1], out[2] = length + r * phi, length - r * phi
    out[3], out[4] = x[3] + r * x[2], x[3] - r * x[2]
    out[5], out[6] = phi, length
    out[7], out[8] = head_position(phi, length)
    out[9] = x[INVOLVED]
    out[10] = math.sqrt(max(ll + r * r * pp + 2.0 * r * pl, 1e-18))
    out[11] = math.sqrt(max(ll + r * r * pp - 2.0 * r * pl, 1e-18))
    out[12] = math.sqrt(max(pp, 1e-18))


@compiled()
def begin_again(
    x: FloatArray, P: FloatArray, x0: FloatArray, P0: FloatArray, view: FloatArray, u: float, v: float
) -> bool:
    """Start a state (36,) from its prior and a picture; what has been learnt may be wrong and goes."""
    phi, length, found = invert_marker(view, x0[INVOLVED:], u, v, 0.0, x0[1])
    if not (found and 0.2 * x0[1] < length < 3.0 * x0[1]):
        return False
    copy_state(x, P, x0, P0)
    x[0], x[1] = phi, length
    return True


@compiled()
def sound(x: FloatArray, P: FloatArray) -> bool:
    """Whether a state is one."""
    good = abs(x[0]) < 3.0 and 1e-3 < x[1] < 1.0
    for i in range(x.shape[0]):
        good = good and abs(x[i]) < 1e4 and 0.0 < P[i, i] < 1e6
        good = good and abs(P[0, i]) + abs(P[1, i]) + abs(P[2, i]) + abs(P[3, i]) < 1e6
    return bool(good)


@compiled()
def run_driven(
    t: FloatArray, readings: FloatArray, kinds: IntArray, forces: FloatArray, driven: FloatArray,
    ring_x: FloatArray, ring_P: FloatArray, ring_t: FloatArray, ring_z: FloatArray, ring_kind: IntArray,
    ring_gated: FloatArray, switch_t: FloatArray, switch_g: FloatArray, whole: IntArray, real: FloatArray,
    camera_clock: FloatArray, imu_clock: FloatArray, x0: FloatArray, P0: FloatArray, plant: FloatArray,
    walk: FloatArray, view: FloatArray, constants: FloatArray, noise: FloatArray, radius: float,
    delay: float, action: float, hoses_sigma: float, z: FloatArray, report: FloatArray, spare: FloatArray,
    spare_x: FloatArray, spare_P: FloatArray, F: FloatArray, work: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n, 5), (n,), (n, 2), (n,) through the ring of the last events; writes `out`.

    `driven` says whether a row's command drives the pumps, `action` how long after it it acts [s]. What is
    from `z` (4,) on is scratch.
    """
    size = ring_x.shape[0]
    for row in range(len(t)):
        stamp = t[row]
        flags = 0
        if begin_row(stamp, real[_LAST], camera_clock, imu_clock, out, row):
            newest = whole[_NEWEST]
            whole[_COUNT], whole[_STARTED], whole[_PENDING] = 0, 0, 0
            for k in range(len(switch_t)):
                switch_t[k] = -math.inf
                switch_g[k, 0] = switch_g[whole[_SWITCH], 0]
                switch_g[k, 1] = switch_g[whole[_SWITCH], 1]
            real[_REJECTED], real[_REJECTED_IMU], real[_FIRST] = 0.0, 0.0, stamp
            flags |= 32
        elif math.isnan(real[_LAST]):
            real[_REJECTED], real[_REJECTED_IMU], real[_FIRST] = 0.0, 0.0, stamp
        real[_LAST] = stamp
        tick = stamp
        if kinds[row] & 1:
            tick = advance(camera_clock, stamp)
        if not math.isnan(forces[row, 0]):
            to = (whole[_SWITCH] + 1) % len(switch_t)
            switch_t[to] = max(tick + action, switch_t[whole[_SWITCH]])
            switch_g[to, 0], switch_g[to, 1] = forces[row, 0], forces[row, 1]
            whole[_SWITCH] = to
        for turn in range(3):
            if turn == 0:
                # Its own event, so that it is done again with those around it.
                if whole[_HOSES] == 1 or not driven[row] > 0.0:
                    continue
                whole[_HOSES] = 1
                kind, when = HOSES, tick
                z[0], z[1], z[2], z[3] = hoses_sigma, math.nan, math.nan, 0.0
            elif turn == 1:
                if not kinds[row] & 1:
                    continue
                kind, when = CAMERA, tick - delay
                z[0], z[1], z[2], z[3] = readings[row, 0], readings[row, 1], math.nan, camera_clock[3]
                if math.isnan(z[0]) or math.isnan(z[1]):
                    continue
            else:
                if not kinds[row] & 2:
                    continue
                kind, when = IMU, advance(imu_clock, stamp)
                z[0], z[1], z[2], z[3] = readings[row, 2], readings[row, 3], readings[row, 4], imu_clock[3]
                if math.isnan(z[2]) and (math.isnan(z[0]) or math.isnan(z[1])):
                    continue
            newest = whole[_NEWEST]
            if whole[_COUNT] == 0:
                ring_t[newest], ring_kind[newest] = when, 0
                whole[_COUNT] = 1
            back = 0
            while back < whole[_COUNT] - 1 and ring_t[(newest - back) % size] > when:
                back += 1
            if ring_t[(newest - back) % size] > when:
                if whole[_COUNT] == size:
                    flags |= 16
                    continue
                when = ring_t[(newest - back) % size]
            for i in range(back):
                to, since = (newest + 1 - i) % size, (newest - i) % size
                ring_t[to], ring_kind[to] = ring_t[since], ring_kind[since]
                for k in range(4):
                    ring_z[to, k] = ring_z[since, k]
                for k in range(3):
                    ring_gated[to, k] = ring_gated[since, k]
            own = (newest + 1 - back) % size
            ring_t[own], ring_kind[own] = when, kind
            for k in range(4):
                ring_z[own, k] = z[k]
            # Who holds the head until the log begins is not in the model.
            begin = (kind == CAMERA and (whole[_STARTED] == 0 or whole[_PENDING] == 1)
                     and when > real[_FIRST] + _BEFORE_S)  # fmt: skip
            for i in range(back + 1):
                now = (newest + 1 - back + i) % size
                before = (now - 1) % size
                x, P = ring_x[now], ring_P[now]
                copy_state(x, P, ring_x[before], ring_P[before])
                if whole[_STARTED] == 1:
                    predict_driven(
                        x, P, ring_t[before], ring_t[now], plant, walk, switch_t, switch_g, whole[_SWITCH],
                        F, work,
                    )  # fmt: skip
                if i == 0 and begin and begin_again(x, P, x0, P0, view, z[0], z[1]):
                    if whole[_STARTED] == 1:
                        flags |= 1
                    whole[_STARTED], whole[_PENDING] = 1, 0
                    real[_BEGUN] = ring_t[now]
                    if whole[_HOSES] == 1:
                        x[13], P[13, 13] = 0.0, hoses_sigma * hoses_sigma
                if ring_kind[now] == IMU and ring_t[now] < real[_BEGUN] + SETTLING_S:
                    ring_z[now, 0], ring_z[now, 1], ring_gated[now, 1] = math.nan, math.nan, 1.0
                if whole[_STARTED] == 0 and ring_kind[now] != HOSES:
                    for k in range(12):
                        report[k] = math.nan
                    for k in range(3):
                        ring_gated[now, k] = 1.0
                    continue
                driven_event(
                    x, P, ring_kind[now], ring_z[now], plant, view, constants, noise, work, i > 0,
                    report if i == 0 else spare, ring_gated[now],
                )  # fmt: skip
                if not sound(x, P):
                    copy_state(x, P, x0, P0)
                    whole[_PENDING] = 1
                    flags |= 1
            whole[_NEWEST] = (newest + 1) % size
            whole[_COUNT] = min(whole[_COUNT] + 1, size)
            if kind == HOSES:
                continue
            likelihood = out[row, 24]
            for k in range(12):
                if not math.isnan(report[k]):
                    out[row, 13 + k] = report[k]
            if not math.isnan(likelihood):
                out[row, 24] += likelihood
            for k in range(3):
                at = _REJECTED if k == 0 else _REJECTED_IMU
                if report[8 + k] == 1.0:
                    real[at] += 1.0
                elif report[8 + k] == 0.0:
                    real[at] *= 0.7
            if real[_REJECTED] > _LOCKED_OUT or real[_REJECTED_IMU] > 2.0 * _LOCKED_OUT:
                whole[_PENDING], real[_REJECTED], real[_REJECTED_IMU] = 1, 0.0, 0.0
        here = whole[_NEWEST]
        ahead = stamp - ring_t[here] if whole[_COUNT] > 0 else 0.0
        if whole[_STARTED] == 0:
            flags |= 64
        if ahead > 1e-3 and whole[_STARTED] == 1:
            copy_state(spare_x, spare_P, ring_x[here], ring_P[here])
            predict_driven(
                spare_x, spare_P, ring_t[here], stamp, plant, walk, switch_t, switch_g, whole[_SWITCH], F,
                work,
            )  # fmt: skip
            if not sound(spare_x, spare_P):
                copy_state(spare_x, spare_P, x0, P0)
            write_row(spare_x, spare_P, 0.0, radius, out[row])
        else:
            write_row(ring_x[here], ring_P[here], min(max(ahead, -0.02), 1e-3), radius, out[row])
        out[row, 25] = flags


class DrivenFilter:
    """A driven filter at work: rows and commands in, estimates out, with memory of the last events only."""

    def __init__(self, setup: Setup, drive: Drive) -> None:
        self.setup, self.drive = setup, drive
        self._delay = max(float(setup.start.sensor[7]), 0.0)
        period = setup.imu_period_s if setup.imu_period_s > 0.0 else 0.002
        size = min(max(16, math.ceil(2.0 * (self._delay + 0.02) / period) + 8), 512)
        n = len(DRIVEN)
        self._x, self._P = np.zeros((size, n)), np.zeros((size, n, n))
        self._t, self._z, self._gated = np.zeros(size), np.zeros((size, 4)), np.zeros((size, 3))
        self._kind, self._whole = np.zeros(size, dtype=np.int64), np.zeros(6, dtype=np.int64)
        self._real = np.full(5, np.nan)
        self._switch_t, self._switch_g = np.full(_SWITCHES, -np.inf), np.zeros((_SWITCHES, 2))
        self._camera_clock = new_clock(setup.camera_period_s)
        self._imu_clock = new_clock(setup.imu_period_s)
        self._start = drive.start(setup)
        self._x[0], self._P[0] = self._start
        self._numbers, self._walk, self._noise = drive.numbers(), drive.walk(setup), drive.noise(setup)
        self._scratch = (
            np.empty(4), np.empty(12), np.empty(12), np.empty(n), np.empty((n, n)),
            np.zeros((DYNAMIC, INVOLVED)), np.zeros(WORK),
        )  # fmt: skip

    def run(self, rows: Rows, pwm: FloatArray) -> FloatArray:
        """Estimates (n, len(OUT)) of rows with commands (n, 2); call again with the rows that follow."""
        setup, drive = self.setup, self.drive
        out = np.empty((len(rows), len(OUT)))
        driven = np.asarray(np.nan_to_num(pwm).max(axis=1, initial=0.0), dtype=np.float64)
        run_driven(
            rows.t_s, rows.readings, rows.kinds, commands(drive, pwm), driven, self._x, self._P, self._t,
            self._z, self._kind, self._gated, self._switch_t, self._switch_g, self._whole, self._real,
            self._camera_clock, self._imu_clock, *self._start, self._numbers, self._walk, setup.view,
            np.array([setup.gravity_mps2, setup.lever_across_m]), self._noise, setup.bellows_radius_m,
            self._delay, drive.pump.delay_ticks * drive.pump.tick_s, drive.sigma[1], *self._scratch, out,
        )  # fmt: skip
        return out

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """State (36,) and covariance (36, 36) after the last event."""
        here = int(self._whole[0])
        return self._x[here].copy(), self._P[here].copy()


assert SIZE == 19
