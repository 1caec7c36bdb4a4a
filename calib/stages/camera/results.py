"""Results of the calculations as sections of rig.yaml, and back."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import numpy as np
from pydantic import ValidationError

from calib.core import rig
from calib.core.arrays import FloatArray
from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.stages.camera.bundle import Covariance, projection_sigma_px
from calib.stages.camera.intrinsics import Intrinsics
from calib.stages.camera.lens import DistortionReport, PlaneView
from calib.stages.camera.model import COEFFICIENTS, INTRINSICS, MODELS, Camera
from calib.stages.camera.plane import Plane

P = ParamSpec("P")
T = TypeVar("T")


def _with_sane_values(make: Callable[P, T]) -> Callable[P, T]:
    """Let a section that the schema refuses end in a sentence: a fit to nonsense can end anywhere."""

    @functools.wraps(make)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return make(*args, **kwargs)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise BadInputError(
                f"no useful answer follows from this input: {key} came out as {first['input']!r:.40}"
            ) from error

    return checked


def image_grid(image_size_px: tuple[int, int], columns: int = 17, rows: int = 13) -> FloatArray:
    """Pixels (rows * columns, 2) spread over the whole picture, its borders included."""
    u, v = np.meshgrid(
        np.linspace(0, image_size_px[0] - 1, columns), np.linspace(0, image_size_px[1] - 1, rows)
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


def _covariance_table(covariance: Covariance) -> rig.CovarianceTable | None:
    if not np.all(np.isfinite(covariance.intrinsics)):
        return None
    return rig.CovarianceTable(order=list(covariance.names), values=covariance.intrinsics.tolist())


@_with_sane_values
def camera_section(result: Intrinsics) -> rig.Camera:
    """The `camera` section of a calibration."""
    fit, camera = result.calibration, result.calibration.camera
    sigma_px = projection_sigma_px(fit, result.covariance, image_grid(camera.image_size_px))
    seen = sigma_px[np.isfinite(sigma_px)]
    projection = {
        "distance_m": result.covariance.distance_m,
        "median": float(np.median(seen)) if len(seen) else None,
        "max": float(seen.max()) if len(seen) == len(sigma_px) else None,
    }
    named = dict(zip(COEFFICIENTS, camera.distortion.tolist(), strict=True))
    coefficients = {n: v for n, v in named.items() if n in (*MODELS["brown5"], *MODELS[camera.model])}
    finite = bool(np.isfinite(fit.rms_px))
    return rig.Camera(
        model=camera.model,
        image_size_px=list(camera.image_size_px),
        fx_px=camera.fx_px,
        fy_px=camera.fy_px,
        skew_px=camera.skew_px,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        distortion=rig.Distortion(**coefficients),
        sigma={name: rig.finite_or_none(value) for name, value in result.covariance.sigma().items()},
        covariance=_covariance_table(result.covariance),
        rms_px=fit.rms_px if finite else None,
        mean_error_px=fit.mean_error_px if finite else None,
        projection_sigma_px=projection,
        views=fit.observations.views,
        points=fit.observations.points,
        board=result.board,
        loss=fit.loss,
        termination=fit.termination,
        rejected=list(result.rejected),
        verdict=result.judgement.verdict,
        reasons=list(result.judgement.reasons),
        remarks=list(result.judgement.remarks),
        advice=list(result.judgement.advice),
    )


def camera_from_section(section: rig.Camera) -> Camera:
    """The camera that a `camera` section describes."""
    coefficients = section.distortion.model_dump()
    width, height = section.image_size_px
    return Camera(
        section.model,
        (width, height),
        section.fx_px,
        section.fy_px,
        section.skew_px,
        section.cx_px,
        section.cy_px,
        np.array([coefficients[name] for name in COEFFICIENTS]),
    )


def camera_covariance(section: rig.Camera, source: str) -> FloatArray | None:
    """Covariance (13, 13) in the order of `projection.INTRINSICS`, None where it is not known.

    Raises `BadInputError` for a table that is no covariance.
    """
    if section.covariance is None or not section.covariance.order:
        return None
    order = section.covariance.order
    wrong = next((name for name in order if name not in INTRINSICS or order.count(name) > 1), None)
    if wrong is not None:
        raise BadInputError(
            f"{shown(source)}: camera.covariance.order has {wrong!r}, expected intrinsics, each once"
        )
    index = [INTRINSICS.index(name) for name in order]
    values = np.array(section.covariance.values, dtype=np.float64)
    scale = np.sqrt(np.abs(np.diag(values)))
    normal = values / np.where(scale > 0, scale, 1.0) / np.where(scale > 0, scale, 1.0)[:, None]
    if not np.allclose(normal, normal.T, atol=1e-6) or np.linalg.eigvalsh(normal)[0] < -1e-6:
        raise BadInputError(f"{shown(source)}: camera.covariance.values is not a covariance matrix")
    whole = np.zeros((len(INTRINSICS), len(INTRINSICS)))
    whole[np.ix_(index, index)] = values
    return whole


@_with_sane_values
def plane_section(plane: Plane, orientation: Sequence[str], camera_verdict: str) -> rig.Plane:
    """The `plane` section of a calibrated plane, which is no better than its camera."""
    sigma = np.sqrt(np.diag(plane.covariance))
    names = ("rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "tx_m", "ty_m", "tz_m")

    def largest(values: FloatArray | None) -> float | None:
        if values is None or not np.isfinite(values).any():
            return None
        return float(np.nanmax(np.linalg.norm(values, axis=1)))

    marker = {
        "intrinsics_max": largest(plane.sigma.intrinsics_mm),
        "plane_max": largest(plane.sigma.plane_mm),
        "calibration_max": largest(plane.sigma.calibration_mm),
        "quantisation_max": largest(plane.sigma.quantisation_mm),
        "total_max": largest(plane.sigma.total_mm),
    }
    difference = plane.direct_difference_mm[np.isfinite(plane.direct_difference_mm)]
    without = (
        {
            "rms_px": float(plane.direct.rms_px),
            "difference_max_mm": float(difference.max()),
            "difference_mean_mm": float(difference.mean()),
        }
        if len(difference)
        else {}
    )
    camera_reasons = (
        []
        if camera_verdict == "ok"
        else [f"The camera's own verdict is {camera_verdict}, and the plane is no better than that."]
    )
    return rig.Plane(
        R_CW=plane.R_CW.tolist(),
        t_CW_m=plane.t_CW_m.tolist(),
        A_px_per_m=plane.A.tolist(),
        A_inverse=plane.A_inverse.tolist(),
        sigma=dict(zip(names, (rig.finite_or_none(s) for s in sigma), strict=True)),
        rms_px=plane.rms_px,
        rms_mm=plane.rms_mm,
        sigma_marker_mm=marker,
        without_intrinsics=without,
        pictures=len(plane.pictures),
        points=plane.points,
        orientation=" ".join(orientation),
        verdict=plane.verdict if camera_verdict == "ok" else "poor",
        reasons=[*camera_reasons, *plane.reasons, *plane.notes],
    )


@_with_sane_values
def imported_camera_section(camera: Camera, source: str) -> rig.Camera:
    """The `camera` section of a camera that another tool calibrated: values without error bars."""
    named = dict(zip(COEFFICIENTS, camera.distortion.tolist(), strict=True))
    return rig.Camera(
        model=camera.model,
        image_size_px=list(camera.image_size_px),
        fx_px=camera.fx_px,
        fy_px=camera.fy_px,
        skew_px=camera.skew_px,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        distortion=rig.Distortion(
            **{n: v for n, v in named.items() if n in (*MODELS["brown5"], *MODELS[camera.model])}
        ),
        verdict="poor",
        reasons=[f"Imported from a {source} file, which holds no error bars and no views to judge by."],
    )


def current_plane(whole: rig.Rig, source: str) -> rig.Plane | None:
    """The rig's plane; `BadInputError` where it was calibrated with another camera than the rig's."""
    if whole.plane is None or whole.camera is None:
        return None
    known = whole.provenance.inputs.get("plane", {}).get("camera")
    if known is not None and known != rig.identity(whole.camera):
        raise BadInputError(
            f"{shown(source)}: plane was calibrated with another camera than the one in camera; "
            "run calib extrinsics again"
        )
    return whole.plane


def outdated(whole: rig.Rig) -> list[str]:
    """Sentences for sections that were computed from others than the rig now has."""
    inputs = whole.provenance.inputs
    now = {
        name: rig.identity(section)
        for name, section in (("camera", whole.camera), ("plane", whole.plane))
        if section is not None
    }
    sentences = []
    for name, verb in (("plane", "extrinsics"), ("lens", "distortion")):
        known = inputs.get(name, {})
        changed = [other for other in now if other in known and known[other] != now[other]]
        if getattr(whole, name) is not None and changed:
            sentences.append(
                f"{name} in the file is of an earlier {' and '.join(changed)}; run calib {verb} again"
            )
    return sentences


def plane_view(plane: rig.Plane, geometry: rig.Geometry) -> PlaneView:
    """What the distortion's cost needs of a plane."""
    x0, y0, x1, y1 = geometry.workspace_m
    sigma = plane.sigma_marker_mm.get("calibration_max")
    return PlaneView(np.array(plane.R_CW), np.array(plane.t_CW_m), (x0, y0, x1, y1), sigma)


@_with_sane_values
def lens_section(report: DistortionReport) -> rig.Lens:
    """The `lens` section of an analysis of distortion."""
    cost, inverse = report.plane, report.inverse
    return rig.Lens(
        kind=report.kind,
        max_px=report.max_px,
        mean_px=report.mean_px,
        region_px=[float(value) for value in report.region_px],
        region_max_px=report.region_max_px,
        region_mean_px=report.region_mean_px,
        region_sigma_px=report.region_sigma_px,
        monotonic=report.monotonic,
        plane_max_mm=None if cost is None else cost.max_mm,
        plane_mean_mm=None if cost is None else cost.mean_mm,
        refitted_max_mm=None if cost is None else cost.refitted_max_mm,
        refitted_mean_mm=None if cost is None else cost.refitted_mean_mm,
        inverse=rig.InverseLens(
            radial=list(inverse.radial),
            decentering_steps=inverse.decentering_steps,
            max_error_px=rig.finite_or_none(inverse.max_error_px),
            covered=inverse.covered,
        ),
        verdict="negligible" if report.verdict == "negligible" else "matters",
        reasons=list(report.reasons),
    )
