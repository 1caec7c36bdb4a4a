"""Undistortion that a microcontroller can afford: a polynomial fitted to the inverse of the lens model.

(B.1) has no inverse in closed form, but over the radii of one picture a short polynomial replaces it.
In normalised distorted coordinates w = (xd, yd), with rho = |w|^2, the radial part is undone by

    x = w P(|w|^2),   P(rho) = 1 + c1 rho + c2 rho^2 + ...

Decentering (p1, p2) is added by the model after the radial part, so it is taken off first, where the
point was found so far; the second line is repeated a few times, once or twice for a usual lens:

    x <- w P(|w|^2)
    x <- v P(|v|^2),   v = w - T(x),   T(x) = (2 p1 x y + p2 (r2 + 2 x^2), p1 (r2 + 2 y^2) + 2 p2 x y)

The coefficients minimise the largest error over the picture (Lawson's reweighted least squares), and
the shortest polynomial that is good enough is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.arrays import AnyArray, BoolArray, FloatArray
from calib.camera.model import Camera, distort, undistort

__all__ = [
    "InversePolynomial",
    "distorted_normalised",
    "exact_inverse",
    "fit_inverse",
    "fold_radius",
    "pixel_grid",
    "undistort_by_polynomial",
]

_MOST_COEFFICIENTS, _MOST_STEPS = 10, 6
_REWEIGHTINGS = 40
_MOST_PIXELS = 200_000
"""Larger pictures are checked on a grid of about this many pixels, their borders included."""


@dataclass(frozen=True)
class InversePolynomial:
    """An inverse of the lens model, see the module.

    Attributes
    ----------
    radial : c1, c2, ...
    p1, p2 : decentering coefficients of the camera.
    decentering_steps : how often the decentering is taken off.
    max_error_px : largest distance between this and the exact inverse over the picture, in undistorted
        pixels, computed in single precision as a microcontroller does.
    covered : share of the picture that the lens model can show at all; the error is over this share.
    tolerance_px : what was asked for.
    """

    radial: tuple[float, ...]
    p1: float
    p2: float
    decentering_steps: int
    max_error_px: float
    covered: float
    tolerance_px: float

    @property
    def good_enough(self) -> bool:
        """Whether it reaches the tolerance everywhere in the picture."""
        return self.covered == 1.0 and self.max_error_px <= self.tolerance_px


def pixel_grid(
    image_size_px: tuple[int, int],
    region_px: tuple[float, float, float, float] | None = None,
    most: int = _MOST_PIXELS,
) -> FloatArray:
    """Centres of the pixels of a picture, or of a box (u0, v0, u1, v1) with its borders, (rows, columns, 2).

    Every pixel where there are no more than `most`, else evenly spaced ones that include the borders.
    """
    width, height = image_size_px
    u0, v0, u1, v1 = region_px or (0.0, 0.0, width - 1.0, height - 1.0)
    columns, rows = round(u1 - u0) + 1, round(v1 - v0) + 1
    shrink = min(1.0, (most / (columns * rows)) ** 0.5)
    u = np.linspace(u0, u1, max(2, round(columns * shrink)) if columns > 1 else 1)
    v = np.linspace(v0, v1, max(2, round(rows * shrink)) if rows > 1 else 1)
    return np.stack(np.meshgrid(u, v), axis=-1)


def distorted_normalised(camera: Camera, pixels: AnyArray) -> AnyArray:
    """Normalised distorted coordinates (..., 2) of pixels (..., 2), in the precision of the input."""
    kind = pixels.dtype.type
    y = (pixels[..., 1] - kind(camera.cy_px)) / kind(camera.fy_px)
    x = (pixels[..., 0] - kind(camera.cx_px) - kind(camera.skew_px) * y) / kind(camera.fx_px)
    return np.stack([x, y], axis=-1)


def fold_radius(camera: Camera) -> tuple[float, float]:
    """Where the radial curve r L(r) stops rising: undistorted radius r and distorted radius r L(r).

    Normalised; infinite where it rises for ever or up to a pole of L. With L = N / D in rho = r^2 the
    slope vanishes where N D + 2 rho (N' D - N D') = 0. Beyond it two points share a pixel.
    """
    k1, k2, _, _, k3, k4, k5, k6 = camera.distortion
    N, D = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    rho = np.polynomial.Polynomial([0, 1])

    def first_root(polynomial: Any) -> float:
        roots = polynomial.trim().roots()
        real = roots[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))) & (roots.real > 0)].real
        return float(real.min()) if len(real) else np.inf

    fold = first_root(N * D + 2 * rho * (N.deriv() * D - N * D.deriv()))
    if not np.isfinite(fold) or first_root(D) < fold:
        return np.inf, np.inf
    radius = float(np.sqrt(fold))
    return radius, radius * float(N(fold) / D(fold))


def undistort_by_polynomial(inverse: InversePolynomial, distorted: AnyArray) -> AnyArray:
    """Normalised undistorted coordinates (..., 2) of distorted ones, in the precision of the input."""
    kind = distorted.dtype.type
    p1, p2, two = kind(inverse.p1), kind(inverse.p2), kind(2)
    xd, yd = distorted[..., 0], distorted[..., 1]
    x, y = _times_radial(inverse.radial, xd, yd)
    for _ in range(inverse.decentering_steps):
        r2, xy = x * x + y * y, two * x * y
        u = xd - (p1 * xy + p2 * (r2 + two * x * x))
        v = yd - (p1 * (r2 + two * y * y) + p2 * xy)
        x, y = _times_radial(inverse.radial, u, v)
    return np.stack([x, y], axis=-1)


def _times_radial(radial: tuple[float, ...], x: AnyArray, y: AnyArray) -> tuple[AnyArray, AnyArray]:
    rho = x * x + y * y
    P = np.zeros_like(rho)
    for coefficient in (*reversed(radial), 1.0):
        P = P * rho + rho.dtype.type(coefficient)
    return x * P, y * P


def exact_inverse(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Normalised undistorted coordinates (M, 2) by Newton's method, and which pixels have them (M,).

    Pixels that only a part of the curve beyond its fold could show count as having none.
    """
    ideal = undistort(camera, pixels)
    with np.errstate(invalid="ignore"):
        inside = np.linalg.norm(ideal, axis=1) < fold_radius(camera)[0]
    return ideal, np.asarray(np.isfinite(ideal).all(axis=1) & inside)


def fit_inverse(camera: Camera, tolerance_px: float = 0.01) -> InversePolynomial:
    """The shortest inverse polynomial within `tolerance_px` of the exact inverse, else the best found.

    Look at `good_enough`: where the lens model folds over inside the picture, or bends more than ten
    coefficients can follow, the tolerance is not reached and `max_error_px` says by how much.
    """
    width, height = camera.image_size_px
    pixels = pixel_grid(camera.image_size_px, (-0.5, -0.5, width - 0.5, height - 0.5)).reshape(-1, 2)
    ideal, seen = exact_inverse(camera, pixels)
    p1, p2 = float(camera.distortion[2]), float(camera.distortion[3])
    covered = float(np.mean(seen))
    best = InversePolynomial((), p1, p2, 0, np.inf, covered, tolerance_px)
    if not seen.any():
        return best
    ideal = ideal[seen]
    distorted = distorted_normalised(camera, pixels[seen].astype(np.float32))

    def checked(radial: tuple[float, ...], steps: int) -> InversePolynomial:
        trial = replace(best, radial=radial, decentering_steps=steps)
        error = (undistort_by_polynomial(trial, distorted) - ideal) @ camera.K[:2, :2].T
        return replace(trial, max_error_px=float(np.sqrt(np.max(np.sum(error**2, axis=1)))))

    most = _MOST_STEPS if p1 or p2 else 0
    largest = float(np.sqrt(np.max(np.sum(ideal**2, axis=1))))
    with np.errstate(over="ignore", invalid="ignore"):
        for count in range(_MOST_COEFFICIENTS + 1):
            trial = checked(_minimax(camera, largest, count), most)
            if trial.max_error_px < best.max_error_px:
                best = trial
            if best.max_error_px <= tolerance_px:
                break
        # Fewer steps where they do, and never more than help.
        goal = max(tolerance_px, 1.02 * best.max_error_px)
        for steps in range(most):
            trial = checked(best.radial, steps)
            if trial.max_error_px <= goal:
                return trial
    return best


def _minimax(camera: Camera, largest: float, count: int) -> tuple[float, ...]:
    """The c1, c2, ... with nearly the least largest error over undistorted radii up to `largest`."""
    r = np.linspace(0.0, largest, 40 * (count + 5))[1:]
    radial = camera.distortion.copy()
    radial[2:4] = 0.0
    w = distort(r, np.zeros_like(r), radial)[0]
    if count == 0 or not radial.any():
        return ()
    rho = w * w
    top = float(rho.max())
    powers = (rho[:, None] / top) ** np.arange(1, count + 1) * w[:, None]
    unit = 1.0 / np.sqrt(np.sum(powers**2, axis=0))
    weight = np.full(len(r), 1.0 / len(r))
    best, least = np.zeros(count), np.inf
    for _ in range(_REWEIGHTINGS):
        root = np.sqrt(weight)
        solution = unit * np.linalg.lstsq(powers * unit * root[:, None], (r - w) * root, rcond=None)[0]
        error = np.abs(powers @ solution - (r - w))
        if error.max() < least:
            best, least = solution, float(error.max())
        if least < 1e-12:
            break
        weight = weight * error
        weight = weight / weight.sum()
    return tuple(float(c) for c in best / top ** np.arange(1.0, count + 1))
