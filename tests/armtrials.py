"""A simulated bending arm under a pressure valve: trials, and their logs as CSV."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.core.arrays import FloatArray
from calib.io.columns import COMMANDED, POSITION, PRESSURES, QUATERNION
from calib.stages.arm.identify import FULL
from calib.stages.arm.model import COMPLIANCE, PARAMETERS, STEP_S, Scale, Trial, drive_run, segment_run

SCALE = Scale(275.0, 0.6, 0.178, 0.13, 275.0)
TRUE = FULL.without("creep").values(
    np.array([0.0 if one.name in COMPLIANCE else 0.3 for one in PARAMETERS]), SCALE
)


def simulated(
    name: str,
    seed: int,
    day: str = "a",
    load_kg: float = 0.0,
    gain: float = 1.0,
    duration_s: float = 40.0,
    values: Mapping[str, float] = TRUE,
) -> Trial:
    """A trial of the true arm under a command that switches at random, with noise of a motion capture."""
    rng = np.random.default_rng(seed)
    n = round(duration_s / STEP_S)
    level = np.repeat(rng.uniform(0.0, 1.0, n // 200 + 1), 200)[:n]
    command = np.where(np.repeat(rng.uniform(size=n // 10 + 1), 10)[:n] < level, 270.0, 7.0)
    command[-150:] = 7.0
    start = Trial(name, day, load_kg, STEP_S * np.arange(n), command, np.full(n, 5.0), np.full(n, 0.13),
                  np.full(n, 0.176 - 0.006 * (seed % 2)))  # fmt: skip
    values = dict(values) | {"bends_rad_per_kpa": gain * values["bends_rad_per_kpa"]}
    pressure = drive_run(start, values)
    angle, chord = segment_run(start, values, pressure)
    return Trial(name, day, load_kg, start.t_s, command, pressure + rng.normal(0.0, 1.0, n),
                 angle + rng.normal(0.0, 1e-3, n), chord + rng.normal(0.0, 1e-4, n))  # fmt: skip


def columns_of(trial: Trial, conjugated: bool = False, planar: bool = False) -> dict[str, FloatArray]:
    """Columns of a log of the trial: the arm points along y and bends towards x, about z."""
    n, phi = len(trial.t_s), trial.angle_rad
    out = dict(zip((*COMMANDED, *PRESSURES), np.full((6, n), 3.0), strict=True))
    out |= {"p_cmd1_kpa": trial.command, "p1_kpa": trial.pressure_kpa}
    lean = 0.55 * phi
    x, y = trial.chord_m * np.sin(lean), trial.chord_m * np.cos(lean)
    if planar:
        return out | {"tip_x_m": x, "tip_y_m": y, "tip_phi_rad": phi}
    out |= dict(zip((*POSITION, *QUATERNION), np.zeros((14, n)), strict=True))
    sign = -1.0 if conjugated else 1.0
    out |= {"tip_x_m": 0.1 + x, "base_x_m": np.full(n, 0.1), "tip_y_m": y, "base_qw": np.full(n, 1.0)}
    return out | {"tip_qw": np.cos(phi / 2), "tip_qz": -sign * np.sin(phi / 2)}


def written(folder: Path, trial: Trial) -> Path:
    """The trial's log."""
    columns = {"t_s": trial.t_s, **columns_of(trial)}
    path = folder / f"{trial.name}.csv"
    table = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, table, "%.6f", ",", header=",".join(columns), comments="")
    return path
