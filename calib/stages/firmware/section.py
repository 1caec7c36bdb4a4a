"""The section `envelope` of rig.yaml: what the firmware lets the actuator do."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from calib.core.result import Number, Section

_Length = Annotated[Number, Field(gt=0, lt=10)]


class Envelope(Section):
    """What a person allows the actuator: the firmware's guard stops the pumps beyond."""

    least_length_m: _Length | None = None
    greatest_length_m: _Length | None = None
    """Lengths of a bellows. Default: from 20 mm below the rest length to 50 mm above."""

    angle_rad: Annotated[Number, Field(gt=0, le=1.5)] | None = None
    """Bending to each side. Default: what one bellows bends alone that is 50 mm longer."""

    rate_mps: Annotated[Number, Field(gt=0, le=10)] = 0.5
    """Rate of a length."""

    full_power_s: Annotated[Number, Field(gt=0, le=600)] = 3.0
    """Time that a pump may stay at its greatest command. Default: 3, or four lags of a slower pump."""

    open_loop_s: Annotated[Number, Field(gt=0, le=600)] = 60.0
    """Time that a pump may be on in open loop, less four times what it was off."""

    open_loop_pwm: Annotated[Number, Field(ge=1, le=255)] | None = None
    """Greatest command in open loop. Default: what holds the greatest length by the pump's map, at
    most controller.pwm_high."""

    apart_m: Annotated[Number, Field(gt=0, lt=1)] = 0.012
    """Distance of the marker from where the angle puts it."""

    @model_validator(mode="after")
    def _ordered(self) -> Envelope:
        least, greatest = self.least_length_m, self.greatest_length_m
        if least is not None and greatest is not None and least >= greatest:
            raise ValueError(
                f"expected least_length_m below greatest_length_m, found {least:g} and {greatest:g}"
            )
        return self
