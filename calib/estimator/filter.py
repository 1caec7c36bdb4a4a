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
from numba import njit

from calib.arrays import FloatArray, IntArray
from calib.estimator.clock import CLOCK_SIZE, advance, new_clock, restart
from calib.estimator.kernel import CAMERA, IMU, TRACE, WORK, event
from calib.estimator.model import axis_noise, axis_transition, mix, predict
from calib.estimator.sensors import SIZE, head_position, invert_marker
from calib.estimator.setup import OUT, Rows, Setup

__all__ = ["Filter", "run_filter", "starting_state", "write_columns"]

_SILENT_S = 0.5
_JUMP_S = (-0.1, 2.0)
_LOCKED_OUT_S = 0.5
_KNOWN_M = 0.05
"""A length with a larger deviation than this is as good as unknown."""
_LAST, _CAMERA_SEEN, _IMU_SEEN, _REJECTED_SINCE, _GYRO_REJECTED_SINCE = range(5)
_NEWEST, _COUNT, _CAMERA_STARTED, _PENDING = range(4)


@njit(cache=True, nogil=True, error_model="numpy")
def _reset_head(
    x: FloatArray, P: FloatArray, weight: FloatArray, head: FloatArray, sigma: FloatArray
) -> None:
    """Forget the head's motion; what is known of the sensors stays."""
    for m in range(x.shape[0]):
        for i in range(6):
            x[m, i] = head[i]
            for j in range(x.shape[1]):
                P[m, i, j] = 0.0
                P[m, j, i] = 0.0
            P[m, i, i] = sigma[i] * sigma[i]
        weight[m] = 1.0 / x.shape[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _hold(x: FloatArray, P: FloatArray, k: int, middle: float, sigma: float) -> None:
    """Use the prior of one quantity as a reading."""
    n = x.shape[0]
    S = P[k, k] + sigma * sigma
    root = 1.0 / math.sqrt(S)
    p = np.empty(n)
    for j in range(n):
        p[j] = P[k, j] * root
    move = (middle - x[k]) * root
    for i in range(n):
        x[i] += p[i] * move
        for j in range(n):
            P[i, j] -= p[i] * p[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _mend(x: FloatArray, P: FloatArray, head: FloatArray, head_sigma: FloatArray) -> int:
    """Whether the state is still one, and what is done where it is not: flags."""
    flags = 0
    for m in range(x.shape[0]):
        if P[m, 0, 0] > 1.0:
            _hold(x[m], P[m], 0, head[0], 0.7)
            flags |= 8
        if P[m, 1, 1] > (1.5 * head_sigma[1]) ** 2:
            _hold(x[m], P[m], 1, head[1], head_sigma[1])
            flags |= 8
        good = abs(x[m, 0]) < 3.0 and 1e-3 < x[m, 1] < 1.0
        for i in range(x.shape[1]):
            good = good and abs(x[m, i]) < 1e6 and P[m, i, i] > 0.0
        if not good:
            # A level that has left the model starts again from the prior, all of it.
            for i in range(x.shape[1]):
                if i < 6:
                    x[m, i] = head[i]
                elif not abs(x[m, i]) < 1e6:
                    x[m, i] = 0.0
                for j in range(x.shape[1]):
                    P[m, i, j] = 0.0
                P[m, i, i] = head_sigma[i] ** 2 if i < 6 else 1e-2
            flags |= 1
    return flags


@njit(cache=True, nogil=True, error_model="numpy")
def _write(
    x: FloatArray, P: FloatArray, weight: FloatArray, dt: float, levels: FloatArray, radius: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Means and deviations of the bank a short time dt after its last event into columns 1 to 12."""
    count = x.shape[0]
    phi = length = dphi = dl = bias = pp = ll = pl = 0.0
    for turn in range(2):
        for m in range(count):
            a01, a02, a11, a12, _ = axis_transition(levels[m, 0], levels[m, 1], dt)
            b01, b02, b11, b12, _ = axis_transition(levels[m, 4], levels[m, 5], dt)
            s = x[m]
            phi_m = s[0] + a01 * s[2] + a02 * s[4]
            length_m = s[1] + b01 * s[3] + b02 * s[5]
            w = weight[m]
            if turn == 0:
                phi += w * phi_m
                length += w * length_m
                dphi += w * (a11 * s[2] + a12 * s[4])
                dl += w * (b11 * s[3] + b12 * s[5])
                bias += w * s[6]
                continue
            C = P[m]
            var_p = (
                C[0, 0] + a01 * a01 * C[2, 2] + a02 * a02 * C[4, 4]
                + 2.0 * (a01 * C[0, 2] + a02 * C[0, 4] + a01 * a02 * C[2, 4])
            )  # fmt: skip
            var_l = (
                C[1, 1] + b01 * b01 * C[3, 3] + b02 * b02 * C[5, 5]
                + 2.0 * (b01 * C[1, 3] + b02 * C[1, 5] + b01 * b02 * C[3, 5])
            )  # fmt: skip
            cross = C[0, 1] + b01 * C[0, 3] + b02 * C[0, 5]
            cross += a01 * (C[2, 1] + b01 * C[2, 3] + b02 * C[2, 5])
            cross += a02 * (C[4, 1] + b01 * C[4, 3] + b02 * C[4, 5])
            if dt > 0.0:
                var_p += axis_noise(levels[m, 2], levels[m, 3], dt)[0]
                var_l += axis_noise(levels[m, 6], levels[m, 7], dt)[0]
            pp += w * (var_p + (phi_m - phi) ** 2)
            ll += w * (var_l + (length_m - length) ** 2)
            pl += w * (cross + (phi_m - phi) * (length_m - length))
    r = radius
    out[1], out[2] = length + r * phi, length - r * phi
    out[3], out[4] = dl + r * dphi, dl - r * dphi
    out[5], out[6] = phi, length
    out[7], out[8] = head_position(phi, length)
    out[9] = bias
    out[10] = math.sqrt(max(ll + r * r * pp + 2.0 * r * pl, 1e-18))
    out[11] = math.sqrt(max(ll + r * r * pp - 2.0 * r * pl, 1e-18))
    out[12] = math.sqrt(max(pp, 1e-18))


@njit(cache=True, nogil=True, error_model="numpy")
def run_filter(
    t: FloatArray, readings: FloatArray, kinds: IntArray,
    ring_x: FloatArray, ring_P: FloatArray, ring_w: FloatArray, ring_t: FloatArray, ring_z: FloatArray,
    ring_kind: IntArray, ring_gated: FloatArray, whole: IntArray, real: FloatArray,
    camera_clock: FloatArray, imu_clock: FloatArray,
    switch_hz: float, levels: FloatArray, walk: FloatArray, view: FloatArray, constants: FloatArray,
    noise: FloatArray, head: FloatArray, head_sigma: FloatArray, radius: float, delay: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Rows (n,), (n, 5), (n,) through the ring of the last events; writes `out` (n, len(OUT))."""
    size, count, n = ring_x.shape
    work, report, spare = np.zeros((count, WORK, n)), np.empty(12), np.empty(12)
    untraced = np.empty((0, TRACE))
    spare_x, spare_P, spare_w = np.empty((count, n)), np.empty((count, n, n)), np.empty(count)
    z = np.empty(3)
    for row in range(len(t)):
        stamp = t[row]
        flags = 0
        for k in range(out.shape[1]):
            out[row, k] = math.nan
        out[row, 0] = stamp
        step = stamp - real[_LAST]
        if step < _JUMP_S[0] or step > _JUMP_S[1]:
            restart(camera_clock)
            restart(imu_clock)
            newest = whole[_NEWEST]
            _reset_head(ring_x[newest], ring_P[newest], ring_w[newest], head, head_sigma)
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
                z[0], z[1], z[2] = readings[row, 0], readings[row, 1], math.nan
                if math.isnan(z[0]) or math.isnan(z[1]):
                    continue
                real[_CAMERA_SEEN] = stamp
            else:
                when = advance(imu_clock, stamp)
                z[0], z[1], z[2] = readings[row, 2], readings[row, 3], readings[row, 4]
                if math.isnan(z[2]) and (math.isnan(z[0]) or math.isnan(z[1])):
                    continue
                real[_IMU_SEEN] = stamp
            newest = whole[_NEWEST]
            if whole[_COUNT] == 0:
                ring_t[newest], ring_kind[newest] = when, 0
                whole[_COUNT] = 1
                if kind == IMU and not math.isnan(z[0]) and math.hypot(z[0], z[1]) > 1.0:
                    tilt = math.atan2(z[1], z[0]) - ring_x[newest, 0, 9]
                    for m in range(count):
                        ring_x[newest, m, 0] = min(max(math.atan2(math.sin(tilt), math.cos(tilt)), -1.5), 1.5)
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
            for k in range(3):
                ring_z[own, k] = z[k]
            begin_camera = kind == CAMERA and (whole[_CAMERA_STARTED] == 0 or whole[_PENDING] == 1)
            for i in range(back + 1):
                now = (newest + 1 - back + i) % size
                before = (now - 1) % size
                if i == 0 and begin_camera:
                    sensor, angle = ring_x[before, 0, 6:], ring_x[before, 0, 0]
                    phi, length, found = invert_marker(view, sensor, z[0], z[1], angle, head[1])
                    if not found:
                        phi, length, found = invert_marker(view, sensor, z[0], z[1], 0.0, head[1])
                    if found and 0.2 * head[1] < length < 3.0 * head[1]:
                        if whole[_CAMERA_STARTED] == 1:
                            flags |= 1
                        _reset_head(ring_x[before], ring_P[before], ring_w[before], head, head_sigma)
                        for m in range(count):
                            ring_x[before, m, 0], ring_x[before, m, 1] = phi, length
                        whole[_CAMERA_STARTED], whole[_PENDING] = 1, 0
                event(
                    ring_x[before], ring_P[before], ring_w[before], ring_x[now], ring_P[now], ring_w[now],
                    ring_kind[now], ring_z[now], ring_t[now] - ring_t[before], switch_hz, levels, walk, view,
                    constants, noise, work, i > 0, report if i == 0 else spare, ring_gated[now], untraced,
                )  # fmt: skip
                flags |= _mend(ring_x[now], ring_P[now], head, head_sigma)
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
                    phi, length = ring_x[here, 0, 0], ring_x[here, 0, 1]
                    _reset_head(ring_x[here], ring_P[here], ring_w[here], head, head_sigma)
                    for m in range(count):
                        ring_x[here, m, 0], ring_x[here, m, 1] = phi, length
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
            mix(ring_x[here], ring_P[here], ring_w[here], spare_x, spare_P, spare_w, 0.0)
            for m in range(count):
                predict(spare_x[m], spare_P[m], levels[m], walk, ahead)
            _write(spare_x, spare_P, spare_w, 0.0, levels, radius, out[row])
        else:
            _write(ring_x[here], ring_P[here], ring_w[here], ahead, levels, radius, out[row])
        if max(out[row, 10], out[row, 11]) > _KNOWN_M:
            flags |= 8
        out[row, 25] = flags
        out[row, 26], out[row, 27] = ring_w[here, count - 1], ring_w[here, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def write_columns(
    x: FloatArray, P: FloatArray, levels: FloatArray, rows: IntArray, radius: float, out: FloatArray
) -> None:
    """States (k, n) and covariances (k, n, n) into columns 1 to 12 of these rows (k,) of `out`."""
    one = np.ones(1)
    for k in range(len(rows)):
        _write(x[k : k + 1], P[k : k + 1], one, 0.0, levels[k : k + 1], radius, out[rows[k]])


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
        self._x, self._P = np.zeros((size, count, SIZE)), np.zeros((size, count, SIZE, SIZE))
        self._w = np.full((size, count), 1.0 / count)
        self._t, self._z, self._gated = np.zeros(size), np.zeros((size, 3)), np.zeros((size, 3))
        self._kind, self._whole = np.zeros(size, dtype=np.int64), np.zeros(4, dtype=np.int64)
        self._real = np.full(5, np.nan)
        self._camera_clock = new_clock(setup.camera_period_s)
        self._imu_clock = new_clock(setup.imu_period_s)
        self._x[0], self._P[0], self._w[0] = starting_state(setup)

    def run(self, rows: Rows) -> FloatArray:
        """Estimates (n, len(OUT)) at the rows' stamps; call again with the rows that follow."""
        setup = self.setup
        out = np.empty((len(rows), len(OUT)))
        run_filter(
            rows.t_s, rows.readings, rows.kinds, self._x, self._P, self._w, self._t, self._z, self._kind,
            self._gated, self._whole, self._real, self._camera_clock, self._imu_clock,
            setup.process.switch_hz,
            self._levels, self._walk, setup.view, np.array([setup.gravity_mps2, setup.lever_across_m]),
            setup.noise, setup.start.head, setup.start.head_sigma, setup.bellows_radius_m, self._delay, out,
        )  # fmt: skip
        return out

    def stream(self, blocks: Iterable[Rows]) -> Iterator[FloatArray]:
        """Estimates of each block in turn."""
        for rows in blocks:
            yield self.run(rows)

    @property
    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """State (M, 19), covariance (M, 19, 19) and weights (M,) after the last event."""
        here = int(self._whole[0])
        return self._x[here].copy(), self._P[here].copy(), self._w[here].copy()


assert CLOCK_SIZE == 10
