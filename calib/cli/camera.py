"""The verbs about the camera: `intrinsics`, `extrinsics`, `distortion`, `board`, `export`, `import`."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from calib.cli.common import (
    FiguresOption,
    JsonOption,
    RigOption,
    document,
    emit,
    narrate,
    progress_bar,
    say,
    table,
)
from calib.core.errors import EXIT_POOR, BadInputError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.core.rig import Camera
    from calib.stages.camera.intrinsics import Intrinsics

# ----------------------------------------------------------------------
# `calib intrinsics`: pictures or a table of correspondences in, the camera with error bars out.


def intrinsics(
    sources: Annotated[
        list[Path],
        typer.Argument(
            help="A folder of pictures (its sub-folders are not read) or single pictures; or a table of "
            "correspondences view,x_m,y_m,u_px,v_px (.csv); or corners of mrgingham or mrcal (.vnl).",
        ),
    ],
    corners: Annotated[
        str | None,
        typer.Option(
            metavar="CxR", help="Inner corners, columns x rows, as 7x5. [default: board.yaml, else found]"
        ),
    ] = None,
    square: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Side of a square with its unit, as 20mm. [default: board.yaml]"),
    ] = None,
    image_size: Annotated[
        str | None,
        typer.Option(
            "--image-size", metavar="WxH", help="Size of the pictures in px, for tables, as 640x480."
        ),
    ] = None,
    model: Annotated[
        Literal["auto", "pinhole", "radial2", "radial3", "brown5", "rational8"],
        typer.Option(help="Lens model; auto compares all on views held back."),
    ] = "auto",
    skew: Annotated[bool, typer.Option("--skew", help="Estimate the skew as well.")] = False,
    loss: Annotated[
        Literal["none", "huber", "cauchy"], typer.Option(help="Robust loss of the residuals.")
    ] = "none",
    board: Annotated[
        Literal["rigid", "warp", "released", "auto"],
        typer.Option(help="The board: flat, bent by two parameters, with free corners, or compared."),
    ] = "rigid",
    reject: Annotated[
        bool, typer.Option("--reject", help="Leave out points that lie far off, and say which.")
    ] = False,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Calibrate the camera from views of a checkerboard.

    Writes the section camera of the rig's file. Exits 1 when the verdict is not ok.
    """
    from calib.core.files import check_folder, check_writable, shown
    from calib.core.rig import read_rig, section_json, write_rig
    from calib.core.units import parse_corners, parse_image_size, parse_square_m
    from calib.stages.camera.intrinsics import Choices, calibrate_camera
    from calib.stages.camera.read import Told, read_views
    from calib.stages.camera.results import camera_section, outdated

    told = Told(
        parse_corners(corners) if corners else None,
        parse_square_m(square) if square else None,
        parse_image_size(image_size) if image_size else None,
    )
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    began = time.perf_counter()
    with progress_bar("finding boards") as progress:
        seen = read_views(sources, told, progress)
    for remark in seen.remarks:
        narrate(remark)
    detected = time.perf_counter()
    choices = Choices(model=model, skew=skew, loss=loss, board=board, reject=reject)
    result = calibrate_camera(seen.views, seen.image_size_px, choices)
    section = camera_section(result)
    after = write_rig(rig, before.model_copy(update={"camera": section}), {"camera": seen.hashes})
    seconds = {"detect": detected - began, **result.seconds}
    if figures is not None:
        from calib.stages.camera.plots import write_camera_figures

        write_camera_figures(figures, result)
        narrate(f"figures in {figures}")
    if as_json:
        document(
            "intrinsics",
            {
                "camera": section_json(section),
                "models": _comparison(result.models),
                "boards": _comparison(result.boards),
                "pictures_without_board": list(seen.without),
                "per_view": _per_view(result),
                "seconds": seconds,
            },
        )
    else:
        _print(section, result, seen.without)
    narrate(f"camera written to {shown(rig)}")
    for sentence in outdated(after):
        narrate(sentence)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def _comparison(candidates: Sequence[Any]) -> list[dict[str, Any]]:
    return [
        {
            "name": c.name,
            "parameters": c.parameters,
            "fitted_rms_px": c.fitted_rms_px,
            "held_back_rms_px": c.held_back_rms_px,
        }
        for c in candidates
    ]


def _per_view(result: Intrinsics) -> list[dict[str, Any]]:
    seen = result.calibration.observations
    return [
        {
            "view": name,
            "points": int(present.sum()),
            "rms_px": rms,
            "points_px": pixels[present].round(2).tolist(),
            "residuals_px": residuals[present].round(4).tolist(),
        }
        for name, present, rms, pixels, residuals in zip(
            seen.names,
            seen.present,
            result.calibration.view_rms_px.tolist(),
            seen.pixels,
            result.calibration.residuals_px,
            strict=True,
        )
    ]


def _print(section: Camera, result: Intrinsics, without: Sequence[str]) -> None:
    for what, candidates in (("model", result.models), ("board", result.boards)):
        if candidates:
            rows = [
                [c.name, str(c.parameters), f"{c.fitted_rms_px:.4f}", f"{c.held_back_rms_px:.4f}"]
                for c in candidates
            ]
            say(f"{what}s compared, RMS in px:")
            for line in table([what, "parameters", "fitted", "held back"], rows):
                say(line)
    say(
        f"camera {section.model}, {section.image_size_px[0]}x{section.image_size_px[1]} px, "
        f"{section.views} views, {section.points} points"
    )
    values = {**section.model_dump(), **section.distortion.model_dump()}
    rows = []
    for name, sigma in section.sigma.items():
        digits = 3 if name.endswith("_px") else 5
        bar = "not bounded" if sigma is None else f"{sigma:.{digits}f}"
        rows.append([name, f"{values[name]:.{digits}f}", bar])
    for line in table(["", "value", "sigma"], rows):
        say(line)
    if section.rms_px is not None and section.mean_error_px is not None:
        say(f"RMS {section.rms_px:.4f} px, mean error {section.mean_error_px:.4f} px")
    projected = section.projection_sigma_px
    if projected.get("median") is not None:
        worst = projected.get("max")
        end = f"{worst:.3f} px at worst" if worst is not None else "not bounded at the borders"
        say(f"projection sigma over the image: median {projected['median']:.3f} px, {end}")
    for name in without:
        say(f"no board in {name}")
    for sentence in section.rejected:
        say(f"rejected: {sentence}")
    say(f"verdict: {section.verdict}")
    for reason in section.reasons:
        say(f"  - {reason}")
    for remark in section.remarks:
        say(f"  (remark) {remark}")
    for advice in section.advice:
        say(f"  next: {advice}")


# ----------------------------------------------------------------------
# `calib extrinsics`: the board lying in the actuator's plane in, the homography in millimetres out.


def extrinsics(
    source: Annotated[
        Path,
        typer.Argument(
            help="Folder with pictures of the board lying in the plane, and with a board.yaml that says "
            "where: corners, square_m, first_corner_m: [x, y], angle_rad."
        ),
    ] = Path("images/plane"),
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find the actuator's plane: its homography, with error bars in millimetres.

    Needs the section camera of the rig's file and writes the section plane. Exits 1 when the verdict is
    not ok.
    """
    from calib.core.files import check_folder, check_writable, shown
    from calib.core.rig import Geometry, identity, read_rig, section_json, write_rig
    from calib.io.pictures import list_pictures
    from calib.stages.camera.model import View
    from calib.stages.camera.plane import calibrate_plane, settle_orientation, world_points_m
    from calib.stages.camera.read import BOARD_FILE, board_of, find_boards
    from calib.stages.camera.results import camera_covariance, camera_from_section, outdated, plane_section

    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    if before.camera is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    pictures = list_pictures([source])
    told, board_hash = board_of([source])
    file = shown((source if source.is_dir() else source.parent) / BOARD_FILE)
    for key in ("corners", "square_m", "first_corner_m", "angle_rad"):
        if getattr(told, key) is None:
            raise BadInputError(f"{file}: {key} is missing; the plane needs to know where the board lies")
    assert told.corners and told.square_m and told.first_corner_m and told.angle_rad is not None
    camera = camera_from_section(before.camera)
    with progress_bar("finding boards") as progress:
        found = find_boards(
            pictures, (told.corners[0], told.corners[1]), told.square_m, progress, camera.image_size_px
        )
    world_m = world_points_m(found.board, told.first_corner_m, told.angle_rad)
    views, orientation = [], []
    for view in found.views:
        placed = settle_orientation(view.pixels, found.board, told.angle_rad, told.first_corner_px, view.name)
        kept = slice(None) if view.measured is None else placed.reordered(view.measured, found.board)
        views.append(View(view.name, world_m[kept], placed.pixels[kept]))
        orientation.append(f"{view.name}: {placed.how}")
    workspace = (before.geometry or Geometry()).workspace_m
    plane = calibrate_plane(
        camera,
        camera_covariance(before.camera, str(rig)),
        views,
        workspace_m=(workspace[0], workspace[1], workspace[2], workspace[3]),
        camera_rms_px=before.camera.rms_px,
    )
    section = plane_section(plane, orientation, before.camera.verdict)
    hashes = {**found.hashes, **board_hash, "camera": identity(before.camera)}
    after = write_rig(rig, before.model_copy(update={"plane": section}), {"plane": hashes})
    if figures is not None:
        from calib.stages.camera.plots import write_plane_figures

        write_plane_figures(figures, camera, plane)
        narrate(f"figures in {figures}")
    if as_json:
        document(
            "extrinsics", {"plane": section_json(section), "pictures_without_board": list(found.without)}
        )
    else:
        say(f"plane from {section.pictures} picture(s), {section.points} points")
        say("A, world metres to pixels (2.9, with K):")
        for row in section.A_px_per_m:
            say("  " + "  ".join(f"{value:12.4f}" for value in row))
        say(f"RMS {section.rms_px:.4f} px, {section.rms_mm:.4f} mm on the plane")
        parts = [
            f"{name.removesuffix('_max')} {value:.3f}"
            for name, value in section.sigma_marker_mm.items()
            if value is not None
        ]
        say(f"sigma of a marker's position over the workspace, mm at worst: {', '.join(parts)}")
        if section.without_intrinsics:
            direct = section.without_intrinsics
            say(
                f"a homography fitted without the lens: RMS {direct['rms_px']:.4f} px, "
                f"differs by {direct['difference_max_mm']:.3f} mm at most, "
                f"{direct['difference_mean_mm']:.3f} mm on average"
            )
        for sentence in orientation:
            say(sentence)
        for name in found.without:
            say(f"no board in {name}")
        say(f"verdict: {section.verdict}")
        for reason in section.reasons:
            say(f"  - {reason}")
    narrate(f"plane written to {shown(rig)}")
    for sentence in outdated(after):
        narrate(sentence)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


# ----------------------------------------------------------------------
# `calib distortion`: what the lens's distortion costs, in pixels and on the plane.


def distortion(
    region: Annotated[
        str | None,
        typer.Option(
            metavar="U0,V0,U1,V1",
            help="Region of interest in px, as 78,52,238,156. [default: around the plane's workspace, "
            "without a plane the middle]",
        ),
    ] = None,
    figures: FiguresOption = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Say what lens distortion costs, and find the polynomial that undoes it.

    Needs the section camera of the rig's file, uses the section plane, and writes the section lens.
    """
    from calib.core.files import check_folder, check_writable, shown
    from calib.core.rig import Geometry, identity, read_rig, section_json, write_rig
    from calib.core.units import parse_region_px
    from calib.stages.camera.lens import analyse_distortion
    from calib.stages.camera.results import (
        camera_covariance,
        camera_from_section,
        current_plane,
        lens_section,
        plane_view,
    )

    region_px = parse_region_px(region) if region else None
    check_writable(rig)
    if figures is not None:
        check_folder(figures)
    before = read_rig(rig)
    if before.camera is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    camera = camera_from_section(before.camera)
    plane = current_plane(before, str(rig))
    view = None if plane is None else plane_view(plane, before.geometry or Geometry())
    report = analyse_distortion(
        camera, camera_covariance(before.camera, str(rig)), plane=view, region_px=region_px
    )
    section = lens_section(report)
    hashes = {"camera": identity(before.camera)} | ({} if plane is None else {"plane": identity(plane)})
    write_rig(rig, before.model_copy(update={"lens": section}), {"lens": hashes})
    if figures is not None:
        from calib.stages.camera.plots import write_lens_figures

        write_lens_figures(figures, camera, report)
        narrate(f"figures in {figures}")
    if before.camera.verdict != "ok":
        narrate(f"the camera's own verdict is {before.camera.verdict}; what follows is no better than that")
    narrate(f"lens written to {shown(rig)}")
    if as_json:
        document("distortion", {"lens": section_json(section)})
        return
    say(f"{section.kind} distortion, {before.camera.model}")
    u0, v0, u1, v1 = section.region_px
    rows = [
        ["whole picture", f"{section.max_px:.3f}", f"{section.mean_px:.3f}"],
        [
            f"region ({u0:.0f}, {v0:.0f}) to ({u1:.0f}, {v1:.0f})",
            f"{section.region_max_px:.3f}",
            f"{section.region_mean_px:.3f}",
        ],
    ]
    for line in table(["displacement, px", "max", "mean"], rows):
        say(line)
    if section.plane_max_mm is not None:
        rows = [
            ["plane read without the lens", f"{section.plane_max_mm:.3f}", f"{section.plane_mean_mm:.3f}"],
            ["best map without a lens", f"{section.refitted_max_mm:.3f}", f"{section.refitted_mean_mm:.3f}"],
        ]
        for line in table(["error over the workspace, mm", "max", "mean"], rows):
            say(line)
    inverse = section.inverse
    error = "without bound" if inverse.max_error_px is None else f"at most {inverse.max_error_px:.4f} px"
    say(
        f"inverse polynomial: {len(inverse.radial)} coefficients, {inverse.decentering_steps} decentering "
        f"steps, error {error} over {inverse.covered:.0%} of the picture"
    )
    for i, value in enumerate(inverse.radial, start=1):
        say(f"  c{i} = {value:.9g}")
    say(f"verdict: {section.verdict}")
    for reason in section.reasons:
        say(f"  - {reason}")


# ----------------------------------------------------------------------
# `calib board`: a checkerboard to print, at exact scale.


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
    from calib.core.files import write_atomically
    from calib.core.units import parse_corners, parse_square_m
    from calib.show.boardsheet import board_pdf

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
    from calib.core.files import shown, write_atomically

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
    from calib.core.files import shown
    from calib.core.rig import read_rig
    from calib.stages.camera.formats import to_kalibr, to_opencv, to_ros
    from calib.stages.camera.results import camera_from_section

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
    from calib.core.files import one_line, shown
    from calib.core.rig import read_rig
    from calib.stages.imu.results import kalibr_imu

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
    from calib.core.files import as_text, check_writable, read_bytes, sha256, shown
    from calib.core.rig import read_rig, section_json, write_rig
    from calib.stages.camera.formats import from_kalibr, from_opencv, from_ros
    from calib.stages.camera.results import imported_camera_section, outdated

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
    from calib.core.files import check_writable, read_bytes, read_yaml_mapping, sha256, shown
    from calib.core.rig import read_rig, section_json, write_rig
    from calib.stages.imu.results import from_kalibr_imu

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
