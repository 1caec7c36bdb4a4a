"""Tilts, hulls, copies and the lens's shape, against sets made to have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sets import Recipe, camera_of, take

from calib.camera.bundle import Calibration, calibrate
from calib.camera.coverage import (
    coverage,
    hull,
    image_outline,
    inside_hull,
    lens_shape,
    repeated_views,
    target_box,
)
from calib.camera.views import pack

USUAL = Recipe()


def _fit(recipe: Recipe = USUAL, count: int = 12, seed: int = 0) -> Calibration:
    return calibrate(
        pack(take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)), (640, 480), "radial2"
    )


def test_hull_of_a_square_and_of_a_disc() -> None:
    rng = np.random.default_rng(0)
    square = np.concatenate([rng.uniform(0, 1, (500, 2)), [[0, 0], [1, 0], [1, 1], [0, 1]]])
    corners = hull(square)
    x, y = corners.T
    assert 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) == pytest.approx(1.0)
    angle = rng.uniform(0, 2 * np.pi, 5000)
    x, y = hull(np.stack([np.cos(angle), np.sin(angle)], axis=1)).T
    assert 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) == pytest.approx(np.pi, rel=0.01)
    assert len(hull(np.ones((3, 2)))) == 1


def test_inside_hull() -> None:
    corners = np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]])
    points = np.array([[1.0, 0.5], [2.1, 0.5], [-0.1, 0.5], [1.0, 1.2], [2.0, 1.0]])
    np.testing.assert_array_equal(inside_hull(points, corners), [True, False, False, False, True])
    np.testing.assert_array_equal(inside_hull(points, corners[::-1]), [True, False, False, False, True])


def test_tilts_are_those_that_were_made() -> None:
    found = coverage(_fit(Recipe(tilt_deg=(19.0, 21.0))))
    np.testing.assert_allclose(found.tilts_deg, 20.0, atol=1.5)
    assert 30 < found.spread_deg < 43
    assert found.weaker_spread_deg > 5
    parallel = coverage(_fit(Recipe(tilt_deg=(20.0, 20.5), azimuth_deg=30.0, roll_deg=0.5)))
    assert parallel.spread_deg < 3
    one_axis = coverage(_fit(Recipe(tilt_deg=(0.0, 40.0), azimuth_deg=0.0, roll_deg=0.0)))
    assert one_axis.spread_deg > 20
    assert one_axis.weaker_spread_deg < 3


def test_shares_of_the_image() -> None:
    full = coverage(_fit(count=40))
    assert full.area_share > 0.7
    assert full.cells_share > 0.8
    assert not full.empty.any()
    assert 0.7 < full.radius_share <= 1.0
    small = coverage(_fit(Recipe(fill=(0.15, 0.2), spread=0.05)))
    assert small.area_share < 0.1
    assert small.empty.sum() >= 6
    assert not small.empty[1, 1]


def test_points_outside_are_counted() -> None:
    views = take(np.random.default_rng(1), camera_of(), 10)
    inside = coverage(calibrate(pack(views), (640, 480), "radial2"))
    assert inside.outside_share == 0.0
    assert coverage(calibrate(pack(views), (320, 240), "radial2")).outside_share > 0.5


def test_copies_are_found_through_noise() -> None:
    rng = np.random.default_rng(2)
    views = take(rng, camera_of(), 8)
    again = [
        replace(views[i], pixels=views[i].pixels + 0.05 * rng.standard_normal((35, 2))) for i in (1, 1, 6)
    ]
    fit = calibrate(pack([*views, *again]), (640, 480), "radial2")
    np.testing.assert_array_equal(repeated_views(fit, 0.5), [0, 1, 2, 3, 4, 5, 6, 7, 1, 1, 6])
    np.testing.assert_array_equal(repeated_views(fit, 1e-6), np.arange(11))


def test_mirrored_views_are_seen_from_behind() -> None:
    views = take(np.random.default_rng(3), camera_of(), 8)
    turned = [replace(v, target_m=v.target_m * [-1.0, 1.0]) if i == 2 else v for i, v in enumerate(views)]
    found = coverage(calibrate(pack(turned), (640, 480), "radial2"))
    np.testing.assert_array_equal(np.flatnonzero(found.mirrored), [2])
    assert found.spread_deg < 90


def test_a_lens_that_folds() -> None:
    fit = _fit()
    fine = lens_shape(fit)
    assert fine.image_shown == 1.0
    assert 0.5 < fine.image_slope <= fine.seen_slope < 1.0
    folding = replace(fit, camera=replace(fit.camera, distortion=np.array([-0.9, 0, 0, 0, 0, 0, 0, 0.0])))
    found = lens_shape(folding)
    assert found.image_shown < 1.0
    assert found.image_slope <= 0.0


def test_box_and_outline() -> None:
    fit = _fit(count=4)
    np.testing.assert_allclose(np.ptp(target_box(fit), axis=0), [0.12, 0.08, 0.0])
    border = image_outline(fit.camera)
    assert len(np.unique(border, axis=0)) == len(border) == 32
    on_edge = np.isin(border[:, 0], [0, 639]) | np.isin(border[:, 1], [0, 479])
    assert on_edge.all()
