"""`calib diff`: what changed between two calibrations, and whether it is more than their error bars."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, answer, narrate
from calib.core.words import as_text


def diff(
    before: Annotated[Path, typer.Argument(help="rig.yaml of one calibration.")],
    after: Annotated[Path, typer.Argument(help="rig.yaml of the other.")],
    every: Annotated[
        bool, typer.Option("--all", help="Show every constant that differs, not only the foremost.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Page to write: both over the picture and on the plane."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two calibrations, in standard deviations and in millimetres on the plane.

    Exits 0 whatever has changed; the two are taken as independent of each other.
    """
    from calib.core.rig import Rig

    one, other = Rig.load(before), Rig.load(after)
    found = one.diff(other)
    if output is not None:
        from calib.core.command import note_inputs
        from calib.core.files import shown
        from calib.core.writing import check_writable
        from calib.show.diff import write_diff_page
        from calib.show.page import PAGE

        note_inputs([before, after])
        check_writable(output, PAGE)
        write_diff_page(output, one, other, (shown(before), shown(after)), found)
        narrate(f"page written to {shown(output)}")
    answer(as_json, "diff", asdict(found), *as_text(list(found.blocks(every)), sys.maxsize))
