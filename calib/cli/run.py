"""`calib run`: a folder of pictures and logs in; rig.yaml, states, firmware and a page out."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import (
    AccUnitOption,
    ColumnsOption,
    GyroUnitOption,
    JsonOption,
    document,
    narrate,
    progress_bar,
    say,
    table,
)
from calib.core.errors import EXIT_DONE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.runner.folder import Folder
    from calib.runner.graph import Done

__all__ = ["is_available", "run"]


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
    acc_unit: AccUnitOption = None,
    gyro_unit: GyroUnitOption = None,
    columns: ColumnsOption = None,
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
    from calib.core.stage import LogOptions
    from calib.core.workers import processors
    from calib.io.columns import read_columns_file
    from calib.runner.folder import read_folder
    from calib.runner.graph import HIDDEN, Pool, Runner, opened
    from calib.runner.outputs import decide, publish, summary
    from calib.show.page import keep_pictures, write_page

    stated = LogOptions(acc_unit, gyro_unit, None if columns is None else columns.absolute())
    if columns is not None:
        read_columns_file(columns)
    seen = None if folder is None else read_folder(folder, follow_links, stated)
    with opened(output, folder) as interrupted, Pool(jobs or processors()) as pool:
        if interrupted is not None:
            narrate("the last run here was interrupted; going on where it stopped")
        if seen is None:
            narrate("no folder given: a simulated rig is calibrated, not a real one")
            seen = _simulated(output)
        for sentence in seen.left_out:
            narrate(sentence)
        with progress_bar("calibrating") as progress:
            runner = Runner(seen, output, pool, is_available, narrate, progress, fresh=fresh)
            ended = runner.run()
        told = summary(runner, ended, folder is None)
        files = publish(runner, ended, told)
        keep_pictures(seen.pictures, output / HIDDEN / "pictures")
        write_page(output / "rig.yaml")
    decision = decide(told, runner.sections().values)
    if as_json:
        document("run", {"run": told, "decision": decision.as_json(), "files": [*files, "report.html"]})
    else:
        _tell(ended, files, output)
        say(f"can it be flashed? {decision.answer}: {decision.headline}")
        for sentence in decision.weak:
            say(f"  - {sentence}")
    narrate(f"page written to {output / 'report.html'}")
    if decision.exit_code:
        raise typer.Exit(decision.exit_code)


@cache
def is_available(verb: tuple[str, ...]) -> bool:
    """Whether this version has a verb."""
    command = _all_verbs()
    for word in verb:
        command = getattr(command, "commands", {}).get(word)
        if command is None:
            return False
    return not getattr(command, "commands", {})


@cache
def _all_verbs() -> Any:
    """The whole command; its classes are those of typer's own copy of click, hence no type."""
    from calib.cli.app import app

    return typer.main.get_command(app)


def _simulated(output: Path) -> Folder:
    """The folder of a simulated rig, made beside the results unless this program has made it before."""
    from calib.core.writing import make_folder
    from calib.runner.cache import key_of, load, remove, store
    from calib.runner.folder import read_folder
    from calib.runner.graph import HIDDEN
    from calib.twin.folder import write_rig_folder
    from calib.twin.rig import SimulatedRig

    hidden = output / HIDDEN
    place, key = hidden / "stages" / "simulate", key_of(("simulate", "rig"), {}, "")
    if load(place, key) is None:
        work = hidden / "work" / "simulate"
        remove(work)
        make_folder(work)
        write_rig_folder(work / "rig", SimulatedRig())
        store(work, place, key, EXIT_DONE, hidden / "work" / "old-simulate")
    return read_folder(place / "rig")


def _tell(ended: Sequence[Done], files: Sequence[str], output: Path) -> None:
    from calib.core.files import one_line, shown

    rows = []
    for done in ended:
        log = "" if done.job.log is None else f" of {one_line(done.job.log.path.stem)}"
        rows.append([f"{done.job.stage.title}{log}", done.status, "as before" if done.reused else ""])
    for line in table(["stage", "", ""], rows):
        say(line)
    say(f"{shown(output)}: report.html and {len(files)} more files")
