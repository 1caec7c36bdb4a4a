"""Simulated rigs, and runs of them that claims and figures share; each run is done once.

A rig is named by the function that makes it, so that runs can be remembered by it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

from source_model import PRINTED_CREEP, PolynomialForce

from calib.core.arrays import BoolArray, FloatArray
from calib.stages.actuator.parameters import Creep, Plant, UnstablePlantWarning
from calib.stages.actuator.pump import Orifice, RateLimit
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import Figures, make_scenario, run_scenario
from calib.twin.simulate import Run

PRINTED_C_SPR, PRINTED_C_DMP, PRINTED_K_BND = 0.9102, 1.0369, 169.49
"""Table 3.2."""

PRINTED_RATE = 2.0
"""Limit of the falling force in 3.5 [N/s], a magnitude."""

Values = dict[str, float | str]
"""What a claim or a figure comes to, by name; units stand in the names."""

RigMaker = Callable[[], SimulatedRig]
Function = TypeVar("Function", bound=Callable[..., Any])
_remembered: list[Callable[[], None]] = []
_nominal = SimulatedRig()


def once(function: Function) -> Function:
    """`function`, computed once for each set of arguments until another rig is put in place."""
    kept = cache(function)
    _remembered.append(kept.cache_clear)
    return kept  # type: ignore[return-value]  # a cached function is called alike


def use(rig: SimulatedRig) -> None:
    """Put another rig in place of the nominal one, and forget all runs."""
    global _nominal  # noqa: PLW0603  the one rig that all runs are of
    _nominal = rig
    for forget in _remembered:
        forget()


def nominal() -> SimulatedRig:
    """The rig with its nominal parameters."""
    return _nominal


def with_plant(**changes: Any) -> SimulatedRig:
    """The nominal rig with some parameters of its plant changed."""
    return replace(nominal(), plant=replace(nominal().plant, **changes))


def first_model() -> SimulatedRig:
    """The rig as the source first modelled it (3.3): no bending, no creep, damping as in (3.41)."""
    rig = with_plant(creep=None, bending_N_per_rad2=0.0, damping_scale=1.0)
    return replace(rig, free_damping_scale=1.0)


def without_creep() -> SimulatedRig:
    """The nominal rig without creep."""
    return with_plant(creep=None)


def printed_damping() -> SimulatedRig:
    """The nominal rig with c_dmp of Table 3.2."""
    return with_plant(damping_scale=PRINTED_C_DMP)


def printed_rate() -> SimulatedRig:
    """The nominal rig with the limit of the falling force of 3.5."""
    return replace(nominal(), pump=replace(nominal().pump, deflation=RateLimit(PRINTED_RATE)))


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


def printed_table() -> SimulatedRig:
    """The nominal rig with the plant of Table 3.2."""
    return replace(nominal(), plant=printed_plant())


def _printed_pump(k_bnd_N: float) -> SimulatedRig:
    rig = printed_rate()
    return replace(rig, plant=printed_plant(k_bnd_N), pump=replace(rig.pump, static=PolynomialForce()))


def printed_in_millinewton() -> SimulatedRig:
    """All of Table 3.2 and 3.5, the bending stiffness in mN."""
    return _printed_pump(1e-3 * PRINTED_K_BND)


def printed_in_newton() -> SimulatedRig:
    """All of Table 3.2 and 3.5, the bending stiffness in N as its printed unit says."""
    return _printed_pump(PRINTED_K_BND)


def other_rig() -> SimulatedRig:
    """A rig that no model was made for: softer, bending and creeping more, its pumps not alike."""
    rig = with_plant(
        stiffness_scale=0.93, bending_N_per_rad2=0.21, creep=Creep(3.6, 12.0, -1.0), damping_scale=17.5
    )
    return replace(rig, free_damping_scale=3.0, strength=(1.0, 0.96))


def unlike_rig() -> SimulatedRig:
    """The nominal rig with pumps that are not alike, as the source's two bellows differ."""
    return replace(nominal(), strength=(1.02, 0.97))


def leaking_rig() -> SimulatedRig:
    """The nominal rig, its air leaving through an orifice."""
    return replace(nominal(), pump=replace(nominal().pump, deflation=Orifice()))


@once
def scored(
    name: str,
    duration_s: float | None = None,
    rig: RigMaker = nominal,
    seed: int = 0,
    feedback: str = "truth",
    **options: str,
) -> tuple[Run, Figures]:
    """A scenario's run and its figures."""
    scenario = make_scenario(name, options)
    run = run_scenario(scenario, rig(), seed, feedback, duration_s)
    return run, scenario.figures(run)


def tried(*where: Any, **options: Any) -> Run:
    """The run of `scored`."""
    return scored(*where, **options)[0]


def figure(key: str, *where: Any, **options: Any) -> float:
    """A figure of `scored`, NaN for what did not happen."""
    value = scored(*where, **options)[1][key]
    return math.nan if value is None else value


def seen(run: Run) -> FloatArray:
    """Angle [rad] and both lengths [m] (n, 3) that the controller got."""
    assert run.seen is not None
    return run.seen


def lengths_m(run: Run) -> FloatArray:
    """True lengths (n, 2) [m] of the bellows at the ticks."""
    return run.states[:, :2]


def angles_rad(run: Run, t_s: FloatArray) -> FloatArray:
    """True angles (n,) [rad] at times (n,) [s]."""
    q = run.trajectory.at(t_s)[:, :2]
    return (q[:, 0] - q[:, 1]) / (2.0 * run.plant.bellows_radius_m)


def first_time_s(run: Run, holds: BoolArray) -> float:
    """Time [s] of the first tick at which a condition (n,) holds; raises `ValueError` where it never does."""
    return float(holds.tolist().index(True) * run.tick_s)


def share_of_way_s(run: Run, elongation_mm: FloatArray, share: float) -> float:
    """Time [s] at which an elongation (n,) first exceeds a share of its last value."""
    return first_time_s(run, elongation_mm > share * elongation_mm[-1])
