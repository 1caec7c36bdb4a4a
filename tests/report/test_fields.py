"""Levels, arrows, ellipses and maps: against their definitions and against what is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from figure_checks import drawn_texts
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.quiver import Quiver

from calib.report.fields import (
    arrows,
    contour_levels,
    contour_map,
    ellipse,
    grid_over,
    magnified,
    panel_height_in,
    picture_frame,
)
from calib.report.style import look, sheet

finite = st.floats(1e-12, 1e12)


@given(finite, st.floats(1.01, 1e8), st.booleans())
def test_levels_enclose_the_values_and_are_few(low: float, ratio: float, even: bool) -> None:
    values = np.array([low, np.nan, low * ratio, np.inf, low * (1 + ratio) / 2])
    levels = contour_levels(values, even=even)
    assert np.all(np.diff(levels) > 0)
    assert levels[0] <= low * (1 + 1e-9)
    assert levels[-1] >= low * ratio * (1 - 1e-9)
    assert 2 <= len(levels) <= 14


@given(finite, finite)
def test_magnification_fills_the_reach_to_a_tenth(reach: float, longest: float) -> None:
    times = magnified(reach, longest)
    assert 0.9 * reach <= times * longest <= reach * (1 + 1e-9)
    assert f"{times:.1e}" == f"{float(f'{times:g}'):.1e}"


@pytest.mark.parametrize("longest", [0.0, -1.0, np.inf, np.nan])
def test_nothing_to_magnify(longest: float) -> None:
    assert magnified(5.0, longest) == 1.0


def test_the_ellipse_is_the_covariance() -> None:
    spread = np.array([[4.0, 1.5], [1.5, 1.0]])
    drawn = ellipse((3.0, -2.0), spread, 2.0, "black")
    border = drawn.get_patch_transform().transform(drawn.get_path().vertices[::3])
    offset = border - [3.0, -2.0]
    distance = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(spread), offset))
    np.testing.assert_allclose(distance, 2.0, rtol=1e-6)


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


def test_pictures_point_downwards_and_keep_their_shape() -> None:
    with look():
        axes = sheet(3.0, "title").subplots()
        picture_frame(axes, (316, 208))
    assert axes.yaxis_inverted()
    assert axes.get_aspect() == 1.0
    assert (
        panel_height_in(6.0, (1920, 1080))
        < panel_height_in(6.0, (640, 480))
        < panel_height_in(6.0, (480, 640))
    )
    u, v = grid_over((316, 208), 17)
    assert (u[0], u[-1], v[0], v[-1]) == (0.0, 315.0, 0.0, 207.0)
    assert np.diff(u)[0] == pytest.approx(np.diff(v)[0], rel=0.2)


@pytest.mark.parametrize(
    ("fill", "words"),
    [
        (np.nan, "no value is known"),
        (np.inf, "not bounded"),
        (0.25, "0.250 mm everywhere"),
        (0.0, "0 mm everywhere"),
    ],
)
def test_maps_without_contours_say_so(fill: float, words: str) -> None:
    with look():
        figure = sheet(3.0, "title")
        axes = figure.subplots()
        drawn = contour_map(axes, np.arange(5.0), np.arange(4.0), np.full((4, 5), fill), "mm")
        assert drawn is None
        assert any(words in text.get_text() for text in drawn_texts(figure))


def test_contours_carry_their_values() -> None:
    x, y = np.linspace(0, 10, 41), np.linspace(0, 6, 31)
    with look():
        figure = sheet(4.0, "title")
        axes = figure.subplots()
        axes.set(xlim=(0, 10), ylim=(0, 6))
        assert contour_map(axes, x, y, np.tile(x, (31, 1)), "px") is not None
        labels = [
            t for t in drawn_texts(figure) if t.axes is axes and t.get_text().replace(".", "").isdigit()
        ]
        for label in labels:
            if label.get_rotation():
                assert label.get_position()[0] == pytest.approx(float(label.get_text()), abs=0.05)
        assert sum(bool(label.get_rotation()) for label in labels) >= 3
