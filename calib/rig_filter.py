"""The section `orientation_filter` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.rig_base import Count, NotNegative, Number, Pair, Positive, Section

__all__ = ["FilterCandidate", "FilterLog", "OrientationFilter"]


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
