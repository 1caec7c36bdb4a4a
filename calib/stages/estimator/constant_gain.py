"""The estimator with constant gain that the firmware runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.compilation import kernel
from calib.core.errors import BadInputError
from calib.stages.actuator.kinematics import chord_ratio_w
from calib.stages.camera.model import FISHEYE, Camera, undistort
from calib.stages.estimator.kinematic import Rows, Setup
from calib.stages.estimator.sensors import marker

# ----------------------------------------------------------------------
# Gains of the fused estimator of `calib.stages.estimator.constant_gain`: what it runs with, and how they
# are found.
#
# K_c, K_a, K_b are those of the stationary filter of (phi, b), which the gyroscope's turn carries from
# tick to
# tick, K_m, K_v of (l, v), and K_r of l alone. With P of the discrete algebraic Riccati equation they are
# K = P H' (H P H' + R)^-1 (Anderson and Moore 1979, 4.4). A picture that is D ticks late shows l - D v. The
# densities of the process noise were found by a random search for the least errors on simulated rigs whose
# parameters vary.

MOST_DELAY_TICKS = 8
MOVING_TICKS = 6
PATIENCE = 6
BOOST_TICKS, BOOST, ALONE = 8, 0.5, 0.25
SHAKING_RADPS2 = 6.0
"""Acceleration of the head that its accelerometer is trusted through."""

_TURN_WALK = 1.1e-3
_BIAS_WALK_RADPS = 2e-4
_REST_WALK_M, _MOVING_WALK_M, _MOVING_ACCEL = 3e-5, 5e-4, 1.5e-3
_RATE_MEMORY_S, _SLOW_S = 0.25, 0.16
_MOVING_SIGMA, _STILL_MPS, _GATE_M = 3.8, 4.4e-4, 5e-3


@dataclass(frozen=True)
class TickNoise:
    """Standard deviations of a tick's readings.

    Attributes
    ----------
    camera_rad, camera_m : of angle and length from a picture. gyro_radps : of the rate.
    accel_rad : of the accelerometer's angle, the head's own acceleration included.
    """

    camera_rad: float
    camera_m: float
    gyro_radps: float
    accel_rad: float


@dataclass(frozen=True)
class Gains:
    """What the estimator runs with; lengths are in metres, rates per tick.

    Attributes
    ----------
    rate_hz, delay_ticks : T = 1 / rate_hz, D. lever_m : l0 / 2 + d.
    camera_phi, accel_phi, bias : K_c, K_a, K_b.
    moving_length, moving_rate, rest_length, rate_decay : K_m, K_v, K_r, K_d.
    slow : K_s. moving_m, still_m : s_0, v_0. gate_m : of the residuals of a picture.
    """

    rate_hz: float
    delay_ticks: float
    lever_m: float
    camera_phi: float
    accel_phi: float
    bias: float
    moving_length: float
    moving_rate: float
    rest_length: float
    rate_decay: float
    slow: float
    moving_m: float
    still_m: float
    gate_m: float


def _stationary(F: FloatArray, Q: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """K (n, m) of the stationary filter."""
    from scipy.linalg import solve_discrete_are

    scale = np.sqrt(np.diag(Q))
    f, h, q = F / scale[:, None] * scale, H * scale, Q / scale[:, None] / scale
    unit = np.sqrt(np.diag(R))
    h, r = h / unit[:, None], R / unit[:, None] / unit
    P = solve_discrete_are(f.T, h.T, q, r)
    K = np.linalg.solve(h @ P @ h.T + r, h @ P).T
    return np.asarray(K * scale[:, None] / unit, dtype=np.float64)


def design(noise: TickNoise, rate_hz: float, delay_s: float, lever_m: float) -> Gains:
    """Gains for ticks of a rate and pictures that are late.

    Raises `BadInputError` for a rate that is not positive, and pictures more than `MOST_DELAY_TICKS` late or
    from the future.
    """
    if not rate_hz > 0.0:
        raise BadInputError(f"rate_hz is {rate_hz:g}, expected a positive rate of ticks")
    delay = delay_s * rate_hz
    if not 0.0 <= delay <= MOST_DELAY_TICKS:
        raise BadInputError(f"pictures are {delay:.3g} ticks late, expected 0 to {MOST_DELAY_TICKS}")
    T = 1.0 / rate_hz
    carried = np.array([[1.0, 1.0], [0.0, 1.0]])
    turned = (noise.gyro_radps * T) ** 2 + _TURN_WALK**2 * T
    phi = _stationary(
        carried,
        np.diag([turned, _BIAS_WALK_RADPS**2 * T**3]),
        np.array([[1.0, 0.0], [1.0, 0.0]]),
        np.diag([noise.camera_rad, noise.accel_rad]) ** 2,
    )
    camera = np.array([[noise.camera_m**2]])
    # The rate's noise per tick, of a white acceleration.
    force = _MOVING_ACCEL**2 * T**3
    moving = _stationary(
        carried,
        np.diag([_MOVING_WALK_M**2 * T + force / 3.0, force]),
        np.array([[1.0, -delay]]),
        camera,
    )
    rest = _stationary(np.eye(1), np.array([[_REST_WALK_M**2 * T]]), np.eye(1), camera)
    slow = 1.0 - math.exp(-T / _SLOW_S)
    return Gains(
        rate_hz=rate_hz,
        delay_ticks=delay,
        lever_m=lever_m,
        camera_phi=float(phi[0, 0]),
        accel_phi=float(phi[0, 1]),
        bias=float(phi[1, 0] / phi[0, 0]),
        moving_length=float(moving[0, 0]),
        moving_rate=float(moving[1, 0]),
        rest_length=float(rest[0, 0]),
        rate_decay=math.exp(-T / _RATE_MEMORY_S),
        slow=slow,
        moving_m=_MOVING_SIGMA * noise.camera_m * math.sqrt(slow / (2.0 - slow)),
        still_m=_STILL_MPS * T,
        gate_m=max(_GATE_M, 8.0 * noise.camera_m),
    )


# ----------------------------------------------------------------------
# The fused estimator with constant gains as the firmware runs it, on one picture and one IMU sample a tick.
#
# A camera that sees whole pixels tells the angle to half a degree, the gyroscope its change to a
# thousandth of
# that, and the accelerometer's angle is wrong while the head accelerates. So the gyroscope carries the
# angle,
# and pictures and accelerometer pull it, slowly. A picture belongs to the time of its exposure, D ticks
# ago:
# the angle of then is remembered, the residual taken there and added now. With (X, Y) the marker, d its
# offset,
# phi_D the angle D ticks ago and h = phi_D / 2, constant curvature (3.6), (A.1) gives to first order
#
#     X cos h - Y sin h - d sin h = (rho / 2 + d cos h) (angle - phi_D)        across the chord
#     X sin h + Y cos h - d cos h = l S(phi_D) - d sin h (angle - phi_D)        along it
#
# without root or arc tangent; the last term, 10 um for a tenth of a degree, is left out. A tick of T is
# then
#
#     phi += T (w + w') / 2 + b,              w = -(g_z - bias) / (1 + scale), w' that of the tick before
#     e_c = across / lever,                   lever = l0 / 2 + d
#     e_a = (a_y cos(phi_D + alpha) - a_x sin(phi_D + alpha)) / g - (phi - phi_D)
#     c = K_c e_c + K_a e_a,                  phi += c,  b += K_b c
#     l += v,  e_l = along - S (l - D v)
#     s += K_s (e_l - s),                     moving: |s| > s_0 or |v| > v_0, and for `MOVING_TICKS` after
# that
#     l += K_m e_l, v += K_v e_l moving,      else l += K_r e_l, v *= K_d
#
# The gains are those of `calib.stages.estimator.constant_gain`. One cannot serve a length at rest and in
# motion; the mean
# residual s tells which it is.
#
# A picture with |across| or |e_l| beyond `gate_m` is left out; after `PATIENCE` of them in a row the next
# one
# starts afresh. Then, and at the beginning, the length is that of the picture, and for `BOOST_TICKS`
# pictures
# angle and length go by `BOOST` of their residual. Without a picture v *= K_d, and without a sample of the
# IMU
# the angle stands but for `ALONE` of the pictures' residual.

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


def tick_noise(setup: Setup) -> TickNoise:
    """Noise of a tick's readings from that of the sensors, at the head's rest."""
    state, by = np.concatenate([setup.start.head, setup.start.sensor]), np.empty((2, 19))
    state[2:6] = 0.0
    marker(setup.view, state, by[0], by[1])
    inverse = np.linalg.inv(by[:, :2])
    pixel = setup.noise[0] ** 2 + setup.noise[1] ** 2 / 12.0
    camera = np.sqrt(pixel * np.sum(inverse**2, axis=1))
    reach = 0.5 * float(setup.start.head[1]) + float(setup.start.sensor[5])
    return TickNoise(
        float(camera[0]),
        float(camera[1]),
        float(setup.noise[4]),
        math.hypot(float(setup.noise[3]), SHAKING_RADPS2 * reach) / setup.gravity_mps2,
    )


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


def run_gains(gains: Gains, setup: Setup, ticks: Ticks, mean_rate: bool = False) -> FloatArray:
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
            setup.start.sensor[6], setup.start.head[1], setup.gravity_mps2, float(mean_rate),
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
