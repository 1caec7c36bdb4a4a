"""A sweep over parameters of rigs, controllers and experiments."""

from __future__ import annotations

import copy
import itertools
import json
import math
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from calib.core.arrays import FloatArray
from calib.core.errors import EXIT_INTERNAL, BadInputError, CalibError, UnknownKeyError, end_of
from calib.core.files import one_line, quoted, read_text, read_yaml_mapping, sha256, shown
from calib.core.plot import every
from calib.core.result import Number, Pair, Section
from calib.core.rig import SCHEMA, VERBS, Rig
from calib.core.schema import contradiction, validated
from calib.core.units import parse_duration_s
from calib.core.words import short
from calib.core.workers import Processes, Task
from calib.runner import outcomes
from calib.runner.cache import program
from calib.stages.control.references import BUILT_IN, built_in
from calib.stages.control.tracking import Tracking
from calib.stages.control.trial import CONTROLLERS, control_model, run_controller
from calib.twin.rig import SimulatedRig, rig_from_file
from calib.twin.scenarios import SCENARIOS, make_scenario, run_scenario

# ----------------------------------------------------------------------
# The specification of a sweep: what is run, over which parameters, and what is measured.
#
#     base: {controller: tuned-pid, reference: jump, rig: rig.yaml, feedback: sensors, duration: 10s}
#     grid:                                   every combination
#       controller.orientation.Kp_pwm_per_rad: [500, 1000, 2000]
#       actuator.stiffness_scale: {from: 0.8, to: 1.2, count: 5}
#     draws:                                  and for each of them so many random plants
#       count: 20
#       seed: 1
#       pump.lag_s: {uniform: [0.1, 0.3]}
#       actuator.mass_kg: {normal: [0.05, 0.002]}
#     measure: [jump_overshoot_rad, angle_rms_rad]
#     near: 0.0                               optional: what the first measure should be, else the least is
#                                             best
#
# `base` names a controller with its reference, a scenario of `calib simulate`, or a filter (fused, baseline)
# with the scenario whose log it gets. A parameter is a key of rig.yaml, or `scenario.OPTION`. Cases are told
# apart by a number; the seed of a case's noise is that of its draw, so that all grid points see the same
# noise.

_SECTIONS = (
    "actuator", "pump", "twin", "controller", "estimator", "align", "imu", "imu_intrinsics", "scenario",
)  # fmt: skip
_PLANT = ("actuator", "pump", "twin")
_HERE = Path("the sweep")
_GAINS = {"orientation": "tuned-pid", "position": "tuned-pd", "computed_torque": "torque"}
_MOST_CASES = 200_000
_LONGEST_S = 3600.0
_KEY = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)+")

Value = Number | str | bool


class Base(Section):
    """What each case is: a controller with its reference, a scenario, or a filter of a scenario's log.

    `rig` is the file that controllers and filters know, and once that is read its text; "" for the nominal
    rig.
    """

    controller: str = ""
    reference: str = ""
    scenario: str = ""
    filter: Literal["fused", "baseline"] | None = None
    rig: str = ""
    feedback: Literal["sensors", "truth"] = "sensors"
    duration: str | None = None
    model: Literal["auto", "kinematic", "driven"] = "auto"

    @property
    def kind(self) -> str:
        """What it is."""
        return "filter" if self.filter else "controller" if self.controller else "scenario"

    @property
    def name(self) -> str:
        """Name of the controller, scenario or filter."""
        return self.filter or self.controller or self.scenario

    @property
    def other(self) -> str:
        """The reference of a controller, the scenario of a filter."""
        return self.scenario if self.filter else self.reference if self.controller else ""

    @property
    def duration_s(self) -> float | None:
        """None for the usual one. Raises `UsageError`."""
        return None if self.duration is None else parse_duration_s(self.duration, "base.duration")


class Range(Section):
    """Evenly spaced values, or such whose logarithms are."""

    start: Number = Field(alias="from")
    to: Number
    count: Annotated[int, Field(ge=1, le=10_000, strict=True)]
    log: bool = False

    @model_validator(mode="after")
    def _positive(self) -> Range:
        if self.log and not (self.start > 0.0 and self.to > 0.0):
            raise contradiction("log goes with positive numbers only")
        return self

    def values(self) -> list[float]:
        """All of them."""
        spaced = np.geomspace if self.log else np.linspace
        numbers: list[float] = spaced(self.start, self.to, self.count).tolist()
        return numbers


class Distribution(Section):
    """Two numbers under the name of a distribution."""

    uniform: Pair | None = None
    normal: Pair | None = None
    log_uniform: Pair | None = None

    @model_validator(mode="after")
    def _one(self) -> Distribution:
        if len(self.model_fields_set) != 1:
            raise contradiction("uniform, normal or log_uniform: expected one of them")
        kind, (a, b) = self.chosen()
        if kind == "normal" and b < 0.0:
            raise contradiction(f"normal has the standard deviation {b:g}, expected none below zero")
        if kind != "normal" and not a < b:
            raise contradiction(f"{kind} goes from {a:g} to {b:g}, expected the smaller one first")
        if kind == "log_uniform" and a <= 0.0:
            raise contradiction(f"log_uniform begins at {a:g}, expected a positive number")
        return self

    def chosen(self) -> tuple[str, list[float]]:
        """Name and numbers of the one that is given."""
        kind = next(iter(self.model_fields_set))
        return kind, getattr(self, kind) or [0.0, 0.0]

    def drawn(self, rng: np.random.Generator) -> float:
        """One value."""
        kind, (a, b) = self.chosen()
        if kind == "log_uniform":
            return math.exp(rng.uniform(math.log(a), math.log(b)))
        return float(rng.normal(a, b) if kind == "normal" else rng.uniform(a, b))


Values = Annotated[
    Annotated[Range, Tag("range")] | Annotated[list[Value], Field(min_length=1), Tag("list")],
    Discriminator(lambda told: "range" if isinstance(told, dict | Range) else "list"),
]


class Draws(BaseModel):
    """How many random plants there are for each point of the grid, and what is random of them."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Distribution] = Field(init=False)

    count: Annotated[int, Field(ge=1, strict=True)] = 1
    seed: Annotated[int, Field(ge=0, strict=True)] = 0

    @property
    def parameters(self) -> dict[str, Distribution]:
        """Distribution of each random parameter."""
        return self.__pydantic_extra__ or {}


class Sweep(Section):
    """A sweep; of `measure` the first one decides, and none names all there are."""

    base: Base
    grid: dict[str, Values] = Field(default={})
    draws: Draws = Draws()
    measure: list[str] = Field(default=[])
    near: Number | None = None

    @property
    def axes(self) -> dict[str, list[Any]]:
        """Values of each parameter of the grid."""
        return {name: one.values() if isinstance(one, Range) else one for name, one in self.grid.items()}

    @property
    def points(self) -> int:
        """Combinations of the grid."""
        return math.prod(one.count if isinstance(one, Range) else len(one) for one in self.grid.values())

    @property
    def cases(self) -> int:
        """Points of the grid times draws."""
        return self.points * self.draws.count

    @property
    def names(self) -> tuple[str, ...]:
        """All parameters."""
        return (*self.grid, *self.draws.parameters)


@dataclass(frozen=True)
class Case:
    """One case: its number, the number of its point in the grid, its draw, and its parameters."""

    number: int
    point: int
    draw: int
    values: tuple[tuple[str, Any], ...]

    def told(self, label: Callable[[str], str] = str) -> str:
        """Its point and its parameters under their labels, for a sentence."""
        values = (
            f"{label(name)} {short(one) if isinstance(one, float) else one}" for name, one in self.values
        )
        return f"#{self.point} ({', '.join(values)})"

    @property
    def name(self) -> str:
        """Name of the file that its outcome is kept in."""
        return f"case{self.number:06d}"


def cases(spec: Sweep) -> Iterator[Case]:
    """All cases in their order: the draws of the first grid point, then those of the next."""
    axes, count = spec.axes, spec.draws.count
    for point, values in enumerate(itertools.product(*axes.values())):
        for draw in range(count):
            rng = np.random.default_rng([spec.draws.seed, draw])
            drawn = [(name, one.drawn(rng)) for name, one in spec.draws.parameters.items()]
            yield Case(point * count + draw, point, draw, (*zip(axes, values, strict=True), *drawn))


def read_sweep(path: Path) -> Sweep:
    """The sweep in a YAML file. Raises `BadInputError` for what is not one, with the key."""
    where = shown(path)
    spec = validated(Sweep, read_yaml_mapping(path), path)
    if spec.base.rig:
        file = path.absolute().parent / spec.base.rig
        if not file.is_file():
            raise BadInputError(f"{where}: base.rig: {shown(file)} is not there")
        Rig.load(file)
        spec.base = spec.base.model_copy(update={"rig": read_text(file)})
    for problem in _problems(spec):
        raise BadInputError(f"{where}: {problem}")
    return spec


def _problems(spec: Sweep) -> Iterator[str]:
    """What does not fit together, in sentences."""
    base = spec.base
    wanted: dict[str, tuple[str, tuple[str, ...]]] = {"scenario": (base.scenario, tuple(SCENARIOS))}
    if base.kind == "controller":
        wanted = {"controller": (base.name, CONTROLLERS), "reference": (base.other, BUILT_IN)}
    if not base.name:
        yield "base names none of controller, scenario, filter"
    if base.controller and (base.filter or base.scenario):
        yield f"base has a controller and a {'filter' if base.filter else 'scenario'}, expected one of them"
    if base.reference and not base.controller:
        yield "base.reference is that of a controller, and base has none"
    for key, (name, names) in wanted.items():
        if name not in names:
            yield f"base.{key} is {quoted(name)}, expected one of {', '.join(names)}"
    try:
        if (base.duration_s or 0.0) > _LONGEST_S:
            yield f"base.duration is {quoted(base.duration)}, expected at most 1h"
    except CalibError as error:
        yield str(error)
    for key in spec.names:
        yield from _problems_of(key, spec.axes.get(key, [0.0])[0], base)
    twice = next((key for key in spec.grid if key in spec.draws.parameters), None)
    if twice is not None:
        yield f"{twice} is in grid and in draws, expected it in one of them"
    again = next((name for k, name in enumerate(spec.measure) if name in spec.measure[:k]), None)
    if again is not None:
        yield f"measure names {quoted(again)} twice"
    if spec.near is not None and not spec.measure:
        yield "near says what the first measure should be, and measure names none"
    if not spec.names and spec.cases == 1:
        yield "has neither grid nor draws, so there is nothing to sweep over"
    if spec.cases > _MOST_CASES:
        yield f"asks for {spec.cases} cases, expected no more than {_MOST_CASES}"


def _problems_of(key: str, value: Any, base: Base) -> Iterator[str]:
    """What is wrong with a parameter, of which `value` is one: nothing would read it."""
    section, _, rest = key.partition(".")
    if not _KEY.fullmatch(key) or section not in _SECTIONS:
        listed = ", ".join(_SECTIONS)
        yield f"{one_line(key)[:60]} is no parameter, expected SECTION.KEY with one of {listed}"
    if section == "scenario" and base.kind == "controller":
        yield f"{key} needs a scenario, and base has a controller with a reference"
    if section == "controller" and base.kind != "controller":
        yield f"{key} needs a controller, and base has a {base.kind}"
    if section == "controller" and (whose := _GAINS.get(rest.split(".")[0], base.name)) != base.name:
        yield f"{key} belongs to the controller {whose}, and base has {base.name}"
    if section not in (*_PLANT, "scenario") and section not in _parsed(base.rig):
        yield f"{key} is in the section {section}, which base.rig lacks; calib {VERBS[section]} writes it"
    try:
        if section == "scenario":
            validated(SCENARIOS[base.scenario], {rest: value}, _HERE, section)
        else:
            Rig.of(_document(base.rig, {key: value}), _HERE)
    except UnknownKeyError as error:
        yield str(error).removeprefix(f"{_HERE}: ")
    except BadInputError:
        # Another value may be one: a case that has none is a row.
        pass


# ----------------------------------------------------------------------
# A case, as it goes to a process: a function of the specification and its number alone.
#
# This module runs the twin on purpose: the plant is the base rig with a case's parameters, while controllers
# and filters know the base rig, but for gains and noise that are parameters themselves.


def measured(case: Case, base: Base, seed: int, key: str, known: str) -> outcomes.Answer:
    """Run a case; every failure is an outcome, none an exception. With a `known` key it is done already."""
    if known == key:
        return outcomes.Answer(outcomes.Outcome(name=case.name, status=outcomes.SAME, key=key))
    began, values, status, sentence = time.perf_counter(), dict[str, float | None](), "ok", ""
    try:
        values = run_case(base, case, seed)
    except Exception as error:
        code, sentence = end_of(error)
        status = "broken" if code == EXIT_INTERNAL else "failed"
    spent = round(time.perf_counter() - began, 4)
    numbers = {name: (value, None) for name, value in values.items()}
    return outcomes.Answer(
        outcomes.Outcome(
            name=case.name, status=status, sentence=sentence, key=key, values=numbers, seconds=spent
        )
    )


def run_case(base: Base, case: Case, seed: int) -> dict[str, float | None]:
    """What is measured in one case, by name; None for what did not happen.

    Raises `BadInputError` for parameters that the plant, the controller or the filter cannot have.
    """
    # The same noise for a draw wherever it is in the grid: differences are then those of the parameters.
    noise = 100_003 * seed + case.draw
    options = {key.removeprefix("scenario."): one for key, one in case.values if key.startswith("scenario.")}
    changed = {key: one for key, one in case.values if not key.startswith("scenario.")}
    told = {key: one for key, one in changed.items() if key.partition(".")[0] not in _PLANT}
    known = Rig.of(_document(base.rig, told), _HERE)
    plant = rig_from_file(Rig.of(_document(base.rig, changed), _HERE))
    if base.kind == "controller":
        return _controlled(base, known, plant, noise)
    plan = make_scenario(base.scenario, options)
    run = run_scenario(plan, plant, noise, base.feedback, base.duration_s)
    if base.kind == "scenario":
        return dict(plan.figures(run))
    return _filtered(base, known, run)


@lru_cache(maxsize=4)
def _parsed(text: str) -> dict[str, Any]:
    found = yaml.safe_load(text) if text else {}
    return found if isinstance(found, dict) else {}


def _document(text: str, changed: Mapping[str, Any]) -> dict[str, Any]:
    """The base rig's file with these changes; those of actuator and pump are what is known of the plant."""
    whole = copy.deepcopy(_parsed(text)) or {"schema": SCHEMA}
    for key, value in changed.items():
        *path, last = key.split(".")
        if path[0] in ("actuator", "pump"):
            path = ["known", *path]
        part = whole
        for name in path:
            part = part.setdefault(name, {})
            if not isinstance(part, dict):
                raise BadInputError(f"{key}: {name} is no section of the rig's file")
        part[last] = value
    return whole


def _controlled(base: Base, known: Rig, plant: SimulatedRig, seed: int) -> dict[str, float | None]:
    model = control_model(rig_from_file(known), known.controller)
    reference = built_in(model, base.other, base.duration_s)
    outcome = run_controller(base.name, plant, model, reference, known.controller, seed, base.feedback)
    return _of_tracking(outcome.figures)


def _of_tracking(figures: Tracking) -> dict[str, float | None]:
    """The measures of `calib.stages.control.tuning`, pairs as two."""
    out: dict[str, float | None] = {}
    for name, value in asdict(figures).items():
        if isinstance(value, tuple):
            out |= {f"{name}_{i}": part for i, part in enumerate(value, start=1)}
        else:
            out[name] = value
    return out


def _filtered(base: Base, known: Rig, run: Any) -> dict[str, float | None]:
    from calib.io.logs import write_log
    from calib.stages.estimator.replay import replay_log
    from calib.twin.simulate import run_log

    with tempfile.TemporaryDirectory(prefix="case-") as place:
        path = Path(place) / "log.csv"
        write_log(path, run_log(run, "log"))
        replayed = replay_log(path, known, _HERE, base.name, model=base.model)
    out: dict[str, float | None] = dict(replayed.rmse)
    for other, errors in replayed.compared.items():
        out |= {f"{other}_{name}": value for name, value in errors.items()}
    for sensor, check in replayed.sensors.items():
        out[f"nis_{sensor}"] = check.nis
    return out


# ----------------------------------------------------------------------
# A sweep from its specification to a table.

_MOST_SHOWN = 10
_MOST_POINTS = 400


@dataclass(frozen=True)
class Point:
    """A point of the grid, or a case where there is no grid: the first measure over its draws.

    Attributes
    ----------
    median : of the measure. worst : of its draws. loss : what points are ranked by, the less the better.
    """

    point: int
    parameters: dict[str, Any]
    median: float
    worst: float
    loss: float
    draws: int
    measures: dict[str, float]

    @property
    def cells(self) -> list[Any]:
        """A row of a table: parameters, the measure that decides as median and worst, the other measures."""
        return [*self.parameters.values(), self.median, self.worst, *list(self.measures.values())[1:]]


@dataclass(frozen=True)
class SweepSummary:
    """All that is told of a sweep.

    Attributes
    ----------
    cases, failed, as_before : how many. first, why : the case that failed first, and its sentence.
    measure : that decides. measures : all of them.
    best, worst : points, by the median over the draws of the measure, or of its distance from `near`.
    clouds : of each parameter with numbers up to 400 pairs of its value and the measure.
    """

    cases: int
    failed: int
    as_before: int
    first: Case | None
    why: str
    measure: str
    measures: tuple[str, ...]
    best: tuple[Point, ...]
    worst: tuple[Point, ...]
    clouds: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]

    def heads(self, first: str, label: Callable[[str], str] = str) -> list[str]:
        """The heading of `Point.cells` behind a `first` column, names under their labels."""
        names, (decides, *others) = map(label, self.best[0].parameters), map(label, self.measures)
        return [first, *names, f"{decides}, median", "worst draw", *others]


def run_sweep(
    store: outcomes.Store,
    processes: Processes,
    spec: Sweep,
    progress: outcomes.Progress = lambda done, total: None,
    limit_s: float = outcomes.LIMIT_S,
) -> Counter[str]:
    """Run all cases that are not there, each in `limit_s` seconds at most. Raises as `run_all`."""
    base, seed = spec.base, spec.draws.seed
    whole = [program(), base.model_dump(), seed]

    def task(case: Case) -> Task:
        key = sha256(json.dumps([*whole, case.draw, case.values], sort_keys=True).encode())
        return Task(case.name, measured, (case, base, seed, key, store.known(case.name)), limit_s)

    return outcomes.run_all(store, processes, map(task, cases(spec)), spec.cases, "case", progress)


def _numeric(spec: Sweep, name: str) -> bool:
    return all(isinstance(value, float) for value in spec.axes.get(name, ()))


def _table(store: outcomes.Store, spec: Sweep) -> tuple[Any, tuple[str, ...]]:
    """All cases as an Arrow table, and the names of what was measured, the one that decides first."""
    numbers, times = {name: _numeric(spec, name) for name in spec.names}, list[tuple[int, float]]()

    def rows() -> Iterator[dict[str, Any]]:
        for case in cases(spec):
            row = {"case": case.number, "point": case.point, "draw": case.draw, "sentence": "was not run"}
            row |= {name: value if numbers[name] else str(value) for name, value in case.values}
            if (outcome := store.outcome(case.name)) is not None:
                times.append((case.number, outcome.seconds))
                row |= {name: value for name, (value, _) in outcome.values.items()}
                row["sentence"] = outcome.sentence
            yield row

    whole = outcomes.arrow_table(rows())
    outcomes.write_timings(store.out, "case,seconds", times)
    first = ("case", "point", "draw", *spec.names)
    found = [name for name in whole.column_names if name not in (*first, "sentence")]
    unknown = next((name for name in spec.measure if found and name not in found), None)
    if unknown is not None:
        raise BadInputError(
            f"measure: {one_line(unknown)} was not measured, expected some of {', '.join(found)}"
        )
    told = [name for name in found if np.isfinite(outcomes.column(whole, name)).any()]
    measures = tuple(name for name in spec.measure or told if name in found)
    kinds = dict.fromkeys(first[:3], "int64") | {"sentence": "string"}
    kinds |= {name: "string" for name, one in numbers.items() if not one}
    return outcomes.typed(whole, [*first, *measures, "sentence"], kinds), measures


def summarise_sweep(store: outcomes.Store, spec: Sweep, as_before: int) -> SweepSummary:
    """Write sweep.parquet and the timings, and return the summary.

    Raises `BadInputError` for a measure that there is not.
    """
    table, measures = _table(store, spec)
    outcomes.write_table(store.out / "sweep.parquet", table)
    sentences = outcomes.texts(table, "sentence")
    failures = ((case, why) for case, why in zip(cases(spec), sentences, strict=True) if why)
    first, why = next(failures, (None, ""))
    deciding = measures[0] if measures else ""
    y = outcomes.column(table, deciding)
    points = _points(table, spec, y, measures)
    ranked = sorted((p for p in points if math.isfinite(p.loss)), key=lambda p: p.loss)
    clouds = tuple(
        (name, _cloud(outcomes.column(table, name), y)) for name in spec.names if _numeric(spec, name)
    )
    best, worst = tuple(ranked[:_MOST_SHOWN]), tuple(reversed(ranked[_MOST_SHOWN:][-_MOST_SHOWN:]))
    return SweepSummary(
        spec.cases, sum(map(bool, sentences)), as_before, first, why, deciding, measures, best, worst, clouds
    )


def _points(table: Any, spec: Sweep, y: FloatArray, measures: tuple[str, ...]) -> list[Point]:
    """Points of the grid; the draws themselves where there is no grid."""
    by_point = bool(spec.grid)
    group = outcomes.column(table, "point" if by_point else "case").astype(np.int64)
    others = {name: outcomes.column(table, name) for name in measures}
    listed: dict[str, Any] = {
        name: outcomes.column(table, name) if _numeric(spec, name) else outcomes.texts(table, name)
        for name in spec.names
    }
    shown = list(spec.grid) if by_point else list(spec.names)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    loss = y if spec.near is None else np.abs(y - spec.near)
    out = []
    for first, rows in zip(starts.tolist(), np.split(order, starts[1:]), strict=True):
        i = int(order[first])
        medians = {name: _median(values[rows]) for name, values in others.items()}
        values = {name: listed[name][i] for name in shown}
        known = rows[np.isfinite(loss[rows])]
        worst = float(y[known[np.argmax(loss[known])]]) if len(known) else math.nan
        out.append(
            Point(int(group[i]), values, _median(y[rows]), worst, _median(loss[rows]), len(known), medians)
        )
    return out


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _cloud(x: FloatArray, y: FloatArray) -> tuple[tuple[float, float], ...]:
    known = every(np.flatnonzero(np.isfinite(x) & np.isfinite(y)), _MOST_POINTS)
    return tuple((float(x[i]), float(y[i])) for i in known)
