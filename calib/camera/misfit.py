"""Views and points that do not fit: told from the correspondences alone, and from the residuals.

A plane seen through a lens follows a homography up to distortion, a smooth bulge of at most a tenth of
the board's extent in the picture. Points in another order, from another board or on one line do not, and
one such view can keep a whole calibration from finding a camera. After the fit the residuals tell views
and points that are far worse than the others, and errors that repeat from view to view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.bundle import Calibration
from calib.camera.views import Observations
from calib.camera.zhang import homographies

__all__ = ["Misfit", "Screening", "misfit", "screen"]

_FLAT = 2e-3
"""Smaller over larger extent of a set of points below which they lie on a line."""
_OFF_PLANE = 0.2
"""Departure from a homography over the extent in the picture; 100 degrees of barrel make 0.1."""


@dataclass(frozen=True)
class Screening:
    """What is wrong with each view, all (N,).

    Attributes
    ----------
    few : fewer than four points.
    on_a_line : the target's points, or their pixels, lie on one line.
    not_a_plane : no homography explains the pixels.
    departure : root mean square departure from a homography over the extent in the picture; NaN in
        the other two cases.
    """

    few: BoolArray
    on_a_line: BoolArray
    not_a_plane: BoolArray
    departure: FloatArray

    @property
    def unusable(self) -> BoolArray:
        """Views with any of these, (N,)."""
        return self.few | self.on_a_line | self.not_a_plane


def _flatness(points: FloatArray, present: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Smaller over larger, and larger, standard deviation of sets of points (N, M, 2), each (N,)."""
    count = np.maximum(present.sum(axis=1), 1)
    weight = present[..., None] / count[:, None, None]
    off = (points - (points * weight).sum(axis=1, keepdims=True)) * present[..., None]
    scatter = np.einsum("nmi,nmj->nij", off, off) / count[:, None, None]
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter), 0.0))
    return values[:, 0] / np.maximum(values[:, 1], 1e-300), values[:, 1]


def screen(observations: Observations) -> Screening:
    """Look for views that cannot be views of the plane."""
    present, pixels = observations.present, observations.pixels
    target = np.broadcast_to(observations.target_m, (*present.shape, 3))
    few = present.sum(axis=1) < 4
    extent = _flatness(pixels, present)[1]
    line = (_flatness(target[..., :2], present)[0] < _FLAT) | (_flatness(pixels, present)[0] < _FLAT)
    departure = np.full(observations.views, np.nan)
    usable = np.flatnonzero(~few & ~line)
    if len(usable):
        chosen = observations.select(usable)
        H = homographies(chosen)
        plane = np.broadcast_to(chosen.target_m[..., :2], chosen.pixels.shape)
        mapped = np.einsum("nij,nmj->nmi", H[..., :2], plane) + H[:, None, :, 2]
        depth = np.where(np.abs(mapped[..., 2:]) > 1e-12, mapped[..., 2:], 1e-12)
        off = np.where(chosen.present, ((mapped[..., :2] / depth - chosen.pixels) ** 2).sum(axis=2), 0.0)
        rms = np.sqrt(off.sum(axis=1) / chosen.present.sum(axis=1))
        departure[usable] = rms / np.maximum(extent[usable], 1e-300)
    return Screening(few, line & ~few, np.nan_to_num(departure) > _OFF_PLANE, departure)


@dataclass(frozen=True)
class Misfit:
    """What the residuals show.

    Attributes
    ----------
    rms_px : over all points.
    view_rms_px : (N,).
    typical_px : median of `view_rms_px`.
    bad_views : (N,) views whose RMS is far above the others'.
    bad_points : (N, M) points outside of bad views whose residual is far above the others'.
    points : how many points there are outside of bad views.
    heavy_share : share of squared residuals that the worst percent of points holds; 0.05 when normal.
    repeated : root mean square over the target's points of the mean residual over views, in the
        target's frame, over what it would be if the views' errors were independent.
    """

    rms_px: float
    view_rms_px: FloatArray
    typical_px: float
    bad_views: BoolArray
    bad_points: BoolArray
    points: int
    heavy_share: float
    repeated: float


def misfit(calibration: Calibration, view_factor: float, point_factor: float, floor_px: float) -> Misfit:
    """Judge the residuals of a calibration.

    Parameters
    ----------
    view_factor : a view is bad above this many times the median RMS of the views ...
    point_factor : a point above this many times its view's and the median view's RMS ...
    floor_px : ... and above this many pixels.
    """
    residuals, present = calibration.residuals_px, calibration.observations.present
    squared = np.where(present, (residuals**2).sum(axis=2), 0.0)
    squared = np.where(present, squared, 0.0)
    per_view = np.sqrt(squared.sum(axis=1) / np.maximum(present.sum(axis=1), 1))
    # A bad view drags the camera and raises its neighbours' residuals, so the lower half is the measure.
    typical = float(np.median(per_view))
    quiet = float(np.median(np.sort(per_view)[: (len(per_view) + 1) // 2]))
    bad_views = per_view > max(view_factor * quiet, floor_px)
    fine = present & ~bad_views[:, None]
    distance = np.sqrt(squared)
    median = _median_distance(distance, fine)
    bad_points = fine & (distance > np.maximum(point_factor * median[:, None], floor_px))
    ordered = np.sort(squared[fine])
    worst = max(1, len(ordered) // 100)
    return Misfit(
        rms_px=calibration.rms_px,
        view_rms_px=per_view,
        typical_px=typical,
        bad_views=bad_views,
        bad_points=bad_points,
        points=int(fine.sum()),
        heavy_share=float(ordered[-worst:].sum() / max(ordered.sum(), 1e-300)) if len(ordered) else 0.0,
        repeated=_repeated(calibration),
    )


def _median_distance(distance: FloatArray, fine: BoolArray) -> FloatArray:
    """Median residual of each view, and not below that of all, (N,)."""
    hidden = np.where(fine, distance, np.nan)
    everything = float(np.median(distance[fine])) if fine.any() else 0.0
    own = np.full(len(distance), everything)
    some = fine.any(axis=1)
    own[some] = np.nanmedian(hidden[some], axis=1)
    return np.asarray(np.maximum(own, everything))


def _repeated(calibration: Calibration) -> float:
    """Mean residual of each target point over views, in the target's axes; one when independent."""
    observations = calibration.observations
    if not observations.same_target or observations.views < 4:
        return 1.0
    block = calibration.block
    # Directions of the target's axes in the picture, turned back, lengths left out.
    axes = block.R_CT[:, :2, :2]
    U, _, Vt = np.linalg.svd(axes)
    turned = np.einsum("nmi,nij->nmj", np.nan_to_num(calibration.residuals_px), U @ Vt)
    count = np.maximum(observations.present.sum(axis=0), 1)
    mean = turned.sum(axis=0) / count[:, None]
    spread = float((turned**2).sum() / max(2 * observations.points, 1))
    if spread <= 0.0:
        return 1.0
    return float(np.sqrt((mean**2 * count[:, None]).mean() / spread))
