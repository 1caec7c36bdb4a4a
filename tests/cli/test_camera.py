"""`calib intrinsics, extrinsics, distortion, board, export, import`: what they write, say and refuse."""

from __future__ import annotations

import json
import re
import shutil

import cv2
import numpy as np
import pytest
import yaml

from calib.stages.camera.model import Board

SIZE = ("--image-size", "640x480")
RADIAL2 = ("--model", "radial2")


def _camera(rig) -> dict:
    return yaml.safe_load(rig.read_text())["camera"]


def test_the_shipped_pictures(calib, project_root, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", project_root / "images", "--rig", rig)
    assert ended.code == 0
    assert "verdict: ok" in ended.out
    assert "models compared" in ended.out
    assert ended.err.splitlines() == ["board found in 17 of 17 pictures", f"camera written to {rig}"]
    truth = json.loads((project_root / "tests" / "truth" / "pictures.json").read_text())["camera"]
    camera = _camera(rig)
    assert camera["model"] == "radial2"
    assert camera["fx_px"] == pytest.approx(truth["fx_px"], abs=5 * camera["sigma"]["fx_px"])
    whole = yaml.safe_load(rig.read_text())
    assert set(whole["provenance"]) == {"version", "inputs", "written"}
    inputs = whole["provenance"]["inputs"]["camera"]
    assert len(inputs) == 18
    assert "board.yaml" in inputs
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in inputs.values())
    assert all("/" not in name for name in inputs)


def test_the_size_of_an_unknown_board_is_found_and_a_turned_one_is_the_same(
    calib, pictures, tmp_path
) -> None:
    folder, rig = pictures(4), tmp_path / "rig.yaml"
    ended = calib("intrinsics", folder, *RADIAL2, "--rig", rig)
    assert "found a board with 7x5 inner corners" in ended.err
    assert "the square's length is not given" in ended.err
    found = _camera(rig)
    calib("intrinsics", folder, *RADIAL2, "--rig", rig, "--corners", "5x7", "--square", "20mm")
    assert _camera(rig)["fx_px"] == pytest.approx(found["fx_px"], rel=1e-6)
    distance = [one["projection_sigma_px"]["distance_m"] for one in (found, _camera(rig))]
    assert distance == [None, pytest.approx(0.3, abs=0.1)]


def test_a_wrong_size_is_answered_with_what_was_found(calib, pictures, tmp_path) -> None:
    folder = pictures(4, "corners: [8, 6]\nsquare_m: 0.03\n")
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == (
        "view01.png ... view04.png: no board with 8x6 inner corners found in any of 4 pictures, "
        "but one with 7x5 was: state these, which are one less than the squares"
    )
    assert not rig.exists()
    ended = calib("intrinsics", folder, *RADIAL2, "--rig", rig, "--corners", "7x5", "--square", "2cm")
    assert ended.code in (0, 1)
    assert "--corners: 7x5 is used, not 8x6 of board.yaml" in ended.err
    assert "--square: 0.02 m is used, not 0.03 m of board.yaml" in ended.err


def test_a_table(calib, points, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", points, *SIZE, *RADIAL2, "--skew", "--rig", rig)
    assert re.search(r"picture, px +640 x 480", ended.out)
    assert re.search(r"views +6\b", ended.out) and re.search(r"points +324\b", ended.out)
    camera = _camera(rig)
    assert camera["fx_px"] == pytest.approx(530.0, abs=5 * camera["sigma"]["fx_px"])
    assert "skew_px" in camera["sigma"]
    assert list(yaml.safe_load(rig.read_text())["provenance"]["inputs"]["camera"]) == ["points.csv"]


def _with(text: str, column: int, value: str) -> str:
    lines = text.splitlines()
    cells = lines[5].split(",")
    cells[column] = value
    return "\n".join([*lines[:5], ",".join(cells), *lines[6:]]) + "\n"


WRONG = {
    "nan": (lambda t: _with(t, 3, "nan"), "line 6: u_px is 'nan', expected a finite number"),
    "outside": (
        lambda t: _with(t, 3, "700"),
        "1 of 54 points lie outside a picture of 640x480 px, as (700, ",
    ),
    "no header": (lambda t: t.split("\n", 1)[1], "line 1: the header lacks view"),
    "binary": (lambda t: t[:99] + "\0" + t[99:], "has a zero byte; expected a text file"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_table(calib, points, table_text, rig, what: str) -> None:
    make, says = WRONG[what]
    before = rig.read_bytes()
    points.write_text(make(table_text))
    ended = calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    assert ended.code == 3
    assert says in ended.sentence
    assert ended.out == ""
    assert rig.read_bytes() == before


def test_options_that_do_not_go_with_a_table(calib, points, project_root, tmp_path) -> None:
    rig = ("--rig", tmp_path / "rig.yaml")
    for words, says in (
        ([points], "a table does not tell the size of the pictures; give --image-size"),
        ([points, *SIZE, "--corners", "9x6"], "--corners, --square and --dictionary do not go with it"),
        ([points, *SIZE, "--square", "25mm"], "do not go with it"),
        ([points, points, *SIZE], "a table is given alone"),
        ([project_root / "images", points, *SIZE], "a table is given alone"),
    ):
        ended = calib("intrinsics", *words, *rig)
        assert ended.code == 2
        assert says in ended.sentence
    ended = calib("intrinsics", points, "--image-size", "320x240", *rig)
    assert ended.code == 3
    assert "outside a picture of 320x240 px" in ended.sentence


def _vnl(table: str) -> str:
    rows = [line.split(",") for line in table.splitlines()[1:]]
    return "# filename x y level\n" + "".join(f"{name}.jpg {u} {v} 0\n" for name, _, _, u, v in rows)


def test_a_corner_file(calib, table_text, points, tmp_path) -> None:
    file, rig = tmp_path / "corners.vnl", tmp_path / "rig.yaml"
    file.write_text(_vnl(table_text))
    calib("intrinsics", points, *SIZE, *RADIAL2, "--rig", rig)
    expected = _camera(rig)["fx_px"]
    board = ("--corners", "9x6", "--square", "25mm")
    assert calib("intrinsics", file, *board, *SIZE, *RADIAL2, "--rig", rig).code in (0, 1)
    assert _camera(rig)["fx_px"] == pytest.approx(expected, rel=1e-9)
    assert (
        "the square's length is not given"
        in calib("intrinsics", file, *board[:2], *SIZE, *RADIAL2, "--rig", rig).err
    )
    for words, code, says in (
        ([*SIZE], 2, "a .vnl file does not tell the board; give --corners and --square"),
        ([*board], 2, "give --image-size"),
        ([*SIZE, "--corners", "8x6"], 3, "line 2: view01.jpg has 54 corners, expected 8x6 = 48"),
    ):
        ended = calib("intrinsics", file, *words, "--rig", rig)
        assert ended.code == code
        assert says in ended.sentence


@pytest.mark.few(1)
@pytest.mark.parametrize("model", ["pinhole", "radial2", "rational8"])
def test_points_that_belong_to_no_camera(calib, table_text, tmp_path, model: str) -> None:
    rng = np.random.default_rng(0)
    rows = [line.split(",")[:3] for line in table_text.splitlines()[1:]][:108]
    pixels = rng.uniform(0, 400, (len(rows), 2)).tolist()
    file, rig = tmp_path / "points.csv", tmp_path / "rig.yaml"
    lines = [",".join([*row, repr(u), repr(v)]) for row, (u, v) in zip(rows, pixels, strict=True)]
    file.write_text("view,x_m,y_m,u_px,v_px\n" + "\n".join(lines))
    ended = calib("intrinsics", file, *SIZE, "--model", model, "--rig", rig)
    if ended.code == 3:
        assert "no camera fits these views" in ended.sentence or "no useful answer" in ended.sentence
        assert not rig.exists()
    else:
        assert ended.code == 1
        assert _camera(rig)["verdict"] != "ok"


@pytest.mark.slow
def test_a_table_of_many_rows_is_read_with_little_memory(tmp_path) -> None:
    import tracemalloc

    from calib.stages.camera.read import read_table

    rng = np.random.default_rng(0)
    file = tmp_path / "points.csv"
    rows = [f"v{i % 100},{x!r},{y!r},1.5,2.5\n" for i, (x, y) in enumerate(rng.random((40_000, 2)).tolist())]
    file.write_text("view,x_m,y_m,u_px,v_px\n" + "".join(rows))
    size = file.stat().st_size
    del rows
    tracemalloc.start()
    views = read_table(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(len(view.pixels) for view in views) == 40_000
    assert peak < 3 * size


@pytest.fixture
def folder(project_root, tmp_path):
    """A copy of images/plane that may be changed."""
    return shutil.copytree(project_root / "images" / "plane", tmp_path / "plane")


def test_the_shipped_plane(calib, project_root, rig) -> None:
    ended = calib("extrinsics", project_root / "images" / "plane", "--rig", rig)
    assert ended.code == 0
    assert "RMS on the plane, mm" in ended.out
    assert "corner (0, 0) was taken at pixel (107.6, 64.7)" in ended.out
    whole = yaml.safe_load(rig.read_text())
    A, A_inverse = np.array(whole["plane"]["A_px_per_m"]), np.array(whole["plane"]["A_inverse"])
    np.testing.assert_allclose(A @ A_inverse, np.eye(3), atol=1e-9)
    assert set(whole["provenance"]["inputs"]["plane"]) == {"board.yaml", "camera", "plane01.png"}


def test_a_print_that_the_camera_was_cleared_of_counts_as_sigma_in_the_plane(calib, folder, rig) -> None:
    """Residuals of a board in its own shape are no measure for those of the board as it is described."""
    path = next(folder.glob("*.png"))
    picture = cv2.imread(str(path))
    height, width = picture.shape[:2]
    rng = np.random.default_rng(0)
    by = [5.0 * cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 4) for _ in range(2)]
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    moved = cv2.remap(picture, (x + by[0]).astype("f4"), (y + by[1]).astype("f4"), cv2.INTER_CUBIC)
    cv2.imwrite(str(path), moved)
    whole = yaml.safe_load(rig.read_text())
    for board, told in (("rigid", True), ("released", False)):
        whole["camera"]["board"] = board
        rig.write_text(yaml.safe_dump(whole))
        ended = calib("extrinsics", folder, "--rig", rig)
        assert ("times the camera's own" in ended.out) == told


def test_the_plane_of_a_video_is_that_of_its_picture(calib, folder, rig) -> None:
    """A hand covers the board before and after."""
    assert calib("extrinsics", folder, "--rig", rig).code == 0
    of_picture = yaml.safe_load(rig.read_text())["plane"]
    still = cv2.imread(str(folder / "plane01.png"))
    (folder / "plane01.png").unlink()
    video = cv2.VideoWriter(
        str(folder / "rest.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 30.0, still.shape[1::-1]
    )
    for frame in (0 * still, still, still, 0 * still):
        video.write(frame)
    video.release()
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3 and "holds no pictures, but rest.avi; give that recording itself" in ended.sentence
    assert calib("extrinsics", folder / "rest.avi", "--rig", rig).code == 0
    whole = yaml.safe_load(rig.read_text())
    np.testing.assert_allclose(whole["plane"]["A_px_per_m"], of_picture["A_px_per_m"], rtol=1e-5, atol=1e-4)
    assert whole["plane"]["pictures"] == 1
    assert set(whole["provenance"]["inputs"]["plane"]) == {"board.yaml", "camera", "rest.avi"}


def test_a_camera_has_to_be_there_first(calib, folder, tmp_path) -> None:
    rig = tmp_path / "rig.yaml"
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == f"{rig}: has no camera yet; run calib intrinsics first"
    assert not rig.exists()


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


def test_another_square_for_as_many_corners_is_doubted(calib, folder, rig) -> None:
    above = folder.parent / "board.yaml"
    above.write_text("corners: [7, 5]\nsquare_m: 0.025\n")
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 1
    assert "plane/board.yaml says squares of 20 mm" in ended.out
    above.write_text("corners: [7, 5]\n")
    assert calib("extrinsics", folder, "--rig", rig).code == 0


def test_a_second_board_in_the_picture_is_named(calib, folder, rig) -> None:
    gray = cv2.imread(str(folder / "plane01.png"), cv2.IMREAD_GRAYSCALE)
    both = np.full_like(gray, 120)
    for (v, u), (width, height) in (((0, 0), (172, 113)), ((115, 174), (140, 92))):
        both[v : v + height, u : u + width] = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folder / "plane01.png"), both)
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 1
    assert "plane01.png: more than one board of 7x5 inner corners is seen" in ended.out


def test_a_plane_is_no_better_than_its_camera(calib, folder, rig) -> None:
    rig.write_text(rig.read_text().replace("verdict: ok", "verdict: poor", 1))
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 1
    assert "verdict: poor\n  - camera is poor; what follows from it is no better" in ended.out
    assert yaml.safe_load(rig.read_text())["plane"]["verdict"] == "poor"


def test_a_plane_of_another_camera_is_not_used(calib, rig, points, folder, tmp_path) -> None:
    calib("intrinsics", points, "--image-size", "640x480", "--model", "radial2", "--rig", rig)
    for words in (("distortion",), ("firmware", "-o", tmp_path / "out")):
        ended = calib(*words, "--rig", rig)
        assert ended.code == 3
        assert "plane was calibrated with another camera than the one in camera" in ended.sentence
    assert not (tmp_path / "out").exists()


def test_the_shipped_camera(calib, rig) -> None:
    ended = calib("distortion", "--rig", rig)
    assert ended.code == 0
    assert re.search(r"kind of distortion +mustache", ended.out)
    assert re.search(r"effect +matters", ended.out)
    whole = yaml.safe_load(rig.read_text())
    assert whole["lens"]["inverse"]["max_error_px"] < 0.01
    assert set(whole["provenance"]["inputs"]["lens"]) == {"camera", "plane"}
    assert json.loads(calib("distortion", "--rig", rig, "--json").out)["lens"] == whole["lens"]


@pytest.mark.few(0, 3)
@pytest.mark.parametrize("k1", ["-50.0", "1.0e+5", "1.0e+30", "-1.0"])
def test_a_lens_that_cannot_be_undone(calib, rig, k1: str) -> None:
    camera = yaml.safe_load(rig.read_text())["camera"]
    camera["distortion"]["k1"] = float(k1)
    rig.write_text(yaml.safe_dump({"camera": camera}))
    ended = calib("distortion", "--rig", rig)
    assert ended.code == 0
    assert re.search(r"effect +matters", ended.out)
    ended = calib("firmware", "--rig", rig, "-o", rig.parent)
    assert ended.code == 1
    assert "the lens is undone" in ended.out
    assert "#define CALIB_CAMERA_OK 0" in (rig.parent / "calib_constants.h").read_text()


def test_a_covariance_that_is_none(calib, rig) -> None:
    whole = yaml.safe_load(rig.read_text())
    table = whole["camera"]["covariance"]
    del whole["plane"]
    for change, says in (
        (
            {"order": ["fx_px", *table["order"][:-1]]},
            "camera.covariance.order names 'fx_px' twice",
        ),
        ({"order": ["f", *table["order"][1:]]}, "camera.covariance.order has 'f', which is no intrinsic"),
        ({"values": table["values"][1:]}, "expected 6 rows and columns"),
        ({"values": [[-9.0, *table["values"][0][1:]], *table["values"][1:]]}, "expected a variance of fx_px"),
    ):
        whole["camera"]["covariance"] = table | change
        rig.write_text(yaml.safe_dump(whole))
        ended = calib("distortion", "--rig", rig)
        assert ended.code == 3
        assert says in ended.sentence
    whole["camera"]["covariance"] = {"order": [], "values": []}
    rig.write_text(yaml.safe_dump(whole))
    ended = calib("distortion", "--rig", rig)
    assert ended.code == 1 and "camera in the file was changed" in ended.out


def test_the_default_board(calib, tmp_path) -> None:
    ended = calib("board", cwd=tmp_path)
    assert ended.code == 0
    data = (tmp_path / "board.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    told = ended.out.splitlines()
    assert yaml.safe_load("\n".join(told[-2:])) == {"corners": [8, 5], "square_m": 0.02}
    assert "half a turn" not in ended.out
    assert "looks the same after half a turn" in calib("board", "--corners", "7x5", cwd=tmp_path).out
    calib("board", "-o", "again.pdf", cwd=tmp_path)
    assert (tmp_path / "again.pdf").read_bytes() == data


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--corners", "20x20", "--square", "50mm"), "does not fit on A4: the largest square that fits is"),
        (("--square", "0.01mm"), "a square needs a side of at least 0.5 mm"),
        (
            ("--corners", "14x9", "--square", "12mm", "--charuco", "--dictionary", "4x4_50"),
            "needs 75 markers",
        ),
    ],
)
def test_boards_that_cannot_be_printed(calib, tmp_path, words: tuple[str, ...], says: str) -> None:
    ended = calib("board", *words, cwd=tmp_path)
    assert ended.code == 3
    assert says in ended.sentence
    assert list(tmp_path.iterdir()) == []


FORMATS = ("ros", "opencv", "kalibr")


@pytest.mark.parametrize("form", FORMATS)
def test_there_and_back(calib, rig, tmp_path, form: str) -> None:
    file, other = tmp_path / f"{form}.yaml", tmp_path / "other.yaml"
    assert calib("export", form, "--rig", rig, "-o", file).code == 0
    assert calib("export", form, "--rig", rig).out == file.read_text().rstrip("\n") + "\n"
    document = json.loads(calib("export", form, "--rig", rig, "--json").out)
    assert document["text"] == file.read_text()
    ended = calib("import", form, file, "--rig", other)
    assert ended.code == 0
    assert "without error bars" in ended.out
    before, after = (yaml.safe_load(path.read_text())["camera"] for path in (rig, other))
    for key in ("fx_px", "fy_px", "cx_px", "cy_px", "image_size_px"):
        assert after[key] == before[key]
    assert after["distortion"]["k1"] == before["distortion"]["k1"]
    assert after["verdict"] == "poor"
    assert list(yaml.safe_load(other.read_text())["provenance"]["inputs"]["camera"]) == [file.name]


@pytest.mark.parametrize("form", ["ros", "opencv"])
def test_a_skew_that_readers_ignore_is_told(calib, rig, tmp_path, form: str) -> None:
    file, skewed = tmp_path / "camera.yaml", tmp_path / "skewed.yaml"
    assert "skew_px" not in calib("export", form, "--rig", rig, "-o", file).err
    whole = yaml.safe_load(rig.read_text())
    camera = whole["camera"]
    camera["skew_px"] = 2.0
    skewed.write_text(yaml.safe_dump({"schema": whole["schema"], "camera": camera}))
    ended = calib("export", form, "--rig", skewed, "-o", file)
    rows = max(camera["cy_px"], camera["image_size_px"][1] - 1 - camera["cy_px"])
    assert ended.code == 0
    assert f"they are {2.0 * rows / camera['fy_px']:.2g} px off at the picture's border" in ended.err


def test_one_camera_of_a_chain_is_taken_and_the_others_are_named(calib, rig, tmp_path) -> None:
    file = tmp_path / "camchain.yaml"
    assert calib("export", "kalibr", "--rig", rig, "-o", file).code == 0
    one = file.read_text()
    file.write_text(one + "  timeshift_cam_imu: 0.005\n" + one.replace("cam0", "cam1"))
    out = calib("import", "kalibr", file, "--rig", tmp_path / "a.yaml").out
    assert "cam0 is taken, cam1 left out" in out
    assert "timeshift_cam_imu are not read" in out


def test_of_a_bag_its_camera_info_is_asked_for(calib, tmp_path) -> None:
    bag = tmp_path / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n\xff")
    said = calib("import", "ros", bag, "--rig", tmp_path / "rig.yaml").sentence
    assert "drive.bag: is a bag, expected a file of the camera" in said and "--once TOPIC" in said


BAD = {
    "empty": b"",
    "a list": b"- 1\n",
    "deep": b"[" * 5000,
    "large": b"a: 1\n" * 100_000,
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("what", BAD)
def test_other_files(calib, rig, tmp_path, form: str, what: str) -> None:
    file, before = tmp_path / "camera.yaml", rig.read_bytes()
    file.write_bytes(BAD[what])
    ended = calib("import", form, file, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(f"{file}: ")
    assert rig.read_bytes() == before


def test_no_file(calib, tmp_path) -> None:
    for source, says in (
        (tmp_path, "is a folder, expected a file"),
        (tmp_path / "gone", "cannot be read: No such file"),
        ("/dev/zero", "is a pipe or a device"),
    ):
        ended = calib("import", "opencv", source, "--rig", tmp_path / "rig.yaml")
        assert ended.code == 3
        assert says in ended.sentence
    ended = calib("export", "ros", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert "has no camera yet" in ended.sentence


IMU = (
    "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    "gyroscope_noise_density: 1.6968e-04\ngyroscope_random_walk: 1.9393e-05\n"
    "rostopic: /imu0\nupdate_rate: 200.0\n"
)


def test_the_noise_of_an_imu_there_and_back(calib, rig, tmp_path) -> None:
    file, again = tmp_path / "imu.yaml", tmp_path / "again.yaml"
    assert calib("export", "kalibr-imu", "--rig", rig).code == 3
    file.write_text(IMU)
    ended = calib("import", "kalibr-imu", file, "--rig", rig)
    assert ended.code == 0 and "verdict is poor until" in ended.out
    section = yaml.safe_load(rig.read_text())["imu"]
    assert section["gyro_walk_radps2_per_sqrt_Hz"] == [1.9393e-05] * 3 and section["rate_hz"] == 200.0
    ended = calib("export", "kalibr-imu", "--rig", rig, "-o", again, "--name", "/imu0")
    assert ended.code == 0 and "the IMU's verdict is poor" in ended.err
    assert yaml.safe_load(again.read_text()) == yaml.safe_load(IMU)
    assert calib("export", "kalibr-imu", "--rig", rig, "--name", "x: 1\ny").code == 2
    assert json.loads(calib("import", "kalibr-imu", again, "--rig", rig, "--json").out)["imu"] == section


def test_points_of_nothing_have_no_answer(calib, tmp_path) -> None:
    """Drawn at random, as no camera sees a board; a matrix on the way to their camera holds no numbers."""
    rng = np.random.default_rng(0)
    target = Board(4, 3, 0.02).points_m()
    rows = ["view,x_m,y_m,u_px,v_px"]
    for name in "abcde":
        pixels = rng.uniform(1.0, 230.0, (len(target), 2))
        rows += [f"{name},{x},{y},{u},{v}" for (x, y), (u, v) in zip(target, pixels, strict=True)]
    points, rig = tmp_path / "points.csv", tmp_path / "rig.yaml"
    points.write_text("\n".join(rows) + "\n")
    words = (points, "--image-size", "320x240", "--model", "pinhole", "--keep-all", "--rig", rig)
    ended = calib("intrinsics", *words)
    assert ended.code == 3 and ended.sentence == f"{points}: no useful answer follows"
    assert not rig.exists()
