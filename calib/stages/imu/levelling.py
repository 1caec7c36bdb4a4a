"""The levelling filter of the angle: a gyroscope levelled by a velocity that stays bounded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import kernel
from calib.core.units import GRAVITY_MPS2

# ----------------------------------------------------------------------
# What an accelerometer shows of the angle is right on the average only: its errors are the sensor's own
# accelerations, over g. The filter (2.3) treats them as white noise. They are not: they are the derivative
# of a velocity, and an instrument that stays on a table has a velocity that stays bounded. So the filter
# integrates the difference between the accelerometer's angle and its own,
#
#     phi' = w + I + K1 V,   I' = K2 V,   V' = (phi_acc - phi) - K0 V,
#
# and takes V, which is velocity / g plus the integral of the angle's error [rad s], for a measurement of
# zero with the velocity's noise. It is the third-order levelling loop of inertial navigation (Britting,
# Inertial Navigation Systems Analysis, 1971, section 7.2) without the Earth's rate. An acceleration of 0.2 s
# and back reaches the angle by a tenth of what (2.3) with the same time constant lets through.
#
# With a density r of the velocity, q of the rate's error in motion and q_b of the bias' walk the gains are
# those of the Kalman filter of (V, angle's error, bias). Without a bias it settles to the poles of
# s^2 + sqrt(2) w0 s + w0^2, w0^4 = q / r, which is what the time constant tau = sqrt(2) / w0 names. The
# gains start large, from what is known before the first sample, and settle as the bias gets known.
#
# In three axes the angle's place is taken by the up vector u in the sensor's axes, V is a vector in them too,
# phi_acc - phi becomes a / g - u, and both turn with the sensor,
#
#     u' = u x (w - b) + K1 V,   V' = V x (w - b) + (a / g - u) - K0 V.
#
# K0 and K1 are those of a bias that is known, for all directions alike. The bias is found apart (Friedland,
# IEEE Trans. Automatic Control 14(4), 1969): V_b and u_b are what an error of each axis' bias has done to V
# and u since the start, so that V / (V_b) measures the bias, and M is its covariance. A bias about the
# vertical does not show until the sensor has turned, and its gain stays open until then; gains alike for all
# directions closed by then, and left 2 degrees of a bias of 5 deg/s. A log that begins in a swing begins
# with forces of any size and direction, so that V is not held in its first seconds.
#
# An acceleration that is held moves V beyond what a velocity and the angle's error allow. In three axes |V|
# is held to three of its standard deviations, that of V and that of the velocity together, so that 0.3 g for
# 3 s turns the angle by 4 degrees and not by 15. Its own mean size over the last minute makes way for motion
# that is faster than was foreseen: a log that begins in a swing of 1 m/s was 3 to 5 degrees off. What is cut
# from V says nothing of the bias. Where the cuts add up to a velocity that nothing on a table has, the angle
# is what is wrong, as after a gyroscope that was beyond its range, and the filter starts anew with the bias
# that it has; so it does after a gap. The filter in the plane, which a board runs, does without a bound: an
# angle that is 40 degrees off after the sensor was lost would take half a minute to come back.

_TURN = 2.0 * math.pi
_LASTING_S = 0.3
"""Time for which a velocity lasts: its density is 2 sigma^2 times this."""
_MOST_SIGMAS, _ANY_MPS = 3.0, 0.1
_MOST_SIZES, _MEMORY_S = 3.75, 60.0
"""Three deviations of what is normally distributed are this many of its mean sizes."""


@dataclass(frozen=True)
class Levelling:
    """Parameters of the filter.

    Attributes
    ----------
    tau_s : time constant of the settled angle.
    velocity_mps : standard deviation of the sensor's velocity; with the next two it makes the start.
    angle_rad, bias_radps : standard deviations of the angle and of the rate's bias at the first sample.
    bias_tau_s : time constant of the settled bias.
    """

    tau_s: float = 2.0
    velocity_mps: float = 0.1
    angle_rad: float = 0.1
    bias_radps: float = 0.02
    bias_tau_s: float = 25.0

    @property
    def densities(self) -> tuple[float, float, float]:
        """r [rad^2 s^3], q [rad^2/s] and q_b [rad^2/s^3]."""
        r = 2.0 * (self.velocity_mps / GRAVITY_MPS2) ** 2 * _LASTING_S
        q = r * (math.sqrt(2.0) / self.tau_s) ** 4
        return r, q, q / self.bias_tau_s**2

    @property
    def start(self) -> tuple[float, float, float]:
        """Variances of V, the angle's error and the bias at the first sample."""
        return (self.velocity_mps / GRAVITY_MPS2) ** 2, self.angle_rad**2, self.bias_radps**2

    def fill(
        self, t: FloatArray, phi_acc: FloatArray, w: FloatArray, phi: FloatArray, integral: FloatArray
    ) -> None:
        """As `Mahony.fill` of `calib.stages.imu.mahony`."""
        _run(t, phi_acc, w, self.densities, _covariance(self), phi, integral)


@kernel()
def _gains(P: FloatArray, dt: float, r: float, q: float, q_b: float, K: FloatArray) -> None:
    """Takes P (vv, ve, vb, ee, eb, bb) over a step and an update; fills K: V, angle, bias, and most |V|."""
    vv, ve, vb, ee, eb, bb = P[0], P[1], P[2], P[3], P[4], P[5]
    ee += 2.0 * dt * eb + dt * dt * bb + q * dt
    eb += dt * bb
    bb += q_b * dt
    ve += dt * vb
    vv += 2.0 * dt * ve + dt * dt * ee
    ve += dt * ee
    vb += dt * eb
    s = vv + r / dt
    K[0], K[1], K[2] = vv / s, ve / s, vb / s
    K[3] = _MOST_SIGMAS * math.sqrt(vv + max(r / (2.0 * _LASTING_S), (_ANY_MPS / GRAVITY_MPS2) ** 2))
    P[0], P[1], P[2] = vv - vv * K[0], ve - vv * K[1], vb - vv * K[2]
    P[3], P[4], P[5] = ee - ve * K[1], eb - ve * K[2], bb - vb * K[2]


@kernel()
def _run(
    t: FloatArray,
    phi_acc: FloatArray,
    w: FloatArray,
    densities: tuple[float, float, float],
    P: FloatArray,
    out_phi: FloatArray,
    out_integral: FloatArray,
) -> None:
    r, q, q_b = densities
    phi, integral = out_phi[0], out_integral[0]
    K = np.zeros(4)
    V = 0.0
    for k in range(len(t)):
        dt = t[k] - t[max(k - 1, 0)]
        if dt > 0.0:
            phi += dt * (0.5 * (w[k - 1] + w[k]) + integral)
            e = phi_acc[k] - phi
            V += dt * (e - _TURN * np.rint(e / _TURN))
            _gains(P, dt, r, q, q_b, K)
            phi += K[1] * V
            integral += K[2] * V
            V -= K[0] * V
        out_phi[k] = phi
        out_integral[k] = integral


@kernel()
def _table(densities: tuple[float, float, float], P: FloatArray, dt: float, out: FloatArray) -> None:
    for k in range(len(out)):
        _gains(P, dt, densities[0], densities[1], densities[2], out[k])


def _covariance(parameters: Levelling) -> FloatArray:
    vv, ee, bb = parameters.start
    return np.array([vv, 0.0, 0.0, ee, 0.0, bb])


@lru_cache(maxsize=256)
def gains(parameters: Levelling, dt_s: float, steps: int) -> FloatArray:
    """Gains (steps, 3) of V, angle [1/s] and integral [1/s^2] from the first step on.

    They hold for steps of at most half the time constant.
    """
    out = np.empty((steps, 4))
    _table(parameters.densities, _covariance(parameters), dt_s, out)
    out.setflags(write=False)
    return out[:, :3]


def settled(parameters: Levelling, dt_s: float) -> FloatArray:
    """Gains (3,) of V, angle and integral that are left after a long time."""
    steps = math.ceil(12.0 * (parameters.bias_tau_s + parameters.tau_s) / dt_s)
    return np.asarray(gains(parameters, dt_s, steps)[-1])


def system(parameters: Levelling, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """A (3, 3) and B (3,) of the settled filter in (phi, I, V), driven by phi_acc."""
    K0, K1, K2 = settled(parameters, dt_s).tolist()
    feed = np.array([K1, K2, 1.0 - K0])
    ahead = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    return ahead + np.outer(feed, [-dt_s, -dt_s * dt_s, 1.0]), dt_s * feed


# ----------------------------------------------------------------------
# Three axes. At rest the bias follows the mean rate: readings have stayed near their means over half a second
# for two seconds, and the direction of the specific force has not turned, which a slow rotation would show.

_MEAN_S = 0.5
_REST_S = 2.0
_START_S = 10.0
_QUIET_RADPS = 0.02
_QUIET_G = 0.05
_TURNED_G = 0.005
"""Rest: readings this near to their means, and a mean force that has moved by no more since rest began."""
_REST_RADPS = 0.0015
"""Standard deviation of the mean rate at rest as a bias; rotations show from 0.0025 rad/s on."""
GAP_S = 0.5
"""A gap after which a filter starts anew, here and on the board."""
_CUT_MPS, _FORGOTTEN_S = 12.0, 10.0
"""A step beyond which, and a velocity cut from V lately by which, the filter starts anew."""


@kernel()
def turned(x: FloatArray, w: FloatArray, dt: float) -> None:
    """x <- x turned to the fifth order of w dt: what rests in the world, seen by a sensor that turns."""
    a, b, c = dt * w[0], dt * w[1], dt * w[2]
    square = a * a + b * b + c * c
    sine, versed = 1.0 - square / 6.0 * (1.0 - square / 20.0), 0.5 - square / 24.0
    d0, d1, d2 = x[1] * c - x[2] * b, x[2] * a - x[0] * c, x[0] * b - x[1] * a
    x[0] += sine * d0 + versed * (d1 * c - d2 * b)
    x[1] += sine * d1 + versed * (d2 * a - d0 * c)
    x[2] += sine * d2 + versed * (d0 * b - d1 * a)


@kernel()
def _bias(M: FloatArray, V_b: FloatArray, V: FloatArray, s: float, PH: FloatArray, db: FloatArray) -> None:
    """Fills db by the update of the bias' covariance M with V, which V_b[i] of its axis i has moved.

    s is the variance of V's elements without it; they are taken in one after the other.
    """
    for j in range(3):
        innovation, variance = V[j], s
        for i in range(3):
            PH[i] = M[i, 0] * V_b[0, j] + M[i, 1] * V_b[1, j] + M[i, 2] * V_b[2, j]
            innovation -= V_b[i, j] * db[i]
        for i in range(3):
            variance += V_b[i, j] * PH[i]
        for i in range(3):
            db[i] += PH[i] * innovation / variance
            for m in range(3):
                M[i, m] -= PH[i] * PH[m] / variance


@kernel()
def _run_three(
    t: FloatArray,
    force: FloatArray,
    gyro: FloatArray,
    densities: tuple[float, float, float],
    start: FloatArray,
    out: FloatArray,
) -> None:
    # Element by element: numba compiles 3 s longer for whole arrays and np.cross.
    r, q, q_b = densities
    K, P, w, PH, db = np.zeros(4), np.zeros(6), np.zeros(3), np.zeros(3), np.zeros(3)
    M, V_b, u_b = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    u, V, b, cut = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    mean_w, mean_f, at_rest = np.zeros(3), np.zeros(3), np.zeros(3)
    still, size, begun = 0.0, 0.0, t[0]
    for k in range(len(t)):
        dt = t[k] - t[max(k - 1, 0)]
        far = cut[0] * cut[0] + cut[1] * cut[1] + cut[2] * cut[2] > (_CUT_MPS / GRAVITY_MPS2) ** 2
        if k == 0 or dt > GAP_S or far:
            begun, size, still = t[k], 0.0, 0.0
            P[0], P[1], P[3] = start[0], 0.0, start[3]
            for i in range(3):
                u[i], V[i], cut[i] = force[k, i], 0.0, 0.0
                mean_w[i], mean_f[i] = gyro[k, i], force[k, i]
                for j in range(3):
                    M[i, j], V_b[i, j], u_b[i, j] = start[5] if i == j else 0.0, 0.0, 0.0
        elif dt > 0.0:
            age = t[k] - begun + dt
            for i in range(3):
                w[i] = 0.5 * (gyro[k - 1, i] + gyro[k, i]) - b[i]
            turned(u, w, dt)
            turned(V, w, dt)
            turned(cut, w, dt)
            for i in range(3):
                V[i] += dt * (force[k, i] - u[i])
                turned(V_b[i], w, dt)
                turned(u_b[i], w, dt)
                for j in range(3):
                    V_b[i, j] += dt * u_b[i, j]
                # -u x the unit vector of axis i.
                u_b[i, (i + 1) % 3] -= dt * u[(i + 2) % 3]
                u_b[i, (i + 2) % 3] += dt * u[(i + 1) % 3]
                M[i, i] += q_b * dt
            _gains(P, dt, r, q, 0.0, K)
            length = math.sqrt(V[0] * V[0] + V[1] * V[1] + V[2] * V[2])
            size += dt / min(age, _MEMORY_S) * (length - size)
            most = max(K[3], _MOST_SIZES * size)
            part = most / length if age > _START_S and length > most else 1.0
            for i in range(3):
                cut[i] += (1.0 - part) * V[i] - dt / _FORGOTTEN_S * cut[i]
                V[i] *= part
                db[i] = 0.0
            if part == 1.0:
                _bias(M, V_b, V, r / dt / (1.0 - K[0]), PH, db)
            share = min(dt / min(age, _MEAN_S), 1.0)
            quiet, stays = True, True
            for i in range(3):
                for j in range(3):
                    u_b[j, i] -= K[1] * V_b[j, i]
                    V_b[j, i] -= K[0] * V_b[j, i]
                u[i] += K[1] * V[i] + u_b[0, i] * db[0] + u_b[1, i] * db[1] + u_b[2, i] * db[2]
                V[i] -= K[0] * V[i] + V_b[0, i] * db[0] + V_b[1, i] * db[1] + V_b[2, i] * db[2]
                b[i] += db[i]
                mean_w[i] += share * (gyro[k, i] - mean_w[i])
                mean_f[i] += share * (force[k, i] - mean_f[i])
                quiet = quiet and abs(gyro[k, i] - mean_w[i]) < _QUIET_RADPS
                quiet = quiet and abs(force[k, i] - mean_f[i]) < _QUIET_G
                stays = stays and abs(mean_f[i] - at_rest[i]) < _TURNED_G
            still = still + dt if quiet and (stays or still < _REST_S / 2) else 0.0
            share = min(dt / (2.0 * _MEAN_S), 1.0) if still >= _REST_S else 0.0
            for i in range(3):
                if still < _REST_S / 2:
                    at_rest[i] = mean_f[i]
                b[i] += share * (mean_w[i] - b[i])
                for j in range(3):
                    M[i, j] += share * ((_REST_RADPS**2 if i == j else 0.0) - M[i, j])
        for i in range(3):
            out[k, i] = u[i]


def level_three(
    parameters: Levelling, t_s: FloatArray, force_mps2: FloatArray, gyro_radps: FloatArray
) -> FloatArray:
    """Up vectors (n, 3) in the sensor's axes, of length about one, after each sample of a log.

    Parameters
    ----------
    t_s : (n,) time stamps that do not go back, one or more.
    force_mps2, gyro_radps : (n, 3) finite readings.
    """
    t, force, gyro = (np.ascontiguousarray(x, dtype=np.float64) for x in (t_s, force_mps2, gyro_radps))
    out = np.empty_like(force)
    _run_three(t, force / GRAVITY_MPS2, gyro, parameters.densities, _covariance(parameters), out)
    return out
