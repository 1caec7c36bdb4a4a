"""The section `lowpass` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calib.core.result import Count, NotNegative, Number, Positive, Row3, Section


class LowPassSection(Section):
    """b0 b1 b2 and 1 a1 a2 of a second-order section; values that binary32 holds exactly."""

    b: Row3
    a: Row3


class LowPassAxis(Section):
    """Jitter of one coordinate in the log's unit (standard deviation), and what becomes of its motion.

    Attributes
    ----------
    motion_hz : where the motion ends.
    motion_changed : share of the motion (RMS) that does not come through unchanged after the delay.
    quantisation_hz, quantisation_db : quartiles of the frequency of the pixel grid's sawtooth, and the
        gain there; empty at rest.
    """

    jitter_before: NotNegative
    jitter_after: NotNegative
    motion_hz: NotNegative
    motion_changed: NotNegative
    quantisation_hz: list[Number] = []
    quantisation_db: list[Number] = []


class LowPassLog(Section):
    """What the filter does to a log."""

    name: str
    unit: Literal["mm", "px"]
    rate_hz: Positive
    ticks: Count
    held: Count
    dropped: Count
    pieces: Count
    axes: dict[str, LowPassAxis]


class LowPass(Section):
    """The low-pass of the positions, its delay, and what rounding does to it.

    Attributes
    ----------
    cutoff_hz, rounded_cutoff_hz : -3 dB as asked for and of the rounded sections.
    poles : real and imaginary part of each, in the z plane.
    dc_delay_s, largest_delay_s : group delay at zero frequency and the largest up to the cut-off.
    step : `rise_s` (10 % to 90 %), `settling_s` (2 %), `overshoot` (share).
    attenuation_db : gain at frequencies.
    noise_gain : variance of the output over that of a white input.
    dead_band_mm : where the output may stick: bound in Q15 and what was seen there, and in float.
    wanted_jitter : what was asked for, in the log's unit.
    """

    family: Literal["butterworth", "bessel", "critical"]
    order: Annotated[int, Field(ge=1, le=8, strict=True)]
    cutoff_hz: Positive
    rate_hz: Positive
    sections: Annotated[list[LowPassSection], Field(min_length=1, max_length=4)]
    rounded_cutoff_hz: Positive
    pole_radius: Positive
    poles: list[list[Number]] = []
    dc_delay_s: Positive
    largest_delay_s: Positive
    step: dict[str, Number] = {}
    attenuation_db: dict[str, Number] = {}
    noise_gain: Positive
    dead_band_mm: dict[str, Number | None] = {}
    wanted_jitter: NotNegative | None = None
    log: LowPassLog | None = None
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []
    remarks: list[str] = []

    @model_validator(mode="after")
    def _consistent(self) -> LowPass:
        if len(self.sections) != (self.order + 1) // 2:
            raise ValueError(f"expected {(self.order + 1) // 2} sections for order {self.order}")
        for section in self.sections:
            if section.a[0] != 1.0 or sum(section.b) != sum(section.a):
                raise ValueError("expected sections with a = [1, a1, a2] and b of the same sum as a")
        return self
