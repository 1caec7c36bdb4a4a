"""The section `estimator` of rig.yaml: what `calib replay --tune` learns of the noise."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["Estimator", "EstimatorLevel"]

Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


class EstimatorLevel(_Section):
    """One level of process noise, see `calib.estimator.model.Level`."""

    name: str
    accel_phi_radps2: Positive
    accel_length_mps2: Positive
    memory_s: Positive
    friction_s: Positive
    walk_phi_rad_per_sqrt_s: NotNegative
    walk_length_m_per_sqrt_s: NotNegative


class Estimator(_Section):
    """Noise of the sensors and of the process, by maximum likelihood of innovations.

    Attributes
    ----------
    jitter_px : of the tracker, before rounding. accel_noise_mps2, gyro_noise_radps : of one sample.
    sigma : standard deviations by key, of the logarithm for the levels' factors.
    levels : the bank; none for the built-in one.
    gain_per_row : log likelihood that the tuning has won, per row of the logs.
    """

    jitter_px: Positive
    accel_noise_mps2: Positive | None = None
    gyro_noise_radps: Positive | None = None
    sigma: dict[str, NotNegative | None] = {}
    levels: list[EstimatorLevel] = []
    gain_per_row: float | None = None
    logs: list[str] = []
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
