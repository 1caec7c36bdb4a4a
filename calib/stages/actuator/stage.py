"""The stages of the actuator: its model from logs, a pump from tables, springs from weights; the check."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from calib.core.errors import UsageError
from calib.core.files import shown
from calib.core.options import PoseOptions, option
from calib.core.stage import Files, Stage, later
from calib.core.units import unit_of
from calib.core.verdict import Verdict
from calib.core.words import BLANK, Block, InWords, Line, Table, number
from calib.stages import expanded

if TYPE_CHECKING:
    from calib.core.arrays import FloatArray
    from calib.core.rig import Rig
    from calib.core.stage import Progress
    from calib.stages.actuator.identify import Start, Track
    from calib.stages.actuator.identify_pump import Held, PumpFound, PumpTable
    from calib.stages.actuator.machine import Machine
    from calib.stages.actuator.results import Identified
    from calib.stages.actuator.section import Actuator, PumpSection
    from calib.stages.actuator.springs import StiffnessFit
    from calib.stages.actuator.validate import Comparison
    from calib.stages.arm.identify import Errors
    from calib.stages.arm.model import Trial

    Sections = tuple[Actuator, PumpSection | None]

_MET = 0.85
"""Of a trial's angles, below which it is unlike those whose errors gave the interval of 95 %."""


@dataclass(frozen=True)
class LogsOptions(PoseOptions):
    """What is estimated."""

    static_map: bool = option(False, "Estimate the steady elongations at 6, 8, 10 and 12 V as well.")
    hold_back: bool = option(
        True, "Predict each log from a fit to the others.", flag="hold-back/--no-hold-back"
    )


def _with_states(files: Files, options: PoseOptions) -> list[tuple[Path, Path | None]]:
    """Logs with their states. Raises `UsageError` where these are not one for each, or not to be used."""
    states = expanded(options.states)
    if not states:
        return [(path, None) for path in files.paths]
    if len(states) != len(files.named):
        raise UsageError(f"--states: {len(states)} files for {len(files.named)} logs, expected one for each")
    if options.truth:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    return [pair for pair in zip(files.named, states, strict=True) if pair[0] in files.paths]


def _read(
    files: Files, rig: Rig, options: LogsOptions
) -> tuple[Sequence[Track], Machine, Mapping[str, float], Rig, LogsOptions, Progress]:
    from calib.stages.actuator.read import read_track
    from calib.stages.actuator.results import beginning

    nominal, stated = beginning(rig)
    files.hashes |= rig.identities("known", "camera", "plane", "align")
    tracks = [
        read_track(files, path, rig, nominal, options, states)
        for path, states in _with_states(files, options)
    ]
    return tracks, nominal, stated, rig, options, files.progress


def _solve(
    tracks: Sequence[Track],
    nominal: Machine,
    stated: Mapping[str, float],
    rig: Rig,
    options: LogsOptions,
    progress: Progress,
) -> Sections:
    """From tracks, the machine to start from, and what a person states of it with standard deviations."""
    from calib.stages.actuator.results import identify_logs, sections_from

    either_law = rig.known is None or rig.known.pump is None or rig.known.pump.deflation is None
    with progress("identifying") as tell:
        found = identify_logs(
            nominal, tracks, options.static_map, options.hold_back, tell, stated, either_law=either_law
        )
    return sections_from(found, rig)


def _document(sections: Sections) -> dict[str, Any]:
    from calib.stages.actuator.results import identified_json

    return {"identify": identified_json(sections[0].evidence)}


def _words(sections: Sections) -> list[Block]:
    """What the logs tell of each parameter, how the parameters hang together, and how well each log fits."""
    from calib.stages.actuator.identify import PARAMETERS
    from calib.stages.actuator.section import label_of

    found: Identified = sections[0].evidence
    solution, known = found.solution, found.uncertainty
    rows = [
        (
            label_of(name),
            number(value, known.sigma[name]),
            f"{known.sigma[name]:.2g}",
            unit_of(name) or BLANK,
            PARAMETERS[name].symbol,
            f"{known.inflation[name] * known.scatter[name]:.1f}",
        )
        for name, value in solution.values.items()
    ]
    blocks: list[Block] = [
        Table(("parameter", "value", "sigma", "unit", "symbol", "raised"), tuple(rows)),
        Line("sigma is one standard deviation; raised, by how much for colour and disagreement"),
    ]
    names = solution.problem.names
    if len(names) > 1:
        matrix = [
            (label_of(n), *(f"{c:+.2f}" for c in row))
            for n, row in zip(names, known.correlation, strict=True)
        ]
        blocks.append(Table(("correlation", *(PARAMETERS[n].symbol for n in names)), tuple(matrix)))
    blocks += [Line(f"fixed: {label_of(name)}: {why}") for name, why in solution.fixed.items()]
    held = {one.name: one for one in found.held}
    fits = []
    for track, (phi, length), colour in zip(solution.problem.tracks, found.rms, found.colours, strict=True):
        one = held.get(track.name)
        fits.append(
            (
                track.name,
                "on" if track.hoses else "off",
                str(len(track.t_s)),
                f"{1e3 * phi:.3g}",
                f"{1e3 * length:.3g}",
                BLANK if one is None else f"{1e3 * one.held_phi_rad:.3g}",
                BLANK if one is None else f"{1e3 * one.held_length_m:.3g}",
                "yes" if colour.white else f"no ({100.0 * colour.outside:.0f} %)",
            )
        )
    head = ("RMS of", "hoses", "poses", "phi, mrad", "length, mm", "held phi", "held length", "white")
    blocks.append(Table(head, tuple(fits)))
    if found.decrements:
        peaks = []
        for name, (d, of_fit) in found.decrements.items():
            zeta, fitted = f"{d.zeta:.4f}", number(of_fit, places=4)
            peaks.append((name, zeta, f"{d.sigma:.1g}", fitted, f"{d.frequency_hz:.3f}", str(d.outliers)))
        columns = ("damping of", "zeta by peaks", "sigma", "of the fit", "f, Hz", "outliers")
        blocks.append(Table(columns, tuple(peaks)))
    if found.prospects:
        after = [
            (one.name, label_of(one.worst), f"{100.0 * one.worst_relative:.2g} %") for one in found.prospects
        ]
        blocks.append(Table(("after one more", "least known", "relative sigma"), tuple(after)))
    return blocks


logs = Stage(
    "identify logs",
    "Model of the actuator",
    """Identify stiffness, damping, bending, creep and the pumps from logs of motion.

    Writes the sections actuator and, where a log has commands, pump. Exits 1 when the verdict is not ok.
    """,
    _read,
    _solve,
    LogsOptions,
    sources="Logs of camera and commands.",
    metavar="LOG...",
    leaves_out=True,
    writes=("actuator", "pump"),
    uses=(
        "camera",
        "plane",
        "imu",
        "imu_intrinsics",
        "align",
        "estimator",
        "geometry",
        "known",
        "actuator",
        "pump",
    ),
    document=_document,
    words=_words,
    plots=later("calib.stages.actuator.plots", "plots"),
)


def _cell(value: float | None, form: str = ".3g") -> str:
    return BLANK if value is None or value != value else f"{value:{form}}"


# ----------------------------------------------------------------------
# `calib identify pump`: a pump from tables of time, PWM and pressure or force.


@dataclass(frozen=True)
class PumpOptions:
    """Which column is what, and which tables are kept out of the fit."""

    held: tuple[Path, ...] | None = option(
        None, "Table to predict and not to fit; may be repeated.", metavar="TABLE"
    )
    time: str | None = option(None, "Column of the time, else recognised.", metavar="COLUMN")
    pwm: str | None = option(None, "Column of the PWM, else recognised.", metavar="COLUMN")
    value: str | None = option(None, "Column of pressure or force, else recognised.", metavar="COLUMN")
    unit: Literal["kPa", "N"] | None = option(None, "Unit of that column.")


def _read_pump(
    files: Files, rig: Rig, options: PumpOptions
) -> tuple[Sequence[PumpTable], Sequence[PumpTable], Rig, Progress]:
    """Tables to fit and tables to predict, and the rig with what it holds of a pump."""
    from calib.stages.actuator.read import read_pump_table

    columns = (options.time, options.pwm, options.value, options.unit)
    tables = []
    for path in files.paths:
        table, name = read_pump_table(path, *columns), files.taken(path)
        # Tables of two folders may have one name.
        record = None if table.record is None else replace(table.record, name=name)
        tables.append(replace(table, record=record))
    kept_out = [read_pump_table(path, *columns) for path in expanded(options.held)]
    files.merged = ("pump",)
    return tables, kept_out, rig, files.progress


def _solve_pump(
    tables: Sequence[PumpTable], kept_out: Sequence[PumpTable], rig: Rig, progress: Progress
) -> PumpSection:
    from calib.stages.actuator.identify_pump import identify_pump, pump_section

    with progress("identifying") as tell:
        found = identify_pump(tables, kept_out, tell)
    return pump_section(found, rig).with_evidence(found)


def _pump_document(section: PumpSection) -> dict[str, Any]:
    found: PumpFound = section.evidence
    asked = {
        model: {one.name: {"rms": one.rms, "ahead_rms": one.ahead} for one in rows}
        for model, rows in found.asked.items()
    }
    return {"held": asked} if any(asked.values()) else {}


def _pump_words(section: PumpSection) -> list[Block]:
    """Parameters, errors on tables that were not fitted, and static maps."""
    from calib.stages.actuator.identify_pump import MODELS

    found: PumpFound = section.evidence
    unit, models = found.unit, list(found.fits)
    blocks: list[Block] = []
    for model, fit in found.fits.items():
        rows = []
        for one in MODELS[model]:
            sigma = fit.sigma.get(one.name)
            value = "off" if sigma is None else number(fit.values[one.name], sigma)
            rows.append((one.name, value, _cell(sigma, ".2g"), one.unit.replace("y", unit)))
        blocks.append(Table((model, "value", "sigma", "unit"), tuple(rows)))
    columns = (*models, *(f"{model}, 0.5 s ahead" for model in models))
    if models:
        errors = [_errors_on(record.name, found.held) for record in found.records]
        blank, main = ("",) * len(models), found.main_group
        if main is not None:
            ends = (_cell(found.held_rms(model, main.files)) for model in models)
            errors.append((f"all that settle near {main.value:.1f} {unit}", *ends, *blank))
        errors.append(("all", *(_cell(found.held_rms(model)) for model in models), *blank))
        blocks.append(Table((f"RMS on files not fitted, {unit}", *columns), tuple(errors)))
        how = "simulated from a file's PWM and its first 0.2 s, which give the start; the extras of a model"
        blocks.append(Line(f"{how} are chosen once, on all files"))
    if models and found.asked[models[0]]:
        told = [_errors_on(one.name, found.asked) for one in found.asked[models[0]]]
        blocks.append(Table((f"RMS on the tables kept out, {unit}", *columns), tuple(told)))
    maps = [
        (
            one.name,
            f"{one.fit.end:.4g} ± {_cell(one.fit.sigma['end'], '.2g')}",
            f"{one.fit.dead_pwm:.1f} ± {_cell(one.fit.sigma['dead_pwm'], '.2g')}",
            f"{one.fit.scale_pwm:.1f} ± {_cell(one.fit.sigma['scale_pwm'], '.2g')}",
            f"{one.fit.saturates_pwm:.0f}",
            _cell(one.fit.scatter),
        )
        for one in found.maps
    ]
    if maps:
        head = ("static map", f"at PWM 255, {unit}", "dead zone, PWM", "scale, PWM", "95 % at PWM", "scatter")
        blocks.append(Table(head, tuple(maps)))
    return blocks


def _errors_on(name: str, errors: Mapping[str, Sequence[Held]]) -> tuple[str, ...]:
    """A recording's row: errors of each model, then those ahead."""
    found = [next((one for one in rows if one.name == name), None) for rows in errors.values()]
    free = (_cell(None if one is None else one.rms) for one in found)
    return name, *free, *(_cell(None if one is None else one.ahead) for one in found)


pump = Stage(
    "identify pump",
    "Pump",
    """Find dead time, lag, static map and flow of a pump; compare two models on tables not fitted.

    Writes the section pump. Exits 1 when something is left that the PWM does not explain.
    """,
    _read_pump,
    _solve_pump,
    PumpOptions,
    sources="Tables of time, PWM and pressure.",
    metavar="TABLE...",
    writes=("pump",),
    uses=("known", "pump"),
    document=_pump_document,
    words=_pump_words,
    plots=later("calib.stages.actuator.plots", "pump_plots"),
)


# ----------------------------------------------------------------------
# `calib identify stiffness`: springs from hanging weights or steady elongations.


@dataclass(frozen=True)
class StiffnessOptions:
    """What was stretched."""

    per: Literal["actuator", "bellows"] = option("actuator", "What the table's forces stretch.")


@dataclass(frozen=True)
class Springs:
    """A table's elongations [m] and forces [N], the laws that were fitted, and which of these is used."""

    elongation_m: FloatArray
    force_N: FloatArray
    per: str
    fits: Sequence[StiffnessFit]
    used: int


def _read_stiffness(
    files: Files, rig: Rig, options: StiffnessOptions
) -> tuple[str, FloatArray, FloatArray, Literal["actuator", "bellows"], Rig]:
    from calib.stages.actuator.read import read_displacements

    (path,) = files.paths
    elongation_m, force_N = read_displacements(path)
    # The section keeps what logs have told of the other parameters.
    files.hashes |= rig.provenance.inputs.get("actuator", {})
    files.merged = ("actuator",)
    files.taken(path)
    return shown(path), elongation_m, force_N, options.per, rig


def _solve_stiffness(
    name: str, elongation_m: FloatArray, force_N: FloatArray, per: Literal["actuator", "bellows"], rig: Rig
) -> Actuator:
    from calib.stages.actuator.results import stiffness_section
    from calib.stages.actuator.springs import fit_stiffness

    fits, best = fit_stiffness(name, elongation_m, force_N)
    section = stiffness_section(fits[best], per == "actuator", rig)
    return section.with_evidence(Springs(elongation_m, force_N, per, fits, best))


def _stiffness_document(section: Actuator) -> dict[str, Any]:
    found: Springs = section.evidence
    laws = [
        {
            "order": fit.order,
            "coefficients": fit.coefficients.tolist(),
            "sigma": fit.sigma.tolist(),
            "correlation": fit.correlation.tolist(),
            "rms_N": fit.rms_N,
            "left_out_rms_N": fit.left_out_rms_N,
            "used": k == found.used,
        }
        for k, fit in enumerate(found.fits)
    ]
    return {"stiffness": {"per": found.per, "laws": laws}}


def _stiffness_words(section: Actuator) -> list[Block]:
    found: Springs = section.evidence
    rows = []
    for k, fit in enumerate(found.fits):
        pairs = zip(fit.coefficients.tolist(), fit.sigma.tolist(), strict=True)
        terms = [f"{c:.5g} ± {s:.2g}" for c, s in pairs]
        terms += [BLANK] * (3 - len(terms))
        used = " (used)" if k == found.used else ""
        rows.append((f"order {fit.order}{used}", *terms, f"{fit.left_out_rms_N:.3g}"))
    head = (f"of the {found.per}", "k0, N/m", "k1, N/m²", "k2, N/m³", "left out, N")
    return [Table(head, tuple(rows))]


stiffness = Stage(
    "identify stiffness",
    "Springs",
    """Find the springs from hanging weights or steady elongations: linear and polynomial, zero at zero.

    Writes k0 .. k3 of one bellows to the section actuator.
    """,
    _read_stiffness,
    _solve_stiffness,
    StiffnessOptions,
    sources="Columns elongation_mm or _m with force_N, force_mN, mass_g or mass_kg.",
    several=False,
    metavar="TABLE",
    writes=("actuator",),
    uses=("actuator",),
    document=_stiffness_document,
    words=_stiffness_words,
    plots=later("calib.stages.actuator.plots", "stiffness_plots"),
)


# ----------------------------------------------------------------------
# `calib validate`: the models against logs.


@dataclass(frozen=True)
class ValidateOptions(PoseOptions):
    """What is known of an arm's logs."""

    load: tuple[str, ...] | None = option(None, "Mass at the tip of an arm's logs.", metavar="NAME=MASS")
    day: tuple[str, ...] | None = option(None, "Day of an arm's logs.", metavar="NAME=DAY")


@dataclass(frozen=True, repr=False)
class Validated(InWords):
    """What models show in place of logs.

    Attributes
    ----------
    compared : logs of the actuator. held : free-run errors of an arm by log. inside : share of a log's angles
        that are met to the interval [rad] of the arm in the rig.
    """

    compared: tuple[Comparison, ...] = ()
    held: Mapping[str, Errors] | None = None
    inside: Mapping[str, float] = field(default_factory=dict)
    interval_rad: float = math.nan
    verdict: Verdict = Verdict()

    def blocks(self) -> list[Block]:
        return _validate_words(self)


def _read_validate(
    files: Files, rig: Rig, options: ValidateOptions
) -> tuple[Sequence[tuple[Track, Start | None]], Sequence[Trial], Rig]:
    """Tracks of the actuator with the estimator's starts, or trials of an arm, and the rig."""
    from calib.io.columns import is_arm_log
    from calib.io.logs import read_column_names
    from calib.stages.actuator.validate import IMPROVED, begun_track, models_of

    logs = _with_states(files, options)
    if (rig.arm is not None and rig.actuator is None) or all(
        is_arm_log(read_column_names(path, options) or ()) for path in files.paths
    ):
        arm = rig.needed("arm", files.rig_path)
        files.hashes |= rig.identities("arm")
        # An arm's trials are read by its own stage.
        from calib.stages.arm.stage import Options, held_trials

        arm_options = Options(columns=options.columns, load=options.load, day=options.day)
        return (), held_trials(files, arm, arm_options), rig
    files.hashes |= rig.identities("camera", "plane", "align", "actuator", "pump")
    tracks = [begun_track(files, path, rig, options, states) for path, states in logs]
    if IMPROVED not in models_of(rig):
        files.remarks.append(
            f"{shown(files.rig_path)} has no section known, actuator or pump: the nominal model alone is "
            "held against the log"
        )
    return tracks, (), rig


def _solve_validate(
    tracks: Sequence[tuple[Track, Start | None]], trials: Sequence[Trial], rig: Rig
) -> Validated:
    from calib.stages.actuator.validate import compare, models_of

    if trials:
        from calib.stages.arm.identify import inside_interval, parameter_errors

        assert rig.arm is not None
        values = {one.name: rig.arm.parameters_on_day(one.day) for one in trials}
        held = {one.name: parameter_errors(values[one.name], one) for one in trials}
        half_rad = rig.arm.interval_rad or math.nan
        met = {one.name: inside_interval(values[one.name], one, half_rad) for one in trials}
        inside = {name: float(of.mean()) for name, of in met.items() if len(of) and math.isfinite(half_rad)}
        return Validated(held=held, inside=inside, interval_rad=half_rad)
    models = models_of(rig)
    return Validated(tuple(compare(track, models, start) for track, start in tracks))


def _validate_document(outcome: Validated) -> dict[str, Any]:
    if outcome.held is not None:
        shares = outcome.inside
        arm = {name: {**one, "inside": shares.get(name)} for name, one in outcome.held.items()}
        return {"validate": {"arm": arm}}
    return {"validate": {"logs": [_log_json(one) for one in outcome.compared]}}


def _log_json(one: Comparison) -> dict[str, Any]:
    from calib.stages.actuator.validate import ORIGINAL, QUANTITIES

    units = {name: "rad" if name == "phi" else "m" for name in QUANTITIES}
    return {
        "log": one.name,
        "pose_from": one.how,
        "start_from": one.start,
        "pumps_connected": one.hoses,
        "poses": len(one.t_s),
        "duration_s": float(one.t_s[-1] - one.t_s[0]),
        "replaced_rows": one.replaced,
        "models": {
            model: {
                name: {
                    f"norm_{units[name]}": error.norm,
                    f"rms_{units[name]}": error.rms,
                    "fit_percent": error.fit_percent,
                }
                for name, error in errors.items()
            }
            for model, errors in one.errors.items()
        },
        "smaller_by_percent": {
            model: {name: one.improvement_percent(name, model) for name in QUANTITIES}
            for model in one.errors
            if model != ORIGINAL
        },
    }


def _validate_words(outcome: Validated) -> list[Block]:
    if outcome.held is not None:
        from calib.stages.arm.identify import QUANTITIES

        scales = {name: of.scale for name, of in QUANTITIES.items()} | {"pressure_kpa": 1.0}
        rows = [
            (
                name,
                *(_cell(scale * errors[of], ".2f") for of, scale in scales.items()),
                _cell(100.0 * outcome.inside.get(name, math.nan), ".0f"),
            )
            for name, errors in outcome.held.items()
        ]
        head = (
            "free run, RMS",
            "angle, °",
            "chord, mm",
            "angle by pressure, °",
            "pressure, kPa",
            "inside, %",
        )
        half = f"{math.degrees(outcome.interval_rad):.1f} deg"
        return [
            Table(head, tuple(rows)),
            *(
                Line(
                    f"{name}: {100.0 * share:.0f} % of its angles are met to {half}, as 95 % are of a trial "
                    "like the identified ones: another arm, load or day, or the arm has changed",
                    "reason",
                )
                for name, share in outcome.inside.items()
                if share < _MET
            ),
        ]
    blocks: list[Block] = []
    for one in outcome.compared:
        hoses = "pumps connected" if one.hoses else "hoses off"
        start = "the estimator" if one.start == "estimator" else one.start
        span_s = one.t_s[-1] - one.t_s[0]
        poses = f"{one.name}: {len(one.t_s)} poses over {span_s:.4g} s from {one.how}"
        blocks += [Line(f"{poses}, {hoses}, start by {start}"), _errors(one)]
        if any(error.norm != error.norm for errors in one.errors.values() for error in errors.values()):
            text = "a simulated motion leaves the model before the log ends, its errors are not known"
            blocks.append(Line(text, "reason"))
        if one.replaced:
            text = f"rows away from their neighbours, replaced by them: {one.replaced}"
            blocks.append(Line(text, "remark"))
    return blocks


def _errors(one: Comparison) -> Table:
    from calib.stages.actuator.validate import CALLED, ORIGINAL, QUANTITIES

    rows = []
    for quantity in QUANTITIES:
        scale, unit = (1.0, "rad") if quantity == "phi" else (1e3, "mm")
        for model, errors in one.errors.items():
            error = errors[quantity]
            gained = None if model == ORIGINAL else one.improvement_percent(quantity, model)
            cells = (_cell(scale * error.norm), _cell(scale * error.rms), _cell(error.fit_percent, ".1f"))
            rows.append((f"{quantity}, {unit}, {CALLED[model]}", *cells, _cell(gained, ".1f")))
    return Table(("error of", "L2 norm", "RMS", "fit, %", "smaller by, %"), tuple(rows))


validate = Stage(
    "validate",
    "Model against log",
    """Hold the models against logs.

    A log's commands are played to a model without bending and creep, to the nominal one with both, and to
    this rig's, with what known, actuator and pump in rig.yaml say, from the estimator's state at its start.
    Logs of pressures are played to an actuator of the kind pressure_arm, from the first readings alone.
    Exits 0 whatever comes of it.
    """,
    _read_validate,
    _solve_validate,
    ValidateOptions,
    sources="Logs to hold the models against.",
    metavar="LOG...",
    leaves_out=True,
    uses=(*logs.uses, "arm"),
    document=_validate_document,
    plots=later("calib.stages.actuator.plots", "validate_plots"),
)
