"""Pictures and figures small enough for one page: views as JPEG, figures with few colours.

What was made once is kept beside the run by the hash of its source, so that a page is rebuilt quickly
and without the pictures themselves.
"""

from __future__ import annotations

import base64
import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.errors import BadInputError
from calib.files import make_folder, read_bytes, sha256, write_atomically

__all__ = ["Embedded", "data_uri", "keep_pictures", "kept_picture", "size_of", "small_figure"]

_WIDEST_PX = 640
_QUALITY = 72
_COLOURS = 128
_MOST_PICTURES = 120
_KIND_AT, _PALETTE = 25, b"\x03"
"""Where a PNG tells how its colours are stored, and what it tells where it has few."""


@dataclass(frozen=True)
class Embedded:
    """A picture in the page: its own size in px, and the data of a smaller copy."""

    name: str
    width_px: int
    height_px: int
    data: bytes


def data_uri(data: bytes) -> str:
    """A picture as an address that needs no network."""
    if data.startswith(b"\xff\xd8"):
        kind = "jpeg"
    elif data.startswith(b"\x89PNG"):
        kind = "png"
    else:
        kind = "svg+xml"
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def size_of(png: bytes) -> tuple[int, int]:
    """Width and height of a PNG, a usual shape for anything else."""
    if png.startswith(b"\x89PNG") and len(png) >= 24:
        return int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")
    return 1196, 800


def _key(name: str) -> str:
    return sha256(name.encode("utf-8", "surrogateescape"))[:24]


def keep_pictures(paths: Sequence[Path], folder: Path) -> None:
    """Keep small copies of pictures, by name; pictures that cannot be read are passed over.

    A copy is named by the picture's name and begins with a line of the picture's hash and size and of its
    own hash.
    """
    make_folder(folder)
    wanted = {f"{_key(path.name)}.view": path for path in paths[:_MOST_PICTURES]}
    for path in folder.iterdir():
        if path.name not in wanted:
            with contextlib.suppress(OSError):
                path.unlink()
    for name, path in wanted.items():
        with contextlib.suppress(BadInputError):
            raw = read_bytes(path)
            digest = sha256(raw)
            place = folder / name
            if kept_picture(path.name, folder) and place.read_bytes()[:64] == digest.encode():
                continue
            made = _small_picture(path)
            if made is not None:
                width, height, data = made
                write_atomically(place, f"{digest} {width} {height} {sha256(data)}\n".encode() + data)


def _small_picture(path: Path) -> tuple[int, int, bytes] | None:
    import cv2

    from calib.pictures import read_picture

    gray = read_picture(path).gray
    height, width = gray.shape
    if width > _WIDEST_PX:
        size = (_WIDEST_PX, max(1, round(height * _WIDEST_PX / width)))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(gray.dtype)
    done, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return (width, height, data.tobytes()) if done else None


def kept_picture(name: str, folder: Path) -> Embedded | None:
    """The small copy of a picture by its name, None where there is none."""
    with contextlib.suppress(OSError, ValueError):
        head, data = (folder / f"{_key(name)}.view").read_bytes().split(b"\n", 1)
        _, width, height, own = head.split()
        if data.startswith(b"\xff\xd8") and own == sha256(data).encode():
            return Embedded(name, int(width), int(height), data)
    return None


def small_figure(path: Path, folder: Path, width_px: int = 0) -> bytes:
    """A figure with as few colours as it needs, from `folder` where it has been made before.

    With `width_px` it is made narrower, if it is wider than that and takes less room then.
    """
    raw = path.read_bytes()
    if not raw.startswith(b"\x89PNG"):
        return raw
    narrower = 0 < width_px < size_of(raw)[0]
    if not narrower and raw[_KIND_AT : _KIND_AT + 1] == _PALETTE:
        return raw
    place = folder / (f"{sha256(raw)}_{width_px}.png" if narrower else f"{sha256(raw)}.png")
    with contextlib.suppress(OSError):
        return place.read_bytes()
    from PIL import Image

    with Image.open(io.BytesIO(raw)) as whole:
        plain = whole.convert("RGB")
        if narrower:
            plain = plain.resize((width_px, max(1, round(plain.height * width_px / plain.width))))
        few = plain.quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        buffer = io.BytesIO()
        few.save(buffer, format="png", compress_level=6)
    small = min(buffer.getvalue(), raw, key=len)
    with contextlib.suppress(BadInputError):
        make_folder(folder)
        write_atomically(place, small)
    return small
