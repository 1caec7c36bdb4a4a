"""What camera and IMU read of the head's motion, with derivatives and exact rounding."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.compilation import kernel
from calib.stages.actuator.kinematics import chord_decay_w, chord_ratio_w
from calib.stages.camera.model import Camera

# ----------------------------------------------------------------------
# Whole pixels: what a rounded reading says of the place that was rounded.
#
# A tracker reports round(z), z = h + jitter, h the pixel that the state predicts. With z ~ N(m, S) before,
# a reading r says that z lies in [r - g / 2, r + g / 2] for a grid g, no more. The truncated normal
# distribution (Johnson, Kotz and Balakrishnan 1994, 13.134) has
#
#     Z = Phi(b) - Phi(a),   E = m + sqrt(S) (n(a) - n(b)) / Z,
#     V = S (1 + (a n(a) - b n(b)) / Z - ((n(a) - n(b)) / Z)^2)
#
# with a, b the ends in units of sqrt(S). Matching the state's moments to it is the update by the equivalent
# Gaussian reading: innovation (E - m) S / (S - V) with variance S^2 / (S - V). A Gaussian reading of
# variance g^2 / 12 instead would let an average over many equal readings pass for more than it says.

_ROOT = math.sqrt(0.5)
_NORM = 1.0 / math.sqrt(2.0 * math.pi)
_FAR = 6.0


@kernel(arrays=False)
def truncated(a: float, b: float) -> tuple[float, float, float]:
    """Log of the probability of [a, b], mean and variance within it, of a standard normal number.

    Beyond six deviations, where the differences cancel, the interval's end and an exponential tail
    stand for them.
    """
    if a > b:
        a, b = b, a
    flip = a + b < 0.0
    if flip:
        a, b = -b, -a
    if a > _FAR:
        # A tail: exponential with the rate a + 1 / a, cut at b.
        rate = a + 1.0 / a
        width = (b - a) * rate
        cut = math.exp(-width) if width < 700.0 else 0.0
        whole = -math.expm1(-width)
        log_z = -0.5 * a * a + math.log(_NORM / rate) + math.log(whole)
        mean = a + (1.0 - width * cut / whole) / rate
        variance = (1.0 - width * width * cut / (whole * whole)) / (rate * rate)
        variance = max(variance, 1e-6 * (b - a) * (b - a))
    else:
        # With erfc both ends keep their digits on the right-hand side.
        z = 0.5 * (math.erfc(a * _ROOT) - math.erfc(b * _ROOT))
        width = b - a
        if width < 1e-3:
            middle = 0.5 * (a + b)
            z = width * _NORM * math.exp(-0.5 * middle * middle)
            mean, variance = middle - middle * width * width / 12.0, width * width / 12.0
        else:
            na, nb = _NORM * math.exp(-0.5 * a * a), _NORM * math.exp(-0.5 * b * b)
            scale = 1.0 / z
            mean = (na - nb) * scale
            variance = 1.0 + (a * na - b * nb) * scale - mean * mean
            variance = min(max(variance, 1e-3 * min(1.0, width * width / 12.0)), 1.0)
        log_z = math.log(z)
    return log_z, -mean if flip else mean, variance


@kernel(arrays=False)
def update_terms(innovation: float, spread: float, jitter: float, grid: float) -> tuple[float, float, float]:
    """Equivalent Gaussian reading of a rounded one: innovation, its whole variance S, log likelihood.

    Parameters
    ----------
    innovation : reading minus the predicted pixel.
    spread : variance of the predicted pixel. jitter : variance of the tracker's jitter.
    grid : step of the readings [px]; 0 for readings that are not rounded.
    """
    S = spread + jitter
    if not grid > 0.0:
        return innovation, S, -0.5 * (innovation * innovation / S + math.log(2.0 * math.pi * S))
    root = math.sqrt(S)
    scale = 1.0 / root
    log_z, mean, variance = truncated((innovation - 0.5 * grid) * scale, (innovation + 0.5 * grid) * scale)
    gain = 1.0 - variance
    if gain < 1e-9:
        # The interval holds nearly all of the distribution: nothing is learnt.
        return 0.0, S * 1e9, log_z
    scale = 1.0 / gain
    return root * mean * scale, S * scale, log_z


# ----------------------------------------------------------------------
# What camera, accelerometer and gyroscope read on a moving head, with analytic gradients.
#
# The head's motion is given by phi, l and their first and second derivatives, see `HEAD`, the sensors
# by the quantities of `SENSOR`; a gradient has one entry for each of them in this order, 20 in all.
#
# Marker. Constant curvature puts the marker, d along the head's tangent (A.1), at
#
#     (X, Y) = l S(phi) (sin(phi / 2), cos(phi / 2)) + d (sin phi, cos phi)                 (3.6)
#
# in the plane. An error of the calibrated plane shows it at (X, Y) + (shift_x, shift_y) +
# stretch ((X, Y) - middle). That point is mapped by the plane's pose and the lens into distorted pixels.
# The picture was exposed `time_offset` seconds earlier than the time to which the head's motion belongs,
# so that phi - time_offset dphi + time_offset^2 ddphi / 2 stands for phi in it, and so for l.
#
# Accelerometer. With h = phi / 2, rho = l S and
#
#     r = rho'' - rho dphi^2 / 4,   x = rho ddphi / 2 + rho' dphi
#
# along and across the chord the head accelerates by A_t = r cos h + x sin h along its tangent and by
# A_n = -r sin h + x cos h across it. At the place c along the tangent and e across it, with gravity g,
#
#     f_x = g cos phi - A_t + dphi^2 c + ddphi e,   f_y = g sin phi + A_n + ddphi c - dphi^2 e
#
# is the specific force a - g in the IMU's axes, x towards the base. Mounted at the angle alpha it reads
#
#     a_x = (1 + scale_x) (cos alpha f_x - sin alpha f_y) + bias_x
#     a_y = (1 + scale_y) (sin alpha f_x + cos alpha f_y) + bias_y
#
# so that at rest and without errors atan2(a_y, a_x) = phi + alpha (2.1).
#
# Gyroscope. g_z = -(1 + scale) dphi + bias.
#
# All functions are compiled; S is that of `calib.stages.actuator.kinematics`.

HEAD = ("phi_rad", "length_m", "dphi_radps", "dlength_mps", "ddphi_radps2", "ddlength_mps2")
"""Motion of the head: entries 0 to 5 of a state and of a gradient."""


class Quantity(NamedTuple):
    """A quantity of the sensors, and what is known of it before any log.

    Attributes
    ----------
    words : for sentences.
    usual : its value, by data sheets, a ruler, and a printed board's scale.
    unaligned, assumed : deviation of that before an alignment, and of an estimator whose rig has none.
    walk : density of its slow random walk, unit per sqrt(s).
    """

    words: str
    usual: float
    unaligned: float
    assumed: float
    walk: float


QUANTITIES = {
    "gyro_bias_radps": Quantity("the gyroscope's bias", 0.0, 0.1, 0.02, 2e-5),
    "accel_bias_x_mps2": Quantity("the accelerometer's bias along x", 0.0, 0.3, 0.1, 3e-3),
    "accel_bias_y_mps2": Quantity("the accelerometer's bias along y", 0.0, 0.3, 0.1, 1e-3),
    "mount_angle_rad": Quantity("the mount angle", 0.0, 0.5, 0.05, 1e-6),
    "gyro_scale": Quantity("the gyroscope's scale", 0.0, 0.02, 0.01, 1e-6),
    "imu_lever_m": Quantity("the IMU's place along the head", 0.006, 0.02, 0.001, 1e-7),
    "marker_offset_m": Quantity("the marker's offset d", 0.015, 0.003, 3e-4, 1e-7),
    "time_offset_s": Quantity("the time offset", 0.025, 0.05, 0.01, 1e-7),
    "shift_x_m": Quantity("the plane's shift along x", 0.0, 2e-4, 2e-4, 1e-8),
    "shift_y_m": Quantity("the plane's shift along y", 0.0, 2e-4, 2e-4, 1e-8),
    "stretch": Quantity("the plane's stretch", 0.0, 1e-3, 1e-3, 1e-6),
    "accel_scale_x": Quantity("the accelerometer's scale along x", 0.0, 0.01, 0.003, 1e-6),
    "accel_scale_y": Quantity("the accelerometer's scale along y", 0.0, 0.01, 0.003, 1e-6),
    "imu_across_m": Quantity("the IMU's place across the head", 0.0, 0.01, 0.001, 1e-7),
}
SENSOR = tuple(QUANTITIES)
"""What the sensors are: entries 6 to 19. The lever is that along the tangent."""

SIZE = len(HEAD) + len(SENSOR)

GRAVITY_MPS2 = 9.81


def _slope_series() -> tuple[float, ...]:
    """Coefficients of -2 dD/dw, highest power of w first."""
    out = []
    for n in range(2, 15):
        decay = (Fraction(1, math.factorial(2 * n + 1)) - Fraction(1, math.factorial(2 * n))) * Fraction(
            (-1) ** n, 4**n
        )
        out.append(float(-2 * (n - 1) * decay))
    return tuple(reversed(out))


_E_SERIES = _slope_series()


@kernel(arrays=False, inlined=True)
def decay_slope_w(w: float) -> float:
    """-2 dD/dw as a function of w = phi^2, so that dD/dphi is -phi times it."""
    E = _E_SERIES[0]
    for coefficient in _E_SERIES[1:]:
        E = E * w + coefficient
    return E


def view_coefficients(
    camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, middle_m: tuple[float, float] = (0.0, 0.08)
) -> FloatArray:
    """Camera and plane as the (25,) numbers that `marker` takes.

    Parameters
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    middle_m : place in the plane about which `stretch` magnifies.
    """
    R = np.asarray(R_CW, dtype=np.float64)
    lens = [camera.fx_px, camera.fy_px, camera.skew_px, camera.cx_px, camera.cy_px]
    parts = [R[:, 0], R[:, 1], t_CW_m, lens, camera.distortion, middle_m, [float(camera.fisheye)]]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def sensor_values(values: dict[str, float]) -> FloatArray:
    """The (14,) vector of `SENSOR` with these values, zero where none is given."""
    return np.array([values.get(name, 0.0) for name in SENSOR], dtype=np.float64)


def rest_reading(sensor: FloatArray) -> tuple[tuple[float, float], FloatArray]:
    """Angle [rad] and size [m/s^2] that the accelerometer reads at phi = 0 at rest, with gradients (2, 14).

    Mount angle, biases and scales turn and stretch it; logs tell it far better than each of them.
    """
    value = dict(zip(SENSOR, sensor.tolist(), strict=True))
    gx, gy = (GRAVITY_MPS2 * one(value["mount_angle_rad"]) for one in (math.cos, math.sin))
    x = (1.0 + value["accel_scale_x"]) * gx + value["accel_bias_x_mps2"]
    y = (1.0 + value["accel_scale_y"]) * gy + value["accel_bias_y_mps2"]
    by = {
        "accel_bias_x_mps2": (1.0, 0.0),
        "accel_bias_y_mps2": (0.0, 1.0),
        "accel_scale_x": (gx, 0.0),
        "accel_scale_y": (0.0, gy),
        "mount_angle_rad": (-(1.0 + value["accel_scale_x"]) * gy, (1.0 + value["accel_scale_y"]) * gx),
    }
    size = math.hypot(x, y)
    each = np.array([by.get(name, (0.0, 0.0)) for name in SENSOR]).T
    turn = np.array([[-y / size**2, x / size**2], [x / size, y / size]])
    return (math.atan2(y, x), size), turn @ each


@kernel(arrays=False)
def head_position(phi: float, length: float) -> tuple[float, float]:
    """Head (x, y) [m] of angle and length (3.6)."""
    rho = length * chord_ratio_w(phi * phi)
    return rho * math.sin(0.5 * phi), rho * math.cos(0.5 * phi)


@kernel(arrays=False)
def _by_fisheye(
    view: FloatArray, p1: float, p2: float, p3: float
) -> tuple[float, float, float, float, float, float]:
    """What a fisheye lens (`calib.stages.camera.model`) makes of (p1, p2, p3) of the camera's frame.

    Distorted normalised coordinates x, y and their derivatives: x, y, x_X, x_Y, y_X, y_Y.
    """
    k1, k2, k3, k4 = view[14], view[15], view[18], view[19]
    rho = max(math.hypot(p1, p2), 1e-9 * p3)
    theta, d2 = math.atan2(rho, p3), rho * rho + p3 * p3
    t2 = theta * theta
    m = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / rho
    slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    bend, along = (slope * p3 / d2 - m) / (rho * rho), -slope / d2
    radial_X, radial_Y = p1 * view[0] + p2 * view[1], p1 * view[3] + p2 * view[4]
    m_X, m_Y = bend * radial_X + along * view[2], bend * radial_Y + along * view[5]
    xd_X, xd_Y = m * view[0] + p1 * m_X, m * view[3] + p1 * m_Y
    return p1 * m, p2 * m, xd_X, xd_Y, m * view[1] + p2 * m_X, m * view[4] + p2 * m_Y


@kernel(arrays=False)
def _by_lens(
    view: FloatArray, p1: float, p2: float, p3: float
) -> tuple[float, float, float, float, float, float]:
    """As `_by_fisheye`, of a lens with radial and tangential distortion."""
    inverse = 1.0 / p3
    x, y = p1 * inverse, p2 * inverse
    x_X, x_Y = (view[0] - x * view[2]) * inverse, (view[3] - x * view[5]) * inverse
    y_X, y_Y = (view[1] - y * view[2]) * inverse, (view[4] - y * view[5]) * inverse
    k1, k2, t1, t2, k3, k4, k5, k6 = (
        view[14], view[15], view[16], view[17], view[18], view[19], view[20], view[21],
    )  # fmt: skip
    r2 = x * x + y * y
    over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over
    slope = (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) * over
    xd = x * radial + 2.0 * t1 * x * y + t2 * (r2 + 2.0 * x * x)
    yd = y * radial + t1 * (r2 + 2.0 * y * y) + 2.0 * t2 * x * y
    xx = radial + 2.0 * x * x * slope + 2.0 * t1 * y + 6.0 * t2 * x
    yy = radial + 2.0 * y * y * slope + 6.0 * t1 * y + 2.0 * t2 * x
    xy = 2.0 * x * y * slope + 2.0 * t1 * x + 2.0 * t2 * y
    return xd, yd, xx * x_X + xy * y_X, xx * x_Y + xy * y_Y, xy * x_X + yy * y_X, xy * x_Y + yy * y_Y


@kernel(arrays=False)
def _pixel(view: FloatArray, X: float, Y: float) -> tuple[float, float, float, float, float, float]:
    """Distorted pixel of a place in the plane and its derivatives: u, v, u_X, u_Y, v_X, v_Y.

    NaN behind the camera.
    """
    p1 = view[0] * X + view[3] * Y + view[6]
    p2 = view[1] * X + view[4] * Y + view[7]
    p3 = view[2] * X + view[5] * Y + view[8]
    if not p3 > 0.0:
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    if view[24] != 0.0:
        xd, yd, xd_X, xd_Y, yd_X, yd_Y = _by_fisheye(view, p1, p2, p3)
    else:
        xd, yd, xd_X, xd_Y, yd_X, yd_Y = _by_lens(view, p1, p2, p3)
    fx, fy, skew, cx, cy = view[9], view[10], view[11], view[12], view[13]
    return (
        fx * xd + skew * yd + cx, fy * yd + cy,
        fx * xd_X + skew * yd_X, fx * xd_Y + skew * yd_Y, fy * yd_X, fy * yd_Y,
    )  # fmt: skip


@kernel(arrays=False)
def marker_terms(
    view: FloatArray, phi: float, length: float, dphi: float, dl: float, ddphi: float, ddl: float,
    d: float, late: float, shift_x: float, shift_y: float, stretch: float,
) -> tuple[float, ...]:  # fmt: skip
    """Distorted pixel (u, v) of the marker and pairs of its derivatives, NaN behind the camera.

    Those by phi, l, d, `late`, X, Y and the stretch; of a head that is not late, phi and l of its motion.

    Parameters
    ----------
    view : (25,) of `view_coefficients`.
    phi .. ddl : motion of the head. d : the marker's offset. late : the time offset.
    """
    dphi, dl = dphi - late * ddphi, dl - late * ddl
    phi, length = phi - late * (dphi + 0.5 * late * ddphi), length - late * (dl + 0.5 * late * ddl)
    w = phi * phi
    S, D = chord_ratio_w(w), chord_decay_w(w)
    S1 = -phi * D
    # sin(phi / 2) and cos(phi / 2), from the series that are there already.
    sh, ch = 0.5 * phi * S, S - w * D
    s, c = 2.0 * sh * ch, 1.0 - 2.0 * sh * sh
    X = length * S * sh + d * s
    Y = length * S * ch + d * c
    X_phi = length * (S1 * sh + 0.5 * S * ch) + d * c
    Y_phi = length * (S1 * ch - 0.5 * S * sh) - d * s
    grow = 1.0 + stretch
    from_x, from_y = X - view[22], Y - view[23]
    u, v, u_X, u_Y, v_X, v_Y = _pixel(
        view, view[22] + grow * from_x + shift_x, view[23] + grow * from_y + shift_y
    )
    u_phi, v_phi = grow * (u_X * X_phi + u_Y * Y_phi), grow * (v_X * X_phi + v_Y * Y_phi)
    u_l, v_l = grow * S * (u_X * sh + u_Y * ch), grow * S * (v_X * sh + v_Y * ch)
    u_d, v_d = grow * (u_X * s + u_Y * c), grow * (v_X * s + v_Y * c)
    u_late, v_late = -(u_phi * dphi + u_l * dl), -(v_phi * dphi + v_l * dl)
    u_grow, v_grow = u_X * from_x + u_Y * from_y, v_X * from_x + v_Y * from_y
    return (
        u, v, u_phi, v_phi, u_l, v_l, u_d, v_d, u_late, v_late, u_X, v_X, u_Y, v_Y, u_grow, v_grow,
    )  # fmt: skip


@kernel(arrays=False)
def marker(view: FloatArray, state: FloatArray, by_u: FloatArray, by_v: FloatArray) -> tuple[float, float]:
    """Distorted pixel (u, v) of the marker; NaN behind the camera.

    Parameters
    ----------
    view : (25,) of `view_coefficients`.
    state : (20,) of `HEAD` and `SENSOR`.
    by_u, by_v : (20,) gradients, written to.
    """
    late = state[13]
    found = marker_terms(
        view, state[0], state[1], state[2], state[3], state[4], state[5], state[12], late, state[14],
        state[15], state[16],
    )  # fmt: skip
    half = 0.5 * late * late
    for k in range(by_u.shape[0]):
        by_u[k] = 0.0
        by_v[k] = 0.0
    by_u[0], by_v[0] = found[2], found[3]
    by_u[1], by_v[1] = found[4], found[5]
    for k in range(2):
        by_u[2 + k], by_v[2 + k] = -late * by_u[k], -late * by_v[k]
        by_u[4 + k], by_v[4 + k] = half * by_u[k], half * by_v[k]
    by_u[12], by_v[12] = found[6], found[7]
    by_u[13], by_v[13] = found[8], found[9]
    by_u[14], by_v[14] = found[10], found[11]
    by_u[15], by_v[15] = found[12], found[13]
    by_u[16], by_v[16] = found[14], found[15]
    return found[0], found[1]


@kernel(arrays=False)
def accelerometer_terms(
    phi: float, length: float, dphi: float, dl: float, ddphi: float, ddl: float, alpha: float, lever: float,
    across: float,
) -> tuple[float, ...]:  # fmt: skip
    """Specific force of the mounted IMU without biases and scales, that at rest, and pairs of derivatives.

    Those by phi, l, dphi, dl, ddphi, ddl, the lever and `across`; that by alpha is (-a_y, a_x).

    Parameters
    ----------
    phi .. ddl : motion of the head. alpha : mount angle. lever, across : place along the tangent and across.
    """
    gravity = GRAVITY_MPS2
    w = phi * phi
    S, D = chord_ratio_w(w), chord_decay_w(w)
    E = decay_slope_w(w)
    S1, S2 = -phi * D, 2.0 * D - 0.25 * S
    S3 = -2.0 * phi * E - 0.25 * S1
    sh, ch = 0.5 * phi * S, S - w * D
    s, c = 2.0 * sh * ch, 1.0 - 2.0 * sh * sh
    rho, drho = length * S, dl * S + length * S1 * dphi
    spin2 = dphi * dphi
    r = ddl * S + 2.0 * dl * S1 * dphi + length * (S2 * spin2 + S1 * ddphi) - 0.25 * rho * spin2
    x = 0.5 * rho * ddphi + drho * dphi
    r_phi = ddl * S1 + 2.0 * dl * S2 * dphi + length * ((S3 - 0.25 * S1) * spin2 + S2 * ddphi)
    x_phi = 0.5 * length * S1 * ddphi + (dl * S1 + length * S2 * dphi) * dphi
    r_l, x_l = (S2 - 0.25 * S) * spin2 + S1 * ddphi, 0.5 * S * ddphi + S1 * spin2
    r_dphi, x_dphi = 2.0 * dl * S1 + (2.0 * length * S2 - 0.5 * rho) * dphi, drho + length * S1 * dphi
    r_dl, x_dl = 2.0 * S1 * dphi, S * dphi
    r_ddphi, x_ddphi = length * S1, 0.5 * rho
    A_t, A_n = r * ch + x * sh, x * ch - r * sh
    f_x = gravity * c - A_t + spin2 * lever + ddphi * across
    f_y = gravity * s + A_n + ddphi * lever - spin2 * across
    x0 = -gravity * s - (r_phi * ch + x_phi * sh + 0.5 * A_n)
    y0 = gravity * c + (x_phi * ch - r_phi * sh - 0.5 * A_t)
    x1, y1 = -(r_l * ch + x_l * sh), x_l * ch - r_l * sh
    x2 = -(r_dphi * ch + x_dphi * sh) + 2.0 * dphi * lever
    y2 = x_dphi * ch - r_dphi * sh - 2.0 * dphi * across
    x3, y3 = -(r_dl * ch + x_dl * sh), x_dl * ch - r_dl * sh
    x4, y4 = across - (r_ddphi * ch + x_ddphi * sh), lever + x_ddphi * ch - r_ddphi * sh
    x5, y5 = -S * ch, -S * sh
    ca, sa = math.cos(alpha), math.sin(alpha)
    return (
        ca * f_x - sa * f_y, sa * f_x + ca * f_y, gravity * (ca * c - sa * s), gravity * (sa * c + ca * s),
        ca * x0 - sa * y0, sa * x0 + ca * y0, ca * x1 - sa * y1, sa * x1 + ca * y1,
        ca * x2 - sa * y2, sa * x2 + ca * y2, ca * x3 - sa * y3, sa * x3 + ca * y3,
        ca * x4 - sa * y4, sa * x4 + ca * y4, ca * x5 - sa * y5, sa * x5 + ca * y5,
        ca * spin2 - sa * ddphi, sa * spin2 + ca * ddphi,
        ca * ddphi + sa * spin2, sa * ddphi - ca * spin2,
    )  # fmt: skip


@kernel(arrays=False)
def accelerometer(state: FloatArray, by_x: FloatArray, by_y: FloatArray) -> tuple[float, float]:
    """Specific force (a_x, a_y) [m/s^2] that the mounted IMU reads.

    Parameters
    ----------
    state : (20,) of `HEAD` and `SENSOR`.
    by_x, by_y : (20,) gradients, written to.
    """
    found = accelerometer_terms(
        state[0], state[1], state[2], state[3], state[4], state[5], state[9], state[11], state[19]
    )
    grow_x, grow_y = 1.0 + state[17], 1.0 + state[18]
    for k in range(by_x.shape[0]):
        by_x[k] = 0.0
        by_y[k] = 0.0
    for k in range(6):
        by_x[k], by_y[k] = grow_x * found[4 + 2 * k], grow_y * found[5 + 2 * k]
    by_x[11], by_y[11] = grow_x * found[16], grow_y * found[17]
    by_x[19], by_y[19] = grow_x * found[18], grow_y * found[19]
    by_x[9], by_y[9] = -grow_x * found[1], grow_y * found[0]
    by_x[7], by_y[8] = 1.0, 1.0
    by_x[17], by_y[18] = found[0], found[1]
    return grow_x * found[0] + state[7], grow_y * found[1] + state[8]


@kernel(arrays=False)
def gyroscope(state: FloatArray, by_z: FloatArray) -> float:
    """Rotation rate g_z [rad/s] of a state (20,); the gradient (20,) is written to."""
    for k in range(by_z.shape[0]):
        by_z[k] = 0.0
    by_z[2], by_z[6], by_z[10] = -(1.0 + state[10]), 1.0, -state[2]
    return float(-(1.0 + state[10]) * state[2] + state[6])


@kernel()
def marker_rows(view: FloatArray, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of the states (n, 20) and their gradients (n, 2, 20)."""
    pixels, by = np.empty((len(states), 2)), np.empty((len(states), 2, states.shape[1]))
    for i in range(len(states)):
        pixels[i, 0], pixels[i, 1] = marker(view, states[i], by[i, 0], by[i, 1])
    return pixels, by


@kernel(arrays=False)
def invert_marker(
    view: FloatArray, sensor: FloatArray, u: float, v: float, phi: float, length: float
) -> tuple[float, float, bool]:
    """Angle and length at which a resting marker is seen at (u, v), and whether they were found.

    Newton's method from (phi, length) on two pixels; the length has to be positive and the angle below
    3 rad.

    Parameters
    ----------
    sensor : (14,) of `SENSOR`.
    """
    for _ in range(30):
        at_u, at_v, u_phi, v_phi, u_l, v_l, _, _, _, _, _, _, _, _, _, _ = marker_terms(
            view, phi, length, 0.0, 0.0, 0.0, 0.0, sensor[6], 0.0, sensor[8], sensor[9], sensor[10]
        )
        eu, ev = u - at_u, v - at_v
        det = u_phi * v_l - u_l * v_phi
        if not abs(det) > 1e-12:
            return phi, length, False
        step_phi = (eu * v_l - ev * u_l) / det
        step_l = (u_phi * ev - v_phi * eu) / det
        limit = max(abs(step_phi) / 0.5, abs(step_l) / 0.02, 1.0)
        phi += step_phi / limit
        length += step_l / limit
        if not (abs(phi) < 3.0 and 1e-3 < length < 10.0):
            return phi, length, False
        if limit == 1.0 and abs(step_phi) < 1e-10 and abs(step_l) < 1e-12:
            return phi, length, True
    return phi, length, False


def heads_seen(view: FloatArray, sensor: FloatArray, pixels: FloatArray, rest_m: float) -> FloatArray:
    """Angle and length (n, 2) at which resting markers are seen at pixels (n, 2), NaN where at none.

    Newton's method starts from the head before, else from the straight one of the length `rest_m`.
    """
    out = np.full((len(pixels), 2), np.nan)
    straight = before = (0.0, rest_m)
    for n, (u, v) in enumerate(pixels.tolist()):
        for phi, length in (before, straight):
            phi, length, found = invert_marker(view, sensor, u, v, phi, length)
            if found:
                out[n] = before = phi, length
                break
    return out
