"""The section `controller` of rig.yaml: gains, limits, criterion and margins, for the firmware to take.

Per tick of `tick_s`, with PWM values between `pwm_low` and `pwm_high`:

    orientation   v = Kp e + I + Ki h e / 2 + Kd (e - e_before) / h,   e = +-(phi_ref - phi)
                  u = limit(v),   I += h (Ki e + (u - v) / back_calculation_s)
    position      v = Kp e + Kd (e - e_before) / h + feed-forward,     e = q_ref - q

The feed-forward is `force_pwm` read at the force that the rest at q_ref needs (`feedforward`). The lower
limit of the orientation loop is the PWM at F - falling_share lag_s falling_N_per_s, F the force by the
pump's model, where `falling_share` is given.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from calib.core.result import Row3, Section

Number = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False, strict=True)]
Pwm = Annotated[float, Field(ge=0, le=255, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, le=1000, strict=True)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]


class ControllerCriterion(Section):
    """Margins that the gains keep at every operating point."""

    gain_margin: Annotated[float, Field(gt=1, lt=100, allow_inf_nan=False, strict=True)]
    phase_margin_rad: Annotated[float, Field(gt=0, lt=1.5708, allow_inf_nan=False, strict=True)]
    sensitivity: Annotated[float, Field(gt=1, lt=100, allow_inf_nan=False, strict=True)]


class OrientationGains(Section):
    """PID of the angle with back-calculation; `sign` is that of the error of bellows 1."""

    Kp_pwm_per_rad: NotNegative
    Ki_pwm_per_rad_s: NotNegative
    Kd_pwm_s_per_rad: NotNegative
    back_calculation_s: Positive
    falling_share: NotNegative | None = None
    sign: Literal[1, -1] = 1


class PositionGains(Section):
    """PD of the lengths beside the feed-forward."""

    Kp_pwm_per_m: NotNegative
    Ki_pwm_per_m_s: NotNegative = 0.0
    Kd_pwm_s_per_m: NotNegative


class StaticMap(Section):
    """Force that holds a bellows, and the PWM for it.

    F_i = c_spr (k0 + k1 eps + k2 eps^2 + k3 eps^3) eps +- k_bnd phi |phi|, eps = q_i - l0, + for bellows 1;
    `stiffness` has c_spr in it. `force_pwm` holds pairs of force [N] and PWM with straight lines between;
    below the first force the PWM is `pwm_low`.
    """

    rest_length_m: Positive
    bellows_radius_m: Positive
    stiffness_N_per_m: Annotated[list[Number], Field(min_length=4, max_length=4)]
    bending_N_per_rad2: NotNegative
    strength: Pair
    force_pwm: Annotated[list[Pair], Field(min_length=2, max_length=64)]


class ComputedTorqueGains(Section):
    """Horizon and gains of the law, and the observer's gain: rows q1, q2, dq1, dq2, z1, z2, d1, d2, bias."""

    horizon_ticks: Count
    Kp_per_s2: NotNegative
    Kd_per_s: NotNegative
    latency_s: NotNegative
    observer_gain: Annotated[list[Row3], Field(min_length=9, max_length=9)]


class ControllerMargins(Section):
    """Margins of a loop at a rest; null where nothing limits them."""

    loop: Literal["orientation", "position"]
    q_m: Pair
    stable: bool
    gain: NotNegative | None = None
    phase_rad: NotNegative | None = None
    delay_s: NotNegative | None = None
    crossover_hz: NotNegative
    sensitivity: Positive


class Controller(Section):
    """Gains that were tuned on the model.

    Attributes
    ----------
    lag_s, delay_ticks, falling_N_per_s : of the pumps, for `falling_share`.
    anti_windup : overshoot after the jump [rad] and time to 95 % of the first step [s], by controller.
    """

    tick_s: Positive
    pwm_low: Pwm = 0.0
    pwm_high: Pwm = 255.0
    criterion: ControllerCriterion
    orientation: OrientationGains
    position: PositionGains
    feedforward: StaticMap
    computed_torque: ComputedTorqueGains | None = None
    lag_s: Positive
    delay_ticks: Annotated[int, Field(ge=0, le=1000, strict=True)]
    falling_N_per_s: Positive | None = None
    margins: list[ControllerMargins] = []
    anti_windup: dict[str, dict[str, Number]] = {}
    verdict: Literal["ok", "poor"]
    reasons: list[str] = []

    @model_validator(mode="after")
    def _ordered(self) -> Controller:
        if not self.pwm_low < self.pwm_high:
            raise ValueError(f"expected pwm_low below pwm_high, found {self.pwm_low:g} and {self.pwm_high:g}")
        return self
