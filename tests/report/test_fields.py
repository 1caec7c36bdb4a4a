"""Levels, arrows, ellipses and maps: against their definitions and against what is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from figure_checks import drawn_texts
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.quiver import Quiver

from calib.show.style import look, sheet
from calib.stages.camera.plots import arrows, contour_levels, picture_frame

finite = st.floats(1e-12, 1e12)


@given(finite, st.floats(1.01, 1e8), st.booleans())
def test_levels_enclose_the_values_and_are_few(low: float, ratio: float, even: bool) -> None:
    values = np.array([low, np.nan, low * ratio, np.inf, low * (1 + ratio) / 2])
    levels = contour_levels(values, even=even)
    assert np.all(np.diff(levels) > 0)
    assert levels[0] <= low * (1 + 1e-9)
    assert levels[-1] >= low * ratio * (1 - 1e-9)
    assert 2 <= len(levels) <= 14


def test_arrows_have_the_length_that_they_claim() -> None:
    at = np.array([[10.0, 20.0], [50.0, 60.0], [np.nan, 1.0]])
    vectors = np.array([[0.5, -0.25], [-1.0, 0.0], [1.0, 1.0]])
    with look():
        figure = sheet(3.0, "title")
        axes = figure.subplots()
        picture_frame(axes, (100, 80))
        times = arrows(axes, at, vectors, 8.0)
        words = [text.get_text() for text in drawn_texts(figure)]
        quiver = next(artist for artist in axes.get_children() if isinstance(artist, Quiver))
    assert times == pytest.approx(8.1, abs=0.15)
    assert len(quiver.U) == 2, "a vector that is not finite is left out"
    # The tips of the polygons, in the data's units.
    for polygon, start, vector in zip(quiver.get_paths(), at, vectors, strict=False):
        shape = quiver.get_transform().transform(polygon.vertices)
        tip = shape[np.argmax(np.linalg.norm(shape, axis=1))]
        pixels_per_unit = axes.transData.transform([1.0, 0.0])[0] - axes.transData.transform([0.0, 0.0])[0]
        expected = times * vector * [1.0, -1.0] * pixels_per_unit
        np.testing.assert_allclose(tip, expected, atol=0.02 * np.linalg.norm(expected) + 0.5)
        del start
    assert "1 px" in words, "the key"
