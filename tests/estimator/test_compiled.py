"""The decorator: same numbers as Python, and arrays that are still there afterwards."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from types import ModuleType

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import calib.actuator
import calib.estimator
from calib.arrays import FloatArray
from calib.estimator.compiled import compiled


@compiled()
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


@pytest.mark.parametrize("package", [calib.estimator, calib.actuator])
def test_no_function_may_round_as_its_compilation_happens_to_be(package: ModuleType) -> None:
    """States are the same bytes whether functions were compiled here, elsewhere or in another order."""
    found = []
    for info in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(info.name)
        found += [one for one in vars(module).values() if isinstance(one, Dispatcher)]
    assert len(found) > 5
    assert not [one.__name__ for one in found if one.targetoptions.get("fastmath")]
