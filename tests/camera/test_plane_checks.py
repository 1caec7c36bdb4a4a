"""Each way in which pictures fail to support a plane is noticed, and good pictures are left in peace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.camera.board import Board
from calib.camera.model import Camera, project
from calib.camera.placement import world_points_m
from calib.camera.plane import Plane, calibrate_plane
from calib.camera.plane_checks import compare_pictures
from calib.camera.pose import fit_pose, rotation
from calib.camera.views import View
from calib.errors import BadInputError

THESIS = Camera(
    "radial2", (316, 208), 273.66, 273.66, 0.0, 157.5, 103.5, np.array([-0.2201, 0.5494, 0, 0, 0, 0, 0, 0])
)
BOARD = Board(7, 5, 0.02)
WORLD = world_points_m(BOARD, (-0.06, 0.02), 0.05)
CENTRE = WORLD.mean(axis=0)
COVARIANCE = np.diag(np.array([1.0, 1.0, 0.5, 0.5, 0, 0.005, 0.03, 0, 0, 0, 0, 0, 0]) ** 2)


def pose_at(tilt_rad: float, distance_m: float, about: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A camera that looks at the board's centre with the plane tilted about the picture's u or v axis."""
    w = np.zeros(3)
    w[about] = tilt_rad
    R = rotation(w)
    return R, np.array([0.0, 0.0, distance_m]) - R[:, :2] @ CENTRE


def picture(
    name: str,
    R: np.ndarray,
    t: np.ndarray,
    noise_px: float = 0.1,
    camera: Camera = THESIS,
    world: np.ndarray = WORLD,
    seed: int = 0,
) -> View:
    pixels = project(camera, world @ R[:, :2].T + t)
    return View(name, world, pixels + np.random.default_rng(seed).normal(0.0, noise_px, pixels.shape))


def several(count: int, tilt_rad: float = 0.3, distance_m: float = 0.3) -> list[View]:
    return [picture(f"{i}.png", *pose_at(tilt_rad, distance_m), seed=i) for i in range(count)]


@pytest.mark.parametrize("tilt", [-0.6, 0.0, 0.05, 0.5])
@pytest.mark.parametrize("distance", [0.25, 0.5])
@pytest.mark.parametrize("count", [1, 4])
def test_good_pictures_are_ok(tilt: float, distance: float, count: int) -> None:
    plane = calibrate_plane(THESIS, COVARIANCE, several(count, tilt, distance), camera_rms_px=0.14)
    assert (plane.verdict, plane.reasons, plane.notes) == ("ok", (), ())


def test_a_camera_that_moved_between_pictures_is_noticed() -> None:
    R, t = pose_at(0.3, 0.3)
    views = several(3)
    views.append(picture("moved.png", R, t + np.array([0.0008, 0.0, 0.0]), seed=9))
    plane = calibrate_plane(THESIS, COVARIANCE, views)
    assert plane.verdict == "inconsistent"
    assert "moved.png" in plane.reasons[0]
    assert plane.pictures[3].moved_px > 2 * plane.pictures[0].moved_px


def test_false_alarms_of_movement_are_rare() -> None:
    probabilities = []
    for trial in range(60):
        views = [
            picture("a", *pose_at(0.3, 0.3), seed=2 * trial),
            picture("b", *pose_at(0.3, 0.3), seed=2 * trial + 1),
        ]
        world = np.concatenate([WORLD, WORLD])
        pose = fit_pose(THESIS, world, np.concatenate([view.pixels for view in views]))
        probabilities.append(compare_pictures(THESIS, views, pose)[1].probability)
    # Under no movement the probability is uniform: mean 0.5 with standard error 0.04.
    assert abs(np.mean(probabilities) - 0.5) < 0.12
    assert np.mean(np.array(probabilities) < 0.05) < 0.15


def test_a_shaking_camera_widens_the_sigma() -> None:
    rng = np.random.default_rng(3)
    R, t = pose_at(0.3, 0.3)
    still = calibrate_plane(THESIS, None, several(6))
    shaken = [picture(f"{i}", R, t + rng.normal(0, 1e-4, 3), seed=i) for i in range(6)]
    plane = calibrate_plane(THESIS, None, shaken)
    assert np.mean(plane.sigma.plane_mm) > 1.5 * np.mean(still.sigma.plane_mm)


def test_a_plane_seen_edge_on() -> None:
    world = world_points_m(BOARD, (0.0, 0.0), 0.0)

    def at(elevation_deg: float) -> Plane:
        R = rotation(np.array([np.radians(90 - elevation_deg), 0.0, 0.0]))
        t = np.array([0.0, 0.0, 0.3]) - R[:, :2] @ world.mean(axis=0)
        return calibrate_plane(THESIS, COVARIANCE, [picture("a", R, t, 0.02, world=world)])

    assert at(30.0).verdict == "ok"
    shallow, lost = at(10.0), at(2.0)
    assert shallow.verdict == "poor"
    assert any("nearly edge-on, at 10" in reason for reason in shallow.reasons)
    assert lost.verdict == "unidentifiable"
    assert "edge-on" in lost.reasons[0]


def test_a_horizon_in_the_picture() -> None:
    R, t = pose_at(1.3, 0.4)
    plane = calibrate_plane(THESIS, COVARIANCE, [picture("a", R, t)])
    assert plane.verdict == "poor"
    assert any("horizon crosses the picture" in reason for reason in plane.reasons)


def test_a_speck_in_the_distance_is_unidentifiable() -> None:
    R, t = pose_at(0.3, 6.0)
    assert calibrate_plane(THESIS, COVARIANCE, [picture("a", R, t)]).verdict == "unidentifiable"


def test_a_large_rms_is_named() -> None:
    R, t = pose_at(0.3, 0.3)
    plane = calibrate_plane(THESIS, COVARIANCE, [picture("a", R, t, noise_px=1.5)])
    assert plane.verdict == "poor"
    assert "limit 1" in plane.reasons[0]
    plane = calibrate_plane(THESIS, COVARIANCE, [picture("a", R, t, noise_px=0.4)], camera_rms_px=0.1)
    assert plane.verdict == "poor"
    assert "camera's own 0.10 px" in plane.reasons[0]


def test_intrinsics_of_another_camera_are_noticed() -> None:
    other = replace(THESIS, fx_px=400.0, fy_px=400.0)
    plane = calibrate_plane(other, COVARIANCE, [picture("a", *pose_at(0.6, 0.22))])
    assert plane.verdict == "poor"
    assert any("free homography" in reason for reason in plane.reasons)


def test_squares_that_are_not_square_are_noticed() -> None:
    view = picture("a", *pose_at(0.1, 0.25), world=WORLD * np.array([1.0, 1.06]))
    plane = calibrate_plane(THESIS, COVARIANCE, [View("a", WORLD, view.pixels)])
    assert plane.verdict == "poor"
    assert any("proportions of the board" in reason for reason in plane.reasons)


def test_two_tilts_that_fit_alike_are_told() -> None:
    far = Camera("pinhole", (640, 480), 900.0, 900.0, 0.0, 319.5, 239.5)
    R, t = pose_at(0.6, 2.8)
    told = 0
    for seed in range(5):
        plane = calibrate_plane(
            far, None, [picture("a", R, t, 0.5, far, seed=seed)], workspace_m=(-0.2, -0.1, 0.2, 0.2)
        )
        told += any("tilted the other way" in reason for reason in plane.reasons)
    near = calibrate_plane(far, None, [picture("a", *pose_at(0.6, 0.4), 0.5, far)])
    assert told >= 3
    assert near.verdict == "ok"


def test_corners_in_one_spot_do_not_fix_a_far_workspace() -> None:
    world = Board(3, 3, 0.006).points_m()
    R = rotation(np.array([0.3, 0.1, 0.0]))
    t = np.array([0.0, 0.0, 0.3])
    plane = calibrate_plane(
        THESIS, None, [picture("a", R, t, 0.5, world=world)], workspace_m=(-0.1, -0.06, 0.1, 0.06)
    )
    assert plane.verdict == "poor"
    assert any("do not fix the plane over the workspace" in reason for reason in plane.reasons)


def test_a_workspace_out_of_the_picture() -> None:
    views = several(1)
    partly = calibrate_plane(THESIS, COVARIANCE, views, workspace_m=(-0.05, 0.02, 0.2, 0.1))
    assert partly.verdict == "ok"
    assert "14 % of the workspace is outside the picture" in partly.notes[0]
    mostly = calibrate_plane(THESIS, COVARIANCE, views, workspace_m=(-0.05, 0.02, 0.5, 0.1))
    assert mostly.verdict == "poor"
    assert "56 % of the workspace is outside the picture" in mostly.reasons[0]
    nowhere = calibrate_plane(THESIS, COVARIANCE, views, workspace_m=(1.0, 1.0, 1.2, 1.2))
    assert nowhere.verdict == "poor"
    assert "no part of the workspace" in nowhere.reasons[0]


def test_intrinsics_that_are_not_known_leave_no_plane_known() -> None:
    plane = calibrate_plane(THESIS, np.diag(np.full(13, np.inf)), several(1))
    assert plane.verdict == "poor"
    assert any("covariance is infinite" in reason for reason in plane.reasons)
    assert np.all(np.isinf(plane.sigma.total_mm))


def test_what_is_missing_is_noted() -> None:
    view = several(1)[0]
    four = [0, 6, 28, 34]
    plane = calibrate_plane(THESIS, None, [View("a", WORLD[four], view.pixels[four])])
    assert len(plane.notes) == 2
    assert "intrinsics is not known" in plane.notes[0]
    assert "2 degrees of freedom" in plane.notes[1]


@pytest.mark.parametrize(
    ("view", "words"),
    [
        (View("a", WORLD[:3], WORLD[:3]), "at least 4 different corners, got 3"),
        (View("a", WORLD[[0, 1, 2, 2]], WORLD[:4] * 1e3), "at least 4 different corners, got 3"),
        (View("a", WORLD[:7], WORLD[:7] * 1e3), "one line"),
        (View("a.png", WORLD, np.full((35, 2), np.nan)), "a.png: a corner's position is not a finite number"),
        (View("a.png", WORLD, np.zeros((34, 2))), r"a.png: world points \(35, 2\) and pixels \(34, 2\)"),
        (View("a", WORLD, WORLD * np.array([-1e3, 1e3])), "mirrored"),
    ],
)
def test_what_supports_no_plane_is_refused(view: View, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        calibrate_plane(THESIS, None, [view])


def test_no_picture_at_all_is_refused() -> None:
    with pytest.raises(BadInputError, match="no picture"):
        calibrate_plane(THESIS, None, [])
