"""Logs of rigs that differ in all that the driven model thinks uncertain, and of a law it does not know."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from estimatorlogs import NOISE, SCENARIOS, rows_from, truth, truth_of_sensors, varied

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.parameters import Creep
from calib.stages.actuator.pump import Orifice, RateLimit
from calib.stages.estimator.kinematic import Rows
from calib.stages.estimator.sensors import SIZE, accelerometer, marker, view_coefficients
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


def held_log(seed: int, held_s: float) -> tuple[SimulatedRig, Rows, FloatArray, FloatArray]:
    """A rig whose head is held at 0.5 rad and let go at a time: rows, commands (n, 2), true q1, q2, phi."""
    rig, log = driven_log("swing", seed)
    rows, true, rng = rows_from(log), truth(log), np.random.default_rng(seed)
    state, spare = np.zeros(SIZE), (np.empty(SIZE), np.empty(SIZE))
    state[6:] = truth_of_sensors(rig)
    state[0], state[1], state[13] = true[0, 2], true[0, :2].mean(), 0.0
    view = rig.view
    seen = marker(view_coefficients(view.camera, view.R_CW, view.t_CW_m), state, *spare)
    felt = (*accelerometer(9.81, 0.0, state, *spare), state[6])
    camera_s, imu_s = np.arange(0.0, held_s, 1.0 / 60.0), np.arange(0.0003, held_s, 1.0 / rig.imu.rate_hz)
    readings = np.full((len(camera_s) + len(imu_s), 5), np.nan)
    readings[: len(camera_s), :2] = np.round(seen + rng.normal(0.0, NOISE[0], (len(camera_s), 2)))
    readings[len(camera_s) :, 2:] = felt + NOISE[2:5] * rng.standard_normal((len(imu_s), 3))
    t, kinds = np.concatenate([camera_s, imu_s]), np.repeat([1, 2], [len(camera_s), len(imu_s)])
    order = np.argsort(t, kind="stable")
    pwm = np.where(kinds[order, None] == 1, 0.0, np.nan) * np.ones(2)
    whole = Rows(
        np.concatenate([t[order], rows.t_s + held_s]),
        np.concatenate([readings[order], rows.readings]),
        np.concatenate([kinds[order], rows.kinds]),
    )
    return (
        rig,
        whole,
        np.concatenate([pwm, commands_of(log)]),
        np.concatenate([np.tile(true[0], (len(t), 1)), true]),
    )
