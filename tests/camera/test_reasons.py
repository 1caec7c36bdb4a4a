"""Numbers about views on either side of their limits, and the sentences that follow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sets import camera_of, take

from calib.camera.board_shape import TargetShape
from calib.camera.bundle import Calibration, calibrate
from calib.camera.coverage import Coverage, coverage
from calib.camera.findings import INCONSISTENT, POOR, REMARK, UNIDENTIFIABLE, Limits
from calib.camera.misfit import Misfit, Screening, misfit
from calib.camera.reasons import of_copies, of_coverage, of_misfit, of_screening, of_split, of_target
from calib.camera.two_cameras import Split
from calib.camera.views import pack

LIMITS = Limits()


@pytest.fixture(scope="module")
def fit() -> Calibration:
    return calibrate(pack(take(np.random.default_rng(0), camera_of(), 12)), (640, 480), "radial2")


@pytest.fixture(scope="module")
def covered(fit: Calibration) -> Coverage:
    return coverage(fit)


@pytest.fixture(scope="module")
def left(fit: Calibration) -> Misfit:
    return misfit(fit, 5.0, 8.0, 0.5)


def test_nothing_is_said_of_good_views(fit: Calibration, covered: Coverage, left: Misfit) -> None:
    whole = replace(covered, radius_share=0.9)
    assert of_coverage(whole, fit, LIMITS) == []
    assert of_misfit(left, fit, LIMITS) == []
    assert of_copies(np.arange(12), fit.observations.names, np.nan, LIMITS) == []


@pytest.mark.parametrize(
    ("change", "kind", "says"),
    [
        ({"spread_deg": 3.0}, UNIDENTIFIABLE, "tilt by more than 3.0 degrees"),
        ({"spread_deg": 8.0}, POOR, "nearly parallel to each other"),
        ({"spread_deg": 8.0, "tilts_deg": np.full(12, 4.0)}, POOR, "nearly parallel to the picture"),
        ({"area_share": 0.1}, POOR, "span 10 % of the picture"),
        ({"view_share": 0.005}, POOR, "fills only 0.5 %"),
        ({"radius_share": 0.6}, REMARK, "reach 60 % of the way"),
        ({"outside_share": 0.5}, INCONSISTENT, "50.0 % of the points lie outside"),
        ({"outside_share": 0.005}, POOR, "image"),
        ({"mirrored": np.arange(12) == 3}, INCONSISTENT, "v03 shows the board mirrored"),
        ({"mirrored": np.arange(12) != 3}, INCONSISTENT, "v03 shows the board mirrored"),
    ],
)
def test_coverage(fit: Calibration, covered: Coverage, change: dict[str, Any], kind: str, says: str) -> None:
    found = of_coverage(replace(covered, **{"radius_share": 0.9, **change}), fit, LIMITS)
    assert [one.kind for one in found] == [kind]
    assert says in found[0].text or says in found[0].advice
    assert found[0].advice


@pytest.mark.parametrize(("cx", "kind"), [(395.0, REMARK), (430.0, POOR)])
def test_principal_point(fit: Calibration, covered: Coverage, cx: float, kind: str) -> None:
    off = replace(fit, camera=replace(fit.camera, cx_px=cx))
    whole = replace(covered, radius_share=0.9)
    assert [one.kind for one in of_coverage(whole, off, LIMITS)] == [kind]
    mirrored = replace(whole, mirrored=np.full(12, True))
    found = of_coverage(mirrored, off, LIMITS)
    assert [one.kind for one in found] == [POOR]
    assert "u and v may be swapped" in found[0].text


def test_screening_names_views() -> None:
    nothing = np.zeros(3, dtype=np.bool_)
    second = np.array([False, True, False])
    names = ("a", "b", "c")
    found = of_screening(Screening(nothing, second, nothing, np.zeros(3)), names)
    assert found[0].text == "b shows only points on one line."
    assert found[0].kind == INCONSISTENT
    found = of_screening(Screening(nothing, nothing, ~nothing, np.ones(3)), names)
    assert found[0].kind == UNIDENTIFIABLE
    assert found[0].text.startswith("All views show points that no camera")


def test_copies() -> None:
    names = tuple("abcdef")
    few = of_copies(np.array([0, 1, 2, 3, 4, 0]), names, 1.02, LIMITS)[0]
    assert few.kind == REMARK
    assert few.text == "f (as a) shows the board where another view does and counts once."
    many = of_copies(np.zeros(6, dtype=np.int64), names, 4.2, LIMITS)[0]
    assert many.kind == POOR
    assert many.text.endswith("the standard deviations come out 4.2 times too small.")


def test_misfit(fit: Calibration, left: Misfit) -> None:
    bad = np.arange(12) == 2
    rms = np.where(bad, 5.0, 0.14)
    found = of_misfit(replace(left, bad_views=bad, view_rms_px=rms), fit, LIMITS)
    assert [one.kind for one in found] == [INCONSISTENT]
    assert found[0].text.startswith("v02 (5.00 px) does not fit the other views, whose RMS is 0.14 px")
    odd = of_misfit(replace(left, view_rms_px=np.where(bad, 0.5, 0.14), typical_px=0.14), fit, LIMITS)
    assert [one.kind for one in odd] == [REMARK]
    loud = of_misfit(replace(left, typical_px=1.4, view_rms_px=np.full(12, 1.4)), fit, LIMITS)
    assert [one.kind for one in loud] == [POOR]
    hopeless = of_misfit(replace(left, typical_px=4.0, view_rms_px=np.full(12, 4.0)), fit, LIMITS)
    assert [one.kind for one in hopeless] == [INCONSISTENT]
    points = np.zeros((12, 35), dtype=np.bool_)
    points[4, :2] = True
    assert [one.kind for one in of_misfit(replace(left, bad_points=points), fit, LIMITS)] == [REMARK]
    points[:, 0] = True
    assert [one.kind for one in of_misfit(replace(left, bad_points=points), fit, LIMITS)] == [POOR]
    pattern = of_misfit(replace(left, repeated=2.5, heavy_share=0.5), fit, LIMITS)
    assert [one.kind for one in pattern] == [REMARK, REMARK]


def _split(**change: float) -> Split:
    values = {"statistic": 60.0, "chance": 20.0, "fx": 20.0, "sigma": 2.0} | change
    return Split(
        np.arange(12) >= 7,
        values["statistic"],
        values["chance"],
        0.2,
        0.15,
        {"fx_px": values["fx"], "cx_px": 0.1, "cy_px": 0.0},
        {"fx_px": values["sigma"], "cx_px": 1.0, "cy_px": 1.0},
    )


def test_two_cameras(fit: Calibration) -> None:
    mixed = of_split(_split(), False, fit, LIMITS)[0]
    assert mixed.kind == INCONSISTENT
    assert "v07, v08, v09, v10, v11 from one" in mixed.text
    assert "fx by 10 standard deviations" in mixed.text
    late = of_split(_split(), True, fit, LIMITS)[0]
    assert late.text.startswith("From v07 on")
    assert of_split(None, True, fit, LIMITS) == []
    assert of_split(_split(statistic=22.0), False, fit, LIMITS) == []
    assert of_split(_split(sigma=8.0), False, fit, LIMITS) == []
    assert of_split(_split(fx=1.5, sigma=0.1), False, fit, LIMITS)[0].kind == REMARK


def _target(**change: Any) -> TargetShape:
    usual = TargetShape(
        0.0, 0.001, 1e-5, 0.5, 0.12, 0.0, 0.0, 0.01, np.zeros(5), np.ones(5), np.zeros((1, 35, 3))
    )
    return replace(usual, **change)


def test_target(fit: Calibration) -> None:
    assert of_target(None, fit, LIMITS) == []
    assert of_target(_target(), fit, LIMITS) == []
    for aspect, kind in ((0.05, INCONSISTENT), (-0.05, INCONSISTENT), (0.005, REMARK)):
        assert [one.kind for one in of_target(_target(aspect=aspect), fit, LIMITS)] == [kind]
    assert of_target(_target(aspect=0.05, aspect_sigma=0.02), fit, LIMITS) == []
    curved = of_target(_target(bow_m=0.003, bow_significance=20.0, focal_shift=0.05), fit, LIMITS)[0]
    assert curved.kind == INCONSISTENT
    assert "bent by about 3.0 mm over 120 mm" in curved.text
    assert "5.0 %" in curved.text
    slight = _target(bow_m=0.0007, bow_significance=20.0, focal_shift=0.006)
    assert [one.kind for one in of_target(slight, fit, LIMITS)] == [REMARK]
    assert [one.kind for one in of_target(replace(slight, focal_shift=0.03), fit, LIMITS)] == [POOR]
    assert of_target(replace(slight, bow_significance=2.0), fit, LIMITS) == []
    assert [one.kind for one in of_target(_target(focal_per_bow=0.05), fit, LIMITS)] == [REMARK]


def test_pixels_or_squares(fit: Calibration) -> None:
    wide = replace(fit, camera=replace(fit.camera, fy_px=0.95 * fit.camera.fx_px))
    assert [one.kind for one in of_target(_target(), wide, LIMITS)] == [REMARK]
    unknown = of_target(_target(aspect=0.03, aspect_sigma=0.015), wide, LIMITS)
    assert [one.kind for one in unknown] == [POOR]
    assert "cannot tell which" in unknown[0].text
