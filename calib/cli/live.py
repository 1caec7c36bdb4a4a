"""`calib live`: a page that leads one through the calibration of a camera."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, answer, narrate
from calib.cli.interrupts import Interrupts
from calib.core.errors import EXIT_POOR, BadInputError, UsageError, pip_install
from calib.core.files import shown
from calib.core.units import parse_corners, parse_square_m
from calib.core.words import as_text, described


def live(
    source: Annotated[
        str | None,
        typer.Argument(
            help="Number of a camera, address of a stream, a video, or a folder that is being filled with "
            "pictures. Without it the browser's own camera.",
            metavar="[CAMERA|URL|FOLDER]",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder for images/ and rig.yaml; an earlier session goes on."),
    ] = Path("live"),
    corners: Annotated[
        str | None,
        typer.Option(
            metavar="CxR", help="Inner corners, columns x rows, as 8x5. [default: board.yaml, else found]"
        ),
    ] = None,
    square: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Side of a square with its unit, as 20mm. [default: board.yaml]"),
    ] = None,
    port: Annotated[
        str | None,
        typer.Option(
            metavar="PORT",
            help="Serial port of a board, as /dev/ttyUSB0: its recordings are made from the page too.",
        ),
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a camera while you hold the board: a page shows what to do next, and when it is enough.

    The page is served on this machine alone. Pictures are saved as they are taken; the section camera of
    rig.yaml is what calib intrinsics makes of them. Done, or Ctrl-C, ends it. Exits 1 when the verdict is
    not ok.
    """
    from calib.core.result import section_json
    from calib.live.album import Album
    from calib.live.session import Session
    from calib.live.sources import source_of
    from calib.stages.camera.options import Told

    try:
        from calib.live.server import Live
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("calib"):
            raise
        raise UsageError(f"calib live needs starlette and uvicorn: {pip_install('live')}") from error
    asked = Told(
        None if corners is None else parse_corners(corners),
        None if square is None else parse_square_m(square),
    )
    album = Album(output)
    frames = source_of(source, album.images)
    board, views, size_px = album.open(asked)
    known = None if board.corners is None else (board.corners[0], board.corners[1])
    stated, square_m = asked.corners or known, asked.square_m or board.square_m
    session = Session(stated, square_m, size_px, board.dictionary)
    session.views.update((view.name, view) for view in views)
    if views:
        narrate(f"{shown(album.images)}: going on with {len(views)} pictures")
    if port is not None and importlib.util.find_spec("serial") is None:
        raise UsageError(f"--port needs pyserial: {pip_install('serial')}")
    at_work = Live(session, album, frames, port)

    before = set(album.logs.glob("*.csv"))

    def ready(address: str) -> None:
        narrate(f"Done on the page, or Ctrl-C, ends it; open {address}")
        if browser:
            import webbrowser

            webbrowser.open(address)

    try:
        at_work.serve(ready)
    except KeyboardInterrupt:
        Interrupts.settle()
        narrate("ended; what was taken is saved")
    if not album.names() and set(album.logs.glob("*.csv")) - before:
        narrate(f"recordings are in {shown(album.logs)}; no picture was taken, so no camera is calibrated")
        answer(as_json, "live", {"camera": None, "pictures": []})
        return
    if not album.names():
        raise BadInputError(
            f"{shown(album.images)}: no picture was taken; hold the board as the page outlines it, or press "
            "space there; a video or a folder that is complete is for calib intrinsics"
        )
    camera = album.calibrate()
    told = {"camera": section_json(camera), "pictures": album.names()}
    answer(as_json, "live", told, *as_text(described(camera)))
    narrate(f"camera written to {shown(album.rig)}")
    if not camera.verdict.ok:
        raise typer.Exit(EXIT_POOR)
