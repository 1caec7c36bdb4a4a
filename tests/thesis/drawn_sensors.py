"""Figures of the sensors and of the steady elongation: 2.4, 2.6, 2.10, 2.11, 2.12."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.ndimage import median_filter

from calib.core.arrays import FloatArray
from calib.stages.actuator.pump import ElongationForce
from calib.stages.imu.mahony import Mahony, accelerometer_angles, filter_log
from calib.stages.lowpass.filters import Design, dc_delay_s, design_lowpass, filter_signal
from calib.twin.rig import workspace_homography
from calib.twin.scenarios import elongation_mm
from calib.twin.simulate import Run
from thesis.drawn import Curve, Plot, drawn
from thesis.runs import tried

__all__ = ["FIGURES", "VOLTS", "seen_elongation_mm", "steady_elongations"]

VOLTS = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0)
_LOGS = 5
_ON_S = 8.0
_LATE_S = 7.5
_THREE = 3
_WRONG_M = 3e-3
_T_OF_TWO = 4.303
"""95 % point of Student's t with two degrees of freedom: three measurements, as in the source."""


@drawn("2.4", "onchip_angle_at_rest", "Angle of the chip's own fusion, five logs at rest")
def onchip() -> Plot:
    curves, slopes = [], []
    for seed in range(_LOGS):
        run, figures = tried("static", 60.0, seed=seed)
        t, phi = run.imu.taken_s[::20], np.degrees(run.onchip_rad[::20])
        curves.append(Curve(f"log {seed + 1}", t, phi - phi[0], colour=seed))
        slopes.append(figures["onchip_drift_degps"] or 0.0)
    mean = float(np.mean(slopes))
    return Plot(
        "time (s)",
        "change of the angle (deg)",
        tuple(curves),
        "five logs of 60 s of the simulated rig at rest, seeds 0 to 4; its chip is given a drift around the "
        "printed one",
        f"Drift {mean:.3f} deg/s on average, {min(slopes):.3f} to {max(slopes):.3f}.",
        numbers={"mean_degps": mean, "least_degps": min(slopes), "greatest_degps": max(slopes)},
    )


@drawn("2.6", "imu_in_motion", "Angle by accelerometer, by gyroscope, and by the filter with gains 3 and 3")
def imu_in_motion() -> Plot:
    run, _ = tried("prbs", 20.0)
    t, gyro = run.imu.taken_s, -run.gyro_radps[:, 2]
    acc = accelerometer_angles(run.accel_mps2[:, 0], run.accel_mps2[:, 1])
    turned = acc[0] + np.concatenate([[0.0], np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t))])
    kept, _ = filter_log(Mahony(), t, acc, gyro)
    q = run.trajectory.at(t)[:, :2]
    truth = (q[:, 0] - q[:, 1]) / (2.0 * run.plant.bellows_radius_m)
    off = {
        "accelerometer": float(np.std(acc - truth)),
        "gyroscope_at_the_end": float(turned[-1] - truth[-1]),
        "filter": float(np.std(kept - truth)),
    }
    return Plot(
        "time (s)",
        "angle (rad)",
        (
            Curve("accelerometer", t, acc, colour=5),
            Curve("gyroscope, integrated", t, turned, colour=1),
            Curve("filter", t, kept, colour=0),
            Curve("truth", t, truth, "dashed", -1),
        ),
        "simulated rig with random commands for 20 s; IMU at 100 Hz",
        f"Deviation from the truth: accelerometer {1e3 * off['accelerometer']:.0f} mrad, filter "
        f"{1e3 * off['filter']:.0f} mrad; the gyroscope is {1e3 * off['gyroscope_at_the_end']:.0f} mrad off "
        "at the end.",
        numbers={f"{name}_rad": value for name, value in off.items()},
    )


def _plane_m(run: Run) -> FloatArray:
    """Marker (n, 2) [m] in the plane, as the firmware maps its pixels."""
    H = np.linalg.inv(workspace_homography(run.rig.view))
    rows = np.column_stack([run.pixels, np.ones(len(run.pixels))]) @ H.T
    return np.asarray(rows[:, :2] / rows[:, 2:])


def _held(values: FloatArray) -> FloatArray:
    """Values (n,) with the last known one in place of NaN."""
    at = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[at])


@drawn("2.10", "marker_low_passed", "The marker's x as the camera gives it, and after the low-pass at 1 Hz")
def marker_low_passed() -> Plot:
    run, _ = tried("orientation", 8.0)
    x = _held(_plane_m(run)[:, 0])
    low = design_lowpass(Design(1.0, 60.0, 1)).exact
    smooth, delay = filter_signal(low, x), dc_delay_s(low, 60.0)
    held = (run.t_s >= 3.0) & (run.t_s < 5.0)
    rough, fine = (float(np.std(np.diff(v[held]))) for v in (x, smooth))
    return Plot(
        "time (s)",
        "x of the marker (mm)",
        (
            Curve("from the camera", run.t_s, 1e3 * x, colour=0),
            Curve("after the low-pass", run.t_s, 1e3 * smooth, colour=1),
        ),
        "simulated rig under PID control to 0.7 rad with a jump to 0.3 rad at 5 s; the camera shows "
        "1 mm as one pixel; first order at 60 Hz",
        f"While the angle is held, x changes by {1e3 * rough:.2f} mm from tick to tick, and by "
        f"{1e3 * fine:.3f} mm "
        f"after the low-pass, which is {1e3 * delay:.0f} ms late. The spikes are wrong pictures.",
        numbers={"rough_m": rough, "fine_m": fine, "delay_s": delay},
    )


def seen_elongation_mm(run: Run) -> FloatArray:
    """Elongation (n,) [mm] of a straight actuator as the camera shows it, wrong pictures replaced."""
    y = _held(_plane_m(run)[:, 1]) - run.rig.tracker.marker_offset_m - run.plant.rest_length_m
    # A wrong picture stands far away from those on both sides of it.
    near = median_filter(y, 9, mode="nearest")
    return np.asarray(1e3 * np.where(np.abs(y - near) > _WRONG_M, near, y))


@lru_cache(maxsize=1)
def steady_elongations() -> FloatArray:
    """Elongations [mm] (voltages, 3) after 7.5 s at `VOLTS`, three runs each, by the camera."""
    rows = []
    for volt in VOLTS:
        row = []
        for seed in range(_THREE):
            run, _ = tried("deflate", _ON_S, seed=seed, volt=str(volt), off_at_s="100")
            row.append(float(np.nanmean(seen_elongation_mm(run)[run.t_s >= _LATE_S])))
        rows.append(row)
    return np.array(rows)


@drawn("2.11", "steady_elongation", "Steady elongation over the voltage of both motors")
def steady_elongation() -> Plot:
    found, volts = steady_elongations(), np.array(VOLTS)
    mean = found.mean(axis=1)
    spread = _T_OF_TWO * found.std(axis=1, ddof=1) / math.sqrt(_THREE)
    active = volts >= 4.7
    cubic = np.polyfit(volts[active], mean[active], 3)
    fine = np.linspace(4.7, 12.0, 120)
    text = np.asarray(np.polyval(ElongationForce().elongation_mm, fine))
    return Plot(
        "motor input (V)",
        "elongation (mm)",
        (
            Curve("mean of three runs, 95 %", volts, mean, "bars", -1, spread),
            Curve("cubic through them", fine, np.asarray(np.polyval(cubic, fine)), colour=0),
            Curve("(2.13) with 3.756 for 3.376", fine, text, "dashed", 1),
        ),
        "27 runs of 8 s of the simulated rig with both motors at the same voltage, lengths by its camera",
        f"{mean[-1]:.2f} mm at 12 V, nothing at 4 V. The rig takes (2.13) for its pumps; what differs is the "
        "lens, which the map of the plane leaves out, and creep that has not settled.",
        numbers={"at_12V_mm": float(mean[-1]), "at_4V_mm": float(mean[0]), "cubic_u3": float(cubic[0])},
    )


@drawn("2.12", "elongation_steps", "Elongation after a step of both motors, four voltages")
def elongation_steps() -> Plot:
    curves, times = [], {}
    for k, volt in enumerate((6.0, 8.0, 10.0, 12.0)):
        run, _ = tried("deflate", _ON_S, seed=k, volt=str(volt), off_at_s="100")
        mm = seen_elongation_mm(run)
        curves.append(Curve(f"{volt:g} V", run.t_s, mm, colour=k))
        true = elongation_mm(run)
        times[volt] = float(run.t_s[np.argmax(true > (1.0 - math.exp(-1.0)) * true[-1])])
    told = ", ".join(f"{t:.2f} s at {volt:g} V" for volt, t in times.items())
    return Plot(
        "time (s)",
        "elongation (mm)",
        tuple(curves),
        "four runs of the simulated rig; lengths by its camera, 60 pictures a second",
        f"63 % of the way after {told}.",
        numbers={f"to_63_percent_{volt:g}V_s": t for volt, t in times.items()},
    )


FIGURES = (onchip, imu_in_motion, marker_low_passed, steady_elongation, elongation_steps)
"""In the order of the source."""
