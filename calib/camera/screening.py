"""Views that no calibration should see, told from the correspondences alone.

A plane seen through a lens follows a homography up to distortion, a smooth bulge of at most a tenth of
the board's extent in the picture. Points in another order, from another board or on one line do not, and
one such view can keep a whole calibration from finding a camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray
from calib.camera.views import Observations
from calib.camera.zhang import homographies

__all__ = ["Screening", "screen"]

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
