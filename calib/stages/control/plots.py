"""Figures of controllers on the model: reference against result, commands, margins, what the pumps reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from calib.show.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SHADE,
    SKY,
    VERMILLION,
    figure_folder,
    look,
    number,
    plain,
    save,
    sheet,
    view_colours,
)
from calib.stages.actuator.kinematics import angle, forward, length
from calib.stages.control.laws import Model, Pid, holding_force, largest_force_N
from calib.stages.control.linear import break_at, frequencies, response
from calib.stages.control.references import Reference
from calib.stages.control.section import Controller
from calib.stages.control.stage import Outcome
from calib.stages.control.tuning import (
    Following,
    Tuned,
    largest_angle,
    longest_m,
    orientation_loop,
    position_loop,
)

_COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY)
_MOST = 6


def write_run_figures(
    folder: Path, model: Model, reference: Reference, outcomes: Sequence[Outcome]
) -> list[Path]:
    """Draw runs of controllers into a folder made if needed; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    shown = list(outcomes)[-_MOST:]
    with look():
        figure = _angles(model, reference, shown) if reference.kind == "angle" else _lengths(reference, shown)
        return [save(figure, folder / "control_run.png")]


def _grid(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title)
    axes.grid()


def _legend(figure: Figure, axes: Axes) -> None:
    """Below all panels, where no line is."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7), handlelength=1.4)


def _commands(axes: Axes, outcomes: Sequence[Outcome], pump: int) -> None:
    for colour, one in zip(_COLOURS, outcomes, strict=False):
        axes.plot(one.run.t_s, one.run.pwm[:, pump], color=colour, linewidth=1.0)
    axes.set_ylim(-10.0, 265.0)
    _grid(axes, "time (s)", "PWM", f"Commands of pump {pump + 1}")


def _angles(model: Model, reference: Reference, outcomes: Sequence[Outcome]) -> Figure:
    note = (
        "Simulated. RMS of the angle: "
        + ", ".join(f"{plain(o.controller)} {number(o.figures.angle_rms_rad, 'rad')}" for o in outcomes)
        + "."
    )
    figure = sheet(6.4, f"Angle of the head: {plain(reference.name, 50)}", note)
    axes = figure.subplot_mosaic([["phi", "phi"], ["one", "two"]], height_ratios=[1.35, 1.0])
    top = axes["phi"]
    top.plot(reference.t_s, reference.phi_rad, color=INK, linewidth=1.6, linestyle="--", label="reference")
    for colour, one in zip(_COLOURS, outcomes, strict=False):
        phi = angle(one.run.states[:, :2], model.plant.bellows_radius_m)
        top.plot(one.run.t_s, phi, color=colour, linewidth=1.4, label=plain(one.controller))
    _grid(top, "time (s)", "angle (rad)", "True angle")
    _legend(figure, top)
    _commands(axes["one"], outcomes, 0)
    _commands(axes["two"], outcomes, 1)
    return figure


def _lengths(reference: Reference, outcomes: Sequence[Outcome]) -> Figure:
    parts = [f"{plain(o.controller)} {number(o.figures.head_rms_mm, 'mm')}" for o in outcomes]
    note = f"Simulated. RMS of the head's place: {', '.join(parts)}."
    figure = sheet(8.6, f"Lengths of the bellows: {plain(reference.name, 50)}", note)
    axes = figure.subplot_mosaic([["q", "q"], ["e1", "e2"], ["one", "two"]], height_ratios=[1.3, 1.0, 0.9])
    top, t = axes["q"], reference.t_s
    for i, style in ((0, "--"), (1, ":")):
        label = f"reference of bellows {i + 1}"
        top.plot(t, 1e3 * reference.q_m[:, i], color=INK, linewidth=1.6, linestyle=style, label=label)
    for colour, one in zip(_COLOURS, outcomes, strict=False):
        q = 1e3 * one.run.states[:, :2]
        top.plot(t, q[:, 0], color=colour, linewidth=1.2, label=plain(one.controller))
        top.plot(t, q[:, 1], color=colour, linewidth=1.2)
    _grid(top, "time (s)", "length (mm)", "True lengths")
    _legend(figure, top)
    errors = [1e3 * (reference.q_m - one.run.states[:, :2]) for one in outcomes]
    worst = sorted(float(np.percentile(np.abs(e), 99)) for e in errors)
    # One controller that is far off would flatten the others.
    limit = 1.15 * (worst[-1] if len(worst) < 2 or worst[-1] < 4.0 * worst[-2] else worst[-2]) or 1.0
    for i, name in ((0, "e1"), (1, "e2")):
        for colour, e in zip(_COLOURS, errors, strict=False):
            axes[name].plot(t, e[:, i], color=colour, linewidth=1.1)
        axes[name].set_ylim(-limit, limit)
        _grid(axes[name], "time (s)", "error (mm)", f"Error of bellows {i + 1}")
    _commands(axes["one"], outcomes, 0)
    _commands(axes["two"], outcomes, 1)
    return figure


def write_tune_figures(
    folder: Path, model: Model, section: Controller, orientation: Tuned, position: Tuned
) -> list[Path]:
    """Draw the tuned loops at their operating points into a folder; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        return [save(_bode(model, section, orientation, position), folder / "control_margins.png")]


def _bode(model: Model, section: Controller, orientation: Tuned, position: Tuned) -> Figure:
    turn, move, wanted = section.orientation, section.position, section.criterion
    note = (
        f"Every rest keeps a gain margin of {wanted.gain_margin:g} and a phase margin of "
        f"{math.degrees(wanted.phase_margin_rad):.0f} deg. Angle: PID {turn.Kp_pwm_per_rad:g} / "
        f"{turn.Ki_pwm_per_rad_s:g} / {turn.Kd_pwm_s_per_rad:g}. Lengths: PD {move.Kp_pwm_per_m:g} / "
        f"{move.Kd_pwm_s_per_m:g}. Grey circles: distance 1 / Ms from -1."
    )
    figure = sheet(7.6, "Open loops on the model: gain, phase and distance from -1", note, section.verdict)
    panels = figure.subplots(3, 2)
    w = frequencies(model.tick_s, 1200)
    f = w / (2.0 * np.pi)
    for column, (name, tuned) in enumerate((("angle", orientation), ("lengths", position))):
        gain, phase, nyquist = panels[:, column]
        nyquist.add_patch(
            Circle((-1.0, 0.0), 1.0 / wanted.sensitivity, facecolor=SHADE, edgecolor=GREY, linewidth=0.8)
        )
        nyquist.plot([-1.0], [0.0], "+", color=INK, markersize=9)
        for colour, point in zip(view_colours(len(tuned.points)), tuned.points, strict=True):
            pid: Pid = tuned.pid
            make = orientation_loop if name == "angle" else position_loop
            L = break_at(response(make(model, pid, point.q_m), w), 0)
            label = " ".join(f"{1e3 * q:.1f}" for q in point.q_m)
            gain.plot(f, 20.0 * np.log10(np.maximum(np.abs(L), 1e-12)), color=colour, label=label)
            phase.plot(f, np.degrees(np.unwrap(np.angle(L))), color=colour)
            nyquist.plot(L.real, L.imag, color=colour, linewidth=1.2)
        for axes in (gain, phase):
            axes.set_xscale("log")
            axes.set_xlim(0.02, f[-1])
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        gain.axhline(0.0, color=INK, linewidth=0.8)
        gain.set_ylim(-50.0, 40.0)
        gain.legend(loc="lower left", ncols=2, title="q1 q2 at rest (mm)", fontsize=9, title_fontsize=9)
        _grid(gain, "frequency (Hz)", "gain (dB)", f"Loop of the {name}")
        phase.axhline(-180.0, color=INK, linewidth=0.8)
        phase.set_ylim(-400.0, 20.0)
        _grid(phase, "frequency (Hz)", "phase (deg)", f"Phase, loop of the {name}")
        nyquist.set_aspect("equal", adjustable="box")
        nyquist.set_xlim(-2.2, 1.2)
        nyquist.set_ylim(-1.3, 1.0)
        _grid(nyquist, "real part", "imaginary part", f"Nyquist, loop of the {name}")
    return figure


def write_check_figures(
    folder: Path, model: Model, reference: Reference, found: Following, slower: Reference | None = None
) -> list[Path]:
    """Draw what the pumps reach and how far they follow a reference; the files written.

    Raises `BadInputError` where the folder or a file cannot be written.
    """
    figure_folder(folder)
    with look():
        return [save(_check(model, reference, found, slower), folder / "control_check.png")]


def _reachable(axes: Axes, model: Model) -> None:
    plant = model.plant
    phi_most, l_most = 1.1 * largest_angle(model), longest_m(model)
    phi = np.linspace(-phi_most, phi_most, 161)
    rest = plant.rest_length_m
    span = l_most - rest
    l = np.linspace(rest - 0.1 * span, l_most + 0.05 * span, 121)  # noqa: E741  the source's symbol
    turned = plant.bellows_radius_m * phi[None, :]
    q = np.stack([l[:, None] + turned, l[:, None] - turned], axis=-1)
    F = holding_force(plant, q)
    spare = np.minimum(F, largest_force_N(model) - F).min(axis=-1)
    axes.contourf(phi, 1e3 * l, spare, levels=[0.0, np.inf], colors=["#d8e9f4"])
    axes.contour(phi, 1e3 * l, spare, levels=[0.0], colors=[BLUE], linewidths=1.2)


def _check(model: Model, reference: Reference, found: Following, slower: Reference | None) -> Figure:
    if found.possible:
        note = "The pumps can follow it."
    else:
        note = f"The pumps cannot follow it from {found.at_s:.2f} s on: {plain(found.reason)}."
        if slower is not None:
            note += f" Slowed down to {slower.duration_s:.2f} s they can."
    verdict = "ok" if found.possible else "poor"
    figure = sheet(6.6, f"Can the pumps follow {plain(reference.name, 50)}?", note, verdict)
    (place, force), (head, missing) = figure.subplots(2, 2)
    r, t = model.plant.bellows_radius_m, reference.t_s
    _reachable(place, model)
    for one, colour, style in ((slower, ORANGE, "--"), (reference, INK, "-")):
        if one is not None:
            place.plot(angle(one.q_m, r), 1e3 * length(one.q_m), color=colour, linestyle=style, linewidth=1.4)
            p = forward(one.q_m, r)
            head.plot(1e3 * p[:, 0], 1e3 * p[:, 1], color=colour, linestyle=style, linewidth=1.4)
    _grid(place, "angle (rad)", "length (mm)", "Blue: what the pumps can hold; line: reference")
    head.invert_yaxis()
    head.set_aspect("equal", adjustable="datalim")
    _grid(head, "x (mm)", "y (mm)", "Head, as the camera sees it")
    most = float(found.given_N.max())
    for i, colour in ((0, BLUE), (1, VERMILLION)):
        force.plot(t, found.wanted_N[:, i], color=colour, linewidth=1.2, label=f"wanted, bellows {i + 1}")
        force.plot(t, found.given_N[:, i], color=colour, linewidth=1.6, linestyle=":")
        missing.plot(t, 1e3 * found.missing_m[:, i], color=colour, linewidth=1.4)
    force.set_ylim(-0.25 * max(most, 0.2), 1.45 * max(most, 0.2))
    _grid(force, "time (s)", "force (N)", "Dotted: the nearest that the pumps can give")
    force.legend(loc="upper right", handlelength=1.4)
    if found.at_s is not None:
        missing.axvline(found.at_s, color=GREY, linewidth=1.2, linestyle="--")
    _grid(missing, "time (s)", "missing (mm)", "Lengths that are missing")
    return figure
