"""Correspondences between points of a plane and pixels: one view, and many views packed for vector code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray, IntArray

__all__ = ["Observations", "View", "pack"]


@dataclass(frozen=True)
class View:
    """One picture of a planar target.

    Attributes
    ----------
    name : name of the picture, for reports.
    target_m : (M, 2) points on the target's plane, metres.
    pixels : (M, 2) where the picture shows them, distorted pixels, (0, 0) at the centre of the
        top-left pixel, u right, v down.
    measured : (M,) False for points that the picture does not show well enough to count; all True
        when None. They keep their place, so that views of one board stay comparable.
    """

    name: str
    target_m: FloatArray
    pixels: FloatArray
    measured: BoolArray | None = None


@dataclass(frozen=True)
class Observations:
    """All views as arrays, padded to the largest number of points M.

    Attributes
    ----------
    names : N names.
    target_m : (1, M, 3) when every view shows the same points, else (N, M, 3); z is zero on a flat
        target.
    pixels : (N, M, 2).
    present : (N, M), False for padding and for points that were not measured or were rejected.
    """

    names: tuple[str, ...]
    target_m: FloatArray
    pixels: FloatArray
    present: BoolArray

    @property
    def views(self) -> int:
        """Number of views N."""
        return len(self.names)

    @property
    def points(self) -> int:
        """Number of points over all views, padding left out."""
        return int(self.present.sum())

    @property
    def complete(self) -> bool:
        """Whether every view shows every point."""
        return bool(self.present.all())

    @property
    def same_target(self) -> bool:
        """Whether the target's points are the same in every view."""
        return bool(self.target_m.shape[0] == 1)

    def select(self, index: IntArray | Sequence[int]) -> Observations:
        """The views at these indices, in this order."""
        chosen = np.asarray(index, dtype=np.int64)
        return Observations(
            names=tuple(self.names[i] for i in chosen),
            target_m=self.target_m if self.same_target else self.target_m[chosen],
            pixels=self.pixels[chosen],
            present=self.present[chosen],
        )

    def part(self, views: slice) -> Observations:
        """A run of views, without copying."""
        target = self.target_m if self.same_target else self.target_m[views]
        return Observations(self.names[views], target, self.pixels[views], self.present[views])

    def displaced(self, displacement_m: FloatArray) -> Observations:
        """The same pixels of a target whose points are moved by `displacement_m` (M, 3)."""
        return Observations(self.names, self.target_m + displacement_m, self.pixels, self.present)

    def without(self, rejected: BoolArray) -> Observations:
        """The same views with the points where `rejected` (N, M) is True left out."""
        return Observations(self.names, self.target_m, self.pixels, self.present & ~rejected)


def pack(views: Sequence[View]) -> Observations:
    """Views as one set of padded arrays; the target is shared when all views have the same one."""
    counts = [len(view.pixels) for view in views]
    size = max(counts)
    first = views[0].target_m
    shared = all(v.target_m is first or np.array_equal(v.target_m, first) for v in views)
    pixels = np.zeros((len(views), size, 2))
    present = np.zeros((len(views), size), dtype=np.bool_)
    target = np.zeros((1 if shared else len(views), size, 3))
    for i, view in enumerate(views):
        pixels[i, : counts[i]] = view.pixels
        present[i, : counts[i]] = True if view.measured is None else view.measured
        if not shared or i == 0:
            target[0 if shared else i, : counts[i], :2] = view.target_m
    return Observations(tuple(v.name for v in views), target, pixels, present)
