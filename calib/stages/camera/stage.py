"""The stages of the camera: intrinsics, the actuator's plane, and what the lens costs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.core.errors import BadInputError
from calib.core.options import NoOptions, option
from calib.core.stage import Files, Stage, later
from calib.core.units import parse_region_px
from calib.stages.camera.options import IntrinsicsOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from calib.core.arrays import FloatArray
    from calib.core.rig import Rig
    from calib.core.verdict import Finding
    from calib.core.words import Block
    from calib.stages.camera import lens, model, plane
    from calib.stages.camera.intrinsics import Candidate, Intrinsics
    from calib.stages.camera.model import LeftOut
    from calib.stages.camera.read import ViewSet
    from calib.stages.camera.section import Camera, Lens, Plane

# ----------------------------------------------------------------------
# `calib intrinsics`: pictures or a table of correspondences in, the camera with error bars out.


def _read_intrinsics(
    files: Files, rig: Rig, options: IntrinsicsOptions
) -> tuple[ViewSet, IntrinsicsOptions, float]:
    """Views of a target, how to calibrate, and how long it took to find the views."""
    import time

    from calib.stages.camera.read import read_views

    del rig
    began = time.perf_counter()
    with files.progress("finding boards") as progress:
        views = read_views(list(files.paths), options, progress)
    for remark in views.remarks:
        files.narrate(remark)
    files.hashes.update(views.hashes)
    return views, options, time.perf_counter() - began


def _solve_intrinsics(found: ViewSet, options: IntrinsicsOptions, detect_s: float) -> Camera:
    """Calibrate, judge, and assemble the section."""
    import numpy as np

    from calib.core.geometry import box_grid
    from calib.core.result import CovarianceTable, finite_or_none, judged
    from calib.stages.camera.bundle import projection_sigma_px
    from calib.stages.camera.intrinsics import calibrate_camera
    from calib.stages.camera.model import ahead_radius, distorted_normalised
    from calib.stages.camera.section import Camera

    result = calibrate_camera(found.views, found.image_size_px, options, found.left_out)
    fit, known = result.calibration, result.covariance
    width, height = fit.camera.image_size_px
    grid = box_grid((0.0, 0.0, width - 1.0, height - 1.0), 17, 13).reshape(-1, 2)
    # Farther out a fisheye lens shows what is beside the camera, or nothing.
    ahead = np.hypot(*distorted_normalised(fit.camera, grid).T) <= ahead_radius(fit.camera)
    sigma_px = projection_sigma_px(fit, known, grid[ahead])
    bounded = sigma_px[np.isfinite(sigma_px)]
    projection = {
        "distance_m": known.distance_m if found.square_known else None,
        "median": float(np.median(bounded)) if len(bounded) else None,
        "max": float(bounded.max()) if len(bounded) == len(sigma_px) else None,
    }
    whole = bool(np.all(np.isfinite(known.intrinsics)))
    return Camera(
        **_optics(fit.camera),
        sigma={name: finite_or_none(value) for name, value in known.sigma().items()},
        covariance=CovarianceTable(order=list(known.names), values=known.intrinsics.tolist())
        if whole
        else None,
        rms_px=finite_or_none(fit.rms_px),
        mean_error_px=finite_or_none(fit.mean_error_px),
        projection_sigma_px=projection,
        views=fit.observations.views,
        points=fit.observations.points,
        board=result.board,
        loss=fit.loss,
        termination=fit.termination,
        rejected=[str(one) for one in result.left_out if one.kind in ("copy", "view", "points")],
        simulated=found.simulated,
        **judged(result.verdict),
    ).with_evidence(replace(result, seconds={"detect": detect_s, **result.seconds}))


def _optics(camera: model.Camera) -> dict[str, Any]:
    """The keys of the section that say what the camera is."""
    from calib.stages.camera.model import COEFFICIENTS, INTRINSICS, MODELS
    from calib.stages.camera.section import Distortion

    named = dict(zip(COEFFICIENTS, camera.distortion.tolist(), strict=True))
    usual = () if camera.fisheye else MODELS["brown5"]
    kept = {n: v for n, v in named.items() if n in (*usual, *MODELS[camera.model])}
    return {
        "model": camera.model,
        "image_size_px": list(camera.image_size_px),
        **{name: getattr(camera, name) for name in INTRINSICS[:5]},
        "distortion": Distortion(**kept),
    }


def imported_camera(camera: model.Camera, source: str) -> Camera:
    """The section of a camera that another tool calibrated: values without error bars."""
    from calib.stages.camera.section import Camera

    reason = f"Imported from a {source} file, which holds no error bars and no views to judge by."
    return Camera(**_optics(camera), verdict="poor", reasons=[reason])


def _camera_document(camera: Camera) -> dict[str, Any]:
    evidence: Intrinsics = camera.evidence
    fit = evidence.calibration

    def compared(candidates: Sequence[Candidate]) -> list[dict[str, Any]]:
        keys = ("name", "parameters", "fitted_rms_px", "held_back_rms_px", "flaw")
        return [{key: getattr(one, key) for key in keys} for one in candidates]

    per_view = [
        {
            "view": name,
            "points": int(present.sum()),
            "rms_px": rms,
            "points_px": pixels[present].round(2).tolist(),
            "residuals_px": residuals[present].round(4).tolist(),
        }
        for name, present, rms, pixels, residuals in zip(
            fit.observations.names,
            fit.observations.present,
            fit.view_rms_px.tolist(),
            fit.observations.pixels,
            fit.residuals_px,
            strict=True,
        )
    ]
    return {
        "models": compared(evidence.models),
        "boards": compared(evidence.boards),
        "not_used": _not_used(evidence.left_out),
        "per_view": per_view,
        "seconds": evidence.seconds,
    }


def _not_used(left_out: Sequence[LeftOut]) -> list[dict[str, str]]:
    return [{"file": one.name, "why": one.why} for one in left_out]


def _camera_words(camera: Camera) -> list[Block]:
    from calib.core.words import Line, Table

    evidence: Intrinsics = camera.evidence
    blocks: list[Block] = []
    for what, candidates in (("model", evidence.models), ("board", evidence.boards)):
        if candidates:
            rows = tuple(
                (one.name, str(one.parameters), f"{one.fitted_rms_px:.4f}", f"{one.held_back_rms_px:.4f}")
                for one in candidates
            )
            head = (what, "parameters", "fitted", "held back")
            blocks.append(Table(head, rows, f"{what}s compared, RMS in px"))
            unsound = ", ".join(f"{one.name} ({one.flaw})" for one in candidates if one.flaw)
            if unsound:
                blocks.append(Line(f"no candidate: {unsound}"))
    blocks += [Line(f"not used: {one}") for one in evidence.left_out]
    return blocks


intrinsics = Stage(
    "intrinsics",
    "Camera",
    """Calibrate the camera from views of a checkerboard.

    Writes the section camera of the rig's file. Exits 1 when the verdict is not ok.
    """,
    _read_intrinsics,
    _solve_intrinsics,
    IntrinsicsOptions,
    sources="A folder of pictures (its sub-folders are not read), single pictures, a video, or a bag with an "
    "image topic; or a table of correspondences view,x_m,y_m,u_px,v_px (.csv); or corners of mrgingham or "
    "mrcal (.vnl).",
    metavar="PICTURES...",
    writes=("camera",),
    document=_camera_document,
    words=_camera_words,
    plots=lambda camera: later("calib.stages.camera.plots", "plots")(camera.evidence),
    remarks=lambda rig: rig.outdated(),
)


# ----------------------------------------------------------------------
# `calib extrinsics`: the board lying in the actuator's plane in, the homography in millimetres out.


@dataclass(frozen=True)
class PlaneEvidence:
    """What a plane was made from."""

    camera: model.Camera
    fit: plane.Plane
    left_out: tuple[LeftOut, ...]


_WHICH = "state which it is with first_corner_px: [u, v] in board.yaml"


def _read_plane(
    files: Files, rig: Rig, options: NoOptions
) -> tuple[
    Camera,
    Sequence[model.View],
    tuple[float, float, float, float],
    Sequence[str],
    Sequence[Finding],
    tuple[LeftOut, ...],
    bool,
    plane.BoardPlace,
]:
    from calib.core.files import shown
    from calib.core.verdict import Finding
    from calib.core.words import several
    from calib.io.frames import is_recording, read_frames
    from calib.io.pictures import list_pictures
    from calib.stages.camera.model import View
    from calib.stages.camera.plane import BoardPlace, settle_orientation, world_points_m
    from calib.stages.camera.read import (
        BOARD_FILE,
        another_square,
        board_of,
        find_boards,
        folder_of,
        meant_folder,
        of_still,
        refuse_recordings,
    )

    del options
    assert rig.camera is not None
    remarks: list[str] = []
    source = meant_folder(files.paths[0] if files.paths else Path("images/plane"), "images/plane", remarks)
    for remark in remarks:
        files.narrate(remark)
    refuse_recordings(source)
    recording = read_frames(source) if is_recording(source) else None
    pictures = list_pictures([source]) if recording is None else []
    stated, board_hash = board_of([source])
    folder = folder_of(source)
    board_file = shown(folder / BOARD_FILE)
    for key in ("corners", "square_m", "first_corner_m", "angle_rad"):
        if getattr(stated, key) is None:
            raise BadInputError(
                f"{board_file}: {key} is missing; the plane needs to know where the board lies"
            )
    assert stated.corners and stated.square_m and stated.first_corner_m and stated.angle_rad is not None
    with files.progress("finding boards") as progress:
        search = find_boards(
            pictures,
            (stated.corners[0], stated.corners[1]),
            stated.square_m,
            progress,
            rig.camera.optics.image_size_px,
            stated.dictionary,
            () if recording is None else recording.pictures,
        )
    if recording is not None:
        search = of_still(recording, search)
    world_m = world_points_m(search.board, stated.first_corner_m, stated.angle_rad)
    views, orientation, doubts = [], [], list[Finding]()
    if other := another_square(folder, stated):
        doubts.append(Finding("poor", *other))
    if search.several and stated.first_corner_px is None:
        columns, rows = stated.corners
        text = (
            f"{several(search.several)}: more than one board of {columns}x{rows} inner corners is seen, and "
            "the one with the largest squares was taken"
        )
        doubts.append(Finding("poor", text, "cover the other, or state first_corner_px in board.yaml"))
    for view in search.views:
        pixels, kept, how = view.pixels, view.measured, "The board's markers say which corner is (0, 0)."
        assert kept is not None
        if search.layout is None:
            placed = settle_orientation(
                pixels, search.board, stated.angle_rad, stated.first_corner_px, view.name
            )
            pixels, kept, how = placed.pixels, placed.reordered(kept, search.board), placed.how
            if placed.doubt and not any(one.advice == _WHICH for one in doubts):
                doubts.append(Finding("poor", placed.doubt, _WHICH))
        views.append(View(view.name, world_m[kept], pixels[kept]))
        orientation.append(f"{view.name}: {how}")
    files.hashes |= {**search.hashes, **board_hash, **rig.identities("camera")}
    x, y = stated.first_corner_m
    place = BoardPlace((x, y), stated.first_corner_sigma_m, stated.angle_sigma_rad)
    return rig.camera, views, rig.workspace_m, orientation, doubts, search.left_out, stated.simulated, place


def _solve_plane(
    camera: Camera,
    views: Sequence[model.View],
    workspace_m: tuple[float, float, float, float],
    orientation: Sequence[str],
    doubts: Sequence[Finding],
    left_out: tuple[LeftOut, ...],
    simulated: bool,
    placed: plane.BoardPlace,
) -> Plane:
    """Fit views of the board in world metres, judge, and assemble the section."""
    import numpy as np

    from calib.core.result import finite_or_none, judged
    from calib.core.verdict import Verdict
    from calib.stages.camera.plane import calibrate_plane
    from calib.stages.camera.section import Plane

    optics, covariance, box = camera.optics, camera.intrinsic_covariance, workspace_m
    # Beside residuals of a board in its own shape those of the board as described say nothing.
    rms_px = camera.rms_px if camera.board == "rigid" else None
    fit = calibrate_plane(
        optics, covariance, views, workspace_m=box, camera_rms_px=rms_px, placed=placed
    )  # fmt: skip
    findings = [*fit.verdict.findings, *doubts]
    sigma = np.sqrt(np.diag(fit.covariance))
    names = ("rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "tx_m", "ty_m", "tz_m")
    parts = ("intrinsics", "plane", "calibration", "quantisation", "total")

    def largest(values: FloatArray | None) -> float | None:
        if values is None or not np.isfinite(values).any():
            return None
        return float(np.nanmax(np.linalg.norm(values, axis=1)))

    difference = fit.direct_difference_mm[np.isfinite(fit.direct_difference_mm)]
    without = {}
    if len(difference):
        without = {
            "rms_px": float(fit.direct.rms_px),
            "difference_max_mm": float(difference.max()),
            "difference_mean_mm": float(difference.mean()),
        }
    return Plane(
        R_CW=fit.R_CW.tolist(),
        t_CW_m=fit.t_CW_m.tolist(),
        A_px_per_m=fit.A.tolist(),
        A_inverse=fit.A_inverse.tolist(),
        sigma=dict(zip(names, (finite_or_none(s) for s in sigma), strict=True)),
        rms_px=fit.rms_px,
        rms_mm=fit.rms_mm,
        sigma_marker_mm={f"{part}_max": largest(getattr(fit.sigma, f"{part}_mm")) for part in parts},
        without_intrinsics=without,
        pictures=len(fit.pictures),
        points=len(fit.corners_m),
        orientation=" ".join(orientation),
        simulated=simulated,
        **judged(Verdict.of(findings)),
    ).with_evidence(PlaneEvidence(optics, fit, left_out))


def _plane_words(result: Plane) -> list[Block]:
    from calib.core.words import Line, Table

    rows = tuple(tuple(f"{value:.4f}" for value in row) for row in result.A_px_per_m)
    return [
        Table(("x, px/m", "y, px/m", "1, px"), rows, "A, world metres to pixels (2.9, with K)"),
        *(Line(f"not used: {one}") for one in result.evidence.left_out),
    ]


extrinsics = Stage(
    "extrinsics",
    "Plane of motion",
    """Find the actuator's plane: its homography, with error bars in millimetres.

    Needs the section camera of the rig's file and writes the section plane. Exits 1 when the verdict is
    not ok.
    """,
    _read_plane,
    _solve_plane,
    sources="Folder with pictures of the board lying in the plane, or a video of it at rest, and beside them "
    "a board.yaml that says where: corners, square_m, first_corner_m: [x, y], angle_rad. "
    "[default: images/plane]",
    several=False,
    optional=True,
    writes=("plane",),
    needs=("camera",),
    document=lambda plane: {"not_used": _not_used(plane.evidence.left_out)},
    words=_plane_words,
    plots=lambda plane: later("calib.stages.camera.plots", "plane_plots")(
        plane.evidence.camera, plane.evidence.fit
    ),
    remarks=lambda rig: rig.outdated(),
)


# ----------------------------------------------------------------------
# `calib distortion`: what the lens's distortion costs, in pixels and on the plane.


@dataclass(frozen=True)
class LensOptions:
    """Where the lens is looked at."""

    region_px: tuple[float, float, float, float] | None = option(
        None,
        "Region of interest in px, as 78,52,238,156. [default: around the plane's workspace, without a plane "
        "the middle]",
        flag="region",
        metavar="U0,V0,U1,V1",
        parse=parse_region_px,
    )


def _read_lens(
    files: Files, rig: Rig, options: LensOptions
) -> tuple[Camera, lens.PlaneView | None, tuple[float, float, float, float] | None]:
    import numpy as np

    from calib.stages.camera.lens import PlaneView

    assert rig.camera is not None
    files.hashes |= rig.identities("camera", "plane")
    view = None
    current = rig.current_plane(files.rig_path)
    if current is not None:
        sigma_mm = current.sigma_marker_mm.get("calibration_max")
        view = PlaneView(np.array(current.R_CW), np.array(current.t_CW_m), rig.workspace_m, sigma_mm)
    return rig.camera, view, options.region_px


def _solve_lens(
    camera: Camera, plane: lens.PlaneView | None, region_px: tuple[float, float, float, float] | None
) -> Lens:
    from calib.stages.camera.lens import analyse_distortion

    return analyse_distortion(camera.optics, camera.intrinsic_covariance, plane=plane, region_px=region_px)


def _lens_words(result: Lens) -> list[Block]:
    from calib.core.words import Line, Table

    inverse = result.inverse
    error = "without bound" if inverse.max_error_px is None else f"at most {inverse.max_error_px:.4f} px"
    rows = tuple((f"c{i}", f"{value:.9g}") for i, value in enumerate(inverse.radial, start=1))
    return [
        Table(("", "value"), rows, "inverse polynomial"),
        Line(f"{inverse.decentering_steps} decentering steps, error {error} over {inverse.covered:.0%}"),
    ]


distortion = Stage(
    "distortion",
    "Lens",
    """Say what lens distortion costs, and find the polynomial that undoes it.

    Needs the section camera of the rig's file, uses the section plane, and writes the section lens.
    """,
    _read_lens,
    _solve_lens,
    LensOptions,
    writes=("lens",),
    needs=("camera",),
    uses=("plane",),
    words=_lens_words,
    plots=later("calib.stages.camera.plots", "lens_plots"),
)
