"""`calib board`: a checkerboard to print, at exact scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.cli.common import JsonOption, document, say

__all__ = ["board"]


def board(
    output: Annotated[Path, typer.Option("-o", "--output", help="PDF to write.")] = Path("board.pdf"),
    corners: Annotated[str, typer.Option(metavar="CxR", help="Inner corners, columns x rows.")] = "7x5",
    square: Annotated[
        str, typer.Option(metavar="LENGTH", help="Side of a square with its unit: mm, cm, m or in.")
    ] = "20mm",
    page: Annotated[Literal["A4", "Letter"], typer.Option(help="Paper.")] = "A4",
    as_json: JsonOption = False,
) -> None:
    """Write a printable PDF of the checkerboard, with a ruler to check the printer's scale."""
    from calib.files import write_atomically
    from calib.report.boardsheet import board_pdf
    from calib.units import parse_corners, parse_square_m

    columns, rows = parse_corners(corners)
    square_m = parse_square_m(square)
    write_atomically(output, board_pdf(columns, rows, square_m, page))
    if as_json:
        document("board", {"corners": [columns, rows], "square_m": square_m, "page": page})
        return
    say(f"{output}: {columns}x{rows} inner corners, squares of {square_m * 1e3:g} mm, {page}")
    say("print at 100 %, without fitting to the page, and measure the ruler")
    say("board.yaml for the pictures' folder:")
    say(f"corners: [{columns}, {rows}]")
    say(f"square_m: {square_m:g}")
