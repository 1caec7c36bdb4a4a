"""The estimator with constant gain that the firmware runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.stages.estimator.kinematic import Setup
from calib.stages.estimator.section import EstimatorGain
from calib.stages.estimator.sensors import GRAVITY_MPS2, SIZE, marker

# ----------------------------------------------------------------------
# Gains of the fused estimator: what it runs with, and how they are found.
#
# K_c, K_a, K_b are those of the stationary filter of (phi, b), which the gyroscope's turn carries from tick
# to tick, K_m, K_v of (l, v), and K_r of l alone. With P of the discrete algebraic Riccati equation they are
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


def design(noise: TickNoise, rate_hz: float, delay_s: float, lever_m: float) -> EstimatorGain:
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
    return EstimatorGain(
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
# A camera that sees whole pixels tells the angle to half a degree, the gyroscope its change to a thousandth
# of that, and the accelerometer's angle is wrong while the head accelerates. So the gyroscope carries the
# angle, and pictures and accelerometer pull it, slowly. A picture belongs to the time of its exposure, D
# ticks ago: the angle of then is remembered, the residual taken there and added now. With (X, Y) the marker,
# d its offset, phi_D the angle D ticks ago and h = phi_D / 2, constant curvature (3.6), (A.1) gives to first
# order
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
# One gain cannot serve a length at rest and in motion; the mean residual s tells which it is.
#
# A picture with |across| or |e_l| beyond `gate_m` is left out; after `PATIENCE` of them in a row the next one
# starts afresh. Then, and at the beginning, the length is that of the picture, and for `BOOST_TICKS` pictures
# angle and length go by `BOOST` of their residual. Without a picture v *= K_d, and without a sample of the
# IMU the angle stands but for `ALONE` of the pictures' residual.


def tick_noise(setup: Setup) -> TickNoise:
    """Noise of a tick's readings from that of the sensors, at the head's rest."""
    state, by = np.concatenate([setup.start.head, setup.start.sensor]), np.empty((2, SIZE))
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
        math.hypot(float(setup.noise[3]), SHAKING_RADPS2 * reach) / GRAVITY_MPS2,
    )
