"""The fused filter, row by row: what is known of the head at the time of each row of a log.

A picture arrives `time_offset` after it was exposed, when newer IMU samples have been used already. The
last events are kept with the state after each; an event that belongs between them is put there and
those after it are done again. So each row's output rests on all that had arrived by then, and on nothing
else. Time stamps go through the clocks of `clock` first.

What goes wrong is said in `flags`: a picture or a sample that was gated; a sensor that is silent; a restart
after half a second of rejected pictures, at a jump of the time, or from a state outside of the model; an
angle or length that no sensor sees, which the prior then holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from calib.arrays import FloatArray, IntArray
from calib.estimator.bank import RECORD, STATE, WIDTH, copy_level, get, new_bank, predict, put
from calib.estimator.clock import CLOCK_SIZE, advance, new_clock
from calib.estimator.columns import begin_row, write_bank
from calib.estimator.compiled import compiled
from calib.estimator.expect import TOLD
from calib.estimator.kernel import CAMERA, IMU, REPORT, TRACE, event
from calib.estimator.sensors import SIZE, invert_marker
from calib.estimator.setup import OUT, Rows, Setup

__all__ = ["Filter", "run_filter", "starting_state"]

_SILENT_S = 0.5
_LOCKED_OUT_S = 0.5
_KNOWN_M = 0.05
"""A length with a larger deviation than this is as good as unknown."""
_LAST, _CAMERA_SEEN, _IMU_SEEN, _REJECTED_SINCE, _GYRO_REJECTED_SINCE = range(5)
_NEWEST, _COUNT, _CAMERA_STARTED, _PENDING = range(4)
_PHI, _LENGTH = 0, 1


@compiled()
def _clear(bank: FloatArray, at: int, i: int, variance: float) -> None:
    """Make a state independent of all others."""
    for j in range(SIZE):
        bank[at + WIDTH * i + j] = 0.0
        bank[at + WIDTH * j + i] = 0.0
    bank[at + (WIDTH + 1) * i] = variance


@compiled()
def _reset_head(
    bank: FloatArray, weights: FloatArray, slot: int, head: FloatArray, sigma: FloatArray
) -> None:
    """Forget the head's motion; what is known of the sensors stays."""
    count = weights.shape[1] - 1
    for m in range(count):
        at = (slot * count + m) * RECORD
        for i in range(6):
            bank[at + STATE + i] = head[i]
            _clear(bank, at, i, sigma[i] * sigma[i])
        weights[slot, m] = 1.0 / count


@compiled()
def _place_head(bank: FloatArray, slot: int, count: int, phi: float, length: float) -> None:
    for m in range(count):
        at = (slot * count + m) * RECORD + STATE
        bank[at], bank[at + 1] = phi, length


@compiled()
def _hold(bank: FloatArray, at: int, k: int, middle: float, sigma: float) -> None:
    """Use the prior of one quantity of the head as a reading."""
    S = bank[at + (WIDTH + 1) * k] + sigma * sigma
    row, scratch = at + WIDTH * k, at + STATE + WIDTH
    for j in range(WIDTH):
        bank[scratch + j] = bank[row + j] / math.sqrt(S)
    move = (middle - bank[at + STATE + k]) / math.sqrt(S)
    for i in range(SIZE):
        gain = bank[scratch + i]
        bank[at + STATE + i] += gain * move
        for j in range(WIDTH):
            bank[at + WIDTH * i + j] -= gain * bank[scratch + j]


@compiled()
def _mend(bank: FloatArray, slot: int, count: int, head: FloatArray, head_sigma: FloatArray) -> int:
    """Whether the state is still one, and what is done where it is not: flags."""
    flags = 0
    for m in range(count):
        at = (slot * count + m) * RECORD
        x = at + STATE
        if bank[at] > 1.0:
            _hold(bank, at, int(_PHI), head[0], 0.7)
            flags |= 8
        if bank[at + WIDTH + 1] > 2.25 * head_sigma[1] * head_sigma[1]:
            _hold(bank, at, int(_LENGTH), head[1], head_sigma[1])
            flags |= 8
        bad = 0 if abs(bank[x]) < 3.0 and 1e-3 < bank[x + 1] < 1.0 else 1
        for i in range(SIZE):
            bad += 0 if abs(bank[x + i]) < 1e6 else 1
            bad += 0 if bank[at + (WIDTH + 1) * i] > 0.0 else 1
        if bad:
            # A level that has left the model starts again from the prior, all of it.
            for i in range(SIZE):
                if i < 6:
                    bank[x + i] = head[i]
                elif not abs(bank[x + i]) < 1e6:
                    bank[x + i] = 0.0
                _clear(bank, at, i, head_sigma[i] ** 2 if i < 6 else 1e-2)
            flags |= 1
    return flags


@compiled()
def run_filter(
    t: FloatArray, readings: FloatArray, kinds: IntArray,
    bank: FloatArray, weights: FloatArray, ring_t: FloatArray, ring_z: FloatArray,
    ring_kind: IntArray, ring_gated: FloatArray, whole: IntArray, real: FloatArray,
    camera_clock: FloatArray, imu_clock: FloatArray,
    switch_hz: float, levels: FloatArray, walk: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, head: FloatArray, head_sigma: FloatArray, radius: float, delay: float,
    sensor: FloatArray, told: FloatArray, report: FloatArray, spare: FloatArray, untraced: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n, 5), (n,) through the ring of the last events; writes `out` (n, len(OUT)).

    The last slot of bank and weights is scratch; so are the arrays from `sensor` (13,) on.
    """
    size, count = ring_t.shape[0], told.shape[0]
    z0 = z1 = z2 = 0.0
    for row in range(len(t)):
        stamp = t[row]
        flags = 0
        if begin_row(stamp, real[_LAST], camera_clock, imu_clock, out, row):
            newest = whole[_NEWEST]
            _reset_head(bank, weights, newest, head, head_sigma)
            whole[_COUNT], whole[_CAMERA_STARTED], whole[_PENDING] = 0, 0, 0
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
            real[_REJECTED_SINCE], real[_GYRO_REJECTED_SINCE] = math.nan, math.nan
            flags |= 32
        elif math.isnan(real[_LAST]):
            real[_CAMERA_SEEN], real[_IMU_SEEN] = stamp, stamp
        real[_LAST] = stamp
        for kind in range(1, 3):
            if not kinds[row] & kind:
                continue
            if kind == CAMERA:
                when = advance(camera_clock, stamp) - delay
                z0, z1, z2 = readings[row, 0], readings[row, 1], math.nan
                if math.isnan(z0) or math.isnan(z1):
                    continue
                real[_CAMERA_SEEN] = stamp
            else:
                when = advance(imu_clock, stamp)
                z0, z1, z2 = readings[row, 2], readings[row, 3], readings[row, 4]
                if math.isnan(z2) and (math.isnan(z0) or math.isnan(z1)):
                    continue
                real[_IMU_SEEN] = stamp
            newest = whole[_NEWEST]
            if whole[_COUNT] == 0:
                ring_t[newest], ring_kind[newest] = when, 0
                whole[_COUNT] = 1
                if kind == IMU and not math.isnan(z0) and math.hypot(z0, z1) > 1.0:
                    at = newest * count * RECORD + STATE
                    tilt = math.atan2(z1, z0) - bank[at + 9]
                    tilt = min(max(math.atan2(math.sin(tilt), math.cos(tilt)), -1.5), 1.5)
                    _place_head(bank, newest, count, tilt, bank[at + 1])
            # Back to the last event before this one.
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
                for k in range(3):
                    ring_z[to, k], ring_gated[to, k] = ring_z[since, k], ring_gated[since, k]
            own = (newest + 1 - back) % size
            ring_t[own], ring_kind[own] = when, kind
            ring_z[own, 0], ring_z[own, 1], ring_z[own, 2] = z0, z1, z2
            begin_camera = kind == CAMERA and (whole[_CAMERA_STARTED] == 0 or whole[_PENDING] == 1)
            for i in range(back + 1):
                now = (newest + 1 - back + i) % size
                before = (now - 1) % size
                if i == 0 and begin_camera:
                    at = before * count * RECORD + STATE
                    for k in range(len(sensor)):
                        sensor[k] = bank[at + 6 + k]
                    phi, length, found = 0.0, 0.0, False
                    for attempt in range(2):
                        if not found:
                            angle = bank[at] if attempt == 0 else 0.0
                            phi, length, found = invert_marker(view, sensor, z0, z1, angle, head[1])
                    if found and 0.2 * head[1] < length < 3.0 * head[1]:
                        if whole[_CAMERA_STARTED] == 1:
                            flags |= 1
                        _reset_head(bank, weights, before, head, head_sigma)
                        _place_head(bank, before, count, phi, length)
                        whole[_CAMERA_STARTED], whole[_PENDING] = 1, 0
                event(
                    bank, weights, before, now, ring_kind[now], ring_z, now, ring_t[now] - ring_t[before],
                    switch_hz, levels, 0, walk, view, constants, noise, told, i > 0,
                    report if i == 0 else spare, ring_gated, untraced,
                )  # fmt: skip
                flags |= _mend(bank, now, count, head, head_sigma)
            whole[_NEWEST] = (newest + 1) % size
            whole[_COUNT] = min(whole[_COUNT] + 1, size)
            likelihood = out[row, 24]
            for k in range(12):
                if not math.isnan(report[k]):
                    out[row, 13 + k] = report[k]
            if not math.isnan(likelihood):
                out[row, 24] += likelihood
            if kind == CAMERA:
                if report[8] == 0.0:
                    real[_REJECTED_SINCE] = math.nan
                elif math.isnan(real[_REJECTED_SINCE]):
                    real[_REJECTED_SINCE] = stamp
                elif stamp - real[_REJECTED_SINCE] > _LOCKED_OUT_S:
                    whole[_PENDING] = 1
                    real[_REJECTED_SINCE] = math.nan
            elif report[10] == 0.0:
                real[_GYRO_REJECTED_SINCE] = math.nan
            elif report[10] == 1.0:
                if math.isnan(real[_GYRO_REJECTED_SINCE]):
                    real[_GYRO_REJECTED_SINCE] = stamp
                elif stamp - real[_GYRO_REJECTED_SINCE] > _LOCKED_OUT_S:
                    here = whole[_NEWEST]
                    at = here * count * RECORD + STATE
                    phi, length = bank[at], bank[at + 1]
                    _reset_head(bank, weights, here, head, head_sigma)
                    _place_head(bank, here, count, phi, length)
                    real[_GYRO_REJECTED_SINCE] = math.nan
                    flags |= 1
        if stamp - real[_CAMERA_SEEN] > _SILENT_S:
            flags |= 2
        if stamp - real[_IMU_SEEN] > _SILENT_S:
            flags |= 4
        here = whole[_NEWEST]
        ahead = stamp - ring_t[here] if whole[_COUNT] > 0 else 0.0
        if whole[_COUNT] == 0:
            flags |= 64
        if abs(ahead) > 0.02:
            for m in range(count):
                weights[size, m] = weights[here, m]
                at = (size * count + m) * RECORD
                copy_level(bank, (here * count + m) * RECORD, at)
                predict(bank, at, levels, 0, m, walk, ahead)
            write_bank(bank, weights, size, 0.0, levels, radius, out, row)
        else:
            write_bank(bank, weights, here, ahead, levels, radius, out, row)
        if max(out[row, 10], out[row, 11]) > _KNOWN_M:
            flags |= 8
        out[row, 25] = flags
        out[row, 26], out[row, 27] = weights[here, count - 1], weights[here, 0]


def starting_state(setup: Setup, rows: Rows | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State (M, 19), covariance and weights before the first reading.

    Parameters
    ----------
    rows : where given, the first of them that the camera can be inverted for says where the head begins.
    """
    start, count = setup.start, len(setup.process.levels)
    mean = np.concatenate([start.head, start.sensor])
    # Pictures are put at their exposure, so that what is left of the offset is zero.
    mean[13] -= max(float(start.sensor[7]), 0.0)
    if rows is not None:
        for u, v in rows.readings[np.isfinite(rows.readings[:, :2]).all(axis=1)][:20, :2].tolist():
            phi, length, found = invert_marker(setup.view, mean[6:], u, v, 0.0, float(start.head[1]))
            if found and 0.2 * start.head[1] < length < 3.0 * start.head[1]:
                mean[0], mean[1] = phi, length
                break
    return np.tile(mean, (count, 1)), np.tile(start.covariance(), (count, 1, 1)), np.full(count, 1.0 / count)


class Filter:
    """A filter at work: rows in, estimates out, with memory of the last events only."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        levels, walk = setup.process.arrays()
        self._levels, self._walk = levels, walk
        delay = max(float(setup.start.sensor[7]), 0.0)
        self._delay = delay
        period = setup.imu_period_s if setup.imu_period_s > 0.0 else 0.002
        size = min(max(16, math.ceil(2.0 * (delay + 0.02) / period) + 8), 512)
        count = len(levels)
        # One slot more than the ring has, for what is only looked ahead.
        self._bank, self._w = new_bank(size + 1, count), np.zeros((size + 1, count + 1))
        self._w[:, :count] = 1.0 / count
        self._scratch = (
            np.empty(SIZE - 6), np.zeros((count, TOLD)), np.empty(len(REPORT)), np.empty(len(REPORT)),
            np.empty((0, 3, TRACE)),
        )  # fmt: skip
        self._t, self._z, self._gated = np.zeros(size), np.zeros((size, 3)), np.zeros((size, 3))
        self._kind, self._whole = np.zeros(size, dtype=np.int64), np.zeros(4, dtype=np.int64)
        self._real = np.full(5, np.nan)
        self._camera_clock = new_clock(setup.camera_period_s)
        self._imu_clock = new_clock(setup.imu_period_s)
        x, P, _ = starting_state(setup)
        put(self._bank, 0, x, P)

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        setup = self.setup
        out = np.empty((len(rows), len(OUT)))
        run_filter(
            rows.t_s, rows.readings, rows.kinds, self._bank, self._w, self._t, self._z, self._kind,
            self._gated, self._whole, self._real, self._camera_clock, self._imu_clock,
            setup.process.switch_hz, self._levels[None], self._walk, setup.view,
            np.array([setup.gravity_mps2, setup.lever_across_m]), setup.noise, setup.start.head,
            setup.start.head_sigma, setup.bellows_radius_m, self._delay, *self._scratch, out,
        )  # fmt: skip
        return out

    def stream(self, blocks: Iterable[Rows]) -> Iterator[FloatArray]:
        """Estimates of each block in turn."""
        for rows in blocks:
            yield self.run(rows)

    @property
    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State (M, 19), covariance (M, 19, 19) and weights (M,) after the last event."""
        here, count = int(self._whole[0]), len(self._levels)
        return *get(self._bank, here, count), self._w[here, :count].copy()


assert CLOCK_SIZE == 10
