"""One minimum where there is one; an interval of focal length that the covariance confirms or cannot see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sets import Recipe, camera_of, take

from calib.camera.bundle import Calibration, calibrate
from calib.camera.covariance import covariance
from calib.camera.starts import (
    FOCAL_STARTS,
    best_of_starts,
    conditioned,
    focal_interval,
    held,
    other_starts,
    resolved,
)
from calib.camera.views import pack

USUAL = Recipe()


def _fit(recipe: Recipe = USUAL, count: int = 14, seed: int = 0, model: str = "radial2") -> Calibration:
    views = take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)
    return calibrate(pack(views), (640, 480), model)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "brown5"])
def test_all_starts_of_a_good_set_end_in_one_place(model: str) -> None:
    fit = _fit(model=model)
    ends = other_starts(fit)
    assert len(ends) == len(FOCAL_STARTS)
    reached = [end for end in ends if end.cost < 1.001 * fit.squared_sum]
    assert len(reached) >= 4
    for end in reached:
        np.testing.assert_allclose(end.block.intrinsics[:4], fit.block.intrinsics[:4], rtol=1e-5)
    # What is left are local minima that no one would take for the answer.
    assert all(end.cost > 1.5 * fit.squared_sum for end in ends if end not in reached)
    assert best_of_starts(fit) is fit


@pytest.mark.parametrize("views", [12, 80])
def test_a_better_minimum_is_adopted(views: int) -> None:
    fit = _fit(count=views)
    # Stopped early, far away.
    intrinsics = fit.block.intrinsics.copy()
    intrinsics[:2] *= 4.0
    lost = calibrate(
        fit.observations,
        (640, 480),
        "radial2",
        start=replace(fit.block, intrinsics=intrinsics, t_CT_m=fit.block.t_CT_m * [1, 1, 4]),
        max_iterations=2,
    )
    assert lost.squared_sum > 2 * fit.squared_sum
    assert best_of_starts(lost).squared_sum == pytest.approx(fit.squared_sum, rel=1e-6)


def test_interval_of_a_good_set_is_its_sigma() -> None:
    fit = _fit()
    sigma = covariance(fit).sigma()["fx_px"]
    found = focal_interval(fit, sigma, 1.0)
    assert found.bounded
    assert not found.lower_cost
    assert fit.camera.fx_px - found.low_px == pytest.approx(1.96 * sigma, rel=0.05)
    assert found.high_px - fit.camera.fx_px == pytest.approx(1.96 * sigma, rel=0.05)
    assert found.half_width_share == pytest.approx(1.96 * sigma / fit.camera.fx_px, rel=0.05)
    wider = focal_interval(fit, sigma, 2.0)
    assert wider.half_width_share == pytest.approx(2 * found.half_width_share, rel=0.05)


def test_interval_does_not_depend_on_the_first_step() -> None:
    fit = _fit()
    sigma = covariance(fit).sigma()["fx_px"]
    right = focal_interval(fit, sigma, 1.0)
    for factor in (0.01, 30.0):
        other = focal_interval(fit, factor * sigma, 1.0)
        assert other.half_width_share == pytest.approx(right.half_width_share, rel=0.06)


def test_parallel_views_leave_the_interval_open() -> None:
    fit = _fit(Recipe(tilt_deg=(0.0, 0.5), noise_px=0.2))
    found = focal_interval(fit, covariance(fit).sigma()["fx_px"], 1.0)
    assert found.lower_cost or not found.bounded
    assert found.lower_cost or np.isinf(found.half_width_share)


def test_resolved_keeps_model_and_what_is_held() -> None:
    observations = _fit().observations
    fit = calibrate(observations, (640, 480), "radial2", skew=True, fixed=("cx_px",))
    assert held(fit) == ("cx_px",)
    part = resolved(fit, np.arange(0, 14, 2))
    assert part.observations.names == fit.observations.names[::2]
    assert part.free_names == fit.free_names
    assert part.camera.cx_px == fit.camera.cx_px
    assert part.converged


def test_the_rational_denominator_is_put_aside() -> None:
    fit = _fit(model="rational8")
    sturdy = conditioned(fit)
    assert sturdy.camera.model == "brown5"
    assert sturdy.squared_sum < 1.05 * fit.squared_sum
    assert np.isfinite(covariance(sturdy).sigma()["fx_px"])
    plain = _fit()
    assert conditioned(plain) is plain


def test_a_denominator_that_is_needed_is_held() -> None:
    lens = (0.4, -0.05, 0.0, 0.0, 0.0, 0.9, 0.15, 0.0)
    camera = camera_of((1280, 960), 100.0, lens, "rational8")
    views = take(np.random.default_rng(1), camera, 25, recipe=Recipe(noise_px=0.01))
    fit = calibrate(pack(views), (1280, 960), "rational8")
    simple = calibrate(pack(views), (1280, 960), "brown5")
    assert simple.squared_sum > 1.05 * fit.squared_sum
    sturdy = conditioned(fit)
    assert sturdy.camera == fit.camera
    assert sturdy.free_names == simple.free_names
    assert sturdy.normal.shape[1] == fit.normal.shape[1] - 3
