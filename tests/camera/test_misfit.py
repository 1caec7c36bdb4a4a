"""Views and points that do not belong are found, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sets import camera_of, good_set, take

from calib.camera.bundle import calibrate
from calib.camera.misfit import Misfit, misfit, screen
from calib.camera.views import View, pack


def _views(count: int = 12, seed: int = 0) -> list[View]:
    return take(np.random.default_rng(seed), camera_of(), count)


def _misfit(views: list[View]) -> Misfit:
    return misfit(calibrate(pack(views), (640, 480), "radial2"), 5.0, 8.0, 0.5)


@pytest.mark.parametrize("model", ["radial2", "brown5", "rational8"])
def test_good_views_pass_the_screen(model: str) -> None:
    for seed in range(4):
        found = screen(pack(good_set(seed, model)[0]))
        assert not found.unusable.any()
        assert found.departure.max() < 0.15


def test_what_is_no_view_of_a_plane_is_named() -> None:
    views = _views(8)
    rng = np.random.default_rng(1)
    grid = views[3].pixels.reshape(5, 7, 2)
    views[1] = replace(views[1], pixels=rng.permutation(views[1].pixels))
    views[3] = replace(views[3], pixels=grid[[1, 0, 2, 4, 3]].reshape(-1, 2))
    views[4] = View("line", views[4].target_m[:7], views[4].pixels[:7])
    views[5] = View("few", views[5].target_m[:3], views[5].pixels[:3])
    views[6] = replace(views[6], pixels=views[6].pixels[:, :1] * [1.0, 0.3] + 5.0)
    found = screen(pack(views))
    np.testing.assert_array_equal(np.flatnonzero(found.not_a_plane), [1, 3])
    np.testing.assert_array_equal(np.flatnonzero(found.on_a_line), [4, 6])
    np.testing.assert_array_equal(np.flatnonzero(found.few), [5])
    np.testing.assert_array_equal(np.flatnonzero(found.unusable), [1, 3, 4, 5, 6])


def test_noise_alone_is_no_misfit() -> None:
    found = _misfit(_views())
    assert not found.bad_views.any()
    assert not found.bad_points.any()
    assert found.rms_px == pytest.approx(found.typical_px, rel=0.1)
    assert found.heavy_share == pytest.approx(0.055, abs=0.03)
    assert found.repeated == pytest.approx(1.0, abs=0.35)


def test_a_bad_view_and_bad_points_are_found() -> None:
    views = _views()
    rng = np.random.default_rng(2)
    views[2] = replace(views[2], pixels=views[2].pixels + rng.normal(0, 2.0, (35, 2)))
    views[7].pixels[4] += [3.0, -2.0]
    found = _misfit(views)
    np.testing.assert_array_equal(np.flatnonzero(found.bad_views), [2])
    np.testing.assert_array_equal(np.argwhere(found.bad_points), [[7, 4]])
    assert found.heavy_share > 0.1


def test_errors_printed_on_the_board_repeat() -> None:
    rng = np.random.default_rng(3)
    views = _views(20)
    printed = views[0].target_m + rng.normal(0, 1e-4, (35, 2))
    wrong = [replace(v, target_m=printed) for v in views]
    assert _misfit(wrong).repeated > 2.0
    # Points that differ from view to view have nothing that could repeat.
    ragged = [View(v.name, v.target_m[i % 3 :], v.pixels[i % 3 :]) for i, v in enumerate(views)]
    assert _misfit(ragged).repeated == 1.0
