"""The decorator: same numbers as Python, and arrays that are still there afterwards."""

from __future__ import annotations

import sys

import numpy as np

from calib.arrays import FloatArray
from calib.estimator.compiled import compiled


@compiled(contract=True)
def _scale(values: FloatArray, factor: float) -> float:
    total = 0.0
    for k in range(len(values)):
        values[k] *= factor
        total += values[k]
    return total


def test_arrays_are_changed_in_place_and_kept_alive_by_their_owner_alone() -> None:
    values = np.arange(4.0)
    _scale(values, 1.0)
    before = sys.getrefcount(values)
    for _ in range(100):
        assert _scale(values, 1.0) == 6.0
    assert sys.getrefcount(values) == before
    assert _scale(values, 0.5) == 3.0
    np.testing.assert_array_equal(values, [0.0, 0.5, 1.0, 1.5])
