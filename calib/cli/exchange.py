"""`calib export` and `calib import`: the camera and the IMU's noise in other tools' formats."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from calib.cli.common import JsonOption, RigOption, document, emit, narrate, say
from calib.errors import BadInputError, UsageError

__all__ = ["export_camera", "import_camera"]

FormatArgument = Annotated[
    Literal["ros", "opencv", "kalibr", "kalibr-imu"],
    typer.Argument(
        metavar="FORMAT",
        help="ros (camera_info), opencv (FileStorage), kalibr (camchain) or kalibr-imu (imu.yaml).",
    ),
]
_MAX_BYTES = 200_000


def export_camera(
    to: FormatArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; stdout by default.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the camera in the file, or topic of the IMU.")
    ] = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Write the camera as ROS camera_info, OpenCV FileStorage or Kalibr camchain, the IMU as imu.yaml."""
    from calib.files import shown, write_atomically

    what = "IMU" if to == "kalibr-imu" else "camera"
    text, verdict = _imu_text(rig, name) if what == "IMU" else _camera_text(to, rig, name or "camera")
    if verdict != "ok":
        narrate(f"the {what}'s verdict is {verdict}; the format cannot say so")
    if output is not None:
        write_atomically(output, text)
        narrate(f"{to} {what} written to {shown(output)}")
    if as_json:
        document("export", {"format": to, "verdict": verdict, "text": text})
    elif output is None:
        emit(text.rstrip("\n") + "\n")


def _camera_text(to: str, rig: Path, name: str) -> tuple[str, str]:
    from calib.camera.formats import to_kalibr, to_opencv, to_ros
    from calib.files import shown
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
    return text, section.verdict


def _imu_text(rig: Path, topic: str | None) -> tuple[str, str]:
    from calib.files import one_line, shown
    from calib.imusections import kalibr_imu
    from calib.rig import read_rig

    if topic is not None and not re.fullmatch(r"[A-Za-z~/][\w~/]*", topic, re.ASCII):
        raise UsageError(f"--name: {one_line(topic)[:60]!r} is no topic, expected for instance /imu0")
    section = read_rig(rig).imu
    if section is None:
        raise BadInputError(f"{shown(rig)}: has no imu yet; run calib imu static first")
    return kalibr_imu(section, topic or "/imu0"), section.verdict


def import_camera(
    from_: FormatArgument,
    source: Annotated[Path, typer.Argument(help="File to read.")],
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Read a camera from ROS camera_info, OpenCV FileStorage or Kalibr camchain, or an imu.yaml."""
    if from_ == "kalibr-imu":
        _import_imu(source, rig, as_json)
        return
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


def _import_imu(source: Path, rig: Path, as_json: bool) -> None:
    from calib.files import check_writable, read_bytes, read_yaml_mapping, sha256, shown
    from calib.kalibr_imu import from_kalibr_imu
    from calib.rig import read_rig, section_json, write_rig

    check_writable(rig)
    before = read_rig(rig)
    digest = sha256(read_bytes(source, _MAX_BYTES))
    try:
        section = from_kalibr_imu(read_yaml_mapping(source))
    except BadInputError as error:
        place = shown(source)
        raise BadInputError(str(error) if str(error).startswith(place) else f"{place}: {error}") from error
    write_rig(rig, before.model_copy(update={"imu": section}), {"imu": {shown(source.name): digest}})
    if as_json:
        document("import", {"imu": section_json(section)})
    else:
        say(f"IMU noise at {section.rate_hz:g} Hz")
        say("it comes without biases and error bars, so its verdict is poor until calib imu static has run")
    narrate(f"imu written to {shown(rig)}")
