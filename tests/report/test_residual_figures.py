"""Residuals in figures: chance is called chance, structure is called structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from figure_checks import drawn_texts

from calib.show.style import look
from calib.stages.camera.bundle import Calibration, calibrate
from calib.stages.camera.model import pack
from calib.stages.camera.plots import _cell_means, residual_figure
from synthetic import views_of

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
