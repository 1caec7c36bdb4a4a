"""The section `align` of rig.yaml."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from calib.core.result import Count, CovarianceTable, NotNegative, Number, Pair, Section

Angle = Annotated[float, Field(ge=-7.0, le=7.0, allow_inf_nan=False, strict=True)]
Seconds = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False, strict=True)]
Metres = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False, strict=True)]
Share = Annotated[float, Field(gt=-1.0, le=10.0, allow_inf_nan=False, strict=True)]
SharePair = Annotated[list[Share], Field(min_length=2, max_length=2)]
MetresPair = Annotated[list[Metres], Field(min_length=2, max_length=2)]


class AlignCovariance(CovarianceTable):
    """Covariance with the names of its rows, those of `calib.stages.estimator.sensors.SENSOR`."""

    @model_validator(mode="after")
    def _positive(self) -> AlignCovariance:
        V = self.values
        for i in range(len(V)):
            for j in range(len(V)):
                limit = math.sqrt(max(V[i][i], 0.0) * max(V[j][j], 0.0)) * (1.0 + 1e-6)
                if abs(V[i][j] - V[j][i]) > 1e-6 * limit or abs(V[i][j]) > limit:
                    raise ValueError("expected a covariance matrix")
        return self


class AlignLogCheck(Section):
    """A log's part: readings that were used, clocks, and residuals; see
    `calib.stages.align.solve.LogCheck`."""

    name: str
    duration_s: NotNegative
    stretches: Count
    pictures: Count
    outliers: Count
    samples: Count
    camera_rate_hz: NotNegative | None = None
    imu_rate_hz: NotNegative | None = None
    camera_jitter_s: NotNegative | None = None
    imu_jitter_s: NotNegative | None = None
    repeated_stamps: Count = 0
    missing: Count = 0
    turned_rad: NotNegative = 0.0
    camera_rms_px: NotNegative | None = None
    gyro_rms_radps: NotNegative | None = None
    accel_rms_mps2: NotNegative | None = None


class Align(Section):
    """Camera and IMU in line.

    Attributes
    ----------
    time_offset_s : stamp of a picture minus its exposure; positive where pictures come late.
    mount_angle_rad : by which the IMU is turned about z on the head.
    rest_angle_rad : what atan2(ay, ax) reads at rest at phi = 0, biases and scales included.
    gyro_scale, accel_scale : scale errors; a rate w is read as (1 + gyro_scale) w. Lists hold x, y.
    imu_lever_m, marker_offset_m : places of IMU and marker along the head's tangent.
    plane_shift_m, plane_stretch : by which the calibrated plane is off.
    sigma : standard deviations by key. prior_sigma : what was known beforehand, by `covariance.order`.
    covariance : of all of them; the marginal deviations of values that are hardly told apart are large while
        their combination is known.
    jitter_px, outlier_share, accel_noise_mps2, gyro_noise_radps : noise of single readings.
    """

    time_offset_s: Seconds
    mount_angle_rad: Angle
    rest_angle_rad: Angle
    gyro_scale: Share
    gyro_bias_radps: Number
    accel_bias_mps2: Pair
    accel_scale: SharePair
    imu_lever_m: Metres
    marker_offset_m: Metres
    plane_shift_m: MetresPair
    plane_stretch: Share
    sigma: dict[str, NotNegative | list[NotNegative] | None] = {}
    prior_sigma: dict[str, NotNegative] = {}
    covariance: AlignCovariance | None = None
    jitter_px: NotNegative
    outlier_share: NotNegative
    accel_noise_mps2: Pair
    gyro_noise_radps: NotNegative
    logs: list[AlignLogCheck] = []
    verdict: Literal["ok", "poor", "unidentifiable"]
    reasons: list[str] = []
    remarks: list[str] = []
    advice: list[str] = []
