"""`calib live`: the session, its folder, its server and its page."""

from __future__ import annotations

import contextlib
import http.client
import http.server
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from boards import CAMERA as MARKED_CAMERA
from boards import charuco
from boards import render as marked
from chromium import browser_or_skip
from liveboards import BOARD, CAMERA, Person, about, follow, random_poses, write_y4m
from markervideos import Scene
from sentframes import encoded
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from calib.cli.main import main
from calib.core.arrays import GrayImage
from calib.core.errors import BadInputError
from calib.core.geometry import box_grid
from calib.io.frames import next_frame
from calib.io.logs import read_log
from calib.io.serial import Frame, Inputs, Outputs
from calib.live import server
from calib.live.album import Album
from calib.live.marker import Marker
from calib.live.plane import Flat
from calib.live.server import MOST_BYTES, Live
from calib.live.session import ENOUGH, Seen, Session, edges
from calib.live.sources import MOST_PIXELS, Source, Watched, source_of
from calib.stages.camera.bundle import calibrate, covariance, projection_sigma_px
from calib.stages.camera.checks import tilted
from calib.stages.camera.intrinsics import calibrate_camera
from calib.stages.camera.model import Board, Camera, View, pack
from calib.stages.camera.options import Told
from calib.stages.camera.read import BoardFile
from calib.twin.scene import Light, Pose, PrintedBoard, Sensor, corner_pixels, pose_facing, render

PATIENCE_S = 300.0
"""Each wait ends with what it waits for; on a busy machine that may be late."""


def session() -> Session:
    return Session(square_m=BOARD.square_m, size_px=CAMERA.image_size_px)


# ----------------------------------------------------------------------
# The session.


@pytest.mark.slow
def test_from_the_first_frame_to_enough() -> None:
    """A person who follows the outline gets a camera that is ok and within its sigmas of the true one."""
    live = session()
    poses = follow(live, Person(np.random.default_rng(0)))
    assert live.corners == (BOARD.columns, BOARD.rows)
    assert 8 <= len(poses) <= 25 and live.enough and live.gain is not None and live.gain < ENOUGH
    assert live.fit is not None and live.fit.verdict.ok
    found, sigma = live.fit.calibration.camera, live.fit.covariance.sigma()
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert abs(getattr(found, name) - getattr(CAMERA, name)) < 4 * sigma[name], name
    worst = [one.worst_sigma_px for one in live.history]
    # Sigma holds what printers do to squares, which pictures lower less than noise.
    assert worst[-1] < 0.55 * worst[3]
    shown = live.shown()
    assert json.dumps(shown, allow_nan=False)
    assert sum(map(sum, shown["coverage"])) == BOARD.corners * len(poses)
    assert len(shown["tilts"]) == len(poses) and np.abs(shown["tilts"]).max() > 25


@pytest.mark.slow
def test_guided_pictures_are_worth_twice_as_many_taken_at_random() -> None:
    """Worst projection sigma of twelve pictures, at the same noise of corners, over the whole picture."""
    noise_px, count = 0.1, 12
    width, height = CAMERA.image_size_px
    pixels = box_grid((0.0, 0.0, width - 1.0, height - 1.0), 17, 13).reshape(-1, 2)

    def worst(views: list[View]) -> float:
        fit = calibrate(pack(views), CAMERA.image_size_px, "radial2")
        known = covariance(fit, noise_px**2)
        return float(np.nanmax(projection_sigma_px(fit, known, pixels)))

    guided, chance = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        person, live, random = Person(rng), session(), []
        live.corners = (BOARD.columns, BOARD.rows)
        some = random_poses(rng)

        def view(pose: Any, rng: np.random.Generator = rng) -> View:
            pixels = corner_pixels(CAMERA, PrintedBoard(BOARD), pose)
            return View(
                f"{len(pixels)}", BOARD.points_m(), pixels + noise_px * rng.standard_normal(pixels.shape)
            )

        for k in range(count):
            live.views[f"v{k}"] = view(person.pose_at(live.ghost()))
            live.fitted(calibrate_camera(list(live.views.values()), CAMERA.image_size_px))
            random.append(view(next(some)))
        guided.append(worst(list(live.views.values())))
        chance.append(worst(random))
    ratio = float(np.median(guided) / np.median(chance))
    print(f"worst projection sigma, {count} pictures: guided over random {ratio:.2f}")
    assert ratio < 0.5


def test_what_is_told_and_not_taken() -> None:
    live, person = session(), Person(np.random.default_rng(1))
    live.corners = (BOARD.columns, BOARD.rows)
    pose = person.pose_at(live.ghost())

    def last(codes: int, **frame: Any) -> Seen:
        for k in range(codes):
            seen = live.look(person.frame(pose, **frame), time.monotonic() + 0.2 * k)
        return seen

    assert last(4, motion_px=(7.0, 0.0)).code == "blurred"
    assert last(4, motion_px=(0.0, 7.0)).code == "blurred"
    assert last(4, light=Light(level=0.09)).code == "dark"
    blank = render(CAMERA, background=0.4)
    assert live.look(blank, 0.0).code == "no board"
    taken = live.accept(person.frame(pose), "a.png")
    assert isinstance(taken, View)
    live.fitted(None)
    assert last(4).code == "alike" and not last(4).take
    again = live.accept(person.frame(pose), "b.png")
    assert isinstance(again, Seen) and again.says == "Too like a.png."
    assert isinstance(live.accept(person.frame(pose), "b.png", by_hand=True), View)
    other = live.look(cv2.resize(blank, (160, 120)), 0.0)
    assert other.code == "size" and "160x120" in other.says and "320x240" in other.says


def test_a_board_that_comes_in_from_the_side_is_not_taken_for_a_smaller_one() -> None:
    live, person = session(), Person(np.random.default_rng(3))
    whole = person.frame(person.pose_at(live.ghost()))
    grid = session().found(whole)[0]
    square = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
    for columns in (4, 3, 2):
        # The border runs through the middle of a square.
        out = int(np.sort(grid[..., 0].mean(axis=0))[columns] - 0.5 * square)
        seen = live.look(np.ascontiguousarray(np.pad(whole[:, out:], ((0, 0), (0, out)), "edge")), 0.0)
        assert (seen.code, live.corners) == ("no board", None), columns
    # A hand on it makes it smaller as well, until all of it is shown.
    hand = whole.copy()
    hand[:, : int(np.sort(grid[..., 0].mean(axis=0))[1] + 0.3 * square)] = 120
    live.look(hand, 0.0)
    assert live.corners is not None and live.corners[0] < BOARD.columns
    live.look(whole, 0.1)
    assert live.corners == (BOARD.columns, BOARD.rows)


def test_what_else_is_held_into_the_picture_is_named() -> None:
    drawing = charuco(8, 6, cv2.aruco.DICT_4X4_50, 0.75).image
    picture = cv2.resize(np.pad(drawing, 96, constant_values=255), (400, 320), interpolation=cv2.INTER_AREA)
    live = Session(corners=(9, 6))
    assert [live.look(picture, t_s).says[:28] for t_s in (0.0, 1.0)] == ["Show the whole board of 9x6 "] * 2
    assert "shows a ChArUco board: show one of 9x6 inner corners, or" in live.look(picture, 3.0).says
    person = Person(np.random.default_rng(0))
    other = Session(corners=(9, 6), size_px=CAMERA.image_size_px)
    whole = person.frame(person.pose_at(session().ghost()))
    assert "whole board of 9x6 inner corners" in other.look(whole, 0.0).says
    says = other.look(whole, 3.0).says
    assert "A board of 8x5 inner corners is seen, expected 9x6: show" in says
    assert "a new folder with --corners 8x5" in says


MARKED = charuco(8, 6, cv2.aruco.DICT_4X4_50, 0.75)


@dataclass
class Holder(Person):
    """A person with a ChArUco board."""

    camera: Camera = MARKED_CAMERA
    board: Board = field(default_factory=lambda: Board(7, 5, 1.0))

    def frame(self, pose: Pose, *_: Any) -> GrayImage:  # type: ignore[override]
        self.seed += 2
        return marked(MARKED, pose.R_CB, pose.t_m - pose.R_CB @ [1.0, 1.0, 0.0], seed=self.seed)


def test_a_charuco_board_leads_as_well_and_a_part_of_it_is_enough(tmp_path: Path) -> None:
    live, person = Session(), Holder(np.random.default_rng(0))
    width, height = MARKED_CAMERA.image_size_px
    whole = person.frame(about(tilted(20.0, "top"), np.array([0.0, 0.0, 9.0]), person.board))
    # Rows that no picture has shown yet are not known of.
    part = np.full_like(whole, 90)
    part[height // 2 - 100 :] = whole[: height // 2 + 100]
    assert live.look(part, 0.0).corners_px is not None and live.corners is not None
    assert live.corners[0] == 7 and live.corners[1] in (3, 4)
    first = live.accept(part, "a.png", by_hand=True)
    assert isinstance(first, View) and first.measured is not None
    assert live.board_file() == BoardFile(dictionary="4X4_50")
    assert live.look(part, 0.1).code == "alike"
    assert live.look(whole, 0.2).code == "move"
    second = live.accept(whole, "b.png")
    assert live.corners == (7, 5) and isinstance(second, View) and second.measured is not None
    assert second.measured.all()
    again = live.accept(part, "c.png")
    assert isinstance(again, Seen) and again.says == "Too like a.png."
    # Beyond the left border two columns lie.
    left = np.roll(whole, -int(np.sort(second.pixels[:, 0])[12]), axis=1)
    left[:, width - int(np.sort(second.pixels[:, 0])[12]) :] = 90
    seen = live.look(left, 0.3)
    assert seen.corners_px is not None and not ((seen.corners_px > 0).all())
    third = live.accept(left, "c.png", by_hand=True)
    assert isinstance(third, View) and third.measured is not None and 15 <= third.measured.sum() < 30
    blurred = np.asarray(cv2.GaussianBlur(whole, (0, 0), 3.0))
    assert live.look(blurred, 0.4).code in ("blurred", "no board")
    # In the plane its markers say which corner is (0, 0).
    live.square_m, flat = 0.02, Flat(live)
    assert flat.look(whole).code == "hold" and flat.take(whole, png(whole)).code == "taken"
    assert (len(flat.ends), flat.chosen) == (1, 0)
    assert flat.place({"x_mm": 10, "y_mm": 0, "angle_deg": 0}) == BoardFile(
        corners=[7, 5], square_m=0.02, dictionary="4X4_50", first_corner_m=[0.01, 0.0], angle_rad=0.0
    )
    # What it has saved is read as it was seen.
    album = Album(tmp_path)
    album.open(Told())
    album.describe(live.board_file())
    assert (album.images / "board.yaml").read_text() == "square_m: 0.02\ndictionary: 4X4_50\n"
    for name, one in (("a.png", part), ("b.png", whole), ("c.png", left)):
        album.add(name, png(one))
    board, views, size_px = album.open(Told())
    assert (board, size_px) == (BoardFile(square_m=0.02, dictionary="4X4_50"), (width, height))
    # Of the first the corners under its last markers count too, now that they are known to be some.
    counts = [int(np.sum(one.measured)) for one in views]
    assert counts == [28, second.measured.sum(), third.measured.sum()]
    on = Session(None, board.square_m, size_px, board.dictionary)
    on.views.update((one.name, one) for one in views)
    assert on.look(whole, 0.0).code == "alike" and on.corners == (7, 5)


def test_a_charuco_board_of_a_stated_size_has_it() -> None:
    person = Holder(np.random.default_rng(0))
    whole = person.frame(about(tilted(20.0, "top"), np.array([0.0, 0.0, 9.0]), person.board))
    live = Session(corners=(7, 9))
    assert live.look(whole, 0.0, still=True).corners_px is not None
    assert live.corners == (7, 9) and live.board_file().corners == [7, 9]
    other = Session(corners=(9, 6))
    assert "shows a ChArUco board: show one of 9x6" in other.look(whole, 0.0, still=True).says


@pytest.mark.slow
def test_a_charuco_board_from_the_first_frame_to_enough() -> None:
    live, person = Session(), Holder(np.random.default_rng(1))
    live.look(person.frame(next(random_poses(person.rng, person.camera, person.board))), -5.0)
    poses = follow(live, person)
    assert 8 <= len(poses) <= 25 and live.fit is not None and live.fit.verdict.ok
    found, sigma = live.fit.calibration.camera, live.fit.covariance.sigma()
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert abs(getattr(found, name) - getattr(MARKED_CAMERA, name)) < 4 * sigma[name], name


@pytest.mark.parametrize("shape", [(1, 1), (1, 4000), (4000, 1), (3, 4000)])
def test_a_frame_of_a_few_pixels_shows_no_board(shape: tuple[int, int]) -> None:
    for live in (Session(), Session(corners=(9, 6))):
        assert live.look(np.full(shape, 128, dtype=np.uint8), 0.0).code == "no board"


@pytest.mark.parametrize("size_px", [(640, 480), (480, 640), (720, 1280)])
@pytest.mark.parametrize("corners", [(8, 5), (5, 8), (4, 3)])
def test_the_first_outlines_are_in_the_picture(size_px: tuple[int, int], corners: tuple[int, int]) -> None:
    """Those of a camera that is mounted upright too."""
    live = Session(corners=corners, size_px=size_px)
    for k in range(4):
        box = live.ghost().box_px
        assert box.min() > 0 and np.all(box < size_px)
        live.views[f"{k}"] = View("", np.zeros((0, 3)), np.zeros((0, 2)))


def test_a_pose_whose_picture_the_fit_leaves_out_is_not_asked_for_again() -> None:
    rng, live = np.random.default_rng(0), session()
    live.corners = (BOARD.columns, BOARD.rows)
    for k, pose in zip(range(4), random_poses(rng), strict=False):
        pixels = corner_pixels(CAMERA, PrintedBoard(BOARD), pose)
        live.views[f"{k}"] = View(f"{k}", BOARD.points_m(), pixels + 0.1 * rng.standard_normal(pixels.shape))
    fit = calibrate_camera(list(live.views.values()), CAMERA.image_size_px)
    live.fitted(fit)
    for k in range(4, 7):
        grid = np.stack(live.ghost().lines_px[: BOARD.rows])
        live.views[f"{k}"] = View(f"{k}", BOARD.points_m(), grid.reshape(-1, 2))
        # As where its corners scatter too much.
        live.fitted(fit)
        other = np.stack(live.ghost().lines_px[: BOARD.rows])
        assert np.sqrt(((other - grid) ** 2).sum(axis=-1).mean()) > 0.02 * CAMERA.image_size_px[0]


def test_the_blur_of_edges_is_measured() -> None:
    pose = pose_facing(CAMERA, PrintedBoard(BOARD), (160.0, 120.0), 0.35, 0.3, 0.5)
    grid = corner_pixels(CAMERA, PrintedBoard(BOARD), pose).reshape(BOARD.rows, BOARD.columns, 2)
    for blur_px in (1.0, 2.0, 3.0):
        sensor = Sensor(blur_px=blur_px, noise_grey=1.0)
        gray = render(CAMERA, PrintedBoard(BOARD), pose, sensor=sensor, background=0.35)
        assert edges(gray, grid)[0] == pytest.approx(np.hypot(blur_px, 0.29), rel=0.2)


def test_a_board_that_moves_is_followed_in_a_fraction_of_the_time_that_finding_it_takes() -> None:
    """As near to the corners as a drawing shows, and no part of it is taken for the whole."""
    person, live = Person(np.random.default_rng(0)), Session(corners=(BOARD.columns, BOARD.rows))
    spent = []
    for k in range(16):
        middle = (150.0 + 2.5 * k, 130.0 - 2.0 * k)
        pose = pose_facing(CAMERA, PrintedBoard(BOARD), middle, 0.4, 0.5 - 0.03 * k, 0.5 + 0.1 * k)
        gray = cv2.resize(person.frame(pose), (640, 480))
        began = time.process_time()
        seen = live.look(gray, 0.1 * k)
        spent.append(time.process_time() - began)
        assert seen.corners_px is not None
        truth = 2.0 * corner_pixels(CAMERA, PrintedBoard(BOARD), pose).reshape(seen.corners_px.shape) + 0.5
        off = min(np.abs(seen.corners_px - turn).max() for turn in (truth, truth[::-1, ::-1]))
        assert off < 0.5, k
        # What `look` begins with, each time anew.
        live._before = live._before if k % 4 else None
    found, followed = np.median(spent[1::4]), np.median(spent[2::4] + spent[3::4])
    print(f"CPU time of a frame of 640x480: {1e3 * found:.0f} ms to find, {1e3 * followed:.0f} ms to follow")
    assert followed < 0.4 * found
    inner = np.sort(seen.corners_px[..., 0].mean(axis=0))
    for out in (inner[1] - 20.0, inner[0] + 3.0):
        cut = np.ascontiguousarray(np.pad(gray[:, int(out) :], ((0, 0), (0, int(out))), "edge"))
        assert live.look(cut, 2.0).corners_px is None
        assert live.look(gray, 2.1).corners_px is not None


# ----------------------------------------------------------------------
# The folder.


def test_pictures_are_never_written_over_and_an_earlier_session_goes_on(
    tmp_path: Path, project_root: Path
) -> None:
    album = Album(tmp_path / "rig")
    assert album.open(Told())[1] == ()
    names = sorted(path.name for path in (project_root / "images").glob("view*.png"))[:5]
    for name in names:
        shutil.copy(project_root / "images" / name, album.images)
    album.describe(BoardFile(corners=[7, 5], square_m=0.02))
    with pytest.raises(BadInputError, match="is there, and is not a picture"):
        album.add(names[0], b"\x89PNG")
    # Of another session in the same folder, while this one writes.
    with pytest.MonkeyPatch.context() as patch, pytest.raises(BadInputError, match="is there, and is not"):
        patch.setattr(os, "fsync", lambda _: (album.images / "x.png").write_bytes(b"another"))
        album.add("x.png", b"\x89PNG")
    assert (album.images / "x.png").read_bytes() == b"another"
    (album.images / "x.png").unlink()
    assert album.drop(names[4]) and album.left_out() == [names[4]] and album.new_name() == "view006.png"
    with pytest.raises(BadInputError, match="is there already"):
        shutil.copy(album.dropped / names[4], album.images / names[4])
        album.drop(names[4])
    (album.images / names[4]).unlink()
    assert album.take_back(names[4]) and not album.drop("../rig.yaml") and album.picture("board.yaml") is None
    # One of another size counts for nothing, though its name comes first.
    other = render(CAMERA, background=0.4)
    cv2.imwrite(str(album.images / "a.png"), other)
    board, views, size_px = album.open(Told())
    assert board.corners == [7, 5] and [view.name for view in views] == names and size_px == (316, 208)
    live = Session((7, 5), size_px=size_px, views={view.name: view for view in views})
    for seen in (live.look(other, 0.0), live.accept(other, "b.png", by_hand=True)):
        assert isinstance(seen, Seen) and "sends 320x240 px, the pictures so far have 316x208" in seen.says
    whole = cv2.imread(str(album.images / names[0]), cv2.IMREAD_GRAYSCALE)
    assert live.look(np.asarray(whole, np.uint8), 1.0).code == "alike"
    with pytest.raises(BadInputError, match="tells another board than --corners"):
        album.open(Told(corners=(8, 5)))


def test_rig_yaml_is_what_intrinsics_writes(tmp_path: Path, project_root: Path) -> None:
    """A folder that is being filled: its pictures are taken, and give the same bytes."""
    watched, rig = tmp_path / "camera", tmp_path / "rig"
    watched.mkdir()
    for path in sorted((project_root / "images").glob("view*.png"))[:6]:
        shutil.copy(path, watched)
    shutil.copy(sorted(watched.iterdir())[0], watched / "view99.png")
    (watched / "x.png").write_bytes(b"\x89PNG")
    with served(rig, Watched(watched, lambda: time.time() + 10)) as live:
        wait(lambda: len(live.album.names()) == 6 and live.state()["saved"] and not live.state()["fitting"])
        wait(lambda: "x.png is not a picture" in live.source.fault)
        # What came half-written is looked at again when the rest has come.
        shutil.copy(sorted((project_root / "images").glob("view*.png"))[7], watched / "x.png")
        wait(lambda: len(live.album.names()) == 7 and live.state()["saved"] and not live.state()["fitting"])
    assert (rig / "images" / "board.yaml").read_text() == "corners: [7, 5]\n"
    written = (rig / "rig.yaml").read_bytes()
    words = ["intrinsics", str(rig / "images"), "--rig", str(tmp_path / "other.yaml")]
    subprocess.run([sys.executable, "-m", "calib", *words], check=False, capture_output=True)
    assert (tmp_path / "other.yaml").read_bytes() == written
    with pytest.raises(BadInputError, match="is where pictures are saved"):
        source_of(str(rig / "images"), rig / "images")


def test_a_picture_whose_clock_is_ahead_is_looked_at(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64), 90, dtype=np.uint8))
    written_s = (tmp_path / "a.png").stat().st_mtime
    assert Watched(tmp_path, lambda: written_s + 0.1).read() is None
    assert Watched(tmp_path, lambda: written_s - 3600.0).read() is not None


def test_a_watched_folder_may_go_and_come_again(tmp_path: Path) -> None:
    folder, later = tmp_path / "shots", lambda: time.time() + 10.0
    folder.mkdir()
    watched = Watched(folder, later)
    for _ in range(2):
        cv2.imwrite(str(folder / "a.png"), np.full((48, 64), 90, dtype=np.uint8))
        assert watched.read() is not None and watched.fault == ""
        shutil.rmtree(folder)
        assert watched.read() is None and "shots: is gone" in watched.fault
        folder.mkdir()
        assert watched.read() is None and watched.fault == ""


def test_a_phones_heic_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    from PIL import Image

    grey = np.full((64, 96), 90, dtype=np.uint8)
    grey[:, :40] = 200
    pillow_heif.from_pillow(Image.fromarray(grey)).save(tmp_path / "a.heic", quality=-1)
    seen = Watched(tmp_path, lambda: time.time() + 10.0).read()
    assert seen is not None and np.abs(seen.astype(int) - grey).mean() < 1.0
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    watched = Watched(tmp_path, lambda: time.time() + 10.0)
    assert watched.read() is None and "a.heic: reading HEIC needs the package pillow-heif" in watched.fault


@pytest.mark.slow
def test_a_video_is_looked_at_as_a_camera_would_be(tmp_path: Path) -> None:
    person = Person(np.random.default_rng(0))
    video = cv2.VideoWriter(
        str(tmp_path / "board.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 20, CAMERA.image_size_px
    )
    for pose in follow_some(person, 3):
        frame = cv2.cvtColor(person.frame(pose), cv2.COLOR_GRAY2BGR)
        for _ in range(24):
            video.write(frame)
    video.release()
    with served(tmp_path / "rig", source_of(str(tmp_path / "board.avi"), tmp_path)) as live:
        with tab(live) as line:
            assert heard(line, "state")["source"] == "here"
            heard(line, "taken")
            assert "has ended" in heard(line, "camera")["fault"]
        wait(lambda: not live.state()["fitting"])
        assert len(live.album.names()) == 3


def test_a_video_of_a_phone_held_upright_has_the_sensors_own_rows(tmp_path: Path) -> None:
    """As for calib intrinsics and calib track: the container's turn is not followed."""
    path = tmp_path / "phone.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20, (64, 48))
    for _ in range(20):
        video.write(np.full((48, 64, 3), 90, dtype=np.uint8))
    video.release()
    # The matrix of the track's header, 44 bytes into it: a quarter turn.
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 48 << 16, 0, 1 << 30)
    path.write_bytes(data)
    turned = cv2.VideoCapture(str(path))
    assert turned.read()[1].shape == (64, 48, 3)
    turned.release()
    source = source_of(str(path), tmp_path / "images")
    assert source is not None
    frame = source.read()
    source.close()
    assert frame is not None and frame.shape == (48, 64, 3)


def test_a_stream_whose_size_is_switched_has_frames_of_both_sizes(tmp_path: Path) -> None:
    """As by the page of an ESP32-CAM; a damaged frame is left out."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=frame")
            self.end_headers()
            whole = [jpeg(np.full((h, 4 * h // 3), 90, np.uint8)) for h in (48, 96)]
            with contextlib.suppress(OSError):
                for data in (*30 * whole[:1], whole[0][:300], *300 * whole[1:]):
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")
                    time.sleep(0.005)

    camera = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=camera.serve_forever, daemon=True).start()
    source = source_of(f"http://127.0.0.1:{camera.server_port}/stream", tmp_path / "images")
    assert source is not None
    sizes = set[tuple[int, ...]]()

    def both() -> bool:
        frame = source.read()
        sizes.add(frame.shape if frame is not None else ())
        return sizes - {()} == {(48, 64, 3), (96, 128, 3)}

    wait(both)
    assert source.fault == ""
    source.close()
    camera.shutdown()
    camera.server_close()


def test_a_stream_of_damaged_frames_alone_ends() -> None:
    """A frame is told from its bytes whatever the property says: DirectShow says -1 of any camera."""
    frame = np.zeros((48, 64, 3), np.uint8)
    sent = cv2.imencode(".jpg", frame)[1][None]
    for given, whole in ((frame, True), (sent, True), (sent[:, :300], False)):
        video: Any = SimpleNamespace(read=lambda given=given: (True, given), get=lambda _: -1.0)
        found = next_frame(video)
        assert (found is not None and found.shape == frame.shape) if whole else found is None


# ----------------------------------------------------------------------
# The server.


@contextlib.contextmanager
def served(folder: Path, source: Source | None = None, port: str | None = None) -> Iterator[Any]:
    album = Album(folder)
    _, views, size_px = album.open(Told())
    live = Live(Session(size_px=size_px, views={view.name: view for view in views}), album, source, port)
    ready, address = threading.Event(), list[str]()

    def tell(where: str) -> None:
        address.append(where)
        ready.set()

    thread = threading.Thread(target=live.serve, args=(tell,))
    thread.start()
    try:
        assert ready.wait(PATIENCE_S)
        wait(lambda: answers(address[0]))
        live.address = address[0]  # type: ignore[attr-defined]  # for the test alone
        yield live
    finally:
        live.finished.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def answers(address: str) -> bool:
    with contextlib.suppress(OSError):
        return ask(address)[0] == 200
    return False


def wait(true: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


def ask(
    address: str, path: str = "", method: str = "GET", **headers: str
) -> tuple[int, dict[str, str], bytes]:
    url = urlsplit(address)
    line = http.client.HTTPConnection("127.0.0.1", url.port, timeout=PATIENCE_S)
    try:
        host = headers.pop("host", url.netloc)
        line.request(method, path or url.path, headers={"Host": host, **headers})
        answer = line.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        line.close()


def tab(live: Any, **more: Any) -> ClientConnection:
    origin = "/".join(live.address.split("/")[:3])
    where = live.address.replace("http", "ws") + "socket"
    return connect(**{"uri": where, "origin": origin, "max_size": None} | more)


def heard(line: ClientConnection, kind: str) -> dict[str, Any]:
    while True:
        got = line.recv(timeout=PATIENCE_S)
        if isinstance(got, str) and (message := json.loads(got))["type"] == kind:
            return dict(message)


def test_other_pages_cannot_drive_it(tmp_path: Path) -> None:
    with served(tmp_path / "rig") as live:
        address = live.address
        status, headers, text = ask(address)
        assert status == 200 and b"<title>calib live</title>" in text and b"{{nonce}}" not in text
        policy = headers["content-security-policy"]
        assert (
            "default-src 'none'" in policy and "unsafe" not in policy and "frame-ancestors 'none'" in policy
        )
        assert headers["referrer-policy"] == "no-referrer" and headers["cache-control"] == "no-store"
        assert b"http://" not in text.replace(b"http://www.w3.org/2000/svg", b"") and b"https://" not in text
        port = urlsplit(address).port
        assert ask(address, "/")[0] == 404 and ask(address, "/wrong/")[0] == 404
        assert ask(address, host=f"evil.example:{port}")[0] == 403
        assert ask(address, host="127.0.0.1")[0] == 403
        assert ask(address, Origin="http://evil.example")[0] == 403
        assert ask(address, method="POST")[0] == 405
        assert ask(address, f"{urlsplit(address).path}picture/..%2Frig.yaml")[0] == 404
        for wrong in (
            {"origin": None},
            {"origin": "http://evil.example"},
            {"origin": f"http://localhost:{port}"},
            {"origin": "null"},
            {"uri": f"ws://127.0.0.1:{port}/wrong/socket"},
        ):
            with pytest.raises(InvalidStatus) as refused:
                tab(live, **wrong)
            assert refused.value.response.status_code in (403, 404)
        with tab(live) as line:
            assert heard(line, "state")["verdict"] == "none yet"


def png(gray: Any) -> bytes:
    return bytes(cv2.imencode(".png", gray)[1])


def jpeg(gray: Any) -> bytes:
    return bytes(cv2.imencode(".jpg", gray)[1])


def test_a_page_sends_frames_and_what_is_too_large_is_refused(tmp_path: Path) -> None:
    person, live_session = Person(np.random.default_rng(2)), session()
    live_session.corners = (BOARD.columns, BOARD.rows)
    pose = person.pose_at(live_session.ghost())
    with served(tmp_path / "rig") as live, tab(live) as line, tab(live) as second:
        heard(line, "state")
        line.send(jpeg(person.frame(pose)))
        line.send('{"do": "camera", "size": [640, 480]}')
        for _ in range(30):
            line.send(jpeg(person.frame(pose)))
            got = heard(line, "seen")
            if got["code"] == "taken":
                break
        assert got["code"] == "taken" and len(got["corners"]) == BOARD.rows
        # Frames are half as large as the picture.
        assert np.max(got["corners"]) > 330 and live.state()["size"] == (640, 480)
        heard(line, "shoot")
        line.send(png(cv2.resize(person.frame(pose), (640, 480))))
        assert heard(second, "taken")["name"] == "view001.png"
        assert live.album.names() == ["view001.png"]
        line.send(jpeg(person.frame(pose)))
        assert heard(line, "seen")["code"] == "alike"
        # A picture that nobody asked for is none.
        line.send(png(person.frame(pose)))
        line.send('{"do": "nonsense"}')
        assert "does not know" in heard(line, "fault")["says"]
        assert live.album.names() == ["view001.png"]
        bomb = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (100_000).to_bytes(4, "big") * 2
        for bad in (bomb, b"GIF89a", b"", jpeg(person.frame(pose))[:300]):
            line.send(bad)
            assert heard(line, "fault")["says"]
        for bad in ("[", "[" * 5000, '{"do": 1}', "{}", "7"):
            line.send(bad)
            assert "does not know" in heard(line, "fault")["says"]
        line.send('{"do": "drop", "name": "../../rig.yaml"}')
        assert "is not there" in heard(line, "fault")["says"]
        line.send('{"do": "drop", "name": "view001.png"}')
        wait(lambda: live.album.left_out() == ["view001.png"])
        line.send('{"do": "back", "name": "view001.png"}')
        wait(lambda: live.album.names() == ["view001.png"])
        # Asked for twice, as on two pages, it is done once.
        line.send('{"do": "back", "name": "view001.png"}')
        line.send('{"do": "nonsense"}')
        assert "does not know" in heard(line, "fault")["says"]
        second.send('{"do": "camera"}')
        heard(line, "lent")
        with tab(live) as third:
            heard(third, "state")
            third.send('{"do": "camera"}')
            heard(second, "lent")
        # Who lends the camera is gone.
        heard(second, "free")
        with contextlib.suppress(Exception):
            line.send(b"\xff\xd8" + bytes(MOST_BYTES))
            line.recv(timeout=PATIENCE_S)
        second.send('{"do": "done"}')
        assert heard(second, "done")["folder"] == str(live.album.folder)
    assert MOST_PIXELS * 3 > MOST_BYTES


@pytest.mark.slow
def test_a_page_that_sleeps_holds_up_no_other(tmp_path: Path) -> None:
    """It takes nothing that it is sent, until it is let go; it may connect again."""
    # As one would be: packed, words that repeat themselves take a few bytes, and all fits into the sockets.
    with served(tmp_path / "rig") as live, tab(live) as line, tab(live, compression=None) as asleep:
        wait(lambda: len(live._tabs) == 2)
        for on in 20_000 * (False, True):
            line.send(json.dumps({"do": "auto", "on": on}))
            while heard(line, "state")["auto"] != on:
                pass
            if len(live._tabs) == 1:
                break
        assert len(live._tabs) == 1
        # What it has not taken would keep the server's end of it open beyond the server.
        asleep.socket.close()
        with tab(live) as again:
            heard(again, "state")
            line.send('{"do": "done"}')
            assert heard(again, "done")


def half_a_rig(folder: Path, project_root: Path) -> bytes:
    """A folder with pictures for the camera; the picture of its board in the plane."""
    (folder / "images").mkdir(parents=True)
    for path in sorted((project_root / "images").glob("view*.png"))[:8]:
        shutil.copy(path, folder / "images")
    (folder / "images" / "board.yaml").write_text("corners: [7, 5]\nsquare_m: 0.02\n")
    return next((project_root / "images" / "plane").glob("*.png")).read_bytes()


def test_the_plane_is_what_extrinsics_makes_of_the_corner_that_was_clicked(
    tmp_path: Path, project_root: Path
) -> None:
    rig = tmp_path / "rig"
    picture = half_a_rig(rig, project_root)
    with served(rig) as live, tab(live) as line:
        line.send('{"do": "camera", "size": [316, 208]}')
        wait(lambda: live.rig.camera is not None and not live.state()["fitting"])
        # A file that an editor has half-written ends no session.
        whole = (rig / "rig.yaml").read_bytes()
        for do, text, says in (("drop", b"camera: [", "not saved: "), ("back", whole, str(rig))):
            (rig / "rig.yaml").write_bytes(text)
            line.send(json.dumps({"do": do, "name": "view01.png"}))
            wait(lambda: live.state()["saved"].startswith(says) and not live.state()["fitting"])  # noqa: B023
        line.send('{"do": "place", "x_mm": 0, "y_mm": 0, "angle_deg": 0}')
        assert "First take a picture" in heard(line, "fault")["says"]

        def lay(corner: int, **place: Any) -> None:
            line.send('{"do": "step", "name": "plane"}')
            wait(lambda: live.step == "plane")
            line.send(jpeg(cv2.imdecode(np.frombuffer(picture, np.uint8), 0)))
            wait(lambda: "plane of motion?" in heard(line, "seen")["says"])
            line.send('{"do": "take"}')
            heard(line, "shoot")
            line.send(picture)
            wait(lambda: live.flat.png is not None)
            ends = live.state()["plane"]["ends"]
            line.send(json.dumps({"do": "point", "at": ends[corner][0]}))
            wait(lambda: live.flat.chosen == corner)
            for wrong in ({}, {"x_mm": "1"}, {"x_mm": float("nan"), "y_mm": 0, "angle_deg": 0}):
                line.send(json.dumps({"do": "place", **wrong}))
                assert "expected a number up to 10000" in heard(line, "fault")["says"]
            line.send(json.dumps({"do": "place", **place}))
            wait(lambda: live.flat.png is None)

        lay(0, x_mm=-58.0, y_mm=22.0, angle_deg=2.865, square_mm=20.0)
        first = live.rig.plane
        assert first is not None and first.verdict.ok and live.state()["plane"]["result"]["rms_mm"] < 0.02
        lay(1, x_mm=60.0, y_mm=100.0, angle_deg=180.0)
        second = live.rig.plane
        written = (rig / "rig.yaml").read_bytes()
        # Both say the same of the plane but for where its axes are.
        assert abs(second.t_CW_m[2] - first.t_CW_m[2]) < 0.01
        assert second.rms_mm == pytest.approx(first.rms_mm)
    # Nothing was written over.
    aside = rig / "images" / "plane" / "dropped" / "1"
    assert sorted(path.name for path in aside.iterdir()) == ["board.yaml", "plane001.png"]
    (tmp_path / "other.yaml").write_bytes(written)
    words = ["extrinsics", str(rig / "images" / "plane"), "--rig", str(tmp_path / "other.yaml")]
    subprocess.run([sys.executable, "-m", "calib", *words], check=True, capture_output=True)
    assert (tmp_path / "other.yaml").read_bytes() == written


def test_a_picture_that_shows_no_plane_leaves_the_earlier_one(tmp_path: Path, project_root: Path) -> None:
    rig = tmp_path / "rig"
    picture = half_a_rig(rig, project_root)
    album = Album(rig)
    board = BoardFile(corners=[7, 5], square_m=0.02, first_corner_m=[0.0, 0.0], angle_rad=0.0)
    with pytest.raises(BadInputError, match="camera"):
        album.lay(picture, board)
    assert [path.name for path in album.plane.iterdir()] == []
    album.calibrate()
    album.lay(picture, board)
    before = {path.name: path.read_bytes() for path in album.plane.iterdir() if path.is_file()}
    with pytest.raises(BadInputError):
        album.lay(png(np.zeros((208, 316), np.uint8)), board)
    assert {path.name: path.read_bytes() for path in album.plane.iterdir() if path.is_file()} == before


def test_a_marker_is_recorded_while_one_looks_at_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is on the disk grows, a click names the marker, and another disc is not followed."""
    # On a busy machine a second of frames takes many.
    monkeypatch.setattr(server, "_CLOCK_S", PATIENCE_S)
    scene = Scene(other="disc", noise=2.0, rate_hz=30.0)
    with served(tmp_path / "rig") as live, tab(live) as line:
        line.send('{"do": "camera", "size": [640, 480]}')
        line.send('{"do": "step", "name": "board"}')
        assert "No board is connected: start calib live with --port" in heard(line, "fault")["says"]
        line.send('{"do": "step", "name": "marker"}')
        wait(lambda: live.step == "marker")
        log = tmp_path / "rig" / "logs" / "track1.csv"
        for k, (t_s, frame) in enumerate(scene.frames(30)):
            line.send(json.dumps({"do": "at", "t_s": 2.0 * PATIENCE_S + t_s}))
            line.send(jpeg(frame))
            seen = heard(line, "seen")
            if k == 0:
                assert "Several discs" in seen["says"] and "marker" not in seen
                line.send(json.dumps({"do": "point", "at": scene.centre_px(0.0).tolist()}))
                wait(lambda: live.marker.tracker.start_px is not None)
                line.send('{"do": "record"}')
                wait(lambda: live.marker.shown()["recording"] == "track1.csv")
                line.send('{"do": "colour", "name": "green"}')
                assert "is being recorded" in heard(line, "fault")["says"]
            else:
                off = np.array([seen["marker"]["u"], seen["marker"]["v"]]) - scene.centre_px(t_s)
                assert np.hypot(*off) < 0.5
        assert len(log.read_text().splitlines()) == 1 + 29
        line.send('{"do": "stop"}')
        wait(lambda: "29 of 29 frames" in live.marker.last)
        track = read_log(log)
        assert np.allclose(track.t_s, np.arange(29) / 30, atol=1e-6)
        # A camera that was lost and comes back begins at zero again: a log has one clock.
        line.send('{"do": "record"}')
        for at_s in (2.0 * PATIENCE_S + 1.0, 2.0 * PATIENCE_S + 1.1, 0.1, 0.2):
            line.send(json.dumps({"do": "at", "t_s": at_s}))
            line.send(jpeg(frame))
            if at_s == 0.1:
                assert "camera is another one" in heard(line, "fault")["says"]
            heard(line, "seen")
        assert not live.marker.recording and "2 of 2 frames" in live.marker.last
        assert len(read_log(log.with_name("track2.csv")).t_s) == 2
        # Frames of another size are of another camera.
        line.send('{"do": "record"}')
        for shown, at_s in ((frame, 0.3), (frame, 0.4), (cv2.resize(frame, (320, 240)), 0.5)):
            line.send(json.dumps({"do": "at", "t_s": at_s}))
            line.send(jpeg(shown))
            heard(line, "seen")
        assert not live.marker.recording and "ended where frames of another size came" in live.marker.last
        (tmp_path / "rig" / "logs" / "track3.csv").unlink()
        # One that sees nothing leaves nothing.
        line.send('{"do": "record"}')
        line.send('{"do": "stop"}')
        wait(lambda: "nothing was recorded" in live.marker.last)
        line.send('{"do": "colour", "name": "no colour"}')
        assert "is no colour" in heard(line, "fault")["says"]
    assert sorted(path.name for path in log.parent.iterdir()) == ["track1.csv", "track2.csv"]


def test_a_full_disk_ends_a_recording_and_not_the_page(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    marker = Marker(Album(tmp_path))
    marker.start()
    (frame,) = (frame for _, frame in Scene(other="none").frames(1))
    assert marker.follow(frame, 0.0)["says"] == "Recording: 1 frames."
    assert marker._stream is not None
    marker._stream.close()
    marker._stream = Path("/dev/full").open("wb")  # noqa: SIM115  the marker closes it
    assert "marker" in marker.follow(frame, 0.1) and not marker.recording
    assert "track1.csv cannot be written: No space left" in marker.last
    assert len((tmp_path / "logs" / "track1.csv").read_text().splitlines()) == 2


def test_a_board_is_recorded_from_the_page(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    from pty import openpty
    from tty import setraw

    ours, theirs = openpty()
    setraw(theirs)
    # Nobody reads between two recordings: as on a wire, what is not taken is lost.
    os.set_blocking(ours, False)
    over = threading.Event()

    def send() -> None:
        outputs = Outputs(0.25, (0.5, 1.0), (0.25, 2.0), (0.0625, 4.0), (1.0, 255.0), 3)
        for k in range(100_000):
            if over.wait(1 / 60):
                return
            given = Inputs(158.0 + 10 * np.sin(0.05 * k), 80.5, 9.81, 0.25, -0.125, (0.08, 0.0805), mode=2)
            with contextlib.suppress(BlockingIOError):
                os.write(ours, encoded(Frame(1, 60000, k & 0xFFFF, given, outputs)))

    board = threading.Thread(target=send)
    board.start()
    try:
        with served(tmp_path / "rig", port=os.ttyname(theirs)) as live, tab(live) as line:
            line.send('{"do": "step", "name": "board"}')
            wait(lambda: live.step == "board")
            line.send('{"do": "record", "name": "../x"}')
            assert "no recording" in heard(line, "fault")["says"]
            line.send('{"do": "record", "name": "static"}')
            wait(lambda: sum(len(plot["rows"]) for plot in heard(line, "board")["board"]["plots"]) > 100)
            line.send('{"do": "record", "name": "swing"}')
            assert "is under way" in heard(line, "fault")["says"]
            told = live.state()["board"]
            assert len(told["plots"]) == 4
            assert told["recording"] == "static1.csv"
            line.send('{"do": "stop"}')
            wait(lambda: not live.board.at_work)
            assert re.search(r"\d+ ticks in .*static1.csv, \d+ lost", live.board.last), live.board.last
            line.send('{"do": "record", "name": "static"}')
            wait(lambda: live.board.at_work)
        # Done ends the recording too.
        assert not live.board.at_work
    finally:
        over.set()
        board.join()
        os.close(ours)
        os.close(theirs)
    assert len(read_log(tmp_path / "rig" / "logs" / "static1.csv").t_s) > 50


def test_of_a_board_that_restarts_its_last_start_is_shown(tmp_path: Path) -> None:
    record = server.Board(Album(tmp_path), "port")
    record.path = record.album.new_log("static")
    for name, shown_s in (("static1", 1.0), ("static1-2", 0.5), ("static1-3", 0.25)):
        rows = "".join(f"{t_s},5.0,6.0\n" for t_s in (0.0, shown_s))
        record.path.with_name(f"{name}.csv").write_text(f"t_s,u_px,v_px\n{rows}")
        told = record.shown()
        assert told["seconds"] == round(shown_s, 1) and len(told["plots"][0]["rows"]) == 2
    for number in (9, 10):
        record.path.with_name(f"static1-{number}.csv").write_text("t_s,u_px,v_px\n")
    record.shown()
    assert record.path.name == "static1-10.csv"


def test_the_page_in_a_browser_from_the_start_to_ok(tmp_path: Path) -> None:
    """A fake camera shows the board where a session asks for it; the page, reloaded, knows everything."""
    person = Person(np.random.default_rng(0))
    # More than a verdict needs: which of them are taken depends on the pace.
    poses = follow_some(person, 12)
    write_y4m(tmp_path / "board.y4m", [person.frame(pose) for pose in poses], frames_each=30)
    switches = (
        "--use-fake-ui-for-media-stream",
        "--use-fake-device-for-media-stream",
        f"--use-file-for-fake-video-capture={tmp_path / 'board.y4m'}",
    )
    with served(tmp_path / "rig") as live:
        browser = browser_or_skip(tmp_path / "profile", *switches)
        try:
            browser.own = (*browser.own, live.address)
            browser.open(live.address, 1200, 1000)
            wait(lambda: "Press c" in browser.run("document.getElementById('says').textContent"))
            browser.run("state.source = 'here'")
            browser.key("c", 67, "c")
            assert browser.run("new Promise(done => setTimeout(done, 50)).then(() => stream === null)")
            browser.run("state.source = 'browser'")
            browser.key("c", 67, "c")
            wait(lambda: live.state()["verdict"] == "ok" and not live.state()["fitting"])
            told = (
                "frame to corners: {:.0f} ms, 95 of 100 within {:.0f} ms, pictures taken and fitted meanwhile"
            )
            print(told.format(*np.percentile(browser.run("delays"), (50, 95))))
            browser.key("a", 65, "a")
            wait(lambda: not live.auto and not live.state()["fitting"])
            # An answer stays while frames go on telling what they show.
            browser.run("send({do: 'colour', name: 'gold-ish'})")
            wait(lambda: "no colour" in browser.run("document.getElementById('says').textContent"))
            answered = browser.run("frames")
            while (told := browser.run("[stays - performance.now(), frames, $('says').textContent]"))[0] > 0:
                assert "no colour" in told[2]
                if told[1] > answered + 10:
                    break
            browser.key("3", 51, "3")
            wait(lambda: browser.run("state.step") == "marker")
            assert browser.run("stays < performance.now()")
            browser.run("video.pause()")
            wait(lambda: "no new pictures" in browser.run("document.getElementById('says').textContent"))
            browser.run("video.play()")
            browser.key("1", 49, "1")
            wait(lambda: browser.run("state.step") == "camera")
            assert len(live.state()["pictures"]) >= 4
            first = (live.album.images / "view001.png").read_bytes()
            assert isinstance(live._take(first, by_hand=False), Seen)
            browser.click("#strip button")
            wait(lambda: len(live.album.left_out()) == 1)
            assert browser.run("document.getElementById('verdict').textContent") != "none yet"
            browser.open(live.address, 390, 844)
            # One that was under way when taking ended may have come after.
            wait(
                lambda: (
                    browser.run("document.querySelectorAll('#strip li').length")
                    == len(live.state()["pictures"]) + 1
                )
            )
            assert browser.run("document.documentElement.scrollWidth") == 390
            assert not browser.run("document.getElementById('auto').checked")
            # As after a click on it.
            browser.run("document.getElementById('sound').focus()")
            browser.key("d", 68, "d")
            assert live.finished.wait(PATIENCE_S)
            wait(lambda: "Done. Saved" in browser.run("document.getElementById('says').textContent"))
            assert browser.errors == []
        finally:
            browser.close()


def follow_some(person: Person, pictures: int) -> list[Any]:
    return follow(session(), person, pictures)


# ----------------------------------------------------------------------
# The command.


def test_ctrl_c_ends_with_the_camera_however_long_that_takes(tmp_path: Path) -> None:
    """The interruption is raised again after a second where nobody answers it."""
    script = (
        "import sys, time\n"
        "from calib.live.album import Album\n"
        "from calib.live.server import Live\n"
        "from calib.core.errors import BadInputError\n"
        "def serve(*_):\n    print('serving', flush=True)\n    time.sleep(30)\n"
        "def slow(*_):\n    time.sleep(1.6)\n    raise BadInputError('calibrated')\n"
        "Live.serve, Album.calibrate, Album.names = serve, slow, lambda *_: ['view001.png']\n"
        "from calib.cli.main import main\n"
        "sys.argv = ['calib', 'live', '-o', 'rig', '--no-browser']\n"
        "main()\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert started.stdout is not None
    assert started.stdout.readline().startswith("serving")
    started.send_signal(signal.SIGINT)
    _, said = started.communicate(timeout=25)
    assert said == "ended; what was taken is saved\ncalib: calibrated\n"
    assert started.returncode == 3


def test_what_the_command_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(*words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["calib", "live", *words])
        with pytest.raises(SystemExit) as left:
            main()
        return int(left.value.code or 0), capsys.readouterr().err

    monkeypatch.chdir(tmp_path)
    assert ends("nothing") == (
        3,
        "calib: nothing: does not exist, expected a camera's number, an address or a path\n",
    )
    (tmp_path / "x.mp4").write_text("no video")
    code, said = ends("x.mp4")
    assert code == 3 and "x.mp4: cannot be opened" in said
    assert ends("--square", "20")[0] == 2
    rig = tmp_path / "ro" / "rig.yaml"
    rig.parent.mkdir()
    rig.write_text("geometry: {}\n")
    rig.chmod(0o444)
    assert ends("-o", "ro") == (3, "calib: ro/rig.yaml: cannot be written: it is read-only\n")
    monkeypatch.setattr(Live, "serve", lambda *_: None)
    code, said = ends()
    assert code == 3 and "no picture was taken" in said
    monkeypatch.setattr(Live, "serve", lambda live, _: live.album.new_log("track").write_text("t_s\n"))
    code, said = ends()
    assert code == 0 and "recordings are in live/logs" in said
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    monkeypatch.delitem(sys.modules, "calib.live.server", raising=False)
    code, said = ends()
    assert code == 2 and "pip install 'calib-rig[live]'" in said
