"""What an information matrix says of its unknowns: their covariance, and which are hardly told apart."""

from __future__ import annotations

import numpy as np

from calib.core.arrays import FloatArray


def scaled_inverse(S: FloatArray, floor: float = 1e-13) -> FloatArray:
    """Pseudo-inverse of symmetric matrices (..., G, G) after scaling their diagonals to one.

    Directions that hold less than `floor` of the scaled information are left out.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 1e-300))
    values, vectors = np.linalg.eigh(S * scale[..., :, None] * scale[..., None, :])
    kept = values > floor * np.maximum(values[..., -1:], 1e-300)
    inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    middle = (vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(middle * scale[..., :, None] * scale[..., None, :])


def tied_groups(correlation: FloatArray, limit: float) -> list[list[int]]:
    """Groups of two or more unknowns whose correlations (n, n) go beyond a limit, directly or by others."""
    tied = np.abs(correlation) > limit
    reached = np.linalg.matrix_power(tied.astype(np.float64), len(tied)) > 0.0
    groups = sorted({tuple(np.flatnonzero(row).tolist()) for row in reached})
    return [list(group) for group in groups if len(group) > 1]
