"""A rig folder as this process can read it: where it lies, or fetched from a URL into a folder of scratch.

What a server calls its files is not trusted: a name that leads out of the folder is refused, only files
that a rig folder can hold are fetched, and their number and size are limited. A fault on the way is
tried again; a file that is not there is not.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from calib.errors import BadInputError
from calib.files import make_folder, one_line, shown
from calib.fleet.extra import needed
from calib.fleet.manifest import is_url, without_secrets

__all__ = ["MOST_BYTES", "local_folder"]

MOST_BYTES = 4_000_000_000
_MOST_FILES = 20_000
_PIECE = 1 << 20
_SUFFIXES = (
    ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".csv", ".parquet", ".yaml",
)  # fmt: skip
_FOLDERS = ("", "images", "images/plane", "logs")
_FINAL = (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError, NotImplementedError)
"""Another attempt would end in the same; the last is fsspec's for what a kind of URL cannot do."""


def local_folder(source: str, scratch: Path, attempts: int, most_bytes: int = MOST_BYTES) -> Path:
    """The rig's folder: the path itself, or `scratch` with what was fetched.

    Raises `BadInputError` for a folder that is not there or cannot be had.
    """
    if not is_url(source):
        root = Path(source)
        if not root.is_dir():
            what = "is a file" if root.exists() else "is not there"
            raise BadInputError(f"{shown(root)}: {what}, expected the rig's folder")
        return root
    return _fetched(source, scratch, attempts, most_bytes)


def _fetched(url: str, scratch: Path, attempts: int, most_bytes: int) -> Path:
    try:
        system, root = needed("fsspec.core").url_to_fs(url)
    except ImportError as error:
        raise BadInputError(
            f"{without_secrets(url)}: needs a package that is not here: {_words(error)}"
        ) from error
    except (ValueError, OSError) as error:
        raise BadInputError(f"{without_secrets(url)}: is no URL that can be read: {_words(error)}") from error
    told = without_secrets(url)
    listed = _again(partial(_listed, system, str(root), told), attempts, told)
    if not listed:
        raise BadInputError(f"{told}: holds no pictures and no logs")
    total = 0
    for name, remote in listed.items():
        left = most_bytes - total
        target = scratch / name
        make_folder(target.parent)
        total += _again(partial(_copied, system, remote, target, left, told), attempts, told)
    return scratch


def _again(work: Callable[[], Any], attempts: int, told: str) -> Any:
    """What `work` returns; a fault that may pass is given time to."""
    for attempt in range(max(1, attempts)):
        try:
            return work()
        except BadInputError:
            raise
        except _FINAL as error:
            raise BadInputError(f"{told}: cannot be read: {_words(error)}") from error
        except Exception as error:  # each file system has errors of its own
            if attempt + 1 >= max(1, attempts):
                raise BadInputError(
                    f"{told}: could not be fetched in {attempt + 1} attempts: {_words(error)}"
                ) from error
            time.sleep(min(0.2 * 4.0**attempt, 10.0))
    raise AssertionError


_SECRETS = (re.compile(r"(?<=://)[^/@\s]+@"), re.compile(r"(?<=://)([^\s?'\"]*)\?[^\s'\"),]*"))
"""User and password, and the query, of a URL in a text."""


def _words(error: BaseException) -> str:
    text = _SECRETS[1].sub(r"\1", _SECRETS[0].sub("", " ".join(str(error).split())))
    return one_line(text)[:200] or type(error).__name__


def _listed(system: Any, root: str, told: str) -> dict[str, str]:
    """Files to fetch by their names relative to the folder."""
    out: dict[str, str] = {}
    base = root.rstrip("/")
    for folder in _FOLDERS:
        place = f"{base}/{folder}".rstrip("/")
        try:
            entries = system.ls(place, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            if not folder:
                raise
            continue
        for entry in entries:
            remote = str(entry["name"])
            # Of a listing only the last part of a name counts; a server's idea of a path does not.
            name = PurePosixPath(remote.rstrip("/").replace("\\", "/")).name
            if entry.get("type") == "directory" or not name.lower().endswith(_SUFFIXES):
                continue
            if name in ("", ".", "..") or name.startswith((".", "-")) or not name.isprintable():
                raise BadInputError(f"{told}: has a file with the name {one_line(remote)[:80]}")
            out[f"{folder}/{name}" if folder else name] = remote
            if len(out) > _MOST_FILES:
                raise BadInputError(f"{told}: has more than {_MOST_FILES} files")
    return dict(sorted(out.items()))


def _copied(system: Any, remote: str, target: Path, most: int, told: str) -> int:
    """Copy one file and return its size; what a listing says of sizes is not relied on."""
    size = 0
    with system.open(remote, "rb") as source, target.open("wb") as sink:
        while piece := source.read(_PIECE):
            size += len(piece)
            if size > most:
                raise BadInputError(f"{told}: is larger than {1e-9 * MOST_BYTES:g} GB, or than was allowed")
            sink.write(piece)
    return size
