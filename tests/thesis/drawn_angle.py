"""Figures of the control of the angle: 4.2 to 4.5, 4.7 to 4.9.

In place of the source's experiments stand runs of the simulated rig in which the controller gets what the
firmware makes of the sensors' readings; what is shown is what it got. Models run on the true state. The
source's u2 drives the bellows that bends towards the reference; in the model's frame that is bellows 1.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from calib.core.arrays import FloatArray
from calib.stages.actuator.pump import PWM_MAX
from calib.stages.control.laws import PWM_MIN, LoopState, OrientationControl, Pid, step_orientation
from calib.stages.control.references import AngleSteps
from calib.twin.scenarios import StepResponse, make_scenario, run_scenario, step_response
from calib.twin.simulate import Run
from thesis.drawn import Band, Curve, Plot, drawn
from thesis.runs import nominal

__all__ = ["FIGURES", "GAINS", "WANTED_RAD", "angle_run", "unsaturated"]

GAINS = (500.0, 1000.0, 2000.0, 5000.0)
WANTED_RAD, _JUMP_RAD, _JUMP_S = 0.7, 0.3, 5.0
_PID = Pid(1000.0, 1000.0, 10.0)
_SEEN = "what the firmware sees of the simulated rig, feedback from its sensors at 60 Hz"


@lru_cache(maxsize=24)
def angle_run(controller: str, Kp: float = 1000.0, seconds: float = 5.0, feedback: str = "sensors") -> Run:
    """The simulated rig under control of its angle: 0.7 rad, and 0.3 rad from 5 s on."""
    options = {"controller": controller} | ({"Kp": str(Kp)} if controller == "p" else {})
    return run_scenario(make_scenario("orientation", options), nominal(), 0, feedback, seconds)


def _wanted(run: Run) -> FloatArray:
    return AngleSteps((WANTED_RAD, _JUMP_RAD), (_JUMP_S,)).angle_rad(run.t_s + 1e-9)


def _seen(run: Run) -> FloatArray:
    """The angle (n,) [rad] that the controller got."""
    assert run.seen is not None
    return np.asarray(run.seen[:, 0])


def unsaturated(run: Run, pid: Pid) -> FloatArray:
    """Outputs (n, 2) [PWM] of the controllers before the limits, from what they got in a run."""
    control, state, out = OrientationControl(pid), LoopState(), []
    for wanted, phi in zip(_wanted(run).tolist(), _seen(run).tolist(), strict=True):
        state, command = step_orientation(control, state, wanted, phi)
        out.append(command.feedback)
    return np.array(out)


def _response(run: Run, phi: FloatArray) -> StepResponse:
    return step_response(run.tick_s, phi[run.t_s < _JUMP_S - 1e-6], WANTED_RAD)


def _reference(run: Run) -> Curve:
    return Curve("reference", run.t_s, _wanted(run), "dotted", -1)


_LIMITS = (Band(PWM_MAX, 1e6, "beyond 255", True), Band(-1e6, PWM_MIN, "below 0", True))


@drawn("4.2", "p_control", "Angle with proportional control, four gains")
def p_control() -> Plot:
    runs = {gain: angle_run("p", gain) for gain in GAINS}
    peaks = {gain: float(run.phi_rad.max()) for gain, run in runs.items()}
    curves = [
        Curve(f"Kp = {gain:g}", run.t_s, _seen(run), colour=k) for k, (gain, run) in enumerate(runs.items())
    ]
    return Plot(
        "time (s)",
        "angle (rad)",
        (*curves, _reference(runs[500.0])),
        _SEEN,
        "True angles reach at most "
        + ", ".join(f"{peak:.3f}" for peak in peaks.values())
        + " rad: none reaches 0.7.",
        numbers={f"peak_{gain:g}_rad": peak for gain, peak in peaks.items()},
    )


@drawn("4.3", "p_control_output", "Output of the proportional controllers before the limits")
def p_output() -> Plot:
    outputs = {
        gain: (angle_run("p", gain), unsaturated(angle_run("p", gain), Pid(gain))[:, 0]) for gain in GAINS
    }
    free = {
        gain: float(run.t_s[np.argmax(u < PWM_MAX)]) if np.any(u < PWM_MAX) else float(run.t_s[-1])
        for gain, (run, u) in outputs.items()
    }
    curves = [
        Curve(f"Kp = {gain:g}", run.t_s, u, colour=k) for k, (gain, (run, u)) in enumerate(outputs.items())
    ]
    return Plot(
        "time (s)",
        "output of the driving controller (PWM)",
        tuple(curves),
        "the runs of Fig. 4.2",
        "They leave the limit of 255 after "
        + ", ".join(f"{t:.2f} s" for t in free.values())
        + "; until the first does, all four runs are the same.",
        _LIMITS[:1],
        {f"first_{gain:g}_pwm": float(u[0]) for gain, (_, u) in outputs.items()}
        | {f"free_{gain:g}_s": t for gain, t in free.items()},
        y_limits=(0.0, 3700.0),
    )


@drawn("4.4", "pid_control", "Angle with PID control")
def pid_control() -> Plot:
    run, model = angle_run("pid"), angle_run("pid", feedback="truth")
    seen, true = _response(run, _seen(run)), _response(model, model.phi_rad)
    return Plot(
        "time (s)",
        "angle (rad)",
        (
            Curve("seen by the firmware", run.t_s, _seen(run), colour=0),
            Curve("fed with the true state", model.t_s, model.phi_rad, "dashed", 1),
            _reference(run),
        ),
        f"{_SEEN}; and a run that gets the true angle. Kp = 1000, Ki = 1000, Kd = 10",
        f"Reached after {seen.reach_s or 0:.2f} s, peak {seen.peak:.3f} rad; with the true state "
        f"{true.reach_s or 0:.2f} s, {true.peak:.3f} rad, within 2 % after {true.settle_s or 0:.1f} s. "
        "The text: "
        "0.95 s, 0.729 rad, 2.3 s.",
        numbers={
            "reach_s": seen.reach_s or 0.0,
            "peak_rad": seen.peak,
            "true_reach_s": true.reach_s or 0.0,
            "true_peak_rad": true.peak,
            "true_settle_s": true.settle_s or 0.0,
        },
    )


@drawn("4.5", "pid_control_output", "Output of the PID controller before the limits")
def pid_output() -> Plot:
    run = angle_run("pid")
    u = unsaturated(run, _PID)
    free = float(run.t_s[np.argmax(u[:, 0] < PWM_MAX)])
    return Plot(
        "time (s)",
        "output (PWM)",
        (
            Curve("driving controller (the source's u2)", run.t_s, u[:, 0], colour=0),
            Curve("the other", run.t_s, u[:, 1], colour=1),
        ),
        "the run of Fig. 4.4 with sensors",
        f"Beyond 255 for the first {free:.2f} s; the text says 0.73 s. In the end {u[-60:, 0].mean():.0f}.",
        _LIMITS,
        {"free_s": free, "late_pwm": float(u[-60:, 0].mean()), "first_pwm": float(u[0, 0])},
        y_limits=(-1400.0, 1400.0),
    )


def _both() -> dict[str, tuple[Run, FloatArray]]:
    return {
        "PID": (angle_run("pid", seconds=10.0), unsaturated(angle_run("pid", seconds=10.0), _PID)),
        "PID with clamping": (
            angle_run("clamping", seconds=10.0),
            unsaturated(angle_run("clamping", seconds=10.0), Pid(1000.0, 1000.0, 10.0, clamping=True)),
        ),
    }


@drawn("4.7", "jump_with_and_without_clamping", "A jump of the reference, without and with anti-windup")
def jump() -> Plot:
    runs = _both()
    curves, told = [], []
    numbers: dict[str, float] = {}
    for k, (name, (run, _)) in enumerate(runs.items()):
        curves.append(Curve(name, run.t_s, _seen(run), colour=k))
        late = run.t_s >= _JUMP_S
        below = _JUMP_RAD - float(run.phi_rad[late].min())
        at_95 = float(run.t_s[np.argmax(run.phi_rad > 0.95 * WANTED_RAD)])
        told.append(f"{name} {max(below, 0.0):.3f} rad, 95 % of the first step after {at_95:.2f} s")
        word = "clamping" if "clamping" in name else "pid"
        numbers |= {f"{word}_overshoot_rad": below, f"{word}_to_95_percent_s": at_95}
    return Plot(
        "time (s)",
        "angle (rad)",
        (*curves, _reference(runs["PID"][0])),
        _SEEN,
        f"Overshoot after the jump: {'; '.join(told)}.",
        numbers=numbers,
    )


@drawn("4.8", "output_with_and_without_clamping", "Outputs of those controllers before the limits")
def jump_output() -> Plot:
    runs = _both()
    curves = [Curve(name, run.t_s, u[:, 0], colour=k) for k, (name, (run, u)) in enumerate(runs.items())]
    below = {
        name: float(np.sum(u[run.t_s >= _JUMP_S, 0] < PWM_MIN) * run.tick_s)
        for name, (run, u) in runs.items()
    }
    return Plot(
        "time (s)",
        "output of the driving controller (PWM)",
        tuple(curves),
        "the runs of Fig. 4.7",
        "Time below 0 after the jump: " + ", ".join(f"{name} {t:.2f} s" for name, t in below.items()) + ".",
        _LIMITS,
        {"pid_below_s": below["PID"], "clamping_below_s": below["PID with clamping"]},
        y_limits=(-700.0, 900.0),
    )


@drawn("4.9", "angle_runs_against_model", "Control of the angle: runs with sensors against the model")
def against_model() -> Plot:
    curves, off = [], {}
    cases = {**{f"Kp = {gain:g}": ("p", gain) for gain in GAINS}, "PID": ("pid", 1000.0)}
    for k, (name, (controller, gain)) in enumerate(cases.items()):
        run, model = angle_run(controller, gain), angle_run(controller, gain, feedback="truth")
        curves.append(Curve(name, run.t_s, _seen(run), "line", k))
        curves.append(Curve("", model.t_s, model.phi_rad, "dashed", k))
        off[name] = float((_seen(run) - model.phi_rad)[-60:].mean())
    share = float(np.mean(angle_run("pid", feedback="truth").pwm[:, 0] >= PWM_MAX))
    return Plot(
        "time (s)",
        "angle (rad)",
        tuple(curves),
        f"solid: {_SEEN}; dashed: the same controllers on the nominal model, fed with its true state",
        "At the end they differ by "
        + ", ".join(f"{1e3 * v:+.0f} mrad ({name})" for name, v in off.items())
        + f". The model's PID is at 255 for {100.0 * share:.0f} % of the 5 s, the source's for all of it.",
        numbers={f"off_{name.replace('Kp = ', 'p')}_rad": v for name, v in off.items()}
        | {"saturated": share},
    )


FIGURES = (p_control, p_output, pid_control, pid_output, jump, jump_output, against_model)
"""In the order of the source, but for the scheme of 4.6."""
