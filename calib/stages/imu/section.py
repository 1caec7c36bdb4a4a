"""The sections `imu`, `imu_intrinsics` and `orientation_filter` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.core.result import Count, Matrix3, NotNegative, Number, Pair, PerAxis, Positive, Section, Sizes

# ----------------------------------------------------------------------
# The section `imu` of rig.yaml.


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


# ----------------------------------------------------------------------
# The section `imu_intrinsics` of rig.yaml.

Angles = dict[str, Number | None]
AngleSigmas = dict[str, NotNegative | None]


class IntrinsicsSigma(Section):
    """Standard deviations of the values of the same names."""

    bias: Sizes
    scale: Sizes
    misalignment_rad: AngleSigmas = {}


class GyroSigma(IntrinsicsSigma):
    """The same with that of the sensitivity, null where it is not fitted."""

    sensitivity: Matrix3 | None = None


class AccelIntrinsics(Section):
    """a = T diag(1 / scale) (reading - bias), T = [[1, -yz, zy], [0, 1, -zx], [0, 0, 1]].

    Attributes
    ----------
    unit : of the readings. Lists hold x, y, z, null for what was not calibrated or cannot be told.
    bias, scale : in that unit, and in that unit per m/s^2.
    misalignment_rad : yz, zy, zx; in a plane yz alone.
    matrix : T diag(1 / scale); absent where a part of it is not known.
    rms_mps2 : of | |a| - g | over the rests; `disagreement_mps2` is what noise does not explain of it.
    """

    unit: Literal["m/s2", "counts"]
    bias: PerAxis
    scale: PerAxis
    misalignment_rad: Angles = {}
    sigma: IntrinsicsSigma
    matrix: Matrix3 | None = None
    rms_mps2: NotNegative | None = None
    disagreement_mps2: NotNegative | None = None


class GyroIntrinsics(Section):
    """w = T diag(1 / scale) (reading - bias - S a), T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]].

    Attributes
    ----------
    unit, scale, misalignment_rad, matrix : as of the accelerometer, per rad/s, to the same frame.
    bias : at no specific force where `sensitivity` is there, else that of the rest at the start.
    start_bias : mean of the rest at the start.
    sensitivity : S, in the readings' unit per m/s^2, rows gx, gy, gz.
    rms_rad : by which the turns miss the direction of gravity.
    """

    unit: Literal["rad/s", "counts"]
    bias: PerAxis
    scale: PerAxis
    misalignment_rad: Angles = {}
    sigma: GyroSigma
    matrix: Matrix3 | None = None
    start_bias: PerAxis
    sensitivity: Matrix3 | None = None
    rms_rad: NotNegative
    turns: Count


class ImuIntrinsics(Section):
    """Bias, scale and misalignment of an IMU from rests in many poses.

    Attributes
    ----------
    gravity_mps2 : that was taken to be there.
    planar : x, y and gz alone were calibrated.
    rests, poses : stretches at rest, and how many poses more than 5 degrees apart they show.
    rest_s : their length together.
    degrees_of_freedom : rests less parameters; quantiles of sigma are Student's with these.
    initial_rest_s : rest at the start, from which the threshold comes.
    threshold : of the detector, as a multiple of the spread at rest.
    thresholds : root mean square residual by multiple [m/s^2], null for too few rests.
    """

    gravity_mps2: Positive
    planar: bool
    rate_hz: Positive
    rests: Count
    poses: Count
    rest_s: NotNegative
    degrees_of_freedom: Annotated[int, Field(strict=True)] | None = None
    initial_rest_s: NotNegative
    threshold: Positive
    thresholds: dict[str, NotNegative | None] = {}
    accel: AccelIntrinsics
    gyro: GyroIntrinsics | None = None
    verdict: Literal["ok", "poor", "unidentifiable", "inconsistent"]
    reasons: list[str] = []
    remarks: list[str] = []
    advice: list[str] = []


# ----------------------------------------------------------------------
# The section `orientation_filter` of rig.yaml.


class FilterCandidate(Section):
    """A pair of gains, what it does, and its held-out error.

    Attributes
    ----------
    poles : discrete, real and imaginary parts.
    bandwidth_hz : of the accelerometer's part.
    noise_gain : variance of the angle over that of white noise on the accelerometer's angle.
    bias_gain_s, bias_peak_s : angle per rate's bias, in the end and at most.
    settling_s : of an error of the angle, `bias_settling_s` of the bias; null where it never does.
    rmse_deg, interval_deg : held-out error and its 95 % interval; null without a judge.
    less_than_3_3_deg, less_interval_deg, confidence : error less that of 3/3, how surely it is less.
    whole_rmse_deg : error on the whole logs, which "tuned" was tuned on.
    """

    Kp_per_s: Positive
    Ki_per_s2: NotNegative
    poles: list[Pair]
    bandwidth_hz: NotNegative
    noise_gain: NotNegative
    bias_gain_s: NotNegative
    bias_peak_s: NotNegative
    settling_s: NotNegative | None
    bias_settling_s: NotNegative | None
    lag_s: NotNegative | None
    rmse_deg: NotNegative | None = None
    interval_deg: Pair | None = None
    less_than_3_3_deg: Number | None = None
    less_interval_deg: Pair | None = None
    confidence: Annotated[float, Field(ge=0, le=1)] | None = None
    whole_rmse_deg: NotNegative | None = None


class FilterLog(Section):
    """How a log was sampled, what it was judged by, and what its own smoothed angle explains.

    Attributes
    ----------
    reference_offset_deg : added to the reference to bring it to the sensor's zero.
    reference_lag_s : by which the reference is late.
    rate_error_degps_per_sqrt_Hz : of -gz as the angle's rate; above the sensor's own where it tilts.
    angle_error_deg_per_sqrt_Hz : of the accelerometer's angle, motion included.
    smoothed_sigma_deg, bias_degps : of the smoothed angle and of its rate.
    """

    name: str
    duration_s: Positive
    samples: Count
    missing: Count
    pieces: Count
    repeated_rows: Count
    repeated_stamps: Count
    reference: str | None = None
    reference_offset_deg: Number | None = None
    reference_lag_s: Number | None = None
    rate_error_degps_per_sqrt_Hz: NotNegative | None = None
    angle_error_deg_per_sqrt_Hz: NotNegative | None = None
    smoothed_sigma_deg: NotNegative | None = None
    bias_degps: Number | None = None


class OrientationFilter(Section):
    """Gains of the angle filter (2.3) and why they are these.

    Attributes
    ----------
    rate_hz : of the logs.
    recommended, recommended_by : the candidate, and "reference", "smoothed" or "default".
    sigma : half of what the gains of the logs' halves differ by, for tuned gains.
    halves : best Kp, Ki of the first and of the second halves.
    densities, densities_from : of the Riccati equation, and where they are from.
    rate_of_angle : "-gz", or "up vector" for a sensor that is not in plane.
    """

    Kp_per_s: Positive
    Ki_per_s2: NotNegative
    rate_hz: Positive
    recommended: str
    recommended_by: Literal["reference", "smoothed", "default"]
    rate_of_angle: Literal["-gz", "up vector"] = "-gz"
    sigma: dict[str, NotNegative | None] = {}
    halves: list[Pair] = []
    candidates: dict[str, FilterCandidate] = {}
    densities: dict[str, NotNegative] = {}
    densities_from: str = ""
    judged_s: NotNegative = 0.0
    block_s: NotNegative | None = None
    logs: list[FilterLog] = []
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
    remarks: list[str] = []
