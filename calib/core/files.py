"""Names and reading of files, with errors of one sentence; `calib.core.writing` writes them."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from calib.core.command import note_inputs
from calib.core.errors import BadInputError
from calib.core.errors import one_line as one_line

_MAX_BYTES = 500_000_000
PICTURES = (
    ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".heic", ".heif", ".avif",
)  # fmt: skip
"""Endings of picture files."""
VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".mjpeg")
"""Endings of videos."""
BAGS = (".bag", ".db3", ".mcap")
"""Endings of bags; a ROS 2 bag may also be a folder."""
_MAX_YAML_BYTES = 1_000_000
_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789-_.")
_LONGEST = 80


def quoted(value: Any) -> str:
    """A value of a file as a sentence shows it."""
    text = one_line(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def shown(path: Path | str) -> str:
    """A path as an error message shows it, see `one_line`."""
    return one_line(str(path))


def inside(path: Path, root: Path) -> bool:
    """Whether a path, links followed, lies in a folder."""
    return Path(os.path.realpath(path)).is_relative_to(Path(os.path.realpath(root)))


def slug(name: str, taken: Iterable[str] = ()) -> str:
    """A file's stem as a safe name: no separators, control characters or leading dots and dashes.

    Where something had to be changed, or the name is taken, six digits of the name's hash tell it apart.
    """
    raw = name.encode("utf-8", "surrogateescape")
    text = "".join(c if c in _SAFE else "_" for c in name).lstrip(".-")[:_LONGEST]
    names = {other.lower() for other in taken}
    if text == name and text and text.lower() not in names:
        return text
    text = f"{text or 'log'}_{hashlib.sha256(raw).hexdigest()[:6]}"
    # The third of one stem, as of a log in three formats.
    return next(one for k in count(1) if (one := text if k == 1 else f"{text}_{k}").lower() not in names)


def check_readable(path: Path) -> int:
    """Size in bytes of a regular file, which is an input of the command from now on.

    Raises `BadInputError` for all else: a pipe may never end.
    """
    size = _size(path)
    note_inputs([path])
    return size


@contextmanager
def to_be(done: str, path: Path) -> Iterator[None]:
    """Raise `BadInputError` for what the system says against a path that is to be "read" or "written"."""
    try:
        yield
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be {done}: {error.strerror or error}") from error


def _size(path: Path) -> int:
    with to_be("read", path):
        status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise BadInputError(f"{shown(path)}: is a folder, expected a file")
    if not stat.S_ISREG(status.st_mode):
        raise BadInputError(f"{shown(path)}: is a pipe or a device, expected a file")
    return status.st_size


def read_bytes(path: Path, most: int = _MAX_BYTES) -> bytes:
    """Contents of a file of at most `most` bytes, or a `BadInputError` that says why not."""
    size = check_readable(path)
    data = b""
    if size <= most:
        with to_be("read", path), path.open("rb") as stream:
            data = stream.read(most + 1)
    if max(size, len(data)) > most:
        raise BadInputError(f"{shown(path)}: is larger than {most / 1e6:g} MB")
    return data


def read_text(path: Path, most: int = _MAX_BYTES) -> str:
    """Text of a UTF-8 file of at most `most` bytes, without a byte-order mark."""
    return as_text(path, read_bytes(path, most))


def as_text(path: Path, data: bytes) -> str:
    """What a UTF-8 file holds as text, without a byte-order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{shown(path)}: is not UTF-8 text (byte {error.start})") from error


def sha256(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def file_sha256(path: Path) -> str:
    """SHA-256 of a file of any size in hexadecimal, or a `BadInputError` that says why not."""
    _size(path)
    with to_be("read", path), path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_of(path: Path) -> str:
    """SHA-256 of a file of any size, or of the names and files in a bag's folder."""
    if (path / "metadata.yaml").is_file():
        files = sorted(item for item in path.iterdir() if item.is_file())
        return sha256("".join(f"{item.name!a} {file_sha256(item)}\n" for item in files).encode())
    return file_sha256(path)


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """A YAML file whose top level is a mapping; bounded in size and depth, aliases included.

    Raises `BadInputError`, also for a key that is given twice: YAML's readers would keep the last.
    """
    from calib.core.bounded_yaml import YamlProblem, load

    text = read_text(path, _MAX_YAML_BYTES)
    try:
        document = load(text)
    except YamlProblem as problem:
        where = "" if problem.line is None else f", line {problem.line}"
        raise BadInputError(f"{shown(path)}{where}: {problem.said}") from problem
    if not isinstance(document, dict):
        found = "nothing" if document is None else f"a {type(document).__name__}"
        raise BadInputError(f"{shown(path)}: holds {found}, expected keys with values")
    wrong = next((key for key in document if not isinstance(key, str)), None)
    if wrong is not None:
        raise BadInputError(f"{shown(path)}: the key {wrong!r} is not text")
    return document


def is_bag(path: Path) -> bool:
    """Whether a path is read as a bag: by its ending, or as a folder with a bag's metadata."""
    return path.suffix.lower() in BAGS or (path / "metadata.yaml").is_file()
