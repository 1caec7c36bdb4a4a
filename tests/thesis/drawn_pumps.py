"""Figures of the pumps: steady angle and force 3.16, 3.17, steps and deflation 3.23, 3.24."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.pump import Orifice
from calib.stages.actuator.simulate import STATE
from calib.twin.scenarios import at_rest, elongation_mm, fall_time_s, tick_times
from calib.twin.simulate import Run, simulate
from thesis.drawn import Band, Curve, Plot, drawn
from thesis.drawn_sensors import seen_elongation_mm
from thesis.drawn_swings import other_rig
from thesis.runs import PRINTED_RATE, nominal, tried, with_pump

__all__ = ["FIGURES", "bent_runs", "leaking_rig", "steady_angles"]

_VOLTS = (5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0)
_ON_S = 8.0
_T_OF_TWO = 4.303
_THREE = 3


@lru_cache(maxsize=1)
def bent_runs() -> tuple[Run, ...]:
    """The simulated rig with one pump at each of the voltages, the other off, for 8 s."""
    rig = nominal()
    ticks = round(_ON_S / rig.pump.tick_s)
    out = []
    for volt in _VOLTS:
        pwm = np.zeros((ticks, 2))
        pwm[tick_times(rig, ticks) >= 0.5, 0] = 255.0 * volt / 12.0
        out.append(simulate(rig, at_rest(rig), pwm, ticks, 0, "truth"))
    return tuple(out)


@lru_cache(maxsize=1)
def steady_angles() -> tuple[FloatArray, FloatArray]:
    """Angles [rad] (voltages, 3) by the accelerometer in three stretches of the last 3 s, and true ones."""
    seen, true = [], []
    for run in bent_runs():
        acc = np.arctan2(run.accel_mps2[:, 1], run.accel_mps2[:, 0])
        seen.append(
            [
                float(acc[(run.imu.taken_s >= _ON_S - 3 + k) & (run.imu.taken_s < _ON_S - 2 + k)].mean())
                for k in range(_THREE)
            ]
        )
        true.append(float(run.phi_rad[-1]))
    return np.array(seen), np.array(true)


@drawn("3.16", "steady_angle", "Steady angle over the voltage of one motor, the other off")
def steady_angle() -> Plot:
    seen, true = steady_angles()
    mean, spread = seen.mean(axis=1), _T_OF_TWO * seen.std(axis=1, ddof=1) / math.sqrt(_THREE)
    volts = np.array(_VOLTS)
    return Plot(
        "motor input (V)",
        "angle (rad)",
        (
            Curve("mean of three seconds, 95 %", volts, mean, "bars", -1, spread),
            Curve("truth", volts, true, "line", 0),
        ),
        "eight runs of 8 s of the simulated rig, angle by its accelerometer",
        f"{true[-1]:.3f} rad at 12 V. The accelerometer is {1e3 * float(np.mean(mean - true)):.0f} mrad off "
        "on average, by its bias and mount.",
        numbers={"at_12V_rad": float(true[-1]), "bias_rad": float(np.mean(mean - true))},
    )


@drawn("3.17", "spring_force_at_steady_angle", "Spring force of the bellows at those angles")
def spring_force() -> Plot:
    law = nominal().plant.stiffness
    q = np.array([run.states[-1, :2] for run in bent_runs()])
    phi = np.array([run.phi_rad[-1] for run in bent_runs()])
    eps = q - nominal().plant.rest_length_m
    force = np.array([[law.secant(e) * e for e in row] for row in eps.tolist()])
    bending = nominal().plant.bending_N_per_rad2 * phi * np.abs(phi)
    pump = np.array([run.states[-1, STATE.index("force1_N")] for run in bent_runs()])
    return Plot(
        "angle (rad)",
        "force (N)",
        (
            Curve("spring of the driven bellows (3.38)", phi, force[:, 0], colour=0),
            Curve("spring of the other", phi, force[:, 1], "points", 1),
            Curve("k phi^2 of (3.44)", phi, bending, "dashed", 2),
            Curve("driving pump", phi, pump, "points", -1),
        ),
        "the end of each run of Fig. 3.16",
        f"At {phi[-1]:.2f} rad the spring takes {force[-1, 0]:.2f} N and the bending {bending[-1]:.3f} N of "
        f"the pump's {pump[-1]:.2f} N.",
        numbers={
            "spring_N": float(force[-1, 0]),
            "bending_N": float(bending[-1]),
            "pump_N": float(pump[-1]),
        },
    )


@drawn("3.23", "steps_against_model", "Elongation after a step: the pump's model against another rig")
def steps_against_model() -> Plot:
    curves, off = [], {}
    for k, volt in enumerate((6.0, 8.0, 10.0, 12.0)):
        other, _ = tried("deflate", _ON_S, rig=other_rig(), volt=str(volt), off_at_s="100")
        model, _ = tried("deflate", _ON_S, volt=str(volt), off_at_s="100")
        seen = seen_elongation_mm(other)
        curves.append(Curve(f"{volt:g} V", other.t_s, seen, "line", k))
        curves.append(Curve("", model.t_s, elongation_mm(model), "dashed", k))
        off[volt] = float(elongation_mm(model)[-1] - elongation_mm(other)[-1])
    told = ", ".join(f"{value:+.2f} mm at {volt:g} V" for volt, value in off.items())
    return Plot(
        "time (s)",
        "elongation (mm)",
        tuple(curves),
        "solid: a simulated rig that is softer and has unlike pumps, by its camera; dashed: the nominal "
        "model "
        "with lag, delay and static force",
        f"At the end the model is off by {told}.",
        numbers={f"off_{volt:g}V_mm": value for volt, value in off.items()},
    )


@lru_cache(maxsize=1)
def leaking_rig() -> Run:
    """Deflation of a rig whose air leaves through an orifice."""
    rig = nominal()
    return tried("deflate", 14.0, rig=replace(rig, pump=replace(rig.pump, deflation=Orifice())))[0]


@drawn("3.24", "inflation_and_deflation", "Both motors at 12 V for 5 s, then off: models against an orifice")
def deflation() -> Plot:
    other = leaking_rig()
    limited, _ = tried("deflate", 14.0)
    printed, _ = tried("deflate", 14.0, rig=with_pump(PRINTED_RATE))
    off = round(5.0 / other.tick_s)
    times = {
        name: fall_time_s(run.tick_s, elongation_mm(run)[off:]) or math.nan
        for name, run in (("orifice", other), ("0p4", limited), ("2", printed))
    }
    return Plot(
        "time (s)",
        "elongation (mm)",
        (
            Curve("rig with an orifice", other.t_s, seen_elongation_mm(other), "points", -1),
            Curve("falling limit of 0.4 N/s", limited.t_s, elongation_mm(limited), colour=0),
            Curve("printed limit of 2 N/s", printed.t_s, elongation_mm(printed), "dashed", 1),
        ),
        "points: the camera's lengths of a simulated rig whose air leaves through an orifice; lines: nominal "
        "model with a limit on the falling force",
        f"To 5 % of the elongation: {times['orifice']:.2f} s, {times['0p4']:.2f} s with 0.4 N/s, "
        f"{times['2']:.2f} s with the printed 2 N/s; the text says about 5 s. None falls below the rest "
        "length.",
        (Band(0.0, 5.0, "motors on"),),
        {f"deflation_{name}_s": value for name, value in times.items()},
        y_limits=(-1.5, 31.0),
    )


STEADY = (steady_angle, spring_force)
MOVING = (steps_against_model, deflation)
FIGURES = (*STEADY, *MOVING)
"""In the order of the source."""
