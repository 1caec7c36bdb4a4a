"""Targets other than the plain checkerboard from the command line."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from boards import CAMERA, charuco, pose, render

from .conftest import Ended

BOARD = charuco(8, 6, cv2.aruco.DICT_4X4_50, 0.75)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight pictures of a board, most of them cut by the border; the seventh lies upside down."""
    folder = tmp_path_factory.mktemp("charuco")
    for seed in range(8):
        cv2.imwrite(str(folder / f"view{seed + 1}.png"), render(BOARD, *pose(BOARD, seed, 1.0), seed=seed))
    return folder


@pytest.fixture(scope="module")
def made(calib, folder: Path) -> tuple[Ended, Path]:
    """How the calibration of these pictures ended, and its rig.yaml."""
    rig = folder / "rig.yaml"
    return calib(
        "intrinsics", folder, "--rig", rig, "--model", "radial2", "--dictionary", "dict_4x4_250"
    ), rig


def test_partial_views_make_a_camera(calib, folder, made, tmp_path) -> None:
    ended, rig = made
    assert "inner corners and markers of 4X4_50" in ended.err
    assert ended.code == 0, ended.out
    camera = yaml.safe_load(rig.read_text())["camera"]
    assert camera["points"] < 0.9 * 8 * 35
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert abs(camera[name] - getattr(CAMERA, name)) < 3 * camera["sigma"][name]
    few = _few(folder, tmp_path)
    words = ("--corners", "5x7", "--model", "pinhole")
    seen = calib("intrinsics", few, "--rig", tmp_path / "rig.yaml", *words)
    assert seen.code in (0, 1)
    assert "found a ChArUco board with 7x5 inner corners and markers of 4X4_50" in seen.err


def test_a_mirrored_picture_among_others_is_named(calib, folder, tmp_path) -> None:
    few = _few(folder, tmp_path)
    mirrored = cv2.imread(str(few / "view2.png"))[:, ::-1]
    cv2.imwrite(str(few / "view2.png"), mirrored)
    ended = calib("intrinsics", few, "--rig", tmp_path / "rig.yaml", "--model", "pinhole")
    assert "view2.png: shows the ChArUco board mirrored" in ended.out


def _few(folder: Path, place: Path) -> Path:
    """Three of the pictures."""
    few = place / "few"
    few.mkdir()
    for k in (1, 2, 3):
        shutil.copy(folder / f"view{k}.png", few)
    return few


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("--dictionary", "4x4_20"), 2, r"--dictionary: '4x4_20' is no dictionary of markers, .* 4X4_250"),
        (("--dictionary", "6X6_50"), 3, r"no ChArUco board with markers of 6X6_50 found in any of 3 pic"),
        (("--corners", "9x6"), 3, "no board with 9x6 .* in any of 3 pictures, but a ChArUco board with 7x5"),
    ],
)
def test_what_the_pictures_do_not_show(calib, folder, tmp_path, words, code, says) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", _few(folder, tmp_path), "--rig", rig, *words)
    assert ended.code == code
    assert re.search(says, ended.sentence)
    assert not rig.exists()


def test_a_plane_by_a_board_that_lies_any_way(calib, made, tmp_path) -> None:
    """The world's axes follow the markers, where a plain board's picture could be read from either end."""
    square_m = 0.02
    rig, plane = Path(shutil.copy(made[1], tmp_path)), tmp_path / "plane"
    plane.mkdir()
    text = (
        "corners: [7, 5]\nsquare_m: 0.02\nfirst_corner_m: [0.02, 0.02]\nangle_rad: 0.0\ndictionary: 4X4_50\n"
    )
    (plane / "board.yaml").write_text(text)
    R = cv2.Rodrigues(np.array([0.2, 0.1, 0.0]))[0] @ cv2.Rodrigues(np.array([0.0, 0.0, 2.5]))[0]
    t = np.array([0.3, -0.2, 8.0]) - R @ np.array([4.0, 3.0, 0.0])
    cv2.imwrite(str(plane / "plane.png"), render(BOARD, R, t))
    ended = calib("extrinsics", plane, "--rig", rig)
    assert ended.code in (0, 1), ended.err
    section = yaml.safe_load(rig.read_text())["plane"]
    np.testing.assert_allclose(section["R_CW"], R, atol=5e-3)
    np.testing.assert_allclose(section["t_CW_m"], square_m * t, atol=5e-3 * 8 * square_m)
    assert "markers say" in section["orientation"]
    (plane / "board.yaml").write_text(text.replace("4X4_50", "4X4_51"))
    ended = calib("extrinsics", plane, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(f"{plane / 'board.yaml'}: dictionary: '4X4_51' is no dictionary of mark")
