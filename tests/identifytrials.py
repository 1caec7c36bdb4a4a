"""Tracks for tests of the identification: from the plant's own integrator, and from the simulated rig."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import firmware_rigs
import numpy as np
from open_loop import simulate

from calib.core.rig import Rig
from calib.io.logs import write_log
from calib.stages.actuator.identify import Track, made, values_of
from calib.stages.actuator.identify_pump import PumpRecord, simulate_pump
from calib.stages.actuator.machine import Machine
from calib.stages.actuator.parameters import TICK_S, Creep
from calib.stages.actuator.pump import RateLimit
from calib.stages.actuator.simulate import rig_at_rest
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import run_log

SIGMA = (0.004, 0.0003)
"""Noise of angle [rad] and length [m] in tracks from the integrator."""


def pwm_of(kind: str, n: int) -> np.ndarray:
    """Commands of a kind of experiment."""
    t = TICK_S * np.arange(n)
    if kind == "free":
        return np.zeros((n, 2))
    if kind == "steps":
        return np.repeat(np.where((t % 4.0) < 2.0, 200.0, 0.0)[:, None], 2, axis=1)
    bits = np.random.default_rng(5).random((n // 30 + 1, 2)) < 0.5
    return np.repeat(np.where(bits, 110.0, 230.0), 30, axis=0)[:n]


def track(
    kind: str,
    values: dict[str, float] | None = None,
    phi_rad: float = 0.5,
    duration_s: float = 4.0,
    noise: float = 1.0,
    seed: int = 0,
    delay_s: float = 0.025,
    nominal: Machine | None = None,
) -> Track:
    """A track from `open_loop.simulate` with steps of its own: "free", "steps" or "prbs"."""
    nominal = nominal or Machine()
    n = round(duration_s / TICK_S)
    plant, pump = made(nominal, {**values_of(nominal), **(values or {})}, kind != "free", TICK_S)
    start = rig_at_rest(plant, pump, phi_rad if kind == "free" else 0.0)
    every = 2
    motion = simulate(plant, pump, pwm_of(kind, n), start, substeps=20, every=every)
    r = plant.bellows_radius_m
    q = motion.q_m
    head = np.stack([(q[:, 0] - q[:, 1]) / (2.0 * r), 0.5 * (q[:, 0] + q[:, 1])], axis=1)
    t = TICK_S * np.arange(n)
    exposed = np.maximum(t - delay_s, 0.0)
    seen = np.stack([np.interp(exposed, motion.t_s, head[:, k]) for k in range(2)], axis=1)
    rng = np.random.default_rng(100 + seed)
    seen += noise * np.array(SIGMA) * rng.standard_normal(seen.shape)
    W = np.broadcast_to(np.diag(1.0 / np.array(SIGMA)), (n, 2, 2)).copy()
    return Track(kind, TICK_S, pwm_of(kind, n), kind != "free", t, seen, W)


def varied(seed: int) -> tuple[SimulatedRig, dict[str, float]]:
    """A rig whose parameters differ from the nominal ones by up to a fifth, and the true values."""
    rng = np.random.default_rng(seed)
    f = np.exp(rng.uniform(-0.2, 0.2, 8)).tolist()
    strength = (float(rng.uniform(0.92, 1.08)), float(rng.uniform(0.92, 1.08)))
    truth = {
        "stiffness_scale": f[0],
        "damping_scale_pumps_connected": 16.0 * f[1],
        "bending_N_per_rad2": 0.1695 * f[2],
        "lambda1_per_s": 3.0 * f[3],
        "lambda2_N_per_m": 10.0 * f[4],
        "lag_s": 0.7 * f[5],
        "falling_N_per_s": 0.4 * f[6],
        "damping_scale_free_swing": 3.3 * f[7],
        "strength1": strength[0],
        "strength2": strength[1],
    }
    late_s = float(rng.uniform(0.015, 0.035))
    truth["rest_length_m"] = 0.065 + 5e-4 * float(rng.standard_normal())
    rig = SimulatedRig()
    truth["lag_ratio"] = float(rng.uniform(0.85, 1.15))
    truth["inertia_kgm2"] = rig.plant.inertia_kgm2 * float(rng.uniform(0.92, 1.08))
    plant = replace(
        rig.plant,
        inertia_kgm2=truth["inertia_kgm2"],
        rest_length_m=truth["rest_length_m"],
        stiffness_scale=truth["stiffness_scale"],
        damping_scale=truth["damping_scale_pumps_connected"],
        bending_N_per_rad2=truth["bending_N_per_rad2"],
        creep=Creep(truth["lambda1_per_s"], truth["lambda2_N_per_m"], -1.0),
    )
    pump = replace(
        rig.pump,
        lag_s=truth["lag_s"],
        lag_ratio=truth["lag_ratio"],
        deflation=RateLimit(truth["falling_N_per_s"]),
    )
    return (
        replace(
            rig,
            plant=plant,
            free_damping_scale=truth["damping_scale_free_swing"],
            pump=pump,
            strength=strength,
            tracker=replace(rig.tracker, latency_s=late_s),
        ),
        truth,
    )


def rig_file(path: Path, **sections: Any) -> Rig:
    """A rig.yaml with the simulated rig's camera and plane."""
    rig = copy.deepcopy(firmware_rigs.rig()).with_sections(sections)
    rig.save(path)
    return rig


def log_file(path: Path, rig: SimulatedRig, kind: str, seed: int, duration_s: float, **settings: str) -> Path:
    """A simulated log with the sensors' noise."""
    run = run_scenario(make_scenario(kind, settings), rig, seed, "sensors", duration_s)
    write_log(path, run_log(run))
    return path


LAG_TRUTH = np.array([0.06, 25.0, 0.5, 1e6])
FLOW_TRUTH = np.array([0.06, 25.0, 0.25, 8e-3, 3.0, 0.0, 1.0])


def pump_records(model: str, theta: np.ndarray, count: int = 4, noise: float = 0.1) -> list[PumpRecord]:
    """Steps to several levels of PWM, up and down, with white noise."""
    t = 0.02 * np.arange(200)
    out = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        pwm = np.repeat(rng.choice([120.0, 160.0, 200.0, 255.0], 5), 40)
        pwm[:3] = 0.0
        clean = simulate_pump(model, theta, PumpRecord("x", t, pwm, np.zeros(len(t))), start_s=-1.0)
        out.append(PumpRecord(f"run{seed}", t, pwm, clean + noise * rng.standard_normal(len(t))))
    return out
