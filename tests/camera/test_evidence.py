"""The quadratic cost of a view is its cost, and groups of views follow from sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sets import Recipe, camera_of, take

from calib.camera.bundle import Calibration, calibrate
from calib.camera.covariance import residual_inflation
from calib.camera.evidence import evidence, gain, overdispersion, scaled_inverse
from calib.camera.levenberg import minimise
from calib.camera.views import pack

NOTHING = np.zeros(0, dtype=np.int64)


def _fit(count: int = 12, seed: int = 0, model: str = "radial2", noise_px: float = 0.1) -> Calibration:
    views = take(np.random.default_rng(seed), camera_of(), count, recipe=Recipe(noise_px=noise_px))
    return calibrate(pack(views), (640, 480), model)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "brown5"])
def test_cost_of_a_view_under_another_camera(model: str) -> None:
    # Curvature without second derivatives is the cost's where residuals and shifts are small.
    fit = _fit(model=model, noise_px=0.001)
    found = evidence(fit)
    rng = np.random.default_rng(1)
    shift = rng.standard_normal(len(fit.free)) * 0.02 / np.sqrt(np.diagonal(found.S.sum(axis=0)))
    moved = fit.block.intrinsics.copy()
    moved[fit.free] += shift
    there = minimise(replace(fit.block, intrinsics=moved), fit.observations, NOTHING)
    assert there.at is not None
    costs = (there.at.residuals**2).sum(axis=(1, 2))
    expected = found.cost + 2 * found.b @ shift + np.einsum("g,ngh,h->n", shift, found.S, shift)
    rise = costs - found.cost
    np.testing.assert_allclose(expected - found.cost, rise, atol=2e-3 * np.abs(rise).max())


def test_views_together_want_nothing_else() -> None:
    fit = _fit()
    found = evidence(fit)
    assert float(gain(found.S.sum(axis=0), found.b.sum(axis=0))) < 1e-8 * fit.squared_sum
    np.testing.assert_allclose(found.cost.sum(), fit.squared_sum, rtol=1e-12)
    assert found.names == fit.free_names


def test_gain_of_a_group_is_what_fitting_it_alone_gains() -> None:
    fit = _fit(16)
    found = evidence(fit)
    group = np.arange(8)
    alone = calibrate(fit.observations.select(group), (640, 480), "radial2")
    fall = found.cost[group].sum() - alone.squared_sum
    assert float(gain(found.S[group].sum(axis=0), found.b[group].sum(axis=0))) == pytest.approx(
        fall, rel=0.02
    )


def test_deformation_has_the_slope_of_the_cost() -> None:
    fit = _fit(8)
    points = fit.observations.target_m.shape[1]
    basis = np.random.default_rng(2).standard_normal((1, 2, 3, points))
    found = evidence(fit, basis, ("one", "two"))
    assert found.names[-2:] == ("one", "two")
    step = 1e-7
    for k in range(2):
        costs = []
        for sign in (1.0, -1.0):
            seen = fit.observations.displaced(sign * step * basis[0, k].T)
            there = minimise(fit.block, seen, NOTHING)
            assert there.at is not None
            costs.append((there.at.residuals**2).sum(axis=(1, 2)))
        slope = (costs[0] - costs[1]) / (2 * step)
        np.testing.assert_allclose(2 * found.b[:, found.intrinsics + k], slope, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(found.camera_only().S, evidence(fit).S, rtol=1e-9, atol=1e-6)


def test_overdispersion_is_one_for_white_noise_and_the_sandwich_estimate() -> None:
    fit = _fit(60, noise_px=0.2)
    assert overdispersion(evidence(fit)) == pytest.approx(1.0, abs=0.2)
    assert overdispersion(evidence(fit)) == pytest.approx(residual_inflation(fit), rel=1e-6)


def test_overdispersion_sees_errors_shared_by_a_view() -> None:
    rng = np.random.default_rng(3)
    views = take(rng, camera_of(), 40)
    # A smooth error of each view, as motion blur or a rolling shutter leave it.
    bent = [
        replace(
            v, pixels=v.pixels + 0.3 * ((v.pixels - v.pixels.mean(axis=0)) / 50) ** 2 * rng.normal(0, 1, 2)
        )
        for v in views
    ]
    fit = calibrate(pack(bent), (640, 480), "radial2")
    assert overdispersion(evidence(fit)) > 1.5


def test_inverse_leaves_out_what_nothing_measures() -> None:
    rng = np.random.default_rng(4)
    A = rng.standard_normal((5, 3)) * [1e4, 1.0, 1e-4]
    S = A.T @ A
    np.testing.assert_allclose(scaled_inverse(S) @ S, np.eye(3), atol=1e-6)
    flat = np.diag([2.0, 0.0, 3.0])
    np.testing.assert_allclose(np.diag(scaled_inverse(flat)), [0.5, 0.0, 1 / 3])


def test_points_behind_the_camera_are_no_evidence() -> None:
    fit = _fit(4)
    behind = replace(fit, block=replace(fit.block, t_CT_m=-fit.block.t_CT_m))
    with pytest.raises(ValueError, match="behind"):
        evidence(behind)
