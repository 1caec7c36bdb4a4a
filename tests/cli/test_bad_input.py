"""What is wrong with an input ends in one sentence and exit code 3, and leaves rig.yaml as it was."""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

RADIAL2 = ("--model", "radial2")


def _encoded(kind: str, picture: np.ndarray) -> bytes:
    return cv2.imencode(kind, picture)[1].tobytes()


def _part(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png_of(header: tuple[int, ...], rows: bytes) -> bytes:
    parts = _part(b"IHDR", struct.pack(">IIBBBBB", *header)) + _part(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + parts + _part(b"IEND", b"")


@pytest.fixture
def gray(project_root: Path) -> np.ndarray:
    return cv2.imread(str(project_root / "images" / "view01.png"), cv2.IMREAD_GRAYSCALE)


def _middle_changed(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(b ^ 0x5A for b in data[middle : middle + 30]) + data[middle + 30 :]


DAMAGED: dict[str, tuple[Callable[[np.ndarray], bytes], str]] = {
    "text.png": (lambda gray: b"no picture at all\n", "not a picture that can be decoded"),
    "zero.png": (lambda gray: b"", "is empty"),
    "short.png": (lambda gray: _encoded(".png", gray)[:-100], "truncated PNG"),
    "middle.png": (lambda gray: _middle_changed(_encoded(".png", gray)), "damaged PNG"),
    "fewrows.png": (lambda gray: _png_of((316, 208, 8, 0, 0, 0, 0), bytes(317 * 100)), "can be decoded"),
    "depth.png": (lambda gray: _png_of((316, 208, 17, 0, 0, 0, 0), bytes(99)), "can be decoded"),
    "nothing.png": (lambda gray: _png_of((0, 0, 8, 0, 0, 0, 0), b""), "can be decoded"),
    "bomb.png": (lambda gray: _png_of((60000, 60000, 8, 0, 0, 0, 0), b""), "million pixels"),
    "half.jpg": (lambda gray: (d := _encoded(".jpg", gray))[: len(d) // 2], "truncated or damaged JPEG"),
    "ended.jpg": (lambda gray: (d := _encoded(".jpg", gray))[: len(d) // 2] + b"\xff\xd9", "premature end"),
    "half.tif": (lambda gray: (d := _encoded(".tif", gray))[: len(d) // 2], "can be decoded"),
    "half.bmp": (lambda gray: (d := _encoded(".bmp", gray))[: len(d) // 2], "can be decoded"),
    "half.webp": (lambda gray: (d := _encoded(".webp", gray))[: len(d) // 2], "can be decoded"),
    "bomb.pgm": (lambda gray: b"P5 60000 60000 255\n" + bytes(100), "more than 178 million pixels"),
}


@pytest.mark.few(1, 3, 7, 8)
@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_picture_alone(calib, pictures, rig, gray, name: str) -> None:
    make, says = DAMAGED[name]
    folder, before = pictures(0), rig.read_bytes()
    (folder / name).write_bytes(make(gray))
    ended = calib("intrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(f"{folder / name}: ")
    assert says in ended.sentence
    assert ended.out == ""
    assert rig.read_bytes() == before


def test_what_is_no_picture_of_the_board_among_good_ones(calib, pictures, gray, noise, tmp_path) -> None:
    """All that is there and not used is named; the camera is the same as without it."""
    folder, rig, clean = pictures(8), tmp_path / "rig.yaml", tmp_path / "clean.yaml"
    assert calib("intrinsics", folder, *RADIAL2, "--rig", clean).code == 0
    for name, (make, _) in DAMAGED.items():
        (folder / name).write_bytes(make(gray))
    (folder / "poster.png").write_bytes(_encoded(".png", noise(316, 208)))
    (folder / "small.png").write_bytes(_encoded(".png", gray[:-1]))
    (folder / "upright.png").write_bytes(_encoded(".png", gray.T))
    (folder / "notes.txt").write_text("the third one is blurred")
    (folder / "gone.png").symlink_to("nowhere.png")
    ended = calib("intrinsics", folder, *RADIAL2, "--rig", rig, "--json")
    values, alone = (yaml.safe_load(path.read_text())["camera"] for path in (rig, clean))
    assert all(values[key] == alone[key] for key in ("fx_px", "cx_px", "distortion", "sigma", "views"))
    why = {one["file"]: one["why"] for one in json.loads(ended.out)["not_used"]}
    assert all(says in why[name] for name, (_, says) in DAMAGED.items())
    assert why["poster.png"] == "shows no board with 7x5 inner corners that can be read"
    assert why["small.png"] == "is 316x207 px; 15 others are 316x208 px"
    assert why["upright.png"] == "is 208x316 px, as if turned by a quarter; 15 others are 316x208 px"
    assert why["notes.txt"].startswith("is no picture (png")
    assert why["gone.png"].startswith("cannot be read: No such file")
    assert len(why) == len(DAMAGED) + 5


def test_what_decoders_say_on_stderr_does_not_come_through(process, pictures, gray, tmp_path) -> None:
    # libpng warns of the colour profile, libjpeg of damage; both write to file descriptor 2 themselves.
    folder = pictures(0)
    png = _encoded(".png", gray)
    (folder / "a.png").write_bytes(png[:33] + _part(b"iCCP", b"x\0\0garbage") + png[33:])
    ended = process("intrinsics", folder, *RADIAL2, "--corners", "7x5", "--rig", tmp_path / "rig.yaml")
    assert ended.code == 1
    assert "libpng" not in ended.err
    (folder / "b.jpg").write_bytes(DAMAGED["ended.jpg"][0](gray))
    ended = process("intrinsics", folder, *RADIAL2, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 1
    assert "not used: b.jpg: is a truncated or damaged JPEG (premature end of data segment)" in ended.out
    assert "libjpeg" not in ended.err and "Corrupt" not in ended.err


@pytest.mark.parametrize("kind", ["deep", "alpha", "colour", "cmyk", "exif"])
def test_other_kinds_of_picture_show_the_same_board(calib, pictures, gray, tmp_path, kind: str) -> None:
    Image = pytest.importorskip("PIL.Image")
    folder = pictures(0)
    if kind == "deep":
        (folder / "a.png").write_bytes(_encoded(".png", gray.astype(np.uint16) * 200))
    elif kind == "alpha":
        (folder / "a.png").write_bytes(_encoded(".png", np.dstack([gray, gray, gray, gray * 0])))
    elif kind == "colour":
        (folder / "a.png").write_bytes(_encoded(".png", np.dstack([gray] * 3)))
    elif kind == "cmyk":
        Image.fromarray(gray).convert("CMYK").save(folder / "a.jpg", quality=95)
    else:
        turned = Image.Exif()
        turned[0x112] = 6
        Image.fromarray(gray).save(folder / "a.jpg", quality=95, exif=turned)
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", folder, *RADIAL2, "--corners", "7x5", "--rig", rig)
    assert ended.code == 1
    assert "image_size_px: [316, 208]" in rig.read_text()
    assert "points: 35" in rig.read_text()
    assert ("a.jpg: turning by EXIF is not done" in ended.err) == (kind == "exif")


def test_a_picture_of_one_pixel_and_pictures_without_a_board(calib, pictures, noise, tmp_path) -> None:
    folder, rig = pictures(0), tmp_path / "rig.yaml"
    (folder / "one.png").write_bytes(_encoded(".png", noise(1, 1)))
    ended = calib("intrinsics", folder, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith("one.png: no checkerboard found in the picture, expected a whole one")
    (folder / "one.png").unlink()
    for name in ("a.png", "b.png"):
        (folder / name).write_bytes(_encoded(".png", noise(24, 18)))
    ended = calib("intrinsics", folder, "--corners", "7x5", "--rig", rig)
    assert ended.code == 3
    assert "no board with 7x5 inner corners found in any of 2 pictures, and no other" in ended.sentence
    assert not rig.exists()


@pytest.mark.slow
def test_pictures_of_thirty_megapixels(calib, pictures, gray, tmp_path) -> None:
    folder = pictures(0)
    large = cv2.GaussianBlur(cv2.resize(gray, (6708, 4416), interpolation=cv2.INTER_CUBIC), (0, 0), 6)
    for name in ("a.png", "b.png"):
        (folder / name).write_bytes(_encoded(".png", large))
    rig = tmp_path / "rig.yaml"
    assert calib("intrinsics", folder, *RADIAL2, "--rig", rig).code == 1
    assert "image_size_px: [6708, 4416]" in rig.read_text()
    # The second picture shows the board where the first one does.
    assert "points: 35" in rig.read_text()


def test_folders_without_pictures(calib, pictures, tmp_path) -> None:
    folder = pictures(0)
    for prepare in (
        lambda: None,
        lambda: (folder / ".hidden.png").write_bytes(b"x"),
        lambda: shutil.copytree(pictures(2, name="other"), folder / "inside"),
        (folder / "folder.png").mkdir,
    ):
        prepare()
        ended = calib("intrinsics", folder, "--rig", tmp_path / "rig.yaml")
        assert ended.code == 3
        assert f"{folder}: holds no pictures, expected files of png" in ended.sentence


def test_sources_that_are_not_there_or_no_files(calib, pictures, tmp_path) -> None:
    folder, rig = pictures(1), tmp_path / "rig.yaml"
    os.mkfifo(tmp_path / "pipe.png")
    os.mkfifo(tmp_path / "pipe.csv")
    for words, says in (
        ([tmp_path / "gone"], "gone: does not exist"),
        ([tmp_path / "gone.csv", "--image-size", "640x480"], "gone.csv: cannot be read: No such file"),
        ([tmp_path / "pipe.png"], "is a pipe or a device, expected a file"),
        ([tmp_path / "pipe.csv", "--image-size", "640x480"], "is a pipe or a device, expected a file"),
        (["/dev/zero"], "/dev/zero: is a pipe or a device, expected a file"),
        ([folder / "view01.png", folder / "view01.png"], "view01.png: two pictures have this name"),
    ):
        ended = calib("intrinsics", *words, "--rig", rig)
        assert ended.code == 3
        assert says in ended.sentence
    assert not rig.exists()


ODD_NAMES = (
    "a\nb.png",
    "q\"'$HOME`ls`.png",
    "-dash.png",
    "\N{GRINNING FACE} \u00fc.png",
    "x\x1b[31mred.png",
    b"\xff\xfe.png".decode("utf-8", "surrogateescape"),
    "\u00b25.png",
    "%s{0}*.png",
    "a:b #c, d.png",
)


def test_odd_file_names(calib, process, pictures, project_root, gray, tmp_path) -> None:
    folder, rig = pictures(0), tmp_path / "rig.yaml"
    shipped = sorted((project_root / "images").glob("view*.png"))
    try:
        for name, path in zip(ODD_NAMES, shipped, strict=False):
            shutil.copy(path, folder / name)
    except OSError:
        pytest.skip("this file system refuses such names")
    (folder / "no\nboard.png").write_bytes(_encoded(".png", gray * 0))
    ended = process(
        "intrinsics", folder, *RADIAL2, "--corners", "7x5", "--rig", rig, PYTHONIOENCODING="ascii"
    )
    assert ended.code == 0
    assert "not used: no\\nboard.png: shows no board" in ended.out
    assert "\x1b" not in ended.out + ended.err + rig.read_text()
    assert calib("firmware", "--rig", rig, "-o", tmp_path).code == 0
    header = (tmp_path / "calib_constants.h").read_text("ascii")
    assert header.count(" * input camera/") == len(ODD_NAMES) + 1
    ended = calib("intrinsics", *RADIAL2, "--rig", rig, "--", "-dash.png", cwd=folder)
    assert ended.code == 1
    assert "board found in 1 of 1 pictures" in ended.err


BOARDS = {
    "corners: [7]": "corners is [7], expected 2 values",
    "corners: [7, '5']": "corners.1 is '5', expected a whole number (without quotes",
    "corners: [-7, 5]": "corners.0 is -7, expected 3 to 200",
    "square_m: 2e-2": "square_m is '2e-2', expected a number (without quotes, and in YAML an exponent needs",
    "square_m: 0": "square_m is 0, expected at least 1e-05 and below 10 m",
    "corner: [7, 5]": "corner is not a key that is known here",
    "corners: [7": "board.yaml, line 2: is not YAML",
    "\x01": "is not YAML",
}


@pytest.mark.parametrize("text", BOARDS)
def test_a_wrong_board_file(calib, pictures, tmp_path, text: str) -> None:
    folder = pictures(2, text + "\n")
    ended = calib("intrinsics", folder, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert ended.sentence.startswith(str(folder / "board.yaml"))
    assert BOARDS[text] in ended.sentence


RIGS = {
    b"services:\n  web: {image: nginx}\n": "is not a rig.yaml: it has 'services', expected sections",
    b"geometri: {}\n": "geometri is not a section that is known here; did you mean geometry?",
    b"": "holds nothing",
    bytes(range(256)): "is not UTF-8 text",
    b"a: &a [*a]\n": "expands to more than",
    b"camera: " + b"[" * 900 + b"]" * 900: "nested more than 40 deep",
    b"camera: {fx_px: " + b"9" * 5000 + b"}": "is not YAML that can be read",
    b"camera: {model: !!python/name:os.system }\n": "is not YAML: could not determine",
    b"geometry: {workspace_m: [1, 2, 0, 0]}\n": "geometry.workspace_m is [1, 2, 0, 0], expected [least x",
}


@pytest.mark.parametrize("number", range(len(RIGS)))
def test_a_wrong_rig_file_is_left_alone(calib, pictures, tmp_path, number: int) -> None:
    data, says = list(RIGS.items())[number]
    rig = tmp_path / "rig.yaml"
    rig.write_bytes(data)
    ended = calib("intrinsics", pictures(2), "--rig", rig)
    assert ended.code == 3
    assert ended.sentence.startswith(str(rig))
    assert says in ended.sentence
    assert rig.read_bytes() == data


CONTRADICTIONS = (
    ("fx_px: 2", "fx_px: 0.0 #", "camera.fx_px is 0, expected 0.001 to 1e+07 px"),
    ("[316, 208]", "[316.0, 208]", "camera.image_size_px.0 is 316.0, expected a whole number"),
    ("rms_px: 0", "rms_px: .inf #", "camera.rms_px is inf, expected a finite number"),
    ("  fx_px: 2", "  fx_px: 2\n  fx_px: 2", "the key fx_px was given before"),
    (
        "  A_inverse:\n  - [0.",
        "  A_inverse:\n  - [1.",
        "plane.A_inverse is not the inverse of A_px_per_m",
    ),
    ("fx_px: 27", "fx_px: 28", "plane was calibrated with another camera"),
)


@pytest.mark.parametrize(
    "verb",
    [
        "replay", "align", "identify", "identify pump", "identify arm", "imu static", "imu intrinsics",
        "imu drift", "imu tune", "validate", "convert",
    ],
)  # fmt: skip
def test_a_log_that_may_never_end(calib, rig, tmp_path, verb: str) -> None:
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    rigs = ["--rig", rig] if verb.split()[0] not in ("imu", "convert") else []
    for path in (pipe, Path("/dev/zero")):
        ended = calib(
            *verb.split(), path, *rigs, *(["-o", tmp_path / "out.csv"] if verb == "convert" else [])
        )
        assert ended.code == 3
        assert ended.sentence == f"{path}: is a pipe or a device, expected a file"


@pytest.mark.parametrize(("old", "new", "says"), CONTRADICTIONS)
def test_a_rig_that_contradicts_itself(calib, rig, old: str, new: str, says: str) -> None:
    text = rig.read_text()
    assert old in text
    rig.write_text(text.replace(old, new, 1))
    ended = calib("firmware", "--rig", rig, "-o", rig.parent / "out")
    assert ended.code == 3
    assert says in ended.sentence
    assert not (rig.parent / "out").exists()


def test_places_where_no_rig_can_be_written(calib, pictures, rig, tmp_path) -> None:
    folder = pictures(2)
    (tmp_path / "dir.yaml").mkdir()
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    (tmp_path / "lost.yaml").symlink_to("no/such/rig.yaml")
    os.mkfifo(tmp_path / "pipe.yaml")
    read_only = tmp_path / "ro.yaml"
    read_only.write_text(rig.read_text())
    read_only.chmod(0o444)
    for path, says in (
        (tmp_path / "dir.yaml", "is a folder, expected a file"),
        (tmp_path / "loop.yaml", "is a symbolic link that leads back to itself"),
        (tmp_path / "lost.yaml", "cannot be written: there is no folder"),
        (tmp_path / "pipe.yaml", "is a pipe or a device, expected a file"),
        (tmp_path / "no" / "rig.yaml", "cannot be written: there is no folder"),
        (rig / "rig.yaml", "cannot be written: there is no folder"),
        (tmp_path / ("a" * 300), "File name too long"),
        (read_only, "cannot be written: it is read-only"),
        (Path("/dev/null"), "/dev/null: is a pipe or a device"),
        (Path("/dev/zero"), "/dev/zero: is a pipe or a device"),
    ):
        ended = calib("intrinsics", folder, "--rig", path)
        assert ended.code == 3
        assert says in ended.sentence
        assert "board found" not in ended.err
    assert read_only.stat().st_mode & 0o777 == 0o444


def test_a_full_disk_leaves_the_old_file(calib, pictures, rig, monkeypatch) -> None:
    before = rig.read_bytes()
    fsync = os.fsync

    def full(descriptor: int) -> None:
        if os.fstat(descriptor).st_size > 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    ended = calib("intrinsics", pictures(3), *RADIAL2, "--rig", rig)
    assert ended.code == 3
    assert ended.sentence == f"{rig}: cannot be written: No space left on device"
    assert ended.out == ""
    assert rig.read_bytes() == before
    assert sorted(p.name for p in rig.parent.iterdir()) == ["rig.yaml", "views"]


@pytest.mark.parametrize("verb", ["intrinsics", "extrinsics", "distortion"])
def test_a_folder_for_figures_that_cannot_be_one(calib, pictures, rig, project_root, verb: str) -> None:
    words = {"intrinsics": [pictures(2)], "extrinsics": [project_root / "images" / "plane"], "distortion": []}
    before = rig.read_bytes()
    for place in (rig, rig / "below"):
        ended = calib(verb, *words[verb], "--rig", rig, "--figures", place)
        assert ended.code == 3
        assert ended.sentence == f"{place}: cannot be made a folder: {rig} is a file"
    assert rig.read_bytes() == before
