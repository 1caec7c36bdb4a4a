"""`calib extrinsics`: the board lying in the actuator's plane in, the homography in millimetres out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import JsonOption, RigOption, document, narrate, progress_bar, say
from calib.errors import EXIT_POOR, BadInputError

__all__ = ["extrinsics"]


def extrinsics(
    source: Annotated[Path, typer.Argument(help="Folder with pictures of the board in the plane.")] = Path(
        "images/plane"
    ),
    figures: Annotated[Path | None, typer.Option(help="Folder to draw figures into.")] = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Find the actuator's plane: its homography in millimetres, with error bars."""
    from calib.boards import find_boards, read_board_file
    from calib.camera.placement import settle_orientation, world_points_m
    from calib.camera.plane import calibrate_plane
    from calib.camera.views import View
    from calib.files import check_writable, shown
    from calib.pictures import list_pictures
    from calib.rig import Geometry, identity, read_rig, section_json, write_rig
    from calib.sections import camera_covariance, camera_from_section, plane_section

    check_writable(rig)
    before = read_rig(rig)
    if before.camera is None:
        raise BadInputError(f"{shown(rig)}: has no camera yet; run calib intrinsics first")
    folder = source if source.is_dir() else source.parent
    told = read_board_file(folder)
    file = shown(folder / "board.yaml")
    for key in ("corners", "square_m", "first_corner_m", "angle_rad"):
        if getattr(told, key) is None:
            raise BadInputError(f"{file}: {key} is missing; the plane needs to know where the board lies")
    assert told.corners and told.square_m and told.first_corner_m and told.angle_rad is not None
    camera = camera_from_section(before.camera)
    with progress_bar("finding boards") as progress:
        found = find_boards(
            list_pictures([source]), (told.corners[0], told.corners[1]), told.square_m, progress
        )
    if found.image_size_px != camera.image_size_px:
        a, b = found.image_size_px, camera.image_size_px
        raise BadInputError(
            f"{shown(source)}: pictures are {a[0]}x{a[1]} px, but the camera in {shown(rig)} has {b[0]}x{b[1]} px"
        )
    world_m = world_points_m(found.board, told.first_corner_m, told.angle_rad)
    views, orientation = [], []
    for view in found.views:
        placed = settle_orientation(view.pixels, found.board, told.angle_rad, told.first_corner_px, view.name)
        views.append(View(view.name, world_m, placed.pixels))
        orientation.append(f"{view.name}: {placed.how}")
    workspace = (before.geometry or Geometry()).workspace_m
    plane = calibrate_plane(
        camera,
        camera_covariance(before.camera, str(rig)),
        views,
        workspace_m=(workspace[0], workspace[1], workspace[2], workspace[3]),
        camera_rms_px=before.camera.rms_px,
    )
    section = plane_section(plane, orientation)
    hashes = {**found.hashes, "camera": identity(before.camera)}
    write_rig(rig, before.model_copy(update={"plane": section}), {"plane": hashes})
    if figures is not None:
        from calib.report.plane_figures import write_plane_figures

        write_plane_figures(figures, camera, plane)
        narrate(f"figures in {figures}")
    if as_json:
        document("extrinsics", {"plane": section_json(section), "pictures_without_board": list(found.without)})
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
                f"a homography fitted without the lens: RMS {direct['rms_px']:.4f} px, differs by "
                f"{direct['difference_max_mm']:.3f} mm at most, {direct['difference_mean_mm']:.3f} mm on average"
            )
        for sentence in orientation:
            say(sentence)
        for name in found.without:
            say(f"no board in {name}")
        if before.camera.verdict != "ok":
            say(f"the camera's own verdict is {before.camera.verdict}; the plane is no better than that")
        say(f"verdict: {section.verdict}")
        for reason in section.reasons:
            say(f"  - {reason}")
        narrate(f"plane written to {rig}")
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)
