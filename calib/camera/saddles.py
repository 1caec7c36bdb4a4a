"""Where a picture looks like the corner of a checkerboard: saddle points of the brightness.

At a corner the brightness is a saddle, so the determinant of its Hessian is negative there and has a
minimum. Position: the zero of the gradient, by one Newton step. Proof: on a circle around a corner
the brightness changes sides four times, and is the same at opposite points.

An edge that leaves a corner has the bright square on one side. Angles grow from u to v, clockwise as
seen; a ray is "rising" where the brightness rises with the angle. Opposite rays are of one kind, so
a corner has one rising and one falling line, and the ray by which an edge arrives at the next corner
is of the other kind than the one by which it left.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from calib.arrays import BoolArray, FloatArray, GrayImage

__all__ = ["Saddles", "find_saddles", "sample"]

_BLUR_PX = 1.2
_RING_PX = 4.0
_RING_POINTS = 32
_BORDER_PX = 2
_CANDIDATES = 4000
_REMAP_ROWS = 30_000
"""OpenCV takes fewer than 2^15 rows."""
_LEAST_CONTRAST = 4.0
"""Grey levels, half the step from dark to bright."""
_ODD_SHARE = 0.55
"""Largest part of the ring that may differ between opposite points, over the part that agrees."""

_Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Saddles:
    """Corner-like points of one picture.

    Attributes
    ----------
    points : (N, 2) pixels.
    rising, falling : (N,) angles of the two edges' lines, rad, in [0, pi).
    contrast : (N,) half the step from dark to bright, grey levels.
    smooth : (H, W) the blurred picture that they were measured in.
    weak : (M, 2) further saddle points that failed the test on the circle.
    """

    points: FloatArray
    rising: FloatArray
    falling: FloatArray
    contrast: FloatArray
    smooth: _Float32
    weak: FloatArray


def sample(image: _Float32, points: FloatArray) -> FloatArray:
    """Bilinear grey levels at (..., 2) points; beyond the border the border's values go on."""
    flat = np.nan_to_num(points.reshape(-1, 2), nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    values = np.empty(len(flat))
    for start in range(0, len(flat), _REMAP_ROWS):
        part = flat[start : start + _REMAP_ROWS]
        u, v = np.ascontiguousarray(part[:, :1]), np.ascontiguousarray(part[:, 1:])
        values[start : start + _REMAP_ROWS] = cv2.remap(
            image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )[:, 0]
    return values.reshape(points.shape[:-1])


def _extrema(smooth: _Float32) -> FloatArray:
    """Saddle points (N, 2) to a fraction of a pixel, the strongest first."""
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=3, scale=0.25)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=3, scale=0.25)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    response = xy * xy - xx * yy
    peak = cv2.dilate(response, np.ones((5, 5), np.uint8))
    # A corner of contrast C and blur s has xy = 2 C / (pi s^2) at its centre.
    least = (_LEAST_CONTRAST * 0.6 / (2 * _BLUR_PX**2)) ** 2
    found = (response == peak) & (response > least)
    found[:_BORDER_PX], found[-_BORDER_PX:] = False, False
    found[:, :_BORDER_PX], found[:, -_BORDER_PX:] = False, False
    v, u = np.nonzero(found)
    strength = response[v, u]
    order = np.lexsort((u, v, -strength))[:_CANDIDATES]
    v, u, strength = v[order], u[order], strength[order]
    gx = (smooth[v, u + 1] - smooth[v, u - 1]) * 0.5
    gy = (smooth[v + 1, u] - smooth[v - 1, u]) * 0.5
    a, b, c = xx[v, u], xy[v, u], yy[v, u]
    du = (b * gy - c * gx) / -strength
    dv = (b * gx - a * gy) / -strength
    near = np.hypot(du, dv) < 2.0
    points: FloatArray = np.stack([u + du, v + dv], axis=1)[near].astype(np.float64)
    return points


def _crossings(even: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Angles where half a turn (N, n) of a ring rises and falls through its middle.

    The second half is the same as the first, so one rise and one fall are what a corner has.
    """
    n = even.shape[1]
    after = np.roll(even, -1, axis=1)
    rises, falls = (even < 0) & (after >= 0), (even >= 0) & (after < 0)
    once = (rises.sum(axis=1) == 1) & (falls.sum(axis=1) == 1)
    angles = []
    rows = np.arange(len(even))
    for crossing in (rises, falls):
        k = np.argmax(crossing, axis=1)
        y0, y1 = even[rows, k], after[rows, k]
        share = np.where(y0 == y1, 0.5, y0 / np.where(y0 == y1, 1.0, y0 - y1))
        angles.append((k + share) * np.pi / n % np.pi)
    return once, angles[0], angles[1]


def find_saddles(gray: GrayImage | _Float32) -> Saddles:
    """Corner-like points of a picture whose squares are at least 6 px wide.

    Parameters
    ----------
    gray : (H, W) grey levels.
    """
    smooth = cv2.GaussianBlur(
        np.asarray(gray, dtype=np.float32), (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE
    ).astype(np.float32, copy=False)
    points = _extrema(smooth)
    angle = np.arange(_RING_POINTS) * (2 * np.pi / _RING_POINTS)
    ring = sample(smooth, points[:, None] + _RING_PX * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    half = _RING_POINTS // 2
    even = 0.5 * (ring[:, :half] + ring[:, half:])
    odd = 0.5 * (ring[:, :half] - ring[:, half:])
    if len(even) == 0:
        none = np.zeros(0)
        return Saddles(np.zeros((0, 2)), none, none, none, smooth, np.zeros((0, 2)))
    # The middle between dark and bright, which the share of bright sectors must not shift.
    even = even - 0.5 * (even.max(axis=1) + even.min(axis=1))[:, None]
    contrast = even.max(axis=1)
    once, rising, falling = _crossings(even)
    odd_share = np.sqrt(np.mean(odd * odd, axis=1)) / np.maximum(np.sqrt(np.mean(even * even, axis=1)), 1e-9)
    good = once & (contrast > _LEAST_CONTRAST) & (odd_share < _ODD_SHARE)
    return Saddles(points[good], rising[good], falling[good], contrast[good], smooth, points[~good])
