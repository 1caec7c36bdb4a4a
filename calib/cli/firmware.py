"""`calib firmware`: the constants of rig.yaml as C, the pipeline that uses them, and a check of boards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.common import JsonOption, RigOption, document, narrate, say
from calib.core.errors import EXIT_POOR, BadInputError

if TYPE_CHECKING:
    from calib.stages.firmware.header import Header

__all__ = ["firmware"]


def firmware(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write into.")] = Path(
        "firmware_constants"
    ),
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Compare a log of calib record with this rig instead of writing."),
    ] = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Write the header, the pipeline in C, its self-test and an Arduino sketch, or check a board's log.

    Exits 1 when the verdict of camera or plane is not ok (all is written and says so), or when a board
    computes something else.
    """
    from calib.core.files import shown
    from calib.core.rig import Rig
    from calib.stages.firmware.header import header_of

    if check is None:
        from calib.core.files import check_folder

        check_folder(output)
    whole = Rig.load(rig, missing_ok=True)
    if whole.camera is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    header = header_of(whole, shown(rig))
    if check is not None:
        _check(header, check, rig, as_json)
        return
    written, count = _write(header, output)
    plane = header.camera.plane
    verdicts = (("camera", header.camera.verdict), ("plane", plane.verdict if plane else ""))
    weak = [f"{name} is {verdict}" for name, verdict in verdicts if verdict not in ("ok", "")]
    if header.camera.verdict != whole.camera.verdict.word:
        error, covered = header.camera.inverse.max_error_px, header.camera.inverse.covered
        weak.append(f"the lens is undone to {error:.3g} px only, over {covered:.0%} of the picture")
    if as_json:
        document("firmware", {"files": written, "constants": count, "gate": weak or "passed"})
    else:
        without = "" if plane else ", no plane yet (calib extrinsics)"
        say(f"{shown(output / written[0])}: {count} constants{without}")
        for name in written[1:]:
            say(shown(output / name))
    if weak:
        narrate(f"{', '.join(weak)}: see CALIB_CAMERA_OK and CALIB_PLANE_OK, do not flash it unread")
        raise typer.Exit(EXIT_POOR)


def _write(header: Header, output: Path) -> tuple[list[str], int]:
    """Write the folder; returns the files' names and how many constants the header has."""
    from calib.core.files import make_folder, write_atomically
    from calib.stages.firmware.header import header_text, verbatim
    from calib.stages.firmware.vectors import selftest_text

    texts = {"calib_constants.h": header_text(header)}
    if header.camera.plane is not None:
        texts["calib_pipeline.h"] = verbatim("calib_pipeline.h")
        texts["calib_selftest.h"] = selftest_text(header)
        # The Arduino IDE wants a sketch to bear the name of its folder.
        texts[f"{output.resolve().name or 'calib_example'}.ino"] = verbatim("calib_example.ino")
    make_folder(output)
    for name, text in texts.items():
        write_atomically(output / name, text)
    return list(texts), len(header.literals)


def _check(header: Header, log: Path, rig: Path, as_json: bool) -> None:
    from calib.core.files import shown
    from calib.stages.firmware.check import check_frames, read_frames
    from calib.stages.firmware.vectors import TOLERANCE

    if header.camera.plane is None:
        raise BadInputError(
            f"{shown(rig)}: has no plane yet, so no board can run it; run calib extrinsics first"
        )
    result = check_frames(header, read_frames(log), shown(log))
    reasons = result.reasons
    if as_json:
        told = {
            "ticks": result.ticks,
            "lost_after": result.missing_after,
            "worst": result.worst,
            "tolerance": TOLERANCE,
            "flags_differ": result.flags_differ,
            "gate": reasons or "passed",
        }
        document("firmware", {"check": told})
    else:
        say(f"{shown(log)}: {result.ticks} ticks compared")
        for name, value in result.worst.items():
            say(f"  {name:<9} differs by {value:.2g} at most, allowed {TOLERANCE[name]:g}")
        say(f"verdict: {'poor, ' + reasons[0] if reasons else 'ok'}")
    if result.missing_after is not None:
        narrate(f"a frame is missing after tick {result.missing_after - 1}; what follows was not compared")
    if reasons:
        raise typer.Exit(EXIT_POOR)
