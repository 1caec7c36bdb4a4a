"""The sections `imu`, `imu_intrinsics` and `orientation_filter` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.core.result import (
    Count,
    Matrix3,
    NotNegative,
    Number,
    Pair,
    PerAxis,
    Positive,
    Result,
    Section,
    Sizes,
    quantity,
)

# ----------------------------------------------------------------------
# The section `imu` of rig.yaml.

Rate = Annotated[Number, Field(ge=-10.0, le=10.0)]
Rates = Annotated[list[Rate | None], Field(min_length=3, max_length=3)]
Force = Annotated[Number, Field(ge=-1e3, le=1e3)]
Forces = Annotated[list[Force | None], Field(min_length=3, max_length=3)]
Small = Annotated[Number, Field(ge=0, le=1e3)]
Noises = Annotated[list[Small | None], Field(min_length=3, max_length=3)]


class ImuDrift(Section):
    """Slopes of an angle, one for each log: mean and standard deviation from log to log."""

    mean_degps: Number = quantity(label="mean", digits=4)
    spread_degps: NotNegative | None = quantity(None, label="from log to log", digits=4)
    logs: Count = quantity(label="logs")


class ImuLog(Section):
    """How a log was sampled, and the drift of the angle in it (Fig. 2.4)."""

    name: str = quantity(label="log")
    duration_s: Positive = quantity(label="length", digits=1)
    rest_s: Positive = quantity(label="at rest", digits=1)
    samples: Count = quantity(label="samples")
    rate_hz: Positive = quantity(label="rate", digits=3)
    jitter_s: NotNegative = quantity(label="jitter", show="ms", digits=3)
    missing: Count = quantity(label="missing")
    gaps: Count = quantity(label="gaps")
    splits: Count = quantity(label="splits")
    repeated_rows: Count = quantity(label="repeated rows")
    repeated_stamps: Count = quantity(label="repeated stamps")
    moves_s: list[Annotated[list[Number], Field(min_length=2, max_length=2)]] = []
    gyro_degps: Number | None = quantity(None, label="drift by -gz", digits=4)
    gyro_sigma_degps: NotNegative | None = quantity(None, label="sigma", digits=4)
    onchip_degps: Number | None = quantity(None, label="by the chip", digits=4)
    onchip_sigma_degps: NotNegative | None = quantity(None, label="sigma", digits=4)


class Imu(Result):
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

    rate_hz: Positive = quantity(label="rate", digits=3, fact=True, le=1e6)
    gyro_bias_radps: Rates = quantity(label="gyro bias", fact=(2,))
    gyro_noise_radps_per_sqrt_Hz: Noises = quantity(label="gyro noise N", fact=(2,))
    gyro_instability_radps: Noises = quantity(label="gyro instability B")
    gyro_walk_radps2_per_sqrt_Hz: Noises = quantity(label="gyro random walk K")
    accel_mean_mps2: Forces = quantity(label="accel mean, with gravity")
    accel_noise_mps2_per_sqrt_Hz: Noises = quantity(label="accel noise N")
    accel_instability_mps2: Noises = quantity(label="accel instability B")
    accel_walk_mps3_per_sqrt_Hz: Noises = quantity(label="accel random walk K")
    sigma: dict[str, Sizes] = {}
    below: dict[str, Sizes] = {}
    gyro_step_radps: Noises = quantity(label="gyro step")
    accel_step_mps2: Noises = quantity(label="accel step")
    drift: dict[str, ImuDrift] = quantity({}, label="drift of the angle")
    logs: list[ImuLog] = quantity([], label="logs")


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


class SensorIntrinsics(Section):
    """What accelerometer and gyroscope have in common; the equations are theirs.

    Attributes
    ----------
    unit : of the readings. Lists hold x, y, z, null for what was not calibrated or cannot be told.
    bias, scale : in that unit, and in that unit per m/s^2 or rad/s.
    misalignment_rad : angles of T by the names in it.
    matrix : T diag(1 / scale); absent where a part of it is not known.
    """

    unit: str = quantity(label="readings in")
    bias: PerAxis = quantity(label="bias")
    scale: PerAxis = quantity(label="scale")
    misalignment_rad: Angles = quantity({}, label="misalignment", show="mrad", digits=3)
    sigma: IntrinsicsSigma
    matrix: Matrix3 | None = None


class AccelIntrinsics(SensorIntrinsics):
    """a = T diag(1 / scale) (reading - bias), T = [[1, -yz, zy], [0, 1, -zx], [0, 0, 1]].

    Attributes
    ----------
    misalignment_rad : yz, zy, zx; in a plane yz alone.
    rms_mps2 : of | |a| - g | over the rests; `disagreement_mps2` is what noise does not explain of it.
    """

    unit: Literal["m/s2", "counts"] = quantity(label="readings in")
    rms_mps2: NotNegative | None = quantity(None, label="rests differ from g by (RMS)", digits=6)
    disagreement_mps2: NotNegative | None = quantity(None, label="rests disagree beyond noise by", digits=6)


class GyroIntrinsics(SensorIntrinsics):
    """w = T diag(1 / scale) (reading - bias - S a), T = [[1, -yz, zy], [xz, 1, -zx], [-xy, yx, 1]].

    Attributes
    ----------
    scale, misalignment_rad : per rad/s, to the accelerometer's frame.
    bias : at no specific force where `sensitivity` is there, else that of the rest at the start.
    start_bias : mean of the rest at the start.
    sensitivity : S, in the readings' unit per m/s^2, rows gx, gy, gz.
    rms_rad : by which the turns miss the direction of gravity.
    """

    unit: Literal["rad/s", "counts"] = quantity(label="readings in")
    sigma: GyroSigma
    start_bias: PerAxis = quantity(label="bias at the start")
    sensitivity: Matrix3 | None = None
    rms_rad: NotNegative = quantity(label="turns miss gravity by (RMS)", show="deg", digits=4)
    turns: Count = quantity(label="turns")


class ImuIntrinsics(Result):
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

    gravity_mps2: Positive = quantity(label="gravity")
    planar: bool = quantity(label="in the plane alone")
    rate_hz: Positive = quantity(label="rate", digits=3)
    rests: Count = quantity(label="rests")
    poses: Count = quantity(label="poses more than 5 degrees apart")
    rest_s: NotNegative = quantity(label="at rest", digits=2)
    degrees_of_freedom: Annotated[int, Field(strict=True)] | None = quantity(None, label="degrees of freedom")
    initial_rest_s: NotNegative = quantity(label="rest at the start", digits=2)
    threshold: Positive = quantity(label="threshold, times the spread at rest")
    thresholds: dict[str, NotNegative | None] = {}
    accel: AccelIntrinsics = quantity(label="accel")
    gyro: GyroIntrinsics | None = quantity(None, label="gyro")


# ----------------------------------------------------------------------
# The section `orientation_filter` of rig.yaml.


class FilterCandidate(Section):
    """An angle filter, what it does, and its held-out error.

    Attributes
    ----------
    Kp_per_s, Ki_per_s2 : of (2.3); tau_s, velocity_mps : of the levelling filter.
    poles : discrete, real and imaginary parts.
    bandwidth_hz : of the accelerometer's part.
    noise_gain : variance of the angle over that of white noise on the accelerometer's angle.
    bias_gain_s, bias_peak_s : angle per rate's bias, in the end and at most.
    settling_s : of an error of the angle, `bias_settling_s` of the bias; null where it never does.
    rmse_deg, interval_deg : held-out error and its 95 % interval; null without a judge.
    less_than_3_3_deg, less_interval_deg, confidence : error less that of 3/3, how surely it is less.
    whole_rmse_deg : error on the whole logs, which "tuned" and "levelling" were tuned on.
    """

    Kp_per_s: Positive | None = quantity(None, label="Kp", digits=4)
    Ki_per_s2: NotNegative | None = quantity(None, label="Ki", digits=4)
    tau_s: Positive | None = quantity(None, label="time constant", digits=2)
    velocity_mps: Positive | None = quantity(None, label="velocity", digits=2)
    poles: list[Pair] = quantity(label="poles", digits=4)
    bandwidth_hz: NotNegative = quantity(label="bandwidth", digits=3)
    noise_gain: NotNegative = quantity(label="noise", digits=5)
    bias_gain_s: NotNegative
    bias_peak_s: NotNegative = quantity(label="peak of a bias", digits=3)
    settling_s: NotNegative | None = quantity(label="settles in", digits=2)
    bias_settling_s: NotNegative | None
    lag_s: NotNegative | None = quantity(label="lag", digits=2)
    rmse_deg: NotNegative | None = quantity(None, label="held-out error", digits=3)
    interval_deg: Pair | None = quantity(None, label="95 % interval", digits=3)
    less_than_3_3_deg: Number | None = None
    less_interval_deg: Pair | None = quantity(None, label="less that of 3/3", digits=3)
    confidence: NotNegative | None = quantity(None, label="surely less", show="%", digits=1, le=1)
    whole_rmse_deg: NotNegative | None = quantity(None, label="error on whole logs", digits=3)


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

    name: str = quantity(label="log")
    duration_s: Positive = quantity(label="length", digits=1)
    samples: Count = quantity(label="samples")
    missing: Count = quantity(label="missing")
    pieces: Count = quantity(label="pieces")
    repeated_rows: Count
    repeated_stamps: Count
    reference: str | None = quantity(None, label="judged by")
    reference_offset_deg: Number | None = None
    reference_lag_s: Number | None = quantity(None, label="which is late by", show="ms", digits=1)
    rate_error_degps_per_sqrt_Hz: NotNegative | None = None
    angle_error_deg_per_sqrt_Hz: NotNegative | None = None
    smoothed_sigma_deg: NotNegative | None = quantity(None, label="smoothed angle's sigma", digits=3)
    bias_degps: Number | None = quantity(None, label="bias", digits=4)


class OrientationFilter(Result):
    """The angle filter, its parameters and why they are these.

    Attributes
    ----------
    filter : "mahony" is that of (2.3), "levelling" the one with a bounded velocity.
    Kp_per_s, Ki_per_s2 : gains of (2.3), for whatever runs it.
    tau_s, velocity_mps : of the levelling filter; null where it was not tried.
    rate_hz : of the logs.
    recommended, recommended_by : the candidate, and "reference", "smoothed" or "default".
    sigma : of tuned gains, by leaving parts of the logs out (jackknife).
    held_out : best Kp, Ki without each part of the logs; older versions wrote `halves`.
    densities, densities_from : of the Riccati equation, and where they are from.
    rate_of_angle : "-gz", or "up vector" for a sensor that is not in plane.
    """

    filter: Literal["mahony", "levelling"] = quantity("mahony", label="filter", fact=True)
    Kp_per_s: Positive = quantity(label="Kp", digits=4, le=1e4)
    Ki_per_s2: NotNegative = quantity(label="Ki", digits=4, le=1e6)
    tau_s: Positive | None = quantity(None, label="time constant", digits=2, le=1e5)
    velocity_mps: Positive | None = quantity(None, label="velocity", digits=2, le=1e3)
    rate_hz: Positive = quantity(label="rate", digits=3, le=1e6)
    recommended: str = quantity(label="recommended", fact=True)
    recommended_by: Literal["reference", "smoothed", "default"] = quantity(label="by")
    rate_of_angle: Literal["-gz", "up vector"] = quantity("-gz", label="rate of the angle by")
    sigma: dict[str, NotNegative | None] = {}
    held_out: list[Pair] = []
    halves: list[Pair] = []
    candidates: dict[str, FilterCandidate] = quantity({}, label="gains")
    densities: dict[str, NotNegative] = quantity({}, label="density")
    densities_from: str = quantity("", label="densities from")
    judged_s: NotNegative = quantity(0.0, label="judged over", digits=1)
    block_s: NotNegative | None = quantity(None, label="blocks of the bootstrap", digits=2)
    logs: list[FilterLog] = quantity([], label="logs")


# ----------------------------------------------------------------------
# What `calib imu drift` finds; it is printed and not written.


class DriftMethod(Section):
    """How the angle of one method drifts on a log; null for what the log does not show.

    Attributes
    ----------
    offset_deg : mean error, against the accelerometer's mean angle where there is no truth.
    slope_degps, sigma_degps, interval_degps : slope of the error, its deviation and 95 % interval.
    allan_1s_deg, allan_100s_deg : Allan deviation of the error averaged over so long.
    rmse_deg, lag_ms : error and lateness in motion, without the constant mount offset.
    """

    offset_deg: Number | None = quantity(label="offset", digits=3)
    slope_degps: Number | None = quantity(label="slope", digits=5, digits_by="sigma_degps")
    sigma_degps: NotNegative | None
    interval_degps: Annotated[list[Number | None], Field(min_length=2, max_length=2)] = quantity(
        label="95 % interval", digits=5, digits_by="sigma_degps"
    )
    allan_1s_deg: NotNegative | None = quantity(label="Allan 1 s", digits=4)
    allan_100s_deg: NotNegative | None = quantity(label="100 s", digits=4)
    rmse_deg: NotNegative | None = quantity(label="RMSE", digits=3)
    lag_ms: Number | None = quantity(label="lag", digits=1)


class DriftOfLog(Section):
    """A log and what every method makes of it.

    Attributes
    ----------
    against, about : what the angles are held against: "truth", "rest" or "nothing", and the same in words.
    judged_s, moving_s : length of what slope, offset and Allan deviation rest on, and of motion.
    skipped : sentences about methods that were left out.
    """

    name: str
    duration_s: Positive
    rate_hz: Positive
    jitter_s: NotNegative
    missing: Count
    gaps: Count
    splits: Count
    repeated_rows: Count
    repeated_stamps: Count
    against: Literal["truth", "rest", "nothing"]
    about: str
    judged_s: NotNegative
    moving_s: NotNegative
    methods: dict[str, DriftMethod]
    skipped: list[str] = []
    remarks: list[str] = []


class DriftSlopes(Section):
    """Slopes of one method over several logs."""

    mean_degps: Number | None = quantity(label="mean", digits=5, digits_by="spread_degps")
    spread_degps: NotNegative | None = quantity(label="spread", digits=5, digits_by="spread_degps")
    logs: Count = quantity(label="logs")


class DriftGains(Section):
    """Parameters of the tuned filter, out of the section `orientation_filter`."""

    filter: Literal["mahony", "levelling"]
    Kp_per_s: Positive | None = None
    Ki_per_s2: NotNegative | None = None
    tau_s: Positive | None = None
    velocity_mps: Positive | None = None
    rate_of_angle: Literal["-gz", "up vector"]


class Drift(Result):
    """How the angles of logs drift by every way of getting them; `note` says what does not follow."""

    note: str
    logs: list[DriftOfLog]
    methods: dict[str, DriftSlopes] = quantity(label="slope over the logs")
    provenance: dict[str, dict[str, str]]
    tuned: DriftGains | None = None
