"""Whether pictures of a plane support the plane fitted to them.

What cannot be computed is refused with an error; what can be computed but not trusted is computed and
marked. Each check has one constant and one sentence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import FloatArray
from calib.camera.homography import fit_homography
from calib.camera.model import Camera, project, undistort
from calib.camera.plane_sigma import PositionSigma, visible
from calib.camera.pose import Pose, fit_pose, plane_map
from calib.camera.views import View
from calib.errors import BadInputError

__all__ = ["Comparison", "PictureFit", "compare_pictures", "judge", "refuse_unusable"]

_MOSTLY_UNSEEN = 0.5
"""Share of the workspace outside the picture above which the plane is of no use."""
_RMS_LIMIT_PX = 1.0
"""A board that is found to 0.1 px and still misses by this much does not fit its description."""
_RMS_FACTOR, _RMS_NOTICED_PX = 3.0, 0.3
"""Against the camera's own RMS: this many times as large, and large enough to matter."""
_HOMOGRAPHY_FACTOR, _HOMOGRAPHY_POINTS = 2.0, 10
"""A homography that is free to bend to the pixels must not fit this much better than the pose."""
_ELEVATION_LOST_DEG, _ELEVATION_POOR_DEG = 3.0, 15.0
"""Angle between the line of sight and the plane: an error across it grows with its inverse sine."""
_SPREAD_LOST_PX = 1.5
"""Root mean square width of the points in the picture, across their longest direction."""
_MOVED_PX, _MOVED_PROBABILITY = 0.25, 1e-4
"""Pictures contradict each other when they differ visibly and not by chance."""
_SCATTER_PROBABILITY = 0.01
"""Below this the scatter between pictures, rather than within them, sets the uncertainty."""
_SIGMA_SHARE = 0.02
"""The plane's own sigma as a share of the workspace's diagonal."""
_FEW_FREEDOMS = 10


@dataclass(frozen=True)
class PictureFit:
    """How one picture fits the common pose.

    Attributes
    ----------
    name : of the picture.
    points : corners in it.
    rms_px : reprojection error under the common pose.
    moved_px : RMS distance between its corners under its own pose and under the common one; NaN when
        it has too few points for a pose of its own.
    """

    name: str
    points: int
    rms_px: float
    moved_px: float


@dataclass(frozen=True)
class Comparison:
    """One pose for all pictures against one for each.

    Attributes
    ----------
    probability : of a difference as large as this by chance (F test); 1 with a single picture.
    moved_px, moved_name : the largest `PictureFit.moved_px`, and whose it is.
    inflation : factor on the pose's covariance where pictures scatter more than their noise explains.
    """

    probability: float
    moved_px: float
    moved_name: str
    inflation: float


def refuse_unusable(views: Sequence[View]) -> None:
    """Raise BadInputError for points from which no plane can be computed."""
    if not views:
        raise BadInputError("no picture of the plane was given")
    for view in views:
        if view.target_m.shape != view.pixels.shape or view.pixels.ndim != 2 or view.pixels.shape[1] != 2:
            raise BadInputError(
                f"{view.name}: world points {view.target_m.shape} and pixels {view.pixels.shape} must both "
                "be (M, 2)"
            )
        if not (np.all(np.isfinite(view.target_m)) and np.all(np.isfinite(view.pixels))):
            raise BadInputError(f"{view.name}: a corner's position is not a finite number")
    world = np.unique(np.round(np.concatenate([view.target_m for view in views]), 9), axis=0)
    if len(world) < 4:
        raise BadInputError(f"a plane needs at least 4 different corners, got {len(world)}")
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise BadInputError(
            "all corners of the plane lie on one line; a plane needs corners on both sides of it"
        )


def compare_pictures(
    camera: Camera, views: Sequence[View], pose: Pose
) -> tuple[tuple[PictureFit, ...], Comparison]:
    """Fit every picture by itself and test whether the camera stood still."""
    fits: list[PictureFit] = []
    joint = separate = 0.0
    tested = freedom = at = 0
    for view in views:
        M = len(view.pixels)
        residuals = pose.residuals_px[at : at + M]
        at += M
        moved = np.nan
        own = _own_pose(camera, view) if len(views) > 1 else None
        if own is not None:
            joint += float(np.sum(residuals**2))
            separate += own.cost_px2
            tested, freedom = tested + 1, freedom + 2 * M - 6
            moved = float(np.sqrt(np.mean(np.sum((own.residuals_px - residuals) ** 2, axis=1))))
        fits.append(PictureFit(view.name, M, float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))), moved))
    if tested < 2:
        return tuple(fits), Comparison(1.0, 0.0, "", 1.0)
    # SciPy takes longer to load than most planes to check.
    from scipy.special import fdtrc

    between = max(joint - separate, 0.0) / (6 * (tested - 1))
    ratio = between / max(separate / freedom, 1e-24)
    probability = float(fdtrc(6 * (tested - 1), freedom, ratio))
    worst = max((fit for fit in fits if np.isfinite(fit.moved_px)), key=lambda fit: fit.moved_px)
    inflation = ratio if probability < _SCATTER_PROBABILITY else 1.0
    return tuple(fits), Comparison(probability, worst.moved_px, worst.name, max(inflation, 1.0))


def _own_pose(camera: Camera, view: View) -> Pose | None:
    try:
        refuse_unusable([view])
        return fit_pose(camera, view.target_m, view.pixels)
    except BadInputError:
        return None


def judge(
    camera: Camera,
    views: Sequence[View],
    pose: Pose,
    comparison: Comparison,
    sigma: PositionSigma,
    workspace_m: tuple[float, float, float, float],
    camera_rms_px: float | None,
) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Verdict, its reasons, and notes that do not lower it."""
    world_m = np.concatenate([view.target_m for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    moved = _moved(comparison)
    lost, flat = _shape(pose, world_m, pixels)
    poor = flat + _fit(camera, pose, world_m, pixels, camera_rms_px)
    poor += _horizon(camera, pose)
    poor += _precision(camera, pose, sigma, workspace_m)
    notes: list[str] = []
    out_of_sight = float(np.mean(~np.isfinite(sigma.plane_mm[:, 0])))
    if out_of_sight == 1.0:
        poor.append("no part of the workspace is in the picture")
    elif out_of_sight > _MOSTLY_UNSEEN:
        poor.append(
            f"{100 * out_of_sight:.0f} % of the workspace is outside the picture; move the camera, or say in "
            "the rig's file where the marker can be (geometry.workspace_m)"
        )
    elif out_of_sight > 0.0:
        notes.append(
            f"{100 * out_of_sight:.0f} % of the workspace is outside the picture; sigma is given for the rest"
        )
    if sigma.intrinsics_mm is None:
        notes.append("the uncertainty of the intrinsics is not known and not part of the sigma")
    freedom = 2 * len(np.unique(np.round(world_m, 9), axis=0)) - 6
    if freedom < _FEW_FREEDOMS:
        notes.append(f"the sigma rests on {freedom} degrees of freedom only and is rough")
    verdict = "inconsistent" if moved else "unidentifiable" if lost else "poor" if poor else "ok"
    return verdict, tuple(moved + lost + poor), tuple(notes)


def _moved(comparison: Comparison) -> list[str]:
    if comparison.probability > _MOVED_PROBABILITY or comparison.moved_px < _MOVED_PX:
        return []
    return [
        f"the pictures contradict each other: {comparison.moved_name} is {comparison.moved_px:.2f} px away "
        "from the "
        "common pose; the camera or the board moved in between"
    ]


def _shape(pose: Pose, world_m: FloatArray, pixels: FloatArray) -> tuple[list[str], list[str]]:
    """Reasons why the plane's direction cannot be known, and why it is known badly."""
    at = pose.R_CW[:, :2] @ world_m.mean(axis=0) + pose.t_CW_m
    elevation = float(np.degrees(np.arcsin(min(1.0, pose.R_CW[:, 2] @ at / np.linalg.norm(at)))))
    width = float(np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(pixels)))
    if elevation < _ELEVATION_LOST_DEG or width < _SPREAD_LOST_PX:
        return [
            f"the plane is seen edge-on or from too far: the line of sight meets it at {elevation:.1f} "
            "degrees and its "
            f"corners spread over {width:.1f} px only"
        ], []
    if elevation < _ELEVATION_POOR_DEG:
        return [], [
            f"the plane is seen nearly edge-on, at {elevation:.1f} degrees; {_ELEVATION_POOR_DEG:.0f} or "
            "more are needed"
        ]
    return [], []


def _fit(
    camera: Camera, pose: Pose, world_m: FloatArray, pixels: FloatArray, camera_rms_px: float | None
) -> list[str]:
    """Reasons that lie in the residuals."""
    reasons = []
    rms = float(np.sqrt(np.mean(np.sum(pose.residuals_px**2, axis=1))))
    if pose.termination == "iteration limit":
        reasons.append("the fit of the pose did not converge")
    if rms > _RMS_LIMIT_PX:
        reasons.append(
            f"the corners miss their places by {rms:.2f} px RMS (limit {_RMS_LIMIT_PX:g}): wrong square, "
            "wrong order of "
            "corners, or another camera's intrinsics"
        )
    elif camera_rms_px is not None and rms > max(_RMS_FACTOR * camera_rms_px, _RMS_NOTICED_PX):
        reasons.append(
            f"the RMS of {rms:.2f} px is more than {_RMS_FACTOR:g} times the camera's own "
            f"{camera_rms_px:.2f} px"
        )
    ideal = undistort(camera, pixels)
    usable = np.isfinite(ideal).all(axis=1)
    if not usable.all():
        reasons.append(f"{int((~usable).sum())} corners lie where the camera's lens model folds over")
    elif len(pixels) >= _HOMOGRAPHY_POINTS and rms > _RMS_NOTICED_PX:
        free = fit_homography(world_m, ideal)
        seen = project(camera, np.column_stack([world_m, np.ones(len(world_m))]) @ free.H.T)
        free_rms = float(np.sqrt(np.mean(np.sum((seen - pixels) ** 2, axis=1))))
        if rms > _HOMOGRAPHY_FACTOR * free_rms:
            reasons.append(
                f"a free homography fits to {free_rms:.2f} px where the pose fits to {rms:.2f} px: the "
                "intrinsics or the "
                "proportions of the board are not the real ones"
            )
    return reasons


def _horizon(camera: Camera, pose: Pose) -> list[str]:
    """The denominator of (2.12) must not cross zero within the picture."""
    width, height = camera.image_size_px
    u, v = np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 31))
    ideal = undistort(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    last = np.linalg.inv(np.column_stack([pose.R_CW[:, :2], pose.t_CW_m]))[2]
    beyond = float(np.mean(ideal @ last[:2] + last[2] <= 0.0)) if len(ideal) else 0.0
    if beyond == 0.0:
        return []
    return [
        f"the plane's horizon crosses the picture: {100 * beyond:.0f} % of the pixels show nothing of the "
        "plane"
    ]


def _precision(
    camera: Camera, pose: Pose, sigma: PositionSigma, workspace_m: tuple[float, float, float, float]
) -> list[str]:
    """Reasons that lie in how well the pose is known over the workspace."""
    seen = visible(camera, pose.R_CW, pose.t_CW_m, sigma.points_m)
    if not seen.any():
        return []
    if np.any(np.isinf(sigma.calibration_mm[seen])):
        return ["the intrinsics themselves are not known: their covariance is infinite"]
    if not np.all(np.isfinite(sigma.calibration_mm[seen])):
        return []
    reasons = []
    diagonal_mm = 1e3 * float(np.hypot(workspace_m[2] - workspace_m[0], workspace_m[3] - workspace_m[1]))
    worst_mm = float(np.hypot(*sigma.plane_mm[seen].T).max())
    if worst_mm > _SIGMA_SHARE * diagonal_mm:
        reasons.append(
            f"the corners do not fix the plane over the workspace: sigma reaches {worst_mm:.1f} mm of "
            f"{diagonal_mm:.0f} mm"
        )
    if pose.other is not None:
        cost, R, t = pose.other
        points = sigma.points_m[seen]
        pixels = project(camera, points @ pose.R_CW[:, :2].T + pose.t_CW_m)
        apart = 1e3 * np.linalg.norm(plane_map(camera, R, t, pixels) - points, axis=1)
        likely = cost - pose.cost_px2 < 9.0 * pose.sigma_px**2
        calibration_mm = float(np.hypot(*sigma.calibration_mm[seen].T).max())
        if likely and np.nanmax(apart) > 3.0 * calibration_mm:
            reasons.append(
                "the plane tilted the other way fits as well and puts the marker up to "
                f"{np.nanmax(apart):.1f} mm elsewhere; "
                "look at it more obliquely or from nearer"
            )
    return reasons
