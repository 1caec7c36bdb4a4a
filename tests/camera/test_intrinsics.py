"""The whole way from views to a judged camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera import intrinsics
from calib.camera.bundle import calibrate
from calib.camera.intrinsics import Choices, calibrate_camera
from calib.camera.views import View
from calib.errors import BadInputError
from synthetic import views_of


def test_good_views_are_ok() -> None:
    result = calibrate_camera(views_of(17, 2, 0.15), (640, 480))
    assert result.judgement.verdict == "ok", result.judgement.reasons
    assert result.calibration.camera.model == "radial2"
    assert [c.name for c in result.models] == ["pinhole", "radial2", "radial3", "brown5", "rational8"]
    assert set(result.seconds) == {"solve", "covariance", "judge"}
    off = abs(result.calibration.camera.fx_px - 530.0)
    assert off < 4 * result.covariance.sigma()["fx_px"]


def test_outliers_are_rejected_and_named() -> None:
    views = views_of(15, 3, 0.1)
    views[4].pixels[10] += [6.0, -5.0]
    views[7].pixels[:30] += np.random.default_rng(0).uniform(-40, 40, (30, 2))
    result = calibrate_camera(views, (640, 480), Choices(model="radial2", reject=True))
    assert any("view05: point 10" in sentence for sentence in result.rejected)
    assert any("view08: left out whole" in sentence for sentence in result.rejected)
    assert len(result.rejected) <= 4
    assert "view08" not in result.calibration.observations.names
    assert result.calibration.sigma_px == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize(
    ("count", "choices", "says"),
    [
        (0, Choices(), "no views"),
        (2, Choices(model="radial2", skew=True), "needs at least 3 views, found 2"),
        (1, Choices(model="radial2", board="released"), "more unknowns"),
    ],
)
def test_what_cannot_be_answered_is_refused(count: int, choices: Choices, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        calibrate_camera(views_of(count, 2, 0.1), (640, 480), choices)


def test_degenerate_views_are_refused() -> None:
    good = views_of(3, 2, 0.1)
    line = View("line", good[0].target_m[:9], good[0].pixels[:9])
    with pytest.raises(BadInputError, match=r"line: all its points lie on one line"):
        calibrate_camera([*good, line], (640, 480))
    few = View("few", good[0].target_m[:3], good[0].pixels[:3])
    with pytest.raises(BadInputError, match="few: has 3 points"):
        calibrate_camera([*good, few], (640, 480))
    corners = [View(v.name, v.target_m[[0, 8, 45, 53]], v.pixels[[0, 8, 45, 53]]) for v in good[:2]]
    with pytest.raises(BadInputError, match="cannot fix"):
        calibrate_camera(corners, (640, 480), Choices(model="brown5"))


@pytest.mark.parametrize("count", [1, 2])
def test_few_views_are_answered_but_not_blessed(count: int) -> None:
    result = calibrate_camera(views_of(count, 2, 0.1), (640, 480))
    assert result.judgement.verdict != "ok"
    assert result.judgement.reasons


def test_the_board_model_is_chosen_on_held_back_views() -> None:
    result = calibrate_camera(views_of(12, 2, 0.15), (640, 480), Choices(model="radial2", board="auto"))
    assert result.board == "rigid"
    assert [c.name for c in result.boards] == ["rigid", "warp", "released"]


def test_a_start_that_ends_lower_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(12, 4, 0.1, tilt_rad=0.05)
    best = calibrate_camera(views, (640, 480), Choices(model="radial2"))
    calls = []

    def worse(*arguments, **named):
        # The first fit stops where a long lens would leave it.
        fit = calibrate(*arguments, **named)
        if calls:
            return fit
        calls.append(fit)
        block = fit.block
        long = replace(
            block,
            intrinsics=block.intrinsics * np.array([4.0, 4.0, *np.ones(len(block.intrinsics) - 2)]),
            t_CT_m=block.t_CT_m * np.array([1.0, 1.0, 4.0]),
        )
        return calibrate(*arguments, **{**named, "start": long, "max_iterations": 1})

    monkeypatch.setattr(intrinsics, "calibrate", worse)
    found = calibrate_camera(views, (640, 480), Choices(model="radial2"))
    assert calls
    assert found.calibration.rms_px == pytest.approx(best.calibration.rms_px, rel=1e-6)
    assert found.calibration.camera.fx_px == pytest.approx(best.calibration.camera.fx_px, rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_view_in_disorder_is_named(seed: int) -> None:
    views = views_of(12, 1, 0.1)
    order = np.random.default_rng(seed).permutation(len(views[4].pixels))
    views[4] = replace(views[4], pixels=views[4].pixels[order])
    found = calibrate_camera(views, (640, 480)).judgement
    assert found.verdict == "inconsistent"
    assert "view05 shows points that no camera sees on a flat board" in found.reasons[0]
    assert found.advice[0] == "Leave out view05."
