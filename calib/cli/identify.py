"""`calib identify`: parameters of the actuator and its pumps from logs and tables, with error bars."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.cli.compiling import telling
from calib.errors import EXIT_POOR, UsageError

if TYPE_CHECKING:
    from calib.actuatorsections import Identified

__all__ = ["identify"]


class _LogsByDefault(TyperGroup):
    """`calib identify LOG...` is `calib identify logs LOG...`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        helps = ctx.help_option_names
        if args and args[0] not in self.commands and args[0] not in helps:
            args = ["logs", *args]
        return super().parse_args(ctx, args)


identify = typer.Typer(
    cls=_LogsByDefault,
    help="Identify the actuator from LOG..., a pump from tables, springs from weights; all with error bars.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@identify.callback()
def _identify() -> None:
    # The group's own options: none. With a callback the names of the commands stay.
    pass


def _tell(found: Identified) -> None:
    from calib.actuator.identify_parameters import PARAMETERS

    solution, known = found.solution, found.uncertainty
    rows = [
        [
            name,
            f"{value:.5g}",
            f"{known.sigma[name]:.2g}",
            PARAMETERS[name].unit or "-",
            PARAMETERS[name].symbol,
            f"{known.inflation[name]:.1f}",
        ]
        for name, value in solution.values.items()
    ]
    head = ["parameter", "value", "sigma", "unit", "symbol", "raised"]
    for line in table(head, rows):
        say(line)
    say("sigma is one standard deviation; raised, by how much for coloured residuals")
    names = list(solution.problem.names)
    if len(names) > 1:
        matrix = [[n, *(f"{c:+.2f}" for c in row)] for n, row in zip(names, known.correlation, strict=True)]
        for line in table(["correlation", *(PARAMETERS[n].symbol for n in names)], matrix):
            say(line)
    for name, why in solution.fixed.items():
        say(f"fixed: {name}: {why}")
    by_name = {h.name: h for h in found.held}
    rows = []
    for track, (phi, length), colour in zip(solution.problem.tracks, found.rms, found.colours, strict=True):
        held = by_name.get(track.name)
        rows.append(
            [
                track.name,
                "on" if track.hoses else "off",
                str(len(track.t_s)),
                f"{1e3 * phi:.3g}",
                f"{1e3 * length:.3g}",
                "-" if held is None else f"{1e3 * held.held_phi_rad:.3g}",
                "-" if held is None else f"{1e3 * held.held_length_m:.3g}",
                "yes" if colour.white else f"no ({100.0 * colour.outside:.0f} %)",
            ]
        )
    head = ["RMS of", "hoses", "poses", "phi, mrad", "length, mm", "held phi", "held length", "white"]
    for line in table(head, rows):
        say(line)
    if found.decrements:
        rows = []
        for name, (d, of_fit) in found.decrements.items():
            fitted = "-" if of_fit is None else f"{of_fit:.4f}"
            rows.append(
                [name, f"{d.zeta:.4f}", f"{d.sigma:.1g}", fitted, f"{d.frequency_hz:.3f}", str(d.outliers)]
            )
        for line in table(["damping of", "zeta by peaks", "sigma", "of the fit", "f, Hz", "outliers"], rows):
            say(line)
    if found.prospects:
        rows = [[p.name, p.worst, f"{100.0 * p.worst_relative:.2g} %"] for p in found.prospects]
        for line in table(["after one more", "least known", "relative sigma"], rows):
            say(line)
    say(f"verdict: {found.judgement.verdict}")
    for sentence in (*found.judgement.reasons, *found.judgement.remarks, *found.judgement.advice):
        say(f"  - {sentence}")


def logs(
    paths: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of camera and commands.")],
    states: Annotated[
        list[Path] | None,
        typer.Option(help="States of calib replay to use instead of the pictures, for the logs in turn."),
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Take the true columns of a simulated log, to test the method.")
    ] = False,
    no_pwm: Annotated[
        bool, typer.Option("--no-pwm", help="Logs without commands are swings with the hoses off.")
    ] = False,
    static_map: Annotated[
        bool,
        typer.Option("--static-map", help="Estimate the steady elongations at 6, 8, 10 and 12 V as well."),
    ] = False,
    hold_back: Annotated[
        bool, typer.Option("--hold-back/--no-hold-back", help="Predict each log from a fit to the others.")
    ] = True,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Identify stiffness, damping, bending, creep and the pumps from logs of motion.

    Writes the sections actuator and, where a log has commands, pump. Exits 1 when the verdict is not ok.
    """
    from calib.actuatorsections import (
        identified_json,
        nominal_of,
        plain_section,
        sections_from,
        with_sections,
    )
    from calib.files import check_folder, check_writable, shown
    from calib.identification import identify_logs
    from calib.identifying import read_track
    from calib.rig import hash_of, read_rig, write_rig

    if states and len(states) != len(paths):
        raise UsageError(f"--states: {len(states)} files for {len(paths)} logs, expected one for each")
    if truth and states:
        raise UsageError("--truth: takes the true columns, --states does not apply")
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    nominal = nominal_of(before, rig)
    sources, hashes = [], {}
    for k, path in enumerate(paths):
        given = states[k] if states else None
        source = read_track(path, before, rig, nominal.plant.bellows_radius_m, given, truth, no_pwm)
        name = shown(path.name)
        hashes[name if name not in hashes else f"{name} ({k + 1})"] = hash_of(path)
        if source.states is not None:
            hashes[shown(source.states.name)] = hash_of(source.states)
        for sentence in source.said:
            narrate(sentence)
        sources.append(source)
    with progress_bar("identifying") as progress:
        found = identify_logs(nominal, sources, static_map, hold_back, progress)
    sections = sections_from(found, before, rig)
    write_rig(rig, with_sections(before, sections), dict.fromkeys(sections, hashes))
    narrate(f"{' and '.join(sections)} written to {shown(rig)}")
    if figures is not None:
        from calib.report.identify_figures import write_identify_figures

        write_identify_figures(figures, found)
        narrate(f"figures in {shown(figures)}")
    if as_json:
        told = {name: plain_section(section) for name, section in sections.items()}
        document("identify", {**told, "identify": identified_json(found)})
    else:
        _tell(found)
    if found.judgement.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def pump(
    paths: Annotated[
        list[Path], typer.Argument(metavar="TABLE...", help="Tables of time, PWM and pressure.")
    ],
    held: Annotated[
        list[Path] | None, typer.Option("--held", help="Table to predict and not to fit; may be repeated.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Column of the time; recognised by default.")] = None,
    pwm: Annotated[str | None, typer.Option(help="Column of the PWM.")] = None,
    value: Annotated[str | None, typer.Option(help="Column of pressure or force.")] = None,
    unit: Annotated[Literal["kPa", "N"] | None, typer.Option(help="Unit of that column.")] = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find dead time, lag, static map and flow of a pump; compare two models on tables not fitted.

    Writes the section pump. Exits 1 when something is left that the PWM does not explain.
    """
    from calib.actuatorsections import plain_section, with_sections
    from calib.cli.identify_tell import tell_pump
    from calib.files import check_folder, check_writable, shown
    from calib.identification import identify_pump
    from calib.pumpsections import pump_section
    from calib.pumptables import read_pump_table
    from calib.rig import hash_of, read_rig, write_rig

    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    tables = [read_pump_table(path, time, pwm, value, unit) for path in paths]
    kept_out = [read_pump_table(path, time, pwm, value, unit) for path in held or []]
    with progress_bar("identifying") as progress:
        found = identify_pump(tables, kept_out, progress)
    section = pump_section(found, before, rig)
    hashes = {shown(path.name): hash_of(path) for path in paths}
    write_rig(rig, with_sections(before, {"pump": section}), {"pump": hashes})
    narrate(f"pump written to {shown(rig)}")
    if figures is not None:
        from calib.report.identify_pump_figures import write_pump_figures

        write_pump_figures(figures, found, section.verdict or "ok")
        narrate(f"figures in {shown(figures)}")
    if as_json:
        told: dict[str, Any] = {"pump": plain_section(section)}
        if kept_out:
            told["held"] = {
                model: {h.name: {"rms": h.rms, "ahead_rms": h.ahead} for h in rows}
                for model, rows in found.asked.items()
            }
        document("identify pump", told)
    else:
        tell_pump(found, section)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def stiffness(
    path: Annotated[Path, typer.Argument(metavar="TABLE", help="Elongations with forces or masses.")],
    per: Annotated[
        Literal["actuator", "bellows"], typer.Option(help="What the table's forces stretch.")
    ] = "actuator",
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find the springs from hanging weights or steady elongations: linear and polynomial, zero at zero.

    Writes k0 .. k3 of one bellows to the section actuator.
    """
    from calib.actuator.identify_stiffness import fit_stiffness
    from calib.actuatorsections import plain_section, stiffness_section, with_sections
    from calib.files import check_folder, check_writable, shown
    from calib.identifying import read_displacements
    from calib.rig import hash_of, read_rig, write_rig

    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    eps, force = read_displacements(path)
    fits, best = fit_stiffness(shown(path), eps, force)
    section = stiffness_section(fits[best], per == "actuator", before, rig)
    write_rig(
        rig,
        with_sections(before, {"actuator": section}),
        {"actuator": {**before.provenance.inputs.get("actuator", {}), shown(path.name): hash_of(path)}},
    )
    narrate(f"actuator written to {shown(rig)}")
    if figures is not None:
        from calib.report.identify_figures import write_stiffness_figure

        write_stiffness_figure(figures, eps, force, fits, best)
        narrate(f"figures in {shown(figures)}")
    laws = [
        {
            "order": f.order,
            "coefficients": f.coefficients.tolist(),
            "sigma": f.sigma.tolist(),
            "correlation": f.correlation.tolist(),
            "rms_N": f.rms_N,
            "left_out_rms_N": f.left_out_rms_N,
            "used": k == best,
        }
        for k, f in enumerate(fits)
    ]
    if as_json:
        document(
            "identify stiffness",
            {"actuator": plain_section(section), "stiffness": {"per": per, "laws": laws}},
        )
        return
    rows = []
    for k, f in enumerate(fits):
        terms = [
            f"{c:.5g} +- {s:.2g}" for c, s in zip(f.coefficients.tolist(), f.sigma.tolist(), strict=True)
        ]
        terms += ["-"] * (3 - len(terms))
        rows.append([f"order {f.order}{' (used)' if k == best else ''}", *terms, f"{f.left_out_rms_N:.3g}"])
    head = [f"of the {per}", "k0, N/m", "k1, N/m^2", "k2, N/m^3", "left out, N"]
    for line in table(head, rows):
        say(line)


identify.command("logs")(telling(logs))
identify.command("pump")(telling(pump))
identify.command("stiffness")(stiffness)
