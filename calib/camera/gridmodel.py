"""Where the other corners say that a corner is: a homography seen through a smooth lens.

A pixel at the distance r from the picture's centre, in half diagonals, is moved to r / (1 + lambda r^2)
(Fitzgibbon 2001), which straightens most of what a wide lens bends. There the corners are a homography
of the board plus what a polynomial of low degree over the board says, fitted robustly (Geman and
McClure's weights). Each corner is compared with what the fit without it would say: e_i / (1 - h_i),
where h_i is the corner's leverage. lambda and the degree are those whose predictions are best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import BoolArray, FloatArray

__all__ = ["Lens", "Prediction", "predict"]

_DEGREES = (1, 2, 3, 5)
_FREEDOM = 1.6
"""Corners for each coefficient that a degree must have."""
_ROUNDS = 4
_LAMBDAS = np.array([-0.9, -0.7, -0.5, -0.35, -0.22, -0.12, -0.05, 0.0, 0.05, 0.12])
_LIMIT = 6.0
_LEAST_SPREAD_PX = 0.02


@dataclass(frozen=True)
class Lens:
    """Centre (2,) and half diagonal of the picture, pixels."""

    centre: FloatArray
    radius_px: float

    def straightened(self, points: FloatArray, strength: FloatArray | float) -> FloatArray:
        """Points (..., 2) without the distortion of strength lambda."""
        d = (points - self.centre) / self.radius_px
        r2 = np.sum(d * d, axis=-1, keepdims=True)
        return np.asarray(d / np.maximum(1.0 + strength * r2, 0.05))

    def bent(self, straight: FloatArray, strength: float) -> FloatArray:
        """The inverse of `straightened`."""
        r2 = np.sum(straight * straight, axis=-1, keepdims=True)
        root = np.sqrt(np.maximum(1.0 - 4.0 * strength * r2, 0.0))
        return np.asarray(straight * (2.0 / (1.0 + root)) * self.radius_px + self.centre)


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


def _homographies(board: FloatArray, targets: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted direct linear transforms of board (N, 2) in [-1, 1] to L targets (L, N, 2), mapped."""
    total = weights.sum()
    centre = (weights[:, None] * targets).sum(axis=1, keepdims=True) / total
    square = np.sum((targets - centre) ** 2, axis=2)
    scale = np.sqrt((weights * square).sum(axis=1) / total)[:, None, None] + 1e-12
    x = (targets - centre) / scale
    X = np.column_stack([board, np.ones(len(board))])
    rows = np.zeros((len(targets), 2, len(X), 9))
    root = np.sqrt(weights)[:, None]
    rows[:, 0, :, :3], rows[:, 1, :, 3:6] = root * X, root * X
    rows[:, 0, :, 6:], rows[:, 1, :, 6:] = -root * x[..., :1] * X, -root * x[..., 1:] * X
    system = rows.reshape(len(targets), -1, 9)
    H = np.linalg.eigh(system.transpose(0, 2, 1) @ system)[1][:, :, 0].reshape(-1, 3, 3)
    mapped = X @ H.transpose(0, 2, 1)
    depth = np.where(np.abs(mapped[..., 2:]) < 1e-9, 1e-9, mapped[..., 2:])
    return np.asarray(mapped[..., :2] / depth * scale + centre)


def _strength(board: FloatArray, pixels: FloatArray, used: BoolArray, lens: Lens) -> float:
    """The lambda under which the corners are nearest to a homography, robustly."""
    straight = lens.straightened(pixels[None], _LAMBDAS[:, None, None])
    mapped = _homographies(board, straight, used.astype(np.float64))
    # What a straightened distance is worth in pixels differs from lambda to lambda.
    back = np.stack([lens.bent(m, s) for m, s in zip(mapped, _LAMBDAS, strict=True)])
    error = np.mean(np.linalg.norm(back - pixels, axis=2)[:, used], axis=1)
    k = int(np.argmin(error))
    none = int(np.argmin(np.abs(_LAMBDAS)))
    if error[k] > 0.9 * error[none]:
        return 0.0
    if not 0 < k < len(_LAMBDAS) - 1:
        return float(_LAMBDAS[k])
    a, b, _ = np.polyfit(_LAMBDAS[k - 1 : k + 2], error[k - 1 : k + 2], 2)
    return float(np.clip(-b / (2.0 * a), _LAMBDAS[k - 1], _LAMBDAS[k + 1])) if a > 0 else float(_LAMBDAS[k])


def _basis(board: FloatArray, degree: int, columns: int, rows: int) -> FloatArray:
    x, y = board.T
    terms = [
        x**p * y**q
        for p in range(degree + 1)
        for q in range(degree + 1 - p)
        if p < max(columns - 1, 2) and q < max(rows - 1, 2)
    ]
    return np.stack(terms, axis=1)


def _median(values: FloatArray) -> float:
    """Median of (n,) values; NumPy's own takes five times as long for so few."""
    n = len(values)
    low, high = np.partition(values, ((n - 1) // 2, n // 2))[[(n - 1) // 2, n // 2]]
    return 0.5 * float(low + high)


def _weights(error: FloatArray, used: BoolArray, least: float) -> FloatArray:
    """Geman and McClure's weights with the median of the errors for a scale."""
    scale = max(3.0 * _median(error[used]), least)
    return used / (1.0 + (error / scale) ** 2) ** 2


def predict(points: FloatArray, known: BoolArray, lens: Lens | None = None) -> Prediction | None:
    """Predict every corner of a grid from the others.

    Parameters
    ----------
    points : (rows, columns, 2) pixels.
    known : (rows, columns) which points to go by; at least six, or None is returned.
    lens : where the picture's centre is; without it lambda is 0.
    """
    rows, columns = known.shape
    j, i = np.mgrid[0:rows, 0:columns]
    grid = np.stack([2.0 * i / max(columns - 1, 1) - 1.0, 2.0 * j / max(rows - 1, 1) - 1.0], axis=2)
    board, used = grid.reshape(-1, 2), known.ravel()
    if int(used.sum()) < 6:
        return None
    pixels = np.where(used[:, None], points.reshape(-1, 2), 0.0)
    strength = 0.0
    if lens is None:
        lens = Lens(np.mean(pixels[used], axis=0), float(np.ptp(pixels[used])) + 1.0)
    else:
        strength = _strength(board, pixels, used, lens)
    fit = _Fit(board, pixels, used, lens, strength, (rows, columns))
    weights, plane = fit.homography()
    best: Prediction | None = None
    for degree in _DEGREES:
        basis = _basis(board, degree, columns, rows)
        if degree > 1 and used.sum() < _FREEDOM * basis.shape[1]:
            break
        candidate = fit.with_basis(basis, weights, plane)
        if best is None or candidate.spread_px < best.spread_px:
            best = candidate
    return best


@dataclass(frozen=True)
class _Fit:
    """Corners to fit: board (N, 2), pixels (N, 2), which are used (N,), and the lens of strength lambda."""

    board: FloatArray
    pixels: FloatArray
    used: BoolArray
    lens: Lens
    strength: float
    shape: tuple[int, int]

    def _apart(self, straight: FloatArray) -> FloatArray:
        u, v = (self.pixels - self.lens.bent(straight, self.strength)).T
        return np.asarray(np.hypot(u, v))

    def homography(self) -> tuple[FloatArray, FloatArray]:
        """Robust weights (N,) and mapped corners (N, 2), straightened."""
        target = self.lens.straightened(self.pixels, self.strength)[None]
        weights = self.used.astype(np.float64)
        plane = _homographies(self.board, target, weights)[0]
        for _ in range(_ROUNDS - 1):
            # Distortion that is left is no reason to distrust a corner; only large errors count here.
            weights = _weights(self._apart(plane), self.used, 1.0)
            plane = _homographies(self.board, target, weights)[0]
        return weights, plane

    def with_basis(self, basis: FloatArray, weights: FloatArray, plane: FloatArray) -> Prediction:
        """Fit the displacement from the homography by `basis` (N, P), robustly."""
        target = self.lens.straightened(self.pixels, self.strength)
        for _ in range(_ROUNDS):
            weighted = basis * weights[:, None]
            inverse = np.linalg.inv(weighted.T @ basis + 1e-9 * np.eye(basis.shape[1]))
            smooth = plane + basis @ (inverse @ (weighted.T @ (target - plane)))
            power = np.sum((basis @ inverse) * basis, axis=1)
            leverage = np.clip(weights * power, 0.0, 0.95)
            apart = self._apart(smooth)
            before, weights = weights, _weights(apart / np.sqrt(1.0 - leverage), self.used, 1e-3)
            if np.max(np.abs(weights - before)) < 0.05:
                break
        without = target - (target - smooth) / (1.0 - leverage)[:, None]
        points = self.lens.bent(np.where(self.used[:, None], without, smooth), self.strength)
        spread = _median((apart / (1.0 - leverage))[self.used])
        # A prediction is as uncertain as the corners, and as its leverage makes it.
        limit = _LIMIT * max(spread, _LEAST_SPREAD_PX) * np.sqrt(1.0 + np.minimum(power, 8.0))
        return Prediction(points.reshape(*self.shape, 2), spread, limit.reshape(self.shape))
