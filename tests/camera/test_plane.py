"""The plane's maps (2.9), (2.11), (2.12), and the numbers reported with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera.board import Board
from calib.camera.model import Camera, project
from calib.camera.placement import settle_orientation, world_points_m
from calib.camera.plane import (
    calibrate_plane,
    plane_scale,
    to_pixels,
    to_world,
    to_world_without_undistortion,
)
from calib.camera.pose import rotation
from calib.camera.views import View

THESIS = Camera(
    "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
SKEWED = Camera(
    "brown5",
    (640, 480),
    530.0,
    541.0,
    1.7,
    322.0,
    236.0,
    np.array([-0.28, 0.09, 1.3e-3, -9e-4, 0.02, 0, 0, 0]),
)
IDEAL = Camera("pinhole", (316, 208), 273.66, 270.0, 0.4, 157.5, 103.5)
BOARD = Board(7, 5, 0.02)
R_TRUE = rotation(np.array([0.3, -0.2, 0.1]))
T_TRUE = np.array([0.005, -0.055, 0.32])


def picture(camera: Camera, noise_px: float = 0.0, seed: int = 0, angle_rad: float = 0.1) -> View:
    world = world_points_m(BOARD, (-0.06, 0.02), angle_rad)
    pixels = project(camera, world @ R_TRUE[:, :2].T + T_TRUE)
    return View(f"{seed}", world, pixels + np.random.default_rng(seed).normal(0.0, noise_px, pixels.shape))


@pytest.mark.parametrize("camera", [THESIS, SKEWED, IDEAL], ids=["thesis", "skewed brown5", "pinhole"])
def test_exact_pixels_give_the_plane_back(camera: Camera) -> None:
    plane = calibrate_plane(camera, None, [picture(camera)])
    assert np.abs(plane.R_CW - R_TRUE).max() < 1e-12
    assert np.abs(plane.t_CW_m - T_TRUE).max() < 1e-13
    expected = camera.K @ np.column_stack([R_TRUE[:, :2], T_TRUE])
    assert np.abs(plane.A / expected - 1.0).max() < 1e-10
    assert plane.rms_px < 1e-10
    assert plane.rms_mm < 1e-10
    assert plane.verdict == "ok"


@pytest.mark.parametrize("camera", [THESIS, SKEWED, IDEAL], ids=["thesis", "skewed brown5", "pinhole"])
def test_there_and_back_is_exact(camera: Camera) -> None:
    plane = calibrate_plane(camera, None, [picture(camera, 0.2)])
    x, y = np.meshgrid(np.linspace(-0.07, 0.07, 15), np.linspace(0.0, 0.1, 11))
    world = np.stack([x, y], axis=-1)
    pixels = to_pixels(plane, camera, world)
    assert pixels.shape == world.shape
    assert np.abs(to_world(plane, camera, pixels) - world).max() < 1e-12


def test_scale_is_the_depth() -> None:
    plane = calibrate_plane(IDEAL, None, [picture(IDEAL, 0.2)])
    world = np.array([[0.0, 0.0], [0.05, 0.08], [-0.06, 0.03]])
    points_C = world @ plane.R_CW[:, :2].T + plane.t_CW_m
    pixels = to_pixels(plane, IDEAL, world)
    assert plane_scale(plane, pixels) == pytest.approx(points_C[:, 2], rel=1e-12)
    # (2.11) as printed, with the scale of (2.12).
    for pixel, point in zip(pixels, world, strict=True):
        s = plane_scale(plane, pixel)
        assert s * (plane.A_inverse @ np.append(pixel, 1.0)) == pytest.approx(
            np.append(point, 1.0), abs=1e-12
        )


def test_the_homography_needs_the_intrinsics() -> None:
    """(2.9) without K, as printed, does not even map the corners into the picture."""
    view = picture(IDEAL)
    plane = calibrate_plane(IDEAL, None, [view])
    with_K = np.column_stack([view.target_m, np.ones(35)]) @ plane.A.T
    assert with_K[:, :2] / with_K[:, 2:] == pytest.approx(view.pixels, abs=1e-9)
    printed = (
        np.column_stack([view.target_m, np.ones(35)]) @ np.column_stack([plane.R_CW[:, :2], plane.t_CW_m]).T
    )
    assert np.abs(printed[:, :2] / printed[:, 2:]).max() < 1.0


def test_without_undistortion_the_lens_shows_up_in_mm() -> None:
    plane = calibrate_plane(THESIS, None, [picture(THESIS)])
    world = np.array([[0.05, 0.09]])
    pixels = to_pixels(plane, THESIS, world)
    error_mm = 1e3 * np.linalg.norm(to_world_without_undistortion(plane, pixels) - world)
    # The lens moves this point by so many pixels, each worth about depth / focal length.
    ideal_px = project(replace(THESIS, distortion=np.zeros(8)), world @ R_TRUE[:, :2].T + T_TRUE)
    moved_px = np.linalg.norm(pixels - ideal_px)
    depth_m = float((R_TRUE[2, :2] @ world[0]) + T_TRUE[2])
    assert error_mm == pytest.approx(1e3 * moved_px * depth_m / 273.66, rel=0.3)
    ideal = calibrate_plane(IDEAL, None, [picture(IDEAL)])
    pixels = to_pixels(ideal, IDEAL, world)
    assert to_world_without_undistortion(ideal, pixels) == pytest.approx(
        to_world(ideal, IDEAL, pixels), abs=1e-14
    )


def test_beyond_the_horizon_and_behind_the_camera_there_is_nothing() -> None:
    R = rotation(np.array([1.2, 0.0, 0.0]))
    world = world_points_m(BOARD, (-0.06, -0.04), 0.0)
    t = np.array([0.0, 0.0, 0.3])
    plane = calibrate_plane(IDEAL, None, [View("a", world, project(IDEAL, world @ R[:, :2].T + t))])
    behind = -(0.1 + t[2] / R[2, 1]) * np.array([0.0, 1.0])
    assert np.all(np.isnan(to_pixels(plane, IDEAL, behind)))
    horizon_v = IDEAL.fy_px * R[1, 1] / R[2, 1] + IDEAL.cy_px
    assert np.all(np.isfinite(to_world(plane, IDEAL, np.array([157.5, horizon_v - 0.5]))))
    assert np.all(np.isnan(to_world(plane, IDEAL, np.array([157.5, horizon_v + 0.5]))))


def test_rms_in_pixels_and_in_millimetres() -> None:
    view = picture(THESIS, 0.3, seed=4)
    plane = calibrate_plane(THESIS, None, [view])
    error_px = np.linalg.norm(to_pixels(plane, THESIS, view.target_m) - view.pixels, axis=1)
    error_mm = 1e3 * np.linalg.norm(to_world(plane, THESIS, view.pixels) - view.target_m, axis=1)
    assert plane.rms_px == pytest.approx(np.sqrt(np.mean(error_px**2)), rel=1e-9)
    assert plane.mean_error_px == pytest.approx(np.mean(error_px), rel=1e-9)
    assert plane.rms_mm == pytest.approx(np.sqrt(np.mean(error_mm**2)), rel=1e-9)
    assert plane.mean_error_mm == pytest.approx(np.mean(error_mm), rel=1e-9)
    assert plane.sigma_px == pytest.approx(0.3, rel=0.25)


def test_several_pictures_are_one_fit() -> None:
    views = [picture(THESIS, 0.2, seed=seed, angle_rad=angle) for seed, angle in enumerate((0.1, 0.1, -0.4))]
    plane = calibrate_plane(THESIS, None, views)
    one = calibrate_plane(THESIS, None, views[:1])
    assert plane.points == 105
    assert [fit.name for fit in plane.pictures] == ["0", "1", "2"]
    assert plane.verdict == "ok"
    assert np.sqrt(np.mean(plane.sigma.plane_mm**2)) < 0.8 * np.sqrt(np.mean(one.sigma.plane_mm**2))
    whole = np.sqrt(np.mean([fit.rms_px**2 for fit in plane.pictures]))
    assert plane.rms_px == pytest.approx(whole, rel=1e-9)


def test_copies_of_one_picture_bring_no_certainty() -> None:
    one = calibrate_plane(THESIS, None, [picture(THESIS, 0.2)])
    copies = calibrate_plane(THESIS, None, [picture(THESIS, 0.2)] * 5)
    assert copies.sigma.plane_mm == pytest.approx(one.sigma.plane_mm, rel=1e-6)


def test_the_direct_homography_differs_by_the_lens() -> None:
    ideal = calibrate_plane(IDEAL, None, [picture(IDEAL)])
    assert ideal.direct_difference_mm.max() < 1e-9
    assert ideal.direct.rms_px < 1e-9
    lens = calibrate_plane(THESIS, None, [picture(THESIS)])
    assert lens.direct.rms_px > 0.05
    assert 0.1 < lens.direct_difference_mm.max() < 2.0
    assert lens.direct_difference_mm.mean() < lens.direct_difference_mm.max()


@pytest.mark.slow
def test_the_plane_is_recovered_within_its_sigma() -> None:
    """95 % of the positions read with noisy planes lie within 1.96 sigma of the truth, and the pose too."""
    inside, pose_inside = [], []
    truth = np.array([0.02, 0.05])
    pixel = project(THESIS, truth @ R_TRUE[:, :2].T + T_TRUE)
    for seed in range(300):
        plane = calibrate_plane(
            THESIS, None, [picture(THESIS, 0.2, seed=seed)], workspace_m=(0.01, 0.04, 0.03, 0.06)
        )
        sigma = plane.sigma.plane_mm[len(plane.sigma.points_m) // 2]
        error = 1e3 * (to_world(plane, THESIS, pixel) - truth)
        inside.append(np.abs(error) < 1.96 * sigma)
        pose_inside.append(np.abs(plane.t_CW_m - T_TRUE) < 1.96 * np.sqrt(np.diag(plane.covariance)[3:]))
    # 300 draws: one standard error is 1.3 %.
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) < 0.04), np.mean(inside, axis=0)
    assert np.all(np.abs(np.mean(pose_inside, axis=0) - 0.95) < 0.04), np.mean(pose_inside, axis=0)


@pytest.mark.parametrize("angle_deg", [-180.0, -100.0, 0.0, 77.0, 180.0])
def test_a_reversed_detection_gives_the_same_plane(angle_deg: float) -> None:
    angle_rad = np.radians(angle_deg)
    view = picture(THESIS, 0.05, angle_rad=angle_rad)
    planes = []
    for seen in (view.pixels, view.pixels[::-1]):
        placement = settle_orientation(seen, BOARD, angle_rad)
        planes.append(calibrate_plane(THESIS, None, [View("a", view.target_m, placement.pixels)]))
    assert np.array_equal(planes[0].A, planes[1].A)
    assert np.abs(planes[0].R_CW - R_TRUE).max() < 0.01
    # Read the wrong way round the plane would fit as well, half a turn off: nothing but the rule tells.
    wrong = calibrate_plane(THESIS, None, [View("a", view.target_m, view.pixels[::-1])])
    assert wrong.rms_px == pytest.approx(planes[0].rms_px, rel=1e-6)
    assert np.abs(wrong.R_CW - R_TRUE).max() > 1.5
