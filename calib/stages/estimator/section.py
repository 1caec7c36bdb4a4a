"""The section `estimator` of rig.yaml: what `calib replay --tune` learns of the noise."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from calib.core.result import Number, Section

Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
Gain = Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False, strict=True)]


class EstimatorLevel(Section):
    """One level of process noise, see `calib.stages.estimator.kinematic.Level`."""

    name: str
    accel_phi_radps2: Positive
    accel_length_mps2: Positive
    memory_s: Positive
    friction_s: Positive
    walk_phi_rad_per_sqrt_s: NotNegative
    walk_length_m_per_sqrt_s: NotNegative


class EstimatorGain(Section):
    """The fused estimator with constant gains, for a controller; see
    `calib.stages.estimator.constant_gain.Gains`."""

    rate_hz: Positive
    delay_ticks: Annotated[float, Field(ge=0, le=8, allow_inf_nan=False, strict=True)]
    lever_m: Positive
    camera_phi: Gain
    accel_phi: Gain
    bias: Gain
    moving_length: Gain
    moving_rate: Gain
    rest_length: Gain
    rate_decay: Gain
    slow: Gain
    moving_m: Positive
    still_m: Positive
    gate_m: Positive


class EstimatorDriven(Section):
    """Process noise of the driven model; densities of the walks of `calib.stages.estimator.driven.Drive`."""

    walk_disturbance_N_per_sqrt_s: Positive
    walk_turning_radps_per_sqrt_s: Positive
    walk_growing_mps_per_sqrt_s: Positive
    walk_forces_N_per_sqrt_s: Positive


class Estimator(Section):
    """Noise of the sensors and of the process, by maximum likelihood of innovations.

    Attributes
    ----------
    jitter_px : of the tracker, before rounding. accel_noise_mps2, gyro_noise_radps : of one sample.
    sigma : standard deviations by key, of the logarithm for the levels' factors.
    levels : the bank; none for the built-in one. driven : none where the logs had no commands.
    constant_gain : for a controller.
    gain_per_row : log likelihood that the tuning has won, per row of the logs.
    """

    jitter_px: Positive
    accel_noise_mps2: Positive | None = None
    gyro_noise_radps: Positive | None = None
    sigma: dict[str, NotNegative | None] = {}
    levels: list[EstimatorLevel] = []
    driven: EstimatorDriven | None = None
    constant_gain: EstimatorGain | None = None
    gain_per_row: Number | None = None
    logs: list[str] = []
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
