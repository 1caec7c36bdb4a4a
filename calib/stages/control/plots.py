"""Figures of controllers on the model: reference against result, commands, margins, what the pumps reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib.core import plot
from calib.stages.actuator.kinematics import angle, bellows, forward, length
from calib.stages.control import loops, reach, tuning
from calib.stages.control.references import Reference
from calib.stages.control.rig_model import Model, holding_force, largest_force_N
from calib.stages.control.section import Controller
from calib.stages.control.stage import Checked, ControllerEvidence, Runs
from calib.stages.control.trial import Outcome

_HUES = ("blue", "orange", "green", "red", "purple", "sky")


def run_plots(runs: Runs) -> dict[str, plot.Figure]:
    """`control_run`: at most the last six runs of controllers."""
    reference, shown = runs.reference, list(runs.outcomes)[-len(_HUES) :]
    angles = reference.kind == "angle"
    return {"control_run": _angles(runs.model, reference, shown) if angles else _lengths(reference, shown)}


def _over_time(
    y: str, marks: Sequence[plot.Mark], title: str, limits: plot.Limits | None = None
) -> plot.Plot:
    return plot.Plot("time (s)", y, marks, title, y_limits=limits)


def _commands(outcomes: Sequence[Outcome]) -> list[plot.Plot]:
    curves = [
        [plot.Curve(one.run.t_s, pwm, colour=hue, size=1.0) for pwm in one.run.pwm.T]
        for hue, one in zip(_HUES, outcomes, strict=False)
    ]
    return [
        _over_time("PWM", pump, f"Commands of pump {k}", (-10.0, 265.0))
        for k, pump in enumerate(zip(*curves, strict=True), start=1)
    ]


def _angles(model: Model, reference: Reference, outcomes: Sequence[Outcome]) -> plot.Figure:
    errors = (f"{one.controller} {plot.number(one.figures.angle_rms_rad, 'rad')}" for one in outcomes)
    note = f"Simulated. The RMS error of the angle is {', '.join(errors)}."
    marks = [plot.Curve(reference.t_s, reference.phi_rad, "reference", "dashed", "ink", 1.6)]
    for hue, one in zip(_HUES, outcomes, strict=False):
        phi = angle(one.run.states[:, :2], model.plant.bellows_radius_m)
        marks.append(plot.Curve(one.run.t_s, phi, one.controller, colour=hue, size=1.4))
    panels = (_over_time("angle (rad)", marks, "True angle"), *_commands(outcomes))
    title = f"Angle of the head: {plot.short(reference.name, 50)}"
    return plot.Figure(title, note, panels, 6.4, mosaic=("AA", "BC"), heights=(1.35, 1.0))


def _lengths(reference: Reference, outcomes: Sequence[Outcome]) -> plot.Figure:
    errors = (f"{one.controller} {plot.number(one.figures.head_rms_mm, 'mm')}" for one in outcomes)
    note = f"Simulated. The RMS error of the head's place is {', '.join(errors)}."
    t, q_mm = reference.t_s, 1e3 * reference.q_m
    lengths = [
        plot.Curve(t, q_mm[:, i], f"reference of bellows {i + 1}", kind, "ink", 1.6)
        for i, kind in enumerate(("dashed", "dotted"))
    ]
    missed: tuple[list[plot.Mark], list[plot.Mark]] = ([], [])
    worst = []
    for hue, one in zip(_HUES, outcomes, strict=False):
        q = 1e3 * one.run.states[:, :2]
        worst.append(float(np.percentile(np.abs(q_mm - q), 99)))
        for i in (0, 1):
            lengths.append(plot.Curve(t, q[:, i], "" if i else one.controller, colour=hue, size=1.2))
            missed[i].append(plot.Curve(t, q_mm[:, i] - q[:, i], colour=hue, size=1.1))
    worst.sort()
    # One controller that is far off would flatten the others.
    limit = 1.15 * (worst[-1] if len(worst) < 2 or worst[-1] < 4.0 * worst[-2] else worst[-2]) or 1.0
    panels = [_over_time("length (mm)", lengths, "True lengths")]
    for k, marks in enumerate(missed, start=1):
        panels.append(_over_time("error (mm)", marks, f"Error of bellows {k}", (-limit, limit)))
    title = f"Lengths of the bellows: {plot.short(reference.name, 50)}"
    panels += _commands(outcomes)
    return plot.Figure(title, note, panels, 8.6, mosaic=("AA", "BC", "DE"), heights=(1.3, 1.0, 0.9))


def tune_plots(section: Controller) -> dict[str, plot.Figure]:
    """`control_margins`: the tuned loops at their operating points."""
    fit: ControllerEvidence = section.evidence
    turn, move, wanted = section.orientation, section.position, section.criterion
    note = (
        f"Every rest keeps a gain margin of {wanted.gain_margin:g} and a phase margin of "
        f"{math.degrees(wanted.phase_margin_rad):.0f} deg. The angle has a PID of {turn.Kp_pwm_per_rad:g} / "
        f"{turn.Ki_pwm_per_rad_s:g} / {turn.Kd_pwm_s_per_rad:g}. The lengths have a PD of "
        f"{move.Kp_pwm_per_m:g} / {move.Kd_pwm_s_per_m:g}. Grey circles are 1 / Ms away from -1."
    )
    loops = (
        _loop(fit.model, "angle", tuning.orientation_loop, fit.orientation, wanted.sensitivity),
        _loop(fit.model, "lengths", tuning.position_loop, fit.position, wanted.sensitivity),
    )
    panels = tuple(panel for row in zip(*loops, strict=True) for panel in row)
    title = "Open loops on the model: gain, phase and distance from -1"
    return {"control_margins": plot.Figure(title, note, panels, 7.6, section.verdict.word, columns=2)}


def _loop(
    model: Model, name: str, loop_of: Callable[..., loops.System], tuned: tuning.Tuned, sensitivity: float
) -> tuple[plot.Plot, plot.Plot, plot.Plot]:
    """Gain, phase and Nyquist's curve of a loop at each rest."""
    w = loops.frequencies(model.tick_s, 1200)
    f = w / (2.0 * np.pi)
    gain: list[plot.Mark] = [plot.Rule("y", 0.0, "ink")]
    phase: list[plot.Mark] = [plot.Rule("y", -180.0, "ink")]
    minus_one = plot.Curve(np.array([-1.0]), np.zeros(1), kind="pluses", colour="ink", size=9.0)
    nyquist: list[plot.Mark] = [
        plot.Shape(plot.circle(-1.0, 0.0, 1.0 / sensitivity), "shade", "grey"),
        minus_one,
    ]
    for hue, point in zip(plot.spaced(len(tuned.points)).tolist(), tuned.points, strict=True):
        L = loops.break_at(loops.response(loop_of(model, tuned.pid, point.q_m), w), 0)
        label = " ".join(f"{1e3 * q:.1f}" for q in point.q_m)
        gain.append(plot.Curve(f, 20.0 * np.log10(np.maximum(np.abs(L), 1e-12)), label, colour=hue))
        phase.append(plot.Curve(f, np.degrees(np.unwrap(np.angle(L))), colour=hue))
        nyquist.append(plot.Curve(L.real, L.imag, colour=hue))
    x, title, limits = "frequency (Hz)", f"loop of the {name}", (0.02, float(f[-1]))
    gains = plot.Plot(x, "gain (dB)", gain, title.capitalize(), limits, (-50.0, 40.0), log="x")
    phases = plot.Plot(x, "phase (deg)", phase, f"Phase, {title}", limits, (-400.0, 20.0), log="x")
    x, y, limits = "real part", "imaginary part", (-2.2, 1.2)
    around = plot.Plot(x, y, nyquist, f"Nyquist, {title}", limits, (-1.3, 1.0), equal=True)
    legend = "q1 q2 at rest (mm)"
    return replace(gains, legend="lower left", legend_title=legend), phases, around


def check_plots(checked: Checked) -> dict[str, plot.Figure]:
    """`control_check`: what the pumps reach, and how far they follow a reference."""
    model, reference, following, slower = checked.model, checked.reference, checked.follow, checked.slower
    note = "The pumps can follow it."
    if not following.possible:
        note = f"The pumps cannot follow it from {following.at_s:.2f} s on: {following.reason}."
        if slower is not None:
            note += f" Slowed down to {slower.duration_s:.2f} s they can."
    t, r = reference.t_s, model.plant.bellows_radius_m
    place, head = [_reachable(model)], []
    for one, hue, kind in ((slower, "orange", "dashed"), (reference, "ink", "line")):
        if one is not None:
            p = 1e3 * forward(one.q_m, r)
            place.append(plot.Curve(angle(one.q_m, r), 1e3 * length(one.q_m), "", kind, hue, 1.4))
            head.append(plot.Curve(p[:, 0], p[:, 1], "", kind, hue, 1.4))
    force: list[plot.Mark] = []
    missing: list[plot.Mark] = []
    for i, hue in enumerate(("blue", "red")):
        force.append(
            plot.Curve(t, following.wanted_N[:, i], f"wanted, bellows {i + 1}", colour=hue, size=1.2)
        )
        force.append(plot.Curve(t, following.given_N[:, i], "", "dotted", hue, 1.6))
        missing.append(plot.Curve(t, 1e3 * following.missing_m[:, i], colour=hue, size=1.4))
    if following.at_s is not None:
        missing.append(plot.Rule("x", following.at_s, kind="dashed"))
    most = max(float(following.given_N.max()), 0.2)
    above = "Dotted: the nearest that the pumps can give"
    panels = (
        plot.Plot("angle (rad)", "length (mm)", place, "Blue: what the pumps can hold; line: reference"),
        _over_time("force (N)", force, above, (-0.25 * most, 1.45 * most)),
        plot.Plot("x (mm)", "y (mm)", head, "Head, as the camera sees it", equal=True, down=True),
        _over_time("missing (mm)", missing, "Lengths that are missing"),
    )
    title = f"Can the pumps follow {plot.short(reference.name, 50)}?"
    verdict = "ok" if following.possible else "poor"
    return {"control_check": plot.Figure(title, note, panels, 6.6, verdict, columns=2)}


def _reachable(model: Model) -> plot.Mark:
    """Where the pumps can hold the head, over its angle and the length in mm."""
    plant, rest = model.plant, model.plant.rest_length_m
    phi_most, l_most = 1.1 * reach.largest_angle(model), reach.longest_m(model)
    phi = np.linspace(-phi_most, phi_most, 161)
    l = np.linspace(rest - 0.1 * (l_most - rest), l_most + 0.05 * (l_most - rest), 121)  # noqa: E741  the source's symbol
    F = holding_force(plant, bellows(phi, l[:, None], plant.bellows_radius_m))
    spare = np.minimum(F, largest_force_N(model) - F).min(axis=-1)
    levels = np.array([0.0, spare.max()])
    # One light shade.
    return plot.Field(phi, 1e3 * l, spare, levels=levels, outlined=levels[:1], scale=(0.0, 3.0 * levels[1]))
