"""Figures of a calibration: complete, repeatable, legible, and drawn for whatever the fit came to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.camera.bundle import calibrate
from calib.camera.covariance import covariance
from calib.camera.intrinsics import Intrinsics
from calib.camera.model import Camera
from calib.camera.selection import Candidate
from calib.camera.verdict import Judgement
from calib.camera.views import View, pack
from calib.errors import BadInputError
from calib.report import camera_figures
from calib.report.camera_figures import write_camera_figures
from synthetic import CAMERA, views_of

SIX = ["errors", "residuals", "coverage", "poses", "sigma", "distortion"]


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


@pytest.fixture(scope="module")
def usual() -> Intrinsics:
    return result_of(views_of(9, noise_px=0.1))


def _candidates(count: int, views: int) -> tuple[Candidate, ...]:
    names = ("pinhole", "radial2", "radial3", "brown5", "rational8")[:count]
    rms = (1.9, 0.2101, 0.2098, 0.2097, 0.2090)
    held = (2.1, 0.2122, 0.2125, 0.2139, np.nan)
    return tuple(Candidate(names[i], 4 + i, rms[i], held[i], np.full(views, rms[i])) for i in range(count))


def test_every_figure_is_written(usual: Intrinsics, tmp_path: Path) -> None:
    result = replace(usual, models=_candidates(5, 9), boards=_candidates(2, 9))
    written = write_camera_figures(tmp_path / "new" / "folder", result)
    assert [p.name for p in written] == [f"camera_{name}.png" for name in [*SIX, "models", "boards"]]
    assert sorted(p.name for p in written[0].parent.iterdir()) == sorted(p.name for p in written)
    for path in written:
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.shape[1] == 1196
        assert 300 < picture.shape[0] < 1300
        assert np.all(picture[:3] == 255), "white paper"
        assert picture.std() > 15, "something is drawn"


@pytest.mark.slow
def test_the_bytes_repeat(usual: Intrinsics, tmp_path: Path) -> None:
    result = replace(usual, models=_candidates(5, 9))
    first = write_camera_figures(tmp_path / "a", result)
    for a, b in zip(first, write_camera_figures(tmp_path / "b", result), strict=True):
        assert a.read_bytes() == b.read_bytes()
        assert b"tIME" not in a.read_bytes()
        assert b"Software" not in a.read_bytes()


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


def test_names_are_shown_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = _words(_no_distortion_and_odd_names(), "errors", tmp_path, monkeypatch)
    for name in ("a$b$c.png", "$\\frac{.png", "\\u5199\\u771f.png", "line\\nbreak\\t.png", "_^{}%.png"):
        assert name in words


def test_numbers_in_the_figures_are_those_of_the_fit(
    usual: Intrinsics, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = usual.calibration
    words = _words(usual, "errors", tmp_path, monkeypatch)
    assert f"RMS {fit.rms_px:.3f} px" in words
    assert f"{np.nanmax(fit.view_rms_px):.3f} px in" in words
    distance = np.linalg.norm(fit.residuals_px, axis=2)
    inside = round(100 * float(np.mean(distance <= 2 * fit.sigma_px)))
    assert f"2\N{GREEK SMALL LETTER SIGMA}: {inside} %" in words


def test_a_folder_that_cannot_be_made_is_named(usual: Intrinsics, tmp_path: Path) -> None:
    file = tmp_path / "taken"
    file.write_text("a file")
    with pytest.raises(BadInputError, match="taken: is a file, expected a folder"):
        write_camera_figures(file, usual)
    with pytest.raises(BadInputError, match="no folder for figures can be made here"):
        write_camera_figures(file / "below", usual)
