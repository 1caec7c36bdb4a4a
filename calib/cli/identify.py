"""`calib identify`: parameters of the actuator and its pumps from logs and tables, with error bars."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from calib.cli.common import (
    FiguresOption,
    JsonOption,
    RigOption,
    document,
    narrate,
    progress_bar,
    say,
    table,
    telling,
)
from calib.cli.verbs import verb
from calib.core.errors import EXIT_POOR
from calib.stages import stage

if TYPE_CHECKING:
    from calib.stages.actuator.pump_results import PumpFound
    from calib.stages.actuator.section import PumpSection

# ----------------------------------------------------------------------
# What `calib identify pump` says on stdout.


def _cell(value: float | None, digits: int = 3) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}g}"


def tell_pump(found: PumpFound, section: PumpSection) -> None:
    """Parameters, errors on files that were not fitted, static maps, and what is not explained."""
    from calib.stages.actuator.pump_results import parameter_rows

    unit = found.unit
    for model, fit in found.fits.items():
        rows = [
            [name, _cell(value, 4) if sigma is not None else "off", _cell(sigma, 2), of or "-"]
            for name, value, sigma, of, _ in parameter_rows(fit, unit)
        ]
        for line in table([model, "value", "sigma", "unit"], rows):
            say(line)
    if found.fits:
        models = list(found.fits)
        held = {model: {h.name: h for h in found.held[model]} for model in models}
        rows = []
        for record in found.records:
            cells = [held[m].get(record.name) for m in models]
            free = [_cell(None if h is None else h.rms) for h in cells]
            rows.append([record.name, *free, *(_cell(None if h is None else h.ahead) for h in cells)])
        main = found.main_group
        if main is not None:
            ends = [_cell(found.held_rms(m, main.names)) for m in models]
            rows.append([f"all that settle near {main.value:.1f} {unit}", *ends, *["" for _ in models]])
        rows.append(["all", *(_cell(found.held_rms(m)) for m in models), *["" for _ in models]])
        head = [f"RMS on files not fitted, {unit}", *models, *(f"{m}, 0.5 s ahead" for m in models)]
        for line in table(head, rows):
            say(line)
        say(
            "simulated from a file's PWM and its first 0.2 s, which give the start; the extras of a model "
            "are chosen once, on all files"
        )
        kept = {model: {h.name: h for h in found.asked[model]} for model in models}
        if kept[models[0]]:
            rows = [
                [
                    name,
                    *(_cell(kept[m][name].rms) for m in models),
                    *(_cell(kept[m][name].ahead) for m in models),
                ]
                for name in kept[models[0]]
            ]
            for line in table([f"RMS on the tables kept out, {unit}", *head[1:]], rows):
                say(line)
    if found.maps:
        rows = [
            [
                m.name,
                f"{m.end:.4g} +- {_cell(m.sigma['end'], 2)}",
                f"{m.shape.dead_pwm:.1f} +- {_cell(m.sigma['dead_pwm'], 2)}",
                f"{m.shape.scale_pwm:.1f} +- {_cell(m.sigma['scale_pwm'], 2)}",
                f"{m.saturates_pwm:.0f}",
                _cell(m.scatter),
            ]
            for m in found.maps
        ]
        head = ["static map", f"at PWM 255, {unit}", "dead zone, PWM", "scale, PWM", "95 % at PWM", "scatter"]
        for line in table(head, rows):
            say(line)
    say(f"verdict: {section.verdict.word}")
    for sentence in (*section.verdict.reasons, *section.verdict.remarks):
        say(f"  - {sentence}")


# ----------------------------------------------------------------------
# `calib identify`: parameters of the actuator and its pumps from logs and tables, with error bars.


def _of_arm(args: list[str]) -> bool:
    """Whether the first argument that is a file is a log of a pressure-driven arm."""
    from calib.io.columns import is_arm_log
    from calib.io.logs import columns_of

    first = next((path for path in map(Path, args) if path.is_file()), None)
    return first is not None and is_arm_log(columns_of(first) or ())


class _LogsByDefault(TyperGroup):
    """`calib identify LOG...` is `calib identify logs LOG...`, or `identify arm` of logs with pressures."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        helps = ctx.help_option_names
        if args and args[0] not in self.commands and args[0] not in helps:
            args = ["arm" if _of_arm(args) else "logs", *args]
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
    from calib.core.command import note_inputs
    from calib.core.files import hash_of, shown
    from calib.core.result import section_json
    from calib.core.rig import SECTIONS, Rig
    from calib.core.writing import check_figures, check_writable
    from calib.stages.actuator.pump_results import identify_pump, pump_section
    from calib.stages.actuator.read import read_pump_table

    note_inputs([*paths, *(held or [])])
    check_writable(rig, SECTIONS)
    if figures is not None:
        check_figures(figures)
    before = Rig.load(rig, missing_ok=True)
    tables = [read_pump_table(path, time, pwm, value, unit) for path in paths]
    kept_out = [read_pump_table(path, time, pwm, value, unit) for path in held or []]
    with progress_bar("identifying") as progress:
        found = identify_pump(tables, kept_out, progress)
    section = pump_section(found, before)
    hashes = {shown(path.name): hash_of(path) for path in paths}
    before.pump = section
    before.save(rig, {"pump": hashes})
    narrate(f"pump written to {shown(rig)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.actuator.plots import pump_plots

        write_figures(figures, pump_plots(found, section.verdict.word))
        narrate(f"figures in {shown(figures)}")
    if as_json:
        told: dict[str, Any] = {"pump": section_json(section)}
        if kept_out:
            told["held"] = {
                model: {h.name: {"rms": h.rms, "ahead_rms": h.ahead} for h in rows}
                for model, rows in found.asked.items()
            }
        document("identify pump", told)
    else:
        tell_pump(found, section)
    if not section.verdict.ok:
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
    from calib.core.command import note_inputs
    from calib.core.files import hash_of, shown
    from calib.core.result import section_json
    from calib.core.rig import SECTIONS, Rig
    from calib.core.writing import check_figures, check_writable
    from calib.stages.actuator.identify import fit_stiffness
    from calib.stages.actuator.read import read_displacements
    from calib.stages.actuator.results import stiffness_section

    note_inputs([path])
    check_writable(rig, SECTIONS)
    if figures is not None:
        check_figures(figures)
    before = Rig.load(rig, missing_ok=True)
    eps, force = read_displacements(path)
    fits, best = fit_stiffness(shown(path), eps, force)
    section = stiffness_section(fits[best], per == "actuator", before)
    learnt = before.provenance.inputs.get("actuator", {})
    before.actuator = section
    before.save(rig, {"actuator": {**learnt, shown(path.name): hash_of(path)}})
    narrate(f"actuator written to {shown(rig)}")
    if figures is not None:
        from calib.show.draw import write_figures
        from calib.stages.actuator.plots import stiffness_plots

        write_figures(figures, stiffness_plots(eps, force, fits, best))
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
            {"actuator": section_json(section), "stiffness": {"per": per, "laws": laws}},
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


identify.command("logs")(telling(verb(stage("identify logs"))))
identify.command("arm")(telling(verb(stage("identify arm"))))
identify.command("pump")(telling(pump))
identify.command("stiffness")(stiffness)
