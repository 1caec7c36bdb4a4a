"""The section `estimator` of rig.yaml: what `calib replay --tune` learns of the noise."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calib.rig_base import Section

__all__ = ["Estimator", "EstimatorAxisGain", "EstimatorGain", "EstimatorLevel"]

Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]


class EstimatorLevel(Section):
    """One level of process noise, see `calib.estimator.model.Level`."""

    name: str
    accel_phi_radps2: Positive
    accel_length_mps2: Positive
    memory_s: Positive
    friction_s: Positive
    walk_phi_rad_per_sqrt_s: NotNegative
    walk_length_m_per_sqrt_s: NotNegative


class EstimatorAxisGain(Section):
    """One axis, see `calib.estimator.constant_gain.AxisGain`: F (n, n), H (m, n), K (n, m), sigma (n,)."""

    F: list[list[Finite]]
    H: list[list[Finite]]
    K: list[list[Finite]]
    sigma: list[NotNegative]

    @model_validator(mode="after")
    def _fits(self) -> EstimatorAxisGain:
        n, m = len(self.F), len(self.H)
        whole = all(len(row) == n for row in (*self.F, *self.H)) and all(len(row) == m for row in self.K)
        if not whole or len(self.K) != n or len(self.sigma) != n:
            raise ValueError("expected F of n x n, H of m x n, K of n x m and n deviations")
        return self


class EstimatorGain(Section):
    """The kinematic filter with constant gains, for a controller; angle and length apart.

    Attributes
    ----------
    rate_hz, delay_ticks : ticks, and how many of them a picture is late.
    phi_level, length_level : names of the levels of process noise that the gains are made for.
    """

    rate_hz: Positive
    delay_ticks: Annotated[int, Field(ge=0, le=8, strict=True)]
    phi_level: str
    length_level: str
    phi: EstimatorAxisGain
    length: EstimatorAxisGain


class Estimator(Section):
    """Noise of the sensors and of the process, by maximum likelihood of innovations.

    Attributes
    ----------
    jitter_px : of the tracker, before rounding. accel_noise_mps2, gyro_noise_radps : of one sample.
    sigma : standard deviations by key, of the logarithm for the levels' factors.
    levels : the bank; none for the built-in one. constant_gain : for a controller.
    gain_per_row : log likelihood that the tuning has won, per row of the logs.
    """

    jitter_px: Positive
    accel_noise_mps2: Positive | None = None
    gyro_noise_radps: Positive | None = None
    sigma: dict[str, NotNegative | None] = {}
    levels: list[EstimatorLevel] = []
    constant_gain: EstimatorGain | None = None
    gain_per_row: float | None = None
    logs: list[str] = []
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
