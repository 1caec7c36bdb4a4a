"""The inverse polynomial: accuracy over whole pictures, shortness, honesty where it cannot work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera.model import Camera, distort, project, undistort
from calib.camera.undistortion import (
    distorted_normalised,
    exact_inverse,
    fit_inverse,
    fold_radius,
    pixel_grid,
    undistort_by_polynomial,
)

FOCAL = 158.0 / np.tan(np.radians(30.0))
THESIS = Camera(
    "radial2", (316, 208), FOCAL, FOCAL, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
CAMERAS = {
    "thesis": THESIS,
    "barrel": replace(THESIS, distortion=np.array([-0.3, 0.1, 0, 0, 0, 0, 0, 0])),
    "pincushion": replace(THESIS, distortion=np.array([0.4, 0.2, 0, 0, 0, 0, 0, 0])),
    "radial3": Camera(
        "radial3", (640, 480), 533.0, 533.0, 0.0, 342.0, 233.0, np.array([-0.28, 0.02, 0, 0, 0.15, 0, 0, 0])
    ),
    "brown5 with skew": Camera(
        "brown5",
        (640, 480),
        530.0,
        541.0,
        1.7,
        322.0,
        236.0,
        np.array([-0.28, 0.09, 1.3e-3, -9e-4, 0.02, 0, 0, 0]),
    ),
    "badly centred": Camera(
        "brown5",
        (640, 480),
        530.0,
        541.0,
        0.0,
        322.0,
        236.0,
        np.array([-0.28, 0.09, 1.3e-2, -9e-3, 0.02, 0, 0, 0]),
    ),
    "rational8": Camera(
        "rational8",
        (640, 480),
        530.0,
        541.0,
        0.0,
        322.0,
        236.0,
        np.array([0.5, 0.09, 1.3e-3, -9e-4, 0.02, 0.8, 0.1, 0.004]),
    ),
    "12 megapixels": Camera(
        "brown5",
        (4000, 3000),
        3500.0,
        3500.0,
        0.0,
        2010.0,
        1480.0,
        np.array([-0.2, 0.09, 5e-4, -4e-4, 0, 0, 0, 0]),
    ),
    "decentering alone": Camera(
        "brown5", (640, 480), 530.0, 541.0, 0.0, 322.0, 236.0, np.array([0, 0, 2e-3, 1e-3, 0, 0, 0, 0])
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_a_hundredth_of_a_pixel_everywhere(name: str) -> None:
    """Checked against the lens model itself: distorting the answer again gives the pixel back."""
    camera = CAMERAS[name]
    inverse = fit_inverse(camera)
    assert inverse.good_enough
    pixels = pixel_grid(camera.image_size_px, most=50_000).reshape(-1, 2)
    x = undistort_by_polynomial(inverse, distorted_normalised(camera, pixels))
    again = project(camera, np.column_stack([x, np.ones(len(x))]))
    # Distorting magnifies a distance at most by the steepest slope of the lens model, below 3 here.
    assert np.linalg.norm(again - pixels, axis=1).max() < 3 * 0.01
    exact = undistort(camera, pixels)
    error_px = np.linalg.norm((x - exact) @ camera.K[:2, :2].T, axis=1)
    assert error_px.max() <= 0.01
    assert inverse.max_error_px == pytest.approx(error_px.max(), abs=2e-3)


def test_the_thesis_lens() -> None:
    """Errata B: 0.006 px or better is within reach of a short polynomial."""
    inverse = fit_inverse(THESIS)
    assert inverse.max_error_px <= 0.006
    assert len(inverse.radial) == 5
    assert inverse.decentering_steps == 0


def test_the_shortest_is_taken() -> None:
    loose, tight = fit_inverse(THESIS, 0.5), fit_inverse(THESIS, 1e-3)
    assert len(loose.radial) < len(fit_inverse(THESIS).radial) < len(tight.radial)
    assert loose.max_error_px <= 0.5
    assert tight.max_error_px <= 1e-3
    # One coefficient less than taken does not reach the tolerance: the minimum over all of c1 ... c4.
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [315, 207], (3000, 2))
    w, x = distorted_normalised(THESIS, pixels), undistort(THESIS, pixels)
    rho = np.sum(w**2, axis=1)
    wanted = (np.linalg.norm(x, axis=1) / np.sqrt(rho) - 1.0) * np.sqrt(rho) * FOCAL
    design = rho[:, None] ** np.arange(1, 5) * np.sqrt(rho)[:, None] * FOCAL
    least_squares = design @ np.linalg.lstsq(design, wanted, rcond=None)[0] - wanted
    # The largest error of any four coefficients is at least the RMS of the least-squares ones.
    assert np.sqrt(np.mean(least_squares**2)) > 0.002
    assert fit_inverse(THESIS, 0.01).tolerance_px == 0.01


def test_single_precision_is_enough() -> None:
    for camera in (THESIS, CAMERAS["brown5 with skew"], CAMERAS["12 megapixels"]):
        inverse = fit_inverse(camera)
        pixels = pixel_grid(camera.image_size_px, most=20_000).reshape(-1, 2)
        single = undistort_by_polynomial(inverse, distorted_normalised(camera, pixels.astype(np.float32)))
        assert single.dtype == np.float32
        error_px = np.linalg.norm((single - undistort(camera, pixels)) @ camera.K[:2, :2].T, axis=1)
        assert error_px.max() <= 0.01


def test_no_distortion_needs_no_polynomial() -> None:
    inverse = fit_inverse(Camera("pinhole", (316, 208), FOCAL, FOCAL, 0.0, 157.5, 103.5))
    assert inverse.radial == ()
    assert inverse.max_error_px < 1e-4
    assert inverse.good_enough


def test_a_lens_that_folds_over_is_admitted() -> None:
    folded = Camera(
        "radial2", (640, 480), 300.0, 300.0, 0.0, 342.0, 231.0, np.array([-0.4, 0.05, 0, 0, 0, 0, 0, 0])
    )
    inverse = fit_inverse(folded)
    assert not inverse.good_enough
    assert 0.2 < inverse.covered < 0.6
    hopeless = fit_inverse(replace(folded, cx_px=5000.0))
    assert hopeless.covered == 0.0
    assert not hopeless.good_enough


@pytest.mark.parametrize(
    ("distortion", "radius"),
    [
        ([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0], np.inf),
        ([0.3, 0.1, 0, 0, 0, 0, 0, 0], np.inf),
        # d/dr (r - r^3 / 3) = 0 at r = 1.
        ([-1 / 3, 0, 0, 0, 0, 0, 0, 0], 1.0),
        # r / (1 + r^2) is greatest at r = 1.
        ([0, 0, 0, 0, 0, 1.0, 0, 0], 1.0),
        # r / (1 - r^2) rises up to its pole.
        ([0, 0, 0, 0, 0, -1.0, 0, 0], np.inf),
        ([0] * 8, np.inf),
    ],
)
def test_where_the_radial_curve_folds(distortion: list[float], radius: float) -> None:
    camera = replace(THESIS, distortion=np.array(distortion, dtype=float))
    found, distorted = fold_radius(camera)
    assert found == pytest.approx(radius)
    if np.isfinite(radius):
        top = distort(np.array([radius]), np.zeros(1), camera.distortion)[0][0]
        assert distorted == pytest.approx(top)


def test_pixels_that_no_ray_reaches_have_no_inverse() -> None:
    camera = replace(THESIS, distortion=np.array([-1 / 3, 0, 0, 0, 0, 0, 0, 0]))
    _, fold = fold_radius(camera)
    pixels = np.array([[157.5 + 0.99 * fold * FOCAL, 103.5], [157.5 + 1.01 * fold * FOCAL, 103.5]])
    assert exact_inverse(camera, pixels)[1].tolist() == [True, False]
    # Beyond a fold that turns up again the lens model answers with a second, wrong point.
    wavy = replace(THESIS, distortion=np.array([-1.2, 0.5, 0, 0, 0, 0, 0, 0]))
    radius, fold = fold_radius(wavy)
    assert radius < 1.0
    ideal, usable = exact_inverse(wavy, np.array([[157.5 + 1.2 * fold * FOCAL, 103.5]]))
    assert not usable[0] or np.linalg.norm(ideal) < radius


def test_pixel_grids() -> None:
    every = pixel_grid((316, 208))
    assert every.shape == (208, 316, 2)
    assert every[0, 0].tolist() == [0.0, 0.0]
    assert every[-1, -1].tolist() == [315.0, 207.0]
    assert np.array_equal(np.unique(np.diff(every[0, :, 0])), [1.0])
    large = pixel_grid((6000, 4000), most=1000)
    assert large.shape[0] * large.shape[1] <= 1100
    assert large[-1, -1].tolist() == [5999.0, 3999.0]
    assert pixel_grid((316, 208), (10.0, 20.0, 10.0, 20.0)).reshape(-1, 2).tolist() == [[10.0, 20.0]]
