"""Runs of the simulated rig that claims are computed from, each done once."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache
from typing import Any

from calib.stages.actuator.parameters import PRINTED_CREEP, Creep, Plant, UnstablePlantWarning
from calib.stages.actuator.pump import Pump, RateLimit
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import Figures, make_scenario, run_scenario
from calib.twin.simulate import Run

__all__ = [
    "PRINTED_C_DMP",
    "PRINTED_C_SPR",
    "PRINTED_K_BND",
    "PRINTED_RATE",
    "first_model",
    "nominal",
    "printed_plant",
    "tried",
    "with_plant",
    "with_pump",
]

PRINTED_C_SPR, PRINTED_C_DMP, PRINTED_K_BND = 0.9102, 1.0369, 169.49
"""Table 3.2."""

PRINTED_RATE = 2.0
"""Limit of the falling force in 3.5 [N/s], a magnitude."""


@lru_cache(maxsize=1)
def nominal() -> SimulatedRig:
    """The rig with its nominal parameters."""
    return SimulatedRig()


def tried(
    name: str, duration_s: float | None = None, rig: SimulatedRig | None = None, seed: int = 0, **options: str
) -> tuple[Run, Figures]:
    """A scenario run with true feedback, and its figures."""
    if rig is not None:
        return _run(name, duration_s, rig, seed, options)
    return _kept(name, duration_s, seed, tuple(sorted(options.items())))


@lru_cache(maxsize=32)
def _kept(
    name: str, duration_s: float | None, seed: int, options: tuple[tuple[str, str], ...]
) -> tuple[Run, Figures]:
    return _run(name, duration_s, nominal(), seed, dict(options))


def _run(
    name: str, duration_s: float | None, rig: SimulatedRig, seed: int, options: dict[str, str]
) -> tuple[Run, Figures]:
    scenario = make_scenario(name, options)
    run = run_scenario(scenario, rig, seed, "truth", duration_s)
    return run, scenario.figures(run)


def with_plant(**changes: Any) -> SimulatedRig:
    """The nominal rig with some parameters of its plant changed."""
    return replace(nominal(), plant=replace(nominal().plant, **changes))


def with_pump(falling_N_per_s: float) -> SimulatedRig:
    """The nominal rig with another limit of the falling force."""
    return replace(nominal(), pump=Pump(deflation=RateLimit(falling_N_per_s)))


def first_model() -> SimulatedRig:
    """The rig as the source first modelled it (3.3): no bending, no creep, damping as in (3.41)."""
    rig = with_plant(creep=None, bending_N_per_rad2=0.0, damping_scale=1.0)
    return replace(rig, free_damping_scale=1.0)


def printed_plant(k_bnd_N: float = 1e-3 * PRINTED_K_BND) -> Plant:
    """The plant with all of Table 3.2, which leaves rest by itself; the spring's sign is corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstablePlantWarning)
        return Plant(
            stiffness_scale=PRINTED_C_SPR,
            damping_scale=PRINTED_C_DMP,
            bending_N_per_rad2=k_bnd_N,
            creep=Creep(*PRINTED_CREEP),
            allow_unstable=True,
        )
