"""Claims about the IMU and its filter (2.1, 2.2.1)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.integrate import solve_ivp

from calib.core.arrays import FloatArray
from calib.stages.imu.mahony import Mahony, MahonySample, MahonyState, accelerometer_angles, filter_log, step
from calib.twin.simulate import Run
from thesis.outcome import Finding, Outcome, claim, exactly
from thesis.runs import tried

__all__ = ["CLAIMS"]

_LOGS = 5
_SETTLED_S = 5.0
_G = 9.81


@claim(
    "imu.onchip_drift",
    "Fig. 2.4",
    "at rest the angle of the chip's own fusion drifts, by this much on average over five logs",
    "0.145 deg/s",
    "data",
    basis="chosen",
)
def onchip_drift() -> Finding:
    drifts = [tried("static", 60.0, seed=seed)[1]["onchip_drift_degps"] or 0.0 for seed in range(_LOGS)]
    mean, spread = float(np.mean(drifts)), float(np.std(drifts, ddof=1))
    return Finding(
        f"{mean:.3f} +- {spread:.3f} deg/s",
        Outcome.UNMEASURED,
        "mean and spread from log to log of five simulated logs of 60 s; the simulated chip is given a drift "
        "around the printed one, so this only shows how far a mean of five may be off",
        {"mean_degps": mean, "spread_degps": spread},
        simulated=True,
    )


def _filtered(run: Run, gains: Mahony) -> FloatArray:
    phi_acc = accelerometer_angles(run.accel_mps2[:, 0], run.accel_mps2[:, 1])
    phi, _ = filter_log(gains, run.imu.taken_s, phi_acc, -run.gyro_radps[:, 2])
    return phi


@lru_cache(maxsize=8)
def _motion_error_rad(Kp: float, Ki: float) -> float:
    """Deviation of the filter's error while the simulated rig moves, its mean taken off."""
    run, _ = tried("prbs", 20.0)
    q = run.trajectory.at(run.imu.taken_s)[:, :2]
    truth = (q[:, 0] - q[:, 1]) / (2.0 * run.plant.bellows_radius_m)
    late = run.imu.taken_s > _SETTLED_S
    return float(np.std((_filtered(run, Mahony(Kp, Ki)) - truth)[late]))


@claim(
    "imu.mm_gains",
    "Fig. 2.6",
    "gains of the filter, chosen by eye on one log",
    "Kp = 3, Ki = 3",
    "data",
    basis="twin",
)
def mm_gains() -> Finding:
    own = _motion_error_rad(3.0, 3.0)
    grid = {(Kp, Ki): _motion_error_rad(Kp, Ki) for Kp in (0.1, 0.3, 1.0, 3.0) for Ki in (0.003, 0.03, 0.3)}
    best = min(grid, key=lambda gains: grid[gains])
    return Finding(
        f"{1e3 * own:.1f} mrad with 3, 3; {1e3 * grid[best]:.1f} mrad with {best[0]:g}, {best[1]:g}",
        Outcome.UNMEASURED,
        "error in simulated motion with random commands, without its mean, against the best of a coarse "
        "grid: which gains are right depends on motion and gyroscope, and its log is not published",
        {"rms_printed_rad": own, "rms_best_rad": grid[best], "best_Kp": best[0], "best_Ki": best[1]},
        simulated=True,
    )


@claim(
    "imu.mm_drift",
    "2.2.1",
    "the filtered angle drifts less than the chip's, by this rate without an angle in its unit",
    "-9.07e-4 /s",
    "data",
    basis="twin",
)
def mm_drift() -> Finding:
    slopes = []
    for seed in range(_LOGS):
        run, _ = tried("static", 60.0, seed=seed)
        late = run.imu.taken_s > _SETTLED_S
        slopes.append(float(np.polyfit(run.imu.taken_s[late], _filtered(run, Mahony())[late], 1)[0]))
    mean, largest = math.degrees(float(np.mean(slopes))), math.degrees(float(np.max(np.abs(slopes))))
    return Finding(
        f"{mean:.1e} deg/s, at most {largest:.1e}",
        Outcome.UNMEASURED,
        "five simulated logs of 60 s at rest, Kp = Ki = 3: the integral takes up a constant bias of the "
        "gyroscope entirely, so what slope is left is the accelerometer's and says nothing about the gains",
        {"mean_degps": mean, "largest_degps": largest},
        simulated=True,
    )


@claim(
    "imu.gyro_lsb",
    "2.1",
    "the gyroscope measures up to this rate with this resolution",
    "2000 deg/s, 0.0305 deg/s",
    basis="printed",
)
def gyro_lsb() -> Finding:
    both, one = 2.0 * 2000.0 / 2**16, 2000.0 / 2**16
    return Finding(
        f"{both:.4f} deg/s",
        exactly(abs(both - 0.0305) < 5e-5),
        f"16 bits have to hold both signs: (2000 + 2000) / 2^16. Printed is 2000 / 2^16 = {one:.4f}, "
        "half of it; by the same rule the accelerometer's printed step does count both signs",
        {"step_degps": both, "step_of_half_the_range_degps": one},
    )


@claim(
    "imu.acc_lsb",
    "2.1",
    "the accelerometer has this range and this resolution",
    "+-4 g, 0.01916 m/s2",
    basis="printed",
)
def acc_lsb() -> Finding:
    step_mps2 = 2.0 * 4.0 * _G / 2**12
    return Finding(
        f"{step_mps2:.5f} m/s2",
        exactly(abs(step_mps2 - 0.01916) < 5e-6),
        "8 g over 2^12 steps; with 14 bits it would be a quarter of it",
        {"step_mps2": step_mps2, "step_of_14_bits_mps2": 0.25 * step_mps2},
    )


def _largest_difference(dt_s: float) -> float:
    """Largest distance of (2.3) from the solution of (2.2) over 4 s of a smooth motion with a gyro bias."""
    gains = Mahony()

    def seen(t: float) -> tuple[float, float]:
        return 0.5 * math.sin(2.0 * t) + 0.1, math.cos(2.0 * t) + 0.05

    def rates(t: float, y: FloatArray) -> list[float]:
        phi_acc, w = seen(t)
        return [gains.Kp * (phi_acc - y[0]) + y[1] + w, gains.Ki * (phi_acc - y[0])]

    times = dt_s * np.arange(1, round(4.0 / dt_s) + 1)
    exact = solve_ivp(rates, (0.0, 4.0 + dt_s), [0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    state, worst = MahonyState(), 0.0
    for t, wanted in zip(times.tolist(), exact.tolist(), strict=True):
        phi_acc, w = seen(t)
        state = step(gains, state, MahonySample(math.cos(phi_acc), math.sin(phi_acc), -w, dt_s))
        worst = max(worst, abs(state.phi_rad - wanted))
    return worst


@claim(
    "imu.backward_difference",
    "2.3",
    "the discrete filter is the continuous one (2.2) to first order in dt",
    basis="equations",
)
def backward_difference() -> Finding:
    coarse, fine = _largest_difference(0.01), _largest_difference(0.005)
    ratio = coarse / fine
    return Finding(
        f"error {1e3 * coarse:.2f} mrad at 100 Hz, {ratio:.2f} times that at 200 Hz",
        exactly(1.8 < ratio < 2.2),
        "largest distance from the exact solution of (2.2) for a sine with a gyro bias: half the step, half "
        "the error",
        {"error_100hz_rad": coarse, "ratio": ratio},
    )


CLAIMS = (onchip_drift, mm_gains, mm_drift, gyro_lsb, acc_lsb, backward_difference)
"""In the order of the source."""
