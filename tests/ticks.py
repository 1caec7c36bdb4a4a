"""The fused estimator with constant gain once more, in float64 and compiled, on the ticks of a log.

It is written from the equations of `calib.stages.estimator.constant_gain` alone and knows no header: what
`calib.stages.firmware.conformance`, and so every board, is held against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.stages.actuator.kinematics import chord_ratio_w
from calib.stages.camera.model import FISHEYE, Camera, undistort
from calib.stages.estimator.constant_gain import ALONE, BOOST, BOOST_TICKS, MOVING_TICKS, PATIENCE
from calib.stages.estimator.kinematic import Rows, Setup
from calib.stages.estimator.section import EstimatorGain
from calib.stages.estimator.sensors import GRAVITY_MPS2

GAINED = ("phi_rad", "length_m", "bias_rad", "rate_m")
"""Columns of what `run_gains` gives; bias and rate are per tick."""


@dataclass(frozen=True)
class Ticks:
    """Readings at the ticks (n,), NaN where missing; marker (n, 2) in the plane, accelerometer (n, 2).

    The IMU's are free of bias, scale and mount: a_x, a_y as at phi, and the rate w of phi.
    """

    t_s: FloatArray
    marker_m: FloatArray
    accel_mps2: FloatArray
    rate_radps: FloatArray


def _camera_of(view: FloatArray) -> tuple[Camera, FloatArray]:
    """The camera of `sensors.view_coefficients`, and the homography (3, 3) from its rays to the plane."""
    fx, fy, skew, cx, cy = (float(value) for value in view[9:14])
    model = FISHEYE if view[24] else "rational8"
    camera = Camera(model, (1, 1), fx, fy, skew, cx, cy, np.asarray(view[14:22], dtype=np.float64))
    return camera, np.asarray(np.linalg.inv(view[:9].reshape(3, 3).T), dtype=np.float64)


def ticks_of(setup: Setup, rows: Rows, mean_rate: bool = False) -> Ticks:
    """A tick at each picture or camera's tick of a log with the IMU's newest sample, as controllers see it.

    Parameters
    ----------
    mean_rate : the rate is the mean since the last tick instead, of all samples, carried on to the tick by
        the last two.
    """
    at = np.flatnonzero(rows.kinds & 1)
    sensor, t = setup.start.sensor, rows.t_s[at]
    camera, to_plane = _camera_of(setup.view)
    places, pixels = np.full((len(at), 2), np.nan), rows.readings[at, :2]
    seen = np.isfinite(pixels).all(axis=1)
    if seen.any():
        rays = undistort(camera, pixels[seen])
        world = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ to_plane.T
        middle = setup.view[22:24]
        shown = world[:, :2] / world[:, 2:] - sensor[8:10]
        places[seen] = middle + (shown - middle) / (1.0 + sensor[10])
    samples = np.flatnonzero(np.isfinite(rows.readings[:, 2:5]).all(axis=1))
    accel, rate = np.full((len(at), 2), np.nan), np.full(len(at), np.nan)
    if len(samples):
        newest = np.searchsorted(samples, at, side="right") - 1
        fresh = (newest >= 0) & (np.diff(newest, prepend=-1) > 0)
        own = newest[fresh]
        force = (rows.readings[samples, 2:4] - sensor[1:3]) / (1.0 + sensor[11:13])
        ca, sa = math.cos(float(sensor[3])), math.sin(float(sensor[3]))
        force = force @ np.array([[ca, -sa], [sa, ca]])
        turning = -(rows.readings[samples, 4] - sensor[0]) / (1.0 + sensor[4])
        accel[fresh], rate[fresh] = force[own], turning[own]
        if mean_rate:
            rate = _means(t, newest, fresh, rows.t_s[samples], turning, setup.imu_period_s)
    return Ticks(t, places, accel, rate)


def _means(
    t: FloatArray, newest: IntArray, fresh: BoolArray, at: FloatArray, rate: FloatArray, period: float
) -> FloatArray:
    """Mean rates between ticks (n,) from even samples (m,), integrated by the trapezoid."""
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * period])
    slope = np.diff(rate, prepend=rate[0]) / period
    k = np.maximum(newest, 0)
    age = np.clip(t - at[k], 0.0, 1.2 * period)
    angle = turned[k] + (rate[k] + 0.5 * slope[k] * age) * age
    out = np.full(len(t), np.nan)
    out[1:] = np.diff(angle) / np.maximum(np.diff(t), 1e-6)
    out[~fresh] = np.nan
    if len(t):
        out[0] = rate[k[0]] if fresh[0] else np.nan
    return out


def run_gains(gains: EstimatorGain, setup: Setup, ticks: Ticks, mean_rate: bool = False) -> FloatArray:
    """Estimates (n, len(GAINED)) after each tick.

    Parameters
    ----------
    mean_rate : the ticks' rates are means, see `ticks_of`.
    """
    g = gains
    numbers = np.array(
        [
            g.rate_hz, g.delay_ticks, g.lever_m, g.camera_phi, g.accel_phi, g.bias, g.moving_length,
            g.moving_rate, g.rest_length, g.rate_decay, g.slow, g.moving_m, g.still_m, g.gate_m,
            setup.start.sensor[6], setup.start.head[1], GRAVITY_MPS2, float(mean_rate),
        ]
    )  # fmt: skip
    out = np.empty((len(ticks.t_s), len(GAINED)))
    _run(numbers, ticks.marker_m, ticks.accel_mps2, ticks.rate_radps, out)
    return out


@kernel()
def _run(n: FloatArray, places: FloatArray, accel: FloatArray, rate: FloatArray, out: FloatArray) -> None:
    T, delay, lever, K_c, K_a, K_b = 1.0 / n[0], n[1], n[2], n[3], n[4], n[5]
    K_m, K_v, K_r, K_d, K_s, s_0, v_0, gate = n[6], n[7], n[8], n[9], n[10], n[11], n[12], n[13]
    d, gravity, mean_rate, hold = n[14], n[16], n[17] != 0.0, round(n[0])
    line = math.ceil(delay)
    past = np.zeros(line + 1)
    phi = bias = v = slow = before = 0.0
    length = n[15]
    # Ticks since the last good sample and picture; both begin beyond what is held.
    imu_age, marker_age, boost, moving, rejected = hold + 1, hold + 1, 0, 0, 0
    for k in range(len(rate)):
        here = not (math.isnan(rate[k]) or math.isnan(accel[k, 0]) or math.isnan(accel[k, 1]))
        if here:
            w = rate[k]
            if imu_age > hold and marker_age > hold:
                phi = math.atan2(accel[k, 1], accel[k, 0])
                past[:] = phi
            else:
                phi += T * (w if mean_rate else 0.5 * (w + (before if imu_age == 0 else w))) + bias
            before, imu_age = w, 0
        else:
            imu_age += 1
        past[line] = phi
        then = phi if line == 0 else past[0] + (line - delay) * (past[1] - past[0])
        sh, ch = math.sin(0.5 * then), math.cos(0.5 * then)
        c = 0.0
        if here:
            e = (accel[k, 1] * math.cos(then) - accel[k, 0] * math.sin(then)) / gravity - (phi - then)
            c = K_a * min(max(e, -1.0), 1.0)
        length += v
        X, Y = places[k]
        if math.isnan(X):
            v *= K_d
            marker_age += 1
        else:
            across, along = X * ch - Y * sh - d * sh, X * sh + Y * ch - d * ch
            s = chord_ratio_w(then * then)
            if marker_age > hold or rejected >= PATIENCE:
                length, v, slow = along / s, 0.0, 0.0
                boost, moving, rejected = BOOST_TICKS, MOVING_TICKS, 0
            e = along - s * (length - delay * v)
            if boost > 0:
                boost -= 1
                marker_age = 0
                c = min(max(BOOST * across / lever, -BOOST), BOOST)
                length += BOOST * e
            elif abs(across) <= gate and abs(e) <= gate:
                rejected = marker_age = 0
                c = c + K_c * across / lever if here else ALONE * across / lever
                slow += K_s * (e - slow)
                if abs(slow) > s_0 or abs(v) > v_0:
                    moving = MOVING_TICKS
                elif moving > 0:
                    moving -= 1
                if moving > 0:
                    length += K_m * e
                    v += K_v * e
                else:
                    length += K_r * e
                    v *= K_d
            else:
                rejected += 1
                marker_age += 1
                v *= K_d
        if here and boost == 0:
            bias += K_b * c
        phi += c
        for j in range(line):
            past[j] = past[j + 1] + c
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = phi, length, bias, v
