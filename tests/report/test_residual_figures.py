"""Residuals in figures: chance is called chance, structure is called structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from figure_checks import drawn_texts

from calib.camera.bundle import Calibration, calibrate
from calib.camera.views import pack
from calib.report.residual_figures import _cell_means, error_figure, residual_figure
from calib.report.style import look
from synthetic import CAMERA, views_of

FIT = calibrate(pack(views_of(12, noise_px=0.1)), (640, 480), "radial2")


def _with_residuals(residuals: np.ndarray) -> Calibration:
    return replace(FIT, residuals_px=residuals)


def _outside(fit: Calibration) -> tuple[int, int]:
    at = fit.observations.pixels.reshape(-1, 2)
    means = _cell_means(fit, at, fit.residuals_px.reshape(-1, 2), fit.weights.ravel())
    return int(means.outside.sum()), len(means.at)


def test_chance_leaves_one_disc_in_twenty() -> None:
    rng = np.random.default_rng(5)
    counts = []
    for _ in range(150):
        noise = rng.standard_normal(FIT.residuals_px.shape) * 0.1
        # The spread is estimated from the residuals with the fit's degrees of freedom; undo that here.
        noise *= np.sqrt(FIT.degrees_of_freedom / (2 * FIT.observations.points))
        fit = _with_residuals(noise)
        counts.append(_outside(fit))
    outside, cells = np.sum(counts, axis=0)
    # 150 sets of about 40 cells: the share of 5 % is known to 0.3 %; the fit's freedom takes part of it.
    assert 0.03 < outside / cells < 0.06


def test_a_field_that_the_noise_hides_leaves_most_discs() -> None:
    rng = np.random.default_rng(6)
    noise = rng.standard_normal(FIT.residuals_px.shape) * 0.1
    pixels = FIT.observations.pixels
    swirl = 0.1 * np.stack([-(pixels[..., 1] - 240) / 240, (pixels[..., 0] - 320) / 320], axis=-1)
    outside, cells = _outside(_with_residuals(noise + swirl))
    assert outside > 0.4 * cells
    with look():
        words = " ".join(t.get_text() for t in drawn_texts(residual_figure(_with_residuals(noise + swirl))))
    assert f"{outside} of {cells} means leave" in words.replace("\n", " ")


def test_means_are_means_over_their_cells() -> None:
    residuals = np.zeros_like(FIT.residuals_px)
    pixels = FIT.observations.pixels
    right = pixels[..., 0] >= 319.5
    residuals[right] = [0.3, -0.1]
    residuals += 0.01 * np.random.default_rng(1).standard_normal(residuals.shape)
    fit = _with_residuals(residuals)
    means = _cell_means(fit, pixels.reshape(-1, 2), residuals.reshape(-1, 2), fit.weights.ravel())
    far = means.at[:, 0] > 319.5
    np.testing.assert_allclose(means.mean[far], np.tile([0.3, -0.1], (int(far.sum()), 1)), atol=0.012)
    np.testing.assert_allclose(means.mean[~far], 0.0, atol=0.012)


def test_a_rejected_weight_takes_a_point_out_of_the_mean() -> None:
    views = views_of(6, noise_px=0.05)
    views[0].pixels[3] += [30.0, 0.0]
    fit = calibrate(pack(views), CAMERA.image_size_px, "radial2", loss="cauchy")
    at, vectors = fit.observations.pixels.reshape(-1, 2), fit.residuals_px.reshape(-1, 2)
    means = _cell_means(fit, at, vectors, fit.weights.ravel())
    assert np.abs(means.mean).max() < 0.15


def test_points_beyond_the_panel_are_counted() -> None:
    residuals = FIT.residuals_px.copy()
    residuals[0, 0] = [9.0, 0.0]
    with look():
        words = [t.get_text() for t in drawn_texts(error_figure(_with_residuals(residuals)))]
    assert any("1 farther out, up to 9.00 px" in text for text in words)
