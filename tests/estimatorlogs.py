"""Simulated logs with a set-up of the estimator that errs from the truth within its own deviations."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.io.logs import Log
from calib.stages.actuator.dynamics import coefficients
from calib.stages.actuator.simulate import derivative, state_row
from calib.stages.estimator.kinematic import Kinematic, Rows, Setup, Start
from calib.stages.estimator.read import periods, rows_of
from calib.stages.estimator.sensors import sensor_values, view_coefficients
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.sensors import Tracker, Trajectory
from calib.twin.simulate import _NODES_PER_TICK, Run, Sensors, _Plant, run_log

SCENARIOS = {
    "static": ("static", 15.0),
    "swing": ("swing", None),
    "ellipse": ("ellipse", None),
    "step": ("orientation", None),
    "elongation": ("elongation", None),
}

SIGMA = {
    "gyro_bias_radps": 5e-4,
    "accel_bias_x_mps2": 0.02,
    "accel_bias_y_mps2": 2e-3,
    "mount_angle_rad": 3e-4,
    "gyro_scale": 1e-3,
    "imu_lever_m": 3e-4,
    "imu_across_m": 2e-4,
    "marker_offset_m": 3e-5,
    "time_offset_s": 5e-4,
    "shift_x_m": 1e-5,
    "shift_y_m": 1e-5,
    "stretch": 1e-4,
    "accel_scale_x": 3e-3,
    "accel_scale_y": 3e-3,
}
"""What a good alignment leaves unknown; of the marker, a drawing."""

ALIGNED = {
    "time_offset_s": 0.0252, "mount_angle_rad": 0.0201, "gyro_scale": 0.0055, "gyro_bias_radps": 0.0062,
    "marker_offset_m": 0.01502, "accel_bias_mps2": [0.05, -0.041], "rest_angle_rad": 0.016,
    "accel_scale": [0.003, -0.002], "imu_lever_m": 0.006, "plane_shift_m": [0.0, 0.0], "plane_stretch": 0.0,
    "jitter_px": 0.3, "outlier_share": 0.003, "accel_noise_mps2": [0.0158, 0.0158],
    "gyro_noise_radps": 0.0026, "verdict": "ok",
    "sigma": {"time_offset_s": 5e-4, "mount_angle_rad": 3e-4, "gyro_scale": 1e-3, "gyro_bias_radps": 5e-4,
              "marker_offset_m": 3e-5, "accel_bias_mps2": [0.02, 0.002]},
}  # fmt: skip
"""Section `align` of the nominal simulated rig, off within its own deviations."""

NOISE = np.array([0.3, 1.0, 0.0158, 0.0158, 0.0026, 0.002, 5e-5, 5e-5, 20.0, 30.0, 25.0])


def varied(seed: int) -> SimulatedRig:
    """A rig whose plant, sensors and latency differ from the nominal one; seed 0 is nominal."""
    rig = SimulatedRig()
    if seed == 0:
        return rig
    rng = np.random.default_rng(1000 + seed)
    imu = replace(
        rig.imu,
        mount_angle_rad=float(rng.uniform(-0.05, 0.05)),
        lever_m=(float(np.random.default_rng(2000 + seed).uniform(-4e-3, 4e-3)), rig.imu.lever_m[1]),
        gyro_bias_radps=tuple(rng.normal(0.0, 0.006, 3).tolist()),
        accel_bias_mps2=tuple(rng.normal(0.0, 0.05, 3).tolist()),
        gyro_scale=tuple(rng.normal(0.0, 0.005, 3).tolist()),
        accel_scale=tuple(rng.normal(0.0, 0.003, 3).tolist()),
    )
    factor = rng.uniform(0.92, 1.08, 4)
    plant = replace(
        rig.plant,
        stiffness_scale=rig.plant.stiffness_scale * factor[0],
        damping_scale=rig.plant.damping_scale * factor[1],
        bending_N_per_rad2=rig.plant.bending_N_per_rad2 * factor[2],
        mass_kg=rig.plant.mass_kg * factor[3],
    )
    strength = 1.0 + rng.uniform(-0.03, 0.03, 2)
    return replace(
        rig,
        imu=imu,
        plant=plant,
        strength=(float(strength[0]), float(strength[1])),
        tracker=replace(rig.tracker, latency_s=float(rng.uniform(0.01, 0.04))),
    )


@cache
def simulated(name: str, seed: int = 0) -> tuple[SimulatedRig, Log]:
    """A rig and its log of a scenario."""
    rig = varied(seed)
    kind, duration = SCENARIOS[name]
    return rig, run_log(run_scenario(make_scenario(kind), rig, seed, "sensors", duration))


def rows_from(log: Log) -> Rows:
    """The log's rows as the estimator gets them."""
    return rows_of(log, periods(log))


def truth_of_sensors(rig: SimulatedRig) -> FloatArray:
    """The sensors of a rig as a vector."""
    imu, tracker = rig.imu, rig.tracker
    return sensor_values(
        {
            "gyro_bias_radps": imu.gyro_bias_radps[2],
            "accel_bias_x_mps2": imu.accel_bias_mps2[0],
            "accel_bias_y_mps2": imu.accel_bias_mps2[1],
            "mount_angle_rad": imu.mount_angle_rad,
            "gyro_scale": imu.gyro_scale[2],
            "imu_lever_m": imu.lever_m[1],
            "imu_across_m": imu.lever_m[0],
            "marker_offset_m": tracker.marker_offset_m,
            "time_offset_s": tracker.latency_s,
            "accel_scale_x": imu.accel_scale[0],
            "accel_scale_y": imu.accel_scale[1],
        }
    )


def setup_for(
    rig: SimulatedRig, seed: int = 0, process: Kinematic | None = None, tracker: Tracker | None = None
) -> Setup:
    """A set-up whose sensors err from the truth by a draw from their deviations."""
    rng = np.random.default_rng(seed)
    sigma = sensor_values(SIGMA)
    error = sigma * rng.standard_normal(len(sigma))
    value = truth_of_sensors(rig) + error
    value[8:11] = 0.0
    view = rig.view
    # The calibrated plane shows places shifted by the error.
    t = view.t_CW_m - view.R_CW[:, 0] * error[8] - view.R_CW[:, 1] * error[9]
    noise = NOISE.copy()
    noise[0] = (tracker or rig.tracker).jitter_px
    return Setup(
        view_coefficients(view.camera, view.R_CW, t),
        noise,
        Start(value, sigma),
        rig.plant.bellows_radius_m,
        process=process or Kinematic(),
        camera_period_s=1.0 / 60.0,
        imu_period_s=1.0 / rig.imu.rate_hz,
        command_period_s=rig.pump.tick_s,
    )


def truth(log: Log) -> FloatArray:
    """True q1, q2, phi (n, 3)."""
    return np.stack([log.columns[name] for name in ("true_q1_m", "true_q2_m", "true_phi_rad")], axis=1)


def pushed_log(seed: int, seconds: float = 15.0) -> Log:
    """A log without commands of a head that a hand pushes along, here and there, and hardly turns."""
    rig, rng = SimulatedRig(), np.random.default_rng(seed)
    ticks, node_s = round(60.0 * seconds), rig.pump.tick_s / _NODES_PER_TICK
    t = node_s * np.arange(_NODES_PER_TICK * ticks + 1)
    # Length and angle with their first two derivatives, along paths of least jerk.
    path = np.zeros((2, 3, len(t)))
    for (place, rate, change), middle, reach in zip(path, (0.065, 0.0), (6e-3, 0.05), strict=True):
        at, place[:] = 2.0, middle
        while at < t[-1]:
            lasts_s, way = rng.uniform(0.25, 1.0), middle + reach * rng.uniform(-1.0, 1.0) - place[-1]
            s = np.clip((t - at) / lasts_s, 0.0, 1.0)
            place += way * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
            rate += way / lasts_s * s**2 * (30.0 - 60.0 * s + 30.0 * s**2)
            change += way / lasts_s**2 * s * (60.0 - 180.0 * s + 120.0 * s**2)
            at += lasts_s + rng.uniform(0.0, 0.8)
    length, turn = path[0], rig.plant.bellows_radius_m * path[1]
    nodes = np.tile(np.asarray(state_row(rig.plant), dtype=np.float64), (len(t), 1))
    nodes[:, :4] = np.stack(
        [length[0] + turn[0], length[0] - turn[0], length[1] + turn[1], length[1] - turn[1]]
    ).T
    c = coefficients(rig.plant)
    for row, wanted in zip(nodes, np.stack([length[2] + turn[2], length[2] - turn[2]]).T, strict=True):
        # The forces that make these accelerations.
        free, one, two = (derivative(c, row[:6], *F)[2:4] for F in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
        row[8:10] = np.linalg.solve(np.stack([one - free, two - free], axis=1), wanted - free)
    whole, sensors = Trajectory(node_s, nodes), Sensors(rig, _Plant(rig, rig.plant), ticks, seed)
    sensors.take_frames(whole, slice(0, ticks))
    sensors.take_samples(whole, slice(0, len(sensors.imu.taken_s)))
    log = run_log(Run(rig, rig.plant, whole, np.zeros((ticks, 2)), rig.pump.tick_s, None, sensors))
    return replace(log, columns={name: of for name, of in log.columns.items() if not name.startswith("pwm")})
