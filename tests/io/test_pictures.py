"""Pictures: which files are whole, their sizes by the header alone, and what their pixels are."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from calib.core.errors import BadInputError
from calib.io.pictures import count_pictures, declared_pixels, list_pictures, read_picture
from calib.stages.camera.corners import detect

GRAY = (np.add.outer(np.arange(40), np.arange(60)) * 2).astype(np.uint8)


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _jpg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def test_a_picture_that_declares_gigabytes_is_not_decoded(tmp_path: Path) -> None:
    import struct
    import zlib

    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = part(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 8, 0, 0, 0, 0))
    bomb = b"\x89PNG\r\n\x1a\n" + header + part(b"IDAT", zlib.compress(bytes(1000))) + part(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(BadInputError, match="million pixels"):
        read_picture(tmp_path / "bomb.png")


def test_depths_and_channels_become_grey(tmp_path: Path) -> None:
    deep = GRAY.astype(np.uint16) * 64
    (tmp_path / "deep.png").write_bytes(_png(deep))
    (tmp_path / "alpha.png").write_bytes(_png(np.dstack([GRAY, GRAY, GRAY, np.full_like(GRAY, 9)])))
    (tmp_path / "colour.png").write_bytes(_png(np.dstack([GRAY] * 3)))
    (tmp_path / "tiny.png").write_bytes(_png(GRAY[:1, :1]))
    gray = read_picture(tmp_path / "deep.png").gray
    assert gray.dtype == np.uint8
    white = np.percentile(GRAY, 99.9)
    assert np.abs(gray.astype(int) - np.clip(GRAY * (255 / white), 0, 255)).max() <= 1
    hot = np.random.default_rng(0).random(deep.shape) < 0.002
    (tmp_path / "hot.png").write_bytes(_png(np.where(hot, np.uint16(65535), deep)))
    spotted = read_picture(tmp_path / "hot.png").gray[~hot].astype(int)
    assert np.abs(spotted - gray[~hot]).max() <= 0.05 * 255
    np.testing.assert_array_equal(read_picture(tmp_path / "alpha.png").gray, GRAY)
    np.testing.assert_array_equal(read_picture(tmp_path / "colour.png").gray, GRAY)
    assert read_picture(tmp_path / "tiny.png").size_px == (1, 1)


@pytest.mark.parametrize("filters", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_a_raw_picture_is_read_without_its_mosaic(project_root: Path, tmp_path: Path, filters: str) -> None:
    path = project_root / "images" / "view03.png"
    gray = read_picture(path).gray
    raw = gray.astype(float)
    for k, colour in enumerate(filters):
        raw[k // 2 :: 2, k % 2 :: 2] *= {"R": 0.7, "G": 1.0, "B": 0.55}[colour]
    cv2.imwrite(str(tmp_path / "raw.png"), np.rint(raw).astype(np.uint8))
    whole, behind = (detect(read_picture(one).gray, 7, 5) for one in (path, tmp_path / "raw.png"))
    assert whole is not None and behind is not None
    # Not even a tenth of a pixel goes to a step between the colours' grids.
    np.testing.assert_allclose(behind.pixels, whole.pixels, atol=0.1)
    assert abs(np.mean(behind.pixels - whole.pixels)) < 0.01
    np.testing.assert_array_equal(gray, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("moved_px", [-3.0, 1.0, 6.0])
def test_an_interlaced_picture_is_read_as_its_first_field(
    project_root: Path, tmp_path: Path, moved_px: float
) -> None:
    """The odd rows of the board that moved are as the even ones say, to a tenth of a pixel."""
    gray = read_picture(project_root / "images" / "view03.png").gray
    step = np.array([[1.0, 0.0, moved_px], [0.0, 1.0, 0.0]])
    woven = gray.copy()
    woven[1::2] = cv2.warpAffine(gray, step, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)[1::2]
    cv2.imwrite(str(tmp_path / "woven.png"), woven)
    whole, field = (detect(one, 7, 5) for one in (gray, read_picture(tmp_path / "woven.png").gray))
    assert whole is not None and field is not None
    np.testing.assert_allclose(field.pixels, whole.pixels, atol=0.15)
    assert abs(np.mean(field.pixels - whole.pixels)) < 0.01


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "WEBP"])
def test_pictures_of_a_file_are_counted(tmp_path: Path, kind: str) -> None:
    """Frames of an animation and pages; a thumbnail, which is smaller, is none."""
    one, other = (Image.fromarray(gray) for gray in (GRAY, GRAY[::-1].copy()))
    file = tmp_path / "several"
    one.save(file, kind, save_all=True, append_images=[other, one])
    assert count_pictures(file.read_bytes()) == 3
    one.save(file, kind)
    assert count_pictures(file.read_bytes()) == 1
    if kind == "TIFF":
        one.save(file, kind, save_all=True, append_images=[one.resize((6, 4))])
        assert count_pictures(file.read_bytes()) == 1
    assert count_pictures(file.read_bytes()[:20]) == 1


def test_exif_orientation_is_left_alone(tmp_path: Path) -> None:
    plain = _jpg(GRAY)
    exif = (
        b"\xff\xe1\x00\x22Exif\x00\x00MM\x00\x2a\x00\x00\x00\x08\x00\x01"
        b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    )
    (tmp_path / "turned.jpg").write_bytes(plain[:2] + exif + plain[2:])
    assert read_picture(tmp_path / "turned.jpg").size_px == (60, 40)


def test_folders_are_listed_in_natural_order_without_sub_folders(tmp_path: Path) -> None:
    for name in ("view10.png", "view2.PNG", "notes.txt", ".hidden.png", "view1.jpg"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "plane").mkdir()
    (tmp_path / "plane" / "plane01.png").write_bytes(b"x")
    assert [p.name for p in list_pictures([tmp_path])] == ["view1.jpg", "view2.PNG", "view10.png"]


def test_the_order_does_not_depend_on_the_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["view1.png", "view01.png", "View1.png", "\u00b25.png", "10.png", "9.png"]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    if len(list(tmp_path.iterdir())) < len(names):
        pytest.skip("this file system does not tell upper from lower case")
    listed = [p.name for p in list_pictures([tmp_path])]
    inside = list(tmp_path.iterdir())
    monkeypatch.setattr(Path, "iterdir", lambda self: reversed(inside))
    assert [p.name for p in list_pictures([tmp_path])] == listed
    assert listed[:2] == ["9.png", "10.png"]


def test_a_motion_photo_with_a_film_behind_the_picture(tmp_path: Path) -> None:
    # The film's bytes may look like markers of a picture.
    (tmp_path / "a.jpg").write_bytes(_jpg(GRAY) + b"ftyp\xff\xda\x00" * 50)
    assert read_picture(tmp_path / "a.jpg").size_px == (60, 40)


def test_damage_that_only_the_decoder_sees(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    data = _jpg(noise)
    (tmp_path / "a.jpg").write_bytes(data[: len(data) // 2] + b"\xff\xd9")
    with pytest.raises(BadInputError, match=r"damaged JPEG \(premature end of data segment\)"):
        read_picture(tmp_path / "a.jpg")
    assert capfd.readouterr().err == ""


def test_floats_with_infinities_and_without_contrast(tmp_path: Path) -> None:
    values = GRAY.astype(np.float32) / 255
    values[3, 3], values[4, 4] = np.inf, np.nan
    (tmp_path / "a.tif").write_bytes(cv2.imencode(".tif", values)[1].tobytes())
    gray = read_picture(tmp_path / "a.tif").gray
    assert gray.dtype == np.uint8
    assert np.median(gray) == pytest.approx(np.median(GRAY) * 255 / np.percentile(GRAY, 99.9), abs=2)
    (tmp_path / "b.png").write_bytes(_png(np.zeros((9, 9), np.uint16)))
    assert read_picture(tmp_path / "b.png").gray.max() == 0


FORMATS = (".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm", ".ppm")


@pytest.mark.parametrize("suffix", FORMATS)
@settings(max_examples=15, deadline=None)
@given(width=st.integers(1, 400), height=st.integers(1, 300), colour=st.booleans())
def test_the_size_is_the_decoded_one(suffix: str, width: int, height: int, colour: bool) -> None:
    colour = suffix == ".ppm" or (colour and suffix != ".pgm")
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3) if colour else (height, width))
    done, data = cv2.imencode(suffix, image.astype(np.uint8))
    assert done
    assert declared_pixels(data.tobytes()) == width * height


def test_lossy_webp_and_deep_tiff() -> None:
    image = np.zeros((37, 91), np.uint8)
    lossy = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()
    assert declared_pixels(lossy) == 37 * 91
    assert declared_pixels(cv2.imencode(".tiff", image.astype(np.uint16))[1].tobytes()) == 37 * 91


def tiff(order: str, big: bool, kind: int, width: int, height: int) -> bytes:
    mark = {"<": b"II", ">": b"MM"}[order]
    letter = {3: "H", 4: "I", 16: "Q"}[kind]
    room = 8 if big else 4
    tags = [
        struct.pack(f"{order}HH{'Q' if big else 'I'}", tag, kind, 1)
        + struct.pack(order + letter, value).ljust(room, b"\0")
        for tag, value in ((256, width), (257, height))
    ]
    if big:
        return mark + struct.pack(f"{order}HHHQQ", 43, 8, 0, 16, 2) + b"".join(tags) + bytes(8)
    return mark + struct.pack(f"{order}HIH", 42, 8, 2) + b"".join(tags) + bytes(4)


HUGE = {
    "big.tif": tiff("<", False, 4, 60_000, 60_000),
    "motorola.tif": tiff(">", False, 3, 60_000, 60_000),
    "bigtiff.tif": tiff("<", True, 16, 60_000, 60_000),
    "big.bmp": b"BM" + struct.pack("<IIIIiiHHIIiiII", 0, 0, 54, 40, 60_000, -60_000, 1, 8, 0, 0, 1, 1, 0, 0),
    "old.bmp": b"BM" + struct.pack("<IIIIHHHH", 0, 0, 26, 12, 60_000, 60_000, 1, 8),
    "big.webp": b"RIFF\x64\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\x5f\xea\x00\x5f\xea\x00" + bytes(40),
    "big.pgm": b"P5\n# large\n60000 60000\n255\n" + bytes(100),
    "big.ppm": b"P3 60000\t60000 255 1 1 1",
    "big.jpg": b"\xff\xd8\xff\xff\xe0\0\x04ab\xff\xc2\0\x11\x08\xea\x60\xea\x60\x03" + bytes(40),
    "other.png": b"P5 60000 60000 255 ",
}


@pytest.mark.parametrize("name", HUGE)
def test_a_header_of_gigabytes_is_refused_before_anything_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("was decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    (tmp_path / name).write_bytes(HUGE[name])
    with pytest.raises(BadInputError, match=f"{name}: has more than 178 million pixels"):
        read_picture(tmp_path / name)


UNKNOWN = {
    "gif": b"GIF89a\x60\xea\x60\xea\0\0\0",
    "radiance": b"#?RADIANCE\n\n-Y 60000 +X 60000\n",
    "jpeg without a frame": b"\xff\xd8\xff\xe0\0\x04ab\xff\xd9",
    "netpbm with signs": b"P5 -5 5 255 ",
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_a_file_whose_size_is_not_known_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert declared_pixels(UNKNOWN[name]) == 0
    (tmp_path / "a.png").write_bytes(UNKNOWN[name])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(BadInputError, match=r"not a picture that can be decoded|JPEG"):
        read_picture(tmp_path / "a.png")


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([b"", b"\xff\xd8", b"II*\0", b"MM\0+", b"BM", b"RIFF    WEBP", b"P5 "]), st.binary())
def test_any_bytes_have_a_size_or_none(start: bytes, rest: bytes) -> None:
    found = declared_pixels(start + rest)
    assert found >= 0
