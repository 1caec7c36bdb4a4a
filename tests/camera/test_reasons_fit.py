"""Numbers about the fit on either side of their limits, and the sentences that follow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sets import camera_of, take

from calib.camera.bundle import Calibration, calibrate
from calib.camera.coverage import Lens
from calib.camera.findings import POOR, REMARK, UNIDENTIFIABLE, Limits
from calib.camera.reasons_fit import (
    of_denominator,
    of_focal,
    of_lens,
    of_projection,
    of_richer,
    of_solution,
    of_starts,
)
from calib.camera.starts import FocalInterval, Start
from calib.camera.views import pack

LIMITS = Limits()


@pytest.fixture(scope="module")
def fit() -> Calibration:
    return calibrate(pack(take(np.random.default_rng(0), camera_of(), 12)), (640, 480), "radial2")


def test_a_solution_that_arrived(fit: Calibration) -> None:
    assert of_solution(fit, 12, LIMITS) == []


@pytest.mark.parametrize(
    ("change", "unique", "kind", "says"),
    [
        ({"termination": "behind the camera"}, 12, UNIDENTIFIABLE, "in front of it"),
        ({"termination": "singular"}, 12, UNIDENTIFIABLE, "singular"),
        ({"termination": "iterations", "decrement": 5.0}, 12, UNIDENTIFIABLE, "5 standard deviations short"),
        ({"termination": "iterations", "decrement": 0.5}, 12, REMARK, "nearly free"),
        ({}, 1, UNIDENTIFIABLE, "only one view"),
        ({}, 3, POOR, "3 different views are too few"),
    ],
)
def test_a_solution_that_did_not(
    fit: Calibration, change: dict[str, Any], unique: int, kind: str, says: str
) -> None:
    found = of_solution(replace(fit, **change), unique, LIMITS)
    assert [one.kind for one in found] == [kind]
    assert says in found[0].text


def test_more_unknowns_than_equations(fit: Calibration) -> None:
    corners = [0, 6, 28, 34]
    views = [
        v.__class__(v.name, v.target_m[corners], v.pixels[corners])
        for v in take(np.random.default_rng(1), camera_of(), 2)
    ]
    tight = calibrate(pack(views), (640, 480), "pinhole")
    assert tight.degrees_of_freedom == 0
    assert UNIDENTIFIABLE in [one.kind for one in of_solution(tight, 2, LIMITS)]


@pytest.mark.parametrize(
    ("lens", "kinds"),
    [
        (Lens(0.7, 0.6, 1.0), []),
        (Lens(-0.1, -0.1, 1.0), [UNIDENTIFIABLE]),
        (Lens(0.5, 0.0, 0.5), [POOR]),
        (Lens(0.5, 0.0, 0.97), [REMARK]),
    ],
)
def test_lens(fit: Calibration, lens: Lens, kinds: list[str]) -> None:
    assert [one.kind for one in of_lens(lens, fit, 0.8)] == kinds


@pytest.mark.parametrize(
    ("focal", "kinds"), [(100.0, [POOR]), (60.0, [UNIDENTIFIABLE]), (2e4, [POOR]), (300.0, [])]
)
def test_a_focal_length_that_no_lens_has(fit: Calibration, focal: float, kinds: list[str]) -> None:
    odd = replace(fit, camera=replace(fit.camera, fx_px=focal, fy_px=focal))
    assert [one.kind for one in of_lens(Lens(0.7, 0.6, 1.0), odd, 0.8)] == kinds


@pytest.mark.parametrize(
    ("share", "kinds"),
    [
        (0.005, []),
        (0.02, [REMARK]),
        (0.05, [POOR]),
        (0.2, [UNIDENTIFIABLE]),
        (np.inf, [UNIDENTIFIABLE]),
        (np.nan, [UNIDENTIFIABLE]),
    ],
)
def test_focal_sigma(share: float, kinds: list[str]) -> None:
    assert [one.kind for one in of_focal(share, None, LIMITS)] == kinds
    denominator = {REMARK: [], POOR: [REMARK], UNIDENTIFIABLE: [POOR]}
    expected = denominator[kinds[0]] if kinds else []
    assert [one.kind for one in of_denominator(share, LIMITS)] == expected


@pytest.mark.parametrize(
    ("low", "high", "kinds", "says"),
    [
        (495.0, 505.0, [], ""),
        (450.0, 550.0, [POOR], "from 450.0 to 550.0 px"),
        (350.0, 750.0, [UNIDENTIFIABLE], "from 350.0"),
        (400.0, np.inf, [UNIDENTIFIABLE], "any value above 400 px"),
        (0.0, 600.0, [UNIDENTIFIABLE], "any value below 600 px"),
        (0.0, np.inf, [UNIDENTIFIABLE], "any value about"),
    ],
)
def test_focal_interval(low: float, high: float, kinds: list[str], says: str) -> None:
    found = of_focal(0.001, FocalInterval(low, high, 500.0, False), LIMITS)
    assert [one.kind for one in found] == kinds
    assert not kinds or says in found[0].text


def test_lower_cost_on_the_way() -> None:
    found = of_focal(0.001, FocalInterval(495.0, 505.0, 500.0, True), LIMITS)
    assert [one.kind for one in found] == [UNIDENTIFIABLE]


def test_projection() -> None:
    assert of_projection(0.5, 640, LIMITS) == []
    assert [one.kind for one in of_projection(2.0, 640, LIMITS)] == [POOR]
    assert [one.kind for one in of_projection(np.inf, 640, LIMITS)] == [POOR]


def test_a_richer_lens(fit: Calibration) -> None:
    assert of_richer(fit, fit, LIMITS) == []
    for factor, kind in ((1.2, REMARK), (1.6, REMARK), (3.0, POOR)):
        worse = replace(fit, residuals_px=factor * fit.residuals_px)
        assert [one.kind for one in of_richer(worse, fit, LIMITS)] == [kind]


def _end(fit: Calibration, zoom: float, cost: float, termination: str = "converged") -> Start:
    intrinsics = fit.block.intrinsics.copy()
    intrinsics[:2] *= zoom
    return Start(100.0, replace(fit.block, intrinsics=intrinsics), cost * fit.squared_sum, termination)


def test_starts(fit: Calibration) -> None:
    sigma = 1e-3 * fit.camera.fx_px
    assert of_starts([], fit, sigma, 1.0, LIMITS) == []
    same, worse = _end(fit, 1.0, 1.0), _end(fit, 0.3, 5.0)
    assert of_starts([same, worse], fit, sigma, 1.0, LIMITS) == []
    lower = of_starts([same, _end(fit, 0.5, 0.8, "iterations")], fit, sigma, 1.0, LIMITS)
    assert "not the best one" in lower[0].text
    rival = of_starts([same, _end(fit, 0.5, 1.05)], fit, sigma, 1.0, LIMITS)
    assert rival[0].kind == UNIDENTIFIABLE
    assert rival[0].text.startswith("Two cameras fit the views about equally well")
    assert of_starts([same, _end(fit, 0.5, 1.05, "iterations")], fit, sigma, 1.0, LIMITS) == []
