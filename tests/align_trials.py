"""Simulated rigs that differ in all that an alignment finds, their logs, and a plane that is a little off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from estimatorlogs import truth_of_sensors

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.align.read import PRIOR as USUAL_PRIOR
from calib.stages.align.solve import AlignLog, Alignment, Settings
from calib.stages.estimator.sensors import SENSOR, rest_reading, sensor_values, view_coefficients
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.sensors import Imu, Tracker
from calib.twin.simulate import run_log

__all__ = ["MOTIONS", "PRIOR", "Trial", "align_log", "draw", "known", "prior_settings", "scores", "twin_log"]

MIDDLE = (0.0, 0.075)
MOTIONS = (
    ("swing", {"phi_rad": "0.5"}),
    ("ellipse", {}),
    ("swing", {"phi_rad": "-0.4"}),
    ("orientation", {}),
)

PRIOR = {**USUAL_PRIOR, "shift_x_m": (0.0, 5e-5), "shift_y_m": (0.0, 5e-5)}
"""The plane of these rigs is known better than a printed board's."""


@dataclass(frozen=True)
class Trial:
    """A rig, what is true of its sensors (14,), and the view that was calibrated (24,)."""

    rig: SimulatedRig
    truth: FloatArray
    view: FloatArray


def known(rig: SimulatedRig, plane_error: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Trial:
    """A rig whose plane was calibrated off by shift_x, shift_y and stretch."""
    dx, dy, stretch = plane_error
    truth = truth_of_sensors(rig)
    truth[[SENSOR.index(name) for name in ("shift_x_m", "shift_y_m", "stretch")]] = plane_error
    R, t = rig.view.R_CW.copy(), rig.view.t_CW_m
    scaled = R / np.array([1.0 + stretch, 1.0 + stretch, 1.0])
    middle = np.array(MIDDLE)
    moved = t + R[:, :2] @ middle - scaled[:, :2] @ (middle + np.array([dx, dy]))
    return Trial(rig, truth, view_coefficients(rig.view.camera, scaled, moved, MIDDLE))


def draw(seed: int) -> Trial:
    """A rig with latency, mount, lever, scales, biases, noise and marker of its own."""
    rng = np.random.default_rng(seed)
    louder = float(rng.uniform(0.6, 1.8))
    nominal = Imu()
    imu = replace(
        nominal,
        mount_angle_rad=float(rng.normal(0.0, 0.05)),
        lever_m=(0.0, float(rng.uniform(0.0, 0.012))),
        gyro_scale=tuple(rng.normal(0.0, 0.006, 3).tolist()),
        accel_scale=tuple(rng.normal(0.0, 0.005, 3).tolist()),
        gyro_bias_radps=tuple(rng.normal(0.0, 0.01, 3).tolist()),
        accel_bias_mps2=tuple(rng.normal(0.0, 0.06, 3).tolist()),
        gyro_noise=louder * nominal.gyro_noise,
        accel_noise=louder * nominal.accel_noise,
    )
    tracker = Tracker(
        marker_offset_m=float(0.015 + rng.normal(0.0, 5e-4)),
        latency_s=float(rng.uniform(0.010, 0.040)),
        jitter_px=float(rng.uniform(0.2, 0.5)),
    )
    rig = replace(SimulatedRig(), imu=imu, tracker=tracker)
    shift = rng.normal(0.0, 5e-5, 2).tolist()
    across = float(np.random.default_rng(7000 + seed).normal(0.0, 0.004))
    rig = replace(rig, imu=replace(imu, lever_m=(across, imu.lever_m[1])))
    return known(rig, (shift[0], shift[1], float(rng.normal(0.0, 1e-3))))


def twin_log(
    rig: SimulatedRig,
    scenario: str,
    options: dict[str, str],
    seed: int,
    duration_s: float | None = None,
    feedback: str = "truth",
) -> Log:
    """A log of the rig."""
    run = run_scenario(make_scenario(scenario, options), rig, seed, feedback, duration_s)
    return run_log(run, f"{scenario}{seed}")


def align_log(log: Log) -> AlignLog:
    """What an alignment takes of it."""
    columns = log.columns
    pixels = np.stack([columns["u_px"], columns["v_px"]], axis=1)
    readings = np.stack([columns[name] for name in ("ax_mps2", "ay_mps2", "gz_radps")], axis=1)
    seen, felt = np.isfinite(pixels).all(axis=1), np.isfinite(readings).any(axis=1)
    return AlignLog(log.source, log.t_s[seen], pixels[seen], log.t_s[felt], readings[felt])


def prior_settings(view: FloatArray) -> Settings:
    """Settings with `PRIOR`."""
    mean = sensor_values({name: value for name, (value, _) in PRIOR.items()})
    return Settings(view, mean, sensor_values({name: sigma for name, (_, sigma) in PRIOR.items()}))


def scores(trial: Trial, found: Alignment) -> FloatArray:
    """Errors over sigma (14,): of `SENSOR`, then of the angle at rest."""
    rest = (found.rest_angle_rad - rest_reading(trial.truth)[0][0]) / found.rest_angle_sigma
    assert len(found.sensor) == len(SENSOR)
    return np.append((found.sensor - trial.truth) / found.sigma, rest)
