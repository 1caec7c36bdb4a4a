"""The section `align` of rig.yaml."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from calib.core.files import quoted
from calib.core.result import Count, CovarianceTable, NotNegative, Number, Result, Section, quantity
from calib.core.schema import contradiction
from calib.core.words import nearest

Angle = Annotated[Number, Field(ge=-7.0, le=7.0)]
Seconds = Annotated[Number, Field(ge=-10.0, le=10.0)]
Metres = Annotated[Number, Field(ge=-1.0, le=1.0)]
Share = Annotated[Number, Field(ge=-0.5, le=0.5)]
Rate = Annotated[Number, Field(ge=-1.0, le=1.0)]
Bias = Annotated[Number, Field(ge=-5.0, le=5.0)]
Noise = Annotated[Number, Field(ge=0.0, le=1e3)]
SharePair = Annotated[list[Share], Field(min_length=2, max_length=2)]
MetresPair = Annotated[list[Metres], Field(min_length=2, max_length=2)]


SENSORS_OF = {
    "time_offset_s": ("time_offset_s",),
    "mount_angle_rad": ("mount_angle_rad",),
    "gyro_scale": ("gyro_scale",),
    "gyro_bias_radps": ("gyro_bias_radps",),
    "accel_bias_mps2": ("accel_bias_x_mps2", "accel_bias_y_mps2"),
    "accel_scale": ("accel_scale_x", "accel_scale_y"),
    "imu_lever_m": ("imu_lever_m",),
    "imu_across_m": ("imu_across_m",),
    "marker_offset_m": ("marker_offset_m",),
    "plane_shift_m": ("shift_x_m", "shift_y_m"),
    "plane_stretch": ("stretch",),
}
"""Keys of the section and the quantities of `calib.stages.estimator.sensors.SENSOR` that they hold."""


class LogCheck(Section):
    """A log's part in the fit: the IMU's samples and the pictures that were used, clocks and residuals.

    `outliers` are pictures that more likely show something else than the marker, `turned_rad` is the
    standard deviation of phi over the log.
    """

    name: str = quantity(label="log")
    duration_s: NotNegative = quantity(label="duration", digits=2)
    stretches: Count
    pictures: Count = quantity(label="pictures")
    outliers: Count = quantity(label="outliers")
    samples: Count = quantity(label="IMU samples")
    camera_rate_hz: NotNegative | None = None
    imu_rate_hz: NotNegative | None = None
    camera_jitter_s: NotNegative | None = quantity(None, label="camera's jitter", show="ms", digits=2)
    imu_jitter_s: NotNegative | None = quantity(None, label="IMU's jitter", show="ms", digits=2)
    repeated_stamps: Count = 0
    missing: Count = 0
    turned_rad: NotNegative = quantity(0.0, label="phi RMS", show="deg", digits=3)
    camera_rms_px: NotNegative | None = quantity(None, label="pictures RMS", digits=2)
    gyro_rms_radps: NotNegative | None = None
    accel_rms_mps2: NotNegative | None = None


class Align(Result):
    """Camera and IMU in line.

    Attributes
    ----------
    time_offset_s : stamp of a picture minus its exposure; positive where pictures come late.
    mount_angle_rad : by which the IMU is turned about z on the head.
    rest_angle_rad : what atan2(ay, ax) reads at rest at phi = 0, biases and scales included.
    gyro_scale, accel_scale : scale errors; a rate w is read as (1 + gyro_scale) w. Lists hold x, y.
    imu_lever_m, marker_offset_m : places of IMU and marker along the head's tangent.
    imu_across_m : place of the IMU across it, positive where x is at phi = 0; absent in earlier files.
    plane_shift_m, plane_stretch : by which the calibrated plane is off.
    sigma : standard deviations by key. prior_sigma : what was known beforehand, by `covariance.order`.
    covariance : of all of them; the marginal deviations of values that are hardly told apart are large while
        their combination is known.
    jitter_px, outlier_share, accel_noise_mps2, gyro_noise_radps : noise of single readings; the tracker's
        jitter before pixels are rounded.
    imu_age_s : deviation of the times to which the IMU's readings belong; absent where none is seen.
    """

    time_offset_s: Seconds = quantity(label="time offset of pictures", show="ms", fact=True)
    mount_angle_rad: Angle = quantity(label="mount angle", show="deg")
    rest_angle_rad: Angle = quantity(label="angle read at rest at phi = 0", show="deg", fact=True)
    gyro_scale: Share = quantity(label="gyro scale error", show="%")
    gyro_bias_radps: Rate = quantity(label="gyro bias", show="deg/s", fact=True)
    accel_bias_mps2: Annotated[list[Bias], Field(min_length=2, max_length=2)] = quantity(label="accel bias")
    accel_scale: SharePair = quantity(label="accel scale error", show="%")
    imu_lever_m: Metres = quantity(label="IMU along the head", show="mm")
    imu_across_m: Metres | None = quantity(None, label="IMU across the head", show="mm")
    marker_offset_m: Metres = quantity(label="marker offset d", show="mm")
    plane_shift_m: MetresPair = quantity(label="shift of the plane", show="mm")
    plane_stretch: Share = quantity(label="stretch of the plane", show="%")
    sigma: dict[str, NotNegative | list[NotNegative] | None] = {}
    prior_sigma: dict[str, NotNegative] = {}
    covariance: CovarianceTable | None = None
    jitter_px: NotNegative = quantity(label="tracker's jitter", digits=2, fact=True, le=1e3)
    outlier_share: NotNegative = quantity(label="outliers", show="%", digits=2, le=1.0)
    accel_noise_mps2: Annotated[list[Noise], Field(min_length=2, max_length=2)] = quantity(
        label="accel noise", digits=4
    )
    gyro_noise_radps: Noise = quantity(label="gyro noise", digits=4)
    imu_age_s: Annotated[Number, Field(gt=0.0, le=0.1)] | None = quantity(
        None, label="times of the IMU's readings", show="ms", digits=2
    )
    logs: list[LogCheck] = quantity([], label="log")

    @field_validator("covariance")
    @classmethod
    def _of_sensors(cls, table: CovarianceTable | None) -> CovarianceTable | None:
        names = [name for several in SENSORS_OF.values() for name in several]
        for name in () if table is None else table.order:
            if name not in names:
                raise contradiction(f"order has {quoted(name)}, which align lacks{nearest(name, names)}")
        return table
