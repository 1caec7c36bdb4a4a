"""The section `twin` of rig.yaml: errors of the simulated rig's sensors, see `calib.twin.sensors`."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, StrictBool, field_validator

from calib.core.result import NotNegative, Number, Statement, quantity

Share = Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False, strict=True)]
Rate = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False, strict=True)]
Acceleration = Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False, strict=True)]
Place = Annotated[float, Field(ge=-0.5, le=0.5, allow_inf_nan=False, strict=True)]


class TwinTracker(Statement):
    """Errors of `calib.twin.sensors.Tracker`; absent ones are its defaults."""

    marker_offset_m: Number | None = quantity(None, label="marker beyond the head", ge=0.0, le=0.5)
    latency_s: Number | None = quantity(None, label="latency", ge=0.0, le=1.0)
    jitter_px: NotNegative | None = quantity(None, label="jitter")
    grid_px: NotNegative | None = quantity(None, label="grid")
    outliers: Number | None = quantity(None, label="share of outliers", ge=0.0, le=1.0)
    outlier_px: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None = quantity(
        None, label="outliers, least and most"
    )
    dropouts: Number | None = quantity(None, label="share of dropouts", ge=0.0, le=1.0)
    blackouts_s: list[Annotated[list[NotNegative], Field(min_length=2, max_length=2)]] | None = None
    stamp_jitter_s: Number | None = quantity(None, label="jitter of the stamps", ge=0.0, le=0.1)

    @field_validator("outlier_px")
    @classmethod
    def _rising(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and value[0] > value[1]:
            raise ValueError("expected [least, most]")
        return value


class TwinImu(Statement):
    """Place and errors of `calib.twin.sensors.Imu`; absent ones are its defaults."""

    rate_hz: Number | None = quantity(None, label="rate", ge=1.0, le=1e5)
    mount_angle_rad: Number | None = quantity(None, label="mount angle", ge=-math.pi, le=math.pi)
    lever_m: Annotated[list[Place], Field(min_length=2, max_length=2)] | None = None
    gravity_mps2: Annotated[list[Acceleration], Field(min_length=2, max_length=2)] | None = None
    gyro_scale: Annotated[list[Share], Field(min_length=3, max_length=3)] | None = None
    accel_scale: Annotated[list[Share], Field(min_length=3, max_length=3)] | None = None
    gyro_bias_radps: Annotated[list[Rate], Field(min_length=3, max_length=3)] | None = None
    accel_bias_mps2: Annotated[list[Acceleration], Field(min_length=3, max_length=3)] | None = None
    gyro_noise: NotNegative | None = None
    accel_noise: NotNegative | None = None
    gyro_walk: NotNegative | None = None
    accel_walk: NotNegative | None = None
    gyro_step_radps: NotNegative | None = None
    accel_step_mps2: NotNegative | None = None
    gyro_range_radps: Number | None = quantity(None, label="range of the gyroscope", gt=0.0)
    accel_range_mps2: Number | None = quantity(None, label="range of the accelerometer", gt=0.0)
    stamp_jitter_s: NotNegative | None = None
    duplicated_stamps: Number | None = quantity(None, label="share of repeated stamps", ge=0.0, lt=1.0)
    onchip: StrictBool | None = None
    onchip_drift_radps: Number | None = quantity(None, label="drift on the chip", ge=-1.0, le=1.0)
    onchip_spread: NotNegative | None = None


class Twin(Statement):
    """What is true of the simulated sensors, where it is not nominal."""

    tracker: TwinTracker | None = None
    imu: TwinImu | None = None
