"""`calib run`: a folder of pictures and logs in; rig.yaml, states, firmware and a page out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, document, narrate, progress_bar, say, say_table
from calib.cli.verbs import of_logs
from calib.core.files import shown
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.verdict import LEADS

_SHOWN = 3
"""Sentences on what to record next, for a terminal."""


@of_logs
def run(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Rig folder: images/, images/plane/, logs/, and rig.yaml for what you know of the rig. "
            "Without one a simulated rig is calibrated."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results; a later run goes on from it.")
    ] = Path("calibration"),
    fresh: Annotated[bool, typer.Option("--fresh", help="Do all stages again, whatever is there.")] = False,
    follow_links: Annotated[
        bool, typer.Option("--follow-links", help="Take files that are links out of the folder as well.")
    ] = False,
    stated: LogOptions = NOTHING_STATED,
    jobs: Annotated[
        int | None, typer.Option(min=1, max=64, help="Stages at a time. [default: one per processor]")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a whole rig: every stage from pictures and logs to the firmware and a page to read.

    Stages whose inputs have not changed are not run again; one that fails stops only what needs it. Pictures
    alone are the calibration of a camera. Exits 0 when the firmware can be flashed, 1 when it cannot or
    something is weak, 3 when a stage has failed.
    """
    from calib.runner.outputs import calibrate

    with progress_bar("calibrating") as progress:
        done = calibrate(
            folder,
            output,
            fresh=fresh,
            follow_links=follow_links,
            stated=stated,
            jobs=jobs,
            narrate=narrate,
            progress=progress,
        )
    decision = done.decision
    if as_json:
        document("run", {"run": done.told, "decision": decision.as_json(), "files": [*done.files]})
    else:
        rows = [[job.label, job.status, "as before" if job.reused else ""] for job in done.ended]
        say_table(["stage", "", ""], rows)
        say(f"{shown(output)}: report.html and {len(done.files) - 1} more files")
        say(f"can it be flashed? {decision.answer}: {decision.headline}")
        for sentence in decision.weak:
            say(f"{LEADS['reason']}{sentence}")
        more = len(decision.record) - _SHOWN
        for sentence in [*decision.record[:_SHOWN], *([f"{more} more on the page"] if more > 0 else [])]:
            say(f"{LEADS['advice']}{sentence}")
    narrate(f"page written to {output / 'report.html'}")
    if decision.exit_code:
        raise typer.Exit(decision.exit_code)
