"""The section `twin` of rig.yaml: the simulated rig's sensors, and what is true of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, StrictBool, model_serializer

from calib.core.result import NotNegative, Number, Section

Part = Annotated[Number, Field(ge=0.0, le=1.0)]
Share = Annotated[Number, Field(ge=-0.5, le=0.5)]
Rate = Annotated[Number, Field(ge=-10.0, le=10.0)]
Acceleration = Annotated[Number, Field(ge=-100.0, le=100.0)]
TWO, THREE = Field(min_length=2, max_length=2), Field(min_length=3, max_length=3)
Pair = Annotated[tuple[NotNegative, ...], TWO]

_DEG = math.pi / 180.0
_G = 9.81


def _rising(value: tuple[float, ...]) -> tuple[float, ...]:
    if value[0] > value[1]:
        raise ValueError("expected [least, most]")
    return value


@dataclass(frozen=True)
class Tracker:
    """Errors of the tracker.

    Attributes
    ----------
    marker_offset_m : d of (A.1).
    latency_s : time from the exposure to the tick that reads the result.
    jitter_px : standard deviation of the found position along each axis, before rounding.
    grid_px : the position is a multiple of this; zero leaves it as it is.
    outliers : probability that a frame shows another thing.
    outlier_px : how far away that is, [least, most].
    dropouts : probability that nothing is found in a frame.
    blackouts_s : pairs [start, duration] without any frame.
    stamp_jitter_s : standard deviation of the time stamps.
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    marker_offset_m: Annotated[Number, Field(ge=0.0, le=0.5)] = 0.015
    latency_s: Part = 0.025
    jitter_px: NotNegative = 0.3
    grid_px: NotNegative = 1.0
    outliers: Part = 0.003
    outlier_px: Annotated[Pair, AfterValidator(_rising)] = (5.0, 20.0)
    dropouts: Part = 0.004
    blackouts_s: tuple[Pair, ...] = ()
    stamp_jitter_s: Annotated[Number, Field(ge=0.0, le=0.1)] = 2e-4


@dataclass(frozen=True)
class Imu:
    """Place and errors of the inertial sensor.

    Attributes
    ----------
    rate_hz : samples per second.
    mount_angle_rad : what it reads at rest at phi = 0.
    lever_m : its place c in the head's frame, across and along the tangent.
    gravity_mps2 : g in the world frame.
    gyro_scale, accel_scale : scale errors per axis.
    gyro_bias_radps, accel_bias_mps2 : biases at the start.
    gyro_noise, accel_noise : densities of the white noise [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)].
    gyro_walk, accel_walk : densities of the biases' walk [rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)].
    gyro_step_radps, accel_step_mps2 : quantisation; zero for none.
    gyro_range_radps, accel_range_mps2 : largest reading.
    stamp_jitter_s, duplicated_stamps : deviation of the time stamps, share that repeat the last one.
    onchip : whether the fusion on the chip is logged too.
    onchip_drift_radps, onchip_spread : mean of its drift over many logs, and the deviation of a log's
        drift from it as a share of it (Fig. 2.4).
    """

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    rate_hz: Annotated[Number, Field(ge=1.0, le=1e5)] = 100.0
    mount_angle_rad: Annotated[Number, Field(ge=-math.pi, le=math.pi)] = 0.02
    lever_m: Annotated[tuple[Share, ...], TWO] = (0.0, 0.006)
    gravity_mps2: Annotated[tuple[Acceleration, ...], TWO] = (0.0, _G)
    gyro_scale: Annotated[tuple[Share, ...], THREE] = (0.004, -0.003, 0.006)
    accel_scale: Annotated[tuple[Share, ...], THREE] = (0.003, -0.002, 0.004)
    gyro_bias_radps: Annotated[tuple[Rate, ...], THREE] = (0.004, -0.003, 0.006)
    accel_bias_mps2: Annotated[tuple[Acceleration, ...], THREE] = (0.05, -0.04, 0.07)
    gyro_noise: NotNegative = 0.014 * _DEG
    accel_noise: NotNegative = 150e-6 * _G
    gyro_walk: NotNegative = 1e-5
    accel_walk: NotNegative = 1e-4
    gyro_step_radps: NotNegative = 0.0305 * _DEG
    accel_step_mps2: NotNegative = 0.01916
    gyro_range_radps: Annotated[Number, Field(gt=0.0)] = 2000.0 * _DEG
    accel_range_mps2: Annotated[Number, Field(gt=0.0)] = 4.0 * _G
    stamp_jitter_s: NotNegative = 4e-4
    duplicated_stamps: Annotated[Number, Field(ge=0.0, lt=1.0)] = 0.002
    onchip: StrictBool = False
    onchip_drift_radps: Annotated[Number, Field(ge=-1.0, le=1.0)] = 0.145 * _DEG
    onchip_spread: NotNegative = 0.4


class Twin(Section):
    """What is true of the simulated sensors; written where it is not nominal."""

    tracker: Tracker = Tracker()
    imu: Imu = Imu()

    @model_serializer
    def _unusual(self) -> dict[str, Any]:
        sensors: dict[str, Tracker | Imu] = {"tracker": self.tracker, "imu": self.imu}
        unusual = {
            name: {key.name: value for key in fields(one) if (value := getattr(one, key.name)) != key.default}
            for name, one in sensors.items()
        }
        return {name: values for name, values in unusual.items() if values}
