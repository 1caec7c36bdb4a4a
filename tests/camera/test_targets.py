"""ChArUco boards against rendered truth and OpenCV's own reading."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from boards import Drawing, charuco, inner_corners, pose, render
from sets import camera_of

from calib.core.errors import BadInputError
from calib.io.pictures import list_pictures, read_picture
from calib.stages.camera.corners import detect, find_size
from calib.stages.camera.model import FISHEYE, project
from calib.stages.camera.read import find_boards
from calib.stages.camera.targets import (
    Layout,
    Markers,
    circle_grid,
    detect_charuco,
    find_markers,
    in_place,
    recognise,
    sketch_charuco,
)

BOARDS = {
    "usual": (charuco(8, 6, cv2.aruco.DICT_4X4_50, 0.75), 0.7),
    "before OpenCV 4.6": (charuco(9, 6, cv2.aruco.DICT_5X5_100, 0.7, legacy=True), 0.7),
    "thin margins": (charuco(8, 6, cv2.aruco.DICT_6X6_250, 0.85), 0.5),
    "AprilTags": (charuco(7, 5, cv2.aruco.DICT_APRILTAG_36h11, 0.8), 1.0),
}


def _pictures(drawing: Drawing, count: int, blur_px: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    poses = [pose(drawing, seed) for seed in range(count)]
    pictures = [render(drawing, *p, blur_px=blur_px, seed=k) for k, p in enumerate(poses)]
    return pictures, [inner_corners(drawing, *p) for p in poses]


@pytest.mark.slow
@pytest.mark.parametrize("name", BOARDS)
def test_corners_against_truth_and_opencv(name: str) -> None:
    """Boards cut by the border: more corners than OpenCV finds, each at most half as far off."""
    drawing, blur_px = BOARDS[name]
    pictures, truth = _pictures(drawing, 5, blur_px)
    layout = recognise(pictures)
    assert layout is not None
    assert (layout.columns, layout.rows, layout.first_white) == (
        drawing.columns, drawing.rows, name == "before OpenCV 4.6",
    )  # fmt: skip
    ours, theirs = [], []
    for gray, true in zip(pictures, truth, strict=True):
        detection = detect_charuco(gray, find_markers(gray, layout.dictionary), layout)
        if detection is not None:
            ours.append((detection.pixels - true)[detection.refined])
        corners, ids, _, _ = cv2.aruco.CharucoDetector(drawing.board).detectBoard(gray)
        if ids is not None:
            theirs.append(corners.reshape(-1, 2) - true[ids.ravel()])
    away, opencv = np.concatenate(ours), np.concatenate(theirs)
    assert len(away) > len(opencv)
    assert np.sqrt(np.mean(away**2)) < min(0.02, 0.5 * np.sqrt(np.mean(opencv**2)))
    assert np.abs(away).max() < 0.25


@pytest.mark.parametrize("tilt_rad", [0.2, 0.4])
def test_markers_behind_a_wide_lens_are_in_place(tilt_rad: float) -> None:
    """Their sides change from one to the next, and no homography places the corners."""
    layout, camera = Layout("charuco", "4X4_50", 9, 6), camera_of((800, 600), 150.0, (), FISHEYE)
    R = cv2.Rodrigues(np.array([tilt_rad, tilt_rad, 0.3]))[0]
    t = np.array([0.5, 0.0, 4.0]) - R @ np.array([4.5, 3.0, 0.0])

    def seen(squares: np.ndarray) -> np.ndarray:
        return project(camera, np.pad(squares, ((0, 0), (0, 1))) @ R.T + t)

    ids = np.arange(27)
    corners = layout.places(ids)[:, None] + 0.5 + 0.35 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    markers = Markers(ids, seen(corners.reshape(-1, 2)).reshape(-1, 4, 2))
    kept, share = in_place(markers, layout)
    assert len(kept.ids) == 27
    assert share == pytest.approx(0.7, abs=0.02)
    sketch = sketch_charuco(np.full((600, 800), 200, dtype=np.uint8), markers, layout)
    assert sketch is not None
    inner = np.stack(np.meshgrid(np.arange(1.0, 9.0), np.arange(1.0, 6.0)), axis=-1)
    true = seen(inner.reshape(-1, 2)).reshape(5, 8, 2)
    assert np.linalg.norm(sketch[0] - true, axis=2).max() < 0.05 * np.linalg.norm(true[2, 4] - true[2, 3])


@pytest.mark.slow
def test_a_plain_board_in_one_picture_does_not_hide_the_markers(tmp_path: Path) -> None:
    """As tiles of the floor may pass for."""
    drawing, blur_px = BOARDS["usual"]
    j, i = np.mgrid[: 6 * 96, : 8 * 96] // 96
    plain = Drawing(np.where((i + j) % 2, 255, 0).astype(np.uint8), 8, 6)
    other = render(plain, *pose(plain, 5, 0.6, 0.1))
    assert find_size(other) is not None
    for k, gray in enumerate([*_pictures(drawing, 4, blur_px)[0], other]):
        cv2.imwrite(str(tmp_path / f"{k}.png"), gray)
    found = find_boards(list_pictures([tmp_path]), None, 1.0)
    assert found.layout is not None
    assert [one.name for one in found.left_out] == ["4.png"]


def test_a_charuco_board_is_no_plain_board() -> None:
    drawing, blur_px = BOARDS["usual"]
    for gray in _pictures(drawing, 3, blur_px)[0]:
        assert find_size(gray) is None
        assert detect(gray, drawing.columns - 1, drawing.rows - 1) is None


@pytest.mark.slow
def test_nothing_has_markers_that_has_none(project_root: Path) -> None:
    rng = np.random.default_rng(0)
    views = [read_picture(path).gray for path in list_pictures([project_root / "images"])[:2]]
    clutter = rng.integers(0, 255, (30, 40), dtype=np.uint8)
    blocks = cv2.resize(clutter, (640, 480), interpolation=cv2.INTER_NEAREST)
    assert recognise([*views, np.full((200, 300), 90, dtype=np.uint8), blocks]) is None


@pytest.mark.slow
def test_public_pictures_are_fitted_better_than_by_opencv(shared_data: Path) -> None:
    """17 photographs of a screen; OpenCV's detector with its best marker length, its calibration 5 + 4."""
    from calib.stages.camera.intrinsics import calibrate_camera
    from calib.stages.camera.options import Choices

    paths = list_pictures([shared_data / "pv_charuco"])
    found = find_boards(paths, None, 1.0)
    assert found.layout is not None and found.layout.dictionary == "4X4_50"
    assert (found.board.columns, found.board.rows, len(found.views)) == (7, 7, 17)
    fit = calibrate_camera(found.views, found.image_size_px, Choices(model="brown5")).calibration
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((8, 8), 1.0, 0.75, markers)
    detector = cv2.aruco.CharucoDetector(board)
    points = []
    for path in paths:
        corners, ids, _, _ = detector.detectBoard(read_picture(path).gray)
        points.append(board.matchImagePoints(corners, ids))
    rms = cv2.calibrateCamera(*zip(*points, strict=True), found.image_size_px, None, None)[0]
    assert fit.observations.points > sum(len(target) for target, _ in points)
    assert fit.rms_px < 0.8 * rms


def _circles(columns: int, rows: int, kind: str) -> Drawing:
    wide = 2 * columns + 1 if kind == "asymmetric" else columns + 1
    image = np.full((96 * (rows + 1), 96 * wide), 255, dtype=np.uint8)
    for i, j in np.ndindex(rows, columns):
        x = 2 * j + i % 2 + 1 if kind == "asymmetric" else j + 1
        cv2.circle(image, (96 * x, 96 * (i + 1)), 29 if kind == "symmetric" else 48, 0, -1)
    return Drawing(image, wide, rows + 1)


def _april_grid() -> Drawing:
    """Kalibr's: numbered from below, frames of two cells, a black square between four tags."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    image = np.full((6 * 124 + 28, 6 * 124 + 28), 255, dtype=np.uint8)
    for row, column in np.ndindex(6, 6):
        tag = cv2.aruco.generateImageMarker(tags, 6 * (5 - row) + column, 96, borderBits=2)
        image[124 * row + 28 : 124 * row + 124, 124 * column + 28 : 124 * column + 124] = np.rot90(tag)
    for row, column in np.ndindex(7, 7):
        image[124 * row : 124 * row + 28, 124 * column : 124 * column + 28] = 0
    return Drawing(image, 8, 8)


@pytest.mark.few(0)
@pytest.mark.parametrize(
    ("drawing", "says"),
    [
        (
            _circles(4, 11, "asymmetric"),
            "the pictures show an asymmetric grid of circles, 4x11; calib reads check",
        ),
        (
            _circles(9, 6, "symmetric"),
            "the pictures show a symmetric grid of circles, 9x6; calib reads check",
        ),
        pytest.param(
            _april_grid(),
            "the pictures show a grid of APRILTAG_36H11 markers, 6x6; calib reads checkerboards and Ch",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_other_targets_are_named(drawing: Drawing, says: str, tmp_path: Path) -> None:
    for seed in range(3):
        cv2.imwrite(str(tmp_path / f"{seed}.png"), render(drawing, *pose(drawing, seed, 0.7, 0.1)))
    with pytest.raises(BadInputError, match=says):
        find_boards(list_pictures([tmp_path]), None, 1.0)


def test_a_grid_of_circles_that_the_border_cuts_is_named(tmp_path: Path) -> None:
    drawing = _circles(9, 6, "symmetric")
    for seed in range(3):
        R, t = pose(drawing, seed, 0.7, 0.0)
        cv2.imwrite(str(tmp_path / f"{seed}.png"), render(drawing, R, t)[:, :440])
    with pytest.raises(BadInputError, match="the pictures show a grid of circles; calib reads check"):
        find_boards(list_pictures([tmp_path]), None, 1.0)


def test_round_spots_in_no_grid_are_not_tried_as_one(monkeypatch) -> None:
    rng = np.random.default_rng(4)
    gravel = np.full((480, 640), 60, dtype=np.uint8)
    for centre in rng.integers(0, [640, 480], (400, 2)):
        cv2.circle(gravel, centre.tolist(), int(rng.integers(6, 12)), int(rng.integers(120, 255)), -1)
    tried: list[object] = []
    monkeypatch.setattr(cv2, "findCirclesGrid", lambda *a, **k: tried.append(a) or (False, None))
    assert circle_grid(cv2.GaussianBlur(gravel, (0, 0), 1)) is None
    # At this many round spots OpenCV takes half a second for each size that it is asked for.
    assert len(tried) <= 1
