"""The stage of the actuator: stiffness, damping, bending, creep and the pumps from logs of motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.core.errors import UsageError
from calib.core.stage import Files, LogOptions, Stage, option

if TYPE_CHECKING:
    from calib.core.plot import Figure
    from calib.core.rig import Rig
    from calib.core.stage import Progress
    from calib.core.words import Block
    from calib.stages.actuator.machine import Machine
    from calib.stages.actuator.read import TrackSource
    from calib.stages.actuator.results import Identified
    from calib.stages.actuator.section import Actuator, PumpSection

    Sections = tuple[Actuator, PumpSection | None]


@dataclass(frozen=True)
class LogsOptions(LogOptions):
    """Where the pose comes from, and what is estimated."""

    states: tuple[Path, ...] | None = option(
        None, "States of calib replay to use instead of the pictures, for the logs in turn."
    )
    truth: bool = option(False, "Take the true columns of a simulated log, to test the method.")
    no_pwm: bool = option(False, "Logs without commands are swings with the hoses off.")
    static_map: bool = option(False, "Estimate the steady elongations at 6, 8, 10 and 12 V as well.")
    hold_back: bool = option(
        True, "Predict each log from a fit to the others.", flag="hold-back/--no-hold-back"
    )


@dataclass(frozen=True)
class LogsInputs:
    """Tracks, the machine to start from, and what a person states of it with standard deviations.

    Attributes
    ----------
    rig : holds what logs do not tell.
    """

    tracks: Sequence[TrackSource]
    nominal: Machine
    stated: Mapping[str, float]
    rig: Rig
    options: LogsOptions
    progress: Progress


def _read(files: Files, rig: Rig, options: LogsOptions) -> LogsInputs:
    from calib.stages import expanded
    from calib.stages.actuator.read import read_track
    from calib.stages.actuator.results import beginning

    states = expanded(options.states)
    if states and len(states) != len(files.paths):
        raise UsageError(f"--states: {len(states)} files for {len(files.paths)} logs, expected one for each")
    if options.truth and states:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    nominal, stated = beginning(rig)
    tracks = []
    for k, path in enumerate(files.paths):
        given = states[k] if states else None
        track = read_track(path, rig, files.rig_path, nominal, given, options.truth, options.no_pwm, options)
        files.taken(path)
        if track.states is not None:
            files.taken(track.states)
        files.remarks += track.said
        tracks.append(track)
    return LogsInputs(tracks, nominal, stated, rig, options, files.progress)


def _solve(inputs: LogsInputs) -> Sections:
    from calib.stages.actuator.results import identify_logs, sections_from

    options = inputs.options
    with inputs.progress("identifying") as progress:
        found = identify_logs(
            inputs.nominal, inputs.tracks, options.static_map, options.hold_back, progress, inputs.stated
        )
    return sections_from(found, inputs.rig)


def _evidence(outcome: Sections | Actuator | PumpSection) -> Identified:
    one = outcome[0] if isinstance(outcome, tuple) else outcome
    found: Identified = one.evidence
    return found


def _document(sections: Sections) -> dict[str, Any]:
    from calib.stages.actuator.results import identified_json

    return {"identify": identified_json(_evidence(sections))}


def _words(sections: Sections) -> list[Block]:
    """What the logs tell of each parameter, how the parameters hang together, and how well each log fits."""
    from calib.core.words import BLANK, Line, Table
    from calib.stages.actuator.identify import PARAMETERS

    found = _evidence(sections)
    solution, known = found.solution, found.uncertainty
    rows = [
        (
            name,
            f"{value:.5g}",
            f"{known.sigma[name]:.2g}",
            PARAMETERS[name].unit or BLANK,
            PARAMETERS[name].symbol,
            f"{known.inflation[name]:.1f}",
        )
        for name, value in solution.values.items()
    ]
    blocks: list[Block] = [
        Table(("parameter", "value", "sigma", "unit", "symbol", "raised"), tuple(rows)),
        Line("sigma is one standard deviation; raised, by how much for coloured residuals"),
    ]
    names = solution.problem.names
    if len(names) > 1:
        matrix = [(n, *(f"{c:+.2f}" for c in row)) for n, row in zip(names, known.correlation, strict=True)]
        blocks.append(Table(("correlation", *(PARAMETERS[n].symbol for n in names)), tuple(matrix)))
    blocks += [Line(f"fixed: {name}: {why}") for name, why in solution.fixed.items()]
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
            fitted = BLANK if of_fit is None else f"{of_fit:.4f}"
            cells = (f"{d.zeta:.4f}", f"{d.sigma:.1g}", fitted, f"{d.frequency_hz:.3f}", str(d.outliers))
            peaks.append((name, *cells))
        columns = ("damping of", "zeta by peaks", "sigma", "of the fit", "f, Hz", "outliers")
        blocks.append(Table(columns, tuple(peaks)))
    if found.prospects:
        after = [(one.name, one.worst, f"{100.0 * one.worst_relative:.2g} %") for one in found.prospects]
        blocks.append(Table(("after one more", "least known", "relative sigma"), tuple(after)))
    return blocks


def _plots(outcome: Sections | Actuator | PumpSection) -> dict[str, Figure]:
    """Figures of an identification; each of its sections has them all."""
    from calib.stages.actuator.plots import plots

    return plots(_evidence(outcome))


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
    plots=_plots,
)
