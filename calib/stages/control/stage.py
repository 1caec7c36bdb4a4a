"""The stages of control: controllers tried on the simulated rig, references checked, gains tuned."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from calib.core.errors import BadInputError, UsageError
from calib.core.files import one_line
from calib.core.options import option
from calib.core.stage import Files, Output, Stage, later
from calib.core.units import parse_angle_rad, parse_duration_s, parse_pwm_limits
from calib.core.verdict import Finding, Verdict
from calib.core.words import Block, InWords, Line, Table, number, of_verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.core.arrays import FloatArray
    from calib.core.rig import Rig
    from calib.core.stage import Progress
    from calib.stages.control.reach import Following
    from calib.stages.control.references import Reference
    from calib.stages.control.rig_model import Model
    from calib.stages.control.section import (
        AntiWindup,
        Controller,
        ControllerCriterion,
        ControllerMargins,
        StaticMap,
    )
    from calib.stages.control.trial import Outcome
    from calib.stages.control.tuning import Point, Tuned
    from calib.twin.rig import SimulatedRig

_REFERENCE = (
    "elongation, step, jump, ellipse, a CSV with t_s and q1_m, q2_m, or x_m, y_m, or phi_rad, "
    "or a recorded log."
)
_limits = partial(
    option,
    None,
    "PWM values between which commands stay. [default: the section controller's, else 0,255]",
    metavar="LOW,HIGH",
    parse=parse_pwm_limits,
)
_duration = partial(
    option,
    None,
    "Length of a reference by name, such as 30s. [default: the reference's own]",
    flag="duration",
    metavar="TIME",
    parse=parse_duration_s,
)


_LONG_S = 600.0


def _wanted(
    files: Files,
    rig: Rig,
    duration_s: float | None,
    limits: tuple[float, float] | None,
    plant: Path | None = None,
) -> tuple[SimulatedRig, Model, Reference]:
    """The machine, what controllers know of it, and the reference that was named."""
    from calib.core.rig import Rig
    from calib.stages.control.read import wanted_reference
    from calib.stages.control.references import check_workspace
    from calib.stages.control.trial import controlled

    machine, model = controlled(rig, limits, None if plant is None else Rig.load(plant))
    wanted = wanted_reference(str(files.paths[0]), model, duration_s, rig, files.rig_path)
    check_workspace(model, wanted, rig.workspace_m)
    if wanted.duration_s > _LONG_S and duration_s is None:
        files.narrate(f"{wanted.name}: lasts {wanted.duration_s:.0f} s; t_s is in seconds, not milliseconds")
    return machine, model, wanted


# ----------------------------------------------------------------------
# `calib control run`: controllers along a reference on the simulated rig.


@dataclass(frozen=True)
class RunOptions:
    """Which controllers are run, and on what."""

    controllers: tuple[str, ...] | None = option(
        None,
        "p, pid, clamping, back, pd, pd+ff, pd+map, torque (not in the firmware), tuned-pid, tuned-pd; may "
        "be repeated. [default: all that suit the reference]",
        flag="controller",
        metavar="NAME",
    )
    feedback: Literal["sensors", "truth"] = option(
        "sensors", "What controllers get: sensors, simulated with their noise, or truth."
    )
    seed: int = option(0, "Seed of the sensors' noise.", least=0)
    duration_s: float | None = _duration()
    pwm_limits: tuple[float, float] | None = _limits()
    plant: Path | None = option(
        None, "Another rig's file, whose actuator and pumps are driven; controllers know those of --rig."
    )


@dataclass(frozen=True, repr=False)
class Runs(InWords):
    """How well controllers follow a reference.

    Attributes
    ----------
    follow : how far the pumps of the model can follow it, whatever the controller.
    """

    model: Model
    reference: Reference
    follow: Following
    outcomes: Sequence[Outcome]
    options: RunOptions

    def blocks(self) -> list[Block]:
        return _run_words(self)

    @property
    def verdict(self) -> Verdict:
        """A comparison is neither good nor bad; what the pumps cannot do is a remark."""
        if self.follow.possible:
            return Verdict()
        text = f"the pumps cannot follow it: at {self.follow.at_s:.2f} s {self.follow.reason}"
        return Verdict((Finding("remark", text),))


def _read_run(
    files: Files, rig: Rig, options: RunOptions
) -> tuple[SimulatedRig, Model, Reference, Sequence[str], Controller | None, RunOptions, Progress]:
    from calib.stages.control.trial import CONTROLLERS, controllers_for, suited

    for name in options.controllers or ():
        if name not in CONTROLLERS:
            raise UsageError(f"--controller: {name!r} is not one of {', '.join(CONTROLLERS)}")
    machine, model, wanted = _wanted(files, rig, options.duration_s, options.pwm_limits, options.plant)
    for name in options.controllers or ():
        if name not in suited(wanted):
            which = f"{wanted.kind}, expected one of {', '.join(suited(wanted))}"
            raise UsageError(f"--controller: {name} does not suit a reference of {which}")
    names = options.controllers or controllers_for(wanted, rig.controller)
    files.narrate("simulated: a model of a rig, not the rig")
    files.hashes |= rig.identities("actuator", "pump", "controller")
    return machine, model, wanted, names, rig.controller, options, files.progress


def _solve_run(
    machine: SimulatedRig,
    model: Model,
    wanted: Reference,
    controllers: Sequence[str],
    section: Controller | None,
    options: RunOptions,
    progress: Progress,
) -> Runs:
    from calib.stages.control.reach import follow
    from calib.stages.control.trial import run_controller

    outcomes = []
    with progress("simulating") as tell:
        for done, name in enumerate(controllers):
            tell(done, len(controllers))
            outcomes.append(
                run_controller(name, machine, model, wanted, section, options.seed, options.feedback)
            )
    found = follow(model, wanted.path_m(model.plant.rest_length_m))
    return Runs(model, wanted, found, outcomes, options)


def _followed(reference: Reference, found: Following) -> dict[str, Any]:
    """Whether a reference can be followed, and by how much not, as plain values."""
    return {
        "reference": reference.name,
        "duration_s": reference.duration_s,
        "possible": found.possible,
        "at_s": found.at_s,
        "reason": found.reason,
        "missing_mm": found.missing_mm,
        "fastest_rise_N_per_s": found.fastest_rise_N_per_s,
        "fastest_fall_N_per_s": found.fastest_fall_N_per_s,
        "approach_s": found.approach_s,
    }


def _run_document(runs: Runs) -> dict[str, Any]:
    rows = []
    for one in runs.outcomes:
        limited = {} if one.limited is None else {"limited": one.limited}
        rows.append({"controller": one.controller, **asdict(one.figures), **limited})
    told: dict[str, Any] = {"feedback": runs.options.feedback, "seed": runs.options.seed}
    if runs.options.plant is not None:
        told["plant"] = runs.options.plant.name
    return {"control": {**told, **_followed(runs.reference, runs.follow), "runs": rows}}


def _run_words(runs: Runs) -> list[Block]:
    reference, rows = runs.reference, []
    if reference.kind == "lengths":
        head = ["rms q1 mm", "rms q2 mm", "rms head mm", "largest mm", "rms rad"]
    else:
        head = ["rms rad", "largest rad", "to 95 % s", "reach s", "overshoot", "settle s"]
        head += ["after jump", "settle s"] if reference.jump_s is not None else []
    for one in runs.outcomes:
        f = one.figures
        told: list[tuple[float | None, int]] = [(f.angle_rms_rad, 4)]
        if reference.kind == "lengths":
            told = [*((v, 3) for v in (*f.rms_mm, f.head_rms_mm, f.largest_mm)), *told]
        else:
            told += [(f.largest_rad, 4), (f.rise_s, 2), (f.reach_s, 2), (f.overshoot_rad, 4)]
            told += [(f.settling_s, 2), (f.jump_overshoot_rad, 4), (f.jump_settling_s, 2)]
        row = [number(value, places=places) for value, places in told]
        saturated = " ".join(f"{share:.0%}" for share in f.saturation)
        rows.append((one.controller, *row[: len(head)], saturated, f"{f.changes_pwm:.1f}"))
    rate_hz = 1.0 / runs.model.tick_s
    first = f"{reference.name}: {reference.duration_s:g} s at {rate_hz:g} Hz, feedback from "
    first += runs.options.feedback
    if runs.options.plant is not None:
        first += f", on the plant of {one_line(runs.options.plant.name)}"
    table = Table(("", *head, "saturated", "PWM steps"), tuple(rows))
    return [Line(first), table, *(Line(text) for text in runs.verdict.remarks)]


run = Stage(
    "control run",
    "Controllers tried",
    """Run controllers along a reference on the simulated rig, from rest, and compare their errors.

    The plant is that of the sections actuator and pump, the nominal one without. No rig is its model: with
    --plant controllers are tried on another one, with another load, say, or of another day.
    """,
    _read_run,
    _solve_run,
    RunOptions,
    sources=_REFERENCE,
    metavar="REFERENCE",
    several=False,
    uses=("camera", "plane", "lowpass", "actuator", "pump", "controller", "twin"),
    document=_run_document,
    plots=later("calib.stages.control.plots", "run_plots"),
)


# ----------------------------------------------------------------------
# `calib control check`: whether the pumps can follow a reference at all.


@dataclass(frozen=True)
class CheckOptions:
    """What is checked."""

    duration_s: float | None = _duration()
    pwm_limits: tuple[float, float] | None = _limits()


@dataclass(frozen=True, repr=False)
class Checked(InWords):
    """Whether the pumps can follow a reference.

    Attributes
    ----------
    slower : the reference slowed down so far that they can; None where they can, and where no slowness helps.
    moved_m : by how much its lengths were moved onto what the pumps can hold.
    never : why no slowness helps.
    """

    model: Model
    reference: Reference
    follow: Following
    slower: Reference | None = None
    moved_m: float = 0.0
    never: str = ""

    def blocks(self) -> list[Block]:
        return _check_words(self)

    @property
    def verdict(self) -> Verdict:
        """Poor from the first second on at which the pumps cannot follow."""
        if self.follow.possible:
            return Verdict()
        text = f"the pumps cannot follow it from {self.follow.at_s:.2f} s on: {self.follow.reason}"
        findings = [Finding("poor", text)]
        findings.append(Finding("poor", f"up to {self.follow.missing_mm:.2f} mm are missing"))
        if self.slower is None:
            findings.append(Finding("poor", self.never))
        else:
            advice = f"slowed down to {self.slower.duration_s:.2f} s they can (--slow writes it)"
            if self.moved_m > 0.0:
                moved = f"{1e3 * self.moved_m:.2f} mm"
                advice += f", with lengths moved by up to {moved} onto what the pumps can hold"
            findings.append(Finding("remark", "", advice))
        return Verdict.of(findings)


def _read_check(files: Files, rig: Rig, options: CheckOptions) -> tuple[Model, Reference]:
    return _wanted(files, rig, options.duration_s, options.pwm_limits)[1:]


def _solve_check(model: Model, wanted: Reference) -> Checked:
    from calib.stages.control.reach import follow, slowed
    from calib.stages.control.references import from_lengths

    path_m = wanted.path_m(model.plant.rest_length_m)
    found = follow(model, path_m)
    if found.possible:
        return Checked(model, wanted, found)
    try:
        q_m, moved_m = slowed(model, path_m)
        slower = from_lengths(model, f"{wanted.name}, slowed", q_m)
    except BadInputError as error:
        return Checked(model, wanted, found, never=str(error))
    return Checked(model, wanted, found, slower, moved_m)


def _check_document(checked: Checked) -> dict[str, Any]:
    from calib.stages.control.reach import largest_angle, longest_m
    from calib.stages.control.rig_model import largest_force_N

    reach = {
        "greatest_angle_rad": largest_angle(checked.model),
        "least_angle_rad": largest_angle(checked.model, 1),
        "greatest_length_m": longest_m(checked.model),
        "greatest_force_N": largest_force_N(checked.model).tolist(),
    }
    told = {**_followed(checked.reference, checked.follow), "reachable": reach}
    if checked.slower is not None:
        told |= {"slowed_s": checked.slower.duration_s, "moved_mm": 1e3 * checked.moved_m}
    if checked.never:
        told["never"] = checked.never
    return {"control": told}


def _check_words(checked: Checked) -> list[Block]:
    from calib.stages.control.reach import largest_angle, longest_m, unlike

    model = checked.model
    bent = f"{largest_angle(model):.3f} rad"
    if unlike(model):
        bent = f"{largest_angle(model, 1):.3f} to {bent}"
    found, reference = checked.follow, checked.reference
    rise, fall = found.fastest_rise_N_per_s, found.fastest_fall_N_per_s
    moved = f"forces rise by up to {rise:.3g} N/s and fall by up to {abs(fall):.3g} N/s"
    forces = moved if rise or fall else "forces are held"
    start = (
        f"the start takes {found.approach_s:.2f} s from rest"
        if math.isfinite(found.approach_s)
        else "the start is beyond their reach"
    )
    return [
        Line(f"{reference.name}: {reference.duration_s:g} s; {forces}"),
        Line(f"the pumps reach {1e3 * longest_m(model):.2f} mm straight and {bent} bent; {start}"),
        *of_verdict(checked.verdict),
    ]


def _write_slower(files: Files, checked: Checked) -> list[Path]:
    from calib.stages.control.read import write_reference

    if checked.never or files.output is None:
        return []
    write_reference(files.output, checked.slower or checked.reference)
    return [files.output]


check = Stage(
    "control check",
    "Reference checked",
    """Say whether the pumps can follow a reference, and the first second at which they cannot.

    Exits 1 when they cannot.
    """,
    _read_check,
    _solve_check,
    CheckOptions,
    sources=_REFERENCE,
    metavar="REFERENCE",
    several=False,
    uses=("camera", "plane", "lowpass", "actuator", "pump", "controller", "twin"),
    output=Output(
        "Write the reference slowed down so far that the pumps follow it.",
        _write_slower,
        flags=("--slow",),
        metavar="CSV",
        kind=("calib.stages.control.read", "REFERENCE"),
    ),
    document=_check_document,
    plots=later("calib.stages.control.plots", "check_plots"),
)


# ----------------------------------------------------------------------
# `calib control tune`: gains with margins at every operating point, and the anti-windup by trial.


@dataclass(frozen=True)
class TuneOptions:
    """Margins that the gains have to keep."""

    gain_margin: float = option(2.0, "Least gain margin, a factor.")
    phase_margin_rad: float = option(
        math.pi / 3.0,
        "Least phase margin, such as 60deg. [default: 60deg]",
        flag="phase-margin",
        metavar="ANGLE",
        parse=parse_angle_rad,
    )
    sensitivity: float = option(2.0, "Greatest peak of the sensitivity.")
    pwm_limits: tuple[float, float] | None = _limits()


@dataclass(frozen=True)
class ControllerEvidence:
    """What gains were chosen from."""

    model: Model
    orientation: Tuned
    position: Tuned


def _read_tune(
    files: Files, rig: Rig, options: TuneOptions
) -> tuple[SimulatedRig, Model, ControllerCriterion, Progress, Sequence[str]]:
    from calib.stages.control.section import ControllerCriterion
    from calib.stages.control.trial import controlled

    gain, phase_rad, peak = options.gain_margin, options.phase_margin_rad, options.sensitivity
    asked = (
        ("gain margin", gain, 1.0, 100.0, ""),
        ("phase margin", math.degrees(phase_rad), 0.0, 90.0, " deg"),
        ("sensitivity", peak, 1.0, 100.0, ""),
    )
    for what, value, low, high, unit in asked:
        if not low < value < high:
            raise UsageError(f"{what}: found {value:g}{unit}, expected between {low:g} and {high:g}{unit}")
    criterion = ControllerCriterion(gain_margin=gain, phase_margin_rad=phase_rad, sensitivity=peak)
    machine, model = controlled(rig, options.pwm_limits)
    # Of lowpass and align the delays alone count: an alignment with a poor mount angle spoils no gains.
    files.hashes |= rig.identities("known", "actuator", "pump")
    nominal = [name for name, values in rig.standing.items() if not values]
    return machine, model, criterion, files.progress, nominal


def _solve_tune(
    machine: SimulatedRig,
    model: Model,
    criterion: ControllerCriterion,
    progress: Progress,
    nominal: Sequence[str],
) -> Controller:
    """Tune both loops on the model and the anti-windup by trial, judge, and assemble the section.

    `nominal` are the sections that nobody has filled.
    """
    from calib.core.result import finite_or_none, judged
    from calib.stages.actuator.pump import RateLimit
    from calib.stages.control.laws import ComputedTorque
    from calib.stages.control.observer import design_observer
    from calib.stages.control.section import (
        AntiWindup,
        ComputedTorqueGains,
        Controller,
        OrientationGains,
        PositionGains,
    )
    from calib.stages.control.trial import tune_back_calculation
    from calib.stages.control.tuning import tune_orientation, tune_position

    orientation, position = tune_orientation(model, criterion), tune_position(model, criterion)
    turn, move = orientation.pid, position.pid
    with progress("anti-windup") as tell:
        back_s, share, trials = tune_back_calculation(machine, model, turn, tell)
    anti_windup = {name: AntiWindup(**values) for name, values in trials.items()}
    torque, tracker = ComputedTorque(), machine.tracker
    observer = design_observer(model, latency_s=tracker.latency_s, marker_offset_m=tracker.marker_offset_m)
    law = model.pump.deflation
    return Controller(
        tick_s=model.tick_s,
        pwm_low=model.low_pwm,
        pwm_high=model.high_pwm,
        criterion=criterion,
        orientation=OrientationGains(
            Kp_pwm_per_rad=turn.Kp,
            Ki_pwm_per_rad_s=turn.Ki,
            Kd_pwm_s_per_rad=turn.Kd,
            back_calculation_s=back_s,
            falling_share=finite_or_none(share),
        ),
        position=PositionGains(Kp_pwm_per_m=move.Kp, Ki_pwm_per_m_s=move.Ki, Kd_pwm_s_per_m=move.Kd),
        feedforward=_static_map(model),
        computed_torque=ComputedTorqueGains(
            horizon_ticks=torque.horizon_ticks,
            Kp_per_s2=torque.Kp_per_s2,
            Kd_per_s=torque.Kd_per_s,
            latency_s=observer.latency_s,
            observer_gain=[[float(f"{v:.6g}") for v in row] for row in observer.gain],
        ),
        lag_s=model.pump.lag_s,
        delay_ticks=model.pump.delay_ticks,
        falling_N_per_s=finite_or_none(law.falling_N_per_s) if isinstance(law, RateLimit) else None,
        margins=[*_margins("orientation", orientation.points), *_margins("position", position.points)],
        anti_windup=anti_windup,
        **judged(_judge(anti_windup["clamping"], anti_windup["back_calculation"], model, nominal)),
    ).with_evidence(ControllerEvidence(model, orientation, position))


def _judge(clamped: AntiWindup, back: AntiWindup, model: Model, nominal: Sequence[str]) -> Verdict:
    """Poor where back-calculation is not worth its name, or the model is nobody's."""
    from calib.stages.control.references import built_in

    findings, tick_s = [], model.tick_s
    if nominal:
        parts = " and ".join(f"the {name}" for name in nominal)
        text = f"rig.yaml tells nothing of {parts}, so that gains are for the nominal one"
        findings.append(Finding("poor", text, "run calib identify, or state what you know under known"))
    if min(back.rise_s, clamped.rise_s) >= built_in(model, "jump").duration_s:
        text = "The first step is not reached, so that the anti-windup is not tried: the pumps are too weak "
        findings.append(Finding("poor", f"{text}for it, or the actuator is of another size."))
    over, limit = back.overshoot_after_jump_rad, clamped.overshoot_after_jump_rad
    if over > max(limit / 3.0, 1e-3):
        text = f"After the jump back-calculation overshoots by {over:.3f} rad, more than a third of "
        findings.append(Finding("poor", f"{text}clamping's {limit:.3f} rad."))
    if back.rise_s > clamped.rise_s + tick_s + 1e-9:
        text = f"The first step is at 95 % after {back.rise_s:.2f} s, later than with clamping "
        findings.append(Finding("poor", f"{text}({clamped.rise_s:.2f} s)."))
    return Verdict.of(findings)


def _margins(loop: Literal["orientation", "position"], points: Sequence[Point]) -> list[ControllerMargins]:
    """Margins at operating points for the file, null where nothing limits them."""
    from calib.stages.control.section import ControllerMargins

    rows = []
    for point in points:
        known: dict[str, Any] = {
            name: value if math.isfinite(value) else None for name, value in vars(point.margins).items()
        }
        del known["gain_down"]
        rows.append(ControllerMargins(loop=loop, q_m=[float(f"{q:.6g}") for q in point.q_m], **known))
    return rows


_MAP_ROWS = 41


def _static_map(model: Model) -> StaticMap:
    import numpy as np

    from calib.stages.control.rig_model import largest_force_N, pwm_of_force
    from calib.stages.control.section import StaticMap

    plant = model.plant
    most = float(largest_force_N(model).max())
    # Close together at small forces, where the map is steepest. Strengths apply to the force first.
    force: FloatArray = most / max(model.strength) * np.linspace(0.0, 1.0, _MAP_ROWS) ** 2
    scaled = force[:, None] * np.array(model.strength)
    pwm = pwm_of_force(model, np.maximum(scaled, 1e-9))[:, 0]
    return StaticMap(
        rest_length_m=plant.rest_length_m,
        bellows_radius_m=plant.bellows_radius_m,
        stiffness_N_per_m=[plant.stiffness_scale * k for k in plant.stiffness.padded],
        bending_N_per_rad2=plant.bending_N_per_rad2,
        strength=list(model.strength),
        force_pwm=[[float(f"{F:.6g}"), float(f"{u:.6g}")] for F, u in zip(force, pwm, strict=True)],
    )


tune = Stage(
    "control tune",
    "Controllers",
    """Tune the loops on the model to margins at every operating point; write the section controller.

    Exits 1 when the anti-windup does not do what it is for.
    """,
    _read_tune,
    _solve_tune,
    TuneOptions,
    writes=("controller",),
    uses=("camera", "plane", "lowpass", "align", "actuator", "pump", "twin"),
    plots=later("calib.stages.control.plots", "tune_plots"),
)
