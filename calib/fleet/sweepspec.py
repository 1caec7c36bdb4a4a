"""The specification of a sweep: what is run, over which parameters, and what is measured.

    base: {controller: tuned-pid, reference: jump, rig: rig.yaml, feedback: sensors, duration: 10s}
    grid:                                   every combination
      controller.orientation.Kp_pwm_per_rad: [500, 1000, 2000]
      actuator.stiffness_scale: {from: 0.8, to: 1.2, count: 5}
    draws:                                  and for each of them so many random plants
      count: 20
      seed: 1
      pump.lag_s: {uniform: [0.1, 0.3]}
      actuator.mass_kg: {normal: [0.05, 0.002]}
    measure: [jump_overshoot_rad, angle_rms_rad]
    near: 0.0                               optional: what the first measure should be, else the least is best

`base` names a controller with its reference, a scenario of `calib simulate`, or a filter (fused, baseline)
with the scenario whose log it gets. A parameter is a key of rig.yaml, or `scenario.OPTION`. Cases are told
apart by a number; the seed of a case's noise is that of its draw, so that all grid points see the same noise.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.errors import BadInputError, CalibError
from calib.files import one_line, read_yaml_mapping, shown
from calib.units import parse_duration_s

__all__ = ["Base", "Case", "SweepSpec", "cases", "read_sweep"]

_SECTIONS = (
    "actuator", "pump", "twin", "controller", "estimator", "align", "imu", "imu_intrinsics", "scenario",
)  # fmt: skip
_KEYS = ("base", "grid", "draws", "measure", "near")
_KINDS = ("controller", "scenario", "filter")
_BASE = (*_KINDS, "reference", "rig", "feedback", "duration", "model")
_FILTERS = ("fused", "baseline")
_GAINS = {"orientation": "tuned-pid", "position": "tuned-pd", "computed_torque": "torque"}
_MODELS = ("auto", "kinematic", "driven")
_MOST_CASES = 1_000_000
_LONGEST_S = 3600.0
_KEY = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)+")

Value = float | str | bool


@dataclass(frozen=True)
class Base:
    """What each case is.

    Attributes
    ----------
    kind : "controller", "scenario" or "filter".
    name : of the controller or filter, or of the scenario.
    other : the reference of a controller, the scenario of a filter.
    rig : text of the rig.yaml that controllers and filters know, "" for the nominal rig.
    feedback : "sensors" or "truth". duration_s : None for the usual one. model : of a filter.
    """

    kind: str
    name: str
    other: str
    rig: str
    feedback: str
    duration_s: float | None
    model: str


@dataclass(frozen=True)
class SweepSpec:
    """A sweep.

    Attributes
    ----------
    grid : values of each parameter of the grid. draws : distribution of each random parameter.
    count, seed : of the draws; one draw without any.
    measures : names of what is measured, the first one decides; empty for all there are.
    near : what the deciding measure should be, None where the least is best.
    """

    base: Base
    grid: tuple[tuple[str, tuple[Value, ...]], ...]
    draws: tuple[tuple[str, tuple[str, float, float]], ...]
    count: int
    seed: int
    measures: tuple[str, ...]
    near: float | None = None

    @property
    def points(self) -> int:
        """Combinations of the grid."""
        return math.prod(len(values) for _, values in self.grid)

    @property
    def cases(self) -> int:
        """Points of the grid times draws."""
        return self.points * self.count

    @property
    def names(self) -> tuple[str, ...]:
        """All parameters."""
        return (*(name for name, _ in self.grid), *(name for name, _ in self.draws))


@dataclass(frozen=True)
class Case:
    """One case: its number, the number of its point in the grid, its draw, and its parameters."""

    number: int
    point: int
    draw: int
    values: tuple[tuple[str, Value], ...]


def cases(spec: SweepSpec) -> Iterator[Case]:
    """All cases in their order: the draws of the first grid point, then those of the next."""
    names = [name for name, _ in spec.grid]
    for point, values in enumerate(itertools.product(*(values for _, values in spec.grid))):
        for draw in range(spec.count):
            drawn = _drawn(spec, draw)
            yield Case(point * spec.count + draw, point, draw, (*zip(names, values, strict=True), *drawn))


def _drawn(spec: SweepSpec, draw: int) -> list[tuple[str, Value]]:
    rng = np.random.default_rng([spec.seed, draw])
    out: list[tuple[str, Value]] = []
    for name, (kind, a, b) in spec.draws:
        if kind == "normal":
            value = rng.normal(a, b)
        elif kind == "log_uniform":
            value = math.exp(rng.uniform(math.log(a), math.log(b)))
        else:
            value = rng.uniform(a, b)
        out.append((name, float(value)))
    return out


def read_sweep(path: Path) -> SweepSpec:
    """The sweep in a YAML file. Raises `BadInputError` for what is not one, with the key."""
    whole, where = read_yaml_mapping(path), shown(path)
    unknown = next((key for key in whole if key not in _KEYS), None)
    if unknown is not None:
        raise BadInputError(f"{where}: {one_line(unknown)} is not known here, expected {', '.join(_KEYS)}")
    base = _base(where, _mapping(where, "base", whole.get("base")), path)
    grid, points = list[tuple[str, tuple[Value, ...]]](), 1
    for key, value in _mapping(where, "grid", whole.get("grid") or {}).items():
        grid.append((key, _values(f"{where}: grid.{one_line(key)}", value)))
        points *= len(grid[-1][1])
        _check_cases(where, points)
    drawn = dict(_mapping(where, "draws", whole.get("draws") or {}))
    count, seed = drawn.pop("count", 1), drawn.pop("seed", 0)
    for name, value, least in (("count", count, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise BadInputError(
                f"{where}: draws.{name} is {_short(value)}, expected a whole number from {least}"
            )
    draws = tuple(
        (key, _distribution(f"{where}: draws.{one_line(key)}", value)) for key, value in drawn.items()
    )
    for key in (*(key for key, _ in grid), *(key for key, _ in draws)):
        _check_key(where, key, base)
    twice = next((key for key, _ in grid if key in dict(draws)), None)
    if twice is not None:
        raise BadInputError(f"{where}: {twice} is in grid and in draws, expected it in one of them")
    measures = whole.get("measure") or []
    if not isinstance(measures, list) or not all(isinstance(name, str) for name in measures):
        raise BadInputError(f"{where}: measure is no list of names")
    near = None if whole.get("near") is None else _finite(f"{where}: near", whole["near"])
    if near is not None and not measures:
        raise BadInputError(f"{where}: near says what the first measure should be, and measure names none")
    spec = SweepSpec(base, tuple(grid), draws, count, seed, tuple(measures), near)
    if not spec.names and count == 1:
        raise BadInputError(f"{where}: has neither grid nor draws, so there is nothing to sweep over")
    _check_cases(where, spec.cases)
    return spec


def _check_cases(where: str, count: int) -> None:
    if count > _MOST_CASES:
        raise BadInputError(f"{where}: asks for {count} cases or more, expected no more than {_MOST_CASES}")


def _mapping(where: str, key: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        found = "missing" if value is None else "no mapping"
        raise BadInputError(f"{where}: {key} is {found}, expected keys with values")
    wrong = [name for name in value if not isinstance(name, str)]
    if wrong:
        raise BadInputError(f"{where}: {key} has the key {one_line(repr(wrong[0]))[:60]}, expected text")
    return value


def _base(where: str, told: Mapping[str, Any], path: Path) -> Base:
    unknown = next((key for key in told if key not in _BASE), None)
    if unknown is not None:
        raise BadInputError(f"{where}: base.{one_line(unknown)} is not known, expected {', '.join(_BASE)}")
    wrong = next((key for key, value in told.items() if not isinstance(value, str)), None)
    if wrong is not None:
        raise BadInputError(f"{where}: base.{wrong} is {_short(told[wrong])}, expected text")
    if "filter" in told:
        kind, name, other = "filter", told["filter"], told.get("scenario", "")
        _one_of(where, "base.filter", name, _FILTERS)
    elif "controller" in told:
        kind, name, other = "controller", told["controller"], told.get("reference", "")
    elif "scenario" in told:
        kind, name, other = "scenario", told["scenario"], ""
    else:
        raise BadInputError(f"{where}: base names none of {', '.join(_KINDS)}")
    _check_names(where, kind, name, other)
    feedback, model = told.get("feedback", "sensors"), told.get("model", "auto")
    _one_of(where, "base.feedback", feedback, ("sensors", "truth"))
    _one_of(where, "base.model", model, _MODELS)
    try:
        duration = parse_duration_s(told["duration"], "base.duration") if "duration" in told else None
    except CalibError as error:
        raise BadInputError(f"{where}: {error}") from error
    if duration is not None and duration > _LONGEST_S:
        raise BadInputError(f"{where}: base.duration is {_short(told['duration'])}, expected at most 1h")
    return Base(kind, name, other, _rig_text(where, told.get("rig"), path), feedback, duration, model)


def _check_names(where: str, kind: str, name: str, other: str) -> None:
    from calib.control.references import BUILT_IN
    from calib.controlling import CONTROLLERS
    from calib.twin.scenarios import SCENARIOS

    if kind == "controller":
        _one_of(where, "base.controller", name, CONTROLLERS)
        _one_of(where, "base.reference", other, BUILT_IN)
    else:
        _one_of(where, "base.scenario", other if kind == "filter" else name, tuple(SCENARIOS))


def _rig_text(where: str, rig: str | None, path: Path) -> str:
    if rig is None:
        return ""
    from calib.files import read_text
    from calib.rig import read_rig

    file = path.absolute().parent / rig
    if not file.is_file():
        raise BadInputError(f"{where}: base.rig: {shown(file)} is not there")
    read_rig(file)
    return read_text(file)


def _one_of(where: str, key: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise BadInputError(f"{where}: {key} is {_short(value)}, expected one of {', '.join(known)}")


def _check_key(where: str, key: str, base: Base) -> None:
    if not _KEY.fullmatch(key) or key.split(".")[0] not in _SECTIONS:
        raise BadInputError(
            f"{where}: {one_line(key)[:60]} is no parameter, expected SECTION.KEY with one of "
            f"{', '.join(_SECTIONS)}"
        )
    if key.startswith("scenario.") and base.kind == "controller":
        raise BadInputError(f"{where}: {key} needs a scenario, and base has a controller with a reference")
    if key.startswith("controller."):
        _check_gain(where, key, base)


def _check_gain(where: str, key: str, base: Base) -> None:
    """Refuse keys of the section `controller` that nothing would read."""
    if base.kind != "controller":
        raise BadInputError(f"{where}: {key} needs a controller, and base has a {base.kind}")
    whose = _GAINS.get(key.split(".")[1], base.name)
    if whose != base.name:
        raise BadInputError(f"{where}: {key} belongs to the controller {whose}, and base has {base.name}")
    if "controller" not in (yaml.safe_load(base.rig) or {}):
        raise BadInputError(
            f"{where}: {key} is in the section controller, which base.rig lacks; calib control tune writes it"
        )


def _finite(where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(_float(value)):
        raise BadInputError(f"{where} has {_short(value)} in it, expected a number")
    return float(value)


def _float(value: float) -> float:
    """The number; infinity for a whole one that no float can hold."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _short(value: Any) -> str:
    return one_line(repr(value))[:60]


def _values(where: str, told: Any) -> tuple[Value, ...]:
    if isinstance(told, dict):
        if set(told) - {"from", "to", "count", "log"} or not {"from", "to", "count"} <= set(told):
            raise BadInputError(f"{where} has {_short(list(told))}, expected from, to, count, log")
        a, b, count = _finite(where, told["from"]), _finite(where, told["to"]), told["count"]
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 10_000:
            raise BadInputError(f"{where}: count is {_short(count)}, expected a whole number from 1 to 10000")
        if told.get("log"):
            if not (a > 0.0 and b > 0.0):
                raise BadInputError(f"{where} goes from {a:g} to {b:g}, expected positive numbers with log")
            return tuple(np.geomspace(a, b, count).tolist())
        return tuple(np.linspace(a, b, count).tolist())
    if not isinstance(told, list) or not told:
        raise BadInputError(f"{where} is no list of values and no range, expected for instance [1.0, 2.0]")
    for value in told:
        word = isinstance(value, str | bool)
        if not word and not (isinstance(value, int | float) and math.isfinite(_float(value))):
            raise BadInputError(f"{where} has {_short(value)} in it, expected numbers or words")
    return tuple(float(v) if isinstance(v, int) and not isinstance(v, bool) else v for v in told)


def _distribution(where: str, told: Any) -> tuple[str, float, float]:
    kinds = ("uniform", "normal", "log_uniform")
    if not isinstance(told, dict) or len(told) != 1 or next(iter(told)) not in kinds:
        raise BadInputError(
            f"{where} is no distribution, expected one of {', '.join(kinds)} with two numbers"
        )
    kind, numbers = next(iter(told.items()))
    if not isinstance(numbers, list) or len(numbers) != 2:
        raise BadInputError(f"{where}.{kind} is {_short(numbers)}, expected two numbers")
    a, b = (_finite(f"{where}.{kind}", value) for value in numbers)
    if kind == "normal" and b < 0.0:
        raise BadInputError(f"{where}.normal has the standard deviation {b:g}, expected none below zero")
    if kind != "normal" and not a < b:
        raise BadInputError(f"{where}.{kind} goes from {a:g} to {b:g}, expected the smaller one first")
    if kind == "log_uniform" and a <= 0.0:
        raise BadInputError(f"{where}.log_uniform begins at {a:g}, expected a positive number")
    return kind, a, b
