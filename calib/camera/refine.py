"""Sub-pixel refinement of a grid of corners.

Each corner is fitted on its own (`cornerfit`). Then the corners check each other (`gridmodel`): one that
did not converge, has the wrong colours or disagrees with the others is fitted again from where the
others place it. A corner that still fails is not a measurement: it is reported at its predicted place,
with a large sigma and `refined` false, and never at the place where the search began.

Where squares are large the picture is averaged over blocks of k x k pixels first: the window then
covers the same share of the square, and averaging loses nothing that the blur has not lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from calib.arrays import BoolArray, FloatArray, GrayImage, IntArray
from calib.camera.cornerfit import WINDOW, Frames, LocalFit, fit_corners, frames_of
from calib.camera.gridmodel import Lens, Prediction, predict
from calib.camera.lattice import extrapolated

__all__ = ["Part", "Refined", "misshape", "part_around", "refine", "square_px"]

_SQUARE_PX = 40.0
"""Squares of twice this size and more are averaged down to it."""
_FIRST_ITERATIONS = 4
_FIRST_REACH_PX = 8
_LARGEST_RESIDUAL = 0.4
"""RMS of a fit over the amplitude; clutter is above it."""
_LEAST_SHARE = 0.1
"""Least amplitude of a corner over the picture's median."""
_FAR = 0.2
"""Share of a square that no corner may be away from its prediction."""
_UNKNOWN_SIGMA = 0.25
"""Sigma of a corner that was not refined, in squares."""
_RESCUE_WINDOWS = (0.45, 0.28, 0.2)
_SIGMAS = 6.0
_PASSES = 3
_CLOSE_WINDOW = 0.28
_DISTURBED = 1.5
_STEADY_PX = 0.1
"""Corners that moved farther are fitted again, with the curvatures of where they are now."""
_LEAST_PICTURE_PX = 8

_Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Refined:
    """A refined grid; arrays are (rows, columns) and `points` has two pixel coordinates more.

    Attributes
    ----------
    points : pixels.
    sigma_px : standard deviation of one coordinate of a corner, from the residuals of its fit.
    amplitude : half the step from dark to bright, positive where the square between growing column
        and growing row is bright, grey levels.
    residual : RMS of the fit over |amplitude|, without the share of the noise.
    narrow : whether a corner had to be fitted with a smaller window than usual.
    refined : False where a corner could not be measured and its predicted place is given.
    misfit_px : typical distance of a corner from where the others place it.
    """

    points: FloatArray
    sigma_px: FloatArray
    amplitude: FloatArray
    residual: FloatArray
    narrow: BoolArray
    refined: BoolArray
    misfit_px: float

    @property
    def sign(self) -> int:
        """+1 where the square between growing column and row of corner (0, 0) is bright, else -1."""
        i, j = np.indices(self.amplitude.shape)
        return 1 if np.sum(np.sign(self.amplitude) * (1 - 2 * ((i + j) % 2))) >= 0 else -1


def square_px(points: FloatArray) -> float:
    """Median length of the sides of the squares."""
    along = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    across = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return float(np.median(np.concatenate([along.ravel(), across.ravel()])))


@dataclass(frozen=True)
class Part:
    """The part of a picture around a grid, averaged over k x k pixels.

    Attributes
    ----------
    image : grey levels.
    points : the grid in it, (rows, columns, 2) of its pixels.
    k, origin : a pixel (x, y) of the part is at k (x, y) + (k - 1) / 2 + origin in the picture.
    lens : the centre and half diagonal of the picture, in pixels of the part.
    noise : standard deviation of the noise, grey levels.
    """

    image: _Float32
    points: FloatArray
    k: int
    origin: FloatArray
    lens: Lens
    noise: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.points.shape[0], self.points.shape[1]

    def to_picture(self, points: FloatArray) -> FloatArray:
        """Pixels of the picture from pixels of the part."""
        return np.asarray(points * self.k + 0.5 * (self.k - 1) + self.origin)


def _noise(image: _Float32) -> float:
    """Standard deviation of the noise, from the median of a mask that is blind to edges (Immerkaer 1996)."""
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    return float(np.median(np.abs(cv2.filter2D(image, cv2.CV_32F, mask)[1:-1, 1:-1])) / (6.0 * 0.6745))


def part_around(gray: GrayImage, points: FloatArray) -> Part | None:
    """The part of a picture that holds a grid (rows, columns, 2); None when that is next to nothing."""
    k = max(1, int(square_px(points) // _SQUARE_PX))
    height, width = gray.shape
    square = float(np.max(np.abs(np.gradient(points, axis=0)) + np.abs(np.gradient(points, axis=1))))
    low = np.floor((points.reshape(-1, 2).min(axis=0) - square) / k).astype(int) * k
    high = np.ceil(points.reshape(-1, 2).max(axis=0) + square).astype(int)
    u0, v0 = max(int(low[0]), 0), max(int(low[1]), 0)
    columns, rows = (min(int(high[0]), width) - u0) // k, (min(int(high[1]), height) - v0) // k
    if min(columns, rows) < _LEAST_PICTURE_PX:
        return None
    image = gray[v0 : v0 + rows * k, u0 : u0 + columns * k].astype(np.float32)
    if k > 1:
        image = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA))
    origin = np.array([u0, v0], dtype=np.float64)
    shift = origin + 0.5 * (k - 1)
    lens = Lens(
        (0.5 * np.array([width - 1, height - 1]) - shift) / k, 0.5 * float(np.hypot(width, height)) / k
    )
    return Part(image, (points - shift) / k, k, origin, lens, _noise(image))


def _colours(fit: LocalFit, shape: tuple[int, int]) -> FloatArray:
    """Amplitude (N,), positive where a corner has the colours that most corners give it."""
    j, i = np.indices(shape)
    signed = fit.amplitude * (1.0 - 2.0 * ((i + j) % 2)).ravel()
    return signed * (1.0 if np.sum(np.sign(signed)) >= 0 else -1.0)


def misshape(fit: LocalFit, noise: float) -> FloatArray:
    """What of the residuals (N,) of fits noise does not explain, over the amplitude."""
    share = noise / np.maximum(np.abs(fit.amplitude), 1e-9)
    return np.sqrt(np.maximum(fit.residual**2 - share**2, 0.0))


def _sound(part: Part, fit: LocalFit) -> BoolArray:
    """Which fits (N,) are of a corner with the right colours, converged or not yet."""
    amplitude = _colours(fit, part.shape)
    enough = amplitude > np.maximum(_LEAST_SHARE * np.median(np.abs(amplitude)), part.noise)
    shaped = misshape(fit, part.noise) < _LARGEST_RESIDUAL
    return np.asarray(enough & shaped & np.isfinite(fit.points[:, 0]))


def _trusted(part: Part, fit: LocalFit) -> BoolArray:
    """Which fits (N,) are measurements."""
    return np.asarray(fit.converged & _sound(part, fit))


def _merged(fit: LocalFit, again: LocalFit, where: IntArray, use: BoolArray) -> LocalFit:
    """`fit` with the corners `where` (indices) replaced by those of `again` that are to be used."""
    values = {}
    for name in LocalFit.__dataclass_fields__:
        merged = getattr(fit, name).copy()
        merged[where[use]] = getattr(again, name)[use]
        values[name] = merged
    return LocalFit(**values)


def _closer_looked(part: Part, fit: LocalFit, frames: Frames) -> LocalFit:
    """Fit with a smaller window the corners that something near them disturbs: a margin, a shadow, a hand."""
    typical = float(np.median(fit.residual))
    doubtful = np.flatnonzero((fit.residual > _DISTURBED * typical + 0.02) | ~fit.converged)
    if len(doubtful) == 0:
        return fit
    again = fit_corners(part.image, fit.points[doubtful], frames.take(doubtful), window=_CLOSE_WINDOW)
    use = again.converged & (again.residual < np.where(fit.converged, 0.7 * fit.residual, np.inf)[doubtful])
    return _merged(fit, again, doubtful, use)


@dataclass(frozen=True)
class _Check:
    """What the other corners say of each of N fits.

    Its place, the distance to it, the distance that is doubtful and the distance that is out of the
    question.
    """

    placed: FloatArray
    away: FloatArray
    bound: FloatArray
    far: FloatArray
    frames: Frames


def _checked(part: Part, fit: LocalFit, good: BoolArray) -> tuple[_Check, Prediction] | None:
    prediction = predict(fit.points.reshape(*part.shape, 2), good.reshape(part.shape), part.lens)
    if prediction is None:
        return None
    placed = prediction.points.reshape(-1, 2)
    frames = frames_of(np.where(good[:, None], fit.points, placed).reshape(*part.shape, 2))
    square = np.minimum(np.linalg.norm(frames.along, axis=1), np.linalg.norm(frames.across, axis=1))
    away = np.linalg.norm(fit.points - placed, axis=1)
    far = _FAR * square
    bound = np.minimum(np.maximum(prediction.limit_px.ravel(), _SIGMAS * fit.sigma_px), far)
    return _Check(placed, away, bound, far, frames), prediction


def _rescued(part: Part, fit: LocalFit) -> tuple[LocalFit, BoolArray, Prediction] | None:
    """Fit again, from where the others place them, the corners that failed or disagree with the others."""
    good = _trusted(part, fit)
    for window in _RESCUE_WINDOWS:
        checked = _checked(part, fit, good)
        if checked is None:
            return None
        check, prediction = checked
        doubtful = np.flatnonzero(~good | ~(check.away < check.bound))
        if len(doubtful) == 0:
            return fit, good, prediction
        again = fit_corners(part.image, check.placed[doubtful], check.frames.take(doubtful), window=window)
        trial = _merged(fit, again, doubtful, np.ones(len(doubtful), dtype=np.bool_))
        near = np.linalg.norm(again.points - check.placed[doubtful], axis=1)
        use = _trusted(part, trial)[doubtful] & (~good[doubtful] | (near < 0.7 * check.away[doubtful]))
        fit = _merged(fit, again, doubtful, use)
        good[doubtful[use]] = True
    checked = _checked(part, fit, good)
    if checked is None:
        return None
    check = checked[0]
    # A clean fit may contradict the others: neither board nor lens need be smooth. A disturbed one may not.
    clean = fit.residual < _DISTURBED * np.median(fit.residual) + 0.02
    beside = extrapolated(fit.points.reshape(*part.shape, 2))[1:-1, 1:-1].reshape(-1, 2)
    nearest = np.fmin(check.away, np.linalg.norm(fit.points - beside, axis=1))
    good &= np.where(clean, nearest < check.far, check.away < check.bound)
    last = predict(fit.points.reshape(*part.shape, 2), good.reshape(part.shape), part.lens)
    return None if last is None else (fit, good, last)


def refine(gray: GrayImage, points: FloatArray) -> Refined | None:
    """Refine a grid of corners to a small fraction of a pixel.

    Parameters
    ----------
    gray : (H, W) grey levels.
    points : (rows, columns, 2) pixels, off by less than a third of a square, at least 3 x 3.

    Returns
    -------
    None where fewer than six corners could be fitted.
    """
    part = part_around(gray, points)
    if part is None:
        return None
    shape, start = part.shape, part.points
    first = fit_corners(
        part.image, start.reshape(-1, 2), frames_of(start), _FIRST_ITERATIONS, _FIRST_REACH_PX
    )
    # A misplaced corner would spoil the curvatures of its row and column.
    sound = _sound(part, first)
    rough = predict(first.points.reshape(start.shape), sound.reshape(shape), part.lens)
    if rough is None:
        return None
    away = np.linalg.norm(first.points - rough.points.reshape(-1, 2), axis=1)
    stays = sound & (away < rough.limit_px.ravel())
    moved = np.where(stays[:, None], first.points, rough.points.reshape(-1, 2)).reshape(start.shape)
    fit = first
    for _ in range(_PASSES):
        fit = fit_corners(part.image, moved.reshape(-1, 2), frames_of(moved), warm=fit)
        before, moved = (
            moved,
            np.where(_sound(part, fit)[:, None], fit.points, moved.reshape(-1, 2)).reshape(start.shape),
        )
        if np.max(np.abs(moved - before)) < _STEADY_PX:
            break
    fit = _closer_looked(part, fit, frames_of(moved))
    rescued = _rescued(part, fit)
    if rescued is None:
        return None
    fit, good, prediction = rescued
    placed = prediction.points.reshape(-1, 2)
    unknown = _UNKNOWN_SIGMA * square_px(prediction.points)
    found = np.where(good[:, None], fit.points, placed).reshape(*shape, 2)
    return Refined(
        points=part.to_picture(found),
        sigma_px=part.k * np.where(good, fit.sigma_px, unknown).reshape(shape),
        amplitude=fit.amplitude.reshape(shape),
        residual=misshape(fit, part.noise).reshape(shape),
        narrow=(fit.window < WINDOW).reshape(shape),
        refined=good.reshape(shape),
        misfit_px=part.k * prediction.spread_px,
    )
