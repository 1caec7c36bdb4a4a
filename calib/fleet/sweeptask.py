"""Cases of a sweep, as they go to a process: functions of the specification and their numbers alone.

This module runs the twin on purpose: the plant is the base rig with a case's parameters, while controllers
and filters know the base rig, but for gains and noise that are parameters themselves.
"""

from __future__ import annotations

import copy
import math
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from calib.control.measures import Tracking
from calib.controlling import control_model, run_controller
from calib.errors import BadInputError, CalibError
from calib.fleet.sweepspec import Base, Case
from calib.rig import Rig, validation_sentence
from calib.sections import camera_from_section
from calib.twin.rig import SimulatedRig, rig_from_file

__all__ = ["CaseResult", "run_case", "run_cases"]

_PLANT = ("actuator", "pump", "twin")
_HERE = Path("the sweep")


@dataclass(frozen=True)
class CaseResult:
    """What was measured in a case; `sentence` says why nothing was."""

    number: int
    measures: dict[str, float | None]
    sentence: str
    seconds: float


def run_cases(base: Base, cases: tuple[Case, ...], seed: int, scratch: str = "") -> list[CaseResult]:
    """Run some cases one after the other; every failure is a result, none an exception."""
    out = []
    for case in cases:
        began, measures, sentence = time.perf_counter(), dict[str, float | None](), ""
        try:
            measures = run_case(base, case, seed, scratch)
        except CalibError as error:
            sentence = str(error)
        except Exception as error:
            sentence = f"internal error: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        out.append(CaseResult(case.number, measures, sentence, round(time.perf_counter() - began, 4)))
    return out


def run_case(base: Base, case: Case, seed: int, scratch: str = "") -> dict[str, float | None]:
    """What is measured in one case, by name; None for what did not happen.

    Raises `BadInputError` for parameters that the plant, the controller or the filter cannot have.
    """
    # The same noise for a draw wherever it is in the grid: differences are then those of the parameters.
    noise = 100_003 * seed + case.draw
    changed, options = _changed(case)
    known = _rig(_known(base.rig, changed))
    plant = _machine(_rig(_document(base.rig, changed)))
    if base.kind == "controller":
        return _controlled(base, known, plant, noise)
    from calib.twin.scenarios import make_scenario, run_scenario

    plan = make_scenario(base.name if base.kind == "scenario" else base.other, options)
    run = run_scenario(plan, plant, noise, base.feedback, base.duration_s)
    if base.kind == "scenario":
        return {name: _or_none(value) for name, value in plan.figures(run).items()}
    return _filtered(base, known, run, scratch)


def _changed(case: Case) -> tuple[dict[str, Any], dict[str, str]]:
    """Changes to rig.yaml by their paths, and options of the scenario as they would be typed."""
    changed, options = dict[str, Any](), dict[str, str]()
    for key, value in case.values:
        section, _, rest = key.partition(".")
        if section == "scenario":
            options[rest] = str(value).lower() if isinstance(value, bool) else _typed(value)
        else:
            changed[key] = value
    return changed, options


def _typed(value: float | str) -> str:
    return value if isinstance(value, str) else repr(int(value) if value == int(value) else value)


@lru_cache(maxsize=4)
def _parsed(text: str) -> dict[str, Any]:
    found = yaml.safe_load(text) if text else {}
    return found if isinstance(found, dict) else {}


def _document(text: str, changed: Mapping[str, Any]) -> dict[str, Any]:
    """The base rig's file with these changes."""
    whole = copy.deepcopy(_parsed(text))
    for key, value in changed.items():
        *path, last = key.split(".")
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


def _rig(document: dict[str, Any]) -> Rig:
    try:
        return Rig.model_validate(document)
    except ValidationError as error:
        raise BadInputError(validation_sentence(_HERE, error)) from error


def _machine(rig: Rig) -> SimulatedRig:
    camera = None if rig.camera is None else camera_from_section(rig.camera)
    return rig_from_file(rig, str(_HERE), camera)


def _controlled(base: Base, known: Rig, plant: SimulatedRig, seed: int) -> dict[str, float | None]:
    from calib.control.references import built_in

    model = control_model(_machine(known), known.controller)
    reference = built_in(model, base.other, base.duration_s)
    outcome = run_controller(base.name, plant, model, reference, known.controller, seed, base.feedback)
    return _of_tracking(outcome.figures)


def _of_tracking(figures: Tracking) -> dict[str, float | None]:
    """The measures of `calib.control.measures`, pairs as two."""
    out: dict[str, float | None] = {}
    for name, value in asdict(figures).items():
        if isinstance(value, tuple):
            out |= {f"{name}_{i}": _or_none(part) for i, part in enumerate(value, start=1)}
        else:
            out[name] = _or_none(value)
    return out


def _filtered(base: Base, known: Rig, run: Any, scratch: str) -> dict[str, float | None]:
    from calib.logs import write_log
    from calib.replay import replay_log
    from calib.twin.simulate import log_of

    with tempfile.TemporaryDirectory(prefix="case-", dir=scratch or None) as place:
        path = Path(place) / "log.csv"
        write_log(path, log_of(run, "log"))
        replayed = replay_log(path, known, _HERE, base.name, model=base.model)
    out = {name: _or_none(value) for name, value in replayed.rmse.items()}
    for other, errors in replayed.others.items():
        out |= {f"{other}_{name}": _or_none(value) for name, value in errors.items()}
    for sensor, check in replayed.sensors.items():
        out[f"nis_{sensor}"] = _or_none(check.get("nis"))
    return out


def _or_none(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
