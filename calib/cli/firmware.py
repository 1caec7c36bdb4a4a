"""`calib firmware`: the constants of rig.yaml as a C header."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, RigOption, document, narrate, say
from calib.errors import EXIT_POOR, BadInputError

__all__ = ["firmware"]


def firmware(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write into.")] = Path(
        "firmware_constants"
    ),
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Write calib_constants.h with the camera's and the plane's constants.

    Exits 1 when the verdict of either is not ok; the header is written and says so.
    """
    from calib.files import check_folder, make_folder, shown, write_atomically
    from calib.firmware.header import header_text
    from calib.rig import read_rig
    from calib.sections import current_plane, firmware_constants

    check_folder(output)
    whole = read_rig(rig)
    if whole.camera is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    plane = current_plane(whole, str(rig))
    inputs = {
        f"{section}/{name}": digest
        for section in ("camera", "plane")
        for name, digest in whole.provenance.inputs.get(section, {}).items()
        # The plane's camera is the camera above; only files are inputs of the header.
        if (section == "camera" or plane is not None) and name != "camera"
    }
    constants = firmware_constants(whole.camera, plane)
    text = header_text(constants, inputs)
    make_folder(output)
    path = output / "calib_constants.h"
    write_atomically(path, text)
    count = len(constants.intrinsics) + len(constants.inverse_lens) + len(constants.plane)
    verdicts = (("camera", constants.verdict), ("plane", constants.plane_verdict))
    weak = [f"{name} is {verdict}" for name, verdict in verdicts if verdict not in ("ok", "")]
    if constants.verdict != whole.camera.verdict:
        error, covered = constants.inverse.max_error_px, constants.inverse.covered
        weak.append(f"the lens is undone to {error:.3g} px only, over {covered:.0%} of the picture")
    if as_json:
        document("firmware", {"files": [path.name], "constants": count, "gate": weak or "passed"})
    else:
        say(f"{shown(path)}: {count} constants" + ("" if plane else ", no plane yet (calib extrinsics)"))
    if weak:
        narrate(f"{', '.join(weak)}: see CALIB_CAMERA_OK and CALIB_PLANE_OK, do not flash it unread")
        raise typer.Exit(EXIT_POOR)
