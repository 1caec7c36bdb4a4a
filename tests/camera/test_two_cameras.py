"""One camera is one, two are two, and bends of board and lens are neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sets import Recipe, camera_of, good_set, take

from calib.camera.board_shape import target_shape
from calib.camera.bundle import Calibration, calibrate
from calib.camera.two_cameras import best_change, best_split, straightened, widened
from calib.camera.views import View, pack


def _fit(views: list[View], model: str = "radial2") -> Calibration:
    return calibrate(pack(views), (640, 480), model)


def _prepared(fit: Calibration) -> Calibration:
    wide = widened(fit)
    shape = target_shape(wide)
    return wide if shape is None else straightened(wide, shape.displacement_m)


@pytest.mark.parametrize("shuffled", [False, True])
def test_two_cameras_are_separated(shuffled: bool) -> None:
    rng = np.random.default_rng(0)
    camera = camera_of()
    other = replace(camera, fx_px=camera.fx_px * 1.03, fy_px=camera.fy_px * 1.03)
    views = take(rng, camera, 10) + take(rng, other, 8, prefix="w")
    order = rng.permutation(18) if shuffled else np.arange(18)
    truth = order >= 10
    wide = _prepared(_fit([views[i] for i in order]))
    split = best_split(wide)
    assert split is not None
    assert split.ratio > 2
    assert (split.second == truth).mean() >= 17 / 18
    assert split.difference["fx_px"] == pytest.approx(0.03 * camera.fx_px, abs=4 * split.sigma["fx_px"])
    assert split.split_rms_px < split.rms_px
    change = best_change(wide)
    assert change is not None
    if shuffled:
        assert change.ratio < split.ratio
    else:
        assert change.ratio > 2
        np.testing.assert_array_equal(change.second, truth)


def test_one_camera_stays_below_what_chance_reaches() -> None:
    splits, changes = [], []
    for seed in range(12):
        views, camera = good_set(seed + 40, ("radial2", "brown5")[seed % 2])
        fit = calibrate(pack(views), camera.image_size_px, camera.model)
        wide = _prepared(fit)
        split, change = best_split(wide), best_change(wide)
        assert split is not None
        assert change is not None
        splits.append(split.ratio)
        changes.append(change.ratio)
    assert max(splits) < 1.4
    assert max(changes) < 1.3
    assert np.median(splits) < 1.0


def test_a_bent_board_is_not_a_second_camera() -> None:
    views = take(np.random.default_rng(1), camera_of(), 25, recipe=Recipe(bow_m=0.001))
    fit = _fit(views)
    straightened = best_split(_prepared(fit))
    assert straightened is not None
    assert straightened.ratio < 1.4


def test_a_lens_that_the_model_cannot_follow_is_not_a_second_camera() -> None:
    camera = camera_of(lens=(-0.29, 0.107, 0.0015, -0.0003))
    fit = _fit(take(np.random.default_rng(2), camera, 20))
    wide = _prepared(fit)
    assert wide.camera.model == "brown5"
    split = best_split(wide)
    assert split is not None
    assert split.ratio < 1.4


def test_widening_only_where_it_helps() -> None:
    fit = _fit(take(np.random.default_rng(3), camera_of(), 15))
    assert widened(fit).camera.model == "radial2"
    five = _fit(take(np.random.default_rng(3), camera_of(), 15), "brown5")
    assert widened(five) is five
    held = calibrate(fit.observations, (640, 480), "radial2", fixed=("cx_px",), start=fit.block)
    assert widened(held) is held


def test_five_views_are_too_few_to_split() -> None:
    fit = _fit(take(np.random.default_rng(4), camera_of(), 5))
    assert best_split(fit) is None
    assert best_change(fit) is None


def test_the_same_seed_gives_the_same_answer() -> None:
    fit = _fit(take(np.random.default_rng(5), camera_of(), 12))
    first, second = best_split(fit, 3), best_split(fit, 3)
    assert first is not None
    assert second is not None
    assert first.statistic == second.statistic
    assert first.chance == second.chance


def test_a_target_moved_behind_the_camera_changes_nothing() -> None:
    fit = _fit(take(np.random.default_rng(0), camera_of(), 6))
    shape = target_shape(widened(fit))
    assert shape is not None
    away = np.zeros_like(shape.displacement_m)
    away[..., 2] = -100.0
    for far in (away, -away):
        moved = straightened(fit, far)
        assert best_change(moved) is not None
