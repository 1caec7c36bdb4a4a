"""The section `imu` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.rig_base import Count, NotNegative, Number, PerAxis, Positive, Section, Sizes

__all__ = ["Imu", "ImuDrift", "ImuLog"]


class ImuDrift(Section):
    """Slopes of an angle, one for each log: mean and standard deviation from log to log."""

    mean_degps: Number
    spread_degps: NotNegative | None = None
    logs: Count


class ImuLog(Section):
    """How a log was sampled, and the drift of the angle in it (Fig. 2.4)."""

    name: str
    duration_s: Positive
    rest_s: Positive
    samples: Count
    rate_hz: Positive
    jitter_s: NotNegative
    missing: Count
    gaps: Count
    splits: Count
    repeated_rows: Count
    repeated_stamps: Count
    moves_s: list[Annotated[list[Number], Field(min_length=2, max_length=2)]] = []
    gyro_degps: Number | None = None
    gyro_sigma_degps: NotNegative | None = None
    onchip_degps: Number | None = None
    onchip_sigma_degps: NotNegative | None = None


class Imu(Section):
    """The sensor at rest; lists hold x, y, z, null for what was not logged or cannot be told.

    Attributes
    ----------
    gyro_bias_radps, accel_mean_mps2 : means at rest, the latter with gravity in it.
    *_noise_* : density N of white noise, continuous time, that of the quantisation included.
    *_instability_* : B, *_walk_* : density K of the bias' random walk.
    sigma : standard deviations by key; that of the means holds for the bias met after the log.
    below : 95 % upper bounds by key, where the logs are too short for an estimate.
    *_step_* : quantisation.
    drift : by the gyroscope (-gz integrated) and by the chip.
    """

    rate_hz: Positive
    gyro_bias_radps: PerAxis
    gyro_noise_radps_per_sqrt_Hz: Sizes
    gyro_instability_radps: Sizes
    gyro_walk_radps2_per_sqrt_Hz: Sizes
    accel_mean_mps2: PerAxis
    accel_noise_mps2_per_sqrt_Hz: Sizes
    accel_instability_mps2: Sizes
    accel_walk_mps3_per_sqrt_Hz: Sizes
    sigma: dict[str, Sizes] = {}
    below: dict[str, Sizes] = {}
    gyro_step_radps: Sizes
    accel_step_mps2: Sizes
    drift: dict[str, ImuDrift] = {}
    logs: list[ImuLog] = []
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
    remarks: list[str] = []
    advice: list[str] = []
