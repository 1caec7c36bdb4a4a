"""The experiments of the source on the simulated rig, by name.

Open loop: `static`, `swing` (3.3), `steps` (Fig. 2.12), `deflate` (Fig. 3.24), `chirp` and `prbs` for
identification. Closed loop at 60 Hz: `orientation` (4.1), `elongation` (4.7), `ellipse` (4.9).

With the nominal plant and `feedback="truth"` they give (thesis in brackets)

    swing from 0.5 rad       damping ratio 0.055 (0.0513), 4.0 Hz, offset 41 -> 6 mrad after 1 s
    steady elongation        1.88 / 11.11 / 21.73 / 26.56 mm at 6 / 8 / 10 / 12 V (26 mm at 12 V)
    deflation                5.05 s to 5 % (about 5 s)
    PID to 0.7 rad           reached at 0.91 s (0.95), peak 0.742 rad (0.7288), settled at 2.4 s (2.3)
    P 500/1000/2000/5000     at most 0.375 / 0.535 / 0.630 / 0.699 rad (0.7 is never reached)
    PD + feed-forward, 4.7   error at most 2.00 mm (2.149), static -0.23 mm (about -0.3)
    anti-windup on a jump    overshoot halved (almost none)

What the model does not reproduce: the wobble of the ellipse at 4 - 5 s and its poor second half
(Figs. 4.14 - 4.18), the overshoot that the source's own simulation has after deflation (Fig. 3.24), an
anti-windup without overshoot (Fig. 4.7), and, while both pumps are alike (see `pump_strength`), the
different lengths of the two bellows in Figs. 4.12 and 4.13.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from calib.errors import BadInputError, UsageError
from calib.twin.closed_loop import EllipseTrack, Elongation, Orientation
from calib.twin.experiment import Scenario
from calib.twin.open_loop import Chirp, Deflate, Prbs, Static, Steps, SwingRelease
from calib.twin.rig import SimulatedRig
from calib.twin.simulate import Run

__all__ = ["SCENARIOS", "make_scenario", "run_scenario"]

SCENARIOS: dict[str, type[Any]] = {
    "static": Static,
    "swing": SwingRelease,
    "steps": Steps,
    "deflate": Deflate,
    "orientation": Orientation,
    "elongation": Elongation,
    "ellipse": EllipseTrack,
    "chirp": Chirp,
    "prbs": Prbs,
}
"""What `make_scenario` knows; `rig`, a folder with all of them, is in `calib.twin.rig_folder`."""


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _value(name: str, text: str, default: object) -> object:
    """An option's text as a value of the default's kind."""
    try:
        if isinstance(default, bool):
            return {"true": True, "yes": True, "false": False, "no": False}[text.strip().lower()]
        if isinstance(default, tuple):
            return tuple(_finite(part) for part in text.split(","))
        if isinstance(default, int):
            return int(text)
        if isinstance(default, float):
            return _finite(text)
    except (KeyError, ValueError):
        kinds = {bool: "true or false", tuple: "numbers separated by commas", int: "a whole number"}
        kind = kinds.get(type(default), "a number")
        raise UsageError(f"{name}: {text!r} is not {kind}") from None
    return text


def make_scenario(name: str, options: Mapping[str, str] | None = None) -> Scenario:
    """A scenario by name, with options as they are typed, such as `{"Kp": "500"}`.

    Raises `UsageError` for a name, an option or a value that is not known, `BadInputError` for one
    that the scenario cannot run with.
    """
    if name not in SCENARIOS:
        raise UsageError(f"SCENARIO: {name!r} is not one of {', '.join([*SCENARIOS, 'rig'])}")
    kind = SCENARIOS[name]
    defaults = {f.name: f.default for f in fields(kind)}
    values = {}
    for key, text in (options or {}).items():
        if key not in defaults or key == "duration_s":
            known = ", ".join(k for k in defaults if k != "duration_s")
            raise UsageError(f"{key}: is no option of the scenario {name}, expected one of {known}")
        values[key] = _value(key, text, defaults[key])
    scenario: Scenario = kind(**values)
    return scenario


def run_scenario(
    scenario: Scenario,
    rig: SimulatedRig,
    seed: int = 0,
    feedback: str = "sensors",
    duration_s: float | None = None,
) -> Run:
    """Run a scenario on a rig for its own duration or for `duration_s` [s]; the same seed, the same run.

    Raises `BadInputError` as `simulate`, and for a duration that is not a number.
    """
    duration = scenario.duration_s if duration_s is None else duration_s
    if not math.isfinite(duration):
        raise BadInputError(f"duration: found {duration}, expected a time")
    return scenario.run(rig, round(duration / rig.pump.tick_s), seed, feedback)
