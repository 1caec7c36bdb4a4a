"""`calib export` and `calib import`: the camera in other tools' formats."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.cli.common import JsonOption, RigOption, document, emit, narrate, say
from calib.errors import BadInputError

__all__ = ["export_camera", "import_camera"]

FormatArgument = Annotated[
    Literal["ros", "opencv", "kalibr"],
    typer.Argument(metavar="FORMAT", help="ros (camera_info), opencv (FileStorage) or kalibr (camchain)."),
]
_MAX_BYTES = 200_000


def export_camera(
    to: FormatArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; stdout by default.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the camera in the file.")] = "camera",
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Write the camera as ROS camera_info, OpenCV FileStorage or Kalibr camchain."""
    from calib.camera.formats import to_kalibr, to_opencv, to_ros
    from calib.files import shown, write_atomically
    from calib.rig import read_rig
    from calib.sections import camera_from_section

    section = read_rig(rig).camera
    if section is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    camera = camera_from_section(section)
    text = {
        "ros": lambda: to_ros(camera, name),
        "opencv": lambda: to_opencv(camera),
        "kalibr": lambda: to_kalibr(camera, name),
    }[to]()
    if section.verdict != "ok":
        narrate(f"the camera's verdict is {section.verdict}; the format cannot say so")
    if output is not None:
        write_atomically(output, text)
        narrate(f"{to} camera written to {shown(output)}")
    if as_json:
        document("export", {"format": to, "verdict": section.verdict, "text": text})
    elif output is None:
        emit(text.rstrip("\n") + "\n")


def import_camera(
    from_: FormatArgument,
    source: Annotated[Path, typer.Argument(help="File to read.")],
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Read a camera from ROS camera_info, OpenCV FileStorage or Kalibr camchain into rig.yaml."""
    from calib.camera.formats import from_kalibr, from_opencv, from_ros
    from calib.files import as_text, check_writable, read_bytes, sha256, shown
    from calib.rig import read_rig, section_json, write_rig
    from calib.sections import imported_camera_section, outdated

    check_writable(rig)
    before = read_rig(rig)
    data = read_bytes(source, _MAX_BYTES)
    text = as_text(source, data)
    try:
        camera = {"ros": from_ros, "opencv": from_opencv, "kalibr": from_kalibr}[from_](text)
    except BadInputError as error:
        raise BadInputError(f"{shown(source)}: {error}") from error
    section = imported_camera_section(camera, from_)
    after = write_rig(
        rig, before.model_copy(update={"camera": section}), {"camera": {shown(source.name): sha256(data)}}
    )
    if as_json:
        document("import", {"camera": section_json(section)})
    else:
        say(f"camera {camera.model}, {camera.image_size_px[0]}x{camera.image_size_px[1]} px")
        say("it comes without error bars, so its verdict is poor until calib intrinsics has seen pictures")
    narrate(f"camera written to {shown(rig)}")
    for sentence in outdated(after):
        narrate(sentence)
