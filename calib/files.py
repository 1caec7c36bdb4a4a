"""Reading and replacing files: whole, atomic, and with errors of one sentence."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Any

from calib.errors import BadInputError

__all__ = ["check_writable", "make_folder", "read_bytes", "read_text", "read_yaml_mapping", "sha256", "shown", "write_atomically"]

_MAX_YAML_BYTES = 4_000_000
_MAX_YAML_NODES = 200_000


def shown(path: Path | str) -> str:
    """A path as an error message shows it: line breaks and other control characters escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in str(path))


def read_bytes(path: Path) -> bytes:
    """Contents of a file, or a `BadInputError` that says why not."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be read: {error.strerror or error}") from error


def read_text(path: Path) -> str:
    """Text of a UTF-8 file, without a byte-order mark."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{shown(path)}: is not UTF-8 text (byte {error.start})") from error


def sha256(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def read_yaml_mapping(path: Path) -> dict[str, Any]:
    """A YAML file whose top level is a mapping; bounded in size, aliases included."""
    import yaml

    if path.exists() and path.stat().st_size > _MAX_YAML_BYTES:
        raise BadInputError(f"{shown(path)}: is larger than {_MAX_YAML_BYTES // 1_000_000} MB, expected a short file")
    text = read_text(path)
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        problem = " ".join(str(getattr(error, "problem", None) or "not readable").split())
        raise BadInputError(f"{shown(path)}{where}: is not YAML: {problem}") from error
    except (RecursionError, ValueError) as error:
        raise BadInputError(f"{shown(path)}: is not YAML that can be read: {error}") from error
    if not isinstance(document, dict):
        found = "nothing" if document is None else f"a {type(document).__name__}"
        raise BadInputError(f"{shown(path)}: holds {found}, expected keys with values")
    if _nodes(document, _MAX_YAML_NODES) < 0:
        raise BadInputError(f"{shown(path)}: expands to more than {_MAX_YAML_NODES} values")
    wrong = next((key for key in document if not isinstance(key, str)), None)
    if wrong is not None:
        raise BadInputError(f"{shown(path)}: the key {wrong!r} is not text")
    return document


def _nodes(value: Any, left: int) -> int:
    """`left` less the values below this one, each alias counted; negative when there are too many."""
    left -= 1
    children = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for child in children:
        if left < 0:
            return left
        left = _nodes(child, left)
    return left


def check_writable(path: Path) -> None:
    """Fail before long work when `path` cannot be written afterwards."""
    parent = path.parent
    if path.is_dir():
        raise BadInputError(f"{shown(path)}: is a folder, expected a file to write")
    if not parent.is_dir():
        raise BadInputError(f"{shown(path)}: cannot be written: there is no folder {shown(parent)}")
    if not os.access(parent, os.W_OK):
        raise BadInputError(f"{shown(path)}: cannot be written: no permission in {shown(parent.resolve())}")


def make_folder(path: Path) -> None:
    """Create a folder to write into, or a `BadInputError` that says why not."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be made a folder: {error.strerror or error}") from error


def write_atomically(path: Path, data: bytes | str) -> None:
    """Replace a file so that at every moment either the old or the new contents are there whole.

    A temporary file beside it is written, flushed to the disk and renamed. Raises `BadInputError`
    when the disk is full or the place cannot be written; the old file then survives.
    """
    raw = data.encode("utf-8") if isinstance(data, str) else data
    check_writable(path)
    target = path.resolve() if path.is_symlink() else path
    temporary: str | None = None
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name[:40]}.", suffix=".tmp", dir=target.parent)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(raw)
            stream.flush()
            os.fsync(stream.fileno())
        mode = target.stat().st_mode & 0o777 if target.exists() else 0o666 & ~_umask()
        Path(temporary).chmod(mode)
        Path(temporary).replace(target)
    except OSError as error:
        raise BadInputError(f"{shown(path)}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            with contextlib.suppress(FileNotFoundError):
                Path(temporary).unlink()
    with contextlib.suppress(OSError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
