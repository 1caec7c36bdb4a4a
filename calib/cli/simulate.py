"""`calib simulate`: an experiment on the simulated rig, and its log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from calib.cli.common import JsonOption, answer, narrate, progress_bar
from calib.core.errors import UsageError
from calib.core.files import shown
from calib.core.units import parse_duration_s
from calib.core.writing import check_writable


def _options(settings: list[str]) -> dict[str, str]:
    options = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or not name:
            raise UsageError(f"--set: {setting!r} is not NAME=VALUE, expected for instance Kp=500")
        options[name.strip()] = value.strip()
    return options


_MOST_S = 86400.0


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            help="static, swing, steps, deflate, orientation, elongation, ellipse, chirp, prbs, or rig for a "
            "whole folder with pictures and logs."
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Log to write, .csv or .parquet; for rig a new folder.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Seed of all noise; the same seed, the same bytes.")] = 0,
    feedback: Annotated[
        str, typer.Option(help="What controllers get: sensors, filtered as in the firmware, or truth.")
    ] = "sensors",
    duration: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Length of the log, such as 10s. [default: the scenario's own]"),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Option of the scenario, such as Kp=500; may be repeated. calib docs simulate lists them.",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Rig to simulate; the nominal one by default.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate an experiment and write its log, with the truth in columns of its own."""
    from calib.io.logs import SIMULATED, write_log
    from calib.twin.rig import SimulatedRig, rig_from_file
    from calib.twin.scenarios import make_scenario, run_scenario
    from calib.twin.simulate import FEEDBACKS, run_log

    if feedback not in FEEDBACKS:
        raise UsageError(f"--feedback: {feedback!r} is not one of {', '.join(FEEDBACKS)}")
    options = _options(settings or [])
    duration_s = None if duration is None else parse_duration_s(duration, "--duration")
    if duration_s is not None and duration_s > _MOST_S:
        raise UsageError(f"--duration: found {duration_s:g} s, expected at most a day, {_MOST_S:g} s")
    machine = SimulatedRig()
    if rig is not None:
        from calib.core.rig import Rig

        machine = rig_from_file(Rig.load(rig))
    told: dict[str, Any] = {"scenario": scenario, "seed": seed, "feedback": feedback}
    if scenario == "rig":
        if options or duration_s is not None:
            raise UsageError("rig: writes a fixed set of logs, --set and --duration do not apply")
        from calib.twin.folder import write_rig_folder

        with progress_bar("simulating") as progress:
            logs = write_rig_folder(output, machine, seed, feedback, progress)
        told |= {"folder": str(output), "logs": [path.name for path in logs]}
        lines = [f"rig folder with {len(logs)} logs written to {output}"]
    else:
        plan = make_scenario(scenario, options)
        check_writable(output, SIMULATED)
        run = run_scenario(plan, machine, seed, feedback, duration_s)
        log = run_log(run, shown(output))
        write_log(output, log, SIMULATED)
        figures = plan.figures(run)
        told |= {
            "duration_s": len(run.pwm) * run.tick_s,
            "rows": len(log),
            "log": str(output),
            "figures": figures,
        }
        lines = [f"{scenario}: {len(run.pwm) * run.tick_s:g} s, {len(log)} rows written to {output}"]
        lines += [
            f"  {name} {'never' if value is None else f'{value:.4g}'}" for name, value in figures.items()
        ]
    answer(as_json, "simulate", {"simulate": told}, *lines)
    if not as_json:
        narrate("simulated: a model of a rig, not a recording of one")
