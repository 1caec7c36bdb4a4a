"""Constants of the fused estimator, from `align` and `estimator.constant_gain` of rig.yaml.

The tick is that of `calib.estimator.constant_gain`. Its calibration of the IMU is folded into one affine map:
with f = ((a_x - b_x) / (1 + s_x), (a_y - b_y) / (1 + s_y)), the mount alpha and k = K_a / g,

    A = k ( f_x cos alpha + f_y sin alpha),   B = k (-f_x sin alpha + f_y cos alpha),

so that K_a e_a = B cos(phi_D) - A sin(phi_D) - K_a (phi - phi_D). A picture's age of D ticks is
`TICKS` = ceil(D) remembered angles less the share `PART` = TICKS - D of a tick.
"""

from __future__ import annotations

import math

import numpy as np

from calib.actuator.parameters import Plant
from calib.errors import BadInputError
from calib.estimator.gains import (
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
from calib.firmware.constants_camera import PlaneConstants
from calib.firmware.known import Known
from calib.firmware.literals import Constant, Group, Item, Whole
from calib.rig_estimator import EstimatorGain

__all__ = ["fused_group"]

_WHOLE = 1e-6
_WEAK_MPS2 = 1.0
_GRAVITY_MPS2 = 9.81


def _designed(known: Known, rate_hz: float, plane: PlaneConstants) -> Gains:
    """Gains for the noise that the alignment has found, at the head's rest; a tracker of whole pixels."""
    rest = known.number("actuator.rest_length_m", Plant().rest_length_m, 5e-3, 1.0)
    d = known.number("align.marker_offset_m", 0.0, -0.5, 0.5)
    # How places of the marker change with a pixel there, by the undistorted plane.
    H = np.linalg.inv(plane.from_ideal)
    at = H @ np.array([0.0, rest + d, 1.0])
    by_place = (H[:2, :2] - np.outer(at[:2] / at[2], H[2, :2])) / at[2]
    pixel = math.hypot(known.number("align.jitter_px", 0.3, 0.0, 100.0), math.sqrt(1.0 / 12.0))
    across, along = pixel * np.linalg.norm(np.linalg.inv(by_place), axis=1)
    lever = 0.5 * rest + d
    reach = 0.5 * rest + known.number("align.imu_lever_m", 0.0, -0.5, 0.5)
    shaken = math.hypot(known.number("align.accel_noise_mps2.0", 0.0), SHAKING_RADPS2 * reach)
    noise = TickNoise(
        float(across) / lever,
        float(along),
        known.number("align.gyro_noise_radps", 0.0, 0.0, 10.0),
        shaken / _GRAVITY_MPS2,
    )
    return design(noise, rate_hz, _delay_ticks(known, rate_hz) / rate_hz, lever)


def _delay_ticks(known: Known, rate_hz: float) -> float:
    delay = known.number("align.time_offset_s", 0.0, -1.0, 1.0) * rate_hz
    # As far as the whole ticks of the other filters reach.
    if not -0.5 <= delay <= MOST_DELAY_TICKS + 0.5:
        raise BadInputError(
            f"{known.source}: align.time_offset_s is {delay / rate_hz:g} s, {delay:.3g} ticks; "
            f"expected pictures that are 0 to {MOST_DELAY_TICKS} ticks late"
        )
    return min(max(delay, 0.0), float(MOST_DELAY_TICKS))


def _delay_items(known: Known, rate_hz: float) -> list[Item]:
    delay = _delay_ticks(known, rate_hz)
    ticks = math.ceil(delay - _WHOLE)
    return [
        Whole("CALIB_FUSED_TICKS", ticks, "angles that are remembered, ceil(D)"),
        Constant("CALIB_FUSED_PART", max(ticks - delay, 0.0), "ceil(D) - D, share of a tick"),
        Constant("CALIB_FUSED_DELAY_TICKS", delay, "D, ticks from the exposure of a picture to its tick"),
    ]


def _imu_items(known: Known, rate_hz: float, accel_gain: float) -> list[Item]:
    bias = [known.number(f"align.accel_bias_mps2.{i}", 0.0, -5.0, 5.0) for i in range(2)]
    scale = [1.0 + known.number(f"align.accel_scale.{i}", 0.0, -0.5, 0.5) for i in range(2)]
    alpha = known.number("align.mount_angle_rad", 0.0)
    turned = 0.5 / (rate_hz * (1.0 + known.number("align.gyro_scale", 0.0, -0.5, 0.5)))
    gyro = known.number("align.gyro_bias_radps", 0.0, -1.0, 1.0)
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
        Constant("CALIB_FUSED_ACCEL_WEAK", k * _WEAK_MPS2, "|A| and |B| below say nothing of phi, rad"),
        Constant("CALIB_FUSED_HALF_DT_S", turned, "dt / 2 over the gyroscope's scale, s"),
        Constant("CALIB_FUSED_HALF_BIAS_RAD", turned * gyro, "bias times the same, rad"),
    ]


def fused_group(known: Known, rate_hz: float, plane: PlaneConstants | None) -> Group:
    """The group of the header; CALIB_HAS_FUSED is 0 where rig.yaml lacks plane or alignment.

    The gains are those of `estimator.constant_gain`, or for the noise in `align` where there are none of this
    tick.

    Raises `BadInputError` for pictures too late or too early.
    """
    missing = [name for name, there in (("plane", plane), ("align", known.node("align"))) if there is None]
    if missing or plane is None:
        notes = ("Fused estimator: none. rig.yaml lacks " + " and ".join(missing) + ".",)
        return Group(notes, (Whole("CALIB_HAS_FUSED", 0, "for #if; CALIB_FUSED 1 does not compile"),))
    delay = _delay_items(known, rate_hz)
    tuned = known.node("estimator.constant_gain")
    if isinstance(tuned, EstimatorGain) and abs(tuned.rate_hz / rate_hz - 1.0) <= 1e-6:
        gain, told = Gains(**tuned.model_dump()), "Gains of estimator.constant_gain."
    else:
        gain, told = _designed(known, rate_hz, plane), "Gains for the noise in align."
        if tuned is not None:
            told += " Those of estimator.constant_gain are for another tick."
    per = 1.0 / gain.lever_m
    items: list[Item] = [
        Whole("CALIB_HAS_FUSED", 1, "for #if"),
        *delay,
        *_imu_items(known, rate_hz, gain.accel_phi),
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
        known.told(),
    )
