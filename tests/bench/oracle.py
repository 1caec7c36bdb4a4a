"""What each piece of knowledge is worth to the driven estimator: it is told the truth, piece by piece.

    python tests/bench/oracle.py [FIRST_SEED] [COUNT] [VARIANT ...]

Rigs and errors of the alignment are those of `driven.py`. A variant takes the named quantities from the
truth, with next to no deviation. `all` is the floor of this filter: what is left then comes from the readings
and from the process noise. Errors are means over seeds of the mean over q1 and q2 in millimetres after two
seconds, forward and smoothed, with NEES (2 expected) and the deviation that is told over the error that is
made, both as roots of means of squares.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace

import _here
import numpy as np
from drivenlogs import driven_log, errors_of, estimated
from estimatorlogs import SCENARIOS, SIGMA, setup_for, truth_of_sensors

from calib.stages.estimator.driven import Drive
from calib.stages.estimator.kinematic import Setup
from calib.stages.estimator.sensors import SENSOR, view_coefficients
from calib.twin.rig import SimulatedRig

SENSORS = {
    "plane": ("shift_x_m", "shift_y_m", "stretch"),
    "marker offset": ("marker_offset_m",),
    "latency": ("time_offset_s",),
    "gyro": ("gyro_bias_radps", "gyro_scale"),
    "mount, accelerometer": (
        "accel_bias_x_mps2", "accel_bias_y_mps2", "mount_angle_rad", "accel_scale_x", "accel_scale_y",
        "imu_lever_m",
    ),
}  # fmt: skip
LEARNT_SHARE = 1e-3
NOTHING = 1e-3


def told_sensors(setup: Setup, rig: SimulatedRig, names: tuple[str, ...]) -> Setup:
    """The set-up with some of its sensors' quantities true and nearly without deviation."""
    value, sigma = setup.start.sensor.copy(), setup.start.sensor_sigma.copy()
    true = truth_of_sensors(rig)
    for name in names:
        at = SENSOR.index(name)
        value[at], sigma[at] = true[at], LEARNT_SHARE * SIGMA[name]
    view = setup.view
    if "shift_x_m" in names:
        view = view_coefficients(rig.view.camera, rig.view.R_CW, rig.view.t_CW_m)
    return replace(setup, view=view, start=replace(setup.start, sensor=value, sensor_sigma=sigma))


def told_plant(rig: SimulatedRig, drive: Drive) -> Drive:
    """The true plant and pumps, nearly without deviation."""
    return replace(
        drive,
        plant=rig.plant,
        pump=rig.pump,
        strength=rig.strength,
        free_damping_scale=rig.free_damping_scale,
        sigma=tuple(NOTHING * value for value in drive.sigma),
    )


def calm(drive: Drive) -> Drive:
    """No process noise to speak of: the twin's own motion has none."""
    return replace(
        drive,
        walk_disturbance=1e-7,
        sigma_disturbance_N=1e-7,
        walk_rates=(1e-6, 1e-7),
        walk_forces=1e-7,
        walk_parameters=0.0,
    )


EVERYTHING = tuple(name for names in SENSORS.values() for name in names)


def variant(name: str, setup: Setup, rig: SimulatedRig) -> tuple[Setup, Drive]:
    """Set-up and drive of a variant."""
    drive = Drive()
    if name in SENSORS:
        return told_sensors(setup, rig, SENSORS[name]), drive
    if name in ("sensors", "all", "all, no process noise"):
        setup = told_sensors(setup, rig, EVERYTHING)
    if name in ("plant", "all", "all, no process noise"):
        drive = told_plant(rig, drive)
    if name in ("no process noise", "all, no process noise"):
        drive = calm(drive)
    return setup, drive


VARIANTS = ("nothing", *SENSORS, "sensors", "plant", "no process noise", "all", "all, no process noise")


def scores(found: Mapping[str, float]) -> tuple[float, float, float, float]:
    """Error [mm], phi [deg], NEES, and the deviation of q that is told [mm]."""
    told = 0.5 * (found["sigma_q1_mm"] + found["sigma_q2_mm"])
    return found["mean_q_mm"], found["phi_deg"], found["nees"], told


def main() -> None:
    """Print both tables."""
    chosen = [word for word in sys.argv[1:] if not word.isdigit()] or list(VARIANTS)
    first, count = _here.numbers(1, 8)
    print(f"{'':8s}{'known':24s}" + "".join(f"{name:>27s}" for name in SCENARIOS))
    print(f"{'':32s}" + f"{'mm   deg  NEES  told':>27s}" * len(SCENARIOS))
    for name in chosen:
        rows: dict[str, list[str]] = {"handover": [], "smoothed": []}
        for scenario in SCENARIOS:
            found: dict[str, list[tuple[float, float, float, float]]] = {way: [] for way in rows}
            for seed in range(first, first + count):
                rig, log = driven_log(scenario, seed)
                setup, drive = variant(name, setup_for(rig, seed), rig)
                outs, _ = estimated(setup, drive, log)
                for way, all_scores in found.items():
                    all_scores.append(scores(errors_of(setup, outs[way], log)))
            for way, all_scores in found.items():
                mm, degrees, nees, _ = np.mean(all_scores, axis=0)
                square = np.mean(np.square(all_scores), axis=0)
                rows[way].append(f"{mm:.3f} {degrees:.3f} {nees:5.1f} {np.sqrt(square[3] / square[0]):5.2f}")
        for way, cells in rows.items():
            print(f"{way:8s}  {name:22s}" + "".join(f"{cell:>27s}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
