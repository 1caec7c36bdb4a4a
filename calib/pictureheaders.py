"""How many pixels the header of a picture declares: known before anything is decoded or allocated.

A few kilobytes can decode to gigabytes, and OpenCV takes the memory for all of a picture before it looks
at the data. OpenCV's own limit is read when its library loads, which nobody here controls.

Formats: PNG (W3C), JPEG (T.81, B.2.2), TIFF 6.0 and BigTIFF, BMP, WebP (RFC 9649), Netpbm.
"""

from __future__ import annotations

import re
import struct

__all__ = ["declared_pixels"]

_PNG = b"\x89PNG\r\n\x1a\n"
_NETPBM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_KINDS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_TAGS = 1000
_MARKER = re.compile(rb"\xff[^\xff]", re.DOTALL)
_MOST_SEGMENTS = 10_000
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_ALONE = frozenset((0x01, *range(0xD0, 0xDA)))


def declared_pixels(data: bytes) -> int | None:
    """Width times height by a picture's header; None where there is no header of a known kind."""
    try:
        if data.startswith(_PNG):
            width, height = struct.unpack_from(">II", data, 16)
        elif data.startswith(b"\xff\xd8"):
            width, height = _jpeg(data)
        elif data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            width, height = _tiff(data)
        elif data.startswith(b"BM"):
            width, height = _bmp(data)
        elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            width, height = _webp(data)
        else:
            found = _NETPBM.match(data)
            width, height = (0, 0) if found is None else (int(found[1]), int(found[2]))
    except (struct.error, OverflowError, KeyError):
        return None
    return int(width) * int(height) or None


def _jpeg(data: bytes) -> tuple[int, int]:
    """Size in the start of frame, after the segments before it."""
    at = 2
    for _ in range(_MOST_SEGMENTS):
        # Some cameras leave bytes between segments, and any number of 0xFF may precede a marker.
        found = _MARKER.search(data, at)
        if found is None:
            break
        at, marker = found.end(), data[found.end() - 1]
        if marker in _SOF:
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
        at += 0 if marker in _ALONE else struct.unpack_from(">H", data, at)[0]
    return 0, 0


def _tiff(data: bytes) -> tuple[int, int]:
    """Size of the first picture of a file."""
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
    return found[_TIFF_WIDTH], found[_TIFF_HEIGHT]


def _bmp(data: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    # A negative height says that the rows begin at the top.
    return abs(width), abs(height)


def _webp(data: bytes) -> tuple[int, int]:
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF
