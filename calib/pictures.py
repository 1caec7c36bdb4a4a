"""Picture files: which there are, whether they are whole, and their pixels as grey values.

A picture's EXIF orientation is not applied: calibration is in the sensor's own pixels, and a camera
that was held upright for one view has not changed its lens.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import AnyArray, GrayImage
from calib.errors import BadInputError
from calib.files import read_bytes, sha256, shown

os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
import cv2

__all__ = ["SUFFIXES", "Picture", "list_pictures", "read_picture", "same_size"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
_MAX_FILE_BYTES = 500_000_000
_MAX_PIXELS = 200_000_000
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Picture:
    """A decoded picture: its name, SHA-256 of the file, and grey values (height, width)."""

    name: str
    sha256: str
    gray: GrayImage

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.gray.shape[1], self.gray.shape[0]


def _natural(path: Path) -> tuple[object, ...]:
    """Sorting key under which view2 comes before view10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return tuple((0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts)


def list_pictures(sources: Sequence[Path]) -> list[Path]:
    """Picture files of folders (without their sub-folders) and of single files, in natural order.

    Raises `BadInputError` when a source does not exist, or no pictures are there.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            try:
                inside = [p for p in source.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
            except OSError as error:
                raise BadInputError(f"{shown(source)}: cannot be listed: {error.strerror}") from error
            if not inside:
                kinds = ", ".join(suffix[1:] for suffix in SUFFIXES)
                raise BadInputError(f"{shown(source)}: holds no pictures, expected files of {kinds}")
            found += sorted((p for p in inside if not p.name.startswith(".")), key=_natural)
        elif source.exists():
            found.append(source)
        else:
            raise BadInputError(f"{shown(source)}: does not exist")
    names = [path.name for path in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise BadInputError(f"{shown(twice)}: two pictures have this name")
    return found


def _incomplete(data: bytes) -> str | None:
    """What is wrong with the file as a container, or None."""
    if data.startswith(_PNG):
        at = len(_PNG)
        while at + 12 <= len(data):
            length, kind = struct.unpack(">I4s", data[at : at + 8])
            end = at + 12 + length
            if end > len(data):
                break
            if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack(">I", data[end - 4 : end])[0]:
                return f"is a damaged PNG (checksum of its {kind.decode('latin-1')} part)"
            if kind == b"IEND":
                return None
            at = end
        return "is a truncated PNG"
    # Entropy-coded data escape the byte FF, so the last start-of-scan is the picture's own.
    if data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        return "is a truncated JPEG"
    return None


def _declared_pixels(data: bytes) -> int:
    """Width times height as a PNG or JPEG header declares them, zero where unknown."""
    if data.startswith(_PNG) and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width) * int(height)
    if data.startswith(b"\xff\xd8"):
        at = 2
        while at + 9 < len(data) and data[at] == 0xFF:
            marker, length = data[at + 1], struct.unpack(">H", data[at + 2 : at + 4])[0]
            if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
                height, width = struct.unpack(">HH", data[at + 5 : at + 9])
                return int(width) * int(height)
            at += 2 + length
    return 0


def read_picture(path: Path) -> Picture:
    """Decode one file to 8-bit grey values.

    Colour is averaged as OpenCV does, an alpha channel is dropped, and deeper pictures are scaled so
    that their brightest 0.1 % are white. Raises `BadInputError` for what is not a whole picture.
    """
    if path.exists() and path.stat().st_size > _MAX_FILE_BYTES:
        raise BadInputError(f"{shown(path)}: is larger than {_MAX_FILE_BYTES // 1_000_000} MB")
    data = read_bytes(path)
    if not data:
        raise BadInputError(f"{shown(path)}: is empty, expected a picture")
    problem = _incomplete(data)
    if problem is not None:
        raise BadInputError(f"{shown(path)}: {problem}")
    if _declared_pixels(data) > _MAX_PIXELS:
        raise BadInputError(f"{shown(path)}: has more than {_MAX_PIXELS // 1_000_000} million pixels")
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        decoded = None
    if decoded is None or decoded.size == 0:
        raise BadInputError(f"{shown(path)}: is not a picture that can be decoded")
    return Picture(path.name, sha256(data), _eight_bits(decoded))


def _eight_bits(decoded: AnyArray) -> GrayImage:
    if decoded.dtype == np.uint8:
        return np.ascontiguousarray(decoded, dtype=np.uint8)
    values = np.nan_to_num(decoded.astype(np.float64))
    low = min(float(values.min()), 0.0)
    white = float(np.percentile(values, 99.9))
    scaled = (values - low) * (255.0 / max(white - low, 1e-12))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def same_size(pictures: Sequence[Picture]) -> tuple[int, int]:
    """The size that all pictures have; `BadInputError` names two that differ."""
    first = pictures[0]
    for other in pictures[1:]:
        if other.size_px != first.size_px:
            a, b = first.size_px, other.size_px
            raise BadInputError(
                f"{shown(other.name)}: is {b[0]}x{b[1]} px, but {shown(first.name)} is {a[0]}x{a[1]} px; "
                "pictures of one camera have one size"
            )
    return first.size_px
