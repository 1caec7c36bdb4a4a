"""The same recursion on filterpy, for one level of process noise: `calib replay --estimator filterpy`.

Readings leave `kinematic.CONSIDERED` alone in both. `extended` runs filterpy's ExtendedKalmanFilter over the
events of a log: predict with F and Q of `model`, then each scalar reading in turn, a rounded pixel as its
equivalent Gaussian reading. It agrees with the compiled filter to rounding.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.estimator import kinematic
from calib.stages.estimator.event import CAMERA, camera_terms, imu_terms, stamp_variance
from calib.stages.estimator.sensors import SIZE, update_terms
from calib.stages.estimator.smoother import Events, events_of, one_level, transition


def process_noise(level: FloatArray, walk: FloatArray, dt: float) -> FloatArray:
    """Q (20, 20) over dt [s], steps of more than `kinematic.LARGEST_STEP_S` in parts."""
    Q, F, part = np.zeros((SIZE, SIZE)), np.empty((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    if not dt > 0.0:
        return Q
    parts = max(math.ceil(dt / kinematic.LARGEST_STEP_S - 1e-9), 1)
    transition(level, dt / parts, F)
    for axis in range(2):
        pp, pv, pa, vv, va, aa = kinematic.axis_noise(level[4 * axis + 2], level[4 * axis + 3], dt / parts)
        rows = [axis, axis + 2, axis + 4]
        part[np.ix_(rows, rows)] = [[pp, pv, pa], [pv, vv, va], [pa, va, aa]]
    part[range(6, SIZE), range(6, SIZE)] = walk * dt / parts
    for _ in range(parts):
        Q = F @ Q @ F.T + part
    return Q


def scalar_readings(
    setup: kinematic.Setup, kind: int, z: FloatArray, x: FloatArray, P: FloatArray
) -> list[tuple[float, float, FloatArray, float, bool]]:
    """Each reading of an event: value, prediction, gradient, variance of its noise, whether rounded."""
    noise, out = setup.noise, np.empty(SIZE)
    H = np.empty((3, SIZE))
    if kind == CAMERA:
        camera_terms(setup.view, noise, stamp_variance(kind, noise, z), x, P, H, out)
        return [(z[k], out[k], H[k].copy(), out[3 + k], True) for k in range(2)]
    imu_terms(noise, stamp_variance(kind, noise, z), x, P, H, out)
    return [(z[k], out[k], H[k].copy(), out[3 + k], False) for k in (2, 0, 1) if not math.isnan(z[k])]


def extended(
    setup: kinematic.Setup, rows: kinematic.Rows, events: Events, gated: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (n, 20) and covariances (n, 20, 20) after each event, by filterpy's EKF.

    Parameters
    ----------
    gated : (n, 3) readings that stay out, as the compiled filter found them.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    levels, walk = setup.process.arrays()
    start_x, start_P, _ = kinematic.starting_state(setup, rows)
    ekf: Any = ExtendedKalmanFilter(dim_x=SIZE, dim_z=1)
    ekf.x, ekf.P = start_x[0].copy(), start_P[0].copy()
    held = list(kinematic.CONSIDERED)
    n = len(events.t_s)
    x, P, F = np.empty((n, SIZE)), np.empty((n, SIZE, SIZE)), np.empty((SIZE, SIZE))
    for k in range(n):
        dt = float(events.t_s[k] - events.t_s[k - 1]) if k else 0.0
        transition(levels[0], dt, F)
        ekf.F, ekf.Q = F.copy(), process_noise(levels[0], walk, dt)
        ekf.predict()
        kind = int(events.kinds[k])
        if kind:
            before = ekf.x.copy()
            readings = scalar_readings(setup, kind, events.readings[k], before, ekf.P)
            for place, (z, predicted, H, variance, rounded) in enumerate(readings):
                sensor = (
                    0 if kind == CAMERA else 2 if place == 0 and not math.isnan(events.readings[k, 2]) else 1
                )
                if gated[k, sensor]:
                    continue
                expected = predicted + float(H @ (ekf.x - before))
                if rounded:
                    spread = float(H @ ekf.P @ H)
                    y, S, _ = update_terms(z - expected, spread, variance, setup.noise[1])
                    z, variance = expected + y, S - spread
                kept_x, kept_P = ekf.x[held].copy(), ekf.P[np.ix_(held, held)].copy()
                ekf.update(
                    np.array([z]),
                    lambda _, H=H: H[None, :],
                    lambda _, h=expected: np.array([h]),
                    R=np.array([[variance]]),
                )
                ekf.x[held], ekf.P[np.ix_(held, held)] = kept_x, kept_P
        x[k], P[k] = ekf.x, ekf.P
    return x, P


def replayed(setup: kinematic.Setup, rows: kinematic.Rows) -> tuple[FloatArray, float]:
    """Estimates (n, len(OUT)) of `extended` at the rows' stamps, and how far the compiled filter is away.

    The last level of process noise alone follows any motion. Pictures stand at their exposure and wait for
    nobody, readings that the compiled filter gates stay out. The difference is the largest of all states and
    covariances, in standard deviations. A row takes a millisecond and 6 kB.
    """
    setup = replace(setup, process=replace(setup.process, levels=setup.process.levels[-1:]))
    events = events_of(setup, rows)
    ours = one_level(setup, rows, events)
    x, P = extended(setup, rows, events, ours.gated)
    own = events.kinds == 0
    out = np.full((len(rows), len(kinematic.OUT)), np.nan)
    out[:, 0], out[:, kinematic.OUT.index("flags")] = rows.t_s, 0.0
    kinematic.write_columns(x[own], P[own], 6, events.rows[own], setup.bellows_radius_m, out)
    sigma = np.sqrt(np.diagonal(ours.P, axis1=1, axis2=2))
    apart = np.abs((x - ours.x) / sigma).max()
    return out, float(max(apart, np.abs((P - ours.P) / (sigma[:, :, None] * sigma[:, None, :])).max()))
