"""The simulated sensors: what they sense of the head's true motion, and what they make of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.core.arrays import BoolArray, FloatArray
from calib.core.compilation import kernel
from calib.core.geometry import in_picture
from calib.stages.actuator.dynamics import Coefficients, rates
from calib.stages.actuator.kinematics import chord_decay_w, chord_ratio_w, forward, marker_from_head
from calib.stages.camera.model import Camera, project
from calib.twin.section import Imu, Tracker

# ----------------------------------------------------------------------
# Random numbers that are the same on every machine.
#
# Only elementwise arithmetic in double precision and NumPy's raw bit streams are used: NumPy promises
# to keep those, while the distributions on top of them may change between versions, and sums in an
# order of the processor's choosing may change between machines.

_BYTES_PER_NORMAL = 16


def uniform(bits: np.random.PCG64, count: int) -> FloatArray:
    """`count` uniform numbers in [0, 1), shape (count,), from the raw stream of `bits`."""
    raw = np.asarray(bits.random_raw(count), dtype=np.uint64)
    return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53


def normal(bits: np.random.PCG64, rows: int, columns: int = 1) -> FloatArray:
    """Normal numbers (rows, columns) of mean 0 and deviation 1: standardised sums of 16 random bytes.

    The sums are exact. The tails end at 6.9 and the excess kurtosis is -0.075, which no picture of 256 levels
    can show.
    """
    words = np.asarray(bits.random_raw(rows * columns * _BYTES_PER_NORMAL // 8), dtype="<u8")
    total = words.view(np.uint8).reshape(rows, columns, _BYTES_PER_NORMAL).sum(axis=-1, dtype=np.int64)
    deviation = math.sqrt(_BYTES_PER_NORMAL * (256**2 - 1) / 12)
    return np.asarray((total - _BYTES_PER_NORMAL * 127.5) / deviation)


# ----------------------------------------------------------------------
# Compiled arithmetic of the simulated head: states between nodes, and the head's motion in them.
#
# Sensors in a closed loop look at one or two states per tick, where calls cost more than numbers.
#
# With rho = l S(phi), h = phi / 2 and S of `calib.stages.actuator.kinematics` the head is at rho (sin h, cos
# h), and its acceleration along and across that direction is
#
#     a_r = rho'' - rho dphi^2 / 4,   a_t = rho ddphi / 2 + rho' dphi,
#     rho' = dl S + l S' dphi,   rho'' = ddl S + 2 dl S' dphi + l (S'' dphi^2 + S' ddphi),
#     S' = -phi D,   S'' = 2 D - S / 4.


@kernel()
def states_between(node_s: float, nodes: FloatArray, t_s: FloatArray) -> FloatArray:
    """States (m, 10) at the times (m,) from nodes (n, 10), those outside of them held.

    Lengths follow the cubic through lengths and rates of both nodes, rates its derivative, the rest a line.
    """
    last = len(nodes) - 1
    out = np.empty((len(t_s), nodes.shape[1]))
    for row in range(len(t_s)):
        place = min(max(t_s[row] / node_s, 0.0), float(last))
        near = np.rint(place)
        # A time meant to be a node's own must find it in spite of rounding.
        if abs(place - near) < 1e-7:
            place = near
        i = int(place)
        s = place - i
        if i >= last or s == 0.0:
            for k in range(nodes.shape[1]):
                out[row, k] = nodes[min(i, last), k]
            continue
        a, b = nodes[i], nodes[i + 1]
        for k in range(4, nodes.shape[1]):
            out[row, k] = a[k] + s * (b[k] - a[k])
        for k in range(2):
            v0, v1, rise = node_s * a[k + 2], node_s * b[k + 2], b[k] - a[k]
            # The cubic q0 + s v0 + s^2 (3 rise - 2 v0 - v1) + s^3 (v0 + v1 - 2 rise).
            second, third = 3.0 * rise - 2.0 * v0 - v1, v0 + v1 - 2.0 * rise
            out[row, k] = a[k] + s * (v0 + s * (second + s * third))
            out[row, k + 2] = (v0 + s * (2.0 * second + 3.0 * s * third)) / node_s
    return out


@kernel()
def _head_rows(c: Coefficients, states: FloatArray) -> FloatArray:
    """Angle with its derivatives, and acceleration, as rows (5, m), of the head in the states (m, 10)."""
    out, half = np.empty((5, len(states))), 0.5 / c.r
    for k in range(len(states)):
        q1, q2, dq1, dq2 = states[k, 0], states[k, 1], states[k, 2], states[k, 3]
        z1, z2, F1, F2 = states[k, 4], states[k, 5], states[k, 8], states[k, 9]
        phi, length = half * (q1 - q2), 0.5 * (q1 + q2)
        dphi, dl = half * (dq1 - dq2), 0.5 * (dq1 + dq2)
        ddl, ddphi, _, _ = rates(c, length, phi, dl, dphi, z1 + z2, z1 - z2, F1, F2)
        S, D = chord_ratio_w(phi * phi), chord_decay_w(phi * phi)
        S1, S2 = -phi * D, 2.0 * D - 0.25 * S
        rho = length * S
        drho = dl * S + length * S1 * dphi
        ddrho = ddl * S + 2.0 * dl * S1 * dphi + length * (S2 * dphi * dphi + S1 * ddphi)
        along = ddrho - 0.25 * rho * dphi * dphi
        across = 0.5 * rho * ddphi + drho * dphi
        sine, cosine = math.sin(0.5 * phi), math.cos(0.5 * phi)
        out[0, k], out[1, k], out[2, k] = phi, dphi, ddphi
        out[3, k], out[4, k] = along * sine + across * cosine, along * cosine - across * sine
    return out


# ----------------------------------------------------------------------
# What sensors on the simulated head could sense: its true motion at any time, and when it is logged.
#
# The plant is simulated on a regular grid of nodes. Between them the bellows' lengths follow the cubic
# that takes lengths and rates over from both nodes, and their rates its derivative (1.1e-8 m and 1.0e-5 m/s
# from the truth in a swing with nodes 1/300 s apart). Creep and forces change slowly and are
# interpolated linearly. Accelerations come from the equations of motion in the interpolated state.
#
# Tracker and IMU measure it. Every random number of a log is drawn before the simulation from streams of its
# own, so that closing the loop over the sensors or not does not change the noise.


def stream(seed: int, *purpose: int) -> np.random.PCG64:
    """Random bits for one purpose; other purposes and seeds have streams of their own."""
    # Not a tuple as the seed: zeros at its end count for nothing.
    return np.random.PCG64(np.random.SeedSequence(seed, spawn_key=purpose))


@dataclass(frozen=True)
class Trajectory:
    """States on a regular grid.

    Attributes
    ----------
    node_s : distance of the nodes [s]; the first is at 0.
    nodes : (n, 10) rows of `kernel.STATE`.
    """

    node_s: float
    nodes: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """States (m, 10) at the times (m,) [s], those before the first and after the last node held."""
        return states_between(self.node_s, self.nodes, t_s)


@dataclass(frozen=True)
class HeadMotion:
    """Motion of the head in the world frame.

    Attributes
    ----------
    phi_rad, dphi_radps, ddphi_radps2 : (m,) angle and its derivatives.
    acceleration_mps2 : (m, 2).
    """

    phi_rad: FloatArray
    dphi_radps: FloatArray
    ddphi_radps2: FloatArray
    acceleration_mps2: FloatArray


def head_motion(c: Coefficients, states: FloatArray) -> HeadMotion:
    """Motion of the head (m) in the states (m, 10), accelerations by the equations of motion."""
    rows = _head_rows(c, states)
    return HeadMotion(rows[0], rows[1], rows[2], rows[3:].T)


def stamps(t_s: FloatArray, jitter_s: float, duplicated: float, bits: np.random.PCG64) -> FloatArray:
    """Time stamps (n,) that a logger gives to samples taken at the times (n,) [s].

    Jitter is normal. A sample that waits in a buffer gets the stamp of the one before it, with the
    probability `duplicated`. Stamps never run backwards and are whole microseconds.
    """
    noisy = t_s + jitter_s * normal(bits, len(t_s))[:, 0]
    noisy = np.maximum.accumulate(np.maximum(np.rint(noisy * 1e6) * 1e-6, 0.0)) if len(noisy) else noisy
    twice = uniform(bits, len(t_s)) < duplicated
    if len(twice):
        twice[0] = False
    source = np.maximum.accumulate(np.where(twice, 0, np.arange(len(t_s))))
    return np.asarray(noisy[source])


# ----------------------------------------------------------------------
# The simulated tracker: a Pixy2 that reports the marker on the head as a whole pixel, 60 times a second.
#
# The marker sits at the distance d along the head's tangent (A.1), is mapped by the plane's pose and
# the lens into distorted pixels, and is found there with jitter, rounded to the pixel grid. Some frames
# show something else instead (outliers), in some nothing is found (dropouts, blackouts), and what is
# reported at a tick was exposed `latency_s` earlier.

_PURPOSE = 1


@dataclass(frozen=True)
class View:
    """A camera and the pose R_CW (3, 3), t_CW_m (3,) of the world in its frame."""

    camera: Camera
    R_CW: FloatArray
    t_CW_m: FloatArray


@dataclass(frozen=True)
class TrackerNoise:
    """Everything random about the n frames of a log.

    Attributes
    ----------
    exposed_s : (n,) times of exposure.
    stamp_s : (n,) time stamps of the ticks that read them.
    offset_px : (n, 2) jitter and outliers.
    missing : (n,) frames in which nothing is found.
    """

    exposed_s: FloatArray
    stamp_s: FloatArray
    offset_px: FloatArray
    missing: BoolArray


def draw_tracker_noise(tracker: Tracker, tick_times_s: FloatArray, seed: int) -> TrackerNoise:
    """Noise of the frames that are read at the times (n,) [s]."""
    n = len(tick_times_s)
    bits = stream(seed, _PURPOSE)
    stamp = stamps(tick_times_s, tracker.stamp_jitter_s, 0.0, bits)
    offset = tracker.jitter_px * normal(bits, n, 2)
    chance, share, turn, lost = (uniform(bits, n) for _ in range(4))
    least, most = tracker.outlier_px
    radius = np.where(chance < tracker.outliers, least + (most - least) * share, 0.0)
    offset += radius[:, None] * np.stack([np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)], axis=-1)
    missing = lost < tracker.dropouts
    for start, duration in tracker.blackouts_s:
        missing |= (tick_times_s >= start) & (tick_times_s < start + duration)
    return TrackerNoise(tick_times_s - tracker.latency_s, stamp, offset, missing)


def marker_pixels(view: View, tracker: Tracker, q_m: FloatArray, bellows_radius_m: float) -> FloatArray:
    """Where the marker is seen (m, 2) [px] for bellows (m, 2) [m]; NaN behind the camera."""
    pose = forward(q_m, bellows_radius_m)
    marker = marker_from_head(pose[:, :2], pose[:, 2], tracker.marker_offset_m)
    R = view.R_CW
    points = marker[:, :1] * R[:, 0] + marker[:, 1:] * R[:, 1] + view.t_CW_m
    front = points[:, 2] > 0.0
    points = np.where(front[:, None], points, 1.0)
    return np.where(front[:, None], project(view.camera, points), np.nan)


def track(
    view: View,
    tracker: Tracker,
    noise: TrackerNoise,
    frames: slice,
    q_m: FloatArray,
    bellows_radius_m: float,
) -> FloatArray:
    """Reported pixels (m, 2) of the frames of `noise`, NaN where there are none.

    Parameters
    ----------
    q_m : (m, 2) lengths of the bellows at the frames' exposures.
    """
    pixels = marker_pixels(view, tracker, q_m, bellows_radius_m) + noise.offset_px[frames]
    if tracker.grid_px > 0.0:
        pixels = tracker.grid_px * np.floor(pixels / tracker.grid_px + 0.5)
    gone = noise.missing[frames] | ~in_picture(pixels, view.camera.image_size_px)
    return np.where(gone[:, None], np.nan, pixels)


# ----------------------------------------------------------------------
# The simulated BNO055 on the head (2.1): rotation rate, specific force, and its own drifting angle.
#
# Axes. Unmounted, the sensor's x axis points from the head to the base, y is the head's +x and z points
# away from the camera, in the world frame
#
#     x_S = -(sin phi, cos phi, 0),   y_S = (cos phi, -sin phi, 0),   z_S = (0, 0, 1),
#
# so that at rest atan2(ay, ax) = phi and at all times gz = -dphi/dt. Mounted with the angle alpha the
# sensor is turned about z so that it reads phi + alpha at rest.
#
# The accelerometer feels the specific force f = a - g at its own place c in the head's frame,
#
#     a = a_head + ddphi R' c - dphi^2 R c,   R = [[cos, sin], [-sin, cos]],  R' = dR / dphi,
#
# with g = (0, 9.81) m/s^2 in the world. Then per axis
#
#     m = clip(round(((1 + scale error) true + bias + walk + white noise) / step) step).
#
# White noise is given by its density, as in Kalibr's imu.yaml: the deviation of a sample is the density
# times sqrt(rate). The bias walks by a normal step of density / sqrt(rate) per sample.
#
# Scale errors, biases and walks are those of a common part, the densities of noise are the data sheet's
# (0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz)).

_SENSOR_PURPOSE = 2
_DEG = math.pi / 180.0

Triple = tuple[float, ...]


@dataclass(frozen=True)
class ImuNoise:
    """Everything random about the n samples of a log.

    Attributes
    ----------
    taken_s, stamp_s : (n,) times of the samples and their time stamps.
    gyro, accel : (n, 3) biases with their walk, and white noise [rad/s, m/s^2].
    onchip_rad : (n,) error of the on-chip angle.
    """

    taken_s: FloatArray
    stamp_s: FloatArray
    gyro: FloatArray
    accel: FloatArray
    onchip_rad: FloatArray


def _axis_errors(
    imu: Imu, n: int, bias: Triple, noise: float, walk: float, bits: np.random.PCG64
) -> FloatArray:
    white = noise * math.sqrt(imu.rate_hz) * normal(bits, n, 3)
    steps = walk / math.sqrt(imu.rate_hz) * normal(bits, n, 3)
    return np.asarray(np.array(bias) + np.cumsum(steps, axis=0) + white)


def draw_imu_noise(imu: Imu, duration_s: float, seed: int) -> ImuNoise:
    """Noise of all samples from 0 up to, not including, the duration [s]."""
    n = max(math.ceil(duration_s * imu.rate_hz - 1e-9), 0)
    taken = np.arange(n) / imu.rate_hz
    stamp = stamps(taken, imu.stamp_jitter_s, imu.duplicated_stamps, stream(seed, _SENSOR_PURPOSE, 0))
    gyro = _axis_errors(
        imu, n, imu.gyro_bias_radps, imu.gyro_noise, imu.gyro_walk, stream(seed, _SENSOR_PURPOSE, 1)
    )
    accel = _axis_errors(
        imu, n, imu.accel_bias_mps2, imu.accel_noise, imu.accel_walk, stream(seed, _SENSOR_PURPOSE, 2)
    )
    # The drift of a log is inconsistent in Fig. 2.4 from log to log, and a little within one.
    bits = stream(seed, _SENSOR_PURPOSE, 3)
    drift = imu.onchip_drift_radps * (1.0 + imu.onchip_spread * float(normal(bits, 1)[0, 0]))
    wander = 0.1 * abs(imu.onchip_drift_radps) / math.sqrt(imu.rate_hz) * np.cumsum(normal(bits, n)[:, 0])
    return ImuNoise(taken, stamp, gyro, accel, drift * taken + wander)


def _read(true: FloatArray, scale: Triple, error: FloatArray, step: float, limit: float) -> FloatArray:
    value = (1.0 + np.array(scale)) * true + error
    if step <= 0.0:
        return np.clip(value, -limit, limit)
    most = math.floor(limit / step + 1e-9)
    return step * np.clip(np.floor(value / step + 0.5), -most, most)


def _specific_force(imu: Imu, motion: HeadMotion) -> FloatArray:
    """f = a - g at the sensor's place, world frame (m, 2)."""
    s, c = np.sin(motion.phi_rad), np.cos(motion.phi_rad)
    across, along = imu.lever_m
    arm_x, arm_y = c * across + s * along, c * along - s * across
    turned_x, turned_y = arm_y, -arm_x
    spin2 = motion.dphi_radps * motion.dphi_radps
    a_x = motion.acceleration_mps2[:, 0] + motion.ddphi_radps2 * turned_x - spin2 * arm_x
    a_y = motion.acceleration_mps2[:, 1] + motion.ddphi_radps2 * turned_y - spin2 * arm_y
    return np.stack([a_x - imu.gravity_mps2[0], a_y - imu.gravity_mps2[1]], axis=-1)


def measure(imu: Imu, noise: ImuNoise, samples: slice, motion: HeadMotion) -> tuple[FloatArray, FloatArray]:
    """Readings of the samples of `noise` while the head moves as `motion` (m).

    Returns
    -------
    specific force (m, 3) [m/s^2] and rotation rate (m, 3) [rad/s] in the sensor's axes.
    """
    s, c = np.sin(motion.phi_rad), np.cos(motion.phi_rad)
    f = _specific_force(imu, motion)
    x = -(s * f[:, 0] + c * f[:, 1])
    y = c * f[:, 0] - s * f[:, 1]
    ca, sa = math.cos(imu.mount_angle_rad), math.sin(imu.mount_angle_rad)
    zero = np.zeros_like(x)
    force = np.stack([ca * x - sa * y, sa * x + ca * y, zero], axis=-1)
    rate = np.stack([zero, zero, -motion.dphi_radps], axis=-1)
    return (
        _read(force, imu.accel_scale, noise.accel[samples], imu.accel_step_mps2, imu.accel_range_mps2),
        _read(rate, imu.gyro_scale, noise.gyro[samples], imu.gyro_step_radps, imu.gyro_range_radps),
    )


def onchip_angle_rad(imu: Imu, noise: ImuNoise, samples: slice, motion: HeadMotion) -> FloatArray:
    """Angle (m,) [rad] of the fusion on the chip: right but for the mount angle and its drift.

    The chip reports it in steps of 1/16 deg.
    """
    step = _DEG / 16.0
    angle = motion.phi_rad + imu.mount_angle_rad + noise.onchip_rad[samples]
    return np.asarray(step * np.floor(angle / step + 0.5))
