"""`calib extrinsics`: the plane of the shipped picture, and everything that board.yaml can have wrong."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml


@pytest.fixture
def folder(project_root, tmp_path):
    """A copy of images/plane that may be changed."""
    return shutil.copytree(project_root / "images" / "plane", tmp_path / "plane")


def test_the_shipped_plane(calib, project_root, rig) -> None:
    ended = calib("extrinsics", project_root / "images" / "plane", "--rig", rig)
    assert ended.code == 0
    assert "mm on the plane" in ended.out
    assert "corner (0, 0) was taken at pixel (107.6, 64.7)" in ended.out
    whole = yaml.safe_load(rig.read_text())
    A, A_inverse = np.array(whole["plane"]["A_px_per_m"]), np.array(whole["plane"]["A_inverse"])
    np.testing.assert_allclose(A @ A_inverse, np.eye(3), atol=1e-9)
    assert set(whole["provenance"]["inputs"]["plane"]) == {"board.yaml", "camera", "plane01.png"}


def test_a_camera_has_to_be_there_first(calib, folder, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == f"{rig}: has no camera yet; run calib intrinsics first"
    assert not rig.exists()


def test_without_a_folder_the_default_is_named(calib, rig) -> None:
    ended = calib("extrinsics", "--rig", rig, cwd=rig.parent)
    assert ended.code == 3
    assert ended.sentence == "images/plane: does not exist"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("angle_rad: 0.05", "", "angle_rad is missing; the plane needs to know where the board lies"),
        ("angle_rad: 0.05", "angle_rad: 90", "angle_rad is 90, expected less than or equal to 6.2832"),
        ("angle_rad: 0.05", "angle_rad: 3deg", "angle_rad is '3deg', expected a number"),
        ("[-0.058, 0.022]", "[-0.058]", "first_corner_m is [-0.058], expected 2 values"),
        ("[-0.058, 0.022]", "[.nan, 0]", "first_corner_m.0 is nan, expected a finite number"),
        ("[-0.058, 0.022]", "[1.0e+300, 0]", "first_corner_m.0 is 1e+300, expected less than"),
        (
            "corners: [7, 5]",
            "corners: [8, 6]",
            "no board with 8x6 inner corners found in the picture, but one with 7x5",
        ),
        ("square_m: 0.020", "", "square_m is missing"),
        (
            "angle_rad: 0.05",
            "angle_rad: 0.05\nfirst_corner_px: [9, 9]",
            "corners that can be the first are seen at",
        ),
    ],
)
def test_a_wrong_board_file(calib, folder, rig, old: str, new: str, says: str) -> None:
    path, before = folder / "board.yaml", rig.read_bytes()
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert says in ended.sentence
    assert rig.read_bytes() == before


def test_no_board_file_and_no_board(calib, folder, rig) -> None:
    gray = cv2.imread(str(folder / "plane01.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "plane01.png"), gray * 0)
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert "no board with 7x5 inner corners found in the picture, and no other" in ended.sentence
    (folder / "board.yaml").unlink()
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(f"{folder / 'board.yaml'}: corners is missing")


def test_pictures_of_another_size(calib, folder, rig) -> None:
    gray = cv2.imread(str(folder / "plane01.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "plane01.png"), cv2.resize(gray, (632, 416)))
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == "plane01.png: is 632x416 px, expected 316x208 px"


def test_a_plane_is_no_better_than_its_camera(calib, folder, rig) -> None:
    rig.write_text(rig.read_text().replace("verdict: ok", "verdict: poor", 1))
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 1
    assert "verdict: poor\n  - The camera's own verdict is poor" in ended.out
    assert yaml.safe_load(rig.read_text())["plane"]["verdict"] == "poor"


def test_a_plane_of_another_camera_is_not_used(calib, rig, points, folder, tmp_path) -> None:
    calib("intrinsics", points, "--image-size", "640x480", "--model", "radial2", "--rig", rig)
    for words in (("distortion",), ("firmware", "-o", tmp_path / "out")):
        ended = calib(*words, "--rig", rig)
        assert ended.code == 3
        assert "plane was calibrated with another camera than the one in camera" in ended.sentence
    assert not (tmp_path / "out").exists()


def test_json(calib, folder, rig) -> None:
    ended = calib("extrinsics", folder, "--rig", rig, "--json")
    document = json.loads(ended.out)
    assert (ended.code, document["verb"], document["plane"]["verdict"]) == (0, "extrinsics", "ok")
    assert document["pictures_without_board"] == []
