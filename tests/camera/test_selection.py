"""The model that made the views is the one that views held back choose."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from calib.camera.bundle import calibrate
from calib.camera.model import COEFFICIENTS, Camera
from calib.camera.selection import (
    board_basis,
    candidates_by_board,
    candidates_by_model,
    simplest_good,
)
from calib.camera.views import View, pack
from synthetic import BOARD, views_of

LENSES = {
    "pinhole": {},
    "radial2": {"k1": -0.25, "k2": 0.1},
    "brown5": {"k1": -0.25, "k2": 0.1, "p1": 0.004, "p2": -0.003, "k3": 0.0},
}


@pytest.mark.parametrize("truth", LENSES)
def test_the_true_lens_is_chosen(truth: str) -> None:
    lens = np.array([LENSES[truth].get(name, 0.0) for name in COEFFICIENTS])
    camera = Camera(truth, (640, 480), 530.0, 532.0, 0.0, 325.0, 236.0, lens)
    found = candidates_by_model(pack(views_of(18, 3, 0.2, camera=camera)), (640, 480))
    names = [candidate.name for candidate, _ in found]
    assert names == ["pinhole", "radial2", "radial3", "brown5", "rational8"]
    fitted = [candidate.fitted_rms_px for candidate, _ in found]
    assert all(b <= a * (1 + 1e-4) for a, b in pairwise(fitted[:4]))
    assert names[simplest_good([candidate for candidate, _ in found])] == truth


def test_models_with_too_many_unknowns_are_left_out() -> None:
    view = views_of(1, 2)[0]
    few = [View("a", view.target_m[[0, 8, 45, 53, 22]], view.pixels[[0, 8, 45, 53, 22]])]
    assert candidates_by_model(pack(few), (640, 480)) == []


@pytest.mark.parametrize("truth", ["rigid", "warp", "released"])
def test_the_true_board_is_chosen(truth: str) -> None:
    views = views_of(16, 5)
    observations = pack(views)
    rng = np.random.default_rng(0)
    basis = board_basis(observations.target_m[0], truth)
    if basis is not None:
        weights = np.array([1.5e-3, -1e-3]) if truth == "warp" else 4e-4 * rng.standard_normal(len(basis))
        shape = np.tensordot(weights, basis, axes=1).T
        # Views of the deformed board: fit poses exactly, then project the displaced points.
        fit = calibrate(observations, (640, 480), "radial2")
        from calib.camera.projection import jacobian

        J = jacobian(fit.block, observations.displaced(shape), fit.free, None)
        assert J is not None
        observations = replace(
            observations, pixels=observations.pixels + J[:, -1].reshape(-1, 2, 54).transpose(0, 2, 1)
        )
    observations = replace(
        observations, pixels=observations.pixels + 0.1 * rng.standard_normal(observations.pixels.shape)
    )
    found = candidates_by_board(calibrate(observations, (640, 480), "radial2"), skew=False)
    names = [candidate.name for candidate, _ in found]
    assert names == ["rigid", "warp", "released"]
    assert names[simplest_good([candidate for candidate, _ in found])] == truth


def test_released_needs_views() -> None:
    found = candidates_by_board(calibrate(pack(views_of(4, 5, 0.1)), (640, 480), "radial2"), skew=False)
    assert [candidate.name for candidate, _ in found] == ["rigid", "warp"]


def test_bases_are_zero_where_the_gauge_is() -> None:
    target = np.concatenate([BOARD.points_m(), np.zeros((54, 1))], axis=1)
    warp = board_basis(target, "warp")
    assert warp is not None
    np.testing.assert_allclose(warp[:, :2], 0.0)
    np.testing.assert_allclose(warp[0, 2, [0, 8]], 0.0, atol=1e-15)
    assert board_basis(target, "rigid") is None
