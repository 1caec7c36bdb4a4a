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
from calib.camera.cornerfit import Frames, LocalFit, fit_corners, frames_of
from calib.camera.gridmodel import Prediction, predict

__all__ = ["Refined", "reduced_around", "refine", "square_px"]

_SQUARE_PX = 40.0
"""Squares of twice this size and more are averaged down to it."""
_FIRST_ITERATIONS = 4
_FIRST_REACH_PX = 8
_LARGEST_RESIDUAL = 0.4
"""RMS of a fit over the amplitude; clutter is above it."""
_LEAST_SHARE = 0.2
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
_LEAST_PICTURE_PX = 4

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
    residual : RMS of the fit over |amplitude|.
    refined : False where a corner could not be measured and its predicted place is given.
    misfit_px : typical distance of a corner from where the others place it.
    """

    points: FloatArray
    sigma_px: FloatArray
    amplitude: FloatArray
    residual: FloatArray
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


def reduced_around(gray: GrayImage, points: FloatArray) -> tuple[_Float32, FloatArray, int, FloatArray]:
    """The part of the picture around the grid, averaged over k x k pixels; the grid in it; k; its origin."""
    k = max(1, int(square_px(points) // _SQUARE_PX))
    height, width = gray.shape
    square = float(np.max(np.abs(np.gradient(points, axis=0)) + np.abs(np.gradient(points, axis=1))))
    low = np.floor((points.reshape(-1, 2).min(axis=0) - square) / k).astype(int) * k
    high = np.ceil(points.reshape(-1, 2).max(axis=0) + square).astype(int)
    u0, v0 = max(int(low[0]), 0), max(int(low[1]), 0)
    u1, v1 = min(int(high[0]), width), min(int(high[1]), height)
    part = gray[v0:v1, u0:u1]
    if k > 1:
        part = part[: part.shape[0] // k * k, : part.shape[1] // k * k]
        image = cv2.resize(
            part.astype(np.float32), (part.shape[1] // k, part.shape[0] // k), interpolation=cv2.INTER_AREA
        )
    else:
        image = part.astype(np.float32)
    origin = np.array([u0, v0], dtype=np.float64)
    return np.asarray(image), (points - origin - 0.5 * (k - 1)) / k, k, origin


def _colours(fit: LocalFit, shape: tuple[int, int]) -> FloatArray:
    """Amplitude (N,), positive where a corner has the colours that most corners give it."""
    j, i = np.indices(shape)
    signed = fit.amplitude * (1.0 - 2.0 * ((i + j) % 2)).ravel()
    return signed * (1.0 if np.sum(np.sign(signed)) >= 0 else -1.0)


def _sound(fit: LocalFit, shape: tuple[int, int]) -> BoolArray:
    """Which fits (N,) are of a corner with the right colours, converged or not yet."""
    amplitude = _colours(fit, shape)
    enough = amplitude > _LEAST_SHARE * np.median(np.abs(amplitude))
    return np.asarray(enough & (fit.residual < _LARGEST_RESIDUAL) & np.isfinite(fit.points[:, 0]))


def _trusted(fit: LocalFit, shape: tuple[int, int]) -> BoolArray:
    """Which fits (N,) are measurements."""
    return np.asarray(fit.converged & _sound(fit, shape))


def _merged(fit: LocalFit, again: LocalFit, where: IntArray, use: BoolArray) -> LocalFit:
    """`fit` with the corners `where` (indices) replaced by those of `again` that are to be used."""
    values = {}
    for name in LocalFit.__dataclass_fields__:
        merged = getattr(fit, name).copy()
        merged[where[use]] = getattr(again, name)[use]
        values[name] = merged
    return LocalFit(**values)


def _closer_looked(image: _Float32, fit: LocalFit, frames: Frames) -> LocalFit:
    """Fit with a smaller window the corners that something near them disturbs: a margin, a shadow, a hand."""
    typical = float(np.median(fit.residual))
    doubtful = np.flatnonzero((fit.residual > _DISTURBED * typical + 0.02) | ~fit.converged)
    if len(doubtful) == 0:
        return fit
    again = fit_corners(image, fit.points[doubtful], frames.take(doubtful), window=_CLOSE_WINDOW)
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


def _checked(fit: LocalFit, good: BoolArray, shape: tuple[int, int]) -> tuple[_Check, Prediction] | None:
    prediction = predict(fit.points.reshape(*shape, 2), good.reshape(shape))
    if prediction is None:
        return None
    placed = prediction.points.reshape(-1, 2)
    frames = frames_of(np.where(good[:, None], fit.points, placed).reshape(*shape, 2))
    square = np.minimum(np.linalg.norm(frames.along, axis=1), np.linalg.norm(frames.across, axis=1))
    away = np.linalg.norm(fit.points - placed, axis=1)
    far = _FAR * square
    bound = np.minimum(np.maximum(prediction.limit_px.ravel(), _SIGMAS * fit.sigma_px), far)
    return _Check(placed, away, bound, far, frames), prediction


def _rescued(image: _Float32, fit: LocalFit, shape: tuple[int, int]) -> tuple[LocalFit, BoolArray, Prediction] | None:
    """Fit again, from where the others place them, the corners that failed or disagree with the others."""
    good = _trusted(fit, shape)
    for window in _RESCUE_WINDOWS:
        checked = _checked(fit, good, shape)
        if checked is None:
            return None
        check, prediction = checked
        doubtful = np.flatnonzero(~good | ~(check.away < check.bound))
        if len(doubtful) == 0:
            return fit, good, prediction
        again = fit_corners(image, check.placed[doubtful], check.frames.take(doubtful), window=window)
        trial = _merged(fit, again, doubtful, np.ones(len(doubtful), dtype=np.bool_))
        near = np.linalg.norm(again.points - check.placed[doubtful], axis=1)
        use = _trusted(trial, shape)[doubtful] & (~good[doubtful] | (near < 0.7 * check.away[doubtful]))
        fit = _merged(fit, again, doubtful, use)
        good[doubtful[use]] = True
    checked = _checked(fit, good, shape)
    if checked is None:
        return None
    check = checked[0]
    # A clean fit may contradict the others: neither board nor lens need be smooth. A disturbed one may not.
    clean = fit.residual < _DISTURBED * np.median(fit.residual) + 0.02
    good &= check.away < np.where(clean, check.far, check.bound)
    prediction = predict(fit.points.reshape(*shape, 2), good.reshape(shape))
    return None if prediction is None else (fit, good, prediction)


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
    shape = (points.shape[0], points.shape[1])
    image, start, k, origin = reduced_around(gray, points)
    if min(image.shape) < 2 * _LEAST_PICTURE_PX:
        return None
    first = fit_corners(image, start.reshape(-1, 2), frames_of(start), _FIRST_ITERATIONS, _FIRST_REACH_PX)
    # A misplaced corner would spoil the curvatures of its row and column.
    sound = _sound(first, shape)
    rough = predict(first.points.reshape(start.shape), sound.reshape(shape))
    if rough is None:
        return None
    away = np.linalg.norm(first.points - rough.points.reshape(-1, 2), axis=1)
    stays = sound & (away < rough.limit_px.ravel())
    moved = np.where(stays[:, None], first.points, rough.points.reshape(-1, 2)).reshape(start.shape)
    for _ in range(_PASSES):
        fit = fit_corners(image, moved.reshape(-1, 2), frames_of(moved))
        before, moved = moved, np.where(_sound(fit, shape)[:, None], fit.points, moved.reshape(-1, 2)).reshape(
            start.shape
        )
        if np.max(np.abs(moved - before)) < _STEADY_PX:
            break
    fit = _closer_looked(image, fit, frames_of(moved))
    rescued = _rescued(image, fit, shape)
    if rescued is None:
        return None
    fit, good, prediction = rescued
    placed = prediction.points.reshape(-1, 2)
    unknown = _UNKNOWN_SIGMA * square_px(prediction.points)
    found = np.where(good[:, None], fit.points, placed).reshape(*shape, 2)
    return Refined(
        points=found * k + 0.5 * (k - 1) + origin,
        sigma_px=k * np.where(good, fit.sigma_px, unknown).reshape(shape),
        amplitude=fit.amplitude.reshape(shape),
        residual=fit.residual.reshape(shape),
        refined=good.reshape(shape),
        misfit_px=k * prediction.spread_px,
    )
