"""Picture files: which there are, what size they declare, whether they are whole, and their grey values."""

from __future__ import annotations

import io
import math
import os
import re
import struct
import tempfile
import threading
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.core.arrays import AnyArray, GrayImage
from calib.core.errors import BadInputError, package, pip_install
from calib.core.files import PICTURES, read_bytes, sha256, shown, to_be

# ----------------------------------------------------------------------
# How many pixels the header of a picture declares: known before anything is decoded or allocated.
#
# A few kilobytes can decode to gigabytes, and OpenCV takes the memory for all of a picture before it looks
# at the data. OpenCV's own limit is read when its library loads, which nobody here controls. Pillow reads
# the headers but for HEIF (ISO/IEC 23008-12) and for TIFF 6.0 and BigTIFF, of which it declines some kinds.

_BY_PILLOW = ("PNG", "JPEG", "BMP", "WEBP", "PPM")
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_KINDS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_TAGS = 1000
_HEIF_BYTES = 1_000_000
"""Within so many bytes properties are looked for."""
_ANIMATION_BYTES, _MOST_PAGES = 10_000, 1000


def declared_pixels(data: bytes) -> int:
    """Width times height by a picture's header; 0 where there is no header of a known kind."""
    return math.prod(declared_size(data))


def declared_size(data: bytes) -> tuple[int, int]:
    """Width and height by a picture's header; zeros where there is no header of a known kind."""
    if data[4:8] == b"ftyp":
        # The largest of the sizes in the file's properties: tiles are smaller than the whole.
        found = re.findall(rb"ispe.{4}(.{4})(.{4})", data[:_HEIF_BYTES], re.DOTALL)
        sizes = [(int.from_bytes(w), int.from_bytes(h)) for w, h in found]
        return max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))
    if data[:4] in _TIFF:
        try:
            return _tiff_size(data)
        except (struct.error, OverflowError, KeyError):
            return 0, 0
    from PIL import Image

    try:
        with _opened(io.BytesIO(data), *_BY_PILLOW) as image:
            return image.width, image.height
    except Image.DecompressionBombError:
        return _MAX_PIXELS + 1, 1
    except Exception:
        # Damaged bytes make its readers raise nearly anything.
        return 0, 0


@contextmanager
def _opened(source: Path | io.BytesIO, *formats: str) -> Iterator[Any]:
    """A picture of one of these formats, as Pillow reads it."""
    from PIL import Image

    with warnings.catch_warnings(action="ignore"), Image.open(source, formats=formats) as image:
        yield image


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Of the first picture of a file."""
    order = "<" if data.startswith(b"II") else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    start = struct.unpack_from(f"{order}Q" if big else f"{order}I", data, 8 if big else 4)[0]
    count = struct.unpack_from(f"{order}Q" if big else f"{order}H", data, start)[0]
    at, size = start + (8 if big else 2), 20 if big else 12
    found: dict[int, int] = {}
    for k in range(min(count, _MOST_TAGS)):
        tag, kind = struct.unpack_from(f"{order}HH", data, at + k * size)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            value_at = at + k * size + (12 if big else 8)
            # A tag given twice counts with its larger value.
            value = struct.unpack_from(order + _TIFF_KINDS[kind], data, value_at)[0]
            found[tag] = max(value, found.get(tag, 0))
    return int(found[_TIFF_WIDTH]), int(found[_TIFF_HEIGHT])


def count_pictures(data: bytes) -> int:
    """How many pictures of one size a file holds, as frames or pages; 1 where nobody can say."""
    if data.startswith(_PNG):
        at = data.find(b"acTL", 0, _ANIMATION_BYTES)
        return max(int.from_bytes(data[at + 4 : at + 8]), 1) if at >= 0 else 1
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return max(data.count(b"ANMF"), 1)
    if data[:4] not in _TIFF:
        return 1
    try:
        with _opened(io.BytesIO(data), "TIFF") as image:
            size, same = image.size, 1
            for page in range(1, min(getattr(image, "n_frames", 1), _MOST_PAGES)):
                image.seek(page)
                # Others are thumbnails and the steps of a pyramid.
                same += image.size == size
            return same
    except Exception:
        # Damaged bytes make its reader raise nearly anything.
        return 1


# ----------------------------------------------------------------------
# Picture files: which there are, whether they are whole, and their pixels as grey values.
#
# A picture's EXIF orientation is not applied: calibration is in the sensor's own pixels, and a camera
# that was held upright for one view has not changed its lens.

os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


_PNG = b"\x89PNG\r\n\x1a\n"
_MAX_PIXELS = 178_000_000
"""Twice as many as Pillow warns of, which is where it refuses."""
_JPEG = b"\xff\xd8"
_DAMAGE = re.compile(
    "premature end|bad huffman|bad arithmetic|found marker|inconsistent progression", re.IGNORECASE
)
"""Complaints of libjpeg after which parts of the picture are made up. Extraneous bytes are not among
them: many cameras pad their pictures."""
_STDERR = threading.Lock()
"""Held while file descriptor 2, which belongs to the whole process, leads elsewhere."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture.

    Attributes
    ----------
    name : of the file, control characters escaped.
    sha256 : of the file.
    gray : (height, width) grey values, of an interlaced picture of its first field; (0, 0) of a picture whose
        header alone was read.
    size_px : width and height.
    count : of pictures in the file, of which this is the first.
    second : the same of the second field of an interlaced picture.
    """

    name: str
    sha256: str
    gray: GrayImage
    size_px: tuple[int, int]
    count: int = 1
    second: GrayImage | None = None


def _natural(path: Path) -> tuple[object, ...]:
    """Sorting key under which view2 comes before view10."""
    parts = re.split(r"(\d+)", path.name.lower())
    key = ((0, int(p), "") if i % 2 else (1, 0, p) for i, p in enumerate(parts))
    # The name itself decides between view1 and view01: folders are listed in no certain order.
    return (*key, (2, 0, path.name))


def list_pictures(sources: Sequence[Path]) -> list[Path]:
    """Picture files of folders (without their sub-folders) and of single files, in natural order.

    Raises `BadInputError` when a source does not exist, or no pictures are there.
    """
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            with to_be("listed", source):
                inside = [p for p in source.iterdir() if _is_picture_file(p)]
            if not inside:
                kinds = ", ".join(suffix[1:] for suffix in PICTURES)
                raise BadInputError(f"{shown(source)}: holds no pictures, expected files of {kinds}")
            found += sorted(inside, key=_natural)
        elif source.exists():
            found.append(source)
        else:
            raise BadInputError(f"{shown(source)}: does not exist")
    twice = next((name for name, n in Counter(shown(path.name) for path in found).items() if n > 1), None)
    if twice is not None:
        raise BadInputError(f"{twice}: two pictures have this name; views are told apart by their names")
    return found


def holds_pictures(folder: Path) -> bool:
    """Whether a folder has pictures in it, its sub-folders left out."""
    try:
        return any(_is_picture_file(path) for path in folder.iterdir())
    except OSError:
        return False


def _is_picture_file(path: Path) -> bool:
    """Whether a folder's entry is to be read; a link that leads nowhere is, so that it is complained of."""
    if path.suffix.lower() not in PICTURES or path.name.startswith("."):
        return False
    return path.is_file() or (path.is_symlink() and not path.exists())


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
    return None


def read_picture(path: Path, pixels: bool = True) -> Picture:
    """Decode one file to 8-bit grey values.

    Colour is averaged as OpenCV does, an alpha channel is dropped, and deeper pictures are scaled so
    that their brightest 0.1 % are white. Raises `BadInputError` for what is not a whole picture.

    Parameters
    ----------
    pixels : whether to decode them; without them the header tells the size, where it can.
    """
    data = read_bytes(path)
    if not pixels:
        width, height = declared_size(data)
        if 0 < width * height <= _MAX_PIXELS:
            nothing = np.empty((0, 0), dtype=np.uint8)
            return Picture(shown(path.name), sha256(data), nothing, (width, height), count_pictures(data))
    return decoded_picture(data, shown(path), shown(path.name), sha256(data))


def decoded_picture(data: bytes, where: str, name: str, digest: str) -> Picture:
    """As `read_picture`, from bytes; `where` begins the sentence of what is wrong with them."""
    if not data:
        raise BadInputError(f"{where}: is empty, expected a picture")
    problem = _incomplete(data)
    if problem is not None:
        raise BadInputError(f"{where}: {problem}")
    pixels = declared_pixels(data)
    if not pixels:
        what = (
            "a truncated or damaged JPEG" if data.startswith(_JPEG) else "not a picture that can be decoded"
        )
        raise BadInputError(f"{where}: is {what}")
    if pixels > _MAX_PIXELS:
        raise BadInputError(f"{where}: has more than {_MAX_PIXELS // 1_000_000} million pixels")
    if data.startswith(_JPEG):
        decoded, complaints = _decoded_with_complaints(data)
        damage = next((line for line in complaints.splitlines() if _DAMAGE.search(line)), None)
        if decoded is None or damage is not None:
            why = "" if damage is None else f" ({damage.removeprefix('Corrupt JPEG data: ')[:80]})"
            raise BadInputError(f"{where}: is a truncated or damaged JPEG{why}")
    elif is_heic(data):
        decoded = decoded_heic(data, where)
    else:
        decoded = decode(data)
    if decoded is None or decoded.size == 0:
        raise BadInputError(f"{where}: is not a picture that can be decoded")
    height, width = decoded.shape[:2]
    gray, second = split_fields(eight_bits(decoded))
    return Picture(name, digest, gray, (width, height), count_pictures(data), second)


def asks_to_turn(path: Path) -> bool:
    """Whether a JPEG's EXIF orientation asks to turn or mirror it, which `read_picture` does not."""
    try:
        with _opened(path, "JPEG") as image:
            return image.getexif().get(0x112, 1) in range(2, 9)
    except Exception:
        # Of another kind, or damaged.
        return False


def is_heic(data: bytes) -> bool:
    """Whether these are the bytes of a HEIF picture that OpenCV does not decode."""
    return data[4:8] == b"ftyp" and b"avif" not in data[8:40]


def decoded_heic(data: bytes, where: str) -> AnyArray | None:
    """Grey values of a HEIC picture, turned back to the sensor's own rows; None of a damaged one.

    Its decoder holds it upright. Raises `BadInputError` without the package that decodes it.
    """
    needed = f"{where}: reading HEIC needs the package pillow-heif: {pip_install('pictures')}"
    pillow_heif = package("pillow_heif", needed)
    try:
        image = pillow_heif.open_heif(data, convert_hdr_to_8bit=True).to_pillow()
        decoded = np.asarray(image.convert("L"))
    except Exception:
        # Damaged bytes make the package raise nearly anything.
        return None
    at = data.find(b"irot", 0, _HEIF_BYTES)
    return np.ascontiguousarray(np.rot90(decoded, -(data[at + 4] & 3) if at >= 0 else 0))


def decode(data: bytes, colour: bool = False) -> AnyArray | None:
    """A picture in the sensor's own rows, in colour or as grey values of any depth; None of a damaged one."""
    kind = cv2.IMREAD_COLOR if colour else cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), kind | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None


def _decoded_with_complaints(data: bytes) -> tuple[AnyArray | None, str]:
    """A decoded picture and what the decoder wrote to stderr, the only place where it tells of damage."""
    with _STDERR, tempfile.TemporaryFile() as heard:
        before = os.dup(2)
        try:
            os.dup2(heard.fileno(), 2)
            decoded = decode(data)
        finally:
            os.dup2(before, 2)
            os.close(before)
        heard.seek(0)
        return decoded, heard.read(10_000).decode("utf-8", "replace")


_NEAR = np.ones((5, 5), dtype=np.uint8)
_NEAR[2, 2] = 0


def eight_bits(decoded: AnyArray) -> GrayImage:
    """Grey values of any depth as 8 bits, the brightest 0.1 % white; of a raw picture without its mosaic."""
    if decoded.dtype == np.uint8:
        return _without_mosaic(np.ascontiguousarray(decoded, dtype=np.uint8))
    values = decoded.astype(np.float32)
    finite = np.isfinite(values)
    if not finite.all():
        values = np.where(finite, values, np.float32(0.0))
    low = min(float(values.min()), 0.0)
    # A hot pixel is brighter than all near it, those of its own colour in a mosaic among them.
    white = float(np.percentile(np.minimum(values, cv2.dilate(values, _NEAR)), 99.9))
    if not 1e-12 < white - low < 1e30:
        return np.zeros(values.shape, dtype=np.uint8)
    values -= np.float32(low)
    values *= np.float32(255.0 / (white - low))
    gray = np.clip(np.rint(values, out=values), 0, 255, out=values).astype(np.uint8)
    return _without_mosaic(gray)


_MOSAIC = 0.08
"""Least amplitude of a mosaic, as a share of the light: up to .11 it costs no corner and no accuracy."""
_TILES = 10_000
_EVEN = 0.25
"""Most that the greens differ, as a share of what the colours do."""


def _without_mosaic(gray: GrayImage) -> GrayImage:
    """The grey values of a raw picture, whose pixels lie behind a mosaic of filters; any other as it is.

    The light m of a grey surface is read as m (1 + e (-1)^(x + y) + f (-1)^x + g (-1)^y): with both greens of
    a 2x2 block on one diagonal, f is g or -g. Tiles of 4x4 pixels tell e, f and g whatever slope m has.
    """
    height, width = (4 * (n // 4) for n in gray.shape)
    every = max(1, round(math.sqrt(height * width / 16 / _TILES)))
    tiles = gray[:height, :width].reshape(height // 4, 4, width // 4, 4)[::every, :, ::every]
    mean = tiles.mean(axis=(1, 3))
    lit = (mean > 16.0) & (mean < 240.0)
    if not lit.any():
        return gray
    steps, flat = np.array([1.0, -3.0, 3.0, -1.0]) / 8.0, np.full(4, 0.25)
    e, f, g = (
        float(np.median(np.einsum("i,minj,j->mn", down, tiles, along)[lit] / mean[lit]))
        for down, along in ((steps, steps), (flat, steps), (steps, flat))
    )
    most = max(abs(e), abs(f), abs(g))
    if most < _MOSAIC or abs(abs(f) - abs(g)) > _EVEN * most:
        return gray
    code = cv2.COLOR_BayerGR2GRAY if f * g < 0.0 else cv2.COLOR_BayerBG2GRAY
    return np.asarray(cv2.cvtColor(gray, code), dtype=np.uint8)


_GRID = (12, 16)
_FIELD_PIXELS = 300_000
_MOVED_PX, _SHARE, _FEWEST = 0.5, 0.2, 12
"""By how much edges must stand apart in odd rows, what share of the rows' differences that must explain, and
in how many cells of the grid. Of 167 photographs none has more than 4 such cells, of sharpened ones 7; woven
ones of boards that move by 0.5 to 10 pixels of a blurred edge have 40 and more."""
_LEAST_SLOPE = 2.0
"""Grey values per pixel, RMS over a cell of the grid."""


def split_fields(gray: GrayImage) -> tuple[GrayImage, GrayImage | None]:
    """The two fields of an interlaced picture, rows of the other interpolated; any other picture, alone.

    Odd rows of an interlaced picture are of another moment, in which the board stood d pixels beside: their
    light is off by -d times its slope m_x. Four rows tell m_x, and by (1, -3, 3, -1) / 8 half of what odd
    rows are off by, whatever slope the light has down the picture.
    """
    height, width = gray.shape
    rows, columns = (n // cells * cells for n, cells in zip((height // 4, width), _GRID, strict=True))
    if min(rows, columns) == 0:
        return gray, None
    every = 1 + rows * columns * 4 // _FIELD_PIXELS
    # Columns have neighbours, so rows are left out.
    quads = gray[: 4 * rows, :columns].reshape(_GRID[0], -1, 4, columns)[:, ::every].astype(np.float32)
    off = 2.0 * np.einsum("gnrx,r->gnx", quads, np.array([1.0, -3.0, 3.0, -1.0], dtype=np.float32) / 8.0)
    mean = np.einsum("gnrx,r->gnx", quads, np.array([1.0, 3.0, 3.0, 1.0], dtype=np.float32) / 8.0)
    slope = np.gradient(mean, axis=2)
    both, squares, offs = (
        cells.reshape(*cells.shape[:2], _GRID[1], -1).sum(axis=(1, 3))
        for cells in (off * slope, slope**2, off**2)
    )
    sloping = squares > _LEAST_SLOPE**2 * (off.size / (_GRID[0] * _GRID[1]))
    moved = sloping & (both**2 > _SHARE * squares * offs) & (abs(both) > _MOVED_PX * squares)
    if max(np.count_nonzero(moved & (both > 0.0)), np.count_nonzero(moved & (both < 0.0))) < _FEWEST:
        return gray, None
    return _interpolate_field(gray, 0), _interpolate_field(gray, 1)


def _interpolate_field(gray: GrayImage, first: int) -> GrayImage:
    """The rows from `first` on, every other, and those between interpolated."""
    own = np.pad(gray[first::2].astype(np.float32), ((2, 3), (0, 0)), mode="edge")
    whole = gray.copy()
    n, k = len(whole[1 - first :: 2]), 2 - first
    between = (
        9.0 * (own[k : k + n] + own[k + 1 : k + 1 + n]) - own[k - 1 : k - 1 + n] - own[k + 2 : k + 2 + n]
    ) / 16.0
    whole[1 - first :: 2] = np.clip(np.rint(between), 0, 255)
    return whole


def usual_size(pictures: Sequence[Picture]) -> tuple[int, int]:
    """The size that most pictures have; in a tie that of the first of them."""
    return Counter(picture.size_px for picture in pictures).most_common(1)[0][0]
