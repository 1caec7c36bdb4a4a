"""The Jacobian against finite differences, for every parameter and model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.camera.levenberg import rotation_exp
from calib.camera.model import MODELS
from calib.camera.projection import INTRINSICS, Block, free_intrinsics, jacobian
from calib.camera.selection import board_basis
from calib.camera.views import Observations, View, pack
from synthetic import BOARD


def _block(seed: int, deformation: int = 0) -> Block:
    rng = np.random.default_rng(seed)
    lens = rng.uniform(-0.1, 0.1, 8)
    intrinsics = np.array([500.0, 510.0, 320.0, 240.0, 3.0, *lens])
    R = rotation_exp(rng.uniform(-0.6, 0.6, (3, 3)))
    t = np.array([[-0.1, -0.06, 0.5], [0.0, 0.0, 0.4], [-0.12, -0.1, 0.7]])
    return Block(intrinsics, R, t, 1e-3 * rng.standard_normal(deformation))


def _observations() -> Observations:
    points = BOARD.points_m()
    views = [View(str(i), points[: 54 - 5 * i], np.full((54 - 5 * i, 2), 100.0 * i)) for i in range(3)]
    shared = [View(v.name, points, np.resize(v.pixels, (54, 2))) for v in views]
    return pack(shared)


def _shifted(
    block: Block, free: np.ndarray, row: int, view: int, step: float, basis: np.ndarray | None
) -> Block:
    G = len(free) + (0 if basis is None else len(basis))
    intrinsics, R, t = block.intrinsics.copy(), block.R_CT.copy(), block.t_CT_m.copy()
    deformation = block.deformation.copy()
    if row < len(free):
        intrinsics[free[row]] += step
    elif row < G:
        deformation[row - len(free)] += step
    elif row < G + 3:
        delta = np.zeros((1, 3))
        delta[0, row - G] = step
        R[view] = rotation_exp(delta)[0] @ R[view]
    else:
        t[view, row - G - 3] += step
    return Block(intrinsics, R, t, deformation)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", ["rigid", "warp"])
@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_gradients_agree_with_finite_differences(model: str, kind: str, seed: int) -> None:
    observations = _observations()
    basis = board_basis(observations.target_m[0], kind)
    free = free_intrinsics(model, skew=True)
    block = _block(seed, 0 if basis is None else len(basis))
    J = jacobian(block, observations, free, basis)
    assert J is not None
    for row in range(J.shape[1] - 1):
        name = INTRINSICS[free[row]] if row < len(free) else "other"
        step = 1e-3 if name.endswith("_px") else 1e-6
        for view in (0, 2):
            ahead = jacobian(_shifted(block, free, row, view, step, basis), observations, free, basis)
            behind = jacobian(_shifted(block, free, row, view, -step, basis), observations, free, basis)
            assert ahead is not None and behind is not None
            numeric = (ahead[view, -1] - behind[view, -1]) / (2 * step)
            scale = np.abs(J[view, row]).max() + 1.0
            np.testing.assert_allclose(J[view, row] / scale, numeric / scale, atol=2e-7)


def test_points_behind_the_camera_are_refused() -> None:
    block = _block(0)
    behind = Block(block.intrinsics, block.R_CT, -block.t_CT_m, block.deformation)
    assert jacobian(behind, _observations(), free_intrinsics("radial2", False), None) is None


def test_absent_points_count_nothing() -> None:
    observations = _observations()
    rejected = np.zeros(observations.present.shape, dtype=np.bool_)
    rejected[1, 7] = True
    J = jacobian(_block(1), observations.without(rejected), free_intrinsics("brown5", False), None)
    assert J is not None
    assert not J[1, :, 7].any()
    assert not J[1, :, 54 + 7].any()


def test_released_board_keeps_place_and_size() -> None:
    target = pack([View("", BOARD.points_m(), np.zeros((54, 2)))]).target_m[0]
    basis = board_basis(target, "released")
    assert basis is not None
    assert basis.shape == (3 * 54 - 7, 3, 54)
    centred = target - 0.5 * (target.max(axis=0) + target.min(axis=0))
    for displacement in basis[::20]:
        assert np.abs(displacement.sum(axis=1)).max() < 1e-12
        assert np.abs(np.cross(centred, displacement.T).sum(axis=0)).max() < 1e-12
        assert abs(np.sum(centred * displacement.T)) < 1e-12
