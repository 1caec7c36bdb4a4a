"""The camera model: pinhole with skew and Brown's or the rational distortion.

A point (X, Y, Z) of the camera's frame is seen at

    x = X / Z,  y = Y / Z,  r2 = x^2 + y^2
    L  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    xd = x L + 2 p1 x y + p2 (r2 + 2 x^2)
    yd = y L + p1 (r2 + 2 y^2) + 2 p2 x y
    u  = fx xd + skew yd + cx,  v = fy yd + cy

which is (2.4), (2.5) and (B.1) of the source document for k1, k2 alone, and OpenCV's model with a
skew added (Zhang 2000). The printed (2.7), gamma = f_w tan(psi), mixes units: skew is in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.arrays import FloatArray

__all__ = ["COEFFICIENTS", "MODELS", "Camera", "distort", "project", "undistort"]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of the distortion coefficients everywhere, OpenCV's."""

MODELS: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "radial2": ("k1", "k2"),
    "radial3": ("k1", "k2", "k3"),
    "brown5": ("k1", "k2", "p1", "p2", "k3"),
    "rational8": COEFFICIENTS,
}
"""Coefficients that each model frees, from the simplest to the richest."""


def _no_distortion() -> FloatArray:
    return np.zeros(len(COEFFICIENTS))


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes
    ----------
    model : a key of `MODELS`.
    image_size_px : (width, height).
    fx_px, fy_px, skew_px, cx_px, cy_px : entries of K (2.5), pixels.
    distortion : (8,) coefficients in the order of `COEFFICIENTS`, dimensionless.
    """

    model: str
    image_size_px: tuple[int, int]
    fx_px: float
    fy_px: float
    skew_px: float
    cx_px: float
    cy_px: float
    distortion: FloatArray = field(default_factory=_no_distortion)

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (2.5), shape (3, 3), pixels."""
        return np.array(
            [[self.fx_px, self.skew_px, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )


def distort(x: FloatArray, y: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted from undistorted normalised coordinates, any shape."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xy = x * y
    xd = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    return xd, yd


def _distort_jacobian(
    x: FloatArray, y: FloatArray, distortion: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Derivatives of (xd, yd) with respect to (x, y): xx, xy, yx, yy."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    r2 = x * x + y * y
    numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return xx, cross, cross, yy


def project(camera: Camera, points_C: FloatArray) -> FloatArray:
    """Pixels of points in the camera's frame.

    Parameters
    ----------
    points_C : (..., 3) with positive Z.

    Returns
    -------
    (..., 2) distorted pixels.
    """
    x = points_C[..., 0] / points_C[..., 2]
    y = points_C[..., 1] / points_C[..., 2]
    xd, yd = distort(x, y, camera.distortion)
    u = camera.fx_px * xd + camera.skew_px * yd + camera.cx_px
    v = camera.fy_px * yd + camera.cy_px
    return np.stack([u, v], axis=-1)


def undistort(camera: Camera, pixels: FloatArray, iterations: int = 30) -> FloatArray:
    """Normalised undistorted coordinates (x, y) of distorted pixels, by Newton's method.

    Where the distortion folds over and no answer exists the result is NaN.

    Parameters
    ----------
    pixels : (..., 2) distorted pixels.

    Returns
    -------
    (..., 2) normalised coordinates.
    """
    yd = (pixels[..., 1] - camera.cy_px) / camera.fy_px
    xd = (pixels[..., 0] - camera.cx_px - camera.skew_px * yd) / camera.fx_px
    x, y = xd.copy(), yd.copy()
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            xd_now, yd_now = distort(x, y, camera.distortion)
            ex, ey = xd - xd_now, yd - yd_now
            xx, xy, yx, yy = _distort_jacobian(x, y, camera.distortion)
            det = xx * yy - xy * yx
            # A step longer than the radius would leap over the fold of a barrel distortion.
            step_x, step_y = (yy * ex - xy * ey) / det, (xx * ey - yx * ex) / det
            limit = 0.5 * np.hypot(xd, yd) + 0.1
            scale = np.minimum(1.0, limit / np.maximum(np.hypot(step_x, step_y), 1e-300))
            x = x + scale * step_x
            y = y + scale * step_y
            if not np.any(np.hypot(step_x, step_y) > 1e-14):
                break
        xd_now, yd_now = distort(x, y, camera.distortion)
        solved = np.hypot(xd - xd_now, yd - yd_now) < 1e-10
        xx, xy, yx, yy = _distort_jacobian(x, y, camera.distortion)
        # Both eigenvalues positive: beyond the fold the picture of the point's antipode has none.
        solved &= (xx * yy - xy * yx > 0.0) & (xx + yy > 0.0)
    return np.where(solved[..., None], np.stack([x, y], axis=-1), np.nan)
