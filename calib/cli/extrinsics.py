"""`calib extrinsics`: the board lying in the actuator's plane in, the homography in millimetres out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say
from calib.errors import EXIT_POOR, BadInputError

__all__ = ["extrinsics"]


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
    from calib.boards import BOARD_FILE, board_of, find_boards
    from calib.camera.placement import settle_orientation, world_points_m
    from calib.camera.plane import calibrate_plane
    from calib.camera.views import View
    from calib.files import check_folder, check_writable, shown
    from calib.pictures import list_pictures
    from calib.rig import Geometry, identity, read_rig, section_json, write_rig
    from calib.sections import camera_covariance, camera_from_section, outdated, plane_section

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
        from calib.report.plane_figures import write_plane_figures

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
