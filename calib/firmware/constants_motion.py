"""From sensors to the bellows' lengths: tick, IMU, angle filter, marker offset, low-pass, kinematics.

The tick's period is folded into the gains of the angle filter (2.3), whose integral is kept as an angle
per tick J = I dt:

    J   += (Ki dt^2) e                       e = atan2(ay, ax) - mount - phi, wrapped to half a turn
    phi += (Kp dt) e + J - dt gz,                J = bias dt at the start

A section of the low-pass of order one, b0 (1 + z^-1) / (1 + a1 z^-1), runs in the trapezoidal form
v = b0 (x - s), y = s + v, s' = y + v: one product, and y = x exactly at rest. A section of order two runs
as a state-variable filter with three gains derived from b0, a1, a2 (Simper 2013), at rest as exact:

    D = 2 / (2 b0 - a1),  g = sqrt(b0 D);   A1 = 1 / D,  A2 = g / D,  A3 = b0.
"""

from __future__ import annotations

import math

import numpy as np

from calib.actuator.kinematics import MARKER_OFFSET_M
from calib.actuator.parameters import Plant
from calib.actuator.series import inverse_coefficients
from calib.errors import BadInputError
from calib.firmware.known import Known
from calib.firmware.literals import Constant, Group, Whole
from calib.signals.lowpass import LowPass, coefficients

__all__ = ["PHI_LIMIT_RAD", "motion_groups", "tick_rate_hz"]

PHI_LIMIT_RAD = 1.58
"""Largest angle of the head that the firmware's sine and cosine are made for."""

_HOLD_S = 1.0
_ACCEL_LIMIT_MPS2 = 400.0
_RATE_LIMIT_RADPS = 60.0
_WEAK_MPS2 = 1.0
_BIAS_LIMIT_RADPS = 1.0
_LONGEST_OFFSET_TICKS = 8


def tick_rate_hz(known: Known) -> float:
    """Rate of the control loop: that of the low-pass, or 60 Hz."""
    return known.number("lowpass.rate_hz", 60.0, 1.0, 1000.0)


def _tick_group(known: Known, rate_hz: float) -> Group:
    offset_s = known.number("align.time_offset_s", 0.0, -1.0, 1.0)
    ticks = round(offset_s * rate_hz)
    if not 0 <= ticks <= _LONGEST_OFFSET_TICKS:
        raise BadInputError(
            f"{known.source}: align.time_offset_s is {offset_s:g} s, {ticks} ticks; "
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
        known.told(),
    )


def _imu_groups(known: Known, rate_hz: float) -> tuple[Group, Group]:
    dt = 1.0 / rate_hz
    bias, ratio = [0.0, 0.0], 1.0
    if known.node("align") is not None:
        mount = math.remainder(known.number("align.mount_angle_rad", 0.0), 2.0 * math.pi)
        bias = [known.number(f"align.accel_bias_mps2.{i}", 0.0, -5.0, 5.0) for i in range(2)]
        x, y = (1.0 + known.number(f"align.accel_scale.{i}", 0.0, -0.5, 0.5) for i in range(2))
        ratio = x / y
        gyro = known.number("align.gyro_bias_radps", 0.0, -1.0, 1.0)
        scale = 1.0 + known.number("align.gyro_scale", 0.0, -0.5, 0.5)
    else:
        mount, scale = known.number("align.rest_angle_rad", 0.0), 1.0
        gyro = known.number("imu.gyro_bias_radps.2", 0.0, -1.0, 1.0)
        if known.node("imu_intrinsics.accel.unit") == "m/s2":
            bias = [known.number(f"imu_intrinsics.accel.bias.{i}", 0.0, -5.0, 5.0) for i in range(2)]
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
        known.told(),
    )
    Kp = known.number("orientation_filter.Kp_per_s", 3.0, 0.0, rate_hz)
    Ki = known.number("orientation_filter.Ki_per_s2", 3.0, 0.0, rate_hz * rate_hz)
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
        known.told(),
    )
    return imu, mahony


def _sections(known: Known, rate_hz: float) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
    """(b0, b1, b2), (a1, a2) of each section; order one has b2 = a2 = 0 and comes last."""
    count = known.node("lowpass.sections")
    if not isinstance(count, list):
        known.number("lowpass.cutoff_hz", 1.0)
        # Rounded so that the gain at rest is one, as the sections of rig.yaml are.
        a1 = float(np.float32(coefficients(LowPass(1.0, rate_hz))[1]))
        b0 = 0.5 * (1.0 + a1)
        return [((b0, b0, 0.0), (a1, 0.0))]
    found = []
    for i in range(len(count)):
        b = known.numbers(f"lowpass.sections.{i}.b", (), 3, 3)
        a = known.numbers(f"lowpass.sections.{i}.a", (), 3, 3)
        found.append((b, a[1:]))
    return sorted(found, key=lambda section: section[1][1] == 0.0)


def _lowpass_group(known: Known, rate_hz: float) -> Group:
    items: list[Constant | Whole] = []
    pairs = 0
    single = False
    for i, (b, a) in enumerate(_sections(known, rate_hz), start=1):
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
            raise BadInputError(f"{known.source}: lowpass.sections.{i - 1} is no low-pass of bilinear form")
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
    return Group(notes, (*counts, *items), known.told())


def _kinematics_groups(known: Known) -> tuple[Group, Group]:
    plant = Plant()
    radius = known.number("actuator.bellows_radius_m", plant.bellows_radius_m, 1e-3, 0.2)
    rest = known.number("actuator.rest_length_m", plant.rest_length_m, 5e-3, 1.0)
    body = known.told()
    offset = known.number("align.marker_offset_m", MARKER_OFFSET_M, -0.5, 0.5)
    marker = Group(
        ("Marker to head (A.1): x = X - d sin(phi), y = Y - d cos(phi).",),
        (Constant("CALIB_MARKER_OFFSET_M", offset, "d, m; positive beyond the head"),),
        known.told(),
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


def motion_groups(known: Known) -> tuple[Group, ...]:
    """Groups of the header from the tick to the kinematics.

    Raises `BadInputError` for values of rig.yaml that the firmware cannot run with.
    """
    rate_hz = tick_rate_hz(known)
    tick = _tick_group(known, rate_hz)
    imu, mahony = _imu_groups(known, rate_hz)
    lowpass = _lowpass_group(known, rate_hz)
    marker, kinematics = _kinematics_groups(known)
    return tick, imu, mahony, marker, lowpass, kinematics
