"""The actuator's plane: from pixels to millimetres and back, and how far to trust it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace

import numpy as np

from calib.core import geometry
from calib.core.arrays import BoolArray, FloatArray, IntArray
from calib.core.errors import BadInputError
from calib.core.verdict import Finding, Verdict
from calib.solve.chance import tail_of_f
from calib.stages.camera.model import INTRINSICS, Board, Camera, View, project, undistort
from calib.stages.camera.pose import Pose, fit_pose, plane_map, plane_pixels, pose_derivatives

# ----------------------------------------------------------------------
# Standard deviation of a marker's position on the plane, from all that is uncertain.
#
# A marker at X is seen at the pixel m = g(c, e, X), with intrinsics c and pose e = (w, t). The position
# read from m solves that for X, so that errors in c, e and m move it by
#
#     dX = G_X^-1 (dm - G_c dc - G_e de)
#
# The pose was itself estimated with these intrinsics, de = E dc + de_noise with E = de/dc of
# `calib.stages.camera.pose`. Much of an error in c is absorbed that way, and leaving E out would overstate
# it:
#
#     from the intrinsics    G_X^-1 (G_c + G_e E) dc
#     from the plane's fit   G_X^-1 G_e de_noise
#     from whole pixels      G_X^-1 dm,  dm uniform over a pixel, variance 1/12 px^2
#
# The three are independent as long as the plane's pictures were not among those of the intrinsics.

QUANTISATION_VARIANCE_PX2 = 1.0 / 12.0
"""Variance of an error that is uniform over one pixel."""


@dataclass(frozen=True)
class PositionSigma:
    """Standard deviations of a marker's position, one row per place and the columns x and y.

    Attributes
    ----------
    points_m : (N, 2) places on the plane; rows of places that the picture does not show are NaN in
        all other arrays.
    intrinsics_mm : (N, 2), or None where the covariance of the intrinsics is not known.
    plane_mm, quantisation_mm : (N, 2).
    """

    points_m: FloatArray
    intrinsics_mm: FloatArray | None
    plane_mm: FloatArray
    quantisation_mm: FloatArray

    @property
    def calibration_mm(self) -> FloatArray:
        """Intrinsics and plane together, (N, 2): what the calibration alone leaves open."""
        if self.intrinsics_mm is None:
            return self.plane_mm
        return np.asarray(np.hypot(self.intrinsics_mm, self.plane_mm))

    @property
    def total_mm(self) -> FloatArray:
        """Everything together, (N, 2)."""
        return np.asarray(np.hypot(self.calibration_mm, self.quantisation_mm))


def visible(camera: Camera, R_CW: FloatArray, t_CW_m: FloatArray, points_m: FloatArray) -> BoolArray:
    """Which places (N, 2) of the plane the picture shows, (N,): in front, inside, and not folded over."""
    pixels = plane_pixels(camera, R_CW, t_CW_m, points_m)
    shown = geometry.in_picture(pixels, camera.image_size_px)
    back = plane_map(camera, R_CW, t_CW_m, pixels[shown])
    shown[shown] = np.linalg.norm(back - points_m[shown], axis=1) < 1e-6 * np.linalg.norm(t_CW_m)
    return shown


def position_sigma(
    camera: Camera, camera_covariance: FloatArray | None, pose: Pose, points_m: FloatArray
) -> PositionSigma:
    """Standard deviations in mm of positions read from the picture.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, zero rows for what was not
        estimated; None where it is not known.
    points_m : (N, 2) places on the plane.
    """
    seen = visible(camera, pose.R_CW, pose.t_CW_m, points_m)
    by_world, by_pose, by_camera = pose_derivatives(camera, pose.R_CW, pose.t_CW_m, points_m[seen])
    to_world = 1e3 * np.linalg.inv(by_world)

    def deviation(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
        rows = to_world @ jacobian
        result = np.full(points_m.shape, np.nan)
        variance = np.einsum("nik,kl,nil->ni", rows, covariance, rows)
        # Rounding may leave a covariance negative by its last digit.
        result[seen] = np.sqrt(np.maximum(variance, 0.0))
        return result

    intrinsics = None
    if camera_covariance is not None and not np.all(np.isfinite(camera_covariance)):
        intrinsics = np.where(seen[:, None], np.inf, np.nan) * np.ones(2)
    elif camera_covariance is not None:
        intrinsics = deviation(by_camera + by_pose @ pose.by_intrinsics, camera_covariance)
    pixel = np.broadcast_to(np.eye(2), by_world.shape)
    return PositionSigma(
        points_m,
        intrinsics,
        deviation(by_pose, pose.covariance),
        deviation(pixel, QUANTISATION_VARIANCE_PX2 * np.eye(2)),
    )


# ----------------------------------------------------------------------
# Whether pictures of a plane support the plane fitted to them.
#
# What cannot be computed is refused with an error; what can be computed but not trusted is computed and
# marked. Each check has one constant and one sentence.

_MOSTLY_UNSEEN = 0.5
"""Share of the workspace outside the picture above which the plane is of no use."""
_RMS_LIMIT_PX = 1.0
"""A board that is found to 0.1 px and still misses by this much does not fit its description."""
_RMS_FACTOR, _RMS_NOTICED_PX = 3.0, 0.3
_STRAIGHT_PX = 0.03
"""Against the camera's own RMS: this many times as large, and large enough to matter."""
_HOMOGRAPHY_FACTOR, _HOMOGRAPHY_POINTS = 2.0, 10
"""A homography that is free to bend to the pixels must not fit this much better than the pose."""
_OFF_SIGMAS, _OFF_SHARE = 3.0, 5e-4
"""Nor put corners so many standard deviations of the calibration, and this share of the board, elsewhere."""
_OTHER_FACTOR, _OTHER_LEAST_PX = 2.0, 1e-3
"""A picture that was zoomed, cropped, turned or mirrored must not fit this much better, unless by rounding:
35 pictures of seven sets reach 1.6."""
_OTHER_STEPS, _OTHER_ZOOM = 4, 0.3
"""Steps to that zoom and centre, and the logarithm of the zoom that one may take."""
_ELEVATION_LOST_DEG, _ELEVATION_POOR_DEG = 3.0, 15.0
"""Angle between the line of sight and the plane: an error across it grows with its inverse sine."""
_SPREAD_LOST_PX = 1.5
"""Root mean square width of the points in the picture, across their longest direction."""
_MOVED_PX, _MOVED_PROBABILITY = 0.25, 1e-4
"""Pictures contradict each other when they differ visibly and not by chance."""
_SCATTER_PROBABILITY = 0.01
"""Below this the scatter between pictures, rather than within them, sets the uncertainty."""
_ALIKE, _NEIGHBOURS = 0.3, 1.1
"""Correlation of residuals at neighbours that noise does not reach; what a neighbour is, over the least
distance."""
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


def compare_pictures(
    camera: Camera, views: Sequence[View], pose: Pose
) -> tuple[tuple[PictureFit, ...], Comparison]:
    """Fit every picture by itself and test whether the camera stood still."""
    fits: list[PictureFit] = []
    tested: list[tuple[float, float, int]] = []
    for view, residuals in _by_view(views, pose.residuals_px):
        moved, squared = np.nan, np.sum(residuals**2, axis=1)
        with suppress(BadInputError):
            own = fit_pose(camera, view.target_m, view.pixels) if len(views) > 1 else pose
            tested.append((float(squared.sum()), own.cost_px2, 2 * len(squared) - 6))
            moved = float(np.sqrt(np.mean(np.sum((own.residuals_px - residuals) ** 2, axis=1))))
        fits.append(PictureFit(view.name, len(squared), float(np.sqrt(np.mean(squared))), moved))
    if len(tested) < 2:
        return tuple(fits), Comparison(1.0, 0.0, "", 1.0)
    joint, separate, freedom = np.sum(tested, axis=0).tolist()
    between_freedom = 6 * (len(tested) - 1)
    between = max(joint - separate, 0.0) / between_freedom
    ratio = between / max(separate / freedom, 1e-24)
    probability = float(tail_of_f(between_freedom, freedom, ratio))
    worst = max((fit for fit in fits if np.isfinite(fit.moved_px)), key=lambda fit: fit.moved_px)
    inflation = ratio if probability < _SCATTER_PROBABILITY else 1.0
    return tuple(fits), Comparison(probability, worst.moved_px, worst.name, max(inflation, 1.0))


def _by_view(views: Sequence[View], residuals_px: FloatArray) -> Iterator[tuple[View, FloatArray]]:
    """Each view with its own of the residuals (M, 2) of all in turn."""
    ends = np.cumsum([len(view.pixels) for view in views])[:-1]
    return zip(views, np.split(residuals_px, ends), strict=True)


def _alike(views: Sequence[View], residuals_px: FloatArray) -> float:
    """Factor on the pose's covariance for residuals (M, 2) that are alike at neighbouring corners.

    A bent board or another lens leaves such, and counts as few corners: of a correlation r between neighbours
    along both sides as 1 of ((1 + r) / (1 - r))^2, at least as many as the pose has unknowns.
    """
    products = squares = 0.0
    for view, own in _by_view(views, residuals_px):
        apart = np.linalg.norm(view.target_m[:, None] - view.target_m, axis=2)
        np.fill_diagonal(apart, np.inf)
        i, j = np.nonzero(apart < _NEIGHBOURS * apart.min())
        products += float(np.mean((own[i] * own[j]).sum(axis=1)))
        squares += float(np.mean((own**2).sum(axis=1)))
    r = products / max(squares, 1e-300)
    most = max(len(view.pixels) for view in views) / 6.0
    return 1.0 if r < _ALIKE else max(1.0, min(((1.0 + r) / (1.0 - r)) ** 2, most))


def _findings(
    camera: Camera, plane: Plane, comparison: Comparison, camera_rms_px: float | None
) -> Iterator[Finding]:
    """What speaks against a plane, and notes that do not."""
    if comparison.probability <= _MOVED_PROBABILITY and comparison.moved_px >= _MOVED_PX:
        text = (
            f"the pictures contradict each other: {comparison.moved_name} is {comparison.moved_px:.2f} px "
            "away from the common pose; the camera or the board moved in between"
        )
        yield Finding("inconsistent", text)
    yield from _of_direction(plane)
    yield from _of_residuals(camera, plane, camera_rms_px)
    yield from _of_horizon(camera, plane)
    yield from _of_precision(camera, plane)
    unseen = float(np.mean(~np.isfinite(plane.sigma.plane_mm[:, 0])))
    share = f"{100 * unseen:.0f} % of the workspace is outside the picture"
    if unseen == 1.0:
        yield Finding("poor", "no part of the workspace is in the picture")
    elif unseen > _MOSTLY_UNSEEN:
        where = "move the camera, or say in the rig's file where the marker can be (geometry.workspace_m)"
        yield Finding("poor", f"{share}; {where}")
    elif unseen > 0.0:
        yield Finding("remark", f"{share}; sigma is given for the rest")
    if plane.sigma.intrinsics_mm is None:
        text = "the uncertainty of the intrinsics is not known and not part of the sigma"
        yield Finding("remark", text)
    freedom = 2 * len(np.unique(np.round(plane.corners_m, 9), axis=0)) - 6
    if freedom < _FEW_FREEDOMS:
        yield Finding("remark", f"the sigma rests on {freedom} degrees of freedom only and is rough")


def _of_direction(plane: Plane) -> Iterator[Finding]:
    """Whether the plane's direction can be known, and well."""
    at, pixels = plane.R_CW[:, :2] @ plane.corners_m.mean(axis=0) + plane.t_CW_m, plane.corners_px
    elevation = float(np.degrees(np.arcsin(min(1.0, plane.R_CW[:, 2] @ at / np.linalg.norm(at)))))
    width = float(np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(pixels)))
    if elevation < _ELEVATION_LOST_DEG or width < _SPREAD_LOST_PX:
        text = (
            f"the plane is seen edge-on or from too far: the line of sight meets it at {elevation:.1f} "
            f"degrees and its corners spread over {width:.1f} px only"
        )
        yield Finding("unidentifiable", text)
    elif elevation < _ELEVATION_POOR_DEG:
        text = (
            f"the plane is seen nearly edge-on, at {elevation:.1f} degrees; {_ELEVATION_POOR_DEG:.0f} or "
            "more are needed"
        )
        yield Finding("poor", text)


def _of_residuals(camera: Camera, plane: Plane, camera_rms_px: float | None) -> Iterator[Finding]:
    world_m, pixels, rms = plane.corners_m, plane.corners_px, plane.rms_px
    if plane.termination == "iterations":
        yield Finding("poor", "the fit of the pose did not converge")
    ideal = undistort(camera, pixels)
    usable = bool(np.isfinite(ideal).all())
    free_rms = plain_rms = off_mm = math.nan
    if usable and len(pixels) >= _HOMOGRAPHY_POINTS and rms > _STRAIGHT_PX:
        free = geometry.fit_homography(world_m, ideal)
        seen = project(camera, np.column_stack([world_m, np.ones(len(world_m))]) @ free.H.T)
        free_rms = float(np.sqrt(np.mean(np.sum((seen - pixels) ** 2, axis=1))))
        posed = plane_map(camera, plane.R_CW, plane.t_CW_m, pixels)
        freed = geometry.apply_homography(np.asarray(np.linalg.inv(free.H)), ideal)
        off_mm = 1e3 * float(np.linalg.norm(posed - freed, axis=1).max())
        plain_rms = geometry.fit_homography(world_m, pixels).rms_px
    if _HOMOGRAPHY_FACTOR * plain_rms < min(free_rms, rms):
        yield Finding(
            "poor",
            f"without any distortion the corners fit to {plain_rms:.2g} px, with the camera's to {rms:.2g} "
            "px: the picture was undistorted before, or is another camera's",
            "give the picture as it was taken",
        )
    elif (other := _another_picture(camera, plane)) is not None:
        yield other
    elif rms > _RMS_LIMIT_PX:
        text = (
            f"the corners miss their places by {rms:.2f} px RMS (limit {_RMS_LIMIT_PX:g}): wrong square, "
            "wrong order of corners, or another camera's intrinsics"
        )
        yield Finding("poor", text)
    elif camera_rms_px is not None and rms > max(_RMS_FACTOR * camera_rms_px, _RMS_NOTICED_PX):
        text = (
            f"the RMS of {rms:.2f} px is more than {_RMS_FACTOR:g} times the camera's own "
            f"{camera_rms_px:.2f} px"
        )
        yield Finding("poor", text)
    if not usable:
        folded = int((~np.isfinite(ideal).all(axis=1)).sum())
        yield Finding("poor", f"{folded} corners lie where the camera's lens model folds over")
    elif rms > _HOMOGRAPHY_FACTOR * free_rms:
        size_mm = 1e3 * float(np.hypot(*np.ptp(world_m, axis=0)))
        # Were the board as described, the noise would be what a free map leaves.
        plane_mm, lens_mm = plane.sigma.plane_mm * free_rms / rms, plane.sigma.intrinsics_mm
        sigma_mm = np.linalg.norm(plane_mm if lens_mm is None else np.hypot(plane_mm, lens_mm), axis=1)
        known_mm = float(np.nanmax(sigma_mm)) if np.isfinite(sigma_mm).any() else math.inf
        if rms > _RMS_NOTICED_PX or off_mm > max(_OFF_SIGMAS * known_mm, _OFF_SHARE * size_mm):
            text = (
                f"a free homography fits to {free_rms:.2g} px where the pose fits to {rms:.2g} px, and puts "
                f"corners up to {off_mm:.2g} mm elsewhere: the intrinsics or the proportions of the board "
                "are not the real ones"
            )
            yield Finding("poor", text, "measure the printed squares along both sides; lay the board flat")


def _another_picture(camera: Camera, plane: Plane) -> Finding | None:
    """Whether corners fit far better as if the picture had been zoomed or cropped, turned or mirrored.

    One view of a plane hardly tells these by its pose: corners that miss by hundredths of a pixel may stand
    for a marker that is read centimetres beside.
    """
    world_m, pixels, points = plane.corners_m, plane.corners_px, plane.sigma.points_m
    if plane.rms_px < _OTHER_LEAST_PX:
        return None
    advice = "give the picture as the camera took it, with the zoom and size that it was calibrated with"
    at = np.array(camera.image_size_px) - 1.0
    flips = {
        "mirrored left to right": (True, False),
        "mirrored upside down": (False, True),
        "turned by half a turn": (True, True),
    }
    flipped: dict[str, float] = {}
    for how, turned in flips.items():
        mirror = np.array([1.0, 1.0 if all(turned) else -1.0])
        with suppress(BadInputError):
            flipped[how] = fit_pose(camera, world_m * mirror, np.where(turned, at - pixels, pixels)).rms_px
    how = min(flipped, key=lambda one: flipped[one], default="")
    if how and plane.rms_px > _OTHER_FACTOR * flipped[how]:
        text = (
            f"as if the picture had been {how} the corners fit to {flipped[how]:.2g} px, as it is to "
            f"{plane.rms_px:.2g} px"
        )
        return Finding("poor", text, advice)
    try:
        other, fit = _zoomed(camera, plane)
    except (BadInputError, np.linalg.LinAlgError):
        return None
    if plane.rms_px < _OTHER_FACTOR * fit.rms_px:
        return None
    # Markers are seen by the camera as it was calibrated, from where the board's picture puts it.
    seen = plane_pixels(camera, fit.R_CW, fit.t_CW_m, points)
    off_mm = 1e3 * np.linalg.norm(plane_map(camera, plane.R_CW, plane.t_CW_m, seen) - points, axis=1)
    off_mm = off_mm[np.isfinite(off_mm)]
    known_mm = float(np.nanmax(np.linalg.norm(plane.sigma.calibration_mm, axis=1)))
    size_mm = 1e3 * float(np.hypot(*np.ptp(world_m, axis=0)))
    if not off_mm.max(initial=0.0) > max(_OFF_SIGMAS * known_mm, _OFF_SHARE * size_mm):
        return None
    text = (
        f"with {100 * other.fx_px / camera.fx_px:.1f} % of the focal length and its centre at "
        f"({other.cx_px:.1f}, {other.cy_px:.1f}) the corners fit to {fit.rms_px:.2g} px, with the camera's "
        f"to {plane.rms_px:.2g} px, and markers would be up to {off_mm.max():.1f} mm elsewhere: the picture "
        "was zoomed, cropped or refocused, or the board is bent"
    )
    return Finding("poor", text, f"{advice}; lay the board flat")


def _zoomed(camera: Camera, plane: Plane) -> tuple[Camera, Pose]:
    """The camera with the zoom and centre that the plane's picture alone gives it, and the pose by it."""
    other, fit = camera, Pose(**{one.name: getattr(plane, one.name) for one in fields(Pose)})
    for _ in range(_OTHER_STEPS):
        _, by_pose, by_camera = pose_derivatives(other, fit.R_CW, fit.t_CW_m, plane.corners_m)
        fx, fy, cx, cy = (
            by_camera[..., INTRINSICS.index(name)] for name in ("fx_px", "fy_px", "cx_px", "cy_px")
        )
        zoom = other.fx_px * fx + other.fy_px * fy
        J = np.concatenate([np.stack([zoom, cx, cy], axis=2), by_pose], axis=2).reshape(-1, 9)
        unit = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        step = (-unit * np.linalg.lstsq(J * unit, fit.residuals_px.ravel(), rcond=None)[0]).tolist()
        share = math.exp(min(max(step[0], -_OTHER_ZOOM), _OTHER_ZOOM))
        other = replace(
            other,
            fx_px=other.fx_px * share,
            fy_px=other.fy_px * share,
            cx_px=other.cx_px + step[1],
            cy_px=other.cy_px + step[2],
        )
        fit = fit_pose(other, plane.corners_m, plane.corners_px)
    return other, fit


def _of_horizon(camera: Camera, plane: Plane) -> Iterator[Finding]:
    """The denominator of (2.12) must not cross zero within the picture.

    In that of a fisheye lens it does for any plane that is tilted; what is beyond has no place on the plane.
    """
    if camera.fisheye:
        return
    width, height = camera.image_size_px
    ideal = undistort(camera, geometry.box_grid((0.0, 0.0, width - 1.0, height - 1.0), 41, 31).reshape(-1, 2))
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    last = np.linalg.inv(np.column_stack([plane.R_CW[:, :2], plane.t_CW_m]))[2]
    beyond = float(np.mean(ideal @ last[:2] + last[2] <= 0.0)) if len(ideal) else 0.0
    if beyond > 0.0:
        text = (
            f"the plane's horizon crosses the picture: {100 * beyond:.0f} % of the pixels show nothing of "
            "the plane"
        )
        yield Finding("poor", text)


def _of_precision(camera: Camera, plane: Plane) -> Iterator[Finding]:
    """How well the pose is known over the workspace."""
    sigma, (x0, y0, x1, y1) = plane.sigma, plane.workspace_m
    seen = visible(camera, plane.R_CW, plane.t_CW_m, sigma.points_m)
    calibration_mm = sigma.calibration_mm[seen]
    if np.any(np.isinf(calibration_mm)):
        text = "the intrinsics themselves are not known: their covariance is infinite"
        yield Finding("poor", text)
    if not seen.any() or not np.all(np.isfinite(calibration_mm)):
        return
    diagonal_mm = 1e3 * float(np.hypot(x1 - x0, y1 - y0))
    worst_mm = float(np.hypot(*sigma.plane_mm[seen].T).max())
    if worst_mm > _SIGMA_SHARE * diagonal_mm:
        text = (
            f"the corners do not fix the plane over the workspace: sigma reaches {worst_mm:.1f} mm of "
            f"{diagonal_mm:.0f} mm"
        )
        yield Finding("poor", text)
    if plane.other is not None:
        cost, R, t = plane.other
        points = sigma.points_m[seen]
        pixels = plane_pixels(camera, plane.R_CW, plane.t_CW_m, points)
        apart = 1e3 * np.linalg.norm(plane_map(camera, R, t, pixels) - points, axis=1)
        likely = cost - plane.cost_px2 < 9.0 * plane.sigma_px**2
        if likely and np.nanmax(apart) > 3.0 * float(np.hypot(*calibration_mm.T).max()):
            text = (
                "the plane tilted the other way fits as well and puts the marker up to "
                f"{np.nanmax(apart):.1f} mm elsewhere; look at it more obliquely or from nearer"
            )
            yield Finding("poor", text)


# ----------------------------------------------------------------------
# The actuator's plane: from pixels to millimetres and back, and how far to trust it.
#
# With the camera K and the pose R, t of the world in the camera's frame the plane Z = 0 is seen by
#
#     s (u, v, 1) = A (X, Y, 1),   A = K [R1 R2 t]                                        (2.9)
#     (X, Y, 1) = s A^-1 (u, v, 1),   1 / s = A^-1_31 u + A^-1_32 v + A^-1_33             (2.11, 2.12)
#
# where (u, v) are pixels freed of lens distortion. The printed (2.9) lacks the K; with it (2.11) and
# (2.12) are exact. A keeps its metric scale, so s is the depth in metres.
#
# A plane comes with a verdict: "ok"; "poor" where something is wrong enough to look into;
# "unidentifiable" where the pictures do not hold the answer; "inconsistent" where they contradict each
# other because the camera or the board moved.


@dataclass(frozen=True)
class Plane(Pose):
    """A calibrated plane: a pose whose covariance holds what it takes over from the intrinsics as well.

    Attributes
    ----------
    A : (3, 3), homography (2.9) from metres to ideal pixels; s is the depth in metres.
    rms_mm : distance on the plane between where corners are and where they are read.
    pictures : fit of each picture.
    corners_m, corners_px : (M, 2) of all pictures in turn: places on the plane, and where the pictures show
        them.
    workspace_m : box (x0, y0, x1, y1) over which the uncertainty is reported.
    sigma : standard deviations of a marker's position over the workspace.
    direct : homography from metres to distorted pixels, fitted without intrinsics.
    direct_difference_mm : (N,) distance between the two maps at `sigma.points_m`.
    verdict : whether to trust it.
    """

    A: FloatArray
    rms_mm: float
    pictures: tuple[PictureFit, ...]
    corners_m: FloatArray
    corners_px: FloatArray
    workspace_m: tuple[float, float, float, float]
    sigma: PositionSigma
    direct: geometry.Homography
    direct_difference_mm: FloatArray
    verdict: Verdict

    @property
    def A_inverse(self) -> FloatArray:
        """A^-1 of (2.11), (3, 3), ideal pixels to metres."""
        return np.asarray(np.linalg.inv(self.A), dtype=np.float64)


@dataclass(frozen=True)
class BoardPlace:
    """Where the board lies in the plane, as far as a ruler tells.

    Attributes
    ----------
    first_corner_m : world position of corner (0, 0).
    corner_sigma_m, angle_sigma_rad : standard deviations of its x and y, and of the board's direction.
    """

    first_corner_m: tuple[float, float]
    corner_sigma_m: float = 0.0
    angle_sigma_rad: float = 0.0

    def covariance(self, R_CW: FloatArray) -> FloatArray:
        """What it leaves open of the pose (w, t), (6, 6): the board as seen stays, the world moves under it.

        A world that moves by e and turns by a about the corner c shows X where X + e + a z x (X - c) was.
        """
        across = np.array([-self.first_corner_m[1], self.first_corner_m[0]])
        J = np.zeros((6, 3))
        J[:3, 2] = -R_CW[:, 2]
        J[3:, :2] = -R_CW[:, :2]
        J[3:, 2] = R_CW[:, :2] @ across
        return J @ np.diag([self.corner_sigma_m**2, self.corner_sigma_m**2, self.angle_sigma_rad**2]) @ J.T


def calibrate_plane(
    camera: Camera,
    camera_covariance: FloatArray | None,
    views: Sequence[View],
    *,
    workspace_m: tuple[float, float, float, float] | None = None,
    camera_rms_px: float | None = None,
    placed: BoardPlace = BoardPlace((0.0, 0.0)),
) -> Plane:
    """Fit one pose of the world's plane to all pictures of it, taken by a camera that stands still.

    Parameters
    ----------
    camera_covariance : (13, 13) in the order of `projection.INTRINSICS`, zero rows for what was not
        estimated; None where it is not known.
    views : pictures with `target_m` in the world's plane, see `placement.world_points_m`.
    workspace_m : box (x0, y0, x1, y1) over which the uncertainty is reported; by default the box
        around the corners, which the source document takes for the marker's range.
    camera_rms_px : RMS of the camera's own calibration, to compare this one with.
    placed : how well the board's place is known; exactly by default.

    Raises
    ------
    BadInputError
        With points on a line, or a mirrored plane.
    """
    world_m = np.concatenate([view.target_m for view in views])
    pixels = np.concatenate([view.pixels for view in views])
    pose = fit_pose(camera, world_m, pixels, _same_points(world_m))
    pictures, comparison = compare_pictures(camera, views, pose)
    inflation = max(comparison.inflation, _alike(views, pose.residuals_px))
    pose = replace(pose, covariance=pose.covariance * inflation + placed.covariance(pose.R_CW))
    low, high = world_m.min(axis=0).tolist(), world_m.max(axis=0).tolist()
    box = workspace_m or (low[0], low[1], high[0], high[1])
    sigma = position_sigma(camera, camera_covariance, pose, geometry.box_grid(box, 9, 9).reshape(-1, 2))
    direct = geometry.fit_homography(world_m, pixels)
    read_m = plane_map(camera, pose.R_CW, pose.t_CW_m, pixels)
    whole = replace(pose, covariance=_pose_covariance(pose, camera_covariance))
    plane = Plane(
        **vars(whole),
        A=camera.K @ np.column_stack([pose.R_CW[:, :2], pose.t_CW_m]),
        rms_mm=1e3 * float(np.sqrt(np.nanmean(np.sum((read_m - world_m) ** 2, axis=1)))),
        pictures=pictures,
        corners_m=world_m,
        corners_px=pixels,
        workspace_m=box,
        sigma=sigma,
        direct=direct,
        direct_difference_mm=1e3 * np.linalg.norm(moved_m(camera, pose, direct, sigma.points_m), axis=1),
        verdict=Verdict(),
    )
    return replace(plane, verdict=Verdict.of(_findings(camera, plane, comparison, camera_rms_px)))


def _pose_covariance(pose: Pose, camera_covariance: FloatArray | None) -> FloatArray:
    """Covariance (6, 6) of the pose: its own fit, and what it takes over from the intrinsics, E cov(c) E'."""
    if camera_covariance is None:
        return pose.covariance
    if not np.all(np.isfinite(camera_covariance)):
        return np.diag(np.full(6, np.inf))
    return np.asarray(pose.covariance + pose.by_intrinsics @ camera_covariance @ pose.by_intrinsics.T)


def _same_points(world_m: FloatArray) -> IntArray:
    """Index of the different world points (to a nanometre) that each row belongs to."""
    keys = np.round(world_m * 1e9).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def moved_m(camera: Camera, pose: Pose, direct: geometry.Homography, points_m: FloatArray) -> FloatArray:
    """How far the map without a lens moves the marker at each of places (..., 2); NaN out of sight."""
    seen = visible(camera, pose.R_CW, pose.t_CW_m, points_m.reshape(-1, 2)).reshape(points_m.shape[:-1])
    moved = np.full(points_m.shape, np.nan)
    pixels = plane_pixels(camera, pose.R_CW, pose.t_CW_m, points_m[seen])
    moved[seen] = geometry.apply_homography(np.asarray(np.linalg.inv(direct.H)), pixels) - points_m[seen]
    return moved


# ----------------------------------------------------------------------
# Where the board lies in the actuator's plane, and which of its corners is the first.
#
# The world's x axis points right and its y axis down as the camera sees them, so that the corner at
# (x, y) on the board lies at
#
#     X_W = first_corner + [[c, -s], [s, c]] (x, y),   c = cos(angle), s = sin(angle)
#
# Most checkerboards look the same after half a turn (a square one after a quarter), and of others nobody
# knows from which end they were measured. So a rule settles that: the turn is taken that makes the world's x
# axis point to the right in the picture, unless the user says where the first corner is seen. Where the
# board's colours tell its ends apart, and say otherwise, the answer comes with that doubt.

_SIDEWAYS_DEG = 60.0
"""A world's x axis that far from the picture's right is a rule's answer that a person has to confirm: corners
stated as rows x columns, or a camera on its side, make it."""
_UNDECIDED_DEG = 0.5
"""Two turns are told apart only when the axis is at least this far from the border between them."""


@dataclass(frozen=True)
class Placement:
    """Corners of one picture in the board's own order.

    Attributes
    ----------
    pixels : (columns * rows, 2), row by row from the corner (0, 0).
    quarter_turns : by how many quarter turns, clockwise as seen, the detected order was turned.
    how : one sentence that says how the orientation was settled.
    doubt : a sentence where the board's colours say otherwise, else empty.
    """

    pixels: FloatArray
    quarter_turns: int
    how: str
    doubt: str = ""

    def reordered(self, values: BoolArray, board: Board) -> BoolArray:
        """Values (columns * rows,) of the detected corners in the order of `pixels`."""
        return np.rot90(values.reshape(board.rows, board.columns), self.quarter_turns).ravel()


def world_points_m(board: Board, first_corner_m: Sequence[float], angle_rad: float) -> FloatArray:
    """Inner corners in the world's plane, shape (columns * rows, 2), metres, row by row.

    Parameters
    ----------
    first_corner_m : world position of corner (0, 0).
    angle_rad : direction of the board's columns axis, from x towards y.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turned = board.points_m() @ np.array([[c, s], [-s, c]])
    return np.asarray(turned + np.asarray(first_corner_m, dtype=np.float64))


def turns_of(pixels: FloatArray, board: Board) -> list[tuple[int, FloatArray]]:
    """Detected corners (columns * rows, 2) after 0, 1, 2, 3 quarter turns (1 and 3 on square boards)."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    turns = range(4) if board.columns == board.rows else (0, 2)
    return [(turn, np.rot90(grid, turn).reshape(-1, 2)) for turn in turns]


def _world_x_direction(pixels: FloatArray, board: Board, angle_rad: float) -> float:
    """Direction (rad) of the world's x axis in the picture at the board's centre."""
    points = board.points_m()
    H = geometry.fit_homography(points, pixels).H
    along_board = np.array([np.cos(angle_rad), -np.sin(angle_rad)])
    du, dv = geometry.map_jacobian(H, points.mean(axis=0)) @ along_board
    return float(np.arctan2(dv, du))


def _wrapped_deg(angle_rad: float) -> float:
    return float(np.degrees((angle_rad + np.pi) % (2 * np.pi) - np.pi))


def settle_orientation(
    pixels: FloatArray,
    board: Board,
    angle_rad: float,
    first_corner_px: Sequence[float] | None = None,
    name: str = "the picture",
) -> Placement:
    """Give the detected corners the board's own order, by a stated rule.

    Without `first_corner_px` the half turn (or, on a square board, the quarter turn) is chosen that
    turns the *world's* x axis most to the right in the picture, whatever `angle_rad` is. With it the corner
    (0, 0) is the one seen there, which must be within half a square of it.

    Parameters
    ----------
    pixels : (columns * rows, 2) detected corners, row by row, not mirrored; of any turn, but where the
        colours tell the ends apart in the order that they say.
    angle_rad : direction of the board's columns axis in the world.
    first_corner_px : (u, v) of the corner (0, 0), distorted pixels.
    name : how messages call the picture.

    Raises
    ------
    BadInputError
        Where the rule cannot decide, and where no corner that can be the first is near `first_corner_px`.
    """
    candidates = turns_of(pixels, board)
    degrees_of = [_wrapped_deg(_world_x_direction(turned, board, angle_rad)) for _, turned in candidates]
    if first_corner_px is not None:
        return _settle_by_pixel(candidates, degrees_of, board, first_corner_px, name)

    best, second, *_ = np.argsort(np.abs(degrees_of)).tolist()
    (turn, chosen), degrees = candidates[best], degrees_of[best]
    if abs(degrees_of[second]) - abs(degrees) < 2 * _UNDECIDED_DEG:
        raise BadInputError(
            f"{name}: the world's x axis would point {degrees:.1f} or {degrees_of[second]:.1f} degrees from "
            "the picture's right, so the first corner cannot be told; give first_corner_px: [u, v] in "
            "board.yaml"
        )
    limit = 90 if len(candidates) == 2 else 45
    tells = not board.half_turn_looks_the_same
    looks = "looks the same after a quarter turn" if limit == 45 else "can be read from either end"
    looks = "has ends of different colours" if tells else looks
    how = (
        f"The board {looks}; corner (0, 0) was taken at pixel ({chosen[0, 0]:.1f}, {chosen[0, 1]:.1f}), so "
        f"that the world's x axis points {_words(degrees)} in the picture (rule: right to within {limit} "
        "degrees)."
    )
    doubt = ""
    if tells and turn:
        u, v = candidates[0][1][0]
        doubt = (
            f"{name}: by the board's colours, dark across corner (0, 0), that corner is at pixel "
            f"({u:.1f}, {v:.1f}), by the world's x axis, which points right, at ({chosen[0, 0]:.1f}, "
            f"{chosen[0, 1]:.1f})"
        )
    elif abs(degrees) > _SIDEWAYS_DEG:
        doubt = (
            f"{name}: the world's x axis points {_words(degrees)} in the picture: {board.columns}x"
            f"{board.rows} may be the wrong order of corners, or angle_rad that of the other axis"
        )
    return Placement(chosen, turn, how, doubt)


def _words(degrees: float) -> str:
    if abs(degrees) < 0.05:
        return "right"
    return f"right and {abs(degrees):.1f} degrees {'down' if degrees > 0 else 'up'}"


def _settle_by_pixel(
    candidates: list[tuple[int, FloatArray]],
    degrees_of: Sequence[float],
    board: Board,
    first_corner_px: Sequence[float],
    name: str,
) -> Placement:
    wanted = np.asarray(first_corner_px, dtype=np.float64)
    distances = [float(np.linalg.norm(turned[0] - wanted)) for _, turned in candidates]
    best = int(np.argmin(distances))
    turn, chosen = candidates[best]
    # Half the mean of the two sides that meet there.
    limit = 0.25 * float(np.linalg.norm(chosen[[1, board.columns]] - chosen[0], axis=1).sum())
    if distances[best] > limit:
        seen = ", ".join(f"({turned[0, 0]:.1f}, {turned[0, 1]:.1f})" for _, turned in candidates)
        raise BadInputError(
            f"{name}: first_corner_px is [{wanted[0]:g}, {wanted[1]:g}], but the corners that can be the "
            f"first are seen at {seen}; expected one within half a square ({limit:.1f} px)"
        )
    how = (
        f"Corner (0, 0) was taken at pixel ({chosen[0, 0]:.1f}, {chosen[0, 1]:.1f}), {distances[best]:.1f} "
        f"px from first_corner_px; the world's x axis points {degrees_of[best]:.1f} degrees from the "
        "picture's right (positive is down)."
    )
    return Placement(chosen, turn, how)
