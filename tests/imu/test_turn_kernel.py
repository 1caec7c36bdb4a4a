"""The compiled integration turns directions as rotations of another library do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.imu.turn_kernel import turn_directions


def _turned(
    rates: np.ndarray, before: np.ndarray, starts: list[int], stops: list[int], h: float
) -> np.ndarray:
    out = np.empty((len(starts), 3))
    turn_directions(rates, np.eye(3), np.array(starts), np.array(stops), before, h, out)
    return out


def test_a_constant_rate_is_a_rotation_about_a_fixed_axis() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        w, v = rng.normal(size=3), rng.normal(size=3)
        rates = np.tile(w, (101, 1))
        found = _turned(rates, v[None], [0], [100], 0.01)
        assert found[0] == pytest.approx(Rotation.from_rotvec(w).inv().apply(v), abs=1e-9)


def test_several_turns_and_a_rate_that_changes() -> None:
    rng = np.random.default_rng(1)
    knots = rng.normal(size=(2, 3))
    t = np.linspace(0.0, 1.0, 201)
    rates = knots[0] + np.sin(2.0 * t)[:, None] * knots[1]
    # Many small turns with the rate in their middle, an integrator of another kind.
    fine = np.linspace(0.0, 1.0, 4_001)
    middle = 0.5 * (fine[1:] + fine[:-1])
    R = Rotation.identity()
    for row in (knots[0] + np.sin(2.0 * middle)[:, None] * knots[1]) * np.diff(fine)[:, None]:
        R = R * Rotation.from_rotvec(row)
    before = rng.normal(size=(2, 3))
    found = _turned(rates, before, [0, 50], [200, 50], 0.005)
    assert found[0] == pytest.approx(R.inv().apply(before[0]), abs=1e-5)
    assert found[1] == pytest.approx(before[1], abs=1e-15)


def test_lengths_and_angles_are_kept() -> None:
    rng = np.random.default_rng(2)
    rates = 5.0 * rng.normal(size=(500, 3))
    a, b = rng.normal(size=(1, 3)), rng.normal(size=(1, 3))
    u, v = _turned(rates, a, [0], [499], 0.01), _turned(rates, b, [0], [499], 0.01)
    assert float(u[0] @ v[0]) == pytest.approx(float(a[0] @ b[0]), abs=1e-12)
    assert float(u[0] @ u[0]) == pytest.approx(float(a[0] @ a[0]), rel=1e-12)
