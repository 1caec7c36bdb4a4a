"""The constants of the header, by part: camera, motion, control, fused estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.geometry import fit_homography
from calib.stages.actuator.kinematics import MARKER_OFFSET_M, inverse_coefficients
from calib.stages.actuator.parameters import LONGEST_ELONGATION_M, Plant
from calib.stages.actuator.pump import PWM_MAX, ElongationForce
from calib.stages.actuator.section import standing
from calib.stages.camera.model import FISHEYE, Camera, project
from calib.stages.camera.section import InverseLens
from calib.stages.control.laws import PWM_MIN, FeedForward, Pid
from calib.stages.control.section import OrientationGains, StaticMap
from calib.stages.estimator.constant_gain import (
    ALONE,
    BOOST,
    BOOST_TICKS,
    MOST_DELAY_TICKS,
    MOVING_TICKS,
    PATIENCE,
    SHAKING_RADPS2,
    Gains,
    TickNoise,
    design,
)
from calib.stages.estimator.section import EstimatorGain
from calib.stages.firmware.literals import Constant, Group, Item, Macro, Table, Whole
from calib.stages.firmware.section import Envelope
from calib.stages.imu.levelling import Levelling, settled
from calib.stages.imu.levelling import gains as gains_of
from calib.stages.lowpass.filters import Design, design_lowpass

if TYPE_CHECKING:
    from calib.core.rig import Rig

# ----------------------------------------------------------------------
# Values of rig.yaml by their keys, with the nominal actuator's where the file has none.


class Lookup:
    """Numbers of a rig by dotted keys, such as `align.accel_bias_mps2.0`; keeps the keys that it lacked.

    Parameters
    ----------
    source : the file's name for messages.
    """

    def __init__(self, rig: Rig, source: str) -> None:
        self.rig, self.source = rig, source
        self._standing = standing(rig)
        self._missing: list[str] = []

    def find(self, key: str) -> Any:
        """What stands at a key, None for nothing."""
        name, *parts = key.split(".")
        if name in self._standing and parts:
            value, _ = self._standing[name].get(parts[0], (None, None))
            return value
        node = getattr(self.rig, name)
        for part in parts:
            if node is None:
                return None
            node = node[int(part)] if isinstance(node, list) else getattr(node, part)
        return node

    def number(self, key: str, default: float, least: float = -math.inf, most: float = math.inf) -> float:
        """The number at a key, the default where there is none.

        Raises `BadInputError` for one beyond what the firmware can run with.
        """
        value = self.find(key)
        if value is None:
            self._missing.append(key)
            return default
        if not least <= value <= most:
            raise BadInputError(
                f"{self.source}: {key} is {value:g}, expected {least:g} to {most:g} for the firmware"
            )
        return float(value)

    def defaults(self) -> str:
        """The keys that took defaults since the last call, in words; empty when there were none."""
        missing, self._missing = self._missing, []
        if not missing:
            return ""
        return f"Defaults of the nominal actuator, not in rig.yaml: {', '.join(dict.fromkeys(missing))}."


# ----------------------------------------------------------------------
# The camera's constants: pinhole and lens, the polynomial that undoes the lens, and the plane.
#
# A marker goes through one of two homographies of (2.11):
#
#     CALIB_UNDISTORT 1   pixels -> normalised -> lens undone -> A^-1 K
#     CALIB_UNDISTORT 0   pixels -> a homography fitted to the pixels as the lens shows them
#
# The second neglects the lens as the source does, and spreads what that costs over the workspace. Both are
# scaled so that the denominator, 1/s of (2.12), is the reciprocal depth in 1/m and positive wherever the
# marker can be; at a tenth of its least value there the marker counts as lost behind the horizon.

_WHAT = {
    "fx_px": "focal length along u, px; sigma_mu of (2.5)",
    "fy_px": "focal length along v, px; sigma_nu of (2.5)",
    "skew_px": "skew, px; gamma of (2.5)",
    "cx_px": "principal point, px from the centre of the left column; mu_0 of (2.5)",
    "cy_px": "principal point, px from the centre of the top row; nu_0 of (2.5)",
}

_HORIZON_SHARE = 0.1

MIDDLE_M = (0.0, 0.08)
"""Place about which an alignment's stretch magnifies, as in `calib.stages.estimator.sensors`."""


@dataclass(frozen=True)
class PlaneConstants:
    """The plane's three homographies (3, 3) and the least denominator.

    Attributes
    ----------
    from_ideal : undistorted pixels to metres, A^-1.
    from_normalised : undistorted normalised coordinates to metres, A^-1 K.
    from_raw : pixels as the camera reports them to metres; None where the camera sees too little of the
        workspace to fit it.
    least : least denominators of the second and of the third in the workspace, times a tenth [1/m].
    raw_error_m : largest error of `from_raw` in the workspace.
    verdict : of the plane.
    """

    from_ideal: FloatArray
    from_normalised: FloatArray
    from_raw: FloatArray | None
    least: tuple[float, float]
    raw_error_m: float
    verdict: str


@dataclass(frozen=True)
class CameraConstants:
    """What the header says of the camera.

    Attributes
    ----------
    image_size_px : width and height.
    model, verdict : of the camera.
    intrinsics : pinhole and distortion by the names of rig.yaml (fx_px ... k1 ...).
    inverse : the polynomial that undistorts.
    plane : None without a plane.
    """

    image_size_px: tuple[int, int]
    model: str
    verdict: str
    intrinsics: dict[str, float]
    inverse: InverseLens
    plane: PlaneConstants | None


def _depths(A: FloatArray, world: FloatArray) -> FloatArray:
    return np.asarray(world @ A[2, :2] + A[2, 2])


def plane_constants(
    camera: Camera,
    R_CW: FloatArray,
    t_CW_m: FloatArray,
    A_inverse: FloatArray,
    workspace_m: tuple[float, float, float, float],
    verdict: str,
) -> PlaneConstants:
    """The plane's homographies for a marker that is in the workspace.

    Parameters
    ----------
    R_CW, t_CW_m : (3, 3) and (3,), world to camera.
    A_inverse : (3, 3) of (2.11), ideal pixels to metres.
    workspace_m : least x, least y, greatest x, greatest y.

    Raises `BadInputError` for a workspace behind the camera.
    """
    x0, y0, x1, y1 = workspace_m
    grid = np.stack(np.meshgrid(np.linspace(x0, x1, 9), np.linspace(y0, y1, 7)), axis=-1).reshape(-1, 2)
    # The denominator is the reciprocal depth when A's depth is in metres.
    A = np.asarray(np.linalg.inv(A_inverse), dtype=np.float64)
    scale = (R_CW[2, 0] * grid[0, 0] + R_CW[2, 1] * grid[0, 1] + t_CW_m[2]) / _depths(A, grid[:1])[0]
    ideal = A_inverse / scale
    depth = _depths(A * scale, grid)
    if not depth.min() > 0.0:
        raise BadInputError("plane: the workspace reaches behind the camera, so no marker can be mapped")
    least = _HORIZON_SHARE / float(depth.max())
    points = grid @ R_CW[:, :2].T + t_CW_m
    pixels = project(camera, points)
    width, height = camera.image_size_px
    inside = ((pixels >= -0.5) & (pixels <= np.array([width - 0.5, height - 0.5]))).all(axis=1)
    raw, raw_least, error = None, 0.0, 0.0
    if inside.sum() >= 12:
        H = fit_homography(grid[inside], pixels[inside], np.arange(int(inside.sum()))).H
        centre = np.array([[0.5 * (x0 + x1), 0.5 * (y0 + y1)]])
        true_depth = float((centre @ R_CW[2, :2] + t_CW_m[2])[0])
        H = H * (true_depth / _depths(H, centre)[0])
        raw = np.asarray(np.linalg.inv(H))
        raw_least = _HORIZON_SHARE / float(_depths(H, grid).max())
        back = np.concatenate([pixels[inside], np.ones((int(inside.sum()), 1))], axis=1) @ raw.T
        error = float(np.abs(back[:, :2] / back[:, 2:] - grid[inside]).max())
    K = np.array([[camera.fx_px, camera.skew_px, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    return PlaneConstants(ideal, ideal @ K, raw, (least, raw_least), error, verdict)


def put_right(plane: PlaneConstants, shift_m: tuple[float, float], stretch: float) -> PlaneConstants:
    """The plane without the error that an alignment has found: places it shows are shifted and stretched.

    Parameters
    ----------
    shift_m, stretch : the calibrated plane shows P at P + shift + stretch (P - `MIDDLE_M`).
    """
    shrink, (x, y) = 1.0 / (1.0 + stretch), MIDDLE_M
    right = np.array(
        [
            [shrink, 0.0, x - shrink * (x + shift_m[0])],
            [0.0, shrink, y - shrink * (y + shift_m[1])],
            [0.0, 0.0, 1.0],
        ]
    )
    raw = None if plane.from_raw is None else right @ plane.from_raw
    return replace(
        plane,
        from_ideal=right @ plane.from_ideal,
        from_normalised=right @ plane.from_normalised,
        from_raw=raw,
    )


def _matrix(name: str, values: FloatArray, comment: str) -> tuple[Constant, ...]:
    return tuple(
        Constant(f"{name}_{i + 1}{j + 1}", float(values[i, j]), f"row {i + 1}, {comment}")
        for i in range(3)
        for j in range(3)
    )


def _lens_group(camera: CameraConstants) -> Group:
    inverse, known = camera.inverse, camera.intrinsics
    notes = [
        "Inverse lens, normalised coordinates: yd = (v - cy) / fy, xd = (u - cx - skew yd) / fx, then",
        "x = xd P, y = yd P with P = 1 + c1 r2 + c2 r2^2 + ..., r2 = xd^2 + yd^2.",
    ]
    if inverse.decentering_steps:
        notes += [
            "Decentering: x and y as above, then CALIB_LENS_DECENTERING_STEPS times the same from",
            "xd - (2 p1 x y + p2 (r2 + 2 x^2)), yd - (p1 (r2 + 2 y^2) + 2 p2 x y) with r2 = x^2 + y^2.",
        ]
    error = "without bound" if inverse.max_error_px is None else f"at most {inverse.max_error_px:.4f} px"
    notes.append(f"Error {error} over {100 * inverse.covered:.0f} % of the picture.")
    items: list[Constant | Whole | Macro] = [
        Whole("CALIB_LENS_INVERSE_ORDER", len(inverse.radial), "number of coefficients c"),
        Whole("CALIB_LENS_DECENTERING_STEPS", inverse.decentering_steps, "0: no decentering"),
        Whole("CALIB_CAMERA_HAS_SKEW", int(known["skew_px"] != 0.0), "for #if"),
        Constant("CALIB_CAMERA_PER_FX", 1.0 / known["fx_px"], "1 / fx, 1/px"),
        Constant("CALIB_CAMERA_PER_FY", 1.0 / known["fy_px"], "1 / fy, 1/px"),
    ]
    items += [
        Constant(f"CALIB_LENS_INVERSE_C{i}", value, f"coefficient of r2^{i}, dimensionless")
        for i, value in enumerate(inverse.radial, start=1)
    ]
    body = "1.0f"
    if inverse.radial:
        names = [f"CALIB_LENS_INVERSE_C{i}" for i in range(1, len(inverse.radial) + 1)]
        body = f"(1.0f + (r2) * {' + (r2) * ('.join(['(' + names[0], *names[1:]])}{')' * (len(names) + 1)}"
    items.append(Macro("CALIB_LENS_INVERSE_P(r2)", body, "P by Horner's scheme"))
    return Group(tuple(notes), tuple(items))


def _plane_groups(plane: PlaneConstants) -> list[Group]:
    ok = Whole("CALIB_PLANE_OK", int(plane.verdict == "ok"), "0: the plane failed its gate")
    groups = [
        Group(
            ("Plane of the actuator, without the shift and stretch that align has found.",),
            (
                Whole("CALIB_HAS_PLANE", 1, "for #if"),
                ok,
                *_matrix(
                    "CALIB_PLANE_INVERSE",
                    plane.from_ideal,
                    "A^-1, undistorted px to m; (2.11), row 3 gives 1/s of (2.12) in 1/m",
                ),
            ),
        ),
        Group(
            ("The same from normalised undistorted coordinates, for CALIB_UNDISTORT 1.",),
            (
                *_matrix("CALIB_PLANE_NORMALISED", plane.from_normalised, "A^-1 K, dimensionless to m"),
                Constant(
                    "CALIB_PLANE_LEAST_PER_M", plane.least[0], "1/s below this: behind the horizon, 1/m"
                ),
            ),
        ),
        Group(
            (
                "The same from pixels as the camera reports them, fitted over the workspace, for",
                f"CALIB_UNDISTORT 0. Neglecting the lens costs up to {1e3 * plane.raw_error_m:.3f} mm there.",
            ),
            (
                Whole(
                    "CALIB_HAS_RAW_PLANE", int(plane.from_raw is not None), "0: the workspace is not in sight"
                ),
                *(
                    ()
                    if plane.from_raw is None
                    else (
                        *_matrix("CALIB_PLANE_RAW", plane.from_raw, "distorted px to m"),
                        Constant(
                            "CALIB_PLANE_RAW_LEAST_PER_M",
                            plane.least[1],
                            "1/s below this: behind the horizon, 1/m",
                        ),
                    )
                ),
            ),
        ),
    ]
    return groups


def camera_groups(camera: CameraConstants | None) -> tuple[Group, ...]:
    """Camera, lens and plane as groups of the header."""
    no_plane = Group(
        ("No plane yet: the sketch records, and controls nothing.",),
        (Whole("CALIB_HAS_PLANE", 0, "for #if"),),
    )
    if camera is None:
        return (no_plane,)
    width, height = camera.image_size_px
    lens = camera.model == FISHEYE or any(
        value != 0.0 for name, value in camera.intrinsics.items() if not name.endswith("_px")
    )
    rows = [
        Constant(
            f"CALIB_CAMERA_{name.upper()}",
            value,
            _WHAT.get(name, "lens, dimensionless, OpenCV's order and signs"),
        )
        for name, value in camera.intrinsics.items()
    ]
    head = Group(
        ("Camera (2.5) and lens (B.1).",),
        (
            Whole("CALIB_IMAGE_WIDTH_PX", width, "columns"),
            Whole("CALIB_IMAGE_HEIGHT_PX", height, "rows"),
            Whole("CALIB_CAMERA_OK", int(camera.verdict == "ok"), "0: the calibration failed its gate"),
            Constant(
                "CALIB_CAMERA_GREATEST_U_PX",
                width - 0.5,
                "greatest u inside the picture, px; the least is -0.5",
            ),
            Constant(
                "CALIB_CAMERA_GREATEST_V_PX",
                height - 0.5,
                "greatest v inside the picture, px; the least is -0.5",
            ),
            Whole("CALIB_CAMERA_HAS_LENS", int(lens), "0: no distortion, default of CALIB_UNDISTORT"),
            *rows,
        ),
    )
    if camera.plane is None:
        return head, _lens_group(camera), no_plane
    return head, _lens_group(camera), *_plane_groups(camera.plane)


# ----------------------------------------------------------------------
# From sensors to the bellows' lengths: tick, IMU, angle filter, marker offset, low-pass, kinematics.
#
# The tick's period is folded into the gains of the angle filter (2.3), whose integral is kept as an angle
# per tick J = I dt:
#
#     J   += (Ki dt^2) e                       e = atan2(ay, ax) - mount - phi, wrapped to half a turn
#     phi += (Kp dt) e + J - dt gz,                J = bias dt at the start
#
# The levelling filter takes V of `calib.stages.imu.levelling` as a sum of angles over ticks, S = V / dt. Its
# gains stand in a table for the ticks at which they change, the last for ever.
#
#     phi += J - dt (gz + gz of the tick before) / 2,   S += e
#     phi += A S,   J += B S,   S -= C S
#
# A section of the low-pass of order one, b0 (1 + z^-1) / (1 + a1 z^-1), runs in the trapezoidal form
# v = b0 (x - s), y = s + v, s' = y + v: one product, and y = x exactly at rest. A section of order two runs
# as a state-variable filter with three gains derived from b0, a1, a2 (Simper 2013), at rest as exact:
#
#     D = 2 / (2 b0 - a1),  g = sqrt(b0 D);   A1 = 1 / D,  A2 = g / D,  A3 = b0.

PHI_LIMIT_RAD = 1.58
"""Largest angle of the head that the firmware's sine and cosine are made for."""

_HOLD_S = 1.0
_ACCEL_LIMIT_MPS2 = 157.0
_RATE_LIMIT_RADPS = 35.0
_WEAK_MPS2 = 1.0
_BIAS_LIMIT_RADPS = 1.0
_LONGEST_OFFSET_TICKS = 8


def tick_rate_hz(lookup: Lookup) -> float:
    """Rate of the control loop: that of the low-pass, or 60 Hz."""
    return lookup.number("lowpass.rate_hz", 60.0, 1.0, 1000.0)


def _tick_group(lookup: Lookup, rate_hz: float) -> Group:
    offset_s = lookup.number("align.time_offset_s", 0.0)
    ticks = round(offset_s * rate_hz)
    if not 0 <= ticks <= _LONGEST_OFFSET_TICKS:
        raise BadInputError(
            f"{lookup.source}: align.time_offset_s is {offset_s:g} s, {ticks} ticks; "
            f"expected 0 to {_LONGEST_OFFSET_TICKS} ticks, by which the pictures are late"
        )
    return Group(
        ("The tick: one picture, one sample of the IMU, one command.",),
        (
            Constant("CALIB_TICK_RATE_HZ", rate_hz, "ticks per second, Hz"),
            Whole("CALIB_TICK_RATE_MHZ", round(1e3 * rate_hz), "the same in millihertz, for #if"),
            Constant("CALIB_TICK_PERIOD_S", 1.0 / rate_hz, "dt, s"),
            Whole(
                "CALIB_HOLD_TICKS",
                round(_HOLD_S * rate_hz),
                "a sensor that is silent for longer stops the pumps",
            ),
            Whole(
                "CALIB_TIME_OFFSET_TICKS", ticks, "ticks by which a picture is later than the IMU, positive"
            ),
            Constant(
                "CALIB_TIME_OFFSET_REST_S",
                offset_s - ticks / rate_hz,
                "what the whole ticks leave of that, s, unused",
            ),
        ),
        lookup.defaults(),
    )


def _imu_groups(lookup: Lookup, rate_hz: float) -> tuple[Group, Group, Group]:
    dt = 1.0 / rate_hz
    bias, ratio = [0.0, 0.0], 1.0
    if lookup.find("align") is not None:
        mount = math.remainder(lookup.number("align.mount_angle_rad", 0.0), 2.0 * math.pi)
        bias = [lookup.number(f"align.accel_bias_mps2.{i}", 0.0) for i in range(2)]
        x, y = (1.0 + lookup.number(f"align.accel_scale.{i}", 0.0) for i in range(2))
        ratio = x / y
        gyro = lookup.number("align.gyro_bias_radps", 0.0)
        scale = 1.0 + lookup.number("align.gyro_scale", 0.0)
    else:
        mount, scale = lookup.number("align.rest_angle_rad", 0.0), 1.0
        gyro = lookup.number("imu.gyro_bias_radps.2", 0.0)
        if lookup.find("imu_intrinsics.accel.unit") == "m/s2":
            bias = [lookup.number(f"imu_intrinsics.accel.bias.{i}", 0.0) for i in range(2)]
    signs = [1, 1, 1]
    imu = Group(
        (
            "IMU on the head, x from the head to the base at rest; phi = atan2(RATIO ay, ax) - mount (2.1),",
            "dphi/dt = -gz. rig.yaml has no key for the signs of the axes, they are 1.",
        ),
        (
            Whole(
                "CALIB_IMU_SIGN_AX",
                signs[0],
                "1 or -1, by hand for an IMU that is not right-handed as mounted",
            ),
            Whole("CALIB_IMU_SIGN_AY", signs[1], "1 or -1"),
            Whole("CALIB_IMU_SIGN_GZ", signs[2], "1 or -1"),
            Constant("CALIB_IMU_ACCEL_BIAS_X_MPS2", bias[0], "subtracted from ax, m/s^2"),
            Constant("CALIB_IMU_ACCEL_BIAS_Y_MPS2", bias[1], "subtracted from ay, m/s^2"),
            Constant(
                "CALIB_IMU_ACCEL_RATIO", ratio, "of ay less its bias: (1 + scale of x) / (1 + scale of y)"
            ),
            Constant("CALIB_IMU_GYRO_BIAS_RADPS", gyro, "gz at rest, rad/s; sign as read"),
            Constant(
                "CALIB_IMU_MOUNT_ANGLE_RAD",
                mount,
                "atan2(RATIO ay, ax) at rest at phi = 0, subtracted, rad, -pi to pi",
            ),
            Constant("CALIB_IMU_ACCEL_LIMIT_MPS2", _ACCEL_LIMIT_MPS2, "readings beyond are lost, m/s^2"),
            Constant("CALIB_IMU_RATE_LIMIT_RADPS", _RATE_LIMIT_RADPS, "readings beyond are lost, rad/s"),
            Constant(
                "CALIB_IMU_ACCEL_WEAK_MPS2", _WEAK_MPS2, "|ax| and |ay| below say nothing of phi, m/s^2"
            ),
        ),
        lookup.defaults(),
    )
    angle = (
        _levelling_group(lookup, rate_hz) if lookup.find("orientation_filter.filter") == "levelling" else None
    )
    Kp = lookup.number("orientation_filter.Kp_per_s", 3.0, 0.0, rate_hz)
    Ki = lookup.number("orientation_filter.Ki_per_s2", 3.0, 0.0, rate_hz * rate_hz)
    mahony = Group(
        (
            "Angle filter (2.3), dt folded in. The integral is kept as an angle per tick, J = I dt:",
            "J += KI_DT2 e, phi += KP_DT e + J - DT gz; J begins at GYRO_BIAS_DT.",
        ),
        (
            Constant("CALIB_MM_KP_DT", Kp * dt, f"Kp dt, dimensionless; Kp = {Kp:.9g} 1/s"),
            Constant("CALIB_MM_KI_DT2", Ki * dt * dt, f"Ki dt^2, dimensionless; Ki = {Ki:.9g} 1/s^2"),
            Constant(
                "CALIB_MM_DT_S",
                dt / scale,
                "dt of the rate over the gyroscope's scale, s; phi falls for gz > 0",
            ),
            Constant("CALIB_MM_GYRO_BIAS_DT_RAD", signs[2] * gyro * dt / scale, "bias times the same, rad"),
            Constant("CALIB_MM_INTEGRAL_LIMIT_RAD", _BIAS_LIMIT_RADPS * dt, "|J| stays below, rad"),
            Constant(
                "CALIB_PHI_LIMIT_RAD",
                PHI_LIMIT_RAD,
                "|phi| stays below; range of the sine in the pipeline, rad",
            ),
        ),
        lookup.defaults(),
    )
    levelled = angle or Group(
        ("Angle filter: (2.3).",), (Whole("CALIB_LEVELLING", 0, "1: the levelling filter, for #if"),)
    )
    return imu, levelled, mahony


_LEVELLING_STEPS = 17


def _levelling_group(lookup: Lookup, rate_hz: float) -> Group:
    """Gains of the levelling filter from the first tick on, constant over stretches that grow."""
    tau_s = lookup.number("orientation_filter.tau_s", Levelling.tau_s, 2.0 / rate_hz, 100.0)
    velocity = lookup.number("orientation_filter.velocity_mps", Levelling.velocity_mps, 1e-4, 100.0)
    filter_ = Levelling(tau_s, velocity)
    dt, last = 1.0 / rate_hz, min(round(3.0 * filter_.bias_tau_s * rate_hz), 0xFFFF)
    edges = np.unique(np.round(np.geomspace(1.0, last, _LEVELLING_STEPS))).astype(int)
    gains = gains_of(filter_, dt, last)
    rows = [gains[a - 1 : b - 1].mean(axis=0) for a, b in pairwise(edges.tolist())]
    table = np.array([*rows, settled(filter_, dt)]) * [1.0, dt, dt * dt]
    return Group(
        (
            f"Angle filter: levelling, tau {tau_s:g} s, velocity {velocity:g} m/s; S is a sum of angles:",
            "phi += J - DT (gz + gz before) / 2, S += e; then phi += ANGLE S, J += BIAS S, S -= SUM S.",
        ),
        (
            Whole("CALIB_LEVELLING", 1, "1: the levelling filter, for #if"),
            Whole("CALIB_LEVELLING_STEPS", len(table), "entries of each table; the last holds for ever"),
            Table(
                "calib_levelling_until",
                tuple(map(float, [*(edges[1:] - 1), 0.0])),
                "ticks for which each holds",
            ),
            Table("calib_levelling_angle", tuple(table[:, 1].tolist()), "ANGLE, dimensionless"),
            Table("calib_levelling_bias", tuple(table[:, 2].tolist()), "BIAS, dimensionless"),
            Table("calib_levelling_sum", tuple(table[:, 0].tolist()), "SUM, dimensionless"),
        ),
        lookup.defaults(),
    )


def _sections(lookup: Lookup, rate_hz: float) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """(b0, b1, b2), (a1, a2) of each section; order one has b2 = a2 = 0 and comes last."""
    if lookup.rig.lowpass is None:
        lookup.number("lowpass.cutoff_hz", 1.0)
        # Rounded so that the gain at rest is one, as the sections of rig.yaml are.
        a1 = float(np.float32(design_lowpass(Design(1.0, rate_hz)).exact[0, 4]))
        b0 = 0.5 * (1.0 + a1)
        return [((b0, b0, 0.0), (a1, 0.0))]
    sections = [(tuple(one.b), tuple(one.a[1:])) for one in lookup.rig.lowpass.sections]
    return sorted(sections, key=lambda section: section[1][1] == 0.0)


def _lowpass_group(lookup: Lookup, rate_hz: float) -> Group:
    items: list[Constant | Whole] = []
    pairs = 0
    single = False
    for i, (b, a) in enumerate(_sections(lookup, rate_hz), start=1):
        stem = f"CALIB_LOWPASS_{i}"
        for j, value in enumerate(b):
            items.append(Constant(f"{stem}_B{j}", value, f"b{j}, dimensionless"))
        for j, value in enumerate(a, start=1):
            items.append(Constant(f"{stem}_A{j}", value, f"a{j}, dimensionless, SciPy's sign"))
        if a[1] == 0.0:
            single = True
            items.append(Constant("CALIB_LOWPASS_SINGLE_G", b[0], "v = G (x - s), y = s + v, s' = y + v"))
            continue
        D = 2.0 / (2.0 * b[0] - a[0])
        if not D > 0.0 or not b[0] > 0.0:
            raise BadInputError(f"{lookup.source}: lowpass.sections.{i - 1} is no low-pass of bilinear form")
        pairs += 1
        g = math.sqrt(b[0] * D)
        for name, value in (("A1", 1.0 / D), ("A2", g / D), ("A3", b[0])):
            items.append(Constant(f"CALIB_LOWPASS_PAIR{pairs}_{name}", value, "of the state-variable form"))
    notes = (
        "Low-pass of x and y. y_k = b0 x_k + b1 x_(k-1) + b2 x_(k-2) - a1 y_(k-1) - a2 y_(k-2): SciPy's",
        "sign of a1, a2; CMSIS-DSP wants -a1, -a2. The pipeline runs forms exact at rest: SINGLE, PAIR.",
    )
    counts = [
        Whole("CALIB_LOWPASS_PAIRS", pairs, "sections of order two"),
        Whole("CALIB_LOWPASS_SINGLES", int(single), "sections of order one"),
    ]
    return Group(notes, (*counts, *items), lookup.defaults())


def _kinematics_groups(lookup: Lookup) -> tuple[Group, Group]:
    plant = Plant()
    radius = lookup.number("actuator.bellows_radius_m", plant.bellows_radius_m)
    rest = lookup.number("actuator.rest_length_m", plant.rest_length_m)
    body = lookup.defaults()
    offset = lookup.number("align.marker_offset_m", MARKER_OFFSET_M)
    marker = Group(
        ("Marker to head (A.1): x = X - d sin(phi), y = Y - d cos(phi).",),
        (Constant("CALIB_MARKER_OFFSET_M", offset, "d, m; positive beyond the head"),),
        lookup.defaults(),
    )
    series = [float(c) for c in inverse_coefficients()]
    return marker, Group(
        (
            "Inverse kinematics (3.12) with the series (3.14): q1,2 = |(x, y)| f(phi) / 2 +- r_B phi,",
            "f = F0 + F1 phi^2 + F2 phi^4 + F3 phi^6; bellows 1 is the longer one for phi > 0.",
        ),
        (
            Constant("CALIB_BELLOWS_RADIUS_M", radius, "r_B, m"),
            Constant("CALIB_REST_LENGTH_M", rest, "l0, m; length until the first picture"),
            *(
                Constant(
                    f"CALIB_INVERSE_F{n}_PER_RAD{2 * n}",
                    value,
                    f"coefficient of phi^{2 * n} (3.14), 1/rad^{2 * n}",
                )
                for n, value in enumerate(series)
            ),
        ),
        body,
    )


def motion_groups(lookup: Lookup) -> tuple[Group, ...]:
    """Groups of the header from the tick to the kinematics.

    Raises `BadInputError` for values of rig.yaml that the firmware cannot run with.
    """
    rate_hz = tick_rate_hz(lookup)
    tick = _tick_group(lookup, rate_hz)
    imu, levelling, mahony = _imu_groups(lookup, rate_hz)
    lowpass = _lowpass_group(lookup, rate_hz)
    marker, kinematics = _kinematics_groups(lookup)
    return tick, imu, levelling, mahony, marker, lowpass, kinematics


# ----------------------------------------------------------------------
# Controllers of chapter 4 for the firmware: gains with the tick folded in, feed-forward, pump limits.
#
# (4.4) summed from a history of zeros is, term by term and clamped ticks included,
#
#     u_k = (Kp + Kd / dt) e_k - Kd / dt e_(k-1) + S_k,   S_k = S_(k-1) + Ki dt / 2 (e_k + e_(k-1)),
#
# where a tick whose u_k lies outside the limits leaves S as it was and takes u_k without the new summand.
# These are the values of the incremental form, but what rounding does to a PD controller's output does not
# add up from tick to tick. The pipeline keeps P_k = S_k + Ki dt / 2 e_k, which saves it a product:
#
#     u_k = (Kp + Kd / dt + Ki dt / 2) e_k + (P_(k-1) - Kd / dt e_(k-1)),   P_k = P_(k-1) + Ki dt e_k.

_ORIENTATION = Pid(1000.0, 1000.0, 10.0, clamping=True)
_POSITION = Pid(15000.0, 0.0, 150.0)
_TABLE_STEP_M = 0.002


def _pid_group(
    lookup: Lookup, name: str, title: str, units: tuple[str, str], default: Pid, rate_hz: float
) -> Group:
    stem, key, (unit, words) = f"CALIB_{name.upper()}", f"controller.{name}", units

    def gain(which: str, value: float) -> float:
        return lookup.number(f"{key}.{which}", value)

    Kp = gain(f"Kp_pwm_per_{words}", default.Kp)
    Ki = gain(f"Ki_pwm_per_{words}_s", default.Ki)
    Kd = gain(f"Kd_pwm_s_per_{words}", default.Kd)
    clamping, back = int(default.clamping), 0.0
    tuned = lookup.find(key)
    if isinstance(tuned, OrientationGains):
        clamping, back = 0, 1.0 / (rate_hz * tuned.back_calculation_s)
        if tuned.falling_share is not None:
            title += " falling_share is left out: the lower limit is CALIB_PUMP_LOW_PWM."
    derivative, half = Kd * rate_hz, 0.5 * Ki / rate_hz
    per = f"PWM_PER_{unit}"
    return Group(
        (
            title,
            f"Kp = {Kp:.9g}, Ki = {Ki:.9g}, Kd = {Kd:.9g}, error in {words}. The pipeline sums (4.4) up:",
            "u = KPDI e_k + (P - KD_PER_DT e_(k-1)), P += 2 KI_HALF_DT e_k; E0, E1, E2 are the factors of",
            "e_k, e_(k-1), e_(k-2) in the incremental form u_k = u_(k-1) + ..., (4.4) and (D.9).",
        ),
        (
            Constant(f"{stem}_KPDI_{per}", Kp + derivative + half, f"Kp + Kd / dt + Ki dt / 2, PWM/{words}"),
            Constant(f"{stem}_KD_PER_DT_{per}", derivative, f"Kd / dt, PWM/{words}"),
            Constant(f"{stem}_KI_HALF_DT_{per}", half, f"Ki dt / 2, PWM/{words}"),
            Whole(f"{stem}_HAS_KI", int(Ki != 0.0), "for #if"),
            Whole(f"{stem}_CLAMPING", clamping, "1: no integration beyond the limits (4.1.1)"),
            Whole(f"{stem}_HAS_BACK", int(back != 0.0), "1: back-calculation, P += BACK (limited - u)"),
            Constant(f"{stem}_BACK", back, "dt / time constant of the back-calculation, dimensionless"),
            Constant(f"{stem}_E0_{per}", Kp + half + derivative, f"Kp + Ki dt / 2 + Kd / dt, PWM/{words}"),
            Constant(
                f"{stem}_E1_{per}", half - Kp - 2.0 * derivative, f"-Kp + Ki dt / 2 - 2 Kd / dt, PWM/{words}"
            ),
            Constant(f"{stem}_E2_{per}", derivative, f"Kd / dt, PWM/{words}"),
        ),
        lookup.defaults(),
    )


def _nominal_table() -> tuple[float, tuple[float, ...]]:
    """First length and PWM values of the steady elongation of both bellows together (2.13)."""
    pump = ElongationForce()
    pwm = np.linspace(pump.dead_zone_V / pump.supply_V * PWM_MAX, PWM_MAX, 2000)
    eps = 1e-3 * np.polyval(pump.elongation_mm, pump.supply_V * pwm / PWM_MAX)
    rising = np.maximum.accumulate(np.maximum(eps, 0.0))
    lengths = np.arange(0.0, float(rising[-1]) + _TABLE_STEP_M, _TABLE_STEP_M)
    keep = np.concatenate([[True], np.diff(rising) > 0.0])
    return Plant().rest_length_m, tuple(float(v) for v in np.interp(lengths, rising[keep], pwm[keep]))


def _tuned_table(map_: StaticMap, low_pwm: float) -> tuple[float, tuple[float, ...]]:
    """First length and PWM values that hold the straight actuator at lengths, by the rig's static map."""
    force, pwm = np.array(map_.force_pwm).T
    first = map_.rest_length_m
    lengths = np.arange(0.0, LONGEST_ELONGATION_M + 1e-9, _TABLE_STEP_M)
    wanted = np.polyval(map_.stiffness_N_per_m[::-1], lengths) * lengths / np.mean(map_.strength)
    held = np.where(wanted < force[0], low_pwm, np.interp(wanted, force, pwm))
    last = int(np.searchsorted(wanted, force[-1])) + 1
    return first, tuple(float(v) for v in held[: max(last, 2)])


def _feedforward_group(lookup: Lookup, low_pwm: float) -> Group:
    line = FeedForward()
    at, offset, slope, limit = line.from_m, line.offset_pwm, line.slope_pwm_per_m, line.limit_pwm
    first, values = _nominal_table()
    tuned = lookup.find("controller.feedforward")
    if isinstance(tuned, StaticMap):
        first, values = _tuned_table(tuned, low_pwm)
        told = "The table: controller.feedforward at phi = 0, without bending; the line: (4.6)."
    else:
        told = "Defaults, not in rig.yaml: the line (4.6), and the table of (2.13)."
    table, step = int(isinstance(tuned, StaticMap)), _TABLE_STEP_M
    return Group(
        (
            "Feed-forward: the line (4.6), 0 below FROM, else min(LIMIT, OFFSET + SLOPE (q_ref - FROM)), or",
            "the table of steady lengths: linear between entries, the last one beyond, 0 before the first.",
        ),
        (
            Whole("CALIB_FF_USE_TABLE", table, "0: the line, 1: the table"),
            Constant("CALIB_FF_FROM_M", at, "shortest bellows that needs pressure, m"),
            Constant("CALIB_FF_OFFSET_PWM", offset, "value there, PWM"),
            Constant("CALIB_FF_SLOPE_PWM_PER_M", slope, "PWM/m"),
            Constant("CALIB_FF_MINUS_PWM", slope * at - offset, "SLOPE FROM - OFFSET, PWM"),
            Constant("CALIB_FF_LIMIT_PWM", limit, "largest value, PWM"),
            Constant("CALIB_FF_TABLE_FROM_M", first, "length of the first entry, m"),
            Constant("CALIB_FF_TABLE_PER_STEP", 1.0 / step, "entries per metre, 1/m"),
            Whole("CALIB_FF_TABLE_SIZE", len(values), "entries"),
            Table(
                "calib_ff_table_pwm",
                values,
                f"PWM that holds a bellows at FROM + {step:.9g} m times the index",
            ),
        ),
        told,
    )


def _limits(lookup: Lookup) -> tuple[float, float]:
    low = lookup.number("controller.pwm_low", PWM_MIN)
    high = lookup.number("controller.pwm_high", PWM_MAX)
    if not low < high or high != round(high) or low != round(low):
        raise BadInputError(
            f"{lookup.source}: controller.pwm_low and pwm_high are {low:g} and {high:g}, "
            "expected rising whole numbers"
        )
    return low, high


def _pump_group(lookup: Lookup, low: float, high: float) -> Group:
    pump = ElongationForce()
    supply = lookup.number("pump.supply_V", pump.supply_V)
    dead = lookup.number("pump.dead_zone_V", pump.dead_zone_V)
    return Group(
        ("Pumps.",),
        (
            Constant("CALIB_PUMP_LOW_PWM", low, "least command and limit of the clamping, PWM"),
            Constant("CALIB_PUMP_HIGH_PWM", high, "greatest command and limit of the clamping, PWM"),
            Whole("CALIB_PUMP_HIGH", round(high), "the same, for #if"),
            Constant(
                "CALIB_PUMP_DEAD_ZONE_PWM", PWM_MAX * dead / supply, "no pressure below, PWM, for information"
            ),
            Constant("CALIB_PUMP_SUPPLY_V", supply, "at PWM 255, V, for information"),
        ),
        lookup.defaults(),
    )


def control_groups(lookup: Lookup, rate_hz: float) -> tuple[Group, ...]:
    """Groups of the header for both controllers, the feed-forward and the pumps.

    Raises `BadInputError` for values of rig.yaml that the firmware cannot run with.
    """
    tick_s = lookup.number("controller.tick_s", 1.0 / rate_hz)
    if abs(tick_s * rate_hz - 1.0) > 1e-6:
        raise BadInputError(
            f"{lookup.source}: controller.tick_s is {tick_s:g} s, but the low-pass runs at {rate_hz:g} Hz; "
            "expected the same tick for both"
        )
    low, high = _limits(lookup)
    pumps = _pump_group(lookup, low, high)
    angle = _pid_group(
        lookup,
        "orientation",
        "Control of the angle, PID (4.1), (4.4).",
        ("RAD", "rad"),
        _ORIENTATION,
        rate_hz,
    )
    sign = round(lookup.number("controller.orientation.sign", 1))
    crossed = Group(
        ("Which bellows a positive error of the angle drives (4.1).",),
        (Whole("CALIB_ORIENTATION_SIGN", sign, "1: bellows 1; -1: the hoses are crossed"),),
        lookup.defaults(),
    )
    lengths = _pid_group(
        lookup, "position", "Control of both lengths, PD (4.5), (4.8).", ("M", "m"), _POSITION, rate_hz
    )
    return (
        pumps,
        angle,
        crossed,
        lengths,
        _feedforward_group(lookup, low),
        _envelope_group(lookup, rate_hz, low, high),
    )


_SHORTEST_M, _LONGEST_M = 0.5 * LONGEST_ELONGATION_M, 1.25 * LONGEST_ELONGATION_M
"""By how much a bellows may be shorter and longer than at rest."""


def _held_pwm(lookup: Lookup, length_m: float, low_pwm: float) -> float:
    """The command that holds both bellows at a length, the greatest one where none does [PWM]."""
    tuned = lookup.find("controller.feedforward")
    first, table = _tuned_table(tuned, low_pwm) if isinstance(tuned, StaticMap) else _nominal_table()
    reached = first + _TABLE_STEP_M * np.arange(len(table))
    return float(np.interp(length_m, reached, table, right=PWM_MAX))


def _envelope_group(lookup: Lookup, rate_hz: float, low: float, high: float) -> Group:
    """Limits of the guard, from the actuator's rest length and radius where a person states none."""
    plant, told = Plant(), Envelope()
    rest = lookup.number("actuator.rest_length_m", plant.rest_length_m)
    radius = lookup.number("actuator.bellows_radius_m", plant.bellows_radius_m)
    lookup.defaults()
    least = lookup.number("envelope.least_length_m", max(rest - _SHORTEST_M, 0.1 * rest))
    greatest = lookup.number("envelope.greatest_length_m", rest + _LONGEST_M)
    angle = lookup.number("envelope.angle_rad", min(_LONGEST_M / (2.0 * radius), 1.5))
    rate = lookup.number("envelope.rate_mps", told.rate_mps)
    full = lookup.number("envelope.full_power_s", told.full_power_s)
    apart = lookup.number("envelope.apart_m", told.apart_m)
    if not least < greatest:
        raise BadInputError(
            f"{lookup.source}: envelope.least_length_m is {least:g}, expected less than the greatest, "
            f"{greatest:g}"
        )
    open_s = lookup.number("envelope.open_loop_s", told.open_loop_s)
    most = lookup.number("envelope.open_loop_pwm", _held_pwm(lookup, greatest, low), low, high)
    ticks, open_ticks = (min(max(round(time * rate_hz), 1), 65000) for time in (full, open_s))
    return Group(
        ("Envelope, see calib_guard.h: the pumps stop where the actuator leaves it.",),
        (
            Constant("CALIB_ENVELOPE_LEAST_M", least, "shortest length of a bellows, m"),
            Constant("CALIB_ENVELOPE_GREATEST_M", greatest, "longest length of a bellows, m"),
            Constant("CALIB_ENVELOPE_ANGLE_RAD", angle, "greatest bending to each side, rad"),
            Constant(
                "CALIB_ENVELOPE_STEP_M",
                rate / rate_hz,
                f"greatest change of a length in a tick, m; {rate:g} m/s",
            ),
            Whole("CALIB_ENVELOPE_FULL_TICKS", ticks, "ticks that a pump may stay at its greatest command"),
            Whole("CALIB_ENVELOPE_OPEN_TICKS", open_ticks, "ticks that a pump may be on in open loop"),
            Constant(
                "CALIB_ENVELOPE_OPEN_HIGH_PWM",
                math.floor(most),
                "greatest command in open loop: what holds the longest length by the pump's map, PWM",
            ),
            Whole("CALIB_ENVELOPE_OPEN_HIGH", math.floor(most), "the same as a whole number"),
            Constant(
                "CALIB_ENVELOPE_APART_M",
                apart,
                "marker from where the angle puts it at most, m",
            ),
        ),
        lookup.defaults(),
    )


def trust_group(ok: bool, simulated: bool) -> Group:
    """Whether the constants may drive a real rig."""
    return Group(
        ("Whether these constants may drive a rig. The guard compiles for a board only where they may.",),
        (
            Whole("CALIB_RIG_OK", int(ok), "0: a section that they come from is not ok"),
            Whole(
                "CALIB_SIMULATED", int(simulated), "1: they come from a simulated rig or rendered pictures"
            ),
        ),
    )


# ----------------------------------------------------------------------
# Constants of the fused estimator, from `align` and `estimator.constant_gain` of rig.yaml.
#
# The tick is that of `calib.stages.estimator.constant_gain`. Its calibration of the IMU is folded into one
# affine map:
# with f = ((a_x - b_x) / (1 + s_x), (a_y - b_y) / (1 + s_y)), the mount alpha and k = K_a / g,
#
#     A = k ( f_x cos alpha + f_y sin alpha),   B = k (-f_x sin alpha + f_y cos alpha),
#
# so that K_a e_a = B cos(phi_D) - A sin(phi_D) - K_a (phi - phi_D). A picture's age of D ticks is
# `TICKS` = ceil(D) remembered angles less the share `PART` = TICKS - D of a tick.

_WHOLE = 1e-6
_FUSED_WEAK_MPS2 = 1.0
_GRAVITY_MPS2 = 9.81


def _designed(lookup: Lookup, rate_hz: float, plane: PlaneConstants) -> Gains:
    """Gains for the noise that the alignment has found, at the head's rest; a tracker of whole pixels."""
    rest = lookup.number("actuator.rest_length_m", Plant().rest_length_m)
    d = lookup.number("align.marker_offset_m", 0.0)
    # How places of the marker change with a pixel there, by the undistorted plane.
    H = np.linalg.inv(plane.from_ideal)
    at = H @ np.array([0.0, rest + d, 1.0])
    by_place = (H[:2, :2] - np.outer(at[:2] / at[2], H[2, :2])) / at[2]
    pixel = math.hypot(lookup.number("align.jitter_px", 0.3), math.sqrt(1.0 / 12.0))
    across, along = pixel * np.linalg.norm(np.linalg.inv(by_place), axis=1)
    lever = 0.5 * rest + d
    reach = 0.5 * rest + lookup.number("align.imu_lever_m", 0.0)
    shaken = math.hypot(lookup.number("align.accel_noise_mps2.0", 0.0), SHAKING_RADPS2 * reach)
    noise = TickNoise(
        float(across) / lever,
        float(along),
        lookup.number("align.gyro_noise_radps", 0.0),
        shaken / _GRAVITY_MPS2,
    )
    return design(noise, rate_hz, _delay_ticks(lookup, rate_hz) / rate_hz, lever)


def _delay_ticks(lookup: Lookup, rate_hz: float) -> float:
    delay = lookup.number("align.time_offset_s", 0.0) * rate_hz
    # As far as the whole ticks of the other filters reach.
    if not -0.5 <= delay <= MOST_DELAY_TICKS + 0.5:
        raise BadInputError(
            f"{lookup.source}: align.time_offset_s is {delay / rate_hz:g} s, {delay:.3g} ticks; "
            f"expected pictures that are 0 to {MOST_DELAY_TICKS} ticks late"
        )
    return min(max(delay, 0.0), float(MOST_DELAY_TICKS))


def _delay_items(lookup: Lookup, rate_hz: float) -> list[Item]:
    delay = _delay_ticks(lookup, rate_hz)
    ticks = math.ceil(delay - _WHOLE)
    return [
        Whole("CALIB_FUSED_TICKS", ticks, "angles that are remembered, ceil(D)"),
        Constant("CALIB_FUSED_PART", max(ticks - delay, 0.0), "ceil(D) - D, share of a tick"),
        Constant("CALIB_FUSED_DELAY_TICKS", delay, "D, ticks from the exposure of a picture to its tick"),
    ]


def _imu_items(lookup: Lookup, rate_hz: float, accel_gain: float) -> list[Item]:
    bias = [lookup.number(f"align.accel_bias_mps2.{i}", 0.0) for i in range(2)]
    scale = [1.0 + lookup.number(f"align.accel_scale.{i}", 0.0) for i in range(2)]
    alpha = lookup.number("align.mount_angle_rad", 0.0)
    turned = 0.5 / (rate_hz * (1.0 + lookup.number("align.gyro_scale", 0.0)))
    gyro = lookup.number("align.gyro_bias_radps", 0.0)
    k = accel_gain / _GRAVITY_MPS2
    ca, sa = k * math.cos(alpha), k * math.sin(alpha)
    rows = ((ca / scale[0], sa / scale[1]), (-sa / scale[0], ca / scale[1]))
    items: list[Item] = []
    for i, (x, y) in enumerate(rows, start=1):
        name = f"CALIB_FUSED_ACCEL_{i}"
        items += [
            Constant(f"{name}1", x, f"row {i}, of ax, K_a / g times mount and scale, rad per m/s^2"),
            Constant(f"{name}2", y, f"row {i}, of ay, rad per m/s^2"),
            Constant(name, x * bias[0] + y * bias[1], f"row {i}, of the biases, subtracted, rad"),
        ]
    return [
        *items,
        Constant("CALIB_FUSED_ACCEL_GAIN", accel_gain, "K_a, share of the accelerometer's residual"),
        Constant("CALIB_FUSED_ACCEL_WEAK", k * _FUSED_WEAK_MPS2, "|A| and |B| below say nothing of phi, rad"),
        Constant("CALIB_FUSED_HALF_DT_S", turned, "dt / 2 over the gyroscope's scale, s"),
        Constant("CALIB_FUSED_HALF_BIAS_RAD", turned * gyro, "bias times the same, rad"),
    ]


def fused_group(lookup: Lookup, rate_hz: float, plane: PlaneConstants | None) -> Group:
    """The group of the header; CALIB_HAS_FUSED is 0 where rig.yaml lacks plane or alignment.

    The gains are those of `estimator.constant_gain`, or for the noise in `align` where there are none of this
    tick.

    Raises `BadInputError` for pictures too late or too early.
    """
    missing = [name for name, there in (("plane", plane), ("align", lookup.find("align"))) if there is None]
    if missing or plane is None:
        notes = ("Fused estimator: none. rig.yaml lacks " + " and ".join(missing) + ".",)
        return Group(notes, (Whole("CALIB_HAS_FUSED", 0, "for #if; CALIB_FUSED 1 does not compile"),))
    delay = _delay_items(lookup, rate_hz)
    tuned = lookup.find("estimator.constant_gain")
    if isinstance(tuned, EstimatorGain) and abs(tuned.rate_hz / rate_hz - 1.0) <= 1e-6:
        gain, told = Gains(**tuned.model_dump()), "Gains of estimator.constant_gain."
    else:
        gain, told = _designed(lookup, rate_hz, plane), "Gains for the noise in align."
        if tuned is not None:
            told += " Those of estimator.constant_gain are for another tick."
    per = 1.0 / gain.lever_m
    items: list[Item] = [
        Whole("CALIB_HAS_FUSED", 1, "for #if"),
        *delay,
        *_imu_items(lookup, rate_hz, gain.accel_phi),
        Constant("CALIB_FUSED_PHI_PER_M", gain.camera_phi * per, "K_c / lever, rad/m"),
        Constant("CALIB_FUSED_ALONE_PHI_PER_M", ALONE * per, "the same without the IMU, rad/m"),
        Constant("CALIB_FUSED_BOOST_PHI_PER_M", BOOST * per, "the same after a start, rad/m"),
        Constant("CALIB_FUSED_BIAS", gain.bias, "K_b, share of the correction"),
        Constant("CALIB_FUSED_MOVING_LENGTH", gain.moving_length, "K_m, dimensionless"),
        Constant("CALIB_FUSED_MOVING_RATE", gain.moving_rate, "K_v, per tick"),
        Constant("CALIB_FUSED_REST_LENGTH", gain.rest_length, "K_r, dimensionless"),
        Constant("CALIB_FUSED_RATE_DECAY", gain.rate_decay, "K_d, per tick, at rest and without a picture"),
        Constant("CALIB_FUSED_SLOW", gain.slow, "K_s, dimensionless"),
        Constant("CALIB_FUSED_MOVING_M", gain.moving_m, "s_0, mean residual of a length that moves, m"),
        Constant("CALIB_FUSED_STILL_M", gain.still_m, "v_0, m per tick"),
        Constant("CALIB_FUSED_GATE_M", gain.gate_m, "residuals beyond are left out, m"),
        Constant("CALIB_FUSED_BOOST", BOOST, "share of the length's residual after a start"),
        Whole("CALIB_FUSED_BOOST_TICKS", BOOST_TICKS, "pictures after a start that this holds for"),
        Whole("CALIB_FUSED_MOVING_TICKS", MOVING_TICKS, "pictures for which a motion is remembered"),
        Whole("CALIB_FUSED_PATIENCE", PATIENCE, "pictures left out in a row before a new start"),
    ]
    return Group(
        (
            "Fused estimator with constant gains, for CALIB_FUSED 1. A tick carries (phi, b), (l, v) on by",
            "phi += dt / 2 (w + w') + b, l += v. With the marker across and along the chord of D ticks ago",
            "phi += c = K_c across / lever + K_a e_a, b += K_b c; e = along - S (l - D v), s += K_s (e - s);",
            "moving (|s| > s_0 or |v| > v_0): l += K_m e, v += K_v e; at rest: l += K_r e, v *= K_d.",
            told,
        ),
        tuple(items),
        lookup.defaults(),
    )
