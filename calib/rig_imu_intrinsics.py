"""The section `imu_intrinsics` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.rig_base import Count, Matrix3, NotNegative, Number, PerAxis, Positive, Section, Sizes

__all__ = ["AccelIntrinsics", "GyroIntrinsics", "GyroSigma", "ImuIntrinsics", "IntrinsicsSigma"]

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
