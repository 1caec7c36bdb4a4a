"""Figures of a calibration: complete, repeatable, legible, and drawn for whatever the fit came to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.stages.camera import plots as camera_figures
from calib.stages.camera.bundle import calibrate, covariance
from calib.stages.camera.intrinsics import Intrinsics
from calib.stages.camera.model import Camera, View, pack
from calib.stages.camera.plots import write_camera_figures
from calib.stages.camera.verdict import Judgement
from synthetic import CAMERA, views_of


def result_of(
    views: list[View],
    size: tuple[int, int] = (640, 480),
    model: str = "radial2",
    fixed: tuple[str, ...] = (),
    verdict: str = "ok",
) -> Intrinsics:
    """A calibration with everything the figures need, without judging it."""
    fit = calibrate(pack(views), size, model, fixed=fixed)
    judgement = Judgement(verdict, (), (), (), {})
    return Intrinsics(fit, covariance(fit), judgement, (), (), "rigid", (), {})


def _tilted(tilt_rad: float, count: int) -> Intrinsics:
    return result_of(views_of(count, noise_px=0.1, tilt_rad=tilt_rad), verdict="unidentifiable")


def _one_view() -> Intrinsics:
    return result_of(
        views_of(1, noise_px=0.1), model="pinhole", fixed=("cx_px", "cy_px"), verdict="unidentifiable"
    )


def _many_views() -> Intrinsics:
    camera = replace(CAMERA, image_size_px=(1920, 1080), fx_px=1500.0, fy_px=1502.0, cx_px=965.0, cy_px=533.0)
    views = views_of(40, noise_px=0.2, camera=camera)
    again = [replace(v, name=f"IMG_2024_11_{k}_{v.name}.jpg") for k in range(10) for v in views]
    return result_of(again, (1920, 1080))


def _no_distortion_and_odd_names() -> Intrinsics:
    camera = Camera("pinhole", (316, 208), 270.0, 271.0, 0.0, 160.0, 101.0)
    odd = [
        "a$b$c.png",
        "$\\frac{.png",
        "\u5199\u771f.png",
        "x" * 200,
        "line\nbreak\t.png",
        "\udcff.png",
        "_^{}%.png",
    ]
    views = views_of(len(odd), noise_px=0.05, camera=camera)
    return result_of([replace(v, name=n) for v, n in zip(views, odd, strict=True)], (316, 208), "pinhole")


def _upright() -> Intrinsics:
    camera = replace(CAMERA, image_size_px=(480, 640), cx_px=236.0, cy_px=325.0)
    return result_of(views_of(6, noise_px=0.1, camera=camera), (480, 640), "rational8")


def _unbounded() -> Intrinsics:
    result = _one_view()
    size = len(result.covariance.names)
    found = replace(
        result.covariance,
        intrinsics=np.diag(np.full(size, np.inf)),
        joint=np.diag(np.full(size + 6, np.inf)),
        poses=np.full_like(result.covariance.poses, np.inf),
    )
    return replace(result, covariance=found)


def _failed() -> Intrinsics:
    """What a fit that ended behind the camera leaves: no residuals, no covariance."""
    result = _unbounded()
    fit = result.calibration
    nothing = replace(
        fit,
        residuals_px=np.full_like(fit.residuals_px, np.nan),
        normal=np.full_like(fit.normal, np.nan),
        termination="behind the camera",
    )
    return replace(result, calibration=nothing)


def _not_finite() -> Intrinsics:
    result = _failed()
    fit = result.calibration
    camera = replace(fit.camera, fx_px=np.nan, fy_px=np.nan, cx_px=np.nan, cy_px=np.nan)
    block = replace(fit.block, R_CT=np.full_like(fit.block.R_CT, np.nan))
    return replace(result, calibration=replace(fit, camera=camera, block=block))


def _exact() -> Intrinsics:
    return result_of(views_of(4), verdict="poor")


def _precise() -> Intrinsics:
    """So precise that the principal point needs many digits."""
    camera = replace(CAMERA, image_size_px=(316, 208), fx_px=273.4, fy_px=272.6, cx_px=160.67, cy_px=101.87)
    return result_of(views_of(17, noise_px=0.007, camera=camera), (316, 208))


def _outliers() -> Intrinsics:
    views = views_of(5, noise_px=0.05)
    views[2].pixels[7] += [40.0, -25.0]
    fit = calibrate(pack(views), (640, 480), "radial2", loss="cauchy")
    return Intrinsics(fit, covariance(fit), Judgement("poor", (), (), (), {}), (), (), "rigid", (), {})


CASES = {
    "one view": _one_view,
    "400 views": _many_views,
    "no distortion, odd names": _no_distortion_and_odd_names,
    "upright picture": _upright,
    "sigma not bounded": _unbounded,
    "no tilt": lambda: _tilted(0.0, 4),
    "failed fit": _failed,
    "not finite": _not_finite,
    "no residuals": _exact,
    "outliers": _outliers,
    "precise": _precise,
}


SLOW = pytest.mark.slow
QUICK = ("sigma not bounded", "no distortion, odd names")


@pytest.mark.parametrize("case", [c if c in QUICK else pytest.param(c, marks=SLOW) for c in CASES])
def test_all_figures_are_legible(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = CASES[case]()
    with kept(monkeypatch, camera_figures) as figures:
        write_camera_figures(tmp_path, result)
    assert len(figures) == 6
    with camera_figures.look():
        for name, figure in figures.items():
            assert complaints(figure) == [], name


def _words(result: Intrinsics, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    with kept(monkeypatch, camera_figures) as figures:
        write_camera_figures(folder, result)
    with camera_figures.look():
        return "\n".join(text.get_text() for text in drawn_texts(figures[f"camera_{name}.png"]))


def test_what_is_not_bounded_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = _unbounded()
    assert "not bounded" in _words(result, "sigma", tmp_path, monkeypatch)
    assert "not estimated" in _words(result, "coverage", tmp_path, monkeypatch)
    assert "verdict: unidentifiable" in _words(result, "poses", tmp_path, monkeypatch)
