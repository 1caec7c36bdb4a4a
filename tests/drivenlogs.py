"""Logs of rigs that differ in all that the driven model thinks uncertain, and of a law it does not know."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from estimatorlogs import SCENARIOS, varied

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.parameters import Creep
from calib.stages.actuator.pump import Orifice, RateLimit
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import log_of


def varied_drive(seed: int, share: float = 0.08) -> SimulatedRig:
    """A rig whose plant and pumps are off by up to a share; seed 0 is nominal."""
    rig, nominal = varied(seed), SimulatedRig()
    if seed == 0:
        return rig
    rng = np.random.default_rng(5000 + seed)
    f = rng.uniform(1.0 - share, 1.0 + share, 9)
    strength = rng.uniform(1.0 - 0.5 * share, 1.0 + 0.5 * share, 2)
    plant = replace(
        nominal.plant,
        stiffness_scale=f[0],
        damping_scale=nominal.plant.damping_scale * f[1],
        bending_N_per_rad2=nominal.plant.bending_N_per_rad2 * f[2],
        mass_kg=nominal.plant.mass_kg * f[3],
        creep=Creep(3.0 * f[4], 10.0 * f[8]),
        rest_length_m=nominal.plant.rest_length_m + float(rng.uniform(-5e-4, 5e-4)),
    )
    pump = replace(nominal.pump, lag_s=0.7 * f[5], deflation=RateLimit(0.4 * f[6]))
    return replace(
        rig,
        plant=plant,
        pump=pump,
        free_damping_scale=nominal.free_damping_scale * f[7],
        pump_strength=(float(strength[0]), float(strength[1])),
    )


@cache
def driven_log(name: str, seed: int = 0, orifice: bool = False) -> tuple[SimulatedRig, Log]:
    """A rig and its log of a scenario of `estimatorlogs.SCENARIOS`."""
    rig = varied_drive(seed)
    if orifice:
        rig = replace(rig, pump=replace(rig.pump, deflation=Orifice()))
    kind, duration = SCENARIOS[name]
    return rig, log_of(run_scenario(make_scenario(kind), rig, seed, "sensors", duration))


def commands_of(log: Log) -> FloatArray:
    """Commands (n, 2) of a log."""
    return np.stack([log.columns["pwm1"], log.columns["pwm2"]], axis=1)
