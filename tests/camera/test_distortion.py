"""What distortion does and costs, against the source document's figures and independent computations."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calib.camera.distortion import (
    PlaneView,
    analyse_distortion,
    central_region,
    displacement_field,
    distortion_kind,
    projection_sigma_px,
)
from calib.camera.model import Camera, project, undistort
from calib.camera.pose import rotation
from calib.camera.projection import camera_from_vector, vector_from_camera
from calib.camera.undistortion import pixel_grid
from calib.errors import BadInputError

FOCAL = 158.0 / np.tan(np.radians(30.0))
THESIS = Camera(
    "radial2", (316, 208), FOCAL, FOCAL, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
PLANE = PlaneView(
    rotation(np.array([0.2, -0.1, 0.05])), np.array([0.0, -0.07, 0.25]), (-0.06, 0.04, 0.06, 0.11)
)
COVARIANCE = np.diag(np.array([1.2, 1.2, 0.5, 0.5, 0, 0.012, 0.08, 0, 0, 0, 0, 0, 0]) ** 2)


def lens(**coefficients: float) -> Camera:
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return replace(THESIS, distortion=np.array([coefficients.get(name, 0.0) for name in order]))


def test_the_figures_of_the_source_document() -> None:
    """Errata B: up to 1.9 px (mean 0.54) in the central 160x120 px, 3.6 px in the corners, mustache."""
    report = analyse_distortion(THESIS)
    assert report.region_px == (78.0, 44.0, 237.0, 163.0)
    assert report.region_max_px == pytest.approx(1.9, abs=0.05)
    assert report.region_mean_px == pytest.approx(0.54, abs=0.005)
    assert report.max_px == pytest.approx(3.6, abs=0.05)
    assert report.kind == "mustache"
    assert report.monotonic
    assert report.verdict == "matters"
    assert report.inverse.max_error_px <= 0.006


def test_displacement_is_b1() -> None:
    """(B.1) written out; inwards where the bracket is negative."""
    mu, nu = 230.0, 60.0
    x, y = (mu - 157.5) / FOCAL, (nu - 103.5) / FOCAL
    bracket = -0.2201 * (x * x + y * y) + 0.5494 * (x * x + y * y) ** 2
    assert bracket < 0
    moved = displacement_field(THESIS, np.array([mu, nu]))
    assert moved == pytest.approx([(mu - 157.5) * bracket, (nu - 103.5) * bracket], rel=1e-10)


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
        ({"k1": 0.1}, "pincushion"),
        ({"k1": 0.1, "k2": 0.2}, "pincushion"),
        ({"k2": 0.2}, "pincushion"),
        ({"k1": -0.1}, "barrel"),
        ({"k1": -0.1, "k2": -0.2}, "barrel"),
        ({"k1": -0.2201, "k2": 0.5494}, "mustache"),
        ({"k1": 0.2, "k2": -0.5}, "mustache"),
        # The signs decide for k1, k2 alone, also where the turn is far outside the picture.
        ({"k1": -0.3, "k2": 0.001}, "mustache"),
        ({"p1": 1e-3}, "decentering"),
        # The curve decides for richer models.
        ({"k1": -0.3, "k2": 0.001, "p1": 1e-4}, "barrel"),
        ({"k1": -0.2201, "k2": 0.5494, "p2": 1e-3}, "mustache"),
        ({"k1": -0.3, "k2": 0.1, "k3": -0.01}, "barrel"),
        ({"k3": 0.1}, "pincushion"),
        ({"k4": 0.3}, "barrel"),
        ({"k4": -0.3}, "pincushion"),
        ({"k1": 0.5, "k4": 0.5}, "none"),
        ({"k1": 0.5, "k4": 0.5, "p1": 1e-3}, "decentering"),
        ({"k1": 0.2, "k4": 0.5}, "barrel"),
        ({"k1": 0.5, "k4": 0.2}, "pincushion"),
    ],
)
def test_kinds_have_their_usual_names(coefficients: dict[str, float], kind: str) -> None:
    assert distortion_kind(lens(**coefficients)) == kind


def test_pincushion_bends_the_borders_inwards_and_barrel_outwards() -> None:
    """The name as one sees it: the middle of a straight border against its ends, from the centre."""
    for k1, sign in ((0.2, 1.0), (-0.2, -1.0)):
        camera = lens(k1=k1)
        border = np.array([[0.0, 0.0], [157.5, 0.0], [315.0, 0.0]])
        v = (border + displacement_field(camera, border))[:, 1]
        assert sign * (v[1] - 0.5 * (v[0] + v[2])) > 1.0


def test_whether_the_curve_rises_throughout() -> None:
    fine = analyse_distortion(lens(k1=-0.3))
    assert fine.monotonic
    assert fine.fold_px == pytest.approx(FOCAL * (1 / np.sqrt(0.9)) * (2 / 3), rel=1e-6)
    assert fine.corner_px == pytest.approx(np.hypot(157.5, 103.5), rel=1e-9)
    folded = analyse_distortion(lens(k1=-1.5))
    assert not folded.monotonic
    assert not folded.inverse.good_enough
    assert np.any(~np.isfinite(undistort(lens(k1=-1.5), np.array([[0.0, 0.0]]))))


def test_cost_on_the_plane() -> None:
    report = analyse_distortion(THESIS, plane=PLANE)
    assert report.plane is not None
    # A pixel of the displacement is worth about depth / focal length.
    mm_per_px = 250.0 / FOCAL
    assert report.plane.max_mm == pytest.approx(report.region_max_px * mm_per_px, rel=0.4)
    assert report.plane.mean_mm < report.plane.max_mm
    # A homography fitted to the distorted pixels takes up a part of it.
    assert report.plane.refitted_max_mm < 0.6 * report.plane.max_mm
    assert report.plane.refitted_mean_mm < report.plane.mean_mm
    u0, v0, u1, v1 = report.region_px
    assert 0 <= u0 < u1 <= 315
    assert 0 <= v0 < v1 <= 207
    nothing = analyse_distortion(lens(), plane=PLANE)
    assert nothing.plane is not None
    assert nothing.plane.max_mm < 1e-9
    assert nothing.plane.refitted_max_mm < 1e-6


def test_the_verdict_holds_the_cost_against_the_sigma_of_the_plane() -> None:
    cost = analyse_distortion(THESIS, plane=PLANE).plane
    assert cost is not None
    for factor, verdict in ((0.9, "matters"), (1.1, "negligible")):
        known = replace(PLANE, sigma_mm=factor * cost.max_mm)
        report = analyse_distortion(THESIS, plane=known)
        assert report.verdict == verdict
        assert f"{cost.max_mm:.3f} mm" in report.reasons[0]


def test_the_verdict_without_a_plane_needs_every_pixel_below_sigma() -> None:
    assert analyse_distortion(THESIS, COVARIANCE).verdict == "matters"
    faint = lens(k1=-2e-4, k2=5e-4)
    report = analyse_distortion(faint, COVARIANCE)
    assert report.verdict == "negligible"
    assert report.region_sigma_px is not None
    assert 0.0 < report.region_sigma_px < 0.5
    # The same lens with the sigma a thousandth of that.
    assert analyse_distortion(faint, 1e-6 * COVARIANCE).verdict == "matters"
    unknown = analyse_distortion(faint)
    assert unknown.verdict == "matters"
    assert "no sigma is known" in unknown.reasons[0]
    infinite = np.diag(np.full(13, np.inf))
    assert analyse_distortion(faint, infinite).region_sigma_px is None
    assert analyse_distortion(lens()).verdict == "negligible"


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
            seen = project(drawn, rays @ rotation(turn).T)
            columns = [
                (project(drawn, rays @ rotation(turn + d).T) - seen)[: len(grid)].ravel() / 1e-6
                for d in 1e-6 * np.eye(3)
            ]
            left = (still - seen)[: len(grid)].ravel()
            turn = turn + np.linalg.lstsq(np.stack(columns, axis=1), left, rcond=None)[0]
        errors.append((project(drawn, rays @ rotation(turn).T) - still)[len(grid) :])
    empirical = np.sqrt(np.mean(np.array(errors) ** 2, axis=(0, 2)))
    assert projection_sigma_px(THESIS, COVARIANCE, at) == pytest.approx(empirical, rel=0.1)


def test_regions() -> None:
    assert central_region((316, 208)) == (78.0, 44.0, 237.0, 163.0)
    u0, v0, u1, v1 = central_region((640, 480))
    assert (u1 - u0 + 1) / 640 == pytest.approx(160 / 316, abs=2e-3)
    assert (v1 - v0 + 1) / 480 == pytest.approx(120 / 208, abs=2e-3)
    assert central_region((1, 1)) == (0.0, 0.0, 0.0, 0.0)
    whole = analyse_distortion(THESIS, region_px=(0.0, 0.0, 315.0, 207.0))
    assert whole.region_max_px == whole.max_px
    assert whole.region_mean_px == pytest.approx(whole.mean_px)
    for box in ((-1.0, 0.0, 10.0, 10.0), (0.0, 0.0, 316.0, 10.0), (20.0, 0.0, 10.0, 10.0)):
        with pytest.raises(BadInputError, match="inside the picture of 316x208"):
            analyse_distortion(THESIS, region_px=box)


def test_a_workspace_out_of_sight_leaves_no_cost() -> None:
    report = analyse_distortion(THESIS, plane=replace(PLANE, workspace_m=(5.0, 5.0, 6.0, 6.0)))
    assert report.plane is None
    assert report.region_px == central_region((316, 208))
