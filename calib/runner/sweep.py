"""A sweep over parameters of rigs, controllers and experiments."""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import math
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError, CalibError
from calib.core.files import one_line, read_yaml_mapping, sha256, shown
from calib.core.rig import SCHEMA, Rig
from calib.core.units import parse_duration_s
from calib.core.workers import Failure, Processes, Task, run_tasks
from calib.core.writing import write_atomically
from calib.runner.cache import program
from calib.runner.fleet import (
    HIDDEN,
    LIMIT_S,
    Progress,
    Store,
    column,
    sentence_of,
    texts,
    write_table,
    write_timings,
)
from calib.stages.control.trial import control_model, run_controller
from calib.stages.control.tuning import Tracking
from calib.twin.rig import SimulatedRig, rig_from_file

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
# best
#
# `base` names a controller with its reference, a scenario of `calib simulate`, or a filter (fused,
# baseline)
# with the scenario whose log it gets. A parameter is a key of rig.yaml, or `scenario.OPTION`. Cases are
# told
# apart by a number; the seed of a case's noise is that of its draw, so that all grid points see the same
# noise.

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
    from calib.stages.control.references import BUILT_IN
    from calib.stages.control.trial import CONTROLLERS
    from calib.twin.scenarios import SCENARIOS

    if kind == "controller":
        _one_of(where, "base.controller", name, CONTROLLERS)
        _one_of(where, "base.reference", other, BUILT_IN)
    else:
        _one_of(where, "base.scenario", other if kind == "filter" else name, tuple(SCENARIOS))


def _rig_text(where: str, rig: str | None, path: Path) -> str:
    if rig is None:
        return ""
    from calib.core.files import read_text

    file = path.absolute().parent / rig
    if not file.is_file():
        raise BadInputError(f"{where}: base.rig: {shown(file)} is not there")
    Rig.load(file)
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


# ----------------------------------------------------------------------
# Cases of a sweep, as they go to a process: functions of the specification and their numbers alone.
#
# This module runs the twin on purpose: the plant is the base rig with a case's parameters, while
# controllers
# and filters know the base rig, but for gains and noise that are parameters themselves.

_PLANT = ("actuator", "pump", "twin")
_HERE = Path("the sweep")


@dataclass(frozen=True)
class CaseResult:
    """What was measured in a case; `sentence` says why nothing was."""

    number: int
    measures: dict[str, float | None]
    sentence: str
    seconds: float


def run_cases(base: Base, cases: tuple[Case, ...], seed: int) -> list[CaseResult]:
    """Run some cases one after the other; every failure is a result, none an exception."""
    out = []
    for case in cases:
        began, measures, sentence = time.perf_counter(), dict[str, float | None](), ""
        try:
            measures = run_case(base, case, seed)
        except CalibError as error:
            sentence = str(error)
        except Exception as error:
            sentence = f"internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        out.append(CaseResult(case.number, measures, sentence, round(time.perf_counter() - began, 4)))
    return out


def run_case(base: Base, case: Case, seed: int) -> dict[str, float | None]:
    """What is measured in one case, by name; None for what did not happen.

    Raises `BadInputError` for parameters that the plant, the controller or the filter cannot have.
    """
    # The same noise for a draw wherever it is in the grid: differences are then those of the parameters.
    noise = 100_003 * seed + case.draw
    changed, options = _changed(case)
    known = Rig.of(_known(base.rig, changed), _HERE)
    plant = rig_from_file(Rig.of(_document(base.rig, changed), _HERE))
    if base.kind == "controller":
        return _controlled(base, known, plant, noise)
    from calib.twin.scenarios import make_scenario, run_scenario

    plan = make_scenario(base.name if base.kind == "scenario" else base.other, options)
    run = run_scenario(plan, plant, noise, base.feedback, base.duration_s)
    if base.kind == "scenario":
        return {name: _or_none(value) for name, value in plan.figures(run).items()}
    return _filtered(base, known, run)


def _changed(case: Case) -> tuple[dict[str, Any], dict[str, str]]:
    """Changes to rig.yaml by their paths, and options of the scenario as they would be typed."""
    from calib.twin.scenarios import as_typed

    changed, options = dict[str, Any](), dict[str, str]()
    for key, value in case.values:
        section, _, rest = key.partition(".")
        if section == "scenario":
            options[rest] = as_typed(value)
        else:
            changed[key] = value
    return changed, options


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


def _known(text: str, changed: Mapping[str, Any]) -> dict[str, Any]:
    """What controllers and filters are told: the base rig, and their own parameters."""
    own = {key: value for key, value in changed.items() if key.partition(".")[0] not in _PLANT}
    return _document(text, own)


def _controlled(base: Base, known: Rig, plant: SimulatedRig, seed: int) -> dict[str, float | None]:
    from calib.stages.control.references import built_in

    model = control_model(rig_from_file(known), known.controller)
    reference = built_in(model, base.other, base.duration_s)
    outcome = run_controller(base.name, plant, model, reference, known.controller, seed, base.feedback)
    return _of_tracking(outcome.figures)


def _of_tracking(figures: Tracking) -> dict[str, float | None]:
    """The measures of `calib.stages.control.tuning`, pairs as two."""
    out: dict[str, float | None] = {}
    for name, value in asdict(figures).items():
        if isinstance(value, tuple):
            out |= {f"{name}_{i}": _or_none(part) for i, part in enumerate(value, start=1)}
        else:
            out[name] = _or_none(value)
    return out


def _filtered(base: Base, known: Rig, run: Any) -> dict[str, float | None]:
    from calib.io.logs import write_log
    from calib.stages.estimator.replay import replay_log
    from calib.twin.simulate import log_of

    with tempfile.TemporaryDirectory(prefix="case-") as place:
        path = Path(place) / "log.csv"
        write_log(path, log_of(run, "log"))
        replayed = replay_log(path, known, _HERE, base.name, model=base.model)
    out = {name: _or_none(value) for name, value in replayed.rmse.items()}
    for other, errors in replayed.compared.items():
        out |= {f"{other}_{name}": _or_none(value) for name, value in errors.items()}
    for sensor, check in replayed.sensors.items():
        out[f"nis_{sensor}"] = _or_none(check.nis)
    return out


def _or_none(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


# ----------------------------------------------------------------------
# A sweep from its specification to a table: cases in bundles, each bundle kept as soon as it is done.

BUNDLE = 8
_MOST_SHOWN = 10
_MOST_POINTS = 400
_BLOCK = 512


@dataclass(frozen=True)
class Point:
    """A point of the grid, or a case where there is no grid: the first measure over its draws.

    Attributes
    ----------
    median : of the measure. worst : of its draws. loss : what points are ranked by, the less the better.
    """

    number: int
    values: tuple[tuple[str, Any], ...]
    median: float
    worst: float
    loss: float
    draws: int
    measures: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class SweepSummary:
    """All that is told of a sweep.

    Attributes
    ----------
    cases, failed, as_before : how many. why : the first failure's sentence.
    measure : that decides. measures : all of them.
    best, worst : points, by the median over the draws of the measure, or of its distance from `near`.
    clouds : of each parameter with numbers up to 400 pairs of its value and the measure.
    """

    cases: int
    failed: int
    as_before: int
    why: str
    measure: str
    measures: tuple[str, ...]
    best: tuple[Point, ...]
    worst: tuple[Point, ...]
    clouds: tuple[tuple[str, tuple[tuple[float, float], ...]], ...]


def _digest(spec: SweepSpec) -> str:
    return sha256(json.dumps([program(), asdict(spec)], sort_keys=True, default=str).encode())


def _file(store: Store, cases: Sequence[Case]) -> Path:
    name = f"cases{cases[0].number:07d}-{len(cases)}.json"
    return store.out / HIDDEN / "outcomes" / name


def _kept(store: Store, cases: Sequence[Case], digest: str, final: bool = False) -> list[CaseResult] | None:
    """Results of some cases; with `final` only where none of them came of the processes that did the work."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        told = json.loads(_file(store, cases).read_text(encoding="utf-8"))
        if told["digest"] == digest and not (final and told["lost"]):
            return [CaseResult(**one) for one in told["results"]]
    return None


def _results(store: Store, spec: SweepSpec) -> Iterator[tuple[Case, CaseResult | None]]:
    """All cases with their results, where these are there."""
    digest = _digest(spec)
    for bundle in _bundles(spec):
        together = {one.number: one for one in _kept(store, bundle, digest) or []}
        for case in bundle:
            alone = () if case.number in together else _kept(store, (case,), digest) or ()
            yield case, together.get(case.number) or next(iter(alone), None)


def _bundles(spec: SweepSpec) -> Iterator[tuple[Case, ...]]:
    every = cases(spec)
    while bundle := tuple(islice(every, BUNDLE)):
        yield bundle


def run_sweep(
    store: Store,
    processes: Processes,
    spec: SweepSpec,
    progress: Progress = lambda done, total: None,
    limit_s: float = LIMIT_S,
) -> int:
    """Run all bundles of cases that are not there, each case in `limit_s` seconds at most.

    A bundle that is lost is done again case by case: one of them may be at fault, and the others are not.
    Returns how many cases were there. Raises as `run_tasks`.
    """
    digest = _digest(spec)
    before = done = 0
    apart: list[Case] = []

    def task(some: tuple[Case, ...]) -> Task:
        name = _file(store, some).stem
        return Task(name, run_cases, (spec.base, some, spec.seed), len(some) * limit_s)

    def there(some: tuple[Case, ...]) -> bool:
        nonlocal before
        if _kept(store, some, digest, final=True) is None:
            return False
        before += len(some)
        return True

    def run(tasks: Iterator[Task]) -> None:
        nonlocal done
        for task, result in run_tasks(processes, tasks):
            some, lost = task.arguments[1], isinstance(result, Failure)
            if lost and len(some) > 1:
                apart.extend(some)
                continue
            if isinstance(result, Failure):
                result = [CaseResult(some[0].number, {}, sentence_of(result, task, "case"), 0.0)]
            told = {"digest": digest, "lost": lost, "results": [asdict(one) for one in result]}
            write_atomically(_file(store, some), json.dumps(told) + "\n")
            done += len(some)
            progress(before + done, spec.cases)

    progress(0, spec.cases)
    run(task(bundle) for bundle in _bundles(spec) if not there(bundle))
    run(task((case,)) for case in apart if not there((case,)))
    progress(spec.cases, spec.cases)
    return before


def _numeric(spec: SweepSpec, name: str) -> bool:
    values = dict(spec.grid).get(name, (0.0,))
    return all(isinstance(value, float) for value in values)


def _measured(store: Store, spec: SweepSpec) -> tuple[str, ...]:
    """Names of all that was measured in any case; those asked for come first."""
    found = dict.fromkeys(
        name for _, one in _results(store, spec) if one is not None for name in one.measures
    )
    unknown = next((name for name in spec.measures if found and name not in found), None)
    if unknown is not None:
        raise BadInputError(
            f"measure: {one_line(unknown)} was not measured, expected some of {', '.join(found)}"
        )
    return spec.measures or tuple(found)


def _table(store: Store, spec: SweepSpec, measures: tuple[str, ...], times: list[tuple[int, float]]) -> Any:
    """All cases as an Arrow table; `times` takes what each has taken."""
    import pyarrow as pa

    fields = [pa.field(name, pa.int64()) for name in ("case", "point", "draw")]
    fields += [pa.field(name, pa.float64() if _numeric(spec, name) else pa.string()) for name in spec.names]
    fields += [pa.field(name, pa.float64()) for name in measures]
    schema = pa.schema([*fields, pa.field("sentence", pa.string())])

    def rows() -> Iterator[dict[str, Any]]:
        for case, one in _results(store, spec):
            values = {name: value if _numeric(spec, name) else str(value) for name, value in case.values}
            row = {"case": case.number, "point": case.point, "draw": case.draw, **values}
            if one is None:
                yield {**row, "sentence": "was not run"}
            else:
                times.append((case.number, one.seconds))
                yield {**row, **one.measures, "sentence": one_line(one.sentence)}

    left, batches = rows(), []
    while block := list(islice(left, _BLOCK)):
        batches.append(pa.RecordBatch.from_pylist(block, schema=schema))
    return pa.Table.from_batches(batches, schema)


def summarise_sweep(store: Store, spec: SweepSpec, as_before: int) -> SweepSummary:
    """Write sweep.parquet and the timings, and return the summary.

    Raises `BadInputError` for a measure that there is not.
    """
    measures, times = _measured(store, spec), list[tuple[int, float]]()
    table = _table(store, spec, measures, times)
    write_table(store.out / "sweep.parquet", table)
    write_timings(store.out, "case,seconds", times)
    failed = [sentence for sentence in texts(table, "sentence") if sentence]
    deciding = measures[0] if measures else ""
    y = column(table, deciding)
    points = _points(table, spec, y, measures)
    ranked = sorted((p for p in points if math.isfinite(p.loss)), key=lambda p: p.loss)
    clouds = tuple((name, _cloud(column(table, name), y)) for name in spec.names if _numeric(spec, name))
    why = failed[0] if failed else ""
    best, worst = tuple(ranked[:_MOST_SHOWN]), tuple(reversed(ranked[_MOST_SHOWN:][-_MOST_SHOWN:]))
    return SweepSummary(spec.cases, len(failed), as_before, why, deciding, measures, best, worst, clouds)


def _points(table: Any, spec: SweepSpec, y: FloatArray, measures: tuple[str, ...]) -> list[Point]:
    """Points of the grid; the draws themselves where there is no grid."""
    by_point = bool(spec.grid)
    group = column(table, "point" if by_point else "case").astype(np.int64)
    others = {name: column(table, name) for name in measures}
    listed: dict[str, Any] = {
        name: column(table, name) if _numeric(spec, name) else texts(table, name) for name in spec.names
    }
    shown = [name for name, _ in spec.grid] if by_point else list(spec.names)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    loss = y if spec.near is None else np.abs(y - spec.near)
    out = []
    for first, rows in zip(starts.tolist(), np.split(order, starts[1:]), strict=True):
        i = int(order[first])
        medians = tuple((name, _median(values[rows])) for name, values in others.items())
        values = tuple((name, listed[name][i]) for name in shown)
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
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(known) > _MOST_POINTS:
        known = np.random.default_rng(0).choice(known, _MOST_POINTS, replace=False)
    return tuple((float(x[i]), float(y[i])) for i in np.sort(known))
