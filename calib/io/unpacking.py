"""Packed parts of bags, unpacked within a bound: a kilobyte may stand for gigabytes.

The packages that read bags unpack what they find, however much that becomes. So an MCAP file's chunks
are looked at before it is read, chunks and messages of ROS bags are unpacked here, and a bag that is packed
as a whole, which is unpacked on the disk, may not grow more than logs do.
"""

from __future__ import annotations

import bz2
import importlib
import io
import os
import struct
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePath
from typing import Any, BinaryIO

from calib.core.errors import BadInputError
from calib.core.files import read_yaml_mapping, shown

MOST_BYTES = 1 << 28
"""Of one record, chunk or message, packed or not."""

_MOST_GROWTH = 200
_NAME_NODE, _ARRAY_NODE, _SEQUENCE_NODE = 2, 3, 4
"""Kinds of nodes in a field's type."""
_PIECE = 1 << 20


class BoundedFile(io.BufferedReader):
    """A file that makes no room for more bytes than it has, whatever it says of the length of a part."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As the base class."""
        if size is not None and size > _PIECE:
            size = min(size, max(0, self._size - self.tell()))
        return super().read(size)


class BoundedPath(type(Path())):  # type: ignore[misc]  # a Path is made as one of two classes
    """A path whose files are `BoundedFile`, for readers that open them by themselves."""

    def open(self, mode: str = "r", *others: Any, **more: Any) -> Any:
        """As the base class."""
        return BoundedFile(self) if mode == "rb" else super().open(mode, *others, **more)


def _zstd() -> Any:
    """The package that `rosbags` uses: Python's own from 3.14 on."""
    try:
        return importlib.import_module("compression.zstd")
    except ImportError:
        return importlib.import_module("backports.zstd")


def _decompressor(packing: str) -> Any:
    if packing == "bz2":
        return bz2.BZ2Decompressor()
    if packing == "lz4":
        return importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    return _zstd().ZstdDecompressor()


def unpacked(packing: str, data: bytes) -> bytes:
    """What is packed as "bz2", "lz4" or "zstd". Raises `ValueError` for more than `MOST_BYTES`."""
    out = _at_most(packing, data)
    if len(out) > MOST_BYTES:
        raise ValueError(f"a part of it unpacks to more than {MOST_BYTES / 1e6:.0f} MB")
    return out


def bound_chunks(reader: Any) -> None:
    """Let an opened reader of ROS 1 bags unpack its chunks by `unpacked`."""
    kinds = {id(bz2.decompress): "bz2", id(importlib.import_module("lz4.frame").decompress): "lz4"}
    for place, chunk in reader.chunks.items():
        if chunk.datasize > MOST_BYTES:
            raise ValueError(f"a chunk has {chunk.datasize / 1e6:.0f} MB")
        packing = kinds.get(id(chunk.decompressor))
        if packing is not None:
            reader.chunks[place] = chunk._replace(decompressor=partial(unpacked, packing))


def check_types(kinds: Mapping[str, Any]) -> None:
    """Raise `ValueError` for message types of which no bytes at all may stand for endless elements.

    Parameters
    ----------
    kinds : constants and fields by the type's name, as `rosbags` has them; a field is its name and a node.
    """
    known: dict[str, bool] = {}

    def empty(node: Any) -> bool:
        kind, inner = int(node[0]), node[1]
        if kind == _NAME_NODE:
            return nothing(inner)
        if kind in (_ARRAY_NODE, _SEQUENCE_NODE) and empty(inner[0]):
            raise ValueError("a type of its messages has many elements that hold nothing")
        return False

    def nothing(name: str) -> bool:
        if name not in known:
            known[name] = False
            # No field is passed over: each may be what is looked for.
            found = [empty(node) for _, node in kinds[name][1]] if name in kinds else [False]
            known[name] = all(found)
        return known[name]

    for name in kinds:
        nothing(name)


def check_mcap(path: Path, stream: BinaryIO) -> None:
    """Refuse a chunk that unpacks to more than there is room for, whatever it says of itself."""
    errors = importlib.import_module("mcap.exceptions")
    records = importlib.import_module("mcap.stream_reader").StreamReader(
        stream, emit_chunks=True, record_size_limit=MOST_BYTES
    )
    try:
        for record in records.records:
            if type(record).__name__ == "Chunk" and (size := _unpacked_size(record)) > MOST_BYTES:
                raise BadInputError(
                    f"{shown(path)}: a chunk unpacks to {size / 1e6:.0f} MB or more, expected at most "
                    f"{MOST_BYTES / 1e6:.0f}"
                )
    except (errors.EndOfFile, struct.error):
        # How much of a file that ends early can be used is seen when it is read.
        pass
    stream.seek(0)


def _unpacked_size(chunk: Any) -> int:
    """Bytes that a chunk unpacks to, at least, where that is beyond what is allowed."""
    size = int(chunk.uncompressed_size)
    if chunk.compression == "zstd":
        told = int(importlib.import_module("zstandard").frame_content_size(chunk.data))
        return max(size, told if told >= 0 else len(_at_most("zstd", chunk.data)))
    if chunk.compression == "lz4" and 255 * len(chunk.data) > MOST_BYTES:
        return max(size, len(_at_most("lz4", chunk.data)))
    return size


def _at_most(packing: str, data: bytes) -> bytes:
    found: bytes = _decompressor(packing).decompress(data, MOST_BYTES + 1)
    return found


def check_folder_of_bag(path: Path) -> str:
    """How the messages of a ROS 2 bag's folder are packed: "zstd", or "" where they are not.

    Raises `BadInputError` where its metadata are no YAML, or a file of it unpacks to too much.
    """
    told = read_yaml_mapping(path / "metadata.yaml").get("rosbag2_bagfile_information")
    if not isinstance(told, dict):
        raise BadInputError(f"{shown(path)}: has a metadata.yaml without rosbag2_bagfile_information")
    mode, listed = str(told.get("compression_mode") or "").lower(), told.get("relative_file_paths")
    files = [path / PurePath(str(name)).name for name in listed] if isinstance(listed, list) else []
    for file in files:
        if not file.is_file():
            raise BadInputError(f"{shown(file)}: is not there, expected a file of the bag")
        if mode == "file":
            _check_growth(file)
        elif told.get("storage_identifier") == "mcap":
            with BoundedFile(file) as stream:
                check_mcap(file, stream)
    return "zstd" if mode == "message" else ""


def _check_growth(file: Path) -> None:
    most, size = max(MOST_BYTES, _MOST_GROWTH * file.stat().st_size), 0
    with file.open("rb") as packed, _zstd().open(packed, "rb") as stream:
        while piece := stream.read(_PIECE):
            size += len(piece)
            if size > most:
                raise BadInputError(f"{shown(file)}: unpacks to more than {most / 1e6:.0f} MB")
