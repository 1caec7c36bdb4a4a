"""`calib intrinsics`: pictures or a table of correspondences in, the camera with error bars out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.cli.common import JsonOption, RigOption, document, narrate, progress_bar, say, table
from calib.errors import EXIT_POOR, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.camera.intrinsics import Intrinsics
    from calib.camera.views import View
    from calib.rig import Camera

__all__ = ["intrinsics"]

_MODELS = "auto, pinhole, radial2, radial3, brown5, rational8"


def intrinsics(
    sources: Annotated[
        list[Path],
        typer.Argument(help="A folder of pictures, single pictures, a table of correspondences, or a .vnl file."),
    ],
    corners: Annotated[str | None, typer.Option(help="Inner corners, columns x rows, as 7x5.")] = None,
    square: Annotated[str | None, typer.Option(help="Length of a square, as 20mm.")] = None,
    image_size: Annotated[
        str | None, typer.Option("--image-size", help="Picture size for tables, as 640x480.")
    ] = None,
    model: Annotated[str, typer.Option(help=f"Lens model: {_MODELS}.")] = "auto",
    skew: Annotated[bool, typer.Option("--skew", help="Estimate the skew as well.")] = False,
    loss: Annotated[str, typer.Option(help="Loss: none, huber or cauchy.")] = "none",
    board: Annotated[str, typer.Option(help="Board: rigid, warp, released, or auto.")] = "rigid",
    reject: Annotated[bool, typer.Option("--reject", help="Leave out points that lie far off.")] = False,
    figures: Annotated[Path | None, typer.Option(help="Folder to draw figures into.")] = None,
    rig: RigOption = Path("rig.yaml"),
    as_json: JsonOption = False,
) -> None:
    """Calibrate the camera from views of a checkerboard."""
    from calib.camera.intrinsics import Choices, calibrate_camera
    from calib.files import check_writable
    from calib.rig import read_rig, section_json, write_rig
    from calib.sections import camera_section

    choices = Choices(
        model=_one_of("--model", model, _MODELS.split(", ")),
        skew=skew,
        loss=_one_of("--loss", loss, ["none", "huber", "cauchy"]),
        board=_one_of("--board", board, ["rigid", "warp", "released", "auto"]),
        reject=reject,
    )
    check_writable(rig)
    before = read_rig(rig)
    began = time.perf_counter()
    views, size, hashes, without = _views(sources, corners, square, image_size)
    detected = time.perf_counter()
    result = calibrate_camera(views, size, choices)
    section = camera_section(result)
    write_rig(rig, before.model_copy(update={"camera": section}), {"camera": hashes})
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
                "pictures_without_board": list(without),
                "per_view": _per_view(result),
                "seconds": seconds,
            },
        )
    else:
        _print(section, result, without, rig)
    if section.verdict != "ok":
        raise typer.Exit(EXIT_POOR)


def _one_of(option: str, value: str, allowed: list[str]) -> str:
    if value not in allowed:
        raise UsageError(f"{option}: {value!r} is not one of {', '.join(allowed)}")
    return value


def _views(
    sources: list[Path], corners: str | None, square: str | None, image_size: str | None
) -> tuple[Sequence[View], tuple[int, int], dict[str, str], tuple[str, ...]]:
    """Views, picture size, SHA-256 of each input, and pictures without a board."""
    from calib.units import parse_corners, parse_image_size, parse_length_m

    size = parse_corners(corners) if corners else None
    square_m = parse_length_m(square, "--square") if square else None
    first = sources[0]
    if first.suffix.lower() in (".csv", ".vnl") and not first.is_dir():
        from calib.rig import hash_of
        from calib.tables import read_table, read_vnl

        if len(sources) > 1:
            raise UsageError("give one table, or pictures, not several tables")
        if image_size is None:
            raise UsageError(f"{first.name}: a table does not tell the picture's size; give --image-size 640x480")
        if first.suffix.lower() == ".csv":
            views = read_table(first)
        else:
            if size is None:
                raise UsageError(f"{first.name}: a .vnl file does not tell the board; give --corners and --square")
            views = read_vnl(first, *size, square_m if square_m is not None else 1.0)
        return views, parse_image_size(image_size), {first.name: hash_of(first)}, ()
    from calib.boards import find_boards, read_board_file
    from calib.pictures import list_pictures

    paths = list_pictures(sources)
    told = read_board_file(first if first.is_dir() else first.parent)
    if size is None and told.corners is not None:
        size = (told.corners[0], told.corners[1])
    if square_m is None:
        square_m = told.square_m
    if square_m is None:
        narrate("the square's length is not given; intrinsics do not depend on it, lengths are in squares")
    with progress_bar("finding boards") as progress:
        found = find_boards(paths, size, square_m if square_m is not None else 1.0, progress)
    board = found.board
    if size is None:
        narrate(f"found a board with {board.columns}x{board.rows} inner corners")
    narrate(f"board found in {len(found.views)} of {len(paths)} pictures")
    return found.views, found.image_size_px, found.hashes, found.without


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
    return [
        {"view": name, "points": int(points), "rms_px": rms}
        for name, points, rms in zip(
            result.calibration.observations.names,
            result.calibration.observations.present.sum(axis=1),
            result.calibration.view_rms_px.tolist(),
            strict=True,
        )
    ]


def _print(section: Camera, result: Intrinsics, without: Sequence[str], rig: Path) -> None:
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
    narrate(f"camera written to {rig}")
