"""The sections `actuator` and `pump` of rig.yaml: what a person knows of them and what was identified.

Both stay plain mappings in the file and for those who only simulate (`calib.twin.rig` names what is wrong
with a number in the unit that was expected). These schemas are for what is identified and for reading it
back: values, and beside them `sigma`, `covariance`, verdict, reasons, remarks and advice.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator

from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.result import CovarianceTable, NotNegative, Number, Pair, Positive, Section
from calib.core.rig import Rig, validation_sentence

Verdict = Literal["ok", "poor", "unidentifiable"]
Kind = TypeVar("Kind", bound=BaseModel)


class _Judged(Section):
    """What every identified section has beside its values.

    Attributes
    ----------
    sigma : standard deviations by key, a list where the value is one; null where nothing bounds it.
    """

    sigma: dict[str, NotNegative | list[NotNegative | None] | None] = {}
    covariance: CovarianceTable | None = None
    verdict: Verdict | None = None
    reasons: list[str] = []
    remarks: list[str] = []
    advice: list[str] = []


class Actuator(_Judged):
    """Mechanical parameters, see `calib.stages.actuator.parameters`; absent ones are nominal."""

    mass_kg: Positive | None = None
    inertia_kgm2: NotNegative | None = None
    bellows_radius_m: Positive | None = None
    rest_length_m: Positive | None = None
    k0_N_per_m: Positive | None = None
    k1_N_per_m2: Number | None = None
    k2_N_per_m3: Number | None = None
    k3_N_per_m4: Number | None = None
    stiffness_scale: Positive | None = None
    damping_ratio: NotNegative | None = None
    damping_scale_free_swing: NotNegative | None = None
    damping_scale_pumps_connected: NotNegative | None = None
    bending_N_per_rad2: NotNegative | None = None
    lambda1_per_s: Number | None = None
    lambda2_N_per_m: Number | None = None
    lambda3: Number | None = None
    gravity_mps2: Pair | None = None
    force_projection: Literal["virtual_work", "head"] | None = None


class PumpModel(Section):
    """One model of the pump in a table: parameters with sigma, and errors on recordings not fitted."""

    parameters: dict[str, Number]
    sigma: dict[str, NotNegative | None]
    fixed: dict[str, str] = {}
    fitted_rms: NotNegative
    held_rms: NotNegative | None = None
    held_rms_in_main_group: NotNegative | None = None
    held_by_file: dict[str, NotNegative] = {}
    ahead_by_file: dict[str, NotNegative | None] = {}


class StaticMapSection(Section):
    """A static map from settled values, see `calib.stages.actuator.identify_pump`."""

    end: Number
    dead_pwm: Number
    scale_pwm: Number
    saturates_pwm: Number
    scatter: NotNegative
    sigma: dict[str, NotNegative | None]
    outliers_pwm: list[Number] = []


class PumpIdentified(Section):
    """What `calib identify pump` finds, in the unit of its tables.

    Attributes
    ----------
    models : by name. groups : settled values, with the PWM and the recordings that settle there.
    """

    unit: Literal["kPa", "N"]
    models: dict[str, PumpModel] = {}
    better: str | None = None
    static: dict[str, StaticMapSection] = {}
    groups: list[dict[str, Number | list[str] | list[Number]]] = []
    unexplained: list[str] = []


class PumpSection(_Judged):
    """Both pumps, see `calib.stages.actuator.pump`; absent values are nominal."""

    lag_s: Positive | None = None
    delay_ticks: Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)] | None = None
    tick_s: Positive | None = None
    supply_V: Positive | None = None
    dead_zone_V: NotNegative | None = None
    elongation_mm: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = None
    deflation: Literal["rate_limit", "orifice"] | None = None
    falling_N_per_s: Positive | None = None
    laminar_s: Positive | None = None
    turbulent_s2_per_N: NotNegative | None = None
    strength: Pair | None = None
    identified: PumpIdentified | None = None

    @model_validator(mode="after")
    def _whole_ticks(self) -> PumpSection:
        if self.delay_ticks is not None and self.delay_ticks != int(self.delay_ticks):
            raise ValueError("expected a whole number of ticks")
        return self


def section_of(rig: Rig, name: str, kind: type[Kind], path: Path) -> Kind:
    """A section of a rig by its schema, empty where the file has none.

    Raises `BadInputError` naming file and key.
    """
    raw: Any = getattr(rig, name, None)
    if raw is None:
        raw = (rig.model_extra or {}).get(name, {})
    if isinstance(raw, kind):
        return raw
    if not isinstance(raw, dict):
        raise BadInputError(f"{shown(path)}: {name} is {raw!r}, expected keys with values")
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        sentence = validation_sentence(path, error)
        key = sentence.split(": ", 1)[1]
        raise BadInputError(f"{shown(path)}: {name}.{key}") from error
