"""Figures of the lens: complete, repeatable, legible, and the numbers those of the lens model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from figure_checks import complaints, drawn_texts, kept

from calib.stages.camera import plots as lens_figures
from calib.stages.camera.bundle import calibrate, covariance
from calib.stages.camera.lens import PlaneView, analyse_distortion
from calib.stages.camera.model import Camera, pack
from calib.stages.camera.plots import _inverse_error, _radial, _radial_sigma, write_lens_figures
from synthetic import CAMERA, views_of

BROWN = Camera(
    "brown5", (316, 208), 273.0, 272.0, 0.4, 160.0, 102.0, np.array([-0.22, 0.55, 2e-3, -3e-3, 0.05, 0, 0, 0])
)
FOLDING = replace(CAMERA, distortion=np.array([-0.9, 0.1, 0, 0, 0, 0, 0, 0.0]))
PINHOLE = Camera("pinhole", (1920, 1080), 1500.0, 1500.0, 0.0, 960.0, 540.0)
UPRIGHT = replace(CAMERA, image_size_px=(480, 640), cx_px=240.0, cy_px=320.0)


@pytest.mark.parametrize("name", ["CAMERA", "BROWN", "FOLDING", "PINHOLE", "UPRIGHT"])
def test_all_figures_are_legible(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = globals()[name]
    plane = PlaneView(np.eye(3), np.array([0.0, -0.07, 0.3]), (-0.06, 0.04, 0.06, 0.11), 0.05)
    report = analyse_distortion(camera, plane=plane)
    with kept(monkeypatch, lens_figures) as figures:
        write_lens_figures(tmp_path, camera, report)
    with lens_figures.look():
        for file, figure in figures.items():
            assert complaints(figure) == [], file
        words = " ".join(
            t.get_text().replace("\n", " ") for t in drawn_texts(figures["lens_displacement.png"])
        )
    assert f"verdict: {report.verdict}" in words
    if name == "PINHOLE":
        assert "no distortion" in words
    if name == "FOLDING":
        assert "folds over" in words


def test_the_band_is_the_spread_of_repeated_calibrations() -> None:
    radius = np.array([100.0, 200.0, 300.0])
    clean = pack(views_of(8))
    rng = np.random.default_rng(2)
    curves = []
    for _ in range(120):
        noisy = replace(clean, pixels=clean.pixels + 0.1 * rng.standard_normal(clean.pixels.shape))
        fit = calibrate(noisy, (640, 480), "radial2")
        curves.append(_radial(fit.camera, radius))
    reported = _radial_sigma(fit.camera, covariance(fit, 0.01), radius)
    # 120 samples give a standard deviation to 6.5 %.
    np.testing.assert_allclose(np.std(curves, axis=0, ddof=1), reported, rtol=0.2)


@pytest.mark.parametrize("camera", [CAMERA, BROWN])
def test_the_drawn_error_is_the_reported_one(camera: Camera) -> None:
    report = analyse_distortion(camera)
    width, height = camera.image_size_px
    border = np.stack(np.meshgrid(np.linspace(0, width - 1, 80), np.linspace(0, height - 1, 60)), -1).reshape(
        -1, 2
    )
    error = _inverse_error(camera, report.inverse, border)
    assert np.isfinite(error).all()
    assert error.max() <= report.inverse.max_error_px * 1.02 + 1e-4
    assert error.max() > 0.5 * report.inverse.max_error_px
