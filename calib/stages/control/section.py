"""The section `controller` of rig.yaml: gains, limits, criterion and margins, for the firmware to take.

Per tick of `tick_s`, with PWM values between `pwm_low` and `pwm_high`:

    orientation   v = Kp e + I + Ki h e / 2 + Kd (e - e_before) / h,   e = +-(phi_ref - phi)
                  u = limit(v),   I += h (Ki e + (u - v) / back_calculation_s),   I = 0 where Ki = 0
    position      v = Kp e + Kd (e - e_before) / h + feed-forward,     e = q_ref - q

The feed-forward is `force_pwm` read at the force that the rest at q_ref needs (`feedforward`). The lower
limit of the orientation loop is the PWM at F - falling_share lag_s falling_N_per_s, F the force by the
pump's model, where `falling_share` is given.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from calib.core.result import Result, Row3, Section, quantity
from calib.core.schema import contradiction

Number = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
_MOST_PWM = 255.0
Pwm = Annotated[float, Field(ge=0, le=_MOST_PWM, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, le=1000, strict=True)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]


class ControllerCriterion(Section):
    """Margins that the gains keep at every operating point."""

    gain_margin: Annotated[float, Field(gt=1, lt=100, allow_inf_nan=False, strict=True)] = quantity(
        label="gain margin"
    )
    phase_margin_rad: Annotated[float, Field(gt=0, lt=1.5708, allow_inf_nan=False, strict=True)] = quantity(
        label="phase margin", show="deg", digits=1
    )
    sensitivity: Annotated[float, Field(gt=1, lt=100, allow_inf_nan=False, strict=True)] = quantity(
        label="sensitivity"
    )


class OrientationGains(Section):
    """PID of the angle with back-calculation; `sign` is that of the error of bellows 1."""

    Kp_pwm_per_rad: NotNegative = quantity(label="Kp")
    Ki_pwm_per_rad_s: NotNegative = quantity(label="Ki")
    Kd_pwm_s_per_rad: NotNegative = quantity(label="Kd")
    back_calculation_s: Positive = quantity(label="back-calculation")
    falling_share: NotNegative | None = quantity(None, label="share of the falling rate")
    sign: Literal[1, -1] = 1


class PositionGains(Section):
    """PD of the lengths beside the feed-forward."""

    Kp_pwm_per_m: NotNegative = quantity(label="Kp")
    Ki_pwm_per_m_s: NotNegative = quantity(0.0, label="Ki")
    Kd_pwm_s_per_m: NotNegative = quantity(label="Kd")


class StaticMap(Section):
    """Force that holds a bellows, and the PWM for it.

    F_i = c_spr (k0 + k1 eps + k2 eps^2 + k3 eps^3) eps +- k_bnd phi |phi|, eps = q_i - l0, + for bellows 1;
    `stiffness` has c_spr in it. `force_pwm` holds pairs of force [N] and PWM with straight lines between;
    below the first force the PWM is `pwm_low`.
    """

    rest_length_m: Positive = Field(le=1.0)
    bellows_radius_m: Positive = Field(le=0.2)
    stiffness_N_per_m: Annotated[list[Number], Field(min_length=4, max_length=4)]
    bending_N_per_rad2: NotNegative
    strength: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    force_pwm: Annotated[list[Pair], Field(min_length=2, max_length=64)]

    @field_validator("force_pwm")
    @classmethod
    def _rising(cls, pairs: list[list[float]]) -> list[list[float]]:
        for k, (force, pwm) in enumerate(pairs):
            if not 0.0 <= pwm <= _MOST_PWM:
                raise contradiction(f"{k}.1 is {pwm:g}, expected 0 to {_MOST_PWM:g} PWM")
            if k and not force > pairs[k - 1][0]:
                raise contradiction(f"{k}.0 is {force:g}, expected more than {pairs[k - 1][0]:g} N before it")
        return pairs


class ComputedTorqueGains(Section):
    """Horizon and gains of the law, and the observer's gain: rows q1, q2, dq1, dq2, z1, z2, d1, d2, bias.

    Attributes
    ----------
    horizon_ticks : of the law, which `calib control run` has and the firmware has not.
    """

    horizon_ticks: Count
    Kp_per_s2: NotNegative
    Kd_per_s: NotNegative
    latency_s: NotNegative = Field(le=10.0)
    observer_gain: Annotated[list[Row3], Field(min_length=9, max_length=9)]


class ControllerMargins(Section):
    """Margins of a loop at a rest; null where nothing limits them."""

    loop: Literal["orientation", "position"] = quantity(label="loop")
    q_m: Pair = quantity(label="q1 q2", show="mm", digits=1)
    stable: bool = quantity(label="stable")
    gain: NotNegative | None = quantity(None, label="gain margin", digits=2)
    phase_rad: NotNegative | None = quantity(None, label="phase margin", show="deg", digits=1)
    delay_s: NotNegative | None = quantity(None, label="delay margin", show="ms", digits=0)
    crossover_hz: NotNegative = quantity(label="crossover", digits=2)
    sensitivity: Positive = quantity(label="sensitivity", digits=2)


class AntiWindup(Section):
    """What a controller does on the model after a step and a jump back."""

    overshoot_after_jump_rad: Number = quantity(label="overshoot after the jump", digits=4)
    rise_s: Number = quantity(label="first step to 95 %", digits=2)


class Controller(Result):
    """Gains that were tuned on the model.

    Attributes
    ----------
    lag_s, delay_ticks, falling_N_per_s : of the pumps, for `falling_share`.
    """

    tick_s: Positive = quantity(label="tick", show="ms", digits=3, fact=True, le=10.0)
    pwm_low: Pwm = quantity(0.0, label="least command")
    pwm_high: Pwm = quantity(255.0, label="greatest command")
    criterion: ControllerCriterion = quantity(label="demanded")
    orientation: OrientationGains = quantity(label="orientation", fact=("Kp_pwm_per_rad", "Ki_pwm_per_rad_s"))
    position: PositionGains = quantity(label="position", fact=("Kp_pwm_per_m",))
    feedforward: StaticMap
    computed_torque: ComputedTorqueGains | None = None
    lag_s: Positive = Field(le=60.0)
    delay_ticks: Annotated[int, Field(ge=0, le=1000, strict=True)]
    falling_N_per_s: Positive | None = None
    margins: list[ControllerMargins] = quantity([], label="margins")
    anti_windup: dict[str, AntiWindup] = quantity({}, label="anti-windup")

    @model_validator(mode="after")
    def _ordered(self) -> Controller:
        if not self.pwm_low < self.pwm_high:
            raise ValueError(f"expected pwm_low below pwm_high, found {self.pwm_low:g} and {self.pwm_high:g}")
        return self
