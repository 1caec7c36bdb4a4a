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
from calib.stages.estimator.consistency import Tally
from calib.stages.estimator.driven import Drive, Handover, blended, smooth_both
from calib.stages.estimator.kinematic import Rows, Setup
from calib.stages.estimator.sensors import SIZE, accelerometer, marker, view_coefficients
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log


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
        strength=(float(strength[0]), float(strength[1])),
    )


@cache
def driven_log(name: str, seed: int = 0, orifice: bool = False) -> tuple[SimulatedRig, Log]:
    """A rig and its log of a scenario of `estimatorlogs.SCENARIOS`."""
    rig = varied_drive(seed)
    if orifice:
        rig = replace(rig, pump=replace(rig.pump, deflation=Orifice()))
    kind, duration = SCENARIOS[name]
    return rig, run_log(run_scenario(make_scenario(kind), rig, seed, "sensors", duration))


def estimated(setup: Setup, drive: Drive, log: Log) -> tuple[dict[str, FloatArray], FloatArray]:
    """Rows of `OUT` by each estimator, and the weight (n,) that the handover gives the driven model."""
    rows = rows_from(log)
    driven, kinematic, weight = Handover(setup, drive).run_each(rows)
    return {
        "kinematic": kinematic,
        "driven": driven,
        "handover": blended(driven, kinematic, weight),
        "smoothed": smooth_both(setup, drive, rows, driven, kinematic),
    }, weight


def errors_of(setup: Setup, out: FloatArray, log: Log) -> dict[str, float]:
    """Errors of an estimator after two seconds, as `Tally.rmse` names them."""
    tally = Tally(setup.bellows_radius_m)
    tally.add(out, truth(log))
    return tally.rmse()


def held_log(seed: int, held_s: float) -> tuple[SimulatedRig, Rows, FloatArray]:
    """A rig whose head is held at 0.5 rad and let go at a time: rows, true q1, q2, phi."""
    rig, log = driven_log("swing", seed)
    rows, true, rng = rows_from(log), truth(log), np.random.default_rng(seed)
    state, spare = np.zeros(SIZE), (np.empty(SIZE), np.empty(SIZE))
    state[6:] = truth_of_sensors(rig)
    state[0], state[1], state[13] = true[0, 2], true[0, :2].mean(), 0.0
    view = rig.view
    seen = marker(view_coefficients(view.camera, view.R_CW, view.t_CW_m), state, *spare)
    felt = (*accelerometer(state, *spare), state[6])
    camera_s, imu_s = np.arange(0.0, held_s, 1.0 / 60.0), np.arange(0.0003, held_s, 1.0 / rig.imu.rate_hz)
    readings = np.full((len(camera_s) + len(imu_s), 5), np.nan)
    readings[: len(camera_s), :2] = np.round(seen + rng.normal(0.0, NOISE[0], (len(camera_s), 2)))
    readings[len(camera_s) :, 2:] = felt + NOISE[2:5] * rng.standard_normal((len(imu_s), 3))
    t, kinds = np.concatenate([camera_s, imu_s]), np.repeat([1, 2], [len(camera_s), len(imu_s)])
    order = np.argsort(t, kind="stable")
    pwm = np.where(kinds[order, None] == 1, 0.0, np.nan) * np.ones(2)
    held = Rows(t[order], readings[order], kinds[order], pwm=pwm)
    whole = Rows.joined([held, replace(rows, t_s=rows.t_s + held_s)])
    return rig, whole, np.concatenate([np.tile(true[0], (len(t), 1)), true])


def hostile(seed: int, rows: Rows) -> Rows:
    """A short piece of a log (120 to 300 rows) on which up to four things go wrong at random."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(120, 301))
    at = int(rng.integers(0, max(len(rows) - n, 1)))
    part = rows[at : at + n]
    t, z, kinds, pwm = (of.copy() for of in (part.t_s, part.readings, part.kinds, part.pwm))
    n = len(t)
    for fault in rng.choice(8, int(rng.integers(1, 5)), replace=False):
        begin, end = np.sort(rng.integers(0, n + 1, 2))
        some = slice(begin, end)
        if fault == 0:
            t[begin:] += 10.0
        elif fault <= 2:
            z[some, slice(0, 2) if fault == 1 else slice(2, 5)] = np.nan
        elif fault == 3:
            wild = np.column_stack([rng.uniform(-50.0, 400.0, (n, 2)), 60.0 * rng.standard_normal((n, 3))])
            z = np.where((rng.random((n, 5)) < 0.05) & np.isfinite(z), wild, z)
        elif fault == 4:
            z[some, 2:] = np.clip(z[some, 2:], -2.0, 2.0)
        elif fault == 5:
            pwm[some] = np.nan
        elif fault == 6:
            pwm[some] = np.where(np.isfinite(pwm[some]), rng.choice([0.0, 255.0], 2), np.nan)
        elif end > begin:
            z[some] = np.where(np.isfinite(z[some]), z[begin], np.nan)
    seen, felt = np.isfinite(z[:, :2]).all(axis=1), np.isfinite(z[:, 2:]).any(axis=1)
    return Rows(t, z, np.where(seen, kinds & 1, 0) + np.where(felt, kinds & 2, 0), pwm=pwm)


def unsound(out: FloatArray) -> str:
    """What no rig does in rows of `OUT`: nothing, "NaN" or "1.23 m/s"."""
    started = np.isfinite(out[:, 5])
    if not np.isfinite(out[started, 1:13]).all() or not (out[started, 10:13] > 0.0).all():
        return "NaN"
    fastest = float(np.abs(out[started, 3:5]).max(initial=0.0))
    return f"{fastest:.2f} m/s" if fastest > 1.0 else ""
