"""Sizes by the header alone: those that OpenCV decodes, and those that it must never try."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.core.errors import BadInputError
from calib.io.pictures import declared_pixels, read_picture

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
    with pytest.raises(BadInputError, match=f"{name}: has more than 200 million pixels"):
        read_picture(tmp_path / name)


UNKNOWN = {
    "gif": b"GIF89a\x60\xea\x60\xea\0\0\0",
    "exr": b"\x76\x2f\x31\x01" + bytes(60),
    "jpeg 2000": b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(60),
    "radiance": b"#?RADIANCE\n\n-Y 60000 +X 60000\n",
    "pam": b"P7\nWIDTH 60000\nHEIGHT 60000\nDEPTH 1\nMAXVAL 255\nENDHDR\n",
    "tiff without a size": b"II*\0\x08\0\0\0\0\0\0\0",
    "tiff that points outside": b"II*\0\xff\xff\xff\xff",
    "jpeg without a frame": b"\xff\xd8\xff\xe0\0\x04ab\xff\xd9",
    "jpeg of markers": b"\xff\xd8" + b"\xff\xd0" * 3_000_000,
    "jpeg of fill bytes": b"\xff\xd8" + b"\xff" * 30_000_000,
    "netpbm with signs": b"P5 -5 5 255 ",
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_a_file_whose_size_is_not_known_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert declared_pixels(UNKNOWN[name]) is None
    (tmp_path / "a.png").write_bytes(UNKNOWN[name])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(BadInputError, match=r"not a picture that can be decoded|JPEG"):
        read_picture(tmp_path / "a.png")


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([b"", b"\xff\xd8", b"II*\0", b"MM\0+", b"BM", b"RIFF    WEBP", b"P5 "]), st.binary())
def test_any_bytes_have_a_size_or_none(start: bytes, rest: bytes) -> None:
    found = declared_pixels(start + rest)
    assert found is None or found > 0
