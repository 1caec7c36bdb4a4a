"""Residuals that are not what noise leaves: bad views, bad points, errors that repeat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.bundle import Calibration

__all__ = ["Misfit", "misfit"]


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
