"""The sections `known`, `actuator` and `pump` of rig.yaml: what a person states, and what was identified.

`known` holds a person's word, `actuator` and `pump` what `calib identify` has estimated; all have the same
keys. `in_force` says which value holds: the nominal one, over it an estimate, over it what is known. A known
value with a standard deviation is a prior; an estimate has it in itself and holds instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from calib.core.files import one_line
from calib.core.result import CovarianceTable, NotNegative, Number, Pair, Result, Section, Statement, quantity
from calib.core.schema import validated
from calib.core.words import nearest

if TYPE_CHECKING:
    from calib.stages.actuator.parameters import Plant

Acceleration = Annotated[Number, Field(ge=-100.0, le=100.0)]
Factor = Annotated[Number, Field(ge=0.0, le=10.0)]
Millimetres = Annotated[Number, Field(ge=-1e4, le=1e4)]
Deviations = dict[str, NotNegative | list[NotNegative | None] | None]
"""Standard deviations by key, a list where the value is one; null where nothing bounds it."""

LAW = ("k0_N_per_m", "k1_N_per_m2", "k2_N_per_m3", "k3_N_per_m4")
"""Keys of the springs' law (3.38), which `calib identify stiffness` estimates."""
CREEP = ("lambda1_per_s", "lambda2_N_per_m", "lambda3")
KNOTS = ("elongation_6V_mm", "elongation_8V_mm", "elongation_10V_mm", "elongation_12V_mm")
"""Elongations that `elongation_mm` is fitted to; keys of its `sigma`."""
STRENGTHS = ("strength1", "strength2")
"""Parameters of an identification that `strength` holds."""


def _of_values(kind: type[Section], sigma: Deviations, info: ValidationInfo) -> Deviations:
    """Deviations whose keys are those of a section; a statement has a value beside each."""
    values, needed = info.data, issubclass(kind, Statement)
    keys = (*kind.model_fields, *(KNOTS if "elongation_mm" in kind.model_fields else ()))
    for name, one in sigma.items():
        if name not in keys:
            raise ValueError(f"expected keys of the section, {one_line(name)} is none{nearest(name, keys)}")
        value = values.get("elongation_mm" if name in KNOTS else name)
        size = len(value) if isinstance(value, list) and name not in KNOTS else 0
        if needed and value is None:
            raise ValueError(f"expected a value beside the standard deviation of {name}")
        if value is not None and size != (len(one) if isinstance(one, list) else 0):
            raise ValueError(f"expected {f'{size} numbers' if size else 'a number'} for {name}")
    return sigma


class ActuatorParameters(Section):
    """Mechanical parameters, see `calib.stages.actuator.parameters`; absent ones are nominal.

    Attributes
    ----------
    kind : of the actuator; absent means two bellows side by side.
    """

    kind: Literal["two_bellows"] = "two_bellows"
    mass_kg: Number | None = quantity(None, label="mass", ge=1e-4, le=10.0)
    inertia_kgm2: Number | None = quantity(None, label="inertia", ge=0.0, le=0.1)
    bellows_radius_m: Number | None = quantity(
        None, label="bellows' distance from the middle", ge=1e-3, le=0.2
    )
    rest_length_m: Number | None = quantity(None, label="length at rest", ge=5e-3, le=1.0)
    k0_N_per_m: Number | None = quantity(None, label="spring k0", ge=0.1, le=1e5)
    k1_N_per_m2: Number | None = quantity(None, label="spring k1", ge=-1e7, le=1e7)
    k2_N_per_m3: Number | None = quantity(None, label="spring k2", ge=-1e10, le=1e10)
    k3_N_per_m4: Number | None = quantity(None, label="spring k3", ge=-1e13, le=1e13)
    stiffness_scale: Number | None = quantity(
        None, label="stiffness, of the nominal", fact=True, ge=0.01, le=100.0
    )
    damping_ratio: Number | None = quantity(None, label="damping ratio", ge=0.0, le=10.0)
    damping_scale_free_swing: Number | None = quantity(None, label="damping, hoses off", ge=0.0, le=1e3)
    damping_scale_pumps_connected: Number | None = quantity(
        None, label="damping, pumps connected", ge=0.0, le=1e3
    )
    bending_N_per_rad2: Number | None = quantity(None, label="bending", fact=True, ge=0.0, le=20.0)
    lambda1_per_s: Number | None = quantity(None, label="creep lambda1", ge=-1e4, le=1e4)
    lambda2_N_per_m: Number | None = quantity(None, label="creep lambda2", ge=-1e5, le=1e5)
    lambda3: Number | None = quantity(None, label="creep lambda3", ge=-1e3, le=1e3)
    gravity_mps2: Annotated[list[Acceleration], Field(min_length=2, max_length=2)] | None = None

    _checked = field_validator("sigma", check_fields=False)(classmethod(_of_values))


class PumpParameters(Section):
    """Both pumps, see `calib.stages.actuator.pump`; absent values are nominal.

    Attributes
    ----------
    lag_s, lag_ratio : geometric mean of both lags, and that of the second pump over that of the first.
    elongation_mm : measured on the rig, so that where it is given its forces follow from the rig's own
        springs, otherwise from the nominal ones.
    strength : factors on the static forces of both pumps, which are never quite alike.
    """

    lag_s: Number | None = quantity(None, label="lag", fact=True, ge=1e-3, le=60.0)
    lag_ratio: Number | None = quantity(None, label="lag of pump 2 over that of pump 1", ge=0.1, le=10.0)
    delay_ticks: Annotated[int, Field(strict=True)] | None = quantity(None, label="delay", ge=0, le=1000)
    tick_s: Number | None = quantity(None, label="tick", ge=1e-3, le=0.1)
    supply_V: Number | None = quantity(None, label="supply", ge=1.0, le=100.0)
    dead_zone_V: Number | None = quantity(None, label="dead zone", ge=0.0, le=100.0)
    elongation_mm: Annotated[list[Millimetres], Field(min_length=4, max_length=4)] | None = None
    deflation: Literal["rate_limit", "orifice"] | None = None
    falling_N_per_s: Number | None = quantity(None, label="deflation", fact=True, ge=1e-3, le=1e3)
    laminar_s: Number | None = quantity(None, label="deflation, laminar", ge=1e-3, le=60.0)
    turbulent_s2_per_N: Number | None = quantity(None, label="deflation, turbulent", ge=0.0, le=1e3)
    play_pwm: Number | None = quantity(None, label="play of the commands", ge=0.0, le=255.0)
    play_N: Number | None = quantity(None, label="play of the forces", ge=0.0, le=1e3)
    strength: Annotated[list[Factor], Field(min_length=2, max_length=2)] | None = quantity(
        None, label="strength of the pumps"
    )

    _checked = field_validator("sigma", check_fields=False)(classmethod(_of_values))


class KnownActuator(ActuatorParameters, Statement):
    """What a person states of the actuator: fixed, or with its standard deviation a prior."""

    sigma: Deviations = {}


class KnownPump(PumpParameters, Statement):
    """What a person states of the pumps: fixed, or with its standard deviation a prior."""

    sigma: Deviations = {}


class Known(Statement):
    """What a person states of the rig; no verb writes it."""

    actuator: KnownActuator | None = None
    pump: KnownPump | None = None


class Actuator(ActuatorParameters, Result):
    """Mechanical parameters that `calib identify` has estimated.

    Attributes
    ----------
    covariance : of all that the logs told together, the pumps' parameters with it.
    """

    sigma: Deviations = {}
    covariance: CovarianceTable | None = None


class PumpModel(Section):
    """One model of the pump in a table: parameters with sigma, and errors on recordings not fitted.

    Attributes
    ----------
    level_between_runs : standard deviation of where runs settle about the level, which `sigma` has in it.
    """

    parameters: dict[str, Number]
    sigma: dict[str, NotNegative | None]
    fixed: dict[str, str] = {}
    fitted_rms: NotNegative
    level_between_runs: NotNegative | None = None
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


class SettledRuns(Section):
    """Runs that settle alike under nearly the same PWM: mean and deviation, least and greatest PWM."""

    value: Number
    spread: NotNegative
    pwm: Pair
    files: list[str]


LAG, ORIFICE = "linear lag", "orifice flow"
"""Models of a pump in a table."""
OF_LAG = ("lag_s", "dead_time_s")
"""Parameters of the former that become those of the section."""


class PumpIdentified(Section):
    """What `calib identify pump` finds, in the unit of its tables.

    Attributes
    ----------
    models : by name. groups : of runs that settle apart.
    """

    unit: Literal["kPa", "N"]
    models: dict[str, PumpModel] = {}
    better: str | None = None
    static: dict[str, StaticMapSection] = {}
    groups: list[SettledRuns] = []
    unexplained: list[str] = []

    @field_validator("models")
    @classmethod
    def _lag(cls, models: dict[str, PumpModel]) -> dict[str, PumpModel]:
        if LAG in models and not {*OF_LAG} <= {*models[LAG].parameters}:
            raise ValueError(f"the parameters of {LAG} lack one of {' and '.join(OF_LAG)}")
        return models


class PumpSection(PumpParameters, Result):
    """Parameters of the pumps that `calib identify` has estimated."""

    sigma: Deviations = {}
    covariance: CovarianceTable | None = None
    identified: PumpIdentified | None = None


# ----------------------------------------------------------------------
# Files of schema 1, in which both words share a section: what was estimated has a standard deviation.

_ESTIMATED_TOGETHER = (LAW, CREEP)


def parted(
    old: Mapping[str, tuple[Any, bool]], known: Known | None, source: Path | str
) -> tuple[Actuator | None, PumpSection | None, Known | None]:
    """The sections `actuator`, `pump` and `known` of those of schema 1.

    A section without a verdict is a person's. Of one with a verdict, or with inputs in the provenance, what
    has no standard deviation is.

    Parameters
    ----------
    old : values of `actuator` and `pump` or None, and whether the provenance names inputs of them.
    known : of the file, which holds over what is found here.

    Raises `BadInputError` as `Rig.load`.
    """
    kinds: dict[str, tuple[type[Result], type[Section]]] = {
        "actuator": (Actuator, KnownActuator), "pump": (PumpSection, KnownPump)
    }  # fmt: skip
    estimates: dict[str, Any] = {}
    stated: dict[str, Any] = {}
    for name, (values, learnt) in old.items():
        if values is None:
            continue
        estimate, statement = kinds[name]
        if not isinstance(values, dict) or not (learnt or _VERBS & values.keys()):
            stated[name] = validated(statement, values, source, name)
            continue
        whole = validated(estimate, {"verdict": "ok", **values}, source, name)
        mine = _stated_keys(values, statement)
        left = {key: value for key, value in values.items() if key not in mine}
        estimates[name] = estimate.model_validate({"verdict": "ok", **left})
        if mine:
            stated[name] = statement.model_validate({key: getattr(whole, key) for key in mine})
    for name, one in stated.items():
        later = getattr(known, name, None)
        if later is not None:
            sigma = {**one.sigma, **later.sigma}
            stated[name] = one.model_copy(update={**later.model_dump(exclude_none=True), "sigma": sigma})
    if stated:
        known = Known(**{name: stated.get(name, getattr(known, name, None)) for name in kinds})
    return estimates.get("actuator"), estimates.get("pump"), known


_VERBS = {"verdict", "reasons", "remarks", "advice", "covariance", "identified"}
"""Keys that verbs alone write."""


def _stated_keys(values: Mapping[str, Any], kind: type[Section]) -> list[str]:
    """Keys of a section of schema 1 that no identification has estimated."""
    sigma = values.get("sigma") or {}
    estimated = {*sigma, "kind", "sigma"}
    for together in _ESTIMATED_TOGETHER:
        estimated |= set(together) if estimated & set(together) else set()
    estimated |= {"elongation_mm"} if estimated & set(KNOTS) else set()
    return [key for key in values if key in kind.model_fields and key not in estimated]


# ----------------------------------------------------------------------
# The one way from sections to a plant.


def in_force(
    estimated: Actuator | PumpSection | None, known: KnownActuator | KnownPump | None
) -> dict[str, tuple[Any, Any]]:
    """Value and standard deviation of each key that is not nominal; a deviation is None where none stands.

    What is known holds over what was estimated, but for a prior, which the estimate has in itself.
    """
    out: dict[str, tuple[Any, Any]] = {}
    for section in (estimated, known):
        if section is None:
            continue
        for key, value in section:
            if value is None or key not in _VALUES:
                continue
            sigma = section.sigma.get(key)
            if section is known and sigma is not None and key in out:
                continue
            out[key] = value, sigma
    return out


Standing = Mapping[str, tuple[Any, Any]]
"""Values in force and their standard deviations by key."""


def label_of(parameter: str) -> str:
    """Words for a parameter of an identification in a sentence, as "damping (hoses off)"."""
    for kind in (ActuatorParameters, PumpParameters):
        if parameter in kind.model_fields:
            label, _, which = str(kind.model_fields[parameter].title).partition(", ")
            return f"{label} ({which})" if which else label
    if parameter in KNOTS:
        return f"elongation at {parameter.split('_')[1].removesuffix('V')} V"
    return f"strength of pump {parameter[-1]}"


_VALUES = frozenset({*ActuatorParameters.model_fields, *PumpParameters.model_fields})
_PLAIN = ("mass_kg", "inertia_kgm2", "bellows_radius_m", "rest_length_m", "stiffness_scale", "damping_ratio",
          "bending_N_per_rad2")  # fmt: skip


def plant_from(values: Mapping[str, Any]) -> Plant:
    """The plant with the pumps connected, of values by the keys of `ActuatorParameters`.

    Raises `BadInputError` for values that no plant can have together.
    """
    from calib.stages.actuator.parameters import Creep, Stiffness, pumps_connected

    plant = pumps_connected()
    changed = {key: values[key] for key in _PLAIN if key in values}
    if "gravity_mps2" in values:
        changed["gravity_mps2"] = tuple(values["gravity_mps2"])
    if "damping_scale_pumps_connected" in values:
        changed["damping_scale"] = values["damping_scale_pumps_connected"]
    if any(key in values for key in LAW):
        law = [values.get(key, k) for key, k in zip(LAW, plant.stiffness.padded, strict=True)]
        changed["stiffness"] = Stiffness(tuple(law))
    creep = [values.get(key, rate) for key, rate in zip(CREEP, plant.creep_rates, strict=True)]
    return replace(plant, creep=Creep(*creep), **changed)
