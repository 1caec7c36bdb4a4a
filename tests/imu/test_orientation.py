"""Errors between orientations against an independent tool, and what they do not depend on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import BadInputError
from calib.imu.orientation import (
    conjugate,
    heading_error,
    inclination_error,
    product,
    rms_in_motion,
    total_error,
    up_in_sensor,
)


def _wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(np.atleast_2d(rotation.as_quat()), 1, axis=1)


def _some(count: int = 200, seed: int = 0) -> tuple[Rotation, np.ndarray]:
    rotation = Rotation.random(count, random_state=np.random.default_rng(seed))
    return rotation, _wxyz(rotation)


def test_product_and_up_vector_against_scipy() -> None:
    one, p = _some()
    other, q = _some(seed=1)
    found, expected = product(p, q), _wxyz(one * other)
    assert np.allclose(np.abs((found * expected).sum(axis=1)), 1.0, atol=1e-14)
    assert np.allclose(product(p, conjugate(p)), [1.0, 0.0, 0.0, 0.0], atol=1e-14)
    assert np.allclose(up_in_sensor(p), one.inv().apply([0.0, 0.0, 1.0]), atol=1e-14)


def test_inclination_is_the_angle_between_the_up_vectors() -> None:
    _, p = _some()
    _, q = _some(seed=1)
    between = np.arccos(np.clip((up_in_sensor(p) * up_in_sensor(p)).sum(axis=1), -1.0, 1.0))
    assert between.max() < 1e-6
    # Both up vectors are seen in the world by turning the true one's sensor axes there.
    one, other = (Rotation.from_quat(np.roll(x, -1, axis=1)) for x in (p, q))
    up = (other * one.inv()).apply([0.0, 0.0, 1.0])
    assert np.allclose(inclination_error(p, q), np.arccos(np.clip(up[:, 2], -1.0, 1.0)), atol=1e-7)
    assert np.allclose(total_error(p, q), (one.inv() * other).magnitude(), atol=1e-7)


def test_a_turn_about_the_vertical_is_heading_and_nothing_else() -> None:
    rotation, q = _some()
    angle = np.linspace(-3.0, 3.0, len(q))
    turned = _wxyz(Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]) * rotation)
    assert inclination_error(turned, q).max() < 1e-7
    assert np.allclose(heading_error(turned, q), np.abs(angle), atol=1e-7)
    assert np.allclose(total_error(turned, q), np.abs(angle), atol=1e-7)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-3, 1.0, 3.1])
def test_a_turn_about_a_horizontal_axis_is_inclination(angle: float) -> None:
    rotation, q = _some(1)
    turned = _wxyz(Rotation.from_rotvec([angle * 0.6, angle * 0.8, 0.0]) * rotation)
    # An arc cosine would lose the first two.
    assert inclination_error(turned, q)[0] == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert inclination_error(-turned, q)[0] == pytest.approx(angle, rel=1e-6, abs=1e-15)


def test_gaps_and_rest_are_left_out() -> None:
    error = np.array([3.0, np.nan, 4.0, 100.0])
    moving = np.array([True, True, True, False])
    assert rms_in_motion(error, moving) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(rms_in_motion(error, np.zeros(4, dtype=bool)))
    _, q = _some(3)
    gap = q.copy()
    gap[1] = np.nan
    assert np.isnan(inclination_error(q, gap)).tolist() == [False, True, False]


def test_other_shapes_are_refused() -> None:
    with pytest.raises(BadInputError, match="expected \\(n, 4\\)"):
        up_in_sensor(np.ones(4))
    with pytest.raises(BadInputError, match="expected as many"):
        inclination_error(np.ones((2, 4)), np.ones((3, 4)))
