"""Smoother and filter of others on the events of a log: Rauch, Tung and Striebel by numpy, filterpy's UKF.

`unscented` has the noise of the compiled filter, whole readings at once and rounding as variance g^2 / 12:
not the same estimator, but one without a Jacobian.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.estimator.event import CAMERA, camera_terms, imu_terms
from calib.stages.estimator.kinematic import CONSIDERED, Rows, Setup, starting_state
from calib.stages.estimator.reference import process_noise, scalar_readings
from calib.stages.estimator.sensors import SIZE
from calib.stages.estimator.smoother import Events, transition


def extended_smoothed(
    setup: Setup, events: Events, x: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rauch, Tung and Striebel over the states of `extended` where what is considered has no variance.

    Inverts the predicted covariance of all that has one.
    """
    levels, walk = setup.process.arrays()
    x, P = x.copy(), P.copy()
    F, free = np.empty((SIZE, SIZE)), [i for i in range(SIZE) if i not in CONSIDERED]
    block = np.ix_(free, free)
    for k in range(len(x) - 2, -1, -1):
        dt = float(events.t_s[k + 1] - events.t_s[k])
        transition(levels[0], dt, F)
        before, f = P[k][block], F[block]
        ahead = f @ before @ f.T + process_noise(levels[0], walk, dt)[block]
        scale = 1.0 / np.sqrt(np.diag(ahead))
        gain = (before @ f.T * scale) @ np.linalg.inv(ahead * scale[:, None] * scale) * scale
        x[k, free] += gain @ (x[k + 1] - F @ x[k])[free]
        P[k][block] += gain @ (P[k + 1][block] - ahead) @ gain.T
    return x, P


def unscented(setup: Setup, rows: Rows, events: Events, gated: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States (n, 19) and covariances after each event, by filterpy's UKF (Julier's sigma points)."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    levels, walk = setup.process.arrays()
    start_x, start_P, _ = starting_state(setup, rows)
    points = MerweScaledSigmaPoints(SIZE, alpha=0.5, beta=2.0, kappa=0.0)
    F = np.eye(SIZE)

    def carry(x: FloatArray, _: float) -> FloatArray:
        return np.asarray(F @ x)

    def nothing(x: FloatArray) -> FloatArray:
        return x[:1]

    ukf: Any = UnscentedKalmanFilter(SIZE, 1, 1.0, hx=nothing, fx=carry, points=points)
    ukf.x, ukf.P = start_x[0].copy(), start_P[0].copy()
    n = len(events.t_s)
    x, P = np.empty((n, SIZE)), np.empty((n, SIZE, SIZE))
    for k in range(n):
        dt = float(events.t_s[k] - events.t_s[k - 1]) if k else 0.0
        transition(levels[0], dt, F)
        ukf.Q = process_noise(levels[0], walk, dt)
        ukf.predict()
        kind = int(events.kinds[k])
        # filterpy keeps the points of the process; readings need those of the predicted covariance.
        ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
        if kind and not gated[k, 0 if kind == CAMERA else 1]:
            z = events.readings[k, : 2 if kind == CAMERA else 3]
            base = scalar_readings(setup, kind, events.readings[k], ukf.x, ukf.P)
            order = [0, 1] if kind == CAMERA else [2, 0, 1]
            R = np.zeros(len(order))
            for place, reading in zip(order, base, strict=True):
                R[place] = reading[3] + (setup.noise[1] ** 2 / 12.0 if kind == CAMERA else 0.0)

            def read(state: FloatArray, kind: int = kind) -> FloatArray:
                H, out, none = np.empty((3, SIZE)), np.empty(SIZE), np.zeros((SIZE, SIZE))
                if kind == CAMERA:
                    camera_terms(setup.view, setup.noise, setup.noise[6] ** 2, state, none, H, out)
                    return out[:2].copy()
                imu_terms(setup.noise, setup.noise[7] ** 2, state, none, H, out)
                return out[:3].copy()

            held = list(CONSIDERED)
            kept_x, kept_P = ukf.x[held].copy(), ukf.P[np.ix_(held, held)].copy()
            ukf._dim_z = len(z)
            ukf.update(z, R=np.diag(R), hx=read)
            ukf.x[held], ukf.P[np.ix_(held, held)] = kept_x, kept_P
        x[k], P[k] = ukf.x, ukf.P
    return x, P
