"""Where the other corners say that a corner is: a homography and a polynomial over the board.

A plane seen through a lens is a homography followed by a smooth displacement; over the board that
is a polynomial of low degree. It is fitted robustly (Geman and McClure's weights), and each corner is
compared with what the fit without it would say: e_i / (1 - h_i), where h_i is the corner's leverage.
The degree is the one whose predictions are best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray

__all__ = ["Prediction", "predict"]

_DEGREES = (1, 2, 3, 5)
_FREEDOM = 1.6
"""Corners for each coefficient that a degree must have."""
_ROUNDS = 4


@dataclass(frozen=True)
class Prediction:
    """Corners as their neighbours place them.

    Attributes
    ----------
    points : (rows, columns, 2) pixels, each from all corners but itself.
    spread_px : typical distance of a corner from its prediction, robust.
    limit_px : (rows, columns) distance beyond which a corner disagrees with the others.
    """

    points: FloatArray
    spread_px: float
    limit_px: FloatArray


def _homography(board: FloatArray, pixels: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted direct linear transform; `board` lies in [-1, 1]."""
    total = weights.sum()
    centre = (weights[:, None] * pixels).sum(axis=0) / total
    scale = np.sqrt((weights * np.sum((pixels - centre) ** 2, axis=1)).sum() / total) + 1e-9
    x = (pixels - centre) / scale
    X = np.column_stack([board, np.ones(len(board))])
    system = np.zeros((2 * len(X), 9))
    root = np.sqrt(weights)[:, None]
    system[0::2, :3], system[0::2, 6:] = root * X, -root * x[:, :1] * X
    system[1::2, 3:6], system[1::2, 6:] = root * X, -root * x[:, 1:] * X
    H = np.linalg.eigh(system.T @ system)[1][:, 0].reshape(3, 3)
    mapped = X @ H.T
    depth = np.where(np.abs(mapped[:, 2:]) < 1e-9, 1e-9, mapped[:, 2:])
    return np.asarray(mapped[:, :2] / depth * scale + centre)


def _basis(board: FloatArray, degree: int, columns: int, rows: int) -> FloatArray:
    x, y = board.T
    terms = [
        x**p * y**q
        for p in range(degree + 1)
        for q in range(degree + 1 - p)
        if p < max(columns - 1, 2) and q < max(rows - 1, 2)
    ]
    return np.stack(terms, axis=1)


def predict(points: FloatArray, known: BoolArray) -> Prediction | None:
    """Predict every corner of a grid from the others.

    Parameters
    ----------
    points : (rows, columns, 2) pixels.
    known : (rows, columns) which points to go by; at least six, or None is returned.
    """
    rows, columns = known.shape
    j, i = np.mgrid[0:rows, 0:columns]
    board = np.stack([2.0 * i / max(columns - 1, 1) - 1.0, 2.0 * j / max(rows - 1, 1) - 1.0], axis=2)
    flat, pixels, used = board.reshape(-1, 2), points.reshape(-1, 2), known.ravel()
    if int(used.sum()) < 6:
        return None
    pixels = np.where(used[:, None], pixels, 0.0)
    weights, plane = _robust_homography(flat, pixels, used)
    best: Prediction | None = None
    for degree in _DEGREES:
        basis = _basis(flat, degree, columns, rows)
        if degree > 1 and used.sum() < _FREEDOM * basis.shape[1]:
            break
        candidate = _fitted(pixels, used, weights, plane, basis, (rows, columns))
        if candidate is not None and (best is None or candidate.spread_px < best.spread_px):
            best = candidate
    return best


def _weights(error: FloatArray, used: BoolArray, least: float) -> FloatArray:
    """Geman and McClure's weights with the median of the errors for a scale."""
    scale = max(3.0 * float(np.median(error[used])), least)
    return used / (1.0 + (error / scale) ** 2) ** 2


def _robust_homography(board: FloatArray, pixels: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Weights (N,) and mapped corners (N, 2)."""
    weights = used.astype(np.float64)
    plane = _homography(board, pixels, weights)
    for _ in range(_ROUNDS):
        # Distortion is no reason to distrust a corner; only large errors count here.
        weights = _weights(np.linalg.norm(pixels - plane, axis=1), used, 1.0)
        plane = _homography(board, pixels, weights)
    return weights, plane


def _fitted(
    pixels: FloatArray,
    used: BoolArray,
    weights: FloatArray,
    plane: FloatArray,
    basis: FloatArray,
    shape: tuple[int, int],
) -> Prediction | None:
    """Fit the displacement from the homography, `basis` (N, P), robustly."""
    terms = basis.shape[1]
    for _ in range(_ROUNDS):
        weighted = basis * weights[:, None]
        inverse = np.linalg.inv(weighted.T @ basis + 1e-9 * np.eye(terms))
        smooth = plane + basis @ (inverse @ (weighted.T @ (pixels - plane)))
        power = np.einsum("np,pq,nq->n", basis, inverse, basis)
        leverage = np.clip(weights * power, 0.0, 0.95)
        apart = np.linalg.norm(pixels - smooth, axis=1)
        before, weights = weights, _weights(apart / np.sqrt(1.0 - leverage), used, 1e-3)
        if np.max(np.abs(weights - before)) < 0.05:
            break
    without = np.where(used[:, None], pixels - (pixels - smooth) / (1.0 - leverage)[:, None], smooth)
    spread = float(np.median((apart / (1.0 - leverage))[used]))
    # A prediction is as uncertain as the corners, and as its leverage makes it.
    limit = 6.0 * max(spread, 0.02) * np.sqrt(1.0 + np.minimum(power, 8.0))
    return Prediction(without.reshape(*shape, 2), spread, limit.reshape(shape))
