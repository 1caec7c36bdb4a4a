"""What the thesis's firmware makes of its sensors, tick by tick: the measurement that closes the loop.

    IMU, 100 Hz    ->  MM filter 3/3                                                  phi      (2.3)
    camera, 60 Hz  ->  homography without undistortion  ->  marker                           (2.11), (2.12)
                   ->  head by the marker's offset and phi                                   (A.1)
                   ->  first-order low-pass, 1 Hz at 60 Hz                            x, y
    x, y, phi      ->  series of the inverse kinematics                               q1, q2   (3.12), (3.14)

Time stamps are not used: the firmware counts samples. Where the camera found nothing the last marker
is held. Latency, bias, mount angle and lens are not corrected either, so that a loop closed over
these values errs as the real one does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from calib.actuator.series import inverse_coefficients
from calib.arrays import FloatArray
from calib.imu.mahony import Mahony, MahonySample, MahonyState, accelerometer_angle
from calib.imu.mahony import step as step_angle
from calib.signals.lowpass import LowPass, LowPassState, settled
from calib.signals.lowpass import step as step_lowpass

__all__ = ["Firmware", "FirmwareState", "Seen", "add_frame", "add_imu"]

_F_SERIES = tuple(float(c) for c in inverse_coefficients())


@dataclass(frozen=True)
class Seen:
    """What a controller is given: the head's angle [rad] and the bellows' lengths [m].

    With sensors also the readings since the last tick, for a controller with an observer of its own:
    the marker [px], NaN where nothing was found, and (ax, ay, gz) of each IMU sample.
    """

    phi_rad: float
    q_m: tuple[float, float]
    marker_px: tuple[float, float] = (math.nan, math.nan)
    imu: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class Firmware:
    """Constants of the firmware.

    Attributes
    ----------
    to_plane : (3, 3) pixels to metres, A^-1 of (2.11).
    bellows_radius_m, rest_length_m : of the actuator; the second until the first frame.
    marker_offset_m : d of (A.1).
    imu_rate_hz : rate that the angle filter counts on.
    mahony, lowpass : filters.
    """

    to_plane: FloatArray
    bellows_radius_m: float
    rest_length_m: float
    marker_offset_m: float
    imu_rate_hz: float
    mahony: Mahony = field(default_factory=Mahony)
    lowpass: LowPass = field(default_factory=LowPass)


@dataclass(frozen=True)
class FirmwareState:
    """Memory of the firmware; None before the first sample of each sensor.

    Attributes
    ----------
    angle : of the MM filter.
    marker_m : last marker in the plane.
    x, y : low-passed head.
    """

    angle: MahonyState | None = None
    marker_m: tuple[float, float] | None = None
    x: LowPassState | None = None
    y: LowPassState | None = None


def add_imu(
    firmware: Firmware, state: FirmwareState, ax_mps2: float, ay_mps2: float, gz_radps: float
) -> FirmwareState:
    """State after one sample of the IMU; the first one sets the angle to the accelerometer's."""
    if state.angle is None:
        return replace(state, angle=MahonyState(accelerometer_angle(ax_mps2, ay_mps2), 0.0))
    sample = MahonySample(ax_mps2, ay_mps2, gz_radps, 1.0 / firmware.imu_rate_hz)
    return replace(state, angle=step_angle(firmware.mahony, state.angle, sample))


def _marker(firmware: Firmware, u: float, v: float) -> tuple[float, float]:
    H = firmware.to_plane
    s = 1.0 / (H[2, 0] * u + H[2, 1] * v + H[2, 2])
    return (
        float(s * (H[0, 0] * u + H[0, 1] * v + H[0, 2])),
        float(s * (H[1, 0] * u + H[1, 1] * v + H[1, 2])),
    )


def _bellows(x: float, y: float, phi: float, bellows_radius_m: float) -> tuple[float, float]:
    """q1, q2 [m] by (3.12) with the series (3.14) in place of f."""
    w, f = phi * phi, 0.0
    for coefficient in reversed(_F_SERIES):
        f = f * w + coefficient
    length = 0.5 * math.hypot(x, y) * f
    return length + bellows_radius_m * phi, length - bellows_radius_m * phi


def add_frame(
    firmware: Firmware, state: FirmwareState, u_px: float, v_px: float
) -> tuple[FirmwareState, Seen]:
    """State after a tick's frame, NaN where the camera found nothing, and what the controller gets."""
    phi = 0.0 if state.angle is None else state.angle.phi_rad
    marker = state.marker_m if math.isnan(u_px) else _marker(firmware, u_px, v_px)
    if marker is None:
        turned = firmware.bellows_radius_m * phi
        return state, Seen(phi, (firmware.rest_length_m + turned, firmware.rest_length_m - turned))
    x = marker[0] - firmware.marker_offset_m * math.sin(phi)
    y = marker[1] - firmware.marker_offset_m * math.cos(phi)
    low_x = settled(x) if state.x is None else step_lowpass(firmware.lowpass, state.x, x)
    low_y = settled(y) if state.y is None else step_lowpass(firmware.lowpass, state.y, y)
    q = _bellows(low_x.y1, low_y.y1, phi, firmware.bellows_radius_m)
    return FirmwareState(state.angle, marker, low_x, low_y), Seen(phi, q)
