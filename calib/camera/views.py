"""Correspondences between points of a plane and pixels, one view at a time."""

from __future__ import annotations

from dataclasses import dataclass

from calib.arrays import FloatArray

__all__ = ["View"]


@dataclass(frozen=True)
class View:
    """One picture of a planar target.

    Attributes
    ----------
    name : name of the picture, for reports.
    target_m : (M, 2) points on the target's plane, metres.
    pixels : (M, 2) where the picture shows them, distorted pixels, (0, 0) at the centre of the
        top-left pixel, u right, v down.
    """

    name: str
    target_m: FloatArray
    pixels: FloatArray
