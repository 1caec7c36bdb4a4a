"""The picture that is advised helps more than others do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sets import Recipe, camera_of, take

from calib.camera.bundle import Calibration, calibrate
from calib.camera.covariance import covariance
from calib.camera.evidence import evidence
from calib.camera.next_view import Candidate, best_next_view
from calib.camera.views import pack


def _fit(recipe: Recipe, count: int = 10, seed: int = 0) -> Calibration:
    return calibrate(
        pack(take(np.random.default_rng(seed), camera_of(), count, recipe=recipe)), (640, 480), "radial2"
    )


def _advice(fit: Calibration) -> Candidate:
    found = best_next_view(fit, evidence(fit).S.sum(axis=0))
    assert found is not None
    assert 0.0 < found.remaining < 1.0
    return found


def test_parallel_views_want_a_tilted_one() -> None:
    found = _advice(_fit(Recipe(tilt_deg=(0.0, 4.0))))
    assert found.tilt_deg >= 30.0
    assert found.away in ("left", "right", "top", "bottom")


def test_views_in_the_middle_want_one_at_the_border() -> None:
    found = _advice(_fit(Recipe(spread=0.05, fill=(0.25, 0.35))))
    assert found.where != "in the middle of the picture"


def test_views_on_the_left_want_one_on_the_right() -> None:
    rng = np.random.default_rng(1)
    views = [
        v for v in take(rng, camera_of(), 60, recipe=Recipe(fill=(0.3, 0.45))) if v.pixels[:, 0].max() < 380
    ]
    fit = calibrate(pack(views), (640, 480), "radial2")
    assert len(views) > 5
    assert "right" in _advice(fit).where


def test_advice_beats_more_of_the_same() -> None:
    rng = np.random.default_rng(2)
    camera = camera_of()
    views = take(rng, camera, 8, recipe=Recipe(tilt_deg=(0.0, 6.0)))

    def sigma(more: Recipe) -> float:
        found = calibrate(
            pack([*views, *take(np.random.default_rng(3), camera, 1, recipe=more)]), (640, 480), "radial2"
        )
        return covariance(found, 0.01).sigma()["fx_px"]

    advised = _advice(calibrate(pack(views), (640, 480), "radial2"))
    tilted = Recipe(tilt_deg=(advised.tilt_deg, advised.tilt_deg), fill=(0.55, 0.6))
    assert sigma(tilted) < 0.5 * sigma(Recipe(tilt_deg=(0.0, 6.0)))


def test_what_was_taken_is_worth_less_the_second_time() -> None:
    fit = _fit(Recipe(), count=12)
    S = evidence(fit).S.sum(axis=0)
    first, later = best_next_view(fit, S), best_next_view(fit, 100 * S)
    assert first is not None
    assert later is not None
    assert later.remaining > first.remaining


def test_no_advice_where_nothing_is_known() -> None:
    fit = _fit(Recipe(), count=6)
    P = len(fit.free)
    assert best_next_view(fit, np.full((P, P), np.nan)) is None
    folded = replace(fit, camera=replace(fit.camera, fx_px=1.0, fy_px=1.0, distortion=np.full(8, -9.0)))
    assert best_next_view(folded, np.eye(P)) is None
