"""The section `lowpass` of rig.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calib.core.result import Count, NotNegative, Number, Positive, Result, Row3, Section, quantity
from calib.core.schema import contradiction

Family = Literal["butterworth", "bessel", "critical", "chebyshev1", "chebyshev2", "elliptic"]


class LowPassSection(Section):
    """b0 b1 b2 and 1 a1 a2 of a second-order section; values that binary32 holds exactly."""

    b: Row3 = quantity(label="b", digits=9)
    a: Row3 = quantity(label="a", digits=9)


class LowPassAxis(Section):
    """Jitter of one coordinate in the log's unit (standard deviation), and what becomes of its motion.

    Attributes
    ----------
    motion_hz : where the motion ends.
    motion_changed : share of the motion (RMS) that does not come through unchanged after the delay.
    quantisation_hz, quantisation_db : quartiles of the frequency of the pixel grid's sawtooth, and the
        gain there; empty at rest.
    """

    jitter_before: NotNegative = quantity(label="jitter", digits=4)
    jitter_after: NotNegative = quantity(label="filtered", digits=4)
    motion_hz: NotNegative = quantity(label="motion up to", digits=2)
    motion_changed: NotNegative = quantity(label="changed", show="%", digits=0)
    quantisation_hz: list[Number] = quantity([], label="pixel grid at", digits=1)
    quantisation_db: list[Number] = quantity([], label="gain there", digits=0)


class LowPassLog(Section):
    """What the filter does to a log."""

    name: str = quantity(label="file")
    unit: Literal["mm", "px"] = quantity(label="jitter in")
    rate_hz: Positive = quantity(label="rate", digits=3)
    ticks: Count = quantity(label="ticks")
    held: Count = quantity(label="held")
    dropped: Count = quantity(label="dropped")
    pieces: Count = quantity(label="pieces")
    axes: dict[str, LowPassAxis] = quantity(label="coordinate")


class LowPass(Result):
    """The low-pass of the positions, its delay, and what rounding does to it.

    Attributes
    ----------
    cutoff_hz, rounded_cutoff_hz : -3 dB as asked for and of the rounded sections.
    poles : real and imaginary part of each, in the z plane.
    dc_delay_s, largest_delay_s : group delay at zero frequency and the largest up to the cut-off.
    step : `rise_s` (10 % to 90 %), `settling_s` (2 %), `overshoot` (share).
    attenuation_db : gain at frequencies.
    noise_gain : variance of the output over that of a white input.
    dead_band_mm : how far from a constant input the output rests in float, in the firmware's form.
    wanted_jitter : what was asked for, in the log's unit.
    """

    family: Family = quantity(label="family", fact=True)
    order: Annotated[int, Field(ge=1, le=8, strict=True)] = quantity(label="order", fact=True)
    cutoff_hz: Positive = quantity(label="cut-off", fact=True, le=1e6)
    rate_hz: Positive = quantity(label="rate", le=1e6)
    sections: Annotated[list[LowPassSection], Field(min_length=1, max_length=4)] = quantity(
        label="coefficients"
    )
    rounded_cutoff_hz: Positive = quantity(label="cut-off, rounded to float")
    pole_radius: Positive = quantity(label="poles within a radius of", digits=5, lt=1.0)
    poles: list[list[Number]] = []
    dc_delay_s: Positive = quantity(label="delay of slow motion", digits=4, fact=True)
    largest_delay_s: Positive = quantity(label="delay up to the cut-off, at most", digits=4)
    step: dict[str, Number] = quantity({}, label="step response:", digits=3)
    attenuation_db: dict[str, Number] = quantity({}, label="gain at", digits=1)
    noise_gain: Positive = quantity(label="variance of white noise", digits=4)
    dead_band_mm: dict[str, Number | None] = quantity({}, label="dead band")
    wanted_jitter: NotNegative | None = quantity(None, label="jitter asked for", digits=4)
    log: LowPassLog | None = quantity(None, label="log")

    @model_validator(mode="after")
    def _consistent(self) -> LowPass:
        if len(self.sections) != (self.order + 1) // 2:
            raise contradiction(
                f"sections has {len(self.sections)}, expected {(self.order + 1) // 2} for order {self.order}"
            )
        for k, section in enumerate(self.sections):
            one, a1, a2 = section.a
            if one != 1.0 or sum(section.b) != sum(section.a):
                raise contradiction(
                    f"sections.{k}: expected a = [1, a1, a2] and b of the same sum as a, found "
                    f"{section.a} and {section.b}"
                )
            if abs(a2) >= 1.0 or abs(a1) >= 1.0 + a2:
                raise contradiction(f"sections.{k}.a is {section.a}, which is not stable")
        return self
