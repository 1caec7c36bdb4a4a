"""`calib intrinsics`: pictures or a table of correspondences in, the camera with error bars out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from calib.cli.common import FiguresOption, JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.errors import EXIT_POOR

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.camera.intrinsics import Intrinsics
    from calib.rig import Camera

__all__ = ["intrinsics"]


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
    from calib.camera.intrinsics import Choices, calibrate_camera
    from calib.files import check_folder, check_writable, shown
    from calib.inputs import Told, read_views
    from calib.rig import read_rig, section_json, write_rig
    from calib.sections import camera_section, outdated
    from calib.units import parse_corners, parse_image_size, parse_square_m

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
        from calib.report.camera_figures import write_camera_figures

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
