"""`calib control`: controllers tried on the identified model before the hardware."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.core.errors import EXIT_POOR, UsageError

if TYPE_CHECKING:
    from calib.core.rig import Rig
    from calib.stages.control.laws import Model
    from calib.stages.control.section import Controller, ControllerMargins
    from calib.stages.control.stage import Outcome
    from calib.twin.rig import SimulatedRig

__all__ = ["control"]

control = typer.Typer(
    name="control", help="Try controllers on the identified model before the hardware.", no_args_is_help=True
)

_REFERENCE = (
    "elongation, step, jump, ellipse, a CSV with t_s and q1_m, q2_m, or x_m, y_m, or phi_rad, "
    "or a recorded log."
)
ReferenceArgument = Annotated[str, typer.Argument(help=_REFERENCE)]
LimitsOption = Annotated[
    str | None, typer.Option("--pwm-limits", help="PWM values between which commands stay, as 0,255.")
]
DurationOption = Annotated[str | None, typer.Option(help="Length of a reference by name, such as 30s.")]


def _limits(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--pwm-limits: {text!r} is not two numbers, expected for instance 0,255") from None
    if not (math.isfinite(low) and math.isfinite(high)):
        raise UsageError(f"--pwm-limits: {text!r} is not two finite numbers, expected for instance 0,255")
    return low, high


def _known(path: Path, limits: str | None) -> tuple[Rig, SimulatedRig, Model]:
    from calib.core.rig import read_rig
    from calib.stages.control.stage import control_model
    from calib.twin.rig import rig_from_file

    typed = _limits(limits)
    rig = read_rig(path)
    camera = None if rig.camera is None else rig.camera.optics
    machine = rig_from_file(rig, str(path), camera)
    return rig, machine, control_model(machine, rig.controller, typed)


def _workspace(rig: Rig) -> tuple[float, float, float, float]:
    from calib.core.rig import Geometry

    x0, y0, x1, y1 = (rig.geometry or Geometry()).workspace_m
    return x0, y0, x1, y1


def _duration_s(text: str | None) -> float | None:
    from calib.core.units import parse_duration_s

    return None if text is None else parse_duration_s(text, "--duration")


@control.command("run")
def run(
    reference: ReferenceArgument,
    controllers: Annotated[
        list[str] | None,
        typer.Option(
            "--controller",
            help="p, pid, clamping, back, pd, pd+ff, pd+map, torque, tuned-pid, tuned-pd; may be repeated. "
            "[default: all that suit the reference]",
        ),
    ] = None,
    feedback: Annotated[
        str, typer.Option(help="What controllers get: sensors, simulated with their noise, or truth.")
    ] = "sensors",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sensors' noise.")] = 0,
    duration: DurationOption = None,
    limits: LimitsOption = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Run controllers along a reference on the simulated rig, from rest, and compare their errors.

    The plant is that of the sections actuator and pump, the nominal one without.
    """
    from calib.core.files import check_folder
    from calib.stages.control.read import wanted_reference
    from calib.stages.control.references import check_workspace
    from calib.stages.control.results import check_json, outcome_json
    from calib.stages.control.stage import CONTROLLERS, controllers_for, run_controller
    from calib.stages.control.tuning import follow
    from calib.twin.simulate import FEEDBACKS

    if feedback not in FEEDBACKS:
        raise UsageError(f"--feedback: {feedback!r} is not one of {', '.join(FEEDBACKS)}")
    for name in controllers or []:
        if name not in CONTROLLERS:
            raise UsageError(f"--controller: {name!r} is not one of {', '.join(CONTROLLERS)}")
    if figures is not None:
        check_folder(figures)
    known, machine, model = _known(rig, limits)
    wanted = wanted_reference(reference, model, _duration_s(duration), known, rig)
    check_workspace(model, wanted, _workspace(known))
    found = follow(model, wanted.path_m(model.plant.rest_length_m))
    names = controllers or list(controllers_for(wanted, known.controller))
    outcomes = []
    with progress_bar("simulating") as progress:
        for done, name in enumerate(names):
            progress(done, len(names))
            outcomes.append(run_controller(name, machine, model, wanted, known.controller, seed, feedback))
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.control.plots import run_plots

        write_figures(figures, run_plots(model, wanted, outcomes))
        narrate(f"figures in {figures}")
    told: dict[str, Any] = {"feedback": feedback, "seed": seed, **check_json(wanted, found)}
    if as_json:
        document("control run", {"control": {**told, "runs": [outcome_json(one) for one in outcomes]}})
        return
    say(f"{wanted.name}: {wanted.duration_s:g} s at {1.0 / model.tick_s:g} Hz, feedback from {feedback}")
    _tell_runs(outcomes, wanted.kind, wanted.jump_s is not None)
    if not found.possible:
        say(f"the pumps cannot follow it: at {found.at_s:.2f} s {found.reason}")
    narrate("simulated: a model of a rig, not the rig")


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def _tell_runs(outcomes: list[Outcome], kind: str, jumps: bool) -> None:
    head = ["", "rms rad", "largest rad"]
    if kind == "lengths":
        head = ["", "rms q1 mm", "rms q2 mm", "rms head mm", "largest mm", "rms rad"]
    else:
        head += ["to 95 % s", "reach s", "overshoot", "settle s"]
        head += ["after jump", "settle s"] if jumps else []
    head += ["saturated", "PWM steps"]
    rows = []
    for one in outcomes:
        f = one.figures
        if kind == "lengths":
            row = [*(_number(v) for v in f.rms_mm), _number(f.head_rms_mm), _number(f.largest_mm)]
            row.append(_number(f.angle_rms_rad, 4))
        else:
            row = [_number(f.angle_rms_rad, 4), _number(f.largest_rad, 4), _number(f.rise_s, 2)]
            row += [_number(f.reach_s, 2), _number(f.overshoot_rad, 4), _number(f.settling_s, 2)]
            row += [_number(f.jump_overshoot_rad, 4), _number(f.jump_settling_s, 2)] if jumps else []
        row.append(" ".join(f"{share:.0%}" for share in f.saturation))
        rows.append([one.controller, *row, f"{f.changes_pwm:.1f}"])
    for line in table(head, rows):
        say(line)


@control.command("check")
def check(
    reference: ReferenceArgument,
    slow: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Write the reference slowed down so far that the pumps follow it."),
    ] = None,
    duration: DurationOption = None,
    limits: LimitsOption = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Whether the pumps can follow a reference, and the first second at which they cannot.

    Exits 1 when they cannot.
    """
    from calib.core.errors import BadInputError
    from calib.core.files import check_folder, check_writable
    from calib.stages.control.read import wanted_reference, write_reference
    from calib.stages.control.references import check_workspace, from_lengths
    from calib.stages.control.results import check_json, reach_json
    from calib.stages.control.tuning import brought_in, follow, slowed

    if slow is not None:
        check_writable(slow)
    if figures is not None:
        check_folder(figures)
    known, _, model = _known(rig, limits)
    wanted = wanted_reference(reference, model, _duration_s(duration), known, rig)
    check_workspace(model, wanted, _workspace(known))
    found = follow(model, wanted.path_m(model.plant.rest_length_m))
    told: dict[str, Any] = {**check_json(wanted, found), "reachable": reach_json(model)}
    slower, never = None, ""
    if not found.possible:
        try:
            q_m, _ = slowed(model, wanted.path_m(model.plant.rest_length_m))
            slower = from_lengths(model, f"{wanted.name}, slowed", q_m)
            told["slowed_s"] = slower.duration_s
            _, moved_m = brought_in(model, wanted.path_m(model.plant.rest_length_m))
            told["moved_mm"] = 1e3 * moved_m
        except BadInputError as error:
            never = str(error)
            told["never"] = never
    if slow is not None and (slower is not None or found.possible):
        write_reference(slow, slower or wanted)
        narrate(f"reference written to {slow}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.control.plots import check_plots

        write_figures(figures, check_plots(model, wanted, found, slower))
        narrate(f"figures in {figures}")
    if as_json:
        document("control check", {"control": told})
    else:
        _tell_check(told, never)
    if not found.possible:
        raise typer.Exit(EXIT_POOR)


def _tell_check(told: dict[str, Any], never: str) -> None:
    say(
        f"{told['reference']}: {told['duration_s']:g} s; forces rise by up to "
        f"{told['fastest_rise_N_per_s']:.3g} N/s and fall by up to {told['fastest_fall_N_per_s']:.3g} N/s"
    )
    far = told["reachable"]
    say(
        f"the pumps reach {1e3 * far['greatest_length_m']:.2f} mm straight and "
        f"{far['greatest_angle_rad']:.3f} rad bent; the start takes {told['approach_s']:.2f} s from rest"
    )
    if told["possible"]:
        say("verdict: the pumps can follow it")
        return
    say(f"verdict: the pumps cannot follow it from {told['at_s']:.2f} s on: {told['reason']}")
    say(f"  up to {told['missing_mm']:.2f} mm are missing")
    if never:
        say(f"  - {never}")
    else:
        say(f"  slowed down to {told['slowed_s']:.2f} s they can (--slow writes it)")
        if told["moved_mm"] > 0.0:
            say(f"  with lengths moved by up to {told['moved_mm']:.2f} mm onto what the pumps can hold")


@control.command("tune")
def tune(
    gain_margin: Annotated[float, typer.Option(help="Least gain margin, a factor.")] = 2.0,
    phase_margin: Annotated[str, typer.Option(help="Least phase margin, such as 60deg.")] = "60deg",
    sensitivity: Annotated[float, typer.Option(help="Greatest peak of the sensitivity.")] = 2.0,
    limits: LimitsOption = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Tune the loops on the model to margins at every operating point; write the section controller.

    Exits 1 when the anti-windup does not do what it is for.
    """
    from calib.core.errors import BadInputError
    from calib.core.files import check_folder, check_writable
    from calib.core.result import section_json
    from calib.core.rig import write_rig
    from calib.core.units import parse_angle_rad
    from calib.stages.control.laws import ComputedTorque, design_observer
    from calib.stages.control.results import controller_section, source_margins
    from calib.stages.control.stage import tune_back_calculation
    from calib.stages.control.tuning import Criterion, tune_orientation, tune_position

    try:
        criterion = Criterion(gain_margin, parse_angle_rad(phase_margin, "--phase-margin"), sensitivity)
    except BadInputError as error:
        raise UsageError(str(error)) from error
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    known, machine, model = _known(rig, limits)
    orientation = tune_orientation(model, criterion)
    position = tune_position(model, criterion)
    with progress_bar("anti-windup") as progress:
        back_s, share, anti = tune_back_calculation(machine, model, orientation.pid, progress)
    observer = design_observer(
        model, latency_s=machine.tracker.latency_s, marker_offset_m=machine.tracker.marker_offset_m
    )
    section = controller_section(
        model, criterion, orientation, position, back_s, share, anti, observer, ComputedTorque()
    )
    source = source_margins(model, orientation, position)
    write_rig(rig, known.model_copy(update={"controller": section}), {"controller": _hashes(known)})
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.control.plots import tune_plots

        write_figures(figures, tune_plots(model, section, orientation, position))
        narrate(f"figures in {figures}")
    narrate(f"controller written to {rig}")
    if as_json:
        before = {name: [section_json(row) for row in rows] for name, rows in source.items()}
        document("control tune", {"controller": section_json(section), "source_margins": before})
    else:
        _tell_tuned(section, source)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def _hashes(known: Rig) -> dict[str, str]:
    """SHA-256 of the sections that the gains follow from, where the file has them."""
    import yaml

    from calib.core.files import sha256
    from calib.core.result import section_json

    extra, out = known.model_extra or {}, {}
    for name in ("actuator", "pump"):
        # A section without a schema is a mapping.
        values = extra.get(name)
        if values is None and name in type(known).model_fields and getattr(known, name) is not None:
            values = section_json(getattr(known, name))
        if values is not None:
            out[name] = sha256(yaml.safe_dump(values, sort_keys=True).encode())
    return out


def _tell_tuned(section: Controller, source: dict[str, list[ControllerMargins]]) -> None:
    turn, move = section.orientation, section.position
    say(
        f"orientation: Kp = {turn.Kp_pwm_per_rad:g} PWM/rad, Ki = {turn.Ki_pwm_per_rad_s:g} PWM/rad/s, "
        f"Kd = {turn.Kd_pwm_s_per_rad:g} PWM s/rad, back-calculation {turn.back_calculation_s:g} s"
    )
    say(f"position: Kp = {move.Kp_pwm_per_m:g} PWM/m, Kd = {move.Kd_pwm_s_per_m:g} PWM s/m")
    groups = {"tuned": section.margins, **source}
    rows = []
    for name, points in groups.items():
        for m in points:
            phase = "-" if m.phase_rad is None else f"{math.degrees(m.phase_rad):.1f}"
            delay = "-" if m.delay_s is None else f"{1e3 * m.delay_s:.0f}"
            rows.append(
                [
                    f"{m.loop}, {name}",
                    f"{1e3 * m.q_m[0]:.1f} {1e3 * m.q_m[1]:.1f}",
                    _number(m.gain, 2) if m.stable else "unstable",
                    phase,
                    delay,
                    f"{m.crossover_hz:.2f}",
                    f"{m.sensitivity:.2f}",
                ]
            )
    for line in table(["", "q1 q2 mm", "gain margin", "phase deg", "delay ms", "crossover Hz", "Ms"], rows):
        say(line)
    for name, told in section.anti_windup.items():
        say(
            f"anti-windup, {name.replace('_', '-')}: {told['overshoot_after_jump_rad']:.4f} rad beyond the "
            f"jump, first step at 95 % after {told['rise_s']:.2f} s"
        )
    say(f"verdict: {section.verdict}")
    for sentence in section.reasons:
        say(f"  - {sentence}")
