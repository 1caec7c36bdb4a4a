"""`calib board`: a checkerboard to print, at exact scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, document, say
from calib.errors import UsageError

__all__ = ["board"]


def board(
    output: Annotated[Path, typer.Option("-o", "--output", help="PDF to write.")] = Path("board.pdf"),
    corners: Annotated[str, typer.Option(help="Inner corners, columns x rows.")] = "7x5",
    square: Annotated[str, typer.Option(help="Length of a square.")] = "20mm",
    page: Annotated[str, typer.Option(help="Paper: A4 or Letter.")] = "A4",
    as_json: JsonOption = False,
) -> None:
    """Write a printable PDF of the checkerboard, with a ruler to check the printer's scale."""
    from calib.files import write_atomically
    from calib.report.boardsheet import board_pdf
    from calib.units import parse_corners, parse_length_m

    if page not in ("A4", "Letter"):
        raise UsageError(f"--page: {page!r} is not one of A4, Letter")
    columns, rows = parse_corners(corners)
    square_m = parse_length_m(square, "--square")
    write_atomically(output, board_pdf(columns, rows, square_m, page))
    if as_json:
        document("board", {"corners": [columns, rows], "square_m": square_m, "page": page})
        return
    say(f"{output}: {columns}x{rows} inner corners, squares of {square_m * 1e3:g} mm, {page}")
    say("print at 100 %, without fitting to the page, and measure the ruler")
    say("board.yaml for the pictures' folder:")
    say(f"corners: [{columns}, {rows}]")
    say(f"square_m: {square_m:g}")
