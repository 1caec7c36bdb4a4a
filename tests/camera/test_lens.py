"""The lens: distortion's figures and its inverse polynomial over whole pictures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.stages.camera.bundle import rotation_exp
from calib.stages.camera.lens import (
    PlaneView,
    analyse_distortion,
    displacement_field,
    distortion_kind,
    fit_inverse,
    pixel_grid,
    projection_sigma_px,
    shown_once,
    undistort_by_polynomial,
)
from calib.stages.camera.model import (
    Camera,
    camera_from_vector,
    distort,
    distorted_normalised,
    fold_radius,
    one_to_one_reach,
    project,
    undistort,
    vector_from_camera,
)

FOCAL = 158.0 / np.tan(np.radians(30.0))
THESIS = Camera(
    "radial2", (316, 208), FOCAL, FOCAL, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
PLANE = PlaneView(
    rotation_exp(np.array([[0.2, -0.1, 0.05]]))[0], np.array([0.0, -0.07, 0.25]), (-0.06, 0.04, 0.06, 0.11)
)
COVARIANCE = np.diag(np.array([1.2, 1.2, 0.5, 0.5, 0, 0.012, 0.08, 0, 0, 0, 0, 0, 0]) ** 2)


def lens(**coefficients: float) -> Camera:
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return replace(THESIS, distortion=np.array([coefficients.get(name, 0.0) for name in order]))


def test_the_figures_of_the_source_document() -> None:
    """Errata B: up to 1.9 px (mean 0.54) in the central 160x120 px, 3.6 px in the corners, mustache."""
    report = analyse_distortion(THESIS)
    assert report.region_px == [78.0, 44.0, 237.0, 163.0]
    assert report.region_max_px == pytest.approx(1.9, abs=0.05)
    assert report.region_mean_px == pytest.approx(0.54, abs=0.005)
    assert report.max_px == pytest.approx(3.6, abs=0.05)
    assert report.kind == "mustache"
    assert report.monotonic
    assert report.effect == "matters"
    assert report.inverse.max_error_px <= 0.006


def test_displacement_against_opencv() -> None:
    camera = Camera(
        "brown5",
        (640, 480),
        530.0,
        541.0,
        0.0,
        322.0,
        236.0,
        np.array([-0.28, 0.09, 1e-3, -9e-4, 0.02, 0, 0, 0]),
    )
    pixels = pixel_grid(camera.image_size_px, most=2000)
    maps = cv2.initUndistortRectifyMap(
        camera.K, camera.distortion[:5], np.eye(3), camera.K, (640, 480), cv2.CV_32FC2
    )[0]
    rows, columns = np.round(pixels[..., 1]).astype(int), np.round(pixels[..., 0]).astype(int)
    whole = np.stack([columns, rows], axis=-1).astype(float)
    assert np.abs(whole + displacement_field(camera, whole) - maps[rows, columns]).max() < 1e-3


@pytest.mark.parametrize(
    ("coefficients", "kind"),
    [
        ({}, "none"),
        ({"k2": 0.2}, "pincushion"),
        ({"k1": -0.1, "k2": -0.2}, "barrel"),
        ({"k1": -0.3, "k2": 0.001}, "mustache"),
        ({"k1": -0.2201, "k2": 0.5494, "p2": 1e-3}, "mustache"),
        ({"k4": 0.3}, "barrel"),
        ({"k1": 0.5, "k4": 0.5}, "none"),
        ({"k1": 0.5, "k4": 0.2}, "pincushion"),
    ],
)
def test_kinds_have_their_usual_names(coefficients: dict[str, float], kind: str) -> None:
    assert distortion_kind(lens(**coefficients)) == kind


def test_cost_on_the_plane() -> None:
    report = analyse_distortion(THESIS, plane=PLANE)
    assert report.plane_max_mm is not None
    # A pixel of the displacement is worth about depth / focal length.
    mm_per_px = 250.0 / FOCAL
    assert report.plane_max_mm == pytest.approx(report.region_max_px * mm_per_px, rel=0.4)
    assert report.plane_mean_mm < report.plane_max_mm
    # A homography fitted to the distorted pixels takes up a part of it.
    assert report.refitted_max_mm < 0.6 * report.plane_max_mm
    assert report.refitted_mean_mm < report.plane_mean_mm
    u0, v0, u1, v1 = report.region_px
    assert 0 <= u0 < u1 <= 315
    assert 0 <= v0 < v1 <= 207
    nothing = analyse_distortion(lens(), plane=PLANE)
    assert nothing.plane_max_mm is not None
    assert nothing.plane_max_mm < 1e-9
    assert nothing.refitted_max_mm < 1e-6


def test_projection_sigma_against_draws_with_the_best_rotation_taken_off() -> None:
    rng = np.random.default_rng(2)
    grid = pixel_grid(THESIS.image_size_px, most=400).reshape(-1, 2)
    at = np.array([[10.0, 10.0], [157.0, 103.0], [300.0, 150.0]])
    both = np.concatenate([grid, at])
    rays = np.column_stack([(both - [157.5, 103.5]) / FOCAL, np.ones(len(both))])
    c = vector_from_camera(THESIS)
    still = project(THESIS, rays)
    errors = []
    for _ in range(400):
        drawn = camera_from_vector("radial2", THESIS.image_size_px, rng.multivariate_normal(c, COVARIANCE))
        turn = np.zeros(3)
        for _ in range(3):
            seen = project(drawn, rays @ rotation_exp(turn[None])[0].T)
            columns = [
                (project(drawn, rays @ rotation_exp((turn + d)[None])[0].T) - seen)[: len(grid)].ravel()
                / 1e-6
                for d in 1e-6 * np.eye(3)
            ]
            left = (still - seen)[: len(grid)].ravel()
            turn = turn + np.linalg.lstsq(np.stack(columns, axis=1), left, rcond=None)[0]
        errors.append((project(drawn, rays @ rotation_exp(turn[None])[0].T) - still)[len(grid) :])
    empirical = np.sqrt(np.mean(np.array(errors) ** 2, axis=(0, 2)))
    assert projection_sigma_px(THESIS, COVARIANCE, at) == pytest.approx(empirical, rel=0.1)


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
    "fisheye": Camera(
        "fisheye4",
        (640, 480),
        330.0,
        332.0,
        0.5,
        322.0,
        236.0,
        np.array([0.03, -0.01, 0, 0, 4e-3, -1e-3, 0, 0]),
    ),
    "decentering alone": Camera(
        "brown5", (640, 480), 530.0, 541.0, 0.0, 322.0, 236.0, np.array([0, 0, 2e-3, 1e-3, 0, 0, 0, 0])
    ),
}


@pytest.mark.few(0, 4, 6, 8)
@pytest.mark.parametrize("name", CAMERAS)
def test_a_hundredth_of_a_pixel_everywhere(name: str) -> None:
    """Checked against the lens model itself: distorting the answer again gives the pixel back."""
    camera = CAMERAS[name]
    inverse = fit_inverse(camera)
    assert inverse.covered == 1.0 and inverse.max_error_px <= 0.01
    pixels = pixel_grid(camera.image_size_px, most=50_000).reshape(-1, 2)
    x = undistort_by_polynomial(camera, inverse, distorted_normalised(camera, pixels))
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


def test_single_precision_is_enough() -> None:
    for camera in (THESIS, CAMERAS["brown5 with skew"], CAMERAS["12 megapixels"]):
        inverse = fit_inverse(camera)
        pixels = pixel_grid(camera.image_size_px, most=20_000).reshape(-1, 2)
        single = undistort_by_polynomial(
            camera, inverse, distorted_normalised(camera, pixels.astype(np.float32))
        )
        assert single.dtype == np.float32
        error_px = np.linalg.norm((single - undistort(camera, pixels)) @ camera.K[:2, :2].T, axis=1)
        assert error_px.max() <= 0.01


@pytest.mark.parametrize(
    ("distortion", "radius"),
    [
        ([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0], np.inf),
        ([0.3, 0.1, 0, 0, 0, 0, 0, 0], np.inf),
        # A pole next to a zero.
        ([-1.0, 0, 0, 0, 0, -1.0 / 0.98, 0, 0], np.sqrt(0.98)),
        # d/dr (r - r^3 / 3) = 0 at r = 1.
        ([-1 / 3, 0, 0, 0, 0, 0, 0, 0], 1.0),
        # r / (1 + r^2) is greatest at r = 1.
        ([0, 0, 0, 0, 0, 1.0, 0, 0], 1.0),
        # r / (1 - r^2) rises up to its pole.
        ([0, 0, 0, 0, 0, -1.0, 0, 0], 1.0),
        ([0] * 8, np.inf),
    ],
)
def test_where_the_radial_curve_folds(distortion: list[float], radius: float) -> None:
    camera = replace(THESIS, distortion=np.array(distortion, dtype=float))
    found, distorted = fold_radius(camera)
    assert found == pytest.approx(radius)
    if distortion[5] < 0.0:
        assert distorted == np.inf
    elif np.isfinite(radius):
        top = distort(np.array([radius]), np.zeros(1), camera.distortion)[0][0]
        assert distorted == pytest.approx(top)


@pytest.mark.few(0, 2)
@pytest.mark.parametrize(
    ("distortion", "reach"),
    [([-1 / 3, 0, 0, 0, 0, 0, 0, 0], 2 / 3), ([0, 0, 0, 0, 0, -1.0, 0, 0], 1.0), ([0.3] + [0.0] * 7, np.inf)],
)
def test_a_lens_shows_nothing_beyond_its_fold_or_pole(distortion: list[float], reach: float) -> None:
    # The corner is at a normalised radius of 1.25.
    camera = Camera("rational8", (801, 601), 400.0, 400.0, 0.0, 400.0, 300.0, np.array(distortion))
    assert one_to_one_reach(camera) == pytest.approx(reach / 1.25)
    report = analyse_distortion(camera)
    assert report.monotonic == (reach > 1.25)
    # Beyond a pole displacements come from the other side of it, and reach thousands of pixels.
    at = pixel_grid(camera.image_size_px, most=3000).reshape(-1, 2)
    shown = np.isfinite(undistort(camera, at)).all(axis=1)
    radius = np.linalg.norm(undistort(camera, at), axis=1)
    assert not np.any(radius[shown] > fold_radius(camera)[0])
    assert shown_once(camera, at).all() == (fold_radius(camera)[0] > 1.25)
    assert report.max_px < 1000.0
