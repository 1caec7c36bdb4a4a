"""A board to print, and cameras and noise in the files of other tools: `board`, `export`, `import`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from calib.cli.common import JsonOption, RigOption, answer, document, emit, narrate, say
from calib.core.command import note_inputs
from calib.core.errors import BadInputError, UsageError
from calib.core.files import as_text, is_bag, one_line, read_bytes, read_yaml_mapping, sha256, shown
from calib.core.units import parse_corners, parse_square_m
from calib.core.writing import check_writable, write_atomically

# ----------------------------------------------------------------------
# `calib board`: a checkerboard or ChArUco board to print, at exact scale.


def board(
    output: Annotated[Path, typer.Option("-o", "--output", help="PDF to write.")] = Path("board.pdf"),
    corners: Annotated[str, typer.Option(metavar="CxR", help="Inner corners, columns x rows.")] = "8x5",
    square: Annotated[
        str, typer.Option(metavar="LENGTH", help="Side of a square with its unit: mm, cm, m or in.")
    ] = "20mm",
    page: Annotated[Literal["A4", "Letter"], typer.Option(help="Paper.")] = "A4",
    charuco: Annotated[
        bool, typer.Option("--charuco", help="With markers, by which any part of the board is recognised.")
    ] = False,
    dictionary: Annotated[
        str | None, typer.Option(metavar="NAME", help="Markers of --charuco. [default: 4X4_50 or larger]")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a printable PDF of a checkerboard or ChArUco board, with a ruler to check the printer's scale.

    Half a turn changes the default board, so that every picture shows which corner is the first. A board
    whose columns and rows of corners are both even or both odd looks the same from either end.
    """
    from calib.show.boardsheet import BOARD_PDF, board_pdf
    from calib.stages.camera.model import Board
    from calib.stages.camera.read import known_dictionary

    columns, rows = parse_corners(corners)
    square_m = parse_square_m(square)
    markers = None
    if dictionary is not None and not charuco:
        raise UsageError("--dictionary: goes with --charuco")
    if charuco:
        count = (columns + 1) * (rows + 1) // 2
        enough = next((n for n in (50, 100, 250, 1000) if n >= count), 1000)
        markers = known_dictionary(dictionary or f"4X4_{enough}", "--dictionary", UsageError)
    write_atomically(output, board_pdf(columns, rows, square_m, page, markers), BOARD_PDF)
    if as_json:
        about = {"corners": [columns, rows], "square_m": square_m, "page": page}
        document("board", about if markers is None else {**about, "dictionary": markers})
        return
    kind = "" if markers is None else f", ChArUco with markers of {markers}"
    say(f"{output}: {columns}x{rows} inner corners, squares of {square_m * 1e3:g} mm, {page}{kind}")
    say("print at 100 %, without fitting to the page, and measure the ruler")
    if markers is None and Board(columns, rows, square_m).half_turn_looks_the_same:
        say(
            "this board looks the same after half a turn: no picture shows which corner is the first; "
            "8x5 corners or --charuco do"
        )
    say("board.yaml for the pictures' folder:")
    say(f"corners: [{columns}, {rows}]")
    say(f"square_m: {square_m:g}")
    if markers is not None:
        say(f"dictionary: {markers}")


# ----------------------------------------------------------------------
# `calib export` and `calib import`: the camera and the IMU's noise in other tools' formats.

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
    from calib.stages.camera.formats import FILES
    from calib.stages.imu.formats import IMU_YAML

    kind = FILES.get(to, IMU_YAML)
    if output is not None:
        note_inputs([rig])
        check_writable(output, kind)
    what = "IMU" if to == "kalibr-imu" else "camera"
    text, verdict = _imu_text(rig, name) if what == "IMU" else _camera_text(to, rig, name or "camera")
    if verdict != "ok":
        narrate(f"the {what}'s verdict is {verdict}; the format cannot say so")
    if output is not None:
        write_atomically(output, text, kind)
        narrate(f"{to} {what} written to {shown(output)}")
    if as_json:
        document("export", {"format": to, "verdict": verdict, "text": text})
    elif output is None:
        emit(text.rstrip("\n") + "\n")


def _camera_text(to: str, rig: Path, name: str) -> tuple[str, str]:
    from calib.core.rig import Rig
    from calib.stages.camera.formats import lost_skew_px, to_kalibr, to_opencv, to_ros

    section = Rig.load(rig, missing_ok=True).needed("camera", rig)
    camera = section.optics
    text = {
        "ros": lambda: to_ros(camera, name),
        "opencv": lambda: to_opencv(camera),
        "kalibr": lambda: to_kalibr(camera, name),
    }[to]()
    if camera.skew_px != 0.0:
        narrate(
            f"{shown(rig)}: skew_px is {camera.skew_px:g}, which OpenCV's functions ignore: they are "
            f"{lost_skew_px(camera):.2g} px off at the picture's border; calibrate with --no-skew for them"
        )
    return text, section.verdict.word


def _imu_text(rig: Path, topic: str | None) -> tuple[str, str]:
    from calib.core.rig import Rig
    from calib.stages.imu.formats import to_kalibr

    if topic is not None and not re.fullmatch(r"[A-Za-z~/][\w~/]*", topic, re.ASCII):
        raise UsageError(f"--name: {one_line(topic)[:60]!r} is no topic, expected for instance /imu0")
    section = Rig.load(rig, missing_ok=True).needed("imu", rig)
    return to_kalibr(section, topic or "/imu0"), section.verdict.word


def import_camera(
    from_: FormatArgument,
    source: Annotated[Path, typer.Argument(help="File to read.")],
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Read a camera from ROS camera_info, OpenCV FileStorage or Kalibr camchain, or an imu.yaml.

    Writes the section camera of the rig's file, or imu.
    """
    from calib.core.result import section_json
    from calib.core.rig import SECTIONS, Rig

    check_writable(rig, SECTIONS)
    before = Rig.load(rig, missing_ok=True)
    where = shown(source)
    if is_bag(source):
        raise BadInputError(
            f"{where}: is a bag, expected a file of the camera; write its message into one: ros2 topic echo "
            "--once TOPIC > camera_info.yaml, or in ROS 1 rostopic echo -n 1 TOPIC > camera_info.yaml"
        )
    data = read_bytes(source, _MAX_BYTES)
    try:
        name, section, words = _imported(from_, source, data)
    except BadInputError as error:
        raise BadInputError(str(error) if str(error).startswith(where) else f"{where}: {error}") from error
    after = before.with_sections({name: section})
    after.save(rig, {name: {shown(source.name): sha256(data)}})
    answer(as_json, "import", {name: section_json(section)}, *words)
    narrate(f"{name} written to {shown(rig)}")
    for sentence in after.outdated():
        narrate(sentence)


def _imported(from_: str, source: Path, data: bytes) -> tuple[str, Any, tuple[str, ...]]:
    """Name and section of what a file holds, and sentences on it."""
    from calib.stages.camera.formats import from_kalibr, from_opencv, from_ros
    from calib.stages.camera.stage import imported_camera
    from calib.stages.imu.formats import from_kalibr as imu_from_kalibr

    if from_ == "kalibr-imu":
        imu = imu_from_kalibr(read_yaml_mapping(source))
        lacks = (
            "it comes without biases and error bars, so its verdict is poor until calib imu static has run"
        )
        return "imu", imu, (f"IMU noise at {imu.rate_hz:g} Hz", lacks)
    text = as_text(source, data)
    camera = {"ros": from_ros, "opencv": from_opencv, "kalibr": from_kalibr}[from_](text)
    others = re.findall(r"^cam[1-9]\d*(?=:)", text, re.MULTILINE) if from_ == "kalibr" else []
    left = [f"cam0 is taken, {' and '.join(others)} left out"] if others else []
    if from_ == "kalibr" and re.search(r"^\s+(T_cam_imu|timeshift_cam_imu):", text, re.MULTILINE):
        left.append("T_cam_imu and timeshift_cam_imu are not read: calib align finds time offset and angle")
    width, height = camera.image_size_px
    lacks = "it comes without error bars, so its verdict is poor until calib intrinsics has seen pictures"
    words = (f"camera {camera.model}, {width}x{height} px", *left, lacks)
    return "camera", imported_camera(camera, from_), words
