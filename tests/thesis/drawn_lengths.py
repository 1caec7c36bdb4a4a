"""Figures of feed-forward and of the length along a set-point: 4.11 to 4.13, 4.22, 4.23.

Runs with sensors are of a rig whose pumps are not alike (2 % and 3 % off); models are nominal.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.pump import ElongationForce
from calib.stages.control.laws import FeedForward, feed_forward
from calib.stages.control.references import PolynomialElongation
from calib.twin.rig import SimulatedRig
from calib.twin.scenarios import make_scenario, run_scenario
from calib.twin.simulate import Run
from thesis.drawn import Band, Curve, Plot, drawn
from thesis.runs import PRINTED_C_DMP, nominal, with_plant

__all__ = ["FIGURES", "length_run", "unlike_rig"]

_REST_M = 0.065
_START_M = 0.0681
_SHOWN_S = 3.0
_SEEN = "what the firmware sees of a simulated rig with unlike pumps, feedback from its sensors"


def unlike_rig() -> SimulatedRig:
    """The nominal rig with pumps that are not alike, as the source's two bellows differ."""
    return replace(nominal(), pump_strength=(1.02, 0.97))


@lru_cache(maxsize=8)
def length_run(controller: str, feedback: str = "sensors", start_m: float = 0.065, c_dmp: float = 0.0) -> Run:
    """A run along (4.7): with sensors of the rig with unlike pumps, with the truth of the nominal one."""
    scenario = make_scenario("elongation", {"controller": controller, "start_m": str(start_m)})
    rig = unlike_rig() if feedback == "sensors" else nominal()
    if c_dmp:
        rig = with_plant(damping_scale=c_dmp)
    return run_scenario(scenario, rig, 0, feedback, 10.0)


def _wanted(run: Run) -> FloatArray:
    return PolynomialElongation().bellows_m(run.t_s)


def _seen_length(run: Run) -> FloatArray:
    """Length (n,) [m] of the backbone as the controller got it."""
    assert run.seen is not None
    return np.asarray(run.seen[:, 1:].mean(axis=1))


@drawn("4.11", "feed_forward_profile", "The feed-forward over the wanted length of a bellows")
def profile() -> Plot:
    line = FeedForward()
    q = np.concatenate([np.linspace(0.062, line.from_m - 1e-9, 40), np.linspace(line.from_m, 0.097, 160)])
    given = np.array([feed_forward(line, value) for value in q.tolist()])
    pwm = np.linspace(100.0, 255.0, 120)
    law = ElongationForce()
    mm = np.polyval(law.elongation_mm, law.supply_V * pwm / 255.0)
    steady = np.asarray(_REST_M + 1e-3 * mm)
    return Plot(
        "wanted length of a bellows (mm)",
        "feed-forward (PWM)",
        (
            Curve("(4.6)", 1e3 * q, given, colour=0),
            Curve("steady lengths of (2.13), corrected", 1e3 * steady, pwm, "dashed", 1),
        ),
        "(4.6), and (2.13) with 3.756 for 3.376, from the equations alone",
        f"At 91 mm it gives {feed_forward(line, 0.091):.0f}; it saturates at "
        f"{1e3 * line.saturates_at_m:.1f} mm.",
        numbers={"at_91mm_pwm": feed_forward(line, 0.091), "saturates_mm": 1e3 * line.saturates_at_m},
    )


@drawn("4.12", "length_with_three_controllers", "Length along the third-order set-point, three controllers")
def three_controllers() -> Plot:
    names = {"pd+ff": "PD with feed-forward", "pd": "PD", "pid": "PID"}
    runs = {name: length_run(name) for name in names}
    rms = {
        name: float(np.sqrt(np.mean((1e3 * (_wanted(run) - run.states[:, :2])) ** 2)))
        for name, run in runs.items()
    }
    late = float(runs["pid"].t_s[np.argmax(runs["pid"].states[:, 0] > _REST_M + 5e-4)])
    first = runs["pd"]
    curves = [
        Curve(words, runs[name].t_s, 1e3 * _seen_length(runs[name]), colour=k)
        for k, (name, words) in enumerate(names.items())
    ]
    return Plot(
        "time (s)",
        "length of the actuator (mm)",
        (*curves, Curve("reference", first.t_s, 1e3 * _wanted(first)[:, 0], "dotted", -1)),
        f"{_SEEN}. Kp = 15000, Kd = 150, Ki = 8000",
        "RMS of the true lengths' errors: "
        + ", ".join(f"{names[n]} {v:.2f} mm" for n, v in rms.items())
        + f". PID begins to move after {late:.2f} s.",
        numbers={f"rms_{name.replace('+', '_')}_mm": v for name, v in rms.items()}
        | {
            "pid_moves_s": late,
            "pd_end_mm": float(1e3 * first.states[-1, :2].mean()),
            "pdff_end_mm": float(1e3 * runs["pd+ff"].states[-1, :2].mean()),
        },
    )


@drawn("4.13", "length_errors", "Errors of both bellows with PD and feed-forward")
def errors() -> Plot:
    run = length_run("pd+ff")
    assert run.seen is not None
    e = 1e3 * (_wanted(run) - run.seen[:, 1:])
    late = run.t_s >= 6.0
    static = e[late].mean(axis=0).tolist()
    true = 1e3 * (_wanted(run) - run.states[:, :2])
    return Plot(
        "time (s)",
        "reference less length (mm)",
        (
            Curve("bellows 1", run.t_s, e[:, 0], colour=0),
            Curve("bellows 2", run.t_s, e[:, 1], colour=1),
        ),
        "the run of Fig. 4.12 with PD and feed-forward, as the firmware sees it",
        f"At most {np.abs(e).max():.2f} mm ({np.abs(true).max():.2f} mm in truth); static "
        f"{static[0]:+.2f} and "
        f"{static[1]:+.2f} mm after 6 s. The text: 2.149 mm, -0.303 and -0.068 mm.",
        (Band(6.0, 10.0, "static"),),
        {
            "largest_mm": float(np.abs(e).max()),
            "largest_true_mm": float(np.abs(true).max()),
            "static_q1_mm": static[0],
            "static_q2_mm": static[1],
        },
    )


@drawn("4.22", "length_against_model", "Length along the set-point: run with sensors against the model")
def against_model() -> Plot:
    run = length_run("pd+ff", start_m=_START_M)
    model = length_run("pd+ff", "truth", _START_M)
    printed = length_run("pd+ff", "truth", _START_M, PRINTED_C_DMP)
    nodes = printed.trajectory.nodes[:, :2].mean(axis=1)
    low = int(np.argmin(nodes[:75]))
    back = float(1e3 * (nodes[low : low + 60].max() - nodes[low]))
    t, some = run.t_s, run.t_s <= _SHOWN_S
    t = t[some]
    return Plot(
        "time (s)",
        "length of the actuator (mm)",
        (
            Curve("printed damping", t, 1e3 * printed.states[some, :2].mean(axis=1), colour=1),
            Curve("nominal model", t, 1e3 * model.states[some, :2].mean(axis=1), colour=0),
            Curve("seen by the firmware", t, 1e3 * _seen_length(run)[some], "points", -1),
            Curve("reference", t, 1e3 * _wanted(run)[some, 0], "dotted", -1),
        ),
        f"{_SEEN}, from l(0) = 68.1 mm; PD with feed-forward. Models fed with the true state",
        f"With c_dmp of Table 3.2 the length swings back by {back:.1f} mm at the start, as in the source's "
        "simulation; damped as with connected pumps it does not. The first 3 s of 10.",
        numbers={"swings_back_mm": back},
    )


@drawn("4.23", "length_difference", "Model less run with sensors, of the length")
def difference() -> Plot:
    run = length_run("pd+ff", start_m=_START_M)
    model = length_run("pd+ff", "truth", _START_M)
    e = 1e3 * (model.states[:, :2].mean(axis=1) - _seen_length(run))
    late = run.t_s >= 6.0
    return Plot(
        "time (s)",
        "model less run (mm)",
        (Curve("nominal model less run", run.t_s, e, colour=0),),
        "the runs of Fig. 4.22",
        f"At most {np.abs(e).max():.2f} mm; {e[late].mean():+.2f} mm on average after 6 s. While the length "
        "rises the run is late by the low-pass of 1 Hz.",
        numbers={"largest_mm": float(np.abs(e).max()), "late_mm": float(e[late].mean())},
    )


BEFORE = (profile, three_controllers, errors)
AFTER = (against_model, difference)
FIGURES = (*BEFORE, *AFTER)
"""In the order of the source."""
