"""The stage of a bending arm: an assembly from logs of pressure and motion capture, proved on held trials."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from calib.core.errors import UsageError
from calib.core.options import LogOptions, option
from calib.core.stage import Files, Progress, Stage
from calib.core.verdict import Finding, Verdict

if TYPE_CHECKING:
    from calib.core.rig import Rig
    from calib.core.words import Block
    from calib.stages.arm.frame import Frame
    from calib.stages.arm.identify import Identification
    from calib.stages.arm.model import Trial
    from calib.stages.arm.section import Arm

_FEWEST = 3
_UNIDENTIFIED = 0.8
"""Posterior over prior deviation above which logs tell nothing of a parameter."""
_OUTLYING = 2.0
"""A held trial is far from the others with this many times their median error."""
_ODD = 0.05
"""Of the angle's range: an error far from the others' that is smaller only widens the interval of a trial."""
_COARSE = 0.1
"""Error of a held trial, of the angle's range, above which a prediction is none."""
_MATTERS = 0.005
"""Of the angle's range or the chord, by which a black box has to be better to count."""
_BEYOND_CHANCE = 0.8
"""Level of the paired interval that a black box' gain has to be outside of, 10 % on its side: of a few trials
one alone holds its day or its load, and is predicted by chance."""
_SHORT = 0.01
_LEAST_RAD = math.radians(0.5)


@dataclass(frozen=True)
class Options(LogOptions):
    """What a person knows of the trials."""

    load: tuple[str, ...] | None = option(
        None,
        "Mass at the tip of the logs with this name, as 1009_4=200g; may be repeated.",
        metavar="NAME=MASS",
    )
    day: tuple[str, ...] | None = option(
        None,
        "Day of the logs with this name, as run3=monday; else what stands before the last _ of the name.",
        metavar="NAME=DAY",
    )
    compare: bool = option(
        True, "Measure what each part is worth on held trials.", flag="compare/--no-compare"
    )


def _stated(words: Iterable[str], flag: str, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Names of logs and what is stated of them. Raises `UsageError` for names that are none."""
    for one in words:
        pattern, _, value = one.partition("=")
        hits = [name for name in names if fnmatchcase(name, pattern)]
        if not hits or not value:
            raise UsageError(
                f"{flag}: {one!r} names no log, expected NAME=VALUE with a NAME of {', '.join(names)}"
            )
        yield from ((name, value) for name in hits)


def read_trials(
    files: Files, options: Options, frame: Frame | None = None
) -> tuple[tuple[Trial, ...], Frame, tuple[Finding, ...]]:
    """Trials of the files, the frame of their poses, and findings.

    Parameters
    ----------
    frame : that an identification has found; found here without.

    Raises
    ------
    BadInputError as `read_recording`, `fit_frame` and `resample_trial`.
    UsageError for statements about logs that are not there.
    """
    from calib.core.units import parse_mass_kg
    from calib.io.logs import read_log
    from calib.stages.arm.frame import check_frame, fit_frame, frame_findings, resample_trial
    from calib.stages.arm.recording import read_recording

    names = [path.stem for path in files.named]
    if len(set(names)) < len(names):
        raise UsageError(f"logs: {', '.join(names)} are not all different, expected a name for each")
    loads = {n: parse_mass_kg(mass, "--load") for n, mass in _stated(options.load or (), "--load", names)}
    days = {name: name.rpartition("_")[0] or name for name in names}
    days |= dict(_stated(options.day or (), "--day", names))
    used = {path.stem for path in files.paths}
    recordings = []
    for path in files.paths:
        log = read_log(path, options, files.remarks)
        recordings.append(read_recording(log, path.stem))
        files.taken(path, log.beginning)
    found = fit_frame(recordings) if frame is None else frame
    if frame is not None:
        check_frame(recordings, frame)
    trials = tuple(resample_trial(one, found, days[one.name], loads.get(one.name, 0.0)) for one in recordings)
    loaded = ", ".join(f"{name} {kg:g} kg" for name, kg in loads.items() if name in used) or "none"
    files.remarks.append(f"days: {', '.join(sorted({days[name] for name in used}))}; loads: {loaded}")
    findings = [finding for one in recordings for finding in one.findings]
    return trials, found, (*findings, *frame_findings(found))


def _read(
    files: Files, rig: Rig, options: Options
) -> tuple[Sequence[Trial], Frame, Sequence[Finding], bool, Progress]:
    del rig
    return *read_trials(files, options), options.compare, files.progress


def _solve(
    trials: Sequence[Trial], frame: Frame, findings: Sequence[Finding], compare: bool, progress: Progress
) -> Arm:
    """From trials, how motion capture is read, and what the recordings show."""
    from calib.core.result import finite_or_none, judged
    from calib.stages.arm.identify import QUANTITIES, angle_error, half_width, identify, mean_error
    from calib.stages.arm.section import Arm, HeldTrial

    with progress("identifying") as tell:
        found = identify(trials, compare, tell)
    made = found.fit
    axis = frame.axis
    return Arm(
        parts=list(made.assembly.parts),
        parameters={name: float(made.values[name]) for name in made.assembly.names},
        sigma={name: float(value) for name, value in found.sigma.items()},
        days={day: dict(factors) for day, factors in made.days.items()},
        bending_axis=None if axis is None else axis.tolist(),
        conjugated=frame.conjugated,
        tip_mount=list(frame.mount),
        tip_zero_rad=frame.zero_rad,
        tip_grows=frame.grows,
        chord_leans=finite_or_none(abs(frame.leans)),
        angle_error_rad=finite_or_none(mean_error(found.held, "angle_rad")),
        chord_error_m=finite_or_none(mean_error(found.held, "chord_m")),
        by_pressure_error_rad=finite_or_none(mean_error(found.held, "angle_by_pressure_rad")),
        interval_rad=finite_or_none(half_width([angle_error(one) for one in found.held.values()])),
        coverage=finite_or_none(found.coverage),
        held={
            name: HeldTrial(**{quantity: finite_or_none(one[quantity]) for quantity in QUANTITIES})
            for name, one in found.held.items()
        },
        **judged(Verdict.of((*findings, *judge(found)))),
    ).with_evidence(found)


def judge(found: Identification) -> Iterator[Finding]:
    """What the held trials, the baselines and the posterior say of an identification."""
    if not any(len(one.angle_rad) for one in found.trials):
        yield Finding("poor", "no log has a pose, so the valve alone is identified", "log base and tip")
        return
    for rule in _RULES:
        yield from rule(found)


def _few_trials(found: Identification) -> Iterator[Finding]:
    if len(found.trials) < _FEWEST:
        yield Finding(
            "poor",
            f"{len(found.trials)} trials do not tell how trials differ, expected at least {_FEWEST}",
            "record more trials: other commands, another day",
        )


def _beside_black_boxes(found: Identification) -> Iterator[Finding]:
    from calib.stages.arm.identify import QUANTITIES, best_baseline, gain_over_baseline, mean_error

    scale = found.fit.scale
    for quantity, one in QUANTITIES.items():
        name = best_baseline(found, quantity)
        mean, half = gain_over_baseline(found, name, quantity) if name else (math.nan, math.nan)
        if math.isnan(mean):
            continue
        text = (
            f"{one.words}: error on held trials {100.0 * abs(mean):.0f} +- {100.0 * half:.0f} % "
            f"{'smaller' if mean > 0.0 else 'larger'} than that of {name} (paired, 95 %)"
        )
        size = scale.chord_m if quantity == "chord_m" else scale.angle_rad
        _, chance = gain_over_baseline(found, name, quantity, _BEYOND_CHANCE)
        worse = -mean > chance and -mean * mean_error(found.others[name], quantity) > _MATTERS * size
        yield Finding("poor" if worse else "remark", text)


def _coarse_prediction(found: Identification) -> Iterator[Finding]:
    from calib.stages.arm.identify import mean_error

    error, size = mean_error(found.held, "angle_rad"), found.fit.scale.angle_rad
    if error > _COARSE * size:
        yield Finding(
            "poor",
            f"held trials are predicted to {math.degrees(error):.1f} deg of a range of "
            f"{math.degrees(size):.0f} deg",
            "look at the logs' days, loads and units",
        )


def _outlying_trials(found: Identification) -> Iterator[Finding]:
    errors = {name: one["angle_rad"] for name, one in found.held.items()}
    for name, error in errors.items():
        others = sorted(x for n, x in errors.items() if n != name and math.isfinite(x))
        if len(others) < _FEWEST - 1:
            continue
        usual = others[len(others) // 2]
        if error - usual >= _LEAST_RAD and error > _OUTLYING * usual:
            yield Finding(
                "poor" if error > _ODD * found.fit.scale.angle_rad else "remark",
                f"{name} is predicted to {math.degrees(error):.1f} deg from the others, which reach "
                f"{math.degrees(usual):.1f} deg: it alone holds its day, load or range",
                f"record another trial like {name}",
            )


def _no_pressure(found: Identification) -> Iterator[Finding]:
    if all(one.pwm and not len(one.pressure_kpa) for one in found.trials):
        yield Finding(
            "remark",
            f"no log has a pressure: parameters in kPa count as if the greatest was "
            f"{found.fit.scale.pressure_kpa:.0f} kPa",
            "log p1_kpa, where they matter",
        )


def _unidentified(found: Identification) -> Iterator[Finding]:
    from calib.stages.arm.model import PARAMETERS, PARTS

    sigmas = zip(PARAMETERS, found.fit.sigma.tolist(), strict=True)
    vague = {parameter.name for parameter, sigma in sigmas if sigma > _UNIDENTIFIED}
    names: dict[str, None] = {}
    takes: dict[str, None] = {}
    for part in PARTS:
        mine = [one for one in part.parameters if one.name in vague and part.name in found.fit.assembly.parts]
        whole = len(mine) == len(part.parameters)
        names |= dict.fromkeys([part.name] if whole else [one.name for one in mine])
        takes |= dict.fromkeys(one.identified_by for one in (mine[:1] if whole else mine))
    if names:
        yield Finding(
            "remark", f"{', '.join(names)}: the prior's, these logs do not tell; it takes {', '.join(takes)}"
        )
    if "load" not in found.fit.assembly.parts:
        yield Finding(
            "remark",
            "area, stiffness and lever arm are one number, bends_rad_per_kpa, without a known load",
            "record a trial with a known mass at the tip and state it with --load",
        )


def _one_day(found: Identification) -> Iterator[Finding]:
    from calib.stages.arm.model import DAILY

    if len({one.day for one in found.trials}) == 1:
        share = DAILY["bends_rad_per_kpa"]
        yield Finding(
            "remark",
            f"all trials are of one day: on another the angle may well differ by {100.0 * share:.0f} %, "
            f"{math.degrees(share * found.fit.scale.angle_rad):.0f} deg at the most, which the interval of a "
            "trial does not hold",
            "record trials on another day, too, and state it with --day where names do not tell",
        )


def _load_straightens(found: Identification) -> Iterator[Finding]:
    from calib.stages.arm.model import COMPLIANCE, load_bends

    values = found.fit.values
    middle_rad = values["rest_rad"] + 0.5 * found.fit.scale.angle_rad
    if load_bends(middle_rad, *(values[name] for name in COMPLIANCE)) < 0.0:
        yield Finding(
            "remark",
            "a load straightens the arm, as it does one that hangs or bends upwards",
            "where the arm stands upright look whether --load names the trials with the mass at the tip",
        )


def _vented_starts(found: Identification) -> Iterator[Finding]:
    values = found.fit.values
    for trial in found.trials:
        if not len(trial.angle_rad):
            continue
        kpa, phi, chord_m = trial.begins
        curve = values["chord_m"] + values["chord_m_per_rad"] * phi + values["chord_m_per_rad2"] * phi**2
        short = curve + values["extends_m_per_kpa"] * kpa - chord_m
        if short > _SHORT * values["chord_m"]:
            yield Finding(
                "remark", f"{trial.name} starts {1e3 * short:.1f} mm too short: a vented start, it settles"
            )


_RULES = (
    _few_trials,
    _beside_black_boxes,
    _coarse_prediction,
    _outlying_trials,
    _no_pressure,
    _unidentified,
    _one_day,
    _load_straightens,
    _vented_starts,
)


def _words(arm: Arm) -> list[Block]:
    """Parameters with what identifies them, and one table of errors on trials held back."""
    from calib.core.words import BLANK, Line, Table, number
    from calib.stages.arm.identify import QUANTITIES, mean_error
    from calib.stages.arm.model import PARTS

    found: Identification = arm.evidence
    rows = [
        (part.name, one.name, f"{arm.parameters[one.name]:.4g}", f"{arm.sigma[one.name] or 0.0:.2g}",
         one.unit or BLANK, one.identified_by)
        for part in PARTS
        if part.name in arm.parts
        for one in part.parameters
    ]  # fmt: skip
    blocks: list[Block] = [
        Table(("part", "parameter", "value", "sigma", "unit", "identified by"), tuple(rows)),
        Line("sigma holds between trials: the larger of the posterior's and of the jackknife's over trials"),
        *(
            Line(f"{day}: " + ", ".join(f"{name} times {factor:.3f}" for name, factor in factors.items()))
            for day, factors in arm.days.items()
        ),
    ]

    ahead = []
    for kind, left in found.prospects.items():
        most = sorted(left, key=lambda name: left[name])[:3]
        ahead.append((kind, ", ".join(f"{name} to {100.0 * left[name]:.0f} %" for name in most)))
    blocks.append(Table(("one more trial, twice", "lowers deviations most"), tuple(ahead)))

    for name, of in QUANTITIES.items():
        if math.isfinite(mean_error(found.held, name)):
            table = [
                (
                    model,
                    *(number(of.scale * one[name], places=2) for one in errors.values()),
                    number(of.scale * mean_error(errors, name), places=2),
                )
                for model, errors in found.models.items()
            ]
            title = f"held trials, {of.title} RMS"
            blocks.append(Table(("model", *found.held, "mean"), tuple(table), title))
    return blocks


def _document(arm: Arm) -> dict[str, Any]:
    from calib.core.result import finite_or_none
    from calib.stages.arm.identify import QUANTITIES

    found: Identification = arm.evidence
    return {
        "models": {
            model: {
                trial: {name: finite_or_none(one[name]) for name in QUANTITIES}
                for trial, one in errors.items()
            }
            for model, errors in found.models.items()
        },
        "next": {kind: dict(left) for kind, left in found.prospects.items()},
    }


def held_trials(files: Files, arm: Arm, options: Options) -> Sequence[Trial]:
    """Trials to hold an arm against, in its plane. Raises `BadInputError` as `read_trials`."""
    import numpy as np

    from calib.stages.arm.frame import Frame
    from calib.stages.arm.model import DAILY

    axis = arm.bending_axis
    if options.load and "load" not in arm.parts:
        raise UsageError(
            "--load: the arm in the rig's file has no part load, expected one that was identified from a log "
            "with a load too"
        )
    frame = Frame(
        None if axis is None else np.array(axis),
        arm.tip_grows,
        arm.tip_zero_rad,
        arm.tip_mount,
        arm.conjugated,
    )
    trials, _, findings = read_trials(files, options, frame)
    files.remarks += [one.text for one in findings]
    files.remarks += [
        f"{one.name}: day {one.day} is not in the rig, its factors are the means; the angle may well be off "
        f"by {100.0 * DAILY['bends_rad_per_kpa']:.0f} %"
        for one in trials
        if one.day not in arm.days
    ]
    return trials


arm = Stage(
    "identify arm",
    "Bending arm",
    """Identify a bending arm under a pressure valve from logs of pressures and motion capture.

    Writes the section actuator, of the kind pressure_arm. Exits 1 when the verdict is not ok.
    """,
    _read,
    _solve,
    Options,
    sources="Logs of commands, pressures and poses.",
    metavar="LOG...",
    leaves_out=True,
    writes=("arm",),
    document=_document,
    words=_words,
)
