"""What the scenarios have in common: their interface, and small helpers."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from calib.actuator.integrate import RigState, rig_at_rest
from calib.arrays import FloatArray
from calib.twin.rig import SimulatedRig
from calib.twin.simulate import Run

__all__ = ["UNSET", "Figures", "Scenario", "at_rest", "elongation_mm", "or_none", "tick_times"]

UNSET = float("nan")
"""Default of a number that then follows from something else."""

Figures = dict[str, float | None]
"""Figures of a run by name; None for what did not happen."""


class Scenario(Protocol):
    """An experiment: its length unless told otherwise, how it is run, and figures of the result."""

    @property
    def duration_s(self) -> float: ...

    def run(self, rig: SimulatedRig, ticks: int, seed: int, feedback: str) -> Run: ...

    def figures(self, run: Run) -> Figures: ...


def or_none(value: float) -> float | None:
    """A number, or None for `UNSET`."""
    return None if value != value else value


def at_rest(rig: SimulatedRig) -> RigState:
    """The rig at rest, straight, with the pumps off."""
    return rig_at_rest(rig.plant, rig.pump)


def tick_times(rig: SimulatedRig, ticks: int) -> FloatArray:
    """Times of the ticks (n,) [s]."""
    return rig.pump.tick_s * np.arange(ticks, dtype=np.float64)


def elongation_mm(run: Run) -> FloatArray:
    """Length of the backbone beyond the rest length (n,) [mm] at the ticks."""
    return np.asarray(1e3 * (run.states[:, :2].mean(axis=1) - run.plant.rest_length_m))
