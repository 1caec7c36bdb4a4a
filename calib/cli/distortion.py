"""`calib distortion`: what the lens's distortion costs, in pixels and on the plane."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, say, table
from calib.errors import BadInputError

__all__ = ["distortion"]


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
    from calib.camera.distortion import analyse_distortion
    from calib.files import check_folder, check_writable, shown
    from calib.rig import Geometry, identity, read_rig, section_json, write_rig
    from calib.sections import camera_covariance, camera_from_section, current_plane, lens_section, plane_view
    from calib.units import parse_region_px

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
        from calib.report.lens_figures import write_lens_figures

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
