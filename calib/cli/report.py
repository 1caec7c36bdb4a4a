"""`calib report`: the page of a rig.yaml, from what lies beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, answer, narrate
from calib.core.command import note_inputs
from calib.core.files import shown
from calib.core.writing import check_writable


def report(
    rig: Annotated[
        Path, typer.Argument(help="rig.yaml of calib run, or of single verbs: then without figures.")
    ] = Path("rig.yaml"),
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Page to write. [default: report.html beside it]"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write the page of a calibration again: one HTML file that needs no network."""
    from calib.show.page import PAGE, write_page

    target = rig.parent / "report.html" if output is None else output
    note_inputs([rig])
    check_writable(target, PAGE)
    write_page(rig, target)
    size = target.stat().st_size
    answer(as_json, "report", {"page": str(target), "bytes": size}, f"{shown(target)}: {1e-6 * size:.1f} MB")
    if not as_json:
        narrate("open it in a browser")
