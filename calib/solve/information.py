"""Groups of unknowns that can hardly be told from each other."""

from __future__ import annotations

import numpy as np

from calib.core.arrays import FloatArray


def tied_groups(correlation: FloatArray, limit: float) -> list[list[int]]:
    """Groups of two or more unknowns whose correlations (n, n) go beyond a limit, directly or by others."""
    tied = np.abs(correlation) > limit
    reached = np.linalg.matrix_power(tied.astype(np.float64), len(tied)) > 0.0
    groups = sorted({tuple(np.flatnonzero(row).tolist()) for row in reached})
    return [list(group) for group in groups if len(group) > 1]
